# SPDX-License-Identifier: MIT
"""What ``segment`` and ``emulate`` share: symbolic links to ptys, and staying until a signal ends the command."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dpmaster.bridge import Bridge
from dpmaster.emulator.host import Host
from dpmaster.errors import DPError

LOOK = 0.2  # s between two looks whether a card failed or the port vanished


@contextmanager
def link(path: Path, target: str) -> Iterator[None]:
    """A symbolic link while the block runs. One that a killed program left behind is replaced, nothing else."""
    try:
        if path.is_symlink() and not path.exists():
            path.unlink()
        path.symlink_to(target)
    except FileExistsError:
        raise DPError(f"--link {path}: it exists; remove it or name another") from None
    except OSError as error:
        raise DPError(f"--link {path}: {error.strerror}; name a path that can be written") from None
    try:
        yield
    finally:
        if path.is_symlink() and os.readlink(path) == target:
            path.unlink()


@contextmanager
def directory(path: Path) -> Iterator[None]:
    """A directory that is removed behind the block if it was made for it and is empty."""
    made = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DPError(f"--link {path}: {error.strerror}; name a directory that can be written") from None
    try:
        yield
    finally:
        if made and not any(path.iterdir()):
            path.rmdir()


def stay(host: Host | Bridge) -> None:
    """Until a signal raises KeyboardInterrupt; or the error of what went wrong meanwhile."""
    while True:
        time.sleep(LOOK)
        host.check()
