# SPDX-License-Identifier: MIT
"""Programs of ours as other processes, which end with the test that starts them, however it ends."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


@contextmanager
def child(*argv: str, text: bool = True, stdin: int | None = None, stdout: int = subprocess.PIPE,
          env: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[Any]]:
    """This Python with these arguments. One that hangs fails its test by the test's own time-out, and nobody waits for it."""
    with subprocess.Popen([sys.executable, *argv], stdin=stdin, stdout=stdout, stderr=subprocess.PIPE, text=text,
                          env=env) as started:
        try:
            yield started
        finally:
            started.kill()
