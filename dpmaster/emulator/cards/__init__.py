# SPDX-License-Identifier: MIT
"""The firmware of the emulated cards, one file per card."""

from dpmaster.emulator.cards.generic import GenericSlave
from dpmaster.emulator.cards.sip1 import SIP1
from dpmaster.emulator.cards.sip3 import SIP3

__all__ = ["SIP1", "SIP3", "GenericSlave"]
