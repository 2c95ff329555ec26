# SPDX-License-Identifier: MIT
"""The tables of the SI-P3's technical manual (SIEP C730600 42), copied here number by number.

Where the manual contradicts itself the numbers are the settled ones of the devices page, and the test says so.
"""

from __future__ import annotations

import pytest

from dpmaster.errors import ConfigurationError
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.ppo import ControlWord, StatusWord
from dpmaster.profiles.yaskawa import Configuration
from dpmaster.profiles.yaskawa_1000 import YASKAWA_1000, Command, Condition, LEDs, Parameter, Status


def test_gsd_modules() -> None:
    """Device data: the thirteen Module lines, in their order."""
    assert [(c.name, c.identifier.hex(" ")) for c in profile.CONFIGURATIONS] == [
        ("Basic data", "72"), ("Extended Data 1", "5f 6f"), ("Extended Data 2", "55 65"),
        ("PPO Type 1", "f3 f1"), ("PPO Type 2", "f3 f5"), ("PPO Type 3", "f1"), ("PPO Type 4", "f5"), ("PPO Type 5", "f3 f9"),
        ("PPO Type 1 (No Cons.)", "73 71"), ("PPO Type 2 (No Cons.)", "73 75"), ("PPO Type 3 (No Cons.)", "71"),
        ("PPO Type 4 (No Cons.)", "75"), ("PPO Type 5 (No Cons.)", "73 79")]
    assert [c.size for c in profile.CONFIGURATIONS[:8]] == [6, 32, 12, 12, 20, 4, 12, 28]


def test_gsd_figures() -> None:
    """Ident Number 0x0ACF; Ext_User_Prm_Data_Const(0) 0x40,0x01,0x00,0x01; MaxTsdr; Min Slave Interval 5."""
    assert profile.IDENT_NUMBER == 0x0ACF and bytes.fromhex("40 01 00 01") == profile.USER_PARAMETERS
    assert list(profile.MAX_TSDR.values()) == [60, 60, 60, 60, 60, 100, 150, 250, 450, 800]
    assert profile.MIN_SLAVE_INTERVAL == 5


def test_configuration_names() -> None:
    assert profile.configuration("ppo  TYPE 2") is profile.CONFIGURATIONS[4]
    with pytest.raises(ConfigurationError, match=r"'PPO 2'.*'Basic data', .*'PPO Type 5 \(No Cons.\)'"):
        profile.configuration("PPO 2")


@pytest.mark.parametrize(("name", "outputs", "inputs", "channel"), [
    ("Basic data", {"command": 0, "frequency_reference": 2, "torque_reference": 4},
     {"status": 0, "motor_speed": 2, "output_current": 4}, None),
    ("Extended Data 1",
     {"command": 0, "frequency_reference": 2, "torque_reference": 4, "torque_compensation": 6, "analog_output_1": 10,
      "analog_output_2": 12, "digital_output": 14},
     {"status": 0, "motor_speed": 2, "torque_reference": 4, "pulse_count": 6, "frequency_reference": 8, "output_frequency": 10,
      "output_current": 12, "analog_input": 14}, (16, 20, 4, 31)),
    ("Extended Data 2", {"command": 0, "frequency_reference": 2}, {"status": 0, "motor_speed": 2}, (4, 8, 1, 11))])
def test_tables_8_9_and_12_register_maps(name: str, outputs: dict[str, int], inputs: dict[str, int],
                                         channel: tuple[int, ...] | None) -> None:
    layout = profile.configuration(name)
    assert isinstance(layout, Configuration)
    assert (dict(layout.outputs), dict(layout.inputs)) == (outputs, inputs)
    where = layout.channel
    assert channel == (where and (where.offset, where.data, where.words, where.handshake))


def test_table_10_operation_command() -> None:
    assert [flag.value.bit_length() - 1 for flag in Command] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 14, 15]
    assert (Command.EXTERNAL_FAULT, Command.FAULT_RESET, Command.HISTORY_RESET, Command.BASEBLOCK) == (
        0x0100, 0x0200, 0x4000, 0x8000)


def test_table_11_drive_status() -> None:
    assert [flag.name for flag in Status] == [
        "RUNNING", "ZERO_SPEED", "REVERSE", "RESET", "SPEED_AGREE", "READY", "ALARM", "FAULT", "OPE_ERROR", "POWER_LOSS",
        "NET_CONTROL", "OUTPUT_M1", "OUTPUT_P1", "OUTPUT_P2", "MOTOR_2", "ZERO_SERVO"]
    assert [flag.value for flag in Status] == [1 << bit for bit in range(16)]


def test_control_and_status_word() -> None:
    """STW: 3 enable, 4 run, 7 reset, 8 and 9 jog, 10 control. ZSW: 0, 1, 4, 5 always 1."""
    assert (profile.RUN, profile.JOG_FORWARD, profile.JOG_REVERSE) == (1 << 4, 1 << 8, 1 << 9)
    assert profile.RUN_STOPPED == ControlWord.ENABLE_OPERATION | ControlWord.CONTROL == 0x0408
    assert profile.STATUS_ALWAYS == 0x0033 and StatusWord.SPEED_AGREE == 1 << 8


@pytest.mark.parametrize(("name", "default", "values"), [
    ("b1-01", 1, range(5)), ("b1-02", 1, range(4)), ("F6-01", 1, range(4)), ("F6-02", 0, range(2)), ("F6-03", 1, range(4)),
    ("F6-06", 0, range(2)), ("F6-07", 0, range(2)), ("F6-08", 0, range(2)), ("F6-30", 0, range(126)), ("F6-31", 0, range(2)),
    ("F6-32", 0, range(2)), ("F6-33", 0, range(2))])
def test_table_7_parameter_settings(name: str, default: int, values: range) -> None:
    """Defaults of b1-01 and b1-02 are lost in the table: 1, the drive's terminals."""
    parameter = YASKAWA_1000[name]
    assert (parameter.default, parameter.minimum, parameter.maximum) == (default, values[0], values[-1])


@pytest.mark.parametrize(("name", "value", "word"), [
    ("d1-01", 30, 0x0BB8),    # example 1: the frequency reference is 30 Hz
    ("H4-03", -5, 0xFFCE),    # example 2: -5 % as the bias of terminal FM
    ("d1-01", 60.00, 0x1770),  # example 3
    ("d1-17", 6.00, 0x0258), ("C1-01", 1.0, 10)])  # examples of chapter 8
def test_examples_of_numbers(name: str, value: float, word: int) -> None:
    parameter = YASKAWA_1000[name]
    assert parameter.to_word(value) == word and parameter.to_value(word) == value


def test_registers_that_the_manual_names() -> None:
    """d1-01 is 0280h (example 3), C1-01 0200h (chapter 8), drive status U1-12; PNU 916's P0.68 to P0.73 are U1-05 to U1-10."""
    assert [YASKAWA_1000.register(name) for name in ("d1-01", "c1-01", "0024h", 0x24)] == [0x280, 0x200, 0x24, 0x24]
    assert [YASKAWA_1000.register_name(n) for n in (0x280, 0x24)] == ["d1-01", "0024h"]
    texts = [YASKAWA_1000.at(n).text for n in (68, 69, 70, 71, 72, 73)]  # type: ignore[union-attr]
    assert texts == ["motor speed", "output voltage", "DC bus voltage", "output power", "torque reference",
                     "input terminals S1 to S8"]
    assert [profile.MONITOR_COPIES[n] - 63 for n in (36, 38)] == [2, 3]  # U1-02 output frequency, U1-03 output current


@pytest.mark.parametrize(("name", "value"), [("F6-30", 126), ("d1-01", -0.01), ("d1-01", 400.01), ("C1-01", True),
                                             ("C1-01", float("nan")), ("H4-03", "5")])
def test_values_outside_the_limits(name: str, value: object) -> None:
    with pytest.raises(ConfigurationError, match=rf"{name} = .*: .* to "):
        YASKAWA_1000[name].to_word(value)  # type: ignore[arg-type]


def test_a_table_of_ones_own() -> None:
    own = Parameter("U4-01", 0x004C, 0, 0xFFFF_FFFF, 0, "operation time", 1.0, "h", "r", double=True)
    bias = Parameter("b3-01", 0x0191, -0x8000_0000, 0x7FFF_FFFF, 0, "a signed double word", 0.01, double=True)
    table = YASKAWA_1000.extended([own, bias])
    assert len(table) == len(YASKAWA_1000) + 2 and table["u4-01"] is own
    assert table.at(0x4C) is own and table.at(0x4D) is own and table.at(0x4E) is None
    assert bias.to_word(-0.01) == 0xFFFF_FFFF and bias.to_value(0xFFFF_FFFF) == -0.01
    for register, text in ((0x0200, "C1-01 is there"), (0x01FF, "0200h: C1-01 is there"), (0x0600, "0601h: they go to 0600h")):
        with pytest.raises(ConfigurationError, match=text):
            YASKAWA_1000.extended([Parameter("n1-01", register, 0, 1, 0, "", double=True)])
    with pytest.raises(ConfigurationError, match="like 'C1-01'"):
        YASKAWA_1000.extended([Parameter("n9-01", 0x500, 0, 1, 0, "")])


GROUPS = """11 A1 12 A2 21 b1 22 b2 23 b3 24 b4 25 b5 26 b6 27 b7 28 b8 29 b9 31 C1 32 C2 33 C3 34 C4 35 C5 36 C6 41 d1 42 d2
    43 d3 44 d4 45 d5 46 d6 47 d7 51 E1 52 E2 53 E3 54 E4 55 E5 61 F1 62 F2 63 F3 64 F4 65 F5 66 F6 67 F7 81 H1 82 H2 83 H3
    84 H4 85 H5 86 H6 121 L1 122 L2 123 L3 124 L4 125 L5 126 L6 127 L7 128 L8 141 n1 142 n2 143 n3 145 n5 146 n6 148 n8
    151 o1 152 o2 153 o3 154 o4 171 q1 181 r1 201 T1 202 T2 203 T3 211 U1 212 U2 213 U3 214 U4 215 U5 216 U6 217 U7 218 U8"""


def test_pnu_numbers_for_drive_parameters() -> None:
    """The table prints 121 for L1 and L2; L2 is 122, as the row of L3 says."""
    words = GROUPS.split()
    assert dict(profile.GROUPS) == dict(zip(map(int, words[::2]), words[1::2], strict=True))
    assert profile.parse_name("C1-01") == (31, 1) and profile.parse_name(" D1-17 ") == (41, 17)
    assert profile.parameter_name(41, 17) == "d1-17" and profile.parameter_name(915, 3) == "P915.3"
    for name in ("C7-01", "C1-1", "n003", "", 31):
        with pytest.raises(ConfigurationError, match="like 'C1-01'"):
            profile.parse_name(name)  # type: ignore[arg-type]


def test_supported_pnu() -> None:
    assert profile.PNU_WRITE_TYPES == {900: 1, 901: 2, 902: 3, 903: 4, 905: 5}
    assert profile.PNU_READ_TYPES == {907: 1, 908: 2, 909: 3, 910: 4, 912: 5}
    assert (profile.PNU_WRITE_TYPE, profile.PNU_READ_TYPE, profile.PNU_ASSIGN_WRITE, profile.PNU_ASSIGN_READ) == (
        904, 911, 915, 916)
    assert (profile.PNU_ADDRESS, profile.PNU_FAULTS, profile.PNU_FAULT_TIMES, profile.PNU_BAUDRATE) == (918, 947, 948, 963)
    assert (profile.PNU_IDENTIFICATION, profile.PNU_PROFILE, profile.PNU_CONTROL, profile.PNU_STATUS, profile.PNU_STORE) == (
        964, 965, 967, 968, 971)
    assert (profile.PNU_ENTER_RAM, profile.PNU_ENTER_ROM, profile.PROFILE) == (300, 301, 0x0302)
    assert profile.IDENTIFICATION == (273, 1, 0, 2007, 220, 1)


def test_pnu_915_916_and_the_registers_of_pnu_0() -> None:
    assert profile.ASSIGNED_WRITE == (1, 2, 6, 7, 9, 15, 0, 0, 0, 0)
    assert profile.ASSIGNED_READ == (32, 2, 36, 38, 68, 69, 70, 72, 71, 73)
    assert sorted(profile.ASSIGNABLE_WRITE) == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 15, 16, 17, 27, 28, 29]
    assert sorted(profile.ASSIGNABLE_READ - profile.ASSIGNABLE_WRITE) == list(range(32, 256))


def test_pnu_963_baud_rate() -> None:
    """Value 5 is not printed; 45.45 kbit/s has no value in the table and is the profile's 11."""
    kilobits = {9.6: 0, 19.2: 1, 93.75: 2, 187.5: 3, 500: 4, 1500: 6, 3000: 7, 6000: 8, 12000: 9, 45.45: 11}
    assert {round(rate * 1000): value for rate, value in kilobits.items()} == profile.BAUDRATES


def test_diagnosis_bits() -> None:
    """Unit_Diag_Bit(0024) to (0027), Max_Diag_Data_Len 11: six octets and a status block of five."""
    assert profile.diagnosis(Condition(0)) == b""
    assert profile.diagnosis(Condition.UNDERVOLTAGE) == bytes.fromhex("05 81 00 00 01")
    assert profile.diagnosis(Condition.INVERTER_COMMUNICATION | Condition.ILLEGAL_PNU_916) == bytes.fromhex("0581 0000 0a")
    assert Condition.ILLEGAL_PNU_915 == 4


def test_table_4_leds() -> None:
    assert [*profile.LED_ROWS.values()] == [
        LEDs("off", "off", "off", "off"), LEDs("solid green", "off", "off", "off"), LEDs("off", "solid red", "off", "off"),
        LEDs("off", "flashing red", "off", "off"), LEDs("solid green", "off", "off", "solid red"),
        LEDs("solid green", "off", "off", "flashing red"), LEDs("solid green", "off", "solid green", "off")]


def test_tables_16_and_17_faults_and_alarms() -> None:
    named = {"bUS", "EF0", "oFA00", "oFA01", "oFA30", "oFA43", "oFb00", "oFb02", "oFc00", "oFc02"}
    assert named <= set(profile.FAULTS) and set(profile.ALARMS) == {"bb", "CALL", "bUS", "EF0"}
    assert len({number for number, _ in profile.FAULTS.values()}) == len(profile.FAULTS)


@pytest.mark.parametrize(("o1_03", "hz", "word"), [(0, 30.0, 3000), (1, 30.0, 5000), (2, 30.0, 900)])
def test_display_scaling(o1_03: int, hz: float, word: int) -> None:
    """Example 1: 30 Hz is BB8h in 0.01 Hz; 0.01 % of E1-04 = 60 Hz; r/min of 4 poles."""
    assert profile.frequency_unit(o1_03, 60.0).to_bus(hz) == word
    with pytest.raises(ConfigurationError, match="set o1-03 to 0"):
        profile.frequency_unit(3, 60.0)


def test_unit_of_the_current() -> None:
    """Table 8, note 4: 0.01 A for drives 7.5 kW and smaller, 0.1 A for 11 kW and larger."""
    assert (profile.current_unit(7.5), profile.current_unit(11)) == (0.01, 0.1)


@pytest.mark.parametrize("address", [0, 126, -1, "5", True])
def test_addresses_that_f6_30_does_not_take(address: object) -> None:
    with pytest.raises(ConfigurationError, match=r"1 to 125 \(0 lights ERR\)"):
        profile.check_address(address)  # type: ignore[arg-type]


def test_addresses_below_3_are_warned_of() -> None:
    assert "masters" in (profile.check_address(2) or "")
    assert profile.check_address(3) is None and profile.check_address(125) is None
