# SPDX-License-Identifier: MIT
"""The SI-P1 option card in a Yaskawa V7: registers, fast words, parameter channel, faults, LEDs and the drive behind.

Behaviour is that of the V7 PROFIBUS-DP Option manual, TM.V7.12. Everything happens inside `step`, on the time that the
host gives; a lock lets a program look at `registers`, `motor` and the rest while the host's thread steps.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, MutableMapping

from dpmaster.emulator.card import Exchange, SlaveState
from dpmaster.emulator.cards._yaskawa import Commissioning, Handshake, YaskawaCard
from dpmaster.emulator.motor import Motor
from dpmaster.errors import ConfigurationError
from dpmaster.profiles.yaskawa import (
    LAST_REGISTER,
    Access,
    AccessCode,
    Configuration,
    FrequencyUnit,
    Function,
    WordOrder,
    get_word,
)
from dpmaster.profiles.yaskawa_v7 import (
    COMMISSIONED,
    CONFIGURATIONS,
    CONTROL,
    CURRENT_UNIT,
    ENTER,
    FAULTS,
    FREQUENCY_REFERENCE,
    IDENT_NUMBER,
    INPUT_TERMINALS,
    LED_ROWS,
    MIN_SLAVE_INTERVAL,
    PARAMETERS,
    TORQUE_UNIT,
    Command,
    LEDs,
    Status,
    check_address,
    frequency_unit,
    register,
    register_name,
)

RECEIPT = 0.001
"""Seconds that STATUS stays 00 when a command has come."""

_MONITORS = range(0x0020, 0x0040)
_PARAMETERS = range(0x0101, 0x0200)
_N003, _N004, _N011, _N018, _N019, _N020, _N024, _N035, _N052, _N057, _N152 = map(
    register, ("n003", "n004", "n011", "n018", "n019", "n020", "n024", "n035", "n052", "n057", "n152"))

_log = logging.getLogger(__name__)


class Registers(MutableMapping[int | str, int]):
    """The drive's registers, 0000h to 0600h, by address or name ("n003"), as a person with the keypad sees them.

    Parameters (n001 ..) keep their limits; what is set here is stored at once, what the bus writes is in force at once and
    stored by the ENTER command. 0020h to 003Fh are monitors. Every other register is mere room: it keeps what was written,
    0 to FFFFh, until the power is cycled. Setting a monitor pins its value until ``del`` frees it, for tests of the other side.
    The card's manual names one monitor, 0037h (output power, here in W); 0020h, 0021h, 0023h, 0024h and 0027h are the
    V7's usual ones.
    """

    def __init__(self, card: SIP1, values: dict[int, int]) -> None:
        self._card = card
        self._stored = values
        self.recall()

    def __getitem__(self, key: int | str) -> int:
        address = self._address(key)
        with self._card._lock:
            if address in self._values:
                return self._values[address]
            return self._card._monitor(address) if address in _MONITORS else 0

    def __setitem__(self, key: int | str, value: int) -> None:
        address = self._address(key)
        low, high = self.limits(address)
        if not isinstance(value, int) or not low <= value <= high:
            raise ConfigurationError(f"{register_name(address)} = {value!r}: the register takes {low} to {high}")
        with self._card._lock:
            self._values[address] = int(value)
            if address in _PARAMETERS:
                self._stored[address] = int(value)

    def __delitem__(self, key: int | str) -> None:
        """Back to the factory's value; a pinned monitor lives again."""
        address = self._address(key)
        with self._card._lock:
            for values in (self._values, self._stored):
                values.pop(address, None)
                if address in PARAMETERS:
                    values[address] = PARAMETERS[address].default

    def __iter__(self) -> Iterator[int]:
        return iter(range(LAST_REGISTER + 1))

    def __len__(self) -> int:
        return LAST_REGISTER + 1

    def write(self, address: int, value: int) -> None:
        """What the bus writes, within its limits."""
        self._values[address] = value

    def enter(self) -> None:
        """The ENTER command: the parameters outlive the power."""
        self._stored = {address: value for address, value in self._values.items() if address in _PARAMETERS}

    def recall(self) -> None:
        """What power-up finds."""
        self._values = dict(self._stored)

    @staticmethod
    def limits(address: int) -> tuple[int, int]:
        """Lowest and highest value of a register."""
        parameter = PARAMETERS.get(address)
        return (parameter.minimum, parameter.maximum) if parameter else (0, 0xFFFF)

    @staticmethod
    def _address(key: int | str) -> int:
        address = register(key)
        if address > LAST_REGISTER:
            raise ConfigurationError(f"register {key!r}: the drive has 0000h to {LAST_REGISTER:04X}h")
        return address


class SIP1(YaskawaCard):
    """A V7 drive with its PROFIBUS card.

    `parameters` is "commissioned" (n003 = 3, n004 = 9, n152 = 1) or "factory" (the manual's defaults: the drive ignores
    the bus). `word_order` turns the words of the fast area. `seed` settles how long the drive takes over each parameter
    access. Addresses outside 1..99 are an error, below 3 a warning.

    State to read at any time: `motor`, `registers`, `running`, `status`, `outputs`, `inputs`, `fault`, `leds`,
    `frequency_reference`, `torque_reference`. Conditions to set: `undervoltage`, `storing`, `pulse_train`, `inject`.
    """

    ident_number: int = IDENT_NUMBER
    configurations: tuple[bytes, ...] = tuple(c.identifier for c in CONFIGURATIONS)
    sync: bool = True
    freeze: bool = True
    min_slave_interval: int = MIN_SLAVE_INTERVAL

    def __init__(self, address: int, *, parameters: Commissioning = "commissioned",
                 word_order: WordOrder = "big", motor: Motor | None = None, seed: int | None = None) -> None:
        if warning := check_address(address):
            _log.warning("%s", warning)
        super().__init__(motor, address if seed is None else seed, parameters)
        if word_order not in ("big", "little"):
            raise ConfigurationError(f"word_order {word_order!r}: give 'big' or 'little'")
        self.address = address
        self.word_order: WordOrder = word_order
        self.undervoltage = False
        """Main circuit undervoltage: the output is off, writing is refused."""
        self.storing = False
        """The drive is storing parameter data: writing is refused."""
        self.pulse_train = 0
        """Pulses at terminal RP, as the word of the bus shows them."""
        values = {address: parameter.default for address, parameter in PARAMETERS.items()}
        self.registers = Registers(self, values | dict(COMMISSIONED) if parameters == "commissioned" else values)
        self._forget()

    def _forget(self) -> None:
        super()._forget()
        self._job: _Channel = _Channel(self._access, self._access_time)
        self._command = Command(0)
        self._reference = 0.0
        self._torque_reference = 0
        self._output_command = 0

    # -- What a program reads and does -----------------------------------------------------------------------------

    @property
    def frequency_reference(self) -> float:
        """Hz, the reference that the drive follows, without sign."""
        return self._reference

    @property
    def torque_reference(self) -> float:
        """Per cent, the last torque reference of Basic data; V/f control makes no use of it."""
        return self._torque_reference * TORQUE_UNIT

    @property
    def inputs(self) -> dict[str, bool]:
        """Input terminals S3 to S7 as the bus closes them."""
        return {name: bool(self._command & flag) for name, flag in INPUT_TERMINALS.items()}

    @property
    def outputs(self) -> dict[str, bool]:
        """Output terminals MA, P1 and P2: closed or not, by their functions n057 to n059."""
        with self._lock:
            return {name: self._terminal(index) for index, name in enumerate(("MA", "P1", "P2"))}

    @property
    def leds(self) -> LEDs:
        """The indicators at the front, as tables 1.6 to 1.8 print them."""
        with self._lock:
            return LED_ROWS[self._row()]

    def inject(self, fault: str) -> None:
        """Break the card or its connection: F06, F21, F22 or F23. Only a power cycle (`reset`) mends it (table 1.9)."""
        if fault not in FAULTS or not fault.startswith("F"):
            raise ConfigurationError(f"fault {fault!r}: inject F06, F21, F22 or F23; BUS and EF0 come from the bus")
        with self._lock:
            self._injected = fault
            self._judge()

    # -- What the host does ----------------------------------------------------------------------------------------

    def reset(self, now: float) -> None:
        with self._lock:
            self.registers.recall()
            self._injected = None
            self._forget()
            self.motor.cut(now)
            self._powered = self._now = now

    def step(self, now: float, exchange: Exchange) -> bytes:
        with self._lock:
            if self._powered is None:
                self.reset(now)
            self._live(now)
            self._see(exchange)
            return self._image()

    def _see(self, exchange: Exchange) -> None:
        """Take over what the slave says now."""
        exchanging = exchange.state is SlaveState.DATA_EXCH and exchange.configuration >= 0
        if exchanging and self._exchange.state is not SlaveState.DATA_EXCH:
            self._job = _Channel(self._access, self._access_time)  # HS is cleared after re-initialisation
        self._exchange = exchange
        self._established = self._established or exchanging
        where = self._configuration
        octets = exchange.outputs if exchanging and exchange.valid and where else b""
        if where is None:
            self._torque_reference = self._output_command = 0
            self._take(Command(0), 0)
            return
        words = {name: get_word(octets, offset, self.word_order) for name, offset in where.outputs.items()}
        self._torque_reference = words.get("torque_reference", 0)
        self._output_command = words.get("multi_function_output", 0)
        self._take(Command(words["command"] & _KNOWN), words["frequency_reference"])
        if where.channel and self._ready:
            self._job.see(octets.ljust(where.size, b"\0"), where.channel, self._now)

    @property
    def _configuration(self) -> Configuration | None:
        index = self._exchange.configuration
        if self._exchange.state is not SlaveState.DATA_EXCH or not 0 <= index < len(CONFIGURATIONS):
            return None
        return CONFIGURATIONS[index]

    @property
    def _counts(self) -> bool:
        where = self._configuration
        return where is not None and where.channel is not None

    def _image(self) -> bytes:
        """The input octets of this moment."""
        where = self._configuration
        if where is None:
            return b""
        image = bytearray(where.size)
        unit = self._unit()

        def count(hz: float) -> int:
            return min(round(abs(hz) / unit.hz), 0xFFFF) if unit else 0

        words = {"status": int(self.status), "frequency_reference": count(self._reference),
                 "output_frequency": count(self.motor.frequency), "pulse_train": self.pulse_train & 0xFFFF,
                 "output_current": round(self.motor.current / CURRENT_UNIT),
                 "torque_reference": min(round(abs(self.motor.torque) * 100 / TORQUE_UNIT), 0xFFFF)}
        for name, offset in where.inputs.items():
            image[offset:offset + 2] = words[name].to_bytes(2, self.word_order)
        if where.channel:
            self._job.show(image, where.channel, self._ticks(self._now))
        return bytes(image)

    # -- The drive -------------------------------------------------------------------------------------------------

    def _unit(self) -> FrequencyUnit | None:
        """The unit of the frequency words, None for user settings (n035 from 40), which no table defines."""
        try:
            return frequency_unit(self.registers[_N035], self.registers[_N152], self.registers[_N011] / 10)
        except ConfigurationError:
            return None

    def _take(self, command: Command, reference: int) -> None:
        """A new command word and frequency reference have come from the bus."""
        reset_edge = bool(command & ~self._command & Command.FAULT_RESET) or self._input_edge(command, 5)
        self._command = command
        unit = self._unit()
        maximum = self.registers[_N011] / 10
        if (source := self.registers[_N004]) in (6, 9):
            word = reference if source == 9 else self.registers[FREQUENCY_REFERENCE]
            self._reference = min(unit.to_hz(word), maximum) if unit else 0.0
        else:  # the keypad has a reference; the terminals of this drive are not connected
            self._reference = min(self.registers[_N024] / 100, maximum) if source == 1 else 0.0
        if reset_edge and self._fault and not self._cause():
            self._fault = None
        self._judge()
        self._act(self._now)

    def _input_edge(self, command: Command, function: int) -> bool:
        """Whether `command` closes an open input terminal of that function (n052 to n056)."""
        return any(self.registers[_N052 + i] == function and command & ~self._command & flag
                   for i, flag in enumerate(INPUT_TERMINALS.values()))

    def _cause(self) -> str | None:
        """The fault that is there now, whether displayed or not."""
        if self._injected:
            return self._injected
        if self._established and self._exchange.state is not SlaveState.DATA_EXCH:
            return "BUS"
        if self._command & Command.EXTERNAL_FAULT:
            return "EF0"
        for i, (name, flag) in enumerate(INPUT_TERMINALS.items()):
            if self._command & flag and self.registers[_N052 + i] == 3:  # external fault, normally open
                return f"EF{name[1]}"
        return None

    def _judge(self) -> None:
        """The first fault stays on the display until it is reset; one in the card itself goes before it."""
        self._fault = self._injected or self._fault or self._cause()

    def _direction(self) -> int:
        """+1, -1 or 0: where the run command leads; both directions at once are none."""
        direction = {Command.FORWARD: 1, Command.REVERSE: -1}.get(self._command & Command.RUN, 0)
        return self._obey(direction, allowed=self.registers[_N003] == 3, healthy=not (self._fault or self.undervoltage))

    def _act(self, now: float) -> None:
        """Lead the motor where command, parameters and faults say."""
        direction = self._direction()
        if self.undervoltage or self._fault not in (None, "BUS"):
            self.motor.cut(now)  # the output is shut off
            return
        if direction == 0 and (not self.motor.powered or self.motor.frequency == 0):
            self.motor.cut(now)
            return
        maximum = self.registers[_N011] / 10
        second = 0.01 if self.registers[_N018] else 0.1
        up, down = (maximum / (self.registers[n] * second) if self.registers[n] else math.inf for n in (_N019, _N020))
        self.motor.drive(now, direction * self._reference, up, down)

    @property
    def status(self) -> Status:
        """The drive status word."""
        with self._lock:
            motor, command = self.motor, self._command
            moving = bool(command & Command.RUN)
            backwards = motor.frequency < 0 or (motor.frequency == 0 and command & Command.RUN == Command.REVERSE)
            reset = command & Command.FAULT_RESET
            remote = all(self.registers[name] == needed for name, needed in CONTROL.items())
            flags = (
                (Status.RUNNING, motor.powered),
                (Status.ZERO_SPEED, motor.frequency == 0),
                (Status.REVERSE, backwards),
                (Status.RESET, reset),
                (Status.FREQUENCY_AGREE, motor.powered and moving and motor.arrived),
                (Status.READY, self._ready and not self._fault and not self.undervoltage),
                (Status.MINOR_FAULT, command & Command.RUN == Command.RUN),
                (Status.MAJOR_FAULT, self._fault),
                (Status.OPE_ERROR, self._unit() is None),
                (Status.LOCAL_REMOTE, remote),
                (Status.OUTPUT_1, self._terminal(0)),
                (Status.OUTPUT_2, self._terminal(1)),
                (Status.OUTPUT_3, self._terminal(2)),
            )
            return Status(sum(flag for flag, on in flags if on)) if self._ready else Status(0)

    def _terminal(self, index: int) -> bool:
        """Whether output terminal `index` is closed.

        Functions: 0 fault, 1 running, 2 frequency agree, 3 zero speed, 18 command from communication; others stay open.
        """
        motor = self.motor
        match self.registers[_N057 + index]:
            case 0:
                return self._fault is not None
            case 1:
                return motor.powered
            case 2:
                return motor.powered and motor.arrived and bool(self._command & Command.RUN)
            case 3:
                return motor.frequency == 0
            case 18:
                return bool(self._output_command & 1 << index)
        return False

    def _monitor(self, address: int) -> int:
        """The living value of a monitor register."""
        motor, status = self.motor, self.status
        unit = self._unit()
        match address:
            case 0x0020:  # bit 0 running, 1 reverse, 2 ready, 3 fault
                flags = (Status.RUNNING, Status.REVERSE, Status.READY, Status.MAJOR_FAULT)
                return sum(1 << i for i, flag in enumerate(flags) if status & flag)
            case 0x0021:  # bit 3 external fault
                return 1 << 3 if self._fault and self._fault.startswith("EF") else 0
            case 0x0023:
                return unit.to_bus(self._reference) if unit else 0
            case 0x0024:
                return unit.to_bus(abs(motor.frequency)) if unit else 0
            case 0x0027:
                return round(motor.current / CURRENT_UNIT)
            case 0x0037:
                return round(motor.power) & 0xFFFF
        return 0

    def _row(self) -> str:
        """Which row of table 1.8 the LEDs show."""
        if self._powered is None:
            return "Power OFF"
        if self._injected:
            return "Drive Error" if self._injected == "F06" else "CPU Error"
        if not self._ready:
            return "CPU Init"
        if self._exchange.state is SlaveState.DATA_EXCH:
            return "Normal"
        return "Com Error" if self._established else "No exchange"

    # -- Parameter access ------------------------------------------------------------------------------------------

    def _access(self, request: Access, words: int) -> Access:
        """Carry out a request of the parameter channel; `words` is what the configuration's channel holds."""
        code = self._refusal(request, words)
        if code is not None:
            return Access.error(request.function, code)
        n = request.length // 2
        addresses = range(request.address, request.address + n)
        if request.function == Function.READ:
            values = tuple(self.registers[a] for a in addresses)
            return Access(request.function, request.address, request.length, values)
        if request.address == ENTER:
            self.registers.enter()
        else:
            for address, value in zip(addresses, request.data, strict=False):
                self.registers.write(address, value)
        return Access(request.function, request.address, request.length)

    def _refusal(self, request: Access, words: int) -> AccessCode | None:
        """The error code of table 3.15 for a request that the drive will not carry out; writes are done whole or not at all.

        "Parameter change during running" is taken for every n-parameter.
        """
        n = request.length // 2
        enter = (request.function, request.address, request.length) == (Function.WRITE, ENTER, 2)
        highest = ENTER if enter else LAST_REGISTER
        if request.function not in (Function.READ, Function.WRITE):
            return AccessCode.FUNCTION
        if request.address > highest:
            return AccessCode.ADDRESS
        if request.length % 2 or not 1 <= n <= words:
            return AccessCode.AMOUNT
        if request.address + n - 1 > highest:
            return AccessCode.ADDRESS
        if request.function == Function.READ:
            return None
        addresses = range(request.address, request.address + n)
        if self.undervoltage or self.storing or any(
                a in _MONITORS or (self.running and (a in _PARAMETERS or a == ENTER)) for a in addresses):
            return AccessCode.WRITE
        for address, value in zip(addresses, request.data, strict=False):
            low, high = Registers.limits(address)
            if not low <= value <= high:
                return AccessCode.CONTENT
        return None


_KNOWN = (Command.RUN | Command.S3 | Command.S4 | Command.S5 | Command.S6 | Command.S7
          | Command.EXTERNAL_FAULT | Command.FAULT_RESET)


class _Channel(Handshake):
    """The STATUS values of table 3.17: HS is mirrored at receipt, the answer of the command before stands until the new one
    is there."""

    def _receive(self, now: float) -> None:
        self.hs = self._taken
        if self._request.function == Function.NONE:
            self.answer = self._request
        else:
            self.due = now + RECEIPT
