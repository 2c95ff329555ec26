# SPDX-License-Identifier: MIT
"""``dpmaster diag PORT STATION``: what a station says of itself (Slave_Diag), in words. It changes nothing on the station."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

from dpmaster.cli import _master as common
from dpmaster.cli._terminal import printable
from dpmaster.gsd import GSD

NAME = "diag"
HELP = "read the diagnosis of a station (Slave_Diag)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_station(parser)
    parser.add_argument("--gsd", metavar="FILE", help="the station's GSD file: what it reports in its maker's words")


def run(args: argparse.Namespace) -> int:
    gsd = None if args.gsd is None else GSD.load(args.gsd)
    with common.opened(args) as master:
        found = master.slave_diag(args.station)
    if gsd is not None and gsd.ident_number != found.ident_number:
        print(f"dpmaster diag: {args.gsd} is that of another device, ident {gsd.ident_number or 0:04X}h", file=sys.stderr)
        gsd = None
    clauses = found.explain() if gsd is None else replace(found, dpv1=gsd.dpv1).explain(gsd.texts)
    owner = "free, no master has it" if found.master is None else f"belongs to master {found.master}"
    lines = [f"station {args.station}: {common.device(found.ident_number)}, {owner}",
             *(printable(f"  {clause}") for clause in clauses or ["nothing to report"]),
             f"  octets {found.octets.hex(' ').upper()}"]
    common.show(args, {
        "station": args.station, "ident_number": found.ident_number, "name": common.KNOWN.get(found.ident_number),
        "master": found.master, "ready": found.ready, "flags": [flag.name for flag in found.flags if flag.name],
        "texts": list(clauses), "octets": found.octets.hex()}, "\n".join(lines))
    return 0
