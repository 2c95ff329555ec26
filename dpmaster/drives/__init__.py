# SPDX-License-Identifier: MIT
"""A class per drive, on the master's side of the wire; `Drive` is what they have in common."""

from dpmaster.drives.drive import Drive, DriveStatus
from dpmaster.drives.yaskawa_v7 import V7Status, YaskawaV7

PROFILES = {"v7": YaskawaV7}
"""The drive classes by the names that the command line has for them."""

__all__ = ["PROFILES", "Drive", "DriveStatus", "V7Status", "YaskawaV7"]
