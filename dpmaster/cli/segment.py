# SPDX-License-Identifier: MIT
"""``dpmaster segment``: a piece of virtual wire whose ports other programs open."""

from __future__ import annotations

import argparse
import os
from contextlib import ExitStack
from pathlib import Path

from dpmaster.cli import _links as links
from dpmaster.emulator import Segment
from dpmaster.errors import ConfigurationError

NAME = "segment"
HELP = "a virtual RS-485 wire: ports (ptys) that hear one another, until SIGINT or SIGTERM"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ports", type=int, required=True, metavar="N", help="how many ports, 1 to 64")
    parser.add_argument("--link", type=Path, required=True, metavar="DIR",
                        help="directory for the symbolic links p0, p1, ... to the ports; made if it is missing")
    parser.add_argument("--baudrate", type=int, metavar="B", help="pace the wire at B bit/s; without it octets take no time")
    parser.add_argument("--echo", action="store_true", help="every port hears itself, as cheap RS-485 hats do")


def run(args: argparse.Namespace) -> int:
    if args.ports < 1:
        raise ConfigurationError(f"--ports {args.ports}: a wire that nobody can reach; give it 1 to 64")
    try:
        with ExitStack() as stack:
            wire = stack.enter_context(Segment(args.baudrate, echo=args.echo, ports=args.ports, cards=0))
            stack.enter_context(links.directory(args.link))
            for number in range(args.ports):
                link = args.link / f"p{number}"
                stack.enter_context(links.link(link, wire.port()))
                print(f"{link} -> {os.readlink(link)}", flush=True)
            links.stay(wire)
    except KeyboardInterrupt:  # SIGTERM too: how it is meant to end
        pass
    return 0
