# SPDX-License-Identifier: MIT
"""Many stations of ours in one ring, on the simulated segment, which watches every rule of the wire.

Each run is made of its seed: the rate, 1 to 8 addresses, HSA, whether ports echo, when each is switched on, off and on again.
200 runs belong to the tests, `make soak` makes 10 000 (DPM_SOAK_RUNS). A failure names the seed: `DPM_SOAK_SEED=2047
DPM_SOAK_RUNS=1`.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator

import pytest
from simulation import Simulation, Talker
from wire import MS, Master, S, Slaves, default_parameters, lib, octets

RATES = (9600, 19200, 45450, 93750, 187500, 500000, 1500000, 3000000, 6000000, 12000000)
RUNS = int(os.environ.get("DPM_SOAK_RUNS", "200"))
SECONDS = int(os.environ.get("DPM_SOAK_SECONDS", "2"))
FIRST = int(os.environ.get("DPM_SOAK_SEED", "0"))
RING = lib.DPM_ROLE_RING
TSL = 200  # Tbit at 500 kbit/s


class Ring:
    """Masters of ours, in Stop, on a wire of their own; all without power."""

    def __init__(self, rate: int, addresses: list[int], *, hsa: int = 126, tap: int = 64, grace: int = 20,
                 echo: bool = False, slots: int = 0, g: int = 0) -> None:
        parameters = default_parameters(rate)
        parameters.hsa = hsa
        parameters.ttr = slots * parameters.tsl or parameters.ttr
        parameters.g = g or parameters.g
        self.tsl = int(lib.dpm_bits_up(parameters, parameters.tsl))
        self.masters = [Master(parameters=parameters, address=a, slaves=2, role=RING) for a in addresses]
        self.wire = Simulation(parameters, ports=16, tap=tap, grace=grace * self.tsl)
        self.ports = [self.wire.attach(master, echo=echo) for master in self.masters]
        self.on = [False] * len(addresses)
        self.addresses = addresses
        self.coincidences = 0
        for port in self.ports:
            self.wire.power(port, False)

    def switch(self, i: int, on: bool) -> None:
        if on == self.on[i]:
            return
        self.on[i] = on
        if on:
            self.masters[i].mode(lib.DPM_MODE_STOP, self.wire.now)
        self.wire.power(self.ports[i], on)
        if not on:
            self.masters[i].mode(lib.DPM_MODE_OFFLINE, self.wire.now)

    def formed(self) -> bool:
        """Every station knows all of those that have power, and no other."""
        running = {a for a, on in zip(self.addresses, self.on, strict=True) if on}
        return all(m.las == running and m.status.fdl_state >= lib.DPM_FDL_ACTIVE_IDLE
                   for m, on in zip(self.masters, self.on, strict=True) if on)

    def run(self, until: int) -> None:
        """Run, and fail on any broken rule but one: stations switched on at different times may find Tto over within the
        same character, and nobody knows of a character that has not ended. Such claims collide, and are counted."""
        while self.wire.run(until=max(until, self.wire.now + 1)) == lib.DPM_STOPPED_VIOLATION:
            claims = [t for t in self.wire.tap(2) if t.octets[:1] == b"\xdc" and t.octets[1] == t.octets[2]]
            if len(claims) < 2 or claims[1].start - claims[0].start > self.wire.bits(11):
                self.wire.check()
            self.wire.run(200 * self.tsl, violation=False)
            self.wire.clear()
            self.coincidences += 1

    def form(self, slots: int = 200_000) -> None:
        end = self.wire.now + slots * self.tsl
        while not self.formed():
            assert self.wire.now < end, f"no ring: {[sorted(m.las) for m in self.masters]}\n" + "\n".join(
                str(t) for t in self.wire.tap(30))
            self.run(self.wire.now + 500 * self.tsl)
        self.wire.check()

    def rotate(self, rotations: int) -> None:
        """So many rotations without one broken rule, each station with its share."""
        n = sum(self.on)
        self.wire.clear()
        self.wire.run(tokens=rotations * n)
        self.wire.check()
        shares = [int(self.wire.share(a).tokens) for a, on in zip(self.addresses, self.on, strict=True) if on]
        assert min(shares) >= rotations - 1 and max(shares) <= rotations + 1, shares
        assert self.formed()


    def rotation(self, stations: int) -> int:
        """Bit times of a rotation in which somebody polls an address that nobody has."""
        tid1 = int(lib.dpm_tid1(self.wire.parameters))
        return stations * (33 + tid1) + 66 + int(self.wire.parameters.tsl) + tid1

    def heal(self) -> None:
        """Whole again in time: two that both believe to have the token part within the slots of its three tries; behind that
        no rule is broken, and a GAP round finds who fell out."""
        self.wire.run(3 * self.tsl, violation=False)
        self.wire.clear()
        end = self.wire.now + 126 * self.wire.bits(self.rotation(len(self.addresses)))
        while not self.formed():
            assert self.wire.now < end, f"no ring: {[sorted(m.las) for m in self.masters]}"
            self.wire.run(20 * self.tsl)
            self.wire.check()


def all_on(rate: int, *addresses: int, **options: int) -> Ring:
    ring = Ring(rate, list(addresses), **options)
    for i in range(len(addresses)):
        ring.switch(i, True)
    ring.form()
    return ring


# --- random rings ------------------------------------------------------------------------------------------------------


def one_run(seed: int) -> Ring:
    """A ring from its seed: it forms, and then 500 rotations without one broken rule."""
    rng = random.Random(seed)
    rate, addresses = rng.choice(RATES), rng.sample(range(126), rng.randint(1, 8))
    ring = Ring(rate, addresses, hsa=max(addresses) if rng.random() < 0.5 else 126, echo=seed % 2 == 1)
    switches = [(rng.randrange(200 * ring.tsl), i) for i in range(len(addresses))]
    switches += [(rng.randrange(4000 * ring.tsl), rng.randrange(len(addresses))) for _ in range(rng.randint(0, 6))]
    for moment, i in sorted(switches):
        ring.run(moment)
        ring.switch(i, not ring.on[i])
    for i in range(len(addresses)):
        ring.switch(i, True)
    ring.form()
    ring.rotate(500)
    return ring


@pytest.mark.timeout(3600)
def test_rings_of_any_size_form_and_keep_every_rule():
    simulated, coincidences = 0.0, 0
    for seed in range(FIRST, FIRST + RUNS):
        try:
            ring = one_run(seed)
            simulated += ring.wire.now / S
            coincidences += ring.coincidences
        except AssertionError as failure:
            raise AssertionError(f"seed {seed}: {failure}") from failure
    print(f"{RUNS} runs from seed {FIRST}, {simulated:.0f} s of bus, {coincidences} claims in the same character")
    assert coincidences <= RUNS / 50


# --- what breaks a ring --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [9600, 500_000, 12_000_000])
@pytest.mark.parametrize("fault", ["LOSE", "GARBLE", "DOUBLE", "DELAY"])
def test_a_token_lost_spoilt_doubled_or_late_heals(rate, fault):
    """Within Tto of the lowest address, three slots of repetitions, and a rotation."""
    ring = all_on(rate, 3, 7, 40)
    for nth in (1, 2, 3, 5):
        ring.wire.plan(lib.DPM_TRAFFIC_TOKEN, getattr(lib, f"DPM_FAULT_{fault}"), nth=nth, after=50 * ring.tsl // 100)
        before = [m.view.rotations for m in ring.masters]
        ring.wire.run((6 + 2 * 3 + 3 * 3 + 10) * ring.tsl, violation=False)
        assert all(m.view.rotations > n for m, n in zip(ring.masters, before, strict=True))
        ring.form(20_000)
    ring.rotate(50)


def moments(ring: Ring, per: float) -> Iterator[int]:
    """Every `per` bit times of a rotation with a GAP poll, in ns: each one behind a new token of the first station's."""
    for step in range(int(ring.rotation(3) / per)):
        ring.wire.run(transmissions=1)
        while ring.wire.tap(1)[0].octets != octets("DC 07 03"):
            ring.wire.run(transmissions=1)
        yield ring.wire.tap(1)[0].start + ring.wire.bits(step * per) + 1


def test_a_master_that_dies_at_any_moment_is_left_out_and_comes_back():
    """Among others when it has the token, in the middle of passing it, when it was just asked."""
    ring = all_on(1_500_000, 3, 7, 40, slots=20, g=1)
    for n, moment in enumerate(moments(ring, 1)):
        ring.wire.run(until=moment)
        ring.switch(n % 3, False)
        ring.heal()
        ring.switch(n % 3, True)
        ring.form()
    ring.rotate(50)


def test_two_halves_of_a_cut_wire_go_on_and_join_again_at_any_moment():
    ring = all_on(500_000, 3, 7, 40, 90, slots=20, g=1)
    for moment in moments(ring, 5.5):
        ring.wire.run(until=moment)
        ring.wire.place(1, ring.ports[1], ring.ports[3])
        ring.wire.run(200 * ring.tsl, violation=False)
        assert [m.las for m in ring.masters] == [{3, 40}, {7, 90}, {3, 40}, {7, 90}]
        ring.wire.place(0, *ring.ports)
        ring.heal()
    ring.rotate(100)


# A foreign octet, beginnings of telegrams; a token doubled, of another to itself, to and from who is not there; answers and
# requests of members.
NOISE = ("E5", "FF 00", "68 05 05 68", "10", "DC 07", "DC 07 03", "DC 03 28", "DC 28 28", "DC 28 07", "DC 14 28", "DC 07 14",
         "10 03 07 30 3A 16", "10 07 28 49 78 16")


@pytest.mark.parametrize(("rate", "per"), [(9600, 1), (500_000, 1), (12_000_000, 5.5)])
def test_noise_at_every_moment_of_a_token_pass(rate, per):
    """At each bit time of a rotation, at 12 Mbit/s at each half octet: the ring heals within the standard's times."""
    ring = all_on(rate, 3, 7, 40, slots=20, g=1)
    for noise in NOISE:
        for moment in moments(ring, per):
            ring.wire.inject(moment, octets(noise))
            try:
                ring.heal()
            except AssertionError as failure:
                raise AssertionError(f"{noise} at {moment}: {failure}") from failure
    ring.rotate(50)


@pytest.mark.parametrize("spoils", [
    ("10 1E 14 49 7B 16",),  # station 20 says a request with a token that it never had,
    ("10 1E 14 49 7B 16", "DC 28 14", "DC 28 14"),  # and hands it on to 40, as if 7 was not there,
    ("DC 03 14", "DC 03 14"),  # or backwards,
    ("DC 14 14", "DC 14 14", "10 15 14 49 72 16"),  # or keeps it,
    ("DC 28 07", "DC 28 07"),  # or has the address of a member
])
def test_a_token_stolen_at_every_moment(spoils):
    """A station that takes a token which is not its own, at each bit time of a rotation, and is silent when it has sinned."""
    ring = all_on(500_000, 3, 7, 40, slots=20, g=1)
    thief = Talker()
    port = ring.wire.attach(thief)
    for moment in moments(ring, 1):
        ring.wire.power(port, True)
        for spoil in spoils:
            thief.say(moment, octets(spoil))
            moment += ring.wire.bits(11 * len(octets(spoil)) + TSL)
        ring.wire.run(until=moment, violation=False)
        ring.wire.power(port, False)
        try:
            ring.heal()
        except AssertionError as failure:
            raise AssertionError(f"{spoils} until {moment}: {failure}") from failure
    ring.rotate(50)


# --- a bus at work ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", RATES)
def test_a_single_master_wastes_nothing_with_hsa_126(rate):
    """Mean cycle over many cycles behind the first GAP round against the sum of T_DX (real Tsdr) and T_token: at most 1.02;
    no cycle longer than that and one T_gap (peers.md: a peer with HSA 126 loses a factor of 17)."""
    cycles = int(os.environ.get("DPM_SOAK_CYCLES", "1000"))
    parameters = default_parameters(rate)
    slaves = Slaves(parameters=parameters, slaves=8)
    master = Master(parameters=parameters, address=1, slaves=8, role=RING, control_interval=1200 * S)
    for address in range(10, 18):
        slaves.add(address, 0x00CA, b"\x72", user=(0, 0))
        master.add(address, 0x00CA, b"\x72")
    wire = Simulation(parameters, master, slaves)
    master.mode(lib.DPM_MODE_OPERATE)
    while master.status.fdl.gap_polls < 125 or not all(master.slave(i).state == lib.DPM_ST_DATA for i in range(8)):
        wire.run(50 * MS)
    wire.clear()
    begin = last = wire.now
    cycle = first = master.status.cycle
    longest = 0
    while cycle < first + cycles:
        wire.run(transmissions=1)
        if master.status.cycle != cycle:
            cycle, last, longest = master.status.cycle, wire.now, max(longest, wire.now - last)
    mean = (wire.now - begin) / cycles
    exchange = 11 * (15 + 15) + 11 + lib.dpm_tid1(parameters)  # these slaves answer after min Tsdr
    ideal = wire.bits(8 * exchange + 33 + lib.dpm_tid1(parameters))
    gap = wire.bits(66 + parameters.tsl + lib.dpm_tid1(parameters))
    print(f"{rate} bit/s: {mean / ideal:.4f} of the ideal cycle, longest {longest / ideal:.3f}, with a GAP poll "
          f"{(ideal + gap) / ideal:.3f}")
    assert mean / ideal <= 1.02
    assert longest <= (ideal + gap) * 1.001
    wire.check()


@pytest.mark.timeout(3600)
def test_two_masters_with_slaves_exchange_side_by_side():
    """An hour of it (`make soak`) takes less than 5 minutes of one core."""
    parameters = default_parameters(1_500_000)
    slaves = Slaves(parameters=parameters, slaves=20)
    masters = []
    for address in (1, 2):
        master = Master(parameters=parameters, address=address, slaves=10, role=RING)
        for slave in range(10):
            master.add(20 * address + slave, 0x00CA, b"\x72", watchdog=(1, 10))
            slaves.add(20 * address + slave, 0x00CA, b"\x72", user=(0, 0))
        master.mode(lib.DPM_MODE_OPERATE)
        masters.append(master)
    wire = Simulation(parameters, *masters, slaves)
    begin = time.process_time()
    wire.run(SECONDS * S)
    took = time.process_time() - begin
    wire.check()
    print(f"{SECONDS} s of a 1.5 Mbit/s bus, 2 masters and 20 slaves: {took:.1f} s of a core")
    assert SECONDS < 3600 or took < SECONDS / 12
    for master in masters:
        states = [master.slave(i) for i in range(10)]
        assert all(s.state == lib.DPM_ST_DATA and s.statistics.losses == 0 for s in states)
        assert min(s.statistics.exchanges for s in states) > 75 * SECONDS
    assert all(slaves.report(i).watchdog_expired == 0 for i in range(20))
