# SPDX-License-Identifier: MIT
"""Whatever happens in whatever order: outputs are zeros, or of a commit that lives and that the program stands by.

Random, by seed (DPM_SOAK_SEED; a failure names it; `make soak`: 2000 of them, DPM_PROGRAMS), on virtual time: a program that
commits, hangs, changes the mode and its stations, a port that comes and goes, slaves that are lost and restarted, answers that
are lost. Each Data_Exchange is judged by a model of when commits end, which knows the promises and nothing of the code.
"""

from __future__ import annotations

import os
import random

import pytest
from wire import MS, Master, S, Sent, Slaves, Wire, default_parameters, ffi, lib

SEED = int(os.environ.get("DPM_SOAK_SEED", "1"))
PROGRAMS = int(os.environ.get("DPM_PROGRAMS", "12"))
WATCHDOG = 1 * S
CONFIGURATION = b"\x72"  # 3 words each way
FIRST = 10  # address of the first of two slaves
LATE = 3 * MS  # a telegram was asked for before it goes out


class Program:
    """What a program may do, and what it may expect of its outputs."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = rng = random.Random(seed)
        parameters = default_parameters(500_000)
        self.master = Master(parameters=parameters, output_watchdog=WATCHDOG, control_interval=50 * MS,
                             auto_clear=seed % 5 == 0)
        self.slaves = Slaves(parameters=parameters)
        self.hold = [rng.random() < 0.5 for _ in range(2)]
        for i, hold in enumerate(self.hold):
            self.master.add(FIRST + i, 0x00CA, CONFIGURATION, watchdog=(5, 10), hold=hold)
            self.slaves.add(FIRST + i, 0x00CA, CONFIGURATION)
        self.wire = Wire(parameters, self.master.machine, self.slaves.machine)
        self.alive: list[set[bytes]] = [set(), set()]
        self.was_lost = [False, False]
        self.stood = 0  # when the program last stood by its commits
        self.commits = 0
        self.outputs = 0  # telegrams with outputs other than zeros
        self.control = ffi.NULL
        self._mode(lib.DPM_MODE_CLEAR)

    # ---- what happens

    def act(self) -> None:
        weights = {self._commit: 5, self._feed: 1, self._mode: 2, self._slave: 2, self._activate: 1, self._new_prm: 1,
                   self._port: 1, self._losses: 1, self._clear_by_order: 1, self._hang: 1}
        self.rng.choices(list(weights), list(weights.values()))[0]()

    def _commit(self) -> None:
        i, value = self.rng.randrange(2), (self.commits + 1).to_bytes(6, "big")
        if self.master.commit(i, value, self.wire.now) > 0:
            self.commits += 1
            self.alive[i].add(value)
            self.stood = self.wire.now

    def _feed(self) -> None:
        lib.dpm_master_feed(self.master.master, self.wire.now, lib.DPM_FED_PROGRAM)
        self.stood = self.wire.now

    def _mode(self, mode: int | None = None) -> None:
        operate = lib.DPM_MODE_OPERATE
        wanted = mode or self.rng.choice([operate] * 6 + [lib.DPM_MODE_CLEAR, lib.DPM_MODE_STOP, lib.DPM_MODE_OFFLINE])
        if lib.dpm_master_set_mode(self.master.master, wanted, self.wire.now) == 0 and wanted == operate:
            self.stood = self.wire.now

    def _slave(self) -> None:
        i = self.rng.randrange(2)
        if self.rng.random() < 0.3:
            lib.dpm_slaves_reset(self.slaves.slaves, i, self.wire.now)
        else:
            lib.dpm_slaves_connect(self.slaves.slaves, i, self.rng.random() < 0.7)

    def _activate(self) -> None:
        i, active = self.rng.randrange(2), self.rng.random() < 0.7
        lib.dpm_master_activate(self.master.master, i, active, self.wire.now)
        if not active:
            self.alive[i].clear()

    def _new_prm(self) -> None:
        i = self.rng.randrange(2)
        begun = lib.DPM_ST_PRM <= self.master.slave(i).state <= lib.DPM_ST_DATA
        lib.dpm_master_new_prm(self.master.master, i, self.wire.now)
        if begun:
            self.alive[i].clear()

    def _port(self) -> None:
        lib.dpm_master_port(self.master.master, self.rng.random() < 0.6, self.wire.now)

    def _losses(self) -> None:
        chance = self.rng.choice([0, 0, 0, 0.02, 0.3, 1])
        self.wire.mangle = lambda sent: b"" if self.rng.random() < chance else None

    def _clear_by_order(self) -> None:
        lib.dpm_master_revoke(self.master.master, self.control)
        da = self.rng.choice([127, FIRST, FIRST + 1])
        self.control = ffi.new("dpm_control *", {"da": da, "clear": self.rng.randrange(2)})
        if lib.dpm_master_order(self.master.master, self.control, self.wire.now) == 0 and self.control.clear:
            for i in range(2):
                if da in (127, FIRST + i):
                    self.alive[i].clear()

    def _hang(self) -> None:
        """It commits to stations that are not there, and nothing after that."""
        for connected in (False, True):
            for i in range(2):
                lib.dpm_slaves_connect(self.slaves.slaves, i, connected)
            self.pass_time(self.rng.choice([1, 50]) * MS)
            if not connected:
                self._commit()
                self.pass_time(2 * S)

    # ---- what it may expect

    def hear(self) -> None:
        """Leaving Operate and the output watchdog end all commits; leaving Data_Exchange and coming back those of a station."""
        for event in self.master.events():
            if event.kind == lib.DPM_EV_STATE and lib.DPM_ST_DATA in (event.a, event.b):
                i = event.address - FIRST
                self.was_lost[i] |= event.b == lib.DPM_ST_DATA
                if self.was_lost[i] and not self.hold[i]:
                    self.alive[i].clear()
            if event.kind == lib.DPM_EV_WATCHDOG or (event.kind == lib.DPM_EV_MODE and event.b == lib.DPM_MODE_OPERATE):
                for alive in self.alive:
                    alive.clear()

    def judge(self, sent: Sent) -> None:
        head, value = sent.octets[:1] + sent.octets[4:6], sent.octets[7:-2]  # SD2, DA and SA without SAPs
        if head not in (bytes((0x68, FIRST, 1)), bytes((0x68, FIRST + 1, 1))) or not any(value):
            return
        self.outputs += 1
        when = f"seed {self.seed}, {sent.start / MS} ms: {sent.hex}"
        assert value in self.alive[head[1] - FIRST], f"{when} is of a commit that has ended"
        assert sent.start <= self.stood + WATCHDOG + LATE, f"{when}: nobody has stood by it for too long"

    def pass_time(self, duration: int) -> None:
        self.hear()
        end = self.wire.now + duration
        while sent := self.wire.step(end):
            self.hear()
            self.judge(sent)
        self.hear()

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.act()
            self.pass_time(self.rng.choice([1, 5, 20, 50, 200, 200, 1500]) * MS // self.rng.choice([1, 1, 7]))


@pytest.mark.timeout(3600)
def test_outputs_are_zeros_or_of_a_commit_that_lives() -> None:
    outputs = 0
    for seed in range(SEED, SEED + PROGRAMS):
        program = Program(seed)
        program.run(100)
        outputs += program.outputs
    assert outputs > 200 * PROGRAMS, "hardly anything was tried"
