# SPDX-License-Identifier: MIT
"""The registers of the drive behind an SI-P3: what a parameter was set to, what is in force, what is stored.

Knows nothing of the card: living values of monitors come from a function that it is given.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, MutableMapping, Set

from dpmaster.errors import ConfigurationError
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.yaskawa import LAST_REGISTER, AccessCode
from dpmaster.profiles.yaskawa_1000 import Table


def _join(words: Iterable[int]) -> int:
    """A word, or a double word with the high word first."""
    value = 0
    for word in words:
        value = value << 16 | word
    return value


class Registers(MutableMapping[int | str, int]):
    """The drive's registers as a person with the keypad sees them, 0000h to 0600h.

    A name ("C1-01") stands for the parameter's count, with its sign and its limits, a number for the raw word. What is
    set here is in force and stored at once; what the bus writes is in force after an Enter command, and stored with the
    one to ROM. 0020h to 00FFh are monitors; setting one pins it until ``del`` frees it, for tests of the other side.
    Registers without a parameter are mere room: they keep what was written until the power is cycled.
    """

    def __init__(self, table: Table, monitor: Callable[[int], int], lock: threading.RLock) -> None:
        self.table = table
        self._monitor = monitor
        self._lock = lock
        self._words: dict[int, int] = {}
        self._active: dict[int, int] = {}
        self._settings: dict[str, int] = {}
        self._stored = {address: word for name in table for address, word in self._split(name, table[name].default)
                        if address not in profile.MONITORS}
        self.recall()

    def __getitem__(self, key: int | str) -> int:
        if parameter := self._named(key):
            return parameter.count(self.value(parameter.registers))
        return self.word(self._address(key))

    def __setitem__(self, key: int | str, value: int) -> None:
        low, high = self.limits(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ConfigurationError(f"{self.table.register_name(self._address(key))} = {value!r}: the register takes "
                                     f"{low} to {high}")
        words = dict(self._split(key, value) if self._named(key) else [(self._address(key), value)])
        with self._lock:
            self._words |= words
            self._take(words.keys() & self._active.keys(), store=True)

    def __delitem__(self, key: int | str) -> None:
        """Back to the factory's value; a pinned monitor lives again."""
        address = self._address(key)
        parameter = self.table.at(address)
        if parameter and parameter.access != "r":
            self[parameter.name] = parameter.default
        else:
            with self._lock:
                self._words.pop(address, None)

    def __iter__(self) -> Iterator[int]:
        return iter(range(LAST_REGISTER + 1))

    def __len__(self) -> int:
        return LAST_REGISTER + 1

    def limits(self, key: int | str) -> tuple[int, int]:
        """Lowest and highest count of a parameter; of a number that is no parameter's, of the word."""
        parameter = self._named(key)
        if parameter is None:
            parameter = self.table.at(self._address(key))
            if parameter is None or parameter.double or parameter.minimum < 0:
                return 0, 0xFFFF
        return parameter.minimum, parameter.maximum

    def word(self, address: int) -> int:
        """The raw word at an address, as the bus reads it."""
        with self._lock:
            if address in self._words:
                return self._words[address]
            return self._monitor(address) if address in profile.MONITORS else 0

    def value(self, registers: range) -> int:
        """The word of one register, the double word of two."""
        return _join(map(self.word, registers))

    def refusal(self, address: int, words: list[int], *, running: bool, blocked: bool) -> AccessCode | None:
        """Why the drive does not take these words from the bus, None when it does; `blocked` is undervoltage or storing."""
        enter = len(words) == 1 and address in (profile.ENTER_RAM, profile.ENTER_ROM)
        if not enter and address + len(words) - 1 > LAST_REGISTER:
            return AccessCode.ADDRESS
        if blocked or (address == profile.ENTER_ROM and running):
            return AccessCode.WRITE
        if enter:
            return None
        new = dict(enumerate(words, address))
        affected = {parameter for at in new if (parameter := self.table.at(at))}
        if any(at in profile.MONITORS for at in new) or any(
                parameter.access == "r" or (running and not parameter.running) for parameter in affected):
            return AccessCode.WRITE
        for parameter in affected:
            count = parameter.count(_join(new.get(at, self.word(at)) for at in parameter.registers))
            if not parameter.minimum <= count <= parameter.maximum:
                return AccessCode.CONTENT
        return None

    def write(self, address: int, words: list[int]) -> None:
        """What the bus writes: to be read back at once, in force after `enter`."""
        self._words.update(enumerate(words, address))

    def setting(self, name: str) -> int:
        """What is in force of a parameter of one word; `name` as the table writes it."""
        if name not in self._settings:  # most are asked for many times between two Enter commands
            parameter = self.table[name]
            self._settings[name] = parameter.count(self._active[parameter.register])
        return self._settings[name]

    def enter(self, store: bool) -> None:
        """The Enter command: what was written comes into force, and with `store` outlives the power."""
        self._take(self._active.keys(), store)

    def _take(self, addresses: Set[int], store: bool) -> None:
        self._active |= {address: self._words[address] for address in addresses}
        self._settings.clear()
        if self.setting("A1-03") in (2220, 3330):
            self._initialise()
        if store:
            self._stored |= {address: self._active[address] for address in addresses}

    def recall(self) -> None:
        """What power-up finds."""
        self._active = dict(self._stored)
        self._words = dict(self._stored)
        self._settings.clear()

    def _initialise(self) -> None:
        """A1-03: the factory's values, without F6 and F7 unless F6-08 says so. A1-02 is never initialised."""
        kept = ("A1-02",) if self.setting("F6-08") else ("A1-02", "F6-", "F7-")
        for name in self.table:
            if self.table[name].access != "r" and (not name.startswith(kept) or name == "A1-03"):
                self._active.update(self._split(name, self.table[name].default))
        self._words |= self._active
        self._stored |= self._active
        self._settings.clear()

    def _named(self, key: int | str) -> profile.Parameter | None:
        """The parameter when `key` is its name."""
        return self.table.get(key) if isinstance(key, str) else None

    def _split(self, name: int | str, count: int) -> list[tuple[int, int]]:
        """Addresses and words of a parameter's count, the high word first."""
        registers = self.table[str(name)].registers
        return [(address, count >> 16 * (registers[-1] - address) & 0xFFFF) for address in registers]

    def _address(self, key: int | str) -> int:
        address = self.table.register(key)
        if address > LAST_REGISTER:
            raise ConfigurationError(f"register {key!r}: the drive has 0000h to {LAST_REGISTER:04X}h")
        return address
