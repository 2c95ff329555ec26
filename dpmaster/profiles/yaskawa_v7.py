# SPDX-License-Identifier: MIT
"""The SI-P1 option card in a Yaskawa V7 as both sides of the wire see it: words, bits, parameters, units.

Tables are those of the V7 PROFIBUS-DP Option manual, TM.V7.12. What the newer card has in common with it is in `yaskawa`.
Pure data and arithmetic; touches nothing but `dpmaster.errors`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from types import MappingProxyType

from dpmaster.errors import ConfigurationError
from dpmaster.profiles.yaskawa import ChannelMap, Configuration, FrequencyUnit, find, judge_address

# -- YASK00CA.GSD ----------------------------------------------------------------------------------------------------------

IDENT_NUMBER = 0x00CA
MAX_TSDR: Mapping[int, int] = MappingProxyType({
    9_600: 60, 19_200: 60, 45_450: 250, 93_750: 60, 187_500: 60, 500_000: 100, 1_500_000: 150, 3_000_000: 250,
    6_000_000: 450, 12_000_000: 800,
})
"""Bit times by rate (bit/s)."""
MIN_SLAVE_INTERVAL = 1
"""0.1 ms."""

# -- The three configurations (tables 3.1, 3.7 and 3.12) ----------------------------------------------------------------

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
    return find(name, CONFIGURATIONS)


def check_address(address: int) -> str | None:
    """Judge a node address by the card's two rotary switches: an error outside 1..99, a warning (returned) below 3."""
    return judge_address(address, 99, "the card's two switches set 1 to 99")


# -- Words of the fast I/O area (tables 3.2, 3.3, 3.8, 3.9, 3.13, 3.14) -------------------------------------------------


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

# -- Registers and parameters -------------------------------------------------------------------------------------------


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


FREQUENCY_REFERENCE = 0x0002
"""The reference that n004 = 6 takes: written by parameter access (table 1.11), at the drive's usual register."""
ENTER = 0x0900
"""The ENTER command of table 3.15, which gives no number; this is the drives' usual one. What the bus has written then outlives
the power. To be written only: to every other access it is above 0600h."""

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


def frequency_unit(n035: int, n152: int, maximum: float) -> FrequencyUnit:
    """What one count of a frequency word means; per cent and fractions are of `maximum`, n011 in Hz (tables 1.12 and 1.13)."""
    if n035 == 0 and 0 <= n152 <= 3:
        return (FrequencyUnit("0.1 Hz", 0.1), FrequencyUnit("0.01 Hz", 0.01), FrequencyUnit("100 % / 30000", maximum / 30000),
                FrequencyUnit("0.1 %", maximum / 1000))[n152]
    if n035 == 1:
        return FrequencyUnit("0.1 %", maximum / 1000)
    if 2 <= n035 <= 39:  # rpm = 120 f / poles
        return FrequencyUnit(f"rpm of {n035} poles", n035 / 120)
    raise ConfigurationError(f"n035 = {n035}, n152 = {n152}: no table defines the frequency unit of a user setting; "
                             "set n035 to 0..39 (0 with n152 = 1 for 0.01 Hz)")


# -- What the card shows at its front (tables 1.6 to 1.9) ---------------------------------------------------------------


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
