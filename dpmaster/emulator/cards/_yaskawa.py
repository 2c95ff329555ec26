# SPDX-License-Identifier: MIT
"""What the two Yaskawa cards do alike: they come up, keep their own time, hold the card's half of the MEMOBUS channel, and
lead a motor that wants a new run command after each fault.

Knows no words, registers or faults of either; touches what a card may.
"""

from __future__ import annotations

import math
import random
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, Protocol

from dpmaster.emulator.card import Card, Exchange
from dpmaster.emulator.motor import Motor
from dpmaster.errors import ConfigurationError
from dpmaster.profiles.yaskawa import HS, WD_MODULUS, WD_PERIOD, WD_SHIFT, Access, ChannelMap, Function, Transfer

INITIALISATION = 0.1
"""Seconds from power-up until the card has come up; the drive is not ready before."""
SENDING = 0.002
"""Seconds that STATUS stays 01; the drive's own time follows as 10."""
ACCESS = (0.010, 0.015)
"""Seconds that the drive takes over an access, least and most."""
SCAN = 0.010
"""Seconds between two looks at a ramp under way."""
IDLE = 1.0
"""Seconds between two steps while nobody exchanges data."""

Commissioning = Literal["commissioned", "factory"]


class Job(Protocol):
    """A parameter channel at work."""

    due: float
    """When something is to happen; infinity while there is nothing to do."""

    def advance(self, now: float) -> None:
        """What is due `now`."""


class Handshake(ABC):
    """The card's half of the MEMOBUS channel: one message at a time.

    A command is new when its HS differs from the one of the command before. While it is busy the card looks at no further
    toggle. What it shows meanwhile is each card's own.
    """

    def __init__(self, carry_out: Callable[[Access, int], Access], duration: Callable[[], float]) -> None:
        self._carry_out = carry_out
        self._duration = duration
        self._request = Access(Function.NONE)
        self._words = 0
        self.clear()

    def clear(self) -> None:
        """As after power-up: HS is 0, nothing is under way."""
        self._taken = self.hs = 0
        self.transfer, self.due = Transfer.IDLE, math.inf
        self.answer = Access(Function.NONE)

    def see(self, octets: bytes, where: ChannelMap, now: float) -> None:
        """Look at the master's half of the channel."""
        hs = octets[where.handshake] & HS
        if hs != self._taken and self.due == math.inf:
            self._taken, self.transfer = hs, Transfer.IDLE
            self._request, self._words = Access.decode(octets, where), where.words
            self._receive(now)

    @abstractmethod
    def _receive(self, now: float) -> None:
        """A command is there: what the card shows until it is carried out, and from when on it is sent to the drive.
        Function 00h is no command: "if no parameter access is desired"."""

    def advance(self, now: float) -> None:
        """The transition that is due at `now`."""
        if self.transfer is Transfer.IDLE:
            self.transfer, self.due = Transfer.SENT, now + SENDING
        elif self.transfer is Transfer.SENT:
            self.transfer, self.due = Transfer.WAITING, now + self._duration()
        else:
            self.answer = self._carry_out(self._request, self._words)
            self.hs, self.transfer, self.due = self._taken, Transfer.RECEIVED, math.inf

    def show(self, image: bytearray, where: ChannelMap, ticks: int) -> None:
        """Put the card's half into the inputs; `ticks` is how often WD has counted up."""
        image[where.offset:where.data + 2 * where.words] = self.answer.encode(where.words)
        image[where.handshake] = self.hs | self.transfer | ticks % WD_MODULUS << WD_SHIFT


class YaskawaCard(Card):
    """A card on given time. `step` of a card is `_live`, then what the slave says; a lock lets a program look meanwhile."""

    def __init__(self, motor: Motor | None, seed: int, parameters: Commissioning) -> None:
        if parameters not in ("commissioned", "factory"):
            raise ConfigurationError(f"parameters {parameters!r}: give 'commissioned' or 'factory'")
        self.motor = motor or Motor()
        self._lock = threading.RLock()
        self._random = random.Random(seed)
        self._injected: str | None = None
        self._powered: float | None = None

    def _forget(self) -> None:
        """What power-up finds: nothing that only memory held."""
        self._now = 0.0
        self._exchange = Exchange()
        self._established = False
        self._fault: str | None = None
        self._armed = True

    _job: Job

    @property
    def running(self) -> bool:
        """Whether the drive feeds the motor, slowing down included."""
        return self.motor.powered

    @property
    def fault(self) -> str | None:
        """The fault on the drive's display, as its manual writes it; None when there is none."""
        return self._fault

    def next_step(self, now: float) -> float:
        with self._lock:
            if self._powered is None:
                return now
            times = [now + IDLE, self._job.due]
            if now < self._powered + INITIALISATION:
                times.append(self._powered + INITIALISATION)
            if not self.motor.arrived:
                times.append(min(now + SCAN, self.motor.settles))
            if self._counts:
                times.append(self._powered + WD_PERIOD * (self._ticks(now) + 1))
            return max(min(times), now + 1e-4)

    def _live(self, now: float) -> None:
        """Let pass what became due since the last step, each event at its own time."""
        while (due := self._job.due) <= now:
            self.motor.advance(due)
            self._now = due
            self._job.advance(due)
            self._act(due)
        self.motor.advance(now)
        self._now = now
        self._act(now)

    @property
    @abstractmethod
    def _counts(self) -> bool:
        """Whether the inputs show WD."""

    @property
    def _ready(self) -> bool:
        """Whether the card has come up."""
        return self._powered is not None and self._now >= self._powered + INITIALISATION

    def _ticks(self, now: float) -> int:
        """How often WD has counted up."""
        return math.floor((now - (self._powered or 0.0)) / WD_PERIOD)

    def _access_time(self) -> float:
        return self._random.uniform(*ACCESS)

    def _obey(self, direction: int, *, allowed: bool, healthy: bool) -> int:
        """+1, -1 or 0: where a run command leads.

        After a fault the command has to be taken away once before it counts again: a reset alone starts no motor.
        """
        self._armed = healthy and (self._armed or not direction)
        return direction if self._armed and self._ready and allowed else 0

    @abstractmethod
    def _act(self, now: float) -> None:
        """Lead the motor where command, parameters and faults say."""
