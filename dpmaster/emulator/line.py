# SPDX-License-Identifier: MIT
"""Emulated cards on somebody else's wire: a serial port, or a port of a segment in another process."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

from dpmaster import _arguments
from dpmaster._core import check, ffi, lib
from dpmaster.bus import allowance_ns, direction_code, port_error
from dpmaster.emulator.card import Card
from dpmaster.emulator.host import Host, bus_parameters, describe
from dpmaster.errors import ConfigurationError, PortError
from dpmaster.realtime import Realtime, schedule, wished

__all__ = ["Line"]


class Line(Host):
    """Opens `port` at `baudrate` (bit/s) and answers there for `cards`, all of which must be known from the start: the
    slaves' machine belongs to the bus thread from then on. `realtime`, `direction` and `allowance` are as `Master`'s; what came
    of the first is in `scheduling`. Raises PortError when the port cannot be opened.
    """

    _room = "dpm_bus"

    def __init__(self, port: str, *cards: Card, baudrate: int, realtime: Realtime | bool | None = None,
                 direction: str | None = None, allowance: float | None = None) -> None:
        super().__init__()
        wished(realtime)
        if not cards:
            raise ConfigurationError("cards: a line needs at least one card")
        self._path = _arguments.path(port)
        self._parameters = parameters = bus_parameters(baudrate)
        self._rate = baudrate
        try:
            self._open(parameters, getattr(port, "paced", None), direction_code(direction), allowance_ns(allowance))
            self._make_slaves(parameters, len(cards))
            for card in cards:
                self._attach(card)
            check(lib.dpm_bus_start_slaves(self._object, self._slaves), "start a line")
            info = self._info()
            self.scheduling = schedule(realtime, info.port.profile != lib.DPM_PROFILE_PTY,
                                       partial(self._call, "realtime"), list(self._kept),
                                       f"the line on {self._path}")
            self._begin()
        except BaseException:
            self._end()
            raise

    def _open(self, parameters: Any, paced: bool | None, direction: int, allowance: int) -> None:
        path = ffi.new("char[]", os.fsencode(self._path))
        config = ffi.new("dpm_port_config *", {"path": path, "allowance": allowance, "direction": direction})
        config.rate_num, config.rate_den = parameters.rate_num, parameters.rate_den
        config.pace = {None: lib.DPM_PACE_AUTO, False: lib.DPM_PACE_NONE, True: lib.DPM_PACE_BAUD}[paced]
        size = lib.dpm_bus_size()
        code = lib.dpm_bus_open(self._keep(size), size, config, self._opened)
        if code < 0:
            raise port_error(self._path, code)

    def _make_slaves(self, parameters: Any, count: int) -> None:
        traits = ffi.new("dpm_port_traits *")
        lib.dpm_bus_get_traits(self._object, traits)
        size = lib.dpm_slaves_size(count)
        out = ffi.new("dpm_slaves **")
        check(lib.dpm_slaves_init(self._keep(size), size, parameters, traits, count, out), "make slaves")
        self._slaves = out[0]

    def _add(self, config: Any, outputs: Any, inputs: Any) -> int:
        code: int = lib.dpm_slaves_add(self._slaves, config, outputs, inputs)
        return code

    def _shut(self) -> None:
        lib.dpm_bus_close(self._object)

    @property
    def tsl(self) -> int:
        """The least slot time, Tbit, that the line's master must be set to: a card behind an operating system answers late."""
        traits = ffi.new("dpm_port_traits *")
        lib.dpm_bus_get_traits(self._object, traits)
        return int(lib.dpm_ring_tsl(self._parameters, traits.allowance))

    def _info(self) -> Any:
        info = ffi.new("dpm_bus_info *")
        check(lib.dpm_bus_get_info(self._object, info), f"state of {self._path}")
        return info

    def check(self) -> None:
        """Raise what has gone wrong: DPError when a card failed, PortError when the port has vanished."""
        super().check()
        info = self._info()
        if info.port_error:
            cards = ", ".join(describe(slot.card) for slot in self._slots)
            text = ffi.string(lib.dpm_strerror(info.port_error)).decode()
            raise PortError(f"{self._path}: {text}; on it: {cards}", path=self._path, dpm_code=info.port_error)
