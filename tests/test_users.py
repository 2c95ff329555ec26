# SPDX-License-Identifier: MIT
"""Several users of one FDL station: the DP master's cycle and requests by hand, many of them, from one or more programs.

"Requests by several users of one station, with priorities, nothing starved": the cycle first, then one request by hand for each
cycle or turn of the token, in the order in which they came. On the simulated segment, which watches the rules of the wire.
"""

from __future__ import annotations

import threading
from typing import Any

import pytest
from simulation import Simulation
from wire import MS, Master, S, Script, Slaves, default_parameters, lib

import dpmaster
from dpmaster.emulator import Segment

SLAVES = 32
RING, SOLE = lib.DPM_ROLE_RING, lib.DPM_ROLE_SOLE
ABSENT = 100


class Loaded:
    """A free-running master with 32 slaves that exchange; in a ring with a second one beside it that has 8."""

    def __init__(self, role: int = SOLE, *, ring: bool = False, ttr: int = 0) -> None:
        parameters = default_parameters(1_500_000)
        parameters.hsa = 2
        parameters.ttr = ttr or parameters.ttr
        self.slaves = Slaves(parameters=parameters)
        self.masters = [Master(parameters=parameters, address=1, role=role, control_interval=3600 * S)]
        if ring:
            self.masters.append(Master(parameters=parameters, address=2, role=role, control_interval=3600 * S))
        for i in range(SLAVES + 8 * ring):
            self.slaves.add(10 + i, 0x00CA, b"\x72", user=(0, 0))
            self.masters[i >= SLAVES].add(10 + i, 0x00CA, b"\x72")
        self.wire = Simulation(parameters, *self.masters, self.slaves)
        for master in self.masters:
            master.mode(lib.DPM_MODE_OPERATE)
        self.master = self.masters[0]
        while not all(self.exchanging(master) and len(master.las) == len(self.masters) for master in self.masters):
            self.wire.run(10 * MS, violation=False)
            assert self.wire.now < 20 * S
        self.wire.clear()  # with a short Ttr a lone master polls its GAP past it: else nobody could come in

    @staticmethod
    def exchanging(master: Master) -> bool:
        return all(master.slave(i).state == lib.DPM_ST_DATA for i in range(len(master.images)))

    def ask(self, n: int, address: int = 10) -> list[Any]:
        return [self.master.request(address, lib.DPM_FDL_STATUS) for _ in range(n)]

    def cycles(self, requests: list[Any]) -> int:
        """Run until all are done: the cycles that took."""
        first = self.master.status.cycle
        end = self.wire.now + 10 * S
        while not all(request.done for request in requests):
            self.wire.run(transmissions=10)
            assert self.wire.now < end, [request.done for request in requests]
        self.wire.check()
        return int(self.master.status.cycle - first)


def test_a_request_is_queued_once():
    """Twice in the queue, it would be behind itself, and the queue without end."""
    master = Master(500_000, address=2)
    master.mode(lib.DPM_MODE_STOP)
    for _ in range(2):
        request = master.request(8, lib.DPM_FDL_STATUS)
        assert lib.dpm_master_request(master.master, request) == lib.DPM_E_BUSY


@pytest.mark.parametrize("address", [10, ABSENT], ids=["answered", "absent"])
def test_many_requests_by_hand_do_not_starve_the_cycle(address):
    """One for each cycle, however many wait: no cycle is longer by more than one of them."""
    bus = Loaded()
    bus.wire.run(20 * MS)
    usual = bus.master.status.cycle_last
    requests = bus.ask(50, address)
    longest = 0
    cycle = bus.master.status.cycle
    while not all(request.done for request in requests):
        bus.wire.run(transmissions=1)
        if bus.master.status.cycle != cycle:
            cycle, longest = bus.master.status.cycle, max(longest, bus.master.status.cycle_last)
    slot = bus.wire.bits(66 + bus.master.parameters.tsl + lib.dpm_tid1(bus.master.parameters))
    token = bus.wire.bits(33 + lib.dpm_tid1(bus.master.parameters))
    assert longest <= usual + slot + 2 * token
    assert bus.exchanging(bus.master)


def test_a_loaded_cycle_does_not_starve_a_request_by_hand():
    """32 slaves, free running, no pause: a request has its turn at the end of the cycle under way, or of the next."""
    bus = Loaded()
    for _ in range(20):
        assert bus.cycles(bus.ask(1)) <= 2
    assert 45 <= bus.cycles(bus.ask(50)) <= 51


def test_requests_have_their_turns_in_the_order_they_came():
    """A second program's one request does not wait for what the first one asks afterwards."""
    bus = Loaded()
    first, other = bus.ask(3), bus.ask(1, ABSENT)
    more = bus.ask(20)
    assert bus.cycles(first + other) <= 5
    assert not more[1].done


def test_in_stop_requests_by_hand_have_the_bus():
    master = Master(1_500_000, role=RING, slaves=1)
    master.mode(lib.DPM_MODE_STOP)
    wire = Simulation(master.parameters, master)
    wire.run(20 * MS)
    requests = [master.request(ABSENT, lib.DPM_FDL_STATUS) for _ in range(100)]
    wire.run(100 * wire.bits(3 * (66 + 300)))
    assert all(request.done for request in requests)
    wire.check()


@pytest.mark.parametrize("ttr", [0, 6000, 3000], ids=["default", "cycle just fits", "shorter than the cycle"])
def test_in_a_ring_everybody_has_a_turn_however_short_ttr_is(ttr):
    """Requests of low priority only while token hold time is left (protocol page D.3); the onlooker watches that. A Ttr that is
    too short stretches the cycle over several turns, and still both masters' cycles go on and requests are carried out."""
    bus = Loaded(RING, ring=True, ttr=ttr)
    before = [master.status.cycle for master in bus.masters]
    requests = bus.ask(20)
    bus.cycles(requests)
    assert all(master.status.cycle > cycle + 5 for master, cycle in zip(bus.masters, before, strict=True))
    assert all(bus.exchanging(master) for master in bus.masters)
    shares = [bus.wire.share(address).tokens for address in (1, 2)]
    assert abs(shares[0] - shares[1]) <= 1


def test_a_lone_master_keeps_the_hold_time_too():
    """With a cycle longer than Ttr it says its token in between; the onlooker watches."""
    bus = Loaded(ttr=3000)
    cycle = bus.master.status.cycle
    bus.wire.run(200 * MS)
    bus.wire.check()
    assert bus.master.status.cycle > cycle + 5


# --- off the bus -----------------------------------------------------------------------------------------------------------


def test_requests_that_wait_are_refused_when_the_station_leaves_the_bus():
    master = Master(500_000)
    master.mode(lib.DPM_MODE_STOP)
    requests = [master.request(ABSENT, lib.DPM_FDL_STATUS) for _ in range(3)]
    script = Script(master)
    assert script.next() and not requests[0].done, "one is out"
    lib.dpm_master_port(master.master, False, script.now)  # the port is gone
    script.next(limit=1 * MS)
    assert [request.status for request in requests] == [lib.DPM_CONF_DS] * 3 and all(request.done for request in requests)
    late = master.request(ABSENT, lib.DPM_FDL_STATUS)
    assert late.done and late.status == lib.DPM_CONF_DS and late.tries == 0


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_request_taken_back_leaves_the_others_their_turns(which):
    master = Master(500_000)
    master.mode(lib.DPM_MODE_STOP)
    requests = [master.request(100 + i, lib.DPM_FDL_STATUS) for i in range(3)]
    script = Script(master)
    assert script.next()[1] == 100
    lib.dpm_master_cancel(master.master, requests[which])
    lib.dpm_master_cancel(master.master, requests[which])
    asked = [script.next()[1] for _ in range(2 if which == 0 else 1)]
    script.next(limit=5 * MS)
    assert asked == [101, 102][:len(asked)] if which != 1 else asked == [102]
    assert [request.done for request in requests] == [i != which for i in range(3)]


def test_threads_of_a_program_take_turns() -> None:
    """One that asks without a pause leaves another its turns."""
    with Segment() as wire, dpmaster.Master(wire.port(), output_watchdog=None) as master:
        asked, stop = [0], threading.Event()

        def ask() -> None:
            while not stop.is_set():
                master.request(127, "SDN", 58, 62, b"\0\0")
                asked[0] += 1

        threads = [threading.Thread(target=ask) for _ in range(3)]
        for thread in threads:
            thread.start()
        try:
            for _ in range(20):
                assert master.request(127, "SDN", 58, 62, b"\0\0", timeout=10.0).ok
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        assert asked[0] > 0


def test_a_request_on_a_port_that_is_gone_fails_with_the_reason() -> None:
    wire = Segment()
    with dpmaster.Master(wire.port(), output_watchdog=None) as master:
        master.stop()
        wire.close()
        with pytest.raises(dpmaster.PortError, match="vanished"):
            master.request(5, "FDL_STATUS", timeout=60.0)
