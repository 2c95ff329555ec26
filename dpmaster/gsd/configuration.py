# SPDX-License-Identifier: MIT
"""What a master needs out of a GSD file: a choice of modules with its configuration octets, its map of inputs and outputs, and
its user parameters with their settings.

Touches the model and the decoder of identifiers, no bus. Everything a file or a choice breaks is a ConfigurationError here,
before a telegram carries it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dpmaster.errors import ConfigurationError
from dpmaster.gsd.model import SLOT_MAX, USER_PRM_MAX, Device, Module, plain
from dpmaster.gsd.parameters import Parameters
from dpmaster.gsd.texts import Texts
from dpmaster.identifier import IO_MAX, Data, Identifier

Chosen = str | int | Module | tuple[int, str | int | Module] | list["int | str | Module"]
"""A module by its name, its Module_Reference, or itself; with a slot before it when it is not the next one."""

EMPTY = Module(name="(empty slot)", configuration=b"\0")

# DPV1_Status_1 to 3, protocol page G.1
_DPV1_ENABLE, _FAIL_SAFE, _WD_BASE_1MS = 0x80, 0x40, 0x04
ALARMS = {"pull_plug": 0x80, "process": 0x40, "diagnostic": 0x20, "manufacturer": 0x10, "status": 0x08, "update": 0x04}
"""Alarms by name and their bits in DPV1_Status_2."""
_PRM_STRUCTURE = 0x08
MAX_TSDR = (37, 1023)  # Tbit: what a station takes for max Tsdr; many files give 15, since their slaves answer at once


@dataclass(frozen=True, slots=True)
class Span:
    """Octets of a station's inputs or outputs."""

    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class Place:
    """A module in its slot."""

    slot: int
    name: str
    """The module's name, or the one that was given to this slot."""
    module: Module
    identifiers: tuple[Identifier, ...]
    """With offsets in the station's inputs and outputs; `slot` counts the station's identifiers, from 1."""
    inputs: Span
    outputs: Span
    parameters: Parameters


@dataclass(frozen=True, slots=True)
class PrmBlock:
    """A block of structured user parameters (Prm_Structure)."""

    type: int
    slot: int
    data: bytes


class Configuration:
    """A station as it is to be: modules in slots, and parameters.

    ``configuration[2]`` or ``configuration["Drive"]`` is a `Place`. `octets` is for Chk_Cfg, `user_parameters` for Set_Prm.
    """

    def __init__(self, device: Device, places: Sequence[tuple[int, Module]], names: Mapping[int, str], *, dpv1: bool | None,
                 fail_safe: bool | None, alarms: Iterable[str]) -> None:
        self.device = device
        self.fail_safe = device.fail_safe if fail_safe is None else fail_safe
        if self.fail_safe != device.fail_safe and (self.fail_safe or device.fail_safe_required):
            what = "it takes zeros in Clear, no empty telegrams" if self.fail_safe else "it requires it (Fail_Safe_required)"
            raise ConfigurationError(f"fail_safe={fail_safe}: {device.title} can not, its GSD file says: {what}")
        if dpv1 not in (None, False, True):
            raise ConfigurationError(f"dpv1 {dpv1!r}: True, False, or None: when the slave has MS1")
        self._dpv1 = dpv1
        self._alarms = self._alarm_bits(alarms)
        self._watchers: list[Callable[[bytes], None]] = []
        self.parameters = Parameters(device.title, device, device, None, self._changed)
        """Of the station; those of a module are in its `Place`."""
        self._owned = self.parameters.masks(3)
        self.places: tuple[Place, ...] = ()
        at = inputs = outputs = 0
        for slot, module in places:
            place = self._place(slot, names.get(slot, module.name), module, at, inputs, outputs)
            at, inputs, outputs = at + len(place.identifiers), inputs + place.inputs.length, outputs + place.outputs.length
            self.places += (place,)
        self.input_length, self.output_length = inputs, outputs
        self.octets = b"".join(place.module.configuration for place in self.places)
        self._check()
        self._check_prm()

    def _place(self, slot: int, name: str, module: Module, at: int, inputs: int, outputs: int) -> Place:
        def moved(data: Data | None, by: int) -> Data | None:
            return data and replace(data, offset=data.offset + by)

        identifiers = tuple(replace(entry, slot=at + entry.slot, inputs=moved(entry.inputs, inputs),
                                    outputs=moved(entry.outputs, outputs)) for entry in module.identifiers)
        parameters = Parameters(f"slot {slot}, {name!r}", self.device, module, module.prm_length, self._changed,
                                slot)
        return Place(slot, name, module, identifiers, Span(inputs, module.input_length), Span(outputs, module.output_length),
                     parameters)

    def __getitem__(self, which: int | str) -> Place:
        """The place of a slot's number, of a name given to a slot, or of a module's name. ConfigurationError for any other."""
        if isinstance(which, int):
            found = [place for place in self.places if place.slot == which]
        else:
            name = plain(str(which))
            found = [place for place in self.places if name in (plain(place.name), plain(place.module.name))]
            found = [place for place in found if plain(place.name) == name] or found
        if len(found) != 1:
            there = ", ".join(f"{place.slot} {place.name!r}" for place in found or self.places)
            raise ConfigurationError(f"{self.device.title} has {'several modules' if found else 'no module'} {which!r}: "
                                     f"{'name it by its slot' if found else 'its slots are'}, {there}")
        return found[0]

    def __iter__(self) -> Iterator[Place]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)

    def __repr__(self) -> str:
        return f"<Configuration of {self.device.title!r}: {', '.join(f'{p.slot} {p.name!r}' for p in self.places)}>"

    # ---- user parameters

    @property
    def user_parameters(self) -> bytes:
        """User_Prm_Data of Set_Prm: the station's block, then each module's in the order of the slots."""
        return self._station_prm() + b"".join(place.parameters.octets for place in self.places)

    def _station_prm(self) -> bytes:
        """Constants and references, or in files without them User_Prm_Data. A DP-V1 slave begins with three status octets."""
        device = self.device
        if device.constants or device.references or device.user_prm is None:
            octets = bytearray(self.parameters.octets)
        else:
            octets = bytearray(device.user_prm)
        if device.dpv1:
            octets.extend(bytes(max(0, 3 - len(octets))))
            self._dpv1_status(octets)
        return bytes(octets)

    def _dpv1_status(self, octets: bytearray) -> None:
        """What the master decides, not the file: except in bits that the file makes a parameter of.

        WD_Base_1ms is clear: Set_Prm counts the watchdog in 10 ms. Fail_Safe says what the master sends in Clear.
        """
        wanted = [
            (0, _DPV1_ENABLE, self._enabled(octets)), (0, _FAIL_SAFE, self.fail_safe),
            (0, _WD_BASE_1MS, False), (1, self._alarms, True), (2, _PRM_STRUCTURE, self._structured(octets)),
        ]
        for at, bits, on in wanted:
            bits &= ~self._owned[at]
            octets[at] = octets[at] | bits if on else octets[at] & ~bits

    def _enabled(self, octets: bytearray) -> bool:
        return self.device.c1_read_write or bool(octets[0] & _DPV1_ENABLE) if self._dpv1 is None else self._dpv1

    def _structured(self, octets: bytearray) -> bool:
        return bool(octets[2] & _PRM_STRUCTURE) or self.device.prm_structure_required

    @property
    def dpv1(self) -> bool:
        """DPV1_Enable is set: the slave opens MS1 and reports alarms."""
        return self.device.dpv1 and bool(self.user_parameters[0] & _DPV1_ENABLE)

    @property
    def prm_blocks(self) -> tuple[PrmBlock, ...]:
        """The blocks of structured user parameters; empty when they are not structured, or lie about their lengths."""
        octets = self.user_parameters
        found = []
        if not self.device.dpv1 or not octets[2] & _PRM_STRUCTURE:
            return ()
        rest = octets[3:]
        while rest:
            if not 4 <= rest[0] <= len(rest):
                return ()
            found.append(PrmBlock(rest[1], rest[2], rest[4 : rest[0]]))
            rest = rest[rest[0] :]
        return tuple(found)

    def _alarm_bits(self, alarms: Iterable[str]) -> int:
        bits = 0
        for name, bit in ALARMS.items():
            bits |= bit if getattr(self.device, f"{name}_alarm_required") else 0
        if isinstance(alarms, str) or not isinstance(alarms, Iterable):
            raise ConfigurationError(f"alarms {alarms!r}: give a list of names, of {', '.join(ALARMS)}")
        for name in alarms:
            if not isinstance(name, str) or name not in ALARMS or not getattr(self.device, f"{name}_alarm"):
                there = ", ".join(known for known in ALARMS if getattr(self.device, f"{known}_alarm")) or "none"
                raise ConfigurationError(f"alarms: {self.device.title} has no {name!r}: it has {there}")
            bits |= ALARMS[name]
        return bits

    # ---- rules

    def _check(self) -> None:
        device = self.device
        broken = next((place.module for place in self.places if not place.module.configuration), None)
        if broken is not None or not self.places:
            what = "no module is chosen" if broken is None else f"module {broken.name!r} has no identifiers in the file"
            raise ConfigurationError(f"{device.title}: {what}; choose of {device.instead() or 'none: the file has no Module'}")
        limits = [("modules", len(self.places), device.most_modules, "Max_Module"),
                  ("octets of inputs", self.input_length, min(IO_MAX, device.max_inputs or IO_MAX), "Max_Input_Len"),
                  ("octets of outputs", self.output_length, min(IO_MAX, device.max_outputs or IO_MAX), "Max_Output_Len"),
                  ("octets of inputs and outputs", self.input_length + self.output_length, device.max_data or 2 * IO_MAX,
                   "Max_Data_Len"),
                  ("identifier octets", len(self.octets), IO_MAX, "a telegram")]
        for what, there, limit, rule in limits:
            if there > limit:
                raise ConfigurationError(f"{device.title}: {there} {what}, and {rule} is {limit}: take modules out")

    def _check_prm(self) -> None:
        length, own = len(self.user_parameters), len(self._station_prm())
        limit = min(USER_PRM_MAX, max(own, self.device.max_user_prm_length or USER_PRM_MAX))
        if length > limit:
            rule = "Max_User_Prm_Data_Len is" if limit < USER_PRM_MAX else "a telegram holds"
            raise ConfigurationError(f"{self.device.title}: {length} octets of user parameters, and {rule} {limit}: take "
                                     "modules out")

    def _changed(self) -> None:
        for watcher in self._watchers:
            watcher(self.user_parameters)

    # ---- for a Station

    @property
    def texts(self) -> Texts:
        """For `Diagnosis.explain`: the maker's words, and the names of the modules."""
        return Texts(self.device, self.places)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know before this station is operated."""
        return tuple(f"slot {place.slot}, {place.name}, has PROFIsafe parameters, which are not sent: this master is no F-Host"
                     for place in self.places if place.module.f_constants or place.module.f_references)

    @property
    def max_tsdr(self) -> dict[int, int]:
        """Tbit for each rate that is supported; where the file promises less than any master can use, that."""
        return {rate: min(MAX_TSDR[1], max(MAX_TSDR[0], bits)) for rate, bits in self.device.max_tsdr.items()
                if rate in self.device.baudrates and bits > 0 and rate != 31250}

    def watch(self, watcher: Callable[[bytes], None]) -> None:
        """Call `watcher(user_parameters)` after each change of a parameter; what it raises undoes the change."""
        self._watchers.append(watcher)


# ---- the choice of modules


def configure(device: Device, modules: Iterable[Chosen] | None, parameters: Mapping[Any, Any] | None,
              names: Mapping[str, int] | None, *, dpv1: bool | None, fail_safe: bool | None,
              alarms: Iterable[str]) -> Configuration:
    """See `GSD.configure`."""
    chosen = choose(device, default_modules(device) if modules is None else modules)
    labels = {}
    for name, slot in _mapping("names", names, '{"Drive": 1}'):
        if not isinstance(slot, int) or slot not in dict(chosen):
            raise ConfigurationError(f"{device.title}: the name {name!r} is for slot {slot!r}, which has no module")
        labels[slot] = name
    configuration = Configuration(device, chosen, labels, dpv1=dpv1, fail_safe=fail_safe, alarms=alarms)
    for name, setting in _mapping("parameters", parameters, '{"Redundancy mode": "on"}'):
        if isinstance(setting, Mapping):
            place = configuration[int(name) if isinstance(name, str) and name.isdecimal() else name]
            for inner, value in setting.items():
                place.parameters[inner] = value
        else:
            configuration.parameters[name] = setting
    return configuration


def _mapping(what: str, given: Mapping[Any, Any] | None, example: str) -> Iterable[tuple[Any, Any]]:
    if given is not None and not isinstance(given, Mapping):
        raise ConfigurationError(f"{what} {given!r}: give a mapping, like {example}")
    return (given or {}).items()


def choose(device: Device, modules: Iterable[Chosen]) -> list[tuple[int, Module]]:
    """Slots and modules: those chosen, those that are fixed, and what stands in the slots between."""
    if isinstance(modules, str) or not isinstance(modules, Iterable):
        raise ConfigurationError(f"modules {modules!r}: give a list of names")
    first = min(device.slots, default=1)
    fixed = [module for module in device.modules if module.preset] if device.fixed_presets else []
    wanted = [_entry(device, entry) for entry in modules]
    if [module for _, module in wanted[: len(fixed)]] == fixed:
        fixed = []
    placed: dict[int, Module] = {}
    at = first
    for slot, module in [(None, module) for module in fixed] + wanted:
        at = at if slot is None else slot
        if at in placed:
            raise ConfigurationError(f"{device.title}: slot {at} is taken by {placed[at].name!r} already")
        if not first <= at <= SLOT_MAX:
            raise ConfigurationError(f"{device.title}: slot {at} of {module.name!r}: its slots begin with {first} and end "
                                     f"with {SLOT_MAX}")
        _allowed(device, at, module)
        placed[at] = module
        at += 1
    for slot in range(first, max([*placed, *device.slots], default=0) + 1):
        placed.setdefault(slot, _default(device, slot))
    return sorted(placed.items(), key=lambda entry: entry[0])


def _entry(device: Device, entry: Chosen) -> tuple[int | None, Module]:
    if isinstance(entry, tuple | list):
        if len(entry) != 2 or not isinstance(entry[0], int):
            raise ConfigurationError(f"module {entry!r}: a name, or a slot's number and a name")
        return entry[0], device.module(entry[1])
    return None, device.module(entry)


def _allowed(device: Device, slot: int, module: Module) -> None:
    definition = device.slots.get(slot)
    if definition is None or definition.allows(module.reference):
        return
    names = [other.name for other in device.modules if definition.allows(other.reference)]
    raise ConfigurationError(f"{device.title}: slot {slot} {definition.name!r} does not take {module.name!r}: it takes "
                             + ", ".join(map(repr, names[:8])) + (", ..." if len(names) > 8 else ""))


def _default(device: Device, slot: int) -> Module:
    definition = device.slots.get(slot)
    return EMPTY if definition is None or definition.default is None else device.module(definition.default)


def default_modules(device: Device) -> list[Module]:
    """See `GSD.default_modules`."""
    if device.slots:
        return []
    preset = [module for module in device.modules if module.preset]
    if preset:
        return preset
    whole = [module for module in device.modules if module.whole]
    return ([module for module in whole if module.input_length or module.output_length] or whole)[:1]
