# SPDX-License-Identifier: MIT
"""``dpmaster run FILE``: the bus that a file describes, exchanged until Ctrl-C, with a live view of its stations.

Outputs are zeros but for what ``--set`` says. It shows what `Master.from_file` makes, and calls nothing else.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Iterator
from typing import Any, TextIO

from dpmaster import Master, Station, StationState
from dpmaster.busfile import BusFile
from dpmaster.errors import ConfigurationError, DPTimeout, StationError
from dpmaster.signals import Value

NAME = "run"
HELP = "exchange data on the bus that a file describes, and watch its stations"

REDRAW = 0.25  # s between two pictures on a terminal
LINE = 1.0  # s between two looks that go line by line
START = 5.0  # s for the stations to come
COLUMNS = 120
OCTETS = 16  # of a process image that one line has room for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="bus file, TOML (docs/busfile.md)")
    parser.add_argument("--port", metavar="PORT", help="in place of the file's")
    parser.add_argument("--check", action="store_true", help="only check the file and say what it makes")
    parser.add_argument("--set", action="append", default=[], metavar="STATION.SIGNAL=VALUE", dest="values",
                        help="set an output by its name in the file; this may move a motor")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after so long (default: Ctrl-C)")
    parser.add_argument("--json", action="store_true", help="print one JSON object for each look, one a second")


# ---- outputs by name


def assignments(texts: list[str], stations: tuple[Station, ...]) -> list[tuple[Station, dict[str, Value]]]:
    """What --set says, by station; checked before the bus is touched."""
    found: dict[Station, dict[str, Value]] = {}
    for text in texts:
        where, equals, value = text.partition("=")
        station = next((s for s in stations if where.startswith((f"{s.name}.", f"{s.address}."))), None)
        if station is None or not equals:
            names = ", ".join(s.name for s in stations)
            raise ConfigurationError(f"--set {text}: write STATION.SIGNAL=VALUE; the stations are {names}")
        name = where.removeprefix(f"{station.name}.").removeprefix(f"{station.address}.")
        signal = station.signals.signal(name)
        try:
            number: Value = {"on": True, "off": False}[value] if signal.type == "bool" else float(value)
        except (KeyError, ValueError):
            takes = "on or off" if signal.type == "bool" else "a number"
            raise ConfigurationError(f"--set {text}: {name} takes {takes}") from None
        if isinstance(number, float) and number.is_integer():
            number = int(number)
        signal.put(number)
        if signal.direction != "outputs":
            raise ConfigurationError(f"--set {text}: {name} is an input: only outputs can be set")
        found.setdefault(station, {})[name] = number
    return list(found.items())


# ---- the view


def octets(data: bytes) -> str:
    return "-" if not data else data[:OCTETS].hex(" ").upper() + (f" .. {len(data)} octets" if len(data) > OCTETS else "")


def state(station: Station) -> str:
    trouble = station.reason
    if station.state == StationState.DATA:
        return "exchange" if station.frame.valid else "exchange begins"
    return f"{station.state.name}: {trouble}" if trouble else station.state.name


def rows(station: Station) -> Iterator[str]:
    """A station's lines: who and how it is, then its values, or its octets where no value has a name."""
    yield f"{station.address:4}  {station.name:<20} {state(station)}"
    diagnosis = station.diagnosis
    if diagnosis is not None and diagnosis.extended and station.state == StationState.DATA:
        texts = getattr(getattr(station, "gsd", None), "texts", None)
        told = diagnosis.explain() if texts is None else diagnosis.explain(texts)
        yield from (f"{'':6}diagnosis: {text}" for text in told)
    if not station.signals:
        yield f"{'':6}in  {octets(station.inputs)}"
        yield f"{'':6}out {octets(station.outputs)}"
    values = [f"{name} {station.signals.signal(name).shown(value)}" for name, value in station.signals.items()]
    yield from (f"{'':6}{'   '.join(values[at : at + 4])}" for at in range(0, len(values), 4))


def picture(master: Master) -> list[str]:
    counts = master.statistics
    rate = float(master.parameters.rate) / 1000
    head = (f"{master.port}, {rate:g} kbit/s, {master.mode.name.title()}: cycle {counts.cycle}, "
            f"{counts.cycle_last * 1000:.2f} ms, {counts.repetitions} repetitions, {counts.unanswered} unanswered")
    return [head, *(line for station in master.stations for line in rows(station))]


def as_object(master: Master) -> dict[str, Any]:
    counts = master.statistics
    return {
        "time": round(time.monotonic(), 3), "mode": master.mode.name.lower(), "cycle": counts.cycle,
        "cycle_last": counts.cycle_last, "repetitions": counts.repetitions, "unanswered": counts.unanswered,
        "stations": [
            {"address": s.address, "name": s.name, "state": s.state.name.lower(), "valid": s.frame.valid, "reason": s.reason,
             "inputs": s.inputs.hex(), "outputs": s.outputs.hex(), "signals": dict(s.signals)} for s in master.stations],
    }


class View:
    """Pictures, each in the place of the last one on a terminal; else line by line, what changed."""

    def __init__(self, stream: TextIO, as_json: bool) -> None:
        self.stream = stream
        self.json = as_json
        self.moving = stream.isatty() and not as_json
        self.height = 0
        self.told: Any = None

    def show(self, master: Master) -> None:
        if self.json:
            found = as_object(master)
            print(json.dumps(found), file=self.stream, flush=True)
        elif self.moving:
            self._draw(picture(master))
        else:
            lines = [line for station in master.stations for line in rows(station)]
            if lines != self.told:
                print("\n".join([picture(master)[0], *lines]), file=self.stream, flush=True)
                self.told = lines

    def _draw(self, lines: list[str]) -> None:
        size = shutil.get_terminal_size()
        width, room = min(COLUMNS, size.columns - 1), size.lines - 1
        if len(lines) > room:
            lines = [*lines[: room - 1], f"... {len(lines) - room + 1} more lines; a taller terminal shows them"]
        up = f"\x1b[{self.height}A" if self.height else ""
        print(up + "".join(f"\r{line[:width]}\x1b[K\n" for line in lines) + "\x1b[J", end="", file=self.stream, flush=True)
        self.height = len(lines)


# ---- the run


def exchange(master: Master, args: argparse.Namespace, wanted: list[tuple[Station, dict[str, Value]]]) -> None:
    view = View(sys.stdout, args.json)
    pace = REDRAW if view.moving else LINE
    if master.output_watchdog is not None:
        pace = min(pace, master.output_watchdog / 3)
    try:
        master.operate(START)
    except (DPTimeout, StationError) as error:
        if not any(station.state == StationState.DATA for station in master.stations):
            raise
        print(f"dpmaster run: going on without some stations: {error}", file=sys.stderr)
        master.operate(0.1, partial=True)
    end = time.monotonic() + (args.seconds if args.seconds is not None else float("inf"))
    given: dict[Station, int] = {}
    while (now := time.monotonic()) < end:
        master.feed()
        for station, values in wanted:  # anew after each return of the station: what was written before is void
            starts = station.statistics.starts
            if station.state == StationState.DATA and given.get(station) != starts:
                station.signals.commit(values)
                given[station] = starts
        view.show(master)
        time.sleep(max(0.0, min(pace, end - now)))


def run(args: argparse.Namespace) -> int:
    bus = BusFile.load(args.file)
    for warning in bus.warnings:
        print(f"dpmaster run: {warning}", file=sys.stderr)
    wanted = assignments(args.values, bus.stations)
    if args.check:
        for station in bus.stations:
            lengths = f"{station.input_length} octets in, {station.output_length} out"
            print(f"{station.address:4}  {station.name:<20} ident {station.ident_number:04X}h, {lengths}")
        print(f"{args.file}: {len(bus.stations)} stations, cycle {bus.timing.cycle.steady * 1000:.3g} ms: nothing wrong")
        return 0
    with bus.master(args.port) as master:
        try:
            exchange(master, args, wanted)
        except KeyboardInterrupt:  # SIGTERM too: how it is meant to end; the `with` gives stop words, then Clear, then releases
            pass
    return 0


