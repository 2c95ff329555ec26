# SPDX-License-Identifier: MIT
"""What the commands that open a master share: port, rate, own address, addresses of stations, and JSON."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping

from dpmaster import Master

RATE = 500_000
HIGHEST = 125  # address of a station in use
UNADDRESSED = 126  # of a slave that waits for its own
KNOWN = {0x00CA: "Yaskawa V7, SI-P1", 0x0ACF: "Yaskawa V1000/A1000, SI-P3", 0x0E2F: "Altivar ATV340, VW3A3607"}


def whole(highest: int, lowest: int = 0) -> Callable[[str], int]:
    """The type of an argument from `lowest` to `highest`, decimal or with 0x in front."""

    def parse(text: str) -> int:
        try:
            value = int(text, 0)
        except ValueError:
            value = -1
        if not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(f"{text!r}: a whole number from {lowest} to {highest}")
        return value

    return parse


def ident(text: str) -> int:
    """The type of an ident number, which everybody writes in hex: 0ACF, 0x0ACF, 0ACFh."""
    digits = text.lower().removeprefix("0x").removesuffix("h")
    try:
        value = int(digits, 16)
    except ValueError:
        value = -1
    if not 0 <= value <= 0xFFFF or not digits.isalnum():
        raise argparse.ArgumentTypeError(f"{text!r}: an ident number, four hex digits like 0ACF")
    return value


def milliseconds(text: str) -> float:
    """The type of an argument in ms; in s."""
    try:
        return float(text) / 1000
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: a number of ms") from None


def add_allowance(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--allowance", type=milliseconds, metavar="MS",
                        help="how late this host hears, as dpmaster calibrate says (default: by the kind of port)")


def add_port(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="path of a serial port or of a segment's port")
    parser.add_argument("--baudrate", type=int, default=RATE, metavar="B", help=f"bit/s (default {RATE})")
    parser.add_argument("--master", type=whole(HIGHEST), default=0, metavar="A",
                        help="this program's own address, which no other station may have (default 0)")
    add_allowance(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def add_station(parser: argparse.ArgumentParser) -> None:
    """The port and one station, its address last."""
    add_port(parser)
    parser.add_argument("station", type=whole(UNADDRESSED), metavar="STATION", help="address of the station, 0 to 126")


def opened(args: argparse.Namespace) -> Master:
    """The master of a command that asks stations and starts none."""
    return Master(args.port, args.baudrate, args.master, output_watchdog=None, allowance=args.allowance)


def device(ident_number: int) -> str:
    """ "0ACFh (Yaskawa V1000/A1000, SI-P3)"."""
    name = KNOWN.get(ident_number)
    return f"{ident_number:04X}h" + (f" ({name})" if name else "")


def show(args: argparse.Namespace, facts: Mapping[str, object], text: str) -> None:
    """One JSON object, or the text."""
    print(json.dumps({"port": str(args.port), **facts}) if args.json else text)
