# SPDX-License-Identifier: MIT
"""What Yaskawa's two PROFIBUS option cards have in common: maps, MEMOBUS messages with their handshake, frequency units.

One source of truth: the drive classes encode with it, the emulated cards decode with it. Each card's own tables are in
`yaskawa_v7` (SI-P1) and `yaskawa_1000` (SI-P3). Pure data and arithmetic; touches nothing but `dpmaster.errors`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Literal, Protocol, TypeVar

from dpmaster.errors import ConfigurationError

WordOrder = Literal["big", "little"]


def get_word(octets: bytes, offset: int, order: WordOrder = "big") -> int:
    """The word at `offset`; 0 where the octets end before it, as after a loss."""
    return int.from_bytes(octets[offset:offset + 2].ljust(2, b"\0"), order)


# -- Configurations -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ChannelMap:
    """Where the parameter access area lies, the same in both directions."""

    offset: int
    """Octet of the function code; address, length and data follow."""
    words: int
    """Most words of one access."""
    handshake: int
    """Octet of the handshake register."""

    @property
    def data(self) -> int:
        """Octet of data 1."""
        return self.offset + 4


@dataclass(frozen=True, slots=True)
class Configuration:
    """One module of the GSD file: its identifier octets and the byte offset of every word of the fast I/O area."""

    name: str
    identifier: bytes
    size: int
    """Octets, the same in both directions."""
    outputs: Mapping[str, int]
    inputs: Mapping[str, int]
    channel: ChannelMap | None


class _Named(Protocol):
    @property
    def name(self) -> str: ...


C = TypeVar("C", bound=_Named)


def find(name: str, configurations: Iterable[C]) -> C:
    """The configuration of that name, in any case."""
    by_name = {each.name.casefold(): each for each in configurations}
    try:
        return by_name[" ".join(str(name).split()).casefold()]
    except KeyError:
        names = ", ".join(repr(each.name) for each in by_name.values())
        raise ConfigurationError(f"configuration {name!r}: the card knows {names}") from None


def judge_address(address: int, highest: int, rule: str) -> str | None:
    """Judge a node address: an error, which tells the card's rule, outside 1..highest; a warning (returned) below 3."""
    if isinstance(address, bool) or not isinstance(address, int) or not 1 <= address <= highest:
        raise ConfigurationError(f"address {address!r}: {rule}")
    if address < 3:
        return f"address {address}: the manual keeps those below 3 for masters; drives take 3 to {highest}"
    return None


# -- MEMOBUS messages and their handshake -------------------------------------------------------------------------------


class Function(IntEnum):
    """Function codes of the parameter channel; an error answer carries the code with ERROR set."""

    NONE = 0x00
    READ = 0x03
    LOOP_BACK = 0x08
    """SI-P3 only."""
    WRITE = 0x10


ERROR = 0x80

HS = 0x80
"""Handshaking bit of both handshake registers."""
STATUS_MASK = 0x60


class Transfer(IntEnum):
    """STATUS, bits 6 and 5 of the response handshake register, in place. (Both manuals write binary digits as "11H".)"""

    IDLE = 0x00
    SENT = 0x20
    WAITING = 0x40
    RECEIVED = 0x60


WD_SHIFT, WD_MODULUS = 1, 16
"""WD, bits 4..1: counts up about every WD_PERIOD."""
WD_PERIOD = 0.064
HANDSHAKE_MASK = 0xE1
"""What is left of a handshake register when WD is masked."""

LAST_REGISTER = 0x0600
"""The drives' registers are 0000h to 0600h."""


class AccessCode(IntEnum):
    """Error codes of the parameter channel."""

    FUNCTION = 0x01
    ADDRESS = 0x02
    AMOUNT = 0x03
    CONTENT = 0x21
    WRITE = 0x22


ACCESS_MEANINGS: Mapping[int, str] = MappingProxyType({
    AccessCode.FUNCTION: "function error: the function code is not one of the channel's",
    AccessCode.ADDRESS: "address error: the starting address is above 0600h",
    AccessCode.AMOUNT: "amount of data: the number of data bytes is 0, odd or more than the channel carries",
    AccessCode.CONTENT: "data content: a value is outside the parameter's limits",
    AccessCode.WRITE: "write fault: the drive is running, has undervoltage or is storing, or the register is read-only",
})


@dataclass(frozen=True, slots=True)
class Access:
    """A message of the parameter channel, request or answer, without its handshake register."""

    function: int
    address: int = 0
    length: int = 0
    """Octets of data, as sent: not judged here."""
    data: tuple[int, ...] = ()

    def encode(self, words: int) -> bytes:
        """Function, address and length, then `words` words of data, the unused ones 0."""
        data = (*self.data, *[0] * words)[:words]
        return bytes((self.function, *self.address.to_bytes(2, "big"), self.length)) + b"".join(
            word.to_bytes(2, "big") for word in data)

    @classmethod
    def decode(cls, octets: bytes, where: ChannelMap) -> Access:
        """Read the message out of an image. Never in `word_order`: that setting is the fast area's alone."""
        data = tuple(get_word(octets, where.data + 2 * i) for i in range(where.words))
        return cls(octets[where.offset], get_word(octets, where.offset + 1), octets[where.offset + 3], data)

    @classmethod
    def error(cls, function: int, code: AccessCode) -> Access:
        """The drive's refusal: function | 80h, address 0000h, length 2, data 1 the code."""
        return cls((function | ERROR) & 0xFF, 0, 2, (code,))

# -- Frequency units -----------------------------------------------------------------------------------------------------

HIGHEST_FREQUENCY = 400.0
"""Hz; the largest maximum frequency that the drives can be set to (n011, E1-04)."""


@dataclass(frozen=True, slots=True)
class FrequencyUnit:
    """What one count of a frequency word means."""

    name: str
    hz: float
    """Hz of one count."""

    @classmethod
    def named(cls, name: str) -> FrequencyUnit:
        """A unit that needs no parameter: "0.01 Hz" or "0.1 Hz"."""
        units = {"0.01hz": cls("0.01 Hz", 0.01), "0.1hz": cls("0.1 Hz", 0.1)}
        try:
            return units["".join(str(name).split()).casefold()]
        except KeyError:
            raise ConfigurationError(f"frequency_unit {name!r}: give '0.01 Hz', '0.1 Hz' or a FrequencyUnit") from None

    def to_bus(self, hz: float) -> int:
        """Hz to the nearest count of the bus."""
        if not math.isfinite(hz) or not 0 <= round(hz / self.hz) <= 0xFFFF:
            raise ConfigurationError(f"{hz} Hz: does not fit a word in units of {self.name}")
        return round(hz / self.hz)

    def to_hz(self, word: int) -> float:
        """A word of the bus in Hz, without the crumbs of binary fractions."""
        return round(word * self.hz, 6)
