# SPDX-License-Identifier: MIT
"""Builds and runs the two-thread programs of tests/race, plain or under the thread sanitizer."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SANITIZERS = ("", "thread")


def _build(source: Path, program: Path, sanitizer: str) -> subprocess.CompletedProcess[str]:
    options = [f"-fsanitize={sanitizer}"] if sanitizer else []
    return subprocess.run(
        ["cc", "-std=c11", "-D_GNU_SOURCE", "-O2", "-g", "-pthread", *options, f"-I{ROOT / 'include'}", str(source),
         "-o", str(program)], capture_output=True, text=True, timeout=120)


def run_race(name: str, folder: Path, sanitizer: str, *arguments: str) -> None:
    """Fail with the program's own words unless it ends with 0; skip where the machine cannot build or run it at all."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler named cc")
    if sanitizer:
        (folder / "empty.c").write_text("int main(void) { return 0; }\n")
        empty = folder / "empty"
        if _build(folder / "empty.c", empty, sanitizer).returncode or subprocess.run([empty]).returncode:
            pytest.skip(f"this machine has no working -fsanitize={sanitizer}")
    program = folder / name
    built = _build(ROOT / "tests" / "race" / f"{name}.c", program, sanitizer)
    assert built.returncode == 0, built.stderr
    for _ in range(10):  # the program says 75 when its threads have hardly met
        ran = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=120)
        print(ran.stdout)
        if ran.returncode != 75:
            break
    assert ran.returncode == 0, ran.stdout + ran.stderr
