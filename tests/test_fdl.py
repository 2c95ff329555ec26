# SPDX-License-Identifier: MIT
"""The FDL station as a sole master, one event at a time: token, idle times, FCB, retries, late octets, foreign masters.

Golden octets are captures (protocol page B.4); times are exact, in bit times at the rate of the test.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
from wire import MS, NEVER, US, Master, Offer, S, Script, default_parameters, feed, lib, octets

# Tsl, Tid1 and Tid2 of the standard sets (protocol page D.2).
SETS = {9600: (100, 37, 60), 187500: (100, 37, 60), 500000: (200, 37, 100), 1500000: (300, 37, 150),
        3000000: (400, 46, 250), 6000000: (600, 57, 450), 12000000: (1000, 76, 800)}

DIAG = octets("68 0B 0B 68 82 88 08 3E 3C 02 05 00 FF 0A 35 D1 16")  # B.4 #18: slave 8 to master 2, free
READY = octets("68 0B 0B 68 82 88 08 3E 3C 00 0C 00 02 0A 35 D9 16")  # B.4 #22


def stopped(rate: int = 500_000, address: int = 2, **options) -> tuple[Master, Script]:
    """A master in Stop that has claimed the token."""
    master = Master(rate, address, **options)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    assert script.next(tokens=True) == script.next(tokens=True) == bytes([0xDC, address, address])
    return master, script


def known(**options) -> tuple[Master, Script]:
    """`stopped`, and station 8 has answered it: what it is asked from now on is repeated."""
    master, script = stopped(**options)
    master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer(DIAG)
    return master, script


# --- token and idle times -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", SETS)
def test_claim_after_tto_with_two_tokens_and_idle_times(rate):
    """Tto = (6 + 2 n) Tsl of silence, then DC TS TS twice (protocol page E.1, B.4 #34); Tid1 behind a token."""
    tsl, tid1, tid2 = SETS[rate]
    master = Master(rate, address=2)
    master.add(8, 0x0A35, octets("21"))
    master.mode(lib.DPM_MODE_CLEAR)
    script = Script(master)
    assert script.next(tokens=True) == octets("DC 02 02")
    assert script.idle_bits(0) == pytest.approx((6 + 2 * 2) * tsl, abs=0.1)
    end = script.last.end
    assert script.next(tokens=True) == octets("DC 02 02")
    assert script.idle_bits(end) == pytest.approx(tid1, abs=0.1)
    end = script.last.end
    # S7 start-up (traces): Global_Control Clear comes first; B.4 #51.
    assert script.next(tokens=True) == octets("68 07 07 68 FF 82 46 3A 3E 02 00 41 16")
    assert script.idle_bits(end) == pytest.approx(tid1, abs=0.1)
    end = script.last.end
    assert script.next(tokens=True) == octets("68 05 05 68 88 82 6D 3C 3E F1 16")  # B.4 #17
    assert script.idle_bits(end) == pytest.approx(tid2, abs=0.1), "Tid2 behind a telegram without answer"


def test_idle_before_a_request_is_never_under_37_bits_at_low_rates():
    """Soft slaves ignore a request after 36.7 Tbit of idle (traces/README)."""
    master = Master(9600, address=2)
    master.add(8, 0x0A35, octets("21"))
    master.mode(lib.DPM_MODE_CLEAR)
    script = Script(master)
    end = 0
    configured = False
    for _ in range(200):
        telegram = script.next(tokens=True)
        assert script.idle_bits(end) >= 37, telegram.hex(" ")
        end = script.last.end
        if telegram[4:5] == b"\x88":
            configured |= telegram[7] == 62
            end = script.answer((READY if configured else DIAG) if telegram[7] == 60 else octets("E5"), tsdr=11.3)
        elif telegram[4:5] == b"\x08":
            end = script.answer("E5", tsdr=12.2)
    assert master.slave(0).statistics.exchanges > 20


def test_with_nothing_to_do_the_token_keeps_the_bus():
    """Nobody may take the token for lost: less than the shortest Tto, 6 Tsl, between two telegrams."""
    _, script = stopped()
    for _ in range(20):
        end = script.last.end
        assert script.next(tokens=True) == octets("DC 02 02")
        assert 37 <= script.idle_bits(end) < 6 * 200


def test_a_host_that_was_away_listens_before_it_talks():
    """Nothing is sent on an old right: after Tto of own silence another master may have the token."""
    master, script = stopped(allowance=1 * MS)
    script.now += 50 * MS  # the process was stopped
    offer = Offer(master.machine, script.now)
    assert not offer.octets
    assert master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN
    assert master.status.fdl.tokens_lost == 1
    late = [e for e in master.events() if e.kind == lib.DPM_EV_LATE]
    assert len(late) == 1 and late[0].value > 40 * MS
    began = script.now
    assert script.next(tokens=True) == octets("DC 02 02")
    assert script.idle_bits(began) >= 10 * 200, "a whole Tto of listening"


def test_a_sole_masters_turn_is_ten_slots_at_most():
    """A cycle's end passes the token once that time has passed; in between the next cycle needs no telegram of its own."""
    master = Master(500_000, address=2)
    master.add(8, 0x0A35, octets("21"))
    master.mode(lib.DPM_MODE_CLEAR)
    script = Script(master)
    configured, tokens = False, []
    while len(tokens) < 30:
        telegram = script.next(tokens=True)
        if telegram == octets("DC 02 02"):
            tokens.append(script.last.start)
        elif telegram[4:5] == b"\x88":
            configured |= telegram[7] == 62
            script.answer((READY if configured else DIAG) if telegram[7] == 60 else octets("E5"))
        elif telegram[4:5] == b"\x08":
            script.answer("E5")
    cycle = script.bits(11 * 12 + 11 + 37)
    assert all(b - a <= script.bits(10 * 200) + 3 * cycle for a, b in pairwise(tokens))
    assert max(b - a for a, b in pairwise(tokens[5:])) > script.bits(10 * 200)


# --- foreign masters ----------------------------------------------------------------------------------------------


def test_goes_silent_on_a_foreign_token():
    """"It goes silent when it hears a foreign one"; it claims again only after Tto of silence."""
    master, script = stopped()
    script.answer("DC 05 03", tsdr=50)
    assert master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN
    assert master.status.foreign == 3
    heard = script.now
    for _ in range(40):  # 3 and 5 go on exchanging tokens, a slot apart
        assert script.next(limit=script.bits(150), tokens=True) == b""
        heard = script.answer("DC 05 03", tsdr=37)
    assert script.next(tokens=True) == octets("DC 02 02")
    assert script.idle_bits(heard) >= 10 * 200
    assert [e.a for e in master.events() if e.kind == lib.DPM_EV_FOREIGN] == [3]


@pytest.mark.parametrize("moment", ["before the request", "while an answer is awaited"])
def test_an_exchange_ends_when_a_foreign_token_comes(moment):
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"\1")
    if moment == "while an answer is awaited":
        assert script.next() == octets("68 04 04 68 08 02 6D 01 78 16")
    script.answer("DC 05 03", tsdr=50)
    assert script.next(limit=script.bits(500), tokens=True) == b""
    assert request.done == (moment == "while an answer is awaited")
    if request.done:
        assert request.status == lib.DPM_CONF_DS


def test_answers_fdl_status_as_a_master_not_ready_for_the_ring():
    """Answer `10 SA TS 10` (B.4 #37 has it for station 5), between min Tsdr and max Tsdr; asked by master 2."""
    master = Master(500_000, address=5)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    Offer(master.machine, 0)
    asked = script.answer("10 05 02 49 50 16", tsdr=50)  # B.4 #1
    assert script.next(tokens=True, limit=script.bits(300)) == octets("10 02 05 10 17 16")
    assert 11 <= script.idle_bits(asked) <= 100


def test_an_answer_that_is_too_late_is_dropped_and_counted():
    master = Master(500_000, address=5)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    Offer(master.machine, 0)
    asked = script.answer("10 05 02 49 50 16", tsdr=50)
    offer = Offer(master.machine, asked)
    assert offer.octets and offer.not_after - asked == script.bits(100)
    assert not Offer(master.machine, offer.not_after + 1).octets
    assert master.status.fdl.late_dropped == 1


def test_services_it_does_not_have_are_refused_and_sdn_is_not_answered():
    master = Master(500_000, address=5)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    Offer(master.machine, 0)
    script.answer("68 05 05 68 85 82 6D 3C 3E EE 16", tsdr=50)  # B.4 #5: Slave_Diag, to a master
    assert script.next(tokens=True, limit=script.bits(300)) == octets("10 02 05 13 1A 16")  # RS
    script.answer("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16", tsdr=50)  # B.4 #52, broadcast
    assert script.next(tokens=True, limit=script.bits(300)) == b""


@pytest.mark.parametrize("fc", [0x40, 0x41, 0x48, 0x4A, 0xC0, 0xC9])
def test_time_events_clock_values_and_reserved_codes_are_not_answered(fc):
    """"Reply expected: no"; "bit 7 = 0 (1 only for Clock Value)" (protocol page C.1)."""
    master = Master(500_000, address=5)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    Offer(master.machine, 0)
    script.answer(bytes([0x10, 5, 2, fc, (7 + fc) & 0xFF, 0x16]), tsdr=50)
    assert script.next(tokens=True, limit=script.bits(300)) == b""


def test_a_request_from_126_is_nobodys():
    """"SA: 0..125, plus 126 only for a not yet addressed slave that answers" (protocol page B.3): no master to give way to."""
    master, script = stopped()
    script.answer("10 02 7E 49 C9 16", tsdr=50)
    assert master.status.fdl_state == lib.DPM_FDL_USE_TOKEN and master.status.foreign == -1
    assert master.status.fdl.stray == 1
    assert script.next(tokens=True) == octets("DC 02 02")


@pytest.mark.parametrize("result", [lib.DPM_SENT_CUT, lib.DPM_SENT_FAILED])
def test_an_sdn_that_did_not_leave_whole_was_not_sent(result):
    """Nobody acknowledges it, so only the port can tell."""
    master, script = stopped()
    request = master.request(127, lib.DPM_SDN_HIGH, b"\0\0", 58, 62)
    while not (offer := Offer(master.machine, script.now)).octets or offer.octets[0] == 0xDC:
        script.next(limit=script.bits(1), tokens=True)
    script.silence(max(offer.not_before - script.now, 0))
    master.machine.sent(master.machine, script.now, script.now, script.now, result)
    assert request.done and request.status == lib.DPM_CONF_DS
    assert (master.status.fdl.sdn, master.status.fdl.send_failed) == (0, 1)


# --- frame count bit, retries -------------------------------------------------------------------------------------


def test_fcb_first_contact_then_toggles_on_every_answer():
    """6D, 5D, 7D, 5D (protocol page C.2, P.1); SC toggles as well as data; every SAP shares it."""
    master, script = stopped()
    seen = []
    for answer in (DIAG, octets("E5"), READY, octets("E5"), octets("10 02 08 03 0D 16")):  # the last: RS, B.4 #23
        dsap = 60 if answer[0] == 0x68 else 61 if answer[0] == 0xE5 else 60
        master.request(8, lib.DPM_SRD_HIGH, b"" if dsap == 60 else b"\0", dsap, 62)
        seen.append(script.next()[6])
        script.answer(answer)
    assert bytes(seen).hex(" ") == "6d 5d 7d 5d 7d"


def test_a_retry_is_the_first_try_octet_for_octet_a_slot_later():
    """S7: one identical repetition a slot time later (traces); same FCB (protocol page C.2 rule 3)."""
    master, script = known()
    request = master.request(8, lib.DPM_SRD_HIGH, b"\x11\x22")
    first = script.next()
    end = script.last.end
    assert script.next() == first
    assert script.idle_bits(end) == pytest.approx(200, abs=0.1)
    script.answer("68 05 05 68 02 08 08 AA BB 77 16")
    assert request.done and request.tries == 2 and bytes(request.answer[0:2]) == octets("AA BB")
    assert master.status.fdl.repetitions == 1


def test_after_all_tries_the_fcb_starts_anew():
    """max_retry_limit repetitions, then "not operational": next is FCB = 1, FCV = 0 (protocol page C.2 rule 4)."""
    parameters = default_parameters(500_000)
    parameters.max_retry_limit = 3
    master, script = known(parameters=parameters)
    request = master.request(8, lib.DPM_SRD_HIGH, b"\1")
    assert [script.next()[6] for _ in range(4)] == [0x5D] * 4
    script.next(tokens=True)
    assert request.done and request.status == lib.DPM_CONF_NA and request.tries == 4
    master.request(8, lib.DPM_SRD_HIGH, b"\1")
    assert script.next()[6] == 0x6D


def test_first_contact_fdl_status_and_sdn_are_never_repeated():
    """Protocol page C.2 rule 1, J.4."""
    master, script = stopped()
    for function, address in ((lib.DPM_SRD_HIGH, 9), (lib.DPM_FDL_STATUS, 9), (lib.DPM_SDN_HIGH, 127)):
        request = master.request(address, function, b"" if function == lib.DPM_FDL_STATUS else b"\1")
        assert script.next()
        assert script.next(tokens=True) == octets("DC 02 02")
        assert request.done and request.tries == 1
        expected = lib.DPM_CONF_SENT if function == lib.DPM_SDN_HIGH else lib.DPM_CONF_NA
        assert request.status == expected


def test_fdl_status_does_not_disturb_the_fcb():
    master, script = known()
    request = master.request(8, lib.DPM_FDL_STATUS)
    assert script.next() == octets("10 08 02 49 53 16")  # B.4 #36
    script.answer("10 02 08 00 0A 16")
    assert request.done and request.fc == 0
    master.request(8, lib.DPM_SRD_HIGH, b"\1")
    assert script.next()[6] == 0x5D


def test_a_time_out_is_judged_only_by_silence():
    """Octets that lie in a FIFO are never called missing: asking late, without a read that came back empty, changes nothing."""
    master, script = stopped(allowance=20 * MS)
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.silence(20 * MS + script.bits(199))
    assert not request.done, "a slot and the allowance: silence before then proves nothing"
    script.now += 15 * MS
    assert not Offer(master.machine, script.now).octets
    script.answer(DIAG)
    assert request.done and request.tries == 1 and request.status == lib.DPM_CONF_ANSWER


def test_the_slot_of_a_wire_that_hands_over_whole_telegrams():
    """A paced hub delivers a telegram when its last octet has ended: at 9600 bit/s the longest takes 292 ms, Tsl is 10 ms."""
    master, script = stopped(9600, delivery=292 * MS)
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    first = script.next()
    script.answer(DIAG, tsdr=100 + 250 * 9.6)  # its octets come at once, 250 ms behind their slot
    assert request.done and request.tries == 1 and request.status == lib.DPM_CONF_ANSWER
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    first = script.next()
    assert script.next() == first, "nothing came: it is repeated, on a right that has not ended meanwhile"
    assert master.status.fdl.tokens_lost == 0


# --- answers that do not belong ------------------------------------------------------------------------------------


@pytest.mark.parametrize("stranger", [
    "68 0B 0B 68 82 89 08 3E 3C 02 05 00 FF 0A 35 D2 16",  # another station's answer
    "68 0B 0B 68 83 88 08 3E 3C 02 05 00 FF 0A 35 D2 16",  # to another master
    "10 03 08 00 0B 16",
])
def test_an_answer_belongs_to_the_exchange_or_to_nobody(stranger):
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer(stranger)
    assert not request.done and master.status.fdl.stray == 1
    script.answer(DIAG)
    assert request.done and bytes(request.answer[0:6]) == octets("02 05 00 FF 0A 35")


@pytest.mark.parametrize("noise", [b"", b"\x68"])
@pytest.mark.parametrize("allowance, granularity", [(2 * MS, 2 * MS), (20 * MS, 18 * MS), (0, 18 * MS)])  # UART, USB
@pytest.mark.parametrize("rate", [9600, 500_000, 1_500_000, 12_000_000])
def test_a_port_that_tells_silence_late_costs_no_token(rate, allowance, granularity, noise):
    """The times of a UART's FIFO or a USB adapter, longer than Tto, are not our own silence: each request keeps its tries."""
    master = Master(rate, address=0, allowance=allowance, granularity=granularity)
    master.mode(lib.DPM_MODE_STOP)
    request, asked, now = None, 0, 0
    while asked < 4 and now < 20 * S:
        if request is None or request.done:
            request, asked = master.request(9, lib.DPM_FDL_STATUS), asked + 1
        offer = Offer(master.machine, now)
        if offer.octets and offer.not_before <= now:
            end = now + len(offer.octets) * int(lib.dpm_bits_up(master.parameters, 11))
            master.machine.sent(master.machine, now, end, end, lib.DPM_SENT_WHOLE)
            now = end
            if noise and offer.octets[0] == 0x10:
                now += int(lib.dpm_bits_up(master.parameters, 50))
                feed(master.machine, noise, now, 0)
            continue
        now = max(offer.not_before if offer.octets else offer.wake, now + 100 * US)
        master.machine.quiet(master.machine, now - granularity)
    assert asked == 4 and master.status.fdl.unanswered == 3
    assert master.status.fdl.tokens_lost == 0


def test_mirrored_saps_are_demanded():
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer("68 0B 0B 68 82 88 08 3E 3B 02 05 00 FF 0A 35 D0 16")  # from SAP 59
    assert request.done and request.status == lib.DPM_CONF_INVALID


def test_a_late_answer_is_dropped_and_not_taken_for_the_next_one():
    """peers.md: "Requests overlap after one late answer, for ever"; "a late answer is taken for the retry's"."""
    master, script = known()
    request = master.request(8, lib.DPM_SRD_HIGH, b"\1")
    script.next()
    script.silence(script.bits(201))  # the slot is over, the repetition is due
    script.answer("68 04 04 68 02 08 08 11 23 16")  # now the first answer comes
    assert not request.done and master.status.fdl.stray == 1
    script.next()
    script.answer("68 04 04 68 02 08 08 11 23 16")
    assert request.done and request.tries == 2


def test_a_late_answer_to_what_was_given_up_does_not_spoil_the_next_request():
    """Data_Exchange is given up, Slave_Diag is asked, and then the inputs come: they fit no SAP and belong to nobody."""
    master, script = stopped()
    master.request(8, lib.DPM_SRD_HIGH, b"\1")
    script.next()
    script.silence(script.bits(201))
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer("68 04 04 68 02 08 08 11 23 16")
    assert not request.done and master.status.fdl.stray == 1
    script.answer(DIAG)
    assert request.done and request.status == lib.DPM_CONF_ANSWER and request.tries == 1


@pytest.mark.parametrize("given_up, distrusted", [("Data_Exchange", True), ("Slave_Diag", False)])
def test_a_late_sc_acknowledges_nobody_else(given_up, distrusted):
    """SC has no address. Behind a request that SC would have answered and that was given up, it is believed when the next
    station says it to the repetition, too; a responder sends its stored answer again (protocol page C.2 rule 3)."""
    master, script = known()
    sap = (60, 62) if given_up == "Slave_Diag" else (-1, -1)
    late = master.request(9, lib.DPM_SRD_HIGH, b"" if given_up == "Slave_Diag" else b"\1", *sap)
    script.next()
    script.silence(script.bits(201))
    assert late.done and late.status == lib.DPM_CONF_NA
    request = master.request(8, lib.DPM_SRD_HIGH, b"\0", 61, 62)
    first = script.next()
    script.answer("E5", tsdr=20)
    assert request.done == (not distrusted) and master.status.fdl.stray == distrusted
    if distrusted:
        assert script.next() == first
        script.answer("E5")
    assert request.done and request.status == lib.DPM_CONF_ANSWER and request.tries == 1 + distrusted
    again = master.request(8, lib.DPM_SRD_HIGH, b"\1")
    script.next()
    script.answer("E5")
    assert again.done and again.tries == 1


def test_behind_a_repetition_its_slot_runs_out_first():
    """peers.md: "Requests overlap after one late answer": here to the first try; the repetition's is still to come."""
    master, script = known()
    first = master.request(8, lib.DPM_SRD_HIGH, b"\1")
    script.next()
    script.next()
    repetition = script.last.end
    script.answer("E5")
    assert first.done and first.tries == 2
    script.next(tokens=True)
    assert script.last.start >= repetition + script.bits(200)


def test_a_doubled_answer_does_not_meet_the_next_exchange():
    """Two tries may bring two answers: the second one finds nobody waiting."""
    master, script = known()
    first = master.request(8, lib.DPM_SRD_HIGH, b"\1")
    script.next()
    script.next()  # the repetition
    script.answer("68 04 04 68 02 08 08 11 23 16")
    assert first.done
    second = master.request(8, lib.DPM_SRD_HIGH, b"\2")
    script.answer("68 04 04 68 02 08 08 11 23 16", tsdr=20)  # the answer to the repetition, too
    assert not second.done and master.status.fdl.stray == 1
    assert script.next()[7] == 2
    script.answer("68 04 04 68 02 08 08 22 34 16")
    assert second.done and second.answer[0] == 0x22


@pytest.mark.parametrize("noise", ["00", "FF", "68", "10", "A2", "E6", "68 05", "FF FF FF FF"])
def test_a_stray_octet_before_an_answer_costs_nothing(noise):
    """peers.md: "one stray octet (00 or FF at turn-round) costs the next telegram and 10 ms"."""
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer(octets(noise) + DIAG)
    script.silence(script.bits(200))
    assert request.done and request.status == lib.DPM_CONF_ANSWER and request.tries == 1


def test_noise_that_looks_like_a_token_costs_one_try_but_not_the_bus():
    """SD4 has no check sequence: a stray DC and the head of the answer make `DC 68 0B`, a token from 11 to 104."""
    master, script = known()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer(octets("DC 44 22") + DIAG)
    assert request.done and request.tries == 1
    assert master.status.fdl_state == lib.DPM_FDL_USE_TOKEN and master.status.fdl.foreign == 0


def test_a_foreign_token_in_the_slot_counts_when_no_answer_comes():
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer("DC 05 03", tsdr=50)
    assert not request.done
    script.silence(script.bits(300))
    assert request.done and request.status == lib.DPM_CONF_DS
    assert master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN and master.status.foreign == 3


@pytest.mark.parametrize("moment", range(12))
def test_a_foreign_e5_at_every_moment_changes_nothing(moment):
    """peers.md: "One E5 right after a token pass panics the master"."""
    master, script = stopped()
    for _ in range(moment // 4):
        script.next(tokens=True)
    script.answer("E5", tsdr=(0, 5, 20, 36)[moment % 4])
    assert master.status.fdl.stray == 1
    assert script.next(tokens=True) == octets("DC 02 02")


def test_an_answer_with_a_line_error_is_no_answer():
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    script.next()
    script.answer(DIAG, errors=bytes([0] * 9 + [lib.DPM_LINE_PARITY] + [0] * 7))
    script.next(tokens=True)
    assert request.done and request.status == lib.DPM_CONF_NA


def test_our_own_echo_is_not_a_foreign_master():
    """peers.md: "Echo from the transceiver: no exchange at all"."""
    master, script = stopped()
    request = master.request(8, lib.DPM_SRD_HIGH, b"", 60, 62)
    sent = script.next()
    feed(master.machine, sent, script.now + 1000, script.character, echo=True)
    assert not request.done and master.status.fdl.stray == 0
    script.answer(DIAG)
    assert request.done and request.tries == 1


def test_offline_sends_nothing_ever():
    master, _ = stopped()
    master.mode(lib.DPM_MODE_OFFLINE)
    assert Offer(master.machine, 0).wake == NEVER
    assert not Offer(master.machine, 10**12).octets


@pytest.mark.parametrize("address", [127, 128, 255])  # nobody may answer a broadcast; no address has eight bits
def test_a_request_that_cannot_be_sent_is_confirmed_as_invalid(address):
    master, script = stopped()
    request = master.request(address, lib.DPM_SRD_HIGH, b"\1")
    script.next(tokens=True)
    assert request.done and request.status == lib.DPM_CONF_INVALID and request.tries == 0
