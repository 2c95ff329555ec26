# SPDX-License-Identifier: MIT
"""Yaskawa's PROFIBUS option cards as both sides of the wire see them: words, bits, codes, units and parameters.

One source of truth: the drive classes encode with it, the emulated cards decode with it. Tables are those of the V7
PROFIBUS-DP Option manual, TM.V7.12 (SI-P1). Pure data and arithmetic; touches nothing but `dpmaster.errors`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from types import MappingProxyType
from typing import Literal

from dpmaster.errors import ConfigurationError

WordOrder = Literal["big", "little"]


def get_word(octets: bytes, offset: int, order: WordOrder = "big") -> int:
    """The word at `offset`; 0 where the octets end before it, as after a loss."""
    return int.from_bytes(octets[offset:offset + 2].ljust(2, b"\0"), order)


# -- The three configurations (tables 3.1, 3.7 and 3.12) ---------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ChannelMap:
    """Where the parameter access area lies, the same in both directions."""

    offset: int
    """Octet of the function code; address, length and data follow."""
    words: int
    """Most words of one access."""
    handshake: int
    """Octet of the handshake register."""

    @property
    def data(self) -> int:
        """Octet of data 1."""
        return self.offset + 4


@dataclass(frozen=True, slots=True)
class Configuration:
    """One module of the GSD file: its identifier octets and the byte offset of every word of the fast I/O area."""

    name: str
    identifier: bytes
    size: int
    """Octets, the same in both directions."""
    outputs: Mapping[str, int]
    inputs: Mapping[str, int]
    channel: ChannelMap | None


BASIC_DATA = Configuration(
    "Basic data", b"\x72", 6,
    MappingProxyType({"command": 0, "frequency_reference": 2, "torque_reference": 4}),
    MappingProxyType({"status": 0, "frequency_reference": 2, "torque_reference": 4}),
    None)
EXTENDED_DATA_1 = Configuration(
    "Extended Data 1", b"\x5f\x6f", 32,
    MappingProxyType({"command": 0, "frequency_reference": 2, "multi_function_output": 14}),
    MappingProxyType({"status": 0, "frequency_reference": 8, "output_frequency": 10, "output_current": 12,
                      "pulse_train": 14}),
    ChannelMap(16, 4, 31))
# Table 3.7 prints 13 octets, the identifier octets say 12: the handshake register is octet 11. The second input word is
# the feedback of table 3.7, not the reference of table 3.9.
EXTENDED_DATA_2 = Configuration(
    "Extended Data 2", b"\x55\x65", 12,
    MappingProxyType({"command": 0, "frequency_reference": 2}),
    MappingProxyType({"status": 0, "output_frequency": 2}),
    ChannelMap(4, 1, 11))
CONFIGURATIONS = (BASIC_DATA, EXTENDED_DATA_1, EXTENDED_DATA_2)


def configuration(name: str) -> Configuration:
    """The configuration of that name, in any case."""
    for candidate in CONFIGURATIONS:
        if candidate.name.casefold() == " ".join(str(name).split()).casefold():
            return candidate
    names = ", ".join(repr(candidate.name) for candidate in CONFIGURATIONS)
    raise ConfigurationError(f"configuration {name!r}: the card knows {names}")


def check_address(address: int) -> str | None:
    """Judge a node address by the card's two rotary switches: an error outside 1..99, a warning (returned) below 3."""
    if isinstance(address, bool) or not isinstance(address, int) or not 1 <= address <= 99:
        raise ConfigurationError(f"address {address!r}: the card's two switches set 1 to 99")
    if address < 3:
        return f"address {address}: the manual keeps 1 and 2 for masters; drives take 3 to 99"
    return None


# -- Words of the fast I/O area (tables 3.2, 3.3, 3.8, 3.9, 3.13, 3.14) ------------------------------------------------


class Command(IntFlag):
    """RUN operation command. Bit 0 is the word's lowest: forward run is the octets 00 01."""

    FORWARD = 1 << 0
    REVERSE = 1 << 1
    S3 = 1 << 2
    S4 = 1 << 3
    S5 = 1 << 4
    S6 = 1 << 5
    S7 = 1 << 6
    EXTERNAL_FAULT = 1 << 8
    FAULT_RESET = 1 << 9

    RUN = FORWARD | REVERSE


class Status(IntFlag):
    """Drive status."""

    RUNNING = 1 << 0
    ZERO_SPEED = 1 << 1
    REVERSE = 1 << 2
    RESET = 1 << 3
    FREQUENCY_AGREE = 1 << 4
    READY = 1 << 5
    MINOR_FAULT = 1 << 6
    MAJOR_FAULT = 1 << 7
    OPE_ERROR = 1 << 8
    FAULT_RESTART = 1 << 9
    LOCAL_REMOTE = 1 << 10
    OUTPUT_1 = 1 << 11
    OUTPUT_2 = 1 << 12
    OUTPUT_3 = 1 << 13


class Output(IntFlag):
    """Multi-function output word: the three output terminals."""

    MA = 1 << 0
    P1 = 1 << 1
    P2 = 1 << 2


INPUT_TERMINALS: Mapping[str, Command] = MappingProxyType(
    {"S3": Command.S3, "S4": Command.S4, "S5": Command.S5, "S6": Command.S6, "S7": Command.S7})
OUTPUT_TERMINALS: Mapping[str, Output] = MappingProxyType({"MA": Output.MA, "P1": Output.P1, "P2": Output.P2})

CURRENT_UNIT = 0.1
"""Amperes of one count of the output current."""
TORQUE_UNIT = 1.0
"""Per cent of one count of the torque words: "0 - 100 %", with no other unit printed."""

# -- Parameter access (tables 3.4, 3.5, 3.10, 3.11, 3.15, 3.16, 3.17) --------------------------------------------------


class Function(IntEnum):
    """Function codes of the parameter channel; an error answer carries the code with ERROR set."""

    NONE = 0x00
    READ = 0x03
    LOOP_BACK = 0x08
    """SI-P3 only."""
    WRITE = 0x10


ERROR = 0x80

HS = 0x80
"""Handshaking bit of both handshake registers."""
STATUS_MASK = 0x60


class Transfer(IntEnum):
    """STATUS, bits 6 and 5 of the response handshake register, in place. (The tables write binary digits as "11H".)"""

    IDLE = 0x00
    SENT = 0x20
    WAITING = 0x40
    RECEIVED = 0x60


WD_SHIFT, WD_MODULUS = 1, 16
"""WD, bits 4..1: counts up about every WD_PERIOD."""
WD_PERIOD = 0.064
HANDSHAKE_MASK = 0xE1
"""What is left of a handshake register when WD is masked."""

LAST_REGISTER = 0x0600


class AccessCode(IntEnum):
    """Error codes of the parameter channel."""

    FUNCTION = 0x01
    ADDRESS = 0x02
    AMOUNT = 0x03
    CONTENT = 0x21
    WRITE = 0x22


ACCESS_MEANINGS: Mapping[int, str] = MappingProxyType({
    AccessCode.FUNCTION: "function error: the function code is not one of the channel's",
    AccessCode.ADDRESS: "address error: the starting address is above 0600h",
    AccessCode.AMOUNT: "amount of data: the number of data bytes is 0, odd or more than the channel carries",
    AccessCode.CONTENT: "data content: a value is outside the parameter's limits",
    AccessCode.WRITE: "write fault: the drive is running, has undervoltage or is storing, or the register is read-only",
})


@dataclass(frozen=True, slots=True)
class Access:
    """A message of the parameter channel, request or answer, without its handshake register."""

    function: int
    address: int = 0
    length: int = 0
    """Octets of data, as sent: not judged here."""
    data: tuple[int, ...] = ()

    def encode(self, words: int) -> bytes:
        """Function, address and length, then `words` words of data, the unused ones 0."""
        data = (*self.data, *[0] * words)[:words]
        return bytes((self.function, *self.address.to_bytes(2, "big"), self.length)) + b"".join(
            word.to_bytes(2, "big") for word in data)

    @classmethod
    def decode(cls, octets: bytes, where: ChannelMap) -> Access:
        """Read the message out of an image. Never in `word_order`: that setting is the fast area's alone."""
        data = tuple(get_word(octets, where.data + 2 * i) for i in range(where.words))
        return cls(octets[where.offset], get_word(octets, where.offset + 1), octets[where.offset + 3], data)

    @classmethod
    def error(cls, function: int, code: AccessCode) -> Access:
        """The drive's refusal: function | 80h, address 0000h, length 2, data 1 the code."""
        return cls((function | ERROR) & 0xFF, 0, 2, (code,))


# -- Registers and parameters ------------------------------------------------------------------------------------------


def register(name: int | str) -> int:
    """The register of a parameter: nXXX is 0100h + XXX. A number (or "0103h") is a register already."""
    if isinstance(name, int) and not isinstance(name, bool) and 0 <= name <= 0xFFFF:
        return name
    text = str(name).strip().lower()
    if match := re.fullmatch(r"n(\d{3})", text):
        return 0x0100 + int(match[1])
    if match := re.fullmatch(r"([0-9a-f]{1,4})h", text):
        return int(match[1], 16)
    raise ConfigurationError(f"register {name!r}: give a number from 0 to 0xFFFF, or a name of the manual, like 'n003'")


def register_name(address: int) -> str:
    """How the manual calls a register: "n003", or "0037h" outside the parameters."""
    if address in PARAMETERS or 0x0101 <= address <= 0x01B3:
        return f"n{address - 0x0100:03d}"
    return f"{address:04X}h"


@dataclass(frozen=True, slots=True)
class Parameter:
    """Limits and factory value of an n-parameter, in the drive's own units."""

    minimum: int
    maximum: int
    default: int
    text: str


# n003, n004, n035 and n152 as tables 1.5 and 1.10 to 1.13 print them. The card's manual names the others without
# figures; theirs are the V7's usual ones. n024 and the terminals' functions are taken as far as the card needs them.
PARAMETERS: Mapping[int, Parameter] = MappingProxyType({
    register("n002"): Parameter(0, 1, 0, "control method"),
    register("n003"): Parameter(0, 3, 1, "operation method selection"),
    register("n004"): Parameter(0, 9, 2, "reference selection"),
    register("n011"): Parameter(500, 4000, 600, "maximum frequency, 0.1 Hz"),
    register("n018"): Parameter(0, 1, 0, "acceleration/deceleration time unit: 0.1 s, 0.01 s"),
    register("n019"): Parameter(0, 6000, 100, "acceleration time from 0 to n011"),
    register("n020"): Parameter(0, 6000, 100, "deceleration time from n011 to 0"),
    register("n024"): Parameter(0, 40000, 600, "frequency reference 1, 0.01 Hz"),
    register("n035"): Parameter(0, 3999, 0, "operator keypad display mode"),
    register("n052"): Parameter(0, 35, 3, "function of input terminal S3"),
    register("n053"): Parameter(0, 35, 5, "function of input terminal S4"),
    register("n054"): Parameter(0, 35, 6, "function of input terminal S5"),
    register("n055"): Parameter(0, 35, 7, "function of input terminal S6"),
    register("n056"): Parameter(0, 35, 10, "function of input terminal S7"),
    register("n057"): Parameter(0, 21, 0, "function of output terminal MA"),
    register("n058"): Parameter(0, 21, 1, "function of output terminal P1"),
    register("n059"): Parameter(0, 21, 2, "function of output terminal P2"),
    register("n152"): Parameter(0, 3, 0, "frequency reference unit selection"),
})
COMMISSIONED: Mapping[int, int] = MappingProxyType({register("n003"): 3, register("n004"): 9, register("n152"): 1})
"""What commissioning for the bus sets: run/stop and frequency from the option card, 0.01 Hz."""
CONTROL: Mapping[str, int] = MappingProxyType({"n003": 3, "n004": 9})
"""What the option card needs to move the drive."""

HIGHEST_FREQUENCY = 400.0
"""Hz; the largest n011."""

# -- Frequency units (tables 1.12 and 1.13) ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FrequencyUnit:
    """What one count of a frequency word means."""

    name: str
    hz: float
    """Hz of one count."""

    @classmethod
    def of(cls, n035: int, n152: int, maximum: float) -> FrequencyUnit:
        """The unit that the parameters select; per cent and fractions are of `maximum`, n011 in Hz."""
        if n035 == 0 and 0 <= n152 <= 3:
            return (cls("0.1 Hz", 0.1), cls("0.01 Hz", 0.01), cls("100 % / 30000", maximum / 30000),
                    cls("0.1 %", maximum / 1000))[n152]
        if n035 == 1:
            return cls("0.1 %", maximum / 1000)
        if 2 <= n035 <= 39:  # rpm = 120 f / poles
            return cls(f"rpm of {n035} poles", n035 / 120)
        raise ConfigurationError(f"n035 = {n035}, n152 = {n152}: no table defines the frequency unit of a user setting; "
                                 "set n035 to 0..39 (0 with n152 = 1 for 0.01 Hz)")

    @classmethod
    def named(cls, name: str) -> FrequencyUnit:
        """A unit that needs no parameter: "0.01 Hz" or "0.1 Hz"."""
        units = {"0.01hz": cls("0.01 Hz", 0.01), "0.1hz": cls("0.1 Hz", 0.1)}
        try:
            return units["".join(str(name).split()).casefold()]
        except KeyError:
            raise ConfigurationError(f"frequency_unit {name!r}: give '0.01 Hz', '0.1 Hz' or a FrequencyUnit") from None

    def to_bus(self, hz: float) -> int:
        """Hz to the nearest count of the bus."""
        if not math.isfinite(hz) or not 0 <= round(hz / self.hz) <= 0xFFFF:
            raise ConfigurationError(f"{hz} Hz: does not fit a word in units of {self.name}")
        return round(hz / self.hz)

    def to_hz(self, word: int) -> float:
        """A word of the bus in Hz, without the crumbs of binary fractions."""
        return round(word * self.hz, 6)


# -- What the card shows at its front (tables 1.6 to 1.9) --------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LEDs:
    """The four indicators: "off", or "solid" or "flashing" with the colour."""

    pwr: str
    comm: str
    err: str
    wd: str


LED_ROWS: Mapping[str, LEDs] = MappingProxyType({
    "Power OFF": LEDs("off", "off", "off", "off"),
    "CPU Error": LEDs("solid green", "off", "solid red", "solid red"),
    "Drive Error": LEDs("solid green", "off", "solid red", "flashing red"),
    "Com Error": LEDs("solid green", "off", "flashing red", "solid green"),
    "CPU Init": LEDs("solid green", "solid green", "off", "solid green"),
    "Normal": LEDs("solid green", "solid green", "off", "flashing green"),
    # Not a row of table 1.8, but of table 1.6: ERR is lit when no data exchange takes place.
    "No exchange": LEDs("solid green", "off", "solid red", "flashing green"),
})

FAULTS: Mapping[str, str] = MappingProxyType({
    "BUS": "option communication error",
    "EF0": "external fault from the option",
    "F06": "option connection fault",
    "F21": "communication option self-diagnostic fault",
    "F22": "communication option model code fault",
    "F23": "communication option mutual diagnostic fault",
})


def bits(word: Iterable[IntFlag]) -> str:
    """Names of flags for a message: "running, ready"."""
    return ", ".join(str(flag.name).lower() for flag in word) or "none"
