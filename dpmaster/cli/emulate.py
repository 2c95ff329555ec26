# SPDX-License-Identifier: MIT
"""``dpmaster emulate``: a slave on a pty of its own or on somebody else's wire: an option card with a drive behind it, or one
that is described by data, a GSD file among them, and has a console."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dpmaster.cli import _console as console
from dpmaster.cli import _links as links
from dpmaster.cli._master import milliseconds
from dpmaster.emulator import Card, Habits, Host, Line, Segment
from dpmaster.emulator.cards import SIP1, SIP3, GenericSlave
from dpmaster.errors import ConfigurationError
from dpmaster.parameters import TSL_MAX

NAME = "emulate"
HELP = "an emulated slave - an option card with its drive and motor, or one described by data - until SIGINT or SIGTERM"

RATE = 500_000  # bit/s of --on without --baudrate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    cards = parser.add_subparsers(metavar="CARD", dest="card", required=True)
    _add(cards, "si-p1", "Yaskawa V7 with SI-P1", _sip1_arguments)
    _add(cards, "si-p3", "Yaskawa V1000 or A1000 with SI-P3", _sip3_arguments)
    _add(cards, "generic", "any slave, described by ident number and configuration, with a console", _generic_arguments)
    _add(cards, "gsd", "any slave, described by its GSD file, with a console", _gsd_arguments)


def _add(cards: argparse._SubParsersAction[argparse.ArgumentParser], name: str, what: str,
         arguments: Callable[[argparse.ArgumentParser], None]) -> None:
    parser = cards.add_parser(name, help=what, description=what, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--address", type=int, required=True, metavar="N", help="station address")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--link", type=Path, metavar="PATH",
                       help="a pty of its own (the path is the first line printed) with a symbolic link to it at PATH")
    where.add_argument("--on", "--port", metavar="PATH", help="join the wire at this serial port or segment's port")
    parser.add_argument("--direction", choices=["rs485", "rs485-inverted"], help="with --on: the driver switches the direction")
    parser.add_argument("--allowance", type=milliseconds, metavar="MS",
                        help="with --on: how late this host hears, as dpmaster calibrate says (default: by the kind of port)")
    parser.add_argument("--baudrate", type=int, metavar="B",
                        help=f"bit/s: paces the card's own pty, which without it is unpaced; with --on {RATE} by default")
    habits = "; ".join(f"{name} {'|'.join(words)}" for name, words in Habits.WORDS.items())
    parser.add_argument("--habit", action="append", default=[], metavar="NAME=WORD",
                        help=f"what it does where the standard's readers disagree, the default first: {habits}")
    arguments(parser)


def _sip1_arguments(parser: argparse.ArgumentParser) -> None:
    _drive_arguments(parser, "n019=50")
    parser.set_defaults(make=_sip1)


def _sip3_arguments(parser: argparse.ArgumentParser) -> None:
    _drive_arguments(parser, "C1-01=50")
    parser.set_defaults(make=lambda args: SIP3(args.address, parameters=args.parameters, settings=_settings(args.settings)))


def _drive_arguments(parser: argparse.ArgumentParser, example: str) -> None:
    parser.add_argument("--parameters", choices=["commissioned", "factory"], default="commissioned",
                        help="the drive's parameters: ready for the bus (default), or as it leaves the factory")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=COUNT", dest="settings",
                        help=f"set one of them beforehand, as with the keypad: {example}; once more for each further one")


def _settings(given: list[str]) -> dict[str, int]:
    found = {}
    for setting in given:
        name, _, count = setting.partition("=")
        try:
            found[name.strip()] = int(count, 0)
        except ValueError:
            raise ConfigurationError(f"--set {setting}: NAME=COUNT, the count a whole number") from None
    return found


def _sip1(args: argparse.Namespace) -> Card:
    card = SIP1(args.address, parameters=args.parameters)
    for name, count in _settings(args.settings).items():
        card.registers[name] = count
    return card


def _gsd_arguments(parser: argparse.ArgumentParser) -> None:
    parser.usage = "dpmaster emulate gsd FILE [--module NAME ...] --address N [options]"
    parser.add_argument("file", metavar="FILE", help="the device's GSD file")
    parser.add_argument("--module", action="extend", nargs="+", metavar="NAME",
                        help="modules by the file's names, in the order of their slots; default: those the file settles")
    _common_arguments(parser)
    parser.set_defaults(make=_gsd)


def _generic_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ident", required=True, metavar="HEX", help="ident number")
    parser.add_argument("--config", required=True, action="append", metavar="HEX",
                        help="identifier octets; once more for each further configuration that it accepts")
    parser.add_argument("--user-parameters", default="0-237", metavar="MIN-MAX", help="octets of User_Prm_Data it takes")
    parser.add_argument("--max-diagnosis", type=int, default=244, metavar="N", help="longest diagnosis, 6 to 244")
    parser.add_argument("--min-slave-interval", type=int, default=0, metavar="N",
                        help="in 100 us; what comes sooner is counted")
    for option, what in (("--fail-safe", "takes an empty Data_Exchange as Clear"),
                         ("--set-address", "takes Set_Slave_Add; with --address 126 it waits for it")):
        parser.add_argument(option, action="store_true", help=what)
    parser.add_argument("--no-sync", action="store_true", help="has no Sync")
    parser.add_argument("--no-freeze", action="store_true", help="has no Freeze")
    _common_arguments(parser)
    parser.set_defaults(make=_generic)


def _common_arguments(parser: argparse.ArgumentParser) -> None:
    """Of all slaves that are described by data."""
    parser.epilog = f"Lines on stdin, while it runs:\n{console.HELP}"
    parser.add_argument("--auto-baud", action="store_true", help="searches the wire's rate")
    parser.add_argument("--echo", action="store_true", help="its inputs are its outputs")
    parser.add_argument("--identity", metavar="VENDOR,CONTROLLER,HARDWARE,SOFTWARE", help="what Ident is answered; default RS")
    parser.add_argument("--input", action="append", default=[], metavar="OFFSET=HEX", help="inputs to begin with")


def _generic(args: argparse.Namespace) -> Card:
    real, *others = (console.octets_of("--config", text) for text in args.config)
    return _begin(GenericSlave(
        args.address, _ident(args.ident), real, others=others, user_parameters=_limits(args.user_parameters),
        fail_safe=args.fail_safe, sync=not args.no_sync, freeze=not args.no_freeze, max_diagnosis=args.max_diagnosis,
        min_slave_interval=args.min_slave_interval, set_address=args.set_address, **_common(args)), args)


def _gsd(args: argparse.Namespace) -> Card:
    return _begin(GenericSlave.from_gsd(args.file, args.module, address=args.address, **_common(args)), args)


def _common(args: argparse.Namespace) -> dict[str, Any]:
    return {"auto_baud": args.auto_baud, "echo": args.echo, "identity": _identity(args.identity)}


def _begin(slave: GenericSlave, args: argparse.Namespace) -> Card:
    for given in args.input:
        where, equals, octets = given.partition("=")
        if not equals:
            raise ConfigurationError(f"--input {given}: OFFSET=HEX")
        console.set_inputs(slave, where, octets)
    return slave


def _ident(text: str) -> int:
    try:
        return int(text, 16)
    except ValueError:
        raise ConfigurationError(f"--ident {text!r}: a hexadecimal number, 0000 to FFFF") from None


def _limits(text: str) -> tuple[int, int]:
    low, dash, high = text.partition("-")
    if not dash or not low.isdecimal() or not high.isdecimal() or not int(low) <= int(high) <= 237:
        raise ConfigurationError(f"--user-parameters {text!r}: MIN-MAX, 0 to 237 octets")
    return int(low), int(high)


def _identity(text: str | None) -> tuple[str, str, str, str] | None:
    match text.split(",") if text is not None else None:
        case None:
            return None
        case [vendor, controller, hardware, software]:
            return vendor, controller, hardware, software
    raise ConfigurationError(f"--identity {text!r}: four texts with commas between them")


def _habits(given: list[str]) -> Habits:
    found = dict(habit.partition("=")[::2] for habit in given)
    for name in found:
        if name not in Habits.WORDS:
            raise ConfigurationError(f"--habit {name}: there are {', '.join(Habits.WORDS)}")
    return Habits(**found)  # type: ignore[arg-type]  # it checks the words


def run(args: argparse.Namespace) -> int:
    card: Card = args.make(args)
    card.habits = _habits(args.habit)
    try:
        if args.on is not None:
            _join(card, args)
        else:
            _host(card, args)
    except KeyboardInterrupt:  # SIGTERM too: how it is meant to end
        pass
    return 0


def _stay(host: Host, card: Card) -> None:
    if isinstance(card, GenericSlave):
        console.Console(host, card).stay()
    else:
        links.stay(host)


def _join(card: Card, args: argparse.Namespace) -> None:
    with Line(args.on, card, baudrate=args.baudrate or RATE, direction=args.direction, allowance=args.allowance) as line:
        print(args.on, flush=True)
        if line.tsl <= TSL_MAX:
            print(f"the master needs Tsl {line.tsl} Tbit or more: this card answers as late as its operating system wakes",
                  flush=True)
        else:
            print(f"no master waits long enough for this card: it would need Tsl {line.tsl}, and {TSL_MAX} is the most; take a "
                  "lower rate", flush=True)
        _stay(line, card)


def _host(card: Card, args: argparse.Namespace) -> None:
    with ExitStack() as stack:
        wire = stack.enter_context(Segment(args.baudrate, ports=1, cards=1))
        wire.attach(card)
        path = wire.port()
        if args.link is not None:
            stack.enter_context(links.link(args.link, path))
        print(path, flush=True)
        _stay(wire, card)
