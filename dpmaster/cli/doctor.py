# SPDX-License-Identifier: MIT
"""``dpmaster doctor PORT``: what is good and bad about a port and this computer, and what to do about it. It sends nothing."""

from __future__ import annotations

import argparse
import json
import shutil
import textwrap

from dpmaster.doctor import Diagnosis, Remark, examine

NAME = "doctor"
HELP = "examine a port and this computer: rates, permissions, RS-485 mode, latency, kernel; it sends nothing"

SUBJECT = 20  # columns


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="path of a serial port")
    parser.add_argument("--baudrate", type=int, metavar="B", help="also listen to the bus at B bit/s for a second")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def text(remark: Remark, width: int) -> str:
    head = f"{remark.level.value:<6}{remark.subject:<{SUBJECT - 6}}"
    rows = textwrap.wrap(remark.text, width - SUBJECT, break_on_hyphens=False)
    if remark.remedy:
        rows += textwrap.wrap(f"-> {remark.remedy}", width - SUBJECT, break_on_hyphens=False, subsequent_indent="   ")
    return head + f"\n{'':{SUBJECT}}".join(rows)


def as_object(found: Diagnosis) -> dict[str, object]:
    return {
        "port": found.port.path, "kind": found.port.kind, "driver": found.port.driver, "works": found.works,
        "rates": {str(rate.nominal): rate.made for rate in found.rates},
        "remarks": [{"level": remark.level.value, "subject": remark.subject, "text": remark.text, "remedy": remark.remedy}
                    for remark in found.remarks],
    }


def run(args: argparse.Namespace) -> int:
    found = examine(args.port, args.baudrate)
    if args.json:
        print(json.dumps(as_object(found)))
    else:
        width = min(110, shutil.get_terminal_size().columns)
        print(f"{found.port.path}\n")
        print("\n".join(text(remark, width) for remark in found.remarks))
    return 0 if found.works else 1
