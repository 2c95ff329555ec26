# SPDX-License-Identifier: MIT
"""What uart.py and cross.py need of other processors: tools that are named where they lack, and Debian's packages."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CONF = """APT::Architecture "{1}"; APT::Architectures {{ "{1}"; }}; APT::Sandbox::User "root";
Dir::State "{0}"; Dir::State::Lists "{0}/lists"; Dir::State::status "{0}/status"; Dir::Cache "{0}";
"""


def run(*command: str | Path, timeout: float = 300, **settings: Any) -> str:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=timeout, **settings)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}"
    return done.stdout


def require(programs: dict[str, str]) -> None:
    """Skip, and say so, without these programs, each with its packages. A compiler for Linux needs its C library, which
    Debian only recommends with it."""

    def serves(program: str) -> bool:
        if not shutil.which(program):
            return False
        headers = [program, "-E", "-include", "stdio.h", "-x", "c", os.devnull]
        return "linux-gnu" not in program or subprocess.run(headers, capture_output=True).returncode == 0

    missing = [packages for program, packages in programs.items() if not serves(program)]
    if missing:
        pytest.skip(f"not run: apt-get install {' '.join(missing)}")


@contextmanager
def apt(state: Path, architecture: str) -> Iterator[dict[str, Any]]:
    """Settings for `run` with which apt fetches another architecture's packages, in a state directory of its own."""
    for folder in ("lists/partial", "archives/partial"):
        (state / folder).mkdir(parents=True, exist_ok=True)
    (state / "status").touch()
    (state / "apt.conf").write_text(CONF.format(state, architecture))
    settings = {"env": os.environ | {"APT_CONFIG": str(state / "apt.conf")}}
    try:
        subprocess.run(["apt-get", "update", "--quiet"], capture_output=True, **settings)  # one list that fails is no matter
        yield settings
    finally:
        shutil.rmtree(state)
