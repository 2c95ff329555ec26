# SPDX-License-Identifier: MIT
"""How late this host hears behind a port, measured by its own echo (the adapter's, or TX and RX joined) or a slave's answers.

Every request is an FDL status request, which changes nothing in any station. From the result follow the allowance for `Master`
and the rates at which the port may enter a ring. A measurement is of this computer with the load it had.
"""

from __future__ import annotations

import json
import math
import platform
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from dpmaster._arguments import whole
from dpmaster._core import NS, ffi, lib
from dpmaster.bus import port_error
from dpmaster.errors import ConfigurationError, DPError, StationError
from dpmaster.listener import Listener
from dpmaster.live import Live
from dpmaster.master import Master, Service
from dpmaster.parameters import BAUDRATES, TSL_MAX, BusParameters
from dpmaster.ports import opened
from dpmaster.telegram import Telegram

__all__ = ["Calibration", "calibrate"]

# Allowances of the profile that an answer may be late, while it is measured and while a slave is looked for.
PATIENCE, SEARCH = 10.0, 1.0
# allowance = this times the worst that was seen: a host is late to hear and again to wake for its own, a ring takes 8/3, and
# the next hour has worse moments than these seconds.
MARGIN = 3.0
STEP = 1e-4  # s to which it is rounded up
NOBODY = 126  # the address that waits for Set_Slave_Add: no request to it is answered in a bus that works
SPAN = 0.05  # s that the measurement of the rate lasts at least


@dataclass(frozen=True, slots=True)
class Calibration:
    """What was measured, times in s. ``by``: "echo" or "station N". ``rate``: bit/s that the UART really makes, None where its
    driver does not tell when it has sent. ``allowance`` is for ``Master(allowance=...)``."""

    port: str
    baudrate: int
    by: str
    samples: int
    mean: float
    p99: float
    worst: float
    allowance: float
    rate: float | None
    machine: str

    def tsl(self, baudrate: int) -> int | None:
        """Tsl that a ring at this rate needs for such a host, Tbit; None: no Tsl is long enough."""
        needed = BusParameters.default(baudrate).ring_tsl(self.allowance)
        return needed if needed <= TSL_MAX else None

    @property
    def ring_rates(self) -> tuple[int, ...]:
        """Rates at which the port may enter a ring whose masters all have the Tsl it needs. Alone it may use any it makes."""
        return tuple(rate for rate in BAUDRATES if self.tsl(rate) is not None)

    def save(self, path: str | Path) -> None:
        """Write it as JSON. Raises OSError."""
        Path(path).write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read what `save` wrote. Raises OSError, ConfigurationError."""
        try:
            return cls(**json.loads(Path(path).read_text()))
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"{path}: {error}; give a file that 'dpmaster calibrate --output' wrote") from None


def calibrate(port: str, baudrate: int = 500_000, *, address: int = 1, station: int | None = None, count: int = 300,
              direction: str | None = None, said: Callable[[str], None] = lambda text: None) -> Calibration:
    """Measure. station: the slave to ask, None: the port's own echo, or else the first slave that answers.

    It takes the bus for itself, for a few seconds. Raises DPError when another master has it, or when neither an echo nor an
    answer comes; PortError, ConfigurationError.
    """
    whole("count", count, 1, 1_000_000, " requests")
    usual = _alone(port, baudrate)
    made = _rate(port, baudrate, direction)
    once = replace(BusParameters.default(baudrate), max_retry_limit=0)
    measuring = partial(Master, port, address=address, parameters=once, ring=False, direction=direction)
    if station is None:
        with measuring(allowance=min(1.0, SEARCH * usual)) as master:
            station = _whom(master, said)
    with measuring(allowance=min(1.0, PATIENCE * usual)) as master:
        late = _by_echo(master, count) if station == NOBODY else _by_answers(master, station, count)
    late.sort()
    worst = late[-1]
    return Calibration(
        port=str(port), baudrate=baudrate, by="echo" if station == NOBODY else f"station {station}", samples=len(late),
        mean=statistics.fmean(late), p99=late[math.ceil(0.99 * len(late)) - 1], worst=worst,
        allowance=round(max(1, math.ceil(MARGIN * worst / STEP)) * STEP, 6), rate=made,
        machine=f"{platform.node()}, {platform.machine()}, Linux {platform.release()}")


def _alone(port: str, baudrate: int) -> float:
    """Make sure of it; returns the profile's allowance, s."""
    parameters = BusParameters.default(baudrate)
    with Listener(port, baudrate) as listener:
        listener.wait(max(0.25, parameters.seconds(parameters.tto(NOBODY))))
        if listener.foreign is not None:
            raise DPError(f"master {listener.foreign} has the bus on {port}: calibrate on a bus without another master")
        return listener._bus.allowance


def _echoes(master: Master) -> tuple[int, float]:
    info = master._bus.info()
    return info.port.echoes, info.port.echo_late / NS


def _ask(master: Master, station: int) -> float | None:
    """One request; the time until the answer, None: there was none."""
    try:
        return master.request(station, Service.FDL_STATUS, timeout=5.0).tsdr
    except StationError:
        return None


def _whom(master: Master, said: Callable[[str], None]) -> int:
    """NOBODY where the port hears itself, else the first slave."""
    for _ in range(20):  # a busy host may miss some
        _ask(master, NOBODY)
        if _echoes(master)[0]:
            return NOBODY
    said("no echo; looking for a slave ...")
    found = master.live_list()
    slave = next((address for address, entry in found.items() if entry.kind == Live.SLAVE), None)
    if slave is None:
        raise DPError("neither an echo nor a slave: connect one that is powered, or name one that answers late (--station N), "
                      "which is waited for longer; or join TX and RX of the port (A to A, B to B of two adapters is no loop)")
    said(f"asking station {slave}")
    return slave


def _by_answers(master: Master, station: int, count: int) -> list[float]:
    """How long after min Tsdr each answer was heard: what of it was the slave's own pause is not known, and counts too."""
    pause = 11 / float(master.parameters.rate)
    late = [max(0.0, time - pause) for _ in range(count) if (time := _ask(master, station)) is not None]
    if len(late) < count / 2:
        raise DPError(f"station {station} answered {len(late)} of {count} requests: 'dpmaster doctor' looks at the port, "
                      "'dpmaster scan' at the bus")
    return late


def _by_echo(master: Master, count: int) -> list[float]:
    late = []
    for _ in range(count):
        before = _echoes(master)[0]
        _ask(master, NOBODY)
        now, seconds = _echoes(master)
        if now > before:
            late.append(max(0.0, seconds))
    if len(late) < count / 2:
        raise DPError(f"{len(late)} of {count} transmissions were heard back whole: the echo is spoilt, by another station or "
                      "by the wiring")
    return late


def _rate(port: str, baudrate: int, direction: str | None) -> float | None:
    """bit/s, from how long the driver takes for telegrams that nobody answers: SDN to an address nobody has."""
    rate = BusParameters.default(baudrate).rate
    octets, took = _telegram() * math.ceil(SPAN * float(rate) / 11 / 255), ffi.new("int64_t *")
    with opened(port, rate, direction) as line:
        code = lib.dpm_port_measure(line, octets, len(octets), 20 * NS, took)
    if code == lib.DPM_E_GONE:
        raise port_error(port, code)
    return None if code < 0 else len(octets) * 11 * NS / took[0]


def _telegram() -> bytes:
    """The longest there is, 255 octets."""
    return Telegram(da=NOBODY, sa=1, fc=0x40 | Service.SDN_LOW, data=bytes(lib.DPM_DATA_MAX)).encode()
