# SPDX-License-Identifier: MIT
"""``dpmaster drive PORT ... ACTION``: one drive by hand: look at it, turn it, stop it, read and write its parameters.

The program is the bus's master for as long as the action lasts, and this drive its only station. It calls what any program
calls of any drive; both watchdogs are on. However it ends, the drive has had its stop word.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

from dpmaster import Master
from dpmaster.cli._master import add_allowance
from dpmaster.cli.demo import SLOW, number
from dpmaster.drives import PROFILES, Drive, DriveStatus
from dpmaster.errors import ConfigurationError, DPTimeout, StationError

NAME = "drive"
HELP = "look at a drive, run and stop it, read and write its parameters"

CYCLE = 0.005  # s
REDRAW = 0.1  # s between two pictures on a terminal, and between two lines elsewhere
LINE = 1.0
SILENT = 5.0  # s without a frame of the drive, after which there is nobody to look at
SUBJECT = 12  # columns
FLAGS = ("running", "reverse", "zero_speed", "at_speed", "ready", "alarm", "fault", "remote")
UNITS = {"": 1.0, "s": 1.0, "ms": 0.001, "min": 60.0, "h": 3600.0}


def duration(text: str) -> float:
    """Seconds of "10", "10s", "500ms", "2min", "1h"."""
    match = re.fullmatch(r"([\d.]+)\s*([a-z]*)", text.strip())
    try:
        seconds = float(match[1]) * UNITS[match[2]] if match else 0.0
    except (KeyError, ValueError):
        seconds = 0.0
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: a time like 10s, 500ms, 2min or 1h")
    return seconds


def assignment(text: str) -> tuple[str, float]:
    """A parameter and its value of "n019=40", "d1-17=6.00" or "n019=0x28"."""
    name, equals, value = (part.strip() for part in text.partition("="))
    try:
        found: float = int(value, 0) if re.fullmatch(r"[+-]?(\d+|0[xX][\da-fA-F]+)", value) else float(value)
    except ValueError:
        found = math.nan
    if not name or not equals or not math.isfinite(found):
        raise argparse.ArgumentTypeError(f"{text!r}: NAME=VALUE, with a number")
    return name, found


def option(text: str) -> tuple[str, float | str]:
    """An argument of a drive class, "maximum_frequency=50" or "index=byte"."""
    name, equals, given = (part.strip() for part in text.partition("="))
    if not name.isidentifier() or not equals:
        raise argparse.ArgumentTypeError(f"{text!r}: NAME=VALUE")
    return assignment(text) if re.fullmatch(r"[-+]?[\d.]+", given) else (name, given)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="path of a serial port or of a segment's port")
    parser.add_argument("--address", type=int, required=True, metavar="N", help="the drive's station address")
    parser.add_argument("--profile", choices=PROFILES, required=True, help="which drive it is")
    parser.add_argument("--configuration", metavar="NAME", help="the configuration by its manual's name, like 'Basic data'")
    parser.add_argument("--option", type=option, action="append", default=[], metavar="NAME=VALUE",
                        help="an argument of its class, like maximum_frequency=50")
    parser.add_argument("--baudrate", type=int, default=500_000, metavar="B", help="bit/s (default 500000)")
    parser.add_argument("--master", type=int, default=1, metavar="A", help="this program's own address (default 1)")
    add_allowance(parser)
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print one JSON object")

    def add(action: Callable[[argparse.Namespace, Drive[Any]], int], text: str) -> argparse.ArgumentParser:
        name = action.__name__.removesuffix("_")
        added = actions.add_parser(name, help=text, description=text, parents=[common])
        added.set_defaults(action=action)
        return added

    add(status, "what the drive says of itself")
    running = add(run_, "run until Ctrl-C, then stop")
    speed = running.add_mutually_exclusive_group(required=True)
    speed.add_argument("--frequency", type=number(0, 1000), metavar="HZ", help="how fast, in Hz")
    speed.add_argument("--percent", type=number(0, 100), metavar="P", help="how fast, in per cent of its highest frequency")
    running.add_argument("--reverse", action="store_true", help="run in reverse")
    running.add_argument("--reset", action="store_true",
                         help="reset a fault first: most drives show one since a master, this program too, last left their bus")
    running.add_argument("--for", type=duration, dest="seconds", metavar="TIME", help="stop after a time: 10s, 500ms, 2min")
    stopping = add(stop, "give it the stop word and wait until it stands")
    for each in (running, stopping):
        each.add_argument("--stop-within", type=duration, default=30.0, metavar="TIME",
                          help="how long its ramp to a standstill may take (default 30s)")
    add(reset, "reset a fault whose cause is gone")
    reading = add(get, "read parameters")
    reading.add_argument("names", nargs="*", metavar="NAME", help="as the drive's manual names them; none: all with a table")
    writing = add(set_, "write parameters and read them back")
    writing.add_argument("--store", action="store_true", help="keep them in the drive's EEPROM, where its card can be told so")
    writing.add_argument("assignments", nargs="+", type=assignment, metavar="NAME=VALUE", help="in the unit that `get` shows")


def run(args: argparse.Namespace) -> int:
    drive = make(args)
    with Master(args.port, args.baudrate, args.master, cycle_time=CYCLE, allowance=args.allowance) as master:
        master.add(drive)
        master.operate()
        code: int = args.action(args, drive)
        return code


def make(args: argparse.Namespace) -> Drive[Any]:
    options = dict(args.option) | ({} if args.configuration is None else {"configuration": args.configuration})
    known = inspect.signature(PROFILES[args.profile]).parameters
    for name in options:
        if name not in known:
            raise ConfigurationError(f"--option {name}: {args.profile} has {', '.join(list(known)[1:])}")
    # A machine that is busy with something else shall not stop the drive; the output watchdog has a second, too.
    options.setdefault("watchdog", 1.0 if args.baudrate > SLOW else 5.0)
    return PROFILES[args.profile](args.address, **options)


# ---- words


def common(drive: Drive[Any], seen: DriveStatus) -> dict[str, object]:
    """What every drive's status has."""
    found: dict[str, object] = {flag: getattr(seen, flag) for flag in FLAGS}
    return found | {"output_frequency": seen.output_frequency, "current": seen.current, "faults": drive.faults()}


def words(seen: DriveStatus) -> str:
    return ", ".join(flag.replace("_", " ") for flag in FLAGS if getattr(seen, flag)) or "nothing"


def value(amount: float | None, unit: str) -> str:
    return f"- {unit}" if amount is None else f"{amount:.2f} {unit}"


def output(seen: DriveStatus) -> str:
    """Hz, or per cent where a configuration has only these."""
    percent = getattr(seen, "percent", None)
    return value(percent, "%") if seen.output_frequency is None and percent is not None else value(seen.output_frequency, "Hz")


def told(args: argparse.Namespace, subject: str, text: str) -> None:
    if not args.json:
        print(f"{subject:<{SUBJECT}}{text}", flush=True)


def learn(drive: Drive[Any]) -> float | None:
    """100 %, Hz; None where the drive cannot be asked. From then on its status has frequencies."""
    try:
        return drive.highest_frequency
    except ConfigurationError:
        return None


# ---- actions


def status(args: argparse.Namespace, drive: Drive[Any]) -> int:
    highest = learn(drive)
    seen = drive.wait_until(lambda s: True, SILENT)
    diagnosis = drive.diagnosis
    if args.json:
        print(json.dumps({"address": drive.address, "profile": args.profile, "configuration": drive.layout,
                          **common(drive, seen), "highest_frequency": highest, "status": asdict(seen),
                          "diagnosis": None if diagnosis is None else diagnosis.octets.hex()}))
        return 0
    told(args, "drive", f"{type(drive).__name__} at address {drive.address}, {drive.layout}")
    told(args, "state", words(seen))
    told(args, "output", output(seen) + ("" if highest is None else f" (100 % is {highest:.2f} Hz)"))
    told(args, "current", value(seen.current, "A"))
    told(args, "faults", ", ".join(drive.faults()) or "none")
    told(args, "words", str(seen))
    told(args, "diagnosis", drive.explain_diagnosis() or "nothing to report")
    return 0


def run_(args: argparse.Namespace, drive: Drive[Any]) -> int:
    begin = time.monotonic()
    try:
        clean(args, drive)
        drive.run(args.frequency, percent=args.percent, reverse=args.reverse)
        told(args, "run", f"{'reverse' if args.reverse else 'forward'} at "
                          + (f"{args.percent:g} %" if args.frequency is None else f"{args.frequency:.2f} Hz")
                          + ("; Ctrl-C stops it" if args.seconds is None else f" for {args.seconds:g} s"))
        for seen in follow(args, drive, math.inf if args.seconds is None else args.seconds):
            if seen.fault:
                raise fault(drive, seen, "stopped by a fault")
    except KeyboardInterrupt:
        if args.seconds is not None:
            halt(args, drive, begin)
            raise
    return halt(args, drive, begin)


def clean(args: argparse.Namespace, drive: Drive[Any]) -> None:
    """Begin without a fault; to reset one unasked is not this program's to decide."""
    seen = drive.wait_until(lambda s: True, SILENT)
    if seen.fault and not args.reset:
        raise fault(drive, seen, "shows a fault; run --reset resets it first (drives show one since a master left their bus)")
    if seen.fault:
        told(args, "reset", ", ".join(drive.faults()))
        drive.fault_reset()


def fault(drive: Drive[Any], seen: DriveStatus, text: str) -> StationError:
    return StationError(f"{drive.name} {text}: {', '.join(drive.faults()) or 'gone again'} (status: {seen})",
                        address=drive.address, reason="fault")


def stop(args: argparse.Namespace, drive: Drive[Any]) -> int:
    return halt(args, drive, time.monotonic())


def halt(args: argparse.Namespace, drive: Drive[Any], begin: float) -> int:
    """The stop word, and the ramp down; the drive is left when it stands, or when the time for that is over."""
    drive.stop()
    told(args, "stop", "the ramp down")
    seen = drive.status
    for seen in follow(args, drive, args.stop_within):
        if seen.zero_speed and not seen.running:
            break
    else:
        raise DPTimeout(f"{drive.name} turns still, {args.stop_within:g} s after its stop word (status: {seen}); it is "
                        "released and goes on as its own parameters say: look at its deceleration time, or give --stop-within")
    if args.json:
        print(json.dumps({"seconds": round(time.monotonic() - begin, 3), **common(drive, seen)}))
    else:
        told(args, "stands", f"after {time.monotonic() - begin:.1f} s")
    return 0


def follow(args: argparse.Namespace, drive: Drive[Any], seconds: float) -> Iterator[DriveStatus]:
    """The drive's status, shown as it changes. Waiting for it feeds the output watchdog."""
    moving = sys.stdout.isatty() and not args.json
    shown, end, due = "", time.monotonic() + seconds, 0.0
    try:
        while (now := time.monotonic()) < end:
            look = min(end, now + REDRAW)
            seen = drive.wait_until(lambda s: s.fault or time.monotonic() >= look, REDRAW + SILENT)  # noqa: B023
            text = f"  {output(seen):>10}  {value(seen.current, 'A'):>8}  {words(seen)}"
            if moving:
                width = shutil.get_terminal_size().columns - 1
                print("\r" + text[:width].ljust(width), end="", flush=True)
            elif not args.json and text != shown and time.monotonic() >= due:
                print(text, flush=True)
                shown, due = text, time.monotonic() + LINE
            yield seen
    finally:
        if moving:
            print(flush=True)


def reset(args: argparse.Namespace, drive: Drive[Any]) -> int:
    drive.fault_reset()
    seen = drive.wait_until(lambda s: True, SILENT)
    if args.json:
        print(json.dumps(common(drive, seen)))
    else:
        told(args, "reset", f"no fault; {words(seen)}")
    return 0


def get(args: argparse.Namespace, drive: Drive[Any]) -> int:
    return show_parameters(args, drive, args.names or drive.parameter_names)


def set_(args: argparse.Namespace, drive: Drive[Any]) -> int:
    drive.write(dict(args.assignments), store=args.store)
    return show_parameters(args, drive, [name for name, _ in args.assignments])


def show_parameters(args: argparse.Namespace, drive: Drive[Any], names: list[str] | tuple[str, ...]) -> int:
    values = {}
    for name in names:
        values[name] = drive[name]
        told(args, name, drive.parameter(name).describe(values[name]))
    if args.json:
        print(json.dumps(values))
    return 0
