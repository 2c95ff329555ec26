# SPDX-License-Identifier: MIT
"""A Yaskawa V7 with the SI-P1 option card, driven in plain Python.

Sits on `Station` alone: it knows words, bits and the parameter channel (from `profiles.yaskawa`), and neither bus nor
port. Its time is that of the frames, so that it runs on virtual time too.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal, Protocol, overload

from dpmaster._arguments import number
from dpmaster.errors import (
    CommissioningError,
    ConfigurationError,
    DPTimeout,
    OutputsDiscarded,
    ParameterAccessError,
    StationError,
)
from dpmaster.profiles.yaskawa import (
    ACCESS_MEANINGS,
    CONTROL,
    CURRENT_UNIT,
    ERROR,
    HIGHEST_FREQUENCY,
    HS,
    INPUT_TERMINALS,
    OUTPUT_TERMINALS,
    STATUS_MASK,
    TORQUE_UNIT,
    WD_MODULUS,
    WD_PERIOD,
    WD_SHIFT,
    Access,
    ChannelMap,
    Command,
    FrequencyUnit,
    Function,
    Status,
    Transfer,
    WordOrder,
    check_address,
    get_word,
    register,
    register_name,
)
from dpmaster.profiles.yaskawa import configuration as find_configuration
from dpmaster.station import Frame, Station

MAX_TSDR: Mapping[int, int] = {
    9_600: 60, 19_200: 60, 45_450: 250, 93_750: 60, 187_500: 60, 500_000: 100, 1_500_000: 150, 3_000_000: 250,
    6_000_000: 450, 12_000_000: 800,
}
"""MaxTsdr of YASK00CA.GSD, bit times by rate."""

SETTLE = 0.020
"""Seconds that the drive may take to look at a new command: what its status says until then may be about the one before."""

_UNIT_PARAMETERS = ("n003", "n004", "n011", "n035", "n152")


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

    def __str__(self) -> str:
        on = [f.name for f in fields(self) if getattr(self, f.name) is True]
        values = [f"{f.name}={value:g}" for f in fields(self)
                  if isinstance(value := getattr(self, f.name), (int, float)) and not isinstance(value, bool)]
        return ", ".join(on + values) or "no flag set"


class Wire(Protocol):
    """What the parameter channel needs of a station."""

    def update(self, offset: int, octets: bytes) -> int:
        """Commit a part of the outputs."""

    def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
        """Wait until a commit was sent and answered."""

    def wait(self, predicate: Callable[[Frame], bool], timeout: float | None) -> Frame:
        """Wait for a frame that fulfils the predicate."""


class ParameterChannel:
    """The master's half of the parameter channel: one access at a time, by the handshake of appendix B.

    HS of the command is made equal to the response's, the data goes first, HS is toggled in a telegram after one that is
    known to have been answered, and an answer counts when its HS equals the command's and STATUS is 11. WD is never
    looked at.
    """

    def __init__(self, wire: Wire, where: ChannelMap) -> None:
        self._wire = wire
        self._where = where
        self._lock = threading.Lock()
        self._abandoned = False

    @property
    def words(self) -> int:
        """Most registers of one access."""
        return self._where.words

    def access(self, function: int, address: int, length: int, data: Sequence[int] = (),
               timeout: float = 1.0) -> tuple[int, ...]:
        """Exchange one message and return the data words of its good answer. ParameterAccessError, DPTimeout."""
        what = f"{function:02X}h on {register_name(address)}"
        with self._lock:
            request = Access(function, address, length, tuple(data))
            frame = self._equalise(timeout)
            self._abandoned = True
            deadline = frame.time + timeout
            hs = self._hs(frame)
            self._commit(request, hs, timeout)
            hs ^= HS
            self._commit(request, hs, timeout)
            try:
                frame = self._wire.wait(lambda f: f.valid and self._answered(f, hs), deadline - frame.time)
            except DPTimeout as late:
                raise DPTimeout(f"parameter channel: no answer to function {what} within {timeout} s; "
                                f"the channel can be used again ({late})") from late
            self._abandoned = False
        return self._judge(request, Access.decode(frame.octets, self._where))

    def _equalise(self, timeout: float) -> Frame:
        """Give the command the response's HS; return a later frame, which has confirmed it.

        The late mirror of an access that was given up can still change the response's HS: then the card is given time to
        have looked, and if HS has moved it is done once more. Function 00h keeps such a crossing from being taken for a
        request.
        """
        frame = self._wire.wait(lambda f: f.valid, timeout)
        deadline = frame.time + timeout
        while frame.time < deadline:
            hs = self._hs(frame)
            self._commit(Access(Function.NONE), hs, timeout)
            frame = self._after(self._wire.wait(lambda f: f.valid, timeout), timeout)
            if self._hs(frame) == hs:
                return frame
        raise DPTimeout(f"parameter channel: HS of the card did not settle within {timeout} s")

    def _after(self, seen: Frame, timeout: float) -> Frame:
        """A frame after `seen`, by `SETTLE` when an access was given up."""
        earliest = seen.time + (SETTLE if self._abandoned else 0.0)
        return self._wire.wait(lambda f: f.valid and f.number != seen.number and f.time >= earliest, timeout + SETTLE)

    def _hs(self, frame: Frame) -> int:
        return frame.octets[self._where.handshake] & HS

    def _commit(self, request: Access, hs: int, timeout: float) -> None:
        """Commit the whole area - message, reserved octets 0, handshake register - and see it answered."""
        message = request.encode(self._where.words)
        area = message.ljust(self._where.handshake - self._where.offset, b"\0") + bytes((hs,))
        self._wire.wait_sent(self._wire.update(self._where.offset, area), timeout)

    def _answered(self, frame: Frame, hs: int) -> bool:
        return frame.octets[self._where.handshake] & (HS | STATUS_MASK) == hs | Transfer.RECEIVED

    @staticmethod
    def _judge(request: Access, answer: Access) -> tuple[int, ...]:
        """The data of a good answer; an error answer and one that does not belong to the request are raised."""
        name = register_name(request.address)
        if answer.function == request.function | ERROR:
            code = answer.data[0]
            meaning = ACCESS_MEANINGS.get(code, "a code that table 3.15 does not know")
            verb = "write" if request.function == Function.WRITE else "read"
            raise ParameterAccessError(f"{verb} {name}: the drive answers error {code:02X}h, {meaning}",
                                       code=code, meaning=meaning, register=request.address)
        if (answer.function, answer.address, answer.length) != (request.function, request.address, request.length):
            raise StationError(f"parameter channel: asked {request}, the answer is {answer}",
                               reason="answer to another request")
        return answer.data[:request.length // 2]


class Terminals(MutableMapping[str, bool]):
    """Terminals by name, closed (True) or open: commands in the outputs of the drive; setting one commits it."""

    def __init__(self, drive: YaskawaV7, word: str, flags: Mapping[str, int]) -> None:
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


class YaskawaV7(Station):
    """A V7 drive with its PROFIBUS option card SI-P1.

    `configuration` is the manual's name: "Basic data", "Extended Data 1" or "Extended Data 2", in any case.
    `word_order` ("big", "little") turns all words of the fast area, never the parameter area.

    Frequencies are Hz. The unit on the bus is read from the drive (n035, n152, n011) before the first run command. Basic
    data has no parameter channel: there the unit is `frequency_unit`, by default the "0.01 Hz" of a drive commissioned with
    n152 = 1; if n035 or n152 say otherwise, the drive turns at another frequency than asked for.

    `address` is 1 to 99, what the card's switches can set; 1 and 2 are usually masters'. What is left of the arguments
    goes to `Station` (watchdog, group, name, ...). The figures of YASK00CA.GSD are set: no user parameters, no Fail_Safe,
    Min_Slave_Intervall 0.1 ms.
    """

    IDENT_NUMBER = 0x00CA

    def __init__(self, address: int, configuration: str = "Extended Data 1", *, word_order: WordOrder = "big",
                 frequency_unit: str | FrequencyUnit | None = None, name: str | None = None,
                 watchdog: float | Literal["default"] | None = "default", group: int = 0, sync: bool = False,
                 freeze: bool = False, active: bool = True) -> None:
        self._address_warning = check_address(address)
        self._layout = find_configuration(configuration)
        if word_order not in ("big", "little"):
            raise ConfigurationError(f"word_order {word_order!r}: give 'big' or 'little'")
        self._word_order: WordOrder = word_order
        self._fixed_unit = self._check_unit(frequency_unit)
        self._facts: dict[str, int] | None = None
        self._commands = threading.RLock()
        super().__init__(address, self.IDENT_NUMBER, self._layout.identifier, name=name or f"drive {address}",
                         watchdog=watchdog, max_tsdr=MAX_TSDR, group=group, sync=sync, freeze=freeze, fail_safe=False,
                         min_slave_interval=1, active=active)
        self._channel = ParameterChannel(self, self._layout.channel) if self._layout.channel else None
        self._pending: int | None = None
        self._settled = 0.0

    def _check_unit(self, unit: str | FrequencyUnit | None) -> FrequencyUnit | None:
        if self._layout.channel:
            if unit is not None:
                raise ConfigurationError(f"frequency_unit {unit!r}: {self._layout.name} reads the unit from the drive; "
                                         "only Basic data takes it as an argument")
            return None
        return unit if isinstance(unit, FrequencyUnit) else FrequencyUnit.named(unit or "0.01 Hz")

    # -- Moving ----------------------------------------------------------------------------------------------------

    def run_forward(self, hz: float) -> None:
        """Run forward at `hz`. CommissioningError when n003 or n004 keep the option card from moving the drive.

        Those, and the frequency's unit, are read once before the first run command (about 0.1 s) and again after
        every `operate()`. With Basic data, which cannot read them, the first run command waits up to 0.5 s for the drive
        to show that it runs, and is taken back if it does not.
        """
        self._run(Command.FORWARD, hz)

    def run_reverse(self, hz: float) -> None:
        """Run in reverse at `hz` (a positive number); see `run_forward`."""
        self._run(Command.REVERSE, hz)

    def stop(self) -> None:
        """Take the run command away; the drive ramps down as its parameters say. The set-point stays."""
        self._change("command", clear=Command.RUN)

    @property
    def frequency(self) -> float:
        """Set-point, Hz. Setting it changes the speed and neither starts nor stops the drive."""
        word = self._output_word("frequency_reference")
        return self._unit().to_hz(word) if word else 0.0

    @frequency.setter
    def frequency(self, hz: float) -> None:
        self._change("frequency_reference", clear=0xFFFF, set_=self._reference(hz))

    def _run(self, direction: Command, hz: float) -> None:
        self._need_control()
        reference = self._reference(hz)
        with self._commands:
            word = self._output_word("command") & ~Command.RUN | direction
            order = self._word_order
            # Command and reference are neighbours in every configuration: one commit, so never one without the other.
            self._pending = self.update(0, word.to_bytes(2, order) + reference.to_bytes(2, order))
        if self._channel is None and self._facts is None and reference:
            self._see_running()

    def _reference(self, hz: float) -> int:
        """`hz` as a word of the bus."""
        if not number(hz):
            raise ConfigurationError(f"frequency {hz!r} Hz: give a number of Hz")
        hz = float(hz)
        if hz < 0:
            raise ConfigurationError(f"frequency {hz} Hz: give a positive number; run_reverse turns the other way")
        if hz == 0:
            return 0
        unit = self._unit()
        maximum = self._maximum()
        if not hz <= maximum:
            limit = "n011, the drive's maximum frequency" if self._facts else "the highest n011"
            raise ConfigurationError(f"frequency {hz} Hz: the limit is {maximum} Hz ({limit})")
        return unit.to_bus(hz)

    def _see_running(self) -> None:
        """Basic data's stand-in for reading n003 and n004: a drive that listens shows it within half a second."""
        try:
            self.wait_until(lambda status: status.running, timeout=0.5)
        except DPTimeout as late:
            self.stop()
            if self.status.major_fault:
                raise StationError(f"{self.name}: does not run, it shows a fault ({self.status}); fault_reset() first",
                                   address=self.address, reason="fault") from late
            needed = " and ".join(f"{name} = {value}" for name, value in CONTROL.items())
            raise CommissioningError(
                f"{self.name}: shows no running. It needs {needed}, which Basic data has no channel to read; "
                f"check them at the keypad (status: {self.status})", parameters=tuple(CONTROL)) from late
        self._facts = {}

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
            facts = {name: self.read_parameter(name) for name in _UNIT_PARAMETERS}
            self._facts = facts
        return facts

    def _unit(self) -> FrequencyUnit:
        if self._fixed_unit:
            return self._fixed_unit
        facts = self._know()
        return FrequencyUnit.of(facts["n035"], facts["n152"], facts["n011"] / 10)

    def _maximum(self) -> float:
        return self._facts["n011"] / 10 if self._channel and self._facts else HIGHEST_FREQUENCY

    def _known_unit(self) -> FrequencyUnit | None:
        """The unit without asking the drive."""
        try:
            return self._unit() if self._fixed_unit or self._facts else None
        except ConfigurationError:
            return None

    # -- Status ----------------------------------------------------------------------------------------------------

    @property
    def status(self) -> V7Status:
        """What the drive said in the last frame."""
        return self._decode(self.frame)

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

    def wait_until(self, predicate: Callable[[V7Status], bool], timeout: float) -> V7Status:
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
        """Whether the card's CPU lives: watches WD for up to four periods (0.26 s), returns as soon as it has moved."""
        before = self.wd_counter
        try:
            self.wait(lambda f: f.valid and self._wd(f) != before, 4 * WD_PERIOD)
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
        if "multi_function_output" not in self._layout.outputs:
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

    def fault_reset(self) -> None:
        """Reset a fault whose cause is gone. StationError if it stays for a second.

        The run command is taken away with it: after a reset the drive stands until it is told to run.
        """
        self._pulse(clear=Command.RUN, set_=Command.FAULT_RESET)
        try:
            self.wait(lambda f: f.valid and not self._decode(f).major_fault, 1.0)
        except DPTimeout as late:
            raise StationError(f"{self.name}: the fault stays; its cause is still there (status: {self.status})",
                               address=self.address, reason="fault") from late
        finally:
            self._pulse(clear=Command.FAULT_RESET)

    def _pulse(self, clear: int, set_: int = 0) -> None:
        """One side of an edge: committed, and seen to be answered."""
        self.wait_sent(self._change("command", clear=clear, set_=set_), 1.0)

    # -- Parameters ------------------------------------------------------------------------------------------------

    @overload
    def read_parameter(self, name: int | str, count: Literal[1] = 1, *, timeout: float = 1.0) -> int: ...

    @overload
    def read_parameter(self, name: int | str, count: int, *, timeout: float = 1.0) -> int | tuple[int, ...]: ...

    def read_parameter(self, name: int | str, count: int = 1, *, timeout: float = 1.0) -> int | tuple[int, ...]:
        """Read a register by number or name ("n003"), or `count` from there on (a tuple; up to 4 in Extended Data 1).

        ParameterAccessError carries the drive's code and its meaning; DPTimeout leaves the channel usable.
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
        refused = False
        try:
            channel.access(Function.WRITE, register(name), 2 * len(values), values, timeout)
        except ParameterAccessError:
            refused = True
            raise
        finally:
            if not refused:
                self._facts = None  # it may have been one of them, or scale one of them

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

    # -- Outputs ---------------------------------------------------------------------------------------------------

    def _output_word(self, name: str) -> int:
        """A word as the next commit builds on it: after a loss or Clear that is 0, whatever was commanded before."""
        try:
            offset = self._layout.outputs[name]
        except KeyError:
            raise ConfigurationError(f"{name}: {self._layout.name} has no such word") from None
        return get_word(self.outputs, offset, self._word_order)

    def _change(self, name: str, *, clear: int, set_: int = 0) -> int:
        """Clear and set bits of a word in one commit; its number."""
        with self._commands:
            word = self._output_word(name) & ~clear & 0xFFFF | set_
            self._pending = number = self.update(self._layout.outputs[name], word.to_bytes(2, self._word_order))
            return number

    # -- Hooks of the master ---------------------------------------------------------------------------------------

    def _rest(self) -> None:
        """Before the master leaves Operate: the stop word, seen to be answered within half a second."""
        self.wait_sent(self._change("command", clear=Command.RUN), 0.5)

    def _before_operate(self) -> list[str]:
        self._facts = None  # the drive may have been another one, or set otherwise
        return [self._address_warning] if self._address_warning else []


_FLAGS: Mapping[str, Status] = {
    **{flag.name.lower(): flag for flag in Status if flag.name and not flag.name.startswith("OUTPUT_")},
    "output1": Status.OUTPUT_1, "output2": Status.OUTPUT_2, "output3": Status.OUTPUT_3,
}
