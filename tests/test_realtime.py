# SPDX-License-Identifier: MIT
"""Real-time scheduling of the bus thread and the hub: what is taken, what is only asked for, and how a refusal shows."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from waiting import until

from dpmaster import ConfigurationError, Master, Realtime, Scheduling
from dpmaster._core import ffi, lib
from dpmaster.emulator import Line, Segment
from dpmaster.emulator.cards import SIP1
from dpmaster.realtime import schedule

# What a program needs to be refused, whoever runs the tests: no capabilities, no limit that grants anything.
REFUSED = """
import ctypes, resource, struct
for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
    resource.setrlimit(limit, (0, 0))
header, sets = struct.pack("Ii", 0x20080522, 0), struct.pack("6I", 0, 0, 0, 0, 0, 0)  # capset(2), version 3
assert ctypes.CDLL(None, use_errno=True).syscall(ctypes.c_long(%d), header, sets) == 0
import logging
logging.basicConfig(format="%%(message)s")
from dpmaster import Master
from dpmaster.emulator import Segment
with Segment() as wire, Master(wire.port(), realtime=True) as master:
    master.stop()
    print(master.statistics.port.scheduling)
from dpmaster.doctor import Level, examine_computer
print({remark.subject for remark in examine_computer() if remark.level is Level.BAD})
"""
CAPSET = {"x86_64": 126, "aarch64": 91, "armv7l": 185, "riscv64": 91}


def granted() -> bool:
    """Whether this user may ask for a priority: tried by a program, which leaves this one as it is."""
    program = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))"
    return subprocess.run([sys.executable, "-c", program], capture_output=True).returncode == 0


may = pytest.mark.skipif(not granted(), reason="SCHED_FIFO is not for this user: ulimit -r")


def thread(name: str) -> int:
    """The one thread of this process with that name, once the kernel has taken those that were joined off its list."""
    found: list[int] = []

    def alone() -> bool:
        found.clear()
        for task in Path("/proc/self/task").iterdir():
            with suppress(OSError):
                if (task / "comm").read_text().strip() == name:
                    found.append(int(task.name))
        return len(found) == 1

    until(alone)
    return found[0]


def locked() -> int:
    """kB of this process that stay in memory."""
    return int(re.search(r"VmLck:\s*(\d+)", Path("/proc/self/status").read_text())[1])  # type: ignore[index]


@may
@pytest.mark.parametrize(("asked", "priority"), [(True, 40), (Realtime(7, cpu=0), 7)])
def test_the_bus_thread_is_scheduled_as_it_was_asked_for(asked: Realtime | bool, priority: int) -> None:
    gc.collect()  # what tests before this one left
    before = locked()
    with Segment() as wire, Master(wire.port(), realtime=asked) as master:
        master.stop()
        task = thread("dpm-bus")
        assert os.sched_getscheduler(task) == os.SCHED_FIFO
        assert os.sched_getparam(task).sched_priority == priority
        cpu = None if asked is True else 0
        assert cpu is None or os.sched_getaffinity(task) == {0}
        assert master.statistics.port.scheduling == Scheduling(priority, cpu, True)
        assert locked() - before >= 64 + (lib.dpm_bus_size() + lib.dpm_master_size(126)) // 1024
    del master
    gc.collect()
    assert locked() == before, "the stack of a thread that is gone, or a block, is still locked"


@may
def test_a_hub_and_a_line_are_scheduled_too() -> None:
    with Segment(realtime=True) as wire, Line(wire.port(), SIP1(5), baudrate=500_000, realtime=Realtime(3)) as line:
        assert wire.scheduling == Scheduling(40, None, True)
        assert line.scheduling == Scheduling(3, None, True)


def test_on_a_pty_it_must_be_asked_for() -> None:
    """Its wire is the CPU: a thread that never waits for a wire would keep the program from running."""
    with Segment() as wire, Master(wire.port()) as master:
        master.stop()
        assert wire.scheduling == master.statistics.port.scheduling == Scheduling()
        assert os.sched_getscheduler(thread("dpm-bus")) == os.SCHED_OTHER


@pytest.mark.parametrize(("asked", "serial", "tried"), [
    (None, True, True), (None, False, False), (False, True, False), (True, False, True), (Realtime(9), False, True)])
def test_a_serial_port_takes_it_unasked(asked: Realtime | bool | None, serial: bool, tried: bool) -> None:
    tries = []

    def system(wish: object, refusals: object) -> int:
        tries.append(wish)
        return 0

    schedule(asked, serial, system, [], "a thread")
    assert bool(tries) is tried


@pytest.mark.skipif(os.uname().machine not in CAPSET, reason="the number of capset here is not known")
def test_a_refusal_is_logged_with_its_remedy_and_the_bus_runs() -> None:
    ran = subprocess.run([sys.executable, "-c", REFUSED % CAPSET[os.uname().machine]], capture_output=True, text=True,
                         env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert ran.returncode == 0, ran.stderr
    assert "Scheduling(priority=None, cpu=None, locked=False" in ran.stdout
    assert all(subject in ran.stdout.splitlines()[-1] for subject in ("'priority'", "'memory'")), "root is not believed, either"
    for words in (r"the bus thread on /dev/pts/\d+: SCHED_FIFO 40 was refused \(Operation not permitted\): raise RLIMIT_RTPRIO",
                  r"locked memory was refused \(.*\): raise RLIMIT_MEMLOCK"):
        assert re.search(words, ran.stderr), ran.stderr
        assert re.search(words.partition(": ")[2], ran.stdout)


def refusing(**errors: int) -> Callable[[object, object], int]:
    def system(wish: object, refusals: object) -> int:
        for name, number in errors.items():
            setattr(refusals, name, number)
        return 0

    return system


def test_what_is_granted_holds_whatever_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    found = schedule(Realtime(5, cpu=900), False, refusing(cpu=22), [], "a thread")
    assert (found.priority, found.cpu, found.locked) == (5, None, True)
    (words,) = found.refused
    assert words.startswith("CPU 900 was refused (Invalid argument): 'nproc --all'")
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_cpu_that_is_not_there_is_refused_by_the_kernel(caplog: pytest.LogCaptureFixture) -> None:
    with Segment(realtime=Realtime(1, cpu=1023, lock=False)) as wire:
        assert wire.scheduling.cpu is None
        assert "CPU 1023 was refused" in caplog.text


@pytest.mark.parametrize("wrong", [1, "yes", 0.5])
def test_what_is_no_wish_is_refused(wrong: object) -> None:
    with Segment() as wire, pytest.raises(ConfigurationError, match="a Realtime, True for its defaults"):
        Master(wire.port(), realtime=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [{"priority": 0}, {"priority": 100}, {"cpu": -1}, {"cpu": True}])
def test_a_wish_out_of_range_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigurationError, match=f"{next(iter(wrong))} "):
        Realtime(**wrong)


def test_a_thread_that_does_not_run_is_not_scheduled() -> None:
    with Segment() as wire:
        refusals = ffi.new("dpm_refusals *")
        for wish in ((100, -1, False), (-1, -1, False), (1, 1024, False), (1, -2, False)):
            assert lib.dpm_segment_realtime(wire._object, ffi.new("dpm_realtime *", wish), refusals) == lib.DPM_E_ARGUMENT
        wire.close()
        assert lib.dpm_segment_realtime(wire._object, ffi.new("dpm_realtime *", (1, -1, False)), refusals) == lib.DPM_E_CLOSED
