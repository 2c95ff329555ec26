# SPDX-License-Identifier: MIT
"""``dpmaster ports``: the serial ports of this computer."""

from __future__ import annotations

import argparse
import json

from dpmaster.ports import Port, ports

NAME = "ports"
HELP = "list the serial ports of this computer"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def line(port: Port) -> str:
    barred = "" if port.permitted else f"for the group {port.group}" if port.group else "for root only"
    words = [port.description, f"driver {port.driver}" if port.driver else "", "the kernel's console" if port.console else "",
             barred, *(link for link in port.links if "by-id" in link)]
    return f"{port.path:<16}{port.kind:<6}{', '.join(word for word in words if word)}".rstrip()


def run(args: argparse.Namespace) -> int:
    found = ports()
    if args.json:
        print(json.dumps({"ports": [{"path": port.path, "kind": port.kind, "driver": port.driver, "links": port.links,
                                     "description": port.description, "console": port.console,
                                     "permitted": port.permitted} for port in found]}))
    else:
        print("\n".join(map(line, found)) or "no serial ports; 'dpmaster segment' makes virtual ones")
    return 0
