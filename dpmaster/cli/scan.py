# SPDX-License-Identifier: MIT
"""``dpmaster scan PORT``: who is on a bus, as a grid of addresses and a list.

It listens first. On a bus with a master it stays a listener, and shows whom it hears; else it asks every address for its FDL
status, and slaves for their diagnosis, which holds the ident number. It parameterises nobody.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from dpmaster import BusParameters, Listener, Live, LiveEntry, Master
from dpmaster.cli import _master as common
from dpmaster.live import HIGHEST

NAME = "scan"
HELP = "show which stations are on a bus"

ROW = 10
PAUSE = 0.5  # s between two looks of --watch
ATTENTION = 0.25  # s, least time to listen for a master before asking
EAVESDROP = 3.0  # s to listen to a bus that has a master
MARKS = {Live.UNKNOWN: "?", Live.NONE: ".", Live.SLAVE: "s", Live.MASTER_NOT_READY: "m", Live.MASTER_READY: "r",
         Live.MASTER_IN_RING: "M"}
OWN = "@"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_port(parser)
    parser.add_argument("--hsa", type=common.whole(HIGHEST), default=HIGHEST, metavar="N", help="highest to ask (default 126)")
    parser.add_argument("--watch", action="store_true",
                        help="go on until Ctrl-C, and print again what changes; with --json a line for each change")


@dataclass(frozen=True)
class Picture:
    """What is shown at a time. ``own``: our address where we asked; ``master``: whom we heard and gave way to."""

    stations: Mapping[int, LiveEntry]
    own: int | None
    master: int | None

    @property
    def there(self) -> dict[int, LiveEntry]:
        return {at: entry for at, entry in self.stations.items() if entry.kind not in (Live.UNKNOWN, Live.NONE)}


# ---- words


def describe(entry: LiveEntry) -> str:
    if entry.kind != Live.SLAVE:
        return entry.kind.text
    if entry.ident_number is None:
        return "slave"
    return f"slave   {entry.ident_number:04X}h  {common.KNOWN.get(entry.ident_number, '')}".rstrip()


def grid(picture: Picture) -> Iterator[str]:
    marks = {at: MARKS[entry.kind] for at, entry in picture.stations.items()}
    if picture.own is not None:
        marks[picture.own] = OWN
    yield "       " + " ".join(map(str, range(ROW)))
    for first in range(0, max(marks) + 1, ROW):
        yield f"  {first:3}  " + " ".join(marks.get(at, " ") for at in range(first, first + ROW)).rstrip()
    unknown = "not heard" if picture.own is None else "not asked"
    legend = [f"{MARKS[kind]} {kind.text if kind else unknown}" for kind in Live if MARKS[kind] in marks.values()]
    yield "       " + "   ".join([f"{OWN} this program"] * (picture.own is not None) + legend)


def text(picture: Picture, args: argparse.Namespace) -> str:
    n = len(picture.there)
    head = f"{args.port}, {args.baudrate / 1000:g} kbit/s: {n} station{'' if n == 1 else 's'}"
    if picture.master is not None:
        head += f"; master {picture.master} has the bus, so this program only listens"
    found = [f"  {at:3}  {describe(entry)}" for at, entry in picture.there.items()]
    return "\n".join([head, "", *grid(picture), "", *(found or ["  nobody answers"])])


def as_json(picture: Picture, args: argparse.Namespace) -> str:
    return json.dumps({
        "port": str(args.port), "baudrate": args.baudrate, "address": picture.own, "foreign_master": picture.master,
        "stations": [
            {"address": at, "kind": entry.kind.name.lower(), "ident_number": entry.ident_number,
             "name": common.KNOWN.get(entry.ident_number or 0)}
            for at, entry in picture.there.items()],
        "unknown": [at for at, entry in picture.stations.items() if entry.kind == Live.UNKNOWN],
    })


# ---- pictures


def hear(listener: Listener, seconds: float) -> int | None:
    """The master that is heard within a time, if there is one."""
    end = time.monotonic() + seconds
    while listener.foreign is None and time.monotonic() < end:
        listener.wait(0.02)
    return listener.foreign


def listening(args: argparse.Namespace, seconds: float) -> Iterator[Picture]:
    """Pictures of a bus that has a master; none when there was no master to hear."""
    with Listener(args.port, args.baudrate) as listener:
        if hear(listener, seconds) is None:
            return
        listener.wait(EAVESDROP)
        while True:
            heard = {at: entry for at, entry in listener.live_list().items() if at <= args.hsa}
            yield Picture(heard, None, listener.foreign)
            listener.wait(PAUSE)


def asking(args: argparse.Namespace) -> Iterator[Picture]:
    """Pictures of a bus that has no master but us; they end when one is heard."""
    with Master(args.port, args.baudrate, args.master, ring=False, allowance=args.allowance) as master:
        while True:
            found = master.live_list(identify=True, refresh=True, highest=args.hsa)
            if master.statistics.foreign is not None:
                return
            yield Picture(found, args.master, None)
            master.feed()
            time.sleep(PAUSE)


def pictures(args: argparse.Namespace) -> Iterator[Picture]:
    """No station whose Tsl is the standard's is silent for as long as we listen first (Tto of the highest address)."""
    parameters = BusParameters.default(args.baudrate)
    attention = max(ATTENTION, parameters.seconds(parameters.tto(HIGHEST)))
    while True:
        yield from listening(args, attention)
        yield from asking(args)


def run(args: argparse.Namespace) -> int:
    shown: Picture | None = None
    try:
        for picture in pictures(args):
            if picture != shown:
                print(as_json(picture, args) if args.json else text(picture, args) + "\n" * args.watch, flush=True)
                shown = picture
            if not args.watch:
                break
    except KeyboardInterrupt:  # SIGTERM too: how --watch is meant to end
        if not args.watch:
            raise
    return 0
