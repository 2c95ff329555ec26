# SPDX-License-Identifier: MIT
"""``dpmaster emulate``: an option card with a drive behind it, on a pty of its own or on somebody else's wire."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from dpmaster.cli import _links as links
from dpmaster.emulator import Card, Line, Segment
from dpmaster.emulator.cards import SIP1

NAME = "emulate"
HELP = "an emulated option card with its drive and motor, until SIGINT or SIGTERM"

RATE = 500_000  # bit/s of --on without --baudrate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("card", choices=["si-p1"], help="si-p1: Yaskawa V7 with SI-P1")
    parser.add_argument("--address", type=int, required=True, metavar="N", help="station address")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--link", type=Path, metavar="PATH",
                       help="a pty of its own (the path is the first line printed) with a symbolic link to it at PATH")
    where.add_argument("--on", metavar="PATH", help="join the wire at this serial port or segment's port")
    parser.add_argument("--baudrate", type=int, metavar="B",
                        help=f"bit/s: paces the card's own pty, which without it is unpaced; with --on {RATE} by default")
    parser.add_argument("--parameters", choices=["commissioned", "factory"], default="commissioned",
                        help="the drive's parameters: ready for the bus (default), or as it leaves the factory")


def run(args: argparse.Namespace) -> int:
    card = SIP1(args.address, parameters=args.parameters)
    try:
        if args.on is not None:
            _join(card, args)
        else:
            _host(card, args)
    except KeyboardInterrupt:  # SIGTERM too: how it is meant to end
        pass
    return 0


def _join(card: Card, args: argparse.Namespace) -> None:
    with Line(args.on, card, baudrate=args.baudrate or RATE) as line:
        print(args.on, flush=True)
        links.stay(line)


def _host(card: Card, args: argparse.Namespace) -> None:
    with ExitStack() as stack:
        wire = stack.enter_context(Segment(args.baudrate, ports=1, cards=1))
        wire.attach(card)
        path = wire.port()
        if args.link is not None:
            stack.enter_context(links.link(args.link, path))
        print(path, flush=True)
        links.stay(wire)
