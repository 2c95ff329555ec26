# SPDX-License-Identifier: MIT
"""``dpmaster demo`` as a person runs it: as a program of its own, on a terminal and in a pipe, to its end and to Ctrl-C."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time

import pytest

from dpmaster.cli import demo, main

COMMAND = [sys.executable, "-m", "dpmaster", "demo"]


def read_until(fd: int, pattern: str, seconds: float) -> str:
    """What a terminal's program writes, up to `pattern`."""
    text, limit = "", time.monotonic() + seconds
    while not re.search(pattern, text):
        ready, _, _ = select.select([fd], [], [], max(0.0, limit - time.monotonic()))
        assert ready, f"{pattern!r} did not come in {seconds} s; what came: {text}"
        try:
            octets = os.read(fd, 65536)
        except OSError:  # the program has left the terminal
            octets = b""
        assert octets, f"the program ended without {pattern!r}: {text}"
        text += octets.decode()
    return text


@pytest.mark.parametrize("paced", [[], ["--paced"]], ids=["unpaced", "paced"])
def test_the_summary_says_what_happened(paced: list[str]) -> None:
    done = subprocess.run([*COMMAND, "--frequency", "20", "--acceleration", "1.5", "--json", *paced], capture_output=True,
                          text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    summary = json.loads(line)
    assert summary["motor_frequency"] == 20.0
    assert summary["refusal_code"] == 0x22  # devices page: "22h write fault (running, ...)"
    assert summary["losses"] == 0 and summary["exchanges"] > 0
    # 20 of 60 Hz in a ramp of 1.5 s: half a second each way, told by the bus and not by the demo's own clock.
    assert 0.4 < summary["seconds_up"] < 5.0 and 0.4 < summary["seconds_down"] < 5.0


def test_in_a_pipe_it_prints_lines() -> None:
    done = subprocess.run([*COMMAND, "--acceleration", "2", "--reverse"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\r" not in done.stdout and not re.search(r" $", done.stdout, flags=re.MULTILINE)
    assert re.search(r"n003 = 3 .* n004 = 9 ", done.stdout)
    assert "written 2.0 s, read back 2.0 s" in done.stdout
    assert re.search(r"\[#{20}\] +30\.00 Hz .*reverse.*frequency agree", done.stdout)
    refused, _, down = done.stdout.partition("the ramp down")
    assert "code 22h" in refused
    assert re.search(r"\[#+\.*\] +[1-9]\d*\.\d\d Hz", down)  # the drive is followed down as it was up
    assert "master.feed()" in done.stdout  # what a person at a prompt must know


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_in_the_middle_of_the_ramp_stops_the_drive_and_leaves(number: signal.Signals, code: int) -> None:
    near, far = pty.openpty()
    fcntl.ioctl(far, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    with subprocess.Popen([*COMMAND, "--acceleration", "30", "--reverse"], stdout=far, stderr=subprocess.PIPE) as process:
        os.close(far)
        try:
            text = read_until(near, r"\r  \[#+\.+\] +[1-9]", 30.0)
            assert "in Data_Exchange after" in text
            process.send_signal(number)
            assert process.wait(10) == code
            text += read_until(near, r"interrupted +the drive was given its stop word", 10.0)
            # A line as wide as the terminal would wrap, and the picture scroll instead of move.
            assert max(len(line) for line in re.split(r"[\r\n]+", text)) < 80
            assert process.stderr is not None and b"Traceback" not in process.stderr.read()
        finally:
            process.kill()
            os.close(near)


@pytest.mark.parametrize("argv", [
    ["--frequency", "0"], ["--frequency", "61"], ["--frequency", "nan"], ["--acceleration", "601"], ["--frequency", "fast"],
])
def test_wrong_arguments_are_named_with_their_range(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([demo.NAME, *argv])
    assert left.value.code == 2
    assert re.search(rf"argument {argv[0]}: '{argv[1]}': a number above 0 and up to \d+", capsys.readouterr().err)


def test_a_rate_that_is_none_is_one_line_with_the_rates(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([demo.NAME, "--baudrate", "115200"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("dpmaster demo: baudrate 115200: ") and err.count("\n") == 1
    assert "500000" in err
