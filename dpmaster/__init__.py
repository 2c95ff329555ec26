# SPDX-License-Identifier: MIT
"""A PROFIBUS-DP master: a small C library keeps the bus's timing, Python drives the stations.

This file only names what a program uses; ``dpmaster.drives`` holds a class per drive, ``dpmaster.emulator`` the bench.
"""

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

__version__ = "0.1.0"

__all__ = [
    "ClosedError",
    "CommissioningError",
    "ConfigurationError",
    "DPError",
    "DPTimeout",
    "NotOperatingError",
    "OutputsDiscarded",
    "ParameterAccessError",
    "PortError",
    "StationError",
    "__version__",
]
