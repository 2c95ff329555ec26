# SPDX-License-Identifier: MIT
"""Where emulated cards live: their slaves in a machine of the C library, their applications on one thread.

`Segment` and `Line` are hosts; they differ in whose wire the slaves are on. The thread sleeps in C until a slave's state or
outputs changed or a card's `next_step` has come. It steps the cards, reads their outputs and writes their inputs; a card
that asks for a step at once (`Slave.refresh`) gets it in the thread that asks, under the same lock. With `segment.py` and
`line.py` this is the emulator's only contact with the binding.
"""

from __future__ import annotations

import logging
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, TypeVar

from dpmaster import _arguments
from dpmaster._core import NS, Process, block, check, error, ffi, lib
from dpmaster.emulator.card import BaudState, Card, Exchange, Habits, SlaveState
from dpmaster.errors import ClosedError, ConfigurationError, DPError

__all__ = ["Host", "SlaveReport", "bus_parameters"]

log = logging.getLogger("dpmaster.emulator")

CardT = TypeVar("CardT", bound=Card)

# Habits as fields of dpm_slave_config: a word's place among the field's words is its number.
HABITS = {
    "wrong_length": "wrong_length_ue", "set_prm": "prm_keeps_exchange", "other_master": "foreign_sc", "announce": "announce",
    "global_control": "control_feeds", "cfg_fault": "cfg_fault_keeps_master", "open_set_prm": "prm_open_takes_user",
}

IDLE = 0.1  # s, longest sleep of the application thread: a card attached meanwhile waits no longer for its first timer
JOIN = 2.0  # s that close() waits for a card's step to return


@dataclass(frozen=True, slots=True)
class SlaveReport:
    """A slave as its DP side is now (`dpm_slave_state_report`); times in seconds."""

    address: int
    state: SlaveState
    master: int | None
    configuration: int
    clear: bool
    operate_seen: bool
    watchdog: float | None
    watchdog_expired: int
    user_parameters: bytes
    group: int
    requests: int
    answers: int
    repetitions: int
    late_dropped: int
    exchanges: int
    too_soon: int
    """Requests that broke `Card.min_slave_interval`."""
    address_locked: bool
    baud_state: BaudState


@dataclass(slots=True, eq=False)
class Slot:
    """A card, its slave and the images between them."""

    card: Card
    exchange: Exchange
    memory: tuple[Any, Any]
    outputs: Any
    inputs: Any
    index: int = -1
    octets: bytes | None = None
    next: float = 0.0
    failed: bool = False
    stepping: bool = False
    report: Any = field(default_factory=lambda: ffi.new("dpm_slave_state_report *"))
    frame: Any = field(default_factory=lambda: ffi.new("dpm_frame *"))

    def step(self, now: float) -> None:
        """Let the card live until `now` and hand its octets over if they are new."""
        self.stepping = True
        try:
            octets = bytes(self.card.step(now, self.exchange))
        finally:
            self.stepping = False
        if len(octets) > lib.DPM_IO_MAX:
            raise ConfigurationError(f"{describe(self.card)} gave {len(octets)} input octets: at most {lib.DPM_IO_MAX} fit")
        self.next = self.card.next_step(now)
        if octets != self.octets:
            self.octets = octets
            self.frame.length = len(octets)
            ffi.memmove(self.frame.octets, octets, len(octets))
            lib.dpm_image_put(self.inputs, self.frame)

    def look(self) -> Exchange:
        """The exchange as report and outputs show it."""
        frame = lib.dpm_image_get(self.outputs)
        report = self.report
        return Exchange(
            state=SlaveState(report.state), outputs=bytes(ffi.buffer(frame.octets, frame.length)), valid=bool(frame.valid),
            number=frame.number, configuration=report.configuration, master=None if report.master < 0 else report.master,
            watchdog_expired=report.watchdog_expired, address=report.address, baudrate=self.exchange.baudrate,
        )

    def store(self) -> None:
        """What Set_Slave_Add has changed goes into the card's EEPROM."""
        card, report = self.card, self.report
        if (card.address, card.address_locked) != (report.address, report.address_locked):
            log.info("%s has address %d now%s", describe(card), report.address, ", locked" if report.address_locked else "")
        card.address, card.address_locked = report.address, bool(report.address_locked)
        if report.remote_length:
            card.remote_data = bytes(report.remote[0 : report.remote_length])


@dataclass(frozen=True, slots=True)
class Handle:
    """The `Slave` that a card is given."""

    host: Host
    slot: Slot

    def refresh(self) -> None:
        self.host._refresh(self.slot)

    def diagnose(self, octets: bytes, *, announce: bool, ext_diag: bool, static_diag: bool) -> None:
        if not self.host._closed:
            self.host.set_diagnosis(self.slot.card, octets, announce=announce, ext_diag=ext_diag, static_diag=static_diag)

    def set_ready(self, ready: bool) -> None:
        if not self.host._closed:
            self.host.set_ready(self.slot.card, ready)


def describe(card: Card) -> str:
    return f"{type(card).__name__} at address {card.address}"


def bus_parameters(baudrate: int) -> Any:
    """The standard's parameters for a nominal rate (bit/s), or a ConfigurationError that names the rates there are."""
    parameters = ffi.new("dpm_parameters *")
    if not isinstance(baudrate, int) or not 0 < baudrate < 1 << 32 or lib.dpm_parameters_default(parameters, baudrate, 0) < 0:
        rates: list[str] = []
        while rate := lib.dpm_parameters_rate(len(rates)):
            rates.append(str(rate))
        raise ConfigurationError(f"baudrate {baudrate!r}: PROFIBUS has {', '.join(rates)} bit/s")
    return parameters


def identity(card: Card) -> bytes:
    """The answer to Ident: four lengths, then the texts."""
    if card.identity is None:
        return b""
    texts = [text.encode("latin-1", "replace") for text in card.identity]
    if len(texts) != 4 or sum(map(len, texts)) > lib.DPM_SLAVE_IDENTITY - 4:
        raise ConfigurationError(f"{describe(card)}: identity {card.identity!r}: four texts, at most "
                                 f"{lib.DPM_SLAVE_IDENTITY - 4} characters together")
    return bytes(map(len, texts)) + b"".join(texts)


def slave_config(card: Card) -> Any:
    """The slave that a card describes."""
    if not isinstance(card, Card):
        raise ConfigurationError(f"card {card!r}: give a Card, like SIP1(address=5)")
    what = describe(card)
    if not 0 <= card.address <= 126:
        raise ConfigurationError(f"{what}: a slave's address is 0 to 126")
    if not 1 <= len(card.configurations) <= lib.DPM_SLAVE_CONFIGURATIONS:
        most = lib.DPM_SLAVE_CONFIGURATIONS
        raise ConfigurationError(f"{what} has {len(card.configurations)} configurations: 1 to {most} fit")
    config = ffi.new("dpm_slave_config *")
    config.address, config.ident_number = card.address, card.ident_number
    config.configurations = len(card.configurations)
    for index, octets in enumerate(card.configurations):
        if not 1 <= len(octets) <= lib.DPM_IO_MAX:
            raise ConfigurationError(f"{what}: configuration {index} has {len(octets)} octets, 1 to {lib.DPM_IO_MAX} fit")
        config.configuration_length[index] = len(octets)
        ffi.memmove(config.configuration[index], octets, len(octets))
    config.user_parameters_min, config.user_parameters_max = card.user_parameters
    config.fail_safe, config.sync_supported, config.freeze_supported = card.fail_safe, card.sync, card.freeze
    config.max_diagnosis, config.min_tsdr = card.max_diagnosis, 11
    interval = _arguments.whole(f"{what}: min_slave_interval", card.min_slave_interval, 0, 65535, " (of 100 us)")
    config.min_slave_interval = interval
    config.set_address, config.address_locked = card.set_address, card.address_locked
    if not _arguments.number(card.baud_control) or not 0 <= round(card.baud_control * 100) <= 255:
        raise ConfigurationError(f"{what}: baud_control {card.baud_control!r} s: 0 to 2.55")
    config.auto_baud, config.baud_control = card.auto_baud, round(card.baud_control * 100)
    who = identity(card)
    config.identity_length, config.identity = len(who), who
    for name, field_name in HABITS.items():
        setattr(config, field_name, Habits.WORDS[name].index(getattr(card.habits, name)))
    return config


def _finish(host: weakref.ref[Host], process: Process, close: Callable[[Any], object], opened: Any, kept: list[Any]) -> None:
    """The end of a host that was not closed: at the program's end, or when nobody has it any more. `kept` is the memory that
    the library's thread uses: an argument outlives it, in whatever order a cycle is collected."""
    found = host()
    if found is not None:
        found.close()
    elif process.here and opened[0]:
        close(opened[0])


class Host(ABC):
    """Cards and the thread of their applications. A sub-class opens what the slaves answer on and closes it.

    Who has one of its cards, or a segment's port, has the host; one that nobody has any more is closed.
    """

    _rate: int  # bit/s of the wire
    _room: str  # the library's room whose functions carry this host: "dpm_segment" or "dpm_bus"

    def __init__(self) -> None:
        self._process = Process()
        self._lock = threading.RLock()  # held while a card steps: attach, reset and steps take turns
        self._slots: list[Slot] = []
        self._failures: list[BaseException] = []
        self._closed = False  # or about to be
        self._ended = False
        self._thread: threading.Thread | None = None
        self._kept: list[Any] = []
        # Where the library's open call puts its object. It has its finaliser first: a Ctrl-C is raised behind that call.
        self._opened = ffi.new(f"{self._room} **")
        self._finish = weakref.finalize(self, _finish, weakref.ref(self), self._process, getattr(lib, f"{self._room}_close"),
                                        self._opened, self._kept)

    @property
    def _object(self) -> Any:
        return self._opened[0]

    def _keep(self, size: int) -> Any:
        """A block that lives as long as the library's thread at least."""
        self._kept.append(block(size))
        return self._kept[-1]

    # --- what a sub-class does

    @abstractmethod
    def _add(self, config: Any, outputs: Any, inputs: Any) -> int:
        """Give a slave to the machine: its index or an error code."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the library's object, which is there: idempotent, bounded, wakes its waiters."""

    def _call(self, name: str, *arguments: Any) -> int:
        code: int = getattr(lib, f"{self._room}_{name}")(self._object, *arguments)
        return code

    def _guard(self) -> None:
        self._process.guard(f"this {type(self).__name__}")
        if self._closed:
            raise ClosedError(f"this {type(self).__name__} was closed: open a new one")

    # --- cards

    def _attach(self, card: CardT) -> CardT:
        self._guard()
        config = slave_config(card)
        size = lib.dpm_image_size()
        memory = self._keep(size), self._keep(size)
        slot = Slot(card, Exchange(baudrate=self._rate), memory, *(lib.dpm_image_init(at, size) for at in memory))
        with self._lock:
            if any(other.card.address == card.address for other in self._slots):
                raise ConfigurationError(f"{describe(card)}: the address is taken here; choose another")
            slot.step(time.monotonic())  # octets are there before the first request is
            slot.index = check(self._add(config, slot.outputs, slot.inputs), f"attach {describe(card)}")
            self._slots.append(slot)
            if self._thread is not None:
                card.attached(Handle(self, slot))
        return card

    def _refresh(self, slot: Slot) -> None:
        if self._closed:
            return
        self._guard()
        with self._lock:
            if not slot.stepping:  # else the card's own step changed it, and its octets are about to be taken
                slot.next = 0.0
                self._live(slot, False)

    def _slot(self, card: Card) -> Slot:
        self._guard()
        for slot in self._slots:
            if slot.card is card:
                return slot
        raise ConfigurationError(f"{describe(card)} is not attached to this {type(self).__name__}")

    def unplug(self, card: Card) -> None:
        """Pull the bus connector: nothing is answered any more; the card stays powered and its watchdog runs."""
        check(self._call("slave_connect", self._slot(card).index, False), f"unplug {describe(card)}")

    def plug(self, card: Card) -> None:
        """Plug the bus connector in again."""
        slot = self._slot(card)
        if slot.failed:
            raise DPError(f"{describe(card)} has failed and stays unplugged; close() tells why")
        check(self._call("slave_connect", slot.index, True), f"plug in {describe(card)}")

    def reset(self, card: Card) -> None:
        """Cycle the card's power."""
        slot = self._slot(card)
        with self._lock:
            check(self._call("slave_reset", slot.index), f"reset {describe(card)}")
            card.reset(time.monotonic())
            if card.address != self.report(card).address:  # a switch or a parameter that is read at power-up
                check(self._call("slave_set_address", slot.index, card.address, card.address_locked),
                      f"{describe(card)}: address")
            slot.next = 0.0

    def set_address(self, card: Card, address: int, *, locked: bool = False) -> None:
        """Give the card another address (0 to 126), as its switches do or a reset to 126; it starts as after power on."""
        slot = self._slot(card)
        number = _arguments.whole(f"{describe(card)}: address", address, 0, 126)
        with self._lock:
            check(self._call("slave_set_address", slot.index, number, bool(locked)), f"{describe(card)}: address {address}")
            card.address, card.address_locked = number, bool(locked)
            card.reset(time.monotonic())
            slot.next = 0.0

    def set_diagnosis(self, card: Card, octets: bytes, *, announce: bool = True, ext_diag: bool = False,
                      static_diag: bool = False) -> None:
        """Diagnosis behind the six standard octets; `announce` makes the master fetch it."""
        octets = octets[:255]  # more than any slave has room for; what does not fit is overflow, whatever its length
        check(self._call("slave_diagnosis", self._slot(card).index, octets, len(octets), announce, ext_diag, static_diag),
              f"diagnosis of {describe(card)}", octets=len(octets))

    def set_ready(self, card: Card, ready: bool) -> None:
        """While not ready the slave says Station_Not_Ready."""
        check(self._call("slave_ready", self._slot(card).index, ready), f"{describe(card)}")

    def report(self, card: Card) -> SlaveReport:
        """The DP side of a card, now."""
        report = ffi.new("dpm_slave_state_report *")
        check(self._call("slave_get", self._slot(card).index, report), f"report of {describe(card)}")
        return SlaveReport(
            address=report.address, state=SlaveState(report.state), master=None if report.master < 0 else report.master,
            configuration=report.configuration, clear=report.clear, operate_seen=report.operate_seen,
            watchdog=report.watchdog / NS if report.watchdog_on else None, watchdog_expired=report.watchdog_expired,
            user_parameters=bytes(report.user_parameters[0 : report.user_parameters_length]), group=report.group,
            requests=report.requests, answers=report.answers, repetitions=report.repetitions,
            late_dropped=report.late_dropped, exchanges=report.exchanges, too_soon=report.too_soon,
            address_locked=bool(report.address_locked), baud_state=BaudState(report.baud_state),
        )

    @property
    def failures(self) -> tuple[BaseException, ...]:
        """What cards have raised; each such card is unplugged."""
        return tuple(self._failures)

    def _raise_failure(self) -> None:
        if self._failures:
            first = self._failures[0]
            raise DPError(f"{len(self._failures)} card(s) failed and were unplugged; the first: {first!r}") from first

    def check(self) -> None:
        """Raise what has gone wrong since the host was opened: DPError when a card failed."""
        self._guard()
        self._raise_failure()

    # --- the application thread

    def _begin(self) -> None:
        """Start the applications; the library's object is there."""
        # Not a thread that the interpreter waits for: those are joined before the finalisers run, which tell this one to end.
        self._thread = threading.Thread(target=_run, args=(weakref.ref(self), self._room, self._opened, self._kept),
                                        name="dpmaster-cards", daemon=True)
        for slot in self._slots:
            slot.card.attached(Handle(self, slot))
        self._thread.start()

    def _live_all(self, changed: bool) -> float:
        """Let each card live that wants to; returns when the first wants to again."""
        until = time.monotonic() + IDLE
        for slot in list(self._slots):
            until = min(until, self._live(slot, changed))
        return until

    def _live(self, slot: Slot, changed: bool) -> float:
        """Step one card if it is due or its exchange changed; returns when it wants to live again."""
        with self._lock:
            try:
                exchange = slot.exchange
                if changed and not slot.failed and self._call("slave_get", slot.index, slot.report) == 0:
                    exchange = slot.look()
                    slot.store()
                now = time.monotonic()
                if not slot.failed and (exchange != slot.exchange or now >= slot.next):
                    slot.exchange = exchange
                    slot.step(now)
            except Exception as failure:  # a card is anybody's code; the other cards go on
                self._fail(slot, failure)
            return float("inf") if slot.failed else slot.next

    def _fail(self, slot: Slot, failure: Exception) -> None:
        log.exception("%s failed and is unplugged", describe(slot.card))
        slot.failed = True
        self._call("slave_connect", slot.index, False)
        self._failures.append(failure)  # last: who sees it finds the slave unplugged

    # --- life

    def close(self) -> None:
        """End the applications and the bus side; idempotent. Raises DPError when a card failed while it was open."""
        if self._ended or not self._process.here:
            return
        self._end()
        self._ended = True
        for slot in self._slots:
            slot.card.detached()
        self._raise_failure()

    def _end(self) -> None:
        """As far as it has come: Ctrl-C may end the opening behind any call, and this, which is then done again."""
        self._closed = True
        if self._object:
            self._shut()
        if self._thread is not None and self._thread.ident and self._thread is not threading.current_thread():
            self._thread.join(JOIN)
            if self._thread.is_alive():
                log.error("a card's step does not return; its thread is left behind")
        self._finish.detach()

    def __enter__(self) -> Self:
        self._guard()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self.close()
        except DPError:
            if value is None:
                raise
            # The block's own exception tells more; the card's was logged when it happened.


def _run(host: weakref.ref[Host], room: str, opened: Any, kept: list[Any]) -> None:
    """The application thread. It has its host only while it steps the cards, and the memory (`kept`) as long as it waits."""
    progress, wait = getattr(lib, f"{room}_progress"), getattr(lib, f"{room}_wait")
    seen, code = None, int(lib.DPM_OK)
    while (found := host()) is not None and not found._closed:
        if code not in (lib.DPM_OK, lib.DPM_E_TIMEOUT, lib.DPM_E_INTERRUPTED):
            found._failures.append(error(code, f"the cards of this {type(found).__name__} stopped"))
            break
        count = progress(opened[0])  # before the look: what changes from here on ends the wait at once
        until = found._live_all(count != seen)
        seen = count
        del found
        code = wait(opened[0], seen, max(1, int((until - time.monotonic()) * NS)))
