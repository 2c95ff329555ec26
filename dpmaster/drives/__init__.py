# SPDX-License-Identifier: MIT
"""A class per drive, on the master's side of the wire; `Drive` is what they have in common."""

from dpmaster.drives.drive import Drive, DriveStatus
from dpmaster.drives.yaskawa_v7 import V7Status, YaskawaV7

__all__ = ["Drive", "DriveStatus", "V7Status", "YaskawaV7"]
