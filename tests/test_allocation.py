# SPDX-License-Identifier: MIT
"""No memory is allocated by the C library after start."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
WRAPPED = ("malloc", "calloc", "realloc", "aligned_alloc")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("cc") is None:
        pytest.skip("no C compiler named cc")
    program = tmp_path_factory.mktemp("allocation") / "allocation"
    sources = [ROOT / "tests" / "allocation.c", *sorted((ROOT / "csrc").glob("*/*.c"))]
    built = subprocess.run(
        ["cc", "-std=c11", "-D_GNU_SOURCE", "-O1", "-fno-builtin", "-pthread", f"-I{ROOT / 'include'}",
         f"-I{ROOT / 'csrc'}", *map(str, sources), *(f"-Wl,--wrap={name}" for name in WRAPPED), "-o", str(program)],
        capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stderr
    return program


def run(program: Path, *arguments: str) -> tuple[int, int]:
    """Exchanges made and allocations counted."""
    ran = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    exchanges, allocations = map(int, ran.stdout.split())
    return exchanges, allocations


def test_thousands_of_exchanges_allocate_nothing(program: Path) -> None:
    exchanges, allocations = run(program)
    assert exchanges >= 3000
    assert allocations == 0


def test_the_count_counts(program: Path) -> None:
    assert run(program, "allocate")[1] == 1
