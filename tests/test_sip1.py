# SPDX-License-Identifier: MIT
"""The emulated SI-P1 on virtual time, octets in and octets out, against the numbers of its manual."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from card_host import CardHost

from dpmaster.emulator.card import Exchange, SlaveState
from dpmaster.emulator.cards import SIP1
from dpmaster.errors import ConfigurationError

BASIC, EXTENDED_1, EXTENDED_2 = range(3)
READY, ZERO, REMOTE, RUNNING, AGREE, REVERSE = 0x0020, 0x0002, 0x0400, 0x0001, 0x0010, 0x0004


class Host(CardHost):
    """A card in exchange."""

    def __init__(self, configuration: int = EXTENDED_1, **arguments: Any) -> None:
        super().__init__(SIP1(5, **arguments), configuration, (6, 32, 12)[configuration])


def word(octets: bytes, offset: int) -> int:
    return int.from_bytes(octets[offset:offset + 2], "big")


def test_extended_data_1_shows_reference_frequency_and_current() -> None:
    """Table 3.3: 8 frequency reference, 10 output frequency (0.01 Hz), 12 current (0.1 A), 14 pulse train, 2 - 7 always 0."""
    host = Host()
    host.card.pulse_train = 0x1234
    host.drive(0x0001, 30.00)
    inputs = host.after(2.5)  # n019: 10.0 s from 0 to n011 = 60 Hz
    assert word(inputs, 0) & 0x00FF == RUNNING | READY
    assert inputs[2:8] == bytes(6)
    assert (word(inputs, 8), word(inputs, 10), word(inputs, 14)) == (3000, 1500, 0x1234)
    assert word(inputs, 12) == round(host.card.motor.current * 10) > 0
    inputs = host.after(2.6)
    assert word(inputs, 0) & 0x00FF == RUNNING | READY | AGREE
    assert word(inputs, 10) == 3000


def test_extended_data_2_shows_the_output_frequency() -> None:
    host = Host(EXTENDED_2)
    host.drive(0x0001, 12.0)
    assert word(host.after(1.0), 2) == 600


def test_basic_data_shows_reference_and_torque() -> None:
    host = Host(BASIC)
    host.outputs[4:6] = (70).to_bytes(2, "big")
    host.drive(0x0001, 12.0)
    inputs = host.after(5.0)
    assert (word(inputs, 2), word(inputs, 4)) == (1200, 50)  # the motor's load is half the rated torque
    assert host.card.torque_reference == 70.0


def test_word_order_turns_the_fast_area_and_not_the_parameter_area() -> None:
    host = Host(word_order="little")
    host.outputs[0:4] = bytes.fromhex("0100b80b")
    inputs = host.after(6.0)
    assert host.card.motor.frequency == 30.0
    assert inputs[8:12] == bytes.fromhex("b80bb80b")
    assert host.access("03010302") == "030103020003" + "0000" * 3


def test_reverse_and_stop() -> None:
    host = Host()
    host.drive(0x0002, 6.0)
    host.after(2.0)
    assert host.card.motor.frequency == -6.0
    assert host.word(0) & 0xFF == RUNNING | REVERSE | AGREE | READY
    host.drive(0x0000)
    host.after(0.5)
    assert host.word(0) & 0xFF == RUNNING | REVERSE | READY  # slowing down
    host.after(0.6)
    assert host.word(0) & 0xFF == ZERO | READY and not host.card.running


def test_both_directions_at_once_stop_with_a_minor_fault() -> None:
    host = Host()
    host.drive(0x0001, 6.0)
    host.after(2.0)
    host.drive(0x0003)
    host.after(2.0)
    assert host.word(0) & 0xFF == ZERO | READY | 0x40


def test_the_maximum_frequency_limits_the_reference() -> None:
    host = Host()
    host.drive(0x0001, 90.0)
    assert word(host.after(11.0), 8) == 6000


@pytest.mark.parametrize(("n003", "n004", "running", "hz"), [
    (3, 9, True, 30.0), (1, 9, False, 0.0), (3, 2, True, 0.0), (3, 1, True, 6.0)])
def test_tables_1_10_and_1_11_who_controls(n003: int, n004: int, running: bool, hz: float) -> None:
    """With other settings than 3 and 9 the card accepts the words and the drive ignores them."""
    host = Host()
    host.card.registers["n003"] = n003
    host.card.registers["n004"] = n004
    host.drive(0x0001, 30.0)
    host.after(6.0)
    assert (host.card.running, host.card.motor.frequency) == (running, hz)
    assert bool(host.word(0) & REMOTE) is (n003 == 3 and n004 == 9)


def test_table_1_11_a_reference_by_parameter_access() -> None:
    """n004 = 6: "Serial Communications (Parameter Access)", in the unit of the fast words; run/stop stays the bus's."""
    host = Host()
    host.card.registers["n004"] = 6
    assert host.access("100002020bb8") == "100002020000" + "0000" * 3
    host.drive(0x0001, 12.0)
    assert word(host.after(6.0), 8) == 3000 and host.card.motor.frequency == 30.0


def test_factory_parameters_ignore_the_bus() -> None:
    host = Host(parameters="factory")
    assert [host.card.registers[n] for n in ("n003", "n004", "n035", "n152")] == [1, 2, 0, 0]
    host.drive(0x0001, 30.0)
    host.after(1.0)
    assert not host.card.running


@pytest.mark.parametrize(("n035", "n152", "reference"), [
    (0, 0, 300), (0, 1, 3000), (0, 2, 15000), (0, 3, 500), (1, 1, 500), (4, 1, 900)])
def test_tables_1_12_and_1_13_units(n035: int, n152: int, reference: int) -> None:
    host = Host()
    host.card.registers["n035"], host.card.registers["n152"] = n035, n152
    host.outputs[2:4] = reference.to_bytes(2, "big")
    host.drive(0x0001)
    inputs = host.after(6.0)
    assert host.card.motor.frequency == pytest.approx(30.0)
    assert word(inputs, 8) == word(inputs, 10) == reference


def test_a_user_unit_is_an_operator_error() -> None:
    host = Host()
    host.card.registers["n035"] = 1500
    host.drive(0x0001, 30.0)
    host.after(1.0)
    assert host.word(0) & 0x0100 and host.card.motor.frequency == 0.0


def test_status_walks_00_01_10_11_and_takes_10_to_15_ms() -> None:
    """Table 3.17 and appendix B: HS mirrored at receipt, then 01, 10, 11; typically 10 ms to 15 ms in the drive."""
    host = Host()
    spans = []
    for turn in range(40):
        host.outputs[16:20] = bytes.fromhex("03010302")
        host.outputs[31] ^= 0x80
        start, seen = host.now, {}
        for _ in range(400):
            status = host.step()[31] & 0xE1
            seen.setdefault(status, host.now)
            if status & 0x60 == 0x60 and len(seen) > 3:
                break
            host.now += 0.0001
        hs = 0x80 if turn % 2 == 0 else 0
        assert [*seen] == [hs, hs | 0x20, hs | 0x40, hs | 0x60]
        assert seen[hs] == start
        spans.append(seen[hs | 0x60] - seen[hs | 0x40])
    assert all(0.0099 <= span <= 0.0152 for span in spans)
    assert max(spans) - min(spans) > 0.001


def test_processing_time_is_settled_by_the_seed() -> None:
    def ends(seed: int) -> float:
        host = Host(seed=seed)
        host.outputs[16:20] = bytes.fromhex("03010302")
        host.outputs[31] = 0x80
        host.step()
        while host.step()[31] & 0x60 != 0x60:
            host.now = host.card.next_step(host.now)
        return host.now

    assert ends(1) == ends(1) != ends(2)


def test_the_answer_stays_until_the_next_command() -> None:
    host = Host()
    answer = host.access("03010302")
    host.outputs[16:28] = bytes(12)
    inputs = host.after(120.0)
    assert inputs[16:28].hex() == answer and inputs[31] & 0xE1 == 0xE0


def test_read_and_write_of_1_to_4_words() -> None:
    """Table 3.5: a good answer repeats function, address and quantity; a write's data is 0."""
    host = Host()
    assert host.access("0301030400000000") == "03010304" + "00030009" + "00000000"
    assert host.access("100200081111222233334444") == "10020008" + "0000" * 4
    assert host.access("03020008") == "03020008" + "1111222233334444"
    assert [host.card.registers[0x200 + i] for i in range(4)] == [0x1111, 0x2222, 0x3333, 0x4444]
    for n in (1, 2, 3, 4):
        assert host.access(f"030200{2 * n:02x}")[:8] == f"030200{2 * n:02x}"


def test_extended_data_2_takes_one_word() -> None:
    host = Host(EXTENDED_2)
    assert host.access("03010302") == "030103020003"
    assert host.access("03010304") == "830000020003"  # 03 amount of data
    assert host.access("100200021234") == "100200020000"
    assert host.card.registers[0x0200] == 0x1234


@pytest.mark.parametrize(("message", "answer"), [
    ("07010302", "870000020001"),      # 01h: invalid function code
    ("08010302", "880000020001"),
    ("03060102", "830000020002"),      # 02h: starting address greater than 600h
    ("101000020001", "900000020002"),
    ("03060004", "830000020002"),      # runs over 600h
    ("03090002", "830000020002"),      # ENTER is for writing, alone
    ("1009000400000000", "900000020002"),
    ("03010300", "830000020003"),      # 03h: nothing, odd, more than 4 words
    ("03010303", "830000020003"),
    ("0301030a", "830000020003"),
    ("100103020004", "900000020021"),  # 21h: n003 is 0 to 3
    ("100123020fa0", "900000020021"),  # n035 is 0 to 3999
    ("1001030400030063", "900000020021"),
    ("100037020001", "900000020022"),  # 22h: read-only
])
def test_table_3_15_errors(message: str, answer: str) -> None:
    host = Host()
    before = dict(host.card.registers)
    assert host.access(message) == answer + "0000" * 3
    assert dict(host.card.registers) == before


def test_0600h_itself_is_an_address() -> None:
    assert Host().access("03060002") == "030600020000" + "0000" * 3


def test_write_fault_while_running_undervoltage_or_storing() -> None:
    host = Host()
    refused, done = "900000020022" + "0000" * 3, "100113020000" + "0000" * 3
    host.drive(0x0001, 6.0)
    assert host.access("100113020032") == refused
    assert host.access("03011302")[:12] == "030113020064"
    host.drive(0x0000)
    host.after(2.0)
    host.card.undervoltage = True
    assert host.access("100113020032") == refused
    host.card.undervoltage, host.card.storing = False, True
    assert host.access("100113020032") == refused
    host.card.storing = False
    assert host.access("100113020032") == done
    assert host.card.registers["n019"] == 50


def test_enter_stores_what_the_bus_has_written_and_not_while_running() -> None:
    """Table 3.15, 22h: "ENTER command was written during running"; its register 0900h is the drives' usual one."""
    host = Host()
    enter, refused, done = "100900020000", "900000020022" + "0000" * 3, "100900020000" + "0000" * 3
    host.access("100113020032")
    assert host.card.registers["n019"] == 50  # in force at once
    host.outputs[:] = bytes(32)
    host.card.reset(host.now)
    host.after(0.2)
    assert host.card.registers["n019"] == 100
    host.access("100113020032")
    host.drive(0x0001, 6.0)
    assert host.access(enter) == refused
    host.drive(0x0000)
    host.after(2.0)
    host.card.undervoltage = True
    assert host.access(enter) == refused
    host.card.undervoltage = False
    assert host.access(enter) == done
    host.card.reset(host.now)
    assert host.card.registers["n019"] == 50
    with pytest.raises(ConfigurationError, match="0600h"):
        host.card.registers[0x0900]


def test_a_toggle_with_function_00h_is_no_access() -> None:
    host = Host()
    host.outputs[31] = 0x80
    assert host.after(0.1)[31] & 0xE1 == 0x80


def test_a_toggle_while_busy_is_looked_at_afterwards() -> None:
    host = Host()
    host.outputs[16:20], host.outputs[31] = bytes.fromhex("03010302"), 0x80
    host.after(0.005)
    host.outputs[16:20], host.outputs[31] = bytes.fromhex("03010402"), 0x00
    assert host.after(0.001)[31] & 0xE1 == 0xC0
    inputs = host.after(0.040)
    assert inputs[31] & 0xE1 == 0x60 and inputs[16:22].hex() == "030104020009"


def test_handshake_is_cleared_after_power_up_and_re_initialisation() -> None:
    """Table 3.16: "must be cleared after power-up or re-initialization"."""
    host = Host()
    host.access("03010302")
    host.outputs[:] = bytes(32)
    host.state = SlaveState.WAIT_PRM
    assert host.after(0.1) == b""
    host.state = SlaveState.DATA_EXCH
    inputs = host.after(0.1)
    assert inputs[31] & 0xE1 == 0 and inputs[16:28] == bytes(12)
    host.access("03010302")
    host.card.reset(host.now)
    host.outputs[:] = bytes(32)
    assert host.after(0.2)[31] & 0xE1 == 0


def test_wd_counts_up_every_64_ms_modulo_16() -> None:
    """Table 3.17: WD, bits 4 - 1, incremented approximately every 64 ms."""
    host = Host()
    host.now = 6.4 + 0.001
    values = []
    for _ in range(40):
        values.append(host.step()[31] >> 1 & 0x0F)
        host.now += 0.064
    assert values == [(values[0] + i) % 16 for i in range(40)]
    asked = host.card.next_step(host.now)
    assert 0 < asked - host.now <= 0.064


def test_clear_is_a_stop_without_a_fault() -> None:
    host = Host()
    host.drive(0x0001, 30.0)
    host.after(6.0)
    host.valid = False
    host.after(1.0)
    assert 20.0 < host.card.motor.frequency < 30.0 and host.card.fault is None
    host.after(5.0)
    assert not host.card.running


def test_loss_of_the_exchange_is_bus_and_stops() -> None:
    """Table 1.9 BUS: communication is not established. Reset when the cause is gone, on the rising edge of bit 9."""
    host = Host()
    host.drive(0x0001, 30.0)
    host.after(6.0)
    host.state = SlaveState.WAIT_PRM
    host.after(1.0)
    assert host.card.fault == "BUS" and 20.0 < host.card.motor.frequency < 30.0
    host.after(5.0)
    assert not host.card.running
    host.state = SlaveState.DATA_EXCH
    host.after(1.0)
    assert host.card.fault == "BUS" and not host.card.running and host.word(0) & 0x80  # the run bit is still there
    host.drive(0x0201)
    host.after(1.0)
    assert host.card.fault is None and not host.card.running  # a reset alone starts no motor
    host.drive(0x0000)
    host.drive(0x0001)
    host.after(1.0)
    assert host.card.running


@pytest.mark.parametrize("lost", [True, False])
def test_neither_clear_nor_a_loss_leaves_anything_commanded(lost: bool) -> None:
    """The words besides the run command too: multi-function output (table 3.2), torque reference (table 3.13)."""
    host, basic = Host(), Host(BASIC)
    host.card.registers["n057"] = 18
    host.outputs[14:16], basic.outputs[4:6] = b"\x00\x01", b"\x00\x46"
    for each in (host, basic):
        each.step()
    assert host.card.outputs["MA"] and basic.card.torque_reference == 70.0
    for each in (host, basic):
        each.valid = False
        each.state = SlaveState.WAIT_PRM if lost else each.state
        each.after(0.1)
    assert not host.card.outputs["MA"] and basic.card.torque_reference == 0.0


def test_no_bus_fault_before_the_exchange_was_established() -> None:
    card = SIP1(5)
    for second in range(10):
        card.step(float(second), Exchange())
    assert card.fault is None


def test_external_fault_bit_is_ef0() -> None:
    host = Host()
    host.drive(0x0001, 30.0)
    host.after(6.0)
    host.drive(0x0101)
    assert host.card.fault == "EF0" and not host.card.running  # the output is shut off at once
    assert host.word(0) & 0xA0 == 0x80  # major fault, not ready
    host.drive(0x0200 | 0x0100)
    assert host.card.fault == "EF0"  # the cause is still there
    host.drive(0x0200)
    assert host.card.fault == "EF0" and host.word(0) & 0x08  # no edge, though the reset signal is shown
    host.drive(0x0000)
    host.drive(0x0200)
    assert host.card.fault is None


@pytest.mark.parametrize(("fault", "err", "wd"), [("F06", "solid red", "flashing red"), ("F21", "solid red", "solid red"),
                                                  ("F22", "solid red", "solid red"), ("F23", "solid red", "solid red")])
def test_injected_faults_need_a_power_cycle(fault: str, err: str, wd: str) -> None:
    host = Host()
    host.drive(0x0001, 30.0)
    host.after(1.0)
    host.card.inject(fault)
    host.after(0.1)
    assert host.card.fault == fault and not host.card.running
    assert (host.card.leds.err, host.card.leds.wd) == (err, wd)
    host.drive(0x0200)
    assert host.card.fault == fault
    host.card.reset(host.now)
    host.drive(0x0000)
    host.after(0.2)
    assert host.card.fault is None


def test_only_faults_of_the_card_can_be_injected() -> None:
    with pytest.raises(ConfigurationError, match=r"'EF0'.*F06, F21, F22 or F23"):
        SIP1(5).inject("EF0")


def test_leds_through_a_life() -> None:
    """Tables 1.6 to 1.8; ERR is solid before the first exchange and flashes after a loss."""
    card = SIP1(5)

    def leds() -> str:
        return " | ".join((card.leds.pwr, card.leds.comm, card.leds.err, card.leds.wd))

    assert leds() == "off | off | off | off"
    card.step(0.0, Exchange())
    assert leds() == "solid green | solid green | off | solid green"
    card.step(1.0, Exchange())
    assert leds() == "solid green | off | solid red | flashing green"
    card.step(2.0, Exchange(SlaveState.DATA_EXCH, bytes(32), True, 1, EXTENDED_1, 1))
    assert leds() == "solid green | solid green | off | flashing green"
    card.step(3.0, Exchange())
    assert leds() == "solid green | off | flashing red | solid green"


def test_terminals_follow_the_bus_and_their_functions() -> None:
    """Table 3.2: 1 = close; what a terminal does depends on n052 to n056 and n057 to n059."""
    host = Host()
    host.drive(0x0050)
    assert host.card.inputs == {"S3": False, "S4": False, "S5": True, "S6": False, "S7": True}
    host.drive(0x0004)  # n052 = 3: external fault
    assert host.card.fault == "EF3" and host.card.outputs["MA"]  # n057 = 0: fault
    host.drive(0x0008)  # n053 = 5: fault reset
    assert host.card.fault is None
    host.drive(0x0000)
    for name in ("n057", "n058", "n059"):
        host.card.registers[name] = 18  # the bus commands them
    host.outputs[14:16] = b"\x00\x05"
    assert host.word(0) & 0x3800 == 0x2800
    assert host.card.outputs == {"MA": True, "P1": False, "P2": True}


def test_initialisation_ends_by_itself() -> None:
    card = SIP1(5)
    exchange = Exchange(SlaveState.DATA_EXCH, bytes(32), True, 1, EXTENDED_1, 1)
    assert card.step(0.0, exchange)[0:2] == bytes(2)
    assert card.step(card.next_step(0.0), exchange)[0:2] == bytes(2)
    assert int.from_bytes(card.step(0.2, exchange)[0:2], "big") & READY


def test_an_idle_card_asks_rarely() -> None:
    card = SIP1(5)
    card.step(0.0, Exchange())
    card.step(1.0, Exchange())
    assert card.next_step(1.0) >= 2.0


def test_registers_as_a_program_sees_them() -> None:
    host = Host()
    registers = host.card.registers
    assert registers["n003"] == registers[0x0103] == registers["0103h"] == 3
    assert len(registers) == 0x601 and registers[0x0600] == 0
    with pytest.raises(ConfigurationError, match="n003 = 4: the register takes 0 to 3"):
        registers["n003"] = 4
    with pytest.raises(ConfigurationError, match="0600h"):
        registers[0x0601]
    del registers["n003"]
    assert registers["n003"] == 1
    registers[0x0037] = 0x15
    assert registers[0x0037] == 0x15
    del registers[0x0037]
    assert registers[0x0037] == 0


def test_monitors_live() -> None:
    host = Host()
    host.drive(0x0002, 30.0)
    host.after(6.0)
    registers = host.card.registers
    assert [registers[a] for a in (0x0020, 0x0023, 0x0024)] == [0b0111, 3000, 3000]
    assert registers[0x0027] == round(host.card.motor.current * 10)
    assert registers[0x0037] == round(host.card.motor.power) > 0


def test_parameters_outlive_a_power_cycle_and_room_does_not() -> None:
    host = Host()
    host.card.registers["n019"], host.card.registers[0x0300] = 50, 7
    host.card.reset(host.now)
    assert (host.card.registers["n019"], host.card.registers[0x0300]) == (50, 0)


def test_bad_arguments() -> None:
    with pytest.raises(ConfigurationError, match=r"address 100: .*1 to 99"):
        SIP1(100)
    with pytest.raises(ConfigurationError, match="parameters 'new'"):
        SIP1(5, parameters="new")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="word_order 'middle'"):
        SIP1(5, word_order="middle")  # type: ignore[arg-type]


def test_a_low_address_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        SIP1(2)
    assert "address 2" in caplog.text


def test_what_the_slave_in_front_needs() -> None:
    """GSD file: Ident_Number 0x00CA, Freeze and Sync supported, Fail_Safe 0, Max_Diag_Data_Len 6, no user parameters,
    Min_Slave_Intervall 1."""
    card = SIP1(5)
    assert (card.ident_number, card.configurations) == (0x00CA, (b"\x72", b"\x5f\x6f", b"\x55\x65"))
    assert (card.sync, card.freeze, card.fail_safe, card.max_diagnosis, card.user_parameters) == (True, True, False, 6, (0, 0))
    assert card.min_slave_interval == 1
