# SPDX-License-Identifier: MIT
"""What the drives' manuals allow of the cable: lengths and stubs by rate, and the cable itself. Numbers only; touches nothing.

Sources: SI-P1 manual, tables C.3 (cable), C.4 (lengths) and C.5 (stubs); SI-P3 manual, tables 5 (cable) and 6 (lengths), which
agree. Rates that a table leaves out have the bound of the next higher rate it names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["CABLE", "REPEATERS", "SPACING", "STATIONS", "Limits", "limits"]

CABLE = {"impedance": "135 to 165 ohm at 3 to 20 MHz", "capacitance": "below 30 pF/m", "loop resistance": "below 110 ohm/km",
         "conductor": "above 0.64 mm, 0.34 mm2", "shield": "above 80 %"}
STATIONS = 31  # on one segment, without a repeater
REPEATERS = 9  # in line
SPACING = 1  # m of cable between two stations, at least

# bit/s: m
_SEGMENT = {93_750: 1200, 187_500: 1000, 500_000: 400, 1_500_000: 200, 12_000_000: 100}
_NETWORK = {187_500: 10_000, 500_000: 4_000, 1_500_000: 2_000, 12_000_000: 1_000}
_STUBS = {9_600: 500, 187_500: 100, 500_000: 33, 1_500_000: 20, 12_000_000: 0}


@dataclass(frozen=True, slots=True)
class Limits:
    """The most at a rate, in m: one segment, all segments together through repeaters, all stubs together."""

    segment: int
    network: int
    stubs: int

    def __str__(self) -> str:
        stubs = f"stubs {self.stubs} m together" if self.stubs else "no stubs"
        return f"{self.segment} m a segment, {self.network} m in all, {stubs}"


def limits(rate: float) -> Limits:
    """The limits at a rate, bit/s."""

    def at(table: Mapping[int, int]) -> int:
        return next((metres for bound, metres in table.items() if rate <= bound * 1.01), 0)

    return Limits(at(_SEGMENT), at(_NETWORK), at(_STUBS))
