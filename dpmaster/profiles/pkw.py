# SPDX-License-Identifier: MIT
"""PKW, the parameter channel of the profile for variable-speed drives (No. 3.072), protocol page L: messages and both ends.

Eight octets each way: PKE (identifier, SPM, parameter number), IND (sub-index), PWE (value). One task at a time: the
master holds its task until the answer is there, the slave holds its answer until another task comes, and task 0 between
two tasks tells them apart. Neither end knows a bus or a clock; touches nothing but `dpmaster.errors`
and the checks of arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

from dpmaster import _arguments
from dpmaster.errors import DPError

LENGTH = 8
"""Octets of the channel, the same in both directions."""
LAST_PNU = 0x7FF

IndexSize = Literal["word", "byte"]
"""Makers differ in where IND holds the sub-index: in the whole word, or as a byte in its high octet."""


class Task(IntEnum):
    """Task identifiers, bits 15 to 12 of PKE from the master."""

    NONE = 0
    REQUEST = 1
    CHANGE = 2
    CHANGE_DOUBLE = 3
    REQUEST_DESCRIPTION = 4
    CHANGE_DESCRIPTION = 5
    REQUEST_ELEMENT = 6
    CHANGE_ELEMENT = 7
    CHANGE_ELEMENT_DOUBLE = 8
    REQUEST_ELEMENTS = 9


class Response(IntEnum):
    """Response identifiers, bits 15 to 12 of PKE from the slave."""

    NONE = 0
    WORD = 1
    DOUBLE = 2
    DESCRIPTION = 3
    ELEMENT = 4
    ELEMENT_DOUBLE = 5
    ELEMENTS = 6
    REFUSED = 7
    NO_PRIORITY = 8


GOOD: Mapping[int, frozenset[int]] = MappingProxyType({
    Task.NONE: frozenset({Response.NONE}),
    Task.REQUEST: frozenset({Response.WORD, Response.DOUBLE}),
    Task.CHANGE: frozenset({Response.WORD}),
    Task.CHANGE_DOUBLE: frozenset({Response.DOUBLE}),
    Task.REQUEST_DESCRIPTION: frozenset({Response.DESCRIPTION}),
    Task.CHANGE_DESCRIPTION: frozenset({Response.DESCRIPTION}),
    Task.REQUEST_ELEMENT: frozenset({Response.ELEMENT, Response.ELEMENT_DOUBLE}),
    Task.CHANGE_ELEMENT: frozenset({Response.ELEMENT}),
    Task.CHANGE_ELEMENT_DOUBLE: frozenset({Response.ELEMENT_DOUBLE}),
    Task.REQUEST_ELEMENTS: frozenset({Response.ELEMENTS}),
})
"""Which responses a task can have when it succeeds."""

ARRAY_TASKS = frozenset({Task.REQUEST_ELEMENT, Task.CHANGE_ELEMENT, Task.CHANGE_ELEMENT_DOUBLE})
CHANGES = frozenset({Task.CHANGE, Task.CHANGE_DOUBLE, Task.CHANGE_ELEMENT, Task.CHANGE_ELEMENT_DOUBLE})
DOUBLES = frozenset({Task.CHANGE_DOUBLE, Task.CHANGE_ELEMENT_DOUBLE})


class Error(IntEnum):
    """Error numbers in PWE of response 7. Above 100 makers differ."""

    PNU = 0
    NOT_CHANGEABLE = 1
    LIMIT = 2
    INDEX = 3
    NO_ARRAY = 4
    TYPE = 5
    RESET_ONLY = 6
    DESCRIPTION = 7
    NO_CONTROL = 11
    KEY_WORD = 12
    NO_TEXT = 15
    STATE = 17
    OTHER = 18
    VALUE = 20
    NOT_IMPLEMENTED = 106


ERROR_MEANINGS: Mapping[int, str] = MappingProxyType({
    Error.PNU: "no such parameter number",
    Error.NOT_CHANGEABLE: "the parameter cannot be changed",
    Error.LIMIT: "the value is below the lower or above the upper limit",
    Error.INDEX: "no such sub-index",
    Error.NO_ARRAY: "the parameter is no array",
    Error.TYPE: "the task is for another type of data",
    Error.RESET_ONLY: "the value can only be reset",
    Error.DESCRIPTION: "the description cannot be changed",
    Error.NO_CONTROL: "no right to change parameters",
    Error.KEY_WORD: "a key word is missing",
    Error.NO_TEXT: "the parameter has no text",
    Error.STATE: "the state of the drive does not allow it",
    Error.OTHER: "another error",
    Error.VALUE: "the value is not permitted",
    Error.NOT_IMPLEMENTED: "the task is not implemented",
})


@dataclass(frozen=True, slots=True)
class Message:
    """The eight octets, from the master or from the slave."""

    identifier: int
    """A `Task` or a `Response`, 0 to 15."""
    pnu: int = 0
    """Parameter number, 0 to 2047."""
    index: int = 0
    """Sub-index, a word; with byte-sized IND 0 to 255."""
    value: int = 0
    """PWE, 32 bits; a word travels in its low half. The error number in response 7."""
    spm: bool = False
    """Toggle bit of spontaneous messages; most slaves leave it 0."""

    def encode(self, index_size: IndexSize = "word") -> bytes:
        """The octets. ConfigurationError names what does not fit."""
        limits = {"identifier": 15, "pnu": LAST_PNU, "index": 0xFFFF if index_size == "word" else 0xFF, "value": 0xFFFF_FFFF}
        for name, most in limits.items():
            _arguments.whole(f"PKW {name}", getattr(self, name), 0, most,
                             " with a sub-index of one byte" if name == "index" and most == 0xFF else "")
        index = self.index if index_size == "word" else self.index << 8
        pke = self.identifier << 12 | self.spm << 11 | self.pnu
        return pke.to_bytes(2, "big") + index.to_bytes(2, "big") + self.value.to_bytes(4, "big")

    @classmethod
    def decode(cls, octets: bytes, index_size: IndexSize = "word") -> Message:
        """Read a message; octets that end early, as after a loss, count as 0."""
        octets = octets[:LENGTH].ljust(LENGTH, b"\0")
        pke, index = int.from_bytes(octets[0:2], "big"), int.from_bytes(octets[2:4], "big")
        return cls(pke >> 12, pke & LAST_PNU, index if index_size == "word" else index >> 8,
                   int.from_bytes(octets[4:8], "big"), bool(pke & 1 << 11))

    def answers(self, request: Message) -> bool:
        """Whether this is an answer, good or not, to that request: parameter and sub-index are the same, the response
        identifier is one of those that the task can have."""
        possible = GOOD.get(request.identifier, frozenset()) | {Response.REFUSED, Response.NO_PRIORITY}
        return self.identifier in possible and (self.pnu, self.index) == (request.pnu, request.index)

    @property
    def error(self) -> int | None:
        """The error number of response 7; None of every other."""
        return self.value & 0xFFFF if self.identifier == Response.REFUSED else None


# -- The slave's end ---------------------------------------------------------------------------------------------------


class Refusal(DPError):
    """What `Parameters` raise instead of serving: it becomes response 7 with that error number."""

    def __init__(self, number: int) -> None:
        super().__init__(f"error number {number}: {ERROR_MEANINGS.get(number, 'of the maker')}")
        self.number = number


class Value(NamedTuple):
    """What a parameter, or one element of an array, holds."""

    value: int
    double: bool = False
    """32 bits; otherwise 16."""


class Parameters(Protocol):
    """What a slave's end needs of a device. Every method may raise `Refusal`."""

    def elements(self, pnu: int) -> int | None:
        """How many elements the array has; None of a parameter that is none. Refusal(Error.PNU) of an unknown one."""

    def read(self, pnu: int, index: int) -> Value:
        """The value; `index` is 0 of a parameter that is no array."""

    def write(self, pnu: int, index: int, value: Value) -> None:
        """Change it."""


def serve(request: Message, parameters: Parameters, numbers: Mapping[int, int] = MappingProxyType({})) -> Message:
    """Carry out a task and return its response; that to a change carries no value.

    `numbers` says which error number a maker with a list of its own puts in place of the profile's.
    """
    if request.identifier == Task.NONE:
        return Message(Response.NONE)
    try:
        response, value = _carry_out(request, parameters)
    except Refusal as refusal:
        response, value = Response.REFUSED, numbers.get(refusal.number, refusal.number)
    return Message(response, request.pnu, request.index, value)


def _carry_out(request: Message, parameters: Parameters) -> tuple[Response, int]:
    """Identifier and value of a good response."""
    task = request.identifier
    if task not in ARRAY_TASKS | CHANGES | {Task.REQUEST, Task.REQUEST_ELEMENTS}:
        raise Refusal(Error.NOT_IMPLEMENTED)
    elements = parameters.elements(request.pnu)
    if task == Task.REQUEST_ELEMENTS:
        if elements is None:
            raise Refusal(Error.NO_ARRAY)
        return Response.ELEMENTS, elements
    if (elements is not None) != (task in ARRAY_TASKS):
        raise Refusal(Error.NO_ARRAY if elements is None else Error.TYPE)
    if elements is None and request.index:
        raise Refusal(Error.INDEX)
    if task in CHANGES:
        double = task in DOUBLES
        if not double and request.value > 0xFFFF:
            raise Refusal(Error.LIMIT)
        parameters.write(request.pnu, request.index, Value(request.value, double))
        value = Value(0, double)
    else:
        value = parameters.read(request.pnu, request.index)
    return (Response.WORD, Response.DOUBLE, Response.ELEMENT, Response.ELEMENT_DOUBLE)[
        value.double + 2 * (elements is not None)], value.value


class Responder:
    """A slave's end: takes a task when the octets have changed, works `duration()` seconds on it, then shows the response
    until another task is done. A task left standing is carried out once. While busy it looks at nothing.
    """

    def __init__(self, carry_out: Callable[[Message], Message], duration: Callable[[], float] = lambda: 0.0,
                 index_size: IndexSize = "word") -> None:
        self._carry_out = carry_out
        self._duration = duration
        self._index_size: IndexSize = index_size
        self._task = bytes(LENGTH)
        self.octets = bytes(LENGTH)
        """What the slave shows."""
        self.due = math.inf
        """When the response to the task under way will be there; infinity without one."""

    def see(self, octets: bytes, now: float) -> None:
        """Look at the master's octets."""
        octets = octets[:LENGTH].ljust(LENGTH, b"\0")
        if self.due == math.inf and octets != self._task:
            self._task = octets
            if Message.decode(octets).identifier == Task.NONE:
                self.advance(now)  # no task needs no work
            else:
                self.due = now + self._duration()

    def advance(self, now: float) -> None:
        """Show the response, `now` that it is due."""
        self.due = math.inf
        request = Message.decode(self._task, self._index_size)
        self.octets = self._carry_out(request).encode(self._index_size)


# -- The master's end --------------------------------------------------------------------------------------------------


class Requester:
    """A master's end: says what to put on the bus and judges what comes back, by calls with frames and times.

    `start` a request, put `octets` on the bus, show `see` every input frame from then on, and put `octets` again when it
    says True, until `answer` is there. Before every request stands task 0 until the slave shows response 0: the same
    request twice, or a read after a write, could otherwise not be told from the one before. After a request that was given
    up, its late response can still come; then task 0 stands for `settle` seconds, longer than a slave works on a task.
    """

    def __init__(self, index_size: IndexSize = "word", settle: float = 0.050) -> None:
        self.index_size: IndexSize = index_size
        self.settle = settle
        self.octets = bytes(LENGTH)
        """What the outputs have to hold now."""
        self.answer: Message | None = None
        """The response to the last request, once it has come."""
        self._request: Message | None = None
        self._spoiled = False
        self._earliest: float | None = None

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        return self._request is not None

    def start(self, request: Message) -> None:
        """Begin a request; one under way is given up. `octets` is task 0 now. ConfigurationError when it does not fit."""
        request.encode(self.index_size)
        self.give_up()
        self._request, self.answer, self._earliest = request, None, None

    def give_up(self) -> None:
        """Wait no longer. `octets` is task 0 now; the next request lets a late response pass."""
        self._spoiled = self._spoiled or (self.busy and any(self.octets))
        self._request, self.octets = None, bytes(LENGTH)

    def see(self, octets: bytes, now: float) -> bool:
        """Look at the channel of a frame, `now` its time (s). True when `octets` has changed or `answer` is there. What
        the frame shows may be older than `octets`; its time must not be: it counts from when they were on the bus."""
        request = self._request
        if request is None:
            return False
        message = Message.decode(octets, self.index_size)
        if any(self.octets):
            if message.answers(request):
                self.answer, self._request = message, None
                self._spoiled = False
                return True
            return False
        if self._earliest is None:
            self._earliest = now + (self.settle if self._spoiled else 0.0)
        if message.identifier == Response.NONE and now >= self._earliest:
            self.octets = request.encode(self.index_size)
            return True
        return False
