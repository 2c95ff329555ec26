# SPDX-License-Identifier: MIT
"""A Yaskawa V7 with the SI-P1 option card, driven in plain Python.

What it shares with every drive is in `Drive`; here are its words, bits, units and parameters, from `profiles.yaskawa_v7`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, overload

from dpmaster._arguments import number
from dpmaster.drives.channel import ParameterChannel
from dpmaster.drives.drive import Drive, ParameterInfo, Terminals, flags_and_values
from dpmaster.errors import CommissioningError, ConfigurationError, DPTimeout, ParameterAccessError
from dpmaster.profiles.yaskawa import (
    HIGHEST_FREQUENCY,
    WD_MODULUS,
    WD_PERIOD,
    WD_SHIFT,
    FrequencyUnit,
    Function,
    WordOrder,
    get_word,
)
from dpmaster.profiles.yaskawa_v7 import (
    CONTROL,
    CURRENT_UNIT,
    ENTER,
    IDENT_NUMBER,
    INPUT_TERMINALS,
    MAX_TSDR,
    MIN_SLAVE_INTERVAL,
    OUTPUT_TERMINALS,
    PARAMETERS,
    TORQUE_UNIT,
    Command,
    Status,
    check_address,
    frequency_unit,
    register,
    register_name,
)
from dpmaster.profiles.yaskawa_v7 import configuration as find_configuration
from dpmaster.station import Frame

if TYPE_CHECKING:
    from dpmaster.drives.aio import AsyncYaskawaV7

_FACTS = ("n003", "n004", "n011", "n035", "n152")
_SCALING = {register(name) for name in (*_FACTS, "n001")}  # n001 can initialise all of them


@dataclass(frozen=True)
class V7Status:
    """What the drive says of itself: the flags of the drive status word, then the values that the configuration carries.

    A value is None where the configuration has no word for it. Frequencies (Hz, without sign) are None also as long as
    the drive's unit is unknown, that is before the first run command, unless the word is 0.
    """

    running: bool
    zero_speed: bool
    reverse: bool
    reset: bool
    frequency_agree: bool
    ready: bool
    minor_fault: bool
    major_fault: bool
    ope_error: bool
    fault_restart: bool
    local_remote: bool
    output1: bool
    output2: bool
    output3: bool
    frequency_reference: float | None = None
    output_frequency: float | None = None
    current: float | None = None
    """A."""
    torque: float | None = None
    """Per cent."""
    pulse_train: int | None = None
    """Main speed pulse train command, as it is on the bus."""
    valid: bool = False
    """Whether the exchange is under way; after a loss the last values stay."""

    @property
    def at_speed(self) -> bool:
        """`frequency_agree`, as every drive calls it."""
        return self.frequency_agree

    @property
    def alarm(self) -> bool:
        """`minor_fault`."""
        return self.minor_fault

    @property
    def fault(self) -> bool:
        """`major_fault`."""
        return self.major_fault

    @property
    def remote(self) -> bool:
        """`local_remote`."""
        return self.local_remote

    def __str__(self) -> str:
        return flags_and_values(self)


class YaskawaV7(Drive[V7Status]):
    """A V7 drive with its PROFIBUS option card SI-P1.

    `configuration` is the manual's name: "Basic data", "Extended Data 1" or "Extended Data 2", in any case.
    `word_order` ("big", "little") turns all words of the fast area, never the parameter area.

    Frequencies are Hz, 100 % is n011. The unit on the bus is read from the drive (n035, n152, n011) before the first run
    command. Basic data has no parameter channel: there the unit is `frequency_unit`, by default the "0.01 Hz" of a drive
    commissioned with n152 = 1; if n035 or n152 say otherwise, the drive turns at another frequency than asked for.

    `address` is 1 to 99, what the card's switches can set; 1 and 2 are usually masters'. What is left of the arguments
    goes to `Station` (watchdog, group, name, ...). The figures of YASK00CA.GSD are set: no user parameters, no Fail_Safe,
    Min_Slave_Intervall 0.1 ms.
    """

    IDENT_NUMBER = IDENT_NUMBER

    def __init__(self, address: int, configuration: str = "Extended Data 1", *, word_order: WordOrder = "big",
                 frequency_unit: str | FrequencyUnit | None = None, name: str | None = None,
                 watchdog: float | Literal["default"] | None = "default", group: int = 0, sync: bool = False,
                 freeze: bool = False, active: bool = True) -> None:
        self._address_warning = check_address(address)
        self._layout = find_configuration(configuration)
        self._fixed_unit = self._check_unit(frequency_unit)
        self._facts: dict[str, int] | None = None
        super().__init__(address, self.IDENT_NUMBER, self._layout.identifier, self._layout.outputs,
                         layout=self._layout.name, word_order=word_order, name=name, watchdog=watchdog,
                         max_tsdr=MAX_TSDR, group=group, sync=sync, freeze=freeze, fail_safe=False,
                         min_slave_interval=MIN_SLAVE_INTERVAL, active=active)
        self._channel = ParameterChannel(self, self._layout.channel, register_name) if self._layout.channel else None

    def _check_unit(self, unit: str | FrequencyUnit | None) -> FrequencyUnit | None:
        if self._layout.channel:
            if unit is not None:
                raise ConfigurationError(f"frequency_unit {unit!r}: {self._layout.name} reads the unit from the drive; "
                                         "only Basic data takes it as an argument")
            return None
        return unit if isinstance(unit, FrequencyUnit) else FrequencyUnit.named(unit or "0.01 Hz")

    # -- Moving ----------------------------------------------------------------------------------------------------

    def run(self, hz: float | None = None, *, percent: float | None = None, reverse: bool = False) -> None:
        """Run at `hz`, or at `percent` of n011. CommissioningError when n003 or n004 keep the card from moving the drive.

        Those, and the frequency's unit, are read once before the first run command (about 0.1 s) and again after
        every `operate()`. With Basic data, which cannot read them, the first run command waits up to 0.5 s for the drive
        to show that it runs, and is taken back if it does not.
        """
        super().run(hz, percent=percent, reverse=reverse)
        if self._channel is None and self._facts is None and self._reference():
            self._see_running(CONTROL, lambda status: status.running)
            self._facts = {}

    def _commit_run(self, count: int) -> int:
        direction = Command.REVERSE if self._reverse else Command.FORWARD
        return self._change_with_setpoint(Command.RUN, direction, count)

    def _commit_stop(self) -> int:
        return self._change("command", clear=Command.RUN)

    def _commit_setpoint(self, count: int) -> int:
        return self._change("frequency_reference", clear=0xFFFF, set_=count)

    def _commit_reset(self, on: bool) -> int:
        return self._change("command", clear=Command.RUN | Command.FAULT_RESET, set_=Command.FAULT_RESET if on else 0)

    def _reference(self) -> int:
        return self._output_word("frequency_reference")

    def _from_hz(self, hz: float) -> int:
        unit = self._unit()
        maximum = self._maximum()
        if not hz <= maximum:
            limit = "n011, the drive's maximum frequency" if self._facts else "the highest n011"
            raise ConfigurationError(f"frequency {hz} Hz: the limit is {maximum} Hz ({limit})")
        return unit.to_bus(hz)

    def _to_hz(self, count: int) -> float:
        return self._unit().to_hz(count)

    @property
    def highest_frequency(self) -> float:
        if self._channel is None:
            raise ConfigurationError(f"per cent: {self._layout.name} has no parameter channel to read n011, which is 100 %; "
                                     "give Hz")
        return self._know()["n011"] / 10

    # -- What the drive's parameters say of control and units --------------------------------------------------------

    def _need_control(self) -> None:
        """Raise CommissioningError unless run command and reference are the option card's."""
        if self._channel is None:
            return
        facts = self._know()
        wrong = {name: needed for name, needed in CONTROL.items() if facts[name] != needed}
        if wrong:
            self._facts = None  # somebody will change them: look again next time
            text = ", ".join(f"{name} is {facts[name]} and must be {needed}" for name, needed in wrong.items())
            raise CommissioningError(f"{self.name}: the option card does not control the drive: {text} "
                                     "(write_parameter sets it while the drive stands)", parameters=tuple(wrong))

    def _know(self) -> dict[str, int]:
        """n003, n004, n011, n035 and n152, read once."""
        facts = self._facts
        if facts is None:
            facts = {name: self.read_parameter(name) for name in _FACTS}
            self._facts = facts
        return facts

    def _unit(self) -> FrequencyUnit:
        if self._fixed_unit:
            return self._fixed_unit
        facts = self._know()
        return frequency_unit(facts["n035"], facts["n152"], facts["n011"] / 10)

    def _maximum(self) -> float:
        return self._facts["n011"] / 10 if self._channel and self._facts else HIGHEST_FREQUENCY

    def _known_unit(self) -> FrequencyUnit | None:
        """The unit without asking the drive."""
        try:
            return self._unit() if self._fixed_unit or self._facts else None
        except ConfigurationError:
            return None

    # -- Status ----------------------------------------------------------------------------------------------------

    def _decode(self, frame: Frame) -> V7Status:
        words = {name: get_word(frame.octets, offset, self._word_order)
                 for name, offset in self._layout.inputs.items()}
        flags = {field: bool(words["status"] & flag) for field, flag in _FLAGS.items()}
        unit = self._known_unit()

        def hz(name: str) -> float | None:
            word = words.get(name)
            return 0.0 if word == 0 else unit.to_hz(word) if unit and word is not None else None

        def scaled(name: str, factor: float) -> float | None:
            return round(words[name] * factor, 6) if name in words else None

        return V7Status(**flags, frequency_reference=hz("frequency_reference"),
                        output_frequency=hz("output_frequency"), current=scaled("output_current", CURRENT_UNIT),
                        torque=scaled("torque_reference", TORQUE_UNIT), pulse_train=words.get("pulse_train"),
                        valid=frame.valid)

    @property
    def wd_counter(self) -> int:
        """WD: counts up about every 64 ms, modulo 16, while the card's CPU lives."""
        return self._wd(self.frame)

    def _wd(self, frame: Frame) -> int:
        if self._layout.channel is None:
            raise self._no_channel("watchdog counter")
        return frame.octets[self._layout.channel.handshake] >> WD_SHIFT & WD_MODULUS - 1

    @property
    def alive(self) -> bool:
        """Whether the card's CPU lives: watches WD for up to four periods (0.26 s) and a fixed cycle time, returns as soon as
        it has moved."""
        before = self.wd_counter
        try:
            self.wait(lambda f: f.valid and self._wd(f) != before, 4 * WD_PERIOD + self._pace)
        except DPTimeout:
            return False
        return True

    # -- Terminals and faults --------------------------------------------------------------------------------------

    @property
    def digital_inputs(self) -> Terminals:
        """Input terminals S3 to S7 closed over the bus: ``drive.digital_inputs["S5"] = True``.

        n052 to n056 say what they are for (some make a fault, as n052 = 3 does with S3).
        """
        return Terminals(self, "command", INPUT_TERMINALS)

    @property
    def digital_outputs(self) -> Terminals:
        """Multi-function output terminals MA, P1 and P2 as commanded (Extended Data 1 only).

        n057 to n059 must give them to the bus. Their state is in `status`: output1 to output3.
        """
        if "multi_function_output" not in self._words:
            raise ConfigurationError(f"digital_outputs: {self._layout.name} has no word for them, Extended Data 1 has")
        return Terminals(self, "multi_function_output", OUTPUT_TERMINALS)

    @property
    def torque_reference(self) -> float:
        """Torque reference, per cent, 0 to 100 (Basic data only)."""
        return self._output_word("torque_reference") * TORQUE_UNIT

    @torque_reference.setter
    def torque_reference(self, percent: float) -> None:
        if not number(percent) or not 0 <= percent <= 100:
            raise ConfigurationError(f"torque_reference {percent!r}: the word takes 0 to 100 %")
        self._change("torque_reference", clear=0xFFFF, set_=round(percent / TORQUE_UNIT))

    def external_fault(self, on: bool = True) -> None:
        """Raise (or take away) an external fault, EF0. The fault itself stays until `fault_reset`."""
        self._change("command", clear=Command.EXTERNAL_FAULT, set_=Command.EXTERNAL_FAULT if on else 0)

    # -- Parameters ------------------------------------------------------------------------------------------------

    def __getitem__(self, name: str) -> int:
        """A parameter by name ("n019"), in the drive's own counts."""
        return self.read_parameter(name)

    def __setitem__(self, name: str, value: float) -> None:
        """Write a parameter, in the drive's own counts: a whole number."""
        self.write_parameter(name, value)  # type: ignore[arg-type]

    def write(self, values: Mapping[str, float], *, store: bool = False) -> None:
        """Write parameters, each in force at once; with `store` the ENTER command (register 0900h) follows, which puts all that
        was written into the drive's EEPROM. That takes a limited number of writes, and none while the drive runs."""
        super().write(values)
        if store:
            self.write_parameter(ENTER, 0)

    def parameter(self, name: str) -> ParameterInfo:
        known = PARAMETERS.get(register(name))
        if known is None:
            return ParameterInfo(register_name(register(name)))
        return ParameterInfo(register_name(register(name)), known.text, "", known.minimum, known.maximum)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(map(register_name, PARAMETERS))

    @overload
    def read_parameter(self, name: int | str, count: Literal[1] = 1, *, timeout: float = 1.0) -> int: ...

    @overload
    def read_parameter(self, name: int | str, count: int, *, timeout: float = 1.0) -> int | tuple[int, ...]: ...

    def read_parameter(self, name: int | str, count: int = 1, *, timeout: float = 1.0) -> int | tuple[int, ...]:
        """Read a register by number or name ("n003"), or `count` from there on (a tuple; up to 4 in Extended Data 1).

        `timeout` is s from its turn in the channel, beside eight fixed cycle times. ParameterAccessError carries the drive's
        code and its meaning; DPTimeout leaves the channel usable.
        """
        channel = self._need_channel("read_parameter")
        self._check_count(count, channel)
        values = channel.access(Function.READ, register(name), 2 * count, (), timeout)
        return values[0] if count == 1 else values

    def write_parameter(self, name: int | str, value: int | Sequence[int], *, timeout: float = 1.0) -> None:
        """Write a register by number or name, or several from there on. Errors as with `read_parameter`."""
        channel = self._need_channel("write_parameter")
        values = tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else (value,)
        self._check_count(len(values), channel)
        for word in values:
            if isinstance(word, bool) or not isinstance(word, int) or not 0 <= word <= 0xFFFF:
                raise ConfigurationError(f"write_parameter {name!r}: {word!r} is no word, 0 to 65535")
        first = register(name)
        scaling = not _SCALING.isdisjoint(range(first, first + len(values)))
        try:
            channel.access(Function.WRITE, first, 2 * len(values), values, timeout)
        except ParameterAccessError:
            scaling = False  # refused: nothing has changed
            raise
        finally:
            if scaling:
                self._facts = None

    def _check_count(self, count: int, channel: ParameterChannel) -> None:
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= channel.words:
            raise ConfigurationError(f"{count!r} registers at once: {self._layout.name} takes 1 to {channel.words}")

    def _need_channel(self, what: str) -> ParameterChannel:
        if self._channel is None:
            raise self._no_channel(what)
        return self._channel

    def _no_channel(self, what: str) -> ConfigurationError:
        return ConfigurationError(f"{what}: {self._layout.name} has no parameter channel; "
                                  "Extended Data 1 and 2 have one")

    @property
    def aio(self) -> AsyncYaskawaV7:
        from dpmaster.drives.aio import AsyncYaskawaV7  # asyncio is loaded by who uses it

        return AsyncYaskawaV7(self)

    # -- Hooks of the master ---------------------------------------------------------------------------------------

    def _before_operate(self) -> list[str]:
        self._facts = None  # the drive may have been another one, or set otherwise
        return [self._address_warning] if self._address_warning else []


_FLAGS: Mapping[str, Status] = {
    **{flag.name.lower(): flag for flag in Status if flag.name and not flag.name.startswith("OUTPUT_")},
    "output1": Status.OUTPUT_1, "output2": Status.OUTPUT_2, "output3": Status.OUTPUT_3,
}
