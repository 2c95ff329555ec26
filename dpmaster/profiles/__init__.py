# SPDX-License-Identifier: MIT
"""What both sides of the wire know of a family of drives: word maps, bits, codes. Pure data and arithmetic, no I/O."""
