# SPDX-License-Identifier: MIT
"""A console for an emulated slave: what its master does is printed as it changes, lines on stdin set inputs and diagnosis.

Changes that come faster than they can be read are joined: the newest is printed. Without input, or with its end, it goes
on printing.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable

from dpmaster.emulator.cards import GenericSlave
from dpmaster.emulator.host import Host
from dpmaster.errors import ConfigurationError, DPError

LOOK = 0.05  # s between two looks at the slave

HELP = """\
in OFFSET = OCTETS   set inputs from an octet on: in 0 = 12 34 (octets are hexadecimal)
in = OCTETS          set all of them
diag OCTETS          diagnosis behind the six standard octets; the words "static" and "status" (no fault) may follow
diag                 no diagnosis
ready on|off         Station_Not_Ready
unplug, plug, reset  the bus connector, the power
show                 state, outputs and inputs
help                 this"""


class Console:
    """One slave and its host, and a command for each first word."""

    def __init__(self, host: Host, slave: GenericSlave) -> None:
        self._host, self._slave = host, slave
        self._printed: list[str] = []
        self._commands: dict[str, Callable[[str], None]] = {
            "in": self._in, "diag": self._diag, "ready": self._ready, "show": lambda _: self._show(True),
            "unplug": lambda _: host.unplug(slave), "plug": lambda _: host.plug(slave), "reset": lambda _: host.reset(slave),
            "help": lambda _: print(HELP, flush=True),
        }

    def stay(self) -> None:
        """Until a signal raises KeyboardInterrupt; or the error of what went wrong meanwhile."""
        listening, rest = sys.stdin is not None, b""
        while True:
            self._show()
            if not select.select([0] if listening else [], [], [], LOOK)[0] or not in_front():
                self._host.check()
                continue
            got = os.read(0, 4096)
            *lines, rest = (rest + got).split(b"\n") if got else (rest, b"")
            listening = bool(got)
            for line in lines:
                self._obey(line.decode("utf-8", "replace").strip())

    def _obey(self, line: str) -> None:
        word, _, rest = line.partition(" ")
        if not word or word.startswith("#"):
            return
        try:
            if word not in self._commands:
                raise ConfigurationError(f"{word!r} is no command here: {', '.join(self._commands)}")
            self._commands[word](rest.strip())
        except DPError as error:
            print(f"dpmaster emulate: {error}", file=sys.stderr, flush=True)

    def _show(self, all_of_it: bool = False) -> None:
        lines = self._lines()
        before = [""] * len(lines) if all_of_it or not self._printed else self._printed
        for new, old in zip(lines, before, strict=True):
            if new != old:
                print(new, flush=True)
        if all_of_it:
            print(f"inputs {self._slave.inputs.hex(' ') or 'none'}", flush=True)
        self._printed = lines

    def _lines(self) -> list[str]:
        """State and outputs, each a line that is printed when it changed."""
        slave, exchange = self._slave, self._slave.exchange
        state = f"address {slave.address}, {exchange.state}"
        if exchange.master is not None:
            state += f", master {exchange.master}"
        if exchange.configuration >= 0:
            state += f", configuration {slave.configurations[exchange.configuration].hex(' ')}"
        return [state, f"outputs {slave.outputs.hex(' ') or 'none'}{'' if exchange.valid else ' (not valid)'}"]

    def _in(self, rest: str) -> None:
        where, equals, octets = rest.partition("=")
        if not equals:
            raise ConfigurationError(f"in {rest}: in OFFSET = OCTETS, or in = OCTETS")
        set_inputs(self._slave, where, octets)

    def _diag(self, rest: str) -> None:
        words = rest.split()
        static, status = "static" in words, "status" in words
        blocks = octets_of("diag", " ".join(word for word in words if word not in ("static", "status")))
        self._slave.diagnosis(blocks, fault=False if status else None, static=static)

    def _ready(self, rest: str) -> None:
        if rest not in ("on", "off"):
            raise ConfigurationError(f"ready {rest}: on or off")
        self._slave.ready = rest == "on"


def in_front() -> bool:
    """Whether reading is ours: a background job that reads its terminal would be stopped."""
    try:
        return os.tcgetpgrp(0) == os.getpgrp()
    except OSError:  # no terminal
        return True


def octets_of(name: str, text: str) -> bytes:
    """Octets in hexadecimal."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ConfigurationError(f"{name} {text.strip()!r}: octets in hexadecimal, like 12 34") from None


def set_inputs(slave: GenericSlave, where: str, octets: str) -> None:
    """Inputs from the octet `where` on, or all of them where that is empty."""
    found = octets_of("in", octets)
    if not where.strip():
        slave.inputs = found
    elif where.strip().isdecimal():
        slave.update(int(where), found)
    else:
        raise ConfigurationError(f"in {where.strip()!r}: the offset is a whole number")
