# SPDX-License-Identifier: MIT
"""The bus thread: the loop, calls from other threads, the port that vanishes, the end, fork and signals."""

from __future__ import annotations

import ctypes
import os
import pty
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from leftovers import nothing_left_behind

from dpmaster._core import block, ffi, lib

ROOT = Path(__file__).resolve().parent.parent
REQUEST = bytes.fromhex("10 05 02 49 50 16")  # Request FDL Status 2 -> 5
ANSWER = bytes.fromhex("10 02 05 00 07 16")
MS = 1_000_000
SECOND = 1000 * MS
SILENT = -1
TOO_LATE = -1
BOUND = 10 * SECOND  # for what comes at once, on any machine


@pytest.fixture(scope="module")
def probes(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    library = tmp_path_factory.mktemp("probe") / "probe.so"
    subprocess.run(["cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-shared", "-fPIC",
                    f"-I{ROOT / 'include'}", str(ROOT / "tests" / "probe.c"), "-o", str(library)], check=True)
    probes = ctypes.CDLL(str(library))
    probes.probe_new.restype = ctypes.c_void_p
    probes.probe_new.argtypes = [ctypes.c_char_p, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int64, ctypes.c_int64]
    probes.probe_count.restype = ctypes.c_uint64
    probes.probe_count.argtypes = [ctypes.c_void_p, ctypes.c_int]
    return probes


class Bus:
    """A bus with a probe on a pty of its own (or on `path`); the far end is in the test's hands."""

    def __init__(self, probes: ctypes.CDLL, *, pause: int = 0, patience: int = BOUND, path: str | None = None,
                 start: bool = True) -> None:
        self.probes = probes
        self.far = -1
        if path is None:
            self.far, near = pty.openpty()
            path = os.ttyname(near)
        self._path = ffi.new("char[]", path.encode())
        config = ffi.new("dpm_port_config *", {"path": self._path, "rate_num": 500_000, "rate_den": 1,
                                               "pace": lib.DPM_PACE_NONE, "allowance": -1})
        self._block = block(lib.dpm_bus_size())
        out = ffi.new("dpm_bus **")
        assert lib.dpm_bus_open(self._block, lib.dpm_bus_size(), config, out) == 0
        if self.far >= 0:
            os.close(near)
        self.bus = out[0]
        self.probe = probes.probe_new(REQUEST, len(REQUEST), len(ANSWER), pause, patience)
        if start:
            assert self.start() == 0

    def start(self) -> int:
        return int(lib.dpm_bus_start(self.bus, ffi.cast("dpm_machine *", self.probe), ffi.NULL))

    def count(self, which: str) -> int:
        counts = ["asks", "exchanges", "timeouts", "failed", "early", "hasty"]
        return int(self.probes.probe_count(self.probe, counts.index(which)))

    @property
    def info(self) -> Any:
        info = ffi.new("dpm_bus_info *")
        assert lib.dpm_bus_get_info(self.bus, info) == 0
        return info

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Until `condition` holds, looked at after each progress."""
        deadline = lib.dpm_now() + BOUND
        while True:
            seen = lib.dpm_bus_progress(self.bus)
            if condition():
                return
            assert lib.dpm_now() < deadline, "what was waited for did not come"
            assert lib.dpm_bus_wait(self.bus, seen, 100 * MS) in (0, lib.DPM_E_TIMEOUT)

    def answer(self, times: int) -> None:
        for _ in range(times):
            assert read_whole(self.far, len(REQUEST)) == REQUEST
            os.write(self.far, ANSWER)

    def hang_up(self) -> None:
        if self.far >= 0:
            os.close(self.far)
            self.far = -1

    def close(self) -> None:
        lib.dpm_bus_close(self.bus)
        self.hang_up()


def read_whole(fd: int, n: int) -> bytes:
    octets = b""
    while len(octets) < n:
        assert select.select([fd], [], [], BOUND / SECOND)[0], f"only {octets.hex(' ')} came"
        octets += os.read(fd, n - len(octets))
    return octets


Opener = Callable[..., Bus]


@pytest.fixture
def opened(probes: ctypes.CDLL) -> Iterator[Opener]:
    """Opens buses; afterwards nothing of them may be left in the process."""
    buses: list[Bus] = []

    def opener(**kwargs: Any) -> Bus:
        buses.append(Bus(probes, **kwargs))
        return buses[-1]

    with nothing_left_behind():
        yield opener
        for bus in buses:
            bus.close()


# ---- the loop ----


def test_requests_go_out_and_answers_come_in(opened: Opener) -> None:
    bus = opened()
    bus.answer(200)
    assert read_whole(bus.far, len(REQUEST)) == REQUEST  # the next one is out: all answers are in
    assert bus.count("exchanges") == 200
    assert bus.count("timeouts") == bus.count("failed") == bus.count("early") == 0
    info = bus.info
    assert info.port.octets_in == 200 * len(ANSWER)
    assert info.port.octets_out == 201 * len(REQUEST)
    assert info.port_error == 0
    assert 0 < info.cpu_time < BOUND


def test_an_answer_in_pieces_is_one_exchange(opened: Opener) -> None:
    bus = opened()
    assert read_whole(bus.far, len(REQUEST)) == REQUEST
    for octet in ANSWER:
        os.write(bus.far, bytes([octet]))
    assert read_whole(bus.far, len(REQUEST)) == REQUEST  # only a whole answer brings the next one
    assert bus.count("exchanges") == 1


@pytest.mark.parametrize("pause", [0, MS])
@pytest.mark.parametrize("patience", [0, MS, BOUND])
def test_a_telegram_goes_out_only_straight_after_an_empty_read_and_a_second_question(opened: Opener, pause: int,
                                                                                     patience: int) -> None:
    """machine.h: "An offer whose time has come: read once more; if that brought octets, report them and ask again."""
    bus = opened(pause=pause, patience=patience)
    bus.answer(20)  # or what comes while none is awaited
    assert bus.count("hasty") == 0


def test_silence_is_reported_past_the_deadline(opened: Opener) -> None:
    bus = opened(patience=MS)
    bus.wait_for(lambda: bus.count("timeouts") >= 5)
    assert bus.count("exchanges") == 0


def test_a_request_waits_for_its_time(opened: Opener) -> None:
    bus = opened(pause=3 * MS)
    begin = lib.dpm_now()
    bus.answer(20)
    assert lib.dpm_now() - begin >= 19 * 3 * MS
    assert bus.count("early") == 0


def test_what_is_offered_too_late_is_not_sent(opened: Opener) -> None:
    """The host may have been away between the question and the write: "past not-after it is dropped"."""
    bus = opened(patience=TOO_LATE)
    bus.wait_for(lambda: bus.count("asks") > 50)
    assert not select.select([bus.far], [], [], 0)[0]


def test_a_machine_with_nothing_to_do_costs_nothing(opened: Opener) -> None:
    bus = opened(pause=SILENT)
    before = bus.info
    assert lib.dpm_bus_wait(bus.bus, lib.dpm_bus_progress(bus.bus), 200 * MS) == lib.DPM_E_TIMEOUT
    after = bus.info
    assert after.wakeups - before.wakeups <= 3  # the calls themselves
    assert after.cpu_time - before.cpu_time < 20 * MS


def test_an_exchange_costs_a_few_wakes(opened: Opener) -> None:
    """For the request's time and for each piece of the answer, and none in between: a program that polls has hundreds."""
    bus = opened(pause=10 * MS)
    before = bus.info
    bus.answer(20)
    assert bus.info.wakeups - before.wakeups <= 4 * 20


def test_the_thread_takes_no_signal(opened: Opener) -> None:
    assert opened(pause=SILENT).info.port_error == 0  # it runs
    blocked = {}
    for task in os.listdir("/proc/self/task"):
        status = Path(f"/proc/self/task/{task}/status").read_text()
        lines = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
        blocked[lines["Name"]] = int(lines["SigBlk"], 16)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM, signal.SIGCHLD, signal.SIGUSR1):
        assert blocked["dpm-bus"] >> (number - 1) & 1


# ---- calls ----


def test_a_machine_that_is_never_idle_does_not_keep_callers_out(opened: Opener) -> None:
    bus = opened(patience=0)
    stop = threading.Event()

    def drain() -> None:
        while not stop.is_set():
            if select.select([bus.far], [], [], 0.05)[0]:
                os.read(bus.far, 65536)

    drainer = threading.Thread(target=drain)
    drainer.start()
    for _ in range(100):
        assert bus.info.port_error == 0
    stop.set()
    drainer.join()
    lib.dpm_bus_close(bus.bus)


def test_calls_of_many_threads_are_all_served(opened: Opener) -> None:
    bus = opened(pause=SILENT)
    results: list[int] = []

    def call() -> None:
        info = ffi.new("dpm_bus_info *")
        results.extend(lib.dpm_bus_get_info(bus.bus, info) for _ in range(200))

    threads = [threading.Thread(target=call) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [0] * 1200


def test_a_bus_starts_once_and_knows_whom_it_drives(opened: Opener) -> None:
    bus = opened(pause=SILENT, start=False)
    assert bus.info.cpu_time == 0
    assert lib.dpm_bus_subscribe(bus.bus, ffi.NULL, -1) == lib.DPM_E_MODE
    assert bus.start() == 0
    assert bus.start() == lib.DPM_E_MODE
    assert lib.dpm_bus_set_mode(bus.bus, lib.DPM_MODE_OPERATE) == lib.DPM_E_MODE
    assert lib.dpm_bus_slave_ready(bus.bus, 0, True) == lib.DPM_E_MODE


# ---- the port vanishes ----


def test_a_vanished_port_is_told_once_and_costs_nothing(opened: Opener) -> None:
    bus = opened(patience=MS)
    ring_block = block(lib.dpm_ring_size(16))
    ring = lib.dpm_ring_init(ring_block, lib.dpm_ring_size(16), 16)
    event_fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
    assert lib.dpm_bus_subscribe(bus.bus, ring, event_fd) == 0
    bus.hang_up()
    assert select.select([event_fd], [], [], BOUND / SECOND)[0]
    event, lost = ffi.new("dpm_event *"), ffi.new("uint64_t *")
    assert lib.dpm_ring_take(ring, event, lost) == 1
    assert (event.kind, event.a, event.address) == (lib.DPM_EV_PORT, lib.DPM_E_GONE, -1)
    before = bus.info
    assert before.port_error == lib.DPM_E_GONE
    begin = lib.dpm_now()
    while lib.dpm_bus_wait(bus.bus, lib.dpm_bus_progress(bus.bus), 300 * MS) == 0:
        pass
    after = bus.info
    ticks = (lib.dpm_now() - begin) // (10 * MS)
    assert after.wakeups - before.wakeups <= ticks + 4
    assert after.cpu_time - before.cpu_time < 30 * MS
    assert lib.dpm_ring_take(ring, event, lost) == 0
    assert lib.dpm_bus_unsubscribe(bus.bus, ring) == 0
    assert lib.dpm_bus_unsubscribe(bus.bus, ring) == lib.DPM_E_ARGUMENT
    os.close(event_fd)


def test_a_pty_comes_back_only_by_a_link_made_anew(opened: Opener, tmp_path: Path) -> None:
    """A pty's number is given to the next one who asks; the link of a segment is made anew with the segment."""
    link = tmp_path / "port"
    far, near = pty.openpty()
    link.symlink_to(os.ttyname(near))
    os.close(near)
    bus = opened(path=str(link), pause=SILENT)
    os.close(far)
    bus.wait_for(lambda: bus.info.port_error == lib.DPM_E_GONE)

    far, near = pty.openpty()  # most likely the same number: the old link leads to it
    tries = 2
    assert not select.select([far], [], [], 0.5 * tries)[0]
    assert bus.info.port_error == lib.DPM_E_GONE
    anew = tmp_path / "anew"
    anew.symlink_to(os.ttyname(near))
    anew.rename(link)
    bus.wait_for(lambda: bus.info.port_error == 0)
    os.close(near)
    os.write(far, ANSWER)
    bus.wait_for(lambda: bus.info.port.octets_in == len(ANSWER))
    os.close(far)


# ---- the end ----


def test_close_turns_everybody_away(opened: Opener) -> None:
    bus = opened(pause=SILENT)
    results: list[int] = []
    begun = threading.Barrier(5)

    def wait() -> None:
        begun.wait()
        results.append(lib.dpm_bus_wait(bus.bus, lib.dpm_bus_progress(bus.bus), BOUND))

    def call() -> None:
        info = ffi.new("dpm_bus_info *")
        begun.wait()
        while (code := lib.dpm_bus_get_info(bus.bus, info)) == 0:
            pass
        results.append(code)

    threads = [threading.Thread(target=task) for task in (wait, wait, call, call)]
    for thread in threads:
        thread.start()
    begun.wait()
    begin = time.monotonic()
    lib.dpm_bus_close(bus.bus)
    assert time.monotonic() - begin < 1.0  # bus.h: returns within a second
    for thread in threads:
        thread.join()
    assert results == [lib.DPM_E_CLOSED] * 4
    lib.dpm_bus_close(bus.bus)
    assert lib.dpm_bus_wait(bus.bus, 0, 0) == lib.DPM_E_CLOSED
    assert bus.start() in (lib.DPM_E_CLOSED, lib.DPM_E_MODE)


def test_close_wakes_the_subscribers(opened: Opener) -> None:
    bus = opened(pause=SILENT)
    size = lib.dpm_ring_size(4)
    ring_block = block(size)
    event_fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
    assert lib.dpm_bus_subscribe(bus.bus, lib.dpm_ring_init(ring_block, size, 4), event_fd) == 0
    lib.dpm_bus_close(bus.bus)
    assert select.select([event_fd], [], [], 0)[0]
    os.close(event_fd)


def test_a_bus_that_never_started_closes_too(opened: Opener) -> None:
    bus = opened(start=False)
    lib.dpm_bus_close(bus.bus)
    assert lib.dpm_bus_get_info(bus.bus, ffi.new("dpm_bus_info *")) == lib.DPM_E_CLOSED
    assert bus.start() == lib.DPM_E_CLOSED


def test_the_port_is_free_after_close(opened: Opener, probes: ctypes.CDLL) -> None:
    far, near = pty.openpty()
    path = os.ttyname(near)
    opened(path=path, pause=SILENT).close()
    opened(path=path, pause=SILENT).close()
    os.close(near)
    os.close(far)


def test_in_a_forked_child_every_call_fails_and_the_parent_goes_on(opened: Opener) -> None:
    bus = opened()
    bus.answer(1)
    child = os.fork()
    if child == 0:
        info = ffi.new("dpm_bus_info *")
        codes = {lib.dpm_bus_get_info(bus.bus, info), lib.dpm_bus_wait(bus.bus, 0, BOUND), bus.start(),
                 lib.dpm_bus_unsubscribe(bus.bus, ffi.NULL)}
        lib.dpm_bus_close(bus.bus)
        os._exit(0 if codes <= {lib.DPM_E_FORKED, lib.DPM_E_MODE} and lib.DPM_E_FORKED in codes else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    bus.answer(10)
    bus.wait_for(lambda: bus.count("exchanges") >= 11)


def test_a_signal_ends_a_wait(opened: Opener) -> None:
    bus = opened(pause=SILENT)
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        for restart in (False, True):  # also where the handler asks for interrupted calls to go on
            signal.siginterrupt(signal.SIGALRM, not restart)
            signal.setitimer(signal.ITIMER_REAL, 0.02, 0.02)
            assert lib.dpm_bus_wait(bus.bus, lib.dpm_bus_progress(bus.bus), BOUND) == lib.DPM_E_INTERRUPTED
            signal.setitimer(signal.ITIMER_REAL, 0)
            assert lib.dpm_bus_wait(bus.bus, lib.dpm_bus_progress(bus.bus), MS) == lib.DPM_E_TIMEOUT
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
