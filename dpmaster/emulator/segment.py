# SPDX-License-Identifier: MIT
"""A piece of virtual RS-485 wire with ports (ptys) and emulated cards on it: the Python face of the segment hub (segment.h).

What one port writes all others hear. Unpaced, octets take no time; paced, a telegram is delivered when its last octet
would have ended, and transmissions that overlap garble one another.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from typing import Any

from dpmaster._arguments import number
from dpmaster._core import NS, check, ffi, lib
from dpmaster.emulator.host import CardT, Host, bus_parameters
from dpmaster.errors import ConfigurationError
from dpmaster.realtime import Realtime, schedule, wished

__all__ = ["PortPath", "Segment", "SegmentInfo"]

NOMINAL = 12_000_000  # bit/s whose times the cards of an unpaced segment keep: the shortest there are


class PortPath(str):
    """The path of a segment's port, which knows what wire is behind it, and keeps it."""

    number: int
    paced: bool
    """A character takes its time on this wire."""
    baudrate: int
    """bit/s of the pace, or whose times the cards keep."""
    _wire: Segment | None

    def __new__(cls, path: str, number: int, paced: bool, baudrate: int, wire: Segment | None = None) -> PortPath:
        self = super().__new__(cls, path)
        self.number, self.paced, self.baudrate, self._wire = number, paced, baudrate, wire
        return self


@dataclass(frozen=True, slots=True)
class SegmentInfo:
    """Counters of a segment; times in seconds."""

    transmissions: int
    octets: int
    collisions: int
    """Transmissions that overlapped another (paced segments only)."""
    faults: int
    """Octets or transmissions touched by faults."""
    undelivered: int
    """Octets lost: a port's reader did not fetch them in time, or their wire was cut."""
    deliveries: int
    late_max: float
    """Paced: how long after its due time a delivery came, at most and in the mean."""
    late_mean: float
    failures: tuple[BaseException, ...]
    """What cards have raised."""


class Segment(Host):
    """A wire of this process. `baudrate` (bit/s) paces it, None does not; `nominal` is the rate whose times (min Tsdr)
    attached cards keep when it is unpaced. With `echo` every port hears itself. `ports` and `cards` are the most there
    can be (0..64, 0..126). `realtime` schedules the hub's thread as `Master`'s, if it is asked for; what came of it is in
    `scheduling`.

    A port exists on the wire while somebody has it open: who opens it hears what is said from then on. The wire lasts as
    long as the program has it, a `port()` of it (a copy of that path keeps nothing) or a card on it, unless it is closed first.
    """

    _room = "dpm_segment"
    _last: Any = None

    def __init__(self, baudrate: int | None = None, *, echo: bool = False, ports: int = 8, cards: int = 32,
                 nominal: int = NOMINAL, realtime: Realtime | bool | None = None) -> None:
        super().__init__()
        wished(realtime)
        for name, value, most in ("ports", ports, lib.DPM_SEGMENT_PORTS), ("cards", cards, 126):
            if not isinstance(value, int) or not 0 <= value <= most:
                raise ConfigurationError(f"{name} {value!r}: a segment takes 0 to {most}")
        self.baudrate = baudrate
        self._rate = nominal if baudrate is None else baudrate
        self._ports: list[PortPath] = []
        self._room_for = ports, cards
        config = ffi.new("dpm_segment_config *")
        config.parameters = bus_parameters(self._rate)[0]
        config.paced, config.echo, config.ports, config.slaves = baudrate is not None, echo, ports, cards
        size = lib.dpm_segment_size(config)
        memory = self._keep(size)
        try:
            check(lib.dpm_segment_open(memory, size, config, self._opened), "open a segment", ports=ports)
            check(lib.dpm_segment_start(self._object), "start a segment")
            self.scheduling = schedule(realtime, False, partial(self._call, "realtime"), [memory], "the segment's hub")
            self._begin()
        except BaseException:
            self._end()
            raise

    def _add(self, config: Any, outputs: Any, inputs: Any) -> int:
        if len(self._slots) >= self._room_for[1]:
            cards = self._room_for[1]
            raise ConfigurationError(f"cards {cards}: this segment is full; open it with Segment(cards={cards + 1})")
        return self._call("attach", config, outputs, inputs)

    def _shut(self) -> None:
        self._last = self._last or self._info()
        lib.dpm_segment_close(self._object)

    def attach(self, card: CardT) -> CardT:
        """Put a card on the wire, powered and plugged in; returns it."""
        return self._attach(card)

    def port(self) -> PortPath:
        """A port nobody was given yet. Its path is good until the segment is closed."""
        self._guard()
        with self._lock:
            index, limit = len(self._ports), self._room_for[0]
            if index >= limit:
                raise ConfigurationError(f"ports {limit}: all are handed out; open it with Segment(ports={limit + 1})")
            path = os.fsdecode(ffi.string(lib.dpm_segment_path(self._object, index)))
            self._ports.append(PortPath(path, index, self.baudrate is not None, self._rate, self))
            return self._ports[index]

    def faults(self, *, seed: int = 0, lose: float = 0.0, flip: float = 0.0, parity: float = 0.0, insert: float = 0.0,
               duplicate: float = 0.0, lose_telegram: float = 0.0, delay: float = 0.0, chunk: float = 0.0) -> None:
        """Make faults from now on, or with no argument none. Chances are per octet (`lose_telegram`: per transmission),
        0.0 to 1.0. `flip` changes a bit and the parity bit with it, so no receiver's UART notices; `parity` changes a bit that
        it does notice: our ports and cards have a line error, foreign programs a wrong octet. `delay` in seconds, 0 to 10, is
        added to every delivery; ports' readers have octets only every `chunk` s, as USB adapters deliver them (0.001, 0.016),
        attached cards at once. The same seed and the same octets give the same faults."""
        self._guard()
        faults = ffi.new("dpm_segment_faults *", {"seed": seed & 0xFFFF_FFFF_FFFF_FFFF})
        chances = {"lose": lose, "flip": flip, "parity": parity, "insert": insert, "duplicate": duplicate,
                   "lose_telegram": lose_telegram}
        for name, chance in chances.items():
            if not number(chance) or not 0.0 <= chance <= 1.0:
                raise ConfigurationError(f"{name} {chance!r}: a chance is 0.0 to 1.0")
            setattr(faults, name, round(chance * 1_000_000))
        for name, time in (("delay", delay), ("chunk", chunk)):
            if not number(time) or not 0.0 <= time <= 10.0:
                raise ConfigurationError(f"{name} {time!r}: 0 to 10 seconds")
            setattr(faults, name, round(time * NS))
        check(self._call("set_faults", faults), "faults of a segment")

    def cut(self, port: str) -> None:
        """Cut a port's wire: nothing passes either way."""
        self._set_cut(port, True)

    def join(self, port: str) -> None:
        """Join a port's wire again."""
        self._set_cut(port, False)

    def pull_out(self, port: str) -> None:
        """Pull a port out, as a USB adapter: whoever has it open sees it vanish."""
        check(self._call("plug", self._known(port).number, False), f"pull out {port}")

    def plug_in(self, port: str) -> PortPath:
        """Plug a port in again, which has been pulled out or not: the path it has from now on."""
        known = self._known(port)
        check(self._call("plug", known.number, True), f"plug in {port}")
        path = os.fsdecode(ffi.string(lib.dpm_segment_path(self._object, known.number)))
        self._ports[known.number] = PortPath(path, known.number, known.paced, known.baudrate, self)
        return self._ports[known.number]

    def _set_cut(self, port: str, cut: bool) -> None:
        check(self._call("cut", self._known(port).number, cut), f"cut {port}")

    def _known(self, port: str) -> PortPath:
        self._guard()
        for known in self._ports:
            if known == port:
                return known
        raise ConfigurationError(f"port {port!r} is none of this segment's: {', '.join(self._ports) or 'none handed out'}")

    def _info(self) -> Any:
        info = ffi.new("dpm_segment_info *")
        check(lib.dpm_segment_get_info(self._object, info), "read a segment's counters")
        return info

    @property
    def info(self) -> SegmentInfo:
        """The counters; those of the end after close()."""
        self._process.guard("this Segment")
        info = self._last or self._info()
        return SegmentInfo(
            transmissions=info.transmissions, octets=info.octets, collisions=info.collisions, faults=info.faults,
            undelivered=info.undelivered, deliveries=info.deliveries, late_max=info.late_max / NS,
            late_mean=info.late_sum / NS / info.deliveries if info.deliveries else 0.0, failures=self.failures,
        )
