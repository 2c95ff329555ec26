# SPDX-License-Identifier: MIT
"""``dpmaster gsd``: GSD files shown, checked, and turned into a station of a bus file. Touches no port."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from dpmaster.cli._terminal import printable
from dpmaster.errors import ConfigurationError
from dpmaster.gsd import GSD, Configuration, Device, Module, Parameters, Severity

NAME = "gsd"
HELP = "show or check GSD files, or make a station for a bus file from one"

WIDTH = 100
FEW = 20  # modules that are listed unless all are asked for

SHOW = "what a GSD file says, readable or as JSON"
CHECK = "what is wrong or odd in GSD files, as FILE:LINE:COLUMN: SEVERITY: TEXT"
CONFIG = "a station for a bus file, in TOML, with modules and parameters that are given or asked for"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(metavar="WHAT", required=True)
    show = _command(commands, "show", SHOW, _show)
    show.add_argument("file", metavar="FILE")
    show.add_argument("--json", action="store_true", help="everything the file says, as one JSON object")
    show.add_argument("--modules", action="store_true", help=f"all modules, not only the first {FEW}")
    show.add_argument("--module", action="append", default=[], metavar="NAME", help="one module with its parameters")
    check = _command(commands, "check", CHECK, _check)
    check.epilog = "exit code 1 when there is an error, or with --strict a warning"
    check.add_argument("files", nargs="+", metavar="FILE")
    check.add_argument("--strict", action="store_true", help="warnings are errors")
    check.add_argument("--quiet", action="store_true", help="no notes")
    config = _command(commands, "config", CONFIG, _config)
    config.epilog = "At a terminal, what is not given is asked for; else it is the file's default."
    config.add_argument("file", metavar="FILE")
    config.add_argument("--address", type=int, metavar="N", help="of the station, 0 to 125")
    config.usage = "dpmaster gsd config FILE [--address N] [--module NAME ...] [--parameter NAME=VALUE] [options]"
    config.add_argument("--module", action="extend", nargs="+", metavar="NAME", help="in the order of the slots, or SLOT=NAME")
    config.add_argument("--parameter", action="append", default=[], metavar="NAME=VALUE", help="SLOT:NAME=VALUE for a module's")
    config.add_argument("--all", action="store_true", help="write parameters that are at their default, too")
    for command in (show, check, config):
        command.add_argument("--encoding", metavar="NAME", help="the code page, where it is guessed wrong")


def _command(commands: Any, name: str, text: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
    command.set_defaults(act=run)
    return command


def run(args: argparse.Namespace) -> int:
    code: int = args.act(args)
    return code


# ---- show


def _rate(rate: int) -> str:
    return f"{rate / 1e6:g}M" if rate >= 1_000_000 else f"{rate / 1000:g}k"


def _row(name: str, *values: object) -> Iterator[str]:
    """A name and what there is to say, or nothing where there is nothing."""
    text = ", ".join(str(value) for value in values if value not in (None, "", False))
    if text:
        yield from textwrap.wrap(text, WIDTH, initial_indent=f"  {name:<14} ", subsequent_indent=" " * 17)


def _device(gsd: GSD) -> Iterator[str]:
    revision = gsd.gsd_revision is not None and f"GSD revision {gsd.gsd_revision}"
    yield gsd.title + (f": {gsd.info}" if gsd.info else "")
    yield from _row("file", gsd.path, revision, gsd.language, gsd.encoding)
    yield from _row("ident number", "none" if gsd.ident_number is None else f"{gsd.ident_number:04X}h")
    yield from _row("revision", gsd.revision, gsd.hardware_release and f"hardware {gsd.hardware_release}",
                    gsd.software_release and f"software {gsd.software_release}", gsd.implementation)
    yield from _row("order number", gsd.order_number)
    yield from _row("rates", *(_rate(rate) for rate in gsd.baudrates))
    tsdr = (f"{_rate(rate)} {bits}" for rate, bits in gsd.max_tsdr.items() if rate in gsd.baudrates)
    yield from _row("max Tsdr, Tbit", *tsdr)
    yield from _row("can", gsd.sync and "sync", gsd.freeze and "freeze", gsd.fail_safe and "fail safe",
                    gsd.auto_baud and "find the rate", gsd.set_slave_add and "Set_Slave_Add")
    interval = gsd.min_slave_interval is not None and f"slave interval {gsd.min_slave_interval / 10:g} ms"
    yield from _row("limits", gsd.max_inputs is not None and f"{gsd.max_inputs} octets of inputs",
                    gsd.max_outputs is not None and f"{gsd.max_outputs} of outputs",
                    gsd.max_data is not None and f"{gsd.max_data} together",
                    gsd.max_modules is not None and f"{gsd.max_modules} module{'s' * (gsd.max_modules != 1)}",
                    gsd.max_diag_length is not None and f"{gsd.max_diag_length} octets of diagnosis", interval)
    yield from _row("DP-V1", *_dpv1(gsd))


def _dpv1(gsd: GSD) -> Iterator[str | bool]:
    if gsd.dpv1:
        yield gsd.c1_read_write and f"MS1 up to {gsd.c1_max_data_length} octets"
        yield gsd.c2_read_write and f"MS2 up to {gsd.c2_max_data_length} octets"
        for name in ("diagnostic", "process", "pull_plug", "status", "update", "manufacturer"):
            yield getattr(gsd, f"{name}_alarm") and f"{name.replace('_', '/')} alarms"
        yield gsd.prm_structure and "structured parameters"
        yield gsd.ident_maintenance and "I&M"


def _octets(module: Module) -> str:
    if not module.whole:
        return "broken"
    there = ((module.input_length, "in"), (module.output_length, "out"))
    return ", ".join(f"{length} {way}" for length, way in there if length) or "no data"


def _modules(gsd: GSD, every: bool) -> Iterator[str]:
    shown = gsd.modules if every else gsd.modules[:FEW]
    width = min(50, max((len(module.name) for module in shown), default=0))
    numbers = max((len(str(module.reference)) for module in shown if module.reference is not None), default=0)
    yield f"Modules ({len(gsd.modules)})"
    for module in shown:
        number = "" if module.reference is None else module.reference
        octets = module.configuration.hex(" ").upper()
        preset = "  preset" if module.preset else ""
        yield f"  {number:>{numbers}} {module.name:<{width}}  {_octets(module):<15} {octets}{preset}"
    if len(shown) < len(gsd.modules):
        yield f"  and {len(gsd.modules) - len(shown)} more: --modules"


def _slots(gsd: GSD) -> Iterator[str]:
    if gsd.slots:
        yield "Slots, with what they take; what is in them by default comes first"
    for slot in gsd.slots.values():
        names = {module.reference: module.name for module in reversed(gsd.modules) if slot.allows(module.reference)}
        default = [names.pop(slot.default, str(slot.default))]
        yield from _row(f"{slot.number} {slot.name}", *default, *list(names.values())[:8], len(names) > 8 and "...")


def _parameters(title: str, parameters: Parameters) -> Iterator[str]:
    if parameters:
        yield title
    for placed in parameters.placed:
        if placed.parameter.visible:
            value = json.dumps(parameters[placed.name], ensure_ascii=False)
            allowed = placed.parameter.allowed if placed.parameter.changeable else "not changeable"
            text = f"{placed.name} = {value}  ({allowed})"
            yield from textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent=" " * 6)


def _whole(gsd: GSD, args: argparse.Namespace) -> Iterator[str]:
    station = Parameters(gsd.title, gsd, gsd, None)
    sections = [_device(gsd), _slots(gsd), _modules(gsd, args.modules), _parameters("Parameters of the station", station)]
    for name in args.module:
        module = gsd.module(_reference(name))
        title = f"Parameters of {module.name!r}{': ' + module.info if module.info else ''}"
        sections.append(_parameters(title, Parameters(module.name, gsd, module, module.prm_length)))
    yield "\n\n".join(filter(None, ("\n".join(section) for section in sections)))
    count = {severity: sum(found.severity is severity for found in gsd.findings) for severity in Severity}
    if gsd.findings:
        texts = (f"{n} {severity}{'s' * (n != 1)}" for severity, n in count.items() if n)
        yield f"\n{', '.join(texts)} in this file: dpmaster gsd check {gsd.path}"


def _reference(name: str) -> str | int:
    return int(name) if name.isdecimal() else name


def _show(args: argparse.Namespace) -> int:
    gsd = GSD.load(args.file, encoding=args.encoding)
    if args.json:
        print(json.dumps(as_object(gsd), ensure_ascii=False))
    else:
        print("\n".join(map(printable, "\n".join(_whole(gsd, args)).split("\n"))))
    return 0


def as_object(value: Any) -> Any:
    """What --json prints: the model's fields by their names, octets as hex."""
    if isinstance(value, bytes):
        return value.hex()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {entry.name: as_object(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): as_object(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_object(entry) for entry in value]
    return value


# ---- check


def _check(args: argparse.Namespace) -> int:
    bad = 0
    for name in args.files:
        try:
            findings = GSD.load(name, encoding=args.encoding).findings
        except ConfigurationError as error:
            print(error, file=sys.stderr)
            bad += 1
            continue
        for finding in findings:
            if finding.severity is not Severity.NOTE or not args.quiet:
                print(printable(f"{name}:{finding}" if finding.line else f"{name}: {finding}"))
        worst = (Severity.ERROR, Severity.WARNING) if args.strict else (Severity.ERROR,)
        bad += any(finding.severity in worst for finding in findings)
    return 1 if bad else 0


# ---- config


def _ask(text: str) -> str:
    """A line from the terminal; the question goes to stderr, so that stdout is the bus file's."""
    print(text, end=" ", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise ConfigurationError("the answers end too early: give --address, --module and --parameter instead")
    return line.strip()


def _entry(text: str) -> Any:
    """``NAME``, a Module_Reference, or either with a slot before it."""
    found = re.fullmatch(r"(\d+)=(.*)", text)
    return (int(found[1]), _reference(found[2])) if found else _reference(text)


def _ask_modules(gsd: GSD) -> list[Any]:
    print("\n".join(map(printable, [*_slots(gsd), *_modules(gsd, True)])), file=sys.stderr)
    default = gsd.default_modules()
    chosen: list[Any] = []
    while len(chosen) < gsd.most_modules:
        usual = f" (nothing: {', '.join(repr(module.name) for module in default) or 'the default'})" if not chosen else ""
        text = _ask(f"Module for the next slot, by name or number{usual}:")
        if not text:
            break
        try:
            gsd.configure([*chosen, _entry(text)])
            chosen.append(_entry(text))
        except ConfigurationError as error:
            print(error, file=sys.stderr)
    return chosen or default


def _ask_parameters(configuration: Configuration) -> None:
    for whose, parameters in _all_parameters(configuration):
        print("\n".join(map(printable, _parameters(f"Parameters of {whose}", parameters))), file=sys.stderr)
    while text := _ask("Change a parameter, NAME=VALUE or SLOT:NAME=VALUE (nothing: done):"):
        try:
            _set(configuration, text)
        except ConfigurationError as error:
            print(error, file=sys.stderr)


def _all_parameters(configuration: Configuration) -> Iterator[tuple[str, Parameters]]:
    yield "the station", configuration.parameters
    for place in configuration:
        yield f"slot {place.slot}, {place.name}", place.parameters


def _set(configuration: Configuration, text: str) -> None:
    """Names and values may contain = too: the first one behind a parameter's name counts."""
    slot = re.match(r"(\d+):", text)
    parameters = configuration[int(slot[1])].parameters if slot else configuration.parameters
    rest = text[slot.end() :] if slot else text
    cuts = [found.start() for found in re.finditer("=", rest)]
    if not cuts:
        raise ConfigurationError(f"parameter {text!r}: write NAME=VALUE, or SLOT:NAME=VALUE")
    cut = next((cut for cut in cuts if rest[:cut].strip() in parameters), cuts[0])
    parameters[rest[:cut].strip()] = rest[cut + 1 :].strip()


def _config(args: argparse.Namespace) -> int:
    gsd = GSD.load(args.file, encoding=args.encoding)
    person = sys.stdin.isatty()
    address = args.address
    if address is None:
        if not person:
            raise ConfigurationError("--address is missing: the station's, 0 to 125")
        text = _ask("Address of the station, 0 to 125:")
        address = int(text) if text.isdecimal() else -1
    if not 0 <= address <= 125:
        raise ConfigurationError(f"address {address}: 0 to 125")
    asked = args.module is None and person
    if asked:
        modules = _ask_modules(gsd)
    else:
        modules = gsd.default_modules() if args.module is None else list(map(_entry, args.module))
    configuration = gsd.configure(modules)
    for text in args.parameter:
        _set(configuration, text)
    if asked and not args.parameter:
        _ask_parameters(configuration)
    print("\n".join(station_toml(args.file, address, modules, configuration, args.all, args.encoding)))
    return 0


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_toml(key)} = {_toml(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return re.sub("[\x7f-\x9f]", lambda found: f"\\u{ord(found[0]):04x}", json.dumps(value, ensure_ascii=False))


def _named(gsd: Device, entry: Any) -> Any:
    """An entry of ``modules`` as a file can have it: a module by its name, or by its reference when others have the name."""
    if isinstance(entry, tuple):
        return [entry[0], _named(gsd, entry[1])]
    module = gsd.module(entry)
    try:
        gsd.module(module.name)
        return module.name
    except ConfigurationError:
        return module.reference


def station_toml(file: str, address: int, modules: list[Any], configuration: Configuration,
                 every: bool = False, encoding: str | None = None) -> Iterator[str]:
    """The lines of ``[[station]]``. Parameters at their default are left out, unless `every`."""
    gsd = configuration.device
    parameters: dict[str, Any] = dict(configuration.parameters if every else configuration.parameters.changed)
    for place in configuration:
        settings = dict(place.parameters if every else place.parameters.changed)
        if settings:
            parameters[str(place.slot)] = settings
    yield printable(f"# {gsd.title}, ident {gsd.ident_number or 0:04X}h")
    for place in configuration:
        spans = [(place.inputs, "inputs"), (place.outputs, "outputs")]
        data = [f"{what} {span.offset} to {span.offset + span.length - 1}" for span, what in spans if span.length]
        yield printable(f"#   slot {place.slot}, {place.name}: {', '.join(data) or 'no data'}")
    yield from (printable(f"#   {note}") for note in configuration.notes)
    yield from ("[[station]]", f"address = {address}", f"gsd = {_toml(file)}")
    if encoding:
        yield f"encoding = {_toml(encoding)}"
    yield f"modules = {_toml([_named(gsd, entry) for entry in modules])}"
    if parameters:
        yield from _parameter_lines(parameters)


def _parameter_lines(parameters: Mapping[str, Any]) -> Iterator[str]:
    """In one line, or where that is too long a table for the station and one for each module."""
    line = f"parameters = {_toml(parameters)}"
    if len(line) <= WIDTH:
        yield line
        return
    yield "[station.parameters]"
    yield from (f"{_toml(name)} = {_toml(value)}" for name, value in parameters.items() if not isinstance(value, Mapping))
    for slot, settings in parameters.items():
        if isinstance(settings, Mapping):
            yield f"[station.parameters.{_toml(slot)}]"
            yield from (f"{_toml(name)} = {_toml(value)}" for name, value in settings.items())
