# SPDX-License-Identifier: MIT
"""What may go to a terminal. Makers' texts and files' names come from anywhere."""

_CONTROLS = dict.fromkeys((*range(0x20), *range(0x7F, 0xA0)), "?")


def printable(line: str) -> str:
    """The line without control characters, which would be orders to the terminal."""
    return line.translate(_CONTROLS)
