# SPDX-License-Identifier: MIT
"""A slave described by data alone, ident number and modules or a GSD file; a program sees its outputs and sets its inputs.

Any thread may call anything. What a program changes is on the wire with the next answer, what a master writes is here as
soon as the host's thread runs.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any, Self

from dpmaster import _arguments
from dpmaster._errand import SLICE
from dpmaster.emulator.card import Card, Exchange, Habits, Slave, SlaveState
from dpmaster.errors import ClosedError, ConfigurationError, DPError, DPTimeout
from dpmaster.gsd import GSD
from dpmaster.gsd.configuration import Chosen
from dpmaster.gsd.model import plain
from dpmaster.identifier import decode

__all__ = ["GenericSlave", "Module"]

IDLE = 10.0
"""Seconds between two steps while nothing happens: it has no life of its own."""


class Module:
    """A place of the configuration in force, with its part of the images. An empty one has neither."""

    name = ""
    """As the GSD file calls it."""

    def __init__(self, slave: GenericSlave, slot: int, identifier: int, octets: bytes, inputs: slice, outputs: slice) -> None:
        self._slave, self._inputs, self._outputs = slave, inputs, outputs
        self.slot = slot
        """From 1, or from what the GSD file begins with."""
        self.identifier = identifier
        """Number of its first identifier, from 1: what diagnosis counts by."""
        self.octets = octets
        """Its identifiers."""

    @property
    def outputs(self) -> bytes:
        """What the master wrote, as `GenericSlave.outputs`."""
        return self._slave.outputs[self._outputs]

    @property
    def inputs(self) -> bytes:
        """What the master reads. To be set in its whole length."""
        return self._slave.inputs[self._inputs]

    @inputs.setter
    def inputs(self, octets: bytes | bytearray | Iterable[int]) -> None:
        size = self._inputs.stop - self._inputs.start
        found = _arguments.octets(f"inputs of slot {self.slot}", octets, size, size)
        if found:
            self._slave.update(self._inputs.start, found)

    def __repr__(self) -> str:
        return f"<slot {self.slot}{f' {self.name!r}' if self.name else ''} of {self._slave}: {self.octets.hex(' ')}>"


@dataclass(frozen=True, slots=True)
class _Layout:
    """A configuration, taken apart."""

    modules: tuple[Module, ...]
    inputs: int
    outputs: int


class GenericSlave(Card):
    """A slave at `address` (0 to 126; 126 waits for Set_Slave_Add) with `modules`, the identifier octets of each.

    modules: an empty place is ``b"\\0"``; a module of several identifiers is one entry. Given as one ``bytes``, each identifier
    is a module. `others` are further configurations that Chk_Cfg accepts, each one ``bytes``. user_parameters: fewest and
    most octets of User_Prm_Data. `substitute` are the outputs that are shown while those of the master do not count, zeros
    by default. `echo`: the inputs are the outputs, as far as they reach. `on_change` is called in the host's thread after
    outputs or state have changed. The rest is as `Card` describes it.

    Raises ConfigurationError for modules that no decoder accepts.
    """

    def __init__(
        self, address: int, ident_number: int, modules: bytes | Iterable[bytes], *, others: Iterable[bytes] = (),
        user_parameters: tuple[int, int] = (0, 237), fail_safe: bool = False, sync: bool = True, freeze: bool = True,
        max_diagnosis: int = 244, min_slave_interval: int = 0, set_address: bool = False, address_locked: bool = False,
        auto_baud: bool = False, baud_control: float = 0.0, identity: tuple[str, str, str, str] | None = None,
        habits: Habits | None = None, substitute: bytes = b"", echo: bool = False,
        on_change: Callable[[GenericSlave], None] | None = None,
    ) -> None:
        self.address = _arguments.whole("address", address, 0, 126)
        self.ident_number = _arguments.whole("ident_number", ident_number, 0, 0xFFFF)
        self._layouts = tuple(self._layout(_modules(configuration)) for configuration in (modules, *others))
        self.configurations = tuple(b"".join(module.octets for module in layout.modules) for layout in self._layouts)
        self.user_parameters, self.max_diagnosis = user_parameters, _arguments.whole("max_diagnosis", max_diagnosis, 6, 244)
        self.fail_safe, self.sync, self.freeze = fail_safe, sync, freeze
        self.min_slave_interval, self.identity, self.habits = min_slave_interval, identity, habits or Habits()
        self.set_address, self.address_locked = set_address, address_locked
        self.auto_baud, self.baud_control = auto_baud, baud_control
        self.substitute, self.echo, self.on_change = bytes(substitute), echo, on_change
        self._inputs = bytearray(max(layout.inputs for layout in self._layouts))
        self._changed = threading.Condition(threading.RLock())
        self._exchange = Exchange()
        self._diagnosis: tuple[bytes, bool, bool, bool] | None = None
        self._ready = True
        self._gone = False
        self._telling: int | None = None  # the thread that is in `on_change`

    @classmethod
    def from_gsd(cls, gsd: GSD | str | PathLike[str], modules: Iterable[Chosen] | None = None, *, address: int,
                 names: Mapping[str, int] | None = None, **options: Any) -> Self:
        """The slave that a GSD file describes, with modules chosen as for `GSD.configure`; None: its default modules.

        It takes User_Prm_Data of exactly the length that its modules ask for, and no other configuration. `options` are those
        of `GenericSlave` and go before what the file says. A search of the rate is one of them: with `auto_baud=True` the
        first answer comes up to 1.3 s late.
        Raises ConfigurationError when the file is no slave's or the modules do not fit.
        """
        device = gsd if isinstance(gsd, GSD) else GSD.load(gsd)
        if device.ident_number is None or device.station_type:
            what = "describes a master" if device.station_type else "has no Ident_Number"
            raise ConfigurationError(f"{device.title}: its GSD file {what}, so there is no slave to emulate")
        chosen = device.configure(modules, names=names)
        length = len(chosen.user_parameters)
        said: dict[str, Any] = {
            "user_parameters": (length, length), "fail_safe": device.fail_safe, "sync": device.sync, "freeze": device.freeze,
            "max_diagnosis": min(max(device.max_diag_length or 6, 6), 244), "set_address": device.set_slave_add,
            "min_slave_interval": device.min_slave_interval or 0,
        }
        slave = cls(address, device.ident_number, [place.module.configuration for place in chosen], **said | options)
        for module, place in zip(slave.modules, chosen, strict=True):
            module.slot, module.name = place.slot, place.name
        return slave

    def _layout(self, modules: Iterable[bytes]) -> _Layout:
        found: list[Module] = []
        identifier, inputs, outputs = 1, 0, 0
        for module in modules:
            parts = decode(module)
            ends = (inputs + sum(part.inputs.octets for part in parts if part.inputs),
                    outputs + sum(part.outputs.octets for part in parts if part.outputs))
            found.append(Module(self, len(found) + 1, identifier, module, slice(inputs, ends[0]), slice(outputs, ends[1])))
            identifier, inputs, outputs = identifier + len(parts), *ends
        decode(b"".join(module.octets for module in found))  # the sums have limits of their own
        return _Layout(tuple(found), inputs, outputs)

    # -- What a program sees and does ------------------------------------------------------------------------------

    @property
    def exchange(self) -> Exchange:
        """State, master, configuration, outputs, all of one moment."""
        return self._exchange

    @property
    def state(self) -> SlaveState:
        return self._exchange.state

    @property
    def modules(self) -> tuple[Module, ...]:
        """Those of the configuration that the master has chosen, or else of the slave's own."""
        return self._layouts[max(self._exchange.configuration, 0)].modules

    def __getitem__(self, which: int | str) -> Module:
        """The module in a slot, or of a name. Raises ConfigurationError for any other."""
        found = [m for m in self.modules if m.slot == which or (isinstance(which, str) and plain(m.name) == plain(which))]
        if len(found) != 1:
            there = ", ".join(f"{m.slot} {m.name}".rstrip() for m in self.modules)
            many = "several modules" if found else "no module"
            raise ConfigurationError(f"{self} has {many} {which!r}: its slots are {there}")
        return found[0]

    @property
    def outputs(self) -> bytes:
        """What the master wrote; `substitute` in Clear, behind a loss and before the first Data_Exchange."""
        exchange = self._exchange
        size = self._layouts[max(exchange.configuration, 0)].outputs
        return exchange.outputs if exchange.valid else self.substitute[:size].ljust(size, b"\0")

    @property
    def inputs(self) -> bytes:
        """What the master reads. To be set in its whole length; `update` sets a part."""
        with self._changed:
            return bytes(self._inputs[: self._layouts[max(self._exchange.configuration, 0)].inputs])

    @inputs.setter
    def inputs(self, octets: bytes | bytearray | Iterable[int]) -> None:
        size = self._layouts[max(self._exchange.configuration, 0)].inputs
        found = _arguments.octets(f"inputs of {self}", octets, size, size)
        if found:
            self.update(0, found)

    def update(self, offset: int, octets: bytes | bytearray | Iterable[int]) -> None:
        """Change some inputs, in one step."""
        with self._changed:
            size = len(self._inputs)
            start = _arguments.whole(f"offset in the inputs of {self}", offset, 0, max(size - 1, 0), f"; it has {size} octets")
            found = _arguments.octets(f"inputs of {self} from octet {start}", octets, 1, size - start, f" of its {size}")
            self._inputs[start : start + len(found)] = found
        if self.slave is not None:
            self.slave.refresh()

    def diagnosis(self, *blocks: bytes, fault: bool | None = None, static: bool = False, announce: bool = True) -> None:
        """Diagnosis behind the six standard octets, made with `emulator.blocks` or by hand; without blocks there is none.

        fault: Ext_Diag, "the blocks tell of a fault"; by default if there are any. static: Stat_Diag, the master reads
        diagnosis instead of data until it is gone. announce: raise the diagnosis flag (DH) until the master has read it.
        What exceeds `max_diagnosis` is cut off and reported as overflow.
        """
        octets = b"".join(bytes(block) for block in blocks)
        self._diagnosis = octets, announce, bool(octets) if fault is None else fault, static
        self._tell()

    @property
    def ready(self) -> bool:
        """While False the slave says Station_Not_Ready, and no master exchanges data with it."""
        return self._ready

    @ready.setter
    def ready(self, ready: bool) -> None:
        self._ready = bool(ready)
        if self.slave is not None:
            self.slave.set_ready(self._ready)

    def wait(self, predicate: Callable[[Self], bool], timeout: float | None = 1.0) -> None:
        """Wait until `predicate(slave)` is true; it is asked now and after every change of outputs or state.

        Raises DPTimeout after `timeout` s (None: never), ClosedError when the wire is closed, DPError in `on_change`.
        """
        _arguments.timeout(timeout)
        if self._telling == threading.get_ident():
            raise DPError(f"{self}: wait() in on_change would wait for the thread that is in it: look at `outputs` there, "
                          "or wait in a thread of your own")
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        seen = None
        while seen is not self._exchange:
            seen = self._exchange
            if predicate(self):  # not under the lock: it may set inputs, which takes the host's
                return
            with self._changed:
                while seen is self._exchange and not self._gone and (left := deadline - time.monotonic()) > 0:
                    self._changed.wait(min(left, SLICE))  # a Ctrl-C straight before it does not end it
        if self._gone:
            raise ClosedError(f"{self}: its wire was closed")
        raise DPTimeout(f"{self}: what was waited for did not come in {timeout} s; it is in {self.state}, outputs "
                        f"{self.outputs.hex(' ') or 'none'}")

    def __str__(self) -> str:
        return f"slave {self.ident_number:04X}h at address {self.address}"

    # -- What the host does ----------------------------------------------------------------------------------------

    def attached(self, slave: Slave) -> None:
        super().attached(slave)
        self._gone = False
        slave.set_ready(self._ready)
        self._tell()

    def detached(self) -> None:
        super().detached()
        with self._changed:
            self._gone = True
            self._changed.notify_all()

    def _tell(self) -> None:
        if self.slave is not None and self._diagnosis is not None:
            octets, announce, fault, static = self._diagnosis
            self.slave.diagnose(octets, announce=announce, ext_diag=fault, static_diag=static)

    def step(self, now: float, exchange: Exchange) -> bytes:
        with self._changed:
            changed, self._exchange = exchange != self._exchange, exchange
            if self.echo:
                self._inputs[: len(self.outputs)] = self.outputs[: len(self._inputs)]
            self._changed.notify_all()
        if changed and self.on_change is not None:
            self._telling = threading.get_ident()
            try:
                self.on_change(self)
            finally:
                self._telling = None
        return self.inputs

    def next_step(self, now: float) -> float:
        return now + IDLE

    def reset(self, now: float) -> None:
        with self._changed:
            self._inputs[:] = bytes(len(self._inputs))
            self._diagnosis = None



def _modules(configuration: bytes | Iterable[bytes]) -> list[bytes]:
    if isinstance(configuration, bytes | bytearray):
        return [identifier.encode() for identifier in decode(bytes(configuration))]
    return [_arguments.octets("module", module, 0, 244) for module in configuration]
