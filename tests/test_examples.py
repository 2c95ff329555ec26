# SPDX-License-Identifier: MIT
"""What lies in examples/ runs as it is, and what the service tells systemd."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from children import child
from waiting import until

from dpmaster.emulator import Segment
from dpmaster.emulator.card import SlaveState
from dpmaster.emulator.cards import SIP1

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

pytestmark = pytest.mark.tree


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment(cards=1, ports=1) as made:
        yield made


def start(example: str, *arguments: str, **env: str) -> AbstractContextManager[subprocess.Popen[str]]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(EXAMPLES.parent), *sys.path])} | env
    return child(str(EXAMPLES / example), *arguments, env=environment)


def notices(manager: socket.socket, path: Path) -> Callable[[], str]:
    manager.bind(str(path))
    manager.settimeout(60)
    return lambda: manager.recv(256).decode()


def test_the_hat(wire: Segment) -> None:
    card = wire.attach(SIP1(address=5))
    with start("hat.py", wire.port(), "500000", "5", "1.0") as program:
        out, error = program.communicate(timeout=60)
    assert program.returncode == 0, error
    assert "exchanges" in out and " Hz" in out
    assert wire.report(card).exchanges > 20


def test_the_service_tells_systemd_and_leaves_the_drive_at_rest(wire: Segment, tmp_path: Path) -> None:
    """sd_notify(3): READY=1 once, WATCHDOG=1 more often than WatchdogSec, STOPPING=1 on SIGTERM."""
    card = wire.attach(SIP1(address=5))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        said = notices(manager, tmp_path / "notify")
        with start("service.py", wire.port(), NOTIFY_SOCKET=str(tmp_path / "notify")) as program:
            assert said().startswith("READY=1\n")
            assert said().startswith("WATCHDOG=1\n")
            program.send_signal(signal.SIGTERM)
            while (words := said()) != "STOPPING=1":
                assert words.startswith("WATCHDOG=1\n")
            _, error = program.communicate(timeout=60)
    assert program.returncode == 0, error
    assert card.motor.frequency < 20 and not wire.failures


def test_a_service_whose_port_vanishes_ends_with_one_line(wire: Segment, tmp_path: Path) -> None:
    """So that systemd starts it anew."""
    card, port = wire.attach(SIP1(address=5)), wire.port()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        said = notices(manager, tmp_path / "notify")
        with start("service.py", port, NOTIFY_SOCKET=str(tmp_path / "notify")) as program:
            assert said().startswith("READY=1\n")
            wire.pull_out(port)
            _, error = program.communicate(timeout=60)
    assert program.returncode == 1
    assert f"service.py: port {port}: the port vanished" in error and "Traceback" not in error
    until(lambda: wire.report(card).state != SlaveState.DATA_EXCH)


def test_a_service_that_is_told_to_end_before_there_is_a_drive_ends(wire: Segment, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        said = notices(manager, tmp_path / "notify")
        with start("service.py", wire.port(), NOTIFY_SOCKET=str(tmp_path / "notify")) as program:
            until(lambda: wire.info.transmissions > 10)
            program.send_signal(signal.SIGTERM)
            assert said() == "STOPPING=1"
            _, error = program.communicate(timeout=60)
    assert (program.returncode, "Traceback" in error) == (0, False), error


def test_the_firmware_understands_what_the_raspberry_pi_page_gives_it() -> None:
    """Raspberry Pi documentation, config.txt: one property=value a line, comments "by starting a line with the # character",
    98 characters at most."""
    page = (EXAMPLES.parent / "docs" / "raspberry-pi.md").read_text()
    (lines,) = re.findall(r"^```\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    for line in lines.splitlines():
        assert len(line) <= 98 and re.fullmatch(r"# .*|#?\w+=[\w,=-]+", line), line


def test_the_unit_is_one_that_systemd_reads(tmp_path: Path) -> None:
    """With a program that is there. What is bound to a device comes back only if the device wants it."""
    text = (EXAMPLES / "dpmaster.service").read_text()
    assert re.findall(r"^(?:BindsTo|After|WantedBy)=(.*)", text, re.MULTILINE) == 3 * ["dev-profibus.device"]
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd here")
    unit = tmp_path / "dpmaster.service"
    unit.write_text(text.replace("/opt/dpmaster/bin/python", sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_unit_says_so_often_enough() -> None:
    """sd_watchdog_enabled(3): at least twice within WatchdogSec."""
    unit = dict(line.split("=", 1) for line in (EXAMPLES / "dpmaster.service").read_text().splitlines()
                if "=" in line and not line.startswith("#"))
    alive = float(re.search(r"^ALIVE = ([\d.]+)", (EXAMPLES / "service.py").read_text(), re.MULTILINE)[1])  # type: ignore[index]
    assert 2 * alive <= float(unit["WatchdogSec"])
    assert (unit["Type"], unit["Restart"], unit["LimitMEMLOCK"]) == ("notify", "always", "infinity")
    assert int(unit["LimitRTPRIO"]) >= 40
    assert float(unit["TimeoutStopSec"]) > 3
