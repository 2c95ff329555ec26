# SPDX-License-Identifier: MIT
"""A GSD file's texts for the diagnosis decoder: the maker's words for bits, areas, channel errors, and the modules' names.

Fills the protocol that `dpmaster.diagnosis` asks for; knows octets, no bus.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from dpmaster.diagnosis import ChannelBlock, DeviceBlock, bit_texts
from dpmaster.gsd.model import Device, Module, _Bits


class Plugged(Protocol):
    """What is asked of a `Place`."""

    @property
    def slot(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def module(self) -> Module: ...
    @property
    def identifiers(self) -> Sequence[object]: ...


class Texts:
    """The device's texts, and those of the modules that are plugged.

    A status or alarm of DP-V1 is read by the UnitDiagType of its type where there is one, else, as other device-related
    diagnosis, by the Unit_Diag keywords outside of all types. A module's own texts go before the device's.
    """

    def __init__(self, device: Device, places: Sequence[Plugged] = ()) -> None:
        self._device = device
        self._slots = {place.slot: place.module for place in places}
        self._identifiers = [place for place in places for _ in place.identifiers]

    def device(self, block: DeviceBlock) -> Sequence[str]:
        data = block.octets[1:]
        module = self._slots.get(data[1]) if self._device.dpv1 and len(data) >= 3 else None
        typed = [owner.types[data[0]] for owner in (module, self._device)
                 if owner is not None and self._device.dpv1 and data[:1] and data[0] in owner.types]
        table: _Bits = typed[0] if typed else module if module is not None and says(module) else self._device
        return bit_texts(data, table.bits, table.not_bits, table.areas)

    def channel_error(self, block: ChannelBlock) -> str | None:
        at = block.identifier
        own = self._identifiers[at].module.channel_errors if at < len(self._identifiers) else {}
        return own.get(block.error) or self._device.channel_errors.get(block.error)

    def module(self, identifier: int) -> str | None:
        return self._identifiers[identifier].name if identifier < len(self._identifiers) else None


def says(table: _Bits) -> bool:
    return bool(table.bits or table.not_bits or table.areas)
