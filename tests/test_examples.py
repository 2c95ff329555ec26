# SPDX-License-Identifier: MIT
"""What lies in examples/ runs as it is, and what the service tells systemd."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

pytestmark = pytest.mark.tree


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment(cards=1, ports=1) as made:
        yield made


def start(example: str, *arguments: str, **env: str) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(EXAMPLES.parent), *sys.path])} | env
    return subprocess.Popen([sys.executable, str(EXAMPLES / example), *arguments], env=environment, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True)


def test_the_hat(wire: Segment) -> None:
    card = wire.attach(SIP1(address=5))
    program = start("hat.py", wire.port(), "500000", "5", "1.0")
    out, error = program.communicate(timeout=60)
    assert program.returncode == 0, error
    assert "exchanges" in out and " Hz" in out
    assert wire.report(card).exchanges > 20


def test_the_service_tells_systemd_and_leaves_the_drive_at_rest(wire: Segment, tmp_path: Path) -> None:
    """sd_notify(3): READY=1 once, WATCHDOG=1 more often than WatchdogSec, STOPPING=1 on SIGTERM."""
    card = wire.attach(SIP1(address=5))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(60)
        program = start("service.py", wire.port(), NOTIFY_SOCKET=str(tmp_path / "notify"))
        try:
            assert manager.recv(256).decode().startswith("READY=1\n")
            assert manager.recv(256).decode().startswith("WATCHDOG=1\n")
            program.send_signal(signal.SIGTERM)
            while not (said := manager.recv(256).decode()).startswith("STOPPING=1"):
                assert said.startswith("WATCHDOG=1\n")
            _, error = program.communicate(timeout=60)
        finally:
            program.kill()
            program.communicate()
    assert program.returncode == 0, error
    assert card.motor.frequency < 20 and not wire.failures


def test_the_unit_says_so_often_enough() -> None:
    """sd_watchdog_enabled(3): at least twice within WatchdogSec."""
    unit = dict(line.split("=", 1) for line in (EXAMPLES / "dpmaster.service").read_text().splitlines()
                if "=" in line and not line.startswith("#"))
    alive = float(re.search(r"^ALIVE = ([\d.]+)", (EXAMPLES / "service.py").read_text(), re.MULTILINE)[1])  # type: ignore[index]
    assert 2 * alive <= float(unit["WatchdogSec"])
    assert (unit["Type"], unit["Restart"], unit["LimitMEMLOCK"]) == ("notify", "always", "infinity")
    assert int(unit["LimitRTPRIO"]) >= 40
    assert float(unit["TimeoutStopSec"]) > 3
