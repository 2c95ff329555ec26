# SPDX-License-Identifier: MIT
"""A class per drive, on the master's side of the wire; `Drive` is what they have in common."""

from collections.abc import Callable, Mapping
from typing import Any

from dpmaster.drives.drive import Drive, DriveStatus, ParameterInfo
from dpmaster.drives.yaskawa_sip3 import SIP3Status, YaskawaSIP3
from dpmaster.drives.yaskawa_v7 import V7Status, YaskawaV7

PROFILES: Mapping[str, Callable[..., Drive[Any]]] = {"v7": YaskawaV7, "si-p3": YaskawaSIP3}
"""The drive classes by the names that the command line has for them."""

__all__ = ["PROFILES", "Drive", "DriveStatus", "ParameterInfo", "SIP3Status", "V7Status", "YaskawaSIP3", "YaskawaV7"]
