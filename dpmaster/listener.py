# SPDX-License-Identifier: MIT
"""A passive station: it listens to a bus and never sends a bit. It owns its `Bus`; what it hears the library sorts.
"""

from __future__ import annotations

from collections.abc import Mapping

from dpmaster import live
from dpmaster._core import NS, ffi, lib
from dpmaster.bus import Bus, Mode
from dpmaster.events import Events
from dpmaster.live import LiveEntry, RingView
from dpmaster.parameters import BusParameters

__all__ = ["Listener"]


class Listener:
    """Listens on a port from now on. Arguments as those of `Master`; it has no address, as it is no member.

    Use it with ``with``, or call close(). Raises PortError, ConfigurationError; after close() every call raises ClosedError.
    """

    def __init__(self, port: str, baudrate: int = 500_000, *, parameters: BusParameters | None = None, echo: bool | None = None,
                 profile: str | None = None, allowance: float | None = None) -> None:
        chosen = parameters if parameters is not None else BusParameters.default(baudrate)
        rate = chosen.rate
        self.parameters = chosen
        self._bus = Bus(port, (rate.numerator, rate.denominator), echo=echo, profile=profile, allowance=allowance)
        config = ffi.new("dpm_master_config *")
        config.station.parameters = chosen.to_c()[0]
        config.station.role = lib.DPM_ROLE_PASSIVE
        config.slaves = 1
        config.data_control_time = NS
        try:
            self._bus.start(config, 1)
            self._bus.set_mode(Mode.STOP)
        except BaseException:
            self._bus.close()
            raise

    def __repr__(self) -> str:
        return f"<Listener on {self._bus.path}{', closed' if self._bus.closed else ''}>"

    @property
    def ring(self) -> RingView:
        """The masters that pass the token, complete after a rotation, and how long it takes."""
        return RingView.of(self._bus.ring(), member=False)

    @property
    def foreign(self) -> int | None:
        """The master heard last, by a token or a request; None: none yet."""
        address = self._bus.status().foreign
        return None if address < 0 else int(address)

    def live_list(self) -> Mapping[int, LiveEntry]:
        """Who was heard, by address 0..126: masters by their tokens, slaves by their answers; all others are unknown."""
        return live.entries(self._bus.ring(), range(live.HIGHEST + 1))

    def events(self, size: int = 256) -> Events:
        """Subscribe to events (LIVE, PORT), as `Master.events`."""
        return Events(self._bus, size)

    def wait(self, timeout: float) -> None:
        """Listen for `timeout` s. Raises PortError when the port vanished."""
        self._bus.wait(lambda: self._bus.check_port(), timeout)
        self._bus.check_port()

    @property
    def closed(self) -> bool:
        return self._bus.closed

    def close(self) -> None:
        """End the thread and close the port. Idempotent."""
        self._bus.close()

    def __enter__(self) -> Listener:
        self._bus.guard()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._bus.process.here:
            self.close()
