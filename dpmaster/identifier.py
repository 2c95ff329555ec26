# SPDX-License-Identifier: MIT
"""Configuration identifiers: what the octets of Chk_Cfg and Get_Cfg say about a station's modules.

A configuration is a row of identifiers, one per slot. Each says how many octets of inputs and outputs its module has, in bytes
or words, and whether they are consistent over the whole length or only per unit. The walk over the octets is the C
library's (csrc/core/identifier.c); this file adds offsets, the way back to octets, and nothing that touches a bus.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dpmaster._core import ffi, lib
from dpmaster.errors import ConfigurationError

__all__ = ["Data", "Identifier", "decode", "encode"]

IO_MAX: int = lib.DPM_IO_MAX
_INPUT, _OUTPUT, _WORDS, _CONSISTENT = 0x10, 0x20, 0x40, 0x80
_SPECIAL_INPUT, _SPECIAL_OUTPUT, _UNCHECKED = 0x40, 0x80, 15


@dataclass(frozen=True, slots=True)
class Data:
    """Inputs or outputs of one module."""

    octets: int
    """Length: 1 to 64 units."""
    unit: int = 1
    """1: bytes; 2: words."""
    consistent: bool = False
    """Consistent over the whole length, not only over a unit."""
    offset: int = 0
    """Where it begins in the station's image; `encode` does not look at it."""

    def _code(self) -> int:
        """The bits that both formats share: consistency, unit, units - 1."""
        if self.unit not in (1, 2) or self.octets % self.unit or not 1 <= self.octets // self.unit <= 64:
            raise ConfigurationError(
                f"module of {self.octets} octets in units of {self.unit}: an identifier holds 1 to 64 bytes (unit 1) or words "
                "(unit 2); use several identifiers")
        return (_CONSISTENT * self.consistent) | (_WORDS * (self.unit == 2)) | (self.octets // self.unit - 1)


@dataclass(frozen=True, slots=True)
class Identifier:
    """One slot of a configuration. Without inputs and outputs it is an empty slot, which counts as a slot too."""

    inputs: Data | None = None
    outputs: Data | None = None
    specific: bytes = b""
    """Maker's octets, 0 to 14; special format only."""
    special: bool = False
    """Written in the special format, also where the general one would do."""
    unchecked: bool = False
    """Special format with 15 for a number of maker's octets: the slave does not check this entry."""
    slot: int = 0
    """Number of the slot, from 1; `encode` does not look at it."""

    def encode(self) -> bytes:
        """The identifier's octets: the general format where it can say this, else the special one."""
        data = [part for part in (self.outputs, self.inputs) if part is not None]
        if self._general():
            direction = (_OUTPUT if self.outputs else 0) | (_INPUT if self.inputs else 0)
            return bytes([direction | data[0]._code()])
        if len(self.specific) > 14 or (self.unchecked and self.specific):
            raise ConfigurationError(
                f"identifier with {len(self.specific)} maker's octets: it holds at most 14, and none when it is not checked")
        head = (_SPECIAL_OUTPUT if self.outputs else 0) | (_SPECIAL_INPUT if self.inputs else 0)
        head |= _UNCHECKED if self.unchecked else len(self.specific)
        return bytes([head, *(part._code() for part in data)]) + self.specific

    def _general(self) -> bool:
        """One octet: up to 16 units, "the SAME length both ways", nothing of the maker's."""
        if self.special or self.specific or self.unchecked or not (self.inputs or self.outputs):
            return False
        shapes = {(part.octets, part.unit, part.consistent) for part in (self.inputs, self.outputs) if part}
        return len(shapes) == 1 and all(octets <= 16 * unit for octets, unit, _ in shapes)


def decode(configuration: bytes) -> list[Identifier]:
    """The identifiers of a configuration, in order, with slots and offsets.

    Raises `ConfigurationError` when one is cut short, or when inputs or outputs exceed 244 octets together.
    """
    identifiers: list[Identifier] = []
    found = ffi.new("dpm_identifier *")
    at = inputs = outputs = 0
    while at < len(configuration):
        code = lib.dpm_identifier_decode(configuration[at:], len(configuration) - at, found)
        if code < 0:
            raise ConfigurationError(
                f"configuration {configuration.hex(' ')}: the identifier {configuration[at]:02x} at octet {at} needs more "
                "octets than follow; compare with the modules in the station's GSD file", dpm_code=code)
        raw = configuration[at : at + found.octets]
        special = not raw[0] & (_INPUT | _OUTPUT)
        identifiers.append(Identifier(
            inputs=Data(found.inputs, found.input_unit, found.input_consistent, inputs) if found.inputs else None,
            outputs=Data(found.outputs, found.output_unit, found.output_consistent, outputs) if found.outputs else None,
            specific=raw[len(raw) - found.specific :],
            special=special, unchecked=special and raw[0] & 0x0F == _UNCHECKED, slot=len(identifiers) + 1))
        at, inputs, outputs = at + found.octets, inputs + found.inputs, outputs + found.outputs
    for name, octets in (("inputs", inputs), ("outputs", outputs)):
        if octets > IO_MAX:
            raise ConfigurationError(
                f"configuration {configuration.hex(' ')}: {octets} octets of {name}; a station has at most {IO_MAX}: "
                "take modules out", dpm_code=lib.DPM_E_CONFIGURATION)
    return identifiers


def encode(identifiers: Iterable[Identifier]) -> bytes:
    """The configuration octets of `identifiers`. Raises `ConfigurationError` for what no identifier can say."""
    return b"".join(identifier.encode() for identifier in identifiers)
