# SPDX-License-Identifier: MIT
"""The slave's side: a virtual wire, the cards on it, and the motors behind them."""

from dpmaster.emulator.card import BaudState, Card, Exchange, Habits, Slave, SlaveState
from dpmaster.emulator.host import Host, SlaveReport
from dpmaster.emulator.line import Line
from dpmaster.emulator.segment import PortPath, Segment, SegmentInfo

__all__ = [
    "BaudState", "Card", "Exchange", "Habits", "Host", "Line", "PortPath", "Segment", "SegmentInfo", "Slave", "SlaveReport",
    "SlaveState",
]
