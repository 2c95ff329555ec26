# SPDX-License-Identifier: MIT
"""The master with real stations on a segment of ptys: states and reasons, process image, both watchdogs, leaving, by hand.

The cards here are the plainest there are: inputs echo outputs. What a drive makes of it is in the drives' own tests.
"""

from __future__ import annotations

import gc
import logging
import os
import select
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from children import child
from interrupting import interrupted
from waiting import PATIENCE, until

from dpmaster import (
    ClosedError,
    ConfigurationError,
    Diagnosis,
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
    StationState,
    services,
)
from dpmaster._core import ffi, lib
from dpmaster.emulator import Card, Exchange, Segment, SlaveState
from dpmaster.emulator.cards import SIP1

IDENT = 0x1234
CONFIGURATION = b"\x33"  # 4 octets each way
SAFE = bytes(4)


class Echo(Card):
    """Inputs are the outputs, zeros while these are not valid. It notes every change of what it was shown."""

    ident_number = IDENT
    configurations = (CONFIGURATION,)
    user_parameters = (0, 4)

    def __init__(self, address: int) -> None:
        self.address = address
        self.seen: list[tuple[bytes, bool]] = []

    def step(self, now: float, exchange: Exchange) -> bytes:
        shown = (exchange.outputs, exchange.valid)
        if exchange.state == SlaveState.DATA_EXCH and shown[0] and (not self.seen or self.seen[-1] != shown):
            self.seen.append(shown)
        return exchange.outputs if exchange.valid else SAFE

    def next_step(self, now: float) -> float:
        return now + 10

    def reset(self, now: float) -> None:
        pass

    @property
    def written(self) -> list[bytes]:
        """The outputs other than zeros that ever took effect, in order."""
        return [octets for octets, valid in self.seen if valid and any(octets)]


class Drive(Station):
    """A station with a stop word that it wants to see answered."""

    def __init__(self, address: int = 5, fail: bool = False, **options: Any) -> None:
        super().__init__(address, IDENT, CONFIGURATION, **options)
        self.fail = fail
        self.rested: list[str] = []

    def runs(self) -> None:
        """Its card's application has seen it."""
        self.update(0, b"RUN!")
        self.wait(lambda frame: frame.octets == b"RUN!", PATIENCE)

    def _rest(self) -> None:
        self.rested.append(threading.current_thread().name)
        if self.fail:
            raise RuntimeError("no stop word today")
        self.wait_sent(self.update(0, b"STOP"), PATIENCE)
        self.wait(lambda frame: frame.octets == b"STOP", PATIENCE)  # the card's application has seen it, before Clear comes

    def _before_operate(self) -> list[str]:
        return ["is set to hold its reference when the bus is lost"]



@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment() as made:
        yield made


@pytest.fixture
def card(wire: Segment) -> Echo:
    return wire.attach(Echo(5))


@pytest.fixture
def master(wire: Segment) -> Iterator[Master]:
    with Master(wire.port()) as made:
        yield made


@pytest.fixture
def station(master: Master, card: Echo) -> Station:
    return master.add(Station(5, IDENT, CONFIGURATION))


@pytest.fixture
def running(master: Master, station: Station) -> Station:
    master.operate()
    return station


# ---- from nothing to Data_Exchange


def test_operate_brings_stations_into_data_exchange(master: Master, running: Station, wire: Segment, card: Echo) -> None:
    assert (master.mode, running.state, running.reason) == (Mode.OPERATE, StationState.DATA, "")
    assert isinstance(running.diagnosis, Diagnosis)
    assert (running.diagnosis.ident_number, running.diagnosis.master, running.diagnosis.ready) == (IDENT, 1, True)
    assert running.statistics.starts == 1
    # "Ten predicted cycles with retries, at least 100 ms": some 2 ms of bus and 25 ms that the host may be late
    assert wire.report(card).watchdog == pytest.approx(0.28, abs=0.03)


@pytest.mark.parametrize(("options", "words"), [
    ({"ident_number": 0x4321}, ["1234h", "4321h"]),
    ({"configuration": b"\x34"}, ["Cfg_Fault", "34"]),
    ({"user_parameters": bytes(5)}, ["Prm_Fault"]),
])
def test_a_station_that_refuses_says_why(master: Master, card: Echo, options: dict[str, Any], words: list[str]) -> None:
    wanted = {"ident_number": IDENT, "configuration": CONFIGURATION} | options
    master.add(Station(5, name="mixer", **wanted))
    with pytest.raises(StationError) as caught:
        master.operate(timeout=PATIENCE)  # it comes back as soon as it is sure
    assert caught.value.address == 5
    for word in ["mixer (address 5)", *words]:
        assert word in str(caught.value)
    assert master.mode == Mode.CLEAR


def test_operate_without_those_that_are_missing(master: Master, station: Station) -> None:
    absent = master.add(Station(9, IDENT, CONFIGURATION))
    master.clear()
    until(lambda: station.state == StationState.DATA)
    with pytest.raises(DPTimeout, match=r"1 of 2 stations.*station 9"):
        master.operate(timeout=0.3)
    assert station.state == StationState.DATA
    master.operate(timeout=0.3, partial=True)
    station.wait_sent(station.update(0, b"go!!"))
    assert absent.state == StationState.OFFLINE
    assert "does not answer" in absent.reason


def test_a_station_added_while_the_bus_runs(wire: Segment, master: Master, running: Station) -> None:
    wire.attach(Echo(6))
    late = master.add(Station(6, IDENT, CONFIGURATION))
    master.operate()
    late.outputs = b"late"
    assert late.wait(lambda frame: frame.octets == b"late", 2).valid


def test_a_station_may_ask_for_its_own_watchdog(wire: Segment, master: Master, card: Echo,
                                                caplog: pytest.LogCaptureFixture) -> None:
    wire.attach(Echo(6))
    master.add(Station(5, IDENT, CONFIGURATION, watchdog=2.57))  # 257 is prime: 2.58 s is the next that factors say
    master.add(Station(6, IDENT, CONFIGURATION, name="free", watchdog=None))
    master.operate()
    assert wire.report(card).watchdog == pytest.approx(2.58)
    assert "free: its watchdog is off" in caplog.text


# ---- the process image


def test_outputs_and_inputs(running: Station) -> None:
    assert running.outputs == SAFE
    running.outputs = b"abcd"
    frame = running.wait(lambda f: f.octets == b"abcd", 2)
    assert isinstance(frame, Frame)
    assert frame.valid
    assert frame.number > 0
    assert abs(frame.time - time.monotonic()) < 2
    running.update(1, b"XY")
    assert running.outputs == b"aXYd"
    assert running.wait(lambda f: f.octets == b"aXYd", 2).cycle > frame.cycle
    assert running.inputs == b"aXYd"


def test_every_commit_is_sent_whole_and_in_order(running: Station, card: Echo) -> None:
    """Edges: each commit waited for reaches the card once, none of them torn."""
    commits = [bytes([n] * 4) for n in range(1, 100)]
    for octets in commits:
        number = running.update(0, octets)
        running.wait_sent(number)
        running.wait(lambda f, octets=octets: f.octets == octets, 2)
    assert card.written == commits


def test_threads_commit_their_own_octets(running: Station, card: Echo) -> None:
    def write(offset: int) -> None:
        for value in range(1, 51):
            running.wait_sent(running.update(offset, bytes([value])))

    threads = [threading.Thread(target=write, args=(offset,)) for offset in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert running.wait(lambda f: f.octets == bytes([50] * 4), 2).valid
    for before, after in zip(card.written, card.written[1:], strict=False):
        assert all(a <= b for a, b in zip(before, after, strict=True))


def test_a_wait_that_is_not_met_says_how_things_stand(running: Station) -> None:
    with pytest.raises(DPTimeout, match=r"did not come in 0.05 s; the station is in Data_Exchange and the master in Operate"):
        running.wait(lambda frame: False, 0.05)


def test_a_lost_station_comes_back_with_safe_outputs(wire: Segment, running: Station, card: Echo) -> None:
    """Invariant 4: only a commit made after its return reaches it."""
    running.outputs = b"run!"
    running.wait(lambda f: f.octets == b"run!", 2)
    wire.unplug(card)
    until(lambda: not running.frame.valid)
    assert running.inputs == b"run!"
    assert running.state != StationState.DATA
    assert "no longer answers (lost in Data_Exchange)" in running.reason
    lost = running.update(0, b"lost")
    until(lambda: wire.report(card).watchdog_expired == 1)  # until then the card rightly holds what it has
    card.seen.clear()
    wire.plug(card)
    until(lambda: running.state == StationState.DATA)
    with pytest.raises(OutputsDiscarded) as caught:
        running.wait_sent(lost)
    assert caught.value.number == lost
    assert running.outputs == SAFE
    running.outputs = b"back"
    running.wait(lambda f: f.octets == b"back", 2)
    assert card.written == [b"back"]
    assert running.statistics.losses == 1


def test_hold_is_for_who_asks_for_it(wire: Segment, master: Master, card: Echo) -> None:
    station = master.add(Station(5, IDENT, CONFIGURATION, resume="hold"))
    master.operate()
    station.outputs = b"hold"
    station.wait(lambda f: f.octets == b"hold", 2)
    wire.unplug(card)
    until(lambda: not station.frame.valid)
    wire.plug(card)
    assert station.wait(lambda f: f.octets == b"hold", 5).valid


def test_diagnosis_is_fetched_when_the_station_announces_it(wire: Segment, running: Station, card: Echo) -> None:
    before = running.diagnosis
    assert before is not None
    wire.set_diagnosis(card, b"", announce=True)
    until(lambda: (now := running.diagnosis) is not None and now.number > before.number)
    assert running.state == StationState.DATA


# ---- the output watchdog


@contextmanager
def watched(wire: Segment, output_watchdog: float) -> Iterator[Station]:
    with Master(wire.port(), output_watchdog=output_watchdog, allowance=0.1) as master:
        station = master.add(Station(5, IDENT, CONFIGURATION, watchdog=5.0))  # a station that is lost has no outputs to watch
        master.operate()
        yield station


@pytest.fixture
def brief(wire: Segment, card: Echo) -> Iterator[Station]:
    """A running station of a master whose output watchdog is short."""
    with watched(wire, 0.15) as station:
        yield station


def master_of(station: Station) -> Master:
    assert station._master is not None
    return station._master


def test_a_program_that_hangs_loses_its_outputs(brief: Station, card: Echo) -> None:
    master, events = master_of(brief), master_of(brief).events()
    brief.wait_sent(brief.update(0, b"run!"))
    until(lambda: card.written == [b"run!"] and not card.seen[-1][1])  # polling is no feeding
    assert master.mode == Mode.CLEAR
    kinds = {event.kind: event for event in iter(lambda: events.take(0), None)}
    assert "fed it last" in str(kinds[EventKind.WATCHDOG])
    with pytest.raises(NotOperatingError, match=r"0.15 s, last was a (wait in the thread|commit of outputs).*operate\(\)"):
        brief.outputs = b"more"
    master.operate()
    assert brief.outputs == SAFE
    brief.outputs = b"anew"
    brief.wait(lambda f: f.octets == b"anew", 2)
    assert card.written == [b"run!", b"anew"]


def outlasts(master: Master) -> float:
    """A time that is long for the output watchdog."""
    assert master.output_watchdog is not None
    return time.monotonic() + 3 * master.output_watchdog


@pytest.mark.parametrize("kind", ["cycles", "wait", "commit", "feed"])
def test_what_feeds_the_output_watchdog(wire: Segment, card: Echo, kind: str) -> None:
    for seconds in (0.15, 0.5, 2.0):  # longer on a computer that was away for the time before
        with watched(wire, seconds) as station:
            feed_long(station, kind)
            if master_of(station).mode == Mode.OPERATE:
                return
    raise AssertionError("it ran out in each attempt")


def feed_long(station: Station, kind: str) -> None:
    master = master_of(station)
    station.outputs = b"run!"
    end = outlasts(master)
    while (left := end - time.monotonic()) > 0 and master.mode == Mode.OPERATE:
        if kind == "cycles":
            master.wait_cycle()
        elif kind == "wait":
            with pytest.raises(DPTimeout):
                station.wait(lambda frame: False, left)
        elif kind == "commit":
            with suppress(NotOperatingError):  # it ran out just now
                station.update(0, b"r")
        else:
            master.feed()


@pytest.mark.parametrize("kind", ["reads", "events", "another thread"])
def test_what_does_not_feed_the_output_watchdog(brief: Station, kind: str) -> None:
    """"Never by reads, events or other threads.\""""
    master = master_of(brief)
    events = master.events()
    brief.outputs = b"run!"

    def other() -> None:
        while master.mode == Mode.OPERATE:
            master.wait_cycle()

    if kind == "another thread":
        thread = threading.Thread(target=other)
        thread.start()
    end = outlasts(master) + 2.0  # s more for a bus thread that a busy computer keeps waiting
    while time.monotonic() < end and master.mode == Mode.OPERATE:
        if kind == "events":
            events.take(0.01)
        elif kind == "reads":
            assert len(brief.inputs) == 4
        else:
            thread.join(0.01)
    assert master.mode == Mode.CLEAR
    with pytest.raises(NotOperatingError):
        brief.outputs = b"run!"


def test_a_later_thread_is_not_the_one_that_committed(brief: Station) -> None:
    """Python gives the ident of a thread that has ended to one that begins later."""
    master = master_of(brief)
    idents: list[int] = []

    def commit() -> None:
        brief.outputs = b"run!"
        idents.append(threading.get_ident())

    def watch() -> None:
        idents.append(threading.get_ident())
        end = outlasts(master) + 2.0
        while len(set(idents)) < len(idents) and master.mode == Mode.OPERATE and time.monotonic() < end:
            master.wait_cycle()

    for target in (commit, watch, watch):
        thread = threading.Thread(target=target)
        thread.start()
        thread.join()
    assert len(set(idents)) == len(idents) or master.mode == Mode.CLEAR


def test_operating_twice_changes_nothing(brief: Station) -> None:
    """A second operate() takes the watchdog's last feed for no new start: a program that hangs behind it is still caught."""
    master = master_of(brief)
    brief.outputs = b"run!"
    master.operate()
    assert brief.outputs == b"run!"
    until(lambda: master.mode == Mode.CLEAR)


def test_operating_again_and_again_does_not_feed(brief: Station) -> None:
    master, events = master_of(brief), master_of(brief).events()
    brief.outputs = b"run!"
    expired = threading.Event()

    def operate() -> None:
        end = outlasts(master) + 2.0
        while time.monotonic() < end and not expired.is_set():
            with suppress(DPTimeout):  # it ran out in the middle
                master.operate()
            if any(event.kind == EventKind.WATCHDOG for event in iter(lambda: events.take(0), None)):
                expired.set()

    other = threading.Thread(target=operate)  # the thread of the commit does nothing any more
    other.start()
    other.join()
    assert expired.is_set() and brief.outputs == SAFE


def test_no_output_watchdog_is_logged(wire: Segment, card: Echo, caplog: pytest.LogCaptureFixture) -> None:
    with Master(wire.port(), output_watchdog=None) as master:
        master.add(Station(5, IDENT, CONFIGURATION))
        master.operate()
    assert "the output watchdog is off" in caplog.text


# ---- signals


@pytest.mark.parametrize(("behind", "call"), [
    ("dpm_outputs_change", lambda s: setattr(s, "outputs", b"news")),
    ("dpm_outputs_peek", lambda s: s.outputs),
    ("dpm_image_read", lambda s: s.frame),
    ("dpm_bus_request", lambda s: s.get_cfg(None)),
    ("dpm_bus_order", lambda s: master_of(s).global_control(clear=True, timeout=None)),
])
def test_a_signals_handler_may_do_what_it_interrupted(running: Station, behind: str, call: Callable[[Station], object]) -> None:
    done = threading.Event()

    def handle(_frame: Any, event: str, function: Any) -> None:
        if event == "c_return" and function.__name__ == behind:  # there Python looks for signals
            sys.setprofile(None)
            call(running)

    def work() -> None:
        sys.setprofile(handle)
        call(running)
        assert sys.getprofile() is None
        done.set()

    threading.Thread(target=work, daemon=True).start()
    assert done.wait(5)


def test_ctrl_c_at_any_moment_takes_a_request_back(master: Master, running: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the bus thread still knew would be written to when nobody keeps it any more."""
    asked: list[Any] = []
    make = services._raw_request
    monkeypatch.setattr(services, "_raw_request", lambda *arguments: asked.append(make(*arguments)) or asked[-1])
    at = 1
    while interrupted(running.get_cfg, at):
        known = [raw.done for raw in asked]
        running.get_cfg()  # the queue's turn is over behind this one
        assert [raw.done for raw in asked[:-1]] == known, f"look {at}"
        asked.clear()
        at += 1
    assert at > 20


def test_ctrl_c_at_any_moment_takes_a_global_control_back(master: Master, running: Station) -> None:
    control = ffi.new("dpm_control *", {"da": 127, "clear": -1})
    bus, at = master._bus._handle, 1
    while interrupted(lambda: master.global_control(clear=True), at):
        assert lib.dpm_bus_order(bus, control) == lib.DPM_OK, f"look {at}: one is left there"
        lib.dpm_bus_revoke(bus, control)
        at += 1
    assert at > 20


def test_ctrl_c_at_any_moment_of_the_start_leaves_a_master_that_goes_on_or_is_closed(wire: Segment, card: Echo) -> None:
    """Behind a call that gave the bus thread something, nobody knows what it has."""
    port, at, came = wire.port(), 1, True
    while came:
        with Master(port) as master:
            station = master.add(Station(5, IDENT, CONFIGURATION))
            came = interrupted(master.stop, at)
            if not master.closed:
                master.stop()
                assert station.state == StationState.OFFLINE and station._index == 0, f"look {at}"
        at += 1
    assert at > 100


def test_closing_again_does_what_ctrl_c_has_kept_it_from(wire: Segment) -> None:
    port, at, came = wire.port(), 1, True
    while came:
        master = Master(port)  # which the one before has left
        master.stop()
        events = master.events()
        came = interrupted(master.close, at)
        master.close()
        assert events.closed and master._logger is not None and not master._logger.is_alive(), f"look {at}"
        at += 1
    assert at > 50


# ---- leaving


@pytest.mark.parametrize("way", ["clear", "stop", "offline", "close"])
def test_the_stop_word_comes_before_clear(wire: Segment, card: Echo, way: str) -> None:
    for _ in range(3):  # a busy computer may lose the station, and with it what was committed
        card.seen.clear()
        with Master(wire.port()) as master:
            drive = master.add(Drive())
            master.operate()
            drive.outputs = b"RUN!"
            with suppress(DPTimeout):
                drive.wait(lambda frame: frame.octets == b"RUN!", 2.0)  # the card's application has seen it
            getattr(master, way)()
            assert len(drive.rested) == 1
            if way != "close":
                assert master.mode == {"clear": Mode.CLEAR, "stop": Mode.STOP, "offline": Mode.OFFLINE}[way]
                getattr(master, way)()
                assert len(drive.rested) == 1
        until(lambda: not card.seen[-1][1] or way != "clear")
        if card.written == [b"RUN!", b"STOP"]:
            return
    raise AssertionError(f"in each attempt, the last: {card.written}")


@pytest.mark.parametrize("way", ["clear", "close", "deactivate", "reparameterise"])
def test_no_other_thread_commits_between_the_stop_word_and_clear(master: Master, card: Echo, way: str,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    drive = master.add(Drive())
    master.operate()
    left = threading.Event()

    def jog() -> None:
        with suppress(ClosedError):
            while True:
                with drive._commands:
                    if left.is_set():
                        return  # behind the way back a commit would be one of after it
                    drive.outputs = b"RUN!"

    thread = threading.Thread(target=jog)
    thread.start()
    until(lambda: card.written == [b"RUN!"])
    rest = drive._rest

    def rest_and_leave() -> None:
        try:
            rest()
        finally:
            left.set()

    monkeypatch.setattr(drive, "_rest", rest_and_leave)
    getattr(master if hasattr(master, way) else drive, way)()
    thread.join()
    assert card.written == [b"RUN!", b"STOP"]


def test_nobody_operates_what_is_being_closed(master: Master, card: Echo, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else what runs would go to Clear without a second stop word."""
    drive = master.add(Drive())
    master.operate()
    drive.runs()
    await_mode = master._await_mode

    def operate_meanwhile(mode: Mode, timeout: float) -> None:
        with pytest.raises(ClosedError, match="is being closed"):
            master.operate()
        await_mode(mode, timeout)

    monkeypatch.setattr(master, "_await_mode", operate_meanwhile)
    master.close()
    assert card.written == [b"RUN!", b"STOP"]


def test_a_thread_that_hangs_with_a_station_in_hand_keeps_nobody_from_leaving(master: Master, card: Echo,
                                                                              monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dpmaster.master.REST_TIME", 0.1)
    drive = master.add(Drive())
    master.operate()
    drive.wait_sent(drive.update(0, b"RUN!"))
    held, over = threading.Event(), threading.Event()

    def hang() -> None:
        with drive._commands:
            held.set()
            over.wait(PATIENCE)

    thread = threading.Thread(target=hang)
    thread.start()
    held.wait()
    master.clear()
    assert thread.is_alive()
    over.set()
    thread.join()
    until(lambda: not card.seen[-1][1])  # Clear all the same
    assert drive.rested == []


class Slow:
    """A master whose stations are gone: it leaves them for some 0.4 s."""

    def __init__(self, wire: Segment) -> None:
        self.wire = wire
        for address in range(10, 18):
            wire.attach(Echo(address))
        self.port = wire.port()
        self.master = Master(self.port)
        for address in range(10, 18):
            self.master.add(Station(address, IDENT, CONFIGURATION))
        self.master.operate()

    def end(self) -> threading.Thread:
        """It is being closed when this returns, as by a second Ctrl-C or the collector."""
        self.wire.cut(self.port)
        thread = threading.Thread(target=self.master._bus.close)
        thread.start()
        until(lambda: self.master.closed)
        return thread


@pytest.fixture
def slow() -> Iterator[Slow]:
    with Segment(cards=8) as wire:
        made = Slow(wire)
        yield made
        made.master.close()


def test_requests_given_up_while_the_bus_is_left_keep_their_memory(slow: Slow, monkeypatch: pytest.MonkeyPatch) -> None:
    bus, lent = slow.master._bus, list[weakref.ref[Any]]()
    lend, began = bus._lend, threading.Barrier(6)

    def watched(job: Any, give: Any, take_back: Any, *rest: Any, **context: Any) -> bool:
        def noted(handle: Any, job: Any) -> int:
            code = int(take_back(handle, job))
            if code != lib.DPM_OK:
                lent.append(weakref.ref(job))
            return code

        return lend(job, give, noted, *rest, **context)

    monkeypatch.setattr(bus, "_lend", watched)

    def ask() -> None:
        began.wait()
        with suppress(ClosedError):
            while True:
                with suppress(StationError):  # nobody is there
                    slow.master.request(9, "fdl_status", timeout=None)

    asking = [threading.Thread(target=ask) for _ in range(5)]
    for thread in asking:
        thread.start()
    began.wait()
    ending = slow.end()
    for thread in asking:
        thread.join()
    gc.collect()
    assert all(job() is not None for job in lent)
    ending.join()


def test_a_subscription_ended_while_the_bus_is_left_gives_its_descriptor_to_nobody(slow: Slow) -> None:
    events = slow.master.events()
    ending = slow.end()
    events.close()
    others = [os.eventfd(0, os.EFD_NONBLOCK) for _ in range(5)]  # one of them would be what the thread still writes to
    ending.join()
    try:
        assert select.select(others, [], [], 0)[0] == []
        assert events.closed
    finally:
        for fd in others:
            os.close(fd)


def test_leaving_unlocks_the_stations(wire: Segment, master: Master, running: Station, card: Echo) -> None:
    assert wire.report(card).master == 1
    master.stop()
    assert wire.report(card).master is None
    assert running.state != StationState.DATA


def test_a_stop_word_that_fails_keeps_nobody(wire: Segment, caplog: pytest.LogCaptureFixture) -> None:
    cards = [wire.attach(Echo(address)) for address in (5, 6)]
    with Master(wire.port()) as master:
        drives = [master.add(Drive(5, fail=True)), master.add(Drive(6))]
        master.operate()
        for drive in drives:
            drive.runs()
    assert [card.written for card in cards] == [[b"RUN!"], [b"RUN!", b"STOP"]]
    assert "no stop word today" in caplog.text
    assert master.closed


def test_a_station_that_is_gone_is_not_asked_to_rest(wire: Segment, master: Master, card: Echo) -> None:
    drive = master.add(Drive())
    master.operate()
    wire.unplug(card)
    until(lambda: drive.state != StationState.DATA)
    start = time.monotonic()
    master.close()
    assert drive.rested == []
    assert time.monotonic() - start < 2


def test_a_warning_before_operate(master: Master, card: Echo, caplog: pytest.LogCaptureFixture) -> None:
    master.add(Drive())
    master.operate()
    assert "station 5: is set to hold" in caplog.text


def test_ctrl_c_leaves_through_the_stop_word(wire: Segment, card: Echo) -> None:
    with pytest.raises(KeyboardInterrupt), Master(wire.port()) as master:
        drive = master.add(Drive())
        master.operate()
        drive.runs()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        drive.wait(lambda frame: False, None)
    assert card.written == [b"RUN!", b"STOP"]


PROGRAM = """
import sys
from dpmaster import Master, Station
class Drive(Station):
    def _rest(self):
        self.update(0, b"STOP")
        self.wait(lambda frame: frame.octets == b"STOP", 5.0)  # the card's application has seen it, before Clear comes
master = Master(sys.argv[1])
drive = master.add(Drive(5, 0x1234, bytes([0x33])))
master.operate()
drive.update(0, b"RUN!")
drive.wait(lambda frame: frame.octets == b"RUN!", 20.0)  # as above
print("runs", flush=True)
"""


@contextmanager
def running_program(wire: Segment, end: str) -> Iterator[subprocess.Popen[str]]:
    with child("-c", PROGRAM + end, wire.port()) as program:
        assert program.stdout.readline() == "runs\n"
        yield program


def test_a_program_that_just_ends_says_its_stop_word(wire: Segment, card: Echo) -> None:
    with running_program(wire, "") as program:
        assert program.communicate(timeout=20) == ("", "")
        assert program.returncode == 0
    assert card.written == [b"RUN!", b"STOP"]


def test_a_program_that_is_killed_leaves_it_to_the_slaves_watchdog(wire: Segment, card: Echo) -> None:
    with running_program(wire, "drive.wait(lambda frame: False, None)") as program:
        program.kill()
    until(lambda: wire.report(card).watchdog_expired == 1)
    assert wire.report(card).state == SlaveState.WAIT_PRM
    assert card.written == [b"RUN!"]


def test_a_program_that_was_stopped_for_a_while_does_not_run_on(wire: Segment, card: Echo) -> None:
    """SIGSTOP, the slave's watchdog, SIGCONT: outputs stay safe until a new command."""
    with running_program(wire, "drive.wait(lambda frame: False, None)") as program:
        program.send_signal(signal.SIGSTOP)
        until(lambda: wire.report(card).watchdog_expired == 1)
        card.seen.clear()
        program.send_signal(signal.SIGCONT)
        before = wire.report(card).exchanges
        until(lambda: wire.report(card).exchanges > before + 20)
        assert card.written == []
        program.send_signal(signal.SIGINT)
        program.communicate(timeout=20)
        assert program.returncode != 0


# ---- by hand


def test_step_by_step(wire: Segment, master: Master, card: Echo) -> None:
    station = master.add(Station(5, IDENT, CONFIGURATION, active=False))
    diagnosis = station.slave_diag()
    assert not diagnosis.ready
    station.set_prm(watchdog=2.0)
    assert wire.report(card).state == SlaveState.WAIT_CFG
    assert wire.report(card).watchdog == pytest.approx(2.0)
    station.chk_cfg()
    until(lambda: station.slave_diag().ready)
    until(lambda: station.data_exchange(b"hand") == b"hand")
    with pytest.raises(StationError, match=r"refuses Data_Exchange"):
        station.data_exchange(b"too long")
    station.set_prm(lock=False, unlock=True)
    assert wire.report(card).master is None
    assert station.state == StationState.INACTIVE


def test_a_refusal_by_hand_is_in_the_diagnosis(master: Master, card: Echo) -> None:
    station = master.add(Station(5, IDENT, CONFIGURATION, active=False))
    station.set_prm(ident_number=0x4321)
    assert "refuses the parameters" in station.slave_diag().texts
    station.set_prm()
    station.chk_cfg(b"\x34")
    assert "refuses the configuration" in station.slave_diag().texts


@pytest.mark.parametrize("call", [lambda s: s.set_prm(), lambda s: s.chk_cfg(), lambda s: s.data_exchange(b"hand")])
def test_services_by_hand_are_not_for_stations_in_the_cycle(running: Station, call: Callable[[Station], object]) -> None:
    with pytest.raises(NotOperatingError, match=r"in the master's cycle.*active=False"):
        call(running)
    assert running.slave_diag().ready
    assert running.state == StationState.DATA


def test_requests_say_what_came_back(master: Master, running: Station) -> None:
    statuses = (master.request(5, "FDL_STATUS") for _ in range(10))
    status = next(status for status in statuses if status.tries == 1)  # a busy computer asks again
    assert (status.fc, status.data, status.ok) == (0x00, b"", True)
    assert status.tsdr is None or 0 <= status.tsdr < 1
    configuration = master.request(5, "SRD", 59, 62)  # Get_Cfg
    assert configuration.data == CONFIGURATION
    closed = master.request(5, "SRD", 20, 62)
    assert (closed.ok, closed.meaning) == (False, "RS, service not activated")
    assert running.state == StationState.DATA


def test_requests_of_many_threads_take_turns(master: Master, running: Station) -> None:
    got: list[bytes] = []
    threads = [threading.Thread(target=lambda: got.append(master.request(5, "SRD", 59, 62, timeout=10).data)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert got == [CONFIGURATION] * 8


# ---- what is told


def test_events_tell_the_way_into_data_exchange(master: Master, station: Station) -> None:
    events = master.events()
    master.operate()
    seen: list[Event] = []
    while not any(event.kind == EventKind.MODE and event.a == Mode.OPERATE for event in seen):
        event = events.take(2)
        assert event is not None
        seen.append(event)
    states = [StationState(event.a) for event in seen if event.kind == EventKind.STATE]
    assert states[-1] == StationState.DATA
    assert {event.address for event in seen if event.kind == EventKind.STATE} == {5}
    assert [event.number for event in seen] == list(range(1, len(seen) + 1))


def test_the_log_tells_a_loss_once(wire: Segment, master: Master, running: Station, card: Echo,
                                   caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dpmaster")
    wire.unplug(card)
    until(lambda: "no longer answers" in caplog.text)
    tries = master.statistics.unanswered
    until(lambda: master.statistics.unanswered >= tries + 3)
    wire.plug(card)
    until(lambda: "-> DATA" in caplog.text)
    assert caplog.text.count("station 5 no longer answers") == 1


def test_the_log_tells_two_troubles_that_take_turns_once_each(wire: Segment, master: Master, card: Echo,
                                                              caplog: pytest.LogCaptureFixture) -> None:
    """Set_Prm that is too long is answered by RS, and the diagnosis behind it says Prm_Fault, with every try."""
    station = master.add(Station(5, IDENT, CONFIGURATION, b"12345"))
    with pytest.raises(StationError):
        master.operate(timeout=PATIENCE)
    assert station.statistics.refused >= 3
    master.close()  # the log is complete
    assert caplog.text.count("RS, service not activated") == 1 and caplog.text.count("Prm_Fault") == 1


def test_an_error_names_a_few_of_many_missing_stations(wire: Segment, master: Master, card: Echo) -> None:
    for address in range(2, 62):
        master.add(Station(address, IDENT, CONFIGURATION if address != 5 else b"\x31"))
    master.clear()
    until(lambda: "Cfg_Fault" in master[5].reason)
    with pytest.raises(StationError, match=r"60 of 60 stations.*: station 5 .*Cfg_Fault.*; and the stations at 10, 11,.*, 61"
                       ) as caught:
        master.operate(timeout=0.1)
    assert str(caught.value).count("(address ") == 8


def test_a_station_added_while_the_bus_runs_is_warned_of_as_well(master: Master, running: Station,
                                                                 caplog: pytest.LogCaptureFixture) -> None:
    master.add(Station(6, IDENT, CONFIGURATION, name="free", watchdog=None))
    assert "free: its watchdog is off" in caplog.text


def test_statistics_count_what_was_done(master: Master, running: Station) -> None:
    for _ in range(3):
        master.wait_cycle()
    statistics = master.statistics
    assert statistics.cycle >= 3
    assert statistics.answers >= running.statistics.exchanges > 0
    assert 0 < statistics.cycle_last <= statistics.cycle_max
    assert sum(statistics.rejected.values()) == 0
    assert statistics.port.profile == "pty"
    assert statistics.port.octets_in > 0
    with pytest.raises(ConfigurationError):
        master.add(Station(5, IDENT, CONFIGURATION))


@pytest.mark.parametrize("known", [True, False], ids=["its own port", "a path"])
def test_a_wire_paced_at_the_lowest_rate_carries_long_telegrams(known: bool) -> None:
    """An answer of 41 octets takes 47 ms at 9600 bit/s and is handed over when it has ended; Tsl is 10 ms."""
    with Segment(9600) as wire:
        wire.attach(SIP1(address=5))
        port = wire.port()
        with Master(port if known else str(port), baudrate=9600) as master:
            station = master.add(Station(5, SIP1.ident_number, bytes.fromhex("5F 6F"), watchdog=5.0))
            master.operate(timeout=20.0)
            for _ in range(3):
                station.wait_sent(station.update(0, b"\0"), 5.0)
            assert station.statistics.losses == 0
