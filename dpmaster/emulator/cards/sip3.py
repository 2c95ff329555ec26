# SPDX-License-Identifier: MIT
"""The SI-P3 option card in a Yaskawa V1000 or A1000: conventional maps and PPOs, MEMOBUS and PKW, faults, LEDs, the drive.

Behaviour is that of the option's technical manual, SIEP C730600 42. Everything happens inside `step`, on the time that the
host gives; a lock lets a program look at `registers`, `motor` and the rest while the host's thread steps.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from dpmaster.emulator.card import Exchange, Slave, SlaveState
from dpmaster.emulator.cards._sip3_numbers import HISTORY, Numbers
from dpmaster.emulator.cards._sip3_registers import Registers
from dpmaster.emulator.cards._yaskawa import SENDING, Commissioning, Handshake, YaskawaCard
from dpmaster.emulator.motor import Motor
from dpmaster.errors import ConfigurationError
from dpmaster.profiles import pkw, ppo
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.pkw import Responder
from dpmaster.profiles.ppo import ControlWord, StatusWord
from dpmaster.profiles.yaskawa import (
    LAST_REGISTER,
    Access,
    AccessCode,
    ChannelMap,
    Configuration,
    FrequencyUnit,
    Function,
    get_word,
)
from dpmaster.profiles.yaskawa_1000 import INIT, YASKAWA_1000, Command, Condition, LEDs, Status, Table

_DC_BUS, _DC_BUS_UNDERVOLTAGE, _RATED_VOLTAGE = 311, 150, 200
"""Volts of a 200 V class drive."""

_NO_COMMAND = Command(0)
_NOTHING_TOLD = (b"", True)  # diagnosis and readiness as a slave has them from the start

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Orders:
    """What the bus wants of the drive, whichever words it says it with."""

    direction: int = 0
    """+1, -1 or 0."""
    reference: float = 0.0
    """Hz, without sign."""
    baseblock: bool = False
    external_fault: bool = False
    reset: bool = False
    """Level of the fault reset bit."""
    history_reset: bool = False
    terminals: Command = _NO_COMMAND
    """Input terminals S3 to S8 that the bus closes."""
    local: bool = False
    """STW bit 10 is 0."""


class SIP3(YaskawaCard):
    """A V1000 or A1000 drive with its PROFIBUS card.

    `parameters` is "commissioned" (b1-01 = b1-02 = 3, and F6-32 follows the configuration that the master chooses) or
    "factory" (the manual's defaults: the drive ignores the bus, the card takes PPOs only). `settings` are counts of
    parameters by name that differ from that, ``{"F6-33": 1}``; with an F6-32 among them the card takes only configurations
    of its kind, as they are when it is attached. F6-30 is `address`: outside 1..125 an error, below 3 a warning. F6-30 and
    F6-33 are read at power-up.

    `table` is the drive's parameters, for a program's own ``YASKAWA_1000.extended([...])``. `size` is the drive's, kW: up
    to 7.5 a count of current is 0.01 A, above 0.1 A; by default the motor's rated power. `seed` settles how long the
    drive takes over each parameter access.

    State to read at any time: `motor`, `registers`, `running`, `status`, `outputs`, `inputs`, `analog_outputs`, `fault`,
    `alarms`, `history`, `leds`, `frequency_reference`, `torque_reference`, `diagnosis`. Conditions to set:
    `undervoltage`, `storing`, `pulse_count`, `analog_input`, `inject`.
    """

    ident_number: int = profile.IDENT_NUMBER
    configurations: tuple[bytes, ...] = tuple(c.identifier for c in profile.CONFIGURATIONS)
    user_parameters: tuple[int, int] = (len(profile.USER_PARAMETERS),) * 2
    fail_safe: bool = True
    sync: bool = True
    freeze: bool = True
    set_address: bool = True
    min_slave_interval: int = profile.MIN_SLAVE_INTERVAL
    max_diagnosis: int = 11

    def __init__(self, address: int, *, parameters: Commissioning = "commissioned",
                 settings: Mapping[str, int] = MappingProxyType({}), table: Table = YASKAWA_1000,
                 motor: Motor | None = None, size: float | None = None, seed: int | None = None) -> None:
        if warning := profile.check_address(address):
            _log.warning("%s", warning)
        super().__init__(motor, address if seed is None else seed, parameters)
        self._address = address
        self.size = self.motor.rated_power / 1000 if size is None else size
        if isinstance(self.size, bool) or not isinstance(self.size, (int, float)) or not 0 < self.size <= 1000:
            raise ConfigurationError(f"size {size!r} kW: above 0 and up to 1000")
        self.undervoltage = False
        """Main circuit undervoltage: the output is off, writing is refused, bit 24 of the diagnosis is set."""
        self.storing = False
        """The drive is storing parameter data: writing is refused."""
        self.pulse_count = 0
        """PG pulse count of channel 1, as the word of the bus shows it."""
        self.analog_input = 0
        """Analogue input channel 1, as the word of the bus shows it."""
        self.history: list[tuple[str, int]] = []
        """The last ten faults, the newest first: name, and seconds since the one before or since power-up."""
        self._told = _NOTHING_TOLD
        self._numbers = Numbers(self)
        self.registers = Registers(table, self._monitor, self._lock)
        self._set_up(parameters, dict(settings))
        self._forget()

    def _set_up(self, parameters: str, settings: dict[str, int]) -> None:
        """The parameters as commissioning left them."""
        fixed = parameters == "factory" or any(name.casefold() == "f6-32" for name in settings)
        commissioned = profile.COMMISSIONED if parameters == "commissioned" else {}
        for name, count in {**commissioned, **settings, "F6-30": self._address}.items():
            self.registers[name] = count
        self._fixed_map = fixed
        if fixed:
            wanted = profile.PPO_MODULES if self.registers["F6-32"] == 0 else profile.CONVENTIONAL
            self._modules: tuple[Configuration | profile.PPOModule, ...] = wanted
            self.configurations = tuple(module.identifier for module in wanted)
        else:
            self._modules = profile.CONFIGURATIONS

    def _forget(self) -> None:
        super()._forget()
        self.registers.recall()
        self._numbers.recall()
        self._disabled = self.registers.setting("F6-30") == 0
        self._address = self.registers.setting("F6-30") or self._address
        self._index_size: pkw.IndexSize = "byte" if self.registers.setting("F6-33") else "word"
        self._timed_out = False
        self._alarm: str | None = None
        self._since_fault = 0.0
        self._orders = Orders()
        self._edges = (False, False)
        self._held = self._octets = self._shown = b""
        self._layout = self._modules[0]
        self._job: _Channel | Responder = self._responder()

    def _responder(self) -> Responder:
        return Responder(lambda task: pkw.serve(task, self._numbers, profile.PKW_SUBSTITUTES),
                         lambda: SENDING + self._access_time(), self._index_size)

    @property
    def address(self) -> int:
        """The node address: F6-30 as it was at power-up, or what a Set_Slave_Add has put there since."""
        return self._address

    @address.setter
    def address(self, address: int) -> None:
        if address != self._address:
            self._address, self._disabled = address, False
            if address <= YASKAWA_1000["F6-30"].maximum:
                self.registers["F6-30"] = address

    # -- What a program reads and does -----------------------------------------------------------------------------

    @property
    def frequency_reference(self) -> float:
        """Hz, the reference that the drive follows, without sign."""
        with self._lock:
            return self._reference()

    @property
    def torque_reference(self) -> float:
        """Per cent: torque reference or limit from the bus, 0 unless F6-06 and the control method (A1-02) make use of it."""
        with self._lock:
            enabled = self.registers.setting("F6-06") and self.registers.setting("A1-02") in (3, 6, 7)
            return ppo.signed(self.registers.word(4)) * profile.TORQUE_UNIT if enabled else 0.0

    @property
    def alarms(self) -> frozenset[str]:
        """What flashes on the drive's display: "bb", "CALL" (table 17), "bUS" or "EF0" where they are set to alarm only."""
        with self._lock:
            shown = (("bb", self._baseblocked), ("CALL", self._calls), (self._alarm or "", self._alarm))
            return frozenset(name for name, there in shown if there)

    @property
    def inputs(self) -> dict[str, bool]:
        """Input terminals S3 to S8 as the bus closes them."""
        return {name: bool(self._orders.terminals & flag) for name, flag in profile.INPUT_TERMINALS.items()}

    @property
    def outputs(self) -> dict[str, bool]:
        """Output terminals M1-M2, P1 and P2: closed or not, by their functions H2-01 to H2-03."""
        with self._lock:
            return {name: self._terminal(name) for name in profile.OUTPUT_TERMINALS}

    @property
    def analog_outputs(self) -> dict[str, int | None]:
        """Analogue outputs FM and AM as the bus sets them; None where H4-01 or H4-04 give them to a monitor."""
        with self._lock:
            return {name: None if self.registers.setting(function) else self.registers.word(register)
                    for name, function, register in (("FM", "H4-01", 7), ("AM", "H4-04", 8))}

    @property
    def leds(self) -> LEDs:
        """The indicators at the front, as table 4 prints them."""
        with self._lock:
            return profile.LED_ROWS[self._row()]

    @property
    def diagnosis(self) -> bytes:
        """The block behind the six standard octets: undervoltage, inverter communication, illegal PNU 915 or 916."""
        with self._lock:
            conditions = (
                (Condition.UNDERVOLTAGE, self.undervoltage),
                (Condition.INVERTER_COMMUNICATION, self._injected),
                (Condition.ILLEGAL_PNU_915, self._numbers.illegal(profile.PNU_ASSIGN_WRITE)),
                (Condition.ILLEGAL_PNU_916, self._numbers.illegal(profile.PNU_ASSIGN_READ)),
            )
            return profile.diagnosis(Condition(sum(condition for condition, there in conditions if there)))

    def inject(self, fault: str) -> None:
        """Break the card or its connection: oFA00, oFA01, oFA30 to oFA43, oFb00, oFb02, oFc00 or oFc02. Only a power cycle
        (`reset`) mends it."""
        if fault not in profile.FAULTS or not fault.startswith("oF"):
            raise ConfigurationError(f"fault {fault!r}: inject oFA00, oFA01, oFA30 to oFA43, oFb00, oFb02, oFc00 or oFc02; "
                                     "bUS and EF0 come from the bus")
        with self._lock:
            self._injected = fault
            self._judge()

    # -- What the host does ----------------------------------------------------------------------------------------

    def reset(self, now: float) -> None:
        with self._lock:
            self._injected = None
            self._forget()
            self.motor.cut(now)
            self._powered = self._now = self._since_fault = now
            self._told = (b"", self._told[1])  # a slave without power forgets its diagnosis

    def step(self, now: float, exchange: Exchange) -> bytes:
        with self._lock:
            if self._powered is None:
                self.reset(now)
            self._live(now)
            self._see(exchange)
            self._shown = self._image()
        self._tell()
        return self._shown

    def attached(self, slave: Slave) -> None:
        super().attached(slave)
        self._told = _NOTHING_TOLD

    def _tell(self) -> None:
        """Give the slave what has changed of diagnosis and readiness: with a node address of 0 the card takes no part."""
        now = (self.diagnosis, not self._disabled)
        if self.slave and now != self._told:
            self._told = now
            self.slave.diagnose(now[0], announce=True, ext_diag=bool(now[0]), static_diag=False)
            self.slave.set_ready(now[1])

    def _see(self, exchange: Exchange) -> None:
        """Take over what the slave says now."""
        before, self._exchange = self._exchange, exchange
        module = self._module
        if module is None:
            self._lose(before)
        else:
            if before.state is not SlaveState.DATA_EXCH or before.configuration != exchange.configuration:
                self._begin(module)
            if exchange.valid:
                self._held = exchange.outputs
            # F6-31: what a Clear leaves is zeros, or the last values
            holds = exchange.valid or self.registers.setting("F6-31")
            self._octets = (self._held if holds else b"").ljust(module.size, b"\0")
        self._orders = self._decode()
        self._command()
        if module and self._ready:
            self._ask(module)

    def _lose(self, before: Exchange) -> None:
        """There is no exchange: F6-01 = 3 (alarm only) lets the drive go on as it was, else what the bus commands is 0."""
        if self._exchange.watchdog_expired != before.watchdog_expired or (
                before.state is SlaveState.WAIT_CFG and self._exchange.state is SlaveState.WAIT_PRM):
            self._timed_out = True
        if not (self._established and self.registers.setting("F6-01") == 3):
            self._octets = b""
            self.registers.write(profile.COMMANDS[0], [0] * len(profile.COMMANDS))

    def _begin(self, module: Configuration | profile.PPOModule) -> None:
        """An exchange begins: nothing of an earlier one is held, and HS is cleared."""
        self._established, self._timed_out = True, False
        self._held, self._layout = b"", module
        if not self._fixed_map:
            self.registers["F6-32"] = int(isinstance(module, Configuration))
        memobus = isinstance(module, Configuration) and module.channel
        self._job = _Channel(self._access, self._access_time) if memobus else self._responder()

    @property
    def _counts(self) -> bool:
        return isinstance(self._job, _Channel)

    @property
    def _module(self) -> Configuration | profile.PPOModule | None:
        index = self._exchange.configuration
        if self._exchange.state is not SlaveState.DATA_EXCH or not 0 <= index < len(self._modules):
            return None
        return self._modules[index]

    def _ask(self, module: Configuration | profile.PPOModule) -> None:
        """Show the parameter channel its part of the outputs."""
        if isinstance(self._job, _Channel):
            assert isinstance(module, Configuration) and module.channel
            self._job.see(self._octets, module.channel, self._now)
        elif isinstance(module, profile.PPOModule) and module.ppo.pkw:
            self._job.see(self._octets, self._now)

    # -- Words of the bus ------------------------------------------------------------------------------------------

    def _decode(self) -> Orders:
        """What the present outputs order. After a loss the words of the last exchange are gone, or stand (F6-01 = 3)."""
        if not self._ready or not self._octets:
            return Orders()
        if isinstance(self._layout, Configuration):
            return self._decode_conventional(self._layout)
        return self._decode_ppo(self._layout.ppo)

    def _decode_conventional(self, layout: Configuration) -> Orders:
        words = {name: get_word(self._octets, offset) for name, offset in layout.outputs.items()}
        registers = {"torque_reference": 4, "torque_compensation": 5, "analog_output_1": 7, "analog_output_2": 8,
                     "digital_output": 9}
        for name, register in registers.items():
            if name in words:
                self.registers.write(register, [words[name]])
        command = Command(words["command"])
        if self.registers.setting("H5-12"):  # RUN, and the direction
            direction = (-1 if command & Command.REVERSE else 1) if command & Command.FORWARD else 0
        else:  # both at once: stop
            direction = {Command.FORWARD: 1, Command.REVERSE: -1}.get(command & Command.RUN, 0)
        unit = self._unit()
        terminals = command & Command(sum(profile.INPUT_TERMINALS.values()))
        functions = self._functions(terminals)
        return Orders(direction, unit.to_hz(words["frequency_reference"]) if unit else 0.0,
                      baseblock=bool(command & Command.BASEBLOCK) or 0x08 in functions,
                      external_fault=bool(command & Command.EXTERNAL_FAULT),
                      reset=bool(command & Command.FAULT_RESET) or 0x14 in functions,
                      history_reset=bool(command & Command.HISTORY_RESET), terminals=terminals)

    def _decode_ppo(self, layout: ppo.PPO) -> Orders:
        words = [get_word(self._octets, layout.offset(n)) for n in range(1, layout.words + 1)]
        for register, word in zip(self._numbers.assigned(profile.PNU_ASSIGN_WRITE), words[2:], strict=False):
            if register:
                self.registers.write(register, [word])
        control = ControlWord(words[0] & 0x07FF)
        local = not control & ControlWord.CONTROL
        if local:  # local control: but what stops is always heard
            control &= ControlWord.ENABLE_OPERATION
        maximum = self._maximum()
        share = ppo.to_share(words[1], profile.FULL_SCALE)
        direction, reference = 0, abs(share) * maximum
        if control & profile.RUN:
            direction = -1 if share < 0 else 1
        elif jog := control & (profile.JOG_FORWARD | profile.JOG_REVERSE):  # both at once: stop
            direction = {profile.JOG_FORWARD: 1, profile.JOG_REVERSE: -1}.get(jog, 0)
            reference = profile.JOG_SHARE * maximum
        baseblock = not control & ControlWord.ENABLE_OPERATION
        return Orders(0 if baseblock else direction, reference, baseblock, reset=bool(control & ControlWord.FAULT_RESET),
                      local=local)

    def _functions(self, terminals: Command) -> set[int]:
        """Functions (H1-03 to H1-08) of the input terminals that are closed."""
        return {self.registers.setting(f"H1-0{name[1]}") for name, flag in profile.INPUT_TERMINALS.items() if terminals & flag}

    def _image(self) -> bytes:
        """The input octets of this moment."""
        module = self._module
        if module is None:
            return b""
        image = bytearray(module.size)
        if isinstance(module, Configuration):
            for name, offset in module.inputs.items():
                image[offset:offset + 2] = self._word(name, module).to_bytes(2, "big")
            if channel := module.channel:
                assert isinstance(self._job, _Channel)
                self._job.show(image, channel, self._ticks(self._now))
            return bytes(image)
        layout = module.ppo
        if layout.pkw:
            assert isinstance(self._job, Responder)
            image[0:pkw.LENGTH] = self._job.octets
        share = min(max(self.motor.frequency / self._maximum(), -3.0), 3.0)  # E1-04 may have been changed meanwhile
        values = [int(self.status_word), ppo.to_word(share, profile.FULL_SCALE)]
        values += [self.registers.word(register) if register else 0
                   for register in self._numbers.assigned(profile.PNU_ASSIGN_READ)]
        for number in range(1, layout.words + 1):
            image[layout.offset(number):layout.offset(number) + 2] = values[number - 1].to_bytes(2, "big")
        return bytes(image)

    def _word(self, name: str, layout: Configuration) -> int:
        """An input word of the conventional maps."""
        method = self.registers.setting("A1-02")
        match name:
            case "status":
                return int(self.status)
            case "motor_speed":  # tables 8 and 12: with V/f and OLV/PM the output frequency; table 9: 0
                return 0 if layout is profile.EXTENDED_DATA_1 and method in (0, 5) else self._monitor(0x0044)
            case "torque_reference":
                return self._monitor(0x0048)
            case "pulse_count":
                return self.pulse_count & 0xFFFF
            case "analog_input":
                return self.analog_input & 0xFFFF
        return self._monitor({"frequency_reference": 0x0040, "output_frequency": 0x0041, "output_current": 0x0042}[name])

    # -- The drive -------------------------------------------------------------------------------------------------

    @property
    def _ready(self) -> bool:
        """Whether the card has come up; with a node address of 0 it never does."""
        return super()._ready and not self._disabled

    def _maximum(self) -> float:
        """E1-04, Hz."""
        return self.registers.setting("E1-04") / 10

    def _unit(self) -> FrequencyUnit | None:
        """The unit of frequency words, None for a user setting, which no table defines."""
        try:
            return profile.frequency_unit(self.registers.setting("o1-03"), self._maximum(), self.registers.setting("E2-04"))
        except ConfigurationError:
            return None

    @property
    def _assigned_to_bus(self) -> bool:
        """bUS is detected when run command or frequency reference are the option's (table 16)."""
        return 3 in (self.registers.setting("b1-01"), self.registers.setting("b1-02"))

    @property
    def _net_control(self) -> bool:
        """Whether run command and frequency reference are the bus's."""
        return not self._orders.local and all(
            self.registers.setting(name) == needed for name, needed in profile.CONTROL.items())

    @property
    def _baseblocked(self) -> bool:
        return self._orders.baseblock and self.registers.setting("b1-02") == 3

    def _reference(self) -> float:
        """Hz, by b1-01; multi-step speeds beside the option's only where F6-07 allows them."""
        source, orders = self.registers.setting("b1-01"), self._orders
        reference = 0.0  # the terminals, serial lines and pulses of this drive are not connected
        if source == 3:
            reference = orders.reference
        elif source == 0:
            reference = self.registers.setting("d1-01") / 100
        if self.registers.setting("F6-07"):
            functions = self._functions(orders.terminals)
            if step := sum(1 << n for n in range(3) if n + 3 in functions):
                reference = self.registers.setting(f"d1-{step + 1:02d}") / 100
            if 6 in functions:
                reference = self.registers.setting("d1-17") / 100
        return min(reference, self._maximum())

    def _command(self) -> None:
        """New orders have come: edges first, then what they lead to."""
        orders, edges = self._orders, self._edges
        self._edges = (orders.reset, orders.history_reset)
        if orders.history_reset and not edges[1]:
            self.history.clear()
        if orders.reset and not edges[0] and all(self._reaction(cause) == 3 for cause in self._causes()):
            self._fault = None
        self._judge()
        self._act(self._now)

    def _causes(self) -> Iterator[str]:
        """Faults that are there now, whether displayed or not, those that are set to alarm only included."""
        if self._injected:
            yield self._injected
        if self._established and self._module is None and self._assigned_to_bus:
            yield "bUS"
        if self._orders.external_fault and (not self.registers.setting("F6-02") or self.motor.powered or self._fault == "EF0"):
            yield "EF0"
        for name, flag in profile.INPUT_TERMINALS.items():
            if self._orders.terminals & flag and self.registers.setting(f"H1-0{name[1]}") == 0x24:
                yield f"EF{name[1]}"

    def _judge(self) -> None:
        """The first fault stays on the display until it is reset; one in the card itself goes before it."""
        causes = list(self._causes())
        self._alarm = next((cause for cause in causes if self._reaction(cause) == 3), None)
        fault = self._injected or self._fault or next((cause for cause in causes if self._reaction(cause) != 3), None)
        if fault and fault != self._fault:
            self.history.insert(0, (fault, min(int(self._now - self._since_fault), 0xFFFF)))
            del self.history[HISTORY:]
            self._since_fault = self._now
        self._fault = fault

    def _reaction(self, fault: str) -> int:
        """0 ramp to stop, 1 coast, 2 fast-stop, 3 alarm only."""
        selection = {"bUS": "F6-01", "EF0": "F6-03"}.get(fault)
        return self.registers.setting(selection) if selection else 1

    def _direction(self) -> int:
        """+1, -1 or 0: where the run command leads."""
        return self._obey(self._orders.direction, allowed=self.registers.setting("b1-02") == 3,
                          healthy=not (self._fault or self.undervoltage))

    def _act(self, now: float) -> None:
        """Lead the motor where orders, parameters and faults say."""
        direction = self._direction()
        reaction = self._reaction(self._fault) if self._fault else None
        stopped = direction == 0 and (not self.motor.powered or self.motor.frequency == 0)
        if self.undervoltage or self._baseblocked or reaction == 1 or stopped:
            self.motor.cut(now)  # the output is shut off
            return
        slow = "C1-09" if reaction == 2 else "C1-02"
        up, down = (self._maximum() / (tenths * 0.1) if (tenths := self.registers.setting(name)) else math.inf
                    for name in ("C1-01", slow))
        self.motor.drive(now, direction * self._reference(), up, down)

    @property
    def _agrees(self) -> bool:
        return self.motor.powered and self.motor.arrived and self._orders.direction != 0

    @property
    def _drive_ready(self) -> bool:
        return self._ready and not self._fault and not self.undervoltage

    @property
    def _warns(self) -> bool:
        """A minor fault. A baseblock is none: table 17 has no output for it."""
        return self._alarm is not None or self._calls

    @property
    def _calls(self) -> bool:
        return self._ready and not self._established and self._assigned_to_bus

    @property
    def status(self) -> Status:
        """The drive status word, U1-12."""
        with self._lock:
            motor, orders = self.motor, self._orders
            flags = (
                (Status.RUNNING, motor.powered),
                (Status.ZERO_SPEED, motor.frequency == 0),
                (Status.REVERSE, motor.frequency < 0 or (motor.frequency == 0 and orders.direction < 0)),
                (Status.RESET, orders.reset),
                (Status.SPEED_AGREE, self._agrees),
                (Status.READY, self._drive_ready),
                (Status.ALARM, self._warns),
                (Status.FAULT, self._fault),
                (Status.OPE_ERROR, self._unit() is None),
                (Status.POWER_LOSS, self.undervoltage),
                (Status.NET_CONTROL, self._net_control),
                (Status.OUTPUT_M1, self._terminal("M1-M2")),
                (Status.OUTPUT_P1, self._terminal("P1")),
                (Status.OUTPUT_P2, self._terminal("P2")),
            )
            return Status(sum(flag for flag, on in flags if on)) if self._ready else Status(0)

    @property
    def status_word(self) -> StatusWord:
        """ZSW."""
        with self._lock:
            flags = (
                (StatusWord.OPERATION_ENABLED, self._drive_ready),
                (StatusWord.FAULT, self._fault),
                (StatusWord.ALARM, self._warns),
                (StatusWord.SPEED_AGREE, self._agrees),
                (StatusWord.CONTROL, self._net_control),
            )
            return profile.STATUS_ALWAYS | StatusWord(sum(flag for flag, on in flags if on))

    def _terminal(self, name: str) -> bool:
        """Whether an output terminal is closed.

        Functions: 0 running, 1 zero speed, 2 speed agree, 6 ready, 8 baseblock, E fault, F through mode, 10 minor fault;
        with others it stays open.
        """
        function = {"M1-M2": "H2-01", "P1": "H2-02", "P2": "H2-03"}[name]
        match self.registers.setting(function):
            case 0x00:
                return self.motor.powered
            case 0x01:
                return self.motor.frequency == 0
            case 0x02:
                return self._agrees
            case 0x06:
                return self._drive_ready
            case 0x08:
                return self._baseblocked
            case 0x0E:
                return self._fault is not None
            case 0x0F:
                return bool(self.registers.word(9) & profile.OUTPUT_TERMINALS[name])
            case 0x10:
                return self._warns
        return False

    def _monitor(self, address: int) -> int:
        """The living value of a monitor register; 0 of one that the card's manual does not name."""
        motor, unit = self.motor, self._unit()
        torque = 0 if self.registers.setting("A1-02") in (0, 1, 5) else round(motor.torque * 100 / profile.TORQUE_UNIT)

        def count(hz: float) -> int:
            return min(round(abs(hz) / unit.hz), 0xFFFF) if unit else 0

        match profile.MONITOR_COPIES.get(address, address):
            case 0x0020:  # bit 0 running, 1 reverse, 2 ready, 3 fault
                status = self.status
                flags = (Status.RUNNING, Status.REVERSE, Status.READY, Status.FAULT)
                return sum(1 << i for i, flag in enumerate(flags) if status & flag)
            case 0x0040:
                return count(self._reference())
            case 0x0041 | 0x0044:  # this motor does not slip
                return count(motor.frequency)
            case 0x0042:
                return min(round(motor.current / profile.current_unit(self.size)), 0xFFFF)
            case 0x0043:
                return self.registers.setting("A1-02")
            case 0x0045:  # 0.1 V, up to the rated voltage at the rated frequency
                return round(10 * _RATED_VOLTAGE * min(abs(motor.frequency) / motor.rated_frequency, 1.0))
            case 0x0046:
                return _DC_BUS_UNDERVOLTAGE if self.undervoltage else _DC_BUS
            case 0x0047:  # 0.1 kW
                return round(motor.power / 100) & 0xFFFF
            case 0x0048:
                return torque & 0xFFFF
            case 0x0049:
                return int(self._orders.terminals)
            case 0x004A:
                return sum(flag for name, flag in profile.OUTPUT_TERMINALS.items() if self._terminal(name))
            case 0x004B:
                return int(self.status)
        return 0

    def _row(self) -> str:
        """Which row of table 4 the LEDs show."""
        if self._powered is None:
            return "No power"
        if self._injected and self._injected.startswith(("oFA3", "oFA4")):
            return "Self-diagnostics error"
        if self._injected or self._disabled:
            return "Problem connecting to the drive"
        if not self._ready:
            return "Checking"
        if self._module:
            return "Exchange"
        return "Data incorrect or timed out" if self._timed_out else "Waiting for the master"

    # -- Parameter access ------------------------------------------------------------------------------------------

    def _access(self, request: Access, words: int) -> Access:
        """Carry out a MEMOBUS message; `words` is what the configuration's channel holds."""
        code = self._refusal(request, words)
        if code is not None:
            return Access.error(request.function, code)
        if request.function == Function.LOOP_BACK:
            return request
        n = request.length // 2
        if request.function == Function.READ:
            values = tuple(self.registers.word(request.address + i) for i in range(n))
            return Access(request.function, request.address, request.length, values)
        self._write(request.address, list(request.data[:n]))
        return Access(request.function, request.address, request.length)

    def _refusal(self, request: Access, words: int) -> AccessCode | None:
        """The error code for a MEMOBUS message that the drive will not carry out; writes are done whole or not at all."""
        n = request.length // 2
        if request.function not in (Function.READ, Function.LOOP_BACK, Function.WRITE):
            return AccessCode.FUNCTION
        if request.length % 2 or not 1 <= n <= words:
            return AccessCode.AMOUNT
        if request.function == Function.LOOP_BACK:
            return None
        if request.function == Function.WRITE:
            return self._write_refusal(request.address, list(request.data[:n]))
        return AccessCode.ADDRESS if request.address + n - 1 > LAST_REGISTER else None

    def _write_refusal(self, address: int, words: list[int]) -> AccessCode | None:
        return self.registers.refusal(address, words, running=self.running, blocked=self.undervoltage or self.storing)

    def _write(self, address: int, words: list[int]) -> None:
        """Carry out a write that was not refused."""
        if address in (profile.ENTER_RAM, profile.ENTER_ROM):
            self.registers.enter(store=address == profile.ENTER_ROM)
            if address == profile.ENTER_ROM:
                self._numbers.store()
        else:
            self.registers.write(address, words)


class _Channel(Handshake):
    """The input HS keeps its old value, with function code 00h, until the answer is there; INIT ends everything."""

    def see(self, octets: bytes, where: ChannelMap, now: float) -> None:
        if octets[where.handshake] & INIT:
            self.clear()
        else:
            super().see(octets, where, now)

    def _receive(self, now: float) -> None:
        self.answer = Access(Function.NONE)
        if self._request.function == Function.NONE:  # zeros of a Clear, for one
            self.hs = self._taken
        else:
            self.advance(now)
