# SPDX-License-Identifier: MIT
"""``dpmaster drive`` as a person runs it: against emulated cards on a segment, on a terminal and in a pipe, to its end and to
Ctrl-C. The card's own history tells what it was told."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import signal
import struct
import termios
from collections.abc import Iterator

import pytest
from children import child
from test_demo import read_until
from test_safety import Witness
from waiting import until

from dpmaster.cli import main
from dpmaster.emulator import Card, Segment, SlaveState
from dpmaster.emulator.cards import SIP3

PATIENCE = 30.0


class Bench:
    def __init__(self, card: Card, profile: str, *options: str) -> None:
        self.wire = Segment(ports=1, cards=1)
        self.card = self.wire.attach(card)
        self.port = self.wire.port()
        self.arguments = ["drive", str(self.port), "--address", str(card.address), "--profile", profile,
                          "--allowance", "100", *options]  # a busy computer shall not lose the drive

    def command(self, *action: str) -> list[str]:
        return ["-m", "dpmaster", *self.arguments, *action]

    def main(self, *action: str) -> int:
        return main([*self.arguments, *action])


@pytest.fixture
def v7() -> Iterator[Bench]:
    bench = Bench(Witness(), "v7")
    with bench.wire:
        yield bench


Capture = pytest.CaptureFixture[str]


def test_status_is_readable_and_json(v7: Bench, capsys: Capture) -> None:
    assert v7.main("status") == 0
    out = capsys.readouterr().out
    assert re.search(r"^state +zero speed, ready, remote$", out, flags=re.MULTILINE)
    assert "0.00 Hz (100 % is 60.00 Hz)" in out and "YaskawaV7 at address 5, Extended Data 1" in out
    assert v7.main("status", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    # The master left the bus in between, which to the drive is a loss.
    assert (found["fault"], found["faults"], found["ready"], found["highest_frequency"]) == (True, ["fault"], False, 60.0)
    assert found["status"]["major_fault"] and found["diagnosis"].endswith("00ca")


def test_parameters_are_read_and_written_by_their_names(v7: Bench, capsys: Capture) -> None:
    assert v7.main("set", "n019=0x28", "n020=30") == 0
    assert re.search(r"n019 +40 +acceleration time from 0 to n011 \(0 to 6000\)", capsys.readouterr().out)
    assert (v7.card.registers["n019"], v7.card.registers["n020"]) == (40, 30)  # type: ignore[attr-defined]
    assert v7.main("get", "--json", "n019", "n003") == 0
    assert json.loads(capsys.readouterr().out) == {"n019": 40, "n003": 3}
    assert v7.main("get") == 0
    assert capsys.readouterr().out.count("\n") == 18  # every parameter that the table has


@pytest.mark.parametrize(("action", "code", "text"), [
    (["set", "n003=4"], 1, "error 21h"), (["set", "n019=70000"], 2, "70000 is no word"), (["get", "x1"], 2, "register 'x1'"),
    (["run", "--frequency", "61"], 2, "the limit is 60.0 Hz"), (["set", "--store", "n003=4"], 1, "error 21h"),
])
def test_what_goes_wrong_is_one_line_and_the_exit_code(v7: Bench, capsys: Capture, action: list[str], code: int,
                                                       text: str) -> None:
    assert v7.main(*action) == code
    err = capsys.readouterr().err
    assert err.startswith("dpmaster drive: ") and text in err and err.count("\n") == 1


@pytest.mark.parametrize("action", [["run"], ["run", "--frequency", "0"], ["run", "--frequency", "5", "--percent", "5"],
                                    ["run", "--frequency", "5", "--for", "5 parsec"], ["set", "n019"], ["set", "n019=nan"], []])
def test_wrong_arguments_leave_with_2(v7: Bench, action: list[str]) -> None:
    with pytest.raises(SystemExit) as left:
        v7.main(*action)
    assert left.value.code == 2


def test_run_for_a_time_then_the_ramp_down(v7: Bench, capsys: Capture) -> None:
    assert v7.main("run", "--percent", "20", "--reverse", "--for", "500ms", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["zero_speed"] and not found["running"] and found["seconds"] >= 0.5
    history = v7.card.history  # type: ignore[attr-defined]
    assert min(seen.frequency for seen in history) == -12.0
    # It stood before it was released: the ramp was the stop word's, not the fault's.
    assert all(seen.frequency == 0 for seen in history if seen.fault)


def test_a_drive_with_a_fault_is_not_started_unasked(v7: Bench, capsys: Capture) -> None:
    assert v7.main("stop") == 0
    assert v7.main("run", "--frequency", "10", "--for", "200ms") == 1
    assert "shows a fault; run --reset resets it first" in capsys.readouterr().err
    assert not any(seen.commanded for seen in v7.card.history)  # type: ignore[attr-defined]
    assert v7.main("reset") == 0
    assert v7.main("run", "--frequency", "10", "--for", "200ms", "--reset") == 0
    assert any(seen.frequency == 10.0 for seen in v7.card.history)  # type: ignore[attr-defined]


def ends_well(v7: Bench) -> None:
    """It stood, told to stop, while the exchange went on; only then was it released."""
    history = v7.card.history  # type: ignore[attr-defined]
    ran = max(index for index, seen in enumerate(history) if seen.commanded)
    after = history[ran + 1:]
    still = next(index for index, seen in enumerate(after) if seen.frequency == 0)
    assert all(seen.exchange.state is SlaveState.DATA_EXCH and seen.exchange.valid for seen in after[:still])


@pytest.mark.parametrize(("number", "seconds", "code"), [
    (signal.SIGINT, [], 0), (signal.SIGTERM, [], 0), (signal.SIGINT, ["--for", "1h"], 130),
    (signal.SIGTERM, ["--for", "1h"], 143)])
def test_a_signal_stops_the_drive_before_it_is_left(v7: Bench, number: signal.Signals, seconds: list[str], code: int) -> None:
    """Without --for, Ctrl-C is how it is meant to end."""
    near, far = pty.openpty()
    fcntl.ioctl(far, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    with child(*v7.command("run", "--frequency", "30", *seconds), stdout=far, text=False) as process:
        os.close(far)
        try:
            text = read_until(near, r"30\.00 Hz .*at speed", PATIENCE)
            process.send_signal(number)
            text += read_until(near, r"stands +after", PATIENCE)
            assert process.wait(PATIENCE) == code
            assert max(len(line) for line in re.split(r"[\r\n]+", text)) < 80
            assert process.stderr.read() == b""
        finally:
            os.close(near)
    ends_well(v7)


def test_a_second_ctrl_c_leaves_at_once_with_the_stop_word_said(v7: Bench) -> None:
    v7.card.registers["n020"] = 6000  # type: ignore[attr-defined]
    with child(*v7.command("run", "--frequency", "30"), text=False) as process:
        read_until(process.stdout.fileno(), r"at speed", PATIENCE)
        process.send_signal(signal.SIGINT)
        read_until(process.stdout.fileno(), r"the ramp down", PATIENCE)
        until(lambda: not v7.card.history[-1].commanded)  # type: ignore[attr-defined]
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
    last = [seen for seen in v7.card.history if seen.exchange.valid][-1]  # type: ignore[attr-defined]
    assert not last.commanded and last.frequency > 0


def test_a_ramp_that_takes_too_long_is_told(v7: Bench, capsys: Capture) -> None:
    v7.card.registers["n020"] = 6000  # type: ignore[attr-defined]
    assert v7.main("run", "--frequency", "30", "--for", "500ms", "--stop-within", "300ms") == 1
    assert re.search(r"drive 5 turns still, 0\.3 s after its stop word .*--stop-within", capsys.readouterr().err)


def test_a_fault_while_it_runs_ends_it(v7: Bench) -> None:
    with child(*v7.command("run", "--frequency", "30"), text=False) as process:
        read_until(process.stdout.fileno(), r"running", PATIENCE)
        v7.card.inject("F21")  # type: ignore[attr-defined]
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert re.fullmatch(rb"dpmaster drive: drive 5 stopped by a fault: fault \(status: .*\)\n", err)




# ---- another drive, the same face


@pytest.fixture
def sip3() -> Iterator[Bench]:
    bench = Bench(SIP3(5, settings={"C1-01": 10, "C1-02": 10}), "si-p3", "--configuration", "PPO Type 2")
    with bench.wire:
        yield bench


def test_an_si_p3_shows_its_status_and_names_its_faults(sip3: Bench, capsys: Capture) -> None:
    assert sip3.main("status") == 0
    out = capsys.readouterr().out
    assert "YaskawaSIP3 at address 5, PPO Type 2" in out and "(100 % is 60.00 Hz)" in out
    assert re.search(r"^faults +none$", out, flags=re.MULTILINE) and "U1-06=" in out
    assert sip3.main("status", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["faults"] == ["bUS"] and found["status"]["percent"] == 0.0 and found["current"] == 0.0
    assert sip3.main("run", "--frequency", "10", "--for", "100ms") == 1
    assert "run --reset resets it first" in capsys.readouterr().err


def test_an_si_p3s_parameters_have_units_and_can_be_stored(sip3: Bench, capsys: Capture) -> None:
    assert sip3.main("set", "d1-17=7.5", "C1-01=2.5", "--store") == 0
    out = capsys.readouterr().out
    assert re.search(r"^d1-17 +7\.50 Hz +jog frequency reference \(0\.00 to 400\.00\)$", out, flags=re.MULTILINE)
    sip3.wire.reset(sip3.card)
    assert sip3.main("get", "--json", "d1-17", "C1-01") == 0
    assert json.loads(capsys.readouterr().out) == {"d1-17": 7.5, "C1-01": 2.5}
    assert sip3.main("set", "C1-01=6001") == 2
    assert "C1-01 = 6001: acceleration time" in capsys.readouterr().err
    assert sip3.main("get", "x1-01") == 2


def test_an_si_p3_runs_at_per_cent_and_stops(sip3: Bench, capsys: Capture) -> None:
    assert sip3.main("run", "--percent", "20", "--reverse", "--for", "1s", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["zero_speed"] and not found["fault"] and found["output_frequency"] == 0.0
    assert sip3.main("stop", "--json") == 0


def test_arguments_of_a_drive_class(sip3: Bench, capsys: Capture) -> None:
    sip3.arguments[-1] = "PPO Type 4"
    assert sip3.main("run", "--frequency", "12", "--for", "100ms") == 2
    assert "tell it by maximum_frequency" in capsys.readouterr().err
    sip3.arguments += ["--option", "maximum_frequency=60"]
    assert sip3.main("run", "--frequency", "12", "--for", "1s", "--reset") == 0
    assert re.search(r"[1-9][\d.]+ Hz +[\d.]+ A  running", capsys.readouterr().out)
    sip3.arguments += ["--option", "colour=red"]
    assert sip3.main("status") == 2
    assert "--option colour: si-p3 has configuration, index," in capsys.readouterr().err
