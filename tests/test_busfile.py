# SPDX-License-Identifier: MIT
"""Bus files: what they make, every fault told with file, line and key before a port is opened, and ``dpmaster run``."""

from __future__ import annotations

import functools
import inspect
import io
import json
import logging
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from children import child
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from waiting import until

from dpmaster import ConfigurationError, Master, PortError, Station, StationState, cli
from dpmaster.busfile import BusFile
from dpmaster.calibration import Calibration
from dpmaster.cli.run import View, logged, numeral, picture
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1, GenericSlave
from dpmaster.gsd.station import GSDStation

GSD = """\
#Profibus_DP
GSD_Revision = 3
Vendor_Name = "Test"
Model_Name = "Valve island"
Ident_Number = 0x4321
500k_supp = 1
MaxTsdr_500k = 150
Freeze_Mode_supp = 1
Fail_Safe = 1
Modular_Station = 1
Max_Module = 4
Max_Input_Len = 16
Max_Output_Len = 16
Max_Data_Len = 32
User_Prm_Data_Len = 1
PrmText = 1
Text(0) = "hold"
Text(1) = "reset"
EndPrmText
ExtUserPrmData = 1 "On failure"
Bit(0) 0 0-1
Prm_Text_Ref = 1
EndExtUserPrmData
Ext_User_Prm_Data_Const(0) = 0x00
Ext_User_Prm_Data_Ref(0) = 1
Module = "8 valves" 0x20
1
EndModule
Module = "2 words in" 0x51
2
EndModule
"""

BUS = """\
# the pump room
[bus]
port = "PORT"
address = 2
output_watchdog = "off"

[bus.parameters]
max_retry_limit = 3

[[station]]
address = 5
name = "Pump"
drive = "v7"
configuration = "Basic data"

[[station]]
address = 7
name = "Valves"
gsd = "valve.gsd"
modules = ["8 valves", "2 words in"]
names = {"Out" = 1, "Level" = 2}
parameters = {"On failure" = "reset"}
watchdog = 0.5
freeze = true

[station.inputs]
"Tank" = {module = "Level", offset = 2, type = "int16", scale = 0.1, unit = "%"}

[station.outputs]
"Drain" = {module = "Out", offset = 0, type = "bool", bit = 4}

[[station]]
address = 9
ident_number = 0x1234
configuration = "13 23"
user_parameters = [1, 2]
max_tsdr = {500000 = 200}
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write the bus file, with a change, beside its GSD file."""

    def write(text: str = BUS, old: str = "", new: str = "") -> Path:
        assert old in text
        (tmp_path / "valve.gsd").write_text(GSD, encoding="ascii")
        path = tmp_path / "bus.toml"
        path.write_text(text.replace(old, new, 1) if old else text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def wire() -> Iterator[Segment]:
    """The stations of the file."""
    with Segment() as segment:
        segment.attach(SIP1(5))
        segment.attach(GenericSlave(7, 0x4321, [bytes.fromhex("20 51")], user_parameters=(0, 237), fail_safe=True, freeze=True))
        segment.attach(GenericSlave(9, 0x1234, [bytes.fromhex("13 23")], user_parameters=(0, 237)))
        yield segment


# ---- what a file makes


def test_a_file_makes_stations_and_bus_parameters(write: Callable[..., Path]) -> None:
    bus = BusFile.load(write())
    pump, valves, bare = bus.stations
    assert isinstance(pump, YaskawaV7) and pump.name == "Pump"
    assert (valves.address, valves.ident_number, valves.configuration) == (7, 0x4321, b"\x20\x51")
    assert valves.user_parameters == b"\x01" and valves.freeze and valves.fail_safe and valves.watchdog == 0.5
    assert (bare.name, bare.configuration, bare.user_parameters) == ("station 9", b"\x13\x23", b"\x01\x02")
    tank, drain = valves.signals.signal("Tank"), valves.signals.signal("Drain")
    assert (tank.direction, tank.offset, tank.unit) == ("inputs", 2, "%") and (drain.offset, drain.bit) == (0, 4)
    assert bus.port == "PORT" and bus.options == {"address": 2, "output_watchdog": None}
    assert bus.timing.parameters.max_retry_limit == 3
    assert bus.timing.parameters.max_tsdr == 200, "the slowest station's"
    assert bus.timing.parameters.tsl >= 215, "Tsl >= MaxTsdr + 15"


def test_from_file_runs_the_bus(write: Callable[..., Path], wire: Segment) -> None:
    with Master.from_file(write(), port=wire.port()) as master:
        master.operate()
        assert {station.state for station in master.stations} == {StationState.DATA}
        valves = master["Valves"]
        assert valves is master[7]
        assert valves["Level"].place.inputs.length == 4 and valves["Out"].outputs == b"\0"
        valves.wait_sent(valves.signals.commit({"Drain": True}), 5)
        assert valves["Out"].outputs == b"\x10"
        with pytest.raises(ConfigurationError, match="'Pumpe': no station has this name or address: there are 5 'Pump', 7 "):
            master["Pumpe"]


def test_parameters_changed_while_it_runs_wait_for_reparameterise(write: Callable[..., Path], wire: Segment) -> None:
    """Protocol page G.1: User_Prm_Data stands behind Ident_Number and Group_Ident in Set_Prm."""
    ear = os.open(wire.port(), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(ear)

    def heard() -> set[bytes]:
        octets = b""
        with suppress(BlockingIOError):
            while octets := octets + os.read(ear, 65536):
                pass
        return set(re.findall(rb"\x3d\x3e.{4}\x43\x21\x00(.)", octets, re.DOTALL))

    try:
        with Master.from_file(write(), port=wire.port()) as master:
            valves = master["Valves"]
            assert isinstance(valves, GSDStation)
            master.operate()
            assert heard() == {b"\x01"}
            valves.signals["Drain"] = True
            valves.parameters["On failure"] = "hold"
            with pytest.raises(ConfigurationError, match=r"hold.*reset"):
                valves.parameters["On failure"] = "keep"
            valves.wait(lambda frame: True, 5)
            assert heard() == set() and valves.state == StationState.DATA
            valves.reparameterise()
            assert heard() == {b"\x00"} and valves["Out"].outputs == b"\0", "anew, and with safe outputs"
    finally:
        os.close(ear)


def test_options_of_the_call_win(write: Callable[..., Path], wire: Segment) -> None:
    with Master.from_file(write(), port=wire.port(), address=3, output_watchdog=2.0) as master:
        assert (master.address, master.output_watchdog) == (3, 2.0)


def test_a_ring_has_room_for_the_hosts_lateness(write: Callable[..., Path]) -> None:
    bus = BusFile.load(write(BUS, "address = 2\n", "address = 2\nmasters = 2\nallowance = 0.001\n"))
    assert bus.options["ring"] is True
    assert bus.timing.parameters.tsl >= 200 + 15 + 500, "max Tsdr + 15 + 1 ms of 500 kbit/s"


# ---- faults

FAULTS = [  # what is changed, and the beginning of what is said of it: line and key
    ('port = "PORT"', 'prt = "PORT"', r":3: bus\.prt: no such key: did you mean port\?"),
    ("address = 2", "address = 126", r":4: bus\.address: the master's address 126: 0 to 125"),
    ("address = 2", "address = 2\nbaudrate = 400000", r":5: bus\.baudrate: baudrate 400000: .* 500000"),
    ('output_watchdog = "off"', "output_watchdog = 0", r":5: bus\.output_watchdog: output_watchdog 0 s: above 0"),
    ('output_watchdog = "off"', 'echo = "yes"', r":5: bus\.echo: 'yes': true or false"),
    ('output_watchdog = "off"', "realtime = {priority = 100}", r":5: bus\.realtime: priority 100: 1 to 99"),
    ('output_watchdog = "off"', "realtime = 3", r":5: bus\.realtime: realtime 3: a Realtime, True"),
    ('output_watchdog = "off"', "realtime = {prio = 9}", r":5: bus\.realtime\.prio: no such key: did you mean priority\?"),
    ('output_watchdog = "off"', 'direction = "rts"', r":5: bus\.direction: direction 'rts': 'rs485' or "),
    ('output_watchdog = "off"', "max_stations = 2", r":5: bus\.max_stations: 2: the file has 3 stations"),
    ('output_watchdog = "off"', 'profile = ""', r":5: bus\.profile: profile '': one of uart"),
    ("max_retry_limit = 3", "max_retries = 3", r":8: bus\.parameters\.max_retries: .*mean max_retry_limit\?"),
    ('drive = "v7"', 'drive = "v8"', r":13: station\[1\]\.drive: 'v8': one of v7"),
    ('drive = "v7"', "", r":10: station\[1\]: a station needs one of gsd, drive and ident_number, and has none"),
    ('configuration = "Basic data"', 'configuration = "Basic"', r":14: station\[1\]\.configuration: configuration 'Basic'"),
    ('drive = "v7"', 'drive = "v7"\nresume = "hold"', r":14: station\[1\]\.resume: no such key: known are active, address, "),
    ('name = "Valves"', 'name = "Pump"', r":18: station\[2\]\.name: 'Pump' is that of station\[1\] already"),
    ("freeze = true", "encoding = 3", r":24: station\[2\]\.encoding: 3: a text in quotes"),
    ("freeze = true", "alarms = true", r":24: station\[2\]\.alarms: alarms True: give a list of names"),
    ("freeze = true", 'alarms = ["x"]', r":24: station\[2\]\.alarms: alarms: .* has no 'x': it has none"),
    ("freeze = true", "dpv1 = 3", r":24: station\[2\]\.dpv1: dpv1 3: True, False"),
    ('{"Out" = 1, "Level" = 2}', '["Out"]', r":21: station\[2\]\.names: names \['Out'\]: give a mapping, like "),
    ("address = 7", "address = 5", r":17: station\[2\]\.address: 5 is that of station\[1\] already"),
    ("address = 7", "address = 2", r":4: bus\.address: address 2 is there twice"),
    ("address = 7", "adress = 7", r":17: station\[2\]\.adress: no such key: did you mean address\?"),
    ("valve.gsd", "valves.gsd", r":19: station\[2\]\.gsd: .*valves\.gsd.*: No such file"),
    ('"8 valves", ', '"9 valves", ', r":20: station\[2\]\.modules: .*'9 valves'"),
    ('"Level" = 2', '"Level" = 3', r":21: station\[2\]\.names: .*'Level' is for slot 3, which has no module"),
    ('{"On failure" = "reset"}', '{"On failure" = "keep"}', r":22: station\[2\]\.parameters\.On failure: .*hold.*reset"),
    ("watchdog = 0.5", "watchdog = 700", r":23: station\[2\]\.watchdog: watchdog 700 s"),
    ("freeze = true", "sync = true", r":24: station\[2\]\.sync: sync=True: .*can not"),
    ('module = "Level"', 'module = "Livel"', r":27: station\[2\]\.inputs\.Tank\.module: .*no module 'Livel'"),
    ('module = "Level"', "module = []", r":27: station\[2\]\.inputs\.Tank\.module: .*no module \[\]"),
    ("offset = 2", "offset = 3", r":27: station\[2\]\.inputs\.Tank: 'Tank': Valves has 4 octets of inputs"),
    ("scale = 0.1", "scal = 0.1", r":27: station\[2\]\.inputs\.Tank\.scal: no such key: did you mean scale"),
    ("bit = 4", "bit = 8", r":30: station\[2\]\.outputs\.Drain: bit of 'Drain' 8: 0 to 7"),
    ("address = 9\n", "", r":32: station\[3\]: it has no address: add address = N"),
    ('"13 23"', '"13 2G"', r":35: station\[3\]\.configuration: '13 2G': octets in hexadecimal"),
    ("[1, 2]", "[1, 256]", r":36: station\[3\]\.user_parameters: user_parameters \[1, 256\]"),
    ("200}", "2000}", r":37: station\[3\]\.max_tsdr: max_tsdr at 500000 bit/s 2000: 37 to 1023"),
    ("[[station]]\naddress = 9", "[station.x]\naddress = 9", r":32: station\[2\]\.x: no such key"),
    ("# the pump room", "pumps = 1", r":1: pumps: no such key: known are bus, station"),
    ("address = 2", "address = ", r":4: Invalid value: this is no TOML"),
    ("address = 2", "address = " + 5000 * "[", r":\d+: .*: this is no TOML"),
    ("address = 2", "address = " + 5000 * "9", r":\d+: .*: this is no TOML"),
]


@pytest.mark.parametrize(("old", "new", "said"), FAULTS, ids=lambda text: re.sub(r"\W+", " ", text)[:40])
def test_a_fault_is_told_with_file_line_and_key(write: Callable[..., Path], old: str, new: str, said: str) -> None:
    path = write(BUS, old, new)
    with pytest.raises(ConfigurationError) as raised:
        Master.from_file(path)  # there is no such port: it was not opened
    assert re.search(rf"^{re.escape(str(path))}{said}", str(raised.value), flags=re.MULTILINE), raised.value


def test_all_faults_are_told_at_once(write: Callable[..., Path]) -> None:
    text = BUS.replace("address = 2", "adress = 2").replace("watchdog = 0.5", "watchdog = 700").replace("13 23", "XX")
    with pytest.raises(ConfigurationError) as raised:
        BusFile.load(write(text))
    assert [int(line.split(":")[1]) for line in str(raised.value).splitlines()] == [4, 23, 35]


def test_lines_are_right_behind_values_of_several_lines(write: Callable[..., Path]) -> None:
    text = BUS.replace('["8 valves", "2 words in"]', '[\n  "8 valves", # first\n\n  "2 words in",\n]')
    with pytest.raises(ConfigurationError, match=r":20: station\[2\]\.modules: "):
        BusFile.load(write(text, "2 words in", "2 words out"))
    with pytest.raises(ConfigurationError, match=r":26: station\[2\]\.parameters\.On failure: "):
        BusFile.load(write(text, '"reset"', '"other"'))


def test_lines_are_right_behind_texts_with_odd_characters(write: Callable[..., Path]) -> None:
    text = BUS.replace("the pump room", "the pump\u2028room").replace('"Pump"', '"Pu\x85mp"').replace('"%"', '"""\n%\n[x]\n"""')
    with pytest.raises(ConfigurationError, match=r":33: station\[2\]\.outputs\.Drain: bit of 'Drain' 8"):
        BusFile.load(write(text, "bit = 4", "bit = 8"))


def test_faults_of_a_long_file_are_found_fast(write: Callable[..., Path]) -> None:
    station = "[[station]]\naddress = {0}\nident_number = 1\nconfiguration = \"10\"\n[station.inputs]\nx = {{offset = 1}}\n"
    text = "".join(station.format(address) for address in range(2, 126))
    begin = time.process_time()
    with pytest.raises(ConfigurationError) as raised:
        BusFile.load(write(text))
    assert [int(line.split(":")[1]) for line in str(raised.value).splitlines()] == list(range(6, 6 * 125, 6))
    assert time.process_time() - begin < 2, "a parse of the file for each line of it took minutes"


def toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{toml(key)} = {toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value).replace("\x7f", "\\u007f")


KEYS = sorted({*re.findall(r"\w+", BUS), *inspect.signature(Master).parameters, *inspect.signature(Station).parameters, "gsd",
               "encoding", "alarms", "dpv1", "masters", "repeaters", "length", "others"})
VALUES = st.recursive(
    st.booleans() | st.integers(-2, 300) | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=5) | st.sampled_from(KEYS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=3), max_leaves=6)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.sampled_from([(), ("bus",), ("bus", "parameters"), ("station", 0), ("station", 1), ("station", 2),
                              ("station", 1, "inputs", "Tank")]), key=st.sampled_from(KEYS), value=VALUES)
def test_any_file_gives_a_bus_or_faults(write: Callable[..., Path], where: tuple[str | int, ...], key: str, value: Any) -> None:
    tables = tomllib.loads(BUS)
    functools.reduce(lambda table, part: table[part], where, tables)[key] = value
    path = write("\n".join(f"{name} = {toml(table)}" for name, table in tables.items()))
    try:
        BusFile.load(path)
    except ConfigurationError as error:
        assert all(line.startswith(f"{path}:") for line in str(error).splitlines()), "each fault in a line, with its place"


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml: No such file or directory: give the path of a bus file"):
        BusFile.load(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b'[bus]\nport = "\xe4"\n')
    with pytest.raises(ConfigurationError, match=r"octet 14 is no UTF-8.*: save it as UTF-8"):
        BusFile.load(tmp_path / "latin.toml")


def test_a_bus_that_cannot_work_is_a_fault(write: Callable[..., Path]) -> None:
    with pytest.raises(ConfigurationError, match=r":2: bus: .*Tsl"):
        BusFile.load(write(BUS, "max_retry_limit = 3", "tsl = 100"))


def test_no_port(write: Callable[..., Path]) -> None:
    bus = BusFile.load(write(BUS, 'port = "PORT"\n'))
    with pytest.raises(ConfigurationError, match=r"\[bus\] has no port: add port = "):
        bus.master()
    with pytest.raises(PortError, match="no/such/port"):
        BusFile.load(write()).master("/no/such/port")


# ---- dpmaster run


def test_run_shows_the_stations(write: Callable[..., Path], wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", str(write()), "--port", wire.port(), "--seconds", "1.2", "--set", "Valves.Drain=on"]) == 0
    out = capsys.readouterr().out
    assert re.search(r", 500 kbit/s, Operate: cycle \d+", out)
    assert re.search(r"   5  Pump +exchange\n      in  .*\n      out 00 00 00 00 00 00\n", out)
    assert re.search(r"   7  Valves +exchange\n      Tank 0 %   Drain on\n", out)


def test_run_as_json(write: Callable[..., Path], wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", str(write()), "--port", wire.port(), "--seconds", "0.1", "--json"]) == 0
    seen = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert seen["mode"] == "operate" and [s["address"] for s in seen["stations"]] == [5, 7, 9]
    assert seen["stations"][1]["signals"] == {"Tank": 0.0, "Drain": False}


def test_run_tells_of_diagnosis_in_the_makers_words(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    path = write()
    path.with_name("valve.gsd").write_text(GSD + 'Unit_Diag_Bit(3) = "Coil 4 burnt"\n', encoding="ascii")
    with Segment() as wire:
        valves = GenericSlave(7, 0x4321, [bytes.fromhex("20 51")], user_parameters=(0, 237), fail_safe=True, freeze=True)
        valves.diagnosis(bytes((0x02, 0x08)))
        for card in (SIP1(5), valves, GenericSlave(9, 0x1234, [bytes.fromhex("13 23")], user_parameters=(0, 237))):
            wire.attach(card)
        bus = BusFile.load(path)
        with bus.master(wire.port()) as master:
            master.operate()
            assert "      diagnosis: device diagnosis: Coil 4 burnt" in picture(master, 100, math.inf)
            assert "watchdog" not in "".join(picture(master, 100, math.inf)), "no trouble"
            assert [line[:14] for line in picture(master, 100, 4)[1:]] == ["   7  Valves  ", "   5  Pump    ", "   9  station "]
            assert picture(master, 100, 3)[1:] == [line for line in picture(master, 100, 4) if "Valves" in line] + [
                "... and 2 more stations"], "those with something to tell come first"
            assert all(len(line) <= 40 for line in picture(master, 40, math.inf))
        assert cli.main(["run", str(path), "--port", wire.port(), "--seconds", "0.1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])["stations"][1]["diagnosis"]
    assert "ext_diag" in told["flags"] and told["octets"].endswith("43210208")
    assert told["texts"][-1] == "device diagnosis: Coil 4 burnt"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_what_is_logged_stays_above_the_picture(write: Callable[..., Path], wire: Segment,
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Master.from_file(write(), port=wire.port()) as master:
        master.operate()
        terminal = Terminal()
        view = View(terminal, as_json=False)
        with logged(view):
            view.show(master)
            height = view.height
            logging.getLogger("dpmaster.master").warning("%s is gone", "Pump\x1b[2J")
            view.show(master)
            seen = terminal.getvalue()
            assert re.search(rf"\x1b\[{height}A\r\x1b\[J\r\d\d:\d\d:\d\d Pump\?\[2J is gone\x1b\[K\n\r/dev/pts/", seen), seen
            height = view.height  # a greater number may have wrapped a line
            view.show(master)
            assert re.search(rf"\x1b\[{height}A\r/dev/pts/", terminal.getvalue()[len(seen) :]), "once, and then it stays"
            monkeypatch.setattr(shutil, "get_terminal_size", lambda: os.terminal_size((40, 9)))
            view.show(master)
            assert "\x1b[H\x1b[2J" in terminal.getvalue(), "the terminal wrapped what was there: begin anew"


def test_run_goes_on_when_the_port_comes_back(write: Callable[..., Path], tmp_path: Path) -> None:
    """The adapter is pulled out and plugged in again; --set is given anew to what came back with zeros."""
    link = tmp_path / "port"

    def until_drained() -> None:
        with Segment() as segment:
            valves = segment.attach(GenericSlave(7, 0x4321, [bytes.fromhex("20 51")], user_parameters=(0, 237),
                                                 fail_safe=True, freeze=True))
            link.unlink(missing_ok=True)
            link.symlink_to(segment.port())
            if not running:
                running.append(stack.enter_context(child(*program, stdout=subprocess.DEVNULL)))
            until(lambda valves=valves: valves.outputs == b"\x10")

    text = BUS[: BUS.index("[[station]]")] + BUS[BUS.index("[[station]]\naddress = 7") : BUS.index("[[station]]\naddress = 9")]
    path = write(text, 'port = "PORT"', f'port = "{link}"')
    program = ["-m", "dpmaster", "run", str(path), "--set", "Valves.Drain=on"]
    running: list[subprocess.Popen[str]] = []
    with ExitStack() as stack:
        until_drained()
        until_drained()
        running[0].send_signal(signal.SIGINT)
        _, said = running[0].communicate(timeout=20)
    assert running[0].returncode == 0 and "Traceback" not in said
    assert re.search(r"port: the port vanished\n(.*\n)*.*port works\n(.*\n)*.* Valves exchanges\n", said), said


def test_run_goes_on_without_a_station(write: Callable[..., Path], capsys: pytest.CaptureFixture[str],
                                       monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dpmaster.cli.run.START", 0.8)
    with Segment() as wire:
        wire.attach(SIP1(5))
        assert cli.main(["run", str(write()), "--port", wire.port(), "--seconds", "0.1"]) == 0
        said = capsys.readouterr()
        assert "going on without some stations: 2 of 3" in said.err
        assert re.search("7  Valves +OFFLINE: does not answer", said.out)
        assert cli.main(["run", str(write(BUS, "address = 2", "address = 2\nauto_clear = true")), "--port", wire.port()]) == 1
        assert "2 of 3" in capsys.readouterr().err, "with auto_clear it is all of them or none"
    with Segment() as nobody:
        assert cli.main(["run", str(write()), "--port", nobody.port(), "--seconds", "0.1"]) == 1


def test_run_shows_who_is_awaited(write: Callable[..., Path], capsys: pytest.CaptureFixture[str],
                                  monkeypatch: pytest.MonkeyPatch) -> None:
    """While it waits: the reader that has seen it leaves, and the rest comes from who waited."""
    class Reader(io.StringIO):
        def write(self, text: str) -> int:
            if re.search(r", Clear: (.*\n)* +5  Pump +exchange\n(.*\n)* +7  Valves +OFFLINE: does not answer", text):
                seen.append(text)
                wire.attach(GenericSlave(7, 0x4321, [bytes.fromhex("20 51")], user_parameters=(0, 237), fail_safe=True,
                                         freeze=True))
                wire.attach(GenericSlave(9, 0x1234, [bytes.fromhex("13 23")], user_parameters=(0, 237)))
                raise BrokenPipeError
            return len(text)

    seen: list[str] = []
    monkeypatch.setattr("dpmaster.cli.run.LINE", 0.05)
    monkeypatch.setattr("dpmaster.cli.run.START", 60.0)
    with Segment() as wire:
        wire.attach(SIP1(5))
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", Reader())
            assert cli.main(["run", str(write()), "--port", wire.port(), "--seconds", "0.1"]) == 0
    assert len(seen) == 1 and "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(("value", "words"), [
    ("Valves.Drain", "write STATION.SIGNAL=VALUE"), ("Tanks.Drain=on", "the stations are Pump, Valves, station 9"),
    ("Valves.Drain=2", "Drain takes on or off"), ("Valves.Tank=2", "is an input"), ("7.Drein=on", "no signal 'Drein'")])
def test_values_are_checked_before_the_port_is_opened(write: Callable[..., Path], capsys: pytest.CaptureFixture[str],
                                                      value: str, words: str) -> None:
    assert cli.main(["run", str(write()), "--set", value]) == 2
    assert words in capsys.readouterr().err


def test_whole_numbers_are_taken_exactly() -> None:
    texts = ("0xFFFFFFFFFFFFFFFF", "9007199254740993", "1e3", "0.5")
    assert list(map(numeral, texts)) == [2**64 - 1, 2**53 + 1, 1000, 0.5]


def test_check_only(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", str(write()), "--check"]) == 0
    assert re.search(r"7  Valves +ident 4321h, 4 octets in, 1 out\n", capsys.readouterr().out)
    assert cli.main(["run", str(write(BUS, "address = 7", "address = 5")), "--check"]) == 2
    assert "station[2].address" in capsys.readouterr().err


def test_ctrl_c_ends_it_well(write: Callable[..., Path], wire: Segment) -> None:
    with child("-m", "dpmaster", "run", str(write()), "--port", wire.port(), "--json") as run:
        run.stdout.readline()
        run.send_signal(2)
        assert run.wait(10) == 0
        assert "Traceback" not in run.stderr.read()


# ---- what other commands make of it


def test_timing_of_a_bus_file(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["timing", "--file", str(write()), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["address"] for entry in found["cycle"]["exchanges"]] == [5, 7, 9]
    assert found["parameters"]["max_tsdr"] == 200
    assert cli.main(["timing", "--file", str(write(BUS, "max_retry_limit = 3", "tsl = 100"))]) == 1
    assert "WILL NOT WORK: " in capsys.readouterr().out


def test_timing_takes_a_file_or_options(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["timing", "--file", str(write()), "--baudrate", "500000", "--station", "3:1/1", "--min-tsdr", "11"]) == 2
    assert "and --baudrate, --station, --min-tsdr: the file says all of the bus; change it there" in capsys.readouterr().err


def test_a_station_of_gsd_config_can_be_pasted(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    path = write()
    gsd = path.with_name("valve.gsd")
    chosen = ["--module", "8 valves", "--parameter", "On failure=reset"]
    assert cli.main(["gsd", "config", str(gsd), "--address", "11", *chosen]) == 0
    with path.open("a", encoding="utf-8") as file:
        file.write("\n" + capsys.readouterr().out)
    station = BusFile.load(path).stations[-1]
    assert (station.address, station.configuration, station.user_parameters) == (11, b"\x20", b"\x01")


def test_masters_that_share_a_bus_are_a_ring(write: Callable[..., Path]) -> None:
    with pytest.raises(ConfigurationError, match=r":6: bus\.ring: false, and 2 masters on the bus share a token"):
        BusFile.load(write(BUS, "address = 2\n", "address = 2\nmasters = 2\nring = false\nallowance = 0.001\n"))


def test_what_was_measured_is_the_allowance(write: Callable[..., Path]) -> None:
    path = write(BUS, "address = 2\n", 'address = 2\nmasters = 2\ncalibration = "found.json"\n')
    with pytest.raises(ConfigurationError, match=r":6: bus\.calibration: found\.json: No such file .*calibrate PORT --output"):
        BusFile.load(path)
    Calibration("PORT", 500_000, "echo", 300, 1e-4, 2e-4, 3e-4, 0.0009, None, "here").save(path.with_name("found.json"))
    bus = BusFile.load(path)
    assert bus.options["allowance"] == 0.0009
    assert bus.timing.parameters.tsl >= 200 + 15 + 450, "max Tsdr + 15 + 0.9 ms of 500 kbit/s"
    path.with_name("found.json").write_text("[]")
    with pytest.raises(ConfigurationError, match=r":6: bus\.calibration: .*give a file that"):
        BusFile.load(path)


@pytest.mark.tree
def test_the_example_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(__file__).parent.parent / "docs" / "busfile.md").read_text()
    file, program = (re.search(rf"```{language}\n(.*?)```", page, re.DOTALL)[1] for language in ("toml", "python"))  # type: ignore[index]
    monkeypatch.chdir(tmp_path)
    Path("valves.gsd").write_text(GSD, encoding="ascii")
    with Segment() as wire:
        wire.attach(SIP1(5))
        valves = wire.attach(GenericSlave(7, 0x4321, [bytes.fromhex("20 51")], user_parameters=(0, 237), fail_safe=True))
        wire.attach(GenericSlave(9, 0x1234, [bytes.fromhex("13 23")]))
        valves.inputs = bytes.fromhex("0000 0177")
        Path("bus.toml").write_text(file.replace("/dev/ttyAMA0", wire.port()), encoding="utf-8")
        exec(program, {"Master": Master})
    assert capsys.readouterr().out == "37.5\nb'\\x00\\x00\\x01w'\n"
