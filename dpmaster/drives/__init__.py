# SPDX-License-Identifier: MIT
"""A class per drive, on the master's side of the wire."""

from dpmaster.drives.yaskawa_v7 import V7Status, YaskawaV7

__all__ = ["V7Status", "YaskawaV7"]
