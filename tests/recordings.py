# SPDX-License-Identifier: MIT
"""Real buses, recorded by a logic analyser: read from beside the repository, skipped with a message where they are absent.

A line of a recording: time of the first start bit in s, direction, idle in Tbit since the last stop bit, octets, a decoding
that tests do not use.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest
from wire import octets

FOLDER = Path(__file__).parents[2] / "shared" / "traces"
S7, PC = "SiemensToBlue.9600.txt", "PCtoBLUE.9600.txt"
RATE = 9600
CHARACTER = 11 * 1_000_000_000 // RATE


class Line(NamedTuple):
    start: int  # ns, the first start bit
    slave: bool
    idle: float  # Tbit since the last stop bit, -1 unknown
    octets: bytes

    @property
    def end(self) -> int:
        return self.start + len(self.octets) * CHARACTER

    @property
    def token(self) -> bool:
        return self.octets[0] == 0xDC

    def to(self, address: int) -> bool:
        """Whether it is a request to that station, FDL status left out."""
        if self.slave or self.token:
            return False
        da, fc = (self.octets[4], self.octets[6]) if self.octets[0] == 0x68 else (self.octets[1], self.octets[3])
        return da & 0x7F == address and fc & 0x0F != 0x09


def recorded(name: str) -> list[Line]:
    """The recording up to its last whole exchange."""
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"no recording at {path}")
    lines: list[Line] = []
    for text in path.read_text().splitlines():
        head, data, meaning = text.split("|", 2)
        if meaning.strip() == "BAD":  # the recording ends inside this telegram: what it answers goes with it
            return lines[:-1]
        time, direction, idle = head.split()[:3]
        lines.append(Line(int(float(time) * 1e9), direction == "S->M", float(idle.removeprefix("idle=")), octets(data)))
    return lines
