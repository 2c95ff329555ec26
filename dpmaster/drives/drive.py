# SPDX-License-Identifier: MIT
"""A variable-speed drive, whatever its make: what a program may ask of each of them, and what they do alike.

A drive class says how a set-point, a run command and a status look on its wire; moving, stopping, waiting, per cent and
hertz are here. Sits on `Station` alone and knows neither bus nor port. Its time is that of the frames, so that it runs on
virtual time too.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, fields
from enum import IntFlag
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

from dpmaster._arguments import number
from dpmaster.diagnosis import DiagnosisTables, DiagnosisTexts
from dpmaster.errors import CommissioningError, ConfigurationError, DPTimeout, OutputsDiscarded, StationError
from dpmaster.profiles.yaskawa import WordOrder, get_word
from dpmaster.station import Frame, Station

if TYPE_CHECKING:
    from dpmaster.drives.aio import AsyncDrive

log = logging.getLogger(__name__)

SETTLE = 0.020
"""Seconds that a drive may take to look at a new command: what its status says until then may be about the one before."""
REST = 0.5
"""Seconds, and a fixed cycle time, in which the stop word must have been answered when the master leaves Operate."""
HEAR = 0.5
"""Seconds in which a drive that listens shows that it runs."""
RESET = 1.0
"""Seconds that a fault whose cause is gone may take to go."""


class DriveStatus(Protocol):
    """What every drive says of itself. A value that the configuration does not carry is None."""

    @property
    def running(self) -> bool:
        """The drive's output is on."""

    @property
    def reverse(self) -> bool:
        """It turns, or is told to turn, in reverse."""

    @property
    def zero_speed(self) -> bool:
        """The motor stands."""

    @property
    def at_speed(self) -> bool:
        """The set-point is reached."""

    @property
    def ready(self) -> bool:
        """A run command would be followed."""

    @property
    def alarm(self) -> bool:
        """A minor fault: the drive runs on."""

    @property
    def fault(self) -> bool:
        """A fault: the drive stopped, or will not start, until `Drive.fault_reset`."""

    @property
    def remote(self) -> bool:
        """Run command and set-point come from the bus."""

    @property
    def output_frequency(self) -> float | None:
        """Hz, without sign."""

    @property
    def current(self) -> float | None:
        """A."""

    @property
    def valid(self) -> bool:
        """Whether the exchange is under way; after a loss the last values stay."""


S = TypeVar("S", bound=DriveStatus)


@dataclass(frozen=True, slots=True)
class ParameterInfo:
    """What a drive class knows of a parameter; limits in `unit`, None where it knows none."""

    name: str
    text: str = ""
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    decimals: int = 0

    def describe(self, value: float) -> str:
        """A value with all that is known: "10.0 s  acceleration time from 0 to E1-04 (0.0 to 6000.0)"."""
        def shown(amount: float) -> str:
            return f"{amount:.{self.decimals}f}"

        limits = "" if self.minimum is None or self.maximum is None else f"({shown(self.minimum)} to {shown(self.maximum)})"
        return f"{f'{shown(value)} {self.unit}':<12}{self.text} {limits}".rstrip()


def flags_and_values(status: Any) -> str:
    """A status dataclass in one line: the flags that are set, then the values there are."""
    on = [f.name for f in fields(status) if getattr(status, f.name) is True]
    values = [f"{f.name}={value:g}" for f in fields(status)
              if isinstance(value := getattr(status, f.name), (int, float)) and not isinstance(value, (bool, IntFlag))]
    return ", ".join(on + values) or "no flag set"


class Drive(Station, ABC, Generic[S]):
    """A variable-speed drive as a station: run, stop, set-points, status, faults, parameters.

    Set-points are positive, Hz or per cent of the drive's highest frequency; `reverse` turns the other way. Commands return
    when they are committed; whoever waits for the status waits first until the last command has reached the drive. Any
    thread may call. `configuration` is what Chk_Cfg sends, `layout` its name; `words` are the octets at which the output
    words lie, by name.
    """

    def __init__(self, address: int, ident_number: int, configuration: bytes, words: Mapping[str, int], *,
                 layout: str, word_order: WordOrder = "big", name: str | None = None, **station: Any) -> None:
        super().__init__(address, ident_number, configuration, name=name or f"drive {address}", **station)
        if word_order not in ("big", "little"):
            raise ConfigurationError(f"word_order {word_order!r}: give 'big' or 'little'")
        self._word_order: WordOrder = word_order
        self._words = words
        self.layout = layout
        self._reverse = False
        self._pending: int | None = None
        self._settled = 0.0

    diagnosis_texts: ClassVar[DiagnosisTexts] = DiagnosisTables()
    """What the maker says about the extended diagnosis."""

    # -- What a drive class says ----------------------------------------------------------------------------------------

    @abstractmethod
    def _decode(self, frame: Frame) -> S:
        """What the drive said in a frame."""

    @abstractmethod
    def _need_control(self) -> None:
        """Raise CommissioningError when parameters keep the bus from moving the drive. May ask the drive."""

    @abstractmethod
    def _from_hz(self, hz: float) -> int:
        """A set-point above 0 in counts of the bus; ConfigurationError above the drive's highest. May ask the drive."""

    @abstractmethod
    def _to_hz(self, count: int) -> float:
        """The way back. May ask the drive."""

    @property
    @abstractmethod
    def highest_frequency(self) -> float:
        """The drive's highest frequency, Hz: 100 %. May ask the drive. ConfigurationError where it cannot be known."""

    @abstractmethod
    def _reference(self) -> int:
        """The set-point's counts in the outputs, without sign."""

    @abstractmethod
    def _commit_setpoint(self, count: int) -> int:
        """Commit a set-point alone."""

    @abstractmethod
    def _commit_run(self, count: int) -> int:
        """Commit the run command for the direction `self._reverse` together with its set-point."""

    @abstractmethod
    def _commit_stop(self) -> int:
        """Commit the stop word: the drive ramps down as its parameters say."""

    @abstractmethod
    def _commit_reset(self, on: bool) -> int:
        """One side of the edge that resets a fault, without any run command."""

    @abstractmethod
    def __getitem__(self, name: str) -> float:
        """A parameter by the drive's own name for it, in the unit that the manual gives it."""

    @abstractmethod
    def __setitem__(self, name: str, value: float) -> None:
        """Write a parameter. ParameterAccessError carries the drive's code and its meaning."""

    def write(self, values: Mapping[str, float], *, store: bool = False) -> None:
        """Write several parameters; with `store` so that they outlive the power, where the bus can ask for that."""
        if store:
            raise ConfigurationError(f"{self.name}: its card has no command to store parameters; write them without store")
        for name, value in values.items():
            self[name] = value

    @abstractmethod
    def parameter(self, name: str) -> ParameterInfo:
        """What is known of a parameter. ConfigurationError when there can be none of that name."""

    @property
    @abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """The parameters that the class has a table for; the drive has more."""

    # -- Moving ---------------------------------------------------------------------------------------------------------

    def run(self, hz: float | None = None, *, percent: float | None = None, reverse: bool = False) -> None:
        """Run at `hz`, or at `percent` of the drive's highest frequency; with neither, at the set-point there is.

        CommissioningError names the parameters that keep the bus from moving the drive. They are read once, and again after
        every `operate()`; not all configurations can.
        """
        if hz is not None and percent is not None:
            raise ConfigurationError(f"run at {hz} Hz and at {percent} %: give one of them")
        self._need_control()
        count = self._count_hz(hz) if hz is not None else self._count_percent(percent) if percent is not None else None
        with self._commands:
            self._reverse = bool(reverse)
            self._pending = self._commit_run(self._reference() if count is None else count)

    def run_forward(self, hz: float) -> None:
        """`run` forward."""
        self.run(hz)

    def run_reverse(self, hz: float) -> None:
        """`run` in reverse at `hz`, a positive number."""
        self.run(hz, reverse=True)

    def stop(self) -> None:
        """Take the run command away; the drive ramps down as its parameters say. The set-point stays."""
        with self._commands:
            self._pending = self._commit_stop()

    @property
    def frequency(self) -> float:
        """Set-point, Hz. Setting it changes the speed and neither starts nor stops the drive."""
        count = self._reference()
        return self._to_hz(count) if count else 0.0

    @frequency.setter
    def frequency(self, hz: float) -> None:
        self._set(self._count_hz(hz))

    @property
    def percent(self) -> float:
        """Set-point, per cent of the drive's highest frequency. Setting it is like setting `frequency`."""
        count = self._reference()
        return self._to_percent(count) if count else 0.0

    @percent.setter
    def percent(self, percent: float) -> None:
        self._set(self._count_percent(percent))

    def _set(self, count: int) -> None:
        with self._commands:
            self._pending = self._commit_setpoint(count)

    def _count_hz(self, hz: float) -> int:
        value = self._setpoint("frequency", hz, "Hz")
        return self._from_hz(value) if value else 0

    def _count_percent(self, percent: float) -> int:
        value = self._setpoint("percent", percent, "%")
        if value > 100:
            raise ConfigurationError(f"percent {value}: the limit is 100, the drive's highest frequency")
        return self._from_percent(value) if value else 0

    @staticmethod
    def _setpoint(what: str, value: object, unit: str) -> float:
        if not number(value):
            raise ConfigurationError(f"{what} {value!r} {unit}: give a number of {unit}")
        given = float(value)  # type: ignore[arg-type]
        if given < 0:
            raise ConfigurationError(f"{what} {given} {unit}: give a positive number; run_reverse turns the other way")
        return given

    def _from_percent(self, percent: float) -> int:
        return self._from_hz(percent * self.highest_frequency / 100)

    def _to_percent(self, count: int) -> float:
        return round(self._to_hz(count) * 100 / self.highest_frequency, 6)

    # -- Status ---------------------------------------------------------------------------------------------------------

    @property
    def status(self) -> S:
        """What the drive said in the last frame."""
        return self._decode(self.frame)

    def wait_until(self, predicate: Callable[[S], bool], timeout: float) -> S:
        """Wait until the status fulfils `predicate` and return it; DPTimeout names the last status.

        First the last command is let reach the drive: a status that may still speak of the one before is not looked
        at. Waiting here feeds the output watchdog, if this thread committed last.
        """
        try:
            self._settle(timeout)
            frame = self.wait(lambda f: f.valid and f.time >= self._settled and predicate(self._decode(f)), timeout)
        except DPTimeout as late:
            raise DPTimeout(f"{self.name}: not within {timeout} s; the last status is: {self.status} ({late})") from late
        return self._decode(frame)

    def wait_at_speed(self, timeout: float) -> S:
        """Wait until the set-point is reached. StationError as soon as the drive shows a fault; DPTimeout."""
        return self._without_fault(self.wait_until(lambda s: s.fault or s.at_speed, timeout))

    def wait_stopped(self, timeout: float) -> S:
        """Wait until the motor stands and the output is off. A fault does not matter here; DPTimeout."""
        return self.wait_until(lambda s: s.zero_speed and not s.running, timeout)

    def _without_fault(self, status: S) -> S:
        if status.fault:
            raise StationError(f"{self.name}: shows a fault (status: {status}); fault_reset() resets it when its cause is gone",
                               address=self.address, reason="fault")
        return status

    def _settle(self, timeout: float) -> None:
        """See the last command answered, and note from when on the status is about it."""
        number = self._pending
        if number is None:
            return
        try:
            self.wait_sent(number, timeout)
        except OutputsDiscarded:
            self._forget(number)
            raise
        self._settled = self.frame.time + SETTLE
        self._forget(number)

    def _forget(self, number: int) -> None:
        """Nobody need wait for this command any more, which until now every thread had to; a later one stands."""
        with self._commands:
            if self._pending == number:
                self._pending = None

    # -- Faults ---------------------------------------------------------------------------------------------------------

    def faults(self) -> tuple[str, ...]:
        """What the drive shows as its faults, the newest first, as its manual names them; empty: none.

        A drive that cannot name them says "fault".
        """
        return ("fault",) if self.status.fault else ()

    def explain_diagnosis(self) -> str:
        """The last diagnosis fetched, in words, the maker's too; "" when it has nothing to report."""
        diagnosis = self.diagnosis
        return "" if diagnosis is None else "; ".join(diagnosis.explain(self.diagnosis_texts))

    def fault_reset(self) -> None:
        """Reset a fault whose cause is gone. StationError if it stays for a second.

        The run command is taken away with it: after a reset the drive stands until it is told to run.
        """
        self._edge(True)
        try:
            self.wait(lambda f: f.valid and not self._decode(f).fault, RESET + 2 * self._pace)
        except DPTimeout as late:
            raise StationError(f"{self.name}: the fault stays; its cause is still there (status: {self.status})",
                               address=self.address, reason="fault") from late
        finally:
            self._edge(False)

    def _edge(self, on: bool) -> None:
        """One side of the reset's edge: committed, and seen to be answered."""
        with self._commands:
            self._pending = number = self._commit_reset(on)
        self.wait_sent(number, 1.0)

    def _see_running(self, needed: Mapping[str, int], heard: Callable[[S], bool]) -> None:
        """The stand-in for reading parameters where nothing can: a drive that listens shows it within half a second."""
        try:
            self.wait_until(heard, HEAR + 2 * self._pace)
        except DPTimeout as late:
            self.stop()
            if not self.status.valid:
                raise  # it is not heard, which says nothing of its parameters
            if self.status.fault:
                raise StationError(f"{self.name}: does not run, it shows a fault ({self.status}); fault_reset() first",
                                   address=self.address, reason="fault") from late
            wanted = " and ".join(f"{name} = {value}" for name, value in needed.items())
            raise CommissioningError(
                f"{self.name}: shows no running. It needs {wanted}, which {self.layout} has no channel to read; "
                f"check them at the keypad (status: {self.status})", parameters=tuple(needed)) from late

    # -- Output words ---------------------------------------------------------------------------------------------------

    def _offset(self, name: str) -> int:
        try:
            return self._words[name]
        except KeyError:
            raise ConfigurationError(f"{name}: {self.layout} has no such word") from None

    def _output_word(self, name: str) -> int:
        """A word as the next commit builds on it: after a loss or Clear that is 0, whatever was commanded before."""
        return get_word(self.outputs, self._offset(name), self._word_order)

    def _change(self, name: str, *, clear: int, set_: int = 0) -> int:
        """Clear and set bits of a word in one commit; its number.

        Read and committed in one step: an order of before a loss that happens just now is not carried over it.
        """
        keep, octets = ~clear & ~set_ & 0xFFFF, set_ & 0xFFFF
        with self._commands:
            order = self._word_order
            self._pending = number = self.update(self._offset(name), octets.to_bytes(2, order), keep.to_bytes(2, order))
            return number

    def _change_with_setpoint(self, clear: int, set_: int, setpoint: int) -> int:
        """Bits of the command word and the whole set-point, its neighbour, in one commit: never one without the other."""
        order = self._word_order
        keep = (~clear & ~set_ & 0xFFFF).to_bytes(2, order) + bytes(2)
        return self.update(self._offset("command"), set_.to_bytes(2, order) + setpoint.to_bytes(2, order), keep)

    @property
    def aio(self) -> AsyncDrive[S]:
        """What of it waits, for asyncio: ``await drive.aio.wait_at_speed(10.0)``."""
        from dpmaster.drives.aio import AsyncDrive  # asyncio is loaded by who uses it

        return AsyncDrive(self)

    # -- Hooks of the master --------------------------------------------------------------------------------------------

    def _stop_word(self) -> None:
        """Before the master leaves Operate: "Clear alone is not stillness"."""
        self.stop()

    def _rest(self) -> None:
        """See the stop word answered."""
        number = self._pending
        if number is not None:
            self.wait_sent(number, REST)


class Terminals(MutableMapping[str, bool]):
    """Terminals by name, closed (True) or open: commands in the outputs of the drive; setting one commits it."""

    def __init__(self, drive: Drive[Any], word: str, flags: Mapping[str, int]) -> None:
        self._drive = drive
        self._word = word
        self._flags = flags

    def _flag(self, name: str) -> int:
        try:
            return self._flags[name]
        except KeyError:
            raise ConfigurationError(f"terminal {name!r}: there are {', '.join(self._flags)}") from None

    def __getitem__(self, name: str) -> bool:
        return bool(self._drive._output_word(self._word) & self._flag(name))

    def __setitem__(self, name: str, closed: bool) -> None:
        flag = self._flag(name)
        self._drive._change(self._word, clear=flag, set_=flag if closed else 0)

    def __delitem__(self, name: str) -> None:
        raise ConfigurationError(f"terminal {name!r} cannot be removed; set it to False to open it")

    def __iter__(self) -> Iterator[str]:
        return iter(self._flags)

    def __len__(self) -> int:
        return len(self._flags)
