# SPDX-License-Identifier: MIT
"""Times of a bus before it runs: bus parameters, the cycle with its parts, slave watchdogs, and what will not work.

Pure: from descriptions to numbers, with no port, thread or state. `Master` takes its prediction and its default watchdog
from here, ``dpmaster timing`` prints them. The sums over one telegram are the C library's (csrc/core/parameters.c), and so is
what a kind of port may be late; this file adds up telegrams and says what the rules make of the result.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any

from dpmaster._arguments import number, whole
from dpmaster._core import NS, check, ffi, lib
from dpmaster.cable import REPEATERS, STATIONS, limits
from dpmaster.errors import ConfigurationError
from dpmaster.parameters import BAUDRATES, TSL_MAX, BusParameters
from dpmaster.station import Station, Watchdog, watchdog_factors

__all__ = ["Cycle", "Finding", "Part", "Slave", "Timing", "cycle", "default_watchdog", "plan"]

TSL_MARGIN = 15  # Tbit: "Tsl >= max Tsdr + 15"
MAX_TSDR_MAX, TTR_MAX = 1_023, 16_777_960  # Tbit
WATCHDOG_CYCLES = 10  # "ten predicted cycles with retries, at least 100 ms, at most 1 s"
DEFAULT_WATCHDOG_MIN, DEFAULT_WATCHDOG_MAX = 0.1, 1.0
TOOL_WATCHDOG = 6_250  # Tbit for each address up to HSA: below it engineering tools do not go
PROPAGATION = Fraction(5, 10**9)  # s for each metre of copper or fibre
REPEATER_DELAY = 9
"""Tbit through one repeater where its maker does not say: that of an optical link, electric ones take less."""
COMMON_RATE_MAX = 3_000_000  # bit/s, the most of a PL011 and of an FT232R

PROFILES = {"uart": lib.DPM_PROFILE_UART, "usb": lib.DPM_PROFILE_USB, "pty": lib.DPM_PROFILE_PTY}


@dataclass(frozen=True, slots=True)
class Slave:
    """What a slave's part in the times depends on. Raises ConfigurationError outside the ranges given.

    outputs, inputs: octets, 0..244. max_tsdr: Tbit, for each rate or for the one at hand; None: the standard's.
    min_slave_interval: 100 us. watchdog: s, "default", or None: off.
    """

    address: int
    outputs: int = 0
    inputs: int = 0
    max_tsdr: int | Mapping[int, int] | None = None
    min_slave_interval: int = 1
    watchdog: Watchdog = "default"
    name: str = ""

    def __post_init__(self) -> None:
        for name, count, high in (("address", self.address, 125), ("outputs", self.outputs, lib.DPM_IO_MAX),
                                   ("inputs", self.inputs, lib.DPM_IO_MAX),
                                   ("min_slave_interval", self.min_slave_interval, 65_535)):
            whole(f"{self}: {name}", count, 0, high)
        for value in self.max_tsdr.values() if isinstance(self.max_tsdr, Mapping) else (self.max_tsdr,):
            if value is not None:
                whole(f"{self}: max_tsdr", value, 1, 65_535)
        if self.watchdog != "default":
            watchdog_factors(self.watchdog)

    @classmethod
    def of(cls, station: Station) -> Slave:
        return cls(station.address, station.output_length, station.input_length, station.max_tsdr,
                   station.min_slave_interval, station.watchdog, station.name)

    def __str__(self) -> str:
        return self.name or f"station {self.address}"

    def tsdr(self, rate: Fraction) -> int | None:
        """Its MaxTsdr at `rate`, Tbit; None when it has not said."""
        if not isinstance(self.max_tsdr, Mapping):
            return self.max_tsdr
        # 45450, 45454 and 500000/11 are one rate
        return max((bits for nominal, bits in self.max_tsdr.items() if abs(nominal / rate - 1) < 0.01), default=None)


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of the cycle: Tbit (rounded up where the host's time is in it) and s."""

    name: str
    bits: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Cycle:
    """The longest undisturbed bus cycle to expect, its parts, and what disturbances make of it; s.

    Every slave answers at its MaxTsdr, and a Global_Control and a GAP poll that nobody answers fall into the same cycle.
    Acyclic requests and diagnosis come on top.
    """

    exchanges: tuple[Part, ...]
    """T_DX of each slave, in order."""
    rest: tuple[Part, ...]
    """Global_Control, token, GAP poll, the host, other masters, waiting for Min_Slave_Interval or the cycle time."""
    steady: float
    """What most cycles take at the most: the exchanges and the token, with hosts in time."""
    time: float
    """The sum of the parts."""
    lost_answer: float
    """With the longest request unanswered once."""
    repeated: float
    """With one slave's request repeated to the limit."""
    worst: float
    """With every slave's request repeated to the limit and the host late each time."""
    rotation: float
    """What the masters together need of Ttr: as `repeated`, without the waiting, as the token goes round meanwhile."""
    watched: float
    """What the default watchdog is ten of: as `repeated`, with the host late once; the factor covers the rest."""

    @property
    def parts(self) -> tuple[Part, ...]:
        return self.exchanges + self.rest


@dataclass(frozen=True, slots=True)
class Finding:
    """Something a person should know: what, and what to do. `fatal`: it will not work as it is."""

    fatal: bool
    text: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Timing:
    """What `plan` found. `delivery`, s, is what a paced pty takes to hand over the longest telegram; `ttd` in Tbit;
    `tsl_needed`, Tbit, is the least that works here; `watchdog`, s, the default one, of which a finding says when it is over
    its bound."""

    parameters: BusParameters
    slaves: tuple[Slave, ...]
    addresses: tuple[int, ...]
    masters: int
    ring: bool
    profile: str
    allowance: float
    delivery: float
    others: float | None
    ttd: int
    tsl_needed: int
    cycle: Cycle
    watchdog: float
    findings: tuple[Finding, ...]

    @property
    def works(self) -> bool:
        return not any(finding.fatal for finding in self.findings)


def _part(parameters: BusParameters, name: str, bits: int) -> Part:
    return Part(name, bits, parameters.seconds(bits))


def _lasting(parameters: BusParameters, name: str, seconds: float) -> Part:
    return Part(name, _bits(seconds, parameters.rate), seconds)


def _bits(seconds: float, rate: Fraction) -> int:
    """Tbit, rounded up; what a float has past its 12th digit is no time."""
    return math.ceil(round(seconds * float(rate), 6))


def cycle(parameters: BusParameters, slaves: Sequence[Slave], *, allowance: float = 0.0, delivery: float = 0.0,
          cycle_time: float | None = None, ring: bool = False, masters: int = 1, others: float | None = None, ttd: int = 0,
          usual: int | None = None, chunk: float = 0.0) -> Cycle:
    """Predict the cycle of a master with these slaves (protocol: T_cycle = sum of T_DX + T_token + T_gap + T_GC).

    allowance: s that the host may wake late, delivery: s that a paced pty takes to hand over a telegram. A sole master waits
    both out behind every slot, as the wait is Tsl + allowance + delivery; in a `ring` they lie inside Tsl. others: s that each
    other master holds the token; None: as long as this one. ttd: Tbit one way. usual: MaxTsdr, Tbit, of slaves that name none;
    None: the bus's. chunk: s between two deliveries of an adapter: each answer is heard at the next one, and the next request
    goes out then.
    """
    p = parameters

    def exchange(slave: Slave) -> Part:
        own = slave.tsdr(p.rate) or usual or p.max_tsdr
        part = _part(p, str(slave), replace(p, max_tsdr=own).predict_exchange(slave.outputs, slave.inputs) + 2 * ttd)
        return _lasting(p, part.name, math.ceil(round(part.seconds / chunk, 6)) * chunk) if chunk else part

    exchanges = tuple(map(exchange, slaves))
    # The GAP poll is an SD1 request, as a Data_Exchange without outputs: "66 + TSL (nobody there)", at most one a turn.
    telegrams = (_part(p, "Global_Control", p.predict_global_control()), _part(p, "token", p.predict_token()),
                 _part(p, "GAP poll", p.predict_failure(0)))
    spoken = p.seconds(sum(part.bits for part in exchanges + telegrams))
    # Behind an adapter the token lies in the wait for the next delivery.
    own, least = spoken + allowance, p.seconds(sum(part.bits for part in exchanges) + (0 if chunk else p.predict_token()))
    foreign = (masters - 1) * (own if others is None else others)
    floor = max(max((slave.min_slave_interval * 1e-4 for slave in slaves), default=0.0), cycle_time or 0.0)
    busy = own + foreign

    failures = [p.seconds(p.predict_failure(slave.outputs)) for slave in slaves] or [p.seconds(p.predict_failure(0))]
    lost, slot, limit = max(failures), 0.0 if ring else allowance + delivery, p.max_retry_limit
    late = allowance * len(slaves) + slot * limit * len(failures)
    return Cycle(
        exchanges,
        (*telegrams, _lasting(p, "host", allowance), _lasting(p, "other masters", foreign),
         _lasting(p, "wait", max(0.0, floor - busy))),
        steady=max(least + (masters - 1) * (least if others is None else others), floor),
        time=max(busy, floor),
        lost_answer=max(busy + lost + slot, floor),
        repeated=max(busy + limit * (lost + slot), floor),
        worst=max(busy + limit * sum(failures) + late, floor),
        rotation=busy + limit * (lost + slot),
        watched=max(busy + limit * lost, floor))


def default_watchdog(cycle: Cycle) -> float:
    """s: ten cycles, 0.1 to 1. Raises ConfigurationError when they need more."""
    seconds = _generous(cycle)
    if seconds > DEFAULT_WATCHDOG_MAX:
        raise ConfigurationError(f"ten predicted cycles take {seconds:.2f} s, more than the {DEFAULT_WATCHDOG_MAX:g} s of the "
                                 f"default watchdog: give each station its own, watchdog={math.ceil(seconds * 10) / 10} "
                                 "or more")
    return seconds


def _generous(cycle: Cycle) -> float:
    return max(WATCHDOG_CYCLES * cycle.watched, DEFAULT_WATCHDOG_MIN)


def slowest(slaves: Iterable[Slave], rate: Fraction) -> int:
    """The largest MaxTsdr that a slave names, Tbit; 0: none does."""
    return max((slave.tsdr(rate) or 0 for slave in slaves), default=0)


def plan(baudrate: int = 500_000, slaves: Sequence[Slave] = (), *, addresses: Sequence[int] = (1,), masters: int = 1,
         ring: bool = False, profile: str = "uart", allowance: float | None = None, repeaters: int = 0,
         repeater_delay: int = REPEATER_DELAY, length: float = 0.0, stubs: float = 0.0, cycle_time: float | None = None,
         others: float | None = None, chunk: float = 0.0, parameters: BusParameters | None = None,
         changes: Mapping[str, int] | None = None) -> Timing:
    """Compute what a bus needs, predict what it does, and say what will not work.

    baudrate: bit/s, a nominal rate. addresses: of our masters. masters: all on the bus; more than one is a ring, and so is
    `ring` with one that waits for others. profile, allowance (s): the port's, as for `Master`. repeaters: the most between
    two stations, repeater_delay: Tbit through one. length: m from end to end. stubs: m, all of a segment
    together. others: s that each other master holds the
    token, None: as long as ours. chunk: s between two deliveries of a USB adapter. parameters: a whole
    set in place of the computed one; changes: single values, by name.

    Raises ConfigurationError for what is no description of a bus; what is one and will not work is in `findings`.
    """
    changes = changes or {}
    _check_bus(slaves, addresses, masters, repeaters, repeater_delay, {"length": length, "stubs": stubs})
    _check_changes(changes)
    masters = max(masters, len(addresses))
    ring = ring or masters > 1
    allowance = profile_allowance(profile) if allowance is None else allowance
    for name, value, most in (("allowance", allowance, 1), ("cycle_time", cycle_time, 10), ("others", others, 10),
                              ("chunk", chunk, 1)):
        if value is not None and not (number(value) and 0 <= value <= most):
            raise ConfigurationError(f"{name} {value!r} s: 0 to {most} s")
    base = parameters or BusParameters.default(baudrate)
    rate, usual = base.rate, changes.get("max_tsdr", base.max_tsdr)
    ttd = math.ceil(repeaters * repeater_delay + Fraction(length) * PROPAGATION * rate)
    delivery = pty_delivery(rate) if profile == "pty" else 0.0
    inside = allowance + delivery if ring else 0.0
    tsdr = max(usual, slowest(slaves, rate))
    needed = tsl_needed(base, tsdr, inside, ttd)
    if parameters is None:
        base = replace(base, max_tsdr=tsdr, tsl=min(max(base.tsl, needed), TSL_MAX))
    values: dict[str, Any] = dict(changes)
    chosen = replace(base, **values)
    predicted = cycle(chosen, slaves, allowance=allowance, delivery=delivery, cycle_time=cycle_time, ring=ring,
                      masters=masters, others=others, ttd=ttd, usual=usual, chunk=chunk)
    ttr = _bits(predicted.rotation, rate)
    if parameters is None and "ttr" not in changes:
        chosen = replace(chosen, ttr=min(max(chosen.ttr, ttr), TTR_MAX))
    if parameters is None and "g" not in changes:
        chosen = replace(chosen, g=lib.dpm_parameters_g(chosen.to_c()))
    findings = [
        *_slow_stations(chosen, slaves),
        *_slot(chosen, needed, tsdr, inside, ttd, masters, slaves),
        *_rotation(chosen, ttr, masters),
        *_refused(chosen, addresses),
        *_rate(chosen, profile),
        *_cable(chosen, length, stubs, repeaters),
        *_stations(masters + len(slaves), repeaters, profile),
        *_watchdogs(predicted, slaves),
    ]
    return Timing(chosen, tuple(slaves), tuple(addresses), masters, ring, profile, allowance, delivery, others, ttd, needed,
                  predicted, _generous(predicted), tuple(sorted(findings, key=lambda finding: not finding.fatal)))


def profile_allowance(profile: str) -> float:
    """s that a host may wake late behind this kind of port, before it was measured."""
    if profile not in PROFILES:
        raise ConfigurationError(f"profile {profile!r}: one of {', '.join(PROFILES)}")
    traits = ffi.new("dpm_port_traits *")
    check(lib.dpm_profile_traits(PROFILES[profile], traits), f"profile {profile}")
    return float(traits.allowance / NS)


def pty_delivery(rate: Fraction) -> float:
    """s from the first octet of the longest telegram until a paced pty hands it over."""
    return float(lib.dpm_pty_delivery(rate.numerator, rate.denominator) / NS)


def tsl_needed(parameters: BusParameters, max_tsdr: int, inside: float = 0.0, ttd: int = 0) -> int:
    """Least Tsl, Tbit: "Tsl >= max Tsdr + 15", there and back past all repeaters, and what the host may be late `inside`, s."""
    return int(lib.dpm_ring_tsl(replace(parameters, max_tsdr=max_tsdr).to_c(), round(inside * NS))) + 2 * ttd


def _check_bus(slaves: Sequence[Slave], addresses: Sequence[int], masters: int, repeaters: int, repeater_delay: int,
               metres: Mapping[str, float]) -> None:
    if not addresses:
        raise ConfigurationError("addresses: a bus needs one master of ours at least")
    for address in addresses:
        whole("the master's address", address, 0, lib.DPM_ADDRESS_MAX)
    whole("masters", masters, 1, 126)
    whole("repeaters", repeaters, 0, 126)
    whole("repeater_delay", repeater_delay, 0, 1_000)
    for name, value in metres.items():
        if not number(value) or not 0 <= value <= 1_000_000:
            raise ConfigurationError(f"{name} {value!r} m: 0 to 1000000 m")
    seen: set[int] = set()
    for address in (*addresses, *(slave.address for slave in slaves)):
        if address in seen:
            raise ConfigurationError(f"address {address} is there twice: every master and every slave needs its own")
        seen.add(address)
    if max(masters - len(addresses), 0) + len(seen) > 126:
        raise ConfigurationError(f"{masters} masters and {len(slaves)} slaves: a bus has 126 addresses")


def _check_changes(changes: Mapping[str, int]) -> None:
    """Names, and whole numbers; what they may be is the library's to say."""
    known = {field.name for field in fields(BusParameters)} - {"rate"}
    for name, value in changes.items():
        if name not in known:
            raise ConfigurationError(f"bus parameter {name!r}: one of {', '.join(sorted(known))}")
        whole(f"bus parameter {name}", value, 0, 2**32 - 1)


# ---- what will not work


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.4g} ms"


def _slow_stations(p: BusParameters, slaves: Sequence[Slave]) -> Iterable[Finding]:
    slow = [slave for slave in slaves if (slave.tsdr(p.rate) or 0) > MAX_TSDR_MAX]
    if slow:
        named = ", ".join(f"{slave} {slave.tsdr(p.rate)}" for slave in slow)
        yield Finding(True, f"MaxTsdr over {MAX_TSDR_MAX} Tbit, the standard's most: {named}",
                      "look at MaxTsdr in the GSD file for this rate, or take a rate at which it is shorter")


def _slot(p: BusParameters, needed: int, tsdr: int, inside: float, ttd: int, masters: int,
          slaves: Sequence[Slave]) -> Iterable[Finding]:
    """The slot time against the slowest answer; "the error names the Tsl needed"."""
    total = f"max Tsdr {tsdr} + {TSL_MARGIN}" + (f" + 2 TTD {2 * ttd}" if ttd else "")
    if inside:
        total += f" + {needed - tsdr - TSL_MARGIN - 2 * ttd} for a telegram noticed {_ms(inside)} late"
    remedies = ["a port with a smaller allowance"] if inside else []
    if needed > TSL_MAX:
        remedies += [f"at most {lower / 1000:g} kbit/s" for lower in _rates_that_fit(p.rate, slaves, inside)[-1:]]
        yield Finding(True, f"Tsl would have to be {needed} Tbit ({total}), the standard ends at {TSL_MAX}",
                      ", or ".join(remedies or ["a faster station"]))
    elif p.tsl < needed:
        refusal = "and this port does not enter a ring with less" if inside else "or answers come when the slot is over"
        yield Finding(True, f"Tsl {p.tsl} Tbit is too short: it must be {needed} ({total}), {refusal}",
                      ", or ".join([f"Tsl {needed} Tbit or more in every master of the bus", *remedies]))
    elif masters > 1 and p.tsl > BusParameters.default(_nominal(p.rate)).tsl:
        yield Finding(False, f"Tsl is {p.tsl} Tbit, more than the standard set's",
                      "set the same Tsl in every other master: one that waits less takes the token for lost")


def _rates_that_fit(rate: Fraction, slaves: Sequence[Slave], inside: float) -> list[int]:
    """The lower rates whose Tsl can hold the host's lateness."""
    sets = [(nominal, BusParameters.default(nominal)) for nominal in BAUDRATES if nominal < rate]
    return [nominal for nominal, p in sets
            if tsl_needed(p, max(p.max_tsdr, slowest(slaves, p.rate)), inside) <= TSL_MAX]


def _nominal(rate: Fraction) -> int:
    return min(BAUDRATES, key=lambda nominal: abs(nominal - rate))


def _rotation(p: BusParameters, needed: int, masters: int) -> Iterable[Finding]:
    if p.ttr < needed:
        whose = f"all {masters} masters together" if masters > 1 else "cycles"
        yield Finding(True, f"Ttr {p.ttr} Tbit is too short: {whose} need {needed}, one station's repetitions included, and "
                      "while the token is late a master has one request a turn",
                      f"Ttr {needed} Tbit or more in every master" if needed <= TTR_MAX else
                      f"fewer stations or masters, or a port with a smaller allowance: Ttr ends at {TTR_MAX}")


def _refused(p: BusParameters, addresses: Sequence[int]) -> Iterable[Finding]:
    """What the library refuses of the set; MaxTsdr and Tsl are told already, with the stations that need them."""
    tsdr = min(p.max_tsdr, MAX_TSDR_MAX)
    legal = replace(p, max_tsdr=tsdr, tsl=max(p.tsl, tsdr + TSL_MARGIN))
    try:
        legal.check(max(addresses))
    except ConfigurationError as error:
        text, _, remedy = str(error).partition("; ")
        yield Finding(True, text, remedy)


def _rate(p: BusParameters, profile: str) -> Iterable[Finding]:
    if p.rate > COMMON_RATE_MAX and profile != "pty":
        yield Finding(False, f"few serial ports reach {float(p.rate) / 1e6:g} Mbit/s: PL011 and FT232R end at 3",
                      "an FT232H or FT2232H, or a lower rate; opening the port reads back what the driver made of it")


def _cable(p: BusParameters, length: float, stubs: float, repeaters: int) -> Iterable[Finding]:
    """What the manuals allow of copper, evenly divided by the repeaters."""
    most = limits(float(p.rate))
    allowed = f"is too long at {float(p.rate) / 1000:g} kbit/s for copper: {most}"
    if length > min(most.segment * (repeaters + 1), most.network):
        needed = f"{math.ceil(length / most.segment) - 1} of them, or " if length <= most.network else ""
        yield Finding(False, f"{length:g} m with {repeaters} repeaters {allowed}", f"{needed}fibre, or a lower rate")
    if stubs > most.stubs:
        yield Finding(False, f"{stubs:g} m of stubs {allowed}", "lead the cable from station to station, or a lower rate")


def _stations(stations: int, repeaters: int, profile: str) -> Iterable[Finding]:
    """With repeaters nobody knows which station is behind which."""
    if stations > STATIONS and not repeaters and profile != "pty":
        yield Finding(False, f"{stations} stations without a repeater: {STATIONS} are the most on one segment", "a repeater")
    if repeaters > REPEATERS:
        yield Finding(False, f"{repeaters} repeaters between two stations: {REPEATERS} are the most in line", "fibre")


def _watchdogs(predicted: Cycle, slaves: Sequence[Slave]) -> Iterable[Finding]:
    if any(slave.watchdog == "default" for slave in slaves):
        try:
            default_watchdog(predicted)
        except ConfigurationError as error:
            text, _, remedy = str(error).partition(": ")
            yield Finding(True, text, remedy)
    for slave in slaves:
        if slave.watchdog is None:
            yield Finding(False, f"{slave}: its watchdog is off, its outputs stay when the master dies", "give it a watchdog")
        elif slave.watchdog != "default" and slave.watchdog < predicted.repeated:
            yield Finding(True, f"{slave}: its watchdog of {_ms(slave.watchdog)} is shorter than a cycle in which one station "
                          f"is repeated to the limit, {_ms(predicted.repeated)}",
                          f"give it {_ms(_generous(predicted))}, the default without its upper bound")
