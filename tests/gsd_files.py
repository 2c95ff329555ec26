# SPDX-License-Identifier: MIT
"""The GSD files of other makers that the tests read where they lie, beside the project; nothing of them is part of it."""

import functools
from pathlib import Path

import pytest

from dpmaster.gsd import GSD

FOLDER = Path(__file__).parents[2] / "shared" / "gsd"
NAMES = sorted(path.name for path in FOLDER.glob("*") if path.suffix != ".tsv") if FOLDER.is_dir() else []

needs_files = pytest.mark.skipif(not NAMES, reason=f"the makers' GSD files are not there: {FOLDER}")


def path(name: str) -> Path:
    if not NAMES:
        pytest.skip(f"the makers' GSD files are not there: {FOLDER}")
    return FOLDER / name


@functools.cache
def load(name: str) -> GSD:
    """The file, read once for all tests that only look at it."""
    return GSD.load(path(name))
