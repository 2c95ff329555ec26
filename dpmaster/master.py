# SPDX-License-Identifier: MIT
"""The DP master class 1 as a program sees it: stations, modes, both watchdogs, requests by hand, a safe end.

It decides in which order things happen; how a call reaches the bus thread is `bus`'s, what a station is is `station`'s.
Nothing here is timed by Python: the C thread keeps the bus, and takes the outputs away when the program hangs.
"""

from __future__ import annotations

import atexit
import functools
import logging
import math
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from dpmaster import _arguments, _errand
from dpmaster._core import NS, ffi, lib
from dpmaster.bus import Bus, FdlState, Feed, Mode, PortStatistics
from dpmaster.cycles import Cycles, Lateness
from dpmaster.diagnosis import StationState, why
from dpmaster.errors import ConfigurationError, DPError, DPTimeout, NotOperatingError, StationError
from dpmaster.events import Event, EventKind, Events
from dpmaster.live import HIGHEST, LiveEntry, LiveList, RingView
from dpmaster.parameters import TSL_MAX, BusParameters
from dpmaster.realtime import Realtime
from dpmaster.services import Answer, Service, Services
from dpmaster.station import START_CYCLES, Station
from dpmaster.timing import DEFAULT_WATCHDOG_MAX, Slave, cycle, default_watchdog, tsl_needed

__all__ = ["Answer", "Master", "MasterStatistics", "MasterStatus", "Mode", "Service"]

if TYPE_CHECKING:
    from dpmaster.aio import AsyncMaster

S = TypeVar("S", bound=Station)

log = logging.getLogger(__name__)
Log = logging.LoggerAdapter[logging.Logger]

REST_TIME = 1.0  # s, and a cycle time, after which no more stop words are waited for
TOLD = 8  # stations whose reasons an error of operate() gives; of more only the addresses
LEAVE_TIME = 1.0  # s for Clear, unlock and the last telegram


@dataclass(frozen=True, slots=True)
class MasterStatus:
    """Master_Status: where the master stands, all of one moment."""

    mode: Mode  # USIF_State
    fdl_state: FdlState
    latched: bool  # the output watchdog ran out
    auto_cleared: int | None  # the station for whose sake auto_clear left Operate
    foreign: int | None  # address of the foreign master heard last


@dataclass(frozen=True, slots=True)
class MasterStatistics:
    """Counters since the master began, times in s. ``rejected``: octets and telegrams thrown away, by reason. ``lateness``: of
    the cycles' starts, None when it runs free."""

    cycle: int
    cycle_last: float
    cycle_max: float
    fdl_state: FdlState
    foreign: int | None  # address of the foreign master heard last
    requests: int
    answers: int
    repetitions: int
    unanswered: int  # requests given up after all tries
    abandoned: int  # requests withdrawn, or under way when the token or the bus was lost
    sdn: int
    tokens: int  # sent
    late_dropped: int  # telegrams not sent, as the host was late
    stray: int  # good telegrams that were nobody's: late, doubled, foreign answers
    foreign_telegrams: int  # tokens and requests of other masters
    send_failed: int
    tokens_lost: int  # given up after our own silence
    token_repetitions: int  # sent again, as the successor was silent
    tokens_spoilt: int  # own tokens not heard back as they were sent, behind a port that echoes
    gap_polls: int
    rejected: Mapping[str, int]
    port: PortStatistics
    lateness: Lateness | None


_live: weakref.WeakSet[Master] = weakref.WeakSet()


class _Named(Log):
    """Every line names the master: a program may have several."""

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        return f"{self.extra['who'] if self.extra else ''}: {msg}", kwargs


def _close_all() -> None:
    """Stop words, Clear and unlock while there is an interpreter to say them."""
    for master in list(_live):
        if master._bus.process.here:
            try:
                master.close()
            except KeyboardInterrupt:  # it has skipped what it may skip of this one, and nothing of the next
                continue
            except Exception:
                master._log.exception("closing it at exit")


class Master(Services):
    """A DP master on a port, which is opened at once; the bus is silent until the first operate(), clear(), stop(), request().

    port: path of a serial port or pty, or a `Segment`'s port. baudrate: a nominal rate in bit/s. address: 0..125, its own.

    parameters: bus parameters, rate included, instead of the standard set. cycle_time: s from one cycle's start to the next
    one's; None: as fast as the bus allows. output_watchdog: s without a commit, feed() or wait in the thread of the last
    commit after which all outputs go safe; None: off, which is logged. echo: the port hears itself, None: found out.
    profile: "uart", "usb", "pty", None: by the path. allowance: s that the host may wake late, None: the profile's.
    max_stations: 1..126.

    ring: whether it shares the bus with other masters. None: if Tsl has room for a host that wakes so late, which
    `BusParameters.for_ring` sees to, else alone, and silent while another master has the bus. True: it must, or
    ConfigurationError names the Tsl needed; all masters of a ring need the same bus parameters. False: alone.

    direction: who switches the transceiver: None: hat or adapter by itself, or the driver as the device tree has set it;
    "rs485": the driver's RS-485 mode, RTS active while sending; "rs485-inverted": while not sending. With either, `echo` also
    says whether the receiver is on while sending; None: as the driver has it.

    auto_clear: Error_Action_Flag: when an active station was not in data transfer for data_control_time s, the master goes from
    Operate to Clear, and operate() wants all of them. data_control_time: s, 0.01..655.35; Global_Control is repeated three
    times in it. data_retries: Max-Retry-Limit(DX), repetitions of a Data_Exchange within its cycle, 0..15, None: the
    parameters' max_retry_limit; with fewer the cycle keeps its pace when an answer is lost, and the station is lost after
    max_retry_limit repetitions all the same, those of later cycles among them.

    realtime: how the bus thread is scheduled, a `Realtime`; True: its defaults; None: these on a serial port, where the user
    may. What the system refuses is logged and stands in ``statistics.port.scheduling``.

    Use it with ``with``, or call close(). Raises PortError with path, reason and remedy, ConfigurationError.
    All methods may be called from any thread. After close(), and in a forked child, every call raises ClosedError.
    """

    def __init__(self, port: str, baudrate: int = 500_000, address: int = 1, *, parameters: BusParameters | None = None,
                 cycle_time: float | None = None, output_watchdog: float | None = 1.0, echo: bool | None = None,
                 profile: str | None = None, allowance: float | None = None, max_stations: int = 126,
                 ring: bool | None = None, auto_clear: bool = False, data_control_time: float = 1.0,
                 data_retries: int | None = None, realtime: Realtime | bool | None = None,
                 direction: str | None = None) -> None:
        self.check_options(address, max_stations=max_stations, cycle_time=cycle_time, output_watchdog=output_watchdog,
                           parameters=parameters, ring=ring, data_control_time=data_control_time, data_retries=data_retries)
        self.address = address
        self.auto_clear = bool(auto_clear)
        self.data_control_time = data_control_time
        self.data_retries = data_retries
        self.cycle_time = cycle_time
        self.output_watchdog = output_watchdog
        self._room = max_stations
        self._given = parameters
        self._baudrate = baudrate
        self._parameters = self._choose(0)
        self._parameters.check(address)
        self._stations: dict[int, Station] = {}
        self._lock = threading.RLock()  # of the list of stations and the start
        self._closing = threading.RLock()
        self._logger: threading.Thread | None = None
        rate = self._parameters.rate
        self._bus = Bus(port, (rate.numerator, rate.denominator), echo=echo, profile=profile, allowance=allowance,
                        realtime=realtime, direction=direction)
        self._log = _Named(log, {"who": f"master {address} on {self._bus.path}"})
        self._ring = ring
        self._live_list = LiveList(self)
        try:
            self._role(self._parameters)
        except BaseException:
            self._bus.close()
            raise
        _live.add(self)
        atexit.unregister(_close_all)
        atexit.register(_close_all)  # the last is the first: before the segment goes that was opened before

    @staticmethod
    def check_options(address: int = 1, *, parameters: BusParameters | None = None, cycle_time: float | None = None,
                      output_watchdog: float | None = 1.0, max_stations: int = 126, ring: bool | None = None,
                      auto_clear: bool = False, data_control_time: float = 1.0, data_retries: int | None = None) -> None:
        """Raise ConfigurationError, naming argument, value and rule, if a Master would not take these; no port is needed."""
        _arguments.whole("the master's address", address, 0, lib.DPM_ADDRESS_MAX)
        _arguments.whole("max_stations", max_stations, 1, 126)
        if cycle_time is not None:
            _arguments.seconds("cycle_time", cycle_time, 10.0, ", or None: as fast as the bus allows")
        if output_watchdog is not None:
            _arguments.seconds("output_watchdog", output_watchdog, 3600.0, ", or None for no watchdog")
        if parameters is not None and not isinstance(parameters, BusParameters):
            raise ConfigurationError(f"parameters {parameters!r}: give BusParameters, or None for the standard set")
        if ring not in (None, False, True):
            raise ConfigurationError(f"ring {ring!r}: True, False, or None: if Tsl has room for it")
        if not _arguments.number(data_control_time) or not 0.01 <= data_control_time <= 655.35:
            raise ConfigurationError(f"data_control_time {data_control_time!r} s: 0.01 to 655.35 s")
        if data_retries is not None:
            _arguments.whole("data_retries", data_retries, 0, 15, ", or None: as max_retry_limit of the parameters")

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], port: str | None = None, **options: Any) -> Master:
        """The master and stations of a bus file (docs/busfile.md), before the first telegram; ``master["Pump"]`` is a station.

        port and options win over the file's. Raises ConfigurationError with file, line and key of every fault, before the port
        is opened; PortError.
        """
        from dpmaster.busfile import BusFile

        return BusFile.load(path).master(port, **options)

    def __getitem__(self, which: int | str) -> Station:
        """A station by its address or its name. Raises ConfigurationError that names those there are."""
        found = [s for s in self.stations if which in (s.address, s.name)]
        if len(found) != 1:
            there = ", ".join(f"{s.address} {s.name!r}" for s in self.stations) or "none"
            raise ConfigurationError(f"{which!r}: {'several stations have' if found else 'no station has'} this name or "
                                     f"address: there are {there}")
        return found[0]

    def __repr__(self) -> str:
        return f"<Master {self.address} on {self._bus.path}{', closed' if self.closed else ''}>"

    @property
    def port(self) -> str:
        """Path of the port."""
        return self._bus.path

    # ---- stations

    @property
    def stations(self) -> tuple[Station, ...]:
        self._bus.process.guard(f"the master on {self._bus.path}")
        with self._lock:
            return tuple(self._stations.values())

    @property
    def parameters(self) -> BusParameters:
        """The bus parameters: final once the bus has begun, before then those of the stations added so far."""
        return self._parameters

    def add(self, station: S) -> S:
        """Add a station, before or while the bus runs; returns it. Raises ConfigurationError when it cannot be here."""
        self._bus.guard()
        with self._lock:
            self._check_room(station)
            parameters = self._fitting(station)
            self._role(parameters)
            station._attach(self)
            self._stations[station.address] = station
            self._parameters = parameters
            if self._bus.master is not None:
                try:
                    self._settle_watchdogs()
                    if self.mode >= Mode.CLEAR:  # it is started at once, with no operate() to warn
                        self._warn_of(station)
                    self._enter(station)
                except BaseException:
                    del self._stations[station.address]
                    station._detach(station.active)
                    raise
        return station

    def remove(self, station: Station, timeout: float = LEAVE_TIME) -> None:
        """Take a station out, before or while the bus runs, as `Station.deactivate` does it; its place is free for another.

        The others' exchange goes on. The object may be added again, also to another master. Raises ConfigurationError when it
        is not here, DPTimeout, ClosedError.
        """
        self._bus.guard()
        if station not in self.stations:
            raise ConfigurationError(f"{station!r} is none of this master's stations: nothing to remove")
        active = station.active
        station.deactivate(timeout)
        with self._lock:
            if station not in self._stations.values():
                return  # another thread was faster
            if station._index is not None:
                self._bus.remove(station._index, station._memory)
            del self._stations[station.address]
            station._detach(active)
            if self._bus.master is not None:
                self._settle_watchdogs()

    def _check_room(self, station: Station) -> None:
        if not isinstance(station, Station):
            raise ConfigurationError(f"add {station!r}: give a Station, or a drive of dpmaster.drives")
        if station._master is not None:
            raise ConfigurationError(f"{station.name} belongs to a master already: make another object for this one")
        if station.address == self.address:
            raise ConfigurationError(f"{station.name} has address {station.address}, which is the master's own: give one of "
                                     "them another")
        other = self._stations.get(station.address)
        if other is not None:
            raise ConfigurationError(f"address {station.address} has a station already, {other.name}: give this one another")
        if len(self._stations) >= self._room:
            raise ConfigurationError(f"{self._room} stations are there already: open the master with a larger max_stations")

    def _choose(self, max_tsdr: int) -> BusParameters:
        return self._given if self._given is not None else BusParameters.default(self._baudrate, max_tsdr)

    def _fitting(self, station: Station) -> BusParameters:
        """Parameters with Tsl for this station too: "Tsl = max(table, largest MaxTsdr on the bus + 15)"."""
        rate = self._parameters.rate
        slowest = Slave.of(station).tsdr(rate) or 0
        needed = tsl_needed(self._parameters, slowest, self._bus.late if self._ring else 0.0)
        fixed = self._given is not None or self._bus.master is not None
        if needed <= self._parameters.tsl and (fixed or slowest <= self._parameters.max_tsdr):
            return self._parameters
        if fixed:
            began = "given:" if self._given is not None else "of a bus that has begun: add it before that, or"
            late = " and what the host may be late" if self._ring else ""
            raise ConfigurationError(
                f"{station.name} needs Tsl {needed} (its MaxTsdr {slowest} + 15{late}), and Tsl is {self._parameters.tsl} in "
                f"the parameters {began} pass parameters= with a larger Tsl")
        return self._choose(slowest)

    def _role(self, parameters: BusParameters) -> int:
        """How it takes part: "max Tsdr + 15 + allowance > Tsl does not enter, and the error names the Tsl needed"."""
        needed = parameters.ring_tsl(self._bus.late)
        if self._ring is not False and needed <= parameters.tsl:
            return int(lib.DPM_ROLE_RING)
        if self._ring:
            raise ConfigurationError(
                f"ring=True: behind {self._bus.path} telegrams may be noticed {self._bus.late * 1000:g} ms late, so the ring "
                f"needs Tsl {needed}, and Tsl is {parameters.tsl}: give all its masters parameters=BusParameters.for_ring("
                f"baudrate, allowance={math.ceil(self._bus.late * 1e5) / 1e5:g}), or take a port that wakes sooner")
        return int(lib.DPM_ROLE_SOLE)

    @property
    def _in_ring(self) -> bool:
        return self._role(self._parameters) == int(lib.DPM_ROLE_RING)

    # ---- the start

    def _start(self) -> None:
        """Begin on the bus with the stations added so far; their MaxTsdr has settled Tsl."""
        self._bus.guard()
        with self._lock:
            if self._bus.master is None:
                self._begin()
            for station in self._stations.values():
                if station._index is None:  # also one that failed to enter the first time
                    self._enter(station)

    def _begin(self) -> None:
        config = ffi.new("dpm_master_config *")
        config.station.parameters = self._parameters.to_c()[0]
        config.station.address = self.address
        config.station.role = self._role(self._parameters)
        config.slaves = self._room
        config.cycle_time = round((self.cycle_time or 0) * NS)
        config.output_watchdog = math.ceil((self.output_watchdog or 0) * NS)  # 0 is off
        config.data_control_time = round(self.data_control_time * NS)
        config.auto_clear = self.auto_clear
        config.data_retries = -1 if self.data_retries is None else self.data_retries
        self._listen()
        with self._giving():
            self._bus.start(config, self._room)

    def _enter(self, station: Station) -> None:
        with self._giving():
            station._index = self._bus.add(station._settings(), station._outputs, station._image, station._memory)

    @contextmanager
    def _giving(self) -> Iterator[None]:
        """To the bus thread: behind a Ctrl-C in here nobody knows what it has, and the master is closed."""
        try:
            yield
        except Exception:
            raise
        except BaseException:
            self.close()
            raise

    def _listen(self) -> None:
        """Log what happens from a thread of its own, which keeps neither the master nor the interpreter alive."""
        if self._logger is not None:
            return  # from a start that failed
        events = Events(self._bus, 256)
        logger = threading.Thread(target=_log_events, args=(weakref.ref(self), events, self._log), name="dpmaster-log",
                                  daemon=True)
        try:
            logger.start()
        except BaseException:
            events.close()
            raise
        self._logger = logger

    # ---- watchdogs

    def _default_watchdog(self) -> float:
        slaves = [Slave.of(station) for station in self.stations if station.active]
        ring = self._in_ring
        predicted = cycle(self._parameters, slaves, allowance=self._bus.allowance, cycle_time=self.cycle_time, ring=ring,
                          delivery=self._bus.late - self._bus.allowance, usual=self._choose(0).max_tsdr)
        seconds = default_watchdog(predicted)
        # Nobody knows who will share the bus, but only that they keep the token for Ttr together.
        return min(seconds + self._parameters.seconds(self._parameters.ttr), DEFAULT_WATCHDOG_MAX) if ring else seconds

    def _settle_watchdogs(self) -> None:
        """Ten cycles of the stations there are now; what changed goes out with a station's next Set_Prm."""
        with self._lock:
            default = functools.cache(self._default_watchdog)
            for station in self._stations.values():
                if station._watch(default) and station._index is not None:
                    self._bus.change(station._index, station._settings())

    def feed(self) -> None:
        """Tell the output watchdog that the program lives and stands by its last commit. Raises ClosedError."""
        self._bus.guard()
        self._bus.feed(Feed.PROGRAM)

    def _latch_text(self) -> str:
        fed = Feed(self._status().fed_by).text
        return (f"the output watchdog ran out: nothing fed it for {self.output_watchdog} s, last was {fed}. All outputs are "
                "safe and stay so until operate(); commit, wait in the committing thread, or feed() more often, or give "
                "the Master another output_watchdog")

    # ---- modes

    def _status(self) -> Any:
        return self._bus.status()

    @property
    def mode(self) -> Mode:
        self._bus.guard()
        return Mode.OFFLINE if self._bus.master is None else Mode(self._status().mode)

    def operate(self, timeout: float | None = 5.0, partial: bool = False) -> None:
        """Bring every active station into Data_Exchange, then Operate: from now on commits reach the stations.

        timeout: s for all stations together, beside eight fixed cycle times; None: for ever. When some are missing then, or
        earlier when all that are missing have refused for good, StationError (one refuses) or DPTimeout says which and why, and
        the mode stays Clear, with the others exchanging; with `partial` it goes on with those that are there. It also ends a
        latch of the output watchdog and what auto_clear did. Raises PortError when the port vanished, ConfigurationError,
        ClosedError.
        """
        if partial and self.auto_clear:
            raise ConfigurationError("partial=True with auto_clear=True, which operates with all active stations or not at "
                                     "all: deactivate() those that may be missing")
        self._start()
        self._warn()
        self._settle_watchdogs()
        if self.mode != Mode.OPERATE:
            self._bus.set_mode(Mode.CLEAR)
        begin = time.monotonic()
        missing = self._await_stations(_arguments.paced(timeout, self.cycle_time, START_CYCLES))
        if missing and not partial:
            raise self._missing_error(missing, time.monotonic() - begin)
        if self.mode != Mode.OPERATE:  # again while it operates would take the watchdog's last feed for a new start
            self._bus.set_mode(Mode.OPERATE)
            self._bus.fed_thread = _errand.caller()
        self._await_mode(Mode.OPERATE, LEAVE_TIME)
        for station in self.stations:
            if station.state == StationState.DATA:
                station._operating()

    def clear(self, timeout: float = LEAVE_TIME) -> None:
        """Clear: stations exchange, with safe outputs. Out of Operate every drive says its stop word first."""
        self._start()
        self._settle_watchdogs()
        self._leave(Mode.CLEAR, timeout)

    def stop(self, timeout: float = LEAVE_TIME) -> None:
        """Stop: stations are released, only the token runs; requests by hand work. Leaves Operate as clear() does."""
        self._start()
        self._leave(Mode.STOP, timeout)

    def offline(self, timeout: float = LEAVE_TIME) -> None:
        """Offline: stations are released and nothing more is sent. Leaves Operate as clear() does."""
        self._bus.guard()
        if self._bus.master is not None:
            self._leave(Mode.OFFLINE, timeout)

    def _leave(self, mode: Mode, timeout: float) -> None:
        with ExitStack() as held:
            try:
                self._rest_stations(held)
            finally:
                self._bus.set_mode(mode)
        self._await_mode(mode, timeout)

    def _rest_stations(self, held: ExitStack) -> None:
        """"Clear alone is not stillness": each drive says its stop word first, and no other thread a word behind it; none can
        keep the master from leaving."""
        stations = self.stations
        deadline = time.monotonic() + REST_TIME + (self.cycle_time or 0)
        for station in stations:
            # Who has it for longer is stopping the station, too, or hangs.
            if station._commands.acquire(timeout=max(0.0, deadline - time.monotonic())):
                held.callback(station._commands.release)
                self._rest(station, station._stop_word)
        for station in stations:
            if time.monotonic() <= deadline:
                self._rest(station, station._rest)
            elif station.state == StationState.DATA:
                self._log.error("%s: no time left to see its stop word answered, it goes to Clear as it is", station.name)

    def _rest(self, station: Station, *hooks: Callable[[], None]) -> None:
        if self.mode != Mode.OPERATE or station.state != StationState.DATA:
            return
        try:
            for hook in hooks:
                hook()
        except Exception:
            self._log.exception("%s: its stop word was not answered", station.name)

    def _await_mode(self, mode: Mode, timeout: float) -> None:
        if self._bus.wait(lambda: True if self._status().mode == mode else None, timeout) is None:
            self._bus.check_port()
            why_not = f"; {self._latch_text()}" if self._status().latched else ""
            raise DPTimeout(f"the master did not reach {mode.name.title()} in {timeout} s, it is in {self.mode.name.title()}"
                            f"{why_not}")

    def _await_stations(self, timeout: float | None) -> list[Station]:
        """Wait until all active stations exchange; those that do not, after `timeout` s or when they refuse for good."""
        def absent(station: Station) -> bool:
            return station.active and station.state != StationState.DATA

        def settled() -> list[Station] | None:
            self._bus.check_port()
            self._check_address()
            missing = list(filter(absent, self.stations))
            final = missing and timeout is not None and all(station._refuses_for_good() for station in missing)
            return missing if final or (not missing and self._all_transfer()) else None

        found = self._bus.wait(settled, timeout)
        return list(filter(absent, self.stations)) if found is None else found

    def _all_transfer(self) -> bool:
        """With auto_clear: "Clear -> Operate only when all were in data exchange within Data_Control_Time"."""
        return not self.auto_clear or self.data_transfer_list >= {s.address for s in self.stations if s.active}

    def _check_address(self) -> None:
        if self._bus.ring().duplicate:
            raise StationError(f"another station on the bus has address {self.address}, which is this master's: the bus was "
                               "left; give one of them another", address=self.address, reason="has the master's own address")

    def _missing_error(self, missing: list[Station], waited: float) -> DPError:
        refusing = [station for station in missing if station._refuses()]
        named = refusing[:TOLD] + [station for station in missing if station not in refusing][:max(0, TOLD - len(refusing))]
        lines = "; ".join(f"{station.name} (address {station.address}) {station.reason}" for station in named)
        if len(named) < len(missing):
            others = (str(station.address) for station in missing if station not in named)
            lines += f"; and the stations at {', '.join(others)}"
        text = f"{len(missing)} of {len(self.stations)} stations not in Data_Exchange after {waited:.1f} s: {lines}"
        text += self._kept_out()
        if refusing:
            return StationError(text, address=refusing[0].address, reason=refusing[0].reason)
        return DPTimeout(text)

    def _kept_out(self) -> str:
        status = self._status()
        if status.foreign < 0 or status.fdl_state != FdlState.LISTEN_TOKEN:
            return ""
        text = f"; master {status.foreign} has the bus"
        if not self._in_ring:
            text += ", and this one is silent beside it"
            needed = self._parameters.ring_tsl(self._bus.late)
            if needed <= TSL_MAX:
                text += (": with ring=True and the same parameters=BusParameters.for_ring(...) in all masters, "
                         f"Tsl {needed} or more, they would share it")
        return text

    def _warn(self) -> None:
        if self.output_watchdog is None:
            self._log.warning("the output watchdog is off: when this program hangs, drives run on with its last commit")
        for station in self.stations:
            self._warn_of(station)

    def _warn_of(self, station: Station) -> None:
        if station.active and station.watchdog is None:
            self._log.warning("%s: its watchdog is off, its outputs stay when the master dies", station.name)
        for text in station._before_operate():
            self._log.warning("%s: %s", station.name, text)

    # ---- waits, events, requests

    def wait_cycle(self, timeout: float | None = 1.0) -> int:
        """Wait for the end of the bus cycle under way; returns its number. In the thread of the last commit it feeds the output
        watchdog. Raises DPTimeout after `timeout` s and a fixed cycle time, NotOperatingError before the bus has begun,
        ClosedError."""
        if self._begun().mode < Mode.CLEAR:
            raise NotOperatingError(f"there are no cycles in {self.mode.name.title()}: operate() or clear() first")
        seen, within = self._status().cycle, _arguments.paced(timeout, self.cycle_time)
        cycle = self._bus.wait(lambda: number if (number := self._status().cycle) != seen else None, within)
        if cycle is None:
            self._bus.check_port()
            raise DPTimeout(f"no bus cycle ended in {within or 0:g} s")
        return int(cycle)

    def cycles(self, timeout: float | None = 1.0) -> Cycles:
        """The bus cycles as they end: ``for cycle in master.cycles():``. A program too slow for some is told how many.

        The loop ends when the master leaves (stop(), offline()) or is closed, by whomever. In the thread of the last commit it
        feeds the output watchdog. Raises DPTimeout when no cycle ends for `timeout` s and a cycle time, PortError when the port
        is the reason, NotOperatingError before operate() or clear().
        """
        self._begun()
        return Cycles(self._bus, self.cycle_time, timeout)

    @property
    def aio(self) -> AsyncMaster:
        """The methods that wait, for asyncio: ``await master.aio.operate()``, ``async for cycle in master.aio.cycles()``."""
        from dpmaster.aio import AsyncMaster  # asyncio is loaded by who uses it

        return AsyncMaster(self)

    def _begun(self) -> Any:
        self._bus.guard()
        if self._bus.master is None:
            raise NotOperatingError("the bus has not begun: operate(), clear() or stop() first")
        return self._status()

    def events(self, size: int = 256) -> Events:
        """Subscribe to events: a ring of `size` events (a power of two, 2..65536) with a descriptor. Up to 7 at a time."""
        self._bus.guard()
        return Events(self._bus, size)

    @property
    def ring(self) -> RingView:
        """The token ring as this master sees it. Raises NotOperatingError before the bus has begun, ClosedError."""
        self._begun()
        return RingView.of(self._bus.ring())

    def live_list(self, *, identify: bool = False, refresh: bool = False, highest: int = HIGHEST,
                  timeout: float | None = 60.0) -> Mapping[int, LiveEntry]:
        """Who is on the bus, by address up to `highest` (0..126), without this master.

        Addresses of which nothing is known are asked for their FDL status, with `refresh` all of them; `identify` asks slaves
        for their ident number, which disturbs no other master. That takes turns with the bus cycle; while stations exchange, it
        leaves nine tenths of the time to them. What `timeout` s do not suffice for, or another master prevents, stays unknown.
        Begins on the bus in Stop if it has not begun. Raises PortError, ClosedError.
        """
        _arguments.whole("highest", highest, 0, HIGHEST)
        self._start()
        if self.mode == Mode.OFFLINE:
            self._bus.set_mode(Mode.STOP)
        known = self._live_list.read(self._bus.ring(), highest)
        self._live_list.ask(known, identify=identify, refresh=refresh, timeout=timeout)
        self._bus.check_port()
        return self._live_list.read(self._bus.ring(), highest)

    @property
    def data_transfer_list(self) -> frozenset[int]:
        """Data_Transfer_List: addresses of stations that were in data transfer within the last `data_control_time`."""
        status = self._begun()
        return _addresses(status.data_transfer)

    @property
    def system_diagnostic(self) -> frozenset[int]:
        """System_Diagnostic: addresses of active stations not in Data_Exchange, or whose diagnosis reports something."""
        status = self._begun()
        return _addresses(status.system_diagnostic)

    @property
    def master_status(self) -> MasterStatus:
        """Raises NotOperatingError before the bus has begun, as these lists do; ClosedError."""
        status = self._begun()
        return MasterStatus(Mode(status.mode), FdlState(status.fdl_state), status.latched,
                            None if status.auto_cleared < 0 else status.auto_cleared,
                            None if status.foreign < 0 else status.foreign)

    @property
    def statistics(self) -> MasterStatistics:
        status = self._begun()
        fdl = status.fdl
        rejected = {ffi.string(lib.dpm_reject_name(i)).decode(): fdl.rejected[i] for i in range(1, lib.DPM_REJECT_COUNT)}
        return MasterStatistics(
            status.cycle, status.cycle_last / NS, status.cycle_max / NS, FdlState(status.fdl_state),
            None if status.foreign < 0 else status.foreign, fdl.requests, fdl.answers, fdl.repetitions, fdl.unanswered,
            fdl.abandoned, fdl.sdn, fdl.tokens, fdl.late_dropped, fdl.stray, fdl.foreign, fdl.send_failed, fdl.tokens_lost,
            fdl.token_repetitions, fdl.tokens_spoilt, fdl.gap_polls, rejected, self._bus.statistics(),
            None if self.cycle_time is None else Lateness.of(status.lateness))

    # ---- the end

    @property
    def closed(self) -> bool:
        return self._bus.closed

    def close(self) -> None:
        """Leave the bus: stop words, Clear, unlock, silence; then end the thread and close the port.

        Idempotent, from any thread, within 3 s and two cycle times whatever the bus does; wakes everybody who waits with
        ClosedError. It runs by itself when the interpreter ends. Ctrl-C meanwhile skips stop words that are not said yet, never
        Clear and unlock.
        """
        self._bus.process.guard(f"the master on {self._bus.path}")
        with self._closing:
            try:
                if not self._bus.closed:
                    self._bus.leave()
                    self.offline()
            except DPError as error:
                self._log.warning("leaving the bus: %s", error)
            finally:
                self._bus.close()
                _live.discard(self)
        if self._logger not in (None, threading.current_thread()):
            self._logger.join(LEAVE_TIME)

    def __enter__(self) -> Master:
        self._bus.guard()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._bus.process.here:
            self.close()


def _addresses(octets: Any) -> frozenset[int]:
    """A bit per address."""
    bits = int.from_bytes(bytes(octets), "little")
    return frozenset(address for address in range(126) if bits >> address & 1)


def _log_events(master: weakref.ref[Master], events: Events, log: Log) -> None:
    """The thread "dpmaster-log". A station's trouble is told once, not with every try."""
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # taken here, a Ctrl-C would not end the program's sleep
    told: dict[int, set[tuple[int, int]]] = {}
    for event in events:
        owner = master()
        station = None if owner is None or event.address is None else owner._stations.get(event.address)
        del owner
        try:
            _log_event(event, station, told, log)
        except Exception:
            log.exception("logging %r", event)
        del station


def _log_event(event: Event, station: Station | None, told: dict[int, set[tuple[int, int]]], log: Log) -> None:
    who = station.name if station is not None else f"station {event.address}"
    match event.kind:
        case EventKind.FAULT if station is not None:
            before = told.setdefault(station.address, set())
            if (event.a, event.b) not in before:
                before.add((event.a, event.b))
                log.warning("%s %s", who, why(event.a, event.b, ident_number=station.ident_number,
                                              configuration=station.configuration))
        case EventKind.STATE:
            data = StationState.DATA in (event.a, event.b)
            if event.a == StationState.DATA and station is not None:
                told.pop(station.address, None)
            log.log(logging.INFO if data else logging.DEBUG, "%s: %s -> %s", who, StationState(event.b).name,
                    StationState(event.a).name)
        case EventKind.MODE | EventKind.LATE:  # a busy computer is late now and then; the telegram is asked for again
            log.info("%s", event)
        case EventKind.FOREIGN | EventKind.WATCHDOG | EventKind.AUTO_CLEAR:
            log.warning("%s", event)
        case EventKind.DUPLICATE:
            log.error("%s; give one of them another, then operate() again", event)
        case EventKind.ECHO:
            log.error("%s", event)
        case EventKind.LIVE:
            log.info("%s", event)
        case EventKind.PORT:
            log.log(logging.ERROR if event.a else logging.INFO, "%s", event)
        case _:
            log.debug("%s", event)
