# SPDX-License-Identifier: MIT
"""The cycle: its raster and lateness on virtual time, and the program's loop over it on a segment of ptys."""

from __future__ import annotations

from test_dp_master import Bus
from wire import MS, S, lib

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
