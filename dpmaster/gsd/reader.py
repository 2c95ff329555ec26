# SPDX-License-Identifier: MIT
"""Statements to the model. What to do with a keyword stands in the model's fields; here is only how blocks open and close, how
values are written, and what a file may contradict itself in. Never raises for what a file contains.

Three rules hold for every broken file: the first of two definitions counts; a block whose end is missing ends where something
stands that it cannot hold; what has no meaning here is kept in `Device.unknown`.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dpmaster.errors import ConfigurationError
from dpmaster.gsd.model import (
    RATES,
    SLOT_MAX,
    TYPES,
    Area,
    DataArea,
    Device,
    Form,
    Interface,
    Module,
    Parameter,
    PrmText,
    Slot,
    UnitDiagType,
    Unknown,
)
from dpmaster.gsd.source import Severity, Source, Statement, Token, number
from dpmaster.identifier import IO_MAX

ERROR, WARNING, NOTE = Severity.ERROR, Severity.WARNING, Severity.NOTE

# What makers write in place of a keyword. Others are found without their underscores and blanks.
MISSPELLED = {
    "min_slave_interval": "min_slave_intervall", "module_offset": "modul_offset", "max_modules": "max_module",
    "unit_diag_!bit": "unit_diag_not_bit", "x_unit_diag_!bit": "x_unit_diag_not_bit", "manufacturer_name": "vendor_name",
    "auto_baud_rate_supp": "auto_baud_supp", "max_input_length": "max_input_len", "max_output_length": "max_output_len",
    "max_data_length": "max_data_len", "max_diag_data_length": "max_diag_data_len", "dp_v1_slave": "dpv1_slave",
    "order_number": "ordernumber", "user_prm_data_length": "user_prm_data_len",
    "max_user_prm_data_length": "max_user_prm_data_len",
}

GUESSES = 200  # findings until which a misspelled keyword is looked for: comparing costs a millisecond
_END = re.compile(r"^[^\S\n]*+(?:end_?(\w++)|(\w+)_end\b)", re.IGNORECASE | re.MULTILINE)


class Bad(Exception):
    """A value that its keyword cannot have; the text says what it should be."""


# ---- values


def _whole(values: list[Token], at: int = 0) -> tuple[int, int]:
    """The number at `at`, with its sign, and where it ends."""
    negative = at < len(values) and values[at][1] == "-"
    at += negative
    if at >= len(values) or values[at][0] != "number":
        raise Bad("a number is missing")
    found = number(values[at][1])
    return -found if negative else found, at + 1


def whole(values: list[Token]) -> int:
    found, end = _whole(values)
    if end < len(values):
        raise Bad("more follows than the one number that belongs here")
    return found


def ranges(values: list[Token], at: int = 0) -> list[tuple[int, int]]:
    """``1-8``, ``0,5,7`` and both together, negative too: ``-32768-32767``."""
    found = []
    while at < len(values):
        low, at = _whole(values, at)
        high = low
        if at < len(values) and values[at][1] == "-":
            high, at = _whole(values, at + 1)
        found.append((min(low, high), max(low, high)))
        at += at < len(values) and values[at][1] == ","
    return found


def octets(values: list[Token]) -> bytes:
    found = [low for low, high in ranges(values) if low == high]
    if len(found) != sum(token[0] == "number" for token in values) or any(not 0 <= octet <= 255 for octet in found):
        raise Bad(f"octets are {Form.OCTETS.value}")
    return bytes(found)


# ---- the table of keywords


def plain(name: str) -> str:
    return name.lower().replace("_", "").replace(" ", "")


@dataclass(frozen=True, slots=True)
class Entry:
    """A keyword: as the specification writes it, the field it fills, and of which rate, when there is one for each."""

    keyword: str
    field: str
    form: Form
    rate: int | None = None


_TABLES: dict[type, dict[str, Entry]] = {}


def table(block: type) -> dict[str, Entry]:
    """What a block may hold, by `plain` keyword."""
    if block in _TABLES:
        return _TABLES[block]
    found: dict[str, Entry] = {}
    for entry in dataclasses.fields(block) if dataclasses.is_dataclass(block) else ():
        if "keyword" not in entry.metadata:
            continue
        name, form = entry.metadata["keyword"], entry.metadata["form"]
        if form in (Form.RATE, Form.BY_RATE):
            for text, rate in RATES.items():
                whole_name = text + name if form is Form.RATE else name + text
                found[plain(whole_name)] = Entry(whole_name, entry.name, form, rate)
        else:
            found[plain(name)] = Entry(name, entry.name, form)
    if block in (UnitDiagType, Area):  # X_Unit_Diag_Bit, X_Value
        found.update({"x" + key: dataclasses.replace(entry, keyword="X_" + entry.keyword) for key, entry in found.items()})
    _TABLES[block] = found
    return found


class Block:
    """How a block ends, what may hold it, and the object it makes of its first statement."""

    def __init__(self, ends: tuple[str, ...], within: tuple[type, ...],
                 make: Callable[[Reader, Any, Statement], object] = lambda reader, what, statement: None) -> None:
        self.ends = ends
        self.ends_plain = frozenset(map(plain, ends))
        self.within = within
        self.make = make


@dataclass(slots=True)
class Open:
    """A block being read."""

    what: Any
    block: Block
    name: str
    key: str = ""
    """The keyword that began it."""


class SlotDefinition:
    """The block of that name while it is read; its lines go to the device."""


class Reader:
    """Fills one `Device` out of one `Source`."""

    def __init__(self, device: Device, source: Source) -> None:
        self.device = device
        self.source = source
        self.stack = [Open(device, Block((), ()), "")]
        self.given: dict[tuple[int, str, int | None], int] = {}
        """Where a field of an object (by `id`), at an index if it has one, was filled: offset in the source."""
        self.made: list[object] = []
        """All objects of blocks, so that no `id` comes twice."""
        self.ends = {plain(found[1] or found[2]): found.start() for found in _END.finditer(source.text)}
        """The names of blocks that end somewhere, known here or not, and where the last of them ends."""

    # ---- statements

    def read(self) -> None:
        for statement in self.source.statements():
            try:
                self.take(statement)
            except Bad as bad:
                self.note(ERROR, statement, f"{statement.keyword or statement.raw[:40]}: {bad}")
        for left in reversed(self.stack[1:]):
            self.source.note(ERROR, None, f"the file ends and {left.block.ends[0]} is missing for {left.name}")

    def note(self, severity: Severity, statement: Statement, text: str) -> None:
        self.source.note(severity, statement.offset, text)

    def take(self, statement: Statement) -> None:
        key = plain(MISSPELLED.get(statement.keyword.lower(), statement.keyword))
        if key in self.stack[-1].block.ends_plain and not statement.equals:
            self.stack.pop()
        elif isinstance(self.stack[-1].what, Unknown) and key != self.stack[-1].key:
            self.stack[-1].what.content.append(self.unknown(statement))
        elif not statement.keyword:
            self.bare(statement)
        elif key in ENDS and not statement.equals:
            self.close(key, statement)
        else:
            depth = next((i for i in range(len(self.stack) - 1, -1, -1) if self.holds(self.stack[i].what, key)), None)
            if isinstance(self.stack[-1].what, Unknown):
                self.unwind(len(self.stack) - 2, statement)
            if depth is None:
                self.keep(key, statement)
            else:
                self.unwind(depth, statement)
                self.put(key, statement)

    def holds(self, what: Any, key: str) -> bool:
        """Whether a block can hold this keyword."""
        kind = type(what)
        return (key in BLOCKS and isinstance(what, BLOCKS[key].within)) or key in LINES.get(kind, {}) or key in table(kind)

    def put(self, key: str, statement: Statement) -> None:
        what = self.stack[-1].what
        if key in BLOCKS and isinstance(what, BLOCKS[key].within):
            name = f"{statement.keyword} {statement.raw[:40]}".strip()
            try:
                self.made.append(BLOCKS[key].make(self, what, statement))
                self.stack.append(Open(self.made[-1], BLOCKS[key], name, key))
            except Bad as bad:
                self.note(ERROR, statement, f"{name}: {bad}; it is left out")
                self.kept(key, statement)
        elif key in LINES.get(type(what), {}):
            LINES[type(what)][key](self, what, statement)
        else:
            self.store(what, table(type(what))[key], statement)

    def unwind(self, depth: int, statement: Statement) -> None:
        """A statement belongs to an outer block: those inside it have ended without saying so."""
        while len(self.stack) > depth + 1:
            left = self.stack.pop()
            self.note(ERROR, statement, f"{left.block.ends[0]} is missing for {left.name} before {statement.keyword}")

    def close(self, key: str, statement: Statement) -> None:
        depth = next((i for i in range(len(self.stack) - 1, 0, -1) if key in self.stack[i].block.ends_plain), None)
        if depth is None:
            raise Bad("ends nothing that was begun")
        self.unwind(depth, statement)
        self.stack.pop()

    def bare(self, statement: Statement) -> None:
        """A line without keyword: in a module its Module_Reference."""
        module = self.stack[-1].what
        if not isinstance(module, Module) or statement.values[0][0] != "number":
            raise Bad("this is no keyword, and no Module_Reference")
        self.fill(module, "reference", None, whole(statement.values), statement)

    # ---- what has no meaning here

    def unknown(self, statement: Statement) -> Unknown:
        line, _ = self.source.place(statement.offset)
        return Unknown(statement.keyword, statement.index, statement.raw, line, self.stack[-1].name)

    def keep(self, key: str, statement: Statement) -> None:
        guess = len(self.source.findings) < GUESSES and len(key) < 50
        near = difflib.get_close_matches(key, KEYWORDS, 1, 0.85) if guess else []
        if near:
            self.note(WARNING, statement, f"{statement.keyword} is no keyword, {KEYWORDS[near[0]]} is one: kept, not looked at")
        else:
            self.note(NOTE, statement, f"{statement.keyword} is not a keyword of the specification: kept, and not looked at")
        self.kept(key, statement)

    def kept(self, key: str, statement: Statement) -> None:
        """Keep a statement, and all of its block if it begins one: if somewhere behind it a block of its name ends."""
        found = self.unknown(statement)
        self.device.unknown.append(found)
        self.open_unknown(key, statement, found)

    def open_unknown(self, key: str, statement: Statement, found: Unknown) -> None:
        name = key.removesuffix("beg")
        if self.ends.get(name, -1) > statement.offset:
            self.stack.append(Open(found, Block((f"End{name}", f"End_{name}", f"{name}_End"), ()),
                                   statement.keyword, key))

    # ---- values

    def fill(self, what: object, name: str, index: int | None, value: object, statement: Statement) -> None:
        """Give a field, or the entry of a dictionary, its value. The first one counts."""
        place = (id(what), name, index)
        if place in self.given:
            before = getattr(what, name) if index is None else getattr(what, name)[index]
            if before != value:
                line = self.source.place(self.given[place])[0]
                self.note(WARNING, statement, f"{statement.keyword} was given in line {line} already, and that one counts")
            return
        self.given[place] = statement.offset
        if index is None:
            setattr(what, name, value)
        else:
            getattr(what, name)[index] = value

    def store(self, what: object, entry: Entry, statement: Statement) -> None:
        form, index = entry.form, entry.rate
        value: object
        if statement.keyword.lower() != entry.keyword.lower():
            self.note(WARNING, statement, f"{statement.keyword} is read as {entry.keyword}")
        if form in (Form.FLAG, Form.RATE):
            value = self.truth(statement)
        elif form in (Form.WHOLE, Form.BY_RATE):
            value = whole(statement.values)
        elif form is Form.OCTETS:
            value = octets(statement.values)
        elif form is Form.RAW:
            value = statement.raw.strip()
        elif form is Form.TEXT:
            value = self.text(statement)
        elif form is Form.TEXTS:
            index, value = self.index(statement, signed=isinstance(what, PrmText)), self.text(statement)
        else:
            self.append(getattr(what, entry.field), form, statement)
            return
        self.fill(what, entry.field, index, value, statement)

    def append(self, entries: list[Any], form: Form, statement: Statement) -> None:
        if form is Form.CONSTANTS:
            entries.append((self.index(statement), octets(statement.values)))
        elif form is Form.REFERENCES:
            entries.append((self.index(statement), whole(statement.values)))
        else:
            entries.append(whole(statement.values))
        self.given[id(entries), "", len(entries) - 1] = statement.offset

    def index(self, statement: Statement, signed: bool = False) -> int:
        if statement.index is None or statement.last is not None or (statement.index < 0 and not signed):
            raise Bad("a number in brackets is missing")
        return statement.index

    def truth(self, statement: Statement) -> bool:
        value = whole(statement.values)
        if value not in (0, 1):
            self.note(WARNING, statement, f"{statement.keyword} = {value}: 0 or 1; taken for 1")
        return value != 0

    def text(self, statement: Statement) -> str:
        values = statement.values
        if values and values[0][0] == "text":
            if len(values) > 1:
                self.note(WARNING, statement, f"{statement.keyword}: what follows the text is not looked at")
            return values[0][1].strip()
        self.note(WARNING, statement, f"{statement.keyword}: its text is not in quotes")
        return statement.raw.strip()

    def named(self, statement: Statement) -> tuple[str, list[Token]]:
        """A text, and what follows it."""
        if not statement.values or statement.values[0][0] != "text":
            raise Bad("a name in quotes is missing")
        return statement.values[0][1].strip(), statement.values[1:]


# ---- blocks


def prm_text(reader: Reader, device: Device, statement: Statement) -> PrmText:
    found = PrmText(whole(statement.values))
    reader.fill(device, "prm_texts", found.number, found, statement)
    return found


def parameter(reader: Reader, device: Device, statement: Statement) -> Parameter:
    which, at = _whole(statement.values)
    rest = statement.values[at:]
    found = Parameter(which, rest[0][1].strip() if rest and rest[0][0] == "text" else "")
    if not found.name:
        reader.note(WARNING, statement, f"{statement.keyword} {which} has no name")
        found.name = f"parameter {which}"
    reader.fill(device, "parameters", which, found, statement)
    return found


def parameter_type(reader: Reader, found: Parameter, statement: Statement) -> None:
    """``BitArea(0-2) 3 0-4``: type, default, what is allowed."""
    if (id(found), "type", None) in reader.given:
        raise Bad(f"{found.name!r} has a type already, {found.type}, and that one counts")
    values = statement.values
    default, at = _whole(values)
    if at < len(values) and values[at][1] == "-" and values[at][2] == values[at - 1][2] + len(values[at - 1][1]):
        reader.note(WARNING, statement, f"{statement.keyword}: the default is missing; {default} is taken for it")
        at = 0
    allowed = ranges(values, at)
    name = TYPES[statement.keyword.lower()]
    if name in ("Bit", "BitArea"):
        first = 0 if statement.index is None else statement.index
        last = first if statement.last is None else statement.last
        if statement.index is None or not 0 <= first <= last <= 31:
            raise Bad("bits of one value are numbered 0 to 31, the first one first")
        found.first, found.last = first, last
    reader.fill(found, "type", None, name, statement)
    found.default, found.ranges = default, allowed
    if not found.allows(default):
        reader.note(WARNING, statement, f"{found.name!r}: its default {default} is not one of {found.allowed}")


def module(reader: Reader, device: Device, statement: Statement) -> Module:
    name, rest = reader.named(statement)
    found = Module(name=name)
    device.modules.append(found)
    reader.given[id(found), "", None] = statement.offset
    try:
        configuration = octets(rest)
        if not 1 <= len(configuration) <= IO_MAX:
            raise Bad(f"it has {len(configuration)} octets of identifiers, 1 to {IO_MAX} belong here")
        found.configuration = configuration
        found.identifiers  # noqa: B018 - it is what tells whether they are whole
    except (Bad, ConfigurationError) as error:
        reader.note(ERROR, statement, f"Module {name!r}: {error}")
    return found


def slot(reader: Reader, block: SlotDefinition, statement: Statement) -> None:
    """``Slot(1) = "name" 1 1-8``: default, what is allowed."""
    name, rest = reader.named(statement)
    default, at = _whole(rest)
    at += at < len(rest) and rest[at][1] == ","
    found = Slot(reader.index(statement), name, default, ranges(rest, at) or [(default, default)])
    if found.number > SLOT_MAX:
        raise Bad(f"slots are numbered 0 to {SLOT_MAX}")
    reader.fill(reader.device, "slots", found.number, found, statement)


def unit_diag_type(reader: Reader, what: Device | Module, statement: Statement) -> UnitDiagType:
    found = UnitDiagType(number=whole(statement.values))
    reader.fill(what, "types", found.number, found, statement)
    return found


def area(reader: Reader, what: Device | Module | UnitDiagType, statement: Statement) -> Area:
    found = ranges(statement.values)
    if len(found) != 1 or not 0 <= found[0][0] <= found[0][1] < 8 * 62:
        raise Bad("an area is its first and its last bit with - between them, 0 to 495")
    made = Area(*found[0])
    what.areas.append(made)
    return made


def data_area(reader: Reader, what: Device | Module, statement: Statement) -> DataArea:
    what.data_areas.append(made := DataArea())
    return made


def interface(reader: Reader, device: Device, statement: Statement) -> Interface:
    made = Interface(whole(statement.values))
    device.interfaces.append(made)
    return made


def jokerblock(reader: Reader, what: Device | Module, statement: Statement) -> Unknown:
    reader.device.jokerblocks.append(made := reader.unknown(statement))
    return made


BLOCKS: dict[str, Block] = {plain(name): block for name, block in {
    "PrmText": Block(("EndPrmText",), (Device,), prm_text),
    "ExtUserPrmData": Block(("EndExtUserPrmData",), (Device,), parameter),
    "Module": Block(("EndModule",), (Device,), module),
    "SlotDefinition": Block(("EndSlotDefinition",), (Device,), lambda reader, device, statement: SlotDefinition()),
    "UnitDiagType": Block(("EndUnitDiagType",), (Device, Module), unit_diag_type),
    "Unit_Diag_Area": Block(("Unit_Diag_Area_End",), (Device, Module, UnitDiagType), area),
    "X_Unit_Diag_Area": Block(("X_Unit_Diag_Area_End", "Unit_Diag_Area_End"), (UnitDiagType,), area),
    "Data_Area_Beg": Block(("Data_Area_End",), (Device, Module), data_area),
    "Physical_Interface": Block(("End_Physical_Interface",), (Device,), interface),
    "Jokerblock_Type": Block(("End_Jokerblock_Type",), (Device, Module), jokerblock),
}.items()}
ENDS = {end for block in BLOCKS.values() for end in block.ends_plain}
LINES: dict[type, dict[str, Callable[[Reader, Any, Statement], None]]] = {
    Parameter: dict.fromkeys(TYPES, parameter_type),
    SlotDefinition: {"slot": slot},
}
_NAMES = [entry.metadata["keyword"] for block in (Device, Module, DataArea) for entry in dataclasses.fields(block)
          if "keyword" in entry.metadata]
KEYWORDS: dict[str, str] = {plain(name): name for name in _NAMES}
"""The keywords that a misspelled one may be meant for, as the specification writes them."""
