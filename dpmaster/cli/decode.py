# SPDX-License-Identifier: MIT
"""``dpmaster decode HEX...``: telegrams to readable lines. Reads arguments or standard input, touches no port."""

from __future__ import annotations

import argparse
import json
import re
import sys
from dataclasses import asdict

from dpmaster.errors import ConfigurationError
from dpmaster.telegram import Rejected, Telegram, decode_all

NAME = "decode"
HELP = "decode telegrams written as hex octets"
EXAMPLE = "10 05 02 49 50 16"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("hex", nargs="+", metavar="HEX",
                        help="octets, with or without blanks, colons, commas or 0x; - reads standard input")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.epilog = "exit code 1 when some octets belong to no good telegram"


def parse(text: str) -> bytes:
    """Hex digits to octets. ConfigurationError names the first word that is none."""
    octets = bytearray()
    for word in re.split(r"[\s:,;-]+", text):
        digits = re.sub(r"^0[xX]", "", word)
        if not re.fullmatch(r"(?:[0-9a-fA-F]{2})*", digits):
            raise ConfigurationError(f"{word[:20]!r} is not hex octets: write two digits for each, such as {EXAMPLE}")
        octets += bytes.fromhex(digits)
    if not octets:
        raise ConfigurationError(f"no octets to decode: give hex digits, such as {EXAMPLE}, or - and standard input")
    return bytes(octets)


def fields(item: Telegram | Rejected) -> dict[str, object]:
    """What --json prints: the fields by their names, octets as hex, the derived names for a reader's convenience."""
    if isinstance(item, Rejected):
        return {"rejected": item.reason, "octets": item.octets.hex()}
    known = asdict(item) | {"format": item.format.name if item.format else None, "data": item.data.hex()}
    return known | {
        "function": item.function, "request": item.is_request, "fcb": item.fcb, "fcv": item.fcv,
        "station_type": item.station_type, "service": item.service, "text": item.describe(),
    }


def line(item: Telegram | Rejected) -> str:
    if isinstance(item, Rejected):
        return item.describe()
    return f"{item.format.name if item.format else '':4}{item.describe()}"


def run(args: argparse.Namespace) -> int:
    words: list[str] = args.hex
    text = " ".join(sys.stdin.read() if word == "-" else word for word in words)
    good = True
    for item in decode_all(parse(text)):
        print(json.dumps(fields(item)) if args.json else line(item))
        good = good and isinstance(item, Telegram)
    return 0 if good else 1
