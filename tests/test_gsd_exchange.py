# SPDX-License-Identifier: MIT
"""Real device files, end to end: ``dpmaster emulate gsd`` plays 30 devices, ``dpmaster run`` brings them all to Data_Exchange.

The files are other people's and are read where they lie; without them the test is skipped.
"""

from __future__ import annotations

import json
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest
from children import child

from dpmaster.emulator import Segment
from dpmaster.errors import ConfigurationError
from dpmaster.gsd import GSD

FOLDER = Path(__file__).parents[2] / "shared" / "gsd"
DEVICES = 30
PATIENCE = 90.0  # s for all of them on a computer that is busy


def devices() -> list[Path]:
    """Files whose default modules make a station, from all over the folder: every one that can, by turns."""
    found = []
    for path in sorted(FOLDER.iterdir()):
        if path.suffix.lower().startswith(".gs"):
            try:
                GSD.load(path).configure()
            except ConfigurationError:
                continue
            found.append(path)
    return found[:: max(1, len(found) // DEVICES)][:DEVICES]


def emulate(stack: ExitStack, path: Path, address: int, port: str) -> subprocess.Popen[str]:
    return stack.enter_context(child("-m", "dpmaster", "emulate", "gsd", str(path), "--address", str(address), "--on", port,
                                     stdin=subprocess.PIPE))


@pytest.mark.skipif(not FOLDER.is_dir(), reason="the folder of real device files is not beside this tree")
@pytest.mark.timeout(300)
def test_thirty_real_devices_exchange(tmp_path: Path) -> None:
    paths = devices()
    assert len(paths) == DEVICES
    with ExitStack() as stack:
        wire = stack.enter_context(Segment(ports=DEVICES + 1))
        addresses = range(10, 10 + DEVICES)
        emulated = [emulate(stack, path, address, wire.port()) for path, address in zip(paths, addresses, strict=True)]
        for process in emulated:
            assert process.stdout.readline(), "its path: it is on the wire"
        stations = "".join(f'[[station]]\naddress = {address}\ngsd = "{path}"\nwatchdog = "off"\n'
                           for path, address in zip(paths, addresses, strict=True))
        bus = tmp_path / "bus.toml"
        bus.write_text(f'[bus]\nport = "{wire.port()}"\n{stations}', encoding="utf-8")
        with child("-m", "dpmaster", "run", str(bus), "--json", "--seconds", str(PATIENCE)) as run:
            states = {}
            for line in run.stdout:
                states = {s["address"]: (s["state"], s["reason"]) for s in json.loads(line)["stations"]}
                if all(state == "data" for state, _ in states.values()):
                    break
            run.terminate()
            errors = run.stderr.read()
        missing = {path.name: states.get(address) for path, address in zip(paths, addresses, strict=True)
                   if states.get(address, ("",))[0] != "data"}
        assert not missing, f"{missing}\n{errors}"
