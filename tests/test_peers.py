# SPDX-License-Identifier: MIT
"""What other open stacks were seen to do wrong, each line with the test that shows what ours does.

`LINES` is that list; the tests here are those that had no place elsewhere: whole buses on virtual time - our master and
our slaves, no clock of this computer. Lines about DP-V1 and a monitor belong to what is still to be built.
"""

from __future__ import annotations

import os
import pty
import re
from pathlib import Path

import pytest
from named_tests import check_named
from wire import MS, Master, S, Script, Slaves, Wire, default_parameters, lib, octets

import dpmaster

LINES = {
    # a Python stack
    "any SC acknowledges every slave": "test_dp_master.py::test_an_sc_acknowledges_nobody_else "
                                       "test_fdl.py::test_a_late_sc_acknowledges_nobody_else",
    "8 slaves at 19.2 kbit/s not connected in 30 s": "test_peers.py::test_eight_slaves_at_19200_all_exchange",
    "requests overlap after one late answer": "test_fdl.py::test_a_late_answer_is_dropped_and_not_taken_for_the_next_one "
                                              "test_fdl.py::test_behind_a_repetition_its_slot_runs_out_first",
    "FCB does not toggle when SC answers": "test_dp_master.py::test_an_output_only_slave_takes_every_telegram",
    "a retry has new data": "test_dp_master.py::test_a_retry_carries_the_old_outputs_and_the_new_ones_follow "
                            "test_fdl.py::test_a_retry_is_the_first_try_octet_for_octet_a_slot_later",
    "8 octets go out as SD3": "test_dp_master.py::test_eight_octets_go_out_as_sd2",
    "SD3 is understood": "test_peers.py::test_an_answer_as_sd3_is_understood "
                         "test_slave_services.py::test_eight_output_octets_as_sd3_and_sd2_rows_46_and_47",
    "a truncated SD2 eats the next telegram": "test_receiver.py::test_the_telegram_after_noise_is_found "
                                              "test_receiver.py::test_patience_ends_an_unfinished_telegram_and_not_a_moment_before",
    "one stray octet costs the next telegram": "test_fdl.py::test_a_stray_octet_before_an_answer_costs_nothing",
    "counts by reason what it throws away": "test_noise.py::test_counters_name_what_was_thrown_away",
    "RS ends the program": "test_dp_master.py::test_rs_ue_rr_at_each_step_lead_back_to_slave_diag "
                           "test_dp_master.py::test_rs_in_data_exchange_leads_to_slave_diag_at_once",
    "parity errors never seen": "test_port.py::test_marks_of_the_driver_become_line_errors "
                                "test_fdl.py::test_an_answer_with_a_line_error_is_no_answer",
    "no echo handling": "test_port.py::test_an_echo_is_found_out_and_marked "
                        "test_fdl.py::test_our_own_echo_is_not_a_foreign_master",
    "two programs can open one port": "test_port.py::test_a_port_of_somebody_else_is_refused "
                                       "test_port.py::test_a_port_is_opened_once",
    "the program spins": "test_bus.py::test_a_machine_with_nothing_to_do_costs_nothing "
                         "test_bus.py::test_an_exchange_costs_a_few_wakes",
    "an absent slave slows the others": "test_peers.py::test_absent_slaves_cost_the_others_little "
                                        "test_dp_master.py::test_an_absent_station_is_tried_rarely_once_others_exchange",
    "1 % of answers lost": "test_peers.py::test_one_answer_in_a_hundred_lost_costs_its_slot_times_only",
    "diagnosis not handed to the program": "test_master_pty.py::test_diagnosis_is_fetched_when_the_station_announces_it",
    "extended diagnosis thrown away": "test_diagnosis.py::test_blocks_of_the_standards_kinds "
                                      "test_recordings.py::test_every_answer_of_the_recorded_slave_is_taken",
    "min Tsdr not settable": "test_recordings.py::test_the_start_up_is_the_s7s_octet_for_octet_and_in_its_order",
    "sensors refused": "test_dp_master.py::test_an_input_only_slave_is_asked_with_sd1",
    "Get_Cfg decodes to None": "test_recordings.py::test_services_by_hand "
                               "test_identifier.py::test_decode_gives_slots_and_offsets",
    "a held pty cannot be opened twice": "test_peers.py::test_a_held_pty_can_be_opened_again",
    "GSD keywords are case-sensitive": "test_gsd.py::test_capitals_do_not_count",
    "a blank behind #Profibus_DP empties the file": "test_gsd.py::test_the_marker_is_not_always_exact",
    "Bit, BitArea, ExtUserPrmData ignored":
        "test_gsd_configuration.py::test_a_makers_file_says_and_configures_what_a_person_reads_in_it "
        "test_gsd_configuration.py::test_a_setting_changes_its_own_bits_and_no_other",
    "DPV1 without user parameters refused": "test_gsd_configuration.py::test_the_status_octets_of_dpv1",
    # a Rust stack
    "FCB not reset when a slave was lost": "test_peers.py::test_half_a_second_of_lost_answers_with_a_slave_that_keeps_its_fcb "
                                           "test_dp_master.py::test_a_lost_station_starts_over_with_a_new_fcb",
    "one E5 after a token panics": "test_fdl.py::test_a_foreign_e5_at_every_moment_changes_nothing",
    "a diagnosis block of length 0 panics": "test_diagnosis.py::test_a_block_that_lies_ends_the_blocks "
                                            "test_diagnosis.py::test_no_octets_are_lost_or_made_up",
    "Clear and Stop panic, no safe stop": "test_dp_master.py::test_leaving_clears_and_unlocks "
                                          "test_dp_master.py::test_clear_sends_zeros_and_a_fail_safe_slave_nothing "
                                          "test_master_pty.py::test_leaving_unlocks_the_stations",
    "HSA 126 slows the cycle": "test_peers.py::test_hsa_126_costs_nothing",
    "fixed sleeps": "test_port.py::test_a_wait_ends_at_its_deadline_not_before",
    "a missing slave costs a slot time for ever": "test_peers.py::test_absent_slaves_cost_the_others_little",
    "bad parameters loop for ever": "test_dp_master.py::test_a_refusal_is_named_and_tried_again_with_growing_pauses",
    "ident never compared": "test_dp_master.py::test_a_wrong_device_or_anothers_slave_is_never_parameterised",
    "one noise octet drops the answer": "test_fdl.py::test_a_stray_octet_before_an_answer_costs_nothing",
    "a late answer is taken for the retry's": "test_fdl.py::test_a_late_answer_is_dropped_and_not_taken_for_the_next_one",
    "wall clock": "test_peers.py::test_no_wall_clock_anywhere",
    "no counters": "test_master_pty.py::test_statistics_count_what_was_done",
    "its ports cannot open a pty": "test_port.py::test_the_line_is_raw_and_a_pty_without_parity_is_accepted",
    "no slave side": "test_slave_recording.py::test_an_s7_and_the_slave_it_knows",
    "no sync, no freeze": "test_services.py::test_sync_and_freeze_reach_the_group_and_end",
    "negative Signed16 refused, Bit cannot be cleared, BitArea wipes its neighbours":
        "test_gsd_configuration.py::test_a_setting_changes_its_own_bits_and_no_other",
    # and does well
    "a simulated bus that fails a test on every broken rule": "test_simulation.py::test_a_master_and_its_slaves_break_no_rule",
    "bus parameters checked against the slaves": "test_master_api.py::test_the_slowest_station_settles_tsl",
    "every prefix, random bit flips": "test_telegram.py::test_every_prefix_is_incomplete_and_nothing_behind_is_taken "
                                      "test_telegram.py::test_one_flipped_bit_is_never_taken_for_another_telegram_of_that_length",
    # their masters, seen from a slave
    "a retry has new data: the slave does not take them": "test_slave.py::test_fcb_toggled_is_new_and_the_same_is_a_repetition",
    "FCB kept after a loss: the first request is a repetition": "test_slave.py::test_fcb_outlives_everything_but_power",
    "requests low priority, Global_Control too":
        "test_slave_services.py::test_any_state_answers_status_diag_and_get_cfg test_slave.py::test_sdn_is_never_answered",
    "the first Data_Exchange as 6D": "test_slave.py::test_fcb_first_cycle_is_new_each_time",
    "8 octets as SD3 reach our slave": "test_slave_services.py::test_eight_output_octets_as_sd3_and_sd2_rows_46_and_47",
    "ten unanswered polls before a cold slave's first answer":
        "test_slave_baud.py::test_the_first_good_telegram_is_not_answered_the_next_one_is",
    "the demo stops sending, 300 ms later the slave has left":
        "test_slave_services.py::test_start_and_loss_of_a_valve_island_rows_17_to_23",
    "a slave that ignores group 0": "test_slave_services.py::test_group_zero_is_everybody_and_others_must_match",
    "sensors, slaves without outputs": "test_generic_slave.py::test_every_shape_exchanges",
    # what users of both ask for
    "two and more slaves that simply work": "test_peers.py::test_eight_slaves_at_19200_all_exchange",
    "a slave over a virtual port": "test_segment.py::test_emulate_on_a_pty_of_its_own",
    "a slave to test a master against": "test_generic_slave.py::test_the_console",
    "the reason for a refusal in words": "test_diagnosis.py::test_the_words_of_a_refusal",
    "a scan and a diagnosis command": "test_scan.py::test_the_grid_fits_a_terminal_and_names_what_is_there "
                                      "test_services.py::test_a_technician_reads_a_station",
    "hats and direction pins": "test_port.py::test_a_pin_that_a_program_switches_is_refused_with_the_reason "
                               "test_port.py::test_a_driver_without_rs485_mode_is_an_error_that_leaves_the_port_free",
    "device files of drives read whole":
        "test_gsd_configuration.py::test_a_makers_file_says_and_configures_what_a_person_reads_in_it",
    "real time": "test_realtime.py::test_a_serial_port_takes_it_unasked "
                 "test_cycles.py::test_lateness_is_measured_against_the_raster",
}

ROOT = Path(__file__).resolve().parent.parent
CONFIGURATION = b"\x72"  # 3 words each way
COMMIT = octets("01 02 03 04 05 06")


def test_every_line_names_a_test() -> None:
    check_named(LINES)


class Bus:
    """Our master in Operate with slaves of ours at 10, 11, ...; more that are asked for and not there."""

    def __init__(self, rate: int, present: int, absent: int = 0, **parameters: int) -> None:
        given = default_parameters(rate)
        for name, value in parameters.items():
            setattr(given, name, value)
        self.present = present
        self.master, self.slaves = Master(parameters=given), Slaves(parameters=given)
        for i in range(present + absent):
            self.master.add(10 + i, 0x00CA, CONFIGURATION, watchdog=(100, 1))
        for i in range(present):
            self.slaves.add(10 + i, 0x00CA, CONFIGURATION)
        self.wire = Wire(given, self.master.machine, self.slaves.machine)
        self.master.mode(lib.DPM_MODE_OPERATE)
        for i in range(present):
            self.master.commit(i, COMMIT)

    def exchanging(self) -> bool:
        return all(bytes(self.slaves.outputs(i).octets[0:6]) == COMMIT for i in range(self.present))

    def exchanges(self) -> int:
        return sum(self.master.slave(i).statistics.exchanges for i in range(self.present))

    def per_second(self, duration: int) -> float:
        """Exchanges a second from now on."""
        begin, before = self.wire.now, self.exchanges()
        self.wire.run(begin + duration)
        return (self.exchanges() - before) * S / (self.wire.now - begin)


def test_eight_slaves_at_19200_all_exchange() -> None:
    """peers: "6 of 12 starts need a 1 s time-out, 8 slaves at 19.2 kbit/s: not connected in 30 s"."""
    bus = Bus(19_200, 8)
    bus.wire.run_until(bus.exchanging, 2 * S)
    assert [bus.master.slave(i).statistics.repetitions for i in range(8)] == [0] * 8


@pytest.mark.parametrize(("rate", "present", "absent", "duration"), [
    (19_200, 1, 1, 20 * S),  # "one absent slave of two at 19.2 kbit/s: 55 exchanges/s fall to 2.7"
    (1_500_000, 2, 4, 300 * MS),  # "four absent at 1.5 Mbit/s: 2000 fall to 482"
])
def test_absent_slaves_cost_the_others_little(rate: int, present: int, absent: int, duration: int) -> None:
    alone, among = Bus(rate, present), Bus(rate, present, absent)
    for bus in (alone, among):
        bus.wire.run_until(bus.exchanging, 10 * S)
    assert among.per_second(duration) > 0.9 * alone.per_second(duration)


def test_one_answer_in_a_hundred_lost_costs_its_slot_times_only() -> None:
    """peers: "1 % of answers lost at 1.5 Mbit/s: 1995/s fall to 679 (100 ms timers)"."""
    clean, lossy = Bus(1_500_000, 1), Bus(1_500_000, 1)
    answers = 0

    def mangle(sent: object) -> bytes | None:
        nonlocal answers
        if sent.source != 1:  # type: ignore[attr-defined]
            return None
        answers += 1
        return b"" if answers % 100 == 0 else None

    for bus in (clean, lossy):
        bus.wire.run_until(bus.exchanging, 1 * S)
    lossy.wire.mangle = mangle
    assert lossy.per_second(500 * MS) > 0.97 * clean.per_second(500 * MS)
    statistics = lossy.master.slave(0).statistics
    assert statistics.repetitions > 10 and (statistics.losses, statistics.unanswered) == (0, 0)


def test_half_a_second_of_lost_answers_with_a_slave_that_keeps_its_fcb() -> None:
    """peers: "a livelock for ever with a slave that keeps its FCB": ours forgets it at power-up only."""
    bus = Bus(500_000, 1)
    bus.wire.run_until(bus.exchanging, 1 * S)
    for parity in range(2):  # the loss begins with either FCB
        bus.wire.run_until(lambda p=parity: bus.exchanges() % 2 == p, 1 * S)
        bus.wire.mangle = lambda sent: b"" if sent.source == 1 else None
        bus.wire.run(bus.wire.now + 500 * MS)
        assert bus.master.slave(0).state == lib.DPM_ST_OFFLINE
        bus.wire.mangle = lambda sent: None
        begin, before = bus.wire.now, bus.exchanges()
        bus.wire.run_until(lambda before=before: bus.exchanges() > before + 10, 1 * S)
        assert bus.wire.now - begin < 50 * MS
    assert bus.slaves.report(0).watchdog_expired == 0, "the slave was never reset: it heard requests all the while"


def test_hsa_126_costs_nothing() -> None:
    """peers: "HSA 126 with the usual slot times: cycle 17 times slower, start 1.1 s"."""
    rates = []
    for hsa in (1, 126):
        bus = Bus(500_000, 1, hsa=hsa)
        bus.wire.run_until(bus.exchanging, 20 * MS)
        rates.append(bus.per_second(200 * MS))
    assert rates[1] > 0.95 * rates[0]


def test_an_answer_as_sd3_is_understood() -> None:
    """peers: "SD3 understood, sent only when asked". Protocol page B.1: `A2 DA SA FC`, 8 octets, FCS, ED."""
    master = Master(500_000, address=2)
    index = master.add(8, 0x0A35, b"\x17")  # 8 octets of input
    master.mode(lib.DPM_MODE_CLEAR)
    script = Script(master)
    for answer in ("68 0B 0B 68 82 88 08 3E 3C 02 05 00 FF 0A 35 D1 16", "E5", "E5",
                   "68 0B 0B 68 82 88 08 3E 3C 00 0C 00 02 0A 35 D9 16"):
        while script.next()[4] & 0x7F == 0x7F:
            pass
        script.answer(answer)
    while script.next()[0] != 0x10:  # no outputs: SD1
        pass
    script.answer("A2 02 08 08 01 02 03 04 05 06 07 08 36 16")
    assert bytes(master.inputs(index).octets[0:8]) == bytes(range(1, 9)) and master.inputs(index).valid


def test_a_held_pty_can_be_opened_again() -> None:
    """peers: "opened twice on a held pty: `termios.error 22`"."""
    far, near = pty.openpty()
    try:
        for _ in range(3):
            dpmaster.Master(os.ttyname(near), 500_000).close()
    finally:
        os.close(far)
        os.close(near)


def test_no_wall_clock_anywhere() -> None:
    """peers: "wall clock used for bus time": a clock that is set would move every deadline."""
    clocks = [clock for path in (ROOT / "csrc").glob("*/*.c") for clock in re.findall(r"\bCLOCK_\w+", path.read_text())]
    assert "CLOCK_MONOTONIC" in clocks and set(clocks) <= {"CLOCK_MONOTONIC", "CLOCK_THREAD_CPUTIME_ID"}
    forbidden = re.compile(r"\b(gettimeofday|time\.time\(|datetime\.now|utcnow)|\btime\(NULL\)")
    sources = [*(ROOT / "csrc").glob("*/*.c"), *(ROOT / "dpmaster").rglob("*.py")]
    users = [path.name for path in sources for _ in forbidden.findall(path.read_text())]
    assert users == ["_core.py"], "wall_clock() alone, which shows times to people"
