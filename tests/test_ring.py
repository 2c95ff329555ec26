# SPDX-License-Identifier: MIT
"""The token ring, one event at a time: listening, entering, taking and passing the token, GAP, loss, duplicates.

A station of ours (address 5) among others played by hand; protocol page E. What many stations of ours do among
themselves, with every rule of the wire watched, is test_ring_soak.py's.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
from dp_bus import diagnosis
from simulation import Simulation
from wire import MS, US, Master, Offer, S, Script, Slaves, Wire, default_parameters, feed, lib, octets

RING = lib.DPM_ROLE_RING
LATE_WAKES = 8  # thirds of what one wake is late, that a host is in all: to hear, for its own, and what its looks leave open
TSL = 200  # Tbit at 500 kbit/s


def token(da: int, sa: int) -> bytes:
    return bytes([0xDC, da, sa])


def status(da: int, sa: int) -> bytes:
    """FDL status request."""
    return bytes([0x10, da, sa, 0x49, (da + sa + 0x49) & 0xFF, 0x16])


def answer(da: int, sa: int, fc: int) -> bytes:
    return bytes([0x10, da, sa, fc, (da + sa + fc) & 0xFF, 0x16])


class Bus:
    """Our master at 5 in Stop, on a bus where a test plays 2, 9 and others."""

    def __init__(self, **options) -> None:
        self.master = Master(500_000, address=5, role=RING, **options)
        self.master.mode(lib.DPM_MODE_STOP)
        self.script = Script(self.master)

    @property
    def state(self) -> int:
        return self.master.status.fdl_state

    def rotations(self, n: int) -> None:
        """Tokens 2 -> 9 -> 2, which our station only hears."""
        for _ in range(n):
            self.script.answer(token(9, 2), tsdr=37)
            self.script.answer(token(2, 9), tsdr=37)

    def listened(self) -> None:
        self.script.next(limit=self.script.bits(50), tokens=True)
        self.rotations(4)

    def entered(self) -> None:
        """Polled by 2, ready, the token comes."""
        self.listened()
        self.script.answer(status(5, 2), tsdr=37)
        assert self.script.next(limit=self.script.bits(120)) == answer(2, 5, 0x20)
        self.script.answer(token(5, 2), tsdr=37)
        assert self.state == lib.DPM_FDL_USE_TOKEN

    def passed(self) -> bytes:
        """Our telegrams up to our token, which is returned; GAP polls stay without answer."""
        while (sent := self.script.next(tokens=True))[0] != 0xDC:
            assert sent[3] == 0x49, sent.hex(" ")
        return sent


# --- listening and entering ------------------------------------------------------------------------------------------


def test_not_ready_before_two_equal_rotations_then_ready_then_in_the_ring():
    """FC 10, 20, 30 (protocol page E.1, B.4 #37 to #39)."""
    bus = Bus()
    bus.script.next(limit=bus.script.bits(50))
    bus.rotations(1)
    bus.script.answer(status(5, 2), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(120)) == octets("10 02 05 10 17 16")
    bus.rotations(3)
    assert bus.master.las == {2, 9}
    bus.script.answer(status(5, 2), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(120)) == octets("10 02 05 20 27 16")
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE and bus.master.las == {2, 5, 9}
    bus.script.answer(status(5, 2), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(120)) == octets("10 02 05 30 37 16")


def test_only_the_predecessor_is_told_that_it_is_ready():
    """"Then 20h (ready) when asked by its predecessor" (protocol page E.1): anybody else's token would never come."""
    bus = Bus()
    bus.listened()
    bus.script.answer(status(5, 9), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(120)) == answer(9, 5, 0x10)
    assert bus.state == lib.DPM_FDL_LISTEN_TOKEN
    bus.script.answer(status(5, 2), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(120)) == answer(2, 5, 0x20)


def test_a_list_that_changes_is_listened_to_anew():
    bus = Bus()
    bus.script.next(limit=bus.script.bits(50))
    bus.rotations(2)
    bus.script.answer(token(9, 7), tsdr=37)  # one more station
    bus.script.answer(token(2, 9), tsdr=37)
    bus.script.answer(status(5, 2), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(120)) == answer(2, 5, 0x10)


def test_it_never_takes_a_token_before_it_was_asked():
    bus = Bus()
    bus.listened()
    bus.script.answer(token(5, 2), tsdr=37)
    bus.script.answer(token(5, 2), tsdr=200)
    assert bus.script.next(limit=bus.script.bits(190), tokens=True) == b""


def test_the_token_from_ps_is_used_and_passed_to_ns_in_time():
    """Tid1 behind the token, within the predecessor's slot."""
    bus = Bus()
    bus.entered()
    came = bus.script.now
    sent = bus.script.next(tokens=True)
    assert sent == status(6, 5), "the GAP is TS + 1 to NS - 1"
    assert bus.script.idle_bits(came) == pytest.approx(37, abs=0.1)
    end = bus.script.last.end
    assert bus.script.next(tokens=True) == token(9, 5)
    assert bus.script.idle_bits(end) == pytest.approx(TSL, abs=0.1), "nobody at 6"
    bus.script.answer(token(2, 9), tsdr=37)
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE


def test_a_stranger_is_believed_at_its_second_try():
    """Protocol page E.2: "From any other SA: remember it; if the same SA sends it again, accept and make it the new PS"."""
    bus = Bus()
    bus.entered()
    assert bus.passed() == token(9, 5)
    bus.script.answer(token(3, 9), tsdr=37)  # 3 is new, and 2 is passed over
    bus.script.answer(token(5, 3), tsdr=37)
    assert bus.script.next(limit=bus.script.bits(190), tokens=True) == b""
    bus.script.answer(token(5, 3), tsdr=10)
    assert bus.state == lib.DPM_FDL_USE_TOKEN
    assert bus.master.view.ps == 3 and bus.master.las == {3, 5, 9}


def test_passed_over_it_leaves_and_listens():
    """SA < TS < DA: we were dropped."""
    bus = Bus()
    bus.entered()
    bus.passed()
    bus.script.answer(token(2, 9), tsdr=37)
    bus.script.answer(token(9, 2), tsdr=37)
    assert bus.state == lib.DPM_FDL_LISTEN_TOKEN


# --- passing ----------------------------------------------------------------------------------------------------------


def test_a_silent_successor_is_tried_three_times_and_dropped():
    """One and two repetitions a slot apart, then the next one in the list (protocol page E.1)."""
    bus = Bus()
    bus.entered()
    assert bus.passed() == token(9, 5)
    for _ in range(2):
        end = bus.script.last.end
        assert bus.script.next(tokens=True) == token(9, 5)
        assert bus.script.idle_bits(end) == pytest.approx(TSL, abs=0.1)
    assert bus.script.next(tokens=True) == token(2, 5)
    assert bus.master.las == {2, 5} and bus.master.status.fdl.token_repetitions == 2
    assert bus.master.view.live[9] == lib.DPM_LIVE_NONE


@pytest.mark.parametrize("activity", ["E5", "FF", "68 00", "DC 02 09"])
def test_any_activity_is_a_successor_that_has_it(activity):
    """"Waits Tsl for any bus activity. Activity -> success"."""
    bus = Bus()
    bus.entered()
    bus.passed()
    bus.script.answer(activity, tsdr=37)
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE
    assert bus.script.next(limit=bus.script.bits(3 * TSL), tokens=True) == b""


def test_the_last_one_left_has_the_token_to_itself():
    bus = Bus()
    bus.entered()
    bus.passed()
    for _ in range(5):
        bus.script.next(tokens=True)
    assert bus.passed() == token(5, 5)
    assert bus.master.las == {5}


# --- GAP ---------------------------------------------------------------------------------------------------------------


def test_the_gap_is_polled_one_address_per_token_and_then_rests_for_g_ttr():
    bus = Bus()
    bus.entered()
    polls = []
    for _ in range(8):
        while (sent := bus.script.next(tokens=True))[0] != 0xDC:
            polls.append(sent[1])
        bus.script.answer(token(2, 9), tsdr=37)
        bus.script.answer(token(5, 2), tsdr=37)
    assert polls == [6, 7, 8]
    g_ttr = bus.script.bits(bus.master.parameters.g * bus.master.parameters.ttr)
    assert bus.passed() == token(9, 5)
    bus.script.now += g_ttr
    for expected in (token(9, 5), status(6, 5)):  # the first rotation took longer than Ttr: no time for a poll
        bus.script.answer(token(2, 9), tsdr=37)
        bus.script.answer(token(5, 2), tsdr=37)
        assert bus.script.next(tokens=True) == expected


def test_a_ready_master_in_the_gap_becomes_ns_and_gets_the_token_at_once():
    bus = Bus()
    bus.entered()
    assert bus.script.next(tokens=True) == status(6, 5)
    bus.script.answer(answer(5, 6, 0x20))
    assert bus.script.next(tokens=True) == token(6, 5)
    assert bus.master.las == {2, 5, 6, 9} and bus.master.view.live[6] == lib.DPM_LIVE_MASTER_READY


@pytest.mark.parametrize("fc, live", [(0x00, "SLAVE"), (0x10, "MASTER_NOT_READY")])
def test_others_in_the_gap_are_noted(fc, live):
    bus = Bus()
    bus.entered()
    bus.script.next(tokens=True)
    bus.script.answer(answer(5, 6, fc))
    assert bus.script.next(tokens=True) == token(9, 5)
    assert bus.master.view.live[6] == getattr(lib, f"DPM_LIVE_{live}")
    assert (6, getattr(lib, f"DPM_LIVE_{live}")) in [(e.address, e.a) for e in bus.master.events() if e.kind == lib.DPM_EV_LIVE]


def test_hsa_bounds_the_gap():
    parameters = default_parameters(500_000)
    parameters.hsa = 7
    bus = Bus(parameters=parameters)
    polls = []
    while bus.script.now < 100 * MS:
        sent = bus.script.next(tokens=True)
        if sent[0] == 0x10:
            polls.append(sent[1])
    assert polls == [6, 7, 0, 1, 2, 3, 4]


# --- token hold time ---------------------------------------------------------------------------------------------------


def test_one_high_priority_cycle_even_when_the_rotation_took_too_long():
    """Tth = Ttr - Trr; one message of high priority always, low priority and GAP only in the time left (E.1, D.3)."""
    parameters = default_parameters(500_000)
    parameters.ttr = 256
    master = Master(parameters=parameters, address=5, role=RING)
    for address in (20, 21, 22):
        master.add(address, 0x0A35, b"\x21")
    bus = Bus.__new__(Bus)
    bus.master, bus.script = master, Script(master)
    master.mode(lib.DPM_MODE_CLEAR)
    bus.entered()
    raw = master.request(30, lib.DPM_FDL_STATUS)
    messages = []
    for _ in range(40):
        turn = []
        while (sent := bus.script.next(tokens=True)) != token(9, 5):
            turn.append(sent)
        assert len(turn) <= 1 and all(sent[0] == 0x68 for sent in turn), "not the raw request, not the GAP"
        messages += turn
        bus.script.answer(token(2, 9), tsdr=150)  # no rotation takes less than Ttr
        bus.script.answer(token(5, 2), tsdr=150)
    assert len(messages) > 3 and not raw.done


def test_the_token_is_not_kept_when_there_is_nothing_to_do():
    bus = Bus()
    bus.entered()
    bus.passed()
    bus.script.answer(token(2, 9), tsdr=37)
    came = bus.script.answer(token(5, 2), tsdr=37)
    bus.script.next(tokens=True)
    assert bus.script.idle_bits(came) == pytest.approx(37, abs=0.1)


# --- loss, doubles, strangers -------------------------------------------------------------------------------------------


def test_a_lost_token_is_claimed_and_the_list_stands():
    """"At re-initialisation the old LAS remains valid": two tokens to itself, then to NS."""
    bus = Bus()
    bus.entered()
    bus.passed()
    heard = bus.script.answer(token(2, 9), tsdr=37)
    assert bus.script.next(tokens=True) == token(5, 5)
    assert bus.script.idle_bits(heard) == pytest.approx((6 + 2 * 5) * TSL, abs=0.1)
    assert bus.script.next(tokens=True) == token(5, 5)
    assert bus.passed() == token(9, 5)
    assert bus.master.las == {2, 5, 9}


def test_it_gives_up_the_token_when_another_has_one():
    """Await_Data_Response and the others: a foreign telegram -> Active_Idle."""
    bus = Bus()
    bus.entered()
    bus.master.request(30, lib.DPM_SRD_HIGH, b"\1")
    request = bus.script.next(tokens=True)
    assert request[0] in (0x10, 0x68)
    bus.script.answer("10 08 02 49 53 16", tsdr=50)
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE
    assert bus.script.next(limit=bus.script.bits(5 * TSL), tokens=True) == b""


def test_a_duplicate_address_is_reported_and_the_bus_left():
    """Listen_Token: own address as SA twice -> Offline."""
    bus = Bus()
    bus.script.next(limit=bus.script.bits(50))
    bus.script.answer(token(9, 5), tsdr=37)
    bus.script.answer(token(9, 5), tsdr=200)
    assert bus.state == lib.DPM_FDL_OFFLINE
    assert [e.address for e in bus.master.events() if e.kind == lib.DPM_EV_DUPLICATE] == [5]
    assert bus.master.view.duplicate and bus.master.status.mode == lib.DPM_MODE_OFFLINE
    assert bus.script.next(limit=1 * S, tokens=True) == b""


def test_a_duplicate_address_is_found_among_other_tokens():
    """Its tokens and those of its ring take turns: "own address seen as SA twice", not twice in a row (page E.1)."""
    bus = Bus()
    bus.script.next(limit=bus.script.bits(50))
    bus.script.answer(token(9, 5), tsdr=37)
    bus.script.answer(token(5, 9), tsdr=37)
    assert bus.state == lib.DPM_FDL_LISTEN_TOKEN
    bus.script.answer(token(9, 5), tsdr=37)
    assert bus.state == lib.DPM_FDL_OFFLINE and bus.master.view.duplicate


@pytest.mark.parametrize("behind", [token(5, 2), token(9, 2), status(5, 2)])
def test_who_left_the_bus_hears_nothing_more(behind):
    """A port hands over several telegrams at once: what stands behind the one that led to Offline is nobody's."""
    bus = Bus()
    bus.script.next(limit=bus.script.bits(50))
    bus.rotations(3)
    bus.script.answer(token(9, 5) * 2 + behind, tsdr=37)
    assert bus.state == lib.DPM_FDL_OFFLINE and bus.master.status.mode == lib.DPM_MODE_OFFLINE
    assert bus.script.next(limit=1 * S, tokens=True) == b""


def test_leaving_waits_half_a_second_for_a_token_that_never_comes():
    """Another one has it, and believes that we are gone."""
    bus = Bus()
    bus.master.add(30, 1, octets("21"))
    bus.entered()
    bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
    parameterised = False
    while (sent := bus.script.next(tokens=True)) != token(9, 5) or not parameterised:
        if sent[7:8] == b"\x3c":
            bus.script.answer(diagnosis(0x02, 0x05, 0x00, 0xFF, 0x00, 0x01, da=5, sa=30))
        elif sent[7:8] in (b"\x3d", b"\x3e"):
            bus.script.answer(b"\xe5")
            parameterised = True
        elif sent == token(9, 5):
            bus.script.answer(token(2, 9), tsdr=37)
            bus.script.answer(token(5, 2), tsdr=37)
    bus.script.answer(token(9, 9), tsdr=37)
    bus.master.mode(lib.DPM_MODE_OFFLINE, bus.script.now)
    begin = bus.script.now
    while bus.state == lib.DPM_FDL_ACTIVE_IDLE:
        bus.script.answer(token(9, 9), tsdr=37)
        assert bus.script.next(limit=bus.script.bits(1), tokens=True) == b""
    assert 0.5 * S <= bus.script.now - begin < 0.51 * S
    assert bus.master.status.mode == lib.DPM_MODE_OFFLINE and bus.state == lib.DPM_FDL_OFFLINE


@pytest.mark.parametrize("others", [False, True], ids=["a silent bus", "others go on"])
def test_who_loses_the_ring_on_its_way_out_waits_for_it_and_no_longer(others):
    """Who is ours is unlocked when the token comes back; when it does not, it is Offline and does not come back itself."""
    bus = Bus()
    bus.master.add(30, 1, octets("21"))
    bus.entered()
    bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
    while (sent := bus.script.next(tokens=True))[7:8] != b"\x3d":  # Set_Prm: from now on it may be ours
        if sent == token(9, 5):
            bus.script.answer(token(2, 9), tsdr=37)
            bus.script.answer(token(5, 2), tsdr=37)
        if sent[7:8] == b"\x3c":
            bus.script.answer(diagnosis(0x02, 0x05, 0x00, 0xFF, 0x00, 0x01, da=5, sa=30))
    bus.master.mode(lib.DPM_MODE_OFFLINE, bus.script.now)
    for _ in range(2):
        bus.script.answer(token(9, 5), tsdr=50)
    assert (bus.state, bus.master.slave(0).state) == (lib.DPM_FDL_LISTEN_TOKEN, lib.DPM_ST_LEAVING)
    if others:
        begin = bus.script.now
        while bus.state == lib.DPM_FDL_LISTEN_TOKEN:
            bus.script.answer(token(9, 9), tsdr=37)
            bus.script.silence(1)
        assert 0.4 * S < bus.script.now - begin < 0.6 * S
    else:
        assert bus.script.next()[6:9] == octets("46 3A 3E"), "Global_Control, Clear"
        assert bus.script.next()[7:10] == octets("3D 3E 40"), "Unlock"
        bus.script.answer(b"\xe5")
    assert bus.script.next(limit=1 * S, tokens=True) == b""
    assert bus.master.status.mode == lib.DPM_MODE_OFFLINE and bus.state == lib.DPM_FDL_OFFLINE


@pytest.mark.parametrize("role", [RING, lib.DPM_ROLE_SOLE])
def test_a_duplicate_is_found_by_who_is_alone_and_knows_its_own_echo(role):
    """What the port does not mark as our own somebody else has said: twice in a row, so we listen; and twice again."""
    master = Master(500_000, address=5, role=role, echo=True)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)

    def own() -> None:
        while (sent := script.next(tokens=True))[0] != 0xDC:
            feed(master.machine, sent, script.now, script.character, echo=True)
        feed(master.machine, sent, script.now, script.character, echo=True)

    for _ in range(5):
        own()
        script.answer(token(5, 5), tsdr=37)
        assert master.status.fdl_state != lib.DPM_FDL_LISTEN_TOKEN, "a copy now and then, ours in between"
    script.answer(token(5, 5), tsdr=37)
    assert master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN and not master.view.duplicate
    script.answer(token(5, 5), tsdr=37)
    assert master.status.mode == lib.DPM_MODE_STOP
    script.answer(token(5, 5), tsdr=37)
    assert master.view.duplicate and master.status.mode == lib.DPM_MODE_OFFLINE
    assert script.next(limit=1 * S, tokens=True) == b""


def test_a_sole_master_counts_copies_of_its_token_anew_when_it_has_given_way():
    """One long before the foreign master is no first of two."""
    master = Master(500_000, address=5, echo=True)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    feed(master.machine, script.next(tokens=True), script.now, script.character, echo=True)
    for sent in (token(5, 5), token(9, 2), token(5, 5)):
        script.answer(sent, tsdr=37)
    assert master.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN and master.status.mode == lib.DPM_MODE_STOP
    script.answer(token(5, 5), tsdr=37)
    assert master.view.duplicate


def test_a_sole_master_whose_port_does_not_know_its_echo_hears_no_duplicate():
    master = Master(500_000, address=5)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    for n in range(10):
        script.answer(script.next(tokens=True), tsdr=0)
        assert master.status.fdl.stray == n + 1
    assert master.status.fdl.tokens == 10 and master.status.mode == lib.DPM_MODE_STOP


def test_in_the_ring_two_foreign_tokens_of_ours_in_a_row_lead_to_listening():
    bus = Bus()
    bus.entered()
    bus.passed()
    bus.script.answer(token(2, 9), tsdr=37)
    bus.script.answer(token(9, 5), tsdr=37)
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE
    bus.script.answer(token(9, 5), tsdr=200)
    assert bus.state == lib.DPM_FDL_LISTEN_TOKEN


@pytest.mark.parametrize("held", ["by a GAP poll", "by a request"])
def test_a_copy_of_our_token_while_we_hold_it_is_one_that_another_takes(held):
    """A token doubled on its way: NS has it now, and talking on would be talking in step with it, slot after slot."""
    bus = Bus()
    bus.entered()
    if held == "by a request":
        bus.master.request(30, lib.DPM_SRD_HIGH, b"\1")
    assert bus.script.next(tokens=True)[0] != 0xDC
    bus.script.answer(token(9, 5), tsdr=50)
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE
    assert bus.script.next(limit=bus.script.bits(5 * TSL), tokens=True) == b""


@pytest.mark.parametrize("noise", ["E5", "FF", "00 00", "68", "DC 05"])
@pytest.mark.parametrize("moment", range(4))
def test_noise_at_every_moment_of_a_token_pass_heals(noise, moment):
    """Two stations of ours; the ring is whole again within the standard's times."""
    parameters = default_parameters(500_000)
    masters = [Master(parameters=parameters, address=a, role=RING, slaves=1) for a in (5, 9)]
    for master in masters:
        master.mode(lib.DPM_MODE_STOP)
    wire = Wire(parameters, *(m.machine for m in masters))
    wire.run_until(lambda: all(m.las == {5, 9} for m in masters))
    wire.run(wire.now + 20 * MS)
    while wire.log[-1].octets[0] != 0xDC:
        wire.step()
    for _ in range(moment):
        wire.step()
    wire.mangle = lambda sent: (octets(noise) + sent.octets, sent.octets + octets(noise), octets(noise), b"")[moment]
    wire.step()
    wire.mangle = lambda sent: None
    before = [m.view.rotations for m in masters]
    wire.run(wire.now + wire.character * 3 * 40 + 16 * 400_000 * 2)
    assert all(m.view.rotations > b + 3 for m, b in zip(masters, before, strict=True))
    assert all(m.las == {5, 9} for m in masters)


# --- self-listening -----------------------------------------------------------------------------------------------------

TOKEN, GARBLE, LOSE = lib.DPM_TRAFFIC_TOKEN, lib.DPM_FAULT_GARBLE, lib.DPM_FAULT_LOSE


class Echoing:
    """A ring of ours at 5 and 9 on the simulated segment, behind ports that hear themselves."""

    def __init__(self, *addresses: int, role: int = RING, told: bool = False, **host: int) -> None:
        parameters = default_parameters(500_000)
        late = LATE_WAKES * host.get("lateness", 0) // 3 + host.get("chunk", 0)
        parameters.tsl = max(TSL, lib.dpm_ring_tsl(parameters, late))
        parameters.hsa = 12
        self.masters = [Master(parameters=parameters, address=a, role=role, slaves=1, echo=told, allowance=late,
                               granularity=late) for a in addresses]
        self.wire = Simulation(parameters)
        for master in self.masters:
            self.wire.attach(master, echo=True, **host)
            master.mode(lib.DPM_MODE_STOP)
        self.wire.run(1 * S, violation=False)
        assert all(master.las == set(addresses) for master in self.masters)
        self.wire.clear()

    def spoil(self, fault: int, *nth: int) -> None:
        """What becomes of coming tokens to 9."""
        for n in nth:
            self.wire.plan(TOKEN, fault, nth=n, address=9)

    def told(self, i: int = 0) -> list[int]:
        return [e.a for e in self.masters[i].events() if e.kind == lib.DPM_EV_ECHO]


@pytest.mark.parametrize("host", [{}, {"lateness": 100 * US}, {"chunk": 400 * US}], ids=["exact", "late", "chunk"])
def test_a_fine_echo_changes_nothing(host):
    bus = Echoing(5, 9, **host)
    bus.wire.run(tokens=400)
    bus.wire.check()
    assert all(m.status.fdl.tokens_spoilt == m.status.fdl.tokens_lost == 0 and m.las == {5, 9} for m in bus.masters)
    idle = [b.start - a.end for a, b in pairwise(bus.wire.tap(40)) if a.kind == "token"]
    if not host:
        assert max(idle) < bus.wire.bits(37.1), "the echo is over with the frame: it costs no time"


@pytest.mark.parametrize("fault", [GARBLE, LOSE])
def test_an_own_token_that_comes_back_wrong_once_is_passed_again(fault):
    """It may be the line's fault: "as if it had been received correctly". Whoever hears no reaction first repeats its pass."""
    bus = Echoing(5, 9)
    bus.spoil(fault, 1)
    bus.wire.run(tokens=100, violation=False)
    assert bus.masters[0].status.fdl.tokens_spoilt == 1
    assert sum(m.status.fdl.token_repetitions for m in bus.masters) == 1
    assert all(m.las == {5, 9} for m in bus.masters) and bus.told() == []


def test_an_own_token_that_comes_back_wrong_twice_is_the_transceivers_fault():
    """Out of the ring, to Listen_Token, and reported (protocol page E.1): not a third try, and silence for Tto at least."""
    bus = Echoing(5, 9)
    bus.spoil(GARBLE, 1, 2)
    five, nine = bus.masters
    bus.wire.run(1 * MS, violation=False)
    assert bus.told() == [0] and five.status.fdl.tokens_spoilt == 2 and five.las == {5}
    assert five.status.fdl_state == lib.DPM_FDL_LISTEN_TOKEN
    sent = five.status.fdl.tokens
    bus.wire.run(until=bus.wire.tap(1)[0].end + bus.wire.bits((6 + 2 * 5) * TSL) - 1, violation=False)
    assert five.status.fdl.tokens == sent
    bus.wire.run(50 * MS, violation=False)
    assert five.las == nine.las == {5, 9}, "it was the line after all"


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("role", [RING, lib.DPM_ROLE_SOLE])
def test_who_hears_nothing_of_its_own_tokens_leaves_the_bus(role, told):
    """A dead transceiver: deaf as well, it would claim a token that others have (EN 50170 part 4: to Offline)."""
    bus = Echoing(9, role=role, told=told)
    bus.spoil(LOSE, 1, 2)
    nine = bus.masters[0]
    bus.wire.run(100 * MS, violation=False)
    assert bus.told() == [1] and nine.status.mode == lib.DPM_MODE_OFFLINE
    assert nine.status.fdl_state == lib.DPM_FDL_OFFLINE
    sent = nine.status.fdl.tokens
    bus.wire.run(1 * S)
    assert nine.status.fdl.tokens == sent
    nine.mode(lib.DPM_MODE_STOP, bus.wire.now)
    bus.wire.run(100 * MS)
    assert nine.status.fdl.tokens > sent + 10, "the program may try again"


def test_a_transmitter_that_was_never_alive_claims_nothing_for_long():
    """Where the port is told of its echo, the first two tokens tell."""
    master = Master(500_000, address=5, role=RING, echo=True)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    assert script.next(tokens=True) == script.next(tokens=True) == token(5, 5)
    assert script.next(limit=1 * S, tokens=True) == b"" and master.status.fdl_state == lib.DPM_FDL_OFFLINE


def test_a_successor_that_goes_on_has_the_token_however_it_came_back():
    """Our receiver was wrong, not the token: a rotation later it counts from the beginning."""
    bus = Bus(echo=True)
    bus.listened()
    bus.script.answer(status(5, 2), tsdr=37)
    bus.script.next(limit=bus.script.bits(120))
    for _ in range(4):
        bus.script.answer(token(5, 2), tsdr=37)
        while (sent := bus.script.next(tokens=True)) != token(9, 5):
            feed(bus.master.machine, sent, bus.script.now, bus.script.character, echo=True)
        feed(bus.master.machine, b"\xdc\x09\x45", bus.script.now, bus.script.character, echo=True)
        bus.script.answer(token(2, 9), tsdr=37)
    assert bus.state == lib.DPM_FDL_ACTIVE_IDLE and bus.master.status.fdl.tokens_spoilt == 4


# --- a host that wakes late, the live list ------------------------------------------------------------------------------


def late_bus() -> Bus:
    parameters = default_parameters(500_000)
    parameters.tsl = lib.dpm_ring_tsl(parameters, 2 * MS)
    bus = Bus(parameters=parameters, allowance=2 * MS)
    bus.entered()
    bus.passed()
    return bus


@pytest.mark.parametrize("asked", [False, True], ids=["", "asked before it has read"])
def test_a_token_that_may_be_older_than_a_slot_is_not_used(asked):
    """The predecessor says it again a slot later, and two would talk at once. Nor does a rotation end with it."""
    bus = late_bus()
    heard = bus.script.answer(token(2, 9), tsdr=37)
    rotations = bus.master.view.rotations
    bus.script.now += bus.script.bits(1115)  # the host slept meanwhile: when the token came, it cannot tell
    if asked:
        assert not Offer(bus.master.machine, bus.script.now).octets
    bus.script.answer(token(5, 2), tsdr=0)
    assert bus.master.view.rotations == rotations
    assert bus.script.next(limit=MS, tokens=True) == b""
    assert bus.master.status.fdl.tokens_lost == 1 and bus.script.now > heard
    bus.script.answer(token(5, 2), tsdr=10)
    assert bus.script.next(limit=MS, tokens=True) != b""


@pytest.mark.parametrize(("waits", "delivery", "speaks"), [(200 - 12, 0, True), (200 - 10, 0, False), (320 - 112, 100, True),
                                                         (320 - 110, 100, False)])
def test_the_first_telegram_is_heard_within_the_predecessors_slot(waits, delivery, speaks):
    """A character of it, or the longest where telegrams are handed over whole, has ended by then: else two talk at once."""
    parameters = default_parameters(500_000)
    parameters.tsl = 320 if delivery else TSL
    bus = Bus(parameters=parameters, delivery=2000 * delivery)
    bus.entered()
    bus.script.now += bus.script.bits(waits)
    assert (bus.script.next(limit=bus.script.bits(1), tokens=True) != b"") is speaks
    assert bus.master.status.fdl.tokens_lost == (not speaks)


@pytest.mark.parametrize("addresses", [(5, 9), (0, 3, 9, 12)])
@pytest.mark.parametrize(("rate", "lateness"), [(9600, 100 * MS), (500_000, 10 * MS), (12_000_000, 100 * US)])
def test_a_ring_of_late_hosts_loses_no_token(rate, lateness, addresses):
    """Tsl = max Tsdr + 15 + allowance, each wake late: the allowance lies inside the slot, and no rule is broken."""
    parameters = default_parameters(rate)
    parameters.tsl, parameters.hsa = lib.dpm_ring_tsl(parameters, LATE_WAKES * lateness // 3), 12
    masters = [Master(parameters=parameters, address=a, role=RING, slaves=1, allowance=LATE_WAKES * lateness // 3,
                      granularity=lateness) for a in addresses]
    wire = Simulation(parameters)
    for i, master in enumerate(masters):
        wire.attach(master, lateness=lateness, seed=rate + i)
        master.mode(lib.DPM_MODE_STOP)
    while any(master.las != set(addresses) for master in masters):
        wire.run(20_000 * wire.bits(parameters.tsl), tokens=100)
        wire.check()
    begin = [m.status.fdl.tokens_lost + m.status.fdl.token_repetitions for m in masters]
    wire.run(tokens=1500)
    wire.check()
    assert [m.status.fdl.tokens_lost + m.status.fdl.token_repetitions for m in masters] == begin


def test_a_late_host_looks_so_often_that_it_can_tell():
    bus = late_bus()
    heard = bus.script.answer(token(2, 9), tsdr=37)
    assert Offer(bus.master.machine, heard).wake == heard + bus.script.bits(1115) // 4
    assert bus.script.next(limit=2 * MS, tokens=True) == b""
    bus.script.answer(token(5, 2), tsdr=0)
    assert bus.script.next(limit=MS, tokens=True) != b""
    assert bus.master.status.fdl.tokens_lost == 0


@pytest.mark.parametrize("asked", [False, True], ids=["", "asked before it has read"])
@pytest.mark.parametrize("role", [lib.DPM_ROLE_SOLE, RING])
def test_a_request_that_may_be_old_is_not_answered(role, asked):
    """Who has asked has gone on: the answer would meet another telegram."""
    parameters = default_parameters(500_000)
    parameters.tsl = lib.dpm_ring_tsl(parameters, 2 * MS)
    master = Master(parameters=parameters, address=5, role=role, allowance=2 * MS)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    for away, answered in ((0, True), (2 * MS, True), (30 * MS, False), (0, True)):
        script.answer(token(2, 9), tsdr=37)
        heard = Offer(master.machine, script.now)
        assert heard.wake <= script.now + script.bits(1115) // 4, "it looks whether somebody asks"
        script.now += away
        if asked:
            assert not Offer(master.machine, script.now).octets
        script.answer(status(5, 2), tsdr=0)
        assert (script.next(limit=MS) != b"") is answered, away
    assert master.status.fdl.late_dropped == 1


@pytest.mark.parametrize("role", [lib.DPM_ROLE_SOLE, lib.DPM_ROLE_RING, lib.DPM_ROLE_PASSIVE])
def test_answers_to_others_tell_who_is_there(role):
    """Bits 5 and 4 of an answer's FC are the station type, whatever it answers (protocol page C.3)."""
    master = Master(500_000, address=5, role=role)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    script.answer(token(9, 2), tsdr=37)
    script.answer("68 05 05 68 88 82 6D 3C 3E F1 16", tsdr=37)  # B.4 #17, #18
    script.answer("68 0B 0B 68 82 88 08 3E 3C 02 05 00 FF 0A 35 D1 16", tsdr=50)
    script.answer(status(7, 2), tsdr=37)
    script.answer(answer(2, 7, 0x10), tsdr=50)
    live = master.view.live
    assert (live[8], live[7], live[2], live[9]) == (lib.DPM_LIVE_SLAVE, lib.DPM_LIVE_MASTER_NOT_READY,
                                                  lib.DPM_LIVE_MASTER_IN_RING, lib.DPM_LIVE_UNKNOWN)
    changed = [e.address for e in master.events() if e.kind == lib.DPM_EV_LIVE]
    assert changed == [2, 8, 7]


def test_nobody_where_nobody_was_is_no_event():
    bus = Bus()
    bus.entered()
    bus.passed()
    assert bus.master.view.live[6] == lib.DPM_LIVE_NONE
    assert 6 not in [e.address for e in bus.master.events() if e.kind == lib.DPM_EV_LIVE]


def test_who_was_passed_over_is_unknown():
    bus = Bus()
    bus.entered()
    bus.passed()
    bus.script.answer(token(2, 9), tsdr=37)
    bus.script.answer(token(5, 2), tsdr=37)
    bus.passed()
    assert bus.master.view.live[9] == lib.DPM_LIVE_MASTER_IN_RING
    bus.script.answer(token(12, 9), tsdr=37)
    bus.script.answer(token(2, 12), tsdr=37)
    bus.script.answer(token(5, 2), tsdr=37)
    assert bus.passed() == token(9, 5)
    bus.script.answer(token(2, 9), tsdr=37)  # 12 was passed over
    assert bus.master.view.live[12] == lib.DPM_LIVE_UNKNOWN and bus.master.las == {2, 5, 9}


def test_ident_is_answered_and_closed_services_are_refused():
    """B.4 #40 asks for Ident; four lengths and the texts. SDA and LSAP status: no SAP is open."""
    bus = Bus()
    bus.script.next(limit=bus.script.bits(50))
    bus.script.answer(bytes([0x10, 5, 2, 0x4E, 0x55, 0x16]), tsdr=37)
    told = bus.script.next(limit=bus.script.bits(120))
    assert told[4:7] == bytes([2, 5, 0x18]), "DL, from a master that is not ready"
    lengths, texts = told[7:11], told[11:-2]
    assert sum(lengths) == len(texts) and texts[: lengths[0]] == b"dpmaster"
    for fc in (0x4F, 0x65, 0x43, 0x6D):  # LSAP status, SDA high and low, SRD
        bus.script.answer(bytes([0x68, 4, 4, 0x68, 5, 2, fc, 1, (8 + fc) & 0xFF, 0x16]), tsdr=60)
        assert bus.script.next(limit=bus.script.bits(120)) == answer(2, 5, 0x13)


# --- roles ---------------------------------------------------------------------------------------------------------------


def test_a_host_that_wakes_late_needs_room_in_the_slot():
    """Design: max Tsdr + 15 + allowance <= Tsl, else it does not enter; the error names the Tsl needed."""
    assert Master(500_000, role=RING, allowance=2 * MS).result == lib.DPM_E_SLOT
    parameters = default_parameters(500_000)
    needed = lib.dpm_ring_tsl(parameters, 2 * MS)
    assert needed == 100 + 15 + 1000
    parameters.tsl = needed - 1
    assert Master(parameters=parameters, role=RING, allowance=2 * MS).result == lib.DPM_E_SLOT
    parameters.tsl = needed
    assert Master(parameters=parameters, role=RING, allowance=2 * MS).result == 0
    assert Master(parameters=parameters, role=RING, allowance=1 * MS, delivery=1 * MS).result == 0
    assert Master(parameters=parameters, role=RING, allowance=2 * MS, delivery=1 * MS).result == lib.DPM_E_SLOT


def test_a_passive_station_never_sends_a_bit():
    master = Master(500_000, address=5, role=lib.DPM_ROLE_PASSIVE)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    for _ in range(4):
        script.answer(token(9, 2), tsdr=37)
        script.answer(token(2, 9), tsdr=37)
        script.answer(status(5, 2), tsdr=37)
        assert script.next(limit=20 * MS, tokens=True) == b""
    assert master.las == {2, 9}
    assert script.next(limit=10 * S, tokens=True) == b""


def test_a_passive_station_that_was_off_the_bus_listens_from_the_beginning():
    master = Master(500_000, address=5, role=lib.DPM_ROLE_PASSIVE)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)

    def rotate() -> None:
        script.answer(token(9, 2), tsdr=37)
        script.answer(token(2, 9), tsdr=37)

    for _ in range(3):
        rotate()
    before = master.view
    for mode in (lib.DPM_MODE_OFFLINE, lib.DPM_MODE_STOP):
        master.mode(mode, script.now)
    assert before.rotations == 2 and master.las == set()
    script.now += 1000 * S
    rotate()
    assert (master.view.rotations, master.view.trr_max) == (2, before.trr_max)
    rotate()
    assert (master.view.rotations, master.view.trr) == (3, before.trr)


def test_only_whole_rotations_are_measured():
    """Trr is from token to token, alone, too: not from the answer that brought the first one (protocol page D.1)."""
    bus = Bus()
    bus.entered()
    assert bus.master.view.rotations == 1 and bus.master.view.trr == 0
    came = bus.script.now
    bus.passed()
    bus.script.answer(token(2, 9), tsdr=37)
    bus.script.answer(token(5, 2), tsdr=37)
    view = bus.master.view
    assert view.rotations == 2 and view.trr == view.trr_min == view.trr_max == bus.script.now - came
    master = Master(500_000, address=5, role=RING)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    ends = []
    while len(ends) < 4:
        if script.next(tokens=True) == token(5, 5):
            ends.append(script.last.end)
    view = master.view  # the second token of the claim is no rotation's end
    assert (view.rotations, view.trr) == (2, ends[3] - ends[2])
    assert {view.trr_min, view.trr_max} == {b - a for a, b in pairwise(ends[1:])}


def test_a_passive_station_has_no_address():
    """Nobody is a duplicate of it, and it counts rotations from wrap to wrap."""
    master = Master(500_000, address=9, role=lib.DPM_ROLE_PASSIVE)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    for _ in range(4):
        script.answer(token(9, 2), tsdr=37)
        script.answer(token(2, 9), tsdr=37)
    view = master.view
    assert master.las == {2, 9} and view.rotations == 3 and view.live[9] == lib.DPM_LIVE_MASTER_IN_RING
    assert view.trr == view.trr_min == view.trr_max == pytest.approx(script.bits(2 * (33 + 37)), abs=1000)
    for _ in range(3):
        script.answer(token(9, 9), tsdr=37)
    assert master.status.fdl_state == lib.DPM_FDL_PASSIVE_IDLE and not master.view.duplicate
    assert master.las == {9} and master.view.live[2] == lib.DPM_LIVE_UNKNOWN
    assert script.next(limit=10 * S, tokens=True) == b""


def test_data_exchange_goes_on_in_a_ring_of_two_masters():
    """Each with a slave of its own: both exchange, and neither slave ever hears the wrong one."""
    parameters = default_parameters(1_500_000)
    slaves = Slaves(parameters=parameters)
    masters = []
    for address, slave in ((1, 30), (2, 31)):
        master = Master(parameters=parameters, address=address, role=RING, slaves=1)
        master.add(slave, 0x00CA, b"\x72", watchdog=(1, 10))
        slaves.add(slave, 0x00CA, b"\x72", user=(0, 0))
        master.mode(lib.DPM_MODE_OPERATE)
        masters.append(master)
    wire = Wire(parameters, *(m.machine for m in masters), slaves.machine)
    wire.run_until(lambda: all(m.slave(0).state == lib.DPM_ST_DATA for m in masters))
    for i, master in enumerate(masters):
        master.commit(0, bytes([i + 1] * 6), wire.now)
    wire.run(wire.now + 100 * MS)
    for i, master in enumerate(masters):
        frame = slaves.outputs(i)
        assert bytes(frame.octets[0:6]) == bytes([i + 1] * 6) and frame.valid
        report = slaves.report(i)
        assert report.master == master.view.ts and report.watchdog_expired == 0
        assert master.slave(0).statistics.exchanges > 90 and master.slave(0).statistics.repetitions == 0


# --- a sole master beside a ring -------------------------------------------------------------------------------------------


class Beside:
    """A master of a ring whose Tsl is for late hosts, and later a sole one with the standard Tsl, on ports of the same kind."""

    def __init__(self, rate: int, allowance: int, seed: int = 0, **options) -> None:
        self.ring = default_parameters(rate)
        self.ring.tsl = lib.dpm_ring_tsl(self.ring, allowance)
        host = {"lateness": allowance // 20, "seed": seed}
        self.owner = Master(parameters=self.ring, address=2, role=RING, allowance=allowance, slaves=1)
        self.guest = Master(rate, address=0, allowance=allowance, slaves=1)
        self.wire = Simulation(self.ring)
        self.port = self.wire.attach(self.owner, **host)
        self.owner.mode(lib.DPM_MODE_STOP)
        while self.owner.status.fdl.gap_polls < 125:  # then it rests, and is silent for as long as it ever is
            self.wire.run(100 * MS)
        self.wire.attach(self.guest, **(host | {"seed": seed + 1}))

    def begin(self) -> None:
        self.guest.mode(lib.DPM_MODE_STOP, self.wire.now)


@pytest.mark.parametrize("rate, allowance", [(500_000, 25 * MS), (500_000, 2 * MS), (93_750, 25 * MS), (9600, 25 * MS)])
def test_a_sole_master_does_not_talk_over_an_idle_one_with_a_long_slot(rate, allowance):
    """Its Tto is of the standard Tsl; the other one, idle, says its token often enough for that."""
    for seed in range(6):
        bus = Beside(rate, allowance, seed)
        bus.wire.run(7 * seed * MS)
        bus.begin()
        for _ in range(20 * (seed % 2)):
            bus.owner.request(100, lib.DPM_FDL_STATUS)  # a slot of silence each
        bus.wire.run(3 * S)
        assert bus.guest.status.fdl.tokens == 0, "not one telegram"
        assert bus.owner.status.fdl.tokens_lost == 0 and bus.wire.statistics.collisions == 0


def test_a_sole_master_takes_the_bus_when_the_other_one_is_gone():
    bus = Beside(500_000, 25 * MS)
    bus.begin()
    bus.wire.run(1 * S)
    bus.wire.power(bus.port, False)
    bus.wire.run(1 * S, violation=False)
    assert bus.guest.status.fdl.tokens > 0


def test_the_time_off_the_bus_is_no_silence_of_that_ring():
    """Octets may come before the first look at the bus: from when it was Offline no silence is known."""
    master = Master(500_000, address=0)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    assert script.next(tokens=True) == token(0, 0)
    script.answer(token(9, 5), tsdr=100)
    for mode in (lib.DPM_MODE_OFFLINE, lib.DPM_MODE_STOP):
        master.mode(mode, script.now)
    script.now += 1000 * S
    end = script.answer(token(9, 5), tsdr=100)
    assert script.next(tokens=True) == token(0, 0)
    assert script.idle_bits(end) == pytest.approx(6 * TSL, abs=1)


def test_who_gave_way_waits_for_four_times_the_longest_silence_of_that_ring():
    """It does not know that ring's Tsl, but what it has heard of it."""
    master = Master(500_000, address=0)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    assert script.next(tokens=True) == token(0, 0)
    for silence in (100, 900, 1100, 300):  # Tto is 1200
        script.answer(token(9, 5), tsdr=silence)
    end = script.now
    assert script.next(tokens=True) == token(0, 0)
    assert script.idle_bits(end) == pytest.approx(4 * (1100 + 11), abs=1), "to the end of the first octet"


def test_what_the_host_was_away_is_no_silence_of_that_ring():
    """A suspended computer would leave a silent bus to nobody for four times as long."""
    master = Master(500_000, address=0, allowance=2 * MS)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    assert script.next(tokens=True) == token(0, 0)
    script.answer(token(9, 5), tsdr=100)
    script.silence(script.bits(300))
    script.now += 3600 * S
    script.answer(token(9, 5), tsdr=0)
    end = script.now
    assert script.next(limit=S, tokens=True) == token(0, 0) and script.now - end < 20 * MS
