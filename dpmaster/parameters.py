# SPDX-License-Identifier: MIT
"""Bus parameters: the standard sets, their rules, and what they make of a cycle's time.

All times of a set are bit times (Tbit), as in every table and tool of PROFIBUS; whatever is said in seconds says so. The sums
are done by the C library (csrc/core/parameters.c); this file gives them names and words and touches nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any

from dpmaster._arguments import seconds
from dpmaster._core import NS, ffi, lib
from dpmaster.errors import ConfigurationError

__all__ = ["BAUDRATES", "BusParameters"]


def _baudrates() -> tuple[int, ...]:
    rates: list[int] = []
    while rate := lib.dpm_parameters_rate(len(rates)):
        rates.append(rate)
    return tuple(rates)


BAUDRATES = _baudrates()
"""The nominal rates, bit/s, lowest first. 45450 stands for 45.45 kbit/s, which is 500000/11."""

TSL_MAX = 16_383  # Tbit

_STANDARD_SET = "BusParameters.default(baudrate) gives the standard set"
_REMEDY = {
    "address": "give the master another address",
    "hsa": "raise hsa, or give the master a lower address",
    "tsl": "BusParameters.default(baudrate, max_tsdr) makes it long enough for the slowest station",
    "max_tsdr": "no station may take longer: look at the MaxTsdr of its GSD file, or lower tset and tqui",
}


@dataclass(frozen=True, slots=True)
class BusParameters:
    """One set of bus parameters, common to all stations of a bus. Times in Tbit; `check` tells whether the set is allowed.

    Begin with `BusParameters.default` and change single values with `dataclasses.replace`.
    """

    rate: Fraction
    """Bits per second, 9600 to 12 million."""
    tsl: int
    """Slot time: how long the first character of a reaction is waited for. 52..16383, at least max_tsdr + 15."""
    min_tsdr: int
    """No station answers earlier. 11..255, below max_tsdr and below 35 + 2 tset + tqui."""
    max_tsdr: int
    """No station answers later. 35 + 2 tset + tqui..1023."""
    tqui: int
    """Quiet time of modulators and repeater switches. 0..31, below min_tsdr."""
    tset: int
    """Setup time, from an event to the reaction. 1..255."""
    ttr: int
    """Target rotation time of the token. 256..16777960."""
    g: int
    """GAP update factor, in target rotation times. 1..100."""
    hsa: int
    """Highest station address a master may have. From the own address to 126."""
    max_retry_limit: int
    """Repetitions of a request that was not answered. 0..15."""

    @classmethod
    def default(cls, baudrate: int, max_tsdr: int = 0) -> BusParameters:
        """The standard set of a nominal rate in bit/s (one of `BAUDRATES`; 45454 and 45455 mean 45450).

        `max_tsdr`, Tbit, is the largest of all stations, where the standard's is not enough: Tsl grows with it. Raises
        `ConfigurationError` for other rates, and for a `max_tsdr` above 1023.
        """
        c = ffi.new("dpm_parameters *")
        try:
            code = lib.dpm_parameters_default(c, baudrate, max_tsdr)
        except (OverflowError, TypeError) as error:
            raise ConfigurationError(
                f"baudrate {baudrate!r}, max_tsdr {max_tsdr!r}: give whole numbers, a rate of BAUDRATES and 0 to 1023 Tbit "
                f"({error})") from None
        if code < 0:
            rates = ", ".join(map(str, BAUDRATES))
            raise ConfigurationError(f"baudrate {baudrate}: PROFIBUS has no such rate; use one of {rates}", dpm_code=code)
        values = {field.name: getattr(c, field.name) for field in fields(cls) if field.name != "rate"}
        parameters = cls(rate=Fraction(c.rate_num, c.rate_den), **values)
        parameters.check()
        return parameters

    @classmethod
    def for_ring(cls, baudrate: int, max_tsdr: int = 0, *, allowance: float) -> BusParameters:
        """The standard set with a Tsl that has room for a host which notices telegrams up to `allowance` s late.

        It may wake late, and a paced pty hands over a telegram when it is whole; ``dpmaster timing`` computes both.

        A master enters a ring only with such a Tsl, and all masters of the ring need the same. Raises `ConfigurationError` as
        `default`, and where no Tsl is long enough.
        """
        standard = cls.default(baudrate, max_tsdr)
        tsl = standard.ring_tsl(allowance)
        if tsl > TSL_MAX:
            raise ConfigurationError(
                f"allowance {allowance} s: in a ring it takes Tsl {tsl} at {baudrate} bit/s, and {TSL_MAX} is the most; take a "
                "lower rate, a port that wakes sooner, or stay the only master")
        return replace(standard, tsl=max(tsl, standard.tsl))

    def ring_tsl(self, allowance: float) -> int:
        """Tsl, Tbit, that a ring needs for a host which is up to `allowance` s late: max Tsdr + 15 + allowance."""
        if allowance:
            seconds("allowance", allowance, 1, ", or 0")
        return int(lib.dpm_ring_tsl(self.to_c(), round(allowance * NS)))

    def check(self, address: int = 0) -> None:
        """Raise `ConfigurationError`, naming parameter, value, rule and remedy, if a master at `address` cannot use the set."""
        c = self.to_c()
        if not isinstance(address, int):
            raise ConfigurationError(f"address {address!r}: it must be a whole number, 0 to 125; {_REMEDY['address']}")
        refusal = ffi.new("dpm_refusal *")
        # An address that is no octet breaks the same rule as 255 does.
        octet = address if 0 <= address <= 255 else 255
        code = lib.dpm_parameters_check(c, octet, refusal)
        if code == 0:
            return
        name, rule = (ffi.string(text).decode() for text in (refusal.parameter, refusal.rule))
        value = address if name == "address" else refusal.value
        raise ConfigurationError(
            f"bus parameter {name} = {value}: it must be {refusal.minimum} to {refusal.maximum} here ({rule}); "
            f"{_REMEDY.get(name, _STANDARD_SET)}", dpm_code=code)

    def to_c(self) -> Any:
        """A new ``dpm_parameters *``. Raises `ConfigurationError` for what is no whole number or does not fit the C field."""
        c = ffi.new("dpm_parameters *")
        rate = Fraction(self.rate)
        values = {"rate_num": rate.numerator, "rate_den": rate.denominator}
        values |= {field.name: getattr(self, field.name) for field in fields(self) if field.name != "rate"}
        for name, value in values.items():
            try:
                setattr(c, name, value)
            except (OverflowError, TypeError):
                most = 2 ** (8 * ffi.sizeof(dict(ffi.typeof("dpm_parameters").fields)[name].type)) - 1
                shown = f"rate = {self.rate}" if name.startswith("rate_") else f"{name} = {value!r}"
                raise ConfigurationError(
                    f"bus parameter {shown}: it must be a whole number, 0 to {most} at the very most; "
                    f"{_STANDARD_SET}") from None
        return c

    def seconds(self, bits: float) -> float:
        """`bits` Tbit in seconds."""
        return float(bits / self.rate)

    @property
    def tid1(self) -> int:
        """Idle time before a request that follows an answer or the token, Tbit: 35 + 2 Tset + Tqui, at least min Tsdr."""
        return int(lib.dpm_tid1(self.to_c()))

    @property
    def tid2(self) -> int:
        """Idle time before a request that follows one without an answer (SDN), Tbit: the longer of Tid1 and max Tsdr."""
        return int(lib.dpm_tid2(self.to_c()))

    def tto(self, address: int) -> int:
        """Silence after which the master at `address`, 0..126, takes the token for lost, Tbit: (6 + 2 n) Tsl."""
        return int(lib.dpm_tto(self.to_c(), address))

    def predict_exchange(self, outputs: int, inputs: int) -> int:
        """Longest undisturbed Data_Exchange with so many octets (0..244), idle time included, Tbit."""
        return int(lib.dpm_predict_exchange(self.to_c(), outputs, inputs))

    def predict_failure(self, outputs: int) -> int:
        """Data_Exchange request with so many octets (0..244) that nobody answers, Tbit."""
        return int(lib.dpm_predict_failure(self.to_c(), outputs))

    def predict_token(self) -> int:
        """The token to oneself, idle time included, Tbit."""
        return int(lib.dpm_predict_token(self.to_c()))

    def predict_global_control(self) -> int:
        """One Global_Control, idle time included, Tbit."""
        return int(lib.dpm_predict_global_control(self.to_c()))
