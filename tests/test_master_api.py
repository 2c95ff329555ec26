# SPDX-License-Identifier: MIT
"""The master on a silent pty: arguments, errors, closing, forking, events. Stations answer in test_master_pty."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import select
import signal
import subprocess
import sys
import threading
import tty
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from leftovers import nothing_left_behind, threads

from dpmaster import (
    BusParameters,
    ClosedError,
    ConfigurationError,
    DPError,
    DPTimeout,
    Event,
    EventKind,
    Master,
    Mode,
    NotOperatingError,
    PortError,
    Station,
    StationError,
    StationState,
)
from dpmaster.master import _log_event, _Named, log

CONFIGURATION = b"\x33"  # 4 octets each way


class Wire:
    """A pty whose far end nobody reads for long: what is written there is only kept from filling up."""

    def __init__(self) -> None:
        self.fd, self.near = os.openpty()
        tty.setraw(self.near)
        self.path = os.ttyname(self.near)

    def vanish(self) -> None:
        for fd in (self.near, self.fd):
            if fd >= 0:
                os.close(fd)
        self.fd = self.near = -1


@pytest.fixture
def wire() -> Iterator[Wire]:
    made = Wire()
    os.set_blocking(made.fd, False)
    yield made
    made.vanish()


@pytest.fixture
def master(wire: Wire) -> Iterator[Master]:
    with Master(wire.path) as made:
        yield made


def station(address: int = 5, **options: Any) -> Station:
    return Station(address, 0x1234, CONFIGURATION, **options)


# ---- opening


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(PortError, match=r"/dev/no-such-port.*check the path") as caught:
        Master("/dev/no-such-port")
    assert caught.value.path == "/dev/no-such-port"


def test_a_port_that_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    with pytest.raises(PortError, match="not a serial port"):
        Master(str(path))


def test_a_port_in_use(wire: Wire, master: Master) -> None:
    with pytest.raises(PortError, match=r"another program.*fuser"):
        Master(wire.path)


def test_a_failed_open_leaves_nothing_behind(wire: Wire, master: Master) -> None:
    with nothing_left_behind():
        for path in ("/dev/no-such-port", "/dev/null", wire.path):
            with pytest.raises(PortError):
                Master(path)


@pytest.mark.parametrize(("options", "words"), [
    ({"baudrate": 115_200}, ["115200", "500000"]),
    ({"address": 126}, ["126", "125"]),
    ({"cycle_time": 0}, ["cycle_time"]),
    ({"output_watchdog": -1}, ["output_watchdog"]),
    ({"profile": "rs232"}, ["rs232", "uart"]),
    ({"allowance": 2.0}, ["allowance"]),
    ({"max_stations": 127}, ["max_stations"]),
    ({"parameters": replace(BusParameters.default(500_000), tsl=20)}, ["tsl", "20"]),
])
def test_bad_arguments_are_named(wire: Wire, options: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Master(wire.path, **options)
    for word in words:
        assert word in str(caught.value)


# ---- stations


def test_stations_that_cannot_be_added(master: Master) -> None:
    pump = master.add(station(5, name="pump"))
    with pytest.raises(ConfigurationError, match=r"address 5 has a station already, pump"):
        master.add(station(5))
    with pytest.raises(ConfigurationError, match=r"the master's own"):
        master.add(station(1))
    with pytest.raises(ConfigurationError, match=r"pump belongs to a master already"):
        master.add(pump)
    assert master.stations == (pump,)


def test_no_more_stations_than_room(wire: Wire) -> None:
    with Master(wire.path, max_stations=1) as master:
        master.add(station(5))
        with pytest.raises(ConfigurationError, match="max_stations"):
            master.add(station(6))


def test_the_slowest_station_settles_tsl(master: Master) -> None:
    # "Tsl = max(table, largest MaxTsdr on the bus + 15)"; 500 kbit/s: 200
    assert master.parameters.tsl == 200
    master.add(station(5, max_tsdr={500_000: 400, 1_500_000: 900}))
    assert master.parameters.tsl == 415
    master.add(station(6, max_tsdr={500_000: 300}))
    assert master.parameters.tsl == 415
    master.stop()
    with pytest.raises(ConfigurationError, match=r"Tsl 515.*Tsl is 415"):
        master.add(station(7, max_tsdr={500_000: 500}))
    assert len(master.stations) == 2


def test_given_parameters_are_not_changed_for_a_station(wire: Wire) -> None:
    given = BusParameters.default(500_000)
    with Master(wire.path, parameters=given) as master, pytest.raises(ConfigurationError, match="larger Tsl"):
        master.add(station(5, max_tsdr={500_000: 400}))


def test_before_the_bus_begins_state_is_known_and_outputs_are_zeros(master: Master) -> None:
    added = master.add(station())
    assert (added.state, added.reason, added.diagnosis, added.statistics.exchanges) == (StationState.OFFLINE, "", None, 0)
    assert added.outputs == added.inputs == bytes(4)
    assert not added.frame.valid
    assert master.mode == Mode.OFFLINE
    with pytest.raises(NotOperatingError, match="operate"):
        master.wait_cycle()


@pytest.mark.parametrize(("offset", "octets"), [(-1, b"a"), (4, b"a"), (0, b"abcde"), (2, b"abc")])
def test_commits_outside_the_image(master: Master, offset: int, octets: bytes) -> None:
    with pytest.raises(ConfigurationError, match="output octets 0 to 3"):
        master.add(station()).update(offset, octets)


def test_part_of_the_outputs_is_not_the_outputs(master: Master) -> None:
    with pytest.raises(ConfigurationError, match="update"):
        master.add(station()).outputs = b"abc"


# ---- a bus where nobody answers


def test_operate_says_who_is_missing_and_why(master: Master) -> None:
    master.add(station(5, name="pump"))
    master.add(station(6, active=False))
    with pytest.raises(DPTimeout, match=r"pump \(address 5\) does not answer.*powered"):
        master.operate(timeout=0.3)
    assert master.mode == Mode.CLEAR
    master.operate(timeout=0.05, partial=True)
    assert master.mode == Mode.OPERATE


def test_requests_nobody_answers(master: Master) -> None:
    with pytest.raises(StationError, match="station 9 does not answer") as caught:
        master.request(9, "FDL_STATUS")
    assert caught.value.address == 9
    assert master.mode == Mode.STOP
    assert master.request(127, "SDN", 58, 62, b"\x02\x00").meaning == "sent"


@pytest.mark.parametrize(("arguments", "words"), [
    ((5, "SEND"), ["SEND", "SRD"]), ((127, "SRD"), ["127", "126"]), ((-1, "SDN"), ["-1"]), ((5, "SRD", 60), ["60", "both"]),
    ((5, "SRD", 64, 62), ["dsap 64"]), ((5, "SRD", None, None, bytes(247)), ["247", "246"]),
    ((5, "SRD", 60, 62, bytes(245)), ["245", "244"]),
])
def test_bad_requests_are_named(master: Master, arguments: tuple[Any, ...], words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        master.request(*arguments)
    for word in words:
        assert word in str(caught.value)


def test_a_default_watchdog_that_is_too_long(wire: Wire) -> None:
    with Master(wire.path, cycle_time=0.2) as master:
        master.add(station())
        with pytest.raises(ConfigurationError, match=r"ten predicted cycles take 2.00 s.*watchdog=2.0"):
            master.operate()


def test_a_port_that_vanishes(wire: Wire, master: Master) -> None:
    master.add(station())
    master.stop()
    wire.vanish()
    with pytest.raises(PortError, match="vanished"):
        master.operate(timeout=5)


# ---- closing


CALLS: list[Callable[[Master], object]] = [
    lambda m: m.operate(), lambda m: m.clear(), lambda m: m.stop(), lambda m: m.offline(), lambda m: m.mode,
    lambda m: m.feed(), lambda m: m.wait_cycle(), lambda m: m.events(), lambda m: m.request(5), lambda m: m.add(station(9)),
    lambda m: m.statistics, lambda m: m.__enter__(),
    lambda m: m.stations[0].inputs, lambda m: m.stations[0].outputs, lambda m: m.stations[0].update(0, b"a"),
    lambda m: m.stations[0].wait_sent(1), lambda m: m.stations[0].wait(lambda f: True, 1), lambda m: m.stations[0].state,
    lambda m: m.stations[0].diagnosis, lambda m: m.stations[0].reason, lambda m: m.stations[0].statistics,
    lambda m: m.stations[0].slave_diag(), lambda m: m.stations[0].set_prm(), lambda m: m.stations[0].chk_cfg(),
    lambda m: m.stations[0].data_exchange(),
]


@pytest.mark.parametrize("begun", [False, True])
def test_closed_is_closed(master: Master, begun: bool) -> None:
    master.add(station())
    if begun:
        master.stop()
    master.close()
    master.close()
    assert master.closed
    for call in CALLS:
        with pytest.raises(ClosedError, match="closed"):
            call(master)


def test_closing_leaves_nothing_behind(wire: Wire) -> None:
    for begun in (False, True):
        with nothing_left_behind():
            master = Master(wire.path)
            master.add(station())
            events = master.events()
            if begun:
                master.clear()
            master.close()
            assert events.closed
            del master, events


def test_a_begin_that_fails_can_be_tried_again_and_leaves_nothing_behind(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    with nothing_left_behind():
        master = Master(wire.path)
        pumps = [master.add(station(address)) for address in (5, 6)]
        with monkeypatch.context() as patched:
            patched.setattr(master._bus, "start", lambda *_: (_ for _ in ()).throw(DPError("no thread")))
            for _ in range(8):  # more often than there is room for subscribers
                with pytest.raises(DPError, match="no thread"):
                    master.clear()
        with monkeypatch.context() as patched:
            patched.setattr(pumps[1], "_settings", lambda: (_ for _ in ()).throw(DPError("no such settings")))
            with pytest.raises(DPError, match="no such settings"):
                master.clear()
        master.clear()
        assert [pump._index for pump in pumps] == [0, 1]
        master.close()
        del master, pumps


def test_closing_while_the_interpreter_ends_ends_the_thread(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    """By then finalisers have had their turn and do nothing any more, unless they are told to."""
    with nothing_left_behind():
        master = Master(wire.path)
        master.clear()
        monkeypatch.setattr(weakref.finalize, "_shutdown", True)
        master.close()
        del master


def test_a_master_nobody_keeps_ends_itself(wire: Wire) -> None:
    with nothing_left_behind():
        before = threads()
        master = Master(wire.path)
        master.add(station())
        master.clear()
        assert threads() - before
        del master


@pytest.mark.parametrize("call", [
    lambda m: m.stations[0].wait(lambda frame: False, None), lambda m: m.stations[0].wait_sent(1, None),
    lambda m: m.operate(timeout=None), lambda m: list(m.events()), lambda m: m.events().take(),
], ids=["wait", "wait_sent", "operate", "iterate", "take"])
def test_close_wakes_every_waiter(master: Master, call: Callable[[Master], object]) -> None:
    pump = master.add(station())
    master.clear()
    pump.update(0, b"a")
    caught: list[BaseException | None] = []
    inside = threading.Event()

    def wait() -> None:
        inside.set()
        try:
            call(master)
            caught.append(None)
        except BaseException as error:
            caught.append(error)

    waiter = threading.Thread(target=wait)
    waiter.start()
    inside.wait()
    while master.statistics.cycle < 3:  # it is likely inside by now; when not, it finds a closed master
        pass
    master.close()
    waiter.join(5)
    assert not waiter.is_alive()
    assert isinstance(caught[0], ClosedError | None)


def test_ctrl_c_leaves_a_wait_and_closes(wire: Wire) -> None:
    with pytest.raises(KeyboardInterrupt), Master(wire.path) as master:
        pump = master.add(station())
        master.clear()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        pump.wait(lambda frame: False, None)
    assert master.closed


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # fork with threads is what is tested
def test_a_forked_child_may_not_touch_the_bus(master: Master) -> None:
    pump = master.add(station())
    events = master.events()
    master.clear()
    forked, held = threading.Event(), threading.Event()

    def hold() -> None:  # in the child nobody lets go of these
        with master._lock, master._closing, events._lock, pump._commands, pump._image_lock:
            held.set()
            forked.wait()

    holder = threading.Thread(target=hold)
    holder.start()
    held.wait()
    pid = os.fork()
    forked.set()
    if pid == 0:
        code = 1
        signal.alarm(20)
        try:
            for number, call in enumerate([*CALLS, lambda m: m.close(), lambda m: m.stations, lambda m: m[5],
                                           lambda m: list(events), lambda m: events.take(), lambda m: events.close()]):
                code = 10 + number
                try:
                    call(master)
                    os._exit(code)
                except ClosedError as error:
                    if "fork" not in str(error):
                        os._exit(code + 100)
            with events:  # leaving a with block is quiet
                code = 2
            del events
            gc.collect()
            code = 0
        finally:
            os._exit(code)
    holder.join()
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    cycle = master.wait_cycle()
    assert master.wait_cycle() > cycle


def test_an_open_master_ends_before_the_segment_it_is_on() -> None:
    """At an interactive prompt nobody writes `with`: the drive is stopped, and nobody sees the port vanish."""
    program = ("from dpmaster import Master; from dpmaster.drives import YaskawaV7; from dpmaster.emulator import Segment\n"
               "from dpmaster.emulator.cards import SIP1\n"
               "wire = Segment(); card = wire.attach(SIP1(5)); master = Master(wire.port(), allowance=0.1)\n"
               "drive = master.add(YaskawaV7(5, watchdog=5.0))\n"
               "master.operate(20.0); drive.run(5.0)\n"
               "card.detached = lambda: print(card.motor.target)\n")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "0.0\n", "")


def test_the_interpreter_ends_with_an_open_master(wire: Wire) -> None:
    program = f"""
from dpmaster import Master, Station
class Drive(Station):
    def _rest(self):
        print("rest", flush=True)
master = Master({wire.path!r})
master.add(Drive(5, 0x1234, bytes([0x33]), active=False))
master.operate()
print(master.mode.name, flush=True)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout, done.stderr) == (0, "OPERATE\n", "")


# ---- events


def test_events_come_with_a_descriptor(master: Master) -> None:
    events = master.events()
    assert events.take(0) is None
    assert not select.select([events], [], [], 0)[0]
    master.stop()
    assert select.select([events], [], [], 5)[0] == [events]
    kinds = []
    while (event := events.take(0)) is not None:
        kinds.append(event.kind)
        assert str(event)
    assert EventKind.MODE in kinds
    assert events.lost == 0
    events.close()
    events.close()
    with pytest.raises(ClosedError):
        events.take(0)


def test_one_event_at_a_time_keeps_the_descriptor_readable(master: Master) -> None:
    events = master.events()
    master.stop()
    master.offline()
    seen = 0
    while select.select([events], [], [], 0.2)[0]:
        seen += events.take(0) is not None
    assert seen >= 2
    assert events.take(0) is None


def test_a_full_ring_drops_the_oldest_and_says_how_many(master: Master) -> None:
    events = master.events(size=2)
    for _ in range(4):
        master.stop()
        master.offline()
    got = []
    while (event := events.take(0)) is not None:
        got.append(event)
    assert len(got) <= 2
    assert events.lost == got[-1].number - len(got) > 0


def test_events_in_asyncio(master: Master) -> None:
    events = master.events()

    async def first() -> EventKind:
        loop, found = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(events, found.set)
        try:
            await asyncio.to_thread(master.stop)
            await asyncio.wait_for(found.wait(), 5)
        finally:
            loop.remove_reader(events)
        event = events.take(0)
        assert event is not None
        return event.kind

    assert asyncio.run(first()) in (EventKind.FDL, EventKind.MODE)


@pytest.mark.parametrize("size", [0, 1, 3, 131072])
def test_rings_are_powers_of_two(master: Master, size: int) -> None:
    with pytest.raises(ConfigurationError, match=str(size)):
        master.events(size)


def test_subscribers_are_limited_and_say_so(master: Master) -> None:
    master.stop()
    with pytest.raises(ConfigurationError, match="8 subscribers"):
        for _ in range(9):
            master.events()


def test_a_late_telegram_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    """It is dropped, counted and asked for again; a program without logging set up would find it in its own output."""
    caplog.set_level(logging.INFO, "dpmaster")
    _log_event(Event(EventKind.LATE, None, 0.0, 1, value=2_600_000), None, {}, _Named(log, {"who": "master 1 on /dev/ttyS0"}))
    (record,) = caplog.records
    assert record.levelno == logging.INFO and "2.600 ms late" in record.message
    assert record.message.startswith("master 1 on /dev/ttyS0: "), "a program may have several"
