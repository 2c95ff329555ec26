# SPDX-License-Identifier: MIT
"""Who is on the bus: the live list, and the token ring as one station sees it.

The library keeps both; this file gives them words, and asks addresses of which nothing is known: FDL status, and Slave_Diag for
the ident number, which a slave answers to any master without leaving its own. It calls what any program could call.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dpmaster import _arguments
from dpmaster._core import NS
from dpmaster._names import Named
from dpmaster.bus import FdlState, Mode
from dpmaster.diagnosis import StationState
from dpmaster.errors import DPTimeout, StationError

if TYPE_CHECKING:
    from dpmaster.master import Master

__all__ = ["Live", "LiveEntry", "LiveList", "RingView", "entries"]

HIGHEST = 126  # a slave that waits for its address has this one
SHARE = 10  # while stations exchange, slots that nobody answers in take one part in so many of the bus's time
TURN = 1.0  # s to wait for a turn on the bus before looking whether there are any
DIAGNOSIS_SAP, MASTER_SAP = 60, 62


class Live(Named):
    """What an address is (``enum dpm_live``)."""

    UNKNOWN = 0  # not asked yet, or left the ring
    NONE = 1
    SLAVE = 2
    MASTER_NOT_READY = 3
    MASTER_READY = 4
    MASTER_IN_RING = 5

    @property
    def text(self) -> str:
        return ("unknown", "nobody", "slave", "master, not ready for the ring", "master, ready for the ring",
                "master in the ring")[self]


@dataclass(frozen=True, slots=True)
class LiveEntry:
    """One address of the live list. ``ident_number`` of a slave that was asked for it, else None."""

    kind: Live
    ident_number: int | None = None


@dataclass(frozen=True, slots=True)
class RingView:
    """The token ring as a station sees it; times in s.

    ``ts`` is this station, ``ns`` and ``ps`` are its neighbours (itself: alone); None of a listener, which is no member.
    ``las`` is the list of active stations. ``duplicate``: another station has our address, and the bus was left. ``rotations``
    counts the times that the token came, ``rotation`` is the last real rotation time (Trr), None before there was one.
    """

    ts: int | None
    ns: int | None
    ps: int | None
    las: tuple[int, ...]
    duplicate: bool
    rotations: int
    rotation: float | None
    rotation_min: float | None
    rotation_max: float | None

    @classmethod
    def of(cls, view: Any, member: bool = True) -> RingView:
        """From a ``dpm_ring_view``."""
        las = tuple(n for n in range(HIGHEST) if view.las[n // 8] >> n % 8 & 1)
        ts, ns, ps = (view.ts, view.ns, view.ps) if member else (None, None, None)
        last, least, most = (view.trr / NS, view.trr_min / NS, view.trr_max / NS) if view.trr else (None, None, None)
        return cls(ts, ns, ps, las, view.duplicate, view.rotations, last, least, most)


def entries(view: Any, addresses: Iterable[int], idents: Mapping[int, int] | None = None) -> dict[int, LiveEntry]:
    """The live list of a ``dpm_ring_view``."""
    found = {address: Live(view.live[address]) for address in addresses}
    idents = idents or {}
    return {address: LiveEntry(kind, idents.get(address) if kind == Live.SLAVE else None) for address, kind in found.items()}


class LiveList:
    """The live list of one master: what it knows, and its way to ask for the rest."""

    def __init__(self, master: Master) -> None:
        self._master = master
        self._idents: dict[int, int] = {}

    def read(self, view: Any, highest: int) -> dict[int, LiveEntry]:
        """What is known, ident numbers of our own stations in Data_Exchange included."""
        return entries(view, self._others(highest), self._idents | {s.address: s.ident_number for s in self._exchanging()})

    def ask(self, known: Mapping[int, LiveEntry], *, identify: bool, refresh: bool, timeout: float | None) -> None:
        """FDL status of the addresses that are unknown, or of all; those that cannot be asked in time stay as they are."""
        _arguments.timeout(timeout)
        deadline = None if timeout is None else time.monotonic() + timeout
        if refresh:
            self._idents.clear()
        for address in self._in_turn(known, deadline):
            found = known[address].kind
            if refresh or found == Live.UNKNOWN:
                found = self._status(address, deadline)
            if found != Live.SLAVE:
                self._idents.pop(address, None)
            elif identify and address not in self._idents:
                self._identify(address, deadline)

    def _others(self, highest: int) -> Iterator[int]:
        return (address for address in range(highest + 1) if address != self._master.address)

    def _exchanging(self) -> list[Any]:
        return [station for station in self._master.stations if station.state == StationState.DATA]

    def _in_turn(self, addresses: Iterable[int], deadline: float | None) -> Iterator[int]:
        """All but our own in Data_Exchange, which are known well, while there is time and the bus is ours to ask."""
        for address in addresses:
            if (deadline is not None and time.monotonic() >= deadline) or self._silent():
                return
            if all(station.address != address for station in self._exchanging()):
                yield address

    def _silent(self) -> bool:
        """Another master has the bus, and we are to be its only one; or somebody has our address."""
        status = self._master._bus.status()
        gave_way = status.foreign >= 0 and status.fdl_state == FdlState.LISTEN_TOKEN and not self._master._in_ring
        return bool(status.mode == Mode.OFFLINE or gave_way)

    def _status(self, address: int, deadline: float | None) -> Live:
        try:
            answer = self._request(address, "FDL_STATUS", deadline)
        except StationError:
            self._make_room()
            return Live.NONE
        return Live.UNKNOWN if answer is None else Live(Live.SLAVE + ((answer.fc or 0) >> 4 & 3))

    def _identify(self, address: int, deadline: float | None) -> None:
        try:
            answer = self._request(address, "SRD", deadline, DIAGNOSIS_SAP, MASTER_SAP)
        except StationError:
            return
        if answer is not None and len(answer.data) >= 6:
            self._idents[address] = int.from_bytes(answer.data[4:6], "big")

    def _request(self, address: int, service: str, deadline: float | None, dsap: int | None = None,
                 ssap: int | None = None) -> Any:
        """The answer; None when there was no turn in time. Raises StationError when nobody answers."""
        while not self._silent():
            left = TURN if deadline is None else min(TURN, deadline - time.monotonic())
            if left <= 0:
                break
            try:
                return self._master.request(address, service, dsap, ssap, timeout=left)
            except DPTimeout:
                continue
        return None

    def _make_room(self) -> None:
        """A slot that nobody answered in has held up the cycle: let that go on for a while."""
        if self._exchanging():
            parameters, bus = self._master.parameters, self._master._bus
            slot = parameters.seconds(parameters.tsl) + bus.late
            bus.wait(lambda: None, (SHARE - 1) * slot)


