# SPDX-License-Identifier: MIT
"""Random requests, PKW and MEMOBUS, against the emulated SI-P3 and a model of a dozen rules that knows neither its code nor
the profile's tables: what the manual and the devices page say, written down a second time."""

from __future__ import annotations

import os

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from sip3_host import RUN, Host

# name, PNU, IND, register, lowest, highest, default, changeable while running; with those that lie behind them in the registers
PARAMETERS = [
    ("C1-01", 31, 1, 0x200, 0, 60000, 100, True), ("C1-02", 31, 2, 0x201, 0, 60000, 100, True),
    *((f"d1-{n:02}", 41, n, 0x27F + n, 0, 40000, 0, True) for n in range(1, 7)), ("d1-17", 41, 17, 0x292, 0, 40000, 600, True),
    ("E1-04", 51, 4, 0x303, 400, 4000, 600, False), ("F6-01", 66, 1, 0x3A2, 0, 3, 1, False),
    ("F6-02", 66, 2, 0x3A3, 0, 1, 0, False), ("F6-03", 66, 3, 0x3A4, 0, 3, 1, False),
    ("F6-31", 66, 31, 0x3CC, 0, 1, 0, False), ("F6-32", 66, 32, 0x3CD, 0, 1, 0, False),
    ("F6-33", 66, 33, 0x3CE, 0, 1, 0, False), ("H4-03", 84, 3, 0x41F, -9999, 9999, 0, True),
    ("H4-04", 84, 4, 0x420, 0, 999, 103, False),
    ("U1-04", 211, 4, 0x43, 0, 0, 2, False)]
GROUPS = {31, 41, 51, 66, 84, 211}
PLACES = {(pnu, index): register for name, pnu, index, register, *_ in PARAMETERS if name != "F6-33"}
BY_REGISTER = {entry[3]: entry for entry in PARAMETERS}
ROOM = (0x0550, 0x0600, 0x000A)  # registers without a parameter; 000Ah is a command register
REGISTERS = sorted([*(BY_REGISTER.keys() - {0x3CE}), *ROOM, 0, 0x22, 0x601, 0x900, 0x910, 0xFFFF])
ADDRESSES = [0x200, 0x201, 0x280, 0x281, 0x282, 0x292, 0x303, 0x3A2, 0x3CC, 0x41F, 0x43, *ROOM, 0, 0x22, 0x601, 0x900, 0x910,
             0xFFFF]
"""Where MEMOBUS messages begin: up to four registers from there on are all known here."""

words = st.one_of(st.sampled_from([0, 1, 2, 3, 10, 400, 600, 4000, 40000, 40001, 60000, 60001, 0xD8F1, 0xD8F0, 0xFFFF]),
                  st.integers(0, 0xFFFF))


class Model:
    """The drive as its manual tells it: what is written is read back, what is entered counts, what is stored stays."""

    def __init__(self, conventional: bool) -> None:
        self.conventional = conventional
        self.stored = {entry[3]: entry[6] for entry in PARAMETERS}
        self.running = self.undervoltage = False
        self.assigned = [1, 2, 6, 7, 9, 15, 0, 0, 0, 0]
        self.assigned_stored = list(self.assigned)
        self.power_up()

    def power_up(self) -> None:
        self.stored[0x3CD] = int(self.conventional)  # F6-32 follows the configuration
        self.values = dict(self.stored)
        self.force = dict(self.stored)
        self.assigned = list(self.assigned_stored)

    def read(self, register: int) -> int:
        return self.values.get(register, 0)

    def refuses(self, register: int, word: int) -> str:
        """"", "no register", "now" (undervoltage), "never" (read-only, or the drive runs), "limit"."""
        if register in (0x900, 0x910):
            return "now" if self.undervoltage else "never" if register == 0x900 and self.running else ""
        if register > 0x600:
            return "no register"
        if self.undervoltage:
            return "now"
        if 0x20 <= register <= 0xFF:
            return "never"
        if register in BY_REGISTER:
            *_, low, high, _, running = BY_REGISTER[register]
            if self.running and not running:
                return "never"
            if not low <= (word - 0x10000 if low < 0 and word > 0x7FFF else word) <= high:
                return "limit"
        return ""

    def write(self, register: int, word: int) -> None:
        if register not in (0x900, 0x910):
            self.values[register] = word
            return
        self.force = {register: self.values[register] for register in self.force}
        if register == 0x900:
            self.stored = dict(self.force)
            self.assigned_stored = list(self.assigned)

    # -- PKW: the hexadecimal digits of PKE, IND and PWE

    def pkw(self, task: int, pnu: int, index: int, value: int) -> tuple[int, int]:
        """Response identifier and PWE."""
        if task not in (1, 2, 3, 6, 7, 8, 9):
            return 7, 106
        array = pnu in GROUPS | {0, 915}
        if not array and pnu not in (300, 301, 904, 971):
            return 7, 0
        if task == 9:
            return (6, {0: 0x601, 915: 10}.get(pnu, 100)) if array else (7, 3)
        if array != (task in (6, 7, 8)) or (not array and index):
            return 7, 3
        if task in (2, 7) and value > 0xFFFF:
            return 7, 2
        if pnu == 915:
            return self.assignment(task, index, value)
        if not array:
            return self.command(task, pnu)
        if pnu and (pnu, index) not in PLACES:
            return 7, 3
        register = PLACES[pnu, index] if pnu else index
        if not 1 <= register <= 0x600:
            return 7, 3
        if task == 6:
            return 4, self.read(register)
        return (7, 1) if task == 8 else self.change(register, value)

    def change(self, register: int, value: int) -> tuple[int, int]:
        refused = self.refuses(register, value)
        if refused:
            return 7, {"now": 17, "never": 1, "limit": 2}[refused]
        self.write(register, value)
        return 4, 0

    def assignment(self, task: int, index: int, value: int) -> tuple[int, int]:
        if task == 8:
            return 7, 1
        if not 1 <= index <= 10:
            return 7, 3
        if task == 6:
            return 4, self.assigned[index - 1]
        if index <= 2:
            return 7, 1
        self.assigned[index - 1] = value
        return 4, 0

    def command(self, task: int, pnu: int) -> tuple[int, int]:
        if pnu == 904:
            return (1, 1) if task == 1 else (7, 1)
        if task == 1:
            return 7, 0
        if task == 3:
            return 7, 1
        response, value = self.change(0x910 if pnu == 300 else 0x900, 0)
        return (1, 0) if response == 4 else (7, value)

    @property
    def diagnosis(self) -> bytes:
        illegal = any(n not in (*range(11), 15, 16, 17, 27, 28, 29) for n in self.assigned)
        octet = self.undervoltage + 4 * illegal
        return bytes.fromhex(f"05 81 00 00 {octet:02x}") if octet else b""

    # -- MEMOBUS

    def memobus(self, function: int, address: int, length: int, data: list[int]) -> str:
        """The answer's function, address, length and data."""
        code = self.memobus_error(function, address, length, data)
        if code:
            return f"{function | 0x80:02x}000002{code:04x}" + "0000" * (len(data) - 1)
        n = length // 2
        if function == 8:
            return f"08{address:04x}{length:02x}" + "".join(f"{word:04x}" for word in data)
        found = [0] * len(data)
        if function == 3:
            found[:n] = [self.read(address + i) for i in range(n)]
        else:
            for i in range(n):
                self.write(address + i, data[i])
        return f"{function:02x}{address:04x}{length:02x}" + "".join(f"{word:04x}" for word in found)

    def memobus_error(self, function: int, address: int, length: int, data: list[int]) -> int:
        if function not in (3, 8, 0x10):
            return 1
        if length % 2 or not 0 < length <= 2 * len(data):
            return 3
        n = length // 2
        if function == 3:
            return 2 if address + n - 1 > 0x600 else 0
        if function == 8:
            return 0
        if n > 1 and address + n - 1 > 0x600:
            return 2
        refused = {self.refuses(address + i, data[i]) for i in range(n)}
        return next((code for why, code in (("no register", 2), ("now", 0x22), ("never", 0x22), ("limit", 0x21))
                     if why in refused), 0)


class Requests(RuleBasedStateMachine):
    """One card; what it answers, what it shows and what it keeps is the model's."""

    host: Host

    @initialize(kind=st.sampled_from(["PPO Type 1", "Extended Data 1", "Extended Data 2"]), seed=st.integers(0, 99))
    def begin(self, kind: str, seed: int) -> None:
        self.host = Host(kind, seed=seed)
        self.ppo = kind == "PPO Type 1"
        self.words = {"Extended Data 1": 4, "Extended Data 2": 1}.get(kind, 0)
        self.model = Model(not self.ppo)
        self.command()

    def command(self) -> None:
        """Run, or stand with a baseblock, whose stop no written deceleration time makes longer."""
        if self.ppo:
            self.host.command(RUN if self.model.running else 0x0400, 0.1)
        else:
            self.host.drive(0x0001 if self.model.running else 0x8000, 6.0)
        self.host.after(0.001)

    @precondition(lambda self: self.ppo)
    @rule(task=st.integers(1, 15), place=st.one_of(
        st.sampled_from([*PLACES, (31, 3), (41, 0)]), st.tuples(st.just(0), st.sampled_from(REGISTERS)),
        st.tuples(st.just(915), st.integers(0, 11)), st.tuples(st.sampled_from([1, 300, 301, 904, 971, 2047]), st.just(0)),
        st.tuples(st.sampled_from([0, 31, 915, 904]), st.integers(0, 0xFFFF))),
        value=st.one_of(words, st.integers(0, 0xFFFF_FFFF)))
    def pkw(self, task: int, place: tuple[int, int], value: int) -> None:
        pnu, index = place
        response, found = self.model.pkw(task, pnu, index, value)
        assert self.host.task(f"{task:x}{pnu:03x} {index:04x} {value:08x}") == f"{response:x}{pnu:03x} {index:04x} {found:08x}"

    @precondition(lambda self: self.ppo)
    @rule(pnu_index=st.sampled_from([*PLACES]), value=words)
    def pkw_write_and_read(self, pnu_index: tuple[int, int], value: int) -> None:
        self.pkw(7, pnu_index, value)
        self.pkw(6, pnu_index, 0)

    @precondition(lambda self: self.words)
    @rule(function=st.sampled_from([3, 3, 8, 0x10, 0x10, 0x10, 7, 0x83]), address=st.sampled_from(ADDRESSES),
          length=st.sampled_from([0, 1, 2, 2, 2, 4, 6, 8, 10]), data=st.lists(words, min_size=4, max_size=4))
    def memobus(self, function: int, address: int, length: int, data: list[int]) -> None:
        data = data[:self.words]
        if 0x20 <= address <= 0xFF and length > 2:
            length = 2  # the monitors behind it live
        message = f"{function:02x}{address:04x}{length:02x}" + "".join(f"{word:04x}" for word in data)
        assert self.host.access(message) == self.model.memobus(function, address, length, data)

    @rule()
    def run_or_halt(self) -> None:
        self.model.running = not self.model.running and not self.model.undervoltage
        self.command()

    @precondition(lambda self: not self.model.running)
    @rule()
    def undervoltage(self) -> None:
        self.host.card.undervoltage = self.model.undervoltage = not self.model.undervoltage
        self.host.after(0.001)

    @precondition(lambda self: not self.model.running)
    @rule()
    def power_cycle(self) -> None:
        self.host.outputs[:] = bytes(self.host.size)
        self.model.power_up()
        self.host.card.reset(self.host.now)
        self.host.after(0.2)
        self.command()

    @invariant()
    def the_same_is_written_and_in_force(self) -> None:
        if not hasattr(self, "host"):
            return
        for name, *_, register, _low, _high, _default, _running in PARAMETERS:
            assert self.host.card.registers.word(register) == self.model.read(register)
            if register > 0xFF:
                assert self.host.card.registers.setting(name) & 0xFFFF == self.model.force[register]
        assert self.host.card.diagnosis == self.model.diagnosis


TestRequests = Requests.TestCase
TestRequests.settings = settings(max_examples=int(os.environ.get("DPM_REQUESTS", "60")), stateful_step_count=25)
