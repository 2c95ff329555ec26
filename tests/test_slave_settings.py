# SPDX-License-Identifier: MIT
"""What the protocol page marks as disputed (D) about slaves: each is a field of `dpm_slave_config`, shown here both ways,
and our master comes through with either.

Pages and rows are the protocol page's.
"""

from __future__ import annotations

import pytest
from simulation import Simulation
from slave_rig import (
    CHK_CFG,
    DATA_EXCH,
    MS,
    OUT,
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
from wire import Master, S, Slaves, default_parameters

from dpmaster._core import ffi, lib

UE = octets("10 02 08 01 0B 16")  # B.4 #48
RS = octets("10 02 08 03 0D 16")  # B.4 #23
SD1_DH = octets("10 02 08 0A 14 16")


@pytest.mark.parametrize(("ue", "answer"), [(False, RS), (True, UE)])
def test_the_answer_to_outputs_of_a_wrong_length(ue: bool, answer: bytes) -> None:
    """Page I.1 "Data_Exchange, wrong output length | RS (or UE) and leave | exact reply code D"."""
    rig, master = running({"wrong_length_ue": ue})
    master.srd(None, OUT)
    assert master.srd(None, OUT[:5]) == answer
    assert (rig.report().state, rig.outputs().valid) == (WAIT_PRM, False)


@pytest.mark.parametrize("keeps", [False, True])
def test_set_prm_in_exchange(keeps: bool) -> None:
    """Page I.1 "DATA-EXCH | Set_Prm own master, ok | DATA-EXCH if nothing relevant changed per some stacks, WAIT-CFG per
    others D"."""
    rig, master = running({"prm_keeps_exchange": keeps}, user_parameters=(0, 2))
    master.srd(None, OUT)
    assert master.prm(0x88, (7, 1), min_tsdr=40, group=6) == SC
    report = rig.report()
    assert (report.watchdog, report.group, report.master) == (70 * MS, 6, 2)
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    assert rig.ask(rig.time).not_before == rig.time + 40 * TBIT
    if keeps:
        assert (report.state, rig.outputs().octets, rig.outputs().valid) == (DATA_EXCH, OUT, True)
        assert master.srd(None, OUT) == master.data(ZEROS)
        rig.quiet(rig.time + 70 * MS)
        assert rig.report().watchdog_expired == 1, "what was taken over counts"
    else:
        assert (report.state, rig.outputs().valid) == (WAIT_CFG, False)
        assert master.srd(None, OUT) == master.rs()


@pytest.mark.parametrize(("status", "user"), [(0x80, b"\x01"), (0xA0, b""), (0x90, b"")])
def test_what_is_relevant_asks_for_a_new_chk_cfg(status: int, user: bytes) -> None:
    """User parameters, Sync_Req or Freeze_Req changed."""
    rig, master = running({"prm_keeps_exchange": True}, user_parameters=(0, 2))
    assert master.prm(status, user=user) == SC
    assert rig.report().state == WAIT_CFG


@pytest.mark.parametrize("keeps", [False, True])
def test_a_faulty_set_prm_in_exchange_always_leaves(keeps: bool) -> None:
    """The same row: "faulty -> WAIT-PRM"."""
    rig, master = running({"prm_keeps_exchange": keeps})
    assert master.prm(ident=0x1234) == SC
    assert rig.report().state == WAIT_PRM


@pytest.mark.parametrize(("sc", "answer"), [(False, octets("10 03 08 03 0E 16")), (True, SC)])
@pytest.mark.parametrize("state", [WAIT_CFG, DATA_EXCH])
def test_another_master_while_locked(sc: bool, answer: bytes, state: int) -> None:
    """Page I.1 "locked | Set_Prm/Chk_Cfg/Data_Exchange from ANOTHER master | not executed: RS or SC+ignore D"."""
    rig = Rig((SlaveConfig(more={"foreign_sc": sc}),))
    own, other = Initiator(rig), Initiator(rig, address=3)
    own.prm(group=1)
    if state == DATA_EXCH:
        own.srd(CHK_CFG, b"\x72")
        own.srd(None, OUT)
    assert other.prm(group=2) == answer
    assert other.prm(0x40) == answer
    assert other.srd(SET_PRM) == answer
    assert other.srd(CHK_CFG, b"\x00") == answer
    assert other.srd(None, bytes(6)) == answer
    report = rig.report()
    assert (report.state, report.master, report.group) == (state, 2, 1)
    assert other.diag()[:1] == (b"\x00" if state == DATA_EXCH else b"\x02"), "no fault of the other's is shown"
    if state == DATA_EXCH:
        assert rig.outputs().octets == OUT


@pytest.mark.parametrize(("announce", "answer"), [
    (lib.DPM_ANNOUNCE_SD1, SD1_DH), (lib.DPM_ANNOUNCE_OCTET, telegram(2, 8, 0x0A, b"\x00")), (lib.DPM_ANNOUNCE_NEVER, SC),
])
@pytest.mark.parametrize("static", [False, True])
def test_announcing_without_inputs(announce: int, answer: bytes, static: bool) -> None:
    """Page I.2 "Slave without inputs: SD1 frame FC 0A, a dummy data octet with DH, or only Stat_Diag/next start-up D"."""
    rig, master = running({"announce": announce}, configurations=(b"\x21",))
    assert master.srd(None, b"\x01\x02") == SC
    rig.diagnosis(b"\x02\x01", announce=True, static=static)
    assert master.srd(None, b"\x03\x04") == answer
    assert rig.outputs().octets == b"\x03\x04", "the outputs are taken all the same"
    assert master.diag()[6:] == b"\x02\x01"
    assert master.srd(None, b"\x03\x04") == (answer if static else SC)


@pytest.mark.parametrize("announce", [lib.DPM_ANNOUNCE_SD1, lib.DPM_ANNOUNCE_OCTET, lib.DPM_ANNOUNCE_NEVER])
def test_with_inputs_the_flag_is_always_in_their_telegram(announce: int) -> None:
    rig, master = running({"announce": announce})
    rig.diagnosis(b"", announce=True)
    assert master.srd(None, OUT) == master.data(ZEROS, 0x0A)


@pytest.mark.parametrize("feeds", [False, True])
@pytest.mark.parametrize("da", [8, 127])
def test_global_control_and_the_watchdog(feeds: bool, da: int) -> None:
    """Page I.3 "Whether Global_Control broadcasts retrigger: D (assume NO)"."""
    rig = Rig((SlaveConfig(more={"control_feeds": feeds}),))
    master = Initiator(rig)
    master.start(0x88, (3, 1))
    Initiator(rig, address=3).control(0x00)
    before = rig.ask(rig.time).wake
    master.control(0x00, da=da)
    assert (rig.ask(rig.time).wake > before) is feeds
    before = rig.ask(rig.time).wake
    Initiator(rig, address=3).control(0x00, da=da)
    assert rig.ask(rig.time).wake == before, "another master's never"


def test_ident_is_answered_or_refused() -> None:
    """Page C.1 "14 (E) Request Ident | reply expected: yes"; a DP slave need not have it. Octets by hand: four lengths, then
    vendor, controller, hardware and software release."""
    who = octets("04 04 02 04") + b"ACME" + b"SPC3" + b"V1" + b"V2.0"
    body = octets("02 08 08") + who
    answer = bytes([0x68, len(body), len(body), 0x68]) + body + bytes([sum(body) & 0xFF, 0x16])
    for more, expected in ({}, RS), ({"identity_length": len(who), "identity": who}, answer):
        rig = Rig((SlaveConfig(more=more),))
        assert rig.exchange(octets("10 08 02 4E 58 16")) == expected  # B.4 #40
        assert rig.exchange(octets("10 08 02 4F 59 16")) == RS, "LSAP status: only reserved in the newest standard"


@pytest.mark.parametrize(("keeps", "master_add"), [(False, 0xFF), (True, 0x02)])
def test_master_add_after_a_wrong_configuration(keeps: bool, master_add: int) -> None:
    """Page H.1 "bad cfg 06 05 (+Prm_Req, master FF or mm depending on device D)"; B.4 #24 and #65."""
    rig = Rig((SlaveConfig(more={"cfg_fault_keeps_master": keeps}),))
    master = Initiator(rig)
    master.prm(0x88, (3, 1))
    assert master.srd(CHK_CFG, b"\x71") == SC
    assert master.diag() == octets("06 05 00") + bytes([master_add]) + octets("00 CA")
    assert (rig.report().state, rig.report().watchdog_on) == (WAIT_PRM, False)
    other = Initiator(rig, address=3)
    assert other.srd(None, OUT) == other.rs()
    assert other.prm() == SC, "it is free either way"
    assert rig.report().master == 3


@pytest.mark.parametrize("takes", [False, True])
def test_user_parameters_without_lock_and_unlock(takes: bool) -> None:
    """Page G.1 "Detail D: all other parameters remain unchanged for 00; min TSDR + slave parameters may be overwritten"."""
    rig, master = running({"prm_open_takes_user": takes}, user_parameters=(0, 2))
    master.srd(None, OUT)
    progress = rig.progress
    assert master.prm(0x08, (9, 9), group=7, user=b"\x11\x22") == SC
    assert master.prm(0x00, user=b"\x11\x22\x33") == SC, "too long: neither taken nor a fault"
    report = rig.report()
    assert bytes(report.user_parameters[0 : report.user_parameters_length]) == (b"\x11\x22" if takes else b"")
    assert (report.state, report.group, report.watchdog_on, rig.progress - progress) == (DATA_EXCH, 0, False, int(takes))


SETTINGS = [
    {}, {"wrong_length_ue": True}, {"prm_keeps_exchange": True}, {"foreign_sc": True}, {"control_feeds": True},
    {"announce": lib.DPM_ANNOUNCE_OCTET}, {"announce": lib.DPM_ANNOUNCE_NEVER}, {"cfg_fault_keeps_master": True},
    {"prm_open_takes_user": True},
]


# What the pages leave to a master: fields of `dpm_slave_set`, and of `dpm_master_config`.
OUR_SETS: list[dict[str, int]] = [
    {}, {"any_ident": True}, {"diagnosis_poll": 5 * MS}, {"ready_timeout": 20 * MS}, {"hold": True}, {"fail_safe": True},
    {"station_status": 0x30, "min_tsdr": 0},
]
OUR_CONFIGS: list[dict[str, int]] = [{"data_retries": 0}, {"auto_clear": True}, {"control_interval": 2 * MS}]
OURS = [(settings, {}) for settings in OUR_SETS] + [({}, options) for options in OUR_CONFIGS]

RIGHT = b"\x72", b"\x21", b"\x11"  # in and out, out, in
WRONG = b"\xf2", b"\xa1", b"\x91"  # as long, with another consistency


class Meeting:
    """A master with settings and three slaves with theirs, one for each of RIGHT."""

    def __init__(self, theirs: dict[str, int], ours: tuple[dict[str, int], dict[str, int]]) -> None:
        self.ours, options = ours
        parameters = default_parameters(500_000)
        self.master = Master(parameters=parameters, **options)
        self.slaves = Slaves(parameters=parameters)
        for address, right, wrong in zip((8, 9, 10), RIGHT, WRONG, strict=True):
            self.slaves.add(address, 0x00CA, right, fail_safe="fail_safe" in self.ours, **theirs)
            self.master.add(address, 0x00CA, wrong, watchdog=(100, 1), **self.ours)
        self.wire = Simulation(parameters, self.master, self.slaves)
        self.master.mode(lib.DPM_MODE_CLEAR)

    def take_back_the_wrong(self) -> None:
        for index, right in enumerate(RIGHT):
            settings = ffi.new("dpm_slave_set *", {
                "address": 8 + index, "ident_number": 0x00CA, "configuration": right, "configuration_length": 1,
                "wd_fact_1": 100, "wd_fact_2": 1, "min_tsdr": 11} | self.ours)
            assert lib.dpm_master_change(self.master.master, index, settings) == 0

    def run(self, duration: int) -> None:
        self.wire.run(duration)
        self.wire.check()

    def check_exchange(self) -> None:
        """All three, with commits of now."""
        before = [self.slaves.report(i).exchanges for i in range(3)]
        sent = [self.master.commit(i, bytes([0x40 + i]), self.wire.now) for i in range(2)]
        self.run(20 * MS)
        for i in range(3):
            report = self.slaves.report(i)
            assert (self.master.slave(i).state, report.state) == (lib.DPM_ST_DATA, DATA_EXCH)
            assert report.exchanges > before[i] + 5 and report.watchdog_expired == 0
        for i, number in enumerate(sent):
            assert self.master.was_sent(i, number) == 1
            assert self.slaves.outputs(i).octets[0] == 0x40 + i and self.slaves.outputs(i).valid


@pytest.mark.parametrize("ours", OURS, ids=lambda ours: " ".join(ours[0] | ours[1]) or "default")
@pytest.mark.parametrize("theirs", SETTINGS, ids=lambda settings: " ".join(settings) or "ours")
def test_every_setting_of_the_slave_meets_every_setting_of_the_master(theirs: dict[str, int], ours: tuple[dict[str, int], ...]):
    """A wrong configuration, start-up, announced diagnosis, New_Prm, a slave that was switched off and on, leaving."""
    meeting = Meeting(theirs, ours)
    master, slaves = meeting.master, meeting.slaves
    meeting.run(50 * MS)
    assert [master.slave(i).reason for i in range(3)] == [lib.DPM_WHY_CFG_FAULT] * 3
    meeting.take_back_the_wrong()
    meeting.run(200 * MS)
    master.mode(lib.DPM_MODE_OPERATE, meeting.wire.now)
    meeting.check_exchange()

    for i in range(3):
        assert lib.dpm_slaves_diagnosis(slaves.slaves, i, b"\x02\x01", 2, True, True, False) == 0
    meeting.run(20 * MS)
    found = [bytes(status.diagnosis[6 : status.diagnosis_length]) for status in map(master.slave, range(3))]
    told = theirs.get("announce") != lib.DPM_ANNOUNCE_NEVER or "diagnosis_poll" in meeting.ours
    assert found == [b"\x02\x01", b"\x02\x01" if told else b"", b"\x02\x01"]
    meeting.check_exchange()

    for i in range(3):
        lib.dpm_master_new_prm(master.master, i, meeting.wire.now)
    meeting.run(20 * MS)
    meeting.check_exchange()
    assert [master.slave(i).statistics.losses for i in range(3)] == [0, 0, 0]

    lib.dpm_slaves_reset(slaves.slaves, 0, meeting.wire.now)
    meeting.run(40 * MS)
    assert master.slave(0).statistics.losses == 1
    meeting.check_exchange()

    master.mode(lib.DPM_MODE_STOP, meeting.wire.now)
    meeting.run(20 * MS)
    assert [slaves.report(i).state for i in range(3)] == [WAIT_PRM] * 3
    assert master.status.mode == lib.DPM_MODE_STOP


@pytest.mark.parametrize("theirs", SETTINGS, ids=lambda settings: " ".join(settings) or "ours")
def test_a_slave_of_another_real_master_is_let_alone_and_taken_when_it_is_free(theirs: dict[str, int]) -> None:
    """Whatever a locked slave answers: the second master reports whose it is, and disturbs nothing."""
    parameters = default_parameters(500_000)
    own, other = masters = [Master(parameters=parameters, address=address, role=lib.DPM_ROLE_RING) for address in (1, 2)]
    slaves = Slaves(parameters=parameters)
    slaves.add(8, 0x00CA, RIGHT[0], **theirs)
    wire = Simulation(parameters, *masters, slaves)
    for master in masters:
        master.add(8, 0x00CA, RIGHT[0], watchdog=(100, 1))
        master.mode(lib.DPM_MODE_OPERATE)
    wire.run(2 * S)
    if other.slave(0).state == lib.DPM_ST_DATA:
        own, other = other, own
    for _ in range(3):
        locked = other.slave(0)
        assert (locked.state, locked.reason, locked.detail) == (lib.DPM_ST_DIAG1, lib.DPM_WHY_LOCKED, slaves.report(0).master)
        by_hand = [other.request(8, 0x0D, b"\x80\x01\x01\x0b\x00\xca\x00", 61, 62),  # Set_Prm all the same
                   other.request(8, 0x0D, RIGHT[0], 62, 62), other.request(8, 0x0D, bytes(6))]
        wire.run(20 * MS)
        assert all(request.done for request in by_hand)
        assert (own.slave(0).state, own.slave(0).statistics.losses) == (lib.DPM_ST_DATA, 0)
        own.mode(lib.DPM_MODE_STOP, wire.now)
        wire.run(1500 * MS)  # who was refused looks again after 1.28 s at the latest
        own.mode(lib.DPM_MODE_OPERATE, wire.now)
        wire.run(20 * MS)
        own, other = other, own
    wire.check()


def test_slave_diag_shows_whoever_asks_the_same() -> None:
    """No setting changes what is not disputed: page I.1 "any | Slave_Diag (any master)"."""
    for settings in SETTINGS:
        rig, _ = running(settings)
        assert rig.exchange(telegram(8, 77, 0x6D, b"", SLAVE_DIAG))[9:15] == octets("00 04 00 02 00 CA")
