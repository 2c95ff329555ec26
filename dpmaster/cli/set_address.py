# SPDX-License-Identifier: MIT
"""``dpmaster set-address PORT OLD NEW --ident N``: give a slave another address (Set_Slave_Add), and see that it has it."""

from __future__ import annotations

import argparse

from dpmaster.cli import _master as common

NAME = "set-address"
HELP = "give a slave that no master uses another address (Set_Slave_Add)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_port(parser)
    parser.add_argument("old", type=common.whole(common.UNADDRESSED), metavar="OLD",
                        help="its address now; 126 as it leaves the factory")
    parser.add_argument("new", type=common.whole(common.HIGHEST), metavar="NEW", help="its address from now on, 0 to 125")
    parser.add_argument("--ident", type=common.ident, required=True, metavar="HEX",
                        help="its ident number, which it must tell first; 'dpmaster diag' shows it")
    parser.add_argument("--lock", action="store_true", help="it keeps this address until it is reset to factory settings")


def run(args: argparse.Namespace) -> int:
    with common.opened(args) as master:
        master.set_slave_add(args.old, args.new, args.ident, args.lock)
    common.show(args, {"old": args.old, "new": args.new, "ident_number": args.ident, "locked": args.lock},
                f"station {args.old} is station {args.new} now: {common.device(args.ident)}{', locked' * args.lock}")
    return 0
