# SPDX-License-Identifier: MIT
"""Waiting in tests for what another thread or process has yet to do; a condition that never comes fails, and says so."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE = 20.0  # s for a computer that is busy with something else


def until(condition: Callable[[], object], timeout: float = PATIENCE) -> None:
    """Poll: a wait of the library would feed the output watchdog, and a card's or a process's state has none."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.002)
