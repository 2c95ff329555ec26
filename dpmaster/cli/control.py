# SPDX-License-Identifier: MIT
"""``dpmaster control PORT --freeze``: one Global_Control telegram, to all stations, a group or one.

Slaves obey it only from the address of the master that parameterised them (--master), while they exchange data: it is for
benches and for slaves whose master has fallen silent. A program with a Master of its own uses `global_control`.
"""

from __future__ import annotations

import argparse

from dpmaster.cli import _master as common
from dpmaster.errors import ConfigurationError

NAME = "control"
HELP = "send one Global_Control: Sync, Unsync, Freeze, Unfreeze, Clear"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_port(parser)
    sync = parser.add_mutually_exclusive_group()
    sync.add_argument("--sync", action="store_true", help="outputs take effect now and are held: motors may start or stop")
    sync.add_argument("--unsync", action="store_true", help="outputs are not held any more: motors may start or stop")
    freeze = parser.add_mutually_exclusive_group()
    freeze.add_argument("--freeze", action="store_true", help="inputs are sampled now and held")
    freeze.add_argument("--unfreeze", action="store_true", help="inputs are not held any more")
    parser.add_argument("--clear", action="store_true", help="outputs go to zero: motors may stop")
    parser.add_argument("--group", type=common.whole(8, 1), action="append", default=[], metavar="N",
                        help="a group, 1 to 8, several times for several; default: all")
    parser.add_argument("--station", type=common.whole(common.HIGHEST), metavar="N", help="one station instead")


def run(args: argparse.Namespace) -> int:
    group = sum({1 << number - 1 for number in args.group})
    names = ("sync", "unsync", "freeze", "unfreeze", "clear")
    said = [name for name in names if getattr(args, name)]
    if not said:
        raise ConfigurationError(f"no command: give one of --{', --'.join(names)}")
    with common.opened(args) as master:
        master.global_control(sync=_either(args.sync, args.unsync), freeze=_either(args.freeze, args.unfreeze),
                              clear=args.clear or None, group=group, station=args.station)
    groups = f"group {' and '.join(map(str, sorted(set(args.group))))}" if group else "all stations"
    whom = groups if args.station is None else f"station {args.station}"
    common.show(args, {"commands": said, "group_select": group, "station": args.station, "address": args.master},
                f"{', '.join(said)} sent to {whom} as master {args.master}; nobody answers Global_Control")
    return 0


def _either(on: bool, off: bool) -> bool | None:
    return True if on else False if off else None
