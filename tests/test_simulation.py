# SPDX-License-Identifier: MIT
"""The simulated segment: who hears what and when, and that every rule is found broken when it is, and only then.

Limits are protocol page D.1 and D.2, the set of 500 kbit/s: Tsl 200, Tid1 37, Tid2 100, min Tsdr 11, max Tsdr 100,
Tto = (6 + 2 n) Tsl. Telegrams are captures (page B.4) or tokens; times are bit times.
"""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from simulation import Heard, Simulation, Talker, rule_name
from wire import MS, US, Master, S, Slaves, default_parameters, ffi, lib, octets

BIT = 2000  # ns at 500 kbit/s
RATES = (9600, 19200, 45450, 93750, 187500, 500000, 1500000, 3000000, 6000000, 12000000)

CLAIM = octets("DC 02 02")  # B.4 #34
DIAG = octets("68 05 05 68 88 82 6D 3C 3E F1 16")  # B.4 #17: master 2 to slave 8, high priority
DIAG_LOW = octets("68 05 05 68 88 82 6C 3C 3E F0 16")  # the same in low priority, FCS one less
ANSWER = octets("68 0B 0B 68 82 88 08 3E 3C 02 05 00 FF 0A 35 D1 16")  # B.4 #18
CONTROL = octets("68 07 07 68 FF 82 46 3A 3E 02 00 41 16")  # B.4 #51: SDN
SC = octets("E5")
TTO_2 = 10 * 200  # address 2 may claim


def bits(octets_: bytes) -> int:
    return 11 * len(octets_)


def talk(*lines: tuple[int, float, bytes], parameters=None, **options) -> tuple[Simulation, list[Talker]]:
    """Talkers on one wire that say (port, bit time, octets); runs until a while after the last."""
    talkers = [Talker() for _ in range(max(port for port, _, _ in lines) + 1)]
    simulation = Simulation(parameters or default_parameters(), *talkers, **options)
    for port, at, text in lines:
        talkers[port].say(round(at * BIT), text)
    simulation.run(until=round(max(at for _, at, _ in lines) + 4000) * BIT, violation=False)
    return simulation, talkers


def sequence(*parts: tuple[int, float, bytes]) -> list[tuple[int, float, bytes]]:
    """Two claiming tokens of address 2 on port 0, then each part after so many idle bits."""
    lines, at = [(0, TTO_2, CLAIM), (0, TTO_2 + 33 + 37, CLAIM)], TTO_2 + 2 * 33 + 37.0
    for port, idle, text in parts:
        lines.append((port, at + idle, text))
        at += idle + bits(text)
    return lines


def bus(rate: int = 500_000, slaves: int = 2, single: bool = False, host: dict | None = None, slave_host: dict | None = None,
        **options) -> tuple[Simulation, Master]:
    """A master in Operate with slaves, in one machine or in one each."""
    simulation = Simulation(default_parameters(rate), **options)
    late = {"allowance": (host or {}).get("lateness", 0) + (host or {}).get("chunk", 0)}
    master = Master(rate, 2, **(late | {"granularity": late["allowance"]}))
    machines = [Slaves(rate, allowance=(slave_host or {}).get("lateness", 0)) for _ in range(slaves if single else 1)]
    simulation.attach(master, **(host or {}))
    for machine in machines:
        simulation.attach(machine, **(slave_host or {}))
    for i in range(slaves):
        assert machines[i % len(machines)].add(8 + i, 0x0A35, octets("13 23")) >= 0
        assert master.add(8 + i, 0x0A35, octets("13 23")) == i
    master.mode(lib.DPM_MODE_OPERATE)
    return simulation, master


# --- a bus --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", RATES)
def test_a_master_and_its_slaves_break_no_rule(rate):
    simulation, master = bus(rate, slaves=3)
    while master.slave(2).statistics.exchanges < 200:
        simulation.run(transmissions=100)
        simulation.check()
    share = simulation.share(2)
    assert share.tokens > 20 and share.requests > 600 and share.rotations == share.tokens - 1
    assert share.rotation_min <= share.rotation_sum / share.rotations <= share.rotation_max


@pytest.mark.parametrize("rate", RATES)
def test_an_exchange_takes_what_the_standard_computes(rate):
    """T_DX = 11 (n_req + n_res) + Tsdr + Tid1 (protocol page D.3), here with 4 octets each way and min Tsdr."""
    simulation, master = bus(rate, slaves=3)
    while master.slave(2).statistics.exchanges < 10:
        simulation.run(transmissions=50)
    simulation.run(transmissions=40)
    tap = simulation.tap(40)
    polls = [b.start - a.start for a, _, b in zip(tap, tap[1:], tap[2:], strict=False)
             if a.kind == b.kind == "request" and b.da != a.da and a.octets[6] & 0x4F == b.octets[6] & 0x4F == 0x4D]
    parameters = simulation.parameters
    tid1 = lib.dpm_tid1(parameters)
    assert polls and all(p == pytest.approx(simulation.bits(11 * 26 + 11 + tid1), abs=8) for p in polls)


def test_many_machines_hear_what_one_machine_hears():
    """Slaves in one machine or each on a port of its own: the same telegrams at the same times."""
    runs = []
    for single in (False, True):
        simulation, _ = bus(1_500_000, slaves=20, single=single, tap=2000)
        simulation.run(50 * MS)
        simulation.check()
        runs.append([(t.start, t.octets) for t in simulation.tap()])
    assert len(runs[0]) > 400 and runs[0] == runs[1]


def test_a_run_in_pieces_is_the_run_in_one():
    whole, _ = bus(tap=2000)
    whole.run(60 * MS)
    pieces, _ = bus(tap=2000)
    while pieces.now < 60 * MS:
        pieces.run(transmissions=7, until=60 * MS)
    assert [t.octets for t in whole.tap()] == [t.octets for t in pieces.tap()]
    assert [t.start for t in whole.tap()] == [t.start for t in pieces.tap()]
    assert len(whole.tap()) > 100


# --- who hears what, when --------------------------------------------------------------------------------------------


def test_a_telegram_is_heard_whole_at_its_end_with_the_times_of_its_octets():
    simulation, talkers = talk((0, 100, ANSWER), (1, 3000, SC))
    assert talkers[1].heard == [Heard(ANSWER, bytes(17), 111 * BIT, 111 * BIT, 11 * BIT, False, (100 + 17 * 11) * BIT)]
    assert simulation.tap()[0].end == (100 + 17 * 11) * BIT
    assert not any(heard.octets == ANSWER for heard in talkers[0].heard), "no echo"


def test_who_must_act_inside_a_telegram_is_first_given_what_has_ended():
    """An offer that falls into a telegram meets the octets whose stop bits have ended, and only those."""
    _, talkers = talk((0, 100, ANSWER), (1, 100 + 5 * 11 + 3, SC))
    first = talkers[1].heard[0]
    assert first.octets == ANSWER[:5] and first.at == (100 + 5 * 11 + 3) * BIT


@pytest.mark.parametrize(("inside", "revoked"), [(0, False), (10, False), (11, True), (12, True)])
def test_carrier_is_known_when_the_first_octet_has_ended(inside, revoked):
    """Who begins while the other's first octet is on the wire cannot know; a stop bit that ended revokes the offer."""
    talkers = Talker(), Talker(polite=True)
    simulation = Simulation(default_parameters(), *talkers)
    talkers[0].say(100 * BIT, ANSWER)
    talkers[1].say((100 + inside) * BIT, SC)
    simulation.run(S, violation=False)
    assert simulation.statistics.transmissions == (1 if revoked else 2)
    assert simulation.statistics.collisions == (0 if revoked else 1)
    assert ("collision" in simulation.rules_broken()) != revoked


def test_a_port_sends_one_thing_at_a_time():
    talker = Talker()
    simulation = Simulation(default_parameters(), talker)
    talker.say(100 * BIT, ANSWER)
    talker.say(150 * BIT, SC)
    simulation.run(until=160 * BIT, violation=False)  # a run asks every machine when it begins
    simulation.run(10 * MS, violation=False)
    assert [t.start for t in simulation.tap()] == [100 * BIT, (100 + bits(ANSWER)) * BIT]
    assert simulation.statistics.collisions == 0


def test_a_host_with_echo_hears_itself_marked():
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters())
    simulation.attach(talkers[0], echo=True)
    simulation.attach(talkers[1])
    talkers[0].say(100 * BIT, ANSWER)
    simulation.run(S, violation=False)
    for talker, echo in zip(talkers, (True, False), strict=True):
        assert [(h.octets, h.echo) for h in talker.heard] == [(ANSWER, echo)]


@pytest.mark.parametrize("seed", range(10))
def test_times_of_a_late_host_hold_the_truth(seed):
    """Lateness and chunks widen the times; every octet ended within what the host was told, and came within the bounds."""
    draw = random.Random(seed)
    lateness, chunk = draw.choice([(300 * US, 0), (0, 1 * MS), (200 * US, 125 * US)])
    talker, listener = Talker(), Talker()
    simulation = Simulation(default_parameters(), talker)
    simulation.attach(listener, seed=seed, lateness=lateness, chunk=chunk)
    at, ends = 0, []
    for _ in range(30):
        at += draw.randrange(50, 2000)
        talker.say(at * BIT, ANSWER)
        ends += [(at + 11 * (i + 1)) * BIT for i in range(len(ANSWER))]
        at += bits(ANSWER)
    simulation.run(S, violation=False)
    told = [(h.earliest + i * h.spacing, h.latest + i * h.spacing, h.at) for h in listener.heard for i in range(len(h.octets))]
    assert len(told) == len(ends), f"seed {seed}"
    assert all(earliest <= end <= latest for end, (earliest, latest, _) in zip(ends, told, strict=True)), f"seed {seed}"
    assert any(earliest < latest for earliest, latest, _ in told)
    assert all(not chunk or lateness or at % chunk == 0 for _, _, at in told), "delivered at multiples of the chunk"
    last = [ends[i + len(ANSWER) - 1] for i in range(0, len(ends), len(ANSWER))]
    delays = [told[ends.index(end)][2] - end for end in last]
    assert max(delays) <= lateness + chunk and max(delays) > (lateness + chunk) / 3, f"seed {seed}"


@pytest.mark.parametrize("asks", [False, True])
def test_a_host_that_stands_still_reads_at_once_what_came_meanwhile(asks):
    """As octets of which the last has just come, as a driver has no times; and says nothing before that."""
    talker, listener = Talker(), Talker()
    simulation = Simulation(default_parameters(), talker, listener)
    for at in (100, 400, 5000):
        talker.say(at * BIT, ANSWER)
    listener.say(1000 * BIT, SC)
    simulation.run(50 * BIT, violation=False)
    assert lib.dpm_simulation_stall(simulation.c, 1, 3000 * BIT, asks) == 0
    simulation.run(10_000 * BIT, violation=False)
    late, prompt = listener.heard
    assert (late.octets, late.latest + (len(late.octets) - 1) * late.spacing) == (ANSWER + ANSWER, 3000 * BIT)
    assert late.earliest == late.latest and not any(late.errors)
    assert (prompt.octets, prompt.latest + (len(ANSWER) - 1) * prompt.spacing) == (ANSWER, (5000 + bits(ANSWER)) * BIT)
    assert [t.start for t in simulation.tap() if t.port == 1] == [3000 * BIT]


def test_a_host_that_stands_still_for_long_keeps_what_a_serial_port_keeps():
    talker, listener = Talker(), Talker()
    simulation = Simulation(default_parameters(), talker, listener, tap=2000)
    for k in range(1000):
        talker.say((100 + 100 * k) * BIT, ANSWER)
    simulation.run(50 * BIT, violation=False)
    assert lib.dpm_simulation_stall(simulation.c, 1, 1 * S, False) == 0
    simulation.run(1 * S, violation=False)
    assert listener.heard[0].octets == (ANSWER * 1000)[:4095]


@pytest.mark.parametrize("seed", range(3))
def test_a_late_host_is_late_by_its_seed(seed):
    def run(seed):
        simulation, master = bus(host={"lateness": 100 * US, "seed": seed}, slaves=2, tap=2000)
        simulation.run(100 * MS)
        simulation.check()
        assert master.slave(0).statistics.exchanges > 20
        return [t.start for t in simulation.tap()]

    assert run(seed) == run(seed)
    assert run(seed) != run(seed + 100)


@pytest.mark.parametrize(("bound", "tsdr", "broken"), [(30, 130, []), (30, 161, ["max Tsdr"]), (0, 101, ["max Tsdr"])])
def test_max_tsdr_allows_for_the_hosts_lateness(bound, tsdr, broken):
    """A late slave may be late twice, to hear the request and to wake for its answer; an exact one answers within max Tsdr."""
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), talkers[0])
    simulation.attach(talkers[1], lateness=bound * BIT, seed=1)
    for port, at, text in sequence((0, 37, DIAG), (1, tsdr, ANSWER)):
        talkers[port].say(round(at) * BIT, text)
    simulation.run(100 * MS, violation=False)
    request, answer = simulation.tap()[-2:]
    assert tsdr * BIT <= answer.start - request.end <= (tsdr + bound) * BIT
    assert simulation.rules_broken() == broken


def test_octets_that_a_late_host_never_read_are_counted():
    talker, listener = Talker(), Talker()
    simulation = Simulation(default_parameters(), talker, tap=64)
    simulation.attach(listener, chunk=S)
    for i in range(100):
        talker.say((100 + 100 * i) * BIT, SC)
    simulation.run(2 * S, violation=False)
    assert simulation.statistics.overrun == 36 and len(listener.heard) == 64


# --- two at once -----------------------------------------------------------------------------------------------------


def test_octets_that_share_time_are_garbled_once_and_marked():
    """Port 0 sends six octets, port 1 begins in the fourth: the rest of the first is the AND of both, with line errors;
    of the second is heard what begins when the wire is free."""
    one, two = octets("10 88 82 49 53 16"), octets("A5 0F 3C 55 66 77")
    _, talkers = talk((0, 100, one), (1, 100 + 3 * 11 + 4, two), (2, 3000, SC))
    heard = talkers[2].heard
    assert b"".join(h.octets for h in heard)[:3] == one[:3] and not any(h.errors[0] for h in heard[:3])
    assert [(h.octets[0], h.errors[0]) for h in heard[3:6]] == [
        (one[3] & two[0], lib.DPM_LINE_PARITY), (one[4] & two[0], lib.DPM_LINE_PARITY), (one[5] & two[1], lib.DPM_LINE_PARITY)]
    assert b"".join(h.octets for h in heard[6:]) == two[3:], "two[2] began inside the first's last octet"
    ends = [h.latest for h in heard]
    assert ends == sorted(ends) and all(b - a >= 11 * BIT for a, b in pairwise(ends))
    assert talkers[0].heard[0].octets == two[3:4], "a driver that is on hears nothing"


def test_the_same_instant_is_a_collision():
    simulation, _ = talk((0, 100, ANSWER), (1, 100, ANSWER))
    assert "collision" in simulation.rules_broken()
    assert [t.flags & lib.DPM_TAP_COLLIDED for t in simulation.tap()] == [lib.DPM_TAP_COLLIDED] * 2
    broken = next(v for v in simulation.violations() if v.rule == lib.DPM_RULE_COLLISION)
    assert (broken.port, broken.time, broken.value) == (1, 100 * BIT, bits(ANSWER))


# --- each rule, just broken and just kept ----------------------------------------------------------------------------

AFTER_ANSWER = [(0, 37, DIAG), (1, 11, ANSWER)]


@pytest.mark.parametrize(("rule", "limit", "before", "port", "text"), [
    ("Tid1", 37, [], 0, DIAG),  # after the own token
    ("Tid1", 37, AFTER_ANSWER, 0, DIAG_LOW),
    ("Tid1", 37, AFTER_ANSWER, 0, CLAIM),
    ("Tid1", 37, [(0, 37, octets("DC 05 02"))], 1, octets("DC 02 05")),  # after another's token
    ("Tid2", 100, [(0, 37, CONTROL)], 0, DIAG),
    ("slot", 200, [(0, 37, DIAG)], 0, DIAG),
    ("slot", 200, [(0, 37, DIAG)], 0, CLAIM),
    ("slot", 200, [(0, 37, octets("DC 05 02"))], 0, octets("DC 05 02")),
    ("min Tsdr", 11, [(0, 37, DIAG)], 1, ANSWER),
])
def test_minima(rule, limit, before, port, text):
    for idle, broken in ((limit, []), (limit - 0.5, [rule])):
        simulation, _ = talk(*sequence(*before, (port, idle, text)))
        assert simulation.rules_broken() == broken
        if broken:
            found = simulation.violations()[0]
            assert (found.value, found.limit) == (limit - 0.5, limit)


def test_syn_comes_before_every_other_idle_time():
    """33 bits; below them the other rules are not told as well."""
    simulation, _ = talk(*sequence((0, 32, DIAG)))
    assert simulation.rules_broken() == ["SYN"]
    simulation, _ = talk(*sequence((0, 33, DIAG)))
    assert simulation.rules_broken() == ["Tid1"]


def test_max_tsdr():
    assert talk(*sequence((0, 37, DIAG), (1, 100, ANSWER)))[0].rules_broken() == []
    simulation, _ = talk(*sequence((0, 37, DIAG), (1, 101, ANSWER)))
    assert simulation.rules_broken() == ["max Tsdr"]
    assert simulation.violations()[0].value == 101


def test_babbling_is_told_once():
    """Tsyni = 2 (2 (33 + 255 * 11)) + 33 = 11385 bits without 33 of idle: what a broken station sends on and on."""
    endless = bytes(255)
    simulation, _ = talk(*[(0, 100 + i * 2805, endless) for i in range(4)])
    assert "babbling" not in simulation.rules_broken()
    simulation, _ = talk(*[(0, 100 + i * 2805, endless) for i in range(8)])
    assert simulation.rules_broken().count("babbling") == 1
    simulation, _ = talk(*[(0, 100 + i * (2805 + 33), endless) for i in range(8)])
    assert "babbling" not in simulation.rules_broken()


@pytest.mark.parametrize("parts", [
    [ANSWER[:9], ANSWER[9:]],  # a telegram with a gap
    [ANSWER[:16]],
    [bytes(3)],
    [SC + SC],
])
def test_a_transmission_is_one_whole_telegram(parts):
    simulation, _ = talk(*sequence((0, 37, DIAG), *((1, 20, part) for part in parts)))
    assert "whole telegram" in simulation.rules_broken()


@pytest.mark.parametrize("parts", [
    [(1, 50, ANSWER)],  # nobody asked
    [(0, 37, DIAG), (1, 11, octets("68 0B 0B 68 82 89 08 3E 3C 02 05 00 FF 0A 35 D2 16"))],  # slave 9 for slave 8
    [(0, 37, DIAG), (1, 11, ANSWER), (1, 11, ANSWER)],  # twice
    [(0, 37, CONTROL), (1, 11, SC)],  # an SDN has no answer
    [(1, 50, SC)],
])
def test_an_answer_needs_a_request(parts):
    assert talk(*sequence(*parts))[0].rules_broken() == ["unasked answer"]


def test_a_token_is_passed_by_its_holder():
    """A pass may be repeated until it was taken; then the passer has no token any more."""
    to_5, to_2 = octets("DC 05 02"), octets("DC 02 05")
    again = [(0, 37, to_5), (0, 200, to_5), (0, 200, octets("DC 07 02"))]
    assert talk(*sequence(*again))[0].rules_broken() == []
    assert talk(*sequence((0, 37, to_5), (1, 37, to_2), (0, 37, to_5)))[0].rules_broken() == []
    taken = [(0, 37, to_5), (1, 37, octets("DC 07 05")), (0, 60, to_5)]
    assert talk(*sequence(*taken))[0].rules_broken() == ["two tokens"]
    assert talk(*sequence((1, 50, octets("DC 09 09"))))[0].rules_broken() == ["two tokens"]


@pytest.mark.parametrize("address", [0, 2, 5])
def test_a_claim_comes_after_tto(address):
    """Tto = (6 + 2 n) Tsl of silence, by the claimer's address, counted from power-on at the earliest."""
    token = bytes([0xDC, address, address])
    tto = (6 + 2 * address) * 200
    assert talk((0, tto, token))[0].rules_broken() == []
    simulation, _ = talk((0, tto - 1, token))
    assert simulation.rules_broken() == ["two tokens"]
    assert (simulation.violations()[0].value, simulation.violations()[0].limit) == (tto - 1, tto)
    assert talk(*sequence((1, tto, token)))[0].rules_broken() == []
    assert talk(*sequence((1, tto - 1, token)))[0].rules_broken() == (["two tokens"] if address != 2 else [])


def test_a_request_needs_the_token():
    assert talk((0, 5000, DIAG))[0].rules_broken() == ["request without token"]
    passed = (0, 37, octets("DC 05 02"))
    for used in (octets("DC 07 05"), octets("10 08 05 49 56 16")):
        assert talk(*sequence(passed, (1, 37, used), (0, 250, DIAG)))[0].rules_broken() == ["request without token"]


def test_a_pass_that_nobody_took_leaves_the_token_with_the_passer():
    passed = octets("DC 05 02")
    assert talk(*sequence((0, 37, passed), (0, 200, passed), (0, 200, passed), (0, 200, DIAG)))[0].rules_broken() == []
    assert talk(*sequence((0, 37, passed), (0, 199, DIAG)))[0].rules_broken() == ["slot"]


def hold(*texts: bytes, held: int) -> list[str]:
    """Ttr 2000; the token comes back to address 2 after `held` bits, then these requests follow, unanswered."""
    parameters = default_parameters()
    parameters.ttr = 2000
    lines = sequence((0, 37, octets("DC 05 02")), (1, held, octets("DC 02 05")), *((0, 37 if i == 0 else 200, text)
                     for i, text in enumerate(texts)))
    return talk(*lines, parameters=parameters)[0].rules_broken()


def test_past_ttr_one_cycle_of_high_priority_is_allowed():
    """"ONE high-priority message cycle is always allowed; a started cycle, with its retries, is finished" (page D.3)."""
    assert hold(DIAG_LOW, DIAG, held=100) == []
    assert hold(DIAG, held=2000) == []
    assert hold(DIAG, DIAG, DIAG, held=2000) == [], "repetitions"
    assert hold(DIAG_LOW, held=2000) == ["token hold"]
    assert hold(DIAG, DIAG_LOW, held=2000) == ["token hold"]
    assert hold(octets("DC 05 02"), held=2000) == [], "passing it on is always right"


@pytest.mark.parametrize(("between", "broken"), [
    ([], ["token hold"]),
    ([(0, 37, octets("10 05 02 49 50 16")), (1, 11, octets("10 02 05 20 27 16"))], []),  # B.4 #38: ready for the ring
])
def test_the_first_token_of_a_new_membership_has_no_rotation(between, broken):
    """5 had the token, and gets it again past Ttr; where it was outside the ring meanwhile, TRR begins with that token."""
    parameters = default_parameters()
    parameters.ttr = 1000
    to_5, to_2 = octets("DC 05 02"), octets("DC 02 05")
    status = octets("10 08 05 49 56 16")
    lines = sequence((0, 37, to_5), (1, 37, to_2), (0, 800, CLAIM), *between, (0, 800, to_5), (1, 37, status))
    assert talk(*lines, parameters=parameters)[0].rules_broken() == broken


def test_a_claim_begins_a_new_rotation():
    parameters = default_parameters()
    parameters.ttr = 1000
    lines = sequence((0, TTO_2, CLAIM), (0, 37, DIAG_LOW), (0, 200, DIAG))
    assert talk(*lines, parameters=parameters)[0].rules_broken() == []


def test_rotations_and_shares():
    """A token counts when its receiver used it; TRR is from token to token."""
    to_5, to_2 = octets("DC 05 02"), octets("DC 02 05")
    simulation, _ = talk(*sequence(*[(0, 37, to_5), (1, 37, to_2)] * 5, (0, 37, to_5), (1, 137, to_2)))
    simulation.check()
    share = simulation.share(5)
    assert (share.tokens, share.rotations) == (6, 5)
    assert share.rotation_min == 2 * (33 + 37) * BIT == share.rotation_max
    assert simulation.share(2).tokens == 2 + 5, "both claims, and 5's tokens but the last, which nobody used"
    assert simulation.statistics.tokens == 14
    assert simulation.statistics.busy == 14 * 33 * BIT
    simulation.clear()
    assert simulation.share(5).tokens == simulation.statistics.tokens == 0


# --- faults ---------------------------------------------------------------------------------------------------------


def heard_under(seed: int = 1, n: int = 40, **chances: int) -> tuple[list[Heard], Simulation]:
    talker, listener = Talker(), Talker()
    simulation = Simulation(default_parameters(), talker, listener)
    simulation.faults(seed=seed, **chances)
    for i in range(n):
        talker.say((1000 + 1000 * i) * BIT, ANSWER)
    simulation.run(S, violation=False)
    return listener.heard, simulation


def test_faults_are_the_same_for_the_same_seed():
    chances = {"lose": 20_000, "flip": 20_000, "insert": 20_000, "duplicate": 20_000, "lose_telegram": 50_000}
    first, simulation = heard_under(7, **chances)
    assert first == heard_under(7, **chances)[0]
    assert first != heard_under(8, **chances)[0]
    assert simulation.statistics.touched > 20
    untouched, simulation = heard_under(7)
    assert [h.octets for h in untouched] == [ANSWER] * 40 and simulation.statistics.touched == 0


def test_a_lost_octet_leaves_its_time_empty_and_an_inserted_one_takes_time():
    lost, simulation = heard_under(3, n=1, lose=200_000)
    stream = [(o, h.latest + i * h.spacing) for h in lost for i, o in enumerate(h.octets)]
    places = [(end // BIT - 1000) // 11 - 1 for _, end in stream]
    assert 3 < len(stream) < len(ANSWER) and bytes(o for o, _ in stream) == bytes(ANSWER[i] for i in places)
    longer, simulation = heard_under(3, n=1, duplicate=1_000_000)
    assert b"".join(h.octets for h in longer) == bytes(o for o in ANSWER for _ in range(2))
    sent = simulation.tap()[0]
    assert sent.wire_end - sent.start == 2 * (sent.end - sent.start) == 2 * bits(ANSWER) * BIT
    inserted, _ = heard_under(3, n=1, insert=1_000_000)
    assert b"".join(h.octets for h in inserted)[1::2] == ANSWER
    flipped, _ = heard_under(3, n=1, flip=1_000_000)
    assert all((a ^ b).bit_count() == 1 for a, b in zip(b"".join(h.octets for h in flipped), ANSWER, strict=True))
    assert not any(any(h.errors) for h in flipped), "the parity bit went along"
    bad, _ = heard_under(3, n=1, parity=1_000_000)
    assert all((a ^ b).bit_count() == 1 for a, b in zip(b"".join(h.octets for h in bad), ANSWER, strict=True))
    assert all(h.errors == bytes([lib.DPM_LINE_PARITY]) * len(h.octets) for h in bad)
    assert heard_under(3, n=5, lose_telegram=1_000_000)[0] == []


def test_noise_comes_by_seed_at_its_mean_distance():
    def run(seed):
        listener = Talker()
        simulation = Simulation(default_parameters(), listener)
        simulation.faults(seed=seed, noise=2 * MS, noise_octets=5)
        simulation.run(2 * S)
        simulation.check()  # noise is no station's doing
        return listener.heard, simulation

    heard, simulation = run(4)
    assert 800 < simulation.statistics.noise < 1200
    lengths = [len(t.octets) for t in simulation.tap(200)]
    assert set(lengths) == {1, 2, 3, 4, 5} and all(t.port == -1 for t in simulation.tap())
    assert heard == run(4)[0] != run(5)[0]


@pytest.mark.parametrize(("fault", "after"), [("LOSE", 0), ("GARBLE", 0), ("DOUBLE", 50), ("DELAY", 400), ("INJECT", 20)])
def test_the_nth_telegram_of_a_kind_meets_its_fault(fault, after):
    talkers = Talker(), Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    plan = simulation.plan(lib.DPM_TRAFFIC_REQUEST, getattr(lib, f"DPM_FAULT_{fault}"), nth=2, address=8,
                           after=after * BIT, octets=SC if fault == "INJECT" else b"")
    other = simulation.plan(lib.DPM_TRAFFIC_REQUEST, lib.DPM_FAULT_LOSE, address=9)
    lines = sequence(*[(0, 1000, CLAIM), (0, 600, DIAG)] * 3)
    for _, at, text in lines:
        talkers[0].say(round(at) * BIT, text)
    simulation.run(100 * MS, violation=False)
    second = round([at for _, at, text in lines if text == DIAG][1]) * BIT
    assert simulation.plan_time(plan) == second and simulation.plan_time(other) == lib.DPM_NEVER
    heard = [(h.octets, h.at) for h in talkers[2].heard if second <= h.at < second + 1000 * BIT]
    end = second + bits(DIAG) * BIT
    if fault == "LOSE":
        assert heard == []
    elif fault == "DOUBLE":
        assert heard == [(DIAG, end), (DIAG, end + 50 * BIT + bits(DIAG) * BIT)]
    elif fault == "DELAY":
        assert heard == [(DIAG, end + 400 * BIT)]
    elif fault == "GARBLE":
        assert [any(h.errors) for h in talkers[2].heard if second <= h.at <= end].count(True) == 1
        assert sum(a != b for a, b in zip(b"".join(o for o, _ in heard), DIAG, strict=True)) == 1
    else:  # E5 began in the second octet: octets two and three of the request are spoilt
        spoilt = [i for i, h in enumerate(h for h in talkers[2].heard if second <= h.at <= end) if any(h.errors)]
        assert spoilt == [1, 2]
        assert simulation.rules_broken().count("collision") == 0, "no station's doing"
    if fault in ("DOUBLE", "DELAY"):
        assert not talkers[0].heard, "its sender does not hear what a fault made of it"


def test_an_injected_telegram_is_heard_by_all():
    simulation, master = bus()
    simulation.run(20 * MS)
    simulation.check()
    while simulation.tap(1)[0].kind != "token":
        simulation.run(transmissions=1)
    simulation.inject(simulation.tap(1)[0].end + 5 * BIT, octets("DC 05 09"))
    simulation.run(20 * MS, violation=False)
    assert [e.a for e in master.events() if e.kind == lib.DPM_EV_FOREIGN] == [9]


def planned(plan: tuple, *parts: tuple[int, float, bytes]) -> list[str]:
    """Rules broken in a sequence of which one telegram meets a fault; nothing is excused."""
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    simulation.plan(*plan)
    for port, at, text in sequence(*parts):
        talkers[port].say(round(at * BIT), text)
    simulation.run(100 * MS, violation=False)
    return simulation.rules_broken()


def test_a_lost_answer_is_no_answer_to_whoever_asked():
    """It would have ended 2 bits before the slot is over; the repetition at Tsl is right, on a wire that was silent."""
    lost = (lib.DPM_TRAFFIC_ANSWER, lib.DPM_FAULT_LOSE)
    assert planned(lost, (0, 37, DIAG), (1, 11, ANSWER), (0, 200 - 11 - bits(ANSWER), DIAG)) == []
    assert planned(lost, (0, 37, DIAG), (1, 11, SC), (0, 199 - 11 - bits(SC), DIAG)) == ["slot"]


def test_a_garbled_answer_may_be_followed_after_syn():
    garbled = (lib.DPM_TRAFFIC_ANSWER, lib.DPM_FAULT_GARBLE)
    assert planned(garbled, (0, 37, DIAG), (1, 11, ANSWER), (0, 33, DIAG)) == []
    assert planned(garbled, (0, 37, DIAG), (1, 11, ANSWER), (0, 32, DIAG)) == ["SYN"]


@pytest.mark.parametrize(("tsdr", "broken"), [(100, []), (101, ["max Tsdr"])])
def test_max_tsdr_counts_from_the_end_that_was_heard(tsdr, broken):
    """A request that faults made longer: its answer cannot begin before it ended."""
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    *lines, (_, at, _), _ = sequence((0, 37, DIAG), (1, 0, ANSWER))
    for port, time, text in lines:
        talkers[port].say(round(time) * BIT, text)
    simulation.run(until=round(at - 5) * BIT)
    simulation.faults(seed=1, duplicate=1_000_000)
    talkers[0].say(round(at) * BIT, DIAG)
    simulation.run(until=round(at + 5) * BIT)
    simulation.faults()
    talkers[1].say(round(at + 2 * bits(DIAG) + tsdr) * BIT, ANSWER)
    simulation.run(100 * MS, violation=False)
    assert simulation.rules_broken() == broken


@pytest.mark.parametrize("seed", range(3))
def test_a_bus_with_faults_keeps_the_rules(seed):
    """Faults of octets are what a station must live with; what it does then is no breach."""
    simulation, master = bus(slaves=3, grace=2 * MS)
    simulation.faults(seed=seed, lose=300, flip=300, insert=300, duplicate=300, lose_telegram=300)
    simulation.run(2 * S)
    print(f"seed {seed}, simulated {simulation.now / S} s")
    simulation.check()
    assert simulation.statistics.touched > 50 and master.slave(0).statistics.exchanges > 500


def test_what_is_broken_soon_after_a_fault_is_excused():
    talker = Talker()
    simulation = Simulation(default_parameters(), talker, grace=5000 * BIT)
    simulation.inject(100 * BIT, SC)
    talker.say(4000 * BIT, ANSWER)
    talker.say(8000 * BIT, ANSWER)
    simulation.run(S, violation=False)
    assert simulation.rules_broken() == ["unasked answer"]
    assert simulation.violations()[0].time == 8000 * BIT
    assert simulation.statistics.excused[lib.DPM_RULE_UNASKED] == 1


# --- power, and the wire cut and joined ---------------------------------------------------------------------------


def test_without_power_a_port_is_deaf_and_dumb():
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    talkers[0].say(100 * BIT, ANSWER)
    talkers[1].say(500 * BIT, ANSWER)
    simulation.power(1, False)
    simulation.run(10 * MS, violation=False)
    assert simulation.statistics.transmissions == 1 and not talkers[1].heard
    simulation.power(1, True)
    simulation.run(10 * MS, violation=False)
    assert simulation.statistics.transmissions == 2, "what it still had to say"


def test_a_transmission_breaks_off_with_its_power():
    talkers = Talker(), Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    talkers[0].say(100 * BIT, ANSWER)
    simulation.run((100 + 5 * 11 + 3) * BIT, violation=False)
    simulation.power(0, False)
    talkers[2].say((100 + 5 * 11 + 20) * BIT, SC)
    simulation.run(10 * MS, violation=False)
    assert b"".join(h.octets for h in talkers[1].heard) == ANSWER[:5] + SC
    cut = simulation.tap()[0]
    assert cut.flags & lib.DPM_TAP_CUT and cut.wire_end == (100 + 5 * 11 + 3) * BIT < cut.end
    assert "collision" not in simulation.rules_broken()


@pytest.mark.parametrize(("octets_heard", "from_"), [(2, 2 * 11), (1, 11), (0, -37)])
@pytest.mark.parametrize(("silence", "broken"), [(12 * 200, []), (12 * 200 - 1, ["two tokens"])])
def test_silence_after_a_break_counts_from_the_last_octet_heard(octets_heard, from_, silence, broken):
    """A character that never ended begins nobody's Tto."""
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    second = TTO_2 + 33 + 37
    talkers[1].say(TTO_2 * BIT, CLAIM)
    talkers[1].say(second * BIT, CLAIM)
    simulation.run(until=(second + octets_heard * 11 + 5) * BIT)
    simulation.power(1, False)
    talkers[0].say((second + from_ + silence) * BIT, octets("DC 03 03"))
    simulation.run(100 * MS, violation=False)
    assert simulation.rules_broken() == broken


@pytest.mark.parametrize(("octets_heard", "broken"), [(0, []), (1, ["two tokens"])])
def test_who_took_a_token_and_broke_off_unheard_did_not_take_it(octets_heard, broken):
    """The passer repeats after Tsl: it cannot know of a character that never ended."""
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    passed = octets("DC 05 02")
    *lines, (_, at, _) = sequence((0, 37, passed), (1, 150, octets("DC 07 05")))
    for port, time, text in lines:
        talkers[port].say(round(time) * BIT, text)
    talkers[0].say(round(at + 50) * BIT, passed)
    talkers[1].say(round(at) * BIT, octets("DC 07 05"))
    simulation.run(until=round(at + 5 + 11 * octets_heard) * BIT)
    simulation.power(1, False)
    simulation.run(10 * MS, violation=False)
    assert simulation.rules_broken() == broken


def test_with_power_again_a_port_need_not_wait_for_what_broke_off():
    talker = Talker()
    simulation = Simulation(default_parameters(), talker)
    talker.say(100 * BIT, ANSWER)
    talker.say(150 * BIT, SC)
    simulation.run(until=120 * BIT, violation=False)
    simulation.power(0, False)
    simulation.power(0, True)
    simulation.run(10 * MS, violation=False)
    assert [t.start for t in simulation.tap()] == [100 * BIT, 150 * BIT]


def test_power_on_inside_a_telegram_hears_the_octets_that_begin():
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    talkers[0].say(100 * BIT, ANSWER)
    simulation.power(1, False)
    simulation.run((100 + 5 * 11 + 3) * BIT, violation=False)
    simulation.power(1, True)
    simulation.run(10 * MS, violation=False)
    assert b"".join(h.octets for h in talkers[1].heard) == ANSWER[6:]


def test_a_cut_wire_has_two_halves_until_it_is_joined():
    talkers = [Talker() for _ in range(4)]
    simulation = Simulation(default_parameters(), *talkers)
    simulation.place(1, 2, 3)
    for port in (0, 2):
        talkers[port].say(100 * BIT, ANSWER)
    simulation.run(10 * MS, violation=False)
    assert [len(t.heard) for t in talkers] == [0, 1, 0, 1]
    assert "collision" not in simulation.rules_broken(), "each half is a wire of its own"
    simulation.place(0, 2, 3)
    talkers[2].say(10_000 * BIT, ANSWER)
    simulation.run(20 * MS, violation=False)
    assert [len(t.heard) for t in talkers] == [1, 2, 0, 2]


def test_joined_inside_a_telegram_hears_the_octets_that_begin():
    talkers = Talker(), Talker()
    simulation = Simulation(default_parameters(), *talkers)
    simulation.place(1, 1)
    talkers[0].say(100 * BIT, ANSWER)
    simulation.run((100 + 5 * 11 + 3) * BIT, violation=False)
    simulation.place(0, 1)
    simulation.run(10 * MS, violation=False)
    assert b"".join(h.octets for h in talkers[1].heard) == ANSWER[6:]


def test_a_master_finds_its_slave_again_when_the_wire_is_joined():
    simulation, master = bus(slaves=1)
    simulation.run(100 * MS)
    simulation.check()
    before = master.slave(0).statistics.exchanges
    simulation.place(1, 1)
    simulation.run(50 * MS)
    assert master.slave(0).statistics.exchanges <= before + 1
    simulation.place(0, 1)
    simulation.run(500 * MS)
    simulation.check()
    assert master.slave(0).statistics.exchanges > before + 100


# --- runs, tap, arguments -------------------------------------------------------------------------------------------


def test_a_run_ends_where_it_should():
    simulation, _ = bus()
    assert simulation.run(until=3 * MS) == lib.DPM_STOPPED_TIME and simulation.now == 3 * MS
    assert simulation.run(tokens=5) == lib.DPM_STOPPED_TOKENS and simulation.statistics.tokens == 5
    seen = simulation.statistics.transmissions
    assert simulation.run(transmissions=10) == lib.DPM_STOPPED_TRANSMISSIONS
    assert simulation.statistics.transmissions == seen + 10
    talker = Talker()
    simulation.attach(talker)
    talker.say(simulation.now + MS, SC)
    assert simulation.run(S) == lib.DPM_STOPPED_VIOLATION and simulation.now < S
    with pytest.raises(AssertionError, match=r"(?s)(unasked answer|collision): port 2 .*>>.* port   2 .*e5"):
        simulation.check()


def test_the_tap_keeps_the_last_transmissions():
    simulation, _ = bus(tap=64)
    simulation.run(100 * MS)
    tap = simulation.tap()
    assert len(tap) == 64 and [t.number for t in tap] == list(range(tap[0].number, tap[0].number + 64))
    assert tap[-1].number + 1 == simulation.statistics.transmissions


@pytest.mark.parametrize(("options", "text"), [
    ({"ports": 0}, "argument"), ({"ports": 129}, "argument"), ({"tap": 63}, "argument"), ({"grace": -1}, "argument"),
])
def test_what_cannot_be_set_up_is_refused(options, text):
    with pytest.raises(ValueError, match=text):
        Simulation(default_parameters(), **options)


def test_bad_arguments_are_refused():
    simulation = Simulation(default_parameters(), Talker(), ports=1)
    c = simulation.c
    assert lib.dpm_simulation_attach(c, Talker().machine, ffi.NULL) == lib.DPM_E_FULL
    assert lib.dpm_simulation_power(c, 1, True) == lib.dpm_simulation_place(c, 1, 0) == lib.DPM_E_ARGUMENT
    assert lib.dpm_simulation_place(c, 0, 8) == lib.DPM_E_ARGUMENT
    assert lib.dpm_simulation_stall(c, 1, S, True) == lib.dpm_simulation_stall(c, 0, 0, True) == lib.DPM_E_ARGUMENT
    assert lib.dpm_simulation_inject(c, 0, -1, SC, 1) == lib.dpm_simulation_inject(c, 0, 5, SC, 0) == lib.DPM_E_ARGUMENT
    for _ in range(lib.DPM_SIMULATION_PLANS):
        simulation.inject(S, SC)
        simulation.plan(lib.DPM_TRAFFIC_TOKEN, lib.DPM_FAULT_LOSE)
    assert lib.dpm_simulation_inject(c, 0, S, SC, 1) == lib.DPM_E_FULL
    plan = ffi.new("dpm_simulation_plan *", {"traffic": lib.DPM_TRAFFIC_TOKEN, "nth": 1})
    assert lib.dpm_simulation_add_plan(c, plan) == lib.DPM_E_FULL
    plan.nth = 0
    assert lib.dpm_simulation_add_plan(c, plan) == lib.DPM_E_ARGUMENT
    assert rule_name(-1) == rule_name(lib.DPM_RULE_COUNT) == "unknown rule"
    assert len({rule_name(i) for i in range(lib.DPM_RULE_COUNT)}) == lib.DPM_RULE_COUNT
