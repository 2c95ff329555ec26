# SPDX-License-Identifier: MIT
"""A PROFIBUS-DP master: a small C library keeps the bus's timing, Python drives the stations.

This file only names what a program uses; ``dpmaster.drives`` holds a class per drive, ``dpmaster.emulator`` the bench.
"""

from dpmaster.cycles import Cycle, Cycles, Lateness
from dpmaster.diagnosis import Diagnosis, DiagnosisHistory, DiagnosisRecord
from dpmaster.errors import (
    ClosedError,
    CommissioningError,
    ConfigurationError,
    DPError,
    DPTimeout,
    NotOperatingError,
    OutputsDiscarded,
    ParameterAccessError,
    PortError,
    StationError,
)
from dpmaster.events import Event, EventKind, Events
from dpmaster.listener import Listener
from dpmaster.live import Live, LiveEntry, RingView
from dpmaster.master import Answer, Master, MasterStatistics, Mode, Service
from dpmaster.parameters import BusParameters
from dpmaster.realtime import Realtime, Scheduling
from dpmaster.station import Frame, Station, StationState, StationStatistics

__version__ = "0.1.0"

__all__ = [
    "Answer",
    "BusParameters",
    "ClosedError",
    "CommissioningError",
    "ConfigurationError",
    "Cycle",
    "Cycles",
    "DPError",
    "DPTimeout",
    "Diagnosis",
    "DiagnosisHistory",
    "DiagnosisRecord",
    "Event",
    "EventKind",
    "Events",
    "Frame",
    "Lateness",
    "Listener",
    "Live",
    "LiveEntry",
    "Master",
    "MasterStatistics",
    "Mode",
    "NotOperatingError",
    "OutputsDiscarded",
    "ParameterAccessError",
    "PortError",
    "Realtime",
    "RingView",
    "Scheduling",
    "Service",
    "Station",
    "StationError",
    "StationState",
    "StationStatistics",
    "__version__",
]
