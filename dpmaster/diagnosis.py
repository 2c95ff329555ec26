# SPDX-License-Identifier: MIT
"""Slave_Diag read for people: flags, ident number, extended blocks, and in words why a station is not exchanging.

Pure: octets in, objects and texts out; touches nothing else. Layout: EN 50170 part 8 (Slave_Diag), six standard octets,
then blocks whose header says in bits 7..6 what they are and, for two of them, in bits 5..0 how long. A length that lies
ends the blocks, and what is left is kept as it came. What the standard leaves to the maker is put into words by a
`DiagnosisTexts`, which a GSD file or a drive provides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import IntFlag
from typing import Protocol

from dpmaster._names import Named
from dpmaster.errors import ConfigurationError

__all__ = [
    "AlarmBlock", "Block", "ChannelBlock", "DeviceBlock", "Diag", "Diagnosis", "DiagnosisArea",
    "DiagnosisHistory", "DiagnosisRecord", "DiagnosisTables", "DiagnosisTexts", "IdentifierBlock", "ModuleState", "Reason",
    "RevisionBlock", "StationState", "StatusBlock", "bit_texts", "decode_blocks", "why",
]


class StationState(Named):
    """The slave handler's states, as EN 50170 part 8 draws them (``enum dpm_station_state``)."""

    OFFLINE = 0  # not heard of; tried at a low rate
    DIAG1 = 1  # answers; is it free?
    PRM = 2  # Set_Prm is next
    CFG = 3  # Chk_Cfg is next
    DIAG2 = 4  # did it accept both, is it ready?
    DATA = 5  # Data_Exchange
    INACTIVE = 6  # listed, never asked
    LEAVING = 7  # Set_Prm with Unlock is next


class Reason(Named):
    """Why a station is not in Data_Exchange, or left it (``enum dpm_reason``)."""

    NONE = 0
    NO_ANSWER = 1
    SERVICE = 2
    INVALID_ANSWER = 3
    IDENT = 4
    PRM_FAULT = 5
    CFG_FAULT = 6
    NOT_SUPPORTED = 7
    LOCKED = 8
    NOT_READY = 9
    STATIC_DIAG = 10
    PRM_REQ = 11
    BUS = 12

    @property
    def refusal(self) -> bool:
        """True when the station said no: waiting longer alone does not help."""
        return self in _REFUSALS


_REFUSALS = frozenset({Reason.IDENT, Reason.PRM_FAULT, Reason.CFG_FAULT, Reason.NOT_SUPPORTED, Reason.LOCKED})


class Diag(IntFlag):
    """The flags of octets 1 to 3: bit n of octet m is bit 8 * (m - 1) + n. Those marked M are the master's own."""

    STATION_NON_EXISTENT = 1 << 0  # M
    STATION_NOT_READY = 1 << 1
    CFG_FAULT = 1 << 2
    EXT_DIAG = 1 << 3
    NOT_SUPPORTED = 1 << 4
    INVALID_SLAVE_RESPONSE = 1 << 5  # M
    PRM_FAULT = 1 << 6
    MASTER_LOCK = 1 << 7  # M
    PRM_REQ = 1 << 8
    STAT_DIAG = 1 << 9
    ALWAYS_1 = 1 << 10
    WD_ON = 1 << 11
    FREEZE_MODE = 1 << 12
    SYNC_MODE = 1 << 13
    DEACTIVATED = 1 << 15  # M
    EXT_DIAG_OVERFLOW = 1 << 23


_TEXTS: dict[Diag, str] = {
    Diag.STATION_NON_EXISTENT: "does not answer",
    Diag.STATION_NOT_READY: "is not ready for Data_Exchange yet",
    Diag.CFG_FAULT: "refuses the configuration",
    Diag.EXT_DIAG: "reports a fault in its extended diagnosis",
    Diag.NOT_SUPPORTED: "does not support a feature that Set_Prm asks for",
    Diag.INVALID_SLAVE_RESPONSE: "gave an answer that fits no request",
    Diag.PRM_FAULT: "refuses the parameters",
    Diag.MASTER_LOCK: "is locked by another master",
    Diag.PRM_REQ: "must be parameterised and configured anew",
    Diag.STAT_DIAG: "asks for Slave_Diag to be read instead of data exchanged",
    Diag.WD_ON: "has its watchdog on",
    Diag.FREEZE_MODE: "has its inputs frozen",
    Diag.SYNC_MODE: "has its outputs synchronised",
    Diag.DEACTIVATED: "is deactivated",
    Diag.EXT_DIAG_OVERFLOW: "has more diagnosis than fits",
}


# --- the maker's words -----------------------------------------------------------------------------------------------


class DiagnosisTexts(Protocol):
    """What a maker says about a slave's diagnosis: `DiagnosisTables` from a GSD file, or what a drive knows of itself."""

    def device(self, block: DeviceBlock) -> Sequence[str]:
        """Clauses for a device-related block; none: it says nothing about this one."""

    def channel_error(self, block: ChannelBlock) -> str | None:
        """Words for an error of a channel that is the maker's (16..31); None: it has none."""

    def module(self, identifier: int) -> str | None:
        """Name of the module with this identifier number of the configuration, 0 the first; None: it has none."""


class Area(Protocol):
    """Bits `first` to `last` of a device-related block are a number, some of whose values have a text."""

    @property
    def first(self) -> int: ...
    @property
    def last(self) -> int: ...
    @property
    def values(self) -> Mapping[int, str]: ...


@dataclass(frozen=True, slots=True)
class DiagnosisArea:
    """An `Area`, as Unit_Diag_Area of a GSD file gives it."""

    first: int
    last: int
    values: Mapping[int, str]

    def __post_init__(self) -> None:
        if not 0 <= self.first <= self.last:
            raise ConfigurationError(f"a diagnosis area of bits {self.first} to {self.last}: the first is 0 or more, and not "
                                     "above the last")


@dataclass(frozen=True, slots=True)
class DiagnosisTables:
    """Texts by number, as a GSD file lists them. Bits count from 0 at bit 0 of the first octet behind a block's header.

    bits: Unit_Diag_Bit, the text of a bit that is set. clear_bits: Unit_Diag_Not_Bit, of one that is not. areas:
    Unit_Diag_Area. types: tables for the status or alarm of one type only (UnitDiagType). channel_errors: Channel_Diag,
    16..31. modules: names of the configuration's identifiers, in order.
    """

    bits: Mapping[int, str] = field(default_factory=dict)
    clear_bits: Mapping[int, str] = field(default_factory=dict)
    areas: Sequence[DiagnosisArea] = ()
    types: Mapping[int, DiagnosisTables] = field(default_factory=dict)
    channel_errors: Mapping[int, str] = field(default_factory=dict)
    modules: Sequence[str] = ()

    def device(self, block: DeviceBlock) -> tuple[str, ...]:
        texts = bit_texts(block.octets[1:], self.bits, self.clear_bits, self.areas)
        if isinstance(block, AlarmBlock | StatusBlock) and block.type in self.types:
            texts += self.types[block.type].device(block)
        return texts

    def channel_error(self, block: ChannelBlock) -> str | None:
        return self.channel_errors.get(block.error)

    def module(self, identifier: int) -> str | None:
        return self.modules[identifier] if identifier < len(self.modules) else None


def bit_texts(data: bytes, bits: Mapping[int, str], clear_bits: Mapping[int, str], areas: Iterable[Area]) -> tuple[str, ...]:
    """Texts for `data`, what follows a block's header, in the order of its bits. What lies beyond its end says nothing."""
    number, size = int.from_bytes(data, "little"), 8 * len(data)
    found = [(bit, text) for bit, text in bits.items() if bit < size and number >> bit & 1]
    found += [(bit, text) for bit, text in clear_bits.items() if bit < size and not number >> bit & 1]
    for area in areas:
        value = number >> area.first & (1 << area.last - area.first + 1) - 1
        if area.last < size and value in area.values:
            found.append((area.first, area.values[value]))
    return tuple(text for _, text in sorted(found))


_NO_TEXTS = DiagnosisTables()

# --- extended blocks -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Block:
    """A block of the extended diagnosis, header included."""

    octets: bytes

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        """The block in words, the maker's where `texts` has some."""
        return self.octets.hex(" ").upper()

    def __str__(self) -> str:
        return self.explain()


@dataclass(frozen=True, slots=True)
class DeviceBlock(Block):
    """Header 00: the maker's own data. One that is an alarm or a status of DP-V1 is an `AlarmBlock` or a `StatusBlock`."""

    @property
    def data(self) -> bytes:
        return self.octets[1:]

    @property
    def _what(self) -> str:
        return "device diagnosis"

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        clauses = texts.device(self)
        return f"{self._what}: {'; '.join(clauses) if clauses else self.data.hex(' ').upper() or 'no data'}"


@dataclass(frozen=True, slots=True)
class _PduBlock(DeviceBlock):
    """A device-related block of DP-V1: type, slot, specifier, data. `data` is what follows these."""

    @property
    def type(self) -> int:
        return self.octets[1] & 0x7F

    @property
    def slot(self) -> int:
        """0: the whole station; 1..254."""
        return self.octets[2]

    @property
    def specifier(self) -> int:
        return self.octets[3]

    @property
    def data(self) -> bytes:
        return self.octets[4:]

    def _words(self, texts: DiagnosisTexts, what: str) -> str:
        said = "; ".join(texts.device(self)) or self.data.hex(" ").upper()
        return f"{what}, slot {self.slot}" + (f": {said}" if said else "")


@dataclass(frozen=True, slots=True)
class AlarmBlock(_PduBlock):
    """An alarm of DP-V1: it stays in the slave until it is acknowledged."""

    @property
    def type_text(self) -> str:
        return _ALARMS.get(self.type) or _maker(self.type, "alarm")

    @property
    def sequence_number(self) -> int:
        """0..31, by which the acknowledgement names it."""
        return self.specifier >> 3

    @property
    def additional_acknowledge(self) -> bool:
        """Besides the acknowledgement it wants one by the program, with a DS_Write."""
        return bool(self.specifier & 0x04)

    @property
    def appears(self) -> str:
        return ("", "appears", "disappears", "disappears, others remain")[self.specifier & 3]

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        what = f"{self.type_text} {self.sequence_number}{' ' if self.appears else ''}{self.appears}"
        return self._words(texts, what + (", wants an additional acknowledge" if self.additional_acknowledge else ""))


class ModuleState(Named):
    """What the module status of DP-V1 says of a slot."""

    VALID = 0
    INVALID = 1  # its data are: it has a fault
    WRONG = 2  # another module than configured
    MISSING = 3


@dataclass(frozen=True, slots=True)
class StatusBlock(_PduBlock):
    """A status of DP-V1: nobody acknowledges it."""

    @property
    def type_text(self) -> str:
        return _STATUSES.get(self.type) or _maker(self.type, "status")

    @property
    def comes(self) -> str:
        return ("", "comes", "goes", "")[self.specifier & 3]

    @property
    def modules(self) -> Mapping[int, ModuleState]:
        """Of a module status: slots, from 1, whose module is not valid. Other types: empty."""
        if self.type != _MODULE_STATUS:
            return {}
        states = {4 * i + n + 1: octet >> 2 * n & 3 for i, octet in enumerate(self.data) for n in range(4)}
        return {slot: ModuleState(state) for slot, state in states.items() if state}

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        if self.type == _MODULE_STATUS:
            told = ", ".join(f"slot {slot} {_MODULES[state]}" for slot, state in self.modules.items())
            return f"{self.type_text}: {told or 'all modules valid'}"
        return self._words(texts, f"{self.type_text}{' ' if self.comes else ''}{self.comes}")


_MODULE_STATUS = 2
_MODULES = {ModuleState.INVALID: "has invalid data", ModuleState.WRONG: "holds another module than configured",
            ModuleState.MISSING: "holds no module"}
_ALARMS = {1: "diagnostic alarm", 2: "process alarm", 3: "pull alarm", 4: "plug alarm", 5: "status alarm", 6: "update alarm"}
_STATUSES = {1: "status message", 2: "module status", 3: "DxB link status", 30: "PrmCmd acknowledge", 31: "redundancy state"}


def _maker(type_: int, what: str) -> str:
    return f"maker's {what} {type_}" if 32 <= type_ <= 126 else f"{what} of the reserved type {type_}"


@dataclass(frozen=True, slots=True)
class IdentifierBlock(Block):
    """Header 01: one bit for each identifier (slot) of the configuration, set where it has diagnosis."""

    @property
    def identifiers(self) -> tuple[int, ...]:
        """Slots with diagnosis; the configuration's first identifier is 0."""
        return tuple(8 * i + bit for i, octet in enumerate(self.octets[1:]) for bit in range(8) if octet >> bit & 1)

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        found = ", ".join(_module(identifier, texts) for identifier in self.identifiers)
        return f"diagnosis in {found}" if found else "no module has diagnosis"


def _module(identifier: int, texts: DiagnosisTexts) -> str:
    name = texts.module(identifier)
    return f"module {identifier}" + (f" ({name})" if name else "")


@dataclass(frozen=True, slots=True)
class ChannelBlock(Block):
    """Header 10: one channel of one module, always three octets."""

    @property
    def identifier(self) -> int:
        return self.octets[0] & 0x3F

    @property
    def channel(self) -> int:
        return self.octets[1] & 0x3F

    @property
    def direction(self) -> str:
        return ("reserved", "input", "output", "input and output")[self.octets[1] >> 6]

    @property
    def channel_type(self) -> int:
        """0 unspecific, 1 bit, 2 two bits, 3 four bits, 4 byte, 5 word, 6 two words, 7 reserved."""
        return self.octets[2] >> 5

    @property
    def type_text(self) -> str:
        return _CHANNEL_TYPES[self.channel_type]

    @property
    def error(self) -> int:
        """1..9 as the standard names them, 16..31 the maker's."""
        return self.octets[2] & 0x1F

    @property
    def error_text(self) -> str:
        if self.error < len(_CHANNEL_ERRORS):
            return _CHANNEL_ERRORS[self.error]
        return f"maker's error {self.error}" if self.error >= 16 else f"reserved error {self.error}"

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        error = texts.channel_error(self) if self.error >= 16 else None
        return (f"{_module(self.identifier, texts)}, {self.direction} channel {self.channel} ({self.type_text}): "
                f"{error or self.error_text}")


_CHANNEL_TYPES = ("unspecific", "bit", "2 bits", "4 bits", "byte", "word", "2 words", "reserved type 7")
_CHANNEL_ERRORS = (
    "reserved error 0", "short circuit", "undervoltage", "overvoltage", "overload", "overtemperature", "line break",
    "upper limit exceeded", "lower limit exceeded", "error",
)


@dataclass(frozen=True, slots=True)
class RevisionBlock(Block):
    """Header 11: one octet, the revision of the diagnosis data."""

    @property
    def revision(self) -> int:
        return self.octets[0] & 0x3F

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> str:
        return f"revision {self.revision} of the diagnosis data"


def _device(octets: bytes, dpv1: bool) -> DeviceBlock:
    """Nothing in the octets says that a device-related block is a PDU of DP-V1. Where DPV1_Enable was not set, only one
    whose type is the standard's is taken for it: some slaves send their module status from power-on."""
    if len(octets) < 4 or octets[2] > 254:
        return DeviceBlock(octets)
    type_ = octets[1] & 0x7F
    if octets[1] & 0x80:
        known = type_ in _STATUSES and not octets[3] & 0xFC  # bits 7..2 of a status's specifier are reserved
        return StatusBlock(octets) if known or dpv1 else DeviceBlock(octets)
    return AlarmBlock(octets) if type_ in _ALARMS or (dpv1 and type_) else DeviceBlock(octets)


def decode_blocks(octets: bytes, dpv1: bool = False) -> tuple[tuple[Block, ...], bytes]:
    """The blocks of an extended diagnosis, and what is left where one announces a length of 0 or 1 or runs past the end.

    Any octets decode, and every one is in exactly one block or in the rest. dpv1: DPV1_Enable was set in Set_Prm.
    """
    found: list[Block] = []
    while octets:
        kind = octets[0] >> 6
        length = (octets[0] & 0x3F, octets[0] & 0x3F, 3, 1)[kind]
        if not (length >= 2 or kind == 3) or length > len(octets):
            break
        block, octets = octets[:length], octets[length:]
        found.append(_device(block, dpv1) if kind == 0 else (IdentifierBlock, ChannelBlock, RevisionBlock)[kind - 1](block))
    return tuple(found), octets


# --- the whole answer ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One answer to Slave_Diag, 6 to 244 octets, the master's own bits added.

    ``number`` counts the answers fetched from this station; ``time`` is when, in s of `time.monotonic`. ``dpv1``: its
    Set_Prm set DPV1_Enable, so its device-related blocks are alarms and statuses. Raises ConfigurationError for fewer than
    six octets.
    """

    octets: bytes
    number: int = 0
    time: float = 0.0
    dpv1: bool = False

    def __post_init__(self) -> None:
        if not 6 <= len(self.octets) <= 244:
            raise ConfigurationError(f"a diagnosis has 6 to 244 octets, not {len(self.octets)}")

    @property
    def flags(self) -> Diag:
        return Diag(int.from_bytes(self.octets[:3], "little"))

    @property
    def master(self) -> int | None:
        """Address of the master that parameterised the station; None: it is free (FFh)."""
        return None if self.octets[3] == 0xFF else self.octets[3]

    @property
    def ident_number(self) -> int:
        return int.from_bytes(self.octets[4:6], "big")

    @property
    def extended(self) -> bytes:
        """Everything behind the six standard octets, as it came."""
        return self.octets[6:]

    @property
    def blocks(self) -> tuple[Block, ...]:
        return decode_blocks(self.extended, self.dpv1)[0]

    @property
    def rest(self) -> bytes:
        """What follows the last whole block: empty, unless a block lies about its length."""
        return decode_blocks(self.extended, self.dpv1)[1]

    @property
    def ready(self) -> bool:
        """Nothing stands between the station and Data_Exchange."""
        return not self.flags & _OBSTACLES

    @property
    def texts(self) -> tuple[str, ...]:
        """One clause per flag that is set, without subject: "refuses the configuration"."""
        return tuple(self._text(flag) for flag in _TEXTS if self.flags & flag)

    def _text(self, flag: Diag) -> str:
        whose = flag == Diag.MASTER_LOCK and self.master is not None
        return f"is locked by master {self.master}" if whose else _TEXTS[flag]

    def explain(self, texts: DiagnosisTexts = _NO_TEXTS) -> tuple[str, ...]:
        """All it says in words: `texts`, then a clause per extended block, in the maker's words where `texts` has some."""
        clauses = (*self.texts, *(block.explain(texts) for block in self.blocks))
        if self.rest:
            clauses += (f"{len(self.rest)} octets that are no block, a length is wrong: {self.rest.hex(' ').upper()}",)
        return clauses

    def __str__(self) -> str:
        owner = "free" if self.master is None else f"master {self.master}"
        return f"ident {self.ident_number:04X}h, {owner}: {'; '.join(self.explain()) or 'nothing to report'}"


@dataclass(frozen=True, slots=True)
class DiagnosisRecord:
    """An answer of a history, or the same one `count` times in a row.

    ``diagnosis`` has number and time of the last of them; ``first`` is when the first one came, in s of `time.monotonic`.
    ``since`` and ``until`` are the same times on the wall clock, as it stood when the history was read.
    """

    diagnosis: Diagnosis
    count: int
    first: float
    since: datetime
    until: datetime

    def __str__(self) -> str:
        again = f", {self.count} times until {self.until:%H:%M:%S}" if self.count > 1 else ""
        return f"{self.since:%Y-%m-%d %H:%M:%S}{again}: {self.diagnosis}"


class DiagnosisHistory(tuple[DiagnosisRecord, ...]):
    """A station's last diagnoses, oldest first. Numbers (`Diagnosis.number`) count all answers from 1, so a program that
    remembers the last one it saw knows what is new, and with `overflow` whether it missed any."""

    __slots__ = ()

    @property
    def overflow(self) -> int:
        """Answers that were dropped for want of room, since the station was added: those with a number up to this one."""
        return self[0].diagnosis.number - self[0].count if self else 0


_OBSTACLES = (
    Diag.STATION_NON_EXISTENT | Diag.STATION_NOT_READY | Diag.CFG_FAULT | Diag.NOT_SUPPORTED | Diag.INVALID_SLAVE_RESPONSE
    | Diag.PRM_FAULT | Diag.MASTER_LOCK | Diag.PRM_REQ | Diag.STAT_DIAG | Diag.DEACTIVATED
)

_STEPS: dict[int, str] = {
    StationState.DIAG1: "Slave_Diag", StationState.PRM: "Set_Prm", StationState.CFG: "Chk_Cfg",
    StationState.DIAG2: "Slave_Diag after Chk_Cfg", StationState.DATA: "Data_Exchange",
    StationState.LEAVING: "Set_Prm with Unlock",
}
_RESULTS = {
    0x0: "OK", 0x1: "UE, user error", 0x2: "RR, no resources", 0x3: "RS, service not activated", 0x8: "DL, data",
    0x9: "NR, no data", 0xA: "DH, data, and diagnosis is waiting", 0xC: "RDL, data, but the request's were not taken",
    0xD: "RDH, data of high priority, but the request's were not taken",
}


def result(fc: int) -> str:
    """What the frame control of an answer says became of the request: "RS, service not activated"."""
    return _RESULTS.get(fc & 0x0F, f"FC {fc:02X}h")


NO_ANSWER = "does not answer: is it powered, its address and the line right?"


def _lost_in(state: int) -> str:
    step = _STEPS.get(state)
    return f"no longer answers (lost in {step})" if step else NO_ANSWER


def _ident(expected: int, found: int | None) -> str:
    named = "another ident number" if found is None else f"ident number {found:04X}h"
    return f"has {named} where {expected:04X}h is expected: another device, or parameters made for another one"


def _prm_fault(ident_number: int, diagnosis: Diagnosis | None) -> str:
    if diagnosis is not None and diagnosis.ident_number != ident_number:
        return f"refuses its parameters (Prm_Fault): it {_ident(ident_number, diagnosis.ident_number)}"
    return "refuses its parameters (Prm_Fault): the user parameters are not its own, or of the wrong length"


def judge(reason: int, diagnosis: Diagnosis | None) -> int:
    """The reason behind a reason: a slave that dislikes its parameters answers what follows them with RS, and says
    why only in the diagnosis that the master then fetches."""
    if reason == Reason.SERVICE and diagnosis is not None:
        for flag, behind in _BEHIND.items():
            if diagnosis.flags & flag:
                return behind
    return reason


_BEHIND = {
    Diag.NOT_SUPPORTED: Reason.NOT_SUPPORTED, Diag.PRM_FAULT: Reason.PRM_FAULT, Diag.CFG_FAULT: Reason.CFG_FAULT,
}


def why(reason: int, detail: int, *, ident_number: int, configuration: bytes = b"", diagnosis: Diagnosis | None = None) -> str:
    """Why a station is not exchanging, a clause without subject; "" when nothing is known against it.

    `reason` and `detail` are the master's (``enum dpm_reason``); the rest is what the station was meant to be.
    """
    match judge(reason, diagnosis):
        case Reason.NONE:
            return ""
        case Reason.NO_ANSWER:
            return _lost_in(detail)
        case Reason.SERVICE:
            return f"refuses a request: {result(detail)}"
        case Reason.INVALID_ANSWER:
            return f"gave an answer that fits no request ({detail} octets): its configuration is not the one given"
        case Reason.IDENT:
            return _ident(ident_number, detail)
        case Reason.PRM_FAULT:
            return _prm_fault(ident_number, diagnosis)
        case Reason.CFG_FAULT:
            return f"refuses the configuration {configuration.hex(' ').upper()} (Cfg_Fault): its modules are others"
        case Reason.NOT_SUPPORTED:
            return "does not support what Set_Prm asks for (Not_Supported): switch off sync or freeze"
        case Reason.LOCKED:
            return f"is locked by master {detail} (Master_Lock): that master must release it first"
        case Reason.NOT_READY:
            return "took its parameters and configuration and is not ready yet (Station_Not_Ready)"
        case Reason.STATIC_DIAG:
            return "asks for its diagnosis to be read instead of data exchanged (Stat_Diag)"
        case Reason.PRM_REQ:
            return "wants to be parameterised anew (Prm_Req): it was reset, or its watchdog ran out"
        case Reason.BUS:
            return "was left alone: the master left the bus (foreign token, or the port vanished)"
    return f"is in trouble for a reason this version does not know ({reason}, detail {detail})"
