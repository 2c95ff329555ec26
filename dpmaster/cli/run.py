# SPDX-License-Identifier: MIT
"""``dpmaster run FILE``: the bus that a file describes, exchanged until Ctrl-C, with a live view of its stations.

Outputs are zeros but for what ``--set`` says. It shows what `Master.from_file` makes, and calls nothing else. A station or the
port may come and go meanwhile: the master takes them back by itself, and what happened stays above the picture.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import shutil
import sys
import textwrap
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from typing import Any, TextIO

from dpmaster import Diagnosis, EventKind, Events, Master, Station, StationState
from dpmaster.busfile import BusFile
from dpmaster.cli._terminal import printable
from dpmaster.diagnosis import Diag
from dpmaster.errors import ConfigurationError, DPError, DPTimeout, NotOperatingError, StationError
from dpmaster.signals import Value

NAME = "run"
HELP = "exchange data on the bus that a file describes, and watch its stations"

REDRAW = 0.25  # s between two pictures on a terminal
LINE = 1.0  # s between two looks that go line by line
START = 5.0  # s for the stations to come
COLUMNS = 120
TROUBLE = Diag.EXT_DIAG | Diag.STAT_DIAG | Diag.EXT_DIAG_OVERFLOW
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


def numeral(text: str) -> int | float:
    """A whole one exactly: 64 bits are more than a float holds."""
    try:
        return int(text, 0)
    except ValueError:
        number = float(text)
        return int(number) if number.is_integer() else number


def assignments(texts: list[str], stations: tuple[Station, ...]) -> list[tuple[Station, dict[str, Value]]]:
    """What --set says, by station; checked before the bus is touched."""
    found: dict[Station, dict[str, Value]] = {}
    for text in texts:
        where, equals, value = text.partition("=")
        prefixes = {f"{which}.": s for s in stations for which in (s.address, s.name)}
        prefix = max((prefix for prefix in prefixes if where.startswith(prefix)), key=len, default=None)
        if prefix is None or not equals:
            names = ", ".join(s.name for s in stations)
            raise ConfigurationError(f"--set {text}: write STATION.SIGNAL=VALUE; the stations are {names}")
        station, name = prefixes[prefix], where.removeprefix(prefix)
        signal = station.signals.signal(name)
        try:
            number: Value = {"on": True, "off": False}[value] if signal.type == "bool" else numeral(value)
        except (KeyError, ValueError):
            takes = "on or off" if signal.type == "bool" else "a number"
            raise ConfigurationError(f"--set {text}: {name} takes {takes}") from None
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


def explained(station: Station, diagnosis: Diagnosis) -> tuple[str, ...]:
    """In the maker's words where the station has a GSD file."""
    texts = getattr(getattr(station, "gsd", None), "texts", None)
    return diagnosis.explain() if texts is None else diagnosis.explain(texts)


def troubles(station: Station) -> tuple[str, ...]:
    """What an exchanging station reports; its watchdog, Sync and Freeze are as they were asked for."""
    diagnosis = station.diagnosis
    if diagnosis is None or station.state != StationState.DATA or not (diagnosis.extended or diagnosis.flags & TROUBLE):
        return ()
    told = explained(station, diagnosis)[len(diagnosis.texts) :]
    return told or diagnosis.texts


def rows(station: Station) -> Iterator[str]:
    """A station's lines: who and how it is, then its values, or its octets where no value has a name."""
    yield f"{station.address:4}  {station.name:<20} {state(station)}"
    yield from (f"{'':6}diagnosis: {text}" for text in troubles(station))
    if not station.signals:
        yield f"{'':6}in  {octets(station.inputs)}"
        yield f"{'':6}out {octets(station.outputs)}"
    values = [f"{name} {station.signals.signal(name).shown(value)}" for name, value in station.signals.items()]
    yield from (f"{'':6}{'   '.join(values[at : at + 4])}" for at in range(0, len(values), 4))


def wrapped(line: str, width: int) -> list[str]:
    line = printable(line)
    return textwrap.wrap(line, max(width, 20), subsequent_indent=" " * 8) if len(line) > width else [line]


def picture(master: Master, width: int, room: float) -> list[str]:
    """All of it; or where there is not so much room, a line for each station, those with something to tell first."""
    counts = master.statistics
    rate = float(master.parameters.rate) / 1000
    head = (f"{master.port}, {rate:g} kbit/s, {master.mode.name.title()}: cycle {counts.cycle}, "
            f"{counts.cycle_last * 1000:.2f} ms, {counts.repetitions} repetitions, {counts.unanswered} unanswered")
    blocks = [list(rows(station)) for station in master.stations]
    lines = [part for line in chain([head], *blocks) for part in wrapped(line, width)]
    if len(lines) <= room:
        return lines
    well = [station.state == StationState.DATA and not troubles(station) for station in master.stations]
    firsts = [block[0] for _, block in sorted(zip(well, blocks, strict=True), key=lambda entry: entry[0])]
    if len(firsts) >= room:
        firsts[int(room) - 2 :] = [f"... and {len(firsts) - int(room) + 2} more stations"]
    return [wrapped(line, width)[0] for line in (head, *firsts)]


def as_object(master: Master) -> dict[str, Any]:
    counts = master.statistics
    return {
        "time": round(time.monotonic(), 3), "mode": master.mode.name.lower(), "cycle": counts.cycle,
        "cycle_last": counts.cycle_last, "repetitions": counts.repetitions, "unanswered": counts.unanswered,
        "stations": [
            {"address": s.address, "name": s.name, "state": s.state.name.lower(), "valid": s.frame.valid, "reason": s.reason,
             "inputs": s.inputs.hex(), "outputs": s.outputs.hex(), "signals": dict(s.signals),
             "diagnosis": None if s.diagnosis is None else diagnosis_object(s, s.diagnosis)} for s in master.stations],
    }


def diagnosis_object(station: Station, diagnosis: Diagnosis) -> dict[str, Any]:
    return {"number": diagnosis.number, "octets": diagnosis.octets.hex(),
            "flags": [flag.name.lower() for flag in diagnosis.flags if flag.name], "texts": list(explained(station, diagnosis))}


class View(logging.Handler):
    """Pictures, each in the place of the last one on a terminal; else line by line, what changed.

    What the library logs goes above the picture, where it stays; without a picture, to stderr.
    """

    def __init__(self, stream: TextIO, as_json: bool) -> None:
        super().__init__(logging.WARNING)
        self.stream = stream
        self.json = as_json
        self.moving = stream.isatty() and not as_json
        self.pace = REDRAW if self.moving else LINE
        self.height = 0
        self.size = shutil.get_terminal_size()
        self.told: Any = None
        self.news: deque[str] = deque()

    def emit(self, record: logging.LogRecord) -> None:
        self.tell(record.getMessage())

    def tell(self, text: str) -> None:
        line = f"{time.strftime('%H:%M:%S')} {text}"
        if self.moving and sys.stderr.isatty():
            self.news.append(line)
        else:
            print(line, file=sys.stderr, flush=True)

    def show(self, master: Master) -> None:
        if self.json:
            print(json.dumps(as_object(master)), file=self.stream, flush=True)
        elif self.moving:
            self._draw(master)
        else:
            lines = picture(master, COLUMNS, math.inf)
            if lines[1:] != self.told:
                print("\n".join(lines), file=self.stream, flush=True)
                self.told = lines[1:]

    def _draw(self, master: Master) -> None:
        size = shutil.get_terminal_size()
        width = min(COLUMNS, size.columns - 1)
        begin = f"\x1b[{self.height}A\r\x1b[J" if self.height and self.news else f"\x1b[{self.height}A" if self.height else ""
        if size != self.size:  # the terminal has wrapped the old lines anew, nobody knows where
            begin, self.size = "\x1b[H\x1b[2J", size
        news = [part for _ in range(len(self.news)) for part in wrapped(self.news.popleft(), width)]
        lines = picture(master, width, size.lines - 1)
        text = "".join(f"\r{line}\x1b[K\n" for line in [*news, *lines])
        print(f"{begin}{text}\x1b[J", end="", file=self.stream, flush=True)
        self.height = len(lines)


@contextmanager
def logged(view: View) -> Iterator[None]:
    log = logging.getLogger("dpmaster")
    log.addHandler(view)
    try:
        yield
    finally:
        log.removeHandler(view)
        for line in view.news:  # what leaving the bus had to say
            print(line, file=sys.stderr)


@contextmanager
def watched(view: View, master: Master) -> Iterator[None]:
    """Pictures while this thread waits: who is awaited, and why."""
    over = threading.Event()

    def look() -> None:
        with suppress(DPError, OSError):  # of a bus or a reader that is gone the waiting thread tells
            while not over.wait(view.pace):
                view.show(master)

    thread = threading.Thread(target=look, name="dpmaster-view", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


# ---- the run


def start(master: Master, view: View) -> None:
    try:
        with watched(view, master):
            master.operate(START)
    except (DPTimeout, StationError) as error:
        if master.auto_clear or not any(station.state == StationState.DATA for station in master.stations):
            raise
        view.tell(f"going on without some stations: {error}")
        master.operate(0.1, partial=True)


def returns(events: Events, master: Master) -> Iterator[str]:
    """Good news, which are not logged as warnings."""
    while (event := events.take(0)) is not None:
        if event.kind == EventKind.PORT and not event.a:
            yield f"{master.port}: {event}"
        if event.kind == EventKind.STATE and event.a == StationState.DATA and event.address is not None:
            yield f"{master[event.address].name} exchanges"


def exchange(master: Master, args: argparse.Namespace, wanted: list[tuple[Station, dict[str, Value]]], view: View) -> None:
    pace = view.pace if master.output_watchdog is None else min(view.pace, master.output_watchdog / 3)
    start(master, view)
    events = master.events()
    end = time.monotonic() + (args.seconds if args.seconds is not None else math.inf)
    given: dict[Station, int] = {}
    while (now := time.monotonic()) < end:
        master.feed()
        for station, values in wanted:  # anew after each return of the station: what was written before is void
            starts = station.statistics.starts
            if station.state == StationState.DATA and given.get(station) != starts and order(station, values):
                given[station] = starts
        for text in returns(events, master):
            view.tell(text)
        view.show(master)
        time.sleep(max(0.0, min(pace, end - now)))


def order(station: Station, values: dict[str, Value]) -> bool:
    """Set outputs, unless the output watchdog holds them safe: the terminal stood still for too long."""
    try:
        station.signals.commit(values)
    except NotOperatingError:
        return False
    return True


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
    view = View(sys.stdout, args.json)
    with logged(view), bus.master(args.port) as master:
        try:
            exchange(master, args, wanted, view)
        except KeyboardInterrupt:  # SIGTERM too: how it is meant to end; the `with` gives stop words, then Clear, then releases
            pass
    return 0


