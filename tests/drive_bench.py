# SPDX-License-Identifier: MIT
"""A drive coupled to an emulated card on virtual time: no bus, no thread, an hour passes in no time.

Each cycle the master's telegram carries the newest commit, and the answer the inputs that the card had before it saw
that telegram, as with a real slave. `trace` keeps (outputs, inputs) of every cycle.
"""

from __future__ import annotations

import collections
import itertools
from collections.abc import Callable
from typing import Any

from dpmaster.drives import Drive, YaskawaSIP3, YaskawaV7
from dpmaster.emulator.card import Exchange, SlaveState
from dpmaster.emulator.cards import SIP1, SIP3
from dpmaster.errors import DPTimeout, OutputsDiscarded
from dpmaster.profiles.yaskawa import HANDSHAKE_MASK, STATUS_MASK, Transfer
from dpmaster.station import Frame


class Virtual(Drive[Any]):
    """A drive class over a transport of its own: what Station and Master do, in a dozen lines. Mixed in before the class."""

    card: Any

    def couple(self, card: Any, *, cycle: float = 0.001, lag: int = 0) -> None:
        """Into Data_Exchange with the card, whose CPU has come up."""
        self.card = card
        self.cycle = cycle
        self._seen = collections.deque([Exchange()] * (lag + 1))  # the card's firmware looks `lag` cycles late
        self.now = 0.0
        self.state_of_slave = SlaveState.DATA_EXCH
        self.answering = True
        self._size = self.output_length
        self._index = card.configurations.index(self.configuration)
        self._image = bytes(self._size)
        self._number = self._sent = 0
        self._discarded = range(0)
        self._frame = Frame(bytes(self._size), 0, 0, 0.0, False)
        self.trace: list[tuple[bytes, bytes]] = []
        card.step(0.0, Exchange())
        self.let_pass(0.2)

    def exchange(self) -> None:
        """One bus cycle."""
        self.now += self.cycle
        if not self.answering:
            return
        exchanging = self.state_of_slave is SlaveState.DATA_EXCH
        image = self._image
        inputs = self.card.step(self.now, self._seen[0])
        self._seen.popleft()
        self._seen.append(Exchange(self.state_of_slave, image, exchanging, self._number,
                                   self._index if exchanging else -1, 1 if exchanging else None))
        self.card.step(self.now, self._seen[0])
        if exchanging:
            self._sent = self._number
            self._frame = Frame(inputs or bytes(self._size), self._frame.number + 1, 0, self.now, True)
            self.trace.append((image, self._frame.octets))

    def let_pass(self, seconds: float) -> None:
        until = self.now + seconds
        while self.now < until:
            self.exchange()

    def lose(self, seconds: float) -> None:
        """The exchange is lost for a while; outputs are safe afterwards."""
        self.state_of_slave = SlaveState.WAIT_PRM
        self._frame = Frame(self._frame.octets, self._frame.number, 0, self._frame.time, False)
        self._image, self._discarded = bytes(self._size), range(self._sent + 1, self._number + 1)
        self.let_pass(seconds)
        self.state_of_slave = SlaveState.DATA_EXCH
        self.let_pass(2 * self.cycle)

    # what Station offers

    @property
    def frame(self) -> Frame:
        return self._frame

    @property
    def outputs(self) -> bytes:
        return self._image

    def update(self, offset: int, octets: bytes, keep: bytes = b"") -> int:  # type: ignore[override]
        assert offset >= 0 and offset + len(octets) <= self._size
        if keep:
            octets = bytes(a & k | b for a, k, b in zip(self._image[offset:], keep, octets, strict=False))
        self._image = self._image[:offset] + bytes(octets) + self._image[offset + len(octets):]
        self._number += 1
        return self._number

    def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
        until = self.now + (timeout or 0.0)
        while number not in self._discarded and self._sent < number:
            if self.now >= until:
                raise DPTimeout("not sent")
            self.exchange()
        if number in self._discarded:
            raise OutputsDiscarded("discarded", number=number)

    def wait(self, predicate: Callable[[Frame], bool], timeout: float | None) -> Frame:
        until = self.now + (timeout or 0.0)
        while not (self._frame.valid and predicate(self._frame)):
            if self.now >= until:
                raise DPTimeout("did not come")
            self.exchange()
        return self._frame


class VirtualV7(Virtual, YaskawaV7):  # type: ignore[misc]
    """A YaskawaV7 and its card."""

    def __init__(self, card: SIP1, configuration: str = "Extended Data 1", *, cycle: float = 0.001,
                 lag: int = 0, **arguments: object) -> None:
        super().__init__(card.address, configuration, **arguments)  # type: ignore[arg-type]
        self.couple(card, cycle=cycle, lag=lag)


class VirtualSIP3(Virtual, YaskawaSIP3):  # type: ignore[misc]
    """A YaskawaSIP3 and its card."""

    def __init__(self, card: SIP3, configuration: str = "PPO Type 2", *, cycle: float = 0.001, lag: int = 0,
                 **arguments: object) -> None:
        super().__init__(card.address, configuration, **arguments)  # type: ignore[arg-type]
        self.couple(card, cycle=cycle, lag=lag)


def rows(drive: VirtualV7) -> list[tuple[str, str]]:
    """(command, response) of the parameter access area in hex, as appendix B prints them: message, then handshake.

    A response is what the next telegram brings, the first that can know of the command. WD is masked, the data of
    a response that is still under way left out ("ignore all response data"), repetitions dropped.
    """
    where = drive._layout.channel
    assert where is not None

    def area(octets: bytes) -> tuple[str, int]:
        return octets[where.offset:where.offset + 6].hex(), octets[where.handshake] & HANDSHAKE_MASK

    printed = []
    for (outputs, _), (_, inputs) in itertools.pairwise(drive.trace):
        (command, hs), (response, handshake) = area(outputs), area(inputs)
        done = handshake & STATUS_MASK == Transfer.RECEIVED
        printed.append((f"{command} {hs:02x}", f"{response if done else ''} {handshake:02x}"))
    return [row for row, _ in itertools.groupby(printed)]
