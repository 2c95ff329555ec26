# SPDX-License-Identifier: MIT
"""A bus described in a TOML file: port, bus parameters, stations. It is checked whole before a port is opened.

This room knows how a file says what `Master`, `Station` and the drives take; what they allow is theirs to say, and their words
come back with the file, line and key in front.
"""

from __future__ import annotations

import difflib
import inspect
import os
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

from dpmaster import _arguments
from dpmaster.bus import direction_code
from dpmaster.calibration import Calibration
from dpmaster.drives import PROFILES as DRIVES
from dpmaster.errors import ConfigurationError
from dpmaster.gsd import GSD
from dpmaster.master import Master
from dpmaster.parameters import BusParameters
from dpmaster.realtime import Realtime, wished
from dpmaster.signals import Signal, Signals
from dpmaster.station import Station
from dpmaster.timing import PROFILES, Slave, Timing, plan

__all__ = ["BusFile"]

Key = tuple[str | int, ...]
Table = dict[str, Any]


def _keywords(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    return {name: p for name, p in inspect.signature(function).parameters.items()
            if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD) and name != "self"}


_MASTER = {name: p for name, p in _keywords(Master.__init__).items() if name != "parameters"}
_STATION = {name: p for name, p in _keywords(Station.__init__).items() if p.kind == p.KEYWORD_ONLY}
_PLAN = ("masters", "repeaters", "repeater_delay", "length", "stubs", "others", "chunk")
_SIGNAL = ("module", "offset", "type", "bit", "scale", "unit")
_GSD = ("gsd", "encoding", "modules", "parameters", "names", "dpv1", "alarms")
_OFF = ("watchdog", "output_watchdog")  # keys that may be "off"; TOML has no word for None


class BusFile:
    """What a bus file says, checked: ``master()`` opens the port and adds the stations.

    stations: `Station` objects, drives among them, that belong to no master yet. timing: bus parameters and predicted cycle, as
    `dpmaster.timing.plan` computes them. warnings: what will work less well than somebody may think.
    """

    def __init__(self, path: Path, port: str | None, options: Mapping[str, Any], timing: Timing,
                 stations: Iterable[Station]) -> None:
        self.path = path
        self.port = port
        self.options = dict(options)
        self.timing = timing
        self.stations = tuple(stations)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, works: bool = True) -> BusFile:
        """Read and check a file. works=False: a bus whose times will not work is no fault, `timing` tells of it.

        Raises ConfigurationError with every fault found: file, line, key, rule and remedy each.
        """
        return _Loader(Path(_arguments.path(path)), works).load()

    @property
    def warnings(self) -> tuple[str, ...]:
        return tuple(f"{finding.text}; remedy: {finding.remedy}" for finding in self.timing.findings)

    def master(self, port: str | None = None, **options: Any) -> Master:
        """The master with all stations, before its first telegram. `port` and options win over the file's.

        Raises ConfigurationError, PortError.
        """
        where = port or self.port
        if where is None:
            raise ConfigurationError(f"{self.path}: [bus] has no port: add port = \"/dev/...\", or give one")
        master = Master(where, **{**self.options, "parameters": self.timing.parameters, **options})
        try:
            for station in self.stations:
                master.add(station)
        except BaseException:
            master.close()
            raise
        return master


class _Source:
    """The text, its tables, and where a key stands in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ConfigurationError(f"{path}: octet {error.start} is no UTF-8, as TOML must be: save it as UTF-8") from None
        except OSError as error:
            raise ConfigurationError(f"{path}: {error.strerror or error}: give the path of a bus file") from None
        try:
            self.tables: Table = tomllib.loads(self.text)
        except (ValueError, RecursionError) as error:  # a number of 5000 digits is a plain ValueError
            what, _, where = str(error).partition(" (at ")
            line = where.partition("line ")[2].partition(",")[0] or str(self.text.count("\n") + 1)
            raise ConfigurationError(f"{path}:{line}: {what}: this is no TOML") from None

    @cached_property
    def places(self) -> dict[Key, int]:
        """The line on which each key begins. tomllib keeps no places, but every statement of a file is a file, too."""
        places: dict[Key, int] = {}
        arrays: Counter[Key] = Counter()
        table: Key = ()
        statement, begin = "", 0
        for line, text in enumerate(self.text.split("\n"), 1):
            begin = begin if statement else line
            statement += text + "\n"
            try:
                found = tomllib.loads(statement)
            except tomllib.TOMLDecodeError:  # its value goes on
                continue
            if statement.lstrip().startswith("["):
                table = _header(found, arrays)
                keys: Iterable[Key] = (table[:n] for n in range(1, len(table) + 1))
            else:
                keys = _keys(found, table)
            for key in keys:
                places.setdefault(key, begin)
            statement = ""
        return places

    def line(self, key: Key) -> int:
        """The line on which a key begins; of one that is missing, that of its table."""
        return next((self.places[key[:n]] for n in range(len(key), 0, -1) if key[:n] in self.places), 1)


def _header(found: Table, arrays: Counter[Key]) -> Key:
    """The table that a header opens, out of what the header alone makes; `arrays` counts those with two brackets."""
    table: Key = ()
    while found:
        [(name, inner)] = found.items()
        table += (name,)
        if isinstance(inner, list):
            arrays[table] += 1
            inner = inner[0]
        if table in arrays:
            table += (arrays[table] - 1,)
        found = inner
    return table


def _keys(value: Any, key: Key) -> Iterator[Key]:
    if key:
        yield key
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, inner in entries:
        yield from _keys(inner, (*key, name))


def _shown(key: Key) -> str:
    """bus.port, station[2].gsd: stations count from 1, as people do."""
    return "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")


class _Loader:
    """One pass over the tables; a fault is kept, and what does not lean on it is looked at all the same."""

    def __init__(self, path: Path, works: bool) -> None:
        self.source = _Source(path)
        self.works = works
        self.faults: list[tuple[int, str]] = []
        self.gsd = cache(GSD.load)  # a bus often has several of one device, and some files have a megabyte

    def fault(self, key: Key, text: object) -> None:
        line = self.source.line(key)
        self.faults.append((line, f"{self.source.path}:{line}: {_shown(key)}: {text}"))

    def load(self) -> BusFile:
        tables = self.source.tables
        self.known((), tables, ("bus", "station"))
        bus = self.table(("bus",), tables.get("bus", {}))
        options = self.options(bus)
        stations = self.stations(tables.get("station", []))
        timing = None if self.faults else self.timing(bus, options, stations)
        if timing is None or self.faults:
            raise ConfigurationError("\n".join(text for _, text in sorted(self.faults)))
        if timing.ring:
            options["ring"] = True
        port = options.pop("port", None)
        options.pop("baudrate", None)
        return BusFile(self.source.path, port, options, timing, stations)

    # ---- small things

    def known(self, key: Key, table: Table, names: Iterable[str]) -> bool:
        names = list(names)
        strange = [name for name in table if name not in names]
        for name in strange:
            near = difflib.get_close_matches(name, names, 1)
            rest = f"did you mean {near[0]}?" if near else f"known are {', '.join(sorted(names))}"
            self.fault((*key, name), f"no such key: {rest}")
        return not strange

    def table(self, key: Key, value: Any) -> Table:
        if isinstance(value, dict):
            return value
        self.fault(key, f"{value!r}: it is a table, [{_shown(key)}]")
        return {}

    def typed(self, key: Key, value: Any, parameter: inspect.Parameter) -> Any:
        """What the constructors take for granted: bools and texts. Ranges are theirs."""
        if key[-1] in _OFF and (value == "off" or value is False):
            return None
        if parameter.annotation in ("bool", "bool | None") and not isinstance(value, bool):
            self.fault(key, f"{value!r}: true or false")
            return parameter.default
        if parameter.annotation in ("str", "str | None") and not isinstance(value, str):
            self.fault(key, f"{value!r}: a text in quotes")
            return parameter.default
        return value

    def attempt(self, key: Key, call: Callable[[], Any], table: Table | None = None) -> Any:
        """The call's result, or None and a fault: at the key of `table` that its words begin with, or else at `key`."""
        try:
            return call()
        except (ConfigurationError, TypeError) as error:
            named = [name for name in table or () if re.match(rf"(the master's )?{re.escape(name)}\b", str(error))]
            self.fault((*key, *named[:1]), error)
            return None

    # ---- [bus]

    def options(self, bus: Table) -> Table:
        """The arguments of Master."""
        self.known(("bus",), bus, [*_MASTER, *_PLAN, "parameters", "calibration"])
        options = {name: self.typed(("bus", name), bus[name], _MASTER[name]) for name in bus if name in _MASTER}
        if "calibration" in bus:
            self.attempt(("bus", "calibration"), lambda: options.setdefault("allowance", self.measured(bus["calibration"])))
        realtime = options.get("realtime")
        if isinstance(realtime, dict) and self.known(("bus", "realtime"), realtime, _keywords(Realtime)):
            options["realtime"] = self.attempt(("bus", "realtime"), lambda: Realtime(**realtime))
        elif not isinstance(realtime, dict):
            self.attempt(("bus", "realtime"), lambda: wished(realtime))
        self.attempt(("bus", "direction"), lambda: direction_code(options.get("direction")))
        if bus:
            self.attempt(("bus",), lambda: BusParameters.default(options.get("baudrate", 500_000)), bus)
            checked = _keywords(Master.check_options)
            self.attempt(("bus",), lambda: Master.check_options(**{k: v for k, v in options.items() if k in checked}), bus)
        return options

    def measured(self, name: Any) -> float:
        """The allowance that ``dpmaster calibrate --output`` wrote beside the bus file."""
        if not isinstance(name, str):
            raise ConfigurationError(f"{name!r}: the path of a file that 'dpmaster calibrate --output' wrote, in quotes")
        try:
            return Calibration.load(self.source.path.parent / name).allowance
        except OSError as error:
            raise ConfigurationError(f"{name}: {error.strerror}: 'dpmaster calibrate PORT --output {name}' writes it") from None

    def timing(self, bus: Table, options: Table, stations: list[Station]) -> Timing | None:
        """Bus parameters of this bus; what will not work is a fault."""
        changes = self.table(("bus", "parameters"), bus.get("parameters", {}))
        self.known(("bus", "parameters"), changes, _keywords(BusParameters))
        ring = options.get("ring") is True
        given = {name: bus[name] for name in _PLAN if name in bus}
        timing: Timing | None = self.attempt(("bus",), lambda: plan(
            options.get("baudrate", 500_000), [Slave.of(station) for station in stations if station.active],
            addresses=(options.get("address", 1),), ring=ring, profile=options.get("profile", _profile(options.get("port"))),
            allowance=options.get("allowance"), cycle_time=options.get("cycle_time"), changes=changes, **given), bus)
        if len(stations) > options.get("max_stations", len(stations)):
            self.fault(("bus", "max_stations"), f"{options['max_stations']}: the file has {len(stations)} stations")
        if timing and timing.ring and options.get("ring") is False:
            self.fault(("bus", "ring"), f"false, and {timing.masters} masters on the bus share a token: leave one key out")
        for finding in timing.findings if timing else ():
            if finding.fatal and self.works:
                self.fault(("bus",), f"{finding.text}; {finding.remedy}")
        return timing

    # ---- [[station]]

    def stations(self, given: Any) -> list[Station]:
        if not isinstance(given, list) or not all(isinstance(entry, dict) for entry in given):
            self.fault(("station",), "write [[station]], with two brackets, above each of them")
            return []
        found = []
        seen: dict[int | str, int] = {}
        for at, table in enumerate(given):
            key = ("station", at)
            station = self.station(key, table)
            if station is None:
                continue
            for name, value in (("address", station.address), ("name", station.name)):
                if seen.setdefault(value, at) != at:
                    first = _shown(("station", seen[value]))
                    self.fault((*key, name), f"{value!r} is that of {first} already: each needs its own")
            signals = self.attempt(key, partial(self.signals, key, table, station))
            if signals is not None:
                station.signals = signals
            found.append(station)
        return found

    def station(self, key: Key, table: Table) -> Station | None:
        kinds = {"gsd": self.by_gsd, "drive": self.by_drive, "ident_number": self.bare}
        there = [kind for kind in kinds if kind in table]
        if len(there) != 1:
            self.fault(key, f"a station needs one of gsd, drive and ident_number, and has {' and '.join(there) or 'none'}")
            return None
        before = len(self.faults)
        if "address" not in table:
            self.fault(key, "it has no address: add address = N, 0 to 125")
            table = {**table, "address": 0}
        station = kinds[there[0]](key, table)
        return station if len(self.faults) == before else None

    def common(self, key: Key, table: Table) -> Table:
        """The keyword arguments of Station."""
        options = {name: self.typed((*key, name), table[name], _STATION[name]) for name in table if name in _STATION}
        if isinstance(options.get("max_tsdr"), dict):  # a key of TOML is a text
            options["max_tsdr"] = {int(rate) if rate.isdecimal() else rate: bits for rate, bits in options["max_tsdr"].items()}
        return options

    def by_gsd(self, key: Key, table: Table) -> Station | None:
        """Step by step, so that a fault is told at the key it is in."""
        self.known(key, table, ("address", "inputs", "outputs", *_GSD, *_STATION))
        for name in ("gsd", "encoding"):
            if not isinstance(table.get(name, ""), str):
                self.fault((*key, name), f"{table[name]!r}: a text in quotes")
                return None
        gsd = self.attempt((*key, "gsd"), lambda: self.gsd(
            self.source.path.parent / table["gsd"], encoding=table.get("encoding")))
        modules, names = table.get("modules"), table.get("names")
        if gsd is None or self.attempt((*key, "modules"), lambda: gsd.configure(modules)) is None:
            return None
        if names is not None and self.attempt((*key, "names"), lambda: gsd.configure(modules, names=names)) is None:
            return None
        parameters = self.table((*key, "parameters"), table.get("parameters", {}))
        for name, setting in parameters.items():
            self.attempt((*key, "parameters", name), partial(gsd.configure, modules, {name: setting}, names=names))
        options = self.common(key, table) | {name: table[name] for name in ("names", "dpv1", "alarms") if name in table}
        station: Station | None = self.attempt(
            key, lambda: Station.from_gsd(gsd, table["address"], modules, parameters, **options), table)
        return station

    def by_drive(self, key: Key, table: Table) -> Station | None:
        drive = DRIVES.get(table["drive"]) if isinstance(table["drive"], str) else None
        if drive is None:
            self.fault((*key, "drive"), f"{table['drive']!r}: one of {', '.join(DRIVES)}")
            return None
        rest = any(p.kind == p.VAR_KEYWORD for p in inspect.signature(drive).parameters.values())
        takes = (_STATION if rest else {}) | _keywords(drive)
        self.known(key, table, ("drive", "inputs", "outputs", *takes))
        options = {name: self.typed((*key, name), value, takes[name]) for name, value in table.items() if name in takes}
        station: Station | None = self.attempt(key, lambda: drive(**options), table)
        return station

    def bare(self, key: Key, table: Table) -> Station | None:
        self.known(key, table, ("address", "ident_number", "configuration", "user_parameters", "inputs", "outputs", *_STATION))
        if "configuration" not in table:
            self.fault(key, "it has no configuration: add the identifiers of Chk_Cfg, like configuration = \"13 23\"")
            return None
        octets = {name: self.octets((*key, name), table[name])
                  for name in ("configuration", "user_parameters") if name in table}
        station: Station | None = self.attempt(
            key, lambda: Station(table["address"], table["ident_number"], **octets, **self.common(key, table)), table)
        return station

    def octets(self, key: Key, value: Any) -> Any:
        """Octets as hex, "13 23", or as an array of numbers."""
        if isinstance(value, str):
            try:
                return bytes.fromhex(value.replace("0x", "").replace(",", " "))
            except ValueError:
                self.fault(key, f"{value!r}: octets in hexadecimal, like \"13 23\"")
        elif isinstance(value, list):
            return value
        else:
            self.fault(key, f"{value!r}: octets, like \"13 23\" or [0x13, 0x23]")
        return b"\0"

    def signals(self, key: Key, table: Table, station: Station) -> Signals:
        found = []
        for direction in ("inputs", "outputs"):
            entries = self.table((*key, direction), table.get(direction, {}))
            found += [self.signal((*key, direction, name), name, direction, entry, station) for name, entry in entries.items()]
        return Signals(station, filter(None, found))

    def signal(self, key: Key, name: str, direction: str, entry: Any, station: Station) -> Signal | None:
        fields = self.table(key, entry)
        self.known(key, fields, _SIGNAL)
        fields = {field: value for field, value in fields.items() if field in _SIGNAL}
        module = fields.pop("module", None)
        if "offset" not in fields:
            self.fault(key, "it has no offset: add offset = N, in octets")
            return None
        start = 0 if module is None else self.attempt((*key, "module"), partial(_module, station, module, direction))
        if start is None:
            return None
        signal: Signal | None = self.attempt(key, partial(_placed, name, direction, fields, start))
        fits = signal and self.attempt(key, partial(Signals, station, [signal])) is not None
        return signal if fits else None


def _module(station: Station, module: str | int, direction: str) -> int:
    """Where a module's octets begin."""
    configuration = getattr(station, "gsd", None)
    if configuration is None:
        raise ConfigurationError(f"module {module!r}: only a station with a GSD file has modules; count the offset from the "
                                 f"beginning of its {direction}")
    return int(getattr(configuration[module], direction).offset)


def _placed(name: str, direction: Any, fields: Table, start: int) -> Signal:
    offset = _arguments.whole("offset", fields.pop("offset"), 0, 243)
    return Signal(name, direction, start + offset, **fields)


def _profile(port: Any) -> str:
    """What a port will be by its path, for a bus that is only computed."""
    path = os.path.realpath(port) if isinstance(port, str) else ""
    profile = "pty" if path.startswith("/dev/pts/") else "usb" if "USB" in path or "ACM" in path else "uart"
    assert profile in PROFILES
    return profile


