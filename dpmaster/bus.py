# SPDX-License-Identifier: MIT
"""One port with its bus thread: opened, started on a master, waited on, fed, closed.

The only owner of the library's ``dpm_bus`` and ``dpm_master`` and of their memory. It knows no station by name: `Master`
decides what happens on the bus, this file sees that it happens in the process that opened the port, on objects that are
still there.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from dpmaster import _arguments, _core, _errand
from dpmaster._core import NS, ffi, lib
from dpmaster._names import Named
from dpmaster.errors import ClosedError, ConfigurationError, PortError
from dpmaster.realtime import Scheduling, Wish, lock, schedule, wished

if TYPE_CHECKING:
    from dpmaster.events import Events

__all__ = ["Bus", "FdlState", "Feed", "Mode", "PortStatistics"]

T = TypeVar("T")


class Mode(Named):
    """The master's mode, with the codes of EN 50170 part 8 (``enum dpm_mode``)."""

    OFFLINE = 0x00  # nothing is sent
    STOP = 0x40  # token only; requests of the program work
    CLEAR = 0x80  # stations exchange, their outputs are zeros (or empty for a fail-safe one)
    OPERATE = 0xC0


class FdlState(Named):
    """The FDL station's state (``enum dpm_fdl_state``)."""

    OFFLINE = 0
    PASSIVE_IDLE = 1
    LISTEN_TOKEN = 2
    ACTIVE_IDLE = 3
    CLAIM_TOKEN = 4
    USE_TOKEN = 5
    AWAIT_DATA_RESPONSE = 6
    PASS_TOKEN = 7
    CHECK_TOKEN_PASS = 8
    AWAIT_STATUS_RESPONSE = 9


class Feed(Named):
    """What fed the output watchdog (``enum dpm_feed``)."""

    OPERATE = 0
    COMMIT = 1
    WAIT = 2
    PROGRAM = 3

    @property
    def text(self) -> str:
        return ("operate()", "a commit of outputs", "a wait in the thread of the last commit", "master.feed()")[self]


@dataclass(frozen=True, slots=True)
class PortStatistics:
    """The port and its thread, and how that is scheduled; ``allowance`` and ``cpu_time`` in s."""

    profile: str
    allowance: float
    rate: int
    """bit/s, as far as it is known what the driver makes."""
    parity: bool
    rs485: bool
    """The driver switches the direction."""
    drains: bool
    """The driver tells when a transmission has ended; else that is computed."""
    low_latency: bool
    fifo_trigger: int | None
    """Octets in the receive FIFO that raise an interrupt; None: the driver does not say."""
    driver: Mapping[str, int] | None
    """The driver's own counters of errors since the port was opened; None: it has none."""
    octets_in: int
    octets_out: int
    echo_octets: int
    echo_errors: int
    line_errors: int
    cpu_time: float
    wakeups: int
    scheduling: Scheduling


_PROFILES = {None: "AUTO", "uart": "UART", "usb": "USB", "pty": "PTY"}
_DIRECTIONS = {None: "AUTO", "rs485": "RS485", "rs485-inverted": "RS485_INVERTED"}
# What Python knows beyond the library's text of the same code.
_REMEDIES = {
    "NO_PORT": "/dev/serial/by-id lists those that are, and 'dpmaster bridge URL' makes one of a converter on the network",
    "PERMISSION": "then log in again",
    "IN_USE": "'fuser -v {path}' names it",
    "NOT_TTY": "give that of one, or a segment's port()",
    "RATE": "'dpmaster doctor {path}' tells which it makes",
    "RS485": "leave direction= out",
    "GONE": "plug it in, or start its segment again: the exchange resumes by itself, with safe outputs; or open a new one",
}


def port_error(path: str, code: int, **context: object) -> PortError:
    """Path, reason, the values concerned, remedy."""
    base = _core.error(code, "", **context)
    remedy = next((text for name, text in _REMEDIES.items() if getattr(lib, f"DPM_E_{name}") == code), "").format(path=path)
    return PortError(f"port {path}: {base}" + (f"; {remedy}" if remedy else ""), path=path, dpm_code=code,
                     errno=base.errno if isinstance(base, PortError) else None)


def direction_code(direction: str | None) -> int:
    """``enum dpm_direction`` of a name, or ConfigurationError with the reason."""
    if direction not in _DIRECTIONS:
        raise ConfigurationError(
            f"direction {direction!r}: 'rs485' or 'rs485-inverted', where the driver switches, or None, where hat or adapter "
            "does. A pin that a program switches (RTS, a GPIO) is not offered: slaves answer 11 bit times after a request, "
            "which is 22 us at 500 kbit/s, and a program wakes 50 us to some ms after its last stop bit, so it would talk "
            "over the answer")
    return int(getattr(lib, f"DPM_DIRECTION_{_DIRECTIONS[direction]}"))


def allowance_ns(allowance: float | None) -> int:
    """``dpm_port_config.allowance`` of s, None: the profile's; or ConfigurationError."""
    if allowance is not None and allowance != 0:
        _arguments.seconds("allowance", allowance, 1, ", 0, or None for the profile's own")
    return -1 if allowance is None else round(allowance * NS)


def _counters(port: Any) -> Mapping[str, int]:
    return {name: getattr(port.driver, name) for name, _ in ffi.typeof("dpm_driver_counters").fields}


def _shut(process: _core.Process, opened: Any, events: list[Events], kept: dict[int, Any]) -> None:
    """The end of a bus, by close() or by the collector. "After fork ... no finaliser touches the bus".

    `kept` is the memory that the thread uses: an argument outlives the thread, in whatever order a cycle is collected.
    """
    if process.here and opened[0]:
        try:
            lib.dpm_bus_close(opened[0])
        finally:
            for each in events:
                each.end()


class Bus:
    """A port, opened at once; the thread begins with `start`. All methods are safe from any thread."""

    def __init__(self, port: str, rate: tuple[int, int], *, echo: bool | None, profile: str | None,
                 allowance: float | None, realtime: Wish = False, direction: str | None = None) -> None:
        if profile not in _PROFILES:
            raise ConfigurationError(f"profile {profile!r}: 'uart', 'usb', 'pty', or None to go by the path")
        if echo not in (None, False, True):
            raise ConfigurationError(f"echo {echo!r}: True, False, or None to find it out")
        late = allowance_ns(allowance)
        self.scheduling = Scheduling()
        self._realtime = wished(realtime)
        self.path = _arguments.path(port)
        self.process = _core.Process()
        self.closed = False
        self.master: Any = None
        self.fed_thread: object = None  # the thread of the last commit: only its waits feed the output watchdog
        self._events: list[Events] = []
        self._kept: dict[int, Any] = {}
        self._starting = threading.RLock()
        self._ordering = threading.RLock()
        self._leaving = False
        opened = ffi.new("dpm_bus **")  # has its finaliser first: a Ctrl-C while the port is opened is raised behind that call
        self._finish = weakref.finalize(self, _shut, self.process, opened, self._events, self._kept)
        self._finish.atexit = False  # a Master that still lives says its stop words first
        self._open(opened, port, rate, echo, profile, late, direction_code(direction))
        self._handle = opened[0]

    def _open(self, opened: Any, port: str, rate: tuple[int, int], echo: bool | None, profile: str | None,
              allowance: int, direction: int) -> None:
        path = ffi.new("char[]", os.fsencode(self.path))
        config = ffi.new("dpm_port_config *")
        config.path = path
        config.rate_num, config.rate_den = rate
        config.profile = getattr(lib, f"DPM_PROFILE_{_PROFILES[profile]}")
        config.echo = {None: lib.DPM_ECHO_AUTO, False: lib.DPM_ECHO_OFF, True: lib.DPM_ECHO_ON}[echo]
        # A segment's port knows whether its hub paces; of any other pty nobody can tell.
        paced: bool | None = getattr(port, "paced", None)
        config.pace = {None: lib.DPM_PACE_AUTO, False: lib.DPM_PACE_NONE, True: lib.DPM_PACE_BAUD}[paced]
        config.direction = direction
        config.allowance = allowance
        memory = self._keep(lib.dpm_bus_size())
        code = lib.dpm_bus_open(memory, len(memory), config, opened)
        if code < 0:
            rated = {"baudrate": f"{rate[0] / rate[1]:.0f}"} if code == lib.DPM_E_RATE else {}
            raise port_error(self.path, code, **rated)

    def _keep(self, size: int) -> Any:
        """A block that lives as long as the thread at least."""
        memory = _core.block(size)
        self._kept[id(memory)] = memory
        return memory

    def guard(self) -> None:
        """Raise ClosedError in a forked child, or after close."""
        self.process.guard(f"the master on {self.path}")
        if self.closed:
            raise ClosedError(f"the master on {self.path} was closed: open a new one", dpm_code=lib.DPM_E_CLOSED)

    def start(self, config: Any, slaves: int) -> None:
        """Build the master in a block of its own and start the thread on it. Once."""
        memory = self._keep(lib.dpm_master_size(slaves))
        handle = ffi.new("dpm_master **")
        lib.dpm_bus_get_traits(self._handle, ffi.addressof(config.station, "traits"))
        _core.check(lib.dpm_master_init(memory, len(memory), config, handle), "set up the master")
        self._call(lib.dpm_bus_start(self._handle, lib.dpm_master_machine(handle[0]), handle[0]), "start the bus thread")
        self.scheduling = schedule(self._realtime, self._profile() != "pty", partial(lib.dpm_bus_realtime, self._handle),
                                   list(self._kept.values()), f"the bus thread on {self.path}")
        with self._starting:
            self.master = handle[0]
            for each in self._events:
                self._subscribe(each)

    @property
    def allowance(self) -> float:
        """What the host may wake late, s."""
        return float(self._traits().allowance / NS)

    @property
    def late(self) -> float:
        """What an answer may come late, s: the host's allowance, and what a paced pty takes to hand over a telegram."""
        traits = self._traits()
        return float((traits.allowance + traits.delivery) / NS)

    def _traits(self) -> Any:
        traits = ffi.new("dpm_port_traits *")
        lib.dpm_bus_get_traits(self._handle, traits)
        return traits

    def _call(self, code: int, what: str, **context: object) -> int:
        """check(), with the words for a port that vanished and for a close that came in between."""
        if code == lib.DPM_E_GONE:
            raise port_error(self.path, code)
        return _core.check(code, what, **context)

    def add(self, settings: Any, outputs: Any, image: Any, memory: tuple[Any, ...]) -> int:
        """Give a slave to the thread, with its images and the memory they are in."""
        self.guard()
        self._kept[id(memory)] = memory
        if self.scheduling.locked and lock(memory):
            self.scheduling = replace(self.scheduling, locked=False)
        return self._call(lib.dpm_bus_add(self._handle, settings, outputs, image), "add the station", address=settings.address)

    def change(self, index: int, settings: Any) -> None:
        self.guard()
        self._call(lib.dpm_bus_change(self._handle, index, settings), "change the station", address=settings.address)

    def new_prm(self, index: int) -> None:
        self.guard()
        self._call(lib.dpm_bus_new_prm(self._handle, index), "parameterise the station anew")

    def activate(self, index: int, active: bool) -> None:
        self.guard()
        self._call(lib.dpm_bus_activate(self._handle, index, active), f"{'' if active else 'de'}activate the station")

    def remove(self, index: int, memory: tuple[Any, ...]) -> None:
        """Take a slave that is inactive from the thread, and with it the need to keep its memory."""
        self.guard()
        self._call(lib.dpm_bus_remove(self._handle, index), "remove the station")
        self._kept.pop(id(memory), None)

    def leave(self) -> None:
        """From here on there is no mode but Offline: nobody brings back what close() has brought to rest."""
        with self._ordering:
            self._leaving = True

    def set_mode(self, mode: Mode) -> None:
        self.guard()  # first: in a forked child a thread of the parent may have held the lock
        with self._ordering:
            if self._leaving and mode is not Mode.OFFLINE:
                raise ClosedError(f"the master on {self.path} is being closed: open a new one", dpm_code=lib.DPM_E_CLOSED)
            self._call(lib.dpm_bus_set_mode(self._handle, mode), f"go to {mode.name.title()}")

    def status(self) -> Any:
        """A ``dpm_master_status``."""
        self.guard()
        status = ffi.new("dpm_master_status *")
        self._call(lib.dpm_bus_get_status(self._handle, status), "read the master's status")
        return status

    def ring(self) -> Any:
        """A ``dpm_ring_view``."""
        self.guard()
        view = ffi.new("dpm_ring_view *")
        self._call(lib.dpm_bus_get_ring(self._handle, view), "read the ring")
        return view

    def slave(self, index: int) -> Any:
        """A ``dpm_slave_status``."""
        self.guard()
        status = ffi.new("dpm_slave_status *")
        self._call(lib.dpm_bus_get_slave(self._handle, index, status), "read a station's status")
        return status

    def history(self, history: Any, room: int) -> list[Any]:
        """Up to `room` ``dpm_diagnosis`` of a slave, oldest first."""
        self.guard()
        records = ffi.new("dpm_diagnosis[]", room)
        found = self._call(lib.dpm_bus_get_history(self._handle, history, 0, records, room), "read a station's diagnoses")
        return [ffi.new("dpm_diagnosis *", records[i]) for i in range(found)]  # an element does not keep its array

    def info(self) -> Any:
        self.guard()
        info = ffi.new("dpm_bus_info *")
        self._call(lib.dpm_bus_get_info(self._handle, info), "read the port's status")
        return info

    def check_port(self) -> None:
        """Raise PortError when the port is not working."""
        code = self.info().port_error
        if code:
            raise port_error(self.path, code)

    def statistics(self) -> PortStatistics:
        info = self.info()
        port = info.port
        return PortStatistics(
            self._profile(), port.traits.allowance / NS, port.rate, port.parity, port.rs485, port.drains, port.low_latency,
            port.fifo_trigger or None, _counters(port) if port.counted else None, port.octets_in, port.octets_out,
            port.echo_octets, port.echo_errors, port.line_errors, info.cpu_time / NS, info.wakeups, self.scheduling)

    def _profile(self) -> str:
        names = {getattr(lib, f"DPM_PROFILE_{theirs}"): ours or "auto" for ours, theirs in _PROFILES.items()}
        info = self.info()  # kept by a name: a struct inside a struct does not keep the outer one
        return names[info.port.profile]

    def request(self, raw: Any, timeout: float | None) -> bool:
        """Carry out one ``dpm_raw``: True when it is done, False when `timeout` passed and it was taken back."""
        return self._lend(raw, lib.dpm_bus_request, lib.dpm_bus_cancel, timeout, "request", address=raw.da)

    def order(self, control: Any, timeout: float | None) -> bool:
        """The same for one ``dpm_control``; that of another thread comes first."""
        return self._lend(control, lib.dpm_bus_order, lib.dpm_bus_revoke, timeout, "order Global_Control")

    def _lend(self, job: Any, give: Callable[[Any, Any], int], take_back: Callable[[Any, Any], int], timeout: float | None,
              what: str, **context: object) -> bool:
        """Let the thread carry out `job`, once it has room. Wherever Ctrl-C comes, its memory is ours again only when it is
        done or was taken back; a thread that is leaving gives nothing back, and is outlived by what is kept."""
        given = False

        def done() -> bool | None:
            nonlocal given
            if not given:
                code = give(self._handle, job)
                if code == lib.DPM_E_BUSY:
                    return None
                self._call(code, what, **context)
                given = True
            return job.done or None

        self.guard()
        self._kept[id(job)] = job
        try:
            return self.wait(done, timeout) is not None
        finally:
            if job.done or take_back(self._handle, job) == lib.DPM_OK:
                self._kept.pop(id(job), None)

    def wait(self, ready: Callable[[], T | None], timeout: float | None) -> T | None:
        """Wait until `ready` returns something: that, or None after `timeout` s. In the thread of the last commit it feeds."""
        self.guard()
        return _core.wait_slices(self._wait, self._progress, ready, timeout, self.feed_from_wait)

    def _progress(self) -> int:
        self.guard()
        return int(lib.dpm_bus_progress(self._handle))

    def _wait(self, seen: int, timeout: int) -> int:
        return int(lib.dpm_bus_wait(self._handle, seen, timeout))

    def feed(self, by: Feed) -> None:
        """Tell the output watchdog that the program lives. A commit, and operate(), name the thread whose waits do so too."""
        if self.master is not None:
            if by in (Feed.COMMIT, Feed.OPERATE):
                self.fed_thread = _errand.caller()
            lib.dpm_master_feed(self.master, _core.now(), by)

    def feed_from_wait(self) -> None:
        """A wait feeds in the thread of the last commit. On an errand the loop's thread does it, if it lives."""
        errand = _errand.here.errand
        if errand is not None:
            errand.pass_on(self.feed_from_wait)
        elif _errand.here.thread is self.fed_thread:
            self.feed(Feed.WAIT)

    def subscribe(self, events: Events) -> None:
        """Events begin to arrive at once, or when the thread starts."""
        self.guard()
        with self._starting:
            self._events.append(events)  # first: Ctrl-C behind the call below leaves nothing that nobody ends
            if self.master is not None:
                self._subscribe(events)

    def _subscribe(self, events: Events) -> None:
        code = lib.dpm_bus_subscribe(self._handle, events.ring, events.fileno())
        if code == lib.DPM_E_FULL:
            raise ConfigurationError("a master has room for 8 subscribers of events, its log among them: close() some",
                                     dpm_code=code)
        self._call(code, "subscribe to events")

    def unsubscribe(self, events: Events) -> bool:
        """True when nothing is written there any more. False: the bus is being closed, and ends it behind its thread."""
        with self._starting:
            if events in self._events:
                if self.master is not None and lib.dpm_bus_unsubscribe(self._handle, events.ring) == lib.DPM_E_CLOSED:
                    return False
                self._events.remove(events)
            return True

    def close(self) -> None:
        """End the thread, close the port, wake every waiter with ClosedError. Within a second; again, it does what Ctrl-C has
        kept it from."""
        self.process.guard(f"the master on {self.path}")
        self.closed = True
        finish = self._finish.peek()  # called as it is, it would do nothing once the interpreter has begun to end
        if finish is not None:
            _, shut, arguments, _ = finish
            shut(*arguments)
            self._finish.detach()
