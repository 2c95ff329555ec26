# SPDX-License-Identifier: MIT
"""One disturbance at every moment of a program's life: nothing runs on, nothing hangs, nothing is sent that must not be.

Each of ``PROGRAMS`` runs on the simulated segment once for each telegram on its bus and each of ``DISTURBANCES``,
which comes in the middle of that telegram, at its end, or in the pause behind it. After it the program goes on, then operates
anew and leaves, and what is promised is judged:

- who leaves is out in time, and no slave that hears is left locked to us or with outputs;
- outputs are zeros, or of a commit that lives; a commit made when all is over arrives;
- requests, orders and waits end, and all exchange again, in time;
- the rules of the wire hold (`Simulation`), but for what a fault on the wire itself breaks, and for two masters that claim a
  silent bus within one character;
- states, events and statistics agree.

A failure names its case: ``DPM_CASE=<case>`` runs that one alone and shows its telegrams. The tests take some of the cases, by
seed (DPM_SOAK_SEED), `make soak` all of them and 50 000 pairs of disturbances (DPM_CASES, DPM_PAIRS).
"""

from __future__ import annotations

import os
import random
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import pytest
from simulation import Simulation
from wire import MS, Master, S, Slaves, default_parameters, ffi, lib, octets

SEED = int(os.environ.get("DPM_SOAK_SEED", "1"))
CASES = int(os.environ.get("DPM_CASES", "1200"))  # 0: all
PAIRS = int(os.environ.get("DPM_PAIRS", "300"))
CASE = os.environ.get("DPM_CASE", "")

OURS, PEER, FOREIGN, ABSENT = 2, 4, 3, 99
ADDRESSES = (10, 20, 30)
CONFIGURATIONS = (octets("10 20"), octets("72"), octets("21"))
SIZES = (1, 6, 2)
IDENT = 0x00CA
RECOVERY = 3 * S  # a pause between two tries of a slave is 1.28 s at the most
LEAVING = 1 * S  # 0.5 s without a token, and the Unlock's 0.1 s of Min_Slave_Interval
WATCHDOG = 100 * MS
OPERATE, CLEAR, STOP, OFFLINE = lib.DPM_MODE_OPERATE, lib.DPM_MODE_CLEAR, lib.DPM_MODE_STOP, lib.DPM_MODE_OFFLINE


@dataclass(frozen=True)
class Case:
    """What runs, where, and what comes in between: a disturbance, with which telegram of the program's, and when."""

    program: str
    bus: str
    blows: tuple[tuple[str, int, int], ...] = ()

    def __str__(self) -> str:
        return ",".join([self.program, self.bus, *(f"{kind}:{step}:{phase}" for kind, step, phase in self.blows)])

    @staticmethod
    def of(text: str) -> Case:
        program, bus, *blows = text.split(",")
        return Case(program, bus, tuple((k, int(s), int(p)) for k, s, p in (b.split(":") for b in blows)))


@dataclass(frozen=True)
class Host:
    """Our master's bus and its port; times in ns."""

    rate: int
    role: int = lib.DPM_ROLE_SOLE
    allowance: int = 0
    lateness: int = 0
    chunk: int = 0
    echo: bool = False
    cycle: int = 0


RING = lib.DPM_ROLE_RING
BUSES = {
    "alone": Host(93_750, allowance=500_000),
    "echo": Host(500_000, allowance=2 * MS, echo=True, cycle=10 * MS),
    "usb": Host(187_500, allowance=20 * MS, lateness=1 * MS, chunk=1 * MS),
    "ring": Host(93_750, role=RING, allowance=2 * MS),
    "late-ring": Host(187_500, role=RING, allowance=2 * MS, lateness=700_000, echo=True, cycle=10 * MS),
}


class World:
    """A bus with our master, three slaves of different manners, perhaps another master; a program's calls; the judge."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.host = host = BUSES[case.bus]
        self.rng = random.Random(str(case))
        parameters = default_parameters(host.rate)
        if host.role == RING:
            parameters.tsl = max(parameters.tsl, lib.dpm_ring_tsl(parameters, host.allowance))
            parameters.hsa, parameters.ttr, parameters.g = 5, 40 * parameters.tsl, 1
        self.auto_clear = case.program == "auto_clear"
        self.master = Master(parameters=parameters, address=OURS, slaves=4, role=host.role, allowance=host.allowance,
                             granularity=host.chunk, cycle_time=host.cycle, control_interval=40 * MS,
                             auto_clear=self.auto_clear, output_watchdog=WATCHDOG if case.program == "hang" else 0)
        self.slaves = Slaves(parameters=parameters, slaves=3)
        self.sets: list[dict[str, Any]] = [
            {"group": 1, "station_status": 0x30},
            {"group": 2, "fail_safe": True, "watchdog": (1, 20), "min_slave_interval": 30},
            {"hold": True}]
        for i, address in enumerate(ADDRESSES):
            self.master.add(address, IDENT, CONFIGURATIONS[i], **self.sets[i])
            self.slaves.add(address, IDENT, CONFIGURATIONS[i], fail_safe=i == 1, min_slave_interval=30 if i == 1 else 0,
                            prm_keeps_exchange=i == 2, foreign_sc=i == 0)
        grace = int(lib.dpm_bits_up(parameters, 20 * parameters.tsl)) + 2 * host.allowance
        self.sim = Simulation(parameters, tap=512, grace=grace)
        self.port = self.sim.attach(self.master, seed=len(str(case)), lateness=host.lateness, chunk=host.chunk, echo=host.echo)
        self.sim.attach(self.slaves)
        if host.role == RING:
            self.peer = Master(parameters=parameters, address=PEER, slaves=1, role=RING)
            self.sim.attach(self.peer)
            self.peer.mode(STOP)
        self.alive: list[set[bytes]] = [set(), set(), set()]
        self.was_lost = [False] * 3
        self.states = [lib.DPM_ST_OFFLINE] * 3
        self.starts = [0] * 3
        self.mode_told = OFFLINE
        self.commits = 0
        self.stood = 0
        self.listed = [True] * 3
        self.requests: list[Any] = []
        self.armed = False  # a disturbance may come
        self.steps = 0  # telegrams since then
        self.seen = 0
        self.digest = 0  # of all telegrams
        self.events = 0
        self.blows = list(case.blows)
        self.stalled = 0
        self.later: list[tuple[int, Callable[[], None]]] = []  # what a disturbance has yet to do
        self.deaf = False  # while the program leaves, a disturbance keeps telegrams of ours from slaves
        self.coincidence = False
        self.t = ffi.new("dpm_transmission *")
        self.breach = ffi.new("dpm_simulation_breach *")

    # ---- time

    @property
    def now(self) -> int:
        return self.sim.now

    def run(self, duration: int) -> None:
        self.advance(self.now + duration)

    def advance(self, end: int) -> None:
        while self.now < end:
            due = min([end, *(time for time, _ in self.later)])
            if due > self.now:
                self.sim.run(until=due, violation=False, transmissions=1)
            self.look()
            for item in [item for item in self.later if item[0] <= self.now]:
                self.later.remove(item)
                item[1]()

    def look(self) -> None:
        """Everything that was sent since the last look, by what holds."""
        self.hear()
        back = 0
        while lib.dpm_simulation_tap(self.sim.c, back, self.t) and self.t.number >= self.seen:
            back += 1
        for k in reversed(range(back)):
            lib.dpm_simulation_tap(self.sim.c, k, self.t)
            self.seen = self.t.number + 1
            telegram = bytes(self.t.octets[0 : self.t.n])
            self.digest = zlib.crc32(b"%d %d " % (self.t.start, self.t.port) + telegram, self.digest)
            if self.t.port == self.port:
                self.judge(telegram, self.t.start)
            if self.armed and not self.t.flags & lib.DPM_TAP_INJECTED:
                self.step()
        if not self.coincidence and lib.dpm_simulation_violation(self.sim.c, 0, self.breach):
            claims = [t for t in self.sim.tap(2) if t.octets[:1] == b"\xdc" and t.octets[1] == t.octets[2]]
            self.coincidence = len(claims) == 2 and claims[1].start - claims[0].start <= self.sim.bits(11)
            if not self.coincidence:
                self.sim.check()

    def step(self) -> None:
        """One more telegram of the program's; what is to disturb it is at hand."""
        self.steps += 1
        for blow in [blow for blow in self.blows if blow[1] <= self.steps]:
            self.blows.remove(blow)
            name, _, number = blow[0].partition("-")
            moment = (self.t.start + 1, self.t.end, self.t.end + self.sim.bits(20), self.t.end + self.sim.bits(60))[blow[2]]
            call = getattr(self, f"blow_{name}")
            self.later.append((max(moment, self.now + 1), lambda call=call, number=number: call(int(number or 0))))

    def until(self, condition: Callable[[], bool], limit: int, what: str) -> None:
        begin = self.now
        while not condition():
            end = max(begin, self.stalled) + limit
            assert self.now < end, f"{what} not within {limit / S} s: {self.told()}"
            self.run(min(end - self.now, 2 * MS))

    def told(self) -> str:
        states = [self.state(i) for i in range(3)]
        slaves = [(r.state, r.master) for r in (self.slaves.report(i) for i in range(3))]
        status = self.master.status
        return f"mode {status.mode:#x}, FDL {status.fdl_state}, states {states}, slaves {slaves}"

    def state(self, i: int) -> int:
        return int(self.master.slave(i).state) if self.listed[i] else lib.DPM_ST_INACTIVE

    # ---- what is disturbed

    def ends(self, after: int, call: Callable[[], None]) -> None:
        self.later.append((self.now + after, call))

    def blow_stall(self, ms: int) -> None:
        self.stalled = self.now + ms * MS
        lib.dpm_simulation_stall(self.sim.c, self.port, self.stalled, self.rng.random() < 0.5)

    def blow_token(self, n: int) -> None:
        self.deaf |= n > 2
        self.sim.inject(self.now + self.sim.bits(40), bytes((0xDC, FOREIGN, FOREIGN)))
        if n > 1:  # 40 of them: longer than who leaves waits for a token
            self.ends(self.sim.bits(90), lambda: self.blow_token(n - 1))

    def blow_request(self, _: int) -> None:
        body = bytes((ABSENT, FOREIGN, 0x49))
        self.sim.inject(self.now + self.sim.bits(40), b"\x10" + body + bytes((sum(body) & 0xFF, 0x16)))

    def plan(self, traffic: int, fault: int, bits: float = 0) -> None:
        self.sim.plan(traffic, fault, after=self.sim.bits(bits))

    def blow_lost(self, _: int) -> None:
        self.plan(lib.DPM_TRAFFIC_ANSWER, lib.DPM_FAULT_LOSE)

    def blow_late(self, percent: int) -> None:
        slot = self.sim.parameters.tsl * percent / 100 + self.host.allowance * self.host.rate / S
        self.plan(lib.DPM_TRAFFIC_ANSWER, lib.DPM_FAULT_DELAY, slot)

    def blow_doubled(self, bits: int) -> None:
        self.plan(lib.DPM_TRAFFIC_ANSWER, lib.DPM_FAULT_DOUBLE, bits)

    def blow_garbled(self, _: int) -> None:
        self.plan(lib.DPM_TRAFFIC_ANSWER, lib.DPM_FAULT_GARBLE)

    def blow_unsent(self, traffic: int) -> None:
        """Neither heard nor echoed."""
        self.plan(traffic, lib.DPM_FAULT_LOSE)

    def blow_port(self, ms: int) -> None:
        self.deaf = True
        lib.dpm_master_port(self.master.master, False, self.now)
        self.sim.power(self.port, False)

        def back() -> None:
            self.sim.power(self.port, True)
            lib.dpm_master_port(self.master.master, True, self.now)
        self.ends(ms * MS, back)

    def blow_reset(self, i: int) -> None:
        lib.dpm_slaves_reset(self.slaves.slaves, i, self.now)

    def unplug(self, i: int, ms: int) -> None:
        self.deaf = True
        lib.dpm_slaves_connect(self.slaves.slaves, i, False)
        self.ends(ms * MS, lambda: lib.dpm_slaves_connect(self.slaves.slaves, i, True))

    def blow_unplug0(self, ms: int) -> None:
        self.unplug(0, ms)

    def blow_unplug1(self, ms: int) -> None:
        self.unplug(1, ms)

    def blow_unplug2(self, ms: int) -> None:
        self.unplug(2, ms)

    # ---- what a program does

    def call(self) -> int:
        """A call has its turn when the computer runs: the first thing that is done then, or behind the rest."""
        if self.stalled > self.now:
            self.advance(self.stalled - 1 if self.rng.random() < 0.5 else self.stalled + 1000)
        self.hear()
        return self.now

    def mode(self, mode: int) -> int:
        result = int(lib.dpm_master_set_mode(self.master.master, mode, self.call()))
        assert result == 0 or (self.auto_clear and result == lib.DPM_E_MODE), result
        self.stood = self.now
        return result

    def commit(self, i: int) -> bytes:
        self.call()
        value = bytes([self.commits + 1] * SIZES[i])
        if self.master.commit(i, value, self.now) > 0:
            self.commits += 1
            self.alive[i].add(value)
            self.stood = self.now
        return value

    def commit_all(self) -> list[bytes]:
        return [self.commit(i) for i in range(3)]

    def activate(self, i: int, active: bool) -> None:
        lib.dpm_master_activate(self.master.master, i, active, self.call())
        if not active:
            self.alive[i].clear()

    def new_prm(self, i: int) -> None:
        self.call()
        if lib.DPM_ST_PRM <= self.state(i) <= lib.DPM_ST_DATA:
            self.alive[i].clear()
        lib.dpm_master_new_prm(self.master.master, i, self.now)

    def request(self, address: int) -> None:
        self.call()
        if self.master.status.mode != OFFLINE:
            self.requests.append(self.master.request(address, lib.DPM_SRD_HIGH, dsap=60, ssap=62))

    def order(self, *, da: int = 127, command: int = 0, group: int = 0, clear: int = -1) -> None:
        order = {"da": da, "command": command, "group": group, "clear": clear}
        control = ffi.new("dpm_control *", order)
        result = lib.dpm_master_order(self.master.master, control, self.call())
        assert result in (0, lib.DPM_E_BUSY, lib.DPM_E_MODE), result
        if result:
            return
        for i in range(3):
            if clear == 1 and da in (127, ADDRESSES[i]) and (not group or group & self.sets[i].get("group", 0)):
                self.alive[i].clear()
        self.until(lambda: control.done, RECOVERY, f"Global_Control {order}")

    # ---- what it may expect

    def hear(self) -> None:
        for event in self.master.events():
            self.events += 1
            assert event.number == self.events, "events were lost"
            if event.kind == lib.DPM_EV_STATE:
                i = ADDRESSES.index(event.address)
                assert event.b == self.states[i], f"a state that was never told of: {event.b}, was {self.states[i]}"
                self.states[i] = event.a
                self.starts[i] += event.a == lib.DPM_ST_DATA
                self.was_lost[i] |= event.b == lib.DPM_ST_DATA
                if lib.DPM_ST_DATA in (event.a, event.b) and self.was_lost[i] and i != 2:
                    self.alive[i].clear()
            if event.kind == lib.DPM_EV_MODE:
                assert event.b == self.mode_told, f"a mode that was never told of: {event.b:#x}"
                self.mode_told = event.a
            if event.kind == lib.DPM_EV_WATCHDOG or (event.kind == lib.DPM_EV_MODE and event.b == OPERATE):
                for alive in self.alive:
                    alive.clear()

    def judge(self, telegram: bytes, start: int) -> None:
        if telegram[:1] != b"\x68" or telegram[4] not in ADDRESSES:
            return  # no Data_Exchange: no octets, or SAPs
        i, value = ADDRESSES.index(telegram[4]), telegram[7:-2]
        if any(value):
            assert value in self.alive[i], f"{telegram.hex(' ')} at {start / MS} ms is of a commit that has ended"
            assert self.case.program != "hang" or start <= self.stood + WATCHDOG + 3 * MS, "nobody has stood by it for too long"

    def outputs(self, i: int) -> bytes:
        frame = self.slaves.outputs(i)
        return bytes(frame.octets[0 : frame.length])

    def active(self) -> list[int]:
        return [i for i in range(3) if self.listed[i] and self.states[i] != lib.DPM_ST_INACTIVE]

    def exchanging(self) -> bool:
        return all(self.state(i) == lib.DPM_ST_DATA for i in self.active())

    def operate(self) -> None:
        """Into Operate, and all in Data_Exchange."""
        if self.auto_clear:
            self.mode(CLEAR)
        self.until(lambda: self.mode(OPERATE) == 0, RECOVERY, "no Operate")
        self.until(self.exchanging, RECOVERY, "no exchange")

    def leave(self, mode: int = OFFLINE, *, first: bool = True) -> None:
        """Out, in time, and nobody is left behind that hears; who was told to go before (not `first`) is not told again."""
        if first:  # a port that swallowed two tokens in a row counts as deaf and dumb: the bus was left already
            self.deaf = bool(self.later) or (len(self.case.blows) > 1 and self.master.status.mode < CLEAR)
        self.mode(mode)
        self.until(lambda: self.master.status.mode == mode, LEAVING, "the way out")
        for i in range(3):
            self.judge_left(i)

    def judge_left(self, i: int, cleared: bool = True) -> None:
        """An Unlock may be lost, and an answer to what was before it meet it or pass for its own: then one more is too many. So
        are two talkers, each over one of its two tries."""
        if self.deaf:
            return
        kinds = [kind for kind, *_ in self.case.blows]
        fatal = len(kinds) > 1 and (any(kind.startswith(("doubled", "late", "unsent")) for kind in kinds)
                                    or all(kind.startswith(("token", "request", "lost", "garbled")) for kind in kinds))
        if fatal and not cleared:  # it has heard neither Unlock nor Clear: its watchdog is what is left
            return
        assert fatal or self.slaves.report(i).master != OURS, f"slave {i} is still locked to us: {self.told()}"
        assert not any(self.outputs(i)), f"slave {i} goes on: {self.told()}"

    def settle(self) -> None:
        """The disturbance is over: everything comes back by itself, and ends as it should."""
        self.armed = False
        self.until(lambda: not self.later and self.now > self.stalled, 3 * S, "its end")
        self.until(lambda: all(request.done for request in self.requests), RECOVERY, "requests")
        self.operate()
        for i in range(3):
            if not self.listed[i]:
                assert self.master.add(ADDRESSES[i], IDENT, CONFIGURATIONS[i], **self.sets[i]) == i
                self.listed[i], self.states[i], self.starts[i] = True, lib.DPM_ST_OFFLINE, 0
            elif self.states[i] == lib.DPM_ST_INACTIVE:
                self.activate(i, True)
        self.until(self.exchanging, RECOVERY, "no exchange of all")
        self.order(clear=0, command=0x14)
        self.run(60 * MS)
        self.operate()
        values = self.commit_all()
        self.until(lambda: [self.outputs(i) for i in range(3)] == values, 200 * MS, f"outputs {values}")
        self.leave()
        self.run(50 * MS)
        self.add_up()

    def add_up(self) -> None:
        fdl = self.master.status.fdl
        assert fdl.requests == fdl.answers + fdl.unanswered + fdl.abandoned
        for i in range(3):
            status, report = self.master.slave(i), self.slaves.report(i)
            assert (status.state, status.statistics.starts) == (self.states[i], self.starts[i])
            assert status.statistics.losses <= status.statistics.starts
            assert not self.master.inputs(i).valid
            assert report.too_soon == 0, f"slave {i}: Min_Slave_Interval"
        assert self.mode_told == self.master.status.mode == OFFLINE


# --- programs ------------------------------------------------------------------------------------------------------------


def started(world: World) -> None:
    world.operate()
    world.commit_all()
    world.run(30 * MS)
    world.armed = True


def start_up(world: World) -> None:
    world.armed = True
    world.mode(CLEAR)
    world.mode(OPERATE)
    world.commit_all()
    world.run(80 * MS)
    world.commit_all()
    world.run(20 * MS)


def commits(world: World) -> None:
    started(world)
    for i in (0, 1, 2, 0, 0):
        world.commit(i)
        world.run(8 * MS)
    world.mode(CLEAR)
    world.run(15 * MS)
    world.mode(OPERATE)
    world.run(15 * MS)
    world.commit_all()
    world.run(15 * MS)


def stop(world: World) -> None:
    started(world)
    world.run(12 * MS)
    world.leave(STOP)
    world.run(10 * MS)
    world.mode(CLEAR)
    world.run(30 * MS)
    world.leave(STOP, first=False)


def offline(world: World) -> None:
    started(world)
    world.run(12 * MS)
    world.leave()
    world.run(10 * MS)


def back_at_once(world: World) -> None:
    """Told to leave, and to come back while it leaves."""
    started(world)
    world.run(3 * MS)
    for mode in (STOP, OPERATE, OFFLINE, CLEAR, OFFLINE, STOP):
        world.mode(mode)
        world.run(4 * MS)
    world.leave()


def deactivate(world: World) -> None:
    started(world)
    world.activate(0, False)
    world.activate(2, False)
    world.run(20 * MS)
    world.activate(0, True)
    world.run(40 * MS)
    world.commit_all()
    world.activate(0, False)
    world.run(5 * MS)
    world.leave(first=False)


def remove(world: World) -> None:
    started(world)
    world.deaf = bool(world.later)
    world.activate(0, False)
    world.until(lambda: world.state(0) == lib.DPM_ST_INACTIVE, LEAVING + RECOVERY, "INACTIVE")
    world.hear()
    world.judge_left(0, cleared=False)
    assert lib.dpm_master_remove(world.master.master, 0) == 0
    world.listed[0] = False
    world.run(20 * MS)


def new_prm(world: World) -> None:
    started(world)
    for i in range(3):
        world.new_prm(i)
        world.run(7 * MS)
    world.run(40 * MS)
    world.commit_all()
    world.run(20 * MS)


def requests(world: World) -> None:
    started(world)
    for address in (*ADDRESSES, ABSENT, ADDRESSES[0]):
        world.request(address)
    world.run(10 * MS)
    world.request(ADDRESSES[1])
    world.run(60 * MS)
    world.request(ADDRESSES[2])
    world.leave(STOP)
    world.request(ADDRESSES[0])
    world.run(10 * MS)


def orders(world: World) -> None:
    started(world)
    for order in ({"command": 0x08, "group": 1}, {"command": 0x20, "group": 1}, {"clear": 1, "da": ADDRESSES[2]}, {"clear": 1}):
        world.order(**order)
        world.run(15 * MS)
        world.commit(0)
    world.order(clear=0)
    world.run(15 * MS)
    world.commit_all()
    world.order(command=0x14)
    world.run(15 * MS)


def hang(world: World) -> None:
    started(world)
    world.run(WATCHDOG + 30 * MS)
    world.mode(OPERATE)
    world.run(20 * MS)
    world.commit_all()
    world.run(20 * MS)


def auto_clear(world: World) -> None:
    started(world)
    world.commit_all()
    world.run(60 * MS)
    world.operate()
    world.commit_all()
    world.run(20 * MS)


PROGRAMS: dict[str, Callable[[World], None]] = {program.__name__: program for program in (
    start_up, commits, stop, offline, back_at_once, deactivate, remove, new_prm, requests, orders, hang, auto_clear)}
DISTURBANCES = (
    "stall-1", "stall-5", "stall-30", "stall-200", "stall-1500", "token-1", "token-2", "token-40", "request", "lost", "late-50",
    "late-130", "late-400", "doubled-0", "doubled-12", "doubled-40", "doubled-500", "garbled",
    f"unsent-{lib.DPM_TRAFFIC_TOKEN}", f"unsent-{lib.DPM_TRAFFIC_REQUEST}", f"unsent-{lib.DPM_TRAFFIC_SDN}",
    "port-0", "port-20", "port-300", "reset-0", "reset-1", "reset-2", "unplug0-3", "unplug0-60", "unplug1-3", "unplug1-300",
    "unplug2-30")


def play(case: Case) -> World:
    world = World(case)
    try:
        PROGRAMS[case.program](world)
        world.settle()
    except AssertionError as failure:
        tail = "\n".join(["", *(str(t) for t in world.sim.tap(40))]) if CASE else ""
        raise AssertionError(f"DPM_CASE={case} DPM_SOAK_SEED={SEED}: at {world.now / MS:.3f} ms: {failure}{tail}") from failure
    return world


# --- cases ---------------------------------------------------------------------------------------------------------------


@cache
def lengths() -> dict[tuple[str, str], int]:
    """Telegrams of each program on each bus, when nothing disturbs it; then no rule is broken at all."""
    return {(program, bus): play(Case(program, bus)).steps for program in PROGRAMS for bus in BUSES}


def singles() -> list[Case]:
    """Every disturbance with every telegram."""
    rng = random.Random(SEED)
    cases = [Case(*where, ((kind, step, rng.randrange(4)),))
             for where, n in lengths().items() for step in range(1, n + 1) for kind in DISTURBANCES]
    return rng.sample(cases, CASES) if CASES else cases


def pairs() -> Iterable[Case]:
    rng = random.Random(SEED)
    for _ in range(PAIRS):
        where, n = rng.choice(list(lengths().items()))
        yield Case(*where, tuple((rng.choice(DISTURBANCES), rng.randint(1, n), rng.randrange(4)) for _ in range(2)))


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("cases", [singles, pairs])
def test_a_disturbance_at_any_moment_is_over_when_it_is_over(cases: Callable[[], Iterable[Case]]) -> None:
    if CASE:
        play(Case.of(CASE))
        return
    worlds = coincidences = simulated = 0
    for case in cases():
        world = play(case)
        worlds += 1
        coincidences += world.coincidence
        simulated += world.now
    print(f"seed {SEED}: {worlds} cases, {simulated / S:.0f} s of bus, {coincidences} claims in the same character")
    assert coincidences <= worlds / 50


def test_a_case_is_repeated_octet_for_octet() -> None:
    cases = [*pairs()][:20]
    digests = [play(case).digest for case in cases]
    assert [play(case).digest for case in cases] == digests and len(set(digests)) > len(cases) / 2
