# SPDX-License-Identifier: MIT
"""A bus on the simulated segment on which one slave's answers can be forged, and the invariants are watched at every event.

The master drives the victim at 5 and a neighbour at 9 and commits new outputs after each of its own telegrams. `Forger` sits
between the victim and the wire: it can keep requests from it, and keep, change, double or delay its answers. `Bench.step`
runs to the next transmission and fails on the first of the design's invariants that is broken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from simulation import Simulation, Transmission, Violation
from slave_rig import telegram
from wire import MS, NEVER, US, Master, Slaves, default_parameters

from dpmaster._core import ffi, lib

MASTER, RIVAL, VICTIM, NEIGHBOUR = 1, 2, 5, 9
IDENT, OTHER_IDENT = 0x00CA, 0x9527
BASIC, LENGTH = b"\x72", 6  # SI-P1 manual, chapter 2, "Basic data": 6 octets each way
SAFE = bytes(LENGTH)
WATCHDOG = (1, 10)  # 100 ms
DATA_CONTROL_TIME = 150 * MS
SLOW = 5  # exchanges after a return until the program, which commits all the time, notices it and begins again

OFFLINE, DIAG1, PRM, CFG = lib.DPM_ST_OFFLINE, lib.DPM_ST_DIAG1, lib.DPM_ST_PRM, lib.DPM_ST_CFG
DIAG2, DATA, LEAVING = lib.DPM_ST_DIAG2, lib.DPM_ST_DATA, lib.DPM_ST_LEAVING

# Protocol page J.2: from which step the handler may go where. From anywhere to OFFLINE on silence, to DIAG1 on a refusal.
EDGES = {(OFFLINE, DIAG1), (OFFLINE, PRM), (DIAG1, PRM), (PRM, CFG), (CFG, DIAG2), (DIAG2, DATA), (DATA, PRM)} | {
    (a, b) for a in (OFFLINE, DIAG1, PRM, CFG, DIAG2, DATA) for b in (OFFLINE, DIAG1)} | {
    (a, LEAVING) for a in (PRM, CFG, DIAG2, DATA)} | {(LEAVING, OFFLINE)}

Answers = list[tuple[int, bytes]]
"""What leaves in place of one answer: (ns later than due, octets)."""


class Forger:
    """A machine that is another one, but for what the test does to requests and answers. FDL status is left alone."""

    def __init__(self, inner: Slaves) -> None:
        self.inner = inner
        self.deaf = False
        self.forge: Callable[[bytes], Answers | None] | None = None
        """Called with each DP answer as it is due; None: let it pass."""
        self._queue: Answers = []
        self._kept: Any = None
        self._own = False
        self._calls = (ffi.callback("void(dpm_machine *, const dpm_span *)")(self._octets),
                       ffi.callback("void(dpm_machine *, int64_t)")(self._quiet),
                       ffi.callback("void(dpm_machine *, int64_t, int64_t, int64_t, int)")(self._sent),
                       ffi.callback("void(dpm_machine *, int64_t, dpm_offer *)")(self._ask))
        self.machine = ffi.new("dpm_machine *")
        self.machine.octets, self.machine.quiet, self.machine.sent, self.machine.ask = self._calls

    def _octets(self, _: Any, span: Any) -> None:
        if not self.deaf:
            self.inner.machine.octets(self.inner.machine, span)

    def _quiet(self, _: Any, until: int) -> None:
        self.inner.machine.quiet(self.inner.machine, until)

    def _sent(self, _: Any, start: int, earliest: int, latest: int, result: int) -> None:
        if self._own:
            self._queue.pop(0)
        else:
            self.inner.machine.sent(self.inner.machine, start, earliest, latest, result)

    def _ask(self, _: Any, now: int, offer: Any) -> None:
        inner = self.inner.machine
        inner.ask(inner, now, offer)
        answer = bytes(ffi.buffer(offer.octets, offer.n)) if offer.n else b""
        status = len(answer) == 6 and answer[0] == 0x10 and answer[3] == 0x00
        if answer and self.forge and not status and now >= offer.not_before:
            forged = self.forge(answer)
            if forged is not None:
                inner.sent(inner, now, now, now, lib.DPM_SENT_WHOLE)
                self._queue = [(now + later, octets) for later, octets in forged]
                inner.ask(inner, now, offer)
        self._own = bool(self._queue)
        if self._own:
            offer.not_before, octets = self._queue[0]
            self._kept = ffi.new("uint8_t[]", octets)
            offer.octets, offer.n, offer.not_after = self._kept, len(octets), NEVER


class Bench:
    """Victim, neighbour and master in Operate (or the mode given); `step()` is one event with all invariants checked."""

    def __init__(self, mode: int = lib.DPM_MODE_OPERATE, *, ring: bool = False, rivals: bool = False,
                 auto_clear: bool = False) -> None:
        """ring: another master shares the bus, in Stop and with no slaves; rivals: one that operates and wants the victim."""
        self.parameters = default_parameters(500_000)
        self.wire = Simulation(self.parameters, ports=8, tap=64, grace=0)
        self.master = Master(parameters=self.parameters, address=MASTER, slaves=2, control_interval=DATA_CONTROL_TIME // 3,
                             role=lib.DPM_ROLE_RING if ring or rivals else lib.DPM_ROLE_SOLE, auto_clear=auto_clear)
        self.devices = [self._device(VICTIM, IDENT), self._device(VICTIM, OTHER_IDENT)]
        self.neighbour = self._device(NEIGHBOUR, IDENT)
        self.forger = Forger(self.devices[0])
        for address in (VICTIM, NEIGHBOUR):
            self.master.add(address, IDENT, BASIC, watchdog=WATCHDOG)
        self.master_port = self.wire.attach(self.master)
        self.wire.attach(self.forger)
        self.wire.attach(self.neighbour)
        if ring or rivals:
            self.other = Master(parameters=self.parameters, address=RIVAL, slaves=1, role=lib.DPM_ROLE_RING)
            self.wire.attach(self.other)
            if rivals:
                self.other.add(VICTIM, IDENT, BASIC, watchdog=WATCHDOG)
            self.other.mode(lib.DPM_MODE_OPERATE if rivals else lib.DPM_MODE_STOP)
        self.count = 0
        self.barrier = 0  # commits up to this one must never be sent (again)
        self.resume = 0  # exchanges after which the program commits again
        self.written = {SAFE, b""}
        self.seen = -1  # number of the last transmission looked at
        self.gaps: list[int] = []  # ns between two answers of the neighbour
        self._neighbour_at = 0
        self.foreign_set_prm = 0  # Set_Prm seen while the other device was plugged
        self.events: list[tuple[int, int]] = []
        if auto_clear and mode == lib.DPM_MODE_OPERATE:
            self.mode(lib.DPM_MODE_CLEAR)
            self.run_until(self.exchanging(), 100 * MS)
        self.mode(mode)

    def _device(self, address: int, ident: int) -> Slaves:
        device = Slaves(parameters=self.parameters, slaves=1)
        device.add(address, ident, BASIC, user=(0, 0))
        return device

    # ---- what a test may do

    def mode(self, mode: int) -> None:
        self.master.mode(mode, self.wire.now)

    def swap(self, other: bool) -> None:
        """Another device on the victim's place, freshly switched on."""
        self.forger.inner = self.devices[other]
        lib.dpm_slaves_reset(self.forger.inner.slaves, 0, self.wire.now)

    def reset(self) -> None:
        lib.dpm_slaves_reset(self.forger.inner.slaves, 0, self.wire.now)

    def rival(self, octets: bytes) -> None:
        """A telegram that only the victim hears, from a master which nobody else knows of."""
        now = self.wire.now
        character = int(lib.dpm_bits_up(self.parameters, 11))
        data = ffi.new("uint8_t[]", octets)
        span = ffi.new("dpm_span *", {"octets": data, "n": len(octets), "earliest": now - (len(octets) - 1) * character,
                                      "latest": now - (len(octets) - 1) * character, "spacing": character})
        machine = self.forger.inner.machine
        machine.octets(machine, span)
        offer = ffi.new("dpm_offer *")
        machine.ask(machine, now, offer)
        if offer.n:
            machine.sent(machine, now, now, now, lib.DPM_SENT_WHOLE)

    def rival_takes(self) -> None:
        """The victim loses its parameters and another master is the first to give it new ones (WD off: it stays)."""
        self.reset()
        self.rival(telegram(VICTIM, RIVAL, 0x4D, bytes((0x80, 1, 1, 11)) + IDENT.to_bytes(2, "big") + b"\0", dsap=61))

    def rival_releases(self) -> None:
        self.rival(telegram(VICTIM, RIVAL, 0x4D, bytes((0x40, 1, 1, 11)) + IDENT.to_bytes(2, "big") + b"\0", dsap=61))

    # ---- what it sees

    @property
    def victim(self) -> Any:
        self._victim = self.master.slave(0)  # a struct inside a struct does not keep the outer one
        return self._victim

    @property
    def state(self) -> int:
        return int(self.victim.state)

    @property
    def report(self) -> Any:
        return self.forger.inner.report(0)

    def exchanging(self) -> Callable[[], bool]:
        """Whether, since now, data was exchanged several times, with outputs of the last few commits in Operate."""
        done = self.report.exchanges + 3

        def condition() -> bool:
            if self.report.exchanges < done or self.state != DATA:
                return False
            frame = self.forger.inner.outputs(0)
            number = int.from_bytes(bytes(frame.octets[0:2]), "big") if frame.valid else 0
            return self.master.status.mode != lib.DPM_MODE_OPERATE or number > max(self.count - 12, self.barrier)

        return condition

    # ---- events

    def step(self, until: int) -> list[Transmission]:
        """To the next transmission or to `until`; what was sent."""
        self.wire.run(until=until, transmissions=1, violation=False)
        self._follow_states()
        sent = [t for t in self.wire.tap(8) if t.number > self.seen]
        for t in sent:
            self.seen = t.number
            self._watch(t)
        frame = self.forger.inner.outputs(0)
        outputs = bytes(frame.octets[0:frame.length])
        assert outputs in self.written, f"the victim has outputs {outputs.hex(' ')}, which nobody wrote"
        if any(t.port == self.master_port for t in sent):
            self._commit()
        return sent

    def _commit(self) -> None:
        self.count += 1
        value = self.count.to_bytes(2, "big") * (LENGTH // 2)
        slow = self.victim.statistics.exchanges < self.resume
        for index in (1,) if slow else (0, 1):
            if self.master.commit(index, value, self.wire.now) > 0:
                self.written.add(value)

    def _watch(self, t: Transmission) -> None:
        if t.port == self.master_port and t.da == VICTIM and t.octets[0] == 0x68 and t.octets[4] == VICTIM:
            data = t.octets[7:-2]
            number = int.from_bytes(data[0:2], "big")
            assert data in self.written, f"sent {data.hex(' ')}, which nobody wrote"
            assert number == 0 or number > self.barrier, f"commit {number} was sent again after a loss at {self.barrier}"
        if t.port == self.master_port and t.da == VICTIM and t.octets[7:8] == b"\x3d":
            self.foreign_set_prm += self.forger.inner is self.devices[1]
        if t.sa == NEIGHBOUR and t.octets[0] == 0x68 and t.octets[4] == MASTER:
            self.gaps.append(t.start - (self._neighbour_at or t.start))
            self._neighbour_at = t.start

    def _follow_states(self) -> None:
        for event in self.master.events():
            if event.kind == lib.DPM_EV_STATE and event.address == VICTIM:
                edge = (event.b, event.a)
                assert edge in EDGES, f"the handler went from {edge[0]} to {edge[1]}"
                self.events.append(edge)
                # "A station that left Data_Exchange comes back with safe outputs."
                if DATA in edge and self.victim.statistics.losses:
                    self.barrier = self.count
                    self.resume = self.victim.statistics.exchanges + SLOW

    def run_until(self, condition: Callable[[], bool], limit: int) -> int:
        """ns until the condition held."""
        begin, end = self.wire.now, self.wire.now + limit
        while not condition():
            if self.wire.now >= end:
                status = self.victim
                tail = "\n".join(map(str, self.wire.tap(24)))
                raise AssertionError(f"not reached in {limit / MS} ms; handler in {status.state}, reason {status.reason} "
                                     f"({status.detail}), slave in {self.report.state}:\n{tail}")
            self.step(end)
        return self.wire.now - begin

    def run(self, duration: int) -> None:
        end = self.wire.now + duration
        while self.wire.now < end:
            self.step(end)

    def check_rules(self, unseen: bool = False) -> None:
        """Whatever the others did: our master broke no rule of the wire. `unseen`: but for talking over an octet that had
        begun less than a character before, which nobody can know of."""
        broken = [v for v in self.wire.violations() if v.port == self.master_port]
        if unseen:
            broken = [v for v in broken if not (v.rule == lib.DPM_RULE_COLLISION and self._had_just_begun(v))]
        assert not broken, f"{broken[0]}\n" + "\n".join(map(str, self.wire.tap(40)))

    def _had_just_begun(self, collision: Violation) -> bool:
        lengths = (17, 15, 1)  # octets of the victim's answers: Slave_Diag, Data_Exchange, SC
        return any(0 <= n * 11 - collision.value < 11 for n in lengths)


# ---- faults: what leaves in place of an answer --------------------------------------------------------------------------


def whole(octets: bytes) -> bytes:
    """The telegram with the right FCS."""
    if octets[0] == 0x10:
        return octets[:4] + bytes([sum(octets[1:4]) & 0xFF, 0x16])
    return octets[:-2] + bytes([sum(octets[4:-2]) & 0xFF, 0x16])


def fields(octets: bytes) -> Iterator[tuple[str, int]]:
    """Names of an answer's octets: "in each field"."""
    names = {1: ("SC",), 6: ("SD1", "DA", "SA", "FC", "FCS", "ED")}.get(len(octets))
    if names is None:
        saps = ("DSAP", "SSAP") if octets[4] & 0x80 else ()
        head = ("SD2", "LE", "LEr", "SD2r", "DA", "SA", "FC", *saps)
        names = (*head, *("data",) * (len(octets) - len(head) - 2), "FCS", "ED")
    return zip(names, range(len(octets)), strict=True)


def slot_and_more(bench: Bench) -> int:
    """ns by which an answer is late "by more than a slot"."""
    return int(lib.dpm_bits_up(bench.parameters, 2 * bench.parameters.tsl)) + 50 * US
