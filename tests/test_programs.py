# SPDX-License-Identifier: MIT
"""The examples of docs/programs.md do what the page says, octet for octet of what they print; those of the other pages run, and
the command line takes the commands on them."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from drive_bench import VirtualSIP3

from dpmaster import cli
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1, SIP3

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "programs.md"

# The pages' masters have a pty's usual allowance; one that a busy computer makes late twice loses its drive.
PATIENT = """
import functools
from dpmaster import Master
Master.__init__ = functools.partialmethod(Master.__init__, allowance=0.08)
"""

pytestmark = pytest.mark.tree


def run(text: str) -> subprocess.CompletedProcess[str]:
    """As a program of its own, which has to end by itself."""
    return subprocess.run([sys.executable, "-W", "error", "-c", PATIENT + text], cwd=ROOT, capture_output=True, text=True,
                          timeout=60)


def examples() -> list[tuple[str, str, str]]:
    """Title of the section, program, what it prints."""
    found = []
    for section in PAGE.read_text().split("\n## ")[1:]:
        title = section.split("\n", 1)[0]
        for program, printed in re.findall(r"```python\n(.*?)```\n(?:\n```text\n(.*?)```)?", section, flags=re.DOTALL):
            found.append((title, program, printed))
    return found


def test_the_page_has_examples_of_everything() -> None:
    assert {title for title, _, _ in examples()} == {
        "Master, stations, modes", "A station's data", "Cycles", "asyncio", "Diagnosis",
        "Services, and stations that change", "Events", "Watchdogs"}
    assert len(re.findall("```python", PAGE.read_text())) == len(examples()) == 9


@pytest.mark.parametrize(("title", "program", "printed"), examples(), ids=lambda text: text.split("\n")[0][:30])
def test_an_example_runs_and_prints_what_is_written(title: str, program: str, printed: str) -> None:
    with Segment() as wire:
        wire.attach(SIP1(address=5))
        done = run(f"port = {str(wire.port())!r}\n{program}")
    assert (done.returncode, done.stdout) == (0, printed), done.stderr
    assert "Traceback" not in done.stderr  # warnings are logged there


# ---- the other pages


def blocks(page: Path, language: str) -> list[str]:
    found = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return [text for named, text in found if named == language]


def commands() -> list[str]:
    """What stands on the pages to be typed; two spaces or more are before what it is for."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    lines = [line for page in pages for block in blocks(page, "") for line in block.splitlines()]
    return [re.split(r"\s{2,}", line)[0] for line in lines if line.startswith("dpmaster ")]


def test_the_command_line_takes_the_commands_on_the_pages() -> None:
    found = commands()
    assert {line.split()[1] for line in found} >= {"demo", "run", "emulate", "scan", "drive", "diag", "gsd", "timing", "doctor"}
    for line in found:
        argv = shlex.split(line)[1:]
        cli._parser(argv).parse_args(argv)


def test_the_program_of_the_readme(capfd: pytest.CaptureFixture[str]) -> None:
    (program,) = blocks(ROOT / "README.md", "python")
    done = run(program.replace("30.00", "3.00"))  # a ramp of half a second
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(r"running, frequency_agree, .*output_frequency=3,.*\n3 3\.0\n", done.stdout)


def test_the_examples_of_drives() -> None:
    turning, parameters = blocks(ROOT / "docs" / "drives.md", "python")
    names: dict[str, Any] = {}
    exec(turning, names)
    drive = VirtualSIP3(SIP3(5))
    names["turn"](drive)
    assert drive.status.zero_speed and drive.trace
    assert names["YaskawaV7"] is YaskawaV7
    exec(parameters, {"drive": drive})
    assert (drive["d1-17"], drive["C1-02"], [*drive.status.monitors][:2]) == (6.0, 2.5, ["U1-07", "U1-08"])
