# SPDX-License-Identifier: MIT
"""Events: hints that something changed, each subscriber with a ring and a descriptor of its own.

"State is level, events are hints: every fact can be read from its object; overflow drops the oldest and says how many." The
descriptor is an eventfd that any select, poll or asyncio loop can watch; it stays readable while events are left.
"""

from __future__ import annotations

import os
import select
import threading
import time
import weakref
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dpmaster import _arguments, _core
from dpmaster._core import NS, ffi, lib
from dpmaster._names import Named
from dpmaster.bus import FdlState, Feed, Mode
from dpmaster.diagnosis import Reason, StationState
from dpmaster.errors import ClosedError, ConfigurationError
from dpmaster.live import Live

if TYPE_CHECKING:
    from dpmaster.bus import Bus

__all__ = ["Event", "EventKind", "Events"]

LOOK = 1.0  # s, longest stay in C: a Ctrl-C straight before the system call does not end it


class EventKind(Named):
    """What happened (``enum dpm_event_kind``, which says what a, b and value hold)."""

    STATE = 1
    FAULT = 2
    DIAGNOSIS = 3
    MODE = 4
    FDL = 5
    FOREIGN = 6
    WATCHDOG = 7
    LATE = 8
    PORT = 9
    DUPLICATE = 10
    LIVE = 11
    ECHO = 12
    AUTO_CLEAR = 13


@dataclass(frozen=True, slots=True)
class Event:
    """One event; ``time`` in s of `time.monotonic`, ``number`` counts all events of the ring, dropped ones included."""

    kind: EventKind
    address: int | None
    time: float
    number: int
    a: int = 0
    b: int = 0
    value: int = 0

    def __str__(self) -> str:
        who = "" if self.address is None else f"station {self.address}: "
        return who + self._text()

    def _text(self) -> str:
        match self.kind:
            case EventKind.STATE:
                return f"{StationState(self.b).name} -> {StationState(self.a).name}"
            case EventKind.FAULT:
                return f"{Reason(self.a).name} ({self.b})"
            case EventKind.DIAGNOSIS:
                return "new diagnosis"
            case EventKind.MODE:
                return f"mode {Mode(self.b).name} -> {Mode(self.a).name}"
            case EventKind.FDL:
                return f"FDL {FdlState(self.b).name} -> {FdlState(self.a).name}"
            case EventKind.FOREIGN:
                return f"foreign master {self.a} heard"
            case EventKind.WATCHDOG:
                return f"the output watchdog ran out; {Feed(self.a).text} fed it last"
            case EventKind.LATE:
                return f"a telegram was dropped: the host was {self.value / 1e6:.3f} ms late"
            case EventKind.PORT:
                return "port works" if not self.a else f"port: {_core.error(self.a)}"
            case EventKind.DUPLICATE:
                return "another station on the bus has this address, which is ours: the bus was left"
            case EventKind.AUTO_CLEAR:
                return "not in data transfer for data_control_time: auto_clear went to Clear, operate() again"
            case EventKind.LIVE:
                return f"live list: {Live(self.b).text} -> {Live(self.a).text}"
            case EventKind.ECHO:
                heard, left = ("not at all", "bus") if self.a else ("otherwise than sent", "ring")
                return (f"our own token was heard back {heard}, twice: a collision, a short, or the transceiver; "
                        f"the {left} was left")


async def _readable(descriptor: int) -> None:
    import asyncio  # loaded by who uses it

    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    loop.add_reader(descriptor, readable.set)
    try:
        await readable.wait()
    finally:
        loop.remove_reader(descriptor)


class Events:
    """A subscription. Any thread may take; each event is given once. Made by `Master.events`."""

    def __init__(self, bus: Bus, size: int) -> None:
        if _arguments.whole("size", size, 2, 65536, " events, a power of two") & (size - 1):
            raise ConfigurationError(f"size {size}: a power of two from 2 to 65536")
        self._process = bus.process
        self._bus = weakref.ref(bus)  # the bus keeps us; a bus that nobody else keeps shall go
        self._memory = _core.block(lib.dpm_ring_size(size))
        self.ring = lib.dpm_ring_init(self._memory, len(self._memory), size)
        # The ring has one taker at a time. The collector may end us in the middle of our own take(): hence an RLock, and
        # `_users` who still have the descriptor, which is closed behind the last of them.
        self._lock = threading.RLock()
        self._users = 0
        self._ended = False
        self._event = ffi.new("dpm_event *")
        self._lost = ffi.new("uint64_t *")
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        try:
            bus.subscribe(self)
        except BaseException:
            self.close()
            raise

    def fileno(self) -> int:
        """For select, poll, asyncio's add_reader: readable while events are left. ClosedError after close."""
        self._guard()
        return self._fd

    @property
    def lost(self) -> int:
        """Events that a full ring dropped, as far as they have been noticed by `take`."""
        return int(self._lost[0])

    @property
    def closed(self) -> bool:
        return self._ended

    def _guard(self) -> None:
        self._process.guard("the subscription of events")
        if self._ended:
            raise ClosedError("the subscription of events was closed, by itself or with its master")

    def take(self, timeout: float | None = None) -> Event | None:
        """The oldest event left; None when none comes within `timeout` s (None: wait for ever; 0: only look).

        Raises ClosedError when the subscription or its master is closed, also while waiting. Does not feed the output watchdog.
        """
        _arguments.timeout(timeout)
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            event = self._take()
            if event is not None:
                return event
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return None
            self._poll(left)

    def _take(self) -> Event | None:
        with self._using(), self._lock:
            if not lib.dpm_ring_take(self.ring, self._event, self._lost):
                # Empty: take the descriptor's mark away, then look again for what came in between.
                try:
                    os.eventfd_read(self._fd)
                except BlockingIOError:
                    return None
                if not lib.dpm_ring_take(self.ring, self._event, self._lost):
                    return None
                os.eventfd_write(self._fd, 1)  # more may be left behind this one
            found = self._event
            return Event(EventKind(found.kind), None if found.address < 0 else found.address, found.time / NS, found.number,
                         found.a, found.b, found.value)

    def _poll(self, timeout: float | None) -> None:
        with self._using():
            poll = select.poll()
            poll.register(self._fd, select.POLLIN)
            poll.poll(1000 * (LOOK if timeout is None else min(timeout, LOOK)))

    @contextmanager
    def _using(self) -> Iterator[None]:
        self._guard()  # in a forked child: a thread of the parent may have held the lock
        with self._lock:
            self._guard()
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                self._close_descriptor()

    def __iter__(self) -> Iterator[Event]:
        """Events as they come, until the subscription or its master is closed."""
        while True:
            try:
                event = self.take()
            except ClosedError:
                if self._ended:
                    return
                raise
            if event is not None:
                yield event

    async def __aiter__(self) -> AsyncIterator[Event]:
        """The same for ``async for``, in any event loop that can watch a descriptor."""
        while True:
            try:
                event = self.take(0)
                if event is None:
                    with self._using():  # what is watched stays open, whoever closes the subscription
                        await _readable(self._fd)
            except ClosedError:
                if self._ended:
                    return
                raise
            if event is not None:
                yield event

    def end(self) -> None:
        """The bus is gone or no longer writes here: wake those who wait and let the descriptor go."""
        with self._lock:
            if not self._ended:
                self._ended = True
                os.eventfd_write(self._fd, 1)  # wakes who polls; those who look now find it ended
            self._close_descriptor()

    def _close_descriptor(self) -> None:
        if self._ended and not self._users and self._fd >= 0:
            fd, self._fd = self._fd, -1  # first: after a Ctrl-C in between nobody closes what is another's by then
            os.close(fd)

    def close(self) -> None:
        """End the subscription. Idempotent."""
        self._process.guard("the subscription of events")
        bus = self._bus()
        if bus is None or bus.unsubscribe(self):
            self.end()

    def __enter__(self) -> Events:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._process.here:
            self.close()
