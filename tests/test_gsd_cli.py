# SPDX-License-Identifier: MIT
"""``dpmaster gsd``: what it shows, what it finds and its exit code, and the station it prints for a bus file."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from gsd_files import NAMES, needs_files, path
from test_gsd_configuration import RACK

from dpmaster import cli
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import GenericSlave
from dpmaster.gsd import GSD, devices


class Person(io.StringIO):
    """Somebody at a terminal, with these answers."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def rack(tmp_path: Path) -> str:
    file = tmp_path / 'rack "1".gsd'
    file.write_text(RACK)
    return str(file)


def station(text: str) -> dict[str, object]:
    (found,) = tomllib.loads(text)["station"]
    assert isinstance(found, dict)
    return found


def test_show_is_readable(rack: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["gsd", "show", rack, "--module", "both"]) == 0
    text = capsys.readouterr().out
    for part in ("Test Rack\n", "4242h", "9.6k, 500k, 12M", "freeze, fail safe", "slave interval 2 ms", "Modules (4)",
                 "  3 Both   7 in, 6 out     72 10", '  Redundancy mode = "on"  ("off" (0), "on" (1))',
                 "  Filter = 2  (0, 2, 5 to 6)",
                 "Parameters of 'Both'", "Fixed = 7  (not changeable)", "1 warning in this file: dpmaster gsd check"):
        assert part in text
    assert max(map(len, text.splitlines())) <= 130


@needs_files
def test_show_names_only_the_first_modules_unless_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["gsd", "show", str(path("B756_P33.GSD"))]) == 0
    few = capsys.readouterr().out
    assert "and 1275 more: --modules" in few
    assert cli.main(["gsd", "show", "--modules", str(path("B756_P33.GSD"))]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(few.splitlines()) + 1274


@needs_files
@pytest.mark.parametrize("name", NAMES[::10])
def test_show_as_json_has_everything(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["gsd", "show", "--json", str(path(name))]) == 0
    found = json.loads(capsys.readouterr().out)
    gsd = GSD.load(path(name))
    assert (found["model"], found["ident_number"], len(found["modules"])) == (gsd.model, gsd.ident_number, len(gsd.modules))
    assert [bytes.fromhex(module["configuration"]) for module in found["modules"]] == [m.configuration for m in gsd.modules]
    assert len(found["parameters"]) == len(gsd.parameters) and len(found["findings"]) == len(gsd.findings)


@pytest.mark.parametrize(("text", "options", "code", "line"), [
    ("", [], 0, ""), ("Foo = 1", [], 0, ":{n}:1: note: Foo"), ("Foo = 1", ["--quiet"], 0, ""),
    ("24V Pins = 1", [], 0, ":{n}:1: warning: 24V Pins"), ("24V Pins = 1", ["--strict"], 1, ":{n}:1: warning"),
    ("  Diag_Update_Delay = x", [], 1, ":{n}:3: error: Diag_Update_Delay"),
])
def test_check_is_a_compilers(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, options: list[str], code: int,
                              line: str) -> None:
    good = RACK.replace("MaxTsdr_12M = 5000\n", "")
    file = tmp_path / "x.gsd"
    file.write_text(good + text)
    assert cli.main(["gsd", "check", *options, str(file)]) == code
    found = capsys.readouterr().out
    assert found.startswith(f"{file}{line.format(n=good.count(chr(10)) + 1)}") if line else found == ""


def test_check_goes_on_behind_a_file_that_is_not_there(rack: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["gsd", "check", str(tmp_path / "none.gsd"), rack]) == 1
    out, err = capsys.readouterr()
    assert "none.gsd" in err and "Traceback" not in err and "MaxTsdr 5000" in out


def test_config_prints_a_station_ready_to_paste(rack: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["gsd", "config", rack, "--address", "7", "--module", "Both", "--module", "3=out 2", "--parameter",
                     "Redundancy mode = off", "--parameter", "1:Wide=200", "--parameter", "3:Channel#2=1"]) == 0
    text = capsys.readouterr().out
    assert "#   slot 1, Both: inputs 0 to 6, outputs 0 to 5\n#   slot 2, (empty slot): no data\n" in text
    found = station(text)
    assert found == {"address": 7, "gsd": rack, "modules": ["Both", [3, "Out 2"]],
                     "parameters": {"Redundancy mode": "off", "1": {"Wide": 200}, "3": {"Channel#2": 1}}}
    again = GSD.load(rack).configure(found["modules"], found["parameters"])  # type: ignore[arg-type]
    assert again.user_parameters.hex(" ") == "a7 81 ff fb 0c 80 07 10 f2"


def test_config_writes_every_parameter_in_tables_when_asked(rack: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["gsd", "config", rack, "--address", "7", "--module", "3", "2", "--all"]) == 0
    text = capsys.readouterr().out
    assert "[station.parameters]" in text and '[station.parameters."1"]' in text
    assert station(text)["parameters"] == {
        "Redundancy mode": "on", "Filter": 2, "Limit": -5, "1": {"Wide": 0, "Fixed": 7}, "2": {"Channel#1": 0, "Channel#2": 0}}


def test_config_asks_a_person(rack: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    answers = "7\nnonsense\nOut 2\n3\n\nFilter=9\nFilter=5\n\n"
    monkeypatch.setattr("sys.stdin", Person(answers))
    assert cli.main(["gsd", "config", rack]) == 0
    out, err = capsys.readouterr()
    assert station(out) == {"address": 7, "gsd": rack, "modules": ["Out 2", "Both"], "parameters": {"Filter": 5}}
    assert "no module 'nonsense'" in err and "'Filter' = '9': 0, 2, 5 to 6" in err


def test_config_asks_for_no_more_modules_than_there_can_be(capsys: pytest.CaptureFixture[str],
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    """YASK0ACF.GSD, Max_Module 1: the answer behind the module is the one about parameters."""
    monkeypatch.setattr("sys.stdin", Person("7\nPPO Type 2\n\n"))
    assert cli.main(["gsd", "config", str(devices.path("si-p3"))]) == 0
    out, err = capsys.readouterr()
    assert station(out)["modules"] == ["PPO Type 2"] and err.count("Module for the next slot") == 1


@pytest.mark.parametrize(("arguments", "text"), [
    ([], "--address is missing"), (["--address", "126"], "0 to 125"), (["--address", "1", "--module", "x"], "no module 'x'"),
    (["--address", "1", "--parameter", "Filter"], "NAME=VALUE"), (["--address", "1", "--encoding", "cp9"], "encoding 'cp9'"),
    (["--address", "1", "--parameter", "Filter=1"], "0, 2, 5 to 6"),
    (["--address", "1", "--parameter", "9:Filter=1"], "no module 9"),
])
def test_config_refuses_in_one_line(rack: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
                                    arguments: list[str], text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main(["gsd", "config", rack, *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and text in err and err.count("\n") == 1


def test_a_person_who_leaves_ends_it(rack: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", Person("7\n"))
    assert cli.main(["gsd", "config", rack]) == 2
    assert "the answers end too early" in capsys.readouterr().err


@needs_files
@pytest.mark.parametrize("name", NAMES[::3])
def test_what_config_prints_configures_the_same_station(name: str, capsys: pytest.CaptureFixture[str],
                                                        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main(["gsd", "config", str(path(name)), "--address", "3", "--all"]) == 0
    found = station(capsys.readouterr().out)
    gsd = GSD.load(found["gsd"])  # type: ignore[arg-type]
    default, again = gsd.configure(), gsd.configure(found["modules"], found.get("parameters"))  # type: ignore[arg-type]
    assert (again.octets, again.user_parameters) == (default.octets, default.user_parameters)


def test_a_makers_text_is_no_order_to_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "evil.gsd"
    file.write_bytes(b'#Profibus_DP\nVendor_Name="Ev\x1b[2Jil"\nIdent_Number=1\nModule="a\x07\x85b" 0x10\nEndModule\n')
    for command in (["show"], ["check"], ["config", "--address", "3"]):
        cli.main(["gsd", *command, str(file), "--encoding", "latin-1"])
        text = capsys.readouterr().out
        assert not set(text) & set(map(chr, (*range(10), *range(11, 32), *range(127, 160)))), command
    pasted = station(text)
    assert pasted["modules"] == ["a\x07\x85b"] and pasted["encoding"] == "latin-1", "and what is pasted names the module"


def test_a_terminal_without_the_characters(tmp_path: Path) -> None:
    file = tmp_path / "umlaut.gsd"
    file.write_bytes(b'#Profibus_DP\nVendor_Name="M\xfcller"\nIdent_Number=1\n')
    shown = subprocess.run([sys.executable, "-m", "dpmaster", "gsd", "show", str(file)], capture_output=True, check=True,
                           env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert shown.stdout.startswith(b"M\\xfcller\n")


def test_diag_uses_the_makers_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Unit_Diag_Bit(0) is the least significant bit behind the block's header; page M: peers lose it."""
    file, other = tmp_path / "valve.gsd", tmp_path / "other.gsd"
    file.write_text('#Profibus_DP\nIdent_Number = 0x4321\nUnit_Diag_Bit(0) = "Coil 1 burnt"\n', encoding="ascii")
    other.write_text('#Profibus_DP\nIdent_Number = 0x4322\nUnit_Diag_Bit(0) = "Door open"\n', encoding="ascii")
    with Segment() as wire:
        valve = wire.attach(GenericSlave(7, 0x4321, [b"\x20"]))
        valve.diagnosis(bytes((0x02, 0x01)))
        for given, words in (([], "device diagnosis: 01"), (["--gsd", str(file)], "device diagnosis: Coil 1 burnt"),
                             (["--gsd", str(other)], "device diagnosis: 01")):
            assert cli.main(["diag", wire.port(), "7", *given]) == 0
            assert words in capsys.readouterr().out
        assert cli.main(["diag", wire.port(), "7", "--gsd", str(other)]) == 0
        assert "is that of another device, ident 4322h" in capsys.readouterr().err
        assert cli.main(["diag", "/no/such/port", "7", "--gsd", str(tmp_path / "none.gsd")]) == 2
