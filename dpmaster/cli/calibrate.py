# SPDX-License-Identifier: MIT
"""``dpmaster calibrate PORT``: how late this host hears behind a port, and what follows from it."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict

from dpmaster.calibration import Calibration, calibrate
from dpmaster.errors import DPError
from dpmaster.parameters import BAUDRATES, TSL_MAX, BusParameters

NAME = "calibrate"
HELP = "measure how late this host hears behind a port, by its echo or a slave's answers"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="path of a serial port or of a segment's port")
    parser.add_argument("--baudrate", type=int, default=500_000, metavar="B", help="bit/s (default 500000)")
    parser.add_argument("--station", type=int, metavar="N", help="the slave to ask (default: the echo, or the first slave)")
    parser.add_argument("--master", type=int, default=1, metavar="A", help="this program's own address (default 1)")
    parser.add_argument("--count", type=int, default=300, metavar="N", help="how many requests (default 300)")
    parser.add_argument("--direction", choices=["rs485", "rs485-inverted"], help="the driver switches the direction")
    parser.add_argument("--output", metavar="FILE", help="write the result, for Calibration.load(FILE).allowance")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def ms(seconds: float) -> str:
    return f"{round(seconds * 1000, 3):g} ms"


def text(found: Calibration) -> str:
    lines = [f"{found.port} at {found.baudrate / 1000:g} kbit/s, by {found.by}, {found.samples} times, on {found.machine}", "",
             f"  heard late by       {ms(found.mean)} in the mean, 99 % within {ms(found.p99)}, at most {ms(found.worst)}",
             f"  allowance           {ms(found.allowance)}, three times the worst: Master(..., allowance={found.allowance:g})",
             f"  {'':<20}in a bus file: allowance = {found.allowance:g}"]
    if found.rate is not None:
        off = (found.rate / float(BusParameters.default(found.baudrate).rate) - 1) * 100
        lines.append(f"  rate                {found.rate / 1000:.4g} kbit/s measured, {off:+.2f} %"
                     + ("" if abs(off) < 1 else ": no line is paced by it (an emulated UART, or an adapter that buffers)"))
    lines += ["", "  alone on the bus    any rate that the port makes", "  in a ring           with Tsl in every master:"]
    for rate in BAUDRATES:
        tsl = found.tsl(rate)
        lines.append(f"  {rate / 1000:>14g} kbit/s  " + (f"{tsl} Tbit" if tsl else f"no: Tsl ends at {TSL_MAX} Tbit"))
    return "\n".join(lines)


def run(args: argparse.Namespace) -> int:
    found = calibrate(args.port, args.baudrate, address=args.master, station=args.station, count=args.count,
                      direction=args.direction, said=lambda words: print(words, file=sys.stderr))
    print(json.dumps({**asdict(found), "ring_rates": found.ring_rates}) if args.json else text(found))
    if args.output:
        try:
            found.save(args.output)
        except OSError as error:
            raise DPError(f"--output {args.output}: {error.strerror}; name a file that can be written") from None
    return 0
