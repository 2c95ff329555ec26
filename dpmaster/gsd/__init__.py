# SPDX-License-Identifier: MIT
"""GSD files: what a maker says of its device, read whole, understood, and turned into what a master needs.

``GSD.load(path)`` reads any file and keeps what is odd in ``findings``; ``gsd.configure(modules, parameters)`` is a station's
configuration octets, map of inputs and outputs, and user parameters. Nothing here knows a bus. The way through this room is
`source` (octets to statements), `reader` (statements to the `model`), `check`, `configuration`.
"""

from dpmaster.gsd.configuration import ALARMS, Configuration, Place, PrmBlock, Span
from dpmaster.gsd.file import GSD, variants
from dpmaster.gsd.model import (
    LANGUAGES,
    RATES,
    Area,
    DataArea,
    Device,
    Interface,
    Module,
    Parameter,
    PrmText,
    Slot,
    UnitDiagType,
    Unknown,
)
from dpmaster.gsd.parameters import Parameters, Placed
from dpmaster.gsd.source import Finding, Severity
from dpmaster.gsd.texts import Texts

__all__ = [
    "ALARMS", "GSD", "LANGUAGES", "RATES", "Area", "Configuration", "DataArea", "Device", "Finding", "Interface", "Module",
    "Parameter", "Parameters", "Place", "Placed", "PrmBlock", "PrmText", "Severity", "Slot", "Span", "Texts", "UnitDiagType",
    "Unknown", "variants",
]
