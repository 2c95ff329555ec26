# SPDX-License-Identifier: MIT
"""A wire on virtual time for tests: machines of the core, or a script, exchange octets that take 11 bit times each.

`Wire` couples machines (masters, slaves, cards) by the event contract of ``machine.h``; no clock of this computer is
read, so every time in a test is exact and an hour of bus needs no hour. `Script` plays the far end by hand: a test takes the
master's next telegram and says what comes back, and when.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from dpmaster._core import block, ffi, lib

NEVER = lib.DPM_NEVER
US = 1_000
MS = 1_000_000
S = 1_000_000_000


def octets(text: str) -> bytes:
    """Octets written as hex with blanks."""
    return bytes.fromhex(text)


def default_parameters(rate: int = 500_000, max_tsdr: int = 0) -> Any:
    """The standard bus parameters of a rate as a C struct."""
    parameters = ffi.new("dpm_parameters *")
    assert lib.dpm_parameters_default(parameters, rate, max_tsdr) == 0
    return parameters


@dataclass(frozen=True)
class Sent:
    """One transmission: who, from its first start bit to its last stop bit (ns), what."""

    source: int
    start: int
    end: int
    octets: bytes

    @property
    def hex(self) -> str:
        return self.octets.hex(" ")


class Offer:
    """What a machine offers at a time."""

    def __init__(self, machine: Any, now: int) -> None:
        offer = ffi.new("dpm_offer *")
        machine.ask(machine, now, offer)
        self.octets: bytes = bytes(ffi.buffer(offer.octets, offer.n)) if offer.n else b""
        self.not_before: int = offer.not_before
        self.not_after: int = offer.not_after
        self.wake: int = offer.wake


def feed(machine: Any, data: bytes, end: int, character: int, errors: bytes | None = None, echo: bool = False) -> None:
    """Give octets of which the last ended at `end`, at exact times."""
    span = ffi.new("dpm_span *")
    kept = ffi.new("uint8_t[]", data)
    faults = ffi.new("uint8_t[]", errors) if errors else ffi.NULL
    span.octets, span.errors, span.n = kept, faults, len(data)
    span.earliest = span.latest = end - (len(data) - 1) * character
    span.spacing, span.echo = character, echo
    machine.octets(machine, span)


class Master:
    """A dpm_master in memory of its own, with its images."""

    def __init__(self, rate: int = 500_000, address: int = 1, *, parameters: Any = None, slaves: int = 126,
                 allowance: int = 0, granularity: int = 0, delivery: int = 0, echo: bool = False, cycle_time: int = 0,
                 output_watchdog: int = 0, control_interval: int = 400 * MS, role: int = lib.DPM_ROLE_SOLE,
                 auto_clear: bool = False, data_retries: int = -1) -> None:
        config = ffi.new("dpm_master_config *")
        self.parameters = parameters or default_parameters(rate)
        config.station.parameters = self.parameters[0]
        config.station.address = address
        config.station.role = role
        config.station.traits.allowance = allowance
        config.station.traits.granularity = granularity
        config.station.traits.delivery = delivery
        config.station.traits.echo = echo
        config.slaves = slaves
        config.cycle_time = cycle_time
        config.output_watchdog = output_watchdog
        config.data_control_time = min(3 * control_interval, 3600 * S)  # an hour is the longest
        config.auto_clear = auto_clear
        config.data_retries = data_retries
        size = lib.dpm_master_size(slaves)
        self._block = block(size)
        out = ffi.new("dpm_master **")
        self.result = lib.dpm_master_init(self._block, size, config, out)
        if self.result == 0:
            self.master = out[0]
            self.machine = lib.dpm_master_machine(self.master)
            self.ring_block = block(lib.dpm_ring_size(1024))
            self.ring = lib.dpm_ring_init(self.ring_block, lib.dpm_ring_size(1024), 1024)
            lib.dpm_station_add_ring(lib.dpm_master_station(self.master), self.ring)
        self.images: list[tuple[Any, Any, Any, Any]] = []
        self._requests: list[Any] = []

    def add(self, address: int, ident: int, configuration: bytes, user: bytes = b"", *, watchdog: tuple[int, int] = (0, 0),
            **fields: Any) -> int:
        """Add a slave; the index, or the error code."""
        slave = ffi.new("dpm_slave_set *")
        slave.address, slave.ident_number = address, ident
        slave.configuration[0 : len(configuration)] = configuration
        slave.configuration_length = len(configuration)
        slave.user_parameters[0 : len(user)] = user
        slave.user_parameters_length = len(user)
        slave.wd_fact_1, slave.wd_fact_2 = watchdog
        slave.active = True
        slave.min_tsdr = 11
        for name, value in fields.items():
            setattr(slave, name, value)
        inputs, outputs = ffi.new("uint16_t *"), ffi.new("uint16_t *")
        lib.dpm_configuration_lengths(slave.configuration, len(configuration), inputs, outputs)
        out_block, in_block = block(lib.dpm_outputs_size()), block(lib.dpm_image_size())
        out = lib.dpm_outputs_init(out_block, lib.dpm_outputs_size(), outputs[0])
        image = lib.dpm_image_init(in_block, lib.dpm_image_size())
        index = int(lib.dpm_master_add(self.master, slave, out, image))
        if index >= 0:
            self.images[index : index + 1] = [(out, image, out_block, in_block)]
        return index

    def mode(self, mode: int, now: int = 0) -> None:
        assert lib.dpm_master_set_mode(self.master, mode, now) == 0

    def order(self, now: int, *, da: int = 127, command: int = 0, group: int = 0, clear: int = -1) -> Any:
        """Order a Global_Control; it lives as long as this object."""
        control = ffi.new("dpm_control *", {"da": da, "command": command, "group": group, "clear": clear})
        self._requests.append(control)
        assert lib.dpm_master_order(self.master, control, now) == 0
        return control

    def commit(self, index: int, data: bytes, now: int = 0, offset: int = 0, keep: bytes = b"") -> int:
        number = int(lib.dpm_outputs_change(self.images[index][0], offset, keep or ffi.NULL, data, len(data), now))
        lib.dpm_master_feed(self.master, now, lib.DPM_FED_COMMIT)
        return number

    def request(self, address: int, function: int, data: bytes = b"", dsap: int = -1, ssap: int = -1) -> Any:
        """Queue a raw request; it lives as long as this object, as the core demands."""
        request = ffi.new("dpm_raw *")
        self._requests.append(request)
        request.da, request.function, request.dsap, request.ssap, request.length = address, function, dsap, ssap, len(data)
        request.data[0 : len(data)] = data
        assert lib.dpm_master_request(self.master, request) == 0
        return request

    def was_sent(self, index: int, number: int) -> int:
        return int(lib.dpm_outputs_was_sent(self.images[index][0], number))

    def inputs(self, index: int) -> Any:
        return lib.dpm_image_get(self.images[index][1])

    def slave(self, index: int) -> Any:
        status = ffi.new("dpm_slave_status *")
        assert lib.dpm_master_get_slave(self.master, index, status) == 0
        return status

    @property
    def status(self) -> Any:
        status = ffi.new("dpm_master_status *")
        lib.dpm_master_get_status(self.master, status)
        return status

    @property
    def view(self) -> Any:
        view = ffi.new("dpm_ring_view *")
        lib.dpm_station_get_ring(lib.dpm_master_station(self.master), view)
        return view

    @property
    def las(self) -> set[int]:
        """The list of active stations."""
        las = bytes(self.view.las)
        return {n for n in range(128) if las[n // 8] >> n % 8 & 1}

    def events(self) -> Iterator[Any]:
        """Events since the last look."""
        lost = ffi.new("uint64_t *")
        while True:
            event = ffi.new("dpm_event *")
            if not lib.dpm_ring_take(self.ring, event, lost):
                return
            yield event


class Slaves:
    """A dpm_slaves machine with slaves and their images."""

    def __init__(self, rate: int = 500_000, *, parameters: Any = None, slaves: int = 126, allowance: int = 0,
                 granularity: int = 0) -> None:
        traits = ffi.new("dpm_port_traits *", {"allowance": allowance, "granularity": granularity})
        self._block = block(lib.dpm_slaves_size(slaves))
        out = ffi.new("dpm_slaves **")
        result = lib.dpm_slaves_init(self._block, lib.dpm_slaves_size(slaves), parameters or default_parameters(rate),
                                     traits, slaves, out)
        assert result == 0, result
        self.slaves = out[0]
        self.machine = lib.dpm_slaves_machine(self.slaves)
        self.images: list[tuple[Any, Any, Any, Any]] = []

    def add(self, address: int, ident: int, *configurations: bytes, user: tuple[int, int] = (0, 237),
            **fields: Any) -> int:
        config = ffi.new("dpm_slave_config *")
        config.address, config.ident_number = address, ident
        config.configurations = len(configurations)
        for i, octets_ in enumerate(configurations):
            config.configuration_length[i] = len(octets_)
            config.configuration[i][0 : len(octets_)] = octets_
        config.user_parameters_min, config.user_parameters_max = user
        config.max_diagnosis, config.min_tsdr = 244, 11
        config.sync_supported = config.freeze_supported = True
        for name, value in fields.items():
            setattr(config, name, value)
        blocks = block(lib.dpm_image_size()), block(lib.dpm_image_size())
        outputs, inputs = (lib.dpm_image_init(b, lib.dpm_image_size()) for b in blocks)
        index = int(lib.dpm_slaves_add(self.slaves, config, outputs, inputs))
        if index >= 0:
            self.images.append((outputs, inputs, *blocks))
        return index

    def outputs(self, index: int) -> Any:
        return lib.dpm_image_get(self.images[index][0])

    def put_inputs(self, index: int, data: bytes, now: int = 0) -> None:
        frame = ffi.new("dpm_frame *")
        frame.length, frame.valid, frame.time = len(data), True, now
        frame.octets[0 : len(data)] = data
        lib.dpm_image_put(self.images[index][1], frame)

    def report(self, index: int) -> Any:
        report = ffi.new("dpm_slave_state_report *")
        assert lib.dpm_slaves_get(self.slaves, index, report) == 0
        return report


class Wire:
    """Machines on one wire. `mangle(sent)` may change what the others hear: returns the octets delivered (None: as sent)."""

    def __init__(self, parameters: Any, *machines: Any) -> None:
        self.now = 0
        self.character = int(lib.dpm_bits_up(parameters, 11))
        self.machines = list(machines)
        self.log: list[Sent] = []
        self.mangle: Callable[[Sent], bytes | None] = lambda sent: None
        self.on_time: Callable[[int], int] = lambda now: NEVER  # an application that runs beside: returns its next time

    def step(self, until: int = NEVER) -> Sent | None:
        """Run to the next transmission (delivered when it returns) or to `until` (None)."""
        while True:
            after = self.on_time(self.now)
            offers = [Offer(machine, self.now) for machine in self.machines]
            due = [(o.not_before, i) for i, o in enumerate(offers) if o.octets and o.not_before <= self.now]
            if due:
                return self._transmit(min(due)[1], offers)
            later = min([o.not_before if o.octets else o.wake for o in offers] + [after, until])
            if later >= until:
                self.now = max(self.now, until)
                self._quiet()
                return None
            self.now = max(later, self.now + 1)
            self._quiet()

    def _quiet(self) -> None:
        for machine in self.machines:
            machine.quiet(machine, self.now)

    def _transmit(self, source: int, offers: list[Offer]) -> Sent:
        data = offers[source].octets
        sent = Sent(source, self.now, self.now + len(data) * self.character, data)
        machine = self.machines[source]
        machine.sent(machine, sent.start, sent.end, sent.end, lib.DPM_SENT_WHOLE)
        self.log.append(sent)
        changed = self.mangle(sent)
        heard = data if changed is None else changed
        self.now = sent.start + max(len(data), len(heard)) * self.character
        for i, other in enumerate(self.machines):
            if i != source and heard:
                feed(other, heard, self.now, self.character)
        return sent

    def run(self, until: int) -> list[Sent]:
        """Run to `until`; the transmissions on the way."""
        begin = len(self.log)
        while self.step(until):
            pass
        return self.log[begin:]

    def run_until(self, condition: Callable[[], bool], limit: int = 10 * S) -> None:
        """Run until `condition` holds, at most `limit` of virtual time."""
        end = self.now + limit
        while not condition():
            if self.now >= end or (self.step(end) is None and self.now >= end):
                tail = "\n".join(f"{s.start / 1000:12.1f} us  {s.source}: {s.hex}" for s in self.log[-20:])
                raise AssertionError(f"not reached in {limit / S} s of virtual time; the last telegrams:\n{tail}")


class Script:
    """One machine against a hand: `next()` lets it send, `answer()` is what comes back, `silence()` is nothing."""

    def __init__(self, owner: Master) -> None:
        self.owner = owner  # keeps the machine's memory
        self.machine = owner.machine
        self.parameters = owner.parameters
        self.now = 0
        self.character = int(lib.dpm_bits_up(self.parameters, 11))
        self.last: Sent | None = None

    def bits(self, n: float) -> int:
        """ns of `n` bit times, rounded up to whole bits' tenths."""
        return -(-int(lib.dpm_bits_up(self.parameters, round(n * 10))) // 10)

    def idle_bits(self, since: int) -> float:
        """Bit times from `since` to the start of the last telegram."""
        assert self.last
        return (self.last.start - since) / int(lib.dpm_bits_up(self.parameters, 1000)) * 1000

    def next(self, limit: int = 10 * S, tokens: bool = False) -> bytes:
        """The next telegram, sent whole; tokens to itself are passed over unless wanted. b"" when none comes."""
        end = self.now + limit
        while self.now < end:
            offer = Offer(self.machine, self.now)
            if offer.octets and offer.not_before <= self.now:
                sent = Sent(0, self.now, self.now + len(offer.octets) * self.character, offer.octets)
                self.machine.sent(self.machine, sent.start, sent.end, sent.end, lib.DPM_SENT_WHOLE)
                self.now, self.last = sent.end, sent
                if tokens or offer.octets[0] != 0xDC:
                    return offer.octets
                continue
            self.now = min(max(offer.not_before if offer.octets else offer.wake, self.now + 1), end)
            self.machine.quiet(self.machine, self.now)
        return b""

    def answer(self, data: bytes | str, tsdr: float = 11, errors: bytes | None = None) -> int:
        """Octets that begin `tsdr` bits after now; returns the end of the last one."""
        data = octets(data) if isinstance(data, str) else data
        self.now += self.bits(tsdr) + len(data) * self.character
        feed(self.machine, data, self.now, self.character, errors)
        return self.now

    def silence(self, duration: int) -> None:
        """Nothing comes for `duration` ns, and the machine is not let to send."""
        self.now += duration
        self.machine.quiet(self.machine, self.now)
