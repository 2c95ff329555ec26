# SPDX-License-Identifier: MIT
"""The tables of chapters 1 and 3 of the V7 PROFIBUS-DP Option manual (TM.V7.12), copied here number by number.

Where the manual contradicts itself the numbers are the settled ones, and the test says so.
"""

import pytest

from dpmaster.errors import ConfigurationError
from dpmaster.profiles import yaskawa, yaskawa_v7
from dpmaster.profiles.yaskawa import Access, FrequencyUnit
from dpmaster.profiles.yaskawa_v7 import MAX_TSDR, Command, Output, Status


def test_gsd_modules() -> None:
    """GSD file: Module = "Basic data" 0x72, "Extended Data 1" 0x5F, 0x6F, "Extended Data 2" 0x55, 0x65."""
    assert [(c.name, c.identifier.hex(), c.size) for c in yaskawa_v7.CONFIGURATIONS] == [
        ("Basic data", "72", 6), ("Extended Data 1", "5f6f", 32), ("Extended Data 2", "5565", 12)]


def test_gsd_max_tsdr() -> None:
    """GSD file: MaxTsdr_9.6 = 60 ... MaxTsdr_45.45 = 250 ... MaxTsdr_12M = 800."""
    assert MAX_TSDR == {9600: 60, 19200: 60, 45450: 250, 93750: 60, 187500: 60, 500000: 100, 1500000: 150, 3000000: 250,
                        6000000: 450, 12000000: 800}


def test_table_3_1_16_word_message() -> None:
    c = yaskawa_v7.EXTENDED_DATA_1
    assert dict(c.outputs) == {"command": 0, "frequency_reference": 2, "multi_function_output": 14}
    assert dict(c.inputs) == {"status": 0, "frequency_reference": 8, "output_frequency": 10, "output_current": 12,
                              "pulse_train": 14}
    assert c.channel is not None
    assert (c.channel.offset, c.channel.data, c.channel.words, c.channel.handshake) == (16, 20, 4, 31)


def test_table_3_7_6_word_message() -> None:
    """Prints 13 octets; `55 65` says 12, so the handshake register is octet 11. Word 1 of the inputs is the feedback."""
    c = yaskawa_v7.EXTENDED_DATA_2
    assert dict(c.outputs) == {"command": 0, "frequency_reference": 2}
    assert dict(c.inputs) == {"status": 0, "output_frequency": 2}
    assert c.channel is not None
    assert (c.channel.offset, c.channel.data, c.channel.words, c.channel.handshake) == (4, 8, 1, 11)


def test_table_3_12_3_word_message() -> None:
    c = yaskawa_v7.BASIC_DATA
    assert dict(c.outputs) == {"command": 0, "frequency_reference": 2, "torque_reference": 4}
    assert dict(c.inputs) == {"status": 0, "frequency_reference": 2, "torque_reference": 4}
    assert c.channel is None


@pytest.mark.parametrize(("name", "bit"), [
    ("FORWARD", 0), ("REVERSE", 1), ("S3", 2), ("S4", 3), ("S5", 4), ("S6", 5), ("S7", 6), ("EXTERNAL_FAULT", 8),
    ("FAULT_RESET", 9)])
def test_tables_3_2_3_8_and_3_13_command_bits(name: str, bit: int) -> None:
    assert Command[name] == 1 << bit


def test_forward_run_is_the_octets_00_01() -> None:
    """Bit 0 of the word lies in byte 1, as "MSB" and "LSB" of table 3.1 say; table 3.2's columns put it beside byte 0."""
    assert Command.FORWARD.to_bytes(2, "big") == b"\x00\x01"
    assert Command.EXTERNAL_FAULT.to_bytes(2, "big") == b"\x01\x00"
    assert yaskawa.get_word(b"\x01\x00", 0, "little") == Command.FORWARD


@pytest.mark.parametrize(("name", "bit"), [
    ("RUNNING", 0), ("ZERO_SPEED", 1), ("REVERSE", 2), ("RESET", 3), ("FREQUENCY_AGREE", 4), ("READY", 5), ("MINOR_FAULT", 6),
    ("MAJOR_FAULT", 7), ("OPE_ERROR", 8), ("FAULT_RESTART", 9), ("LOCAL_REMOTE", 10), ("OUTPUT_1", 11), ("OUTPUT_2", 12),
    ("OUTPUT_3", 13)])
def test_tables_3_3_3_9_and_3_14_status_bits(name: str, bit: int) -> None:
    assert Status[name] == 1 << bit


def test_table_3_2_multi_function_output_bits() -> None:
    """MA MB MC, P1-PC, P2-PC: bits 0 to 2 of the word at 14, so they lie in byte 15."""
    assert (Output.MA, Output.P1, Output.P2) == (1, 2, 4)


def test_tables_3_4_3_5_3_10_and_3_11_access_messages() -> None:
    """Function 03h/10h, starting address MSB, LSB, data quantity in bytes, data 1 to 4 MSB first."""
    assert Access(0x03, 0x0037, 2).encode(4).hex() == "03003702" + "0000" * 4
    assert Access(0x10, 0x1234, 8, (0x5678, 2, 3, 4)).encode(4).hex() == "10123408" + "5678000200030004"
    assert Access(0x10, 0x0105, 2, (1,)).encode(1).hex() == "100105020001"
    where = yaskawa_v7.EXTENDED_DATA_1.channel
    assert where is not None
    image = bytes(16) + bytes.fromhex("83000002000200000000000000000000")
    assert Access.decode(image, where) == Access(0x83, 0, 2, (2, 0, 0, 0))
    assert Access.error(0x10, yaskawa.AccessCode.ADDRESS).encode(1).hex() == "900000020002"
    assert (yaskawa.Function.NONE, yaskawa.Function.READ, yaskawa.Function.WRITE) == (0x00, 0x03, 0x10)


def test_table_3_15_error_codes() -> None:
    assert {int(code): text.split(":")[0] for code, text in yaskawa.ACCESS_MEANINGS.items()} == {
        0x01: "function error", 0x02: "address error", 0x03: "amount of data", 0x21: "data content", 0x22: "write fault"}
    assert yaskawa.LAST_REGISTER == 0x600


def test_tables_3_16_and_3_17_handshake_registers() -> None:
    """HS bit 7; STATUS bits 6 - 5: 00 idle, 01 sending, 10 waiting, 11 received; WD bits 4 - 1; bit 0 not used."""
    assert yaskawa.HS == 0b1000_0000 and yaskawa.STATUS_MASK == 0b0110_0000
    assert [int(t) for t in yaskawa.Transfer] == [0b0000_0000, 0b0010_0000, 0b0100_0000, 0b0110_0000]
    assert (yaskawa.WD_MODULUS - 1) << yaskawa.WD_SHIFT == 0b0001_1110
    assert yaskawa.HANDSHAKE_MASK == 0xE1 and yaskawa.WD_PERIOD == 0.064


@pytest.mark.parametrize(("name", "address"), [("n003", 0x103), ("n004", 0x104), ("n035", 0x123), ("n152", 0x198)])
def test_table_1_5_register_addresses(name: str, address: int) -> None:
    """103h n003, 104h n004, 123h n035; n152 by the same rule."""
    assert yaskawa_v7.register(name) == yaskawa_v7.register(f"{address:04X}h") == yaskawa_v7.register(address) == address
    assert yaskawa_v7.register_name(address) == name


@pytest.mark.parametrize("name", ["", "n3", "003", "n0003", "U1-01", -1, 65536, True, 3.0])
def test_what_is_no_register_says_how_it_is_written(name: object) -> None:
    with pytest.raises(ConfigurationError, match="like 'n003'"):
        yaskawa_v7.register(name)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "default", "values"), [
    ("n003", 1, range(4)), ("n004", 2, range(10)), ("n035", 0, range(4000)), ("n152", 0, range(4))])
def test_tables_1_5_and_1_10_to_1_13_parameters(name: str, default: int, values: range) -> None:
    parameter = yaskawa_v7.PARAMETERS[yaskawa_v7.register(name)]
    assert (parameter.default, parameter.minimum, parameter.maximum) == (default, values[0], values[-1])


@pytest.mark.parametrize(("n035", "n152", "hz", "word"), [
    (0, 0, 30.0, 300), (0, 1, 30.0, 3000), (0, 2, 30.0, 15000), (0, 3, 30.0, 500),  # n011 = 60 Hz
    (1, 1, 30.0, 500), (2, 1, 30.0, 1800), (4, 1, 30.0, 900), (39, 1, 60.0, 185)])
def test_tables_1_12_and_1_13_frequency_units(n035: int, n152: int, hz: float, word: int) -> None:
    """n152: 0 0.1 Hz, 1 0.01 Hz, 2 100% / 30,000, 3 0.1%; n035: 1 0.1%, 2 - 39 rpm (number of motor poles)."""
    unit = yaskawa_v7.frequency_unit(n035, n152, 60.0)
    assert unit.to_bus(hz) == word
    assert unit.to_hz(word) == pytest.approx(hz, rel=0.003)


@pytest.mark.parametrize(("n035", "n152"), [(40, 1), (3999, 0), (0, 4)])
def test_a_unit_that_no_table_defines_is_an_error(n035: int, n152: int) -> None:
    with pytest.raises(ConfigurationError, match=rf"n035 = {n035}, n152 = {n152}.*set n035"):
        yaskawa_v7.frequency_unit(n035, n152, 60.0)


def test_what_does_not_fit_a_word_is_an_error() -> None:
    for hz in (656.0, -0.01, float("nan"), float("inf")):
        with pytest.raises(ConfigurationError, match="does not fit"):
            FrequencyUnit.named("0.01 Hz").to_bus(hz)


def test_configuration_names() -> None:
    assert yaskawa_v7.configuration("extended  DATA 1") is yaskawa_v7.EXTENDED_DATA_1
    with pytest.raises(ConfigurationError, match=r"'Extended Data 3'.*'Basic data', 'Extended Data 1', 'Extended Data 2'"):
        yaskawa_v7.configuration("Extended Data 3")


def test_table_1_8_led_diagnostics() -> None:
    """PWR, COM, ERR, WD of every row that a card alone can tell."""
    expected = {
        "Power OFF": "off off off off", "CPU Error": "solid green|off|solid red|solid red",
        "Drive Error": "solid green|off|solid red|flashing red", "Com Error": "solid green|off|flashing red|solid green",
        "CPU Init": "solid green|solid green|off|solid green", "Normal": "solid green|solid green|off|flashing green"}
    for name, row in expected.items():
        leds = yaskawa_v7.LED_ROWS[name]
        assert [leds.pwr, leds.comm, leds.err, leds.wd] == (row.split("|") if "|" in row else row.split())


def test_table_1_9_drive_faults() -> None:
    assert list(yaskawa_v7.FAULTS) == ["BUS", "EF0", "F06", "F21", "F22", "F23"]


@pytest.mark.parametrize("address", [0, 100, 126, -1, "5", True])
def test_addresses_that_the_switches_cannot_set(address: object) -> None:
    with pytest.raises(ConfigurationError, match=r"1 to 99"):
        yaskawa_v7.check_address(address)  # type: ignore[arg-type]


def test_addresses_below_3_are_warned_of() -> None:
    assert "masters" in (yaskawa_v7.check_address(2) or "")
    assert yaskawa_v7.check_address(3) is None and yaskawa_v7.check_address(99) is None
