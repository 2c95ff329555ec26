# SPDX-License-Identifier: MIT
"""What a card behind an emulated slave is: a pure machine on given time, with no thread and no binding.

The host (a segment or a line) owns the DP slave itself - states, checks, watchdog, stored answer - and shows the card
what has become of the exchange; the card gives back the octets for the master. Times are seconds from any monotonic
origin, so that a test can let hours pass in no time. This room may touch nothing but the standard library.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from dpmaster._names import Named


class SlaveState(Named):
    """State of the DP slave in front of the card; the numbers are those of `enum dpm_slave_state` in slave.h."""

    OFF = 0
    WAIT_PRM = 1
    WAIT_CFG = 2
    DATA_EXCH = 3


@dataclass(frozen=True, slots=True)
class Exchange:
    """What the slave knows of its exchange at the moment of a step."""

    state: SlaveState = SlaveState.WAIT_PRM
    outputs: bytes = b""
    """Octets of the last good Data_Exchange."""
    valid: bool = False
    """False in Clear or after the exchange was lost: `outputs` then count as zeros."""
    number: int = 0
    """Number of the output frame; it changes with every new one."""
    configuration: int = -1
    """Index of the accepted configuration in `Card.configurations`, -1 none."""
    master: int | None = None
    """Address of the master that has locked the slave."""
    watchdog_expired: int = 0
    """How often the slave's watchdog has run out."""


class Card(ABC):
    """An application behind a DP slave. The host reads the attributes once, when it attaches the card."""

    address: int
    ident_number: int
    configurations: tuple[bytes, ...]
    """Identifier octets of every configuration that Chk_Cfg accepts; the first is the one Get_Cfg tells before that."""
    user_parameters: tuple[int, int] = (0, 0)
    """Fewest and most octets of User_Prm_Data that Set_Prm accepts."""
    fail_safe: bool = False
    sync: bool = False
    freeze: bool = False
    max_diagnosis: int = 6

    @abstractmethod
    def step(self, now: float, exchange: Exchange) -> bytes:
        """Live until `now` and return the input octets of that moment.

        Called whenever the outputs or the slave's state changed, and at `next_step` at the latest. Between two calls
        the card has held the outputs of the earlier one.
        """

    @abstractmethod
    def next_step(self, now: float) -> float:
        """The time at which the card wants its next step at the latest. An idle card asks rarely."""

    @abstractmethod
    def reset(self, now: float) -> None:
        """Cycle the power: everything volatile is lost, what the device stores in its EEPROM stays."""
