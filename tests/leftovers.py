# SPDX-License-Identifier: MIT
"""What a test may leave behind in the process: no descriptor and no thread, once the kernel and the collector are done."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from waiting import PATIENCE


def descriptors() -> set[str]:
    """Each with what it leads to: a number is given again."""
    found = set()
    for fd in os.listdir("/proc/self/fd"):
        try:
            found.add(f"descriptor {fd} of {os.readlink(f'/proc/self/fd/{fd}')}")
        except FileNotFoundError:  # the listing's own
            pass
    return found


def threads() -> set[str]:
    """Those of C among them. The kernel takes one that was joined off its list a little later."""
    return {f"thread {task}" for task in os.listdir("/proc/self/task")}


@contextmanager
def nothing_left_behind() -> Iterator[None]:
    """No more than before the block. What an earlier test had left in a cycle may go meanwhile."""
    before = descriptors() | threads()
    yield
    deadline = time.monotonic() + PATIENCE
    while left := (descriptors() | threads()) - before:
        assert time.monotonic() < deadline, f"left behind: {', '.join(sorted(left))}"
        gc.collect()
