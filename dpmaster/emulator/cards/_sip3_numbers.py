# SPDX-License-Identifier: MIT
"""The parameter numbers of an SI-P3, 0 to 2047: what PKW reads and writes in card and drive, and what PNU 915 and 916 assign.

A part of the card, as `_sip3_registers` is a part of the drive behind it; needs of it the words of the exchange, the fault
history and the drive's leave to write.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from dpmaster.profiles import pkw, ppo
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.pkw import Refusal, Value
from dpmaster.profiles.yaskawa import LAST_REGISTER, AccessCode, get_word

if TYPE_CHECKING:
    from dpmaster.emulator.cards.sip3 import SIP3

HISTORY = 10
"""Faults that PNU 947 remembers."""

_WRITE_ONLY = frozenset({profile.PNU_ENTER_RAM, profile.PNU_ENTER_ROM, profile.PNU_STORE})
_SINGLE = _WRITE_ONLY | {profile.PNU_WRITE_TYPE, profile.PNU_READ_TYPE, profile.PNU_ADDRESS, profile.PNU_BAUDRATE,
                         profile.PNU_PROFILE, profile.PNU_CONTROL, profile.PNU_STATUS}
_ASSIGNABLE: Mapping[int, frozenset[int]] = MappingProxyType({
    profile.PNU_ASSIGN_WRITE: profile.ASSIGNABLE_WRITE, profile.PNU_ASSIGN_READ: profile.ASSIGNABLE_READ})


class Numbers:
    """The card's parameter numbers, as `pkw.serve` asks for them."""

    def __init__(self, card: SIP3) -> None:
        self._card = card
        self._stored: dict[int, tuple[int, ...]] = {
            profile.PNU_ASSIGN_WRITE: profile.ASSIGNED_WRITE, profile.PNU_ASSIGN_READ: profile.ASSIGNED_READ}
        self.recall()

    # -- PNU 915 and 916

    def recall(self) -> None:
        """What power-up finds."""
        self._assigned = dict(self._stored)

    def store(self) -> None:
        """What is assigned outlives the power."""
        self._stored = dict(self._assigned)

    def assigned(self, pnu: int) -> tuple[int, ...]:
        """The registers behind PZD3 and those after it; 0 of a word that is none's, or an illegal register's."""
        return tuple(register if register in _ASSIGNABLE[pnu] else 0 for register in self._assigned[pnu][2:])

    def illegal(self, pnu: int) -> bool:
        """Whether a register is assigned that cannot be."""
        return any(register and register not in _ASSIGNABLE[pnu] for register in self._assigned[pnu])

    # -- What `pkw.Parameters` asks

    def elements(self, pnu: int) -> int | None:
        if pnu == profile.PNU_REGISTERS:
            return LAST_REGISTER + 1
        if pnu in profile.GROUPS:
            return profile.GROUP_ELEMENTS
        array = self._array(pnu)
        if array is not None:
            return len(array)
        if pnu not in _SINGLE:
            raise Refusal(pkw.Error.PNU)
        return None

    def read(self, pnu: int, index: int) -> Value:
        if pnu in _WRITE_ONLY:
            raise Refusal(pkw.Error.PNU)
        if pnu == profile.PNU_REGISTERS or pnu in profile.GROUPS:
            registers = self._registers(pnu, index)
            return Value(self._card.registers.value(registers), len(registers) == 2)
        array = self._array(pnu)
        if array is None:
            return Value(self._single(pnu))
        if not 1 <= index <= len(array):
            raise Refusal(pkw.Error.INDEX)
        return Value(array[index - 1])

    def write(self, pnu: int, index: int, value: Value) -> None:
        if pnu == profile.PNU_REGISTERS or pnu in profile.GROUPS:
            registers = self._registers(pnu, index)
            if value.double != (len(registers) == 2):
                raise Refusal(pkw.Error.NOT_CHANGEABLE)
            self._write(registers[0], [value.value >> 16, value.value & 0xFFFF][-len(registers):])
        elif value.double:
            raise Refusal(pkw.Error.NOT_CHANGEABLE)
        elif pnu in _WRITE_ONLY:
            self._write(profile.ENTER_RAM if pnu == profile.PNU_ENTER_RAM else profile.ENTER_ROM, [value.value])
        elif pnu in self._assigned:
            self._assign(pnu, index, value.value)
        elif pnu != profile.PNU_CONTROL:  # whose next word comes with the process data: a write is overtaken at once
            raise Refusal(pkw.Error.NOT_CHANGEABLE)

    def _assign(self, pnu: int, index: int, register: int) -> None:
        assigned = list(self._assigned[pnu])
        if not 1 <= index <= len(assigned):
            raise Refusal(pkw.Error.INDEX)
        if index <= 2:  # PZD1 and PZD2 are STW, HSW, ZSW and HIW
            raise Refusal(pkw.Error.NOT_CHANGEABLE)
        assigned[index - 1] = register  # an illegal one is taken, and told in the diagnosis
        self._assigned[pnu] = tuple(assigned)

    def _write(self, address: int, words: list[int]) -> None:
        card = self._card
        code = card._write_refusal(address, words)
        if code is AccessCode.WRITE and (card.undervoltage or card.storing):
            raise Refusal(pkw.Error.STATE)
        if code is not None:
            raise Refusal(profile.ACCESS_ERRORS[code])
        card._write(address, words)

    def _registers(self, pnu: int, index: int) -> range:
        """The registers of a drive parameter, or of PNU 0 the one."""
        if pnu == profile.PNU_REGISTERS:
            if not 1 <= index <= LAST_REGISTER:
                raise Refusal(pkw.Error.INDEX)
            return range(index, index + 1)
        parameter = self._card.registers.table.get(profile.parameter_name(pnu, index))
        if parameter is None:
            raise Refusal(pkw.Error.INDEX)
        return parameter.registers

    def _array(self, pnu: int) -> tuple[int, ...] | None:
        """The elements of one of the profile's arrays."""
        card = self._card
        if pnu in profile.PNU_WRITE_TYPES:
            return self._words(card._octets, ppo.TYPES[profile.PNU_WRITE_TYPES[pnu]])
        if pnu in profile.PNU_READ_TYPES:
            return self._words(card._shown, ppo.TYPES[profile.PNU_READ_TYPES[pnu]])
        if pnu in self._assigned:
            return self._assigned[pnu]
        if pnu == profile.PNU_FAULTS:
            return (*(profile.FAULTS[name][0] for name, _ in card.history), *[0] * HISTORY)[:HISTORY]
        if pnu == profile.PNU_FAULT_TIMES:
            return (*(seconds for _, seconds in card.history), *[0] * HISTORY)[:HISTORY]
        return profile.IDENTIFICATION if pnu == profile.PNU_IDENTIFICATION else None

    def _words(self, octets: bytes, wanted: ppo.PPO) -> tuple[int, ...]:
        """The exchange's octets as another type would have them: its channel and process words, 0 where it has none."""
        present = self._type()
        channel = octets[:pkw.LENGTH] if present.pkw else bytes(pkw.LENGTH)
        view = (channel if wanted.pkw else b"") + octets[present.pzd:]
        return tuple(get_word(view, 2 * n) for n in range(wanted.size // 2))

    def _type(self) -> ppo.PPO:
        module = self._card._module
        return module.ppo if isinstance(module, profile.PPOModule) else ppo.TYPES[1]

    def _single(self, pnu: int) -> int:
        """The value of a parameter number that is no array."""
        card = self._card
        match pnu:
            case profile.PNU_WRITE_TYPE | profile.PNU_READ_TYPE:
                return self._type().type
            case profile.PNU_ADDRESS:
                return card.address
            case profile.PNU_BAUDRATE:
                return profile.BAUDRATES[card._exchange.baudrate]
            case profile.PNU_PROFILE:
                return profile.PROFILE
            case profile.PNU_CONTROL:
                return get_word(card._octets, self._type().pzd)
            case _:
                return int(card.status_word)
