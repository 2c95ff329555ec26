# SPDX-License-Identifier: MIT
"""The master's half of the parameter channels that lie in the cyclic data: MEMOBUS with its handshake bit, and PKW.

One request at a time, the others wait in a queue; an answer is taken only for the request it belongs to, and a channel whose
answer never came can be used again. Needs of a station what `Wire` names, and counts in the time of its frames.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from dpmaster import _arguments
from dpmaster.drives.drive import SETTLE
from dpmaster.errors import DPTimeout, ParameterAccessError, StationError
from dpmaster.profiles.yaskawa import (
    ACCESS_MEANINGS,
    ERROR,
    HS,
    STATUS_MASK,
    Access,
    ChannelMap,
    Function,
    Transfer,
    register_name,
)
from dpmaster.station import Frame


class Wire(Protocol):
    """What a parameter channel needs of a station."""

    def update(self, offset: int, octets: bytes) -> int:
        """Commit a part of the outputs."""

    def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
        """Wait until a commit was sent and answered."""

    def wait(self, predicate: Callable[[Frame], bool], timeout: float | None) -> Frame:
        """Wait for a frame that fulfils the predicate."""


class Channel:
    """A channel that carries one request at a time, in the order in which they came."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._queue: deque[object] = deque()
        self._moved = threading.Condition()
        self._abandoned = False

    @contextmanager
    def _turn(self, timeout: float) -> Iterator[float]:
        """Wait for the requests that came before; gives the seconds that are left of `timeout`."""
        _arguments.seconds("timeout", timeout, 3600.0)
        begin, ticket = time.monotonic(), object()
        with self._moved:
            self._queue.append(ticket)
            self._moved.notify_all()
        try:
            with self._moved:
                if not self._moved.wait_for(lambda: self._queue[0] is ticket, timeout):
                    raise DPTimeout(f"parameter channel: {self._queue.index(ticket)} requests were before this one for "
                                    f"{timeout} s; give it a longer timeout")
            yield max(0.0, timeout - (time.monotonic() - begin))
        finally:
            with self._moved:
                self._queue.remove(ticket)
                self._moved.notify_all()

    def _valid(self, timeout: float) -> Frame:
        """A frame of an exchange that is under way."""
        return self._wire.wait(lambda f: f.valid, timeout)

    def _after(self, seen: Frame, timeout: float) -> Frame:
        """A frame after `seen`, by `SETTLE` when a request was given up: its answer may still be on the way."""
        earliest = seen.time + (SETTLE if self._abandoned else 0.0)
        return self._wire.wait(lambda f: f.valid and f.number != seen.number and f.time >= earliest, timeout + SETTLE)

    @staticmethod
    def _late(what: str, timeout: float, late: DPTimeout) -> DPTimeout:
        return DPTimeout(f"parameter channel: no answer to {what} within {timeout:g} s; the channel can be used again ({late})")


class ParameterChannel(Channel):
    """MEMOBUS messages with a handshake bit: appendix B of the V7 manual, "Handshaking Register" of the SI-P3 manual.

    HS of the command is made equal to the response's, the data goes first, HS is toggled in a telegram after one that is
    known to have been answered. An answer counts when its HS equals the command's and, where the card mirrors HS before it is
    through (SI-P1), STATUS is `done`. WD is never looked at.
    """

    def __init__(self, wire: Wire, where: ChannelMap, done: Transfer | None = Transfer.RECEIVED) -> None:
        super().__init__(wire)
        self._where = where
        self._mask = HS if done is None else HS | STATUS_MASK
        self._done = done or 0

    @property
    def words(self) -> int:
        """Most registers of one access."""
        return self._where.words

    def access(self, function: int, address: int, length: int, data: Sequence[int] = (),
               timeout: float = 1.0) -> tuple[int, ...]:
        """Exchange one message and return the data words of its good answer. ParameterAccessError, DPTimeout."""
        what = f"function {function:02X}h on {register_name(address)}"
        with self._turn(timeout) as left:
            request = Access(function, address, length, tuple(data))
            frame = self._equalise(left)
            self._abandoned = True
            deadline = frame.time + left
            hs = self._hs(frame)
            self._commit(request, hs, left)
            hs ^= HS
            self._commit(request, hs, left)
            try:
                frame = self._wire.wait(lambda f: f.valid and self._answered(f, hs), deadline - frame.time)
            except DPTimeout as late:
                raise self._late(what, timeout, late) from late
            self._abandoned = False
        return self._judge(request, Access.decode(frame.octets, self._where))

    def _equalise(self, timeout: float) -> Frame:
        """Give the command the response's HS; return a later frame, which has confirmed it.

        The late mirror of an access that was given up can still change the response's HS: then the card is given time to
        have looked, and if HS has moved it is done once more. Function 00h keeps such a crossing from being taken for a
        request.
        """
        frame = self._valid(timeout)
        deadline = frame.time + timeout
        while frame.time < deadline:
            hs = self._hs(frame)
            self._commit(Access(Function.NONE), hs, timeout)
            frame = self._after(self._valid(timeout), timeout)
            if self._hs(frame) == hs:
                return frame
        raise DPTimeout(f"parameter channel: HS of the card did not settle within {timeout:g} s")

    def _hs(self, frame: Frame) -> int:
        return frame.octets[self._where.handshake] & HS

    def _commit(self, request: Access, hs: int, timeout: float) -> None:
        """Commit the whole area - message, reserved octets 0, handshake register - and see it answered."""
        message = request.encode(self._where.words)
        area = message.ljust(self._where.handshake - self._where.offset, b"\0") + bytes((hs,))
        self._wire.wait_sent(self._wire.update(self._where.offset, area), timeout)

    def _answered(self, frame: Frame, hs: int) -> bool:
        return frame.octets[self._where.handshake] & self._mask == hs | self._done

    @staticmethod
    def _judge(request: Access, answer: Access) -> tuple[int, ...]:
        """The data of a good answer; an error answer and one that does not belong to the request are raised."""
        name = register_name(request.address)
        if answer.function == request.function | ERROR:
            code = answer.data[0]
            meaning = ACCESS_MEANINGS.get(code, "a code that table 3.15 does not know")
            verb = "write" if request.function == Function.WRITE else "read"
            raise ParameterAccessError(f"{verb} {name}: the drive answers error {code:02X}h, {meaning}",
                                       code=code, meaning=meaning, register=request.address)
        if (answer.function, answer.address, answer.length) != (request.function, request.address, request.length):
            raise StationError(f"parameter channel: asked {request}, the answer is {answer}",
                               reason="answer to another request")
        return answer.data[:request.length // 2]
