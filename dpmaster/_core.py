# SPDX-License-Identifier: MIT
"""The gate to the compiled library: errors, memory, clock, waits and the guard against use after fork.

The master side's Python reaches ``ffi`` and ``lib`` through this file. It knows no object of the library, only the rules that
hold for all of them: a negative code is an exception, a block is 16-aligned and lives as long as its owner, an object belongs
to the process that made it, and a wait comes back now and then so that Python can run its signal handlers.
"""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any, TypeVar

from dpmaster import _arguments, _errand, errors
from dpmaster._dpm import ffi as _ffi
from dpmaster._dpm import lib as _lib

ffi: Any = _ffi
lib: Any = _lib

T = TypeVar("T")

NS = 1_000_000_000

_PORT = ("NO_PORT", "PERMISSION", "IN_USE", "NOT_TTY", "SETTINGS", "RATE", "RS485", "GONE", "SYSTEM")
_KINDS: dict[type[errors.DPError], tuple[str, ...]] = {
    errors.ConfigurationError: ("ARGUMENT", "ADDRESS", "DUPLICATE", "FULL", "LENGTH", "CONFIGURATION", "PARAMETER", "SLOT"),
    errors.NotOperatingError: ("MODE", "LATCHED"),
    errors.DPTimeout: ("TIMEOUT", "INTERRUPTED"),
    errors.ClosedError: ("CLOSED", "FORKED"),
    errors.PortError: _PORT,
    errors.OutputsDiscarded: ("DISCARDED",),
}
_ERRORS: dict[int, type[errors.DPError]] = {
    getattr(_lib, f"DPM_E_{name}"): kind for kind, names in _KINDS.items() for name in names
}


def error(code: int, what: str = "", **context: object) -> errors.DPError:
    """The exception for a negative code of the library: ``what: the library's text (name value, ...)``."""
    text = ffi.string(lib.dpm_strerror(code)).decode()
    if code == lib.DPM_E_SYSTEM:
        text += f" ({os.strerror(ffi.errno)})"
    if context:
        text += " (" + ", ".join(f"{name} {value}" for name, value in context.items()) + ")"
    found = _ERRORS.get(code, errors.DPError)(f"{what}: {text}" if what else text, dpm_code=code)
    if isinstance(found, errors.PortError) and code == lib.DPM_E_SYSTEM:
        found.errno = ffi.errno
    return found


def check(code: int, what: str = "", **context: object) -> int:
    """`code` itself, or its exception when it is negative. `what` was tried; `context` names the values concerned."""
    if code < 0:
        raise error(code, what, **context)
    return code


def block(size: int) -> Any:
    """`size` zeroed octets, aligned to 16 as every object of the library wants, alive as long as the value returned.

    Pages of their own, as a bytearray's start is aligned nowhere, and a memoryview into one crashes CPython's collector
    when it is part of a cycle.
    """
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return ffi.from_buffer("uint8_t[]", pages, require_writable=True)


def now() -> int:
    """The library's clock (CLOCK_MONOTONIC), ns."""
    return time.monotonic_ns()


def wall_clock() -> Callable[[int], datetime]:
    """What turns a time of `now` into one that people read, by the wall clock as it stands; for no other use."""
    here, reference = datetime.now().astimezone(), now()
    return lambda time: here + timedelta(microseconds=(time - reference) / 1000)


class Process:
    """The process that made an object. "Objects belong to the process that opened them: after fork every call raises"."""

    __slots__ = ("pid",)

    def __init__(self) -> None:
        self.pid = os.getpid()

    @property
    def here(self) -> bool:
        return os.getpid() == self.pid

    def guard(self, what: str) -> None:
        if os.getpid() != self.pid:
            raise errors.ClosedError(
                f"{what} belongs to process {self.pid} and this is {os.getpid()}, which was forked from it: open a "
                "new one here, or start children with the 'spawn' method", dpm_code=lib.DPM_E_FORKED)


def wait_slices(wait: Callable[[int, int], int], progress: Callable[[], int], ready: Callable[[], T | None],
                timeout: float | None, each: Callable[[], None] | None = None) -> T | None:
    """Wait until `ready` returns something: that, or None when `timeout` (s; None: for ever) has passed.

    `progress` reads a counter that changes whenever `ready` may have; `wait(seen, ns)` waits in C, without the GIL, until it
    differs from `seen`. `each` runs before every stay in C, at least every 100 ms. Signal handlers run between stays, so
    Ctrl-C leaves as KeyboardInterrupt. What `wait` refuses (closed, forked) is raised.
    """
    _arguments.timeout(timeout)
    deadline = None if timeout is None else time.monotonic() + timeout
    while True:
        _errand.check()
        seen = progress()  # before `ready`: what changes in between ends the wait at once
        result = ready()
        if result is not None:
            return result
        left = _errand.SLICE if deadline is None else min(_errand.SLICE, deadline - time.monotonic())
        if left <= 0:
            return None
        if each is not None:
            each()
        code = wait(seen, max(1, int(left * NS)))
        if code not in (0, lib.DPM_E_TIMEOUT, lib.DPM_E_INTERRUPTED):
            check(code)
