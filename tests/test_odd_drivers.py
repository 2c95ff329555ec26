# SPDX-License-Identifier: MIT
"""Drivers that no machine has at hand, as odd_driver.c plays them on a pty: what they say and what is made of it.

What they do is from the kernel's sources. Real drivers in a real kernel are uart.py's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dpmaster._core import lib

pytestmark = pytest.mark.tree

HERE = Path(__file__).resolve().parent
SC16IS752 = {"driver": "sc16is7xx", "major": "204", "base": "921600", "most": "921600"}  # sc16is7xx.c: uartclk / 16
SC16IS752_24 = SC16IS752 | {"base": "1500000", "most": "1500000"}  # 24 MHz; its driver cuts its divisor off
PL011 = {"driver": "uart-pl011", "major": "204", "base": "1500000", "most": "1500000"}
FT232R = {"driver": "ftdi_sio", "major": "188", "base": "24000000", "most": "3000000"}
CH340 = {"driver": "ch341-uart", "major": "188"}  # ch341.c never calls tty_encode_baud_rate
BEGIN = """
import fcntl, json, os, pty, struct, sys, termios
from dpmaster.ports import Port
from test_port import Port as Opened
far, near = pty.openpty()
path = os.ttyname(near)
"""

Played = Callable[..., Any]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    """Run a program with the driver that `driver` describes; returns what it prints."""
    library = tmp_path_factory.mktemp("driver") / "odd.so"
    subprocess.run(["cc", "-std=c11", "-D_GNU_SOURCE", "-shared", "-fPIC", str(HERE / "odd_driver.c"), "-o", str(library),
                    "-ldl"], check=True)

    def run(driver: dict[str, str], program: str) -> Any:
        odd = {f"ODD_{name.upper()}": value for name, value in driver.items()}
        preload = " ".join(filter(None, (os.environ.get("LD_PRELOAD"), str(library))))
        done = subprocess.run(
            [sys.executable, "-c", BEGIN + program], capture_output=True, text=True, timeout=60,
            env=os.environ | odd | {"LD_PRELOAD": preload, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])})
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


RATES = """
port = Port(path, "uart")
print(json.dumps([[rate.nominal for rate in port.rates() if rate.made is not None], port.repeats]))
"""


@pytest.mark.parametrize(("driver", "made", "repeats"), [
    (SC16IS752, [9600, 19200], False),  # protocol page N.1: "14.7456 MHz crystal -> no 93.75k/500k"
    (SC16IS752_24, [9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000], False),
    (PL011, [9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000], False),
    (FT232R, [9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000, 3000000], False),
    (CH340, [9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000, 3000000, 6000000, 12000000], True),
], ids=["SC16IS752", "SC16IS752 at 24 MHz", "PL011", "FT232R", "CH340"])
def test_what_a_driver_says_of_its_rates_is_judged(
        played: Played, driver: dict[str, str], made: list[int], repeats: bool) -> None:
    assert played(driver, RATES) == [made, repeats]


ENABLED, ON_SEND, AFTER_SEND, RX_DURING_TX, TERMINATE_BUS = 1, 2, 4, 16, 32  # protocol page N.2
RS422 = 1 << 9  # include/uapi/linux/serial.h, SER_RS485_MODE_RS422 of Linux 6.8
ANY = ENABLED | ON_SEND | AFTER_SEND | RX_DURING_TX | TERMINATE_BUS | RS422
# Direction, flags that the driver knows, those that never leave it, those before; code, whether it switches, flags after.
MODES = [
    ("AUTO", ANY, 0, ENABLED | ON_SEND, 0, 1, ENABLED | ON_SEND),
    ("AUTO", ANY, 0, ENABLED | RS422, 0, 0, ENABLED | RS422),
    ("RS485", ANY, 0, 0, 0, 1, ENABLED | ON_SEND),
    ("RS485", ANY, 0, ENABLED | AFTER_SEND | RX_DURING_TX, 0, 1, ENABLED | ON_SEND | RX_DURING_TX),
    ("RS485", ANY, 0, ENABLED | RS422 | TERMINATE_BUS, 0, 1, ENABLED | ON_SEND | TERMINATE_BUS),
    ("RS485_INVERTED", ANY, 0, ENABLED | RS422, 0, 1, ENABLED | AFTER_SEND),
    ("RS485", ANY, RS422, ENABLED | RS422, lib.DPM_E_RS485, 0, ENABLED | RS422),
    ("RS485", ANY, AFTER_SEND, ENABLED | ON_SEND, lib.DPM_E_RS485, 0, ENABLED | ON_SEND | AFTER_SEND),
    ("RS485", ENABLED | ON_SEND, 0, 0, 0, 1, ENABLED | ON_SEND),
    ("RS485_INVERTED", ENABLED | ON_SEND, 0, 0, lib.DPM_E_RS485, 0, 0),
    ("RS485_INVERTED", ENABLED | ON_SEND, 0, ENABLED | ON_SEND, lib.DPM_E_RS485, 0, ENABLED | ON_SEND),
]


def test_what_a_driver_makes_of_the_rs485_mode_is_judged(played: Played) -> None:
    """Protocol page N.2: "The ioctl returns the accepted set: check". RTS at the wrong level, or RS-422, keeps a transceiver
    sending over every answer; a mode that is refused is not left behind."""
    asked = [[getattr(lib, f"DPM_DIRECTION_{mode[0]}"), *mode[1:4]] for mode in MODES]
    assert played(PL011, f"""
found = []
for direction, knows, stays, before in {asked}:
    os.environ.update(ODD_RS485=str(knows), ODD_STAYS=str(stays))
    fcntl.ioctl(near, 0x542F, struct.pack("I28x", before))  # TIOCSRS485
    port = Opened(path, direction=direction)
    switches = port.code == 0 and port.info.rs485
    port.close()
    flags, = struct.unpack_from("I", fcntl.ioctl(near, 0x542E, bytes(32)))  # TIOCGRS485
    found.append([port.code, int(switches), flags])
print(json.dumps(found))
""") == [list(mode[4:]) for mode in MODES]


@pytest.mark.parametrize(("empty", "told"), [(None, [False] * 4), ("1", [True, False, False, False]), ("99", [True] * 4)])
def test_a_driver_that_never_tells_the_end_is_waited_for_once(played: Played, empty: str | None, told: list[bool]) -> None:
    """The rest is computed: 11 bits a character (protocol page A), and no later than write() and the allowance allow."""
    found, late = played(PL011 | ({"empty": empty} if empty else {}), """
port = Opened(path, rate=500_000, allowance=30_000_000)
found, late = [port.info.drains], []
for _ in range(3):
    port.write(bytes(6))
    start, earliest, latest, _ = port.recorder.take("sent")[0]
    found.append(port.info.drains)
    late.append(earliest - start >= 132_000 and latest >= earliest)
print(json.dumps([found, late]))
""")
    assert found == told
    assert all(late)


def test_a_port_that_is_refused_stays_as_it_was(played: Played) -> None:
    """It may be somebody's console."""
    assert played(PL011, """
before = termios.tcgetattr(near)
code = Opened(path, rate=3_000_000).code
print(json.dumps([code, [str(each) for each in before] == [str(each) for each in termios.tcgetattr(near)]]))
""") == [lib.DPM_E_RATE, True]


def test_who_is_turned_away_does_not_open_the_port_to_others(played: Played) -> None:
    """Ioctl_tty(2): TIOCEXCL "has no effect for a process with CAP_SYS_ADMIN"; TIOCGEXCL tells whether it is set."""
    assert played(PL011, """
TIOCGEXCL = 0x80045440
def exclusive():
    return struct.unpack("i", fcntl.ioctl(near, TIOCGEXCL, bytes(4)))[0]
first = Opened(path)
found = [first.code, exclusive()]
found += [Opened(path).code, exclusive()]
first.close()
found += [exclusive()]
fcntl.ioctl(near, termios.TIOCEXCL)  # another program's, which takes no lock
found += [Opened(path).code, exclusive()]
print(json.dumps(found))
""") == [0, 1, lib.DPM_E_IN_USE, 1, 0, lib.DPM_E_IN_USE, 1]
