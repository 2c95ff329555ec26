# SPDX-License-Identifier: MIT
"""A station made from a GSD file: `Station` with settings by name and a process image by module.

The only file of this room that knows a station; `dpmaster.gsd` does not load it, so that reading files needs no bus.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

from dpmaster import _arguments
from dpmaster.errors import ConfigurationError
from dpmaster.gsd import GSD, Configuration, Parameters, Place
from dpmaster.gsd.configuration import Chosen
from dpmaster.identifier import IO_MAX
from dpmaster.station import Station


class GSDStation(Station):
    """A slave as its GSD file describes it; see `Station.from_gsd`. ``station["Drive"]`` or ``station[1]`` is a module."""

    def __init__(self, gsd: GSD | str | os.PathLike[str], address: int, modules: Iterable[Chosen] | None = None,
                 parameters: Mapping[Any, Any] | None = None, *, names: Mapping[str, int] | None = None,
                 dpv1: bool | None = None, alarms: Iterable[str] = (), fail_safe: bool | None = None, **options: Any) -> None:
        device = gsd if isinstance(gsd, GSD) else GSD.load(gsd)
        for ability in ("sync", "freeze"):
            if options.get(ability) and not getattr(device, ability):
                keyword = f"{ability.title()}_Mode_supp"
                raise ConfigurationError(f"{ability}=True: {device.title} can not, its GSD file says ({keyword} is not 1)")
        if device.ident_number is None:
            raise ConfigurationError(f"{device.title}: its GSD file has no Ident_Number, so no master can know the device")
        self.gsd: Configuration = device.configure(
            modules, parameters, names=names, dpv1=dpv1, alarms=alarms, fail_safe=fail_safe)
        """Modules, octets and texts; ``station.diagnosis.explain(station.gsd.texts)`` speaks the maker's words."""
        taken: dict[str, Any] = {"max_tsdr": self.gsd.max_tsdr, "min_slave_interval": device.min_slave_interval or 0}
        super().__init__(address, device.ident_number, self.gsd.octets, self.gsd.user_parameters,
                         fail_safe=self.gsd.fail_safe, **taken | options)
        self.gsd.watch(self._take)

    def _before_operate(self) -> list[str]:
        return [*super()._before_operate(), *self.gsd.notes]

    def _take(self, user_parameters: bytes) -> None:
        self.user_parameters = user_parameters

    @property
    def parameters(self) -> Parameters:
        """Settings of the station by name: ``station.parameters["Redundancy mode"] = "on"``; those of a module are
        ``station[2].parameters``. Set before `Master.add` they go out with the first Set_Prm; on a bus that runs, any number of
        them with ``station.reparameterise()``, which makes outputs safe. A station that returns before that may get the old."""
        return self.gsd.parameters

    def __getitem__(self, which: int | str) -> ModuleImage:
        """A module by its slot, by the name given to the slot, or by its own. Raises ConfigurationError for any other."""
        return ModuleImage(self, self.gsd[which])


class ModuleImage:
    """The part of a station's process image that is one module's; `place` says where it lies and what it is."""

    def __init__(self, station: GSDStation, place: Place) -> None:
        self.station = station
        self.place = place

    def __repr__(self) -> str:
        return f"<slot {self.place.slot} {self.place.name!r} of {self.station.name!r}>"

    @property
    def parameters(self) -> Parameters:
        """The module's settings, as `GSDStation.parameters`."""
        return self.place.parameters

    @property
    def inputs(self) -> bytes:
        """The newest input octets of the module. Those of two modules, read one after the other, can be of two telegrams."""
        span = self.place.inputs
        return self.station.inputs[span.offset : span.offset + span.length]

    @property
    def outputs(self) -> bytes:
        """What the next commit builds on, as `Station.outputs`. Setting commits all octets of the module."""
        span = self.place.outputs
        return self.station.outputs[span.offset : span.offset + span.length]

    @outputs.setter
    def outputs(self, octets: bytes) -> None:
        length = self.place.outputs.length
        self.update(0, _arguments.octets(f"outputs of {self!r}", octets, length, length))

    def update(self, offset: int, octets: bytes | bytearray | Iterable[int], keep: bytes = b"") -> int:
        """Change outputs of the module, `offset` counted in it, as `Station.update` does it; returns the commit's number."""
        span = self.place.outputs
        data = _arguments.octets(f"outputs of {self!r}", octets, 0, IO_MAX)
        if not isinstance(offset, int) or offset < 0 or offset + len(data) > span.length:
            raise ConfigurationError(f"{self!r} has {span.length} output octets; {len(data)} at offset {offset!r} do not fit")
        return self.station.update(span.offset + offset, data, keep)
