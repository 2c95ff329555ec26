# SPDX-License-Identifier: MIT
"""The master's half of the parameter channels that lie in the cyclic data: MEMOBUS with its handshake bit, and PKW.

One request at a time, the others wait in a queue; an answer is taken only for the request it belongs to, and a channel whose
answer never came can be used again. Needs of a station what `Wire` names, and counts in the time of its frames.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import ClassVar, Protocol, TypeVar

from dpmaster import _arguments, _errand
from dpmaster.drives.drive import SETTLE
from dpmaster.errors import DPError, DPTimeout, OutputsDiscarded, ParameterAccessError, StationError
from dpmaster.profiles import pkw
from dpmaster.profiles.yaskawa import (
    ACCESS_MEANINGS,
    ERROR,
    HS,
    STATUS_MASK,
    Access,
    ChannelMap,
    Function,
    Transfer,
)
from dpmaster.station import Frame

T = TypeVar("T")

CYCLES = 8  # of an access to a drive that answers at once, the longest: MEMOBUS behind one that was given up


class Wire(Protocol):
    """What a parameter channel needs of a station."""

    @property
    def _pace(self) -> float:
        """s of a fixed cycle time, else 0."""

    @property
    def outputs(self) -> bytes:
        """What the next commit builds on."""

    def update(self, offset: int, octets: bytes) -> int:
        """Commit a part of the outputs."""

    def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
        """Wait until a commit was sent and answered."""

    def wait(self, predicate: Callable[[Frame], bool], timeout: float | None) -> Frame:
        """Wait for a frame that fulfils the predicate."""


class Interrupted(StationError):
    """The outputs went safe while a request stood in them."""


class Channel(ABC):
    """A channel that carries one request at a time, in the order in which they came."""

    _silence: ClassVar[str] = ""
    """What a person may look at when there never is an answer."""

    def __init__(self, wire: Wire, offset: int) -> None:
        self._wire = wire
        self._offset = offset
        self._queue: deque[object] = deque()
        self._moved = threading.Condition()
        self._held = b""  # what the outputs hold as long as they have not gone safe
        self._asked = False  # the drive may have seen the request
        self._now = self._deadline = 0.0  # in the time of the frames

    def _carry(self, what: str, attempt: Callable[[], T], *, again: bool, timeout: float) -> T:
        """Wait for the turn, then make the attempt; once more after a loss of the station, unless the drive may have seen
        a request that must not be done twice (`again` is False). `timeout` is s from its turn, for all of it, beside the
        fixed cycle times that its telegrams wait for.
        """
        _arguments.seconds("timeout", timeout, 3600.0)
        within = timeout + CYCLES * self._wire._pace
        with self._turn():
            self._held = b""
            try:
                self._now = self._wire.wait(lambda f: f.valid, within).time
                self._deadline = self._now + within
                while True:
                    self._asked = False
                    try:
                        return attempt()
                    except (Interrupted, OutputsDiscarded) as lost:
                        self._held = b""
                        if self._asked and not again:
                            raise StationError(f"parameter channel: outputs went safe while {what} was under way; whether it "
                                               "was done is not known: read it back", reason="lost") from lost
            except BaseException as late:
                self._withdraw()
                if isinstance(late, DPTimeout):
                    raise DPTimeout(f"parameter channel: no answer to {what} within {within:g} s; the channel can be used "
                                    f"again{self._silence} ({late})") from late
                raise

    def _withdraw(self) -> None:
        """Nobody waits for the answer any more: a drive that looks only now shall find nothing to do."""
        if self._held and not self._gone:
            with suppress(DPError):
                self._wire.update(self._offset, self._nothing())

    @abstractmethod
    def _nothing(self) -> bytes:
        """The channel's octets when they ask for nothing."""

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Wait until the requests that came before are through; each of them ends, by its own time-out at the latest. Who
        was given up leaves the queue. A thread that stands in it is in a signal's handler now, and would wait for itself."""
        ticket = _errand.here.thread
        if ticket in self._queue:
            raise DPError("parameter channel: this thread is in an access already, and a signal's handler cannot wait: let it "
                          "leave a note (threading.Event) and ask behind the access, or in another thread")
        try:
            with self._moved:
                self._queue.append(ticket)
                self._moved.notify_all()
                _errand.wait_for(self._moved, lambda: self._queue[0] is ticket)
            yield
        finally:
            with self._moved:
                self._queue.remove(ticket)
                self._moved.notify_all()

    @property
    def _left(self) -> float:
        return max(0.0, self._deadline - self._now)

    def _put(self, octets: bytes) -> None:
        """Commit the channel's octets and see them answered. Interrupted when those before are no longer there."""
        self._check()
        number = self._wire.update(self._offset, octets)
        self._held = octets
        self._wire.wait_sent(number, self._left)

    def _wait(self, predicate: Callable[[Frame], bool]) -> Frame:
        """A valid frame that fulfils the predicate. Interrupted when the outputs are no longer what was put there: what
        comes then may look like an answer and is none."""
        frame = self._wire.wait(lambda f: f.valid and (self._gone or predicate(f)), self._left)
        self._now = frame.time
        self._check()
        return frame

    @property
    def _gone(self) -> bool:
        return self._wire.outputs[self._offset:self._offset + len(self._held)] != self._held

    def _check(self) -> None:
        if self._gone:
            raise Interrupted("the outputs went safe")


class ParameterChannel(Channel):
    """MEMOBUS messages with a handshake bit: appendix B of the V7 manual, "Handshaking Register" of the SI-P3 manual.

    HS of the command is made equal to the response's, the data goes first, HS is toggled in a telegram after one that is
    known to have been answered. An answer counts when its HS equals the command's and, where the card mirrors HS before it is
    through (SI-P1), STATUS is 11. WD is never looked at. `name` is how the drive's manual calls a register; `init` is the bit
    that clears HS, 0 where the card has none.
    """

    def __init__(self, wire: Wire, where: ChannelMap, name: Callable[[int], str], *,
                 done: int = Transfer.RECEIVED, init: int = 0) -> None:
        super().__init__(wire, where.offset)
        self._where = where
        self._name = name
        self._mask = HS | (STATUS_MASK if done else 0)
        self._done = done
        self._init = init
        self._abandoned = False

    @property
    def words(self) -> int:
        """Most registers of one access."""
        return self._where.words

    def access(self, function: int, address: int, length: int, data: Sequence[int] = (),
               timeout: float = 1.0) -> tuple[int, ...]:
        """Exchange one message and return the data words of its good answer. ParameterAccessError, DPTimeout, StationError."""
        request = Access(function, address, length, tuple(data))
        answer = self._carry(f"function {function:02X}h on {self._name(address)}", lambda: self._exchange(request),
                             again=function != Function.WRITE, timeout=timeout)
        return self._judge(request, answer)

    def _exchange(self, request: Access) -> Access:
        hs = self._equalise()
        self._abandoned = True
        self._message(request, hs)
        hs ^= HS
        self._asked = True
        self._message(request, hs)
        frame = self._wait(lambda f: f.octets[self._where.handshake] & self._mask == hs | self._done)
        answer = Access.decode(frame.octets, self._where)
        if answer.function == Function.NONE:
            raise Interrupted("the card began anew")  # with HS 0, which was the one that was waited for
        self._abandoned = False
        return answer

    def _equalise(self) -> int:
        """Give the command the response's HS and see that it stays so; that HS.

        The late mirror of an access that was given up can still change the response's HS: then the card is given time to
        have looked, and if HS has moved it is done once more. Function 00h keeps such a crossing from being taken for a
        request. A card that has the bit for it is told to clear HS first, which ends what it may still be busy with.
        """
        if self._abandoned and self._init:
            self._message(Access(Function.NONE), self._init)
            self._after(self._wait(lambda f: self._hs(f) == 0))
        while True:
            hs = self._hs(self._wait(lambda f: True))
            self._message(Access(Function.NONE), hs)
            if self._hs(self._after(self._wait(lambda f: True))) == hs:
                return hs

    def _after(self, seen: Frame) -> Frame:
        """A frame after `seen`, by `SETTLE` when a request was given up: its answer may still be on the way."""
        earliest = seen.time + (SETTLE if self._abandoned else 0.0)
        return self._wait(lambda f: f.number != seen.number and f.time >= earliest)

    def _hs(self, frame: Frame) -> int:
        return frame.octets[self._where.handshake] & HS

    def _message(self, request: Access, hs: int) -> None:
        self._put(self._area(request, hs))

    def _area(self, request: Access, hs: int) -> bytes:
        """The whole area: message, reserved octets 0, handshake register."""
        message = request.encode(self._where.words)
        return message.ljust(self._where.handshake - self._where.offset, b"\0") + bytes((hs,))

    def _nothing(self) -> bytes:
        """Function 00h, and HS as it stands: its toggle may have been seen."""
        return self._area(Access(Function.NONE), self._held[-1] & HS)

    def _judge(self, request: Access, answer: Access) -> tuple[int, ...]:
        """The data of a good answer; an error answer and one that does not belong to the request are raised."""
        name = self._name(request.address)
        if answer.function == request.function | ERROR:
            code = answer.data[0]
            meaning = ACCESS_MEANINGS.get(code, "a code that the manual's table does not know")
            verb = "write" if request.function == Function.WRITE else "read"
            raise ParameterAccessError(f"{verb} {name}: the drive answers error {code:02X}h, {meaning}",
                                       code=code, meaning=meaning, register=request.address)
        if (answer.function, answer.address, answer.length) != (request.function, request.address, request.length):
            raise StationError(f"parameter channel: asked {request}, the answer is {answer}",
                               reason="answer to another request")
        return answer.data[:request.length // 2]


class PKWChannel(Channel):
    """PKW of the profile for variable-speed drives; what to say and what to believe is `pkw.Requester`'s.

    Task 0 follows every answer at once: a channel that nobody uses says "no action".
    """

    _silence = "; if it never answers, its IND may be of the other size: give index='byte' or 'word', as the drive is set"

    def __init__(self, wire: Wire, offset: int, requester: pkw.Requester, meanings: Mapping[int, str]) -> None:
        super().__init__(wire, offset)
        self._requester = requester
        self._meanings = meanings

    def ask(self, request: pkw.Message, name: str, timeout: float = 1.0) -> pkw.Message:
        """Carry out a task and return its good response. ParameterAccessError, DPTimeout, StationError."""
        change = request.identifier in pkw.CHANGES
        what = f"task {request.identifier} on {name}"
        answer = self._carry(what, lambda: self._exchange(request), again=not change, timeout=timeout)
        code = pkw.Error.NO_CONTROL if answer.identifier == pkw.Response.NO_PRIORITY else answer.error
        if code is not None:
            meaning = self._meanings.get(code) or pkw.ERROR_MEANINGS.get(code, "a number that the manual does not know")
            raise ParameterAccessError(f"{'write' if change else 'read'} {name}: the drive answers error {code}, {meaning}",
                                       code=code, meaning=meaning, register=request.pnu)
        return answer

    def _exchange(self, request: pkw.Message) -> pkw.Message:
        requester = self._requester
        requester.start(request)
        try:
            while requester.answer is None:
                self._asked = any(requester.octets)
                self._put(requester.octets)
                self._wait(lambda f: requester.see(f.octets[self._offset:self._offset + pkw.LENGTH], f.time))
            self._wire.update(self._offset, self._nothing())
            return requester.answer
        finally:
            requester.give_up()

    def _nothing(self) -> bytes:
        return bytes(pkw.LENGTH)
