# SPDX-License-Identifier: MIT
"""A DP slave's services and states: what real masters sent, the state table row by row, diagnosis, Global_Control.

Pages and rows are the protocol page's.
"""

from __future__ import annotations

import pytest
from named_tests import check_named
from slave_rig import (
    CHK_CFG,
    DATA_EXCH,
    GET_CFG,
    GLOBAL_CONTROL,
    MS,
    OUT,
    POWER_UP,
    RD_INP,
    RD_OUTP,
    SC,
    SET_PRM,
    SLAVE_DIAG,
    TBIT,
    WAIT_CFG,
    WAIT_PRM,
    ZEROS,
    Initiator,
    Rig,
    SlaveConfig,
    octets,
    running,
    telegram,
)

from dpmaster._core import lib

# ---- page B.4: what real masters sent and real slaves answered ----


def test_start_of_an_et200s_rows_1_to_13() -> None:
    rig = Rig((SlaveConfig(5, 0x806A, (octets("00 10 20"),), user_parameters=(29, 29)),))
    ext = octets("49" + "00" * 8 + "14 82 00 00" + "00" * 16)
    rig.diagnosis(ext)
    lib.dpm_slaves_ready(rig.slaves, 0, False)
    assert rig.exchange(octets("10 05 02 49 50 16")) == octets("10 02 05 00 07 16")
    assert rig.exchange(octets("68 05 05 68 85 82 6D 3C 3E EE 16")) == octets(
        "68 28 28 68 82 85 08 3E 3C 02 05 00 FF 80 6A 49 00 00 00 00 00 00 00 00 14 82 00 00" + "00" * 16 + "58 16")
    assert rig.exchange(octets("68 29 29 68 85 82 5D 3D 3E B8 1E 01 00 80 6A 01 40 01 00 11 21 00 00 00 00 00 00 00 00 00 00 00"
                               "00 00 00 00 20 01 00 20 08 00 20 08 00 85 16")) == SC
    assert rig.report().watchdog == 300 * MS  # "WD 30*1*10 ms = 300 ms"
    assert rig.exchange(octets("68 08 08 68 85 82 7D 3E 3E 00 10 20 30 16")) == SC
    not_ready = octets("68 28 28 68 82 85 08 3E 3C 02 0C 00 02 80 6A") + ext + octets("62 16")
    assert rig.exchange(octets("68 05 05 68 85 82 5D 3C 3E DE 16")) == not_ready
    lib.dpm_slaves_ready(rig.slaves, 0, True)
    ready = rig.exchange(octets("68 05 05 68 85 82 7D 3C 3E FE 16"))
    assert ready == octets("68 28 28 68 82 85 08 3E 3C 00 0C 00 02 80 6A") + ext + ready[-2:]


def test_start_of_a_minimal_slave_rows_3_4_and_14_to_16() -> None:
    rig = Rig((SlaveConfig(2, 0x0CDA, user_parameters=(3, 3)),))
    assert rig.exchange(octets("10 02 63 49 AE 16")) == octets("10 63 02 00 65 16")
    assert rig.exchange(octets("68 05 05 68 82 E3 6D 3C 3E 4C 16")) == octets(
        "68 0B 0B 68 E3 82 08 3E 3C 02 05 00 FF 0C DA D3 16")
    assert rig.exchange(octets("68 0F 0F 68 82 E3 5D 3D 3E B8 05 01 00 0C DA 01 40 00 00 22 16")) == SC
    assert (rig.report().state, rig.report().master, rig.report().watchdog) == (WAIT_CFG, 0x63, 50 * MS)


def test_start_and_loss_of_a_valve_island_rows_17_to_23() -> None:
    rig = Rig((SlaveConfig(8, 0x0A35, (b"\x21",), user_parameters=(7, 7)),))
    assert rig.exchange(octets("68 05 05 68 88 82 6D 3C 3E F1 16")) == octets(
        "68 0B 0B 68 82 88 08 3E 3C 02 05 00 FF 0A 35 D1 16")
    assert rig.exchange(octets("68 13 13 68 88 82 5D 3D 3E B8 1E 01 00 0A 35 01 00 00 00 82 00 00 00 7B 16")) == SC
    assert rig.exchange(octets("68 06 06 68 88 82 7D 3E 3E 21 24 16")) == SC
    assert rig.exchange(octets("68 05 05 68 88 82 5D 3C 3E E1 16")) == octets(
        "68 0B 0B 68 82 88 08 3E 3C 00 0C 00 02 0A 35 D9 16")
    # Row 23: "it has left DATA-EXCH (likely its 300 ms watchdog ran out)". Rows 45 and 50 are its kinds of answers.
    assert rig.exchange(telegram(8, 2, 0x7D, b"\x12\x34")) == SC
    assert rig.exchange(telegram(8, 2, 0x5D, b"\x12\x34"), after=301 * MS) == octets("10 02 08 03 0D 16")


def test_a_fault_of_the_last_configuration_is_still_shown_rows_24_and_25() -> None:
    rig = Rig((SlaveConfig(10, 0x0F84, user_parameters=(0, 1)),))
    old = Initiator(rig, slave=10)
    assert old.prm(ident=0x0F84) == SC
    assert old.srd(CHK_CFG, b"\x11") == SC
    assert rig.exchange(telegram(10, 2, 0x6D, b"", 60)) == octets("68 0B 0B 68 82 8A 08 3E 3C 06 05 00 FF 0F 84 2B 16")
    assert rig.exchange(octets("68 0C 0C 68 8A 82 5D 3D 3E 80 01 01 00 0F 84 01 FA 16")) == SC
    report = rig.report()
    assert (report.state, report.group, report.watchdog_on) == (WAIT_CFG, 1, False)


def test_start_with_get_cfg_and_stat_diag_rows_26_to_33() -> None:
    rig = Rig((SlaveConfig(8, 0x80E0, (octets("00 10 10"),), user_parameters=(25, 25), min_tsdr=20),))
    assert rig.exchange(octets("68 05 05 68 88 81 6D 3C 3E F0 16")) == octets(
        "68 0B 0B 68 81 88 08 3E 3C 02 05 00 FF 80 E0 F1 16")
    assert rig.exchange(octets("68 05 05 68 88 81 5D 3B 3E DF 16")) == octets("68 08 08 68 81 88 08 3E 3B 00 10 10 AA 16")
    assert rig.exchange(octets("68 25 25 68 88 81 7D 3D 3E B8 0D 0F 0B 80 E0 00 C0 00 00 11 21 00 00 00 00 00 00 01 00 00 00 00"
                               "00 00 00 00 20 01 00 18 18 84 16")) == SC
    assert rig.report().state == WAIT_CFG
    assert rig.report().watchdog == 1950 * MS  # "WD 13*15*10 ms = 1.95 s"
    assert rig.exchange(octets("68 08 08 68 88 81 5D 3E 3E 00 10 10 02 16")) == SC
    ext = octets("49" + "00" * 8 + "14 82 00 00" + "00" * 16)
    rig.diagnosis(ext, static=True)
    first = rig.exchange(octets("68 05 05 68 88 81 7D 3C 3E 00 16"))
    assert first == octets("68 28 28 68 81 88 08 3E 3C 00 0E 00 01 80 E0") + ext + octets("D9 16")
    rig.diagnosis(ext)
    assert rig.exchange(telegram(8, 1, 0x5D, b"", 60))[-2:] == octets("D7 16")
    assert rig.exchange(octets("68 07 07 68 FF 81 46 3A 3E 00 00 3E 16")) == b""
    assert rig.report().operate_seen


# ---- page I.1: the states, a test for each row ----


ROWS = {
    "any (after init) | FDL status request": "test_slave_services.py::test_any_state_answers_status_diag_and_get_cfg",
    "any | Slave_Diag (any master)": "test_slave_services.py::test_any_state_answers_status_diag_and_get_cfg "
                                     "test_slave_services.py::test_diagnosis_flag_until_the_own_master_fetched",
    "any | Get_Cfg (any master)": "test_slave_services.py::test_any_state_answers_status_diag_and_get_cfg "
                                  "test_slave_services.py::test_the_configuration_chosen_is_told_and_sets_the_lengths",
    "POWER-ON | without a valid address": "test_slave_address.py::test_a_slave_at_126_waits_and_does_nothing_else",
    "WAIT-PRM | Set_Slave_Add ok": "test_slave_address.py::test_the_telegram_of_row_56",
    "WAIT-PRM | Set_Prm, Lock=1 Unlock=0, ident ok, prm ok":
        "test_slave_services.py::test_good_set_prm_locks_and_asks_for_chk_cfg",
    "WAIT-PRM | Set_Prm bad ident / bad length / bad user prm":
        "test_slave_services.py::test_bad_set_prm_is_acknowledged_and_refused",
    "WAIT-PRM | Set_Prm Lock=Unlock=0":
        "test_slave_services.py::test_set_prm_without_lock_and_unlock_takes_min_tsdr_only "
        "test_slave_settings.py::test_user_parameters_without_lock_and_unlock",
    "WAIT-PRM | Chk_Cfg, Data_Exchange, RD_Inp, RD_Outp": "test_slave_services.py::test_wait_prm_refuses_what_needs_parameters",
    "WAIT-PRM | Global_Control": "test_slave_services.py::test_wait_prm_refuses_what_needs_parameters",
    "WAIT-CFG | Set_Prm from the same master": "test_slave_services.py::test_set_prm_again_in_wait_cfg",
    "WAIT-CFG | Set_Prm Unlock": "test_slave_services.py::test_unlock_releases",
    "WAIT-CFG | Chk_Cfg from own master, ok": "test_slave_services.py::test_good_chk_cfg_opens_the_exchange "
                                              "test_slave_services.py::test_station_not_ready_until_the_application_is",
    "WAIT-CFG | Chk_Cfg wrong": "test_slave_services.py::test_wrong_chk_cfg "
                                "test_slave_settings.py::test_master_add_after_a_wrong_configuration",
    "WAIT-CFG | Data_Exchange": "test_slave_services.py::test_wait_cfg_refuses_exchange",
    "DATA-EXCH | Data_Exchange from own master, right length": "test_slave_services.py::test_exchange_octets_rows_41_to_43",
    "DATA-EXCH | Data_Exchange, wrong output length":
        "test_slave_services.py::test_wrong_output_length test_slave_settings.py::test_the_answer_to_outputs_of_a_wrong_length",
    "DATA-EXCH | Data_Exchange with 0 octets, slave in Fail_Safe mode":
        "test_slave_services.py::test_empty_exchange_of_a_fail_safe_slave_is_clear",
    "DATA-EXCH | Set_Prm own master, ok; faulty": "test_slave_settings.py::test_set_prm_in_exchange "
                                                  "test_slave_settings.py::test_a_faulty_set_prm_in_exchange_always_leaves",
    "DATA-EXCH | Set_Prm Unlock (own master)": "test_slave_services.py::test_unlock_releases",
    "DATA-EXCH | Chk_Cfg own master, ok / not ok":
        "test_slave_services.py::test_the_configuration_chosen_is_told_and_sets_the_lengths "
        "test_slave_services.py::test_wrong_chk_cfg",
    "WAIT-CFG, DATA-EXCH | watchdog expired": "test_slave.py::test_watchdog_expires_exactly_after_its_time "
                                              "test_slave.py::test_watchdog_runs_in_wait_cfg_and_unplugged",
    "locked | Set_Prm/Chk_Cfg/Data_Exchange from ANOTHER master": "test_slave_settings.py::test_another_master_while_locked",
    "DATA-EXCH | baud lost / bus off": "test_slave_baud.py::test_dp_control_belongs_to_the_watchdog "
                                       "test_slave_baud.py::test_a_rate_lost_without_watchdog_leaves_the_outputs",
    "I.2 DH until the OWN master has fetched": "test_slave_services.py::test_diagnosis_flag_until_the_own_master_fetched",
    "I.2 with Stat_Diag=1 the flag stays on": "test_slave_services.py::test_static_diagnosis_keeps_the_flag",
    "I.2 slave without inputs": "test_slave_settings.py::test_announcing_without_inputs",
    "I.3 supervised in WAIT-CFG and DATA-EXCH": "test_slave.py::test_watchdog_runs_in_wait_cfg_and_unplugged",
    "I.3 retriggered by every correct request of the own master":
        "test_slave.py::test_watchdog_is_fed_by_requests_of_the_own_master",
    "I.3 Global_Control": "test_slave_settings.py::test_global_control_and_the_watchdog",
    "I.3 WD_On=0": "test_slave.py::test_without_watchdog_the_outputs_stay",
    "I.4 Sync": "test_slave_services.py::test_sync",
    "I.4 Freeze": "test_slave_services.py::test_freeze",
    "I.4 only if enabled and if the group matches; leaving cancels":
        "test_slave_services.py::test_sync_and_freeze_must_be_asked_for_and_end_with_the_exchange "
        "test_slave_services.py::test_group_zero_is_everybody_and_others_must_match",
    "I.4 Clear_Data": "test_slave_services.py::test_clear_and_operate "
                      "test_slave_services.py::test_clear_in_sync_reaches_buffer_and_terminals",
    "I.5 Min_Slave_Intervall": "test_slave_baud.py::test_requests_that_come_too_soon_are_counted_and_answered "
                               "test_slave_baud.py::test_our_master_keeps_the_distance",
    "I.6 BAUD_SEARCH": "test_slave_baud.py::test_a_search_hears_only_at_the_wires_rate",
    "I.6 BAUD_CONTROL": "test_slave_baud.py::test_baud_control_is_kept_by_telegrams_to_the_own_address",
    "I.6 DP_CONTROL": "test_slave_baud.py::test_dp_control_belongs_to_the_watchdog",
    "I.6 another master takes over": "test_slave_baud.py::test_without_watchdog_it_is_baud_control_again",
    "I.6 several frames before it answers at all":
        "test_slave_baud.py::test_the_first_good_telegram_is_not_answered_the_next_one_is",
}


def test_every_row_names_a_test() -> None:
    check_named(ROWS)


@pytest.mark.parametrize("state", [WAIT_PRM, WAIT_CFG, DATA_EXCH])
def test_any_state_answers_status_diag_and_get_cfg(rig: Rig, master: Initiator, state: int) -> None:
    """Rules: "any | FDL status request | 10 SA TS 00", "any | Slave_Diag (any master)", "any | Get_Cfg (any master)"."""
    if state >= WAIT_CFG:
        master.prm()
    if state == DATA_EXCH:
        master.srd(CHK_CFG, b"\x72")
    assert rig.report().state == state
    assert rig.exchange(octets("10 08 02 49 53 16")) == octets("10 02 08 00 0A 16")  # B.4 #36
    for address in (2, 77):
        other = Initiator(rig, address=address, function=0x0C)  # SRD low is taken as SRD high is
        assert other.diag()[4:] == octets("00 CA")
        assert other.answer(GET_CFG) == b"\x72"
    assert rig.report().state == state


def test_good_set_prm_locks_and_asks_for_chk_cfg(rig: Rig, master: Initiator) -> None:
    """Rule: "WAIT-PRM | Set_Prm, Lock=1 Unlock=0, ident ok | SC; Master_Add := SA; take WD, min TSDR, group | WAIT-CFG"."""
    assert master.diag() == POWER_UP
    before = rig.progress
    assert master.prm(0xB8, (30, 1), min_tsdr=20, group=5) == SC
    report = rig.report()
    assert (report.state, report.master, report.configuration, report.group) == (WAIT_CFG, 2, -1, 5)
    assert (report.watchdog_on, report.watchdog) == (True, 300 * MS)
    assert master.diag() == octets("02 0C 00 02 00 CA")  # page H.1 "after good Set_Prm 02 04|0C 00 mm"
    assert rig.progress > before


@pytest.mark.parametrize(("what", "prm"), [
    ("bad ident", {"ident": 0x00CB}),
    ("bad length", {"user": b"\x00"}),
    ("factor 0 with WD_On", {"status": 0x88, "watchdog": (0, 7)}),
    ("min Tsdr that max Tsdr forbids", {"min_tsdr": 100}),
])
@pytest.mark.parametrize("state", [WAIT_PRM, WAIT_CFG, DATA_EXCH])
def test_bad_set_prm_is_acknowledged_and_refused(rig: Rig, master: Initiator, state: int, what: str,
                                                 prm: dict[str, object]) -> None:
    """Rule: "WAIT-PRM | Set_Prm bad ident / bad length / bad user prm | SC; Prm_Fault=1, Prm_Req=1"; others too."""
    if state >= WAIT_CFG:
        master.prm()
    if state == DATA_EXCH:
        master.srd(CHK_CFG, b"\x72")
    assert master.prm(**prm) == SC, what  # type: ignore[arg-type]
    assert master.diag() == octets("42 05 00 FF 00 CA")  # page H.1 "bad prm 42 05 00 FF"
    assert rig.report().state == WAIT_PRM
    assert rig.report().master == -1
    assert master.prm() == SC
    assert master.diag() == octets("02 04 00 02 00 CA")


def test_set_prm_shorter_than_its_fixed_part(rig: Rig, master: Initiator) -> None:
    assert master.srd(SET_PRM, octets("80 01 01 00 00 CA")) == SC
    assert master.diag()[0] == 0x42
    assert master.srd(SET_PRM) == SC
    assert master.diag()[0] == 0x42


@pytest.mark.parametrize(("status", "sync", "freeze"), [(0xA0, False, True), (0x90, True, False)])
def test_sync_or_freeze_asked_for_and_not_there(status: int, sync: bool, freeze: bool) -> None:
    """Page G.1 "if it cannot -> Diag.Not_Supported (and Prm_Fault)"."""
    rig = Rig((SlaveConfig(sync=sync, freeze=freeze),))
    master = Initiator(rig)
    assert master.prm(status) == SC
    assert master.diag() == octets("52 05 00 FF 00 CA")
    assert master.prm(status ^ 0x30) == SC
    assert master.diag() == octets("02 04 00 02 00 CA")


@pytest.mark.parametrize("ident", [0x00CA, 0x1234])
@pytest.mark.parametrize("state", [WAIT_PRM, WAIT_CFG, DATA_EXCH])
def test_set_prm_without_lock_and_unlock_takes_min_tsdr_only(rig: Rig, master: Initiator, ident: int, state: int) -> None:
    """Rule: "WAIT-PRM | Set_Prm Lock=Unlock=0 | SC; only min TSDR"; G.1 "accepted even with a foreign ident number"."""
    if state >= WAIT_CFG:
        master.prm(group=3)
    if state == DATA_EXCH:
        master.srd(CHK_CFG, b"\x72")
    assert master.prm(0x08, (9, 9), min_tsdr=30, ident=ident, group=7, user=b"\x00") == SC
    report = rig.report()
    assert (report.state, report.group, report.watchdog_on) == (state, 0 if state == WAIT_PRM else 3, False)
    rig.hear(telegram(8, 2, master.fc(), b"", SLAVE_DIAG), rig.time + MS)
    assert rig.ask(rig.time).not_before == rig.time + 30 * TBIT


def test_the_octets_of_unlock_and_min_tsdr_rows_62_and_63() -> None:
    rig = Rig((SlaveConfig(8, 0x0959),))
    Initiator(rig).prm(ident=0x0959)
    assert rig.exchange(octets("68 0C 0C 68 88 82 5D 3D 3E 40 01 01 00 09 59 00 86 16")) == SC
    assert rig.report().state == WAIT_PRM
    assert rig.exchange(octets("68 0C 0C 68 88 82 7D 3D 3E 00 00 00 1E 00 00 00 20 16")) == SC
    rig.hear(octets("10 08 02 49 53 16"), rig.time + MS)
    assert rig.ask(rig.time).not_before == rig.time + 30 * TBIT


def test_wait_prm_refuses_what_needs_parameters(rig: Rig, master: Initiator) -> None:
    """Rule: "WAIT-PRM | Chk_Cfg, Data_Exchange, RD_Inp, RD_Outp | RS (SD1 FC 03)", "WAIT-PRM | Global_Control | ignore"."""
    for sap, data in ((CHK_CFG, b"\x72"), (None, OUT), (RD_INP, b""), (RD_OUTP, b"")):
        assert master.srd(sap, data) == master.rs()
    master.control(0)
    assert (rig.report().state, rig.report().operate_seen) == (WAIT_PRM, False)


def test_wait_cfg_refuses_exchange(rig: Rig, master: Initiator) -> None:
    """Rule: "WAIT-CFG | Data_Exchange | RS"."""
    master.prm()
    for sap, data in ((None, OUT), (RD_INP, b""), (RD_OUTP, b"")):
        assert master.srd(sap, data) == master.rs()
    assert rig.report().state == WAIT_CFG
    assert rig.outputs().number == 0


@pytest.mark.parametrize("status", [0x40, 0xC0])
@pytest.mark.parametrize("state", [WAIT_CFG, DATA_EXCH])
def test_unlock_releases(rig: Rig, master: Initiator, status: int, state: int) -> None:
    """Rule: "WAIT-CFG | Set_Prm Unlock | SC; release, Master_Add := FF | WAIT-PRM", the same in DATA-EXCH; "Unlock wins"."""
    master.prm()
    if state == DATA_EXCH:
        master.srd(CHK_CFG, b"\x72")
        master.srd(None, OUT)
        assert rig.outputs().octets == OUT
    assert master.prm(status) == SC
    assert master.diag() == POWER_UP
    assert rig.report().state == WAIT_PRM
    if state == DATA_EXCH:
        assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)


def test_set_prm_again_in_wait_cfg(rig: Rig, master: Initiator) -> None:
    """Rule: "WAIT-CFG | Set_Prm from the same master | evaluate again | WAIT-CFG / WAIT-PRM when faulty"."""
    master.prm(group=1)
    assert master.prm(group=2) == SC
    assert (rig.report().state, rig.report().group) == (WAIT_CFG, 2)
    assert master.prm(ident=1) == SC
    assert rig.report().state == WAIT_PRM


def test_good_chk_cfg_opens_the_exchange(rig: Rig, master: Initiator) -> None:
    """Rule: "WAIT-CFG | Chk_Cfg from own master, ok | SC; Cfg_Fault=0 | DATA-EXCH"; D.D. 72 is 6 octets each way."""
    master.start()
    assert (rig.report().state, rig.report().configuration) == (DATA_EXCH, 0)
    assert master.diag() == octets("00 04 00 02 00 CA")
    rig.put_inputs(octets("11 12 13 14 15 16"))
    assert master.srd(None, OUT) == master.data(octets("11 12 13 14 15 16"))
    outputs = rig.outputs()
    assert (outputs.octets, outputs.valid) == (OUT, True)


def test_station_not_ready_until_the_application_is(rig: Rig, master: Initiator) -> None:
    """Rule: "Station_Not_Ready=0 as soon as the application delivers data"; lost again, the flag tells the master."""
    lib.dpm_slaves_ready(rig.slaves, 0, False)
    master.start()
    assert master.diag() == octets("02 04 00 02 00 CA")
    lib.dpm_slaves_ready(rig.slaves, 0, True)
    assert master.diag() == octets("00 04 00 02 00 CA")
    lib.dpm_slaves_ready(rig.slaves, 0, False)
    assert master.srd(None, OUT) == master.data(ZEROS, 0x0A)
    assert master.diag() == octets("02 04 00 02 00 CA")
    assert master.srd(None, OUT) == master.data(ZEROS)


@pytest.mark.parametrize("wrong", [b"", b"\x71", b"\x72\x72", b"\x73"])
@pytest.mark.parametrize("state", [WAIT_CFG, DATA_EXCH])
def test_wrong_chk_cfg(rig: Rig, master: Initiator, wrong: bytes, state: int) -> None:
    """Rule: "WAIT-CFG | Chk_Cfg wrong | SC; Cfg_Fault=1, Prm_Req=1"; "DATA-EXCH | Chk_Cfg not ok | WAIT-PRM"."""
    master.prm()
    if state == DATA_EXCH:
        master.srd(CHK_CFG, b"\x72")
        master.srd(None, OUT)
    assert master.srd(CHK_CFG, wrong) == SC
    assert master.diag() == octets("06 05 00 FF 00 CA")
    assert not rig.outputs().valid
    master.start()
    assert master.diag() == octets("00 04 00 02 00 CA")


def test_the_configuration_chosen_is_told_and_sets_the_lengths() -> None:
    rig = Rig((SlaveConfig(configurations=(b"\x72", octets("5F 6F"), octets("55 65"))),))
    master = Initiator(rig)
    assert master.answer(GET_CFG) == b"\x72"
    master.start(configuration=octets("55 65"))
    assert rig.report().configuration == 2
    assert master.answer(GET_CFG) == octets("55 65")
    assert master.srd(None, bytes(range(12))) == master.data(bytes(12))
    # Chk_Cfg again, in DATA-EXCH: the same changes nothing, another one makes the outputs safe in their new length.
    before = rig.outputs()
    assert master.srd(CHK_CFG, octets("55 65")) == SC
    assert rig.outputs() == before
    assert master.srd(CHK_CFG, b"\x72") == SC
    assert (rig.report().state, rig.report().configuration) == (DATA_EXCH, 0)
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)
    assert master.srd(None, OUT) == master.data(ZEROS)


@pytest.mark.parametrize("data", [b"", OUT[:5], OUT + b"\x00", bytes(244)])
def test_wrong_output_length(rig: Rig, master: Initiator, data: bytes) -> None:
    """Rule: "DATA-EXCH | Data_Exchange, wrong output length | RS and leave | WAIT-PRM"."""
    master.start()
    master.srd(None, OUT)
    assert master.srd(None, data) == master.rs()
    assert rig.report().state == WAIT_PRM
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)
    assert master.diag() == POWER_UP


def test_empty_exchange_of_a_fail_safe_slave_is_clear() -> None:
    """Rule: "DATA-EXCH | Data_Exchange with 0 octets, slave in Fail_Safe mode | outputs -> fail-safe values; reply inputs"."""
    rig, master = running(fail_safe=True)
    master.srd(None, OUT)
    assert master.srd(None) == master.data(ZEROS)
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)
    assert (rig.report().state, rig.report().clear) == (DATA_EXCH, True)
    master.srd(None, OUT)
    assert (rig.outputs().octets, rig.outputs().valid, rig.report().clear) == (OUT, True, False)


@pytest.mark.parametrize("state", [WAIT_CFG, DATA_EXCH])
def test_another_master_is_refused(rig: Rig, master: Initiator, state: int) -> None:
    """Rule: "locked | Set_Prm/Chk_Cfg/Data_Exchange from ANOTHER master | not executed: RS"."""
    master.prm(group=1)
    if state == DATA_EXCH:
        master.srd(CHK_CFG, b"\x72")
        master.srd(None, OUT)
    other = Initiator(rig, address=3)
    assert other.prm(group=2) == other.rs()
    assert other.prm(0x40) == other.rs()
    assert other.prm(0x00, min_tsdr=50) == other.rs()
    assert other.srd(SET_PRM) == other.rs()
    assert other.srd(CHK_CFG, b"\x00") == other.rs()
    assert other.srd(None, bytes(6)) == other.rs()
    assert other.srd(None, b"") == other.rs()
    other.control(0x02)
    assert other.diag()[3] == 2
    report = rig.report()
    assert (report.state, report.master, report.group, report.clear) == (state, 2, 1, False)
    if state == DATA_EXCH:
        assert rig.outputs().octets == OUT
        assert other.answer(RD_OUTP) == OUT


def test_closed_saps_and_foreign_sources_are_refused(rig: Rig, master: Initiator) -> None:
    """Page F.1 "SAP not active or the source is not allowed: SD1 with FC RS"; Set_Slave_Add is not supported."""
    master.start()
    for sap in [*range(55), 55, 58, 63]:
        assert master.srd(sap) == master.rs(), sap
    assert master.srd(55, octets("09 00 CA 00")) == master.rs()
    for ssap in (0, 54, 61, 63):
        assert rig.exchange(telegram(8, 2, master.fc(), b"", SLAVE_DIAG, ssap)) == master.rs()
    assert rig.report().state == DATA_EXCH


def test_rd_inp_and_rd_outp_rows_57_and_58() -> None:
    rig = Rig((SlaveConfig(configurations=(b"\x33",)),))
    master = Initiator(rig)
    master.start(configuration=b"\x33")
    rig.put_inputs(octets("02 37 00 00"))
    master.srd(None, octets("04 7F 00 00"))
    assert rig.exchange(octets("68 05 05 68 88 82 5D 38 3E DD 16")) == octets("68 09 09 68 82 88 08 3E 38 02 37 00 00 C1 16")
    assert rig.exchange(octets("68 05 05 68 88 82 7D 39 3E FE 16")) == octets("68 09 09 68 82 88 08 3E 39 04 7F 00 00 0C 16")


def test_exchange_octets_rows_41_to_43() -> None:
    rig = Rig((SlaveConfig(configurations=(b"\x33",)),))
    master = Initiator(rig)
    master.start(configuration=b"\x33")
    master.diag()
    rig.put_inputs(octets("02 37 00 00"))
    assert master.fcb
    assert rig.exchange(octets("68 07 07 68 08 02 5D 04 7F 00 00 EA 16")) == octets("68 07 07 68 02 08 08 02 37 00 00 4B 16")
    rig.diagnosis(b"\x02\xaa", announce=True)
    assert rig.exchange(telegram(8, 2, 0x7D, octets("04 7F 00 00"))) == octets("68 07 07 68 02 08 0A 02 37 00 00 4D 16")


def test_eight_output_octets_as_sd3_and_sd2_rows_46_and_47() -> None:
    rig = Rig((SlaveConfig(configurations=(b"\x27",)),))
    master = Initiator(rig)
    master.start(configuration=b"\x27")
    master.diag()
    assert rig.exchange(octets("A2 08 02 5D 01 02 03 04 05 06 07 08 8B 16")) == SC
    assert rig.outputs().octets == octets("01 02 03 04 05 06 07 08")
    assert master.prm() == SC  # 7D
    assert master.srd(CHK_CFG, b"\x27") == SC
    master.diag()
    rig.exchange(octets("68 0B 0B 68 08 02 5D 01 02 03 04 05 06 07 08 8B 16"))
    assert (rig.outputs().octets, rig.outputs().valid) == (octets("01 02 03 04 05 06 07 08"), True)


# ---- diagnosis ----


def test_diagnosis_flag_until_the_own_master_fetched(rig: Rig, master: Initiator) -> None:
    """Page I.2: "every Data_Exchange reply is then sent with FC DH until the OWN master has fetched Slave_Diag"."""
    master.start()
    rig.diagnosis(octets("05 81 00 00 01"), announce=True, ext=True)
    assert master.srd(None, OUT) == master.data(ZEROS, 0x0A)
    other = Initiator(rig, address=3)
    assert other.diag() == octets("08 04 00 02 00 CA 05 81 00 00 01")
    assert master.srd(None, OUT) == master.data(ZEROS, 0x0A)
    assert master.diag() == octets("08 04 00 02 00 CA 05 81 00 00 01")
    assert master.srd(None, OUT) == master.data(ZEROS)


def test_static_diagnosis_keeps_the_flag(rig: Rig, master: Initiator) -> None:
    """Rule: "With Stat_Diag=1 the flag stays on after the fetch"."""
    master.start()
    rig.diagnosis(b"", static=True)
    assert master.diag() == octets("00 06 00 02 00 CA")
    assert master.srd(None, OUT) == master.data(ZEROS, 0x0A)
    rig.diagnosis(b"")
    assert master.srd(None, OUT) == master.data(ZEROS)


def test_output_only_slave_announces_by_sd1(rig: Rig) -> None:
    """Rule: "emulator: send 10 MA TS 0A"; B.4 #45 "E5: reply of an output-only slave"."""
    rig = Rig((SlaveConfig(configurations=(b"\x21",)),))
    master = Initiator(rig)
    master.start(configuration=b"\x21")
    assert master.srd(None, b"\x01\x02") == SC
    rig.diagnosis(b"", announce=True)
    assert master.srd(None, b"\x01\x02") == octets("10 02 08 0A 14 16")
    master.diag()
    assert master.srd(None, b"\x01\x02") == SC
    assert master.srd(RD_INP) == octets("10 02 08 09 13 16")  # NR, B.4 #50


def test_input_only_slave_row_44() -> None:
    rig = Rig((SlaveConfig(configurations=(b"\x11",)),))
    master = Initiator(rig)
    master.start(configuration=b"\x11")
    rig.put_inputs(b"\x31\x32\x33")  # longer than configured: the first octets
    master.diag()
    master.diag()
    assert master.fcb is False
    assert rig.exchange(octets("10 08 02 7D 87 16")) == telegram(2, 8, 0x08, b"\x31\x32")
    assert (rig.outputs().octets, rig.outputs().valid) == (b"", True)


def test_diagnosis_that_does_not_fit_is_cut_and_says_so() -> None:
    """Page H.1: "Ext_Diag_Overflow (more diagnosis than fits; set by slave)"."""
    rig = Rig((SlaveConfig(max_diagnosis=8),))
    master = Initiator(rig)
    rig.diagnosis(b"\x02\x01")
    assert master.diag() == POWER_UP + b"\x02\x01"
    rig.diagnosis(b"\x03\x01\x02")
    assert master.diag() == octets("02 05 80 FF 00 CA 03 01")
    rig.diagnosis(b"")
    assert master.diag() == POWER_UP


def test_the_longest_diagnosis() -> None:
    rig = Rig()
    rig.diagnosis(bytes(range(238)))
    assert Initiator(rig).diag() == POWER_UP + bytes(range(238))


# ---- Global_Control, pages F.2 and I.4 ----


def test_clear_and_operate() -> None:
    rig, master = running()
    master.srd(None, OUT)
    assert not rig.report().operate_seen, "outputs are applied before an Operate, as an ASIC does"
    assert rig.outputs().valid
    master.control(0x02)
    assert (rig.outputs().octets, rig.outputs().valid, rig.report().clear) == (ZEROS, False, True)
    master.srd(None, OUT)
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)
    master.control(0x00)
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)
    assert (rig.report().clear, rig.report().operate_seen) == (False, True)
    master.srd(None, OUT)
    assert (rig.outputs().octets, rig.outputs().valid) == (OUT, True)


def test_group_zero_is_everybody_and_others_must_match() -> None:
    rig = Rig()
    master = Initiator(rig)
    master.start(group=0x05)
    for group, acts in ((0x02, False), (0xFA, False), (0x04, True), (0xFF, True), (0x00, True)):
        master.srd(None, OUT)
        master.control(0x02, group)
        assert rig.report().clear is acts, group
        master.control(0x00, 0x00)
    master.control(0x02, 0, da=8)  # to this slave alone
    assert rig.report().clear


@pytest.mark.parametrize("command", [0x03, 0x42, 0x82])
def test_reserved_bits_make_a_command_void(command: int) -> None:
    rig, master = running()
    master.control(command)
    assert not rig.report().clear


@pytest.mark.parametrize("data", [b"", b"\x02", b"\x02\x00\x00"])
def test_control_of_another_length_is_void(data: bytes) -> None:
    rig, _ = running()
    rig.exchange(telegram(127, 2, 0x46, data, GLOBAL_CONTROL))
    assert not rig.report().clear


def test_sync() -> None:
    """Rule: "outputs are frozen while Data_Exchange continues to fill the buffer; each further Sync transfers once"."""
    rig = Rig()
    master = Initiator(rig)
    master.start(0xA0)
    master.srd(None, b"\x01" * 6)
    master.control(0x20)
    assert master.diag()[1] == 0x24
    for value in (2, 3):
        master.srd(None, bytes([value]) * 6)
    assert rig.outputs().octets == b"\x01" * 6
    assert master.answer(RD_OUTP) == b"\x01" * 6
    master.control(0x20)
    assert rig.outputs().octets == b"\x03" * 6
    master.srd(None, b"\x04" * 6)
    master.control(0x30)  # "Unsync over Sync when both are set"
    assert rig.outputs().octets == b"\x04" * 6
    assert master.diag()[1] == 0x04
    master.srd(None, b"\x05" * 6)
    assert rig.outputs().octets == b"\x05" * 6


def test_clear_in_sync_reaches_buffer_and_terminals() -> None:
    rig = Rig()
    master = Initiator(rig)
    master.start(0xA0)
    master.srd(None, b"\x01" * 6)
    master.control(0x20)
    master.srd(None, b"\x02" * 6)
    master.control(0x02)
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)
    master.control(0x20)
    assert (rig.outputs().octets, rig.outputs().valid) == (ZEROS, False)


def test_freeze() -> None:
    """Rule: "inputs are sampled at the command and frozen; each Freeze re-samples; Unfreeze returns to normal"."""
    rig = Rig()
    master = Initiator(rig)
    master.start(0x90)
    rig.put_inputs(b"\x01" * 6)
    master.control(0x08)
    rig.put_inputs(b"\x02" * 3)
    assert master.srd(None, OUT) == master.data(b"\x01" * 6)
    assert master.answer(RD_INP) == b"\x01" * 6
    assert master.diag()[1] == 0x14
    master.control(0x08)
    assert master.srd(None, OUT) == master.data(b"\x02" * 3 + bytes(3))
    rig.put_inputs(b"\x03" * 6)
    master.control(0x0C)  # "Unfreeze wins over Freeze"
    assert master.srd(None, OUT) == master.data(b"\x03" * 6)


def test_sync_and_freeze_must_be_asked_for_and_end_with_the_exchange() -> None:
    _, master = running()
    master.control(0x28)
    assert master.diag()[1] == 0x04
    master.start(0xB0)
    master.control(0x28)
    assert master.diag()[1] == 0x34
    master.start(0xB0)  # "Leaving DATA-EXCH cancels sync and freeze"
    assert master.diag()[1] == 0x04
