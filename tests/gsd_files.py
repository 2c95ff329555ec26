# SPDX-License-Identifier: MIT
"""The GSD files of other makers that the tests read where they lie, beside the project; nothing of them is part of it."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "shared" / "gsd"
NAMES = sorted(path.name for path in FOLDER.glob("*") if path.suffix != ".tsv") if FOLDER.is_dir() else []

needs_files = pytest.mark.skipif(not NAMES, reason=f"the makers' GSD files are not there: {FOLDER}")


def path(name: str) -> Path:
    if not NAMES:
        pytest.skip(f"the makers' GSD files are not there: {FOLDER}")
    return FOLDER / name
