# SPDX-License-Identifier: MIT
"""Checks of arguments, so that all of them refuse in the same words: the thing, its value, the rule. Touches only errors.

A value of a wrong type breaks the same rule as one out of range. What Python would take silently for something else is
refused too: True for 1, 5 for five zero octets, "5" for text.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Iterable
from numbers import Real

from dpmaster.errors import ConfigurationError


def whole(name: str, value: object, low: int, high: int, note: str = "") -> int:
    """A whole number from `low` to `high`; any type that is one (``__index__``: numpy's, too)."""
    try:
        if isinstance(value, bool):
            raise TypeError
        found = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        found = low - 1
    if not low <= found <= high:
        raise ConfigurationError(f"{name} {value!r}: {low} to {high}{note}")
    return found


def number(value: object) -> bool:
    """Whether it is a real number and no NaN."""
    return isinstance(value, Real) and not isinstance(value, bool) and value == value


def seconds(name: str, value: object, limit: float, note: str = "") -> None:
    """A time above 0 and up to `limit`."""
    if not number(value) or not 0 < value <= limit:  # type: ignore[operator]
        raise ConfigurationError(f"{name} {value!r} s: above 0 and up to {limit:g} s{note}")


def timeout(value: float | None) -> None:
    """A time to wait; 0 only looks. None waits for ever."""
    if value is not None and not number(value):
        raise ConfigurationError(f"timeout {value!r}: seconds, or None to wait for ever")


def paced(value: float | None, cycle_time: float | None, cycles: int = 1) -> float | None:
    """A time to wait that counts beside so many fixed cycle times: what the program chose itself is nobody's delay, and a
    default of a second holds on a slow cycle, too. 0 still only looks."""
    timeout(value)
    return value and value + cycles * (cycle_time or 0.0)


def octets(name: str, value: bytes | bytearray | memoryview | Iterable[int], low: int, high: int, note: str = "") -> bytes:
    """`low` to `high` octets."""
    try:
        if isinstance(value, int | str):
            raise TypeError
        found = bytes(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} {value!r}: give bytes, or whole numbers from 0 to 255") from None
    if not low <= len(found) <= high:
        raise ConfigurationError(f"{name} of {len(found)} octets: {f'{low} to {high}' if low else f'at most {high}'}{note}")
    return found


def path(value: str | os.PathLike[str]) -> str:
    """The path of a port."""
    try:
        found = os.fspath(value)
    except TypeError:
        found = ""
    if not isinstance(found, str) or not found or "\0" in found:
        raise ConfigurationError(f"port {value!r}: give the path of a serial port, like '/dev/ttyUSB0', or a segment's port()")
    return found
