# SPDX-License-Identifier: MIT
"""What a thread does on behalf of an event loop, and how it learns that nobody waits for it any more.

`aio` gives errands, every wait looks whether its own was given up. Touches nothing of the package.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

SLICE = 0.1
"""Seconds, the longest stay in one wait: Ctrl-C is answered, the output watchdog fed and an errand looked at so often."""


class GivenUp(BaseException):
    """Ends a wait whose errand nobody waits for any more. No ``except Exception`` on the way may stop it."""


class Errand:
    """What a thread does on behalf of an event loop, which lives in `thread`. Once it is given up, its waits end."""

    def __init__(self, loop: AbstractEventLoop, thread: object) -> None:
        self.thread = thread
        self.given_up = False
        self._loop = loop
        self._passed_on = False

    def check(self) -> None:
        """Raise GivenUp when nobody waits for it any more."""
        if self.given_up or self._loop.is_closed():
            raise GivenUp

    def post(self, callback: Callable[[], None]) -> None:
        """Let the loop run `callback` in its thread. A loop that was closed in the middle has given up what it wanted."""
        try:
            self._loop.call_soon_threadsafe(callback)
        except RuntimeError:
            self.given_up = True

    def pass_on(self, callback: Callable[[], None]) -> None:
        """`post`, unless the loop has yet to run the one before."""
        def run() -> None:
            self._passed_on = False
            callback()

        if not self._passed_on:
            self._passed_on = True
            self.post(run)


class _Here(threading.local):
    errand: Errand | None = None

    def __init__(self) -> None:
        self.thread = object()  # this thread and no other: `get_ident` of one that ended is given to a later one


here = _Here()  # of this thread


def caller() -> object:
    """The thread on whose account this one acts: its own, or that of the event loop it does an errand for."""
    return here.errand.thread if here.errand else here.thread


def check() -> None:
    """Raise GivenUp in a thread whose errand nobody waits for any more."""
    if here.errand is not None:
        here.errand.check()


def wait_for(condition: threading.Condition, predicate: Callable[[], bool]) -> None:
    """`condition.wait_for`, for ever, but for an errand that is given up."""
    while not condition.wait_for(predicate, SLICE):
        check()
