# SPDX-License-Identifier: MIT
"""A DP slave as its master sees it: what it is to be, its process image, its state, and services by hand.

A station belongs to one master; before `Master.add` it is only a description. Drive classes derive from `Station`,
override the two hooks and use what is public here. It owns the blocks of its process image and touches no other object of
the library.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from dpmaster import _arguments, _core
from dpmaster._core import NS, ffi, lib
from dpmaster.bus import Feed, Mode
from dpmaster.diagnosis import NO_ANSWER, Diagnosis, DiagnosisHistory, DiagnosisRecord, Reason, StationState, judge, why
from dpmaster.errors import ConfigurationError, DPTimeout, NotOperatingError, OutputsDiscarded, StationError
from dpmaster.signals import Signals

if TYPE_CHECKING:
    from dpmaster.aio import AsyncStation
    from dpmaster.gsd import GSD
    from dpmaster.gsd.station import GSDStation
    from dpmaster.master import Master

__all__ = ["Frame", "Station", "StationState", "StationStatistics"]

Watchdog = float | Literal["default"] | None

DIAGNOSES = 64  # that a station's history has room for
BY_HAND_WATCHDOG = 1.0  # s, of a Set_Prm by hand when the station says "default": no cycle is there to predict it from
WATCHDOG_MAX = 650.25  # s, 255 * 255 * 10 ms
START_CYCLES = 8  # a station's way into Data_Exchange has a request in each; one that is not ready at once has more
REFUSALS = 8  # with the growing pauses between them two thirds of a second: a slave that is only starting says yes by then
USER_PARAMETERS_MAX = 237  # octets of User_Prm_Data in Set_Prm

# Station_Status of Set_Prm, EN 50170 part 8
_WD_ON, _FREEZE_REQ, _SYNC_REQ, _UNLOCK_REQ, _LOCK_REQ = 0x08, 0x10, 0x20, 0x40, 0x80
_DPV1_ENABLE = 0x80  # of DPV1_Status_1


@dataclass(frozen=True, slots=True)
class Frame:
    """Inputs that came in one telegram. ``cycle`` is the bus cycle, ``time`` in s of `time.monotonic`.

    ``number`` counts frames, 0: none yet. ``valid`` is False while the station is not in Data_Exchange: after a loss the octets
    stay and validity is gone.
    """

    octets: bytes
    number: int
    cycle: int
    time: float
    valid: bool


@dataclass(frozen=True, slots=True)
class StationStatistics:
    """Counters since the station was added; Tsdr in s as well as the port can tell, None before the first measurement."""

    exchanges: int
    diagnoses: int
    repetitions: int
    unanswered: int  # requests given up after all tries
    refused: int  # RS, UE, RR
    invalid: int  # answers that fit no request
    starts: int  # of Data_Exchange
    losses: int  # of it
    tsdr_min: float | None
    tsdr_max: float | None


def watchdog_factors(seconds: float | None) -> tuple[int, int]:
    """WD_Fact_1 and WD_Fact_2 (1..255 each) of the shortest watchdog not under `seconds`: factors times 10 ms. None: (0, 0)."""
    if seconds is None:
        return 0, 0
    _arguments.seconds("watchdog", seconds, WATCHDOG_MAX, ", 'default', or None for no watchdog")
    ticks = max(1, -(-round(seconds * 1_000_000) // 10_000))
    first = range(-(-ticks // 255), 256)
    return min(((f, -(-ticks // f)) for f in first), key=lambda pair: (pair[0] * pair[1], pair[0]))


def _address(address: int) -> int:
    if address == 126:
        raise ConfigurationError("address 126 is that of a slave which waits for its address: give it one from 0 to 125 first, "
                                 "with Set_Slave_Add or its switches")
    return _arguments.whole("address", address, 0, 125, " is what a slave can have")


def _max_tsdr(given: Mapping[int, int] | None) -> dict[int, int]:
    if given is not None and not isinstance(given, Mapping):
        raise ConfigurationError(f"max_tsdr {given!r}: give a mapping from a rate in bit/s to Tbit, like {{500_000: 100}}")
    return {rate: _arguments.whole(f"max_tsdr at {rate} bit/s", bits, 37, 1023, " Tbit")
            for rate, bits in (given or {}).items()}


class Station:
    """A slave of a DP master.

    address: 0..125. ident_number: 0..FFFFh, as its maker registered it. configuration: Chk_Cfg identifiers, 1..244 octets;
    they say how long inputs and outputs are. user_parameters: User_Prm_Data of Set_Prm, 0..237 octets.

    name: for messages. watchdog: s (rounded up to WD_Fact_1 * WD_Fact_2 * 10 ms), "default" (ten predicted cycles, 100 ms
    to 1 s), or None: off, with a warning; then outputs stay when the master dies. min_tsdr: Tbit, 11..255, or 0: leave the
    slave's own. max_tsdr: Tbit for each rate in bit/s that differs from the standard's table. group: Group_Ident, a bit for
    each of 8 groups. sync, freeze: ask for these in Set_Prm. fail_safe: in Clear it gets an empty Data_Exchange instead of
    zeros. min_slave_interval: 100 us, 0..65535. resume: "safe", outputs are zeros after a loss until the next commit, or
    "hold", the last commit is sent again (bare stations only). active=False: listed, never asked: for services by hand.

    Where masters differ: check_ident=False: Set_Prm is sent though Slave_Diag tells another ident number, and the slave says
    what it thinks of it. diagnosis_poll: s between two Slave_Diag in Data_Exchange, 0.01..3600, for a slave that has no inputs
    to announce its diagnosis with; each takes the place of one exchange; None: only when announced. ready_timeout: s,
    0.01..3600, after which a slave that is still not ready gets Set_Prm and Chk_Cfg again; None: never, as some need seconds.

    Raises ConfigurationError for anything outside these ranges.
    """

    def __init__(self, address: int, ident_number: int, configuration: bytes, user_parameters: bytes = b"", *,
                 name: str | None = None, watchdog: Watchdog = "default", min_tsdr: int = 11,
                 max_tsdr: Mapping[int, int] | None = None, group: int = 0, sync: bool = False, freeze: bool = False,
                 fail_safe: bool = False, min_slave_interval: int = 1, resume: Literal["safe", "hold"] = "safe",
                 active: bool = True, check_ident: bool = True, diagnosis_poll: float | None = None,
                 ready_timeout: float | None = None) -> None:
        self.address = _address(address)
        self.ident_number = _arguments.whole("ident_number", ident_number, 0, 0xFFFF)
        self.configuration = _arguments.octets("configuration", configuration, 1, lib.DPM_IO_MAX, " identifiers of Chk_Cfg")
        self.user_parameters = _arguments.octets("user_parameters", user_parameters, 0, USER_PARAMETERS_MAX)
        self.name = name or f"station {address}"
        self.watchdog = watchdog
        self.min_tsdr = min_tsdr
        self.max_tsdr = _max_tsdr(max_tsdr)
        self.group = group
        self.sync = sync
        self.freeze = freeze
        self.fail_safe = fail_safe
        self.min_slave_interval = _arguments.whole("min_slave_interval", min_slave_interval, 0, 65535, " (of 100 us)")
        self.resume = resume
        self.check_ident = check_ident
        self.diagnosis_poll = diagnosis_poll
        self.ready_timeout = ready_timeout
        self._active = active
        self._check()
        self.input_length, self.output_length = self._lengths()
        self._master: Master | None = None
        self._index: int | None = None
        # Who is interrupted by a signal may find its handler committing or reading too: each is one call to C.
        self._commands = threading.RLock()
        self._image_lock = threading.RLock()
        self._factors = (0, 0)
        self._history: Any = ffi.NULL
        self.signals = Signals(self)
        """Values by name: a bus file gives them, or a program, ``station.signals = Signals(station, [...])``."""

    @staticmethod
    def from_gsd(gsd: GSD | str | os.PathLike[str], address: int, modules: Iterable[Any] | None = None,
                 parameters: Mapping[Any, Any] | None = None, **options: Any) -> GSDStation:
        """The station that a GSD file describes, with modules and parameters as `GSD.configure` takes them.

        Ident number, max_tsdr, fail_safe and min_slave_interval are the file's. options: `names`, `dpv1` and `alarms` go to
        `configure`, the rest are those of `Station`, and win over the file's. Raises ConfigurationError that names what the
        file does not allow, sync and freeze included.
        """
        from dpmaster.gsd.station import GSDStation  # a program without GSD files does not load their reader

        return GSDStation(gsd, address, modules, parameters, **options)

    def _check(self) -> None:
        if not isinstance(self.name, str):
            raise ConfigurationError(f"name {self.name!r}: give a text")
        for name in ("sync", "freeze", "fail_safe", "check_ident", "active"):
            if getattr(self, name) not in (False, True):
                raise ConfigurationError(f"{name} {getattr(self, name)!r}: True or False")
        _arguments.whole("group", self.group, 0, 255)
        for name, value in (("diagnosis_poll", self.diagnosis_poll), ("ready_timeout", self.ready_timeout)):
            if value is not None and (not _arguments.number(value) or not 0.01 <= value <= 3600):
                raise ConfigurationError(f"{name} {value!r} s: 0.01 to 3600 s, or None")
        if self.min_tsdr != 0:
            _arguments.whole("min_tsdr", self.min_tsdr, 11, 255, " Tbit, or 0 to leave the slave's own")
        if self.resume not in ("safe", "hold"):
            raise ConfigurationError(f"resume {self.resume!r}: 'safe' or 'hold'")
        if self.watchdog != "default":
            watchdog_factors(self.watchdog)

    def _lengths(self) -> tuple[int, int]:
        inputs, outputs = ffi.new("uint16_t *"), ffi.new("uint16_t *")
        octets = self.configuration
        _core.check(lib.dpm_configuration_lengths(octets, len(octets), inputs, outputs),
                    f"configuration {octets.hex(' ').upper()}")
        return inputs[0], outputs[0]

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r} address {self.address}, ident {self.ident_number:04X}h>"

    @property
    def aio(self) -> AsyncStation:
        """The methods that wait, for asyncio: ``await station.aio.wait_sent(number)``."""
        from dpmaster.aio import AsyncStation  # asyncio is loaded by who uses it

        return AsyncStation(self)

    # ---- what Master uses

    def _attach(self, master: Master) -> None:
        """Become `master`'s: the process image begins."""
        sizes = lib.dpm_outputs_size(), lib.dpm_image_size(), lib.dpm_history_size(DIAGNOSES)
        outputs, image, history = self._memory = tuple(map(_core.block, sizes))
        self._outputs = lib.dpm_outputs_init(outputs, len(outputs), self.output_length)
        self._image = lib.dpm_image_init(image, len(image))
        self._history = lib.dpm_history_init(history, len(history), DIAGNOSES)
        self._master = master

    def _detach(self, active: bool) -> None:
        """Belong to no master any more; another one finds it as active as it was."""
        self._master = None
        self._index = None
        self._active = active

    def _settings(self) -> Any:
        """The ``dpm_slave_set``; the watchdog's factors are those of `_watch`."""
        settings = ffi.new("dpm_slave_set *")
        settings.address = self.address
        settings.ident_number = self.ident_number
        settings.configuration = self.configuration
        settings.configuration_length = len(self.configuration)
        settings.user_parameters = self.user_parameters
        settings.user_parameters_length = len(self.user_parameters)
        settings.station_status = self._features()
        settings.wd_fact_1, settings.wd_fact_2 = self._factors
        settings.min_tsdr = self.min_tsdr
        settings.group = self.group
        settings.fail_safe = self.fail_safe
        settings.hold = self.resume == "hold"
        settings.active = self._active
        settings.any_ident = not self.check_ident
        settings.diagnosis_poll = round((self.diagnosis_poll or 0) * NS)
        settings.ready_timeout = round((self.ready_timeout or 0) * NS)
        settings.min_slave_interval = self.min_slave_interval
        settings.history = self._history
        return settings

    def _features(self) -> int:
        return (_SYNC_REQ if self.sync else 0) | (_FREEZE_REQ if self.freeze else 0)

    def _watch(self, default: Callable[[], float]) -> bool:
        """Settle the watchdog, `default()` when it is "default": True when the factors changed."""
        seconds = default() if self.watchdog == "default" else self.watchdog
        factors = watchdog_factors(seconds if seconds is None else float(seconds))
        changed, self._factors = factors != self._factors, factors
        return changed

    def _status(self) -> Any:
        """The ``dpm_slave_status``, or None while the master has not begun."""
        master = self._owner()
        return None if self._index is None else master._bus.slave(self._index)

    def _refuses(self) -> bool:
        """The station says no, rather than nothing."""
        status = self._status()
        return status is not None and Reason(judge(status.reason, _diagnosis(status))).refusal

    def _refuses_for_good(self) -> bool:
        """It said no again and again, and no other master has to let it go first."""
        status = self._status()
        if status is None or status.refusals < REFUSALS:
            return False
        reason = Reason(judge(status.reason, _diagnosis(status)))
        return reason.refusal and reason != Reason.LOCKED

    def _trouble(self, status: Any) -> str:
        diagnosis = _diagnosis(status)
        text = why(status.reason, status.detail, ident_number=self.ident_number, configuration=self.configuration,
                   diagnosis=diagnosis)
        if text or status.state == StationState.DATA:
            return text
        if status.state == StationState.OFFLINE:
            return NO_ANSWER
        if diagnosis is not None and not diagnosis.ready:
            return "; ".join(diagnosis.texts)
        return f"is still being started ({StationState(status.state).name})"

    def _before_operate(self) -> list[str]:
        """Hook: what a person should know before this station is operated, logged as warnings."""
        return []

    def _operating(self) -> None:
        """Hook: the master has reached Operate. A drive asks, bounded, for what a person should know of it, and logs that."""

    def _stop_word(self) -> None:
        """Hook: the master is about to leave Operate. A drive commits its stop word: those of all go out in one cycle."""

    def _rest(self) -> None:
        """Hook: all stations have said their `_stop_word`. A drive waits, bounded, until its own was answered.

        Other threads' commits to the station wait from here on until Clear is ordered. What it raises is logged and stops
        nothing. It runs only while the station is in Data_Exchange.
        """

    # ---- the process image

    def _owner(self) -> Master:
        if self._master is None:
            raise ConfigurationError(f"{self.name} belongs to no master yet: master.add(station) first")
        self._master._bus.guard()
        return self._master

    @property
    def _pace(self) -> float:
        """s that a fixed cycle time keeps its turn waiting, at most."""
        return (self._master.cycle_time if self._master is not None else None) or 0.0

    @property
    def frame(self) -> Frame:
        """The newest inputs with cycle, time and validity. Never waits."""
        self._owner()
        frame = ffi.new("dpm_frame *")
        with self._image_lock:
            lib.dpm_image_read(self._image, frame)
        octets = bytes(ffi.buffer(frame.octets, frame.length))
        return Frame(octets.ljust(self.input_length, b"\0"), frame.number, frame.cycle, frame.time / NS, frame.valid)

    @property
    def inputs(self) -> bytes:
        """The newest input octets, `input_length` of them; zeros before the first."""
        return self.frame.octets

    @property
    def outputs(self) -> bytes:
        """What the next commit builds on: the last commit, or zeros when outputs went safe since then."""
        self._owner()
        octets = ffi.new("uint8_t[]", self.output_length or 1)
        with self._commands:
            lib.dpm_outputs_peek(self._outputs, octets)
        return bytes(ffi.buffer(octets, self.output_length))

    @outputs.setter
    def outputs(self, octets: bytes) -> None:
        given = _arguments.octets(f"{self.name}: outputs", octets, 0, lib.DPM_IO_MAX)
        if len(given) != self.output_length:
            raise ConfigurationError(f"{self.name} has {self.output_length} output octets, {len(given)} were given: "
                                     "set all of them, or use update(offset, octets)")
        self.update(0, given)

    def update(self, offset: int, octets: bytes | bytearray | Iterable[int], keep: bytes = b"") -> int:
        """Change some outputs and commit the whole image in one step; returns the commit's number (1, 2, ...).

        Octets not named keep what the last commit gave them, and so do bits set in `keep`, a mask as long as `octets` (none:
        all bits change): what is kept is that of the epoch the commit is made in, so never an order from before a loss. Any
        thread may call. It feeds the output watchdog and makes the calling thread the one whose waits do so. Raises
        ConfigurationError outside the image, NotOperatingError when the output watchdog has latched outputs safe, ClosedError.
        """
        master = self._owner()
        data = _arguments.octets(f"{self.name}: outputs", octets, 0, lib.DPM_IO_MAX)
        if not isinstance(offset, int) or offset < 0 or offset + len(data) > self.output_length:
            raise ConfigurationError(f"{self.name} has output octets 0 to {self.output_length - 1}; {len(data)} octets at "
                                     f"offset {offset!r} do not fit")
        keep = _arguments.octets(f"{self.name}: keep", keep, 0, lib.DPM_IO_MAX)
        if len(keep) not in (0, len(data)):
            raise ConfigurationError(f"{self.name}: a mask of {len(keep)} octets for {len(data)} octets: as many, or none")
        with self._commands:
            number = lib.dpm_outputs_change(self._outputs, offset, keep or ffi.NULL, data, len(data), _core.now())
        if number == lib.DPM_E_LATCHED:
            raise NotOperatingError(master._latch_text(), dpm_code=number)
        _core.check(number, f"commit outputs of {self.name}")
        master._bus.feed(Feed.COMMIT)
        return int(number)

    def wait_sent(self, number: int, timeout: float | None = 1.0) -> None:
        """Wait until commit `number`, or one after it, was sent and answered.

        Raises OutputsDiscarded, with the reason, when no telegram will ever carry it; DPTimeout after `timeout` s and two
        fixed cycle times (0: only look), PortError when the port is the reason; ClosedError.
        """
        master = self._owner()
        if not isinstance(number, int) or not 0 < number < 1 << 63:
            raise ConfigurationError(f"{self.name}: commit {number!r}: give a number that update() returned")
        within = _arguments.paced(timeout, self._pace, 2)  # the first behind operate() waits for the second
        result: int | None = master._bus.wait(lambda: lib.dpm_outputs_was_sent(self._outputs, number) or None, within)
        if result is None:
            master._bus.check_port()
            raise DPTimeout(f"{self.name}: commit {number} was not answered in {within or 0:g} s; {self._standing(master)}")
        if result == lib.DPM_E_DISCARDED:
            raise OutputsDiscarded(f"{self.name}: commit {number} will never be sent; {self._standing(master)}", number=number,
                                   dpm_code=result)
        if result == lib.DPM_E_ARGUMENT:
            raise ConfigurationError(f"{self.name}: commit {number} was never made: give a number that update() returned",
                                     dpm_code=result)
        _core.check(result, f"{self.name}: wait for commit {number}")

    def wait(self, predicate: Callable[[Frame], bool], timeout: float | None) -> Frame:
        """Wait until `predicate` is true of a valid frame: the newest one, then each that comes. Returns that frame.

        In the thread of the last commit it feeds the output watchdog. Raises DPTimeout after `timeout` s (None: never),
        PortError when the port is the reason, ClosedError.
        """
        master = self._owner()
        seen = -1

        def ready() -> Frame | None:
            nonlocal seen
            frame = self.frame
            if frame.number == seen:
                return None
            seen = frame.number
            return frame if frame.valid and predicate(frame) else None

        found = master._bus.wait(ready, timeout)
        if found is None:
            master._bus.check_port()
            raise DPTimeout(f"{self.name}: what was waited for did not come in {timeout} s; {self._standing(master)}")
        return found

    def _standing(self, master: Master) -> str:
        """How things stand, for the message of a wait that failed."""
        if self._index is None:
            return "the master has not begun: operate() first"
        general = master._status()
        if general.latched:
            return master._latch_text()
        status = self._status()
        trouble = self._trouble(status)
        if status.state != StationState.DATA:
            return f"the station {trouble}"
        text = f"the station is in Data_Exchange and the master in {Mode(general.mode).name.title()}"
        if general.auto_cleared >= 0:
            text += f", since station {general.auto_cleared} was not in data transfer (auto_clear): operate() again"
        return f"{text}; last trouble: the station {trouble}" if trouble else text

    # ---- part of the cycle or not

    @property
    def active(self) -> bool:
        """It is, or will be, in the master's cycle."""
        return self._active

    def activate(self) -> None:
        """Let it take part again; `state` tells when it exchanges, with safe outputs until the next commit."""
        master = self._owner()
        self._active = True
        if self._index is not None:
            master._settle_watchdogs()
            master._bus.activate(self._index, True)

    def deactivate(self, timeout: float | None = 1.0) -> None:
        """Take it out of the cycle, where it stays listed, for services by hand: stop word, safe outputs, Unlock.

        The others' exchange goes on. Raises DPTimeout when that took more than `timeout` s and a cycle time, ClosedError.
        """
        master = self._owner()
        within = _arguments.paced(timeout, self._pace)
        with self._commands:
            master._rest(self, self._stop_word, self._rest)
            self._active = False
            if self._index is None:
                return
            master._bus.activate(self._index, False)
        if master._bus.wait(lambda: True if self.state == StationState.INACTIVE else None, within) is None:
            raise DPTimeout(f"{self.name} was not released in {within or 0:g} s; {self._standing(master)}")
        master._settle_watchdogs()

    def reparameterise(self, user_parameters: bytes | None = None, timeout: float = 5.0) -> None:
        """Set_Prm and Chk_Cfg anew (New_Prm) with the attributes as they are now: watchdog, min_tsdr, group, sync, freeze, and
        `user_parameters` when they are given here.

        The others' exchange goes on. A drive says its stop word first; the station comes back with safe outputs, and only a
        commit made after that reaches it. Returns when it exchanges again; one that did not before is not waited for. Raises
        StationError when it refuses, DPTimeout after `timeout` s and eight fixed cycle times, ConfigurationError, ClosedError.
        """
        master = self._owner()
        if user_parameters is not None:
            self.user_parameters = _arguments.octets("user_parameters", user_parameters, 0, USER_PARAMETERS_MAX)
        self._check()
        if self._index is None:
            return
        waits = self.state == StationState.DATA
        master._settle_watchdogs()
        with self._commands:
            master._rest(self, self._stop_word, self._rest)
            master._bus.change(self._index, self._settings())
            master._bus.new_prm(self._index)
        if waits:
            self._await_data(master, _arguments.paced(timeout, self._pace, START_CYCLES))

    def _await_data(self, master: Master, timeout: float | None) -> None:
        def settled() -> bool | None:
            return True if self.state == StationState.DATA or self._refuses_for_good() else None

        settled_in_time = master._bus.wait(settled, timeout)
        if self.state == StationState.DATA:
            return
        master._bus.check_port()
        text = f"{self.name} is not back in Data_Exchange: it {self.reason}"
        if settled_in_time or self._refuses():
            raise StationError(text, address=self.address, reason=self.reason)
        raise DPTimeout(f"{text}, after {timeout or 0:g} s")

    # ---- state

    @property
    def state(self) -> StationState:
        """Where the master's handler stands with this station."""
        status = self._status()
        if status is None:
            return StationState.OFFLINE if self.active else StationState.INACTIVE
        return StationState(status.state)

    @property
    def reason(self) -> str:
        """In words why the station is not in Data_Exchange, or why it left it last; "" when nothing is known against it."""
        status = self._status()
        return "" if status is None else self._trouble(status)

    @property
    def diagnosis(self) -> Diagnosis | None:
        """The last diagnosis fetched, None before the first."""
        status = self._status()
        return None if status is None else _diagnosis(status, self._dpv1)

    @property
    def diagnosis_history(self) -> DiagnosisHistory:
        """The last 64 diagnoses fetched, with times, oldest first; the same one several times in a row is one record."""
        master = self._owner()
        records = [] if self._index is None else master._bus.history(self._history, DIAGNOSES)
        wall = _core.wall_clock()

        def record(found: Any) -> DiagnosisRecord:
            octets = bytes(ffi.buffer(found.octets, found.length))
            return DiagnosisRecord(Diagnosis(octets, found.number, found.time / NS, self._dpv1), found.count, found.first / NS,
                                   wall(found.first), wall(found.time))

        return DiagnosisHistory(map(record, records))

    @property
    def _dpv1(self) -> bool:
        """DPV1_Enable is set in DPV1_Status_1, the first octet of a DP-V1 slave's user parameters."""
        return bool(self.user_parameters[:1] and self.user_parameters[0] & _DPV1_ENABLE)

    @property
    def statistics(self) -> StationStatistics:
        status = self._status()
        if status is None:
            return StationStatistics(0, 0, 0, 0, 0, 0, 0, 0, None, None)
        s = status.statistics
        low, high = (None if value < 0 else value / NS for value in (s.tsdr_min, s.tsdr_max))
        return StationStatistics(s.exchanges, s.diagnoses, s.repetitions, s.unanswered, s.refused, s.invalid, s.starts,
                                 s.losses, low, high)

    # ---- services by hand, for debugging step by step

    def slave_diag(self, timeout: float | None = 1.0) -> Diagnosis:
        """Slave_Diag by hand; also for a station in the cycle. Raises StationError when it does not answer or refuses."""
        return replace(self._owner().slave_diag(self.address, timeout), dpv1=self._dpv1)

    def get_cfg(self, timeout: float | None = 1.0) -> bytes:
        """Get_Cfg: the real configuration, identifiers as in Chk_Cfg; also for a station in the cycle."""
        return self._owner().get_cfg(self.address, timeout)

    def rd_inp(self, timeout: float | None = 1.0) -> bytes:
        """RD_Inp: the present inputs, also of another master's station. Outside Data_Exchange it refuses, or has no data."""
        return self._owner().rd_inp(self.address, timeout)

    def rd_outp(self, timeout: float | None = 1.0) -> bytes:
        """RD_Outp: the present outputs, also of another master's station. Outside Data_Exchange it refuses, or has no data."""
        return self._owner().rd_outp(self.address, timeout)

    def set_prm(self, user_parameters: bytes | None = None, *, lock: bool = True, unlock: bool = False,
                watchdog: Watchdog = "default", ident_number: int | None = None, timeout: float = 1.0) -> None:
        """Set_Prm by hand with the station's own values where none are given.

        watchdog: s; "default" is the station's own, 1 s when that says "default" as well; None: off, outputs then stay.
        Taken is not accepted: the verdict is in the next `slave_diag`. Raises NotOperatingError in the cycle, StationError.
        """
        self._not_in_cycle("Set_Prm")
        chosen = self.watchdog if watchdog == "default" else watchdog
        seconds = BY_HAND_WATCHDOG if chosen == "default" else chosen
        factors = watchdog_factors(None if seconds is None else float(seconds))
        status = self._features()
        for wanted, bit in ((lock, _LOCK_REQ), (unlock, _UNLOCK_REQ), (any(factors), _WD_ON)):
            status |= bit if wanted else 0
        ident = self.ident_number if ident_number is None else _arguments.whole("ident_number", ident_number, 0, 0xFFFF)
        given = self.user_parameters if user_parameters is None else user_parameters
        parameters = _arguments.octets("user_parameters", given, 0, USER_PARAMETERS_MAX)
        octets = bytes((status, *factors, self.min_tsdr, *ident.to_bytes(2, "big"), self.group)) + parameters
        self._owner()._serve(self.address, "Set_Prm", lib.DPM_SAP_SET_PRM, octets, timeout)

    def chk_cfg(self, configuration: bytes | None = None, timeout: float = 1.0) -> None:
        """Chk_Cfg by hand, the station's own configuration when none is given. The verdict is in the next `slave_diag`."""
        self._not_in_cycle("Chk_Cfg")
        given = self.configuration if configuration is None else configuration
        octets = _arguments.octets("configuration", given, 1, lib.DPM_IO_MAX)
        self._owner()._serve(self.address, "Chk_Cfg", lib.DPM_SAP_CHK_CFG, octets, timeout)

    def data_exchange(self, octets: bytes = b"", timeout: float = 1.0) -> bytes:
        """Data_Exchange by hand: sends `octets` as outputs, whatever their number, and returns the inputs."""
        self._not_in_cycle("Data_Exchange")
        given = _arguments.octets("outputs", octets, 0, lib.DPM_IO_MAX)
        return self._owner()._serve(self.address, "Data_Exchange", None, given, timeout)

    def _not_in_cycle(self, service: str) -> None:
        if self.active and self._owner().mode >= Mode.CLEAR:
            raise NotOperatingError(f"{service} by hand to {self.name}, which is in the master's cycle: add it with "
                                    "active=False, deactivate() it, or stop() the master first")


def _diagnosis(status: Any, dpv1: bool = False) -> Diagnosis | None:
    if status.diagnosis_length < 6:
        return None
    octets = bytes(ffi.buffer(status.diagnosis, status.diagnosis_length))
    return Diagnosis(octets, status.diagnosis_number, status.diagnosis_time / NS, dpv1)
