# SPDX-License-Identifier: MIT
"""Blocks of the extended diagnosis, as a slave sends them behind the six standard octets. Pure: numbers in, octets out.

Layout: EN 50170 part 8, Slave_Diag. Every function raises ConfigurationError for what its block cannot say.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

from dpmaster._arguments import octets, whole
from dpmaster.errors import ConfigurationError

__all__ = ["channel", "device", "identifiers", "module_status", "revision"]

_DIRECTIONS = {"input": 0x40, "output": 0x80, "both": 0xC0}


def device(data: bytes) -> bytes:
    """The maker's own data, 1 to 62 octets."""
    data = octets("device diagnosis", data, 1, 62)
    return bytes([1 + len(data)]) + data


def identifiers(numbers: Iterable[int], of: int) -> bytes:
    """Which of the configuration's `of` identifiers (at most 496, counted from 1) have diagnosis."""
    length = (whole("identifiers", of, 1, 496) + 7) // 8
    bits = bytearray(length)
    for number in numbers:
        at = whole("identifier", number, 1, of) - 1
        bits[at // 8] |= 1 << at % 8
    return bytes([0x40 | 1 + length]) + bits


def channel(identifier: int, number: int, error: int, *, direction: Literal["input", "output", "both"] = "input",
            type: int = 1) -> bytes:
    """A fault of channel `number` (0 to 63) of an identifier (1 to 64).

    error: 1 short circuit, 2 undervoltage, 3 overvoltage, 4 overload, 5 overtemperature, 6 line break, 7 and 8 upper and
    lower limit exceeded, 9 error, 16 to 31 the maker's. type: 0 unspecific, 1 bit, 2 two bits, 3 four bits, 4 byte, 5 word,
    6 two words.
    """
    if direction not in _DIRECTIONS:
        raise ConfigurationError(f"direction {direction!r}: {', '.join(_DIRECTIONS)}")
    return bytes([0x80 | whole("identifier", identifier, 1, 64) - 1, _DIRECTIONS[direction] | whole("channel", number, 0, 63),
                  whole("channel type", type, 0, 7) << 5 | whole("channel error", error, 0, 31)])


def module_status(states: Mapping[int, int], of: int) -> bytes:
    """The module status of DP-V1: the state of each of `of` slots (1 to 236).

    states, by slot: 0 valid, 1 its data are not, 2 wrong module, 3 no module; slots not named are valid.
    """
    data = bytearray((whole("slots", of, 1, 236) + 3) // 4)
    for slot, state in states.items():
        at = whole("slot", slot, 1, of) - 1
        data[at // 4] |= whole("module state", state, 0, 3) << 2 * (at % 4)
    return device(bytes([0x82, 0, 0]) + data)


def revision(number: int) -> bytes:
    """The revision of the diagnosis data, 0 to 63."""
    return bytes([0xC0 | whole("revision", number, 0, 63)])
