# SPDX-License-Identifier: MIT
"""The examples of docs/programs.md do what the page says, octet for octet of what they print."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "programs.md"

pytestmark = pytest.mark.tree


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
    """As a program of its own, which has to end by itself."""
    with Segment() as wire:
        wire.attach(SIP1(address=5))
        text = f"port = {str(wire.port())!r}\n{program}"
        done = subprocess.run([sys.executable, "-W", "error", "-c", text], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, printed), done.stderr
    assert "Traceback" not in done.stderr  # warnings are logged there
