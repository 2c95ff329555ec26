# SPDX-License-Identifier: MIT
"""What a user does wrong or finds broken: one clear message each - the thing, the value, the rule, the remedy - and no thread
or descriptor left behind.

Each case is a call and the parts its message must have. Messages are for reading: whoever changes one looks at the whole of it.
"""

from __future__ import annotations

import gc
import os
import subprocess
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from children import child
from interrupting import Behind, interrupted
from leftovers import descriptors, nothing_left_behind

from dpmaster import (
    ClosedError,
    CommissioningError,
    ConfigurationError,
    DPError,
    DPTimeout,
    EventKind,
    Master,
    Mode,
    NotOperatingError,
    PortError,
    Realtime,
    Station,
    StationState,
    calibration,
)
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Line, Segment
from dpmaster.emulator.cards import SIP1
from dpmaster.ports import Port

CONFIGURATION = b"\x33"  # 4 octets each way
PATIENCE = 20.0  # s; only a failing test waits so long


@pytest.fixture(autouse=True)
def tidy() -> Iterator[None]:
    with nothing_left_behind():
        yield


@pytest.fixture
def wire(tidy: None) -> Iterator[Segment]:
    with Segment(ports=2, cards=4) as made:
        yield made


@pytest.fixture
def master(wire: Segment) -> Iterator[Master]:
    with Master(wire.port(), output_watchdog=60.0) as made:  # what is tested here is not it
        yield made


@pytest.fixture
def drive(wire: Segment, master: Master) -> YaskawaV7:
    """A drive in Operate."""
    wire.attach(SIP1(5))
    added = master.add(YaskawaV7(5, name="fan"))
    master.operate(PATIENCE)
    return added


def refused(kind: type[DPError], parts: str, call: Callable[..., object], *arguments: Any, **named: Any) -> str:
    """`call` raises exactly that kind with one line that has the parts (separated by |) in their order; the message."""
    with pytest.raises(kind) as caught:
        call(*arguments, **named)
    assert type(caught.value) is kind
    message, at = str(caught.value), 0
    assert "\n" not in message
    for part in parts.split("|"):
        assert part in message[at:], f"{part!r} is not (there) in: {message}"
        at = message.index(part, at) + len(part)
    assert caught.value.__cause__ is None or isinstance(caught.value.__cause__, DPError)
    return message


# ---- ports


def test_a_missing_port() -> None:
    for opened in (Master, lambda path: Line(path, SIP1(5), baudrate=500_000)):
        message = refused(PortError, "/dev/ttyNO|no such port|check the path|/dev/serial/by-id", opened, "/dev/ttyNO")
        assert message.count("check the path") == 1  # the remedy is told once


@pytest.mark.parametrize("path", ["/dev/null", "/", __file__])
def test_what_is_no_serial_port(path: str) -> None:
    refused(PortError, f"{path}|not a serial port|segment's port()", Master, path)


@pytest.mark.parametrize("port", [5, None, "", "a\0b", b"/dev/ttyUSB0"])
def test_what_is_no_path(port: Any) -> None:
    refused(ConfigurationError, f"port {port!r}|path of a serial port|/dev/ttyUSB0", Master, port)


def test_a_path_object_is_a_path() -> None:
    refused(PortError, "/dev/ttyNO|no such port", Master, Path("/dev/ttyNO"))


def test_a_port_in_use_by_this_process(wire: Segment, master: Master) -> None:
    path = str(wire.port())
    with Master(path):
        refused(PortError, f"{path}|has the port|close that first|'fuser -v {path}'", Master, path)
        refused(PortError, f"{path}|has the port|close that first", Line, path, SIP1(5), baudrate=500_000)
    Master(path).close()  # and now it is free


def test_a_port_in_use_by_another_process(wire: Segment) -> None:
    path = str(wire.port())
    program = f"from dpmaster import Master; master = Master({path!r}); print('open', flush=True); input()"
    with child("-c", program, stdin=subprocess.PIPE) as other:
        assert other.stdout.readline() == "open\n"
        refused(PortError, f"{path}|another program|has the port|close that first|fuser", Master, path)
        other.communicate("\n", timeout=PATIENCE)
    assert other.returncode == 0
    Master(path).close()


def test_a_port_that_vanishes(wire: Segment, master: Master, drive: YaskawaV7) -> None:
    drive.run_forward(30.0)
    with master.events() as events:
        wire.close()
        while (event := events.take(PATIENCE)) is not None and event.kind is not EventKind.PORT:
            pass
        assert event is not None and "vanished" in str(event)
    # Everything can still be read; the inputs stay, their validity is gone.
    assert (drive.state, drive.frame.valid, len(drive.inputs)) == (StationState.OFFLINE, False, 32)
    assert drive.outputs == bytes(32)
    # A commit is taken, as after every loss; whoever waits for it is told.
    number = drive.update(0, b"\0\1")
    for call in (master.operate, master.wait_cycle, lambda timeout: master.request(5, timeout=timeout),
                 lambda timeout: drive.wait_sent(number, timeout), lambda timeout: drive.wait(lambda frame: True, timeout)):
        refused(PortError, f"{master._bus.path}|the port vanished|open a new one", call, timeout=0.1)
    begin = time.monotonic()
    master.close()
    assert time.monotonic() - begin < PATIENCE


# ---- arguments


STATION: list[tuple[str, Any, str]] = [
    ("address", 126, "126|waits for its address|0 to 125|Set_Slave_Add"), ("address", 127, "address 127|0 to 125"),
    ("address", -1, "address -1|0 to 125"), ("address", "5", "address '5'|0 to 125"),
    ("address", True, "address True|0 to 125"),
    ("ident_number", 0x10000, "ident_number 65536|0 to 65535"), ("ident_number", "00CA", "ident_number '00CA'|0 to 65535"),
    ("configuration", b"", "configuration of 0 octets|1 to 244"),
    ("configuration", bytes(245), "configuration of 245 octets|1 to 244"),
    ("configuration", b"\x40", "configuration 40|cut short"),
    ("configuration", "33", "configuration '33'|bytes"), ("configuration", 5, "configuration 5|bytes"),
    ("configuration", [256], "configuration [256]|0 to 255"),
    ("user_parameters", bytes(238), "user_parameters of 238 octets|237"), ("user_parameters", 3, "user_parameters 3|bytes"),
    *(("watchdog", value, f"watchdog {value!r}|above 0|650.25 s|'default'|None")
      for value in (0, -1, 651, float("nan"), "off", True, [1])),
    ("min_tsdr", 10, "min_tsdr 10|11 to 255"), ("max_tsdr", 60, "max_tsdr 60|mapping"),
    ("max_tsdr", {9600: 5000}, "max_tsdr at 9600 bit/s 5000|37 to 1023"), ("group", 256, "group 256|0 to 255"),
    ("min_tsdr", None, "min_tsdr None|11 to 255"), ("name", 5, "name 5|text"),
    *((flag, "yes", f"{flag} 'yes'|True or False") for flag in ("sync", "freeze", "fail_safe", "check_ident", "active")),
    ("resume", "run", "resume 'run'|'safe' or 'hold'"), ("min_slave_interval", 65536, "min_slave_interval 65536|0 to 65535"),
]


@pytest.mark.parametrize(("name", "value", "parts"), STATION)
def test_a_stations_arguments(name: str, value: Any, parts: str) -> None:
    arguments = {"address": 5, "ident_number": 0x1234, "configuration": CONFIGURATION} | {name: value}
    refused(ConfigurationError, parts, Station, **arguments)


MASTER: list[tuple[str, Any, str]] = [
    ("baudrate", 115_200, "baudrate 115200|use one of 9600|500000|12000000"), ("baudrate", "fast", "baudrate 'fast'|BAUDRATES"),
    *(("address", value, f"the master's address {value!r}|0 to 125") for value in (126, -1, "1", True, None)),
    *(("output_watchdog", value, f"output_watchdog {value!r}|above 0|3600 s|None") for value in (0, -1, 3601, "1", True)),
    *(("cycle_time", value, f"cycle_time {value!r}|above 0|10 s|None") for value in (0, 11, "1")),
    ("max_stations", 127, "max_stations 127|1 to 126"), ("profile", "rs232", "profile 'rs232'|'uart', 'usb', 'pty'"),
    *(("allowance", value, f"allowance {value!r}|1 s") for value in (2, -1, [])), ("echo", "yes", "echo 'yes'|True, False"),
    ("parameters", 5, "parameters 5|BusParameters"),
]


@pytest.mark.parametrize(("name", "value", "parts"), MASTER)
def test_a_masters_arguments(wire: Segment, name: str, value: Any, parts: str) -> None:
    refused(ConfigurationError, parts, Master, wire.port(), **{name: value})


@pytest.mark.parametrize(("arguments", "parts"), [
    *(((value,), f"address {value!r}|two switches|1 to 99") for value in (0, 100, 126, "5", None)),
    *(((5, value), f"configuration {value!r}|'Basic data', 'Extended Data 1', 'Extended Data 2'")
      for value in ("Extended Data 3", "", None)),
])
def test_a_drives_arguments(arguments: tuple[Any, ...], parts: str) -> None:
    refused(ConfigurationError, parts, YaskawaV7, *arguments)


def test_stations_that_cannot_be_added(wire: Segment, master: Master) -> None:
    fan = master.add(Station(5, 0x1234, CONFIGURATION, name="fan"))
    refused(ConfigurationError, "address 5|a station already|fan|another", master.add, Station(5, 1, CONFIGURATION))
    refused(ConfigurationError, "station 1|address 1|the master's own|another", master.add, Station(1, 1, CONFIGURATION))
    refused(ConfigurationError, "fan belongs to a master|another object", master.add, fan)
    refused(ConfigurationError, "'fan'|a Station", master.add, "fan")
    wire.attach(SIP1(7))
    refused(ConfigurationError, "SIP1 at address 7|taken|another", wire.attach, SIP1(7))
    refused(ConfigurationError, "card 7|a Card", wire.attach, 7)


def test_commits_that_do_not_fit(drive: YaskawaV7) -> None:
    before = drive.outputs
    for offset, octets in ((0, bytes(33)), (32, b"a"), (-1, b"a"), ("0", b"a")):
        refused(ConfigurationError, f"fan has output octets 0 to 31|{len(octets)} octets at offset {offset!r}|do not fit",
                drive.update, offset, octets)
    for length in (0, 31, 33):
        refused(ConfigurationError, f"fan has 32 output octets|{length} were given|update(offset, octets)",
                lambda n=length: setattr(drive, "outputs", bytes(n)))
    for wrong in ("ab", 5, None, [256], [-1], [1.0]):  # 5 is not five zeros
        refused(ConfigurationError, f"fan: outputs {wrong!r}|bytes|0 to 255", drive.update, 0, wrong)
    refused(ConfigurationError, "fan: commit 1000|never made|update()", drive.wait_sent, 1000)
    for number in ("x", -1, 10**30):
        refused(ConfigurationError, f"fan: commit {number!r}|update()", drive.wait_sent, number)
    refused(ConfigurationError, "fan: keep 5|bytes", drive.update, 0, b"a", 5)
    refused(ConfigurationError, "timeout 'x'|seconds, or None", drive.deactivate, "x")
    refused(ConfigurationError, "timeout 'x'|seconds, or None", drive.wait, lambda frame: False, "x")
    assert drive.outputs == before == bytes(32)


@pytest.mark.parametrize(("call", "parts"), [
    (lambda d: d.run_forward(60.1), "frequency 60.1 Hz|60.0 Hz|n011"), (lambda d: d.run_forward(-1), "-1|positive|run_reverse"),
    (lambda d: d.run_forward("fast"), "frequency 'fast'|number"),
    (lambda d: d.run_forward(float("nan")), "frequency nan|number"),
    (lambda d: d.read_parameter("q003"), "register 'q003'|like 'n003'"), (lambda d: d.read_parameter(None), "None|like 'n003'"),
    (lambda d: d.read_parameter("n003", 5), "5 registers|Extended Data 1|1 to 4"),
    (lambda d: d.read_parameter("n003", "2"), "'2' registers|1 to 4"),
    (lambda d: d.write_parameter("n003", 65_536), "'n003'|65536|0 to 65535"),
    (lambda d: d.write_parameter("n003", 3.0), "'n003'|3.0|0 to 65535"),
    (lambda d: d.write_parameter("n003", "3"), "'n003'|'3'|0 to 65535"),
    (lambda d: d.digital_inputs.__setitem__("S8", True), "terminal 'S8'|S3, S4, S5, S6, S7"),
])
def test_what_a_drive_cannot_do(drive: YaskawaV7, call: Callable[[YaskawaV7], object], parts: str) -> None:
    refused(ConfigurationError, parts, call, drive)
    assert drive.outputs[:4] == bytes(4)


def test_factory_parameters_in_the_way(wire: Segment, master: Master) -> None:
    card = wire.attach(SIP1(5, parameters="factory"))
    drive = master.add(YaskawaV7(5, name="fan"))
    master.operate(PATIENCE)
    message = refused(CommissioningError, "fan|n003 is 1 and must be 3|n004 is 2 and must be 9|write_parameter",
                      drive.run_forward, 30.0)
    assert "\n" not in message and not card.running
    drive.write_parameter("n003", 3)  # the remedy that was named
    refused(CommissioningError, "n004 is 2 and must be 9", drive.run_forward, 30.0)
    drive.write_parameter("n004", 9)
    drive.run_forward(30.0)


# ---- closed, forked, too early


def fan(master: Master) -> YaskawaV7:
    drive = master.stations[0]
    assert isinstance(drive, YaskawaV7)
    return drive


MASTER_CALLS: dict[str, Callable[[Master], object]] = {
    "operate": lambda m: m.operate(), "clear": lambda m: m.clear(), "stop": lambda m: m.stop(),
    "offline": lambda m: m.offline(),
    "feed": lambda m: m.feed(), "add": lambda m: m.add(Station(9, 1, CONFIGURATION)), "request": lambda m: m.request(5),
    "update": lambda m: m.stations[0].update(0, b"a"), "outputs": lambda m: m.stations[0].outputs,
    "set outputs": lambda m: setattr(m.stations[0], "outputs", bytes(32)), "inputs": lambda m: m.stations[0].inputs,
    "run": lambda m: fan(m).run_forward(5.0), "stop drive": lambda m: fan(m).stop(),
    "read": lambda m: fan(m).read_parameter("n003"),
}
SEGMENT_CALLS: dict[str, Callable[[Segment], object]] = {
    "attach": lambda w: w.attach(SIP1(9)), "port": lambda w: w.port(), "faults": lambda w: w.faults(),
    "check": lambda w: w.check(),
    "cut": lambda w: w.cut("x"), "report": lambda w: w.report(SIP1(5)), "enter": lambda w: w.__enter__(),
}


def test_closed_objects_say_so(wire: Segment, master: Master, drive: YaskawaV7) -> None:
    master.close()
    for call in MASTER_CALLS.values():
        refused(ClosedError, f"the master on {master._bus.path}|closed|open a new one", call, master)
    wire.close()
    for other in SEGMENT_CALLS.values():
        refused(ClosedError, "this Segment|closed|open a new one", other, wire)
    master.close()
    wire.close()


def test_objects_of_the_parent_say_so_in_a_child(wire: Segment, master: Master, drive: YaskawaV7) -> None:
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            words = f"belongs to process {os.getppid()}|this is {os.getpid()}|forked|open a new one here|'spawn'"
            for name, call in MASTER_CALLS.items():
                os.write(write, f"{name}; ".encode())
                refused(ClosedError, f"the master on {master._bus.path} {words}", call, master)
            for name, other in SEGMENT_CALLS.items():
                os.write(write, f"{name}; ".encode())
                refused(ClosedError, f"this Segment {words}", other, wire)
            os.write(write, b"end")
        except BaseException as error:
            os.write(write, repr(error).encode())
        finally:
            os._exit(0)
    os.close(write)
    os.waitpid(child, 0)
    with open(read, "rb") as told:
        assert told.read().decode() == "; ".join([*MASTER_CALLS, *SEGMENT_CALLS, "end"])
    drive.wait_sent(drive.update(0, b"\0\0"), PATIENCE)


def test_too_early(master: Master) -> None:
    drive = YaskawaV7(5, name="fan")
    for call in (lambda: drive.outputs, lambda: drive.update(0, b"a"), lambda: drive.run_forward(5.0)):
        refused(ConfigurationError, "fan belongs to no master|master.add(station) first", call)
    master.add(drive)
    refused(NotOperatingError, "the bus has not begun|operate()", master.wait_cycle)
    for size in ("x", 0, 3):
        refused(ConfigurationError, f"size {size!r}|power of two", master.events, size)
    with master.events() as events:
        refused(ConfigurationError, "timeout 'x'|seconds, or None", events.take, "x")
    refused(DPTimeout, "fan|the master has not begun|operate() first", drive.read_parameter, "n003", timeout=0.01)
    with pytest.raises(DPTimeout, match=r"fan \(address 5\) does not answer"):
        master.operate(timeout=0.1)


def test_a_drive_that_is_not_heard_is_not_said_to_be_set_wrongly(master: Master) -> None:
    drive = master.add(YaskawaV7(5, "Basic data", name="fan"))
    refused(DPTimeout, "fan|the master has not begun: operate() first", drive.run, 10.0)
    master.clear()
    refused(DPTimeout, "fan|the station does not answer: is it powered", drive.run, 10.0)


def test_two_objects_on_one_wire_that_are_both_masters(wire: Segment, drive: YaskawaV7) -> None:
    """Their Tsl has no room for a ring: the one that hears a foreign token gives way, and says so."""
    with Master(wire.port(), address=2) as second:
        second.add(Station(9, 1, CONFIGURATION))
        refused(DPTimeout, "station 9 (address 9)|master 1 has the bus|ring=True|for_ring|Tsl", second.operate, timeout=0.5)
    assert drive.state is StationState.DATA


# ---- Ctrl-C


def test_ctrl_c_while_a_port_is_opened_leaves_it_to_the_next(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    path = wire.port()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("dpmaster.bus.lib", Behind("dpm_bus_open"))
        Master(path)
    gc.collect()
    Master(path).close()


def test_ctrl_c_while_a_port_is_closed_ends_the_subscriptions_all_the_same(wire: Segment,
                                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that waits for events would keep the interpreter from ending."""
    master = Master(wire.port())
    events = master.events()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("dpmaster.bus.lib", Behind("dpm_bus_close"))
        master.close()
    assert events.closed
    master.close()


def test_closing_a_wire_again_does_what_ctrl_c_has_kept_it_from() -> None:
    before, at, came = descriptors(), 1, True
    while came:
        wire = Segment(ports=1)
        came = interrupted(wire.close, at)
        wire.close()
        assert descriptors() <= before and wire.info.transmissions == 0, f"look {at}"
        at += 1
    assert at > 10


@pytest.mark.parametrize("look", [
    lambda path: calibration._rate(path, 500_000, None), lambda path: Port(path, "uart").rates(),
    lambda path: Port(path, "uart").rs485()], ids=["calibrate", "rates", "rs485"])
def test_ctrl_c_at_any_moment_of_a_look_at_a_port_leaves_it_to_the_next(wire: Segment, look: Callable[[str], object]) -> None:
    path, at = wire.port(), 1
    before = descriptors()
    while interrupted(lambda: look(path), at):
        assert descriptors() <= before, f"look {at}"
        at += 1
    assert at > 5


def test_ctrl_c_at_any_moment_of_the_opening_of_a_wire_leaves_nothing() -> None:
    """The last of them lies before its `with`."""
    at, made, came = 1, list[Segment](), True
    while came:
        with nothing_left_behind():
            came = interrupted(lambda: made.append(Segment(ports=1)), at)
            made.clear()
        at += 1
    assert at > 10


@pytest.mark.parametrize("use", [
    lambda wire: wire.port(), lambda wire: wire.attach(SIP1(5)), lambda wire: Line(wire.port(), SIP1(5), baudrate=500_000)],
    ids=["port", "card", "line"])
def test_a_wire_that_nobody_has_any_more_is_closed(use: Callable[[Segment], object]) -> None:
    """Who has its port or a card on it has the wire, too."""
    with nothing_left_behind():
        wire = Segment()
        used, gone = use(wire), weakref.ref(wire)
        del wire
        gc.collect()
        assert gone() is not None
        del used


@pytest.mark.parametrize("step", ["open", "start", "realtime"])
def test_ctrl_c_while_a_wire_is_opened_leaves_nothing(step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        for room in "segment", "host":
            patch.setattr(f"dpmaster.emulator.{room}.lib", Behind(f"dpm_segment_{step}"))
        Segment(realtime=Realtime(lock=False))


def test_ctrl_c_while_the_log_begins_is_what_is_raised(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise KeyboardInterrupt

    with Master(wire.port()) as master:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(threading.Thread, "start", start)
            master.operate()
        master.clear()  # goes on after that
        assert master.mode == Mode.CLEAR
    with pytest.raises(KeyboardInterrupt), Master(wire.port()) as master, monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", start)
        master.operate()
