# SPDX-License-Identifier: MIT
"""What a master does beside its cycle: requests by hand, the services any station answers, Global_Control, Set_Slave_Add.

`Master` is a `Services`. Everything here waits for its turn between the cycle's own telegrams and touches no station object but
for its name. SAPs and octets: EN 50170 part 8.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from dpmaster import _arguments
from dpmaster._core import NS, ffi, lib, now
from dpmaster.bus import Bus, Mode
from dpmaster.diagnosis import NO_ANSWER, Diagnosis, result
from dpmaster.errors import ConfigurationError, DPTimeout, NotOperatingError, StationError

if TYPE_CHECKING:
    from dpmaster.station import Station

__all__ = ["Answer", "Service", "Services"]

UNADDRESSED = 126  # a slave that waits for its address
TRIES = 3  # of a service by hand: the first request to a station is never repeated by the FDL
LOOK = 0.05  # s between two looks for a slave at its new address

# Control_Command of Global_Control
_CLEAR, _UNFREEZE, _FREEZE, _UNSYNC, _SYNC = 0x02, 0x04, 0x08, 0x10, 0x20


class Service(IntEnum):
    """FDL services a program may ask for by hand; SRD and SDN are those of high priority, as DP uses them."""

    SDA_LOW = 0x03
    SDN_LOW = 0x04
    SDA = 0x05
    SDN = 0x06
    FDL_STATUS = 0x09
    SRD_LOW = 0x0C
    SRD = 0x0D
    IDENT = 0x0E
    LSAP_STATUS = 0x0F


@dataclass(frozen=True, slots=True)
class Answer:
    """What came back for a request by hand.

    ``fc`` is the answer's frame control, None for a short acknowledge and for SDN, which has no answer. ``tsdr`` is the time
    from the request's end to the answer's first bit in s, None where the port cannot tell. ``tries`` counts telegrams sent,
    0 for SDN.
    """

    fc: int | None
    data: bytes
    tsdr: float | None
    tries: int

    @property
    def ok(self) -> bool:
        """The service was carried out."""
        return self.fc is None or self.fc & 0x0F in (0x0, 0x8, 0x9, 0xA)

    @property
    def meaning(self) -> str:
        """The result in words: "RS, service not activated"."""
        if self.fc is None:
            return "acknowledged" if self.tries else "sent"
        return result(self.fc)


class Services:
    """The services of a master. Their `timeout` is in s for all telegrams of a call together, None: for ever.

    All of them raise ConfigurationError for bad arguments, StationError when a station does not answer or refuses, DPTimeout
    when there was no turn on the bus in time, PortError, ClosedError.
    """

    address: int
    cycle_time: float | None
    _bus: Bus

    @property
    @abstractmethod
    def mode(self) -> Mode: ...

    @property
    @abstractmethod
    def stations(self) -> tuple[Station, ...]: ...

    @abstractmethod
    def _start(self) -> None: ...

    @abstractmethod
    def _kept_out(self) -> str:
        """Who has the bus instead, for the end of an error; "" when nobody."""

    def _no_turn(self, what: str, timeout: float | None) -> DPTimeout:
        return DPTimeout(f"{what} had no turn on the bus in {timeout:.3g} s{self._kept_out()}")

    # ---- by hand

    def request(self, address: int, service: str | Service = Service.SRD, dsap: int | None = None, ssap: int | None = None,
                data: bytes = b"", timeout: float | None = 1.0) -> Answer:
        """Carry out one FDL service by hand, between the cycle's own telegrams, or in Stop on a bus that is otherwise idle.

        address: 0..126, 127 (all) for SDN. service: a `Service` or its name. dsap, ssap: 0..63, both or neither. data: up
        to 246 octets, 244 behind SAPs. Raises StationError when nobody answers, ConfigurationError, DPTimeout after
        `timeout` s without a turn on the bus.
        """
        raw = _raw_request(address, service, dsap, ssap, data)
        self._start()
        if self.mode == Mode.OFFLINE:
            self._bus.set_mode(Mode.STOP)
        if not self._bus.request(raw, timeout):
            self._bus.check_port()
            raise self._no_turn(f"the request to station {address}", timeout)
        if raw.status == lib.DPM_CONF_DS:
            self._bus.check_port()  # it may be the reason why nothing was asked
        return _answer(raw)

    def _name(self, address: int) -> str:
        return next((s.name for s in self.stations if s.address == address), f"station {address}")

    def _serve(self, address: int, service: str, sap: int | None, octets: bytes = b"", timeout: float | None = 1.0) -> bytes:
        """One DP service of one station: the data of its answer."""
        deadline = None if timeout is None else time.monotonic() + timeout
        own = None if sap is None else lib.DPM_SAP_MASTER
        for left in reversed(range(TRIES)):
            remaining = None if deadline is None else max(0.0, deadline - time.monotonic())
            try:
                answer = self.request(address, Service.SRD, sap, own, octets, remaining)
                break
            except StationError:
                if not left or remaining == 0.0:
                    raise
        if not answer.ok:
            raise StationError(f"{self._name(address)} refuses {service}: {answer.meaning}", address=address,
                               reason=answer.meaning)
        return answer.data

    # ---- services that a station answers to every master

    def slave_diag(self, address: int, timeout: float | None = 1.0) -> Diagnosis:
        """Slave_Diag of any station at 0..126, also of another master's and of one this master exchanges with."""
        octets = self._serve(address, "Slave_Diag", lib.DPM_SAP_SLAVE_DIAG, timeout=timeout)
        if len(octets) < 6:
            raise StationError(f"{self._name(address)} answered Slave_Diag with {len(octets)} octets, 6 at least are due",
                               address=address, reason="invalid answer")
        return Diagnosis(octets, time=now() / NS)

    def get_cfg(self, address: int, timeout: float | None = 1.0) -> bytes:
        """Get_Cfg of any station: its real configuration, identifiers as in Chk_Cfg (see `dpmaster.identifier.decode`)."""
        return self._serve(address, "Get_Cfg", lib.DPM_SAP_GET_CFG, timeout=timeout)

    def rd_inp(self, address: int, timeout: float | None = 1.0) -> bytes:
        """RD_Inp of any station: its present inputs. One that is not in Data_Exchange refuses, or has no data (b"")."""
        return self._serve(address, "RD_Inp", lib.DPM_SAP_RD_INP, timeout=timeout)

    def rd_outp(self, address: int, timeout: float | None = 1.0) -> bytes:
        """RD_Outp of any station: its present outputs. One that is not in Data_Exchange refuses, or has no data (b"")."""
        return self._serve(address, "RD_Outp", lib.DPM_SAP_RD_OUTP, timeout=timeout)

    # ---- Set_Slave_Add

    def set_slave_add(self, old: int, new: int, ident_number: int, lock: bool = False, *, rem_slave_data: bytes = b"",
                      timeout: float = 3.0) -> None:
        """Give the slave at `old` (0..126; 126 as it leaves the factory) the address `new` (0..125), and see that it has it.

        ident_number: the slave's own, which it must tell first. lock: the address cannot be changed again (No_Add_Chg) until
        the slave is reset to its factory settings. rem_slave_data: up to 240 octets that the slave keeps. timeout: s, which a
        slave may need to store it.

        Nothing is changed, and StationError says why, when `new` has a station already, the slave has another ident number, or
        a master has it. Raises StationError too when afterwards it is found at its old address, or nowhere.
        """
        octets = self._address_pdu(old, new, ident_number, lock, rem_slave_data)
        _arguments.seconds("timeout", timeout, 3600.0)
        deadline = time.monotonic() + timeout
        if self._is_there(new):
            raise StationError(f"address {new} has a station already: take that one off the bus, or give another address",
                               address=new, reason="the address is taken")
        self._check_unaddressed(old, ident_number)
        self._serve(old, "Set_Slave_Add", lib.DPM_SAP_SET_SLAVE_ADD, octets)
        while not self._has_ident(new, ident_number):
            if time.monotonic() >= deadline:
                raise self._not_moved(old, new, timeout)
            self._bus.wait(lambda: None, LOOK)

    def _address_pdu(self, old: int, new: int, ident_number: int, lock: bool, data: bytes) -> bytes:
        _arguments.whole("old", old, 0, UNADDRESSED)
        _arguments.whole("new", new, 0, lib.DPM_ADDRESS_MAX, " is what a slave can have")
        _arguments.whole("ident_number", ident_number, 0, 0xFFFF)
        kept = _arguments.octets("rem_slave_data", data, 0, 240)
        if old == new:
            raise ConfigurationError(f"old {old}, new {new}: give two different addresses")
        for address in (old, new):
            if address == self.address:
                raise ConfigurationError(f"address {address} is this master's own: give another")
            for station in self.stations:
                if station.address == address and station.active and self.mode >= Mode.CLEAR:
                    raise NotOperatingError(f"{station.name} at address {address} is in the master's cycle: deactivate() or "
                                            "remove() it first, or stop() the master")
        return bytes((new, *ident_number.to_bytes(2, "big"), 0xFF if lock else 0x00)) + kept

    def _is_there(self, address: int) -> bool:
        for _ in range(TRIES):
            try:
                self.request(address, Service.FDL_STATUS)
            except StationError:
                continue
            return True
        return False

    def _has_ident(self, address: int, ident_number: int) -> bool:
        try:
            return self.slave_diag(address).ident_number == ident_number
        except StationError:
            return False

    def _check_unaddressed(self, address: int, ident_number: int) -> None:
        found = self.slave_diag(address)
        if found.ident_number != ident_number:
            raise StationError(
                f"{self._name(address)} has ident number {found.ident_number:04X}h and not {ident_number:04X}h: nothing was "
                "changed", address=address, reason="has another ident number")
        if found.master is not None:
            raise StationError(f"{self._name(address)} belongs to master {found.master}, and takes an address only while it is "
                               "free: that master must release it first", address=address, reason="belongs to a master")

    def _not_moved(self, old: int, new: int, timeout: float) -> StationError:
        if self._is_there(old):
            reason = "kept its address: it is locked (No_Add_Chg), set by switches, or does not support Set_Slave_Add"
        else:
            reason = f"answers at neither address {timeout:g} s later: some take the new one only when switched off and on"
        return StationError(f"the slave at {old} acknowledged address {new} and {reason}", address=old, reason=reason)

    # ---- Global_Control

    def global_control(self, *, sync: bool | None = None, freeze: bool | None = None, clear: bool | None = None, group: int = 0,
                       station: Station | int | None = None, timeout: float | None = 1.0) -> None:
        """Global_Control to all, to a group or to one station; returns when it was sent.

        sync, freeze: True is the command, False its end (Unsync, Unfreeze), None leaves it as it is. group: Group_Select, a bit
        for each of 8 groups, 0: all. station: one of them, or its address, instead of a group.

        In Clear and Operate it goes out before the first Data_Exchange of a cycle, once each station concerned was given what
        was committed before the call: after Sync all of them show outputs of that moment. Stations obey what their
        ``sync=True`` or ``freeze=True`` asked for, and their own master only.

        clear=True makes the outputs of those concerned safe at once, and they stay so until clear=False or the next change of
        the mode; then only a new commit reaches them. clear=None leaves that, and the mode's own Clear_Data, as it is.

        It may take two cycles, so `timeout` counts beside two fixed cycle times. In Stop it is sent at once, to whatever slaves
        listen. Raises NotOperatingError for clear=False in Clear,
        ConfigurationError when no station concerned can obey.
        """
        _arguments.whole("group", group, 0, 255, ", a bit for each of 8 groups")
        at = _destination(station)
        if group and station is not None:
            raise ConfigurationError(f"group {group:02X}h, station {at}: give one of them")
        command = _switched("sync", sync, _SYNC, _UNSYNC) | _switched("freeze", freeze, _FREEZE, _UNFREEZE)
        _switched("clear", clear, 0, 0)
        if sync is freeze is clear is None:
            raise ConfigurationError("global_control() without a command: give sync, freeze or clear")
        self._start()
        if self.mode < Mode.CLEAR:
            octets = bytes((command | (_CLEAR if clear else 0), group))
            self.request(at, Service.SDN, lib.DPM_SAP_GLOBAL_CONTROL, lib.DPM_SAP_MASTER, octets, timeout)
            return
        if clear is False and self.mode == Mode.CLEAR:
            raise NotOperatingError("clear=False in Clear, which holds for all stations: operate() first")
        self._check_concerned(at, group, bool(sync), bool(freeze))
        control = ffi.new("dpm_control *")
        control.da, control.command, control.group, control.clear = at, command, group, -1 if clear is None else clear
        within = _arguments.paced(timeout, self.cycle_time, 2)
        if not self._bus.order(control, within):
            self._bus.check_port()
            raise self._no_turn("Global_Control, which will not be sent,", within)

    def _check_concerned(self, at: int, group: int, sync: bool, freeze: bool) -> None:
        """A command that nobody obeys would look like one that was carried out."""
        concerned = [s for s in self.stations if s.active and at in (s.address, lib.DPM_BROADCAST)
                     and (not group or group & s.group)]
        if not concerned:
            whom = f"in group {group:02X}h" if group else "there" if at == lib.DPM_BROADCAST else f"at address {at}"
            raise ConfigurationError(f"Global_Control: no active station of this master is {whom}")
        for name, wanted in (("sync", sync), ("freeze", freeze)):
            if wanted and not any(getattr(s, name) for s in concerned):
                raise ConfigurationError(f"{name}=True: Set_Prm told no station concerned of it: make it with {name}=True")


def _destination(station: Station | int | None) -> int:
    if station is None:
        return int(lib.DPM_BROADCAST)
    address = station if isinstance(station, int) else getattr(station, "address", station)
    return _arguments.whole("station", address, 0, lib.DPM_ADDRESS_MAX)


def _switched(name: str, value: bool | None, on: int, off: int) -> int:
    if value not in (None, False, True):
        raise ConfigurationError(f"{name} {value!r}: True, False, or None to leave it as it is")
    return 0 if value is None else on if value else off


def _raw_request(address: int, service: str | Service, dsap: int | None, ssap: int | None, data: bytes) -> Any:
    """A checked ``dpm_raw``."""
    try:
        chosen = Service[service.upper()] if isinstance(service, str) else Service(service)
    except (KeyError, ValueError):
        raise ConfigurationError(f"service {service!r}: one of {', '.join(s.name for s in Service)}") from None
    highest = 127 if chosen in (Service.SDN, Service.SDN_LOW) else 126
    _arguments.whole("address", address, 0, highest, f" for {chosen.name}")
    if (dsap is None) != (ssap is None):
        raise ConfigurationError(f"dsap {dsap}, ssap {ssap}: give both or neither")
    for name, sap in (("dsap", dsap), ("ssap", ssap)):
        if sap is not None:
            _arguments.whole(name, sap, 0, 63)
    room = lib.DPM_DATA_MAX if dsap is None else lib.DPM_IO_MAX
    octets = _arguments.octets("data", data, 0, room, f", with SAPs {lib.DPM_IO_MAX}")
    raw = ffi.new("dpm_raw *")
    raw.da, raw.function = address, chosen
    raw.dsap = lib.DPM_NO_SAP if dsap is None else dsap
    raw.ssap = lib.DPM_NO_SAP if ssap is None else ssap
    raw.length = len(octets)
    raw.data = octets
    return raw


def _answer(raw: Any) -> Answer:
    """The confirmation, or why there is none."""
    tsdr = None if raw.tsdr < 0 else raw.tsdr / NS
    if raw.status == lib.DPM_CONF_SENT:
        return Answer(None, b"", None, 0)
    if raw.status == lib.DPM_CONF_ANSWER:
        return Answer(None if raw.short_ack else raw.fc, bytes(ffi.buffer(raw.answer, raw.answer_length)), tsdr, raw.tries)
    reason = {
        lib.DPM_CONF_NA: NO_ANSWER,
        lib.DPM_CONF_INVALID: "answered with something that is no answer to this request",
    }.get(raw.status, "was not asked: the master lost the token or left the bus")
    raise StationError(f"station {raw.da} {reason}", address=raw.da, reason=reason)
