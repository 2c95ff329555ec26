# SPDX-License-Identifier: MIT
"""The slaves' side of the wire, one event at a time on virtual time: frame count bit, times, watchdog, noise, set-up.

Pages and rows are the protocol page's.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slave_rig import (
    CHARACTER,
    CHK_CFG,
    DATA_EXCH,
    GLOBAL_CONTROL,
    MAX_TSDR,
    MIN_TSDR,
    MS,
    NEVER,
    OUT,
    POWER_UP,
    SC,
    SET_PRM,
    SET_SLAVE_ADD,
    SLAVE_DIAG,
    WAIT_PRM,
    ZEROS,
    Initiator,
    Rig,
    SlaveConfig,
    octets,
    running,
    telegram,
)

from dpmaster._core import block, ffi, lib

# ---- page C.2: the frame count bit ----


def exchange(fc: int, data: bytes = OUT, sa: int = 2) -> bytes:
    return telegram(8, sa, fc, data)


def test_fcb_first_cycle_is_new_each_time() -> None:
    """Responder 1: "FCV=0, FCB=1: first cycle -> store FCB=1 together with SA; treat as new request"."""
    rig, _ = running()
    for value in (b"\x01" * 6, b"\x02" * 6):
        assert rig.exchange(exchange(0x6D, value))
        assert rig.outputs().octets == value
    rig.exchange(exchange(0x7D, b"\x03" * 6))  # same FCB, now with FCV: a repetition
    assert rig.outputs().octets == b"\x02" * 6


def test_fcb_toggled_is_new_and_the_same_is_a_repetition() -> None:
    """2: "FCB changed: new request"; 3: "FCB unchanged: RETRY -> resend the stored reply, do not execute again"."""
    rig, _ = running()
    rig.exchange(exchange(0x6D, b"\x01" * 6))
    rig.put_inputs(b"\xa1" * 6)
    first = rig.exchange(exchange(0x5D, b"\x02" * 6))
    rig.put_inputs(b"\xa2" * 6)
    exchanges = rig.report().exchanges
    for _ in range(3):
        assert rig.exchange(exchange(0x5D, b"\x99" * 6)) == first == telegram(2, 8, 0x08, b"\xa1" * 6)
    assert rig.outputs().octets == b"\x02" * 6
    assert (rig.report().repetitions, rig.report().exchanges) == (3, exchanges)
    assert rig.exchange(exchange(0x7D, b"\x03" * 6)) == telegram(2, 8, 0x08, b"\xa2" * 6)
    assert rig.outputs().octets == b"\x03" * 6


def test_a_repetition_is_answered_from_the_store_in_every_service() -> None:
    """A repeated Set_Prm is not executed again, not even in another state; FCB belongs to the address, not to the SAP."""
    rig = Rig()
    prm = telegram(8, 2, 0x6D, octets("80 01 01 00 00 CA 00"), SET_PRM)
    cfg = telegram(8, 2, 0x5D, b"\x72", CHK_CFG)
    assert rig.exchange(prm) == SC
    assert rig.exchange(cfg) == SC
    assert rig.exchange(cfg) == SC
    assert rig.exchange(telegram(8, 2, 0x5D, b"", SLAVE_DIAG)) == SC  # by the rule, whatever the SAP
    assert rig.report().state == DATA_EXCH


def test_fcb_of_another_master_is_not_compared() -> None:
    """4: "FCV=1, different SA: no evaluation; take it as new, store SA+FCB"."""
    rig = Rig()
    diag2, diag3 = (telegram(8, sa, 0x7D, b"", SLAVE_DIAG) for sa in (2, 3))
    assert rig.exchange(diag2)[5] == 0x88
    assert rig.exchange(diag3)[4] == 0x83
    rig.diagnosis(b"\x02\x00")
    assert len(rig.exchange(diag3)) == 17  # the repetition of the answer without diagnosis
    assert len(rig.exchange(diag2)) == 19  # new: 3 came in between
    assert rig.report().repetitions == 1


@pytest.mark.parametrize("between", ["10 08 02 49 53 16", "10 08 02 4E 58 16", "10 08 02 4F 59 16"])
def test_fcb_is_not_touched_by_status_requests(between: str) -> None:
    """Initiator 5: "SDN, FDL status, Ident, LSAP: FCB=0, FCV=0, and they do not disturb the stored FCB"."""
    rig, _ = running()
    first = rig.exchange(exchange(0x6D, b"\x01" * 6))
    assert rig.exchange(octets(between)) in (octets("10 02 08 00 0A 16"), octets("10 02 08 03 0D 16"))
    rig.exchange(octets("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16"))
    rig.put_inputs(b"\x55" * 6)
    assert rig.exchange(exchange(0x7D, b"\x02" * 6)) == first
    assert rig.outputs().octets == b"\x01" * 6


def test_srd_without_fcb_is_executed_and_leaves_the_store_alone() -> None:
    """6: "FCV=0, FCB=0: no FCB evaluation"."""
    rig, _ = running()
    first = rig.exchange(exchange(0x6D, b"\x01" * 6))
    rig.put_inputs(b"\x55" * 6)
    for value in (b"\x02" * 6, b"\x03" * 6):
        assert rig.exchange(exchange(0x4D, value)) == telegram(2, 8, 0x08, b"\x55" * 6)
        assert rig.outputs().octets == value
    assert rig.exchange(exchange(0x7D)) == first


def test_fcb_outlives_everything_but_power(rig: Rig, master: Initiator) -> None:
    """A slave that never forgets its FCB is what masters must cope with; only a power cycle forgets."""
    master.start(0x88)  # 6D, 5D
    assert rig.exchange(exchange(0x7D)) == master.data(ZEROS)
    rig.quiet(rig.time + 60_000 * MS)  # the watchdog has run out, the bus was dead for a minute
    lib.dpm_slaves_connect(rig.slaves, 0, False)
    lib.dpm_slaves_connect(rig.slaves, 0, True)
    assert rig.exchange(exchange(0x7D)) == master.data(ZEROS)
    assert rig.report().state == WAIT_PRM
    assert rig.exchange(exchange(0x5D)) == master.rs()
    lib.dpm_slaves_reset(rig.slaves, 0, rig.time)
    assert rig.exchange(telegram(8, 2, 0x5D, b"", SLAVE_DIAG))[9:15] == POWER_UP


# ---- SDA, SDN, Ident ----


def test_sda_is_acknowledged(rig: Rig) -> None:
    assert rig.exchange(telegram(8, 2, 0x65, octets("80 01 01 00 00 CA 00"), SET_PRM)) == SC
    assert rig.exchange(telegram(8, 2, 0x53, b"\x72", CHK_CFG)) == SC
    assert rig.report().state == DATA_EXCH
    for request in (telegram(8, 2, 0x73, b"", SLAVE_DIAG), telegram(8, 2, 0x55, OUT)):
        assert rig.exchange(request) == octets("10 02 08 03 0D 16")
    assert rig.outputs().octets == ZEROS


@pytest.mark.parametrize("fc", [0x44, 0x46])
def test_sdn_is_never_answered(fc: int) -> None:
    rig, _ = running()
    for sap in (None, SLAVE_DIAG, SET_PRM, GLOBAL_CONTROL):
        for da in (8, 127):
            assert rig.exchange(telegram(da, 2, fc, b"\x02\x00", sap)) == b""
    assert rig.report().clear


def test_srd_to_everybody_is_ignored(rig: Rig) -> None:
    assert rig.exchange(telegram(127, 2, 0x6D, b"", SLAVE_DIAG)) == b""
    assert rig.exchange(telegram(127, 2, 0x49)) == b""


@pytest.mark.parametrize("request_", [
    "10 08 02 0D 17 16",  # a response (FC bit 6 = 0): page B.3 rule 5
    "10 08 7E 49 CF 16",  # SA 126 asks nothing: rule 4
    "10 09 02 49 54 16",  # another address
    "10 08 02 41 4B 16",  # reserved function
    "10 08 02 C9 D3 16",  # bit 7 belongs to clock values
    "68 06 06 68 88 02 49 7F 49 9B 16",  # a segment address
    "DC 08 02",
    "E5",
])
def test_what_is_no_request_of_ours_is_not_answered(rig: Rig, request_: str) -> None:
    data = octets(request_)
    assert rig.exchange(data) == b""
    assert rig.report().requests == 0


# ---- the watchdog, page I.3 ----


def test_watchdog_expires_exactly_after_its_time(rig: Rig, master: Initiator) -> None:
    master.start(0x88, (3, 1))  # 30 ms
    master.srd(None, OUT)
    deadline = rig.report().exchange_time + 30 * MS
    assert rig.ask(rig.time).wake == deadline
    rig.quiet(deadline - 1)
    assert (rig.report().state, rig.outputs().valid) == (DATA_EXCH, True)
    assert rig.ask(deadline - 1).wake == deadline
    before = rig.progress
    rig.quiet(deadline)
    report = rig.report()
    assert (report.state, report.master, report.watchdog_on, report.watchdog_expired) == (WAIT_PRM, -1, False, 1)
    outputs = rig.outputs()
    assert (outputs.octets, outputs.valid, outputs.time) == (ZEROS, False, deadline)
    assert rig.progress > before
    assert rig.ask(deadline).wake == NEVER
    assert master.diag() == POWER_UP  # "Prm_Req=1, Not_Ready=1", released


@pytest.mark.parametrize(("late", "alive"), [(0, True), (1, False)])
def test_watchdog_judges_a_request_by_its_own_time(rig: Rig, master: Initiator, late: int, alive: bool) -> None:
    """Octets that lay in a FIFO are judged by when they came, whenever they are reported."""
    master.start(0x88, (3, 1))
    master.srd(None, OUT)
    deadline = rig.report().exchange_time + 30 * MS
    rig.hear(exchange(master.fc(), OUT), deadline + late)
    assert (rig.report().state == DATA_EXCH) is alive
    assert (rig.ask(rig.time).octets != master.rs()) is alive


def test_watchdog_gives_the_benefit_of_doubt(rig: Rig, master: Initiator) -> None:
    """A request that may have come in time did; the next deadline counts from its latest end."""
    master.start(0x88, (3, 1))
    master.srd(None, OUT)
    deadline = rig.report().exchange_time + 30 * MS
    rig.hear(exchange(master.fc(), OUT), deadline, doubt=5 * MS)
    assert rig.report().state == DATA_EXCH
    assert rig.ask(rig.time).wake == deadline + 35 * MS


def test_watchdog_sees_foreign_octets_as_time(rig: Rig, master: Initiator) -> None:
    """A bus that is never quiet proves just as well that nothing came for this slave."""
    master.start(0x88, (3, 1))
    deadline = rig.ask(rig.time).wake
    rig.hear(octets("DC 02 02"), deadline)
    assert rig.report().state == DATA_EXCH
    rig.hear(octets("00"), deadline + 1)
    assert rig.report().state == WAIT_PRM


def test_watchdog_is_not_judged_by_asking(rig: Rig, master: Initiator) -> None:
    """machine.h: "Only quiet() lets a machine judge that something did not come"."""
    master.start(0x88, (3, 1))
    deadline = rig.ask(rig.time).wake
    assert rig.ask(deadline + 1000 * MS).wake == deadline
    assert rig.report().state == DATA_EXCH


@pytest.mark.parametrize(("request_", "feeds"), [
    (lambda m: telegram(8, 2, m.fc(), OUT), True),
    (lambda m: telegram(8, 2, m.fc(), b"", SLAVE_DIAG), True),
    (lambda m: telegram(8, 2, m.fc(), b"", 20), True),
    (lambda m: telegram(8, 2, 0x40 | 0x1D, b"\x72", CHK_CFG), True),  # the repetition of the last Chk_Cfg
    (lambda m: telegram(8, 3, 0x6D, b"", SLAVE_DIAG), False),
    (lambda m: telegram(8, 2, 0x49), False),
    (lambda m: telegram(127, 2, 0x46, b"\x00\x00", GLOBAL_CONTROL), False),
    (lambda m: telegram(9, 2, 0x6D, OUT), False),
])
def test_watchdog_is_fed_by_requests_of_the_own_master(rig: Rig, master: Initiator, request_: Callable[[Initiator], bytes],
                                                       feeds: bool) -> None:
    """Rule: "Retriggered by every correct request of the own master to this slave"; status and Global_Control do not."""
    master.start(0x88, (3, 1))
    before = rig.ask(rig.time).wake
    rig.exchange(request_(master), after=5 * MS)
    assert (rig.ask(rig.time).wake > before) is feeds


def test_watchdog_runs_in_wait_cfg_and_unplugged(rig: Rig, master: Initiator) -> None:
    """Rule: "supervised in WAIT-CFG and DATA-EXCH"; slave.h: unplugged "the watchdog runs"."""
    master.prm(0x88, (2, 2))
    rig.quiet(rig.ask(rig.time).wake)
    assert rig.report().state == WAIT_PRM
    master.start(0x88, (2, 2))
    master.srd(None, OUT)
    lib.dpm_slaves_connect(rig.slaves, 0, False)
    assert rig.report().state == lib.DPM_SL_OFF
    assert rig.exchange(exchange(0x5D)) == b""
    assert rig.exchange(telegram(8, 2, 0x49)) == b""
    assert rig.outputs().valid
    rig.quiet(rig.ask(rig.time).wake)
    assert not rig.outputs().valid
    lib.dpm_slaves_connect(rig.slaves, 0, True)
    assert (rig.report().state, rig.report().watchdog_expired) == (WAIT_PRM, 2)


def test_without_watchdog_the_outputs_stay(rig: Rig, master: Initiator) -> None:
    """Rule: "WD_On=0: outputs stay forever"."""
    master.start(0x80, (0, 0))
    master.srd(None, OUT)
    rig.quiet(rig.time + 3_600_000 * MS)
    assert (rig.outputs().octets, rig.outputs().valid, rig.report().state) == (OUT, True, DATA_EXCH)
    assert rig.ask(rig.time).wake == NEVER


@pytest.mark.parametrize(("user", "largest", "base"), [
    (b"\x04\x00\x00", 3, 1), (b"\x40\x01\x00", 3, 10), (b"\x04", 2, 10), (b"", 3, 10),
])
def test_watchdog_base(user: bytes, largest: int, base: int) -> None:
    """Page G.1: "DPV1_Status_1: bit2 WD_Base_1ms", where there are DPV1 status octets."""
    rig = Rig((SlaveConfig(user_parameters=(0, largest)),))
    Initiator(rig).prm(0x88, (255, 255), user=user)
    assert rig.report().watchdog == 255 * 255 * base * MS
    report = rig.report()
    assert bytes(report.user_parameters[0 : report.user_parameters_length]) == user


# ---- when an answer may leave ----


def test_answer_between_min_and_max_tsdr() -> None:
    rig = Rig(allowance=70_000)
    rig.hear(telegram(8, 2, 0x49), rig.time + MS, doubt=5_000)
    offer = rig.ask(rig.time)
    assert offer.not_before == rig.time + MIN_TSDR  # after its latest end
    assert offer.not_after == rig.time - 5_000 + MAX_TSDR + 70_000  # after its earliest


def test_minima_are_rounded_up_and_maxima_down() -> None:
    rig = Rig(changes={"rate_num": 500_000, "rate_den": 11, "max_tsdr": 250, "tsl": 265})
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    offer = rig.ask(rig.time)
    assert offer.not_before - rig.time == 11 * 22_000
    assert offer.not_after - rig.time == 250 * 22_000
    rig = Rig(changes={"rate_num": 187_500, "max_tsdr": 61, "tsl": 100})
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    offer = rig.ask(rig.time)
    assert offer.not_before - rig.time == 58_667  # 58 666.67
    assert offer.not_after - rig.time == 325_333  # 325 333.33


def test_a_late_host_drops_the_answer_and_counts_it(rig: Rig, master: Initiator) -> None:
    master.start()
    rig.hear(exchange(master.fc()), rig.time + MS)
    latest = rig.time + MAX_TSDR
    assert rig.ask(latest).octets == master.data(ZEROS)
    assert rig.ask(latest + 1).octets == b""
    assert rig.ask(latest - 1).octets == b"", "dropped is dropped"
    assert rig.report().late_dropped == 1
    # The master repeats, and is answered from the store.
    assert rig.exchange(exchange(0x40 | 0x3D if master.fcb else 0x5D)) == master.data(ZEROS)
    assert (rig.report().repetitions, rig.report().exchanges) == (1, 1)


def test_a_new_request_revokes_the_answer(rig: Rig, master: Initiator) -> None:
    master.start()
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    assert rig.ask(rig.time).octets == octets("10 02 08 00 0A 16")
    rig.hear(exchange(master.fc()), rig.time + MIN_TSDR // 2)
    assert rig.ask(rig.time).octets == master.data(ZEROS)
    rig.hear(octets("DC 02 02"), rig.time + MIN_TSDR // 2)  # the bus has gone on without us
    assert rig.ask(rig.time).octets == b""
    assert rig.report().late_dropped == 0


def test_octets_that_may_become_a_request_hold_the_answer_back() -> None:
    rig = Rig(granularity=20_000)
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    request = telegram(8, 2, 0x6D, b"", SLAVE_DIAG)
    rig.hear(request[:4], rig.time + 4 * CHARACTER)
    assert rig.ask(rig.time).octets == b""
    patience = 66_000 + 20_000  # Tsyn at 500 kbit/s, and what the port cannot tell
    assert rig.ask(rig.time).wake == rig.time + patience
    rig.hear(request[4:], rig.time + (len(request) - 4) * CHARACTER)
    assert rig.ask(rig.time).octets[9:15] == POWER_UP
    # Given up, they were noise, and an answer still in time goes out.
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    answered = rig.ask(rig.time)
    rig.hear(b"\x68", rig.time + CHARACTER)
    assert rig.ask(rig.time).octets == b""
    rig.quiet(rig.time + patience)
    assert rig.ask(rig.time) == answered


@pytest.mark.parametrize("noise", [b"\x00", b"\xff", b"\x16", b"\x55\xaa"])
def test_a_glitch_at_turn_round_does_not_cost_the_answer(rig: Rig, noise: bytes) -> None:
    rig.hear(telegram(8, 2, 0x49) + noise, rig.time + MS)
    offer = rig.ask(rig.time)
    assert offer.octets == octets("10 02 08 00 0A 16")
    assert offer.not_before == rig.time - len(noise) * CHARACTER + MIN_TSDR
    assert rig.report().requests == 1


def test_only_an_answer_that_left_whole_counts(rig: Rig) -> None:
    for result in (lib.DPM_SENT_CUT, lib.DPM_SENT_FAILED):
        rig.hear(telegram(8, 2, 0x49), rig.time + MS)
        rig.sent(rig.ask(rig.time), rig.time + MIN_TSDR, result)
        assert rig.ask(rig.time).octets == b""
    assert rig.report().answers == 0
    assert rig.exchange(telegram(8, 2, 0x49))
    assert (rig.report().answers, rig.report().requests) == (1, 3)


def test_echo_of_our_own_is_not_heard(rig: Rig) -> None:
    rig.hear(telegram(8, 2, 0x49), rig.time + MS, echo=True)
    assert rig.ask(rig.time).octets == b""


def test_unplugged_or_reset_takes_its_answer_along(rig: Rig) -> None:
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    lib.dpm_slaves_connect(rig.slaves, 0, False)
    assert rig.ask(rig.time).octets == b""
    lib.dpm_slaves_connect(rig.slaves, 0, True)
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    lib.dpm_slaves_reset(rig.slaves, 0, rig.time)
    assert rig.ask(rig.time).octets == b""


# ---- images, progress, several slaves, set-up ----


def test_short_inputs_are_padded_with_zeros() -> None:
    rig, master = running()
    assert master.srd(None, OUT) == master.data(ZEROS)
    rig.put_inputs(b"\x01\x02")
    assert master.srd(None, OUT) == master.data(b"\x01\x02\x00\x00\x00\x00")


def test_an_idle_application_is_not_woken() -> None:
    """slave.h: a frame is published, and progress grows, only when something changed."""
    rig, master = running()
    master.srd(None, OUT)
    number, progress, exchanges = rig.outputs().number, rig.progress, rig.report().exchanges
    for _ in range(50):
        master.srd(None, OUT)
    master.control(0x00)
    first_operate = rig.progress
    assert first_operate == progress + 1
    master.control(0x00)
    assert (rig.outputs().number, rig.progress, rig.report().exchanges) == (number, first_operate, exchanges + 50)
    master.srd(None, ZEROS)
    assert (rig.outputs().number, rig.progress) == (number + 1, first_operate + 1)


def test_two_slaves_on_one_wire() -> None:
    rig = Rig((SlaveConfig(5), SlaveConfig(6, 0x0ACF, configurations=(b"\xf1",))))
    five, six = Initiator(rig, slave=5), Initiator(rig, slave=6)
    five.start(0x88, (5, 1))
    assert six.prm(ident=0x0ACF) == SC
    assert six.srd(CHK_CFG, b"\xf1") == SC
    rig.put_inputs(b"\x66" * 4, 1)
    assert five.srd(None, OUT) == five.data(ZEROS)
    assert six.srd(None, b"\x01\x02\x03\x04") == six.data(b"\x66" * 4)
    assert (rig.outputs(0).octets, rig.outputs(1).octets) == (OUT, b"\x01\x02\x03\x04")
    five.control(0x02)
    assert (rig.outputs(0).valid, rig.outputs(1).valid) == (False, False), "one broadcast, every slave"
    five.control(0x00)
    six.srd(None, b"\x01\x02\x03\x04")
    rig.quiet(rig.time + 50 * MS)  # only one has a watchdog
    assert (rig.report(0).state, rig.report(1).state, rig.outputs(1).valid) == (WAIT_PRM, DATA_EXCH, True)
    # A request to one revokes the answer of the other.
    rig.hear(telegram(5, 2, 0x49), rig.time + MS)
    rig.hear(telegram(6, 2, 0x49), rig.time + 6 * CHARACTER)
    assert rig.ask(rig.time).octets == telegram(2, 6, 0x00)


def test_a_full_wire() -> None:
    rig = Rig(tuple(SlaveConfig(address) for address in range(126)))
    for address in range(126):
        assert rig.exchange(telegram(address, 125 if address != 125 else 0, 0x49)) != b""
        assert rig.report(address).answers == 1


def test_the_longest_image() -> None:
    cfg = octets("FF" * 7 + "F9")  # 7 * 32 + 20 = 244 octets each way
    rig = Rig((SlaveConfig(configurations=(cfg,)),))
    master = Initiator(rig)
    master.start(configuration=cfg)
    image = bytes(range(244))
    rig.put_inputs(image)
    assert master.srd(None, image[::-1]) == master.data(image)
    assert rig.outputs().octets == image[::-1]


def test_power_cycle() -> None:
    rig, master = running()
    master.prm(0xB8, (9, 9), min_tsdr=40, group=7)
    rig.diagnosis(b"\x02\x00", ext=True, static=True)
    lib.dpm_slaves_reset(rig.slaves, 0, rig.time)
    assert Initiator(rig).diag() == POWER_UP
    report = rig.report()
    assert (report.state, report.master, report.group, report.watchdog_on, report.watchdog) == (WAIT_PRM, -1, 0, False, 0)
    rig.hear(telegram(8, 2, 0x49), rig.time + MS)
    assert rig.ask(rig.time).not_before == rig.time + MIN_TSDR


@pytest.mark.parametrize(("config", "code"), [
    (SlaveConfig(9), "DPM_E_FULL"),
    (SlaveConfig(8), "DPM_E_DUPLICATE"),
    (SlaveConfig(127), "DPM_E_ADDRESS"),
    (SlaveConfig(9, configurations=()), "DPM_E_CONFIGURATION"),
    (SlaveConfig(9, configurations=(b"\x72",) * 17), "DPM_E_CONFIGURATION"),
    (SlaveConfig(9, user_parameters=(4, 3)), "DPM_E_ARGUMENT"),
    (SlaveConfig(9, user_parameters=(0, 238)), "DPM_E_ARGUMENT"),
    (SlaveConfig(9, max_diagnosis=5), "DPM_E_ARGUMENT"),
    (SlaveConfig(9, max_diagnosis=245), "DPM_E_ARGUMENT"),
    (SlaveConfig(9, min_tsdr=10), "DPM_E_ARGUMENT"),
    (SlaveConfig(9, min_tsdr=256), "DPM_E_ARGUMENT"),
    (SlaveConfig(9, min_tsdr=100), "DPM_E_ARGUMENT"),
])
def test_what_add_refuses(rig: Rig, config: SlaveConfig, code: str) -> None:
    assert rig.add(config) == getattr(lib, code)


@pytest.mark.parametrize("configuration", [b"", b"\x41", b"\xff" * 8])
def test_configurations_nobody_can_decode(configuration: bytes) -> None:
    with pytest.raises(ValueError, match="configuration"):
        Rig((SlaveConfig(configurations=(configuration,)),))


def test_what_init_refuses() -> None:
    parameters, traits, out = ffi.new("dpm_parameters *"), ffi.new("dpm_port_traits *"), ffi.new("dpm_slaves **")
    lib.dpm_parameters_default(parameters, 500_000, 0)
    size = lib.dpm_slaves_size(2)
    memory = block(size + 16)
    assert lib.dpm_slaves_init(memory, size - 1, parameters, traits, 2, out) == lib.DPM_E_BLOCK
    assert lib.dpm_slaves_init(memory + 8, size, parameters, traits, 2, out) == lib.DPM_E_BLOCK
    assert lib.dpm_slaves_init(memory, size, parameters, traits, 0, out) == lib.DPM_E_ARGUMENT
    assert lib.dpm_slaves_init(memory, size, parameters, traits, 127, out) == lib.DPM_E_ARGUMENT
    parameters.tsl = 1
    assert lib.dpm_slaves_init(memory, size, parameters, traits, 2, out) == lib.DPM_E_PARAMETER


def test_an_index_that_is_no_slave(rig: Rig) -> None:
    for index in (-1, 1):
        assert lib.dpm_slaves_get(rig.slaves, index, ffi.new("dpm_slave_state_report *")) == lib.DPM_E_ARGUMENT
        assert lib.dpm_slaves_connect(rig.slaves, index, True) == lib.DPM_E_ARGUMENT
        assert lib.dpm_slaves_reset(rig.slaves, index, 0) == lib.DPM_E_ARGUMENT
        assert lib.dpm_slaves_ready(rig.slaves, index, True) == lib.DPM_E_ARGUMENT
        assert lib.dpm_slaves_diagnosis(rig.slaves, index, ffi.NULL, 0, False, False, False) == lib.DPM_E_ARGUMENT


# ---- noise and random masters ----


def holds_a_request(data: bytes) -> bool:
    """A slow decoder of our own: does a telegram that passes every check begin anywhere in `data`?"""
    for i in range(len(data)):
        rest = data[i:]
        if rest[0] == 0x10:
            body, end = rest[1:4], rest[4:6]
        elif rest[0] == 0xA2:
            body, end = rest[1:12], rest[12:14]
        elif rest[0] == 0x68 and len(rest) > 3 and rest[1] == rest[2] and rest[3] == 0x68:
            body, end = rest[4 : 4 + rest[1]], rest[4 + rest[1] : 6 + rest[1]]
        else:
            continue
        if end == bytes([sum(body) & 0xFF, 0x16]):
            return True
    return False


def state_of(rig: Rig) -> tuple[object, ...]:
    report = rig.report()
    return (report.state, report.master, report.configuration, report.clear, report.group, report.requests, report.exchanges,
            rig.progress, rig.outputs())


GOOD = [
    telegram(8, 2, 0x7D, OUT),
    telegram(8, 2, 0x5D, b"", SLAVE_DIAG),
    telegram(8, 2, 0x5D, octets("40 01 01 00 00 CA 00"), SET_PRM),
    telegram(8, 2, 0x7D, b"\x71", CHK_CFG),
    telegram(127, 2, 0x46, b"\x02\x00", GLOBAL_CONTROL),
    telegram(8, 2, 0x49),
]


@settings(max_examples=200)
@given(st.lists(st.binary(min_size=1, max_size=60), max_size=5))
def test_random_octets_change_counters_only(chunks: list[bytes]) -> None:
    rig, master = running()
    master.srd(None, bytes(reversed(OUT)))
    before = state_of(rig)
    for chunk in chunks:
        rig.hear(chunk, rig.time + len(chunk) * CHARACTER)
    rig.quiet(rig.time + MS)
    if not holds_a_request(b"".join(chunks)):
        assert state_of(rig) == before
        assert rig.ask(rig.time).octets == b""


@pytest.mark.parametrize("good", GOOD, ids=lambda good: good.hex(" "))
def test_any_octet_changed_or_lost_is_no_telegram(good: bytes) -> None:
    """Invariant 2 of the design: "a telegram that fails any check changes no state but a counter"."""
    rig, master = running()
    master.srd(None, bytes(reversed(OUT)))
    before = state_of(rig)
    for i in range(len(good)):
        for damaged in (good[:i] + good[i + 1 :], good[:i] + bytes([good[i] ^ 0x04]) + good[i + 1 :]):
            if holds_a_request(damaged):
                continue  # a request with two faults that cancel; none with one flipped bit
            rig.hear(damaged, rig.time + MS)
            rig.quiet(rig.time + MS)
            assert state_of(rig) == before, damaged.hex(" ")
            assert rig.ask(rig.time).octets == b""


WRITTEN = [bytes([value] * 6) for value in range(1, 5)]
STEPS = st.sampled_from([
    "exchange", "repeat", "short", "empty", "prm", "prm wrong", "unlock", "cfg", "cfg wrong", "diag", "clear", "operate",
    "sync", "unsync", "freeze", "other exchange", "other prm", "other address", "pause", "long pause", "reset", "replug",
])
HABITS = ("wrong_length_ue", "prm_keeps_exchange", "foreign_sc", "control_feeds", "cfg_fault_keeps_master",
          "prm_open_takes_user")


class RandomMaster:
    """Every step is a good telegram; what the outputs may be is all that was ever written."""

    def __init__(self, habits: frozenset[str]) -> None:
        self.rig = Rig((SlaveConfig(fail_safe=True, more={"set_address": True, **dict.fromkeys(habits, True)}),))
        self.refusal = SC if "foreign_sc" in habits else telegram(3, 8, 0x03)
        self.own, self.other = Initiator(self.rig), Initiator(self.rig, address=3)
        self.own.start(0xB8, (5, 1))
        self.last = b""

    def step(self, name: str, value: bytes) -> None:
        rig, own = self.rig, self.own
        control = {"clear": 0x02, "operate": 0x00, "sync": 0x20, "unsync": 0x10, "freeze": 0x08}
        data = {"exchange": (None, value), "short": (None, value[:3]), "empty": (None, b""), "cfg": (CHK_CFG, b"\x72"),
                "cfg wrong": (CHK_CFG, b"\x71"), "diag": (SLAVE_DIAG, b"")}
        prm = {"prm": (0xB8, 0x00CA), "prm wrong": (0xB8, 0x00CB), "unlock": (0x40, 0x00CA)}
        if name in control:
            own.control(control[name])
        elif name in data:
            self.last = telegram(8, 2, own.fc(), data[name][1], data[name][0])
            assert rig.exchange(self.last)
        elif name in prm:
            assert own.prm(prm[name][0], (5, 1), ident=prm[name][1])
        elif name == "repeat" and self.last:
            rig.exchange(self.last)
        elif name == "other exchange":
            locked = rig.report().state != WAIT_PRM
            assert self.other.srd(None, b"\xee" * 6) == (self.refusal if locked else self.other.rs())
        elif name == "other prm" and rig.report().state != WAIT_PRM:
            assert self.other.prm() == self.refusal
        elif name == "other address" and rig.report().state != WAIT_PRM:
            assert self.other.srd(SET_SLAVE_ADD, octets("09 00 CA 00")) == SC
        elif name in ("pause", "long pause"):
            rig.quiet(rig.time + (20 if name == "pause" else 60) * MS)
        elif name == "reset":
            lib.dpm_slaves_reset(rig.slaves, 0, rig.time)
        elif name == "replug":
            lib.dpm_slaves_connect(rig.slaves, 0, False)
            lib.dpm_slaves_connect(rig.slaves, 0, True)


@settings(max_examples=150)
@given(st.lists(st.tuples(STEPS, st.sampled_from(WRITTEN)), max_size=40), st.frozensets(st.sampled_from(HABITS)))
def test_outputs_are_what_was_written_or_zeros(steps: list[tuple[str, bytes]], habits: frozenset[str]) -> None:
    """Invariant 1 of the design: "what one commit of the application wrote, or safe"; whatever the slave's habits."""
    random = RandomMaster(habits)
    written = set()
    for name, value in steps:
        if name == "exchange":
            written.add(value)
        random.step(name, value)
        outputs, report = random.rig.outputs(), random.rig.report()
        assert outputs.octets in written if outputs.valid else outputs.octets == ZEROS
        assert not outputs.valid or (report.state == DATA_EXCH and not report.clear)
        if "cfg_fault_keeps_master" not in habits:
            assert (report.state == WAIT_PRM) == (report.master == -1)
        assert report.address == 8
        assert (report.state == DATA_EXCH) == (report.configuration == 0)
        assert (random.rig.ask(random.rig.time).wake == NEVER) == (report.state == WAIT_PRM)
