# SPDX-License-Identifier: MIT
"""``dpmaster bridge URL``: a serial converter on the network as a port of this computer."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from dpmaster.bridge import Bridge
from dpmaster.cli import _links as links

NAME = "bridge"
HELP = "a converter on the network (socket://, rfc2217://) as a port, until SIGINT or SIGTERM"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("url", metavar="URL", help="socket://HOST:PORT or rfc2217://HOST:PORT")
    parser.add_argument("--baudrate", type=int, default=500_000, metavar="B", help="bit/s (default 500000)")
    parser.add_argument("--link", type=Path, metavar="PATH", help="make a symbolic link to the port at PATH")


def run(args: argparse.Namespace) -> int:
    try:
        with ExitStack() as stack:
            bridge = stack.enter_context(Bridge(args.url, args.baudrate))
            if args.link is not None:
                stack.enter_context(links.link(args.link, bridge.path))
            print(bridge.path, flush=True)
            links.stay(bridge)
    except KeyboardInterrupt:  # SIGTERM too: how it is meant to end
        pass
    return 0
