# SPDX-License-Identifier: MIT
"""The bus cycle as a program sees it: a loop over cycles, and how late a fixed cycle time's cycles begin.

It waits through `bus` and knows neither stations nor modes' rules; `Master.cycles` makes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dpmaster import _arguments
from dpmaster._core import NS
from dpmaster.bus import Bus, Mode
from dpmaster.errors import ClosedError, DPTimeout, NotOperatingError

if TYPE_CHECKING:
    from typing import Self

__all__ = ["Cycle", "Cycles", "Lateness"]


@dataclass(frozen=True, slots=True)
class Cycle:
    """A bus cycle that has ended: every station was asked once.

    ``number`` counts cycles since the master began. ``time`` is its start in s of `time.monotonic`, ``duration`` what it took,
    in s, without what it then waited for the next one. ``lateness``: s that it began behind its place in the raster of a
    fixed cycle time; None when the master runs free. ``missed``: cycles since the one before that this program was too
    slow for.
    """

    number: int
    time: float
    duration: float
    lateness: float | None
    missed: int


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late the cycles of a fixed cycle time began, in s, against a raster that never moves.

    ``over``: cycles later than the port's allowance. ``skipped``: places of the raster without a cycle, since the one before
    took their time. ``counts``: cycles by lateness; entry n is those under 2 ** (n + 1) us, the last one anything above.
    """

    last: float
    max: float
    over: int
    skipped: int
    counts: tuple[int, ...]

    @classmethod
    def of(cls, raw: Any) -> Self:
        """A ``dpm_lateness``."""
        return cls(raw.last / NS, raw.max / NS, raw.over, raw.skipped, tuple(raw.counts))


class Cycles(Iterator[Cycle]):
    """The cycles of a master, one after the other; see `Master.cycles`."""

    def __init__(self, bus: Bus, cycle_time: float | None, timeout: float | None) -> None:
        self._bus = bus
        self._fixed = cycle_time is not None
        self._timeout = _arguments.paced(timeout, cycle_time)
        status = bus.status()
        if status.mode < Mode.CLEAR:
            raise NotOperatingError(f"there are no cycles in {Mode(status.mode).name.title()}: operate() or clear() first")
        self._seen = status.cycle

    def __next__(self) -> Cycle:
        try:
            self._bus.feed_from_wait()  # also when the program is slow, and the next cycle has ended already
            status = self._bus.wait(self._ready, self._timeout)
            if status is None:
                self._bus.check_port()
                raise DPTimeout(f"no bus cycle ended in {self._timeout or 0:g} s")
        except ClosedError:
            if self._bus.closed:
                raise StopIteration from None
            raise
        if status.mode < Mode.CLEAR:
            raise StopIteration
        missed, self._seen = status.cycle - self._seen - 1, status.cycle
        return Cycle(status.cycle, status.cycle_began / NS, (status.cycle_ended - status.cycle_began) / NS,
                     status.cycle_late / NS if self._fixed else None, missed)

    def _ready(self) -> Any:
        status = self._bus.status()
        return status if status.cycle != self._seen or status.mode < Mode.CLEAR else None
