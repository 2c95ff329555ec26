# SPDX-License-Identifier: MIT
"""``dpmaster diag PORT STATION``: what a station says of itself (Slave_Diag), in words. It changes nothing on the station."""

from __future__ import annotations

import argparse

from dpmaster.cli import _master as common

NAME = "diag"
HELP = "read the diagnosis of a station (Slave_Diag)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_station(parser)


def run(args: argparse.Namespace) -> int:
    with common.opened(args) as master:
        found = master.slave_diag(args.station)
    clauses = found.explain()
    owner = "free, no master has it" if found.master is None else f"belongs to master {found.master}"
    lines = [f"station {args.station}: {common.device(found.ident_number)}, {owner}",
             *(f"  {clause}" for clause in clauses or ["nothing to report"]), f"  octets {found.octets.hex(' ').upper()}"]
    common.show(args, {
        "station": args.station, "ident_number": found.ident_number, "name": common.KNOWN.get(found.ident_number),
        "master": found.master, "ready": found.ready, "flags": [flag.name for flag in found.flags if flag.name],
        "texts": list(clauses), "octets": found.octets.hex()}, "\n".join(lines))
    return 0
