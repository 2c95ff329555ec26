# SPDX-License-Identifier: MIT
"""Cycles without end on a bus that is not well: nothing grows, nothing is lost from the count, all comes back.

The simulated segment by seed (DPM_SOAK_SEED; `make soak`: 10 million cycles, DPM_DP_CYCLES), and ptys (1 million,
DPM_PTY_CYCLES). A failure names the seed.
"""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import pytest
from simulation import Simulation
from wire import MS, Master, S, Slaves, default_parameters, lib

import dpmaster
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

SEED = int(os.environ.get("DPM_SOAK_SEED", "1"))
CYCLES = int(os.environ.get("DPM_DP_CYCLES", "200000"))
PTY_CYCLES = int(os.environ.get("DPM_PTY_CYCLES", "2000"))
ADDRESSES = (5, 17)
# Chances per million octets: a bus that is well, one with a bad plug, one beside a welder, and one that is cut.
WEATHER: tuple[dict[str, int], ...] = (
    {}, {"lose": 50, "flip": 50, "insert": 20, "duplicate": 20, "lose_telegram": 200},
    {"lose": 2000, "flip": 2000, "insert": 1000, "duplicate": 1000, "lose_telegram": 10_000, "noise": 5 * MS,
     "noise_octets": 9},
    {"lose_telegram": 1_000_000})
PTY_WEATHER = ({}, {"lose": 2e-5, "flip": 2e-5, "insert": 1e-5, "duplicate": 1e-5, "lose_telegram": 1e-4},
               {"lose": 2e-4, "flip": 2e-4})


def resident() -> int:
    """Octets of memory in use."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class Bus:
    """A master and two slaves at 12 Mbit/s, where 10 million cycles need the least time."""

    def __init__(self) -> None:
        parameters = default_parameters(12_000_000)
        self.master = Master(parameters=parameters, address=1, slaves=2, control_interval=50 * MS)
        self.slaves = Slaves(parameters=parameters, slaves=2)
        for address in ADDRESSES:
            self.master.add(address, 0x00CA, b"\x72", watchdog=(1, 10))
            self.slaves.add(address, 0x00CA, b"\x72", user=(0, 0))
        self.wire = Simulation(parameters, self.master, self.slaves)
        self.master.mode(lib.DPM_MODE_OPERATE)
        self.written = {bytes(6)}

    def commit(self, rng: random.Random) -> None:
        """New outputs for one of them; the last few hundred are what may still be on its way."""
        value = rng.randbytes(6)
        if self.master.commit(rng.randrange(2), value, self.wire.now) > 0:
            self.written.add(value)

    def check_outputs(self) -> None:
        for index in range(2):
            frame = self.slaves.outputs(index)
            octets = bytes(frame.octets[0:frame.length])
            assert not octets or octets in self.written, octets.hex(" ")

    def status(self, index: int) -> Any:
        self._kept = self.master.slave(index)  # a struct inside a struct does not keep the outer one
        return self._kept

    def exchanging(self) -> bool:
        return all(self.status(i).state == lib.DPM_ST_DATA for i in range(2))


@pytest.mark.timeout(3600)
def test_random_faults_for_a_long_time_leave_no_trace():
    rng = random.Random(SEED)
    bus = Bus()
    begun, simulated = 0, 0
    while bus.master.status.cycle < CYCLES:
        weather = rng.choice(WEATHER)
        bus.wire.faults(seed=rng.randrange(1 << 60), **weather)
        for _ in range(rng.randint(1, 8)):
            bus.commit(rng)
            bus.wire.run(rng.randint(1, 100) * MS, violation=False)
            bus.check_outputs()
        bus.wire.faults()
        assert bus.wire.run(2 * S, violation=False) == lib.DPM_STOPPED_TIME
        assert bus.exchanging(), f"seed {SEED}: {[bus.status(i).state for i in range(2)]} 2 s after {weather}"
        bus.written = {bytes(6), *(bytes(f.octets[0:f.length]) for f in map(bus.slaves.outputs, range(2)))}
        simulated += 1
        if not begun and simulated == 20:
            begun = resident()
    status = bus.master.status
    fdl = status.fdl
    print(f"seed {SEED}: {status.cycle} cycles, {bus.wire.now / S:.0f} s of bus, {fdl.repetitions} repetitions;", told(fdl))
    assert add_up(fdl)
    counters = [bus.status(i) for i in range(2)]
    assert all(c.statistics.starts in (c.statistics.losses, c.statistics.losses + 1) for c in counters)
    assert not begun or resident() - begun < 4 << 20


def told(fdl: Any) -> str:
    return f"{fdl.requests} requests = {fdl.answers} answered + {fdl.unanswered} unanswered + {fdl.abandoned} abandoned"


def add_up(fdl: Any) -> bool:
    """Sent = answered + each kind of loss, and one under way."""
    return fdl.requests - fdl.answers - fdl.unanswered - fdl.abandoned in (0, 1)


@pytest.mark.timeout(7200)
def test_random_faults_on_a_pty():
    """The same with all of the machinery of a real bus. Faults are rare: on a pty each costs a slot of 25 ms."""
    rng = random.Random(SEED)
    with Segment() as segment:
        cards = [segment.attach(SIP1(address)) for address in ADDRESSES]
        with dpmaster.Master(segment.port(), 12_000_000, output_watchdog=None) as master:
            stations = [master.add(dpmaster.Station(card.address, 0x00CA, b"\x72")) for card in cards]
            master.operate()
            begun, next_fault = 0, 0
            while (cycle := master.wait_cycle()) < PTY_CYCLES:
                rng.choice(stations).update(1, rng.randbytes(1))  # word 0, the run command, stays 0
                if cycle >= next_fault:
                    segment.faults(seed=rng.randrange(1 << 60), **rng.choice(PTY_WEATHER))
                    next_fault = cycle + 1000
                    begun = begun or (cycle > 20_000 and resident())
            segment.faults()
            master.operate()
            statistics = master.statistics
            print(f"seed {SEED}: {statistics.cycle} cycles, {statistics.repetitions} repetitions;", told(statistics))
            assert add_up(statistics)
            assert statistics.answers > PTY_CYCLES
            assert all(station.state == dpmaster.StationState.DATA for station in stations)
            assert not begun or resident() - begun < 4 << 20
