# SPDX-License-Identifier: MIT
"""How punctual the bus thread of this computer is: a master with a fixed cycle time, and how late each cycle began.

The lateness is counted by the thread itself, against a raster that never moves. On a port of one's own, or on a virtual wire of
this process, where an emulated card answers.
"""

from __future__ import annotations

import platform
from contextlib import ExitStack
from dataclasses import dataclass
from html import escape

from dpmaster._arguments import seconds as check_seconds
from dpmaster._core import NS, lib
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1
from dpmaster.errors import DPError
from dpmaster.master import Master
from dpmaster.realtime import Realtime, Scheduling
from dpmaster.station import Station

__all__ = ["Class", "Punctuality", "measure"]


@dataclass(frozen=True, slots=True)
class Class:
    """Cycles that began at most `below` us late, and more than half of that; the last class has no bound (None)."""

    below: int | None
    cycles: int


@dataclass(frozen=True, slots=True)
class Punctuality:
    """What was counted. Times in s; ``skipped``: cycles that had no time at all, the one before took theirs."""

    port: str
    cycle_time: float
    cycles: int
    skipped: int
    worst: float
    classes: tuple[Class, ...]
    scheduling: Scheduling
    machine: str

    def within(self, share: float) -> int | None:
        """us within which at least this share of the cycles began; None: beyond the last bound."""
        total = 0
        for each in self.classes:
            total += each.cycles
            if total >= share * self.cycles:
                return each.below
        return None

    @property
    def title(self) -> str:
        how = f"SCHED_FIFO {self.scheduling.priority}" if self.scheduling.priority else "ordinary scheduling"
        return f"{self.machine}; {self.cycles} cycles of {self.cycle_time * 1000:g} ms on {self.port}, {how}"


def measure(port: str | None = None, baudrate: int = 500_000, *, cycle_time: float = 0.002, duration: float = 10.0,
            realtime: Realtime | bool = True, station: Station | None = None) -> Punctuality:
    """Run a master for `duration` s. port: None: a virtual wire, with an SI-P1 on it. station: on a real port the slave to
    exchange data with, in Clear, so that its outputs stay zero; None: the bus has the token only. Raises PortError, also when
    the port vanishes meanwhile, ConfigurationError, DPError when no cycle began.
    """
    check_seconds("duration", duration, 86_400)
    with ExitStack() as stack:
        if port is None:
            wire = stack.enter_context(Segment(nominal=baudrate, ports=1, cards=1, realtime=realtime))
            card = wire.attach(SIP1(address=5))
            station = Station(card.address, card.ident_number, card.configurations[0])
        where = port if port is not None else wire.port()
        master = stack.enter_context(Master(where, baudrate, cycle_time=cycle_time, realtime=realtime))
        if station is not None:
            master.add(station)
        master.clear()
        master._await_stations(5.0)
        before = master._bus.status().lateness
        counts, skipped = list(before.counts), before.skipped
        master._bus.wait(lambda: None, duration)
        master._bus.check_port()
        status = master._bus.status().lateness
        scheduling = master.statistics.port.scheduling
    classes = [Class(None if n == lib.DPM_LATENESS_CLASSES - 1 else 2 << n, after - counts[n])
               for n, after in enumerate(status.counts)]
    if not any(each.cycles for each in classes):
        raise DPError(f"no cycle of {cycle_time * 1000:g} ms began within {duration:g} s: measure longer, and where "
                      "no other master has the bus")
    while len(classes) > 1 and not classes[-1].cycles:
        classes.pop()
    return Punctuality(
        port="a virtual wire" if port is None else str(port), cycle_time=cycle_time, cycles=sum(c.cycles for c in classes),
        skipped=status.skipped - skipped, worst=status.max / NS, classes=tuple(classes), scheduling=scheduling,
        machine=f"{platform.node()}, {platform.machine()}, Linux {platform.release()}")


def svg(found: Punctuality) -> str:
    """The histogram as a picture; bars are logarithmic, as the rare late ones matter most."""
    width, height, left, top, step = 720, 320, 20, 56, 680 / len(found.classes)
    most = max(each.cycles for each in found.classes).bit_length() or 1
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="11">',
             f'<rect width="{width}" height="{height}" fill="white"/>',
             f'<text x="{left}" y="22" font-size="13">How late cycles of the bus thread began</text>',
             f'<text x="{left}" y="40" fill="#555">{escape(found.title)}</text>']
    for n, each in enumerate(found.classes):
        x, tall = left + n * step, 200 * each.cycles.bit_length() / most
        label = f"&lt; {each.below}" if each.below else "more"
        parts += [f'<rect x="{x:.1f}" y="{top + 210 - tall:.1f}" width="{step - 4:.1f}" height="{tall:.1f}" fill="#2a6f97"/>',
                  f'<text x="{x:.1f}" y="{top + 205 - tall:.1f}">{each.cycles or ""}</text>',
                  f'<text x="{x:.1f}" y="{top + 226}">{label}</text>']
    summary = f"us late; bars logarithmic; at most {found.worst * 1e6:.0f} us, {found.skipped} cycles skipped"
    parts += [f'<text x="{left}" y="{height - 12}" fill="#555">{summary}</text>', "</svg>"]
    return "\n".join(parts) + "\n"
