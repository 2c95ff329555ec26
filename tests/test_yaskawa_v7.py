# SPDX-License-Identifier: MIT
"""YaskawaV7 against the emulated card on virtual time; appendix B of the manual octet by octet."""

from __future__ import annotations

import itertools
import threading

import pytest
from appendix_b import B2_READ, B3_READ_ERROR, B4_WRITE, B5_WRITE_ERROR
from drive_bench import VirtualV7, rows

from dpmaster.drives import YaskawaV7
from dpmaster.emulator.card import SlaveState
from dpmaster.emulator.cards import SIP1
from dpmaster.errors import (
    CommissioningError,
    ConfigurationError,
    DPTimeout,
    OutputsDiscarded,
    ParameterAccessError,
    StationError,
)

CHANNELS = ["Extended Data 1", "Extended Data 2"]
ALL = ["Basic data", *CHANNELS]


def bench(configuration: str = "Extended Data 1", *, cycle: float = 0.001, **arguments: object) -> VirtualV7:
    card = {key: arguments.pop(key) for key in ("parameters", "seed") if key in arguments}
    if "word_order" in arguments:
        card["word_order"] = arguments["word_order"]
    made = SIP1(5, **card)  # type: ignore[arg-type]
    made.registers["n019"] = made.registers["n020"] = 10  # ramps of a second
    return VirtualV7(made, configuration, cycle=cycle, **arguments)  # type: ignore[arg-type]


# -- Appendix B, on the drive class alone; test_appendix_b has it on the wire -----------------------------------------------


@pytest.mark.parametrize("configuration", CHANNELS)
def test_b2_read(configuration: str) -> None:
    drive = bench(configuration, cycle=0.0005)
    drive.card.registers[0x0037] = 0x15
    assert drive.read_parameter(0x0100) == 0
    drive.trace.clear()
    assert drive.read_parameter(0x0037) == 0x15
    assert rows(drive) == B2_READ


@pytest.mark.parametrize("configuration", CHANNELS)
def test_b3_read_error(configuration: str) -> None:
    drive = bench(configuration, cycle=0.0005)
    drive.read_parameter(0x0100)
    drive.read_parameter(0x0100)
    drive.trace.clear()
    with pytest.raises(ParameterAccessError, match=r"1000h.*error 02h, address error") as caught:
        drive.read_parameter(0x1000)
    assert (caught.value.code, caught.value.register) == (2, 0x1000) and "600h" in caught.value.meaning
    assert rows(drive) == B3_READ_ERROR


@pytest.mark.parametrize("configuration", CHANNELS)
def test_b4_write(configuration: str) -> None:
    drive = bench(configuration, cycle=0.0005)
    drive.read_parameter(0x0100)
    drive.read_parameter(0x0100)
    drive.trace.clear()
    drive.write_parameter(0x0105, 1)
    assert drive.card.registers["n005"] == 1
    assert rows(drive) == B4_WRITE


@pytest.mark.parametrize("configuration", CHANNELS)
def test_b5_write_error(configuration: str) -> None:
    drive = bench(configuration, cycle=0.0005)
    drive.read_parameter(0x0037)
    drive.trace.clear()
    with pytest.raises(ParameterAccessError) as caught:
        drive.write_parameter(0x1000, 1)
    assert caught.value.code == 2
    assert rows(drive) == B5_WRITE_ERROR


# -- The handshake -----------------------------------------------------------------------------------------------------


def toggles_follow_their_data(drive: VirtualV7) -> bool:
    """Whether each change of HS in the commands found its data already in the telegram before."""
    return all(before[16:31] == after[16:31] for (before, _), (after, _) in itertools.pairwise(drive.trace)
               if (before[31] ^ after[31]) & 0x80 and after[16])


def test_data_goes_first_and_the_toggle_in_a_later_telegram() -> None:
    drive = bench()
    for turn in range(3):
        drive.write_parameter("n019", 50 + turn)
    assert toggles_follow_their_data(drive)


def test_an_answer_counts_only_with_its_hs_and_status_11() -> None:
    """The card shows the old data until it is through: a master that looked earlier would return the value before."""
    drive = bench()
    drive.card.registers[0x0200], drive.card.registers[0x0201] = 0x1111, 0x2222
    for _ in range(5):
        assert drive.read_parameter(0x0200) == 0x1111
        assert drive.read_parameter(0x0201) == 0x2222


@pytest.mark.parametrize("cycle", [0.0002, 0.003, 0.02, 0.1])
def test_the_bus_cycle_does_not_matter(cycle: float) -> None:
    drive = bench(cycle=cycle)
    drive.write_parameter("n019", [70, 80], timeout=5.0)
    assert drive.read_parameter("n019", 2, timeout=5.0) == (70, 80)


@pytest.mark.parametrize("lag", [0, 3, 12])
@pytest.mark.parametrize("pause", [i * 0.0007 for i in range(28)])
def test_after_a_time_out_the_channel_is_usable(pause: float, lag: int) -> None:
    """Also where the card has not even looked at the request that was given up: its late mirror must not be believed. This
    card has no INIT: the settling time alone shows it."""
    drive = bench(lag=lag)
    drive.card.registers[0x0200], drive.card.registers[0x0201] = 0x1111, 0x2222
    with pytest.raises(DPTimeout):
        drive.read_parameter(0x0200, timeout=0.005)
    drive.let_pass(pause)
    assert drive.read_parameter(0x0201) == 0x2222
    assert drive.read_parameter(0x0200) == 0x1111
    assert toggles_follow_their_data(drive)


def test_a_card_that_never_answers_is_a_timeout_that_says_so() -> None:
    drive = bench()
    drive.card._job.see = lambda *_: None  # type: ignore[method-assign]
    with pytest.raises(DPTimeout, match=r"no answer to function 03h on n003 within 0.2 s; the channel can be used again"):
        drive.read_parameter("n003", timeout=0.2)


def test_a_loss_in_between_leaves_the_channel_usable() -> None:
    drive = bench()
    drive.read_parameter("n003")  # HS of card and command are 1
    drive.lose(0.5)
    assert drive.read_parameter("n003") == 3


def test_one_access_at_a_time() -> None:
    """Two threads read: the lock keeps each pair of question and answer together."""
    drive = bench()
    drive.card.registers[0x0200], drive.card.registers[0x0201] = 0x1111, 0x2222
    wrong: list[int] = []
    step = threading.RLock()
    plain = drive.exchange

    def exchange() -> None:
        with step:
            plain()

    drive.exchange = exchange  # type: ignore[method-assign]

    def read(register: int, value: int) -> None:
        wrong.extend(got for _ in range(20) if (got := drive.read_parameter(register, timeout=30.0)) != value)

    threads = [threading.Thread(target=read, args=(0x0200 + i, 0x1111 * (i + 1))) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    assert wrong == []


@pytest.mark.parametrize(("call", "code"), [
    (lambda d: d.write_parameter("n003", 4), 0x21), (lambda d: d.write_parameter(0x0037, 1), 0x22),
    (lambda d: d.read_parameter(0x0601), 0x02), (lambda d: d._channel.access(0x07, 0x0100, 2), 0x01),
    (lambda d: d._channel.access(0x03, 0x0100, 10), 0x03)])
def test_table_3_15_codes_arrive_with_their_meaning(call: object, code: int) -> None:
    drive = bench()
    with pytest.raises(ParameterAccessError, match=f"error {code:02X}h") as caught:
        call(drive)  # type: ignore[operator]
    assert caught.value.code == code and caught.value.meaning in str(caught.value)


@pytest.mark.parametrize("configuration", CHANNELS)
def test_parameters_are_stored_by_the_enter_command(configuration: str) -> None:
    """Table 3.15, 22h: "ENTER command was written during running"; register 0900h."""
    drive = bench(configuration)
    drive.write({"n019": 50, "n020": 50})
    drive.write({"n024": 3000}, store=True)
    drive.write({"n020": 70})
    drive.run(6.0)
    with pytest.raises(ParameterAccessError, match="write 0900h: the drive answers error 22h") as caught:
        drive.write({}, store=True)
    assert caught.value.code == 0x22
    drive.card.reset(drive.now)
    drive.lose(0.3)
    assert [drive[name] for name in ("n019", "n020", "n024")] == [50, 50, 3000]


def test_several_registers_at_once() -> None:
    drive = bench()
    assert drive.read_parameter("n003", 2) == (3, 9)
    drive.write_parameter(0x0200, [1, 2, 3, 4])
    assert drive.read_parameter(0x0200, 4) == (1, 2, 3, 4)
    with pytest.raises(ConfigurationError, match="5 registers at once: Extended Data 1 takes 1 to 4"):
        drive.read_parameter(0x0200, 5)
    with pytest.raises(ConfigurationError, match="Extended Data 2 takes 1 to 1"):
        bench("Extended Data 2").write_parameter(0x0200, [1, 2])
    with pytest.raises(ConfigurationError, match="0 registers"):
        drive.write_parameter(0x0200, [])
    with pytest.raises(ConfigurationError, match="70000 is no word"):
        drive.write_parameter(0x0200, 70000)


def test_basic_data_has_no_channel() -> None:
    drive = bench("Basic data")
    for call in (lambda: drive.read_parameter("n003"), lambda: drive.write_parameter("n003", 3), lambda: drive.wd_counter):
        with pytest.raises(ConfigurationError, match="Basic data has no parameter channel; Extended Data 1 and 2 have one"):
            call()


# -- Moving ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("word_order", ["big", "little"])
@pytest.mark.parametrize("configuration", ALL)
def test_forward_reverse_stop_in_every_configuration(configuration: str, word_order: str) -> None:
    drive = bench(configuration, word_order=word_order, cycle=0.005)
    drive.run_forward(30.0)
    drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)
    assert drive.card.motor.frequency == drive.frequency == 30.0
    drive.run_reverse(12.5)
    status = drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)
    assert status.reverse and drive.card.motor.frequency == -12.5
    drive.stop()
    status = drive.wait_until(lambda s: not s.running, timeout=10.0)
    assert status.zero_speed and not drive.card.running and drive.frequency == 12.5


def test_the_octets_of_a_run_command() -> None:
    """Table 3.1: byte 1 is the LSB of the command, bytes 2 and 3 the reference, 0.01 Hz."""
    drive = bench()
    drive.run_forward(30.0)
    assert drive.outputs[0:16].hex() == "00010bb8" + "00" * 12
    drive.run_reverse(0.01)
    assert drive.outputs[0:4].hex() == "00020001"
    drive.stop()
    assert drive.outputs[0:4].hex() == "00000001"
    little = bench("Basic data", word_order="little")
    little.frequency = 30.0
    assert little.outputs.hex() == "0000b80b0000"


def test_frequency_agree_is_never_that_of_the_command_before() -> None:
    drive = bench()
    drive.run_forward(10.0)
    drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)
    drive.frequency = 20.0
    drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)
    assert drive.card.motor.frequency == 20.0


@pytest.mark.parametrize(("n035", "n152", "words"), [(0, 0, "012c"), (0, 2, "3a98"), (1, 0, "01f4"), (4, 1, "0384")])
def test_the_unit_is_read_from_the_drive(n035: int, n152: int, words: str) -> None:
    drive = bench()
    drive.card.registers["n035"], drive.card.registers["n152"] = n035, n152
    drive.run_forward(30.0)
    assert drive.outputs[2:4].hex() == words
    status = drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)
    assert status.output_frequency == pytest.approx(30.0) == drive.card.motor.frequency == status.frequency_reference


def test_an_unknown_unit_stops_before_any_command() -> None:
    drive = bench()
    drive.card.registers["n035"] = 1500
    with pytest.raises(ConfigurationError, match="n035 = 1500"):
        drive.run_forward(30.0)
    assert drive.outputs[0:4] == bytes(4)


def test_basic_data_takes_the_unit_as_an_argument() -> None:
    drive = bench("Basic data", frequency_unit="0.1 Hz")
    drive.card.registers["n152"] = 0
    drive.run_forward(30.0)
    assert drive.outputs[2:4].hex() == "012c"
    with pytest.raises(ConfigurationError, match=r"frequency_unit '1 Hz'"):
        YaskawaV7(5, "Basic data", frequency_unit="1 Hz")
    with pytest.raises(ConfigurationError, match="only Basic data"):
        YaskawaV7(5, frequency_unit="0.1 Hz")


@pytest.mark.parametrize(("hz", "text"), [(-1.0, "run_reverse turns the other way"), (60.01, "the limit is 60.0 Hz .n011"),
                                          (float("nan"), "give a number of Hz")])
def test_frequencies_out_of_range(hz: float, text: str) -> None:
    drive = bench()
    with pytest.raises(ConfigurationError, match=text):
        drive.run_forward(hz)
    assert drive.outputs[0:4] == bytes(4)


def test_basic_data_is_limited_to_400_hz() -> None:
    with pytest.raises(ConfigurationError, match=r"the limit is 400\.0 Hz"):
        bench("Basic data").run_forward(400.1)


def test_run_at_0_is_allowed() -> None:
    drive = bench()
    drive.run_forward(0)
    assert drive.outputs[0:4].hex() == "00010000"


@pytest.mark.parametrize("configuration", CHANNELS)
def test_factory_parameters_in_the_way_are_named(configuration: str) -> None:
    drive = bench(configuration, parameters="factory")
    with pytest.raises(CommissioningError, match="n003 is 1 and must be 3, n004 is 2 and must be 9") as caught:
        drive.run_forward(30.0)
    assert caught.value.parameters == ("n003", "n004") and drive.outputs[0:4] == bytes(4)
    drive.write_parameter("n003", 3)
    with pytest.raises(CommissioningError, match="control the drive: n004 is 2 and must be 9"):
        drive.run_forward(30.0)
    drive.write_parameter("n004", 9)
    drive.run_forward(30.0)
    assert drive.outputs[2:4].hex() == "012c"  # n152 is still 0: 0.1 Hz


def test_factory_parameters_with_basic_data_show_by_no_running() -> None:
    drive = bench("Basic data", parameters="factory")
    with pytest.raises(CommissioningError, match="n003 = 3 and n004 = 9, which Basic data has no channel to read"):
        drive.run_forward(30.0)
    assert drive.outputs[0:2] == bytes(2)
    faulty = bench("Basic data")
    faulty.external_fault()
    with pytest.raises(StationError, match="fault_reset"):
        faulty.run_forward(30.0)


def test_parameters_are_read_once_and_again_after_operate() -> None:
    drive = bench()
    drive.run_forward(10.0)
    before = drive.now
    drive.run_forward(20.0)
    assert drive.now == before
    drive._before_operate()
    drive.run_forward(10.0)
    assert drive.now > before


def test_units_are_read_anew_only_where_a_write_may_have_changed_them() -> None:
    drive = bench(cycle=0.005)
    drive.run_forward(30.0)
    drive.wait_at_speed(10.0)
    drive.write_parameter(0x0200, [1, 2])
    with pytest.raises(ParameterAccessError, match="running"):
        drive["n152"] = 0
    assert drive.status.output_frequency == 30.0
    drive.stop()
    drive.wait_stopped(10.0)
    drive["n020"] = 50
    drive.write_parameter(0x0151, [1, 0])  # n081, and n082 behind it
    before = drive.now
    drive.run_forward(30.0)
    assert drive.now == before and drive.outputs[2:4].hex() == "0bb8"
    drive.stop()
    drive.wait_stopped(10.0)
    for register, words in (("n152", [0]), (0x0197, [0, 3])):  # n152 itself, and as the second of two
        drive.write_parameter(register, words)
        assert drive.status.output_frequency == 0.0
        drive.run_forward(30.0)
        assert drive.outputs[2:4].hex() == ("012c" if len(words) == 1 else "01f4")  # 0.1 Hz; 0.1 % of 60 Hz
        drive.stop()
        drive.wait_stopped(10.0)


def test_after_a_loss_nothing_of_the_old_command_is_sent() -> None:
    drive = bench(cycle=0.005)
    drive.run_forward(30.0)
    drive.wait_until(lambda s: s.running, timeout=1.0)
    drive.lose(0.1)
    drive.digital_inputs["S5"] = True
    assert drive.outputs[0:4].hex() == "00100000"
    drive.let_pass(10.0)
    assert not drive.card.running and drive.card.fault == "BUS"
    drive.fault_reset()
    drive.run_forward(30.0)
    drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)


def test_a_command_that_was_discarded_is_told_once() -> None:
    drive = bench()
    drive.run_forward(30.0)
    drive.lose(0.1)
    with pytest.raises(OutputsDiscarded):
        drive.wait_until(lambda s: s.running, timeout=1.0)
    assert drive.wait_until(lambda s: s.major_fault, timeout=1.0).valid


# -- Status, terminals, faults -----------------------------------------------------------------------------------------


def test_status_has_what_the_configuration_has() -> None:
    one, two, basic = (bench(name) for name in ("Extended Data 1", "Extended Data 2", "Basic data"))
    for drive in (one, two, basic):
        drive.card.pulse_train = 77
        drive.run_forward(12.0)
        drive.wait_until(lambda s: s.frequency_agree, timeout=10.0)
        drive.let_pass(0.1)
    status = one.status
    assert (status.frequency_reference, status.output_frequency, status.pulse_train, status.torque) == (12.0, 12.0, 77, None)
    assert status.current == pytest.approx(one.card.motor.current, abs=0.05)
    status = two.status
    assert (status.frequency_reference, status.output_frequency, status.current, status.torque) == (None, 12.0, None, None)
    status = basic.status
    assert (status.frequency_reference, status.output_frequency, status.current, status.torque) == (12.0, None, None, 50.0)
    assert status.running and status.ready and status.local_remote and status.valid and not status.reverse
    assert "running" in str(status) and "torque=50" in str(status)


@pytest.mark.parametrize(("bit", "field"), [
    (0, "running"), (1, "zero_speed"), (2, "reverse"), (3, "reset"), (4, "frequency_agree"), (5, "ready"), (6, "minor_fault"),
    (7, "major_fault"), (8, "ope_error"), (9, "fault_restart"), (10, "local_remote"), (11, "output1"), (12, "output2"),
    (13, "output3")])
def test_every_bit_of_table_3_3_has_its_flag(bit: int, field: str) -> None:
    drive = bench()
    frame = drive.frame
    octets = (1 << bit).to_bytes(2, "big") + bytes(30)
    status = drive._decode(type(frame)(octets, 1, 0, 0.0, True))
    flags = [name for name, value in vars(status).items() if value is True and name != "valid"]
    assert flags == [field]


def test_frequencies_are_unknown_before_the_unit_is() -> None:
    drive = bench()
    drive.card.registers["n004"] = 1  # the keypad's reference, 6 Hz
    drive.let_pass(0.1)
    assert (drive.status.frequency_reference, drive.status.output_frequency) == (None, 0.0)


def test_wait_until_names_the_last_status() -> None:
    drive = bench()
    with pytest.raises(DPTimeout, match=r"drive 5: not within 0.1 s; the last status is: zero_speed, ready, local_remote"):
        drive.wait_until(lambda s: s.running, timeout=0.1)


def test_digital_inputs_and_outputs() -> None:
    drive = bench()
    drive.card.registers["n058"] = 18
    drive.digital_inputs["S5"] = True
    drive.digital_inputs["S7"] = True
    drive.digital_inputs["S5"] = False
    drive.digital_outputs["P1"] = True
    assert drive.outputs[0:2].hex() == "0040" and drive.outputs[14:16].hex() == "0002"
    drive.let_pass(0.01)
    assert drive.card.inputs["S7"] and drive.status.output2
    assert dict(drive.digital_inputs) == {"S3": False, "S4": False, "S5": False, "S6": False, "S7": True}
    assert dict(drive.digital_outputs) == {"MA": False, "P1": True, "P2": False}
    with pytest.raises(ConfigurationError, match="terminal 'S1': there are S3, S4, S5, S6, S7"):
        drive.digital_inputs["S1"] = True
    with pytest.raises(ConfigurationError, match="Extended Data 2 has no word for them"):
        _ = bench("Extended Data 2").digital_outputs


def test_external_fault_and_reset() -> None:
    drive = bench(cycle=0.002)
    drive.run_forward(10.0)
    drive.wait_until(lambda s: s.running, timeout=1.0)
    drive.external_fault()
    drive.wait_until(lambda s: s.major_fault and not s.running, timeout=1.0)
    assert drive.card.fault == "EF0"
    with pytest.raises(StationError, match="the fault stays"):
        drive.fault_reset()
    drive.external_fault(False)
    drive.trace.clear()
    drive.fault_reset()
    commands = [outputs[0:2].hex() for outputs, _ in drive.trace]
    assert "0200" in commands and drive.outputs[0:2] == bytes(2)
    assert drive.card.fault is None and not drive.card.running
    drive.run_forward(10.0)
    drive.wait_until(lambda s: s.frequency_agree, timeout=5.0)


def test_torque_reference_of_basic_data() -> None:
    drive = bench("Basic data")
    drive.torque_reference = 80
    assert drive.outputs.hex() == "000000000050" and drive.torque_reference == 80.0
    with pytest.raises(ConfigurationError, match="0 to 100"):
        drive.torque_reference = 101
    with pytest.raises(ConfigurationError, match="Extended Data 1 has no such word"):
        _ = bench().torque_reference


def test_wd_shows_whether_the_cards_cpu_lives() -> None:
    """Table 3.17: WD counts up about every 64 ms; it is masked everywhere else."""
    drive = bench()
    before = drive.wd_counter
    drive.let_pass(0.0645)
    assert (drive.wd_counter - before) % 16 in (1, 2)
    assert drive.alive
    drive.card._ticks = lambda now: 0  # type: ignore[method-assign]
    drive.let_pass(0.01)
    assert not drive.alive


# -- Hooks and figures -------------------------------------------------------------------------------------------------


def test_rest_sends_the_stop_word_and_sees_it_answered() -> None:
    drive = bench()
    drive.run_forward(10.0)
    drive.let_pass(0.1)
    drive._stop_word()
    drive._rest()
    assert drive.trace[-1][0][0:4].hex() == "000003e8"
    drive.answering = False
    start = drive.now
    drive._stop_word()
    with pytest.raises(DPTimeout):
        drive._rest()
    assert drive.now - start == pytest.approx(0.5, abs=0.01)


def test_figures_of_the_gsd_file() -> None:
    drive = YaskawaV7(5)
    assert (drive.address, drive.ident_number, drive.configuration) == (5, 0x00CA, b"\x5f\x6f")
    assert (drive.input_length, drive.output_length, drive.user_parameters) == (32, 32, b"")
    assert (drive.min_slave_interval, drive.fail_safe, drive.resume, drive.max_tsdr[45_450]) == (1, False, "safe", 250)
    assert YaskawaV7(5, "basic DATA").configuration == b"\x72"
    assert YaskawaV7(5, "Extended Data 2").configuration == b"\x55\x65"


def test_addresses() -> None:
    for address in (0, 100, 126):
        with pytest.raises(ConfigurationError, match=f"address {address}: .*1 to 99"):
            YaskawaV7(address)
    assert YaskawaV7(3)._before_operate() == []
    assert "address 2" in YaskawaV7(2)._before_operate()[0]


def test_the_slave_is_not_in_exchange() -> None:
    drive = bench()
    drive.state_of_slave = SlaveState.WAIT_PRM
    drive._frame = type(drive.frame)(drive.frame.octets, 1, 0, 0.0, False)
    with pytest.raises(DPTimeout):
        drive.read_parameter("n003", timeout=0.1)
    assert not drive.status.valid


def test_whoever_waits_lets_the_last_command_arrive_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread has not yet seen the command answered when another begins to wait: it may not look at an older status."""
    drive = bench()
    drive.run_forward(10.0)
    wait_sent, numbers = drive.wait_sent, []

    def slow(number: int, timeout: float | None = 1.0) -> None:
        numbers.append(number)
        if len(numbers) == 1:  # the other thread, at this moment
            assert drive.wait_until(lambda status: True, timeout=1.0).running
        wait_sent(number, timeout)

    monkeypatch.setattr(drive, "wait_sent", slow)
    assert drive.wait_until(lambda status: True, timeout=1.0).running
    assert len(numbers) == 2 and numbers[0] == numbers[1]
