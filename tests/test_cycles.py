# SPDX-License-Identifier: MIT
"""The cycle: its raster and lateness on virtual time, and the program's loop over it on a segment of ptys."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest
from test_dp_master import Bus
from test_master_pty import CONFIGURATION, IDENT, Echo
from waiting import until
from wire import MS, S, lib

from dpmaster import ConfigurationError, Cycle, DPTimeout, Master, Mode, NotOperatingError, PortError, Station
from dpmaster.bus import Feed
from dpmaster.emulator import Segment

CYCLE = 10 * MS
ALLOWANCE = 2 * MS


def exchanging() -> Bus:
    """A master with a fixed cycle of 10 ms whose station exchanges, waiting for the next cycle."""
    bus = Bus(cycle_time=CYCLE, control_interval=100 * S, allowance=ALLOWANCE)
    bus.start()
    exchange(bus)  # Global_Control goes before it: the mode is told to who joined
    return bus


def exchange(bus: Bus) -> int:
    """One cycle; the time at which it began. It runs on until the master is idle."""
    bus.exchange()
    assert bus.script.next(limit=MS) == b""
    return int(bus.master.status.cycle_began)


def host_is_away(bus: Bus, place: int, late: int) -> None:
    """All goes its way until shortly before the next cycle's place; the host looks again `late` behind it."""
    assert bus.script.next(limit=place - MS // 20 - bus.script.now) == b""
    bus.script.silence(place + late - bus.script.now)


# --- on virtual time ---------------------------------------------------------------------------------------------------


def test_a_host_that_is_late_moves_no_later_cycle() -> None:
    """Isochronous: "without drift". After every lateness the next cycle is in its place again."""
    bus = exchanging()
    place = exchange(bus)
    for late in (0, MS, 0, 2 * MS, 0, 0):
        place += CYCLE
        host_is_away(bus, place, late)
        assert exchange(bus) == place + late
    assert bus.master.status.lateness.skipped == 0


def test_lateness_is_measured_against_the_raster() -> None:
    bus = exchanging()
    place = exchange(bus)
    before = list(bus.master.status.lateness.counts)
    for late in (0, 1, 700, 2500, 5):  # us; one is over the allowance
        place += CYCLE
        host_is_away(bus, place, late * 1000)
        exchange(bus)
        assert bus.master.status.lateness.last == bus.master.status.cycle_late == late * 1000
    lateness = bus.master.status.lateness
    assert (lateness.max, lateness.over, lateness.skipped) == (2_500_000, 1, 0)
    grown = [after - was for was, after in zip(before, lateness.counts, strict=True)]
    # under 2 us, 2 to 4, 4 to 8, ..., 512 to 1024, 1024 to 2048, 2048 to 4096
    assert {n: count for n, count in enumerate(grown) if count} == {0: 2, 2: 1, 9: 1, 11: 1}


def test_places_that_passed_are_skipped_and_counted() -> None:
    """A host that slept over two places, and lost its token by that: then the raster goes on with its old phase, and each of
    its places had a cycle or is counted as skipped."""
    bus = exchanging()
    place, cycle = exchange(bus), bus.master.status.cycle
    host_is_away(bus, place + CYCLE, 2 * CYCLE + CYCLE // 2)
    for _ in range(3):
        bus.exchange()
    assert bus.script.next(limit=MS) == b""
    passed, phase = divmod(exchange(bus) - place, CYCLE)
    lateness = bus.master.status.lateness
    assert (phase, lateness.skipped, lateness.max // CYCLE) == (0, 2, 3)
    assert passed == bus.master.status.cycle - cycle + lateness.skipped


def test_a_pause_is_no_lateness() -> None:
    """Stop for a second, the bus lost for a second: the next cycle lays a new raster."""
    bus = exchanging()
    bus.master.mode(lib.DPM_MODE_STOP, bus.script.now)
    while bus.master.status.mode != lib.DPM_MODE_STOP:
        bus.script.next(limit=50 * MS, tokens=True)
        bus.script.answer("E5")
    bus.script.next(limit=S)
    bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
    bus.start()
    lib.dpm_master_port(bus.master.master, False, bus.script.now)
    bus.script.silence(S)
    lib.dpm_master_port(bus.master.master, True, bus.script.now)
    bus.start()
    lateness = bus.master.status.lateness
    assert lateness.max < MS
    assert lateness.skipped == 0


def test_a_free_cycle_has_no_lateness() -> None:
    bus = Bus(control_interval=100 * S)
    bus.start()
    for _ in range(5):
        bus.exchange()
    status = bus.master.status
    assert (status.lateness.max, sum(status.lateness.counts), status.lateness.skipped) == (0, 0, 0)
    assert status.cycle_began < status.cycle_ended <= bus.script.now


# --- on a segment of ptys ----------------------------------------------------------------------------------------------


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment() as made:
        made.attach(Echo(5))
        yield made


def operating(wire: Segment, **options: object) -> Master:
    master = Master(wire.port(), **options)  # type: ignore[arg-type]
    master.add(Station(5, IDENT, CONFIGURATION, watchdog=5.0))
    master.operate()
    return master


def take(cycles: Iterator[Cycle], n: int) -> list[Cycle]:
    return [next(cycles) for _ in range(n)]


def test_a_loop_over_cycles_misses_none_unsaid(wire: Segment) -> None:
    with operating(wire) as master:
        found = take(master.cycles(), 100)
    assert [b.number - a.number for a, b in pairwise(found)] == [cycle.missed + 1 for cycle in found[1:]]
    assert all(cycle.lateness is None and 0 < cycle.duration < 1 for cycle in found)
    assert all(a.time + a.duration < b.time + 1e-6 for a, b in pairwise(found))
    assert found[-1].time < time.monotonic()


def test_a_slow_program_is_told_how_many_it_missed_and_gets_the_newest(wire: Segment) -> None:
    with operating(wire) as master:
        cycles = master.cycles()
        cycle = next(cycles)
        until(lambda: master.statistics.cycle >= cycle.number + 5)
        late = next(cycles)
        assert late.missed == late.number - cycle.number - 1 >= 4


def test_a_fixed_cycle_time_is_kept_and_its_lateness_told(wire: Segment) -> None:
    """Over 50 cycles nothing adds up: the last begins where the first did, in the raster."""
    with operating(wire, cycle_time=0.01) as master:
        found = take(master.cycles(), 50)
        lateness = master.statistics.lateness
    assert lateness is not None
    places = [cycle.time - (cycle.lateness or 0.0) for cycle in found]
    steps = [(place - places[0]) / 0.01 for place in places]
    assert all(abs(step - round(step)) < 1e-6 for step in steps)
    assert round(steps[-1]) >= found[-1].number - found[0].number
    assert all(0 <= (cycle.lateness or 0.0) <= lateness.max for cycle in found)
    assert sum(lateness.counts) >= found[-1].number
    assert lateness.over <= sum(lateness.counts)


def test_a_free_master_tells_of_no_lateness(wire: Segment) -> None:
    with operating(wire) as master:
        assert master.statistics.lateness is None


@pytest.mark.parametrize("end", [Master.stop, Master.offline, Master.close])
def test_the_loop_ends_when_the_master_leaves(wire: Segment, end: Callable[[Master], None]) -> None:
    with operating(wire) as master:
        leaver = threading.Thread(target=end, args=(master,))
        for cycle in master.cycles():
            assert cycle.number > 0
            if not leaver.ident:
                leaver.start()
        leaver.join()
        assert master.closed or master.mode < Mode.CLEAR


def test_a_loop_goes_on_in_clear(wire: Segment) -> None:
    with operating(wire) as master:
        cycles = master.cycles()
        next(cycles)
        master.clear()
        take(cycles, 3)
        assert master.mode == Mode.CLEAR


def test_what_a_loop_cannot_begin_with(wire: Segment) -> None:
    with Master(wire.port()) as master:
        master.add(Station(5, IDENT, CONFIGURATION))
        with pytest.raises(NotOperatingError, match="operate"):
            master.cycles()
        master.stop()
        with pytest.raises(NotOperatingError, match="Stop"):
            master.cycles()
        master.clear()
        with pytest.raises(ConfigurationError, match="timeout"):
            master.cycles("1")  # type: ignore[arg-type]


def test_a_loop_without_cycles_says_why(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cycle time is no lack of cycles; a port that has gone is."""
    with operating(wire, cycle_time=0.4) as master:
        cycles = master.cycles(timeout=0.2)
        take(cycles, 2)
        with monkeypatch.context() as patch:
            patch.setattr(master._bus, "wait", lambda ready, timeout: None)
            with pytest.raises(DPTimeout, match=r"no bus cycle ended in 0\.6 s"):
                next(cycles)
        wire.close()
        with pytest.raises(PortError):
            take(cycles, 5)


def test_a_loop_that_is_always_late_feeds_the_output_watchdog(wire: Segment) -> None:
    """It never has to wait, for a cycle has always ended already; it lives all the same."""
    with operating(wire, output_watchdog=0.3) as master:
        master.stations[0].update(0, b"\x01")
        end = time.monotonic() + 0.9
        for cycle in master.cycles():
            until(lambda seen=cycle: master.statistics.cycle > seen.number)  # type: ignore[misc]
            if cycle.time > end:
                break
        status = master._status()
        assert (status.latched, Feed(status.fed_by)) == (False, Feed.WAIT)


def test_a_loop_in_another_thread_than_the_last_commits_feeds_nothing(wire: Segment) -> None:
    with operating(wire, output_watchdog=0.3) as master:
        committer = threading.Thread(target=master.stations[0].update, args=(0, b"\x01"))
        committer.start()
        committer.join()
        deadline = time.monotonic() + 5
        for cycle in master.cycles():
            if master.mode == Mode.CLEAR:
                break
            assert cycle.time < deadline, "it did not run out"
        assert master._status().latched
