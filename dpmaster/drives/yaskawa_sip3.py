# SPDX-License-Identifier: MIT
"""A Yaskawa V1000 or A1000 with the SI-P3 option card, driven in plain Python, in all its thirteen configurations.

What it shares with every drive is in `Drive`. The conventional configurations and the PPOs say the same with other words:
`_Conventional` and `_PPO` know them, and `profiles.yaskawa_1000` their tables.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

from dpmaster import _arguments
from dpmaster.diagnosis import DiagnosisTables
from dpmaster.drives.channel import ParameterChannel, PKWChannel
from dpmaster.drives.drive import Drive, ParameterInfo, Terminals, flags_and_values
from dpmaster.errors import CommissioningError, ConfigurationError, DPError, ParameterAccessError
from dpmaster.profiles import pkw, ppo
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.ppo import StatusWord
from dpmaster.profiles.yaskawa import HIGHEST_FREQUENCY, Configuration, FrequencyUnit, Function, get_word
from dpmaster.profiles.yaskawa_1000 import Command, Parameter, Status
from dpmaster.station import Frame

if TYPE_CHECKING:
    from dpmaster.drives.aio import AsyncYaskawaSIP3

log = logging.getLogger(__name__)

_FACTS = ("b1-01", "b1-02", "E1-04", "E2-04", "H5-12", "o1-03")
_SCALING = {name.casefold() for name in (*_FACTS, "A1-03")}  # A1-03 initialises all of them
_ENTER = {profile.parameter_name(pnu, 0) for pnu in (profile.PNU_ENTER_RAM, profile.PNU_ENTER_ROM, profile.PNU_STORE)} | {
    profile.YASKAWA_1000.register_name(register) for register in (profile.ENTER_RAM, profile.ENTER_ROM)}
_RUNS_ON: Mapping[str, tuple[int, str]] = MappingProxyType({
    "F6-01": (3, "alarm only: it runs on when the bus is lost; 0, 1 or 2 stop it"),
    "F6-31": (1, "in Clear it holds its last command; 0 stops it")})
"""Settings with which Clear or a loss do not bring the drive to rest."""
_ANSWERED = 1.0  # s


@dataclass(frozen=True)
class SIP3Status:
    """What the drive says of itself. A value is None where the configuration has no word for it, or its unit is not known yet.

    A PPO has no bit for running, zero speed and direction: there they are those of the main actual value HIW.
    """

    running: bool
    reverse: bool
    zero_speed: bool
    at_speed: bool
    ready: bool
    alarm: bool
    fault: bool
    remote: bool
    word: Status | StatusWord
    """The whole word: U1-12 (table 11), or ZSW."""
    frequency_reference: float | None = None
    """Hz."""
    output_frequency: float | None = None
    """Hz, without sign."""
    percent: float | None = None
    """Per cent of the highest frequency (HIW), without sign; PPO only."""
    current: float | None = None
    """A."""
    torque: float | None = None
    """Per cent."""
    monitors: Mapping[str, float] = field(default_factory=dict)
    """What else the configuration carries, by the drive's names ("U1-07"), in their units."""
    valid: bool = False
    """Whether the exchange is under way; after a loss the last values stay."""

    def __str__(self) -> str:
        more = "".join(f", {name}={value:g}" for name, value in self.monitors.items())
        return flags_and_values(self) + more


class Fault(NamedTuple):
    """An entry of the drive's fault history."""

    name: str
    """As the manual names it, or its number where that names none."""
    number: int
    seconds: int
    """Since the fault before it."""


class Bits(NamedTuple):
    """A change of the command word."""

    clear: int
    set: int


class _Conventional:
    """Tables 8 to 12: operation command and drive status, frequencies in the unit of o1-03."""

    def __init__(self, layout: Configuration) -> None:
        self.layout = layout
        self.words = layout.outputs

    def run(self, reverse: bool, facts: Mapping[str, float]) -> Bits:
        if reverse and facts.get("H5-12"):  # bit 0 is RUN, bit 1 the direction
            return Bits(Command.RUN | Command.BASEBLOCK, Command.RUN)
        return Bits(Command.RUN | Command.BASEBLOCK, Command.REVERSE if reverse else Command.FORWARD)

    stop = Bits(Command.RUN, 0)
    baseblock = (Bits(Command.BASEBLOCK, 0), Bits(Command.RUN, Command.BASEBLOCK))
    reset = (Bits(Command.RUN | Command.FAULT_RESET, 0), Bits(Command.RUN, Command.FAULT_RESET))

    def setpoint(self, count: int, reverse: bool) -> int:
        return count

    def count(self, word: int) -> int:
        return word

    def unit(self, facts: Mapping[str, float]) -> FrequencyUnit:
        return profile.frequency_unit(int(facts["o1-03"]), facts["E1-04"], int(facts["E2-04"]))

    def status(self, frame: Frame, drive: YaskawaSIP3) -> SIP3Status:
        words = {name: get_word(frame.octets, offset) for name, offset in self.layout.inputs.items()}
        word = Status(words["status"])
        # Basic data and Extended Data 2: with V/f control the speed's word is the output frequency (notes 3 and 1).
        output = words.get("output_frequency", words["motor_speed"])
        monitors: dict[str, float] = {name: word for name, word in words.items() if name in ("pulse_count", "analog_input")}
        torque = ppo.signed(words["torque_reference"]) * profile.TORQUE_UNIT if "torque_reference" in words else None
        return SIP3Status(
            running=Status.RUNNING in word, reverse=Status.REVERSE in word, zero_speed=Status.ZERO_SPEED in word,
            at_speed=Status.SPEED_AGREE in word, ready=Status.READY in word, alarm=Status.ALARM in word,
            fault=Status.FAULT in word, remote=Status.NET_CONTROL in word, word=word,
            frequency_reference=drive._hertz(words.get("frequency_reference")), output_frequency=drive._hertz(output),
            current=drive._amperes(words["output_current"]) if "output_current" in words else None,
            torque=None if torque is None else round(torque, 6), monitors=monitors, valid=frame.valid)


class _PPO:
    """Chapter 8: STW and ZSW, HSW and HIW with +-10000 for +-100 % of E1-04, and words that PNU 915 and 916 assign."""

    def __init__(self, layout: profile.PPOModule) -> None:
        self.layout = layout.ppo
        names = ["command", "frequency_reference", *(f"pzd{n}" for n in range(3, self.layout.words + 1))]
        self.words = {name: self.layout.offset(n) for n, name in enumerate(names, 1)}
        self.forget()

    def forget(self) -> None:
        """What the drive's PNU 916 says is not known: nothing, or without a channel to read it, what it says by default."""
        self.assigned: tuple[int, ...] = () if self.layout.pkw else profile.ASSIGNED_READ

    _MOVE = profile.RUN | profile.JOG_FORWARD | profile.JOG_REVERSE

    def run(self, reverse: bool, facts: Mapping[str, float]) -> Bits:
        return Bits(self._MOVE, profile.RUN_STOPPED | profile.RUN)

    def jog(self, reverse: bool) -> Bits:
        return Bits(self._MOVE, profile.RUN_STOPPED | (profile.JOG_REVERSE if reverse else profile.JOG_FORWARD))

    stop = Bits(_MOVE, profile.RUN_STOPPED)
    baseblock = (stop, Bits(_MOVE | ppo.ControlWord.ENABLE_OPERATION, ppo.ControlWord.CONTROL))
    reset = (Bits(_MOVE | ppo.ControlWord.FAULT_RESET, profile.RUN_STOPPED),
             Bits(_MOVE, profile.RUN_STOPPED | ppo.ControlWord.FAULT_RESET))

    def setpoint(self, count: int, reverse: bool) -> int:
        return (-count if reverse else count) & 0xFFFF

    def count(self, word: int) -> int:
        return abs(ppo.signed(word))

    def unit(self, facts: Mapping[str, float]) -> FrequencyUnit:
        return FrequencyUnit("100 % / 10000", facts["E1-04"] / profile.FULL_SCALE)

    def status(self, frame: Frame, drive: YaskawaSIP3) -> SIP3Status:
        layout = self.layout
        words = [get_word(frame.octets, layout.offset(n)) for n in range(1, layout.words + 1)]
        word, actual = StatusWord(words[0]), ppo.signed(words[1])
        found = {register: value for register, value in zip(self.assigned[2:], words[2:], strict=False) if register}
        monitors: dict[str, float] = {}
        for register, value in found.items():
            parameter = drive.table.at(profile.MONITOR_COPIES.get(register, register))
            if parameter and (amount := drive._amount(parameter, value)) is not None:
                monitors[parameter.name] = amount
        return SIP3Status(
            running=actual != 0, reverse=actual < 0, zero_speed=actual == 0, at_speed=StatusWord.SPEED_AGREE in word,
            ready=StatusWord.OPERATION_ENABLED in word, alarm=StatusWord.ALARM in word, fault=StatusWord.FAULT in word,
            remote=StatusWord.CONTROL in word, word=word, frequency_reference=monitors.pop("U1-01", None),
            output_frequency=drive._hertz(abs(actual)), percent=abs(actual) * 100 / profile.FULL_SCALE,
            current=monitors.pop("U1-03", None), torque=monitors.pop("U1-09", None), monitors=monitors, valid=frame.valid)


class YaskawaSIP3(Drive[SIP3Status]):
    """A V1000 or A1000 drive with its PROFIBUS option card SI-P3.

    `configuration` is the manual's name, in any case: "Basic data", "Extended Data 1", "Extended Data 2", "PPO Type 1" to
    "PPO Type 5", and these with " (No Cons.)". The drive's F6-32 must agree with it (0: PPO, 1: the others). Extended Data 1
    and 2 and PPO 1, 2 and 5 carry a parameter channel.

    Frequencies are Hz, 100 % is E1-04. Units are read from the drive (E1-04, o1-03, ...). Where there is no channel, Basic
    data takes `frequency_unit`, by default the "0.01 Hz" of o1-03 = 0, and H5-12 = 0 for granted (with 1 it cannot reverse);
    PPO 3 and 4, whose words are shares of E1-04, take per cent, and Hz once `maximum_frequency` tells E1-04 (Hz).

    `index` is the size of IND, "word" or "byte" (F6-33). `size` is the drive's in kW: from 11 kW on a count of current is 0.1
    A, by default 0.01 A. `table` has the drive's parameters, ``YASKAWA_1000.extended([...])`` has more. `address` is 1 to 125.
    What is left of the arguments goes to `Station`. The figures of YASK0ACF.GSD are set: four user parameters, Fail_Safe,
    Min_Slave_Interval 0.5 ms.
    """

    IDENT_NUMBER = profile.IDENT_NUMBER
    diagnosis_texts = DiagnosisTables(bits={
        24: "undervoltage", 25: "inverter communication error", 26: "illegal register assigned by PNU 915",
        27: "illegal register assigned by PNU 916"})

    def __init__(self, address: int, configuration: str = "PPO Type 2", *, index: pkw.IndexSize = "word",
                 size: float | None = None, frequency_unit: str | FrequencyUnit | None = None,
                 maximum_frequency: float | None = None, table: profile.Table = profile.YASKAWA_1000, name: str | None = None,
                 watchdog: float | Literal["default"] | None = "default", group: int = 0, sync: bool = False,
                 freeze: bool = False, active: bool = True) -> None:
        self._address_warning = profile.check_address(address)
        layout = profile.configuration(configuration)
        self._format = _Conventional(layout) if isinstance(layout, Configuration) else _PPO(layout)
        if index not in ("word", "byte"):
            raise ConfigurationError(f"index {index!r}: 'word' or 'byte', as F6-33 says")
        self._index_size: pkw.IndexSize = index
        if size is not None and (not _arguments.number(size) or not 0 < size <= 1000):
            raise ConfigurationError(f"size {size!r} kW: above 0 and up to 1000")
        self._current_unit = profile.current_unit(size or 0.0)
        self.table = table
        super().__init__(address, self.IDENT_NUMBER, layout.identifier, self._format.words, layout=layout.name, name=name,
                         user_parameters=profile.USER_PARAMETERS, watchdog=watchdog, max_tsdr=profile.MAX_TSDR, group=group,
                         sync=sync, freeze=freeze, fail_safe=True, min_slave_interval=profile.MIN_SLAVE_INTERVAL, active=active)
        self._channel = self._make_channel()
        self._facts: dict[str, float] | None = None
        self._rescaled = False  # what units depend on was written, and no Enter command has put it into force yet
        self._fixed_unit = self._check_unit(frequency_unit)
        self._fixed_maximum = self._check_maximum(maximum_frequency)
        self._heard = False

    def _make_channel(self) -> ParameterChannel | PKWChannel | None:
        if isinstance(self._format, _PPO):
            if not self._format.layout.pkw:
                return None
            return PKWChannel(self, 0, pkw.Requester(self._index_size), profile.PKW_ERRORS)
        where = self._format.layout.channel
        return ParameterChannel(self, where, self.table.register_name, done=0, init=profile.INIT) if where else None

    def _check_unit(self, unit: str | FrequencyUnit | None) -> FrequencyUnit | None:
        if self._channel is None and isinstance(self._format, _Conventional):
            return unit if isinstance(unit, FrequencyUnit) else FrequencyUnit.named(unit or "0.01 Hz")
        if unit is not None:
            raise ConfigurationError(f"frequency_unit {unit!r}: only Basic data takes it; {self.layout} " + (
                "reads the unit from the drive" if self._channel else "has shares of E1-04: give maximum_frequency"))
        return None

    def _check_maximum(self, maximum: float | None) -> float | None:
        if maximum is None:
            return None
        if self._channel:
            raise ConfigurationError(f"maximum_frequency {maximum!r}: {self.layout} reads E1-04 from the drive")
        if not _arguments.number(maximum) or not 0 < maximum <= HIGHEST_FREQUENCY:
            raise ConfigurationError(f"maximum_frequency {maximum!r} Hz: E1-04, above 0 and up to {HIGHEST_FREQUENCY:g}")
        return float(maximum)

    # -- Moving ---------------------------------------------------------------------------------------------------------

    def run(self, hz: float | None = None, *, percent: float | None = None, reverse: bool = False) -> None:
        """Run at `hz`, or at `percent` of E1-04. CommissioningError when b1-01 or b1-02 keep the card from moving the drive.

        Those, and what units depend on, are read before the first run command and again after every `operate()`. Where there
        is no channel to read them, the first run command waits up to 0.5 s for the drive to show that it listens, and is
        taken back if it does not.
        """
        super().run(hz, percent=percent, reverse=reverse)
        if self._channel is None and not self._heard and self._reference():
            self._see_running(profile.CONTROL, lambda status: status.running or (status.remote and not status.fault))
            self._heard = True

    def jog(self, *, reverse: bool = False) -> None:
        """Turn at a tenth of E1-04 until `stop` or `run` (PPO only)."""
        if not isinstance(self._format, _PPO):
            raise ConfigurationError(f"jog: {self.layout} has no bit for it; the PPOs have")
        self._need_control()
        self._command(self._format.jog(reverse))

    def baseblock(self, on: bool = True) -> None:
        """Switch the output off: the motor coasts, and the run command is taken away. Off again, or by `run`, it is ready."""
        self._command(self._format.baseblock[bool(on)])

    def _command(self, bits: Bits) -> int:
        return self._change("command", clear=bits.clear, set_=bits.set)

    def _commit_run(self, count: int) -> int:
        bits = self._format.run(self._reverse, self._facts or {})
        return self._change_with_setpoint(bits.clear, bits.set, self._format.setpoint(count, self._reverse))

    def _commit_stop(self) -> int:
        return self._command(self._format.stop)

    def _commit_setpoint(self, count: int) -> int:
        return self._change("frequency_reference", clear=0xFFFF, set_=self._format.setpoint(count, self._reverse))

    def _commit_reset(self, on: bool) -> int:
        return self._command(self._format.reset[on])

    def _reference(self) -> int:
        return self._format.count(self._output_word("frequency_reference"))

    def _from_hz(self, hz: float) -> int:
        unit, maximum = self._unit(), self._maximum()
        if not hz <= (maximum or HIGHEST_FREQUENCY):
            limit = "E1-04, the drive's maximum frequency" if maximum else "the highest E1-04"
            raise ConfigurationError(f"frequency {hz} Hz: the limit is {maximum or HIGHEST_FREQUENCY} Hz ({limit})")
        return unit.to_bus(hz)

    def _to_hz(self, count: int) -> float:
        return self._unit().to_hz(count)

    def _from_percent(self, percent: float) -> int:
        if isinstance(self._format, _PPO):
            return round(percent * profile.FULL_SCALE / 100)
        return super()._from_percent(percent)

    def _to_percent(self, count: int) -> float:
        return count * 100 / profile.FULL_SCALE if isinstance(self._format, _PPO) else super()._to_percent(count)

    @property
    def highest_frequency(self) -> float:
        maximum = self._know()["E1-04"] if self._channel else self._fixed_maximum
        if maximum is None:
            raise ConfigurationError(f"per cent and Hz: {self.layout} has no parameter channel to read E1-04, which is 100 %; "
                                     "tell it by maximum_frequency")
        return maximum

    # -- What the drive's parameters say of control and units -------------------------------------------------------------

    def _know(self) -> dict[str, float]:
        """What control and units depend on, read once."""
        facts = self._facts
        if facts is None:
            facts = {name: self.read(name) for name in _FACTS}
            if isinstance(self._format, _PPO) and self._format.layout.words > 2:
                self._format.assigned = self._assignment(profile.PNU_ASSIGN_READ)
            self._facts = facts
        return facts

    def _need_control(self) -> None:
        if self._channel is None:
            return
        facts = self._know()
        wrong = {name: needed for name, needed in profile.CONTROL.items() if facts[name] != needed}
        if wrong:
            self._facts = None  # somebody will change them: look again next time
            text = ", ".join(f"{name} is {facts[name]:g} and must be {needed}" for name, needed in wrong.items())
            raise CommissioningError(f"{self.name}: the option card does not control the drive: {text} "
                                     '(drive["b1-01"] = 3 sets it while the drive stands)', parameters=tuple(wrong))

    def _maximum(self) -> float | None:
        return self._facts["E1-04"] if self._facts else self._fixed_maximum

    def _unit(self) -> FrequencyUnit:
        if self._fixed_unit:
            return self._fixed_unit
        return self._format.unit(self._know() if self._channel else {"E1-04": self.highest_frequency})

    def _known_unit(self) -> FrequencyUnit | None:
        """The unit without asking the drive."""
        try:
            return self._unit() if self._facts or self._fixed_unit or self._fixed_maximum else None
        except ConfigurationError:
            return None

    def _hertz(self, word: int | None) -> float | None:
        unit = self._known_unit()
        return 0.0 if word == 0 else unit.to_hz(word) if unit and word is not None else None

    def _amperes(self, word: int) -> float:
        return round(word * self._current_unit, 6)

    def _amount(self, parameter: Parameter, word: int) -> float | None:
        """A word in the parameter's unit; None where that hangs on parameters which are not known."""
        if parameter.scale:
            return parameter.to_value(word)
        if parameter.unit == "A":
            return self._amperes(word)
        facts = self._facts or ({"o1-03": 0, "E1-04": 0, "E2-04": 0} if self._channel is None else None)
        if facts is None:
            return None
        try:
            return profile.frequency_unit(int(facts["o1-03"]), facts["E1-04"], int(facts["E2-04"])).to_hz(word)
        except ConfigurationError:
            return None

    # -- Status and terminals -----------------------------------------------------------------------------------------------

    def _decode(self, frame: Frame) -> SIP3Status:
        return self._format.status(frame, self)

    def faults(self) -> tuple[str, ...]:
        if not self.status.fault:
            return ()
        if isinstance(self._channel, PKWChannel):
            return (self._fault_name(self.read_pnu(profile.PNU_FAULTS, 1)),)
        return ("fault",)

    def fault_history(self) -> tuple[Fault, ...]:
        """The drive's last faults, the newest first, up to ten: PNU 947 and 948. Only PPO 1, 2 and 5 carry them."""
        found = []
        for index in range(1, self.elements(profile.PNU_FAULTS) + 1):
            number = self.read_pnu(profile.PNU_FAULTS, index)
            if not number:
                break
            found.append(Fault(self._fault_name(number), number, self.read_pnu(profile.PNU_FAULT_TIMES, index)))
        return tuple(found)

    @staticmethod
    def _fault_name(number: int) -> str:
        return next((name for name, (known, _) in profile.FAULTS.items() if known == number), f"{number:04X}h")

    def external_fault(self, on: bool = True) -> None:
        """Raise (or take away) an external fault, EF0; conventional configurations only. It stays until `fault_reset`."""
        self._conventional("external_fault")
        self._change("command", clear=Command.EXTERNAL_FAULT, set_=Command.EXTERNAL_FAULT if on else 0)

    def clear_fault_history(self) -> None:
        """Reset fault trace and fault history by the rising edge of bit E (table 10); conventional configurations only."""
        self._conventional("clear_fault_history")
        for bit in (Command.HISTORY_RESET, 0):
            self.wait_sent(self._change("command", clear=Command.HISTORY_RESET, set_=bit), 1.0)

    @property
    def digital_inputs(self) -> Terminals:
        """Input terminals S3 to S8 closed over the bus (conventional configurations). H1-03 to H1-08 say what they are for."""
        self._conventional("digital_inputs")
        return Terminals(self, "command", profile.INPUT_TERMINALS)

    @property
    def digital_outputs(self) -> Terminals:
        """Output terminals M1-M2, P1 and P2 as commanded (Extended Data 1); H2-01 to H2-03 must be F, through mode."""
        self._offset("digital_output")
        return Terminals(self, "digital_output", profile.OUTPUT_TERMINALS)

    def _conventional(self, what: str) -> None:
        if not isinstance(self._format, _Conventional):
            raise ConfigurationError(f"{what}: {self.layout} has no bit for it; the conventional configurations have")

    @property
    def process_words(self) -> ProcessWords:
        """The other output words as counts, by name: "torque_reference" (0.1 %), "analog_output_1", ...; of a PPO "pzd3" to
        "pzd10", whose meaning `assign_outputs` gives them."""
        return ProcessWords(self)

    # -- Parameters ---------------------------------------------------------------------------------------------------------

    def __getitem__(self, name: str) -> float:
        """A parameter by the drive's name ("C1-01"), in the unit of its table; a name without one as a count."""
        return self.read(name)

    def __setitem__(self, name: str, value: float) -> None:
        """Write a parameter in its unit and enter it: it is in force, and gone with the power. See `write`."""
        self.write({name: value})

    def parameter(self, name: str) -> ParameterInfo:
        known = self.table.get(name)
        if known is None:
            pnu, index = profile.parse_name(name)
            return ParameterInfo(profile.parameter_name(pnu, index))
        scale = known.scale or 1.0
        decimals = {1.0: 0, 0.1: 1, 0.01: 2}.get(scale, 3) if known.scale else 2
        unit = "Hz" if known.unit == "o1-03" else known.unit
        if known.access == "r":
            return ParameterInfo(known.name, known.text, unit, decimals=decimals)
        return ParameterInfo(known.name, known.text, unit, known.minimum * scale, known.maximum * scale, decimals)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(self.table)

    def read(self, name: str, *, timeout: float = _ANSWERED) -> float:
        """Read a parameter, in the unit of its table. `timeout` is s from its turn in the channel, beside eight fixed
        cycle times.

        ParameterAccessError carries the drive's code and its meaning; DPTimeout leaves the channel usable.
        """
        parameter = self.table.get(name)
        if isinstance(self._need_channel("read"), PKWChannel):
            word = self._task(pkw.Task.REQUEST_ELEMENT, *profile.parse_name(name), timeout=timeout)
        else:
            words = self.read_registers(name, len(parameter.registers) if parameter else 1, timeout=timeout)
            word = int.from_bytes(b"".join(each.to_bytes(2, "big") for each in words))
        amount = self._amount(parameter, word) if parameter else word
        return word if amount is None else amount

    def write(self, values: Mapping[str, float], *, store: bool = False, timeout: float = _ANSWERED) -> None:
        """Write parameters in their units, then one Enter command: in force from then on; with `store` in the drive's EEPROM,
        which takes a limited number of writes, else until the power goes. Values out of range are refused before anything
        is written. Most parameters, and storing, are refused while the drive runs."""
        self._need_channel("write")
        words = {name: self._word_of(name, value) for name, value in values.items()}
        for name, word in words.items():
            self._write_word(name, word, timeout)
        self._enter(store, timeout)

    def enter(self, *, store: bool = False, timeout: float = _ANSWERED) -> None:
        """The Enter command: what was written comes into force; with `store` it is kept in the EEPROM."""
        self._rescaled = True  # nobody knows what had been written
        self._enter(store, timeout)

    def _enter(self, store: bool, timeout: float) -> None:
        if isinstance(self._need_channel("enter"), PKWChannel):
            self.write_pnu(profile.PNU_ENTER_ROM if store else profile.PNU_ENTER_RAM, 0, timeout=timeout)
        else:
            self.write_register(profile.ENTER_ROM if store else profile.ENTER_RAM, 0, timeout=timeout)

    @contextmanager
    def _writing(self, names: Iterable[str]) -> Iterator[None]:
        """Write these. What units depend on is forgotten with the Enter command that puts something else into force, whoever
        gives it in whatever form."""
        written = set(names)
        self._rescaled = self._rescaled or not _SCALING.isdisjoint(name.casefold() for name in written)
        entered = not _ENTER.isdisjoint(written)
        rescaled = self._rescaled and entered
        try:
            yield
            self._rescaled = self._rescaled and not entered
        except ParameterAccessError:
            rescaled = False  # refused: what was written waits for the next one
            raise
        finally:
            if rescaled:
                self._facts = None

    def _word_of(self, name: str, value: float) -> int:
        parameter = self.table.get(name)
        if parameter is None:
            return _arguments.whole(f"{profile.parameter_name(*profile.parse_name(name))}, which has no table, =", value,
                                    -0x8000, 0xFFFF) & 0xFFFF
        return parameter.to_word(value)

    def _write_word(self, name: str, word: int, timeout: float) -> None:
        parameter = self.table.get(name)
        if isinstance(self._channel, PKWChannel):
            task = pkw.Task.CHANGE_ELEMENT_DOUBLE if parameter and parameter.double else pkw.Task.CHANGE_ELEMENT
            self._task(task, *profile.parse_name(name), word, timeout)
        else:  # a double word in one message where the channel has room: half of one may be out of range
            double = parameter is not None and parameter.double
            self.write_register(name, [word >> 16, word & 0xFFFF] if double else word, timeout=timeout)

    # Parameter numbers

    def read_pnu(self, pnu: int, index: int | None = None, *, timeout: float = _ANSWERED) -> int:
        """The value of a parameter number (0 to 2047), or of the element `index` of an array. PPO 1, 2 and 5 only."""
        if index is None:
            return self._task(pkw.Task.REQUEST, pnu, 0, timeout=timeout)
        return self._task(pkw.Task.REQUEST_ELEMENT, pnu, index, timeout=timeout)

    def write_pnu(self, pnu: int, value: int, index: int | None = None, *, double: bool = False,
                  timeout: float = _ANSWERED) -> None:
        """Change a parameter number, or an element of an array: a word, or with `double` a double word. A drive parameter's
        comes into force with `enter`."""
        tasks = (pkw.Task.CHANGE, pkw.Task.CHANGE_DOUBLE) if index is None else (
            pkw.Task.CHANGE_ELEMENT, pkw.Task.CHANGE_ELEMENT_DOUBLE)
        self._task(tasks[double], pnu, index or 0, value, timeout)

    def elements(self, pnu: int, *, timeout: float = _ANSWERED) -> int:
        """How many elements an array has."""
        return self._task(pkw.Task.REQUEST_ELEMENTS, pnu, 0, timeout=timeout)

    def read_array(self, pnu: int, *, timeout: float = _ANSWERED) -> tuple[int, ...]:
        """All elements of one of the profile's arrays, which begin with 1 (900 to 964)."""
        elements = self.elements(pnu, timeout=timeout)
        return tuple(self.read_pnu(pnu, index, timeout=timeout) for index in range(1, elements + 1))

    def _task(self, task: pkw.Task, pnu: int, index: int, value: int = 0, timeout: float = _ANSWERED) -> int:
        channel = self._need_channel("parameter numbers")
        if not isinstance(channel, PKWChannel):
            raise ConfigurationError(f"parameter numbers: {self.layout} has MEMOBUS registers in their place; PPO 1, 2 and 5 "
                                     "have them")
        name = profile.parameter_name(pnu, index) if pnu else self.table.register_name(index)
        with self._writing([name] if task in pkw.CHANGES else ()):
            return channel.ask(pkw.Message(task, pnu, index, value), name, timeout).value

    # Registers

    def read_register(self, register: int | str, *, timeout: float = _ANSWERED) -> int:
        """A MEMOBUS register by number, "0200h" or the name of its parameter, as the word it is."""
        return self.read_registers(register, 1, timeout=timeout)[0]

    def read_registers(self, register: int | str, count: int, *, timeout: float = _ANSWERED) -> tuple[int, ...]:
        """`count` registers from `register` on, with as few requests as the configuration allows (4, 1 or 1 at a time)."""
        first = self.table.register(register)
        _arguments.whole("count", count, 1, 0xFFFF, " registers")
        channel = self._need_channel("registers")
        if isinstance(channel, PKWChannel):
            return tuple(self.read_pnu(profile.PNU_REGISTERS, first + n, timeout=timeout) for n in range(count))
        found: tuple[int, ...] = ()
        while len(found) < count:
            words = min(channel.words, count - len(found))
            found += channel.access(Function.READ, first + len(found), 2 * words, (), timeout)
        return found

    def write_register(self, register: int | str, value: int | Sequence[int], *, timeout: float = _ANSWERED) -> None:
        """Write a register, or several from there on; a parameter's comes into force with `enter`."""
        first = self.table.register(register)
        values = list(value) if isinstance(value, Iterable) else [value]
        words = [_arguments.whole(f"register {register!r}", word, 0, 0xFFFF) for word in values]
        channel = self._need_channel("registers")
        while words:
            if isinstance(channel, PKWChannel):
                self.write_pnu(profile.PNU_REGISTERS, words[0], first, timeout=timeout)
                part = 1
            else:
                part = min(channel.words, len(words))
                with self._writing(self.table.register_name(first + n) for n in range(part)):
                    channel.access(Function.WRITE, first, 2 * part, words[:part], timeout)
            words, first = words[part:], first + part

    def loop_back(self, words: Sequence[int], *, timeout: float = _ANSWERED) -> tuple[int, ...]:
        """MEMOBUS 08h: the drive sends the words back (Extended Data 1: up to 4, Extended Data 2: 1)."""
        channel = self._need_channel("loop_back")
        if isinstance(channel, PKWChannel):
            raise ConfigurationError(f"loop_back: {self.layout} has no MEMOBUS messages; Extended Data 1 and 2 have")
        return channel.access(Function.LOOP_BACK, 0, 2 * len(words), words, timeout)

    def _need_channel(self, what: str) -> ParameterChannel | PKWChannel:
        if self._channel is None:
            raise ConfigurationError(f"{what}: {self.layout} has no parameter channel; Extended Data 1 and 2 and PPO 1, 2 and "
                                     "5 have one")
        return self._channel

    # Assigning the process words

    def assign_outputs(self, *registers: int | str, timeout: float = _ANSWERED) -> None:
        """What PZD3 and those after it of PPO-Write are for: MEMOBUS command registers, 0 for nothing (PNU 915).

        In force at once; `enter(store=True)` keeps it. PZD1 and PZD2 are always STW and HSW.
        """
        self._assign(profile.PNU_ASSIGN_WRITE, registers, profile.ASSIGNABLE_WRITE, timeout)

    def assign_inputs(self, *registers: int | str, timeout: float = _ANSWERED) -> None:
        """What PZD3 and those after it of PPO-Read show: command and monitor registers, or monitors by name (PNU 916)."""
        self._assign(profile.PNU_ASSIGN_READ, registers, profile.ASSIGNABLE_READ, timeout)
        assert isinstance(self._format, _PPO)
        self._format.assigned = self._assignment(profile.PNU_ASSIGN_READ, timeout)

    def _assign(self, pnu: int, registers: Sequence[int | str], legal: frozenset[int], timeout: float) -> None:
        most = self._format.layout.words - 2 if isinstance(self._format, _PPO) else 0
        if len(registers) > most:
            raise ConfigurationError(f"{len(registers)} process words: {self.layout} has {most} that can be assigned")
        numbers = [self.table.register(register) for register in registers]
        for number in numbers:
            if number and number not in legal:
                raise ConfigurationError(f"register {number} cannot be assigned by PNU {pnu}: "
                                         f"{', '.join(map(str, sorted(legal)[:17]))} can, or 0 for none"
                                         + ("; and the monitors 32 to 255" if pnu == profile.PNU_ASSIGN_READ else ""))
        for index, number in enumerate(numbers, 3):
            self.write_pnu(pnu, number, index, timeout=timeout)

    def _assignment(self, pnu: int, timeout: float = _ANSWERED) -> tuple[int, ...]:
        """What an assignment says, as far as the configuration's process words go; PZD1 and PZD2 as they always are."""
        assert isinstance(self._format, _PPO)
        read = (self.read_pnu(pnu, index, timeout=timeout) for index in range(3, self._format.layout.words + 1))
        return (0, 0, *read)

    @property
    def aio(self) -> AsyncYaskawaSIP3:
        from dpmaster.drives.aio import AsyncYaskawaSIP3  # asyncio is loaded by who uses it

        return AsyncYaskawaSIP3(self)

    # -- Hooks of the master --------------------------------------------------------------------------------------------

    def _before_operate(self) -> list[str]:
        self._facts = None  # the drive may have been another one, or set otherwise
        if isinstance(self._format, _PPO):
            self._format.forget()
        self._heard = False
        return [self._address_warning] if self._address_warning else []

    def _operating(self) -> None:
        """A drive that holds its command, or ignores a loss, is named before anything turns."""
        if self._channel is None:
            return
        try:
            for name, (value, text) in _RUNS_ON.items():
                if self.read(name) == value:
                    log.warning("%s: %s is %d, %s", self.name, name, value, text)
        except DPError as error:
            log.info("%s: whether it stops after a loss could not be read: %s", self.name, error)


class ProcessWords(MutableMapping[str, int]):
    """Output words of a drive as counts, by name; setting one commits it. Command and set-point are not among them."""

    def __init__(self, drive: YaskawaSIP3) -> None:
        self._drive = drive
        self._names = tuple(drive._words)[2:]

    def _check(self, name: str) -> str:
        if name not in self._names:
            raise ConfigurationError(f"process word {name!r}: {self._drive.layout} has {', '.join(self._names) or 'none'}")
        return name

    def __getitem__(self, name: str) -> int:
        return self._drive._output_word(self._check(name))

    def __setitem__(self, name: str, count: int) -> None:
        word = _arguments.whole(f"process word {self._check(name)}", count, -0x8000, 0xFFFF) & 0xFFFF
        self._drive._change(name, clear=0xFFFF, set_=word)

    def __delitem__(self, name: str) -> None:
        raise ConfigurationError(f"process word {name!r} cannot be removed; set it to 0")

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)
