# SPDX-License-Identifier: MIT
"""``dpmaster segment``: a piece of virtual wire whose ports other programs open."""

from __future__ import annotations

import argparse
import inspect
import os
from contextlib import ExitStack
from pathlib import Path

from dpmaster.cli import _links as links
from dpmaster.emulator import Segment
from dpmaster.errors import ConfigurationError

NAME = "segment"
HELP = "a virtual RS-485 wire: ports (ptys) that hear one another, until SIGINT or SIGTERM"
FAULTS = {name: type(parameter.default) for name, parameter in inspect.signature(Segment.faults).parameters.items()
          if parameter.kind is parameter.KEYWORD_ONLY}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ports", type=int, required=True, metavar="N", help="how many ports, 1 to 64")
    parser.add_argument("--link", type=Path, required=True, metavar="DIR",
                        help="directory for the symbolic links p0, p1, ... to the ports; made if it is missing")
    parser.add_argument("--baudrate", type=int, metavar="B", help="pace the wire at B bit/s; without it octets take no time")
    parser.add_argument("--echo", action="store_true", help="every port hears itself, as cheap RS-485 hats do")
    parser.add_argument("--fault", action="append", default=[], type=fault, metavar="NAME=VALUE",
                        help="make a fault, as often as wanted. Chances of an octet, 0.0 to 1.0: lost (lose), changed unseen "
                             "(flip) or with a parity error (parity), twice (duplicate), behind a random one (insert); of a "
                             "whole transmission: lost (lose_telegram). In s: a delay (delay), the time between deliveries, as "
                             "an adapter's (chunk). The same seed makes the same faults (seed)")


def fault(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, FAULTS[name](value)
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r}: NAME=VALUE with a number, NAME one of {', '.join(FAULTS)}") from None


def run(args: argparse.Namespace) -> int:
    if args.ports < 1:
        raise ConfigurationError(f"--ports {args.ports}: a wire that nobody can reach; give it 1 to 64")
    try:
        with ExitStack() as stack:
            wire = stack.enter_context(Segment(args.baudrate, echo=args.echo, ports=args.ports, cards=0))
            wire.faults(**dict(args.fault))
            stack.enter_context(links.directory(args.link))
            for number in range(args.ports):
                link = args.link / f"p{number}"
                stack.enter_context(links.link(link, wire.port()))
                print(f"{link} -> {os.readlink(link)}", flush=True)
            links.stay(wire)
    except KeyboardInterrupt:  # SIGTERM too: how it is meant to end
        pass
    return 0
