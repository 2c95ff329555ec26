# SPDX-License-Identifier: MIT
"""A YaskawaV7 and an emulated SI-P1 with the whole bus between them, on virtual time: every octet is in `bus.log`.

Both C cores - master and slave - run against each other on a `Wire`; the card lives beside it as it does in a segment. What
`Station` does on a port, `WireV7` does by running the wire.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

from wire import NEVER, Master, Slaves, Wire, default_parameters, ffi, lib

from dpmaster.drives import YaskawaV7
from dpmaster.emulator.card import Exchange, SlaveState
from dpmaster.emulator.cards import SIP1
from dpmaster.errors import DPTimeout, OutputsDiscarded
from dpmaster.profiles.yaskawa_v7 import MAX_TSDR
from dpmaster.station import Frame

NS = 1_000_000_000
MASTER, SLAVE = 1, 5


class Pair(NamedTuple):
    """A Data_Exchange telegram and its answer, whole."""

    request: bytes
    answer: bytes


class WireV7(YaskawaV7):
    """The drive class in Operate on a wire of its own; the card's CPU has come up."""

    def __init__(self, configuration: str = "Extended Data 1", rate: int = 1_500_000) -> None:
        super().__init__(SLAVE, configuration)
        self.card = SIP1(SLAVE)
        parameters = default_parameters(rate, MAX_TSDR[rate])
        self.bus_master = Master(address=MASTER, parameters=parameters)
        self.bus_master.add(SLAVE, self.ident_number, self.configuration, watchdog=(10, 1),
                            min_slave_interval=self.min_slave_interval)
        self.slaves = Slaves(parameters=parameters, slaves=1)
        self.slaves.add(SLAVE, self.card.ident_number, *self.card.configurations, user=self.card.user_parameters,
                        max_diagnosis=self.card.max_diagnosis)
        self.bus = Wire(parameters, self.bus_master.machine, self.slaves.machine)
        self.bus.on_time = self._live
        self._seen = Exchange()
        self._next = 0
        self._octets: bytes | None = None
        self.bus_master.mode(lib.DPM_MODE_CLEAR)
        self.bus.run_until(lambda: self.bus_master.slave(0).state == lib.DPM_ST_DATA)
        self.bus_master.mode(lib.DPM_MODE_OPERATE, self.bus.now)
        self.let_pass(0.2)

    def _live(self, now: int) -> int:
        """The card's application, as its host runs it: on news, and when it wants to."""
        report, frame = self.slaves.report(0), self.slaves.outputs(0)
        exchange = Exchange(SlaveState(report.state), bytes(ffi.buffer(frame.octets, frame.length)), bool(frame.valid),
                            frame.number, report.configuration, report.master if report.master >= 0 else None)
        if exchange != self._seen or now >= self._next:
            self._seen = exchange
            octets = self.card.step(now / NS, exchange)
            self._next = round(self.card.next_step(now / NS) * NS)
            if octets != self._octets:
                self.slaves.put_inputs(0, octets, now)
                self._octets = octets
        return min(self._next, NEVER)

    def let_pass(self, seconds: float) -> None:
        self.bus.run(self.bus.now + round(seconds * NS))

    def exchanges(self, begin: int = 0) -> list[Pair]:
        """Data_Exchange from entry `begin` of the log on: requests to the drive without SAPs, and what followed each."""
        log = self.bus.log[begin:]
        return [Pair(sent.octets, answer.octets) for sent, answer in pairwise(log)
                if sent.source == 0 and sent.octets[0] == 0x68 and sent.octets[4] == SLAVE and answer.source == 1]

    # what Station offers

    @property
    def frame(self) -> Frame:
        frame = self.bus_master.inputs(0)
        octets = bytes(ffi.buffer(frame.octets, frame.length)).ljust(self.input_length, b"\0")
        return Frame(octets, frame.number, frame.cycle, frame.time / NS, bool(frame.valid))

    @property
    def outputs(self) -> bytes:
        octets = ffi.new("uint8_t[]", self.output_length)
        lib.dpm_outputs_peek(self.bus_master.images[0][0], octets)
        return bytes(octets)

    def update(self, offset: int, octets: bytes, keep: bytes = b"") -> int:  # type: ignore[override]
        number = self.bus_master.commit(0, bytes(octets), self.bus.now, offset, keep)
        assert number > 0, number
        return number

    def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
        self._run_until(lambda: bool(self.bus_master.was_sent(0, number)), timeout)
        if self.bus_master.was_sent(0, number) < 0:
            raise OutputsDiscarded("discarded", number=number)

    def wait(self, predicate: Callable[[Frame], bool], timeout: float | None) -> Frame:
        seen = -1

        def ready() -> bool:
            nonlocal seen
            frame = self.frame
            if frame.number == seen:
                return False
            seen = frame.number
            return frame.valid and predicate(frame)

        self._run_until(ready, timeout)
        return self.frame

    def _run_until(self, condition: Callable[[], bool], timeout: float | None) -> None:
        until = self.bus.now + round((timeout or 0.0) * NS)
        while not condition():
            if self.bus.step(until) is None:
                raise DPTimeout("did not come")
