# SPDX-License-Identifier: MIT
"""YaskawaSIP3 against the emulated card on virtual time: the manual's examples octet by octet, all configurations, both
parameter channels under faults, and what they carry in a second. Manual: SIEP C730600 42."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from drive_bench import Virtual, VirtualSIP3, VirtualV7

from dpmaster.diagnosis import Diagnosis
from dpmaster.drives import YaskawaSIP3, channel
from dpmaster.emulator.cards import SIP1, SIP3
from dpmaster.errors import CommissioningError, ConfigurationError, DPTimeout, ParameterAccessError, StationError
from dpmaster.profiles.ppo import StatusWord
from dpmaster.profiles.yaskawa_1000 import CONFIGURATIONS, YASKAWA_1000, Parameter, Status
from dpmaster.station import Frame

PKW = ["PPO Type 1", "PPO Type 2", "PPO Type 5"]
MEMOBUS = ["Extended Data 1", "Extended Data 2"]
CHANNELS = [*PKW, *MEMOBUS]
WITHOUT = ["Basic data", "PPO Type 3", "PPO Type 4"]


def bench(configuration: str = "PPO Type 2", *, cycle: float = 0.002, lag: int = 0, settings: Any = None,
          card: Any = None, **arguments: Any) -> VirtualSIP3:
    made = card or SIP3(5, settings={"C1-01": 10, "C1-02": 10} | (settings or {}))  # ramps of a second
    return VirtualSIP3(made, configuration, cycle=cycle, lag=lag, **arguments)


def said(drive: Virtual, begin: int = 0, end: int = 8) -> list[str]:
    """What the outputs held in octets `begin` to `end`, each once, without the zeros of task 0."""
    found: list[str] = []
    for outputs, _ in drive.trace:
        text = outputs[begin:end].hex()
        if any(outputs[begin:end]) and (not found or found[-1] != text):
            found.append(text)
    return found


# -- The configurations -----------------------------------------------------------------------------------------------------

# Chapter "SI-P3 Device Data": the module lines of the GSD file.
IDENTIFIERS = {
    "Basic data": "72", "Extended Data 1": "5f6f", "Extended Data 2": "5565",
    "PPO Type 1": "f3f1", "PPO Type 2": "f3f5", "PPO Type 3": "f1", "PPO Type 4": "f5", "PPO Type 5": "f3f9",
    "PPO Type 1 (No Cons.)": "7371", "PPO Type 2 (No Cons.)": "7375", "PPO Type 3 (No Cons.)": "71",
    "PPO Type 4 (No Cons.)": "75", "PPO Type 5 (No Cons.)": "7379"}
LENGTHS = {"Basic data": 6, "Extended Data 1": 32, "Extended Data 2": 12, "PPO Type 1": 12, "PPO Type 2": 20, "PPO Type 3": 4,
           "PPO Type 4": 12, "PPO Type 5": 28}


def test_the_figures_of_the_gsd_file() -> None:
    assert list(IDENTIFIERS) == [each.name for each in CONFIGURATIONS]
    for name, identifier in IDENTIFIERS.items():
        drive = YaskawaSIP3(5, name.upper())
        length = LENGTHS[name.removesuffix(" (No Cons.)")]
        assert drive.configuration.hex() == identifier
        assert (drive.input_length, drive.output_length, drive.layout) == (length, length, name)
    assert (drive.ident_number, drive.user_parameters.hex(), drive.fail_safe, drive.min_slave_interval) == (
        0x0ACF, "40010001", True, 5)
    assert (drive.max_tsdr[12_000_000], drive.max_tsdr[45_450]) == (800, 60)


@pytest.mark.parametrize(("arguments", "text"), [
    ({"address": 0}, "F6-30 takes 1 to 125"), ({"configuration": "PPO Type 6"}, "configuration 'PPO Type 6': the card knows"),
    ({"index": 1}, "index 1: 'word' or 'byte'"), ({"size": 0}, "size 0 kW"), ({"frequency_unit": "0.1 Hz"}, "reads the unit"),
    ({"configuration": "PPO Type 3", "frequency_unit": "0.1 Hz"}, "give maximum_frequency"),
    ({"maximum_frequency": 60.0}, "reads E1-04 from the drive"),
    ({"configuration": "Basic data", "maximum_frequency": 0}, "maximum_frequency 0 Hz")])
def test_wrong_arguments_are_named(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        YaskawaSIP3(**{"address": 5} | arguments)


# -- Words of the drive -----------------------------------------------------------------------------------------------------


def test_the_octets_of_the_commands() -> None:
    """Table 10, and STW/HSW of chapter 8: bit 3 no baseblock, 4 run, 7 fault reset, 8 and 9 jog, 10 control; 10000 = 100 %."""
    ppo = bench("PPO Type 3")
    ppo.run(percent=50)
    assert ppo.outputs.hex() == "0418" + "1388"
    ppo.run(percent=100, reverse=True)
    assert ppo.outputs.hex() == "0418" + "d8f0"  # -10000
    ppo.stop()
    assert ppo.outputs.hex() == "0408" + "d8f0"
    ppo.jog()
    assert ppo.outputs.hex()[:4] == "0508"
    ppo.jog(reverse=True)
    assert ppo.outputs.hex()[:4] == "0608"
    ppo.baseblock()
    assert ppo.outputs.hex()[:4] == "0400"
    ppo.baseblock(False)
    assert ppo.outputs.hex()[:4] == "0408"
    basic = bench("Basic data")
    basic.run(30.0)
    assert basic.outputs.hex() == "0001" + "0bb8" + "0000"  # "30 Hz/0.01 Hz = 3000 -> BB8H"
    basic.run(30.0, reverse=True)
    assert basic.outputs.hex()[:4] == "0002"
    basic.baseblock()
    assert basic.outputs.hex()[:4] == "8000"


def test_run_and_direction_where_h5_12_says_so() -> None:
    """Table 10, H5-12 = 1: bit 0 is RUN, bit 1 the direction."""
    drive = bench("Extended Data 1", settings={"H5-12": 1})
    drive.run(24.0, reverse=True)
    assert drive.outputs[:2].hex() == "0003"
    drive.wait_at_speed(20.0)
    assert drive.card.motor.frequency == -24.0


@pytest.mark.parametrize("bit", range(16))
def test_every_bit_of_table_11_and_of_zsw(bit: int) -> None:
    fields = {0: "running", 1: "zero_speed", 2: "reverse", 4: "at_speed", 5: "ready", 6: "alarm", 7: "fault", 10: "remote"}
    status = bench("Basic data")._decode(Frame((1 << bit).to_bytes(2, "big") + bytes(4), 1, 0, 0.0, True))
    assert {f for f in fields.values() if getattr(status, f)} == ({fields[bit]} if bit in fields else set())
    assert status.word == Status(1 << bit)
    fields = {2: "ready", 3: "fault", 7: "alarm", 8: "at_speed", 9: "remote"}
    status = bench("PPO Type 3")._decode(Frame((1 << bit).to_bytes(2, "big") + b"\xd8\xf0", 1, 0, 0.0, True))
    assert status.running and status.reverse and not status.zero_speed and status.percent == 100.0
    assert {f for f in fields.values() if getattr(status, f)} == ({fields[bit]} if bit in fields else set())
    assert status.word == StatusWord(1 << bit)


def test_status_has_what_the_configuration_has() -> None:
    drives = {name: bench(name, maximum_frequency=60.0 if name in WITHOUT else None) for name in LENGTHS}
    for drive in drives.values():
        drive.run(30.0)
        drive.wait_at_speed(20.0)
        drive.let_pass(0.05)
    current = pytest.approx(drives["Basic data"].card.motor.current, abs=0.005)
    status = {name: drive.status for name, drive in drives.items()}
    assert all(each.output_frequency == pytest.approx(30.0, abs=1.5) for each in status.values())
    assert {name for name, each in status.items() if each.current == current} == {
        "Basic data", "Extended Data 1", "PPO Type 2", "PPO Type 4", "PPO Type 5"}
    assert {name for name, each in status.items() if each.percent == 50.0} == {name for name in LENGTHS if "PPO" in name}
    assert status["Extended Data 1"].frequency_reference == status["Extended Data 1"].output_frequency == 30.0
    # PNU 916 as printed: output frequency, current, speed, output voltage, DC bus, torque, power, input terminals.
    assert set(status["PPO Type 2"].monitors) == {"U1-02", "U1-05", "U1-06"}
    assert set(status["PPO Type 5"].monitors) == {"U1-02", "U1-05", "U1-06", "U1-07", "U1-08", "U1-10"}
    assert status["PPO Type 5"].monitors["U1-02"] == 30.0 and "U1-02=30" in str(status["PPO Type 5"])


def test_the_size_of_the_drive_is_the_unit_of_its_current() -> None:
    """Table 8, note 4: 0.01 A up to 7.5 kW, 0.1 A from 11 kW on."""
    frame = Frame(bytes(4) + b"\x03\xe8", 1, 0, 0.0, True)
    assert YaskawaSIP3(5, "Basic data", size=7.5)._decode(frame).current == 10.0
    assert YaskawaSIP3(5, "Basic data", size=11)._decode(frame).current == 100.0


@pytest.mark.parametrize(("o1_03", "word"), [(0, "0bb8"), (1, "1388"), (2, "0384")])
def test_the_unit_of_the_conventional_words_is_read_from_the_drive(o1_03: int, word: str) -> None:
    drive = bench("Extended Data 1", settings={"o1-03": o1_03})
    drive.run(30.0)
    assert drive.outputs[2:4].hex() == word
    assert drive.wait_at_speed(20.0).output_frequency == 30.0 == drive.card.motor.frequency
    with pytest.raises(ConfigurationError, match="o1-03 = 3"):
        bench("Extended Data 1", settings={"o1-03": 3}).run(30.0)


def test_hertz_without_a_channel_need_the_highest_frequency() -> None:
    drive = bench("PPO Type 4")
    with pytest.raises(ConfigurationError, match=r"PPO Type 4 has no parameter channel to read E1-04.*maximum_frequency"):
        drive.run(30.0)
    drive.run(percent=50)
    drive.wait_at_speed(20.0)
    assert drive.card.motor.frequency == 30.0
    assert (drive.percent, drive.status.percent, drive.status.output_frequency) == (50.0, 50.0, None)
    with pytest.raises(ConfigurationError, match=r"frequency 51\.0 Hz: the limit is 50\.0 Hz"):
        bench("PPO Type 4", maximum_frequency=50.0).run(51.0)


@pytest.mark.parametrize("configuration", [*CHANNELS, *WITHOUT])
def test_factory_parameters_in_the_way_are_named(configuration: str) -> None:
    """With factory parameters F6-32 is 0 and the card takes PPOs only, so here b1-01 and b1-02 are made factory's."""
    told = {"maximum_frequency": 60.0} if configuration in WITHOUT else {}
    drive = bench(configuration, settings={"b1-01": 1, "b1-02": 1}, **told)
    with pytest.raises(CommissioningError, match="b1-01") as caught:
        drive.run(24.0)
    assert caught.value.parameters == ("b1-01", "b1-02")
    assert drive._output_word("command") & 0x13 in (0, 0x00) and not drive.card.running
    if configuration in CHANNELS:
        drive.write({"b1-01": 3, "b1-02": 3})
        drive.run(24.0)
        drive.wait_at_speed(20.0)


def test_jog_baseblock_terminals_and_process_words() -> None:
    drive = bench("PPO Type 2")
    drive.jog()
    drive.wait_at_speed(10.0)
    assert drive.card.motor.frequency == 6.0
    drive.baseblock()
    drive.let_pass(0.02)
    assert drive.card.alarms == {"bb"} and not drive.card.running
    drive.process_words["pzd5"] = 5
    drive.let_pass(0.02)
    assert drive.card.registers[9] == 5  # PNU 915 as printed: PZD5 is the digital outputs
    for call in (drive.external_fault, lambda: drive.digital_inputs, lambda: drive.process_words["pzd7"]):
        with pytest.raises(ConfigurationError, match="PPO Type 2 has"):
            call()
    one = bench("Extended Data 1", settings={"H2-01": 0x0F})
    one.digital_inputs["S8"] = True
    one.digital_outputs["M1-M2"] = True
    one.process_words["torque_reference"] = -50
    assert one.outputs[:2].hex() == "0080" and one.outputs[14:16].hex() == "0001" and one.outputs[4:6].hex() == "ffce"
    one.let_pass(0.02)
    assert one.card.inputs["S8"] and one.card.outputs["M1-M2"]
    with pytest.raises(ConfigurationError, match="jog: Extended Data 1 has no bit"):
        one.jog()
    one.external_fault()
    assert one.wait_until(lambda s: s.fault, 1.0).fault and one.card.fault == "EF0"


# -- The manual's examples --------------------------------------------------------------------------------------------------


def test_writing_c1_01_and_the_enter_command() -> None:
    """Examples "Writing to C1-01" and "Writing to RAM with the Enter command": 701F 0001 10, then 212C."""
    drive = bench("PPO Type 1")
    drive.trace.clear()
    drive["C1-01"] = 1.0  # s, 10 counts
    assert said(drive) == ["701f00010000000a", "212c000000000000"]
    assert drive.card.registers["C1-01"] == 10
    drive.enter(store=True)
    assert said(drive)[-1] == "212d000000000000"  # PNU 301


def test_reading_d1_17() -> None:
    """Example "Reading to d1-17": 6029 0011, answered 4029 0011 258."""
    drive = bench("PPO Type 1")
    drive.trace.clear()
    assert drive["d1-17"] == 6.0
    assert said(drive) == ["6029001100000000"]
    assert drive.trace[-1][1][:8].hex() == "4029001100000258"


def test_the_ppo_as_the_card_has_it() -> None:
    """Examples of PNU 900, 907 and 904: 6384 with IND 5 and 1, 638B with IND 5, 1388."""
    drive = bench("PPO Type 1")
    drive.run(percent=10)
    drive.let_pass(0.02)
    drive.trace.clear()
    assert drive.read_pnu(900, 5) == 0x0418  # STW
    assert drive.read_pnu(907, 5) == int(drive.card.status_word)
    assert drive.read_pnu(900, 1) == 0x6384  # the request itself
    assert drive.read_pnu(904) == 1
    assert said(drive) == ["6384000500000000", "638b000500000000", "6384000100000000", "1388000000000000"]


def test_ind_as_a_byte() -> None:
    """F6-33 = 1: the sub-index is the high byte of IND."""
    drive = bench("PPO Type 1", settings={"F6-33": 1}, index="byte")
    drive.trace.clear()
    assert drive["d1-17"] == 6.0
    assert said(drive) == ["6029110000000000"]
    with pytest.raises(ConfigurationError, match="sub-index of one byte"):
        drive.read_register(0x0200)


@pytest.mark.parametrize(("configuration", "begin", "length"), [("Extended Data 1", 16, 12), ("Extended Data 2", 4, 6)])
def test_table_15(configuration: str, begin: int, length: int) -> None:
    """60.00 Hz is assigned for d1-01 (0280h): 10 0280 02 1770; at a fault 90 0000 02 and the code."""
    drive = bench(configuration)
    drive.trace.clear()
    drive.write_register("d1-01", 6000)
    assert said(drive, begin, begin + length)[0] == "100280021770".ljust(2 * length, "0")
    assert drive.trace[-1][1][begin:begin + length].hex() == "10028002".ljust(2 * length, "0")
    with pytest.raises(ParameterAccessError, match=r"write 1000h: the drive answers error 02h, address error"):
        drive.write_register(0x1000, 1)
    assert drive.trace[-1][1][begin:begin + length].hex() == "900000020002".ljust(2 * length, "0")


def test_a_negative_number() -> None:
    """Example 2: -5 % as the bias of FM is FFCEh."""
    for configuration in ("PPO Type 1", "Extended Data 1"):
        drive = bench(configuration)
        drive["H4-03"] = -5.0
        assert drive.read_register("H4-03") == 0xFFCE and drive["H4-03"] == -5.0 and drive.card.registers["H4-03"] == -50


# -- Parameters by name, through either channel -----------------------------------------------------------------------------


@pytest.mark.parametrize("configuration", CHANNELS)
def test_parameters_by_their_names_with_units_and_ranges(configuration: str) -> None:
    drive = bench(configuration)
    drive["d1-17"] = 7.5
    drive["c1-01"] = 2.5
    assert (drive["d1-17"], drive["C1-01"], drive["U1-07"]) == (7.5, 2.5, 311)
    assert (drive.card.registers["d1-17"], drive.card.registers["C1-01"]) == (750, 25)
    drive.run(30.0)
    drive.wait_at_speed(20.0)
    assert drive["U1-02"] == 30.0
    with pytest.raises(ConfigurationError, match=r"C1-01 = 6000\.1: acceleration time .*0 to 6000 s"):
        drive["C1-01"] = 6000.1
    with pytest.raises(ParameterAccessError, match=r"write b1-01: the drive answers error .*running"):
        drive["b1-01"] = 2
    with pytest.raises(ParameterAccessError, match="write U1-01"):
        drive["U1-01"] = 1
    with pytest.raises(ConfigurationError, match="'x9-99'"):
        _ = drive["x9-99"]
    info = drive.parameter("C1-01")
    assert info.describe(2.5) == "2.5 s       acceleration time from 0 to E1-04 (0.0 to 6000.0)"
    assert "C1-01" in drive.parameter_names


@pytest.mark.parametrize("configuration", CHANNELS)
def test_ram_and_rom(configuration: str) -> None:
    drive = bench(configuration)
    drive.write({"d1-01": 10.0, "d1-02": 20.0})
    drive.write({"d1-03": 30.0}, store=True)
    drive.write_register("d1-04", 4000)
    assert drive["d1-04"] == 40.0 and drive.card.registers.setting("d1-04") == 0, "written, and not in force before Enter"
    drive.enter()
    assert drive.card.registers.setting("d1-04") == 4000
    drive.card.reset(drive.now)
    drive.lose(0.3)
    assert [drive[f"d1-0{n}"] for n in range(1, 5)] == [10.0, 20.0, 30.0, 0.0]


@pytest.mark.parametrize("configuration", CHANNELS)
def test_units_are_read_anew_only_where_a_write_may_have_changed_them(configuration: str) -> None:
    drive = bench(configuration)
    drive.run(30.0)
    drive.wait_at_speed(20.0)
    drive["C1-01"] = 3.0
    with pytest.raises(ParameterAccessError, match="running"):
        drive["E1-04"] = 50.0
    assert drive.status.output_frequency == 30.0
    drive.stop()
    drive.wait_stopped(20.0)
    with pytest.raises(ParameterAccessError, match="write U1-01"):
        drive.write({"E1-04": 50.0, "U1-01": 1})  # the first is written, but no Enter command follows
    assert drive.highest_frequency == 60.0 == drive.card.registers.setting("E1-04") / 10
    drive["C1-01"] = 3.0  # one follows here
    assert drive.highest_frequency == 50.0 == drive.card.registers.setting("E1-04") / 10


@pytest.mark.parametrize(("configuration", "enter"), [
    *((name, lambda drive: drive.enter()) for name in CHANNELS),
    *((name, lambda drive, at=at: drive.write_register(at, 0)) for name in MEMOBUS for at in ("0910h", "0900h")),
    *(("PPO Type 2", lambda drive, pnu=pnu: drive.write_pnu(pnu, 0)) for pnu in (300, 301)),
    ("PPO Type 2", lambda drive: drive.write_pnu(971, 1))])
def test_every_form_of_the_enter_command_forgets_units(configuration: str, enter: Callable[[Any], None]) -> None:
    """SI-P3 manual, chapter 8: PNU 300, 301 and 971; registers 0910h and 0900h."""
    drive = bench(configuration)
    assert drive.highest_frequency == 60.0
    drive.write_register("E1-04", 500)
    assert drive.highest_frequency == 60.0, "written, and not in force before Enter"
    enter(drive)
    assert drive.highest_frequency == 50.0 == drive.card.registers.setting("E1-04") / 10
    drive.write_register("E1-04", 400)
    assert drive.highest_frequency == 50.0
    drive["C1-01"] = 3.0
    drive.run(percent=50)
    drive.wait_at_speed(20.0)
    assert drive.card.motor.frequency == 20.0 == drive.frequency == drive.status.output_frequency


def test_run_lifts_a_baseblock_and_nothing_else_does() -> None:
    for configuration in ("PPO Type 2", "Extended Data 1"):
        drive = bench(configuration)
        drive.baseblock()
        drive.frequency = 24.0
        drive.let_pass(0.1)
        assert drive.card.alarms == {"bb"} and not drive.card.running
        drive.run()
        drive.wait_at_speed(20.0)
        assert drive.card.motor.frequency == 24.0


@pytest.mark.parametrize("configuration", ["PPO Type 2", *MEMOBUS])
def test_a_program_may_bring_a_table_with_double_words(configuration: str) -> None:
    table = YASKAWA_1000.extended([Parameter("q1-01", 0x0580, 0, 0x7FFF_FFFF, 70000, "a counter", double=True)])
    drive = bench(configuration, card=SIP3(5, table=table), table=table)
    assert drive["q1-01"] == 70000
    drive["q1-01"] = 0x123456
    assert drive["q1-01"] == drive.card.registers["q1-01"] == 0x123456


def test_a_double_word_is_one_message_where_the_channel_has_room() -> None:
    """Table 13: "number of data items", 2 to 8 bytes. Word by word 65535 to 65537 would pass through 131071, beyond the limit,
    and a counter that moves on between its halves would be read wrong."""
    table = YASKAWA_1000.extended([Parameter("q1-01", 0x0580, 0, 70_000, 65_535, "a counter", double=True)])
    drive = bench("Extended Data 1", card=SIP3(5, table=table), table=table)
    drive.trace.clear()
    assert drive["q1-01"] == 65_535
    drive["q1-01"] = 65_537
    assert drive.card.registers["q1-01"] == 65_537
    words = [text for text in said(drive, 16, 24) if text[2:6] == "0580"]
    assert words == ["0305800400000000", "1005800400010001"]


def test_registers_several_at_a_time() -> None:
    for configuration in CHANNELS:
        drive = bench(configuration)
        drive.write_register(0x0280, [1, 2, 3, 4, 5])
        assert drive.read_registers("d1-01", 5) == (1, 2, 3, 4, 5)
        assert drive.read_register("0284h") == 5
    one = bench("Extended Data 1")
    one.trace.clear()
    one.read_registers(0x0280, 6)
    assert len({text for text in said(one, 16, 20) if text.startswith("03")}) == 2, "four words, then two"
    assert bench("Extended Data 1").loop_back([1, 2, 3, 4]) == (1, 2, 3, 4)  # MEMOBUS 08h
    with pytest.raises(ConfigurationError, match="MEMOBUS"):
        bench("PPO Type 1").loop_back([1])


def test_arrays_identification_and_refusals() -> None:
    drive = bench("PPO Type 5")
    assert drive.read_array(964) == (273, 1, 0, 2007, 220, 1)
    assert drive.elements(915) == 10 and drive.read_pnu(965) == 0x0302 and drive.read_pnu(918) == 5
    for call, code, text in [
            (lambda: drive.read_pnu(999), 0, "incorrect PNU"), (lambda: drive.write_pnu(918, 6), 1, "write mode"),
            (lambda: drive.write_pnu(31, 60001, 1), 2, "limit"), (lambda: drive.read_pnu(964, 7), 3, "IND")]:
        with pytest.raises(ParameterAccessError, match=text) as caught:
            call()
        assert caught.value.code == code
    drive.card.undervoltage = True
    with pytest.raises(ParameterAccessError, match="17, write mode error during undervoltage"):
        drive["C1-01"] = 1.0
    with pytest.raises(ConfigurationError, match=r"parameter numbers: Extended Data 1 has MEMOBUS registers"):
        bench("Extended Data 1").read_pnu(904)


@pytest.mark.parametrize("configuration", WITHOUT)
def test_configurations_without_a_channel_say_so(configuration: str) -> None:
    drive = bench(configuration)
    for call in (lambda: drive["C1-01"], lambda: drive.enter(), lambda: drive.read_register(1), lambda: drive.read_pnu(900, 1)):
        with pytest.raises(ConfigurationError, match=f"{configuration} has no parameter channel; Extended Data 1"):
            call()


def test_the_process_words_are_assigned() -> None:
    drive = bench("PPO Type 5")
    assert drive.highest_frequency == 60.0  # what units depend on is read
    drive.assign_inputs("U1-07", 36, 0)
    drive.assign_outputs(7, 8)
    drive.let_pass(0.02)
    assert drive.read_array(916)[2:5] == (0x46, 36, 0) and drive.read_array(915)[2:5] == (7, 8, 9)
    assert list(drive.status.monitors)[:2] == ["U1-07", "U1-02"] and drive.status.monitors["U1-07"] == 311
    with pytest.raises(ConfigurationError, match=r"register 32 cannot be assigned by PNU 915: 1, 2, .*or 0 for none"):
        drive.assign_outputs(32)
    with pytest.raises(ConfigurationError, match="9 process words: PPO Type 5 has 8"):
        drive.assign_inputs(*[36] * 9)
    other = bench("PPO Type 2", card=drive.card)  # another program finds them so
    assert other.status.monitors == {} and other.status.current is None, "what the words are for has yet to be read"
    other.run(percent=10)
    assert list(other.status.monitors)[:2] == ["U1-07", "U1-02"]
    other._before_operate()
    assert other.status.monitors == {}, "it may be another drive by now"


def test_faults_by_name_and_their_history() -> None:
    drive = bench("PPO Type 2")
    assert drive.faults() == () and drive.fault_history() == ()
    drive.lose(2.0)
    assert drive.faults() == ("bUS",)
    drive.fault_reset()
    assert [(each.name, each.number) for each in drive.fault_history()] == [("bUS", 0x22)] and drive.faults() == ()


@pytest.mark.parametrize("configuration", ["Basic data", *MEMOBUS])
def test_the_fault_history_is_reset_by_the_edge_of_bit_e(configuration: str) -> None:
    """Table 10, bit E: fault information is reset by the rising edge; the run command beside it stays."""
    drive = bench(configuration)
    for _ in range(2):
        drive.external_fault()
        drive.wait_until(lambda s: s.fault, 1.0)
        drive.external_fault(False)
        drive.fault_reset()
        drive.run(6.0)
        assert [name for name, _ in drive.card.history] == ["EF0"]
        drive.trace.clear()
        drive.clear_fault_history()
        assert said(drive, 0, 2) == ["4001", "0001"] and drive.card.history == [] and drive.card.running
        drive.stop()
    with pytest.raises(ConfigurationError, match="clear_fault_history: PPO Type 2 has no bit"):
        bench("PPO Type 2").clear_fault_history()


def test_the_extended_diagnosis_in_words() -> None:
    """Unit_Diag_Bit(0024) to (0027): `05 81 00 00 0x`."""
    texts = YaskawaSIP3.diagnosis_texts
    for bit, text in enumerate(("undervoltage", "inverter communication error", "illegal register assigned by PNU 915",
                                "illegal register assigned by PNU 916")):
        found = Diagnosis(bytes.fromhex("080c00010acf0581000000")[:-1] + bytes((1 << bit,))).explain(texts)
        assert found[-1].endswith(text)


@pytest.mark.parametrize(("settings", "text"), [({"F6-01": 3}, "F6-01 is 3, alarm only: it runs on when the bus is lost"),
                                                ({"F6-31": 1}, "F6-31 is 1, in Clear it holds its last command")])
def test_a_drive_that_would_not_stop_is_named_when_it_is_operated(settings: dict[str, int], text: str,
                                                                  caplog: pytest.LogCaptureFixture) -> None:
    for configuration in CHANNELS:
        caplog.clear()
        drive = bench(configuration, settings=settings)
        with caplog.at_level(logging.WARNING):
            drive._operating()
        assert text in caplog.text
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        bench("PPO Type 2")._operating()
        bench("PPO Type 3", settings=settings)._operating()  # nothing to ask it through
    assert caplog.text == ""


def test_rest_ramps_down_and_sees_it_answered() -> None:
    drive = bench("PPO Type 2")
    drive.run(24.0)
    drive.wait_at_speed(20.0)
    drive._stop_word()
    drive._rest()
    assert drive.trace[-1][0][8:10].hex() == "0408" and drive.card.running
    drive.answering = False
    start = drive.now
    drive._stop_word()
    with pytest.raises(DPTimeout):
        drive._rest()
    assert drive.now - start == pytest.approx(0.5, abs=0.01)


# -- The channels under faults ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("configuration", ["PPO Type 1", *MEMOBUS])
@pytest.mark.parametrize("lag", [0, 3])
@pytest.mark.parametrize("pause", [i * 0.0031 for i in range(8)])
def test_after_a_time_out_the_channel_works_again(configuration: str, pause: float, lag: int) -> None:
    """The late answer to the request that was given up is nobody's: also where the next one asks for the same."""
    drive = bench(configuration, cycle=0.001, lag=lag)
    drive.write_register("d1-01", 1111)
    drive.write_register("d1-02", 2222)
    for request in (lambda: drive.read_register("d1-01", timeout=0.010),
                    lambda: drive.write_register("d1-01", 3333, timeout=0.010)):
        with pytest.raises(DPTimeout, match=r"parameter channel: no answer to .*d1-01 within 0\.01 s; the channel can be used"):
            request()
        drive.let_pass(pause)
        assert drive.read_register("d1-02") == 2222
        drive.write_register("d1-01", 1111)
        assert drive.read_register("d1-01") == 1111


@pytest.mark.parametrize("configuration", ["PPO Type 1", *MEMOBUS])
@pytest.mark.parametrize("pause", [i * 0.0013 for i in range(20)])
def test_the_late_answer_to_a_write_is_not_the_value_of_a_read(configuration: str, pause: float) -> None:
    """Devices page: "A write and a read of one PNU answer alike", and the answer to a write carries 0."""
    drive = bench(configuration, cycle=0.001, lag=8)
    drive.write_register("d1-01", 1111)
    with pytest.raises(DPTimeout):
        drive.write_register("d1-01", 2222, timeout=0.012)
    drive.let_pass(pause)
    assert drive.read_register("d1-01") in (1111, 2222)
    with pytest.raises(DPTimeout):
        drive.read_register("d1-02", timeout=0.012)
    drive.let_pass(pause)
    drive.write_register("d1-02", 3333)
    assert drive.read_register("d1-02") == 3333 == drive.card.registers.word(0x0281)


@pytest.mark.parametrize(("scan", "settle"), [(0.0, 0.0), (0.010, 0.020)])
@pytest.mark.parametrize("configuration", MEMOBUS)
def test_init_ends_an_access_that_outlasts_the_settling_time(configuration: str, scan: float, settle: float,
                                                             monkeypatch: pytest.MonkeyPatch) -> None:
    """"INIT: clears the handshaking bit to 0". A drive that takes a tenth of a second shows the old HS so long; no settling
    time would tell its late answer from the next one's. INIT needs none, but where a card looks seldom it has to stand."""
    monkeypatch.setattr(channel, "SETTLE", settle)
    drive = bench(configuration, cycle=0.001)
    job = drive.card._job
    plain, looked = job.see, [0.0]

    def see(octets: bytes, where: Any, now: float) -> None:
        if now >= looked[0] + scan:
            looked[0] = now
            plain(octets, where, now)

    job.see = see
    drive.card._random.uniform = lambda low, high: 0.1
    for value in (1111, 2222, 3333):
        with pytest.raises(DPTimeout):
            drive.write_register("d1-01", value, timeout=0.050)
        drive.write_register("d1-01", value + 1)
        assert drive.read_register("d1-01") == value + 1 == drive.card.registers.word(0x0280)


def test_a_card_with_the_other_size_of_ind_is_named() -> None:
    """F6-33: IND of a card set to bytes lies elsewhere, and it sees no request that it knows."""
    drive = bench("PPO Type 1", settings={"F6-33": 1})
    with pytest.raises(DPTimeout, match=r"no answer to .* if it never answers, its IND may be of the other size: give index="):
        _ = drive.read("C1-01", timeout=0.3)


@pytest.mark.parametrize("configuration", ["PPO Type 1", *MEMOBUS])
def test_a_card_that_never_answers_is_a_time_out_and_no_hang(configuration: str) -> None:
    drive = bench(configuration)
    job = drive.card._job
    job.see, see = (lambda *_: None), job.see
    begin = drive.now
    with pytest.raises(DPTimeout, match=r"no answer to .* on d1-01 within 0\.3 s; the channel can be used again"):
        _ = drive.read("d1-01", timeout=0.3)
    assert drive.now - begin <= 0.35
    job.see = see
    assert drive["d1-01"] == 0.0


@pytest.mark.parametrize("configuration", ["PPO Type 1", *MEMOBUS])
def test_a_read_survives_the_loss_of_the_station_and_a_write_says_that_it_is_not_known(configuration: str) -> None:
    for moment in range(1, 14):
        drive = bench(configuration)
        drive.write_register("d1-01", 1111)
        after(drive, moment, lambda drive=drive: drive.lose(0.1))
        assert drive.read_register("d1-01") == 1111
        after(drive, moment, lambda drive=drive: drive.lose(0.1))
        try:
            drive.write_register("d1-01", 2222)
        except StationError as error:
            assert "whether it was done is not known" in str(error) and moment > 2, "before that the drive had seen nothing"
        else:
            assert drive.card.registers.word(0x0280) == 2222
        drive.exchange = type(drive).exchange.__get__(drive)  # type: ignore[method-assign]
        assert drive.read_register("d1-01") in (1111, 2222)


def after(drive: Virtual, cycles: int, call: Callable[[], None]) -> None:
    """Make the call once, so many cycles from now."""
    plain, left = type(drive).exchange.__get__(drive), [cycles]

    def exchange() -> None:
        plain()
        left[0] -= 1
        if left[0] == 0:
            call()

    drive.exchange = exchange  # type: ignore[method-assign]


class Rough:
    """A bus on which telegrams are lost (a cycle without the drive), and now and then the station, for a while."""

    def __init__(self, drive: Virtual, seed: int, lost: float, losses: float) -> None:
        self.plain, self.drive = type(drive).exchange.__get__(drive), drive
        self.chance, self.lost, self.losses = random.Random(seed), lost, losses
        self.lock = threading.RLock()
        self.inside = False
        self.counts = [0, 0]
        drive.exchange = self  # type: ignore[method-assign]

    def __call__(self) -> None:
        with self.lock:
            if not self.inside and self.chance.random() < self.losses:
                self.inside = True
                self.drive.lose(self.chance.uniform(0.0, 0.1))
                self.inside = False
                self.counts[1] += 1
            elif self.chance.random() < self.lost:
                self.drive.now += self.drive.cycle
                self.counts[0] += 1
            else:
                self.plain()


@pytest.mark.parametrize("configuration", ["PPO Type 1", "Extended Data 1", "Extended Data 2"])
def test_ten_parameters_at_once_each_get_their_own_answer(configuration: str) -> None:
    """Ten threads over one channel; telegrams and the station itself are lost in between. No request is lost or answered
    with another's value: a read gets its own, a write is done or says that this is not known."""
    seed = random.randrange(1 << 32)
    print("seed", seed)
    drive = bench(configuration)
    rough = Rough(drive, seed, lost=0.05, losses=0.006)
    wrong: list[str] = []
    unknown: list[str] = []

    def ask(number: int) -> None:
        name, chance = f"d1-{number:02d}", random.Random(seed + number)
        written = {0}
        for turn in range(12):
            value = 1000 * number + turn
            if chance.random() < 0.5:
                try:
                    drive.write_register(name, value, timeout=60.0)
                    written = {value}
                except StationError as error:
                    assert "not known" in str(error)
                    unknown.append(name)
                    written |= {value}
            if (got := drive.read_register(name, timeout=60.0)) not in written:
                wrong.append(f"{name}: {got}, not {written}")
            written = {got}

    run_threads([threading.Thread(target=guarded, args=(wrong, ask, number)) for number in range(1, 11)])
    assert wrong == []
    print(f"{rough.counts[0]} telegrams lost, {rough.counts[1]} times the station, {len(unknown)} writes not known")
    assert rough.counts[0] > 20 and rough.counts[1] > 0


def guarded(wrong: list[str], call: Callable[[int], None], number: int) -> None:
    try:
        call(number)
    except Exception as error:
        wrong.append(repr(error))


def run_threads(threads: list[threading.Thread]) -> None:
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + 100
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
        assert not thread.is_alive()


# -- What the channels carry ------------------------------------------------------------------------------------------------

# Cycles that one request takes at most, and the card's own time for it: 2 ms and 10 to 15 ms ("2 ms" of high-speed data;
# devices page: processing takes 10 to 15 ms). PKW: task 0, its response, the task, its response. MEMOBUS: HS made equal and
# confirmed, data, HS, answer.
CYCLES = {"PPO Type 1": 4, "Extended Data 1": 5, "Extended Data 2": 5, "V7, Extended Data 1": 5}
CARD = 0.0171


@pytest.mark.parametrize("cycle", [0.001, 0.005, 0.020, 0.100])
@pytest.mark.parametrize("configuration", CYCLES)
def test_how_many_requests_a_second(configuration: str, cycle: float) -> None:
    """Ten parameters, over and over, one after the other as ten threads are served too: requests a second against the cycle."""
    if configuration.startswith("V7"):
        drive: Any = VirtualV7(SIP1(5), "Extended Data 1", cycle=cycle)
        names = ["n003", "n004", "n011", "n018", "n019", "n020", "n024", "n035", "n052", "n152"]
        read = drive.read_parameter
    else:
        drive = bench(configuration, cycle=cycle)
        names, read = [f"d1-{n:02d}" for n in range(1, 11)], drive.read_register
    requests, begin = 40, drive.now
    for turn in range(requests):
        read(names[turn % 10], timeout=5.0)
    took = (drive.now - begin) / requests
    print(f"{configuration}: cycle {cycle * 1000:g} ms, {1 / took:.1f} requests/s, {took / cycle:.1f} cycles each")
    assert took <= (CYCLES[configuration] + 1) * cycle + CARD
    assert took >= 3 * cycle, "no answer can be quicker than its handshake"


@pytest.mark.parametrize(("call", "text"), [
    (lambda drive: drive.read_pnu("P904"), "PKW pnu 'P904': 0 to 2047"),
    (lambda drive: drive.read_pnu(915, 1.0), "PKW index 1.0: 0"),
    (lambda drive: drive.write_pnu(915, "5", 3), "PKW value '5': 0 to"),
    (lambda drive: drive.read_registers(1, "2"), "count '2': 1 to 65535 registers"),
    (lambda drive: drive.write_register("C1-01", 2.5), "register 'C1-01' 2.5: 0 to 65535")])
def test_what_is_no_number_is_refused_in_words(call: Callable[[Any], Any], text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        call(bench("PPO Type 2"))
    assert str(caught.value).startswith(text)
