# SPDX-License-Identifier: MIT
"""The DP master class 1, one event at a time: start-up as an S7 does it, the way back from every state, outputs that are safe.

Golden octets: captures of protocol page B.4, in dp_bus.py.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
from dp_bus import (
    CHK_CFG,
    CLEAR,
    DIAG_REQUEST,
    FREE,
    OPERATE,
    READY,
    RS,
    SC,
    SET_PRM,
    Bus,
    diagnosis,
    frame,
    lose,
    restart,
)
from wire import MS, Master, Offer, S, Script, Slaves, Wire, default_parameters, feed, lib, octets

# --- start-up -------------------------------------------------------------------------------------------------------


def test_start_up_is_the_s7s_octet_for_octet():
    """Order and octets of a real master for the same slave parameters: Global_Control Clear, then rows 17 to 22."""
    bus = Bus()
    script = bus.script
    assert script.next() == CLEAR
    assert script.next() == DIAG_REQUEST
    script.answer(FREE)
    assert script.next() == SET_PRM
    script.answer(SC)
    assert script.next() == CHK_CFG
    script.answer(SC)
    assert script.next() == octets("68 05 05 68 88 82 5D 3C 3E E1 16")  # 21
    script.answer(READY)
    assert script.next() == frame(0x7D, b"\0\0", da=8, sa=2)  # zeros in Clear
    script.answer(SC)
    assert bus.state == lib.DPM_ST_DATA
    bus.master.mode(lib.DPM_MODE_OPERATE, script.now)
    assert script.next() == OPERATE


def test_states_and_events_on_the_way():
    bus = Bus()
    bus.start()
    states = [(e.b, e.a) for e in bus.master.events() if e.kind == lib.DPM_EV_STATE]
    assert states == [(lib.DPM_ST_OFFLINE, lib.DPM_ST_PRM), (lib.DPM_ST_PRM, lib.DPM_ST_CFG),
                      (lib.DPM_ST_CFG, lib.DPM_ST_DIAG2), (lib.DPM_ST_DIAG2, lib.DPM_ST_DATA)]


def test_set_prm_without_watchdog_and_user_parameters():
    """B.4 #25 (Lake Shore 240, address 10, ident 0F84): Lock only, factors 01 01, one user octet 01."""
    master = Master(500_000, address=2)
    master.add(10, 0x0F84, b"\x21", b"\x01", min_tsdr=0)
    master.mode(lib.DPM_MODE_CLEAR)
    script = Script(master)
    script.next()
    assert script.next()[4] == 0x8A
    script.answer("68 0B 0B 68 82 8A 08 3E 3C 06 05 00 FF 0F 84 2B 16")  # 24: an old Cfg_Fault does not count
    assert script.next() == octets("68 0C 0C 68 8A 82 5D 3D 3E 80 01 01 00 0F 84 01 FA 16".replace("0F 84 01", "0F 84 00")
                                   .replace("68 0C 0C", "68 0D 0D").replace("00 FA 16", "00 01 FA 16"))


@pytest.mark.parametrize("answer, reason, detail", [
    (diagnosis(0x02, 0x05, 0, 0xFF, 0x00, 0xCA), "IDENT", 0x00CA),
    (diagnosis(0x00, 0x0C, 0, 0x07, 0x0A, 0x35), "LOCKED", 7),
])
def test_a_wrong_device_or_anothers_slave_is_never_parameterised(answer, reason, detail):
    """peers.md: "ident never compared"; lock by another master: whose."""
    bus = Bus()
    for _ in range(6):
        assert bus.next()[7] == 0x3C, "Slave_Diag and nothing else"
        bus.script.answer(answer)
    assert bus.slave.reason == getattr(lib, f"DPM_WHY_{reason}") and bus.slave.detail == detail
    assert bool(bus.slave.diagnosis[0] & 0x80) == (reason == "LOCKED"), "Master_Lock is the master's own bit"
    faults = [e for e in bus.master.events() if e.kind == lib.DPM_EV_FAULT]
    assert len(faults) == 1, "told once, not with every try"
    bus.next()
    bus.script.answer(FREE)
    assert bus.next()[7] == 0x3D, "free again"


@pytest.mark.parametrize("status, reason", [
    ((0x42, 0x05, 0, 0xFF, 0x0A, 0x35), "PRM_FAULT"),  # B.4 #64
    ((0x06, 0x05, 0, 0x02, 0x0A, 0x35), "CFG_FAULT"),  # B.4 #65
    ((0x52, 0x05, 0, 0xFF, 0x0A, 0x35), "NOT_SUPPORTED"),
    ((0x02, 0x05, 0, 0xFF, 0x0A, 0x35), "PRM_REQ"),
    ((0x00, 0x0C, 0, 0x05, 0x0A, 0x35), "LOCKED"),
])
def test_a_refusal_is_named_and_tried_again_with_growing_pauses(status, reason):
    """peers.md: "bad parameters loop for ever"."""
    bus = Bus()
    times = []
    for _ in range(11):
        while bus.next()[7] == 0x3C and bus.state != lib.DPM_ST_DIAG2:
            bus.script.answer(FREE)
        times.append(bus.script.now)
        assert bus.script.last.octets[7] == 0x3D
        bus.script.answer(SC)
        assert bus.next()[7] == 0x3E
        bus.script.answer(SC)
        assert bus.next()[7] == 0x3C
        bus.script.answer(diagnosis(*status))
        assert bus.slave.reason == getattr(lib, f"DPM_WHY_{reason}")
        assert bus.state == lib.DPM_ST_DIAG1
    pauses = [b - a for a, b in pairwise(times)]
    assert pauses == sorted(pauses) and pauses[-1] > 1 * S and pauses[0] < 20 * MS


@pytest.mark.parametrize("status, reason", [((0x02, 0x0C, 0, 2, 0x0A, 0x35), "NOT_READY"),
                                            ((0x00, 0x0E, 0, 2, 0x0A, 0x35), "STATIC_DIAG")])  # B.4 #11, #32
def test_a_slave_that_is_not_ready_is_asked_until_it_is(status, reason):
    """"A slave may need seconds between Chk_Cfg and ready"; Stat_Diag kept for several diagnoses (traces)."""
    bus = Bus()
    for answer in (FREE, SC, SC):
        bus.next()
        bus.script.answer(answer)
    for _ in range(50):
        assert bus.next()[7] == 0x3C
        bus.script.answer(diagnosis(*status))
        assert bus.state == lib.DPM_ST_DIAG2 and bus.slave.reason == getattr(lib, f"DPM_WHY_{reason}")
    bus.next()
    bus.script.answer(READY)
    assert bus.next()[4] == 8


def test_a_prm_fault_shown_in_one_diagnosis_only_is_still_a_refusal():
    """A soft slave shows Prm_Fault once and a clean diagnosis afterwards (traces/README)."""
    bus = Bus()
    for answer in (FREE, SC, SC):
        bus.next()
        bus.script.answer(answer)
    bus.next()
    bus.script.answer(diagnosis(0x42, 0x05, 0, 0xFF, 0x0A, 0x35))
    assert bus.slave.reason == lib.DPM_WHY_PRM_FAULT
    bus.next()
    bus.script.answer(FREE)
    assert bus.slave.reason == lib.DPM_WHY_PRM_FAULT, "the reason stays until it is in Data_Exchange"
    assert bus.next()[7] == 0x3D


def test_silence_instead_of_sc_names_the_step():
    """A soft slave answers a Set_Prm that it refuses with silence (traces/README)."""
    bus = Bus()
    bus.next()
    bus.script.answer(FREE)
    assert bus.next()[7] == 0x3D
    assert bus.next()[7] == 0x3D, "repeated once"
    assert bus.next()[6] == 0x6D, "first contact again"
    assert bus.slave.reason == lib.DPM_WHY_NO_ANSWER and bus.slave.detail == lib.DPM_ST_PRM
    assert bus.slave.diagnosis[0] & 0x01, "Station_Non_Existent is the master's own bit"


def test_the_always_one_bit_may_be_missing():
    """traces/README: "the always-1 bit missing"."""
    bus = Bus()
    for answer in (diagnosis(0x02, 0x01, 0, 0xFF, 0x0A, 0x35), SC, SC, diagnosis(0, 0x08, 0, 2, 0x0A, 0x35)):
        bus.next()
        bus.script.answer(answer)
    assert bus.state == lib.DPM_ST_DATA


@pytest.mark.parametrize("code", [1, 2, 3])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_rs_ue_rr_at_each_step_lead_back_to_slave_diag(code, step):
    """RS before Set_Prm, and anywhere else; "RS from a slave ends the program" (peers.md)."""
    bus = Bus()
    for answer in (FREE, SC, SC)[:step]:
        bus.next()
        bus.script.answer(answer)
    bus.next()
    bus.script.answer(bytes([0x10, 2, 8, code, 10 + code, 0x16]))
    assert bus.state == lib.DPM_ST_DIAG1
    assert (bus.slave.reason, bus.slave.detail) == (lib.DPM_WHY_SERVICE, code)
    assert bus.next()[7] == 0x3C


def test_the_diagnosis_behind_an_rs_names_the_reason():
    """A slave that dislikes its parameters refuses Chk_Cfg with RS; only Slave_Diag says why."""
    bus = Bus()
    for answer in (FREE, SC, RS):
        bus.next()
        bus.script.answer(answer)
    assert bus.slave.reason == lib.DPM_WHY_SERVICE
    bus.next()
    bus.script.answer(diagnosis(0x42, 0x05, 0, 0xFF, 0x0A, 0x35))
    assert bus.slave.reason == lib.DPM_WHY_PRM_FAULT
    assert [e.a for e in bus.master.events() if e.kind == lib.DPM_EV_FAULT] == [lib.DPM_WHY_SERVICE, lib.DPM_WHY_PRM_FAULT]
    assert bus.next()[7] == 0x3D


@pytest.mark.parametrize("tsdr", [6, 11, 60, 90])
def test_answers_from_6_to_90_bits_after_the_request(tsdr):
    """traces/README, last demand."""
    bus = Bus()
    for answer in (FREE, SC, SC, READY, SC):
        bus.next()
        bus.script.answer(answer, tsdr=tsdr)
    assert bus.state == lib.DPM_ST_DATA
    for _ in range(20):
        bus.next()
        bus.script.answer(SC, tsdr=tsdr)
    assert bus.slave.statistics.repetitions == 0
    assert bus.slave.statistics.tsdr_max == pytest.approx(tsdr * 2000, abs=10)


def test_an_sc_acknowledges_nobody_else():
    """peers.md: "Any SC acknowledges every slave: with 2 slaves one never gets its Chk_Cfg". Behind every answer comes an SC
    that is nobody's, just when the next request would have gone out."""
    master = Master(500_000, address=2)
    for address in (8, 9):
        master.add(address, 0x0A35, b"\x21")
    master.mode(lib.DPM_MODE_CLEAR)
    script = Script(master)
    seen: dict[int, list[int]] = {8: [], 9: []}
    while min(map(len, seen.values())) < 5:
        telegram = script.next()
        address = telegram[4] & 0x7F
        if address == 0x7F:
            continue
        sap = telegram[7] if telegram[4] & 0x80 else 0
        seen[address].append(sap)
        ready = 62 in seen[address]
        script.answer(diagnosis(*((0, 0x0C, 0, 2) if ready else (2, 5, 0, 255)), 0x0A, 0x35, sa=address) if sap == 60 else SC)
        while not (offer := Offer(script.machine, script.now)).octets:
            script.silence(max(offer.wake - script.now, 1))
        script.answer(SC)
    assert [saps[:5] for saps in seen.values()] == [[60, 61, 62, 60, 0]] * 2


# --- Data_Exchange -------------------------------------------------------------------------------------------------


def test_outputs_of_one_commit_and_inputs_of_one_telegram():
    """B.4 #41/#42: four octets out, four in."""
    bus = Bus(configuration="F1")
    bus.start(octets("68 07 07 68 02 08 08 00 00 00 00 12 16"))
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    number = bus.master.commit(0, octets("04 7F 00 00"), bus.script.now)
    assert bus.master.was_sent(0, number) == 0
    telegram = bus.next()
    assert telegram[7:11] == octets("04 7F 00 00")
    bus.script.answer("68 07 07 68 02 08 08 02 37 00 00 4B 16")  # 42
    assert bus.master.was_sent(0, number) == 1
    inputs = bus.master.inputs(0)
    assert bytes(inputs.octets[0:4]) == octets("02 37 00 00") and inputs.valid and inputs.time == bus.script.now


def test_an_output_only_slave_takes_every_telegram():
    """peers.md: "FCB does not toggle when Data_Exchange is answered by SC: an output-only slave takes the first of 380"."""
    bus = Bus()
    bus.start()
    assert [bus.exchange()[6] for _ in range(6)] == [0x5D, 0x7D] * 3


def test_an_input_only_slave_is_asked_with_sd1():
    """peers.md: "sensors (no outputs) refused". B.4 #44 is the request."""
    bus = Bus(configuration="11")
    bus.start(frame(0x08, b"\x12\x34"))
    bus.script.now += 1
    telegrams = {bus.exchange(frame(0x08, b"\x12\x34")) for _ in range(2)}
    assert octets("10 08 02 7D 87 16") in telegrams
    assert bytes(bus.master.inputs(0).octets[0:2]) == b"\x12\x34"


def test_eight_octets_go_out_as_sd2():
    """peers.md: "8 octets go out as SD3; slaves without SD3 are never reached". B.4 #47."""
    bus = Bus(configuration="27")
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, bytes(range(1, 9)), bus.script.now)
    assert bus.exchange() == octets("68 0B 0B 68 08 02 5D 01 02 03 04 05 06 07 08 8B 16")


def test_a_retry_carries_the_old_outputs_and_the_new_ones_follow():
    """peers.md: "A retry has the same FCB and NEW data: those outputs are lost"."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    first = bus.master.commit(0, b"\x11\x11", bus.script.now)
    tried = bus.next()
    second = bus.master.commit(0, b"\x22\x22", bus.script.now)
    assert bus.next() == tried
    bus.script.answer(SC)
    assert (bus.master.was_sent(0, first), bus.master.was_sent(0, second)) == (1, 0)
    assert bus.exchange()[7:9] == b"\x22\x22"
    assert bus.master.was_sent(0, second) == 1


def test_dh_means_fetch_the_diagnosis_next_and_the_data_count():
    """traces: "the next request to that slave is Slave_Diag, then the exchange goes on; the data in the DH answer count"."""
    bus = Bus(configuration="F1")
    bus.start(frame(0x08, bytes(4)))
    bus.exchange(octets("68 07 07 68 02 08 0A 02 37 00 00 4D 16"))  # 43
    assert bytes(bus.master.inputs(0).octets[0:4]) == octets("02 37 00 00")
    assert bus.next()[7] == 0x3C
    bus.script.answer(diagnosis(0x08, 0x0C, 0, 2, 0x0A, 0x35, extended=octets("42 01")))
    assert bus.state == lib.DPM_ST_DATA and bytes(bus.slave.diagnosis[0:8]) == octets("08 0C 00 02 0A 35 42 01")
    assert bus.next()[4] == 8, "the exchange goes on"


def test_an_output_only_slave_announces_diagnosis_without_data():
    """Protocol page I.2: SD1 with FC 0A, or a dummy octet; accept all."""
    for answer in (octets("10 02 08 0A 14 16"), frame(0x0A, b"\0")):
        bus = Bus()
        bus.start()
        bus.exchange(answer)
        assert bus.next()[7] == 0x3C


def test_an_empty_sd2_is_an_answer_without_data():
    """traces/README: "empty SD2 answers (LE = 3)"."""
    bus = Bus()
    bus.start()
    bus.exchange(octets("68 03 03 68 02 08 08 12 16"))
    assert bus.state == lib.DPM_ST_DATA and bus.slave.statistics.exchanges == 2


def test_static_diagnosis_in_data_exchange_is_read_until_it_is_gone():
    bus = Bus()
    bus.start()
    bus.exchange(octets("10 02 08 0A 14 16"))
    for _ in range(4):
        assert bus.next()[7] == 0x3C
        bus.script.answer(diagnosis(0x00, 0x0E, 0, 2, 0x0A, 0x35))
    assert bus.next()[7] == 0x3C
    bus.script.answer(READY)
    assert bus.next()[4] == 8


@pytest.mark.parametrize("answer", [
    frame(0x08, b"\1\2\3"), frame(0x08, b"\1\2\3\4\5"), SC, octets("10 02 08 09 13 16"),
    frame(0x0C, b"\1\2\3\4"), frame(0x0D, b"\1\2\3\4"),
    frame(0x08, b"\1\2\3\4", saps=b"\x3e\x3c"),
], ids=["short", "long", "SC", "NR", "RDL", "RDH", "with SAPs"])
def test_an_answer_that_does_not_fit_is_invalid_and_changes_no_input(answer):
    """traces/README: "an answer of another length or with SAPs to a Data_Exchange"; J.2: Invalid_Slave_Response."""
    bus = Bus(configuration="F1")
    bus.start(frame(0x08, b"\xAA\xBB\xCC\xDD"))
    bus.exchange(answer)
    assert bus.state == lib.DPM_ST_DIAG1 and bus.slave.reason == lib.DPM_WHY_INVALID_ANSWER
    assert bus.slave.diagnosis[0] & 0x20 and bus.slave.statistics.invalid == 1
    inputs = bus.master.inputs(0)
    assert bytes(inputs.octets[0:4]) == b"\xAA\xBB\xCC\xDD" and not inputs.valid


@pytest.mark.parametrize("status", [(0x02, 0x05, 0, 0xFF), (0x42, 0x05, 0, 0xFF), (0x06, 0x05, 0, 2), (0x00, 0x0C, 0, 9)])
def test_a_diagnosis_that_wants_parameters_ends_the_exchange(status):
    bus = Bus()
    bus.start()
    bus.exchange(octets("10 02 08 0A 14 16"))
    bus.next()
    bus.script.answer(diagnosis(*status, 0x0A, 0x35))
    assert bus.state == lib.DPM_ST_DIAG1 and bus.slave.statistics.losses == 1


# --- loss and return ------------------------------------------------------------------------------------------------


def test_a_lost_station_starts_over_with_a_new_fcb():
    """peers.md: "FCB not reset when a slave was lost: a livelock for ever with a slave that keeps its FCB"."""
    bus = Bus()
    bus.start()
    lose(bus)
    assert (bus.slave.reason, bus.slave.detail) == (lib.DPM_WHY_NO_ANSWER, lib.DPM_ST_DATA)
    assert restart(bus)[4] == 8
    assert bus.state == lib.DPM_ST_DATA and bus.slave.statistics.starts == 2


def test_it_comes_back_with_safe_outputs_and_only_a_new_commit_reaches_it():
    """Design, invariant 4."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    sent = bus.master.commit(0, b"\x11\x11", bus.script.now)
    assert bus.exchange()[7:9] == b"\x11\x11"
    unanswered = bus.master.commit(0, b"\x44\x44", bus.script.now)
    lose(bus)
    assert [bus.master.was_sent(0, number) for number in (sent, unanswered)] == [1, lib.DPM_E_DISCARDED], "known at once"
    away = bus.master.commit(0, b"\x22\x22", bus.script.now)
    assert restart(bus)[7:9] == b"\0\0"
    assert bus.exchange()[7:9] == b"\0\0"
    assert bus.master.was_sent(0, away) == lib.DPM_E_DISCARDED
    new = bus.master.commit(0, b"\x33", bus.script.now, offset=1)
    assert bus.exchange()[7:9] == b"\0\x33", "what was written before the loss is not in it"
    assert bus.master.was_sent(0, new) == 1


def test_hold_keeps_the_outputs_of_a_bare_station():
    bus = Bus(slave={"hold": True})
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    lose(bus)
    assert restart(bus)[7:9] == b"\x11\x11"


def test_rs_in_data_exchange_leads_to_slave_diag_at_once():
    """"A slave that says RS is asked for Slave_Diag with toggling FCB" (traces)."""
    bus = Bus()
    bus.start()
    toggled = bus.exchange(RS)[6] ^ 0x20
    telegram = bus.next()
    assert telegram[6:8] == bytes([toggled, 0x3C])


def test_an_absent_station_is_tried_rarely_once_others_exchange():
    """peers.md: "One absent slave of two at 19.2 kbit/s: 55 exchanges/s fall to 2.7; four absent: 2000 fall to 482"."""
    bus = Bus()
    for address in (20, 21, 22, 23):
        bus.master.add(address, 0x0A35, b"\x21")
    tries = exchanges = 0
    begin = 0
    for _ in range(20000):
        telegram = bus.next()
        if telegram[4] & 0x7F >= 20:
            tries += 1
            continue
        if telegram[4] == 8:
            begin = begin or bus.script.now
            exchanges += 1
        bus.script.answer((FREE if bus.state != lib.DPM_ST_DIAG2 else READY) if telegram[7] == 60 and telegram[4] != 8 else SC)
        if bus.script.now > 2 * S:
            break
    alone = (11 * (11 + 1) + 11 + 37 + 33 + 37 + 37) * 2  # us: request, SC, Tsdr, Tid1, token, Tid1
    assert exchanges > 0.93 * (bus.script.now - begin) / 1000 / alone
    assert tries > 50, "but each of them is tried"


def test_what_the_host_is_away_is_no_cost_of_a_try():
    """A suspended computer would leave it untried for twenty times as long."""
    bus = Bus()
    bus.start()
    bus.master.add(20, 0x0A35, b"\x21")

    def tried() -> int:
        while bus.next()[4] & 0x7F != 20:
            bus.script.answer(SC)
        return bus.script.last.start

    tried()
    bus.script.silence(10 * S)
    back = bus.script.now
    assert tried() - back < 100 * MS


@pytest.mark.parametrize("deaf", [0x3D, 0x3E, None])
def test_a_station_deaf_to_one_service_does_not_slow_the_others(deaf):
    """"Silence instead of SC" (traces/README), for ever: Set_Prm, Chk_Cfg, Data_Exchange; with a host's allowance."""
    bus = Bus(allowance=10 * MS)
    bus.master.add(20, 0x0A35, b"\x21")
    unanswered = 0
    while bus.script.now < 4 * S:
        telegram = bus.next()
        address, sap = telegram[4] & 0x7F, telegram[7] if telegram[4] & 0x80 else None
        if address == 20 and sap == deaf:
            unanswered += 1
            continue
        state = bus.master.slave(0 if address == 8 else 1).state
        ready = (0, 4, 0, 2, 0x0A, 0x35) if state == lib.DPM_ST_DIAG2 else (2, 5, 0, 0xFF, 0x0A, 0x35)
        bus.script.answer(diagnosis(*ready, sa=address) if sap == 0x3C else SC)
    assert 6 < unanswered < 30
    assert bus.slave.statistics.exchanges > 4000


def test_min_slave_interval_is_kept():
    """GSD Min_Slave_Intervall, unit 100 us: between two requests to the same slave, start-up included."""
    bus = Bus(slave={"min_slave_interval": 20})
    last = -2 * MS
    for _ in range(40):
        telegram = bus.next()
        assert bus.script.last.start - last >= 2 * MS
        last = bus.script.last.start
        diag = telegram[4] == 0x88 and telegram[7] == 60
        bus.script.answer((READY if bus.state == lib.DPM_ST_DIAG2 else FREE) if diag else SC)
    assert bus.slave.statistics.exchanges > 30


def test_a_fixed_cycle_keeps_its_raster():
    bus = Bus(cycle_time=10 * MS, control_interval=10 * S)
    bus.start()
    bus.exchange()  # Global_Control goes before it: the mode is told to who joined
    starts = []
    for _ in range(50):
        bus.exchange()
        starts.append(bus.script.last.start)
    assert {round((b - a) / MS, 3) for a, b in pairwise(starts)} == {10.0}


@pytest.mark.parametrize("cycle_time", [0, 10 * MS])
def test_a_pause_is_no_cycle(cycle_time):
    """Stop, or the bus lost: the time until the next cycle was none that anybody was exchanged with in."""
    bus = Bus(mode=lib.DPM_MODE_OPERATE, cycle_time=cycle_time)
    bus.start()
    bus.exchange()
    longest = bus.master.status.cycle_max
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    bus.next()
    bus.script.answer(SC)
    assert bus.next(limit=3 * S) == b""
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.start()
    bus.exchange()
    assert longest <= bus.master.status.cycle_max < 20 * MS


# --- modes, Global_Control, watchdog ---------------------------------------------------------------------------------


def test_global_control_is_repeated_and_told_to_a_station_that_joined():
    bus = Bus(control_interval=50 * MS)
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    times = []
    while len(times) < 6:
        telegram = bus.script.next()
        if telegram == OPERATE:
            times.append(bus.script.last.start)
        elif telegram != CLEAR:
            bus.script.answer(SC)
    assert all(50 * MS <= b - a <= 52 * MS for a, b in pairwise(times[1:]))
    lose(bus)
    restart(bus)
    while (telegram := bus.script.next()) != OPERATE:
        bus.script.answer(SC)
    assert bus.script.last.start - times[-1] < 40 * MS, "not only at the next repetition"


def test_clear_sends_zeros_and_a_fail_safe_slave_nothing():
    """Protocol page J.1."""
    for fail_safe, expected in ((False, b"\0\0"), (True, b"")):
        bus = Bus(slave={"fail_safe": fail_safe})
        bus.start()
        bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
        bus.master.commit(0, b"\x11\x11", bus.script.now)
        assert bus.exchange()[7:9] == b"\x11\x11"
        bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
        bus.exchange()
        telegram = bus.exchange()
        assert telegram[7:-2] == expected if expected else telegram[0] == 0x10


def test_what_was_written_before_leaving_operate_is_never_sent_again():
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.exchange()
    assert bus.exchange()[7:9] == b"\0\0"


@pytest.mark.parametrize("mode", [lib.DPM_MODE_CLEAR, lib.DPM_MODE_STOP, lib.DPM_MODE_OFFLINE])
def test_a_repetition_does_not_outlive_operate(mode):
    """Neither the repetition of a telegram under way carries what was written before leaving Operate."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    assert bus.next()[7:9] == b"\x11\x11"
    bus.master.mode(mode, bus.script.now)
    telegram = bus.next()
    assert telegram[7:9] == (b"\0\0" if mode == lib.DPM_MODE_CLEAR else b"\x3d\x3e")
    assert telegram[6] == 0x6D, "whether the slave took it is unknown: first contact again"
    assert mode != lib.DPM_MODE_CLEAR or bus.state == lib.DPM_ST_DATA, "one lost answer loses no slave"


def test_an_answer_to_withdrawn_outputs_still_counts():
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    last = bus.next()[6]
    bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
    bus.script.answer(SC)
    assert bus.next()[6:9] == bytes([last ^ 0x20, 0, 0])


def test_the_output_watchdog_stops_a_repetition():
    """Design, invariant 3: "what was written before is never sent again"; here it runs out in the slot of a lost answer."""
    bus = Bus(output_watchdog=1 * S, allowance=2 * MS)
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    lib.dpm_master_feed(bus.master.master, bus.script.now - 999 * MS, lib.DPM_FED_PROGRAM)
    assert bus.next()[7:9] == b"\x11\x11"
    assert bus.next()[7:9] == b"\0\0"
    assert bus.master.status.latched


def test_the_output_watchdog_makes_everything_safe_and_latches():
    """Design, invariant 3: a program that hangs while the C thread lives."""
    bus = Bus(output_watchdog=1 * S)
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    for _ in range(3000):  # never armed by exchanging alone: outputs that nobody wrote are safe already
        bus.exchange()
    assert bus.script.now > 1 * S and bus.master.status.mode == lib.DPM_MODE_OPERATE
    committed = bus.script.now
    bus.master.commit(0, b"\x11\x11", committed)
    while (telegram := bus.exchange())[7:9] == b"\x11\x11":
        pass
    assert committed + 1 * S < bus.script.last.start < committed + 1.003 * S
    assert telegram[7:9] == b"\0\0"
    status = bus.master.status
    assert status.latched and status.mode == lib.DPM_MODE_CLEAR and status.fed_by == lib.DPM_FED_COMMIT
    assert bus.master.commit(0, b"\x22\x22", bus.script.now) == lib.DPM_E_LATCHED
    assert [e.a for e in bus.master.events() if e.kind == lib.DPM_EV_WATCHDOG] == [lib.DPM_FED_COMMIT]
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.exchange()
    assert bus.exchange()[7:9] == b"\0\0", "the old commit is gone for good"
    bus.master.commit(0, b"\x33\x33", bus.script.now)
    assert bus.exchange()[7:9] == b"\x33\x33"


def test_a_commit_made_in_clear_is_watched_from_operate_on():
    bus = Bus(output_watchdog=1 * S)
    bus.start()
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.script.now += 5 * S  # longer ago than the watchdog's time, which only Operate counts
    began = bus.script.now
    bus.master.mode(lib.DPM_MODE_OPERATE, began)
    bus.exchange()
    while bus.exchange()[7:9] == b"\x11\x11":
        pass
    assert began + 1 * S < bus.script.last.start < began + 1.003 * S
    assert bus.master.status.latched and bus.master.status.fed_by == lib.DPM_FED_OPERATE


@pytest.mark.parametrize(("away", "hold"), [("absent", False), ("absent", True), ("port", True)])
def test_a_program_that_hangs_while_nothing_takes_its_outputs(away, hold):
    """No output of its commit was alive when it hung, so nothing ran out: the commit is too old to begin with all the same."""
    bus = Bus(output_watchdog=1 * S, slave={"hold": hold})
    if away == "port":
        bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    if away == "port":
        bus.exchange()
        lib.dpm_master_port(bus.master.master, False, bus.script.now)
    bus.script.silence(3 * S)
    assert not bus.master.status.latched
    lib.dpm_master_port(bus.master.master, True, bus.script.now)
    assert [telegram[7:9] for telegram in (restart(bus), bus.exchange(), bus.exchange())] == [b"\0\0"] * 3
    status = bus.master.status
    assert status.latched and status.mode == lib.DPM_MODE_CLEAR


def test_feeding_keeps_the_outputs():
    bus = Bus(output_watchdog=1 * S)
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    while bus.script.now < 5 * S:
        lib.dpm_master_feed(bus.master.master, bus.script.now, lib.DPM_FED_PROGRAM)
        assert bus.exchange()[7:9] == b"\x11\x11"


def test_the_output_watchdog_holds_while_its_clock_goes_round():
    """It counts 2^32 ticks of 2^18 ns: 13 days."""
    bus = Bus(output_watchdog=1 * S)
    bus.start()
    bus.script.now = 2**50 - 3 * S
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    while bus.script.now < 2**50 - S // 2:
        fed = bus.script.now
        lib.dpm_master_feed(bus.master.master, fed, lib.DPM_FED_PROGRAM)
        assert bus.exchange()[7:9] == b"\x11\x11"
    while bus.exchange()[7:9] == b"\x11\x11":
        pass
    assert fed + 1 * S < bus.script.last.start < fed + 1.003 * S


def test_a_stopped_process_comes_back_with_safe_outputs():
    """SIGSTOP for a while, then SIGCONT: nothing of before is sent."""
    bus = Bus(output_watchdog=1 * S)
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    bus.script.now += 3 * S
    lib.dpm_master_feed(bus.master.master, bus.script.now, lib.DPM_FED_WAIT)  # the program's wait, awake before the bus thread
    while (telegram := bus.next(tokens=True))[0] == 0xDC:
        pass
    assert telegram[7:9] == b"\0\0" and bus.master.status.latched and bus.master.status.fed_by == lib.DPM_FED_COMMIT


def test_leaving_clears_and_unlocks():
    """Set_Prm with Unlock on leaving: station status 40, factors 01 01, ident, as B.4 #62."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    telegram = bus.next()
    assert telegram[7:-2] == octets("3D 3E 40 01 01 00 0A 35 00")
    assert bus.master.status.mode != lib.DPM_MODE_STOP
    bus.script.answer(SC)
    assert bus.script.next(limit=20 * MS, tokens=False) == b""
    assert bus.master.status.mode == lib.DPM_MODE_STOP and bus.state == lib.DPM_ST_OFFLINE


def test_offline_is_silent_from_the_last_answer_on():
    """The turn that unlocked the last slave does not go on: no token, no FDL state but Offline."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OFFLINE, bus.script.now)
    assert bus.next()[7] == 0x3D
    bus.script.answer(SC)
    assert bus.script.next(limit=1 * S, tokens=True) == b""
    assert bus.master.status.mode == lib.DPM_MODE_OFFLINE
    assert bus.master.status.fdl_state == lib.DPM_FDL_OFFLINE


@pytest.mark.parametrize("steps", range(6))
def test_leaving_unlocks_whatever_answer_is_under_way(steps):
    """Set_Prm locks a slave to us from the moment it is sent; an answer to the way in must not skip the way out."""
    bus = Bus(configuration="10")
    inputs = frame(0x08, b"\x55")
    answers = (FREE, SC, SC, READY, inputs, inputs)
    for answer in answers[:steps]:
        bus.next()
        bus.script.answer(answer)
    bus.next()
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    bus.script.answer(answers[steps])
    assert not bus.master.inputs(0).valid
    if steps:
        assert bus.next()[7:-2] == octets("3D 3E 40 01 01 00 0A 35 00")
        bus.script.answer(SC)
    assert bus.script.next(limit=20 * MS) in (b"", CLEAR)
    assert bus.master.status.mode == lib.DPM_MODE_STOP and bus.state == lib.DPM_ST_OFFLINE


def test_leaving_does_not_wait_for_a_station_that_is_gone():
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OFFLINE, bus.script.now)
    assert bus.next()[7] == 0x3D
    assert bus.next()[7] == 0x3D
    assert bus.script.next(limit=1 * S, tokens=True) == b""
    assert bus.master.status.mode == lib.DPM_MODE_OFFLINE
    assert bus.master.status.fdl_state == lib.DPM_FDL_OFFLINE


UNLOCK = octets("3D 3E 40 01 01 00 0A 35 00")  # as B.4 #62


def unlocked(bus: Bus) -> None:
    """Tokens of who claims the bus, Clear to all, Unlock; and nothing else."""
    assert bus.script.next() == CLEAR
    assert bus.script.next()[7:-2] == UNLOCK
    bus.script.answer(SC)
    assert bus.script.next(limit=1 * S) == b""
    assert bus.master.status.mode == lib.DPM_MODE_STOP and bus.state == lib.DPM_ST_OFFLINE


@pytest.mark.parametrize("when", ["before", "before, and it talks once more", "behind Clear", "behind Unlock"])
def test_leaving_waits_for_a_token_that_was_lost(when):
    """A slave that is ours holds its last outputs, with its watchdog off for ever: it is told as soon as the bus is silent."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.exchange()
    if when.startswith("behind"):
        bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
        assert bus.script.next() == CLEAR
    if when == "behind Unlock":
        assert bus.script.next()[7:-2] == UNLOCK
    bus.script.answer("DC 05 03", tsdr=40)
    bus.script.silence(bus.script.bits(201))  # in the slot of Unlock the token might yet turn into an answer
    if when.startswith("before"):
        assert bus.state == lib.DPM_ST_OFFLINE
        bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    if when.endswith("more"):
        assert bus.script.next(limit=bus.script.bits(400), tokens=True) == b""
        bus.script.answer("DC 05 03", tsdr=40)
    assert bus.state == lib.DPM_ST_LEAVING and bus.master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN
    unlocked(bus)


def come_back_late(bus: Bus) -> None:
    """The host was away for longer than a right to talk lasts: the master listens for Tto, and has lost nobody yet."""
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    bus.script.now += 50 * MS
    assert bus.script.next(limit=1, tokens=True) == b""
    assert (bus.master.status.fdl_state, bus.state) == (lib.DPM_FDL_LISTEN_TOKEN, lib.DPM_ST_DATA)


def test_a_host_that_was_away_while_it_waited_for_the_token_claims_it_first():
    """Nobody has the bus; that the time to wait is over does not say that somebody has."""
    bus = Bus()
    bus.start()
    bus.script.answer("DC 05 03", tsdr=40)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    bus.script.now += 1 * S
    unlocked(bus)


@pytest.mark.parametrize("foreign", [False, True])
def test_leaving_behind_a_late_host_waits_for_the_token_as_well(foreign):
    bus = Bus()
    bus.start()
    come_back_late(bus)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    if foreign:
        bus.script.answer("DC 05 03", tsdr=40)
    unlocked(bus)


def test_a_foreign_master_that_a_late_host_hears_has_taken_the_bus():
    bus = Bus()
    bus.start()
    come_back_late(bus)
    bus.script.answer("DC 05 03", tsdr=40)
    assert bus.state == lib.DPM_ST_OFFLINE and not bus.master.inputs(0).valid
    assert [e.a for e in bus.master.events() if e.kind == lib.DPM_EV_FOREIGN] == [3]
    assert bus.master.status.mode == lib.DPM_MODE_OPERATE


@pytest.mark.parametrize("away", [50 * MS, 10 * S])
@pytest.mark.parametrize("moment", ["token", "Clear", "Unlock", "listening", "other", "silent"])
def test_what_the_host_itself_was_away_is_not_waited_for(away, moment):
    """It would give up the token before it had looked whether that is there. Nor does a cycle time of an hour hold it up."""
    bus = Bus(cycle_time=2 * S)
    bus.start()
    if moment == "other":
        bus.script.answer("DC 05 03", tsdr=40)
    if moment == "listening":
        come_back_late(bus)
    if moment == "silent":
        lose(bus)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    if moment in ("Clear", "Unlock"):
        assert bus.script.next() == CLEAR
    if moment == "Unlock":
        assert bus.script.next()[7:-2] == UNLOCK
    bus.script.now += away
    assert Offer(bus.master.machine, bus.script.now).octets in (b"", CLEAR), "asked before it has read"
    left = bus.script.now
    while (sent := bus.script.next(limit=100 * MS)) == CLEAR:
        pass
    assert sent[7:-2] == UNLOCK and bus.script.now < left + 100 * MS
    bus.script.answer(SC)
    assert bus.script.next(limit=1 * S) == b"" and bus.master.status.mode == lib.DPM_MODE_STOP


def test_a_wait_for_the_token_begins_when_the_host_has_read():
    """What a late host reads at once bears the times of a line that was never silent, back to when it was away."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    bus.script.now += 1 * S
    feed(bus.master.machine, octets("DC 05 03") * 180, bus.script.now, bus.script.character)  # 12 ms; Tto is 4 ms
    unlocked(bus)


@pytest.mark.parametrize("since", [1, 100])
def test_leaving_does_not_wait_for_a_token_that_others_keep(since):
    bus = Bus()
    bus.start()

    def others() -> None:
        bus.script.answer("DC 05 03", tsdr=40)
        assert bus.script.next(limit=MS, tokens=True) == b""

    for _ in range(since):
        others()
    begin = bus.script.now
    bus.master.mode(lib.DPM_MODE_STOP, begin)
    while bus.master.status.mode != lib.DPM_MODE_STOP:
        assert bus.script.now - begin < 20 * MS
        others()
    assert bus.state == lib.DPM_ST_OFFLINE and bus.script.now - begin > bus.script.bits(2000)


def test_leaving_waits_for_a_token_half_a_second_at_most():
    bus = Bus(allowance=600 * MS)
    bus.start()
    bus.script.answer("DC 05 03", tsdr=40)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    assert bus.script.next(limit=499 * MS, tokens=True) == b"" and bus.state == lib.DPM_ST_LEAVING
    assert bus.script.next(limit=2 * MS, tokens=True) == b"" and bus.master.status.mode == lib.DPM_MODE_STOP


def test_a_token_lost_long_after_the_way_out_began_is_waited_for():
    bus = Bus(slave={"min_slave_interval": 1000})  # 0.1 s
    bus.script.next()
    for answer in (FREE, SC, SC, READY):
        bus.next()
        bus.script.answer(answer)
    bus.next()
    bus.script.answer(SC)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    assert bus.script.next() == CLEAR
    assert bus.script.next(limit=50 * MS) == b""
    bus.script.answer("DC 05 03", tsdr=40)
    unlocked(bus)


@pytest.mark.parametrize("asked", [False, True])
def test_a_host_that_is_late_on_the_way_out_goes_on_with_it(asked):
    """Whether it is away before the Unlock or with it in hand; it then waits for Tto, and for no fixed cycle time."""
    bus = Bus(slave={"min_slave_interval": 1000}, cycle_time=10 * S)  # 0.1 s
    bus.script.next()
    for answer in (FREE, SC, SC, READY, SC):
        bus.next(limit=11 * S)
        bus.script.answer(answer)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    assert bus.script.next() == CLEAR
    assert bus.script.next(limit=50 * MS) == b""
    while asked and (offer := Offer(bus.script.machine, bus.script.now)).octets[7:-2] != UNLOCK:
        if offer.octets:
            assert bus.script.next(tokens=True)[0] == 0xDC
        else:
            bus.script.silence(offer.wake - bus.script.now)
    bus.script.now += 50 * MS
    assert bus.script.next(limit=1) == b""
    assert bus.master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN and bus.state == lib.DPM_ST_LEAVING
    assert bus.script.next(limit=1 * S)[7:-2] == UNLOCK


def plant(stations: int, silent: int, foreign: bool = False) -> tuple[Master, Wire, Slaves]:
    """Stations from address 2 on that have exchanged data, without a watchdog; the first of them do not answer any more,
    `foreign`: do not come back when another master's token has cost us the bus."""
    master, slaves = Master(500_000, allowance=20 * MS), Slaves(500_000)
    for address in range(2, 2 + stations):
        master.add(address, 0x0A35, b"\x21")
        slaves.add(address, 0x0A35, b"\x21")
    wire = Wire(master.parameters, master.machine, slaves.machine)
    master.mode(lib.DPM_MODE_CLEAR)
    wire.run_until(lambda: all(master.slave(i).state == lib.DPM_ST_DATA for i in range(stations)) and wire.log[-1].source == 1)
    if foreign:
        feed(master.machine, octets("DC 05 03"), wire.now, wire.character)
        assert master.slave(0).reason == lib.DPM_WHY_BUS
    wire.mangle = lambda sent: b"" if sent.octets[0] == 0x68 and sent.octets[4] & 0x7F in range(2, 2 + silent) else None
    wire.run_until(lambda: all(master.slave(i).statistics.unanswered for i in range(silent)) and
                   all(master.slave(i).state == lib.DPM_ST_DATA for i in range(silent, stations)))
    return master, wire, slaves


@pytest.mark.parametrize("foreign", [False, True])
def test_who_was_silent_is_unlocked_behind_the_others(foreign):
    """A part of the plant without power must not keep the rest of it waiting: a slot here has 20 ms."""
    master, wire, _slaves = plant(6, silent=3, foreign=foreign)
    begin = wire.now
    master.mode(lib.DPM_MODE_STOP, begin)
    wire.run_until(lambda: master.status.mode == lib.DPM_MODE_STOP)
    unlocks = [sent for sent in wire.log if sent.start >= begin and sent.octets[7:10] == UNLOCK[:3]]
    assert [sent.octets[4] & 0x7F for sent in unlocks] == [5, 6, 7, 2, 3, 4]
    assert unlocks[2].end - begin < 30 * MS, "one slot was under way"


def test_the_silent_are_given_half_a_second():
    master, wire, _slaves = plant(40, silent=39)
    begin = wire.now
    master.mode(lib.DPM_MODE_STOP, begin)
    wire.run_until(lambda: master.status.mode == lib.DPM_MODE_STOP)
    assert 500 * MS < wire.now - begin < 550 * MS


def test_leaving_does_not_wait_for_a_port_that_vanished():
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    assert bus.script.next() == CLEAR
    lib.dpm_master_port(bus.master.master, False, bus.script.now)
    assert bus.master.status.mode == lib.DPM_MODE_STOP and bus.state == lib.DPM_ST_OFFLINE


@pytest.mark.parametrize("deactivate", [False, True])
def test_a_station_that_was_lost_is_unlocked_all_the_same(deactivate):
    """It did not answer twice; that does not mean that it did not hear."""
    bus = Bus(control_interval=200 * S)
    bus.start()
    lose(bus)
    if deactivate:
        lib.dpm_master_activate(bus.master.master, 0, False, bus.script.now)
        assert bus.next()[7:-2] == UNLOCK
        bus.script.answer(SC)
        assert bus.state == lib.DPM_ST_INACTIVE
    else:
        bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
        unlocked(bus)


def test_who_does_not_hear_the_unlock_is_not_asked_again():
    bus = Bus(control_interval=200 * S)
    bus.start()
    lose(bus)
    lib.dpm_master_activate(bus.master.master, 0, False, bus.script.now)
    assert bus.next()[7:-2] == UNLOCK
    bus.script.silence(bus.script.bits(201))
    assert bus.state == lib.DPM_ST_INACTIVE
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    assert bus.script.next(limit=1 * S) in (b"", CLEAR) and bus.master.status.mode == lib.DPM_MODE_STOP


def test_an_unlock_that_is_a_first_contact_is_repeated_all_the_same():
    """The station would not, and one telegram lost would leave the slave locked."""
    bus = Bus(control_interval=200 * S)
    bus.start()
    bus.script.answer("DC 05 03", tsdr=40)
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    assert bus.script.next() == CLEAR
    for _ in range(2):
        assert bus.script.next()[6:-2] == b"\x6d" + UNLOCK, "FCB = 1, FCV = 0"
        bus.script.silence(bus.script.bits(201))
    assert bus.script.next(limit=1 * S) == b""
    assert bus.master.status.mode == lib.DPM_MODE_STOP and bus.state == lib.DPM_ST_OFFLINE


@pytest.mark.parametrize("owner", [0x02, 0x05, 0xFF])
def test_only_what_is_ours_is_unlocked(owner):
    """It was lost and says, when it is back, whose it is."""
    bus = Bus()
    bus.start()
    lose(bus)
    assert bus.next()[7] == 0x3C
    bus.script.answer(diagnosis(0x00, 0x05, 0x00, owner, 0x0A, 0x35))
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    if owner == 2:
        unlocked(bus)
    else:
        assert bus.script.next(limit=1 * S) in (b"", CLEAR)
        assert bus.master.status.mode == lib.DPM_MODE_STOP


def test_a_foreign_master_takes_the_bus_and_all_stations_are_safe_afterwards():
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    bus.script.answer("DC 05 03", tsdr=40)
    assert bus.state == lib.DPM_ST_OFFLINE and bus.slave.reason == lib.DPM_WHY_BUS
    assert not bus.master.inputs(0).valid
    assert restart(bus)[7:9] == b"\0\0"


def test_a_port_that_vanishes_and_comes_back():
    bus = Bus()
    bus.start()
    lib.dpm_master_port(bus.master.master, False, bus.script.now)
    assert bus.state == lib.DPM_ST_OFFLINE and bus.script.next(limit=1 * S, tokens=True) == b""
    lib.dpm_master_port(bus.master.master, True, bus.script.now)
    assert restart(bus)[7:9] == b"\0\0"


# --- refusals at set-up -----------------------------------------------------------------------------------------------


def test_set_up_refuses_what_cannot_work():
    assert Master(address=126).result == lib.DPM_E_ADDRESS
    assert Master(slaves=127).result == lib.DPM_E_ARGUMENT
    for bad in ({"role": 3}, {"allowance": -1}, {"granularity": -1}, {"delivery": -1}):
        assert Master(**bad).result == lib.DPM_E_ARGUMENT, bad
    broken = default_parameters()
    broken.tsl = 60
    assert Master(parameters=broken).result == lib.DPM_E_PARAMETER
    master = Master(address=2, slaves=2)
    assert master.add(2, 1, b"\x21") == lib.DPM_E_ADDRESS
    assert master.add(126, 1, b"\x21") == lib.DPM_E_ADDRESS
    assert master.add(8, 1, b"\xC1\x21") == lib.DPM_E_CONFIGURATION
    assert master.add(8, 1, b"\x21", watchdog=(3, 0)) == lib.DPM_E_ARGUMENT
    assert master.add(8, 1, b"\x21", min_tsdr=10) == lib.DPM_E_ARGUMENT
    assert master.add(8, 1, b"\x21") == 0
    assert master.add(8, 2, b"\x21") == lib.DPM_E_DUPLICATE
    assert master.add(9, 1, b"\x21") == 1
    assert master.add(10, 1, b"\x21") == lib.DPM_E_FULL
