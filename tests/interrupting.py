# SPDX-License-Identifier: MIT
"""Ctrl-C at a moment of one's choice: behind a call to the library, or at each moment, one after the other."""

from __future__ import annotations

import gc
import inspect
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from dpmaster._core import lib


def interrupted(call: Callable[[], object], at: int) -> bool:
    """Make the call, with Ctrl-C the `at`-th time that Python looks for a signal in this package: whether it came so far."""
    left = at

    def look(frame: Any, event: str, _: object) -> None:
        nonlocal left
        # A signal is raised inside of a generator that goes on, what is raised here would leave it without its `finally`.
        resumed = event == "call" and frame.f_code.co_flags & inspect.CO_GENERATOR
        if event in ("call", "c_return") and not resumed and "dpmaster" in frame.f_code.co_filename:
            left -= 1
            if not left:
                sys.setprofile(None)
                raise KeyboardInterrupt

    gc.disable()  # or what an earlier test has left would be ended in here, and that be interrupted
    sys.setprofile(look)
    with suppress(KeyboardInterrupt):
        call()
    sys.setprofile(None)
    gc.enable()
    return left <= 0


class Behind:
    """The library, with Ctrl-C during its function `name`: Python raises it when the call has returned."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        function = getattr(lib, name)
        if name != self._name:
            return function

        def interrupted(*arguments: Any) -> None:
            function(*arguments)
            raise KeyboardInterrupt

        return interrupted
