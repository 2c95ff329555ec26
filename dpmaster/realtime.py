# SPDX-License-Identifier: MIT
"""Real-time scheduling of a thread of the library: what is asked for, what the system grants, and what to do where it does not.

A PROFIBUS master is a real-time program, so on a serial port it takes what the user may take: who may is an
administrator's decision already (RLIMIT_RTPRIO). On a pty the wire is the CPU itself, and a thread that never waits for a wire
would keep the rest of the program from running, so there it has to be asked for. A refusal stops nothing; it is logged and
stays readable.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from dpmaster import _arguments
from dpmaster._core import check, ffi, lib
from dpmaster.errors import ConfigurationError

__all__ = ["Realtime", "Scheduling", "schedule"]

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Realtime:
    """How a thread is to run. Raises ConfigurationError outside the ranges.

    priority: of SCHED_FIFO, 1..99. The default is below the interrupt threads of a PREEMPT_RT kernel (50), which bring the
    octets that the thread waits for. cpu: the only one to run on, as one kept free by ``isolcpus=``; None: any. lock: its stack
    and the library's blocks stay in memory.
    """

    priority: int = 40
    cpu: int | None = None
    lock: bool = True

    def __post_init__(self) -> None:
        _arguments.whole("priority", self.priority, 1, 99, " of SCHED_FIFO")
        if self.cpu is not None:
            _arguments.whole("cpu", self.cpu, 0, 1023, ", or None for any")


Wish = Realtime | bool | None


@dataclass(frozen=True, slots=True)
class Scheduling:
    """What is in force. ``priority`` None: ordinary scheduling; ``refused``: what was wanted, why not, and the remedy."""

    priority: int | None = None
    cpu: int | None = None
    locked: bool = False
    refused: tuple[str, ...] = ()


def wished(asked: Wish) -> Wish:
    """`asked`, or ConfigurationError where it is no wish."""
    if asked is None or isinstance(asked, bool | Realtime):
        return asked
    raise ConfigurationError(f"realtime {asked!r}: a Realtime, True for its defaults, False, or None: on serial ports only")


def schedule(asked: Wish, serial: bool, thread: Callable[[Any, Any], int], blocks: Iterable[Any], what: str) -> Scheduling:
    """Schedule a running thread by its library call, and keep its `blocks` in memory."""
    if asked is False or (asked is None and not serial):
        return Scheduling()
    wish = asked if isinstance(asked, Realtime) else Realtime()
    refusals = ffi.new("dpm_refusals *")
    given = ffi.new("dpm_realtime *", (wish.priority, -1 if wish.cpu is None else wish.cpu, wish.lock))
    check(thread(given, refusals), f"schedule {what}")
    unlocked = refusals.lock or (lock(blocks) if wish.lock else 0)
    refused = [
        f"{name} was refused ({os.strerror(number)}): {remedy}" for name, number, remedy in (
            (f"SCHED_FIFO {wish.priority}", refusals.priority,
             "raise RLIMIT_RTPRIO ('@dialout - rtprio 60' in /etc/security/limits.conf, LimitRTPRIO=60 in a systemd unit)"),
            (f"CPU {wish.cpu}", refusals.cpu, "'nproc --all' and /sys/devices/system/cpu/online tell which there are"),
            ("locked memory", unlocked,
             "raise RLIMIT_MEMLOCK ('@dialout - memlock unlimited', LimitMEMLOCK=infinity)")) if number]
    for text in refused:
        log.warning("%s: %s", what, text)
    return Scheduling(None if refusals.priority else wish.priority, None if refusals.cpu else wish.cpu,
                      wish.lock and not unlocked, tuple(refused))


def lock(blocks: Iterable[Any]) -> int:
    """Keep blocks in memory: 0, or the errno of the first refusal."""
    return next((ffi.errno or errno.ENOMEM for each in blocks if lib.dpm_lock(each, len(each)) < 0), 0)
