# SPDX-License-Identifier: MIT
"""asyncio's face: the methods that wait, awaited. Not a second implementation: a thread makes the very same call.

    await master.aio.operate()
    async for cycle in master.aio.cycles(): ...
    await drive.aio.wait_until(...)

A face holds nothing but its object. The thread works on behalf of the event loop, and lives as long as its call (or its
loop over cycles):

- Cancelled, the call is given up: its wait ends within 0.1 s, what it had asked of the bus is taken back, and only then
  does the await end. Closing the master wakes it with ClosedError, as it wakes every waiter.
- A predicate given to a wait runs in that thread; it should look at its argument and nothing else.
- Commits count as the loop's. Its waits feed the output watchdog through the loop: a loop that hangs feeds nothing.

Whoever needs another blocking call in a coroutine has `call`.
"""

from __future__ import annotations

import asyncio
import functools
import queue
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar, overload

from dpmaster._errand import Errand, GivenUp, here
from dpmaster.cycles import Cycle
from dpmaster.events import Event, Events
from dpmaster.master import Master
from dpmaster.station import Station

__all__ = ["AsyncMaster", "AsyncStation", "Awaited", "Face", "call"]

S = TypeVar("S")
P = ParamSpec("P")
R = TypeVar("R")

Job = tuple[Callable[[], Any], asyncio.Future[Any]]


class Worker:
    """A thread that makes calls for the running event loop, one at a time, until `end`."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._errand = Errand(self._loop, here.thread)
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        threading.Thread(target=self._work, name="dpmaster-aio", daemon=True).start()

    def _work(self) -> None:
        here.errand = self._errand
        while not self._errand.given_up and (job := self._jobs.get()) is not None:
            function, done = job
            self._errand.post(functools.partial(_settle, done, *_outcome(function)))
            del job, function, done  # they shall not live until the next one

    async def run(self, function: Callable[[], R]) -> R:
        done: asyncio.Future[R] = self._loop.create_future()
        self._jobs.put((function, done))
        try:
            return await asyncio.shield(done)
        except asyncio.CancelledError:
            self._errand.given_up = True
            while not done.done():
                try:
                    await asyncio.wait({done})
                except asyncio.CancelledError:
                    continue
            done.exception()  # looked at, or asyncio logs that nobody has
            raise
        finally:
            del done  # it holds the error, which holds this frame

    def end(self) -> None:
        self._errand.given_up = True
        self._jobs.put(None)


def _outcome(function: Callable[[], Any]) -> tuple[Any, BaseException | None]:
    try:
        return function(), None
    except GivenUp:
        return None, asyncio.CancelledError()
    except BaseException as error:
        return None, error


def _settle(done: asyncio.Future[Any], result: Any, error: BaseException | None) -> None:
    if error is None:
        done.set_result(result)
    else:
        done.set_exception(error)


async def call(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Make a blocking call of this package from a coroutine: ``await call(drive.fault_reset)``."""
    worker = Worker()
    try:
        return await worker.run(functools.partial(function, *args, **kwargs))
    finally:
        worker.end()


class Face(Generic[S]):
    """The methods of an object, awaited. ``of`` is the object itself.

    Those that wait are listed with `Awaited`, for editors and type checkers; any other method works as well.
    """

    def __init__(self, of: S) -> None:
        self.of = of

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Callable[..., Coroutine[Any, Any, Any]]:
            method = getattr(self.of, name)
            if name.startswith("_") or not callable(method):
                raise AttributeError(f"aio.{name}: {type(self.of).__name__}.{name} is no method; use it as it is, without aio")
            return functools.partial(call, method)


class Awaited(Generic[P, R]):
    """A method of the face's object, awaited: same name, arguments, result and errors; overriding one overrides it, too."""

    def __init__(self, method: Callable[Concatenate[Any, P], R]) -> None:
        self._name = method.__name__
        self.__doc__ = method.__doc__

    @overload
    def __get__(self, face: None, owner: type) -> Awaited[P, R]: ...

    @overload
    def __get__(self, face: Face[Any], owner: type) -> Callable[P, Coroutine[Any, Any, R]]: ...

    def __get__(self, face: Face[Any] | None, owner: type) -> Awaited[P, R] | Callable[P, Coroutine[Any, Any, R]]:
        return self if face is None else functools.partial(call, getattr(face.of, self._name))


class AsyncStation(Face[Station]):
    """`Station.aio`."""

    wait = Awaited(Station.wait)
    wait_sent = Awaited(Station.wait_sent)
    slave_diag = Awaited(Station.slave_diag)
    set_prm = Awaited(Station.set_prm)
    chk_cfg = Awaited(Station.chk_cfg)
    data_exchange = Awaited(Station.data_exchange)
    get_cfg = Awaited(Station.get_cfg)
    rd_inp = Awaited(Station.rd_inp)
    rd_outp = Awaited(Station.rd_outp)
    activate = Awaited(Station.activate)
    deactivate = Awaited(Station.deactivate)
    reparameterise = Awaited(Station.reparameterise)


class AsyncMaster(Face[Master]):
    """`Master.aio`. ``async with Master(...).aio as master:`` closes it at the end without holding up the loop."""

    operate = Awaited(Master.operate)
    clear = Awaited(Master.clear)
    stop = Awaited(Master.stop)
    offline = Awaited(Master.offline)
    wait_cycle = Awaited(Master.wait_cycle)
    request = Awaited(Master.request)
    live_list = Awaited(Master.live_list)
    global_control = Awaited(Master.global_control)
    set_slave_add = Awaited(Master.set_slave_add)
    remove = Awaited(Master.remove)
    slave_diag = Awaited(Master.slave_diag)
    get_cfg = Awaited(Master.get_cfg)
    rd_inp = Awaited(Master.rd_inp)
    rd_outp = Awaited(Master.rd_outp)
    close = Awaited(Master.close)

    async def cycles(self, timeout: float | None = 1.0) -> AsyncIterator[Cycle]:
        """`Master.cycles` for ``async for``."""
        cycles = self.of.cycles(timeout)
        worker = Worker()
        try:
            while (cycle := await worker.run(functools.partial(next, cycles, None))) is not None:
                yield cycle
        finally:
            worker.end()

    def events(self, size: int = 256) -> AsyncIterator[Event]:
        """`Master.events` for ``async for``: from now on, until the master is closed or the loop left."""
        return _taken(self.of.events(size))

    async def __aenter__(self) -> Master:
        return self.of

    async def __aexit__(self, *exc: object) -> None:
        await self.close()


async def _taken(events: Events) -> AsyncIterator[Event]:
    with events:
        async for event in events:
            yield event
