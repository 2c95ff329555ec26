# SPDX-License-Identifier: MIT
"""The emulated SI-P3 on virtual time, octets in and octets out, against the numbers of its manual (SIEP C730600 42)."""

from __future__ import annotations

import logging

import pytest
from sip3_host import HALT, JOG, RESET, REVERSE_JOG, RUN, Host

from dpmaster.emulator.card import Exchange, SlaveState
from dpmaster.emulator.cards import SIP3, _yaskawa
from dpmaster.errors import ConfigurationError
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.yaskawa_1000 import YASKAWA_1000, Parameter

BASIC, EXTENDED_1, EXTENDED_2 = "Basic data", "Extended Data 1", "Extended Data 2"
WITH_PKW = ["PPO Type 1", "PPO Type 2", "PPO Type 5"]
WITH_PKW += [f"{name} (No Cons.)" for name in WITH_PKW]
RUNNING, ZERO, REVERSE, AGREE, READY, ALARM, FAULT, NET = 0x01, 0x02, 0x04, 0x10, 0x20, 0x40, 0x80, 0x0400


@pytest.fixture(autouse=True)
def _seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at a ramp under way twice a second: it is computed, so how often it is looked at shows nowhere."""
    monkeypatch.setattr(_yaskawa, "SCAN", 0.5)


# -- The seven PKW examples of chapter 8 ---------------------------------------------------------------------------------


@pytest.mark.parametrize("configuration", WITH_PKW)
def test_the_printed_pkw_examples(configuration: str) -> None:
    """Chapter 8: two reads of PNU 900, one of 907, 904, writing C1-01, reading d1-17, RAM Enter."""
    host = Host(configuration)
    host.command(HALT)
    pzd, kind = host.pzd, int(configuration[9])
    assert kind in (1, 2, 5)
    if kind == 1:  # the examples' addresses are those of type 1
        assert host.task("6384 0005 00000000") == f"4384 0005 0000{HALT:04x}"  # 5th word: STW
        zsw = host.word(pzd)
        assert host.task("638b 0005 00000000") == f"438b 0005 0000{zsw:04x}" and zsw == 0x0237
        assert host.task("6384 0001 00000000") == "4384 0001 00006384"  # 1st word: PKE itself
    assert host.task("1388 0000 00000000") == f"1388 0000 {kind:08x}"  # current PPO-Write: its type
    assert host.task("701f 0001 0000000a") == "401f 0001 00000000"  # C1-01 = 10
    assert host.card.registers["C1-01"] == 10
    assert host.task("6029 0011 00000000") == "4029 0011 00000258"  # d1-17
    assert host.task("212c 0000 00000000") == "112c 0000 00000000"  # RAM Enter
    assert host.card.registers.setting("C1-01") == 10


def test_ind_as_a_byte() -> None:
    """F6-33 = 1: the sub-index is the high byte of IND; it is read at power-up."""
    host = Host(settings={"F6-33": 1})
    assert host.task("6029 1100 00000000") == "4029 1100 00000258"
    assert host.task("6000 2400 00000000") == "4000 2400 00000000"  # PNU 0 reaches registers 0 to 255
    assert host.task("6000 ff00 00000000")[:4] == "4000"
    host.card.registers["F6-33"] = 0
    assert host.task("6029 1100 00000000") == "4029 1100 00000258"
    host.card.reset(host.now)
    host.after(0.2)
    assert host.task("6029 0011 00000000") == "4029 0011 00000258"


# -- PNU -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [1, 2, 5])
def test_pnu_900_to_912_ppo_data_of_every_type(kind: int) -> None:
    """A type that is not the current one shows what both have in common: channel, and as many process words."""
    host = Host(f"PPO Type {kind}")
    host.command(HALT, 0.25)
    host.after(0.1)
    types = ((900, 907, 6, 5), (901, 908, 10, 5), (902, 909, 2, 1), (903, 910, 6, 1), (905, 912, 14, 5))
    for write, read, words, first in types:
        assert host.task(f"9{write:03x} 0000 00000000")[10:] == host.task(f"9{read:03x} 0000 00000000")[10:] == f"{words:08x}"
        assert host.task(f"6{write:03x} {first:04x} 00000000")[10:] == f"0000{HALT:04x}"
        assert host.task(f"6{write:03x} {first + 1:04x} 00000000")[10:] == f"{2500:08x}"
        assert host.task(f"6{read:03x} {first:04x} 00000000")[10:] == "00000237"
        assert host.task(f"6{write:03x} {words:04x} 00000000")[:4] == f"4{write:03x}"
        for index in (0, words + 1):
            assert host.task(f"6{read:03x} {index:04x} 00000000") == f"7{read:03x} {index:04x} 00000003"
        assert host.task(f"7{write:03x} 0001 00000000")[10:] == "00000001"  # cannot be written
    assert host.task("138f 0000 00000000") == f"138f 0000 {kind:08x}"  # 911 current PPO-Read


@pytest.mark.parametrize(("baudrate", "code"), [
    (9_600, 0), (19_200, 1), (93_750, 2), (187_500, 3), (500_000, 4), (1_500_000, 6), (3_000_000, 7), (6_000_000, 8),
    (12_000_000, 9), (45_450, 11)])
def test_pnu_963_baud_rate(baudrate: int, code: int) -> None:
    host = Host()
    host.baudrate = baudrate
    assert host.task("13c3 0000 00000000") == f"13c3 0000 {code:08x}"


def test_pnu_918_964_965_and_971() -> None:
    host = Host()
    assert host.task("1396 0000 00000000") == "1396 0000 00000005"  # node address
    found = [host.task(f"63c4 {n:04x} 00000000") for n in range(1, 8)]
    assert found[6] == "73c4 0007 00000003"
    assert [int(answer[10:], 16) for answer in found[:6]] == [273, 1, 0, 2007, 220, 1]
    assert host.task("13c5 0000 00000000") == "13c5 0000 00000302"  # profile
    assert host.task("23cb 0000 00000001") == "13cb 0000 00000000"
    assert host.task("13cb 0000 00000000") == "73cb 0000 00000000"  # write only
    for pnu in (904, 911, 918, 963, 965, 968):
        assert host.task(f"2{pnu:03x} 0000 00000001") == f"7{pnu:03x} 0000 00000001"  # read only


def test_pnu_967_and_968_control_and_status_word() -> None:
    host = Host()
    host.command(RUN, 0.5)
    host.after(6.0)
    assert host.task("13c7 0000 00000000") == f"13c7 0000 0000{RUN:04x}"
    assert host.task("13c8 0000 00000000") == "13c8 0000 00000337"
    assert host.task("23c7 0000 00000000") == "13c7 0000 00000000"  # the next telegram's STW overtakes it
    assert host.card.motor.frequency == 30.0


@pytest.mark.parametrize("pnu", [*profile.GROUPS])
def test_every_function_group_is_an_array_of_00_to_99(pnu: int) -> None:
    host = Host()
    assert host.task(f"9{pnu:03x} 0000 00000000") == f"6{pnu:03x} 0000 00000064"
    for index in range(1, 35):
        answer = host.task(f"6{pnu:03x} {index:04x} 00000000")
        name = profile.parameter_name(pnu, index)
        if name not in YASKAWA_1000:
            assert answer == f"7{pnu:03x} {index:04x} 00000003"
        elif YASKAWA_1000[name].access == "rw":
            assert answer == f"4{pnu:03x} {index:04x} {host.card.registers.word(YASKAWA_1000[name].register):08x}"
        else:
            assert answer[:9] == f"4{pnu:03x} {index:04x}"


@pytest.mark.parametrize("pnu", [1, 10, 13, 30, 37, 120, 129, 144, 299, 302, 899, 906, 913, 917, 970, 972, 2047])
def test_numbers_that_no_table_has(pnu: int) -> None:
    host = Host()
    for task in (1, 2, 3, 6, 7, 8, 9):
        assert host.task(f"{task}{pnu:03x} 0000 00000000") == f"7{pnu:03x} 0000 00000000"


def test_pnu_0_by_memobus_register() -> None:
    host = Host()
    assert host.task("6000 0200 00000000") == "4000 0200 00000064"  # C1-01 is 200h
    assert host.task("7000 0200 0000000a") == "4000 0200 00000000"
    assert host.task("601f 0001 00000000") == "401f 0001 0000000a"
    assert host.task("7000 000a 0000ffce") == "4000 000a 00000000"  # a command register
    assert host.task("6000 000a 00000000") == "4000 000a 0000ffce"
    assert host.task("7000 0024 00000001") == "7000 0024 00000001"  # a monitor
    for index in (0x0000, 0x0601):
        assert host.task(f"6000 {index:04x} 00000000") == f"7000 {index:04x} 00000003"


@pytest.mark.parametrize(("task", "error"), [
    ("2384 0000 00000001", 3), ("1384 0001 00000000", 3),  # an array asked for as one value
    ("6388 0000 00000000", 3), ("9388 0000 00000000", 3), ("1388 0001 00000000", 3),  # and the other way round
    ("7042 001f 00000002", 2), ("7042 001f 0000ffff", 2), ("701f 0001 00010000", 2),  # F6-31 is 0 or 1; no word
    ("7051 0063 00000000", 3), ("60d3 0000 00000000", 3),
    ("70d3 0001 00000001", 1),  # U1-01 can only be read
    ("801f 0001 0000000a", 1), ("33cb 0000 00000001", 1),  # a word written as a double word
    ("412c 0000 00000000", 106), ("a01f 0001 00000000", 106), ("f01f 0001 00000000", 106)])
def test_error_numbers(task: str, error: int) -> None:
    """PWE of response 7: 0 incorrect PNU, 1 write mode error, 2 limit, 3 disabled IND; the profile's 106 for tasks that the
    table of task identifiers does not have."""
    host = Host()
    before = dict(host.card.registers)
    assert host.task(task) == f"7{task[1:9]} {error:08x}"
    assert {n: word for n, word in host.card.registers.items() if n not in profile.MONITORS} == {
        n: word for n, word in before.items() if n not in profile.MONITORS}


def test_writing_while_running_undervoltage_and_storing() -> None:
    """Error 1 while the drive runs, for what cannot be changed then; 17 during undervoltage or parameter processing."""
    host = Host()
    host.command(RUN, 0.1)
    host.after(1.0)
    assert host.task("7033 0004 00000258") == "7033 0004 00000001"  # E1-04
    assert host.task("712d 0000 00000000")[0] == "7"
    assert host.task("212d 0000 00000000") == "712d 0000 00000001"  # ROM Enter
    assert host.task("701f 0001 0000000a") == "401f 0001 00000000"  # C1-01 can
    assert host.task("212c 0000 00000000") == "112c 0000 00000000"
    for condition in ("undervoltage", "storing"):
        host = Host()
        setattr(host.card, condition, True)
        assert host.task("701f 0001 0000000a") == "701f 0001 00000011"
        assert host.task("212c 0000 00000000") == "712c 0000 00000011"
        assert host.task("601f 0001 00000000") == "401f 0001 00000064"


@pytest.mark.parametrize(("enter", "kept"), [(None, False), ("212c", False), ("212d", True), ("23cb", True)])
def test_enter_puts_into_force_and_stores(enter: str | None, kept: bool) -> None:
    """300 RAM, 301 ROM, 971 "Start Store in non-volatile memory (Enter code with EEPROM)"."""
    host = Host()
    host.task("7029 0001 00000bb8")
    host.task("701f 0001 0000000a")
    assert host.card.registers["C1-01"] == 10 and host.card.registers.setting("C1-01") == 100
    if enter:
        assert host.task(f"{enter} 0000 00000000")[0] == "1"
        assert host.card.registers.setting("C1-01") == 10
    host.card.reset(host.now)
    assert host.card.registers["C1-01"] == host.card.registers.setting("C1-01") == (10 if kept else 100)
    assert host.card.registers["d1-01"] == (3000 if kept else 0)


def test_double_words_of_a_users_own_table() -> None:
    table = YASKAWA_1000.extended([Parameter("b3-01", 0x0191, -70_000, 70_000, -1, "a double word", double=True)])
    host = Host(table=table)
    assert host.task("6017 0001 00000000") == "5017 0001 ffffffff"
    assert host.task("8017 0001 00011170") == "5017 0001 00000000"
    assert host.task("6017 0001 00000000") == "5017 0001 00011170" and host.card.registers["b3-01"] == 70_000
    assert (host.card.registers[0x191], host.card.registers[0x192]) == (1, 0x1170)
    assert host.task("8017 0001 00011171") == "7017 0001 00000002"
    assert host.task("7017 0001 00000001") == "7017 0001 00000001"  # another width
    host.card.registers["B3-01"] = -5
    assert host.task("6017 0001 00000000") == "5017 0001 fffffffb"


# -- PNU 915 and 916 -----------------------------------------------------------------------------------------------------


def test_pnu_915_and_916_as_printed() -> None:
    host = Host("PPO Type 5")
    assert [int(host.task(f"6393 {n:04x} 00000000")[10:], 16) for n in range(1, 11)] == [1, 2, 6, 7, 9, 15, 0, 0, 0, 0]
    assert [int(host.task(f"6394 {n:04x} 00000000")[10:], 16) for n in range(1, 11)] == [
        32, 2, 36, 38, 68, 69, 70, 72, 71, 73]
    for pnu in ("393", "394"):
        for index in (1, 2):  # PZD1 and PZD2 are always STW and HSW, ZSW and HIW
            assert host.task(f"7{pnu} {index:04x} 00000003") == f"7{pnu} {index:04x} 00000001"
        for index in (0, 11):
            assert host.task(f"7{pnu} {index:04x} 00000003") == f"7{pnu} {index:04x} 00000003"


def test_process_words_go_where_915_and_916_say() -> None:
    host = Host("PPO Type 5")
    registers = host.card.registers
    host.command(RUN, 0.5)
    host.put(12, 1111, 2222, 3333, 4444, 5555)  # PZD3 to PZD7
    inputs = host.after(8.0)
    assert [registers[n] for n in (6, 7, 9, 15)] == [1111, 2222, 3333, 4444]
    # 36 output frequency, 38 current, 68 motor speed, 69 output voltage, 70 bus voltage, 72 torque, 71 power, 73 terminals
    current, torque, power = host.card.motor.current, host.card.motor.torque, host.card.motor.power
    assert [int.from_bytes(inputs[n:n + 2], "big") for n in range(12, 28, 2)] == [
        3000, round(current * 100), 3000, 1000, 311, round(torque * 1000), round(power / 100), 0]
    assert current > 1 and torque == 0.5 and round(power / 100) == 2
    assert host.task("7393 0007 00000008") == "4393 0007 00000000"  # PZD7 -> register 8
    assert host.task("7394 0003 00000043") == "4394 0003 00000000"  # U1-04 -> PZD3
    host.after(0.01)
    assert registers[8] == 5555 and host.word(12) == registers["A1-02"] == 2
    assert host.card.diagnosis == b""


@pytest.mark.parametrize(("pnu", "register", "octet"), [
    (915, 11, 4), (915, 32, 4), (915, 0x200, 4), (915, 0xFFFF, 4), (916, 11, 8), (916, 0x100, 8)])
def test_an_illegal_pnu_is_taken_and_told(pnu: int, register: int, octet: int) -> None:
    """Unit_Diag_Bit 26 and 27: "PNU915: Illegal PNU configured". The word stays 0 and changes nothing."""
    host = Host()
    assert host.task(f"7{pnu:03x} 0003 {register:08x}") == f"4{pnu:03x} 0003 00000000"
    assert host.card.diagnosis == bytes.fromhex(f"05 81 00 00 {octet:02x}")
    before = host.card.registers.word(register) if register <= 0x600 else 0
    host.put(12, 0x1234)
    host.after(0.01)
    if pnu == 915:
        assert register > 0x600 or host.card.registers.word(register) == before
    else:
        assert host.word(12) == 0
    assert host.task(f"7{pnu:03x} 0003 00000000") == f"4{pnu:03x} 0003 00000000"
    assert host.card.diagnosis == b""


def test_the_assignment_outlives_the_power_after_a_store() -> None:
    host = Host()
    host.task("7393 0003 00000008")
    host.outputs[0:8] = bytes(8)
    host.card.reset(host.now)
    host.after(0.2)
    assert host.task("6393 0003 00000000")[10:] == "00000006"
    host.task("7393 0003 00000008")
    host.task("23cb 0000 00000001")
    host.card.reset(host.now)
    host.after(0.2)
    assert host.task("6393 0003 00000000")[10:] == "00000008"


# -- STW, ZSW, HSW, HIW --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("configuration", [c.name for c in profile.PPO_MODULES])
def test_run_and_stop_in_every_type(configuration: str) -> None:
    host = Host(configuration)
    host.command(HALT)
    assert host.word(host.pzd) == 0x0237  # always 1: 0, 1, 4, 5; ready; control from PROFIBUS
    host.command(RUN, 0.5)
    assert host.word(host.pzd) == 0x0237
    host.after(6.0)
    assert (host.word(host.pzd), host.word(host.pzd + 2)) == (0x0337, 5000)  # speed agree; 50 %
    host.command(RUN, -0.25)
    host.after(10.0)
    assert host.card.motor.frequency == -15.0 and host.word(host.pzd + 2) == 0xF63C  # -2500
    host.command(HALT)
    host.after(3.0)
    assert not host.card.running and host.word(host.pzd) == 0x0237


def test_full_scale_and_beyond() -> None:
    host = Host()
    host.command(RUN, 1.0)
    host.after(11.0)
    assert host.word(10) == 10_000 and host.card.motor.frequency == 60.0
    host.command(RUN, 3.0)
    host.after(1.0)
    assert host.word(10) == 10_000  # E1-04 is the limit


@pytest.mark.parametrize(("stw", "hz"), [(JOG, 6.0), (REVERSE_JOG, -6.0), (0x0708, 0.0), (0x0500, 0.0), (0x0108, 0.0),
                                         (0x0518, 30.0)])
def test_jog(stw: int, hz: float) -> None:
    """Bits 8 and 9: Fmax/10. Both stop; without bit 3 or bit 10 nothing jogs; RUN goes before it."""
    host = Host()
    host.command(stw, 0.5)
    host.after(6.0)
    assert host.card.motor.frequency == hz


def test_bit_3_is_baseblock_and_stop() -> None:
    host = Host()
    host.command(0x0400)
    assert host.card.alarms == {"bb"} and host.word(8) & ALARM << 1 == 0
    host.command(RUN, 0.5)
    host.after(6.0)
    assert host.card.alarms == frozenset()
    host.command(0x0410)
    assert not host.card.running and host.card.motor.frequency == 0 and host.card.alarms == {"bb"}
    host.command(RUN)
    host.after(1.0)
    assert host.card.running


def test_bit_10_is_local_control() -> None:
    host = Host()
    host.command(RUN, 0.5)
    host.after(6.0)
    host.command(RUN & ~0x0400)
    host.after(1.0)
    assert 0 < host.card.motor.frequency < 30 and host.word(8) & 0x0200 == 0  # a ramp to stop
    host.after(6.0)
    assert not host.card.running


@pytest.mark.parametrize("bit", [0, 1, 2, 5, 6, 11, 12, 13, 14, 15])
def test_reserved_bits_do_nothing(bit: int) -> None:
    host = Host()
    host.command(RUN | 1 << bit, 0.5)
    host.after(6.0)
    assert host.card.motor.frequency == 30.0 and host.word(8) == 0x0337


@pytest.mark.parametrize(("b1_01", "b1_02", "running", "hz"), [(3, 3, True, 30.0), (1, 3, True, 0.0), (3, 1, False, 0.0),
                                                               (0, 3, True, 12.0)])
def test_who_controls(b1_01: int, b1_02: int, running: bool, hz: float) -> None:
    host = Host(settings={"b1-01": b1_01, "b1-02": b1_02, "d1-01": 1200})
    host.command(RUN, 0.5)
    host.after(6.0)
    assert (host.card.running, host.card.motor.frequency) == (running, hz)
    assert bool(host.word(8) & 0x0200) is (b1_01 == b1_02 == 3)


def test_factory_parameters_ignore_the_bus() -> None:
    host = Host(parameters="factory")
    assert [host.card.registers[name] for name in ("b1-01", "b1-02", "F6-01", "F6-32", "F6-33")] == [1, 1, 1, 0, 0]
    assert len(host.card.configurations) == 10
    host.command(RUN, 0.5)
    host.after(1.0)
    assert not host.card.running and host.card.alarms == frozenset()


# -- The conventional maps -----------------------------------------------------------------------------------------------


def test_table_8_basic_data() -> None:
    host = Host(BASIC)
    host.drive(0x0001, 30.00)
    assert host.word(0) == READY | NET | RUNNING | ZERO | 0x1000  # P1: H2-02 = 0, running
    inputs = host.after(6.0)
    assert host.word(0) == RUNNING | AGREE | READY | NET | 0x1000 | 0x2000
    assert [host.word(2), host.word(4)] == [3000, round(host.card.motor.current * 100)] and len(inputs) == 6
    host.card.registers["A1-02"] = 0  # V/f: the output frequency is shown
    assert host.word(2) == 3000


def test_table_9_extended_data_1() -> None:
    host = Host(EXTENDED_1)
    card = host.card
    card.pulse_count, card.analog_input = 0x1234, 0x5678
    host.put(4, 500, 0xFFCE, 0, 0x1000, 0x2000, 0x0005)
    host.drive(0x0001, 30.00)
    host.after(6.0)
    assert [host.word(n) for n in range(2, 16, 2)] == [
        3000, round(card.motor.torque * 1000), 0x1234, 3000, 3000, round(card.motor.current * 100), 0x5678]
    assert card.motor.torque == 0.5
    assert [card.registers[n] for n in (4, 5, 7, 8, 9)] == [500, 0xFFCE, 0x1000, 0x2000, 5]
    card.registers["A1-02"] = 0  # notes 5 and 6: motor speed and torque are 0 with V/f
    assert [host.word(2), host.word(4), host.word(10)] == [0, 0, 3000]


def test_table_12_extended_data_2() -> None:
    host = Host(EXTENDED_2)
    host.drive(0x0002, 12.00)
    host.after(6.0)
    assert host.word(2) == 1200 and host.word(0) & 0xFF == RUNNING | REVERSE | AGREE | READY
    host.drive(0x0002, 0.0)  # table 11, bit 2: "during reverse run", at a standstill too
    host.after(6.0)
    assert host.word(0) & 0xFF == RUNNING | ZERO | REVERSE | AGREE | READY
    host.drive(0x0000)
    assert host.word(0) & 0xFF == ZERO | READY
    assert host.access("030200020000") == "030200020064"


def test_the_unit_of_the_current_is_the_drives_size() -> None:
    for size, unit in ((7.5, 0.01), (11.0, 0.1)):
        host = Host(BASIC, size=size)
        host.drive(0x0001, 30.00)
        host.after(6.0)
        assert host.word(4) == round(host.card.motor.current / unit) > 0


@pytest.mark.parametrize(("o1_03", "word"), [(0, 3000), (1, 5000), (2, 900)])
def test_o1_03_is_the_unit_of_references(o1_03: int, word: int) -> None:
    host = Host(EXTENDED_1, settings={"o1-03": o1_03})
    host.put(2, word)
    host.drive(0x0001)
    host.after(6.0)
    assert host.card.motor.frequency == pytest.approx(30.0)
    assert host.word(8) == host.word(10) == word


def test_a_user_unit_is_an_operator_error() -> None:
    host = Host(BASIC, settings={"o1-03": 3})
    host.drive(0x0001, 30.0)
    assert host.word(0) & 0x0100 and host.card.frequency_reference == 0.0


@pytest.mark.parametrize(("h5_12", "command", "hz"), [
    (0, 0x01, 6.0), (0, 0x02, -6.0), (0, 0x03, 0.0), (1, 0x01, 6.0), (1, 0x03, -6.0), (1, 0x02, 0.0)])
def test_h5_12_run_and_direction(h5_12: int, command: int, hz: float) -> None:
    """Table 10: forward/stop and reverse/stop, or run/stop and direction."""
    host = Host(BASIC, settings={"H5-12": h5_12})
    host.drive(command, 6.0)
    host.after(2.0)
    assert host.card.motor.frequency == hz


def test_baseblock_command() -> None:
    """Table 10, bit F; table 17: "the operation command bit F is set to 1"."""
    host = Host(BASIC)
    host.drive(0x0001, 30.0)
    host.after(6.0)
    host.drive(0x8001)
    assert host.card.alarms == {"bb"} and not host.card.running and not host.word(0) & ALARM
    host.drive(0x0001)
    host.after(6.0)
    assert host.card.motor.frequency == 30.0


def test_terminals_follow_the_bus_and_their_functions() -> None:
    host = Host(EXTENDED_1, settings={"H2-01": 0xF, "H2-02": 0xF, "H2-03": 0xF, "H4-01": 0})
    host.put(10, 0x1111, 0x2222, 0x0005)
    assert host.card.outputs == {"M1-M2": True, "P1": False, "P2": True} and host.word(0) & 0x3800 == 0x2800
    assert host.card.analog_outputs == {"FM": 0x1111, "AM": None}
    host.card.registers["H4-04"] = 0  # table 9, note 3: through mode
    assert host.card.analog_outputs == {"FM": 0x1111, "AM": 0x2222}
    host.drive(0x0054)
    assert host.card.inputs == {"S3": True, "S4": False, "S5": True, "S6": False, "S7": True, "S8": False}
    assert host.card.fault == "EF3"  # H1-03 = 24: external fault
    host.drive(0x0008)
    assert host.card.fault is None  # H1-04 = 14: fault reset
    host.drive(0x0080)
    assert host.card.alarms == {"bb"}  # H1-08 = 8: baseblock


def test_f6_07_multi_step_speeds() -> None:
    """"0: Multi-step speed reference disabled (F7 mode), 1: allowed (V7 mode)"; H1-05 = 3, H1-06 = 4, H1-07 = 6 jog."""
    for f6_07, expected in ((0, [30.0] * 4), (1, [11.0, 12.0, 13.0, 6.0])):
        host = Host(BASIC, settings={"F6-07": f6_07, "d1-02": 1100, "d1-03": 1200, "d1-04": 1300})
        found = []
        for command in (0x0011, 0x0021, 0x0031, 0x0041):
            host.drive(command, 30.0)
            host.after(6.0)
            found.append(host.card.motor.frequency)
        assert found == expected


def test_f6_06_torque_reference() -> None:
    for f6_06, a1_02, percent in ((0, 3, 0.0), (1, 3, -5.0), (1, 2, 0.0), (1, 6, -5.0), (1, 7, -5.0)):
        host = Host(BASIC, settings={"F6-06": f6_06, "A1-02": a1_02})
        host.put(4, 0xFFCE)
        assert host.card.torque_reference == percent


@pytest.mark.parametrize(("f6_08", "f6_01"), [(0, 2), (1, 1)])
def test_f6_08_a1_03_initialises(f6_08: int, f6_01: int) -> None:
    host = Host(EXTENDED_1, settings={"F6-08": f6_08, "F6-01": 2, "C1-01": 50, "A1-02": 3})
    assert host.access("10010302 08ac") == "100103020000" + "0000" * 3  # 2220
    assert host.access("10090002 0000") == "100900020000" + "0000" * 3  # ROM Enter
    registers = host.card.registers
    assert [registers[name] for name in ("F6-01", "C1-01", "A1-02", "A1-03", "b1-01")] == [f6_01, 100, 3, 0, 1]


# -- MEMOBUS -------------------------------------------------------------------------------------------------------------


def test_table_15_parameter_setting_by_memobus() -> None:
    """Command, response, response at fault: bytes 16 to 31, the handshaking register masked with 80h."""
    host = Host(EXTENDED_1)
    command = bytes.fromhex("10 0280 02 1770 0000 0000 0000 000000 80")
    assert len(command) == 16
    host.outputs[16:32] = command[:15] + b"\0"
    host.step()
    host.outputs[16:32] = command
    area = host.after(0.020)[16:32]
    assert area[:15] == bytes.fromhex("10 0280 02 0000 0000 0000 0000 000000") and area[15] & 0x80 == 0x80
    assert host.card.registers["d1-01"] == 6000
    host = Host(EXTENDED_1)
    fault = command[:1] + bytes.fromhex("0601") + command[3:]  # no such register
    host.outputs[16:32] = fault[:15] + b"\0"
    host.step()
    host.outputs[16:32] = fault
    area = host.after(0.020)[16:32]
    assert area[:15] == bytes.fromhex("90 0000 02 0002 0000 0000 0000 000000") and area[15] & 0x80 == 0x80


def test_read_write_and_loop_back_of_1_to_4_words() -> None:
    host = Host(EXTENDED_1)
    assert host.access("10 0200 08 000a 000b 1111 2222") == "10020008" + "0000" * 4
    assert host.access("03 0200 08") == "03020008" + "000a000b11112222"
    for n in (1, 2, 3, 4):
        assert host.access(f"03 0200 {2 * n:02x}")[:8] == f"030200{2 * n:02x}"
    assert host.access("08 1234 06 a55a 5aa5 0ff0 0001") == "08123406" + "a55a5aa50ff00001"
    host = Host(EXTENDED_2)
    assert host.access("10 0200 02 000a") == "100200020000" and host.access("03 0200 02") == "03020002000a"
    assert host.access("08 0000 02 a55a") == "08000002a55a"


@pytest.mark.parametrize(("message", "answer"), [
    ("07 0200 02", "870000020001"), ("90 0200 02", "900000020001"),  # 01h: function code
    ("03 0601 02", "830000020002"), ("03 0600 04", "830000020002"), ("10 0900 04 0000 0000", "900000020002"),
    ("03 0900 02", "830000020002"),  # 02h: no such register; the Enter command is for writing
    ("03 0200 00", "830000020003"), ("03 0200 03", "830000020003"), ("03 0200 0a", "830000020003"),
    ("08 0000 01", "880000020003"),  # 03h: amount of data
    ("10 03cc 02 0002", "900000020021"), ("10 0280 04 9c40 9c41", "900000020021"),  # 21h: out of limits
    ("10 0024 02 0001", "900000020022")])  # 22h: read-only
def test_memobus_errors(message: str, answer: str) -> None:
    host = Host(EXTENDED_1)
    before = {n: word for n, word in host.card.registers.items() if n not in profile.MONITORS}
    assert host.access(message) == answer + "0000" * 3
    assert {n: word for n, word in host.card.registers.items() if n not in profile.MONITORS} == before


def test_enter_by_memobus() -> None:
    host = Host(EXTENDED_2)
    host.access("10 0200 02 000a")
    assert host.card.registers.setting("C1-01") == 100
    host.access("10 0910 02 0000")
    assert host.card.registers.setting("C1-01") == 10
    host.card.reset(host.now)
    assert host.card.registers["C1-01"] == 100


def test_the_handshake_keeps_the_old_hs_while_busy() -> None:
    """Devices page: 00 -> 20 -> 40 -> E0 for a toggle to 1, E0 -> A0 -> C0 -> 60 for a toggle to 0; function 00h meanwhile."""
    host = Host(EXTENDED_2)
    walks = []
    for hs in (0x80, 0x00, 0x80):
        host.outputs[4:8], host.outputs[11] = bytes.fromhex("03020002"), hs
        seen = [host.inputs[11] & 0xE1]
        start = host.now
        while host.now < start + 0.030:
            inputs = host.step()
            if inputs[11] & 0xE1 != seen[-1]:
                seen.append(inputs[11] & 0xE1)
            assert inputs[4] == (0x03 if inputs[11] & 0x80 == hs else 0x00)
            assert inputs[8:10] == (b"\x00\x64" if inputs[11] & 0x80 == hs else b"\0\0")
            host.now += 0.0005
        walks.append(seen)
    assert walks == [[0x00, 0x20, 0x40, 0xE0], [0xE0, 0xA0, 0xC0, 0x60], [0x60, 0x20, 0x40, 0xE0]]


def test_init_clears_the_handshaking_bit() -> None:
    host = Host(EXTENDED_2)
    host.access("03 0200 02")
    host.outputs[11] = 0x01
    inputs = host.after(0.001)
    assert inputs[11] & 0xE1 == 0 and inputs[4:10] == bytes(6)
    host.outputs[11] = 0x81  # INIT holds it
    assert host.after(0.050)[11] & 0xE1 == 0
    host.outputs[11] = 0x00
    host.step()
    assert host.access("03 0200 02") == "030200020064"
    host.outputs[4:8], host.outputs[11] = bytes.fromhex("03020002"), 0x00  # INIT in the middle of a message
    host.after(0.004)
    host.outputs[11] = 0x01
    host.after(0.001)
    host.outputs[11] = 0x00
    assert host.after(0.050)[11] & 0xE1 == 0


def test_a_toggle_while_busy_is_looked_at_afterwards() -> None:
    host = Host(EXTENDED_1)
    host.outputs[16:20], host.outputs[31] = bytes.fromhex("03020002"), 0x80
    host.after(0.005)
    host.outputs[16:20], host.outputs[31] = bytes.fromhex("03028002"), 0x00
    inputs = host.after(0.040)
    assert inputs[31] & 0xE1 == 0x60 and inputs[16:22].hex() == "030280020000"


def test_hs_is_cleared_after_power_up_and_a_new_exchange() -> None:
    host = Host(EXTENDED_1)
    host.access("03 0200 02")
    host.state = SlaveState.WAIT_PRM
    assert host.after(0.1) == b""
    host.state = SlaveState.DATA_EXCH
    host.outputs[:] = bytes(32)
    assert host.after(0.1)[31] & 0xE1 == 0
    host.access("03 0200 02")
    host.card.reset(host.now)
    host.outputs[:] = bytes(32)
    assert host.after(0.2)[31] & 0xE1 == 0


def test_wd_counts_up_every_64_ms_modulo_16() -> None:
    host = Host(EXTENDED_2)
    host.now = 6.4 + 0.001
    values = []
    for _ in range(40):
        values.append(host.step()[11] >> 1 & 0x0F)
        host.now += 0.064
    assert values == [(values[0] + i) % 16 for i in range(40)]
    assert 0 < host.card.next_step(host.now) - host.now <= 0.064


# -- Faults, alarms, loss, Clear -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("f6_01", "hz"), [(0, 24.0), (1, 0.0), (2, 18.0), (3, 30.0)])
def test_f6_01_reaction_to_loss_of_exchange(f6_01: int, hz: float) -> None:
    """0 ramp to stop (C1-02), 1 coast, 2 fast-stop (C1-09), 3 alarm only."""
    for configuration in ("PPO Type 4", BASIC):
        host = Host(configuration, settings={"F6-01": f6_01, "C1-09": 50})
        host.command(RUN, 0.5) if configuration != BASIC else host.drive(0x0001, 30.0)
        host.after(6.0)
        host.state = SlaveState.WAIT_PRM
        host.after(1.0)
        assert host.card.motor.frequency == pytest.approx(hz)
        assert host.card.fault == (None if f6_01 == 3 else "bUS")
        assert host.card.alarms == ({"bUS"} if f6_01 == 3 else frozenset())
        host.after(10.0)
        assert host.card.running is (f6_01 == 3)
        host.outputs[:] = bytes(host.size)
        host.state = SlaveState.DATA_EXCH
        host.after(10.0)
        assert not host.card.running and (host.card.fault is None) is (f6_01 == 3)


def test_bus_is_detected_only_when_the_option_has_something_to_say() -> None:
    """Table 16: "Only detected when the run command or frequency reference is assigned to the option"."""
    for b1_01, b1_02, fault in ((3, 1, "bUS"), (1, 3, "bUS"), (1, 1, None)):
        host = Host(settings={"b1-01": b1_01, "b1-02": b1_02})
        host.state = SlaveState.WAIT_PRM
        host.after(0.1)
        assert host.card.fault == fault


def test_a_fault_needs_an_edge_and_a_new_run_command() -> None:
    host = Host()
    host.command(RUN, 0.5)
    host.after(6.0)
    host.state = SlaveState.WAIT_PRM
    host.after(1.0)
    host.state = SlaveState.DATA_EXCH
    host.after(1.0)
    assert host.card.fault == "bUS" and not host.card.running and host.word(8) == 0x023B  # fault, not ready
    host.command(RUN | 0x0080)
    host.after(1.0)
    assert host.card.fault is None and not host.card.running  # a reset alone starts no motor
    host.command(HALT)
    host.command(RUN)
    host.after(1.0)
    assert host.card.running
    host.command(RESET)
    host.state = SlaveState.WAIT_PRM
    host.after(0.1)
    host.state = SlaveState.DATA_EXCH
    host.command(RESET)
    assert host.card.fault is None  # the bit came anew with the exchange
    host.card.undervoltage = False


@pytest.mark.parametrize(("f6_03", "hz"), [(0, 24.0), (1, 0.0), (2, 18.0), (3, 30.0)])
def test_f6_03_reaction_to_an_external_fault(f6_03: int, hz: float) -> None:
    host = Host(BASIC, settings={"F6-03": f6_03, "C1-09": 50})
    host.drive(0x0001, 30.0)
    host.after(6.0)
    host.drive(0x0101)
    host.after(1.0)
    assert host.card.motor.frequency == pytest.approx(hz)
    assert (host.card.fault, bool(host.word(0) & FAULT), bool(host.word(0) & ALARM)) == (
        (None, False, True) if f6_03 == 3 else ("EF0", True, False))
    host.drive(0x0300)
    assert host.card.fault == (None if f6_03 == 3 else "EF0")  # the cause is still there
    host.drive(0x0200)
    assert host.card.fault == (None if f6_03 == 3 else "EF0")  # no edge
    assert host.word(0) & 0x08
    host.drive(0x0000)
    host.drive(0x0200)
    assert host.card.fault is None and not host.word(0) & ALARM


def test_an_alarm_only_hides_no_fault_and_keeps_none_from_being_reset() -> None:
    host = Host(BASIC, settings={"F6-03": 3})
    host.drive(0x0100)
    assert host.card.fault is None and host.card.alarms == {"EF0"}
    host.drive(0x0104)
    assert host.card.fault == "EF3" and host.card.alarms == {"EF0"}
    host.drive(0x0300)
    assert host.card.fault is None and host.card.alarms == {"EF0"}


def test_f6_02_external_fault_only_during_operation() -> None:
    host = Host(BASIC, settings={"F6-02": 1})
    host.drive(0x0100)
    host.after(0.1)
    assert host.card.fault is None
    host.drive(0x0001, 30.0)
    host.after(1.0)
    host.drive(0x0101)
    assert host.card.fault == "EF0"


def test_call_until_the_exchange_is_established() -> None:
    card = SIP3(5)
    card.step(0.0, Exchange())
    card.step(1.0, Exchange())
    assert card.alarms == {"CALL"} and card.fault is None
    host = Host()
    assert "CALL" not in host.card.alarms
    host.state = SlaveState.WAIT_PRM
    host.after(0.1)
    assert host.card.fault == "bUS" and "CALL" not in host.card.alarms


@pytest.mark.parametrize(("fault", "run", "err"), [
    ("oFA00", "off", "flashing red"), ("oFA01", "off", "flashing red"), ("oFA30", "off", "solid red"),
    ("oFA43", "off", "solid red"), ("oFb00", "off", "flashing red"), ("oFb02", "off", "flashing red"),
    ("oFc00", "off", "flashing red"), ("oFc02", "off", "flashing red")])
def test_injected_faults_need_a_power_cycle(fault: str, run: str, err: str) -> None:
    host = Host()
    host.command(RUN, 0.5)
    host.after(1.0)
    host.card.inject(fault)
    host.after(0.1)
    assert host.card.fault == fault and not host.card.running
    assert (host.card.leds.run, host.card.leds.err) == (run, err)
    assert host.card.diagnosis == bytes.fromhex("05 81 00 00 02")  # inverter communications error
    host.command(RESET)
    assert host.card.fault == fault
    host.card.reset(host.now)
    host.command(HALT)
    host.after(0.2)
    assert host.card.fault is None and host.card.diagnosis == b""


def test_only_faults_of_the_card_can_be_injected() -> None:
    for fault in ("bUS", "EF0", "oFA02"):
        with pytest.raises(ConfigurationError, match=f"'{fault}'.*oFA30 to oFA43"):
            SIP3(5).inject(fault)


def test_undervoltage_is_told_in_the_diagnosis() -> None:
    host = Host()
    host.command(RUN, 0.5)
    host.after(1.0)
    host.card.undervoltage = True
    host.after(0.1)
    assert host.card.diagnosis == bytes.fromhex("05 81 00 00 01")
    assert not host.card.running and host.word(8) & 0x0004 == 0
    host.card.undervoltage = False
    host.after(1.0)
    assert host.card.diagnosis == b"" and not host.card.running  # a new run command is needed


def test_pnu_947_and_948_fault_history() -> None:
    host = Host(EXTENDED_1)
    for command in (0x0100, 0x0000, 0x0200, 0x0000, 0x0004, 0x0000, 0x0200, 0x0000):
        host.drive(command)
        host.after(3.0)
    assert [name for name, _ in host.card.history] == ["EF3", "EF0"]
    ppo = Host()
    ppo.card.history = host.card.history
    assert [ppo.task(f"63b3 {n:04x} 00000000")[10:] for n in (1, 2, 3)] == ["00000011", "00000027", "00000000"]
    assert ppo.task("63b4 0001 00000000")[10:] == f"{12:08x}"  # seconds since the fault before
    assert ppo.task("63b3 000b 00000000") == "73b3 000b 00000003"
    host.drive(0x4000)  # bit E: fault information is reset by the rising edge
    assert host.card.history == []


@pytest.mark.parametrize("f6_31", [0, 1])
@pytest.mark.parametrize("configuration", ["PPO Type 2", EXTENDED_1])
def test_f6_31_clear(f6_31: int, configuration: str) -> None:
    """0: resets back to 0. 1: maintains the previous value - but not that of an exchange before this one."""
    host = Host(configuration, settings={"F6-31": f6_31})
    host.command(RUN, 0.5) if "PPO" in configuration else host.drive(0x0001, 30.0)
    host.after(6.0)
    host.outputs[:] = b""
    host.valid = False
    host.after(10.0)
    assert host.card.motor.frequency == (30.0 if f6_31 else 0.0) and host.card.fault is None
    host.state = SlaveState.WAIT_PRM
    host.after(1.0)
    host.state = SlaveState.DATA_EXCH
    host.after(10.0)
    assert not host.card.running


def test_a_new_exchange_in_clear_holds_nothing_of_the_one_before() -> None:
    host = Host(settings={"F6-31": 1, "F6-01": 3})
    host.command(RUN, 0.5)
    host.after(6.0)
    host.state = SlaveState.WAIT_PRM
    host.after(1.0)
    assert host.card.motor.frequency == 30.0
    host.state, host.valid = SlaveState.DATA_EXCH, False
    host.after(0.1)
    assert not host.card.running


def test_leds_through_a_life() -> None:
    """Tables 3 and 4."""
    card = SIP3(5)

    def leds() -> str:
        return " | ".join((card.leds.run, card.leds.err, card.leds.comm, card.leds.bf))

    assert leds() == "off | off | off | off"
    card.step(0.0, Exchange())
    assert leds() == "solid green | off | off | off"
    card.step(1.0, Exchange())
    assert leds() == "solid green | off | off | solid red"
    card.step(2.0, Exchange(SlaveState.WAIT_CFG))
    card.step(2.1, Exchange(SlaveState.WAIT_PRM))  # Chk_Cfg was refused
    assert leds() == "solid green | off | off | flashing red"
    card.step(3.0, Exchange(SlaveState.DATA_EXCH, bytes(20), True, 1, 4, 1))
    assert leds() == "solid green | off | solid green | off"
    card.step(4.0, Exchange(SlaveState.WAIT_PRM, watchdog_expired=1))
    assert leds() == "solid green | off | off | flashing red"


def test_a_node_address_of_0_lights_err() -> None:
    """Tables 3 and 4: ERR flashes; note 5 of table 7 has it lit for 0. The card takes no part from the next power-up on."""
    host = Host()
    host.card.registers["F6-30"] = 0
    host.card.reset(host.now)
    host.command(RUN, 0.5)
    host.after(1.0)
    assert (host.card.leds.run, host.card.leds.err) == ("off", "flashing red") and not host.card.running


# -- As a program sees it --------------------------------------------------------------------------------------------------


def test_configurations_by_f6_32() -> None:
    """F6-32: 0 PPO, 1 conventional. A commissioned card follows its master; with F6-32 set it refuses the other kind."""
    every = tuple(c.identifier for c in profile.CONFIGURATIONS)
    assert SIP3(5).configurations == every
    assert SIP3(5, settings={"F6-32": 0}).configurations == SIP3(5, parameters="factory").configurations == every[3:]
    assert SIP3(5, settings={"f6-32": 1}).configurations == every[:3]
    assert Host(BASIC).card.registers["F6-32"] == 1 and Host("PPO Type 3").card.registers["F6-32"] == 0
    host = Host(EXTENDED_2, settings={"F6-32": 1})
    assert host.access("03 0200 02") == "030200020064"


def test_what_the_slave_in_front_needs() -> None:
    card = SIP3(5)
    assert (card.ident_number, len(card.configurations), card.user_parameters) == (0x0ACF, 13, (4, 4))
    assert (card.sync, card.freeze, card.fail_safe, card.max_diagnosis) == (True, True, True, 11)
    assert card.min_slave_interval == 5 and card.set_address  # Min Slave Interval 5, Set Slave Add supp 1


def test_registers_as_a_program_sees_them() -> None:
    host = Host()
    registers = host.card.registers
    assert registers["b1-01"] == registers[0x0180] == registers["0180h"] == 3
    assert len(registers) == 0x601 and registers[0x0600] == 0
    registers["H4-03"] = -50  # manual, example 2
    assert registers["H4-03"] == -50 and registers[0x041F] == 0xFFCE
    for key, value, text in (("b1-01", 5, "b1-01 = 5: the register takes 0 to 4"), (0x0180, 5, "takes 0 to 4"),
                             ("H4-03", 10_000, "-9999 to 9999"), (0x0500, 65536, "0 to 65535"), ("b1-01", True, "True")):
        with pytest.raises(ConfigurationError, match=text):
            registers[key] = value
    with pytest.raises(ConfigurationError, match="0600h"):
        registers[0x0601]
    with pytest.raises(ConfigurationError, match="like 'C1-01'"):
        registers["n1-01"]
    del registers["b1-01"], registers[0x041F]
    assert registers["b1-01"] == 1 and registers["H4-03"] == 0
    registers["U1-02"] = 1234
    assert registers[0x41] == 1234
    del registers["U1-02"]
    assert registers["U1-02"] == 0


def test_monitors_live() -> None:
    host = Host()
    host.command(RUN, -0.5)
    host.after(6.0)
    registers = host.card.registers
    assert [registers[n] for n in (0x20, 0x23, 0x24, 0x25, 0x31)] == [0b0111, 3000, 3000, 1000, 311]
    assert registers[0x26] == registers["U1-03"] == round(host.card.motor.current * 100)
    assert registers["U1-09"] == round(host.card.motor.torque * 1000) == -500
    assert registers["U1-12"] == int(host.card.status)


def test_parameters_outlive_a_power_cycle_and_room_does_not() -> None:
    host = Host()
    host.card.registers["C1-01"], host.card.registers[0x0500] = 50, 7
    host.card.reset(host.now)
    assert (host.card.registers["C1-01"], host.card.registers[0x0500]) == (50, 0)


def test_bad_arguments(caplog: pytest.LogCaptureFixture) -> None:
    for arguments, text in (({"parameters": "new"}, "parameters 'new'"), ({"size": 0}, "size 0 kW"),
                            ({"settings": {"F6-33": 2}}, "F6-33 = 2"), ({"settings": {"F9-33": 2}}, "like 'C1-01'")):
        with pytest.raises(ConfigurationError, match=text):
            SIP3(5, **arguments)  # type: ignore[arg-type]
    for address in (0, 126):
        with pytest.raises(ConfigurationError, match=rf"address {address}: .*1 to 125"):
            SIP3(address)
    with caplog.at_level(logging.WARNING):
        SIP3(2)
    assert "address 2" in caplog.text


def test_an_idle_card_asks_rarely() -> None:
    card = SIP3(5)
    card.step(0.0, Exchange())
    card.step(1.0, Exchange())
    assert card.next_step(1.0) >= 2.0
    for configuration in ("PPO Type 2", BASIC):
        host = Host(configuration)
        assert host.card.next_step(host.now) >= host.now + 1.0
