# SPDX-License-Identifier: MIT
"""Telegrams for programs and people: octets to fields and back, and one readable line for each.

What is good and what is bad is judged in C (``telegram.h``); this file names things. It knows no port and no time.
Names of functions, results and services are those of IEC 61158-4-3 and of the DP service access points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from dpmaster._core import check, ffi, lib
from dpmaster.errors import DPError

__all__ = ["Format", "Rejected", "Telegram", "TelegramError", "decode", "decode_all"]


class Format(IntEnum):
    """The start delimiter, which is also the format."""

    SD1 = 0x10  #: no data
    SD2 = 0x68  #: variable length
    SD3 = 0xA2  #: eight octets behind FC
    SD4 = 0xDC  #: token
    SC = 0xE5  #: short acknowledge


REQUESTS = {
    0x0: "TE", 0x3: "SDA_low", 0x4: "SDN_low", 0x5: "SDA_high", 0x6: "SDN_high", 0x7: "MSRD", 0x9: "FDL_Status",
    0xC: "SRD_low", 0xD: "SRD_high", 0xE: "Ident", 0xF: "LSAP_Status",
}
RESPONSES = {
    0x0: "OK", 0x1: "UE", 0x2: "RR", 0x3: "RS", 0x8: "DL", 0x9: "NR", 0xA: "DH", 0xC: "RDL", 0xD: "RDH",
}
STATION_TYPES = ("slave", "master_not_ready", "master_ready", "master_in_ring")
SERVICES = {  # by the SAP of the slave
    49: "MS2_Initiate", 50: "Alarm", 51: "MS1", 53: "Set_Ext_Prm", 54: "Master_Master", 55: "Set_Slave_Add",
    56: "RD_Inp", 57: "RD_Outp", 58: "Global_Control", 59: "Get_Cfg", 60: "Slave_Diag", 61: "Set_Prm", 62: "Chk_Cfg",
} | {sap: f"MS2_{sap}" for sap in range(49)}
_EXCHANGES = {"MSRD", "SRD_low", "SRD_high", "DL", "DH", "RDL", "RDH"}  # without a SAP they carry Data_Exchange


class TelegramError(DPError, ValueError):
    """Octets that begin no good telegram. ``reason`` is the receiver's: "FCS", "length twice", "incomplete", ..."""

    def __init__(self, message: str, *, reason: str) -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_error, (str(self), self.reason)


def _rebuild_error(message: str, reason: str) -> TelegramError:
    return TelegramError(message, reason=reason)


_RULES = {  # what a person can compare the octets with
    "delimiter": "a telegram begins with 10 (SD1), 68 (SD2), A2 (SD3), DC (token) or E5 (SC)",
    "length": "LE counts DA to the last data octet, 3..249",
    "length twice": "LE is sent twice and both must be equal",
    "second delimiter": "68 LE LE must be followed by 68",
    "FCS": "FCS is the sum of DA to the last data octet, modulo 256",
    "end delimiter": "FCS must be followed by 16",
    "address": "SA is 0..126, in a token DA and SA are 0..125",
    "extension": "bit 7 of DA or SA announces a SAP, a segment, or a segment and then a SAP, inside the telegram",
    "incomplete": "the octets end before the telegram does",
}


def _hex(octets: bytes) -> str:
    return octets.hex(" ").upper()


@dataclass(frozen=True, slots=True)
class Telegram:
    """One telegram. Token and SC have addresses or nothing; every other format has `fc` and may have data.

    `da` 0..127, `sa` 0..126, `fc` the frame control octet, `dsap`/`ssap` 0..63 or None, `dsegment`/`ssegment`
    region/segment addresses 0..63 or None, `data` what lies behind the address extensions. `format` None lets `encode`
    choose: SD1 when nothing lies behind FC, else SD2.
    """

    da: int = 0
    sa: int = 0
    fc: int = 0
    data: bytes = b""
    dsap: int | None = None
    ssap: int | None = None
    dsegment: int | None = None
    ssegment: int | None = None
    format: Format | None = None

    @property
    def is_request(self) -> bool:
        """Bit 6 of FC. Token and SC are neither request nor response."""
        return self._has_fc and bool(self.fc & 0x40)

    @property
    def is_response(self) -> bool:
        return self._has_fc and not self.fc & 0x40

    @property
    def fcb(self) -> bool:
        """Frame count bit of a request."""
        return self.is_request and bool(self.fc & 0x20)

    @property
    def fcv(self) -> bool:
        """Frame count bit valid."""
        return self.is_request and bool(self.fc & 0x10)

    @property
    def function(self) -> str:
        """What FC says: "SRD_high", "FDL_Status", "DL", "RS", ...; "Token", "SC"."""
        if not self._has_fc:
            return "SC" if self.format is Format.SC else "Token"
        code = self.fc & 0x0F
        if self.is_request:
            return "CV" if self.fc & 0x8F == 0x80 else REQUESTS.get(code, f"reserved_{code:X}")
        return RESPONSES.get(code, f"reserved_{code:X}")

    @property
    def station_type(self) -> str | None:
        """Of the responder: "slave", "master_in_ring", ...; None when this is no response."""
        return STATION_TYPES[self.fc >> 4 & 3] if self.is_response else None

    @property
    def service(self) -> str | None:
        """The DP service, by the slave's SAP; Data_Exchange is the one without."""
        sap = self.dsap if self.is_request else self.ssap
        if sap is not None:
            return SERVICES.get(sap)
        return "Data_Exchange" if self.function in _EXCHANGES and self.dsap is None and self.ssap is None else None

    def encode(self) -> bytes:
        """The octets. ConfigurationError when a field is outside its range or would not survive the way back."""
        for name in ("da", "sa", "fc"):
            self._within(name, getattr(self, name), 0xFF)
        for name in ("dsap", "ssap", "dsegment", "ssegment"):
            value = getattr(self, name)
            if value is not None:
                self._within(name, value, 63)
        self._within("octets of data:", len(self.data), lib.DPM_DATA_MAX)
        data = ffi.from_buffer("uint8_t[]", self.data)
        sides = (-1 if e is None else e for e in (self.dsap, self.ssap, self.dsegment, self.ssegment))
        fields = (self.format or 0, self.da, self.sa, self.fc, *sides, len(self.data), data)
        telegram = ffi.new("dpm_telegram *", fields)
        out = ffi.new("uint8_t[]", lib.DPM_TELEGRAM_MAX)
        n = check(lib.dpm_encode(telegram, out, len(out)), "cannot encode the telegram", da=self.da, sa=self.sa,
                  format=self.format.name if self.format else "any", octets=len(self.data))
        return bytes(ffi.buffer(out, n))

    def describe(self) -> str:
        """One line: ``SRD_high 2 -> 5 FCB=1 FCV=0 Slave_Diag (60 <- 62) [..]``."""
        if self.format is Format.SC:
            return "SC"
        words = [self.function, f"{self.sa} -> {self.da}"]
        if self.is_request:
            words.append(f"FCB={self.fcb:d} FCV={self.fcv:d}")
        elif self.is_response and self.station_type and (self.fc & 0x30 or self.function == "OK"):
            words.append(self.station_type)
        if self.service:
            words.append(self.service)
        sides = [self._side(self.dsegment, self.dsap), self._side(self.ssegment, self.ssap)]
        if any(sides):
            words.append(f"({sides[0] or '-'} <- {sides[1] or '-'})")
        if self.data:
            words.append(f"[{_hex(self.data)}]")
        return " ".join(words)

    @property
    def _has_fc(self) -> bool:
        return self.format not in (Format.SD4, Format.SC)

    @staticmethod
    def _side(segment: int | None, sap: int | None) -> str:
        return ".".join(([] if segment is None else [f"segment {segment}"]) + ([] if sap is None else [str(sap)]))

    @staticmethod
    def _within(name: str, value: int, limit: int) -> None:
        if not 0 <= value <= limit:
            check(lib.DPM_E_ARGUMENT, f"{name} {value} is not in 0..{limit}")


@dataclass(frozen=True, slots=True)
class Rejected:
    """Octets that belong to no good telegram, and why: the reason of the first that looked like a beginning."""

    octets: bytes
    reason: str

    def describe(self) -> str:
        return f"rejected, {self.reason}: {_RULES[self.reason]} [{_hex(self.octets)}]"


def _decode(octets: bytes, offset: int) -> tuple[Telegram | None, int]:
    """The telegram and its octets, or None and minus the reason, which is 0 when more octets are needed."""
    raw = ffi.new("dpm_telegram *")
    window = octets[offset : offset + lib.DPM_TELEGRAM_MAX]
    n = lib.dpm_decode(ffi.from_buffer("uint8_t[]", window), len(window), raw)
    if n <= 0:
        return None, n
    dsap, ssap, dsegment, ssegment = (None if e < 0 else int(e) for e in (raw.dsap, raw.ssap, raw.dsegment, raw.ssegment))
    data = bytes(ffi.buffer(raw.data, raw.length)) if raw.length else b""
    return Telegram(raw.da, raw.sa, raw.fc, data, dsap, ssap, dsegment, ssegment, Format(raw.format)), n


def _reason(verdict: int) -> str:
    name: bytes = ffi.string(lib.dpm_reject_name(-verdict or lib.DPM_REJECT_INCOMPLETE))
    return name.decode()


def decode(octets: bytes) -> tuple[Telegram, int]:
    """The telegram at octets[0] and how many octets it takes. TelegramError with the reason when none does."""
    octets = bytes(octets)
    telegram, n = _decode(octets, 0)
    if telegram is None:
        reason = _reason(n)
        begin = _hex(octets[:8]) or "nothing"
        raise TelegramError(f"no telegram begins with {begin}: {reason} ({_RULES[reason]})", reason=reason)
    return telegram, n


def decode_all(octets: bytes) -> Iterator[Telegram | Rejected]:
    """Everything in a stretch of octets after which the bus fell silent, in order; no octet is left out.

    The receiver's rules: what is proved bad costs one octet, and the next good telegram is found wherever it begins.
    """
    octets = bytes(octets)
    at = start = 0
    reason = ""
    while at < len(octets):
        telegram, n = _decode(octets, at)
        if telegram is None:
            if reason in ("", "delimiter"):
                reason = _reason(n)
            at += 1
            continue
        if start < at:
            yield Rejected(octets[start:at], reason)
        yield telegram
        at = start = at + n
        reason = ""
    if start < at:
        yield Rejected(octets[start:at], reason)
