# SPDX-License-Identifier: MIT
"""One block of user parameters: its constants, its references, and the settings of a person by their names.

Knows nothing of stations or modules; `configuration.py` puts blocks together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from dpmaster.errors import ConfigurationError
from dpmaster.gsd.model import USER_PRM_MAX, Device, Parameter, _Prm, plain


@dataclass(frozen=True, slots=True)
class Placed:
    """A parameter and where it lies in its block."""

    name: str
    offset: int
    parameter: Parameter


class Parameters(Mapping[str, int | str]):
    """The parameters of a station or a module by name, each at its default until it is set.

    ``parameters["Redundancy mode"] = "on"``: a text of its PrmText, or a number. Capitals and blanks at the ends do not count.
    Where several have one name, it is followed by ``#1``, ``#2`` and so on, in the order of the octets they lie in. Reading
    gives the text, or the number where there is none. Setting raises ConfigurationError for what is not allowed. What makers
    call ``[SlotNumber]`` begins as the number of the module's slot.
    """

    def __init__(self, whose: str, device: Device, block: _Prm, length: int | None,
                 changed: Callable[[], None] = lambda: None, slot: int | None = None) -> None:
        self._whose = whose
        self._changed = changed
        room = USER_PRM_MAX if length is None else length  # what does not fit is a finding of the file's
        self._constants = [(offset, octets) for offset, octets in block.constants if offset + len(octets) <= room]
        found = [(offset, device.parameters[number]) for offset, number in block.references if number in device.parameters]
        found = [(offset, parameter) for offset, parameter in found if offset + parameter.octets <= room]
        self.placed = self._name(found)
        self.defaults = {placed.name: self._default(placed.parameter, slot) for placed in self.placed}
        self._values = dict(self.defaults)
        self._names = {plain(placed.name): placed for placed in self.placed}
        ends = [offset + len(octets) for offset, octets in self._constants] + [at + p.octets for at, p in found]
        self.length = max(ends, default=0) if length is None else length
        """Octets of the block."""

    @staticmethod
    def _default(parameter: Parameter, slot: int | None) -> int:
        own = slot is not None and plain(parameter.name) == "[slotnumber]" and parameter.allows(slot)
        return slot if own and slot is not None else parameter.default

    @staticmethod
    def _name(found: list[tuple[int, Parameter]]) -> tuple[Placed, ...]:
        many = Counter(plain(parameter.name) for _, parameter in found)
        seen: Counter[str] = Counter()
        placed = []
        for offset, parameter in sorted(found, key=lambda entry: (entry[0], entry[1].first)):
            name = parameter.name
            if many[plain(name)] > 1:
                seen[plain(name)] += 1
                name = f"{name}#{seen[plain(name)]}"
            placed.append(Placed(name, offset, parameter))
        return tuple(placed)

    def find(self, name: str) -> Placed:
        """Where the parameter of this name lies. Raises ConfigurationError that names those there are."""
        placed = self._names.get(plain(str(name)))
        if placed is None:
            names = [entry.name for entry in self.placed]
            alike = [entry for entry in names if plain(entry).startswith(plain(str(name)) + "#")]
            there = ", ".join(map(repr, (alike or names)[:20])) or "none"
            raise ConfigurationError(f"{self._whose} has no parameter {name!r}: there {'is' if not names else 'are'} {there}")
        return placed

    def __getitem__(self, name: str) -> int | str:
        placed = self._names.get(plain(str(name)))
        if placed is None:
            raise KeyError(name)
        return placed.parameter.shown(self._values[placed.name])

    def __setitem__(self, name: str, setting: object) -> None:
        placed = self.find(name)
        try:
            value = placed.parameter.value(setting)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self._whose}: {error}") from None
        before = self._values[placed.name]
        if value != before and not placed.parameter.changeable:
            raise ConfigurationError(f"{self._whose}: parameter {name!r} is not changeable (Changeable = 0): it is "
                                     f"{placed.parameter.shown(before)!r}")
        self._values[placed.name] = value
        try:
            self._changed()
        except BaseException:
            self._values[placed.name] = before
            raise

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return repr(dict(self))

    def masks(self, length: int) -> bytes:
        """Of the block's first octets the bits that are some parameter's."""
        block = bytearray(max(length, self.length))
        for placed in self.placed:
            placed.parameter.put(block, placed.offset, -1)
        return bytes(block[:length])

    @property
    def changed(self) -> dict[str, int | str]:
        """Those that are not at their defaults."""
        return {name: self[name] for name, value in self._values.items() if value != self.defaults[name]}

    @property
    def octets(self) -> bytes:
        """The block: constants in the order of the file, then each parameter's own bits."""
        block = bytearray(self.length)
        for offset, octets in self._constants:
            block[offset : offset + len(octets)] = octets
        for placed in self.placed:
            placed.parameter.put(block, placed.offset, self._values[placed.name])
        return bytes(block)
