# SPDX-License-Identifier: MIT
"""PPO, the process data objects of the profile for variable-speed drives (No. 3.072), protocol page L.

A PPO is the parameter channel PKW (see `pkw`), which types 3 and 4 do not have, and 2, 6 or 10 process words PZD. The first
two are control word STW and main set-point HSW from the master, status word ZSW and main actual value HIW from the drive.
Pure data and arithmetic; touches nothing but `dpmaster.errors`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from types import MappingProxyType

from dpmaster.errors import ConfigurationError
from dpmaster.profiles import pkw


@dataclass(frozen=True, slots=True)
class PPO:
    """One type: where its parts lie, the same in both directions."""

    type: int
    """1 to 5."""
    pkw: bool
    """Whether it has the parameter channel, at octet 0."""
    words: int
    """Process words."""

    @property
    def pzd(self) -> int:
        """Octet of the first process word."""
        return pkw.LENGTH if self.pkw else 0

    @property
    def size(self) -> int:
        """Octets of all."""
        return self.pzd + 2 * self.words

    def offset(self, number: int) -> int:
        """Octet of PZD `number`, from 1."""
        if not 1 <= number <= self.words:
            raise ConfigurationError(f"PZD{number}: PPO type {self.type} has PZD1 to PZD{self.words}")
        return self.pzd + 2 * (number - 1)

    def identifier(self, consistent: bool = True) -> bytes:
        """Identifier octets: words in and out, consistent over the whole part or each for itself (protocol page G.2)."""
        parts = ([pkw.LENGTH // 2] if self.pkw else []) + [self.words]
        return bytes((0xF0 if consistent else 0x70) | words - 1 for words in parts)


TYPES: Mapping[int, PPO] = MappingProxyType({
    1: PPO(1, True, 2), 2: PPO(2, True, 6), 3: PPO(3, False, 2), 4: PPO(4, False, 6), 5: PPO(5, True, 10)})


class ControlWord(IntFlag):
    """STW. Drives leave bits out and give some another meaning: their own profile says which."""

    ON = 1 << 0
    """0: OFF1, ramp to stop and switch off."""
    NO_COAST = 1 << 1
    """0: OFF2."""
    NO_QUICK_STOP = 1 << 2
    """0: OFF3."""
    ENABLE_OPERATION = 1 << 3
    ENABLE_RAMP = 1 << 4
    CONTINUE_RAMP = 1 << 5
    ENABLE_SETPOINT = 1 << 6
    FAULT_RESET = 1 << 7
    """Acts with its rising edge."""
    JOG_1 = 1 << 8
    JOG_2 = 1 << 9
    CONTROL = 1 << 10
    """0: nothing in the process words counts; the drive is under local control."""


class StatusWord(IntFlag):
    """ZSW."""

    READY_TO_SWITCH_ON = 1 << 0
    READY = 1 << 1
    OPERATION_ENABLED = 1 << 2
    FAULT = 1 << 3
    NO_COAST = 1 << 4
    NO_QUICK_STOP = 1 << 5
    SWITCH_ON_INHIBITED = 1 << 6
    ALARM = 1 << 7
    SPEED_AGREE = 1 << 8
    CONTROL = 1 << 9
    """1: control by the bus."""
    REACHED = 1 << 10


FULL_SCALE = 0x4000
"""HSW and HIW of the profile: 4000h is 100 % of the reference frequency. Some drives have another figure."""


def to_word(share: float, full: int = FULL_SCALE) -> int:
    """A share of the reference frequency (1.0 = 100 %, negative in reverse) as a word, two's complement."""
    if not -0x8000 <= (count := round(share * full)) <= 0x7FFF:
        raise ConfigurationError(f"{share:.1%}: a word of {full} per 100 % holds {-0x8000 / full:.0%} to {0x7FFF / full:.0%}")
    return count & 0xFFFF


def to_share(word: int, full: int = FULL_SCALE) -> float:
    """A word as a share of the reference frequency."""
    return signed(word) / full


def signed(word: int) -> int:
    """A word's two's complement: -32768 to 32767."""
    return (word & 0xFFFF ^ 0x8000) - 0x8000
