# SPDX-License-Identifier: MIT
"""Enumerations that show their names: a program that prints a state means DATA, not 5. Touches nothing."""

from __future__ import annotations

from enum import IntEnum


class Named(IntEnum):
    """An IntEnum whose text is its name; a format that names need not have (``:02X``) shows the number."""

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str) -> str:
        return format(int(self), spec) if spec[-1:] in ("b", "c", "d", "o", "x", "X", "n") else format(self.name, spec)
