# SPDX-License-Identifier: MIT
"""The family of errors, and the gate's rules: codes to exceptions, aligned memory, bounded interruptible waits."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import threading
import time
import weakref

import pytest

from dpmaster import _core, errors
from dpmaster._core import ffi, lib

ALL = [getattr(errors, name) for name in errors.__all__]


@pytest.mark.parametrize("kind", ALL)
def test_every_error_is_a_dperror(kind: type[Exception]) -> None:
    assert issubclass(kind, errors.DPError)


@pytest.mark.parametrize(("kind", "builtin"), [
    (errors.ConfigurationError, ValueError), (errors.PortError, OSError), (errors.DPTimeout, TimeoutError),
])
def test_counterparts_among_the_builtins(kind: type[Exception], builtin: type[Exception]) -> None:
    assert issubclass(kind, builtin)


@pytest.mark.parametrize("error", [
    errors.DPError("m", dpm_code=-1), errors.PortError("m", path="/dev/x", errno=2), errors.StationError("m", address=5),
    errors.ParameterAccessError("m", code=0x21, meaning="limit", register=0x103), errors.DPTimeout("m"),
    errors.CommissioningError("m", parameters=("n003",)), errors.OutputsDiscarded("m", number=7),
])
def test_errors_survive_pickling(error: errors.DPError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == "m"
    assert vars(copy) == vars(error)


def test_every_code_of_the_library_has_a_text_and_an_exception() -> None:
    codes = [getattr(lib, name) for name in dir(lib) if name.startswith("DPM_E_")]
    assert len(codes) > 20
    texts = set()
    for code in codes:
        with pytest.raises(errors.DPError) as caught:
            _core.check(code, "open", path="/dev/ttyX")
        assert caught.value.dpm_code == code
        assert str(caught.value).startswith("open: ")
        assert "path /dev/ttyX" in str(caught.value)
        texts.add(str(caught.value))
    assert len(texts) == len(codes)
    assert _core.check(0) == 0
    assert _core.check(7) == 7


@pytest.mark.parametrize(("name", "kind"), [
    ("ADDRESS", errors.ConfigurationError), ("LATCHED", errors.NotOperatingError), ("TIMEOUT", errors.DPTimeout),
    ("CLOSED", errors.ClosedError), ("FORKED", errors.ClosedError), ("IN_USE", errors.PortError),
    ("DISCARDED", errors.OutputsDiscarded), ("BLOCK", errors.DPError),
])
def test_codes_map_to_their_exception(name: str, kind: type[errors.DPError]) -> None:
    assert type(_core.error(getattr(lib, f"DPM_E_{name}"))) is kind


@pytest.mark.parametrize("size", [1, 15, 16, 17, 4096])
def test_blocks_are_aligned_zeroed_and_of_the_size_asked_for(size: int) -> None:
    blocks = [_core.block(size) for _ in range(16)]
    for memory in blocks:
        assert int(ffi.cast("uintptr_t", memory)) % 16 == 0
        assert len(memory) == size
        assert bytes(memory) == bytes(size)
        memory[size - 1] = 0xA5
    assert all(memory[size - 1] == 0xA5 for memory in blocks)


def test_blocks_in_a_cycle_are_collected() -> None:
    # The crash that made block() what it is came when the block was older than the rest of its cycle.
    class Owner:
        pass

    for _ in range(10):
        memory, owner = _core.block(1000), Owner()
        vars(owner).update(memory=memory, me=owner)
        alive = weakref.ref(memory)
        del memory, owner
        gc.collect()
        assert alive() is None


class Counter:
    """A stand-in for a bus: a counter and a wait on it."""

    def __init__(self) -> None:
        self.value = 0
        self.changed = threading.Condition()

    def bump(self) -> None:
        with self.changed:
            self.value += 1
            self.changed.notify_all()

    def wait(self, seen: int, timeout: int) -> int:
        with self.changed:
            done = self.changed.wait_for(lambda: self.value != seen, timeout / _core.NS)
        return 0 if done else int(lib.DPM_E_TIMEOUT)


def test_a_wait_ends_with_what_was_waited_for() -> None:
    counter = Counter()

    def three_times() -> None:
        for _ in range(3):
            counter.bump()

    thread = threading.Thread(target=three_times)
    thread.start()
    found = _core.wait_slices(counter.wait, lambda: counter.value, lambda: counter.value if counter.value >= 3 else None, 5)
    thread.join()
    assert found == 3


def test_a_wait_is_bounded_and_feeds_every_slice() -> None:
    counter, fed = Counter(), []
    start = time.monotonic()
    assert _core.wait_slices(counter.wait, lambda: 0, lambda: None, 0.25, lambda: fed.append(1)) is None
    assert time.monotonic() - start >= 0.25
    assert len(fed) >= 3


def test_a_wait_without_time_still_looks_once() -> None:
    counter = Counter()
    assert _core.wait_slices(counter.wait, lambda: 0, lambda: "there", 0) == "there"


def test_a_wait_raises_what_the_library_refuses() -> None:
    with pytest.raises(errors.ClosedError):
        _core.wait_slices(lambda seen, timeout: int(lib.DPM_E_CLOSED), lambda: 0, lambda: None, None)


def test_ctrl_c_leaves_a_wait_without_end() -> None:
    counter = Counter()
    timer = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        timer.start()
        _core.wait_slices(counter.wait, lambda: 0, lambda: None, None)
    timer.join()


def test_an_object_knows_its_process() -> None:
    owner = _core.Process()
    owner.guard("the master")
    assert owner.here
    pid = os.fork()
    if pid == 0:
        try:
            owner.guard("the master")
        except errors.ClosedError as error:
            os._exit(0 if "the master" in str(error) and not owner.here else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
