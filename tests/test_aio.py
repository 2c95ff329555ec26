# SPDX-License-Identifier: MIT
"""asyncio's face over the same objects: results and errors are theirs, a cancelled await leaves nothing behind, and an event
loop that hangs lets the output watchdog run out."""

from __future__ import annotations

import asyncio
import gc
import inspect
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from test_master_pty import CONFIGURATION, IDENT, Echo
from waiting import until

from dpmaster import (
    ClosedError,
    ConfigurationError,
    DPTimeout,
    Event,
    EventKind,
    Frame,
    Master,
    Mode,
    NotOperatingError,
    OutputsDiscarded,
    Station,
    StationError,
)
from dpmaster._errand import SLICE
from dpmaster.aio import AsyncMaster, AsyncStation, call
from dpmaster.bus import Feed
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1


def workers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "dpmaster-aio"]


@pytest.fixture(autouse=True)
def nothing_stays_behind() -> Iterator[None]:
    yield
    until(lambda: not workers())


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment() as made:
        made.attach(Echo(5))
        yield made


@pytest.fixture
def master(wire: Segment) -> Iterator[Master]:
    with Master(wire.port()) as made:
        yield made


@pytest.fixture
def station(master: Master) -> Station:
    return master.add(Station(5, IDENT, CONFIGURATION))


def never(frame: Frame) -> bool:
    return False


def test_a_program(master: Master, station: Station) -> None:
    async def program() -> list[int]:
        await master.aio.operate()
        numbers = []
        async for cycle in master.aio.cycles():
            number = station.update(0, bytes([cycle.number % 255 + 1]))
            await station.aio.wait_sent(number)
            wanted = station.outputs
            frame = await station.aio.wait(lambda f, wanted=wanted: f.octets == wanted, timeout=1.0)  # type: ignore[misc]
            assert frame.octets == wanted
            numbers.append(cycle.number)
            if len(numbers) == 5:
                break
        assert await master.aio.wait_cycle() > numbers[-1]
        assert (await station.aio.slave_diag()).ident_number == IDENT
        assert (await master.aio.request(5, "FDL_STATUS")).ok
        await master.aio.stop()
        return numbers

    numbers = asyncio.run(program())
    assert numbers == sorted(set(numbers))
    assert master.mode == Mode.STOP


def test_a_drive(wire: Segment, master: Master) -> None:
    wire.attach(SIP1(address=6))

    async def program() -> None:
        drive = master.add(YaskawaV7(6))
        await master.aio.operate()
        assert await drive.aio.read_parameter("n003") == 3
        await drive.aio.write_parameter("n019", 40)
        values = await drive.aio.read_parameter("n019", 2)
        assert isinstance(values, tuple)
        assert values[0] == 40
        await drive.aio.run(5.0)
        status = await drive.aio.wait_until(lambda s: s.running, timeout=2.0)
        assert status.running
        drive.stop()
        assert await call(lambda: drive.alive) is True

    asyncio.run(program())


@pytest.mark.parametrize(("ask", "error"), [
    (lambda m, s: m.aio.wait_cycle(), NotOperatingError),
    (lambda m, s: s.aio.wait(never, 0.01), DPTimeout),
    (lambda m, s: s.aio.wait_sent("1"), ConfigurationError),
    (lambda m, s: m.aio.request(9, "FDL_STATUS"), StationError),
    (lambda m, s: anext(m.aio.cycles()), NotOperatingError),
])
def test_errors_are_those_of_the_call(master: Master, station: Station, ask: Callable[..., Awaitable[Any]],
                                      error: type[Exception]) -> None:
    async def program() -> None:
        with pytest.raises(error):
            await ask(master, station)

    asyncio.run(program())


def test_a_method_of_a_face_is_that_of_its_object(station: Station) -> None:
    """Also where a sub-class has its own."""
    class Patient(Station):
        def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
            raise OutputsDiscarded("mine", number=number)

    async def program() -> None:
        with pytest.raises(OutputsDiscarded, match="mine"):
            await Patient(7, IDENT, CONFIGURATION).aio.wait_sent(3)

    asyncio.run(program())
    assert station.aio.wait.func.__name__ == "call"  # type: ignore[attr-defined]
    assert type(station.aio).wait.__doc__ == Station.wait.__doc__


def test_methods_that_are_not_listed_work_too(master: Master, station: Station) -> None:
    async def program() -> None:
        await master.aio.operate()
        number = await station.aio.update(0, b"\x05")  # type: ignore[attr-defined]
        await station.aio.wait_sent(number)
        with pytest.raises(AttributeError, match=r"aio\.state.*without aio"):
            _ = station.aio.state  # type: ignore[attr-defined]
        with pytest.raises(AttributeError, match="no_such"):
            _ = station.aio.no_such  # type: ignore[attr-defined]

    asyncio.run(program())


@pytest.mark.parametrize(("of", "face"), [(Master, AsyncMaster), (Station, AsyncStation)])
def test_every_method_that_waits_is_listed(of: type, face: type) -> None:
    """So that an editor knows it: one line in aio.py, ``name = Awaited(Class.name)``."""
    waiting = {name for name, method in vars(of).items() if not name.startswith("_") and callable(method)
               and "timeout" in inspect.signature(method).parameters}
    assert len(waiting) > 5
    assert waiting - set(dir(face)) == set()


# ---- cancelling and closing


@pytest.mark.parametrize("ask", [
    lambda m, s: s.aio.wait(never, None),
    lambda m, s: m.aio.request(9, "FDL_STATUS", timeout=None),
    lambda m, s: m.aio.operate(timeout=None),
])
def test_a_cancelled_await_leaves_no_thread_and_no_request(master: Master, station: Station,
                                                           ask: Callable[..., Coroutine[Any, Any, Any]],
                                                           caplog: pytest.LogCaptureFixture) -> None:
    """The await ends when its thread has ended what it did, so there is nobody left waiting then, and nothing to log."""
    master.add(Station(6, IDENT, CONFIGURATION))  # nobody is there

    async def program() -> None:
        await master.aio.operate(timeout=0.5, partial=True)
        await master.aio.clear()
        while workers():  # those of the calls before
            await asyncio.sleep(0)
        task = asyncio.create_task(ask(master, station))
        while not workers():
            await asyncio.sleep(0)
        began = time.monotonic()
        task.cancel()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert time.monotonic() - began < 10 * SLICE
        assert (await master.aio.request(5, "FDL_STATUS")).ok  # what was asked is taken back: the place is free

    asyncio.run(program())
    gc.collect()
    assert not [record for record in caplog.records if record.name == "asyncio"]


def test_a_cancelled_await_ends_behind_its_call(master: Master, station: Station) -> None:
    steps: list[str] = []

    def waiting() -> None:
        steps.append("begun")
        try:
            station.wait(never, None)
        finally:
            steps.append("taken back")

    async def program() -> None:
        await master.aio.operate()
        task = asyncio.create_task(call(waiting))
        while not steps:
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.sleep(0)
        task.cancel()  # as impatient as it may be
        with pytest.raises(asyncio.CancelledError):
            await task
        assert steps == ["begun", "taken back"]

    asyncio.run(program())


def test_a_cancelled_access_leaves_the_parameter_channel_usable(wire: Segment, master: Master) -> None:
    wire.attach(SIP1(address=6))

    async def program() -> None:
        drive = master.add(YaskawaV7(6))
        await master.aio.operate()
        for _ in range(10):
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.003):
                    while True:
                        await drive.aio.read_parameter("n011")
            assert await drive.aio.read_parameter("n003") == 3

    asyncio.run(program())


def test_a_cancelled_access_leaves_the_queue_before_its_turn(wire: Segment, master: Master) -> None:
    wire.attach(SIP1(address=6))
    drive = master.add(YaskawaV7(6))
    channel = drive._channel
    assert channel

    async def program() -> None:
        await master.aio.operate()
        with ExitStack() as turn:
            turn.enter_context(channel._turn())
            asyncio.get_running_loop().call_later(50 * SLICE, turn.close)  # so that a broken queue ends, too
            task = asyncio.create_task(drive.aio.read_parameter("n003"))
            while len(channel._queue) < 2:
                await asyncio.sleep(0)
            began = time.monotonic()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert time.monotonic() - began < 10 * SLICE and len(channel._queue) == 1
        assert await drive.aio.read_parameter("n003") == 3

    asyncio.run(program())


def test_cancelling_the_program_ends_its_loops(master: Master, station: Station) -> None:
    async def loop() -> None:
        async for _ in master.aio.cycles():
            station.update(0, b"\x01")

    async def program() -> None:
        await master.aio.operate()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await asyncio.gather(loop(), loop(), station.aio.wait(never, None))

    asyncio.run(program())


def test_closing_wakes_everybody(master: Master, station: Station) -> None:
    async def count(things: Any, begun: asyncio.Event) -> int:
        n = 0
        async for _ in things:
            n += 1
            begun.set()
        return n

    async def program() -> None:
        begun = [asyncio.Event(), asyncio.Event()]
        await master.aio.stop()
        waits = [asyncio.create_task(station.aio.wait(never, None)) for _ in range(20)]  # more than an executor has threads
        events = asyncio.create_task(count(master.aio.events(), begun[0]))
        await asyncio.sleep(0)  # it has subscribed
        await master.aio.operate()
        loops = [asyncio.create_task(count(master.aio.cycles(), begun[1])), events]
        await asyncio.gather(*(each.wait() for each in begun))
        threading.Thread(target=master.close).start()
        results = await asyncio.wait_for(asyncio.gather(*waits, *loops, return_exceptions=True), 5.0)
        assert {type(result) for result in results[:20]} == {ClosedError}
        assert all(isinstance(seen, int) and seen > 0 for seen in results[20:])

    asyncio.run(program())


def test_a_loop_that_was_closed_in_the_middle_leaves_no_thread(master: Master, station: Station) -> None:
    master.operate()
    loop = asyncio.new_event_loop()
    waiting = station.aio.wait(never, None)
    task = loop.create_task(waiting)
    loop.run_until_complete(asyncio.sleep(0.01))
    assert workers()
    loop.close()
    until(lambda: not workers())
    task._log_destroy_pending = False  # type: ignore[attr-defined]
    waiting.close()


def test_leaving_the_face_closes_the_master(wire: Segment) -> None:
    async def program() -> Master:
        async with Master(wire.port()).aio as master:
            master.add(Station(5, IDENT, CONFIGURATION))
            await master.aio.operate()
            assert master.mode == Mode.OPERATE
        return master

    assert asyncio.run(program()).closed


# ---- events


def test_events_come_through_the_descriptor(master: Master, station: Station) -> None:
    async def program() -> list[Event]:
        found = []
        events = master.aio.events()
        asyncio.get_running_loop().call_later(0.02, master.operate)  # it may hold up the loop: nothing is lost
        async for event in events:
            found.append(event)
            if event.kind == EventKind.MODE and event.a == Mode.OPERATE:
                break
        return found

    kinds = {event.kind for event in asyncio.run(program())}
    assert {EventKind.MODE, EventKind.STATE, EventKind.DIAGNOSIS} <= kinds


def test_a_loop_over_events_that_was_left_holds_no_subscription(master: Master, station: Station) -> None:
    async def program() -> None:
        for _ in range(10):  # there is room for seven
            async for _event in master.aio.events():
                break
            await asyncio.sleep(0)  # the loop closes what was left

    over = threading.Event()

    def change() -> None:
        while not over.is_set():
            master.clear()
            master.stop()

    changing = threading.Thread(target=change)
    changing.start()
    asyncio.run(program())
    over.set()
    changing.join()


def test_a_slow_taker_of_events_costs_no_time(master: Master, station: Station) -> None:
    """While nobody waits for them the descriptor is not watched, so a readable one does not keep the loop spinning."""
    async def program() -> float:
        events = master.aio.events()
        await call(master.operate)
        await anext(events)
        began = time.thread_time()
        await asyncio.sleep(0.2)
        return time.thread_time() - began

    assert asyncio.run(program()) < 0.1


# ---- the output watchdog


WATCHDOG = 0.3


@pytest.fixture
def short(wire: Segment) -> Iterator[Station]:
    with Master(wire.port(), output_watchdog=WATCHDOG) as made:
        station = made.add(Station(5, IDENT, CONFIGURATION))
        made.operate()
        yield station


def latched(station: Station) -> bool:
    return bool(station._owner()._status().latched)


def fed_by(station: Station) -> Feed:
    return Feed(station._owner()._status().fed_by)


async def for_longer_than_the_watchdog(waiting: Awaitable[Any]) -> None:
    with pytest.raises(DPTimeout):
        await waiting


def test_waits_feed_on_behalf_of_a_loop_that_lives(short: Station) -> None:
    """"Waits in the thread of the last commit": a commit in a coroutine is the loop's, an await is its wait."""
    async def program() -> None:
        short.update(0, b"\x01")
        await for_longer_than_the_watchdog(short.aio.wait(never, 3 * WATCHDOG))
        assert (latched(short), fed_by(short)) == (False, Feed.WAIT)
        await short.aio.wait_sent(await call(short.update, 0, b"\x02"))  # a commit made on an errand is the loop's, too
        await for_longer_than_the_watchdog(short.aio.wait(never, 3 * WATCHDOG))
        assert (latched(short), fed_by(short)) == (False, Feed.WAIT)

    asyncio.run(program())


def test_a_loop_over_cycles_feeds(short: Station) -> None:
    async def program() -> None:
        short.update(0, b"\x01")
        end = time.monotonic() + 3 * WATCHDOG
        async for _ in short._owner().aio.cycles():
            if time.monotonic() > end:
                break
        assert (latched(short), fed_by(short)) == (False, Feed.WAIT)

    asyncio.run(program())


def test_an_event_loop_that_hangs_lets_the_watchdog_run_out(short: Station, caplog: pytest.LogCaptureFixture) -> None:
    """Though a thread of its waits all the while, and another loops over cycles."""
    async def cycles() -> None:
        async for _ in short._owner().aio.cycles():
            pass

    async def program() -> None:
        short.update(0, b"\x01")
        others = [asyncio.create_task(cycles()), asyncio.create_task(short.aio.wait(never, None))]
        await short._owner().aio.wait_cycle()
        until(lambda: latched(short))  # in the loop's thread, which hangs as long
        for other in others:
            other.cancel()

    with caplog.at_level(logging.CRITICAL):
        asyncio.run(program())


def test_awaits_do_not_feed_for_another_threads_commit(short: Station) -> None:
    async def program() -> None:
        committer = threading.Thread(target=short.update, args=(0, b"\x01"))
        committer.start()
        committer.join()
        await for_longer_than_the_watchdog(short.aio.wait(never, 3 * WATCHDOG))
        assert latched(short)

    asyncio.run(program())


def test_sleeping_without_the_master_feeds_nothing(short: Station) -> None:
    async def program() -> None:
        short.update(0, b"\x01")
        await asyncio.sleep(3 * WATCHDOG)
        assert latched(short)

    asyncio.run(program())
