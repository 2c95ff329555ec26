# SPDX-License-Identifier: MIT
"""A wire with emulated slaves on virtual time: the test is the driver of the event contract and the master.

Telegrams are made here octet by octet, not by the library's encoder. Times are ns; nothing waits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from dpmaster._core import block, check, ffi, lib

TBIT = 2_000  # ns at 500 kbit/s
CHARACTER = 11 * TBIT
MIN_TSDR, MAX_TSDR = 11 * TBIT, 100 * TBIT  # the standard set for 500 kbit/s
MS = 1_000_000
NEVER: int = lib.DPM_NEVER
WAIT_PRM, WAIT_CFG, DATA_EXCH = lib.DPM_SL_WAIT_PRM, lib.DPM_SL_WAIT_CFG, lib.DPM_SL_DATA_EXCH
SET_SLAVE_ADD, RD_INP, RD_OUTP, GLOBAL_CONTROL, GET_CFG, SLAVE_DIAG, SET_PRM, CHK_CFG = 55, 56, 57, 58, 59, 60, 61, 62
SC = b"\xe5"
OUT, ZEROS = bytes(range(1, 7)), bytes(6)
POWER_UP = bytes.fromhex("02 05 00 FF 00 CA")  # page H.1 "power-up 02 05 00 FF id id"


def octets(text: str) -> bytes:
    """Octets from the protocol page's notation."""
    return bytes.fromhex(text)


def telegram(da: int, sa: int, fc: int, data: bytes = b"", dsap: int | None = None, ssap: int | None = 62) -> bytes:
    """SD1, or SD2 when there is anything after FC (protocol page B.1)."""
    body = bytes([da | (0x80 if dsap is not None else 0), sa | (0x80 if dsap is not None else 0), fc])
    if dsap is not None:
        assert ssap is not None
        body += bytes([dsap, ssap])
    body += data
    tail = bytes([sum(body) & 0xFF, 0x16])
    return b"\x10" + body + tail if len(body) == 3 else bytes([0x68, len(body), len(body), 0x68]) + body + tail


@dataclass(frozen=True)
class SlaveConfig:
    """What a test wants of a slave; the defaults are the SI-P1 in Basic data (6 octets each way)."""

    address: int = 8
    ident_number: int = 0x00CA
    configurations: tuple[bytes, ...] = (b"\x72",)
    user_parameters: tuple[int, int] = (0, 0)
    fail_safe: bool = False
    sync: bool = True
    freeze: bool = True
    max_diagnosis: int = 244
    min_tsdr: int = 11
    more: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of dpm_slave_config by name; what is disputed among them."""

    def c(self) -> Any:
        config = ffi.new("dpm_slave_config *")
        config.address = self.address
        config.ident_number = self.ident_number
        config.configurations = len(self.configurations)
        for i, configuration in enumerate(self.configurations[:16]):
            config.configuration_length[i] = len(configuration)
            ffi.memmove(config.configuration[i], configuration[:244], min(len(configuration), 244))
        config.user_parameters_min, config.user_parameters_max = self.user_parameters
        config.fail_safe, config.sync_supported, config.freeze_supported = self.fail_safe, self.sync, self.freeze
        config.max_diagnosis, config.min_tsdr = self.max_diagnosis, self.min_tsdr
        for name, value in self.more.items():
            setattr(config, name, value)
        return config


@dataclass(frozen=True)
class Offer:
    octets: bytes
    not_before: int
    not_after: int
    wake: int


@dataclass(frozen=True)
class Outputs:
    octets: bytes
    valid: bool
    number: int
    time: int


@dataclass
class Rig:
    """A machine with slaves; `time` is the end of the last octet that was on the wire."""

    configs: tuple[SlaveConfig, ...] = (SlaveConfig(),)
    allowance: int = 0
    granularity: int = 0
    changes: dict[str, int] = field(default_factory=dict)  # of the standard set of bus parameters
    time: int = 1_000 * MS

    def __post_init__(self) -> None:
        parameters = ffi.new("dpm_parameters *")
        check(lib.dpm_parameters_default(parameters, 500_000, 0))
        for name, value in self.changes.items():
            setattr(parameters, name, value)
        traits = ffi.new("dpm_port_traits *", {"allowance": self.allowance, "granularity": self.granularity})
        out = ffi.new("dpm_slaves **")
        size = lib.dpm_slaves_size(max(len(self.configs), 1))
        self._memory = [block(size)]
        check(lib.dpm_slaves_init(self._memory[0], size, parameters, traits, max(len(self.configs), 1), out))
        self.slaves = out[0]
        self.machine = lib.dpm_slaves_machine(self.slaves)
        self.images: list[tuple[Any, Any]] = []
        for config in self.configs:
            check(self.add(config))

    def add(self, config: SlaveConfig) -> int:
        images = []
        for _ in range(2):
            memory = block(lib.dpm_image_size())
            self._memory.append(memory)
            images.append(lib.dpm_image_init(memory, lib.dpm_image_size()))
        index: int = lib.dpm_slaves_add(self.slaves, config.c(), *images)
        if index >= 0:
            self.images.append((images[0], images[1]))
        return index

    # ---- the event contract, one call each ----

    def hear(self, data: bytes, end: int, doubt: int = 0, spacing: int = CHARACTER, echo: bool = False) -> None:
        """`data` arrived, its last octet ended within [end, end + doubt]."""
        first = end - (len(data) - 1) * spacing
        buffer = ffi.from_buffer(data)
        span = ffi.new("dpm_span *", {"octets": buffer, "errors": ffi.NULL, "n": len(data), "earliest": first,
                                      "latest": first + doubt, "spacing": spacing, "echo": echo})
        self.machine.octets(self.machine, span)
        self.time = max(self.time, end + doubt)

    def quiet(self, until: int) -> None:
        self.machine.quiet(self.machine, until)
        self.time = max(self.time, until)

    def ask(self, now: int) -> Offer:
        offer = ffi.new("dpm_offer *")
        self.machine.ask(self.machine, now, offer)
        data = bytes(ffi.buffer(offer.octets, offer.n)) if offer.n else b""
        return Offer(data, offer.not_before, offer.not_after, offer.wake)

    def sent(self, offer: Offer, start: int, result: int = lib.DPM_SENT_WHOLE) -> None:
        end = start + len(offer.octets) * CHARACTER
        self.machine.sent(self.machine, start, end, end, result)
        self.time = max(self.time, end)

    # ---- a well-behaved driver ----

    def exchange(self, request: bytes, after: int = MS) -> bytes:
        """Put `request` on the wire `after` ns from now; the answer, sent at its earliest time, or nothing."""
        self.hear(request, self.time + after)
        offer = self.ask(self.time)
        if not offer.octets:
            return b""
        assert offer.not_before <= offer.not_after
        assert self.ask(offer.not_before) == offer
        self.sent(offer, offer.not_before)
        assert self.ask(self.time).octets == b"", "an answer leaves once"
        return offer.octets

    # ---- the application's side ----

    def report(self, index: int = 0) -> Any:
        report = ffi.new("dpm_slave_state_report *")
        check(lib.dpm_slaves_get(self.slaves, index, report))
        return report

    def outputs(self, index: int = 0) -> Outputs:
        frame = lib.dpm_image_get(self.images[index][0])
        return Outputs(bytes(frame.octets[0 : frame.length]), frame.valid, frame.number, frame.time)

    def put_inputs(self, data: bytes, index: int = 0) -> None:
        frame = ffi.new("dpm_frame *", {"length": len(data), "valid": True, "octets": data})
        lib.dpm_image_put(self.images[index][1], frame)

    def diagnosis(self, data: bytes, announce: bool = False, ext: bool = False, static: bool = False, index: int = 0) -> None:
        check(lib.dpm_slaves_diagnosis(self.slaves, index, data, len(data), announce, ext, static))

    @property
    def progress(self) -> int:
        return int(self.machine.progress)


@dataclass
class Initiator:
    """A master's view of one slave: SRD high with the frame count bit, 6D, 5D, 7D, 5D, ... (protocol page C.2)."""

    rig: Rig
    slave: int = 8
    address: int = 2
    function: int = 0x0D
    fcb: bool | None = None

    def fc(self) -> int:
        """FC of the next new request."""
        first, self.fcb = self.fcb is None, not self.fcb if self.fcb is not None else True
        return 0x40 | self.function | (0x20 if self.fcb else 0) | (0 if first else 0x10)

    def srd(self, sap: int | None = None, data: bytes = b"", after: int = MS) -> bytes:
        return self.rig.exchange(telegram(self.slave, self.address, self.fc(), data, sap), after)

    def answer(self, sap: int | None = None, data: bytes = b"", after: int = MS) -> bytes:
        """The data of an answer FC 08, its addresses and SAPs checked."""
        got = self.srd(sap, data, after)
        length = len(got) - (11 if sap is not None else 9)
        want = telegram(self.address, self.slave, 0x08, got[-2 - length : -2], 62 if sap is not None else None, sap)
        assert got == want
        return got[-2 - length : -2]

    def rs(self) -> bytes:
        return telegram(self.address, self.slave, 0x03)

    def data(self, data: bytes, fc: int = 0x08) -> bytes:
        """The answer to a Data_Exchange."""
        return telegram(self.address, self.slave, fc, data)

    def prm(self, status: int = 0x80, watchdog: tuple[int, int] = (1, 1), min_tsdr: int = 0, ident: int = 0x00CA,
            group: int = 0, user: bytes = b"") -> bytes:
        return self.srd(SET_PRM, bytes([status, *watchdog, min_tsdr]) + ident.to_bytes(2, "big") + bytes([group]) + user)

    def diag(self) -> bytes:
        return self.answer(SLAVE_DIAG)

    def start(self, status: int = 0x80, watchdog: tuple[int, int] = (1, 1), group: int = 0, user: bytes = b"",
              configuration: bytes = b"\x72") -> None:
        """Into Data_Exchange."""
        assert self.prm(status, watchdog, group=group, user=user) == SC
        assert self.srd(CHK_CFG, configuration) == SC

    def control(self, command: int, group: int = 0, da: int = 127) -> None:
        assert self.rig.exchange(telegram(da, self.address, 0x46, bytes([command, group]), GLOBAL_CONTROL)) == b""


@pytest.fixture
def rig() -> Rig:
    """The SI-P1's slave, switched on."""
    return Rig()


@pytest.fixture
def master(rig: Rig) -> Initiator:
    """A master that has not talked to it yet."""
    return Initiator(rig)


def running(more: Mapping[str, Any] | None = None, **config: Any) -> tuple[Rig, Initiator]:
    """A slave in Data_Exchange with a master that is in step with it."""
    rig = Rig((SlaveConfig(**config, more=more or {}),))
    master = Initiator(rig)
    master.start(configuration=rig.configs[0].configurations[0])
    return rig, master
