# SPDX-License-Identifier: MIT
"""When the program hangs or dies, drives do not run on: real processes over a real pty.

The segment and the card live in this process, the master in another one. What came when is told by the card's own history
and by a tap on the wire, never by how long something was waited for.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby

import pytest
from slow_decoder import whole

from dpmaster.emulator import Exchange, Segment, SlaveState
from dpmaster.emulator.cards import SIP1
from dpmaster.profiles.yaskawa_v7 import Command

PATIENCE = 30.0  # s; only a failing test waits so long
LATE = 2.0  # s that a loaded machine may be late
ALLOWANCE = 0.2  # s that it may be so between a request and its answer, without the drive being lost
RAMP = 0.3  # s from 60 Hz to 0: n020
SPEED = 30.0  # Hz
DOWN = RAMP * SPEED / 60


@dataclass(frozen=True)
class Seen:
    """The card behind one step."""

    time: float
    exchange: Exchange
    fault: str | None
    frequency: float

    @property
    def commanded(self) -> bool:
        """The card has outputs that say run."""
        return self.exchange.valid and bool(int.from_bytes(self.exchange.outputs[:2], "big") & Command.RUN)


class Witness(SIP1):
    """An SI-P1 that remembers."""

    def __init__(self) -> None:
        super().__init__(5)
        self.registers["n019"] = self.registers["n020"] = round(RAMP * 10)
        self.history: list[Seen] = []
        self._news = threading.Condition()

    def step(self, now: float, exchange: Exchange) -> bytes:
        octets = super().step(now, exchange)
        with self._news:
            self.history.append(Seen(now, exchange, self.fault, self.motor.frequency))
            self._news.notify_all()
        return octets

    def since(self, begin: float) -> list[Seen]:
        with self._news:
            return [seen for seen in self.history if seen.time >= begin]

    def until(self, predicate: Callable[[Seen], bool], begin: float = 0.0) -> Seen:
        """The first that fulfils the predicate, from `begin` on."""
        looked = 0

        def found() -> Seen | None:
            nonlocal looked
            new, looked = self.history[looked:], len(self.history)
            return next((seen for seen in new if seen.time >= begin and predicate(seen)), None)

        with self._news:
            seen = self._news.wait_for(found, PATIENCE)
            assert seen is not None, f"it did not come; the last was {self.history[-1]}"
            return seen

    def until_still(self, begin: float) -> Seen:
        return self.until(lambda seen: seen.frequency == 0, begin)


class Tap:
    """A client that hears the wire."""

    def __init__(self, path: str, wire: Segment) -> None:
        self.octets = bytearray()
        self._news = threading.Condition()
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self._end, self._ending = os.pipe()
        _ = wire.info  # runs on the hub's thread behind the open: from here on it is heard
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while self._end not in (ready := select.select([self._fd, self._end], [], [])[0]):
            assert ready
            with self._news:
                self.octets += os.read(self._fd, 65536)
                self._news.notify_all()

    def close(self) -> None:
        if self._ending >= 0:
            os.close(self._ending)
            self._ending = -1
            self._thread.join()
            os.close(self._end)
            os.close(self._fd)

    def telegrams(self) -> list[bytes]:
        """Those that are here; the last may have come in part."""
        rest, found = bytes(self.octets), []
        while rest:
            telegram = whole(rest)
            if telegram is not None and len(telegram) > len(rest):
                break
            assert telegram is not None and rest.startswith(telegram), rest[:20].hex(" ")
            found.append(telegram)
            rest = rest[len(telegram):]
        return found

    def told_until(self, last: str) -> list[str]:
        """`told`, once it ends so: the thread that listens may be late."""
        with self._news:
            self._news.wait_for(lambda: self.told()[-1:] == [last], PATIENCE)
        return self.told()

    def told(self) -> list[str]:
        """What the master said to the drive, in order: run, stop (each when it was answered), Clear, Unlock."""
        found = []
        telegrams = self.telegrams()
        for telegram, behind in zip(telegrams, [*telegrams[1:], b""], strict=True):
            if telegram[0] == 0x68:
                answered = behind[4:6] == bytes((1, 5)) or behind == b"\xE5"
                found.append(self._what(telegram[4:-2], telegram[7:-2], answered=answered))
        return [word for word, _ in groupby(filter(None, found))]

    @staticmethod
    def _what(body: bytes, data: bytes, *, answered: bool) -> str:
        if body[:2] == bytes((5, 1)) and any(data):  # Data_Exchange; zeros say nothing
            return ("run" if data[1] & 3 else "stop") if answered else ""
        if body[:2] == bytes((0xFF, 0x81)) and data[:2] == bytes((58, 62)):  # Global_Control; 02h: Clear_Data
            return "Clear" if data[2] & 0x02 else ""
        if body[:2] == bytes((0x85, 0x81)) and data[:2] == bytes((61, 62)):  # Set_Prm; 40h: Unlock_Req, 80h: Lock_Req
            return "Unlock" if data[2] & 0xC0 == 0x40 and answered else ""
        return ""


class Bench:
    """A wire with the card and a tap on it."""

    def __init__(self) -> None:
        self.wire = Segment(ports=2, cards=1)
        self.card = self.wire.attach(Witness())
        self.port, tapped = self.wire.port(), self.wire.port()
        self.tap = Tap(tapped, self.wire)
        self.programs: list[Program] = []
        self.watchdog = 0.0

    def program(self, text: str, *, output_watchdog: float = 30.0, watchdog: float | str = 1.5,
                cycle_time: float = 0.01, allowance: float | None = ALLOWANCE) -> Program:
        """A program whose drive has just reached its speed, then `text`."""
        self.programs.append(Program(START.format(path=str(self.port), output_watchdog=output_watchdog, watchdog=watchdog,
                                                  cycle_time=cycle_time, speed=SPEED, allowance=allowance) + text))
        self.programs[-1].expect("running")
        self.watchdog = self.wire.report(self.card).watchdog or 0.0  # s, as it was set
        return self.programs[-1]

    def until_clear(self) -> Seen:
        """The first without outputs after it ran."""
        ran = self.card.until(lambda seen: seen.frequency == SPEED)
        return self.card.until(lambda seen: not seen.exchange.valid, ran.time)

    @property
    def expired(self) -> int:
        return self.wire.report(self.card).watchdog_expired

    def close(self) -> None:
        for program in self.programs:
            program.end()
        self.tap.close()
        self.wire.close()


class Program:
    """A Python process that is talked to by lines."""

    def __init__(self, text: str) -> None:
        self.process = subprocess.Popen([sys.executable, "-c", text], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                        stderr=subprocess.PIPE, bufsize=0)

    def expect(self, beginning: str) -> str:
        assert self.process.stdout is not None
        line = ""
        if select.select([self.process.stdout], [], [], PATIENCE)[0]:
            line = self.process.stdout.readline().decode().rstrip()
        if not line.startswith(beginning):
            self.process.kill()
            assert self.process.stderr is not None
            pytest.fail(f"{beginning!r} was expected, {line!r} came; stderr: {self.process.stderr.read().decode()}")
        return line

    def do(self, line: str, answer: str = "done") -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        return self.expect(answer)

    def signal(self, number: signal.Signals) -> float:
        """Send it; the time when it was sent."""
        now = time.monotonic()
        self.process.send_signal(number)
        return now

    def wait(self) -> tuple[int, str]:
        """Its exit code and stderr."""
        _, stderr = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, stderr.decode()

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


START = """
import os, select, sys, time
from dpmaster import DPError, Master
from dpmaster.drives import YaskawaV7
master = Master({path!r}, cycle_time={cycle_time}, output_watchdog={output_watchdog!r}, allowance={allowance})
drive = master.add(YaskawaV7(5, watchdog={watchdog!r}))
master.operate(20.0)
drive.run_forward({speed!r})
drive.wait_until(lambda status: status.frequency_agree, 20.0)
print("running", flush=True)
"""

FOLLOW = """
while True:
    master.wait_cycle(20.0)
"""

OBEY = """
recommit = False
while True:
    master.wait_cycle(20.0)
    if recommit:
        drive.frequency = 30.0
    if select.select([sys.stdin], [], [], 0)[0]:
        try:
            exec(sys.stdin.readline())
        except DPError as error:
            print(type(error).__name__, error, flush=True)
        else:
            print("done", flush=True)
"""


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


# ---- killed


def test_a_killed_master_is_noticed_by_the_slaves_watchdog_which_is_on_by_default(bench: Bench) -> None:
    program = bench.program(FOLLOW, watchdog="default", cycle_time=0.03, allowance=0.08)
    assert 0.1 <= bench.watchdog <= 1.0  # "ten predicted cycles with retries, at least 100 ms, at most 1 s"
    killed = program.signal(signal.SIGKILL)
    fault = bench.card.until(lambda seen: seen.fault == "BUS", killed)
    still = bench.card.until_still(killed)
    assert bench.expired == 1
    assert fault.time <= killed + bench.watchdog + LATE
    assert still.time <= fault.time + DOWN + LATE
    assert bench.tap.told()[-1] == "run"  # nobody was left to say stop


# ---- hung


@pytest.mark.parametrize("hang", ["sys.stdin.read()", "while True: pass", "time.sleep(3600)"])
def test_a_program_that_hangs_loses_its_outputs(bench: Bench, hang: str) -> None:
    program = bench.program(hang, output_watchdog=0.5)
    hung = time.monotonic()
    clear = bench.until_clear()
    still = bench.card.until_still(clear.time)
    assert clear.time <= hung + 0.5 + LATE
    assert still.time <= clear.time + DOWN + LATE
    # The bus thread lives: the drive is in the master's cycle, in Clear, and has no fault.
    assert clear.exchange.state is still.exchange.state is SlaveState.DATA_EXCH
    assert (still.fault, bench.expired, program.process.poll()) == (None, 0, None)


def test_after_a_hang_nothing_moves_until_operate_and_a_new_command(bench: Bench) -> None:
    program = bench.program("sys.stdin.readline(); print('awake', flush=True)" + OBEY, output_watchdog=0.5)
    still = bench.card.until_still(bench.until_clear().time)
    program.do("", "awake")
    refused = program.do("drive.run_forward(20.0)", "NotOperatingError")
    for part in ("output watchdog", "0.5 s", "last was a wait", "operate()", "feed()"):
        assert part in refused
    program.do("master.operate(20.0)")
    program.do("for _ in range(5): master.wait_cycle(20.0)")
    program.do("assert drive.outputs == bytes(32), drive.outputs")  # "what was written before is never sent again"
    again = time.monotonic()
    assert not any(seen.commanded or seen.frequency for seen in bench.card.since(still.time))
    program.do("drive.run_forward(20.0)")
    bench.card.until(lambda seen: seen.frequency == 20.0, again)


# ---- Ctrl-C and the program's end


def leaves_well(bench: Bench, begin: float) -> None:
    """Stop word, answered; Clear; Unlock; and the slave's watchdog had nothing to do."""
    ran = bench.card.until(lambda seen: seen.exchange.state is SlaveState.DATA_EXCH, begin)
    gone = bench.card.until(lambda seen: seen.exchange.state is SlaveState.WAIT_PRM, ran.time)
    still = bench.card.until_still(gone.time)
    assert (gone.exchange.master, bench.expired) == (None, 0)
    assert still.time <= gone.time + DOWN + LATE
    told = bench.tap.told_until("Unlock")
    last = max(index for index, word in enumerate(told) if word == "run")
    assert told[last:] == ["run", "stop", "Clear", "Unlock"]
    assert bench.wire.info.undelivered == 0


@pytest.mark.parametrize("waiting", [
    "while True: master.wait_cycle(20.0)", "drive.wait_until(lambda status: False, 60.0)",
    "while True: time.sleep(0.5)", "with master:\n    while True: time.sleep(0.5)", "for event in master.events(): pass",
])
def test_ctrl_c_leaves_through_stop_word_clear_and_unlock(bench: Bench, waiting: str) -> None:
    """Short sleeps: a signal between Python's last look for one and the system call does not end that call."""
    program = bench.program(waiting)
    begin = program.signal(signal.SIGINT)
    code, stderr = program.wait()
    assert code == -signal.SIGINT  # which a shell shows as 130
    assert stderr.rstrip().endswith("KeyboardInterrupt")
    leaves_well(bench, begin)


@pytest.mark.parametrize(("end", "code", "words"), [
    ("", 0, ""), ("sys.exit(3)", 3, ""), ("raise RuntimeError('my own')", 1, "RuntimeError: my own"),
    ("with master: sys.exit(3)", 3, ""), ("del master, drive", 0, ""),
    ("__import__('threading').Thread(target=lambda: time.sleep(0.2)).start()", 0, ""),
])
def test_a_program_that_ends_leaves_as_well(bench: Bench, end: str, code: int, words: str) -> None:
    begin = time.monotonic()
    program = bench.program(end)
    left, stderr = program.wait()
    assert left == code
    assert words in stderr if words else not stderr
    leaves_well(bench, begin)


# ---- stopped for a while


def test_stopped_for_longer_than_both_watchdogs(bench: Bench) -> None:
    program = bench.program(OBEY, output_watchdog=0.6, watchdog=0.3)
    stopped = program.signal(signal.SIGSTOP)
    fault = bench.card.until(lambda seen: seen.fault == "BUS", stopped)
    assert fault.time <= stopped + bench.watchdog + LATE
    bench.card.until(lambda seen: seen.frequency == 0 and seen.time > stopped + 1.0, stopped)
    resumed = program.signal(signal.SIGCONT)
    bench.card.until(lambda seen: seen.exchange.state is SlaveState.DATA_EXCH, resumed)
    program.do("drive.wait(lambda frame: frame.valid, 20.0)")
    assert "output watchdog" in program.do("drive.run_forward(20.0)", "NotOperatingError")
    program.do("master.operate(20.0)")
    program.do("for _ in range(5): master.wait_cycle(20.0)")
    again = time.monotonic()
    assert not any(seen.commanded or seen.frequency for seen in bench.card.since(resumed))
    program.do("drive.fault_reset(); drive.run_forward(20.0)")
    bench.card.until(lambda seen: seen.frequency == 20.0, again)


@pytest.mark.parametrize("recommit", [False, True])
def test_stopped_for_longer_than_the_slaves_watchdog_only(bench: Bench, recommit: bool) -> None:
    """A commit that the program repeats builds on safe outputs after the loss: the set-point comes back, the run does not."""
    program = bench.program(OBEY, watchdog=0.3)
    program.do(f"recommit = {recommit}")
    stopped = program.signal(signal.SIGSTOP)
    bench.card.until_still(bench.card.until(lambda seen: seen.fault == "BUS", stopped).time)
    resumed = program.signal(signal.SIGCONT)
    bench.card.until(lambda seen: seen.exchange.state is SlaveState.DATA_EXCH, resumed)
    program.do("drive.wait(lambda frame: frame.valid, 20.0)")
    program.do("for _ in range(5): master.wait_cycle(20.0)")
    again = time.monotonic()
    assert not any(seen.commanded or seen.frequency for seen in bench.card.since(resumed))
    program.do("drive.fault_reset(); drive.run_forward(20.0)")  # nothing was latched
    bench.card.until(lambda seen: seen.frequency == (SPEED if recommit else 20.0), again)


# ---- forked


CHILDREN = ["sys.exit(0)", "os._exit(0)", "raise RuntimeError('the child')", "os.kill(os.getpid(), 9)",
            "master.__exit__(None, None, None); del master, drive; sys.exit(0)"]


@pytest.mark.parametrize("end", CHILDREN)
def test_a_forked_childs_end_disturbs_nothing(bench: Bench, end: str) -> None:
    begin = time.monotonic()
    program = bench.program(f"""
if os.fork() == 0:
    {end}
os.wait()
print("alone", flush=True)""" + OBEY)
    program.expect("alone")
    program.do("for _ in range(10): master.wait_cycle(20.0)")
    program.do("drive.run_forward(20.0)")
    bench.card.until(lambda seen: seen.frequency == 20.0, begin)
    states = [state for state, _ in groupby(seen.exchange.state for seen in bench.card.since(begin))]
    assert states[-1] is SlaveState.DATA_EXCH and states.count(SlaveState.DATA_EXCH) == 1
    assert (bench.card.fault, bench.expired) == (None, 0)
    program.do("master.close()")
    leaves_well(bench, begin)


def test_a_child_that_outlives_its_parent_keeps_no_drive_running(bench: Bench) -> None:
    """A child that was forked has the descriptor of the port; the bus thread it has not."""
    program = bench.program("""
if os.fork() == 0:
    sys.stdin.read()
    os._exit(0)
print("two", flush=True)""" + FOLLOW)
    program.expect("two")
    killed = program.signal(signal.SIGKILL)
    still = bench.card.until_still(bench.card.until(lambda seen: seen.fault == "BUS", killed).time)
    assert still.time <= killed + bench.watchdog + DOWN + 2 * LATE
    assert bench.expired == 1
