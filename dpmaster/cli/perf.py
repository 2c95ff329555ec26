# SPDX-License-Identifier: MIT
"""``dpmaster perf``: a histogram of how late cycles begin on this computer."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from dpmaster.errors import DPError
from dpmaster.perf import Punctuality, measure, svg
from dpmaster.realtime import Realtime

NAME = "perf"
HELP = "measure how late bus cycles begin on this computer, as text and as a picture"

BAR = 40  # columns


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", nargs="?", help="a port with no other master on it (default: a virtual wire)")
    parser.add_argument("--baudrate", type=int, default=500_000, metavar="B", help="bit/s (default 500000)")
    parser.add_argument("--cycle-time", type=float, default=2.0, metavar="MS", help="ms from one cycle to the next (default 2)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="how long (default 10)")
    parser.add_argument("--priority", type=int, default=Realtime().priority, metavar="P",
                        help="of SCHED_FIFO, 0: ordinary scheduling (default %(default)s)")
    parser.add_argument("--cpu", type=int, metavar="N", help="the CPU to run on")
    parser.add_argument("--svg", metavar="FILE", help="write a picture too")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def text(found: Punctuality) -> str:
    most = max(each.cycles for each in found.classes).bit_length() or 1
    lines = [found.title, ""]
    for each in found.classes:
        label = f"< {each.below} us" if each.below else "more"
        bar = "#" * (BAR * each.cycles.bit_length() // most)
        lines.append(f"{label:>14}  {each.cycles:>9}  {bar}")
    half, most_of = found.within(0.5), found.within(0.999)
    summary = (f"half of them within {half or 'more'} us, 99.9 % within {most_of or 'more'} us, at most "
               f"{found.worst * 1e6:.0f} us; {found.skipped} skipped (bars are logarithmic)")
    return "\n".join([*lines, "", summary, *found.scheduling.refused])


def run(args: argparse.Namespace) -> int:
    realtime = Realtime(args.priority, args.cpu) if args.priority else False
    found = measure(args.port, args.baudrate, cycle_time=args.cycle_time / 1000, duration=args.seconds, realtime=realtime)
    print(json.dumps(asdict(found)) if args.json else text(found))
    if args.svg:
        try:
            Path(args.svg).write_text(svg(found))
        except OSError as error:
            raise DPError(f"--svg {args.svg}: {error.strerror}; name a file that can be written") from None
    return 0
