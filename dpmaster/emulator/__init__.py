# SPDX-License-Identifier: MIT
"""The slave's side: a virtual wire, the cards on it, and the motors behind them."""

from dpmaster.emulator.card import Card, Exchange, SlaveState
from dpmaster.emulator.host import SlaveReport
from dpmaster.emulator.line import Line
from dpmaster.emulator.segment import PortPath, Segment, SegmentInfo

__all__ = ["Card", "Exchange", "Line", "PortPath", "Segment", "SegmentInfo", "SlaveReport", "SlaveState"]
