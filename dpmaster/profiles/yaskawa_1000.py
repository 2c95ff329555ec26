# SPDX-License-Identifier: MIT
"""The SI-P3 option card in a Yaskawa V1000 or A1000 as both sides of the wire see it: words, parameter numbers, registers.

Tables are those of the option's technical manual, SIEP C730600 42. What the older card has in common with it is in
`yaskawa`, what every drive of the profile has in `ppo` and `pkw`. Pure data and arithmetic; touches nothing but
`dpmaster.errors`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntFlag
from types import MappingProxyType
from typing import Literal

from dpmaster.errors import ConfigurationError
from dpmaster.profiles import ppo
from dpmaster.profiles.pkw import Error
from dpmaster.profiles.ppo import PPO, ControlWord
from dpmaster.profiles.yaskawa import (
    LAST_REGISTER,
    AccessCode,
    ChannelMap,
    Configuration,
    FrequencyUnit,
    find,
    judge_address,
)

IDENT_NUMBER = 0x0ACF
USER_PARAMETERS = bytes((0x40, 0x01, 0x00, 0x01))
"""Ext_User_Prm_Data_Const(0): the three DPV1 status octets - Fail_Safe on, DPV1_Enable off - and one of the maker's."""
MAX_TSDR: Mapping[int, int] = MappingProxyType({
    9_600: 60, 19_200: 60, 45_450: 60, 93_750: 60, 187_500: 60, 500_000: 100, 1_500_000: 150, 3_000_000: 250,
    6_000_000: 450, 12_000_000: 800,
})
"""Bit times by rate (bit/s)."""
MIN_SLAVE_INTERVAL = 5
"""0.1 ms."""

# -- The thirteen configurations (device data; tables 8, 9 and 12) -------------------------------------------------------

BASIC_DATA = Configuration(
    "Basic data", b"\x72", 6,
    MappingProxyType({"command": 0, "frequency_reference": 2, "torque_reference": 4}),
    MappingProxyType({"status": 0, "motor_speed": 2, "output_current": 4}),
    None)
EXTENDED_DATA_1 = Configuration(
    "Extended Data 1", b"\x5f\x6f", 32,
    MappingProxyType({"command": 0, "frequency_reference": 2, "torque_reference": 4, "torque_compensation": 6,
                      "analog_output_1": 10, "analog_output_2": 12, "digital_output": 14}),
    MappingProxyType({"status": 0, "motor_speed": 2, "torque_reference": 4, "pulse_count": 6, "frequency_reference": 8,
                      "output_frequency": 10, "output_current": 12, "analog_input": 14}),
    ChannelMap(16, 4, 31))
EXTENDED_DATA_2 = Configuration(
    "Extended Data 2", b"\x55\x65", 12,
    MappingProxyType({"command": 0, "frequency_reference": 2}),
    MappingProxyType({"status": 0, "motor_speed": 2}),
    ChannelMap(4, 1, 11))
CONVENTIONAL = (BASIC_DATA, EXTENDED_DATA_1, EXTENDED_DATA_2)


@dataclass(frozen=True, slots=True)
class PPOModule:
    """A module of the GSD file that is a PPO, with or without consistency over its parts."""

    ppo: PPO
    consistent: bool

    @property
    def name(self) -> str:
        return f"PPO Type {self.ppo.type}" + ("" if self.consistent else " (No Cons.)")

    @property
    def identifier(self) -> bytes:
        return self.ppo.identifier(self.consistent)

    @property
    def size(self) -> int:
        """Octets, the same in both directions."""
        return self.ppo.size


PPO_MODULES = tuple(PPOModule(kind, consistent) for consistent in (True, False) for kind in ppo.TYPES.values())
CONFIGURATIONS: tuple[Configuration | PPOModule, ...] = (*CONVENTIONAL, *PPO_MODULES)
"""In the order of the GSD file."""


def configuration(name: str) -> Configuration | PPOModule:
    """The configuration of that name, in any case."""
    return find(name, CONFIGURATIONS)


def check_address(address: int) -> str | None:
    """Judge a node address by F6-30: an error outside 1..125, a warning (returned) below 3."""
    return judge_address(address, 125, "F6-30 takes 1 to 125 (0 lights ERR)")


# -- Words of the conventional formats (tables 10 and 11) ----------------------------------------------------------------


class Command(IntFlag):
    """Operation command. Bit 0 is the word's lowest."""

    FORWARD = 1 << 0
    """RUN with H5-12 = 1."""
    REVERSE = 1 << 1
    """Direction with H5-12 = 1."""
    S3 = 1 << 2
    S4 = 1 << 3
    S5 = 1 << 4
    S6 = 1 << 5
    S7 = 1 << 6
    S8 = 1 << 7
    EXTERNAL_FAULT = 1 << 8
    FAULT_RESET = 1 << 9
    HISTORY_RESET = 1 << 14
    BASEBLOCK = 1 << 15

    RUN = FORWARD | REVERSE


class Status(IntFlag):
    """Drive status, U1-12."""

    RUNNING = 1 << 0
    ZERO_SPEED = 1 << 1
    REVERSE = 1 << 2
    RESET = 1 << 3
    SPEED_AGREE = 1 << 4
    READY = 1 << 5
    ALARM = 1 << 6
    FAULT = 1 << 7
    OPE_ERROR = 1 << 8
    POWER_LOSS = 1 << 9
    NET_CONTROL = 1 << 10
    OUTPUT_M1 = 1 << 11
    OUTPUT_P1 = 1 << 12
    OUTPUT_P2 = 1 << 13
    MOTOR_2 = 1 << 14
    ZERO_SERVO = 1 << 15


INPUT_TERMINALS: Mapping[str, Command] = MappingProxyType({
    "S3": Command.S3, "S4": Command.S4, "S5": Command.S5, "S6": Command.S6, "S7": Command.S7, "S8": Command.S8})
OUTPUT_TERMINALS: Mapping[str, int] = MappingProxyType({"M1-M2": 1 << 0, "P1": 1 << 1, "P2": 1 << 2})
"""Bits of the digital output word and of register 0009h."""

INIT = 0x01
"""Bit 0 of the handshaking output register: clears the handshaking bit."""
TORQUE_UNIT = 0.1
"""Per cent of one count of the torque words."""


def current_unit(kilowatts: float) -> float:
    """Amperes of one count of a current word, by the drive's size: 0.01 A up to 7.5 kW, 0.1 A from 11 kW on."""
    return 0.01 if kilowatts <= 7.5 else 0.1


def frequency_unit(o1_03: int, maximum: float, poles: int = 4) -> FrequencyUnit:
    """What one count of a frequency or speed word means; `maximum` is E1-04 in Hz, `poles` E2-04."""
    match o1_03:
        case 0:
            return FrequencyUnit("0.01 Hz", 0.01)
        case 1:
            return FrequencyUnit("0.01 %", maximum / 10_000)
        case 2:  # r/min = 120 f / poles
            return FrequencyUnit(f"r/min of {poles} poles", poles / 120)
    raise ConfigurationError(f"o1-03 = {o1_03}: no table defines the frequency unit of a user setting; "
                             "set o1-03 to 0 for 0.01 Hz")


# -- Words of the PPOs (STW/ZSW, HSW/HIW) --------------------------------------------------------------------------------

FULL_SCALE = 10_000
"""HSW and HIW: +-10000 is +-100 % of E1-04."""

RUN = ControlWord.ENABLE_RAMP
"""STW bit 4 is RUN or STOP here; bit 3 "Enable to RUN": without it baseblock and stop. 0, 1, 2, 5, 6 are reserved."""
JOG_FORWARD, JOG_REVERSE = ControlWord.JOG_1, ControlWord.JOG_2
RUN_STOPPED = ControlWord.ENABLE_OPERATION | ControlWord.CONTROL
"""STW of a drive that stands ready under control of the bus."""
JOG_SHARE = 0.1
"""Jog turns at a tenth of E1-04."""

STATUS_ALWAYS = (ppo.StatusWord.READY_TO_SWITCH_ON | ppo.StatusWord.READY | ppo.StatusWord.NO_COAST
                 | ppo.StatusWord.NO_QUICK_STOP)
"""Bits of ZSW that are always 1; bit 2 is Drive ready, the others as in the profile."""

# -- Error numbers -------------------------------------------------------------------------------------------------------

PKW_ERRORS: Mapping[int, str] = MappingProxyType({
    Error.PNU: "incorrect PNU number",
    Error.NOT_CHANGEABLE: "write mode error: the drive is running, the parameter is read-only or has another width",
    Error.LIMIT: "lower or upper limit violated",
    Error.INDEX: "disabled IND is set: no such sub-index, or the task does not fit the parameter",
    Error.STATE: "write mode error during undervoltage or parameter processing",
})
PKW_SUBSTITUTES: Mapping[int, int] = MappingProxyType({Error.NO_ARRAY: Error.INDEX, Error.TYPE: Error.INDEX})
"""The card has fewer error numbers than the profile: what fits neither array nor single value is a wrong IND."""
ACCESS_ERRORS: Mapping[AccessCode, Error] = MappingProxyType({
    AccessCode.ADDRESS: Error.INDEX, AccessCode.CONTENT: Error.LIMIT, AccessCode.WRITE: Error.NOT_CHANGEABLE})
"""How a refusal of the drive reads in PKW; undervoltage and storing have 17 instead."""

# -- Parameter numbers (chapter 8) ---------------------------------------------------------------------------------------

PNU_REGISTERS, PNU_ENTER_RAM, PNU_ENTER_ROM = 0, 300, 301
PNU_WRITE_TYPES: Mapping[int, int] = MappingProxyType({900: 1, 901: 2, 902: 3, 903: 4, 905: 5})
"""PPO-Write by type, as arrays of words."""
PNU_READ_TYPES: Mapping[int, int] = MappingProxyType({907: 1, 908: 2, 909: 3, 910: 4, 912: 5})
PNU_WRITE_TYPE, PNU_READ_TYPE = 904, 911
PNU_ASSIGN_WRITE, PNU_ASSIGN_READ = 915, 916
PNU_ADDRESS, PNU_FAULTS, PNU_FAULT_TIMES = 918, 947, 948
PNU_BAUDRATE, PNU_IDENTIFICATION, PNU_PROFILE = 963, 964, 965
PNU_CONTROL, PNU_STATUS, PNU_STORE = 967, 968, 971

GROUP_ELEMENTS = 100
"""Sub-indices of a function group: 00 to 99."""
_GROUPS = {"A": "12", "b": "123456789", "C": "123456", "d": "1234567", "E": "12345", "F": "1234567", "H": "123456",
           "L": "12345678", "n": "123568", "o": "1234", "q": "1", "r": "1", "T": "123", "U": "12345678"}
# A letter's place in the alphabet, then the group's digit; so L1 is 121 and L2 is 122, which is printed as 121 again.
GROUPS: Mapping[int, str] = MappingProxyType({
    10 * (ord(letter.upper()) - ord("A") + 1) + int(digit): letter + digit
    for letter, digits in _GROUPS.items() for digit in digits})
"""Function groups by PNU: 31 is C1."""
_NUMBERS = {group.casefold(): pnu for pnu, group in GROUPS.items()}


def parse_name(name: str) -> tuple[int, int]:
    """PNU and sub-index of a drive parameter: ("C1-01") is (31, 1)."""
    if (match := re.fullmatch(r"([a-z]\d)-(\d{2})", str(name).strip().casefold())) and match[1] in _NUMBERS:
        return _NUMBERS[match[1]], int(match[2])
    raise ConfigurationError(f"parameter {name!r}: give a name of the drive's manual, like 'C1-01'")


def parameter_name(pnu: int, index: int) -> str:
    """The drive parameter of a PNU and sub-index, or how they are written together ("P904", "P915.3")."""
    if pnu in GROUPS:
        return f"{GROUPS[pnu]}-{index:02d}"
    return f"P{pnu}.{index}" if index else f"P{pnu}"


ASSIGNABLE_WRITE = frozenset({*range(1, 11), 15, 16, 17, 27, 28, 29})
"""MEMOBUS command registers that PNU 915 can give to a PZD of PPO-Write."""
ASSIGNABLE_READ = ASSIGNABLE_WRITE | frozenset(range(0x20, 0x100))
"""Command and monitor registers that PNU 916 can give to a PZD of PPO-Read."""
ASSIGNED_WRITE = (1, 2, 6, 7, 9, 15, 0, 0, 0, 0)
"""PNU 915 as printed; 0 is nothing. PZD1 is always STW and PZD2 HSW, whatever the first two say."""
ASSIGNED_READ = (32, 2, 36, 38, 68, 69, 70, 72, 71, 73)
"""PNU 916 as printed; PZD1 is always ZSW and PZD2 HIW."""

BAUDRATES: Mapping[int, int] = MappingProxyType({
    9_600: 0, 19_200: 1, 93_750: 2, 187_500: 3, 500_000: 4, 1_500_000: 6, 3_000_000: 7, 6_000_000: 8, 12_000_000: 9,
    45_450: 11})
"""PNU 963 by bit/s. The table has no 45.45 kbit/s; 11 is the profile's code for it."""
IDENTIFICATION = (273, 1, 0, 2007, 220, 1)
"""PNU 964, sub-indices 1 to 6: maker, device type, software version, year, month and day, DO."""
PROFILE = 0x0302

# -- Diagnosis -----------------------------------------------------------------------------------------------------------


class Condition(IntFlag):
    """Unit_Diag_Bit 24 to 27: the last octet of the diagnosis block."""

    UNDERVOLTAGE = 1 << 0
    INVERTER_COMMUNICATION = 1 << 1
    ILLEGAL_PNU_915 = 1 << 2
    ILLEGAL_PNU_916 = 1 << 3


def diagnosis(conditions: Condition) -> bytes:
    """The block behind the six standard octets; bit 24 is counted from after the header. None while there is nothing."""
    return bytes((0x05, 0x81, 0x00, 0x00, conditions)) if conditions else b""


# -- Registers and parameters --------------------------------------------------------------------------------------------

Access = Literal["rw", "r", "w"]
ENTER_ROM, ENTER_RAM = 0x0900, 0x0910
"""Registers of the Enter command: written parameters come into force, and with 0900h into the EEPROM."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter or monitor of the drive. Limits and factory value are counts as the wire carries them; a parameter whose
    lowest value is negative is two's complement there."""

    name: str
    register: int
    minimum: int
    maximum: int
    default: int
    text: str
    scale: float = 1.0
    """What one count is, in `unit`; 0 where it depends on other parameters or on the drive's size."""
    unit: str = ""
    access: Access = "rw"
    running: bool = False
    """Whether it can be changed while the drive runs."""
    double: bool = False
    """A double word: its high word is in `register`, its low word in the next one."""

    @property
    def registers(self) -> range:
        return range(self.register, self.register + 1 + self.double)

    def to_word(self, value: float) -> int:
        """A value in `unit` as a word or double word. ConfigurationError outside the limits."""
        scale = self.scale or 1.0
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not (
                self.minimum - 0.5 <= value / scale <= self.maximum + 0.5):
            raise ConfigurationError(f"{self.name} = {value!r}: {self.text}, {self.minimum * scale:g} to "
                                     f"{self.maximum * scale:g} {self.unit}".rstrip())
        return min(max(round(value / scale), self.minimum), self.maximum) & self._mask

    def count(self, word: int) -> int:
        """The number that a word stands for, negative where the parameter can be."""
        sign = self._mask // 2 + 1
        return (word & self._mask ^ sign) - sign if self.minimum < 0 else word

    def to_value(self, word: int) -> float:
        """A word in `unit`, a whole number where one count is 1."""
        return self.count(word) if self.scale in (0.0, 1.0) else round(self.count(word) * self.scale, 6)

    @property
    def _mask(self) -> int:
        return 0xFFFF_FFFF if self.double else 0xFFFF


class Table(Mapping[str, Parameter]):
    """Parameters by name, in any case. ``YASKAWA_1000.extended([Parameter(...)])`` adds a program's own or replaces some."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._by_name: dict[str, Parameter] = {}
        for parameter in parameters:
            parse_name(parameter.name)
            self._by_name[parameter.name.casefold()] = parameter
        self._by_register: dict[int, Parameter] = {}
        for parameter in self._by_name.values():
            for register in parameter.registers:
                other = self._by_register.setdefault(register, parameter)
                if other is not parameter or not 0 <= register <= LAST_REGISTER:
                    raise ConfigurationError(f"{parameter.name} at register {register:04X}h: " + (
                        f"{other.name} is there" if other is not parameter else f"they go to {LAST_REGISTER:04X}h"))

    def extended(self, parameters: Iterable[Parameter]) -> Table:
        """This table with more parameters; one of the same name replaces."""
        return Table([*self._by_name.values(), *parameters])

    def at(self, register: int) -> Parameter | None:
        """The parameter of a register."""
        return self._by_register.get(register)

    def __getitem__(self, name: str) -> Parameter:
        return self._by_name[str(name).strip().casefold()]

    def __iter__(self) -> Iterator[str]:
        return (parameter.name for parameter in self._by_name.values())

    def __len__(self) -> int:
        return len(self._by_name)

    def register(self, name: int | str) -> int:
        """The register of a parameter ("C1-01"), of a number or of "0200h"."""
        if isinstance(name, int) and not isinstance(name, bool) and 0 <= name <= 0xFFFF:
            return name
        text = str(name).strip().casefold()
        if text in self._by_name:
            return self._by_name[text].register
        if match := re.fullmatch(r"([0-9a-f]{1,4})h", text):
            return int(match[1], 16)
        raise ConfigurationError(f"register {name!r}: give a number from 0 to 0xFFFF, '0200h', or a parameter of the table, "
                                 "like 'C1-01'; a table of your own can add more")

    def register_name(self, register: int) -> str:
        """The parameter of a register, or "0024h"."""
        parameter = self.at(register)
        return parameter.name if parameter else f"{register:04X}h"


def _parameter(name: str, register: int, minimum: int, maximum: int, default: int, text: str, unit: str = "",
               scale: float = 1.0, running: bool = False) -> Parameter:
    return Parameter(name, register, minimum, maximum, default, text, scale, unit, running=running)


def _monitor(number: int, text: str, unit: str = "", scale: float = 0.0, minimum: int = 0) -> Parameter:
    return Parameter(f"U1-{number:02d}", 0x003F + number, minimum, 0x7FFF if minimum else 0xFFFF, 0, text, scale, unit, "r")


# d1-09 stands before the two of d2 in the registers, d1-10 to d1-17 behind them.
_PRESET_REGISTERS = [*range(0x0280, 0x0289), *range(0x028B, 0x0292)]

# Table 7 gives limits and defaults of F6; registers 0280h (d1-01) and 0200h (C1-01) are the manual's. What it names
# without figures has those of the V1000 and A1000.
YASKAWA_1000 = Table([
    _parameter("A1-02", 0x0102, 0, 7, 2, "control method: 0 V/f, 1 V/f with PG, 2 OLV, 3 CLV, 5 OLV/PM, 6 AOLV/PM, 7 CLV/PM"),
    _parameter("A1-03", 0x0103, 0, 5550, 0, "initialise parameters: 2220 two-wire, 3330 three-wire"),
    _parameter("b1-01", 0x0180, 0, 4, 1, "frequency reference: 0 operator, 1 terminals, 2 MEMOBUS, 3 option, 4 pulses"),
    _parameter("b1-02", 0x0181, 0, 3, 1, "run command: 0 operator, 1 terminals, 2 MEMOBUS, 3 option card"),
    _parameter("C1-01", 0x0200, 0, 60000, 100, "acceleration time from 0 to E1-04", "s", 0.1, True),
    _parameter("C1-02", 0x0201, 0, 60000, 100, "deceleration time from E1-04 to 0", "s", 0.1, True),
    _parameter("C1-09", 0x0208, 0, 60000, 100, "fast-stop time from E1-04 to 0", "s", 0.1, True),
    *(_parameter(f"d1-{n:02d}", register, 0, 40000, 0, f"frequency reference {n}", "Hz", 0.01, True)
      for n, register in enumerate(_PRESET_REGISTERS, 1)),
    _parameter("d1-17", 0x0292, 0, 40000, 600, "jog frequency reference", "Hz", 0.01, True),
    _parameter("d5-01", 0x029A, 0, 1, 0, "torque control: 0 speed, 1 torque"),
    _parameter("E1-04", 0x0303, 400, 4000, 600, "maximum output frequency", "Hz", 0.1),
    _parameter("E2-04", 0x0311, 2, 48, 4, "number of motor poles"),
    _parameter("F6-01", 0x03A2, 0, 3, 1, "reaction to bUS: 0 ramp to stop, 1 coast, 2 fast-stop, 3 alarm only"),
    _parameter("F6-02", 0x03A3, 0, 1, 0, "EF0 detected: 0 always, 1 only during operation"),
    _parameter("F6-03", 0x03A4, 0, 3, 1, "reaction to EF0: 0 ramp to stop, 1 coast, 2 fast-stop, 3 alarm only"),
    _parameter("F6-06", 0x03A7, 0, 1, 0, "torque reference or limit from the option: 0 disabled, 1 enabled"),
    _parameter("F6-07", 0x03A8, 0, 1, 0, "multi-step speeds beside the option: 0 disabled, 1 enabled"),
    _parameter("F6-08", 0x036A, 0, 1, 0, "A1-03 resets F6 and F7 too: 0 no, 1 yes"),
    _parameter("F6-30", 0x03CB, 0, 125, 0, "node address"),
    _parameter("F6-31", 0x03CC, 0, 1, 0, "in Clear: 0 back to 0, 1 hold the previous value"),
    _parameter("F6-32", 0x03CD, 0, 1, 0, "map: 0 PPO, 1 conventional"),
    _parameter("F6-33", 0x03CE, 0, 1, 0, "size of IND: 0 word, 1 byte"),
    *(_parameter(f"H1-{n:02d}", 0x03FD + n, 0, 0x9F, function, f"function of input S{n}")
      for n, function in enumerate((0x24, 0x14, 0x03, 0x04, 0x06, 0x08), 3)),
    _parameter("H2-01", 0x040B, 0, 0x192, 0x0E, "function of output M1-M2"),
    _parameter("H2-02", 0x040C, 0, 0x192, 0x00, "function of output P1"),
    _parameter("H2-03", 0x040D, 0, 0x192, 0x02, "function of output P2"),
    _parameter("H4-01", 0x041D, 0, 999, 102, "analogue output FM: 0 through mode, or the monitor Ux-xx"),
    _parameter("H4-03", 0x041F, -9999, 9999, 0, "bias of analogue output FM", "%", 0.1, True),
    _parameter("H4-04", 0x0420, 0, 999, 103, "analogue output AM: 0 through mode, or the monitor Ux-xx"),
    _parameter("H5-12", 0x043D, 0, 1, 0, "run command: 0 forward/stop and reverse/stop, 1 run/stop and direction"),
    _parameter("o1-03", 0x0502, 0, 3, 0, "display scaling: 0 0.01 Hz, 1 0.01 %, 2 r/min, 3 user"),
    _monitor(1, "frequency reference", "o1-03"),
    _monitor(2, "output frequency", "o1-03"),
    _monitor(3, "output current", "A"),
    _monitor(4, "control method", scale=1.0),
    _monitor(5, "motor speed", "o1-03"),
    _monitor(6, "output voltage", "V", 0.1),
    _monitor(7, "DC bus voltage", "V", 1.0),
    _monitor(8, "output power", "kW", 0.1, -0x8000),
    _monitor(9, "torque reference", "%", 0.1, -0x8000),
    _monitor(10, "input terminals S1 to S8", scale=1.0),
    _monitor(11, "output terminals", scale=1.0),
    _monitor(12, "drive status", scale=1.0),
])
"""What the card's manual names, and what the emulated drive needs to turn."""

COMMANDS = range(0x0001, 0x0020)
"""Registers of commands."""
MONITORS = range(0x0020, 0x0100)
"""Registers that can only be read."""
MONITOR_COPIES: Mapping[int, int] = MappingProxyType({
    0x0023: 0x0040, 0x0024: 0x0041, 0x0025: 0x0045, 0x0026: 0x0042, 0x0027: 0x0047, 0x0028: 0x0048, 0x002B: 0x0049,
    0x002D: 0x004A, 0x0031: 0x0046})
"""Monitor registers that show the same as one of U1."""

COMMISSIONED: Mapping[str, int] = MappingProxyType({"b1-01": 3, "b1-02": 3})
"""What commissioning for the bus sets, besides F6-30 and F6-32."""
CONTROL = COMMISSIONED
"""What the option card needs to move the drive."""

# -- What card and drive show (tables 3, 4, 16 and 17) -------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LEDs:
    """The four indicators: "off", or "solid" or "flashing" with the colour."""

    run: str
    err: str
    comm: str
    bf: str


LED_ROWS: Mapping[str, LEDs] = MappingProxyType({
    "No power": LEDs("off", "off", "off", "off"),
    "Checking": LEDs("solid green", "off", "off", "off"),
    "Self-diagnostics error": LEDs("off", "solid red", "off", "off"),
    "Problem connecting to the drive": LEDs("off", "flashing red", "off", "off"),
    "Waiting for the master": LEDs("solid green", "off", "off", "solid red"),
    "Data incorrect or timed out": LEDs("solid green", "off", "off", "flashing red"),
    "Exchange": LEDs("solid green", "off", "solid green", "off"),
})
"""The rows of table 4."""


def _option_fault(port: str, number: int) -> int:
    """The code of oFA00 .. in the fault history: the port's letter and the number, from 1."""
    return ("Abc".index(port) + 1 << 8) + number + 1


FAULTS: Mapping[str, tuple[int, str]] = MappingProxyType({
    "bUS": (0x0022, "option communication error"),
    "EF0": (0x0027, "external fault from the option"),
    **{f"EF{n}": (0x000E + n, f"external fault at terminal S{n}") for n in range(3, 9)},
    "oFA00": (_option_fault("A", 0x00), "non-compatible option at port A"),
    "oFA01": (_option_fault("A", 0x01), "option not properly connected to port A"),
    **{f"oFA{n:02X}": (_option_fault("A", n), "option hardware fault: communication ID error")
       for n in (*range(0x30, 0x3E), *range(0x40, 0x44))},
    "oFb00": (_option_fault("b", 0x00), "non-compatible option at port B"),
    "oFb02": (_option_fault("b", 0x02), "two of the same option: port B"),
    "oFc00": (_option_fault("c", 0x00), "non-compatible option at port C"),
    "oFc02": (_option_fault("c", 0x02), "two of the same option: port C"),
})
"""Faults of table 16 with their numbers in the drive's fault history; EF3 to EF8 come from input terminals."""
ALARMS: Mapping[str, str] = MappingProxyType({
    "bb": "the output is disabled: baseblock", "CALL": "communication has not yet been established",
    "bUS": FAULTS["bUS"][1], "EF0": FAULTS["EF0"][1]})
"""Table 17; bUS and EF0 where F6-01 and F6-03 make them alarms."""
