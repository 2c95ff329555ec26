# SPDX-License-Identifier: MIT
"""``dpmaster timing``: bus parameters, cycle and watchdogs of a bus that is only described, and what will not work.

Prints what `dpmaster.timing.plan` says; touches no port.
"""

from __future__ import annotations

import argparse
import inspect
import json
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

from dpmaster.busfile import BusFile
from dpmaster.cable import limits
from dpmaster.cli._master import milliseconds
from dpmaster.drives import PROFILES as DRIVES
from dpmaster.errors import ConfigurationError
from dpmaster.station import watchdog_factors
from dpmaster.timing import DEFAULT_WATCHDOG_MAX, PROFILES, REPEATER_DELAY, TOOL_WATCHDOG, Finding, Part, Slave, Timing, plan

NAME = "timing"
HELP = "compute bus parameters, cycle time and watchdogs, and say what will not work"

WIDTH = 79
STATION = """\
A STATION is ADDRESS:OUT/IN or FIRST-LAST:OUT/IN, with the octets of outputs and
inputs as the master sees them, or ADDRESS:v7[:CONFIGURATION]. What differs from
the standard follows, each after a colon: max_tsdr=TBIT, watchdog=MS or off,
min_slave_interval=N (of 100 us). Exit code 1 when something will not work.

  dpmaster timing --baudrate 1500000 --station 5:v7 --station 7-9:32/32:max_tsdr=200"""
CHANGES = {
    "tsl": "slot time", "min-tsdr": "least time before an answer", "max-tsdr": "longest time before an answer",
    "tqui": "quiet time", "tset": "setup time", "ttr": "target rotation time", "g": "GAP update factor",
    "hsa": "highest station address", "max-retry-limit": "repetitions of a request",
}


# ---- arguments


def _typed(parse: Callable[[str], list[Slave]]) -> Callable[[str], list[Slave]]:
    """As the type of an argument: what is wrong with it in its own words, and exit code 2."""

    def typed(text: str) -> list[Slave]:
        try:
            return parse(text)
        except ConfigurationError as error:
            raise argparse.ArgumentTypeError(f"{text!r}: {error}") from None

    return typed


@_typed
def stations(text: str) -> list[Slave]:
    where, _, rest = text.partition(":")
    fields = rest.split(":")
    words = [field for field in fields if "=" not in field]
    options = dict(_option(field) for field in fields if "=" in field)
    span = re.fullmatch(r"(\d{1,3})(?:-(\d{1,3}))?", where)
    lengths = re.fullmatch(r"(\d{1,3})/(\d{1,3})", words[0]) if words else None
    if not span or not words or (lengths and len(words) > 1) or (not lengths and words[0] not in DRIVES):
        raise ConfigurationError(f"write ADDRESS:OUT/IN, or ADDRESS:DRIVE with one of {', '.join(DRIVES)}")
    addresses = range(int(span[1]), int(span[2] or span[1]) + 1)
    if not addresses:
        raise ConfigurationError("the first address is above the last")
    if lengths:
        return [replace(Slave(address, int(lengths[1]), int(lengths[2])), **options) for address in addresses]
    return [replace(Slave.of(DRIVES[words[0]](address, *words[1:])), **options) for address in addresses]


def _option(field: str) -> tuple[str, Any]:
    name, _, value = field.partition("=")
    if name == "watchdog" and value == "off":
        return name, None
    if name == "watchdog" and re.fullmatch(r"\d+(\.\d+)?", value):
        return name, float(value) / 1000
    if name in ("max_tsdr", "min_slave_interval") and value.isdecimal():
        return name, int(value)
    raise ConfigurationError(f"{field}: max_tsdr=TBIT, min_slave_interval=N, watchdog=MS or watchdog=off")


def addresses(text: str) -> tuple[int, ...]:
    if not re.fullmatch(r"\d{1,3}(,\d{1,3})*", text):
        raise argparse.ArgumentTypeError(f"{text!r}: addresses with commas between them")
    return tuple(map(int, text.split(",")))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = STATION
    parser.add_argument("--file", metavar="FILE", help="a bus file, in place of the other options")
    parser.add_argument("--baudrate", type=int, metavar="B", help="bit/s (default 500000)")
    parser.add_argument("--station", dest="slaves", type=stations, action="extend", metavar="STATION",
                        help="a slave, see below")
    parser.add_argument("--address", dest="addresses", type=addresses, metavar="N[,N]",
                        help="of our master or masters (default 1)")
    parser.add_argument("--masters", type=int, metavar="N", help="how many masters the bus has (default 1)")
    parser.add_argument("--ring", action="store_true", default=None, help="other masters may come, though there are none now")
    parser.add_argument("--others", type=milliseconds, metavar="MS", help="time each other master holds the token (as ours)")
    parser.add_argument("--profile", choices=list(PROFILES), help="kind of our port (default uart)")
    parser.add_argument("--allowance", type=milliseconds, metavar="MS", help="how late our host wakes (the profile's)")
    parser.add_argument("--repeaters", type=int, metavar="N", help="most repeaters between two stations")
    parser.add_argument("--repeater-delay", type=int, metavar="TBIT",
                        help=f"of each of them, as its maker says (default {REPEATER_DELAY})")
    parser.add_argument("--chunk", type=milliseconds, metavar="MS",
                        help="ms between two deliveries of a USB adapter, its latency timer: 1 or 16")
    parser.add_argument("--length", type=float, metavar="M", help="metres of cable between the ends")
    parser.add_argument("--stubs", type=float, metavar="M", help="metres of all stubs of a segment together")
    parser.add_argument("--cycle-time", type=milliseconds, metavar="MS", help="from one cycle's start to the next one's")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    group = parser.add_argument_group("bus parameters, in place of the computed ones")
    for name, text in CHANGES.items():
        group.add_argument(f"--{name}", type=int, metavar="N", help=text)


# ---- the table


def shown(seconds: float) -> str:
    """Four digits and a unit."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= scale:
            return f"{seconds / scale:.4g} {unit}"
    return f"{seconds * 1e6:.4g} us"


def rate(bits: float) -> str:
    return f"{bits / 1e6:g} Mbit/s" if bits >= 1e6 else f"{round(bits / 1000, 2):g} kbit/s"


def _row(name: str, bits: float, seconds: float) -> str:
    return f"  {name:<50}{bits:>11.0f}{shown(seconds):>15}"


def _plural(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _head(t: Timing) -> str:
    return (f"{rate(float(t.parameters.rate))}, {_plural(t.masters, 'master')}{' in a ring' if t.ring else ''}, "
            f"{_plural(len(t.slaves), 'slave')}; {t.profile}, host up to {shown(t.allowance)} late\n"
            f"copper: {limits(float(t.parameters.rate))}"
            + (f"\na paced pty hands over telegrams when they are whole: up to {shown(t.delivery)} more" if t.delivery else ""))


def _parameters(t: Timing) -> Iterator[str]:
    p = t.parameters
    rows = {
        "Tsl      slot time": p.tsl,
        "         of it needed here": t.tsl_needed,
        "min Tsdr no answer comes earlier": p.min_tsdr,
        "max Tsdr no answer comes later": p.max_tsdr,
        "Tid1     idle after an answer or the token": p.tid1,
        "Tid2     idle after a request without answer": p.tid2,
        "Tset     setup time": p.tset,
        "Tqui     quiet time": p.tqui,
        "TTD      delay by cable and repeaters, one way": t.ttd,
        **{f"Tto      token lost, to the master at {address}": p.tto(address) for address in t.addresses},
        "Ttr      target rotation time": p.ttr,
        f"Tgud     from one GAP round to the next, G {p.g} x Ttr": p.g * p.ttr,
    }
    yield f"{'Bus parameters':<52}{'Tbit':>11}{'time':>15}"
    yield from (_row(name, bits, p.seconds(bits)) for name, bits in rows.items())
    yield f"  HSA {p.hsa}, max_retry_limit {p.max_retry_limit}"


def _ranges(numbers: list[int]) -> str:
    """5, 7-9"""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)


def _exchanges(t: Timing) -> Iterator[str]:
    """A row for each kind of slave, as a bus of 60 equal ones is no reason for 60 rows."""
    kinds: dict[tuple[int, int, int], list[tuple[Slave, Part]]] = {}
    for slave, part in zip(t.slaves, t.cycle.exchanges, strict=True):
        kinds.setdefault((slave.outputs, slave.inputs, part.bits), []).append((slave, part))
    for (outputs, inputs, _), alike in kinds.items():
        numbers = _ranges([slave.address for slave, _ in alike])
        many = f", {len(alike)} x {alike[0][1].bits}" if len(alike) > 1 else ""
        name = f"T_DX {textwrap.shorten(numbers, 20, placeholder=' ...')}: {outputs} out, {inputs} in{many}"
        yield _row(name, sum(part.bits for _, part in alike), sum(part.seconds for _, part in alike))


def _cycle(t: Timing) -> Iterator[str]:
    p, c = t.parameters, t.cycle
    names = {
        "GAP poll": "GAP poll that nobody answers",
        "host": "the host wakes late once",
        "other masters": _plural(t.masters - 1, "other master") + (", each as long as ours" if t.others is None else ""),
        "wait": "wait for Min_Slave_Interval or cycle time",
    }
    yield "Cycle, each slave answering at its latest"
    yield from _exchanges(t)
    yield from (_row(names.get(part.name, part.name), part.bits, part.seconds) for part in c.rest if part.bits)
    totals = {
        "= longest undisturbed": c.time,
        "  most cycles: exchanges and tokens": c.steady,
        "  with one lost answer": c.lost_answer,
        **({"  with one slave repeated to the limit": c.repeated} if p.max_retry_limit > 1 else {}),
        "  worst: every slave repeated to the limit": c.worst,
    }
    yield from (_row(name, seconds * float(p.rate), seconds) for name, seconds in totals.items())


def _watchdogs(t: Timing) -> Iterator[str]:
    p = t.parameters
    yield "Slave watchdog"
    yield _row(f"default: ten cycles of {shown(t.cycle.watched)}, at least 100 ms", t.watchdog * float(p.rate), t.watchdog)
    yield "    these cycles: one slave repeated to the limit, the host late once"
    if t.watchdog <= DEFAULT_WATCHDOG_MAX:
        first, second = watchdog_factors(t.watchdog)
        yield f"    in Set_Prm WD_Fact_1 {first}, WD_Fact_2 {second}: {first * second * 10} ms"
    tools = TOOL_WATCHDOG * p.hsa
    yield _row(f"engineering tools give at least {TOOL_WATCHDOG} x HSA", tools, p.seconds(tools))


def _finding(finding: Finding) -> str:
    head = "WILL NOT WORK: " if finding.fatal else "Note: "
    lines = textwrap.wrap(head + finding.text, WIDTH, subsequent_indent="  ")
    return "\n".join(lines + textwrap.wrap("remedy: " + finding.remedy, WIDTH, initial_indent="  ", subsequent_indent="  "))


def table(t: Timing) -> str:
    sections = (_parameters(t), _cycle(t), _watchdogs(t), map(_finding, t.findings))
    return "\n\n".join([_head(t), *filter(None, ("\n".join(section) for section in sections))])


def as_object(t: Timing) -> dict[str, object]:
    """What --json prints: Tbit where the name does not say otherwise, seconds in the cycle and the watchdog."""
    p, c = t.parameters, t.cycle
    return {
        "baudrate": float(p.rate), "masters": t.masters, "ring": t.ring, "profile": t.profile, "allowance": t.allowance,
        "delivery": t.delivery,
        "parameters": {k: v for k, v in asdict(p).items() if k != "rate"},
        "tid1": p.tid1, "tid2": p.tid2, "ttd": t.ttd, "tto": {address: p.tto(address) for address in t.addresses},
        "tsl_needed": t.tsl_needed, "copper": asdict(limits(float(p.rate))),
        "cycle": {
            "exchanges": [{"address": s.address, "outputs": s.outputs, "inputs": s.inputs, "bits": part.bits,
                           "seconds": part.seconds} for s, part in zip(t.slaves, c.exchanges, strict=True)],
            "rest": [asdict(part) for part in c.rest],
            "steady": c.steady, "time": c.time, "lost_answer": c.lost_answer, "repeated": c.repeated, "worst": c.worst,
        },
        "watchdog": t.watchdog, "works": t.works, "findings": [asdict(finding) for finding in t.findings],
    }


def described(args: argparse.Namespace) -> Timing:
    """The bus that the file describes, or the options. ConfigurationError when both do."""
    names = [name for name in inspect.signature(plan).parameters if name not in ("parameters", "changes")]
    given = {name: value for name in names if (value := getattr(args, name)) is not None}
    changes = {field: value for name in CHANGES if (value := getattr(args, field := name.replace("-", "_"))) is not None}
    if args.file is None:
        return plan(**given, changes=changes)
    if given or changes:
        flags = {"slaves": "station", "addresses": "address"}
        also = ", ".join(f"--{flags.get(name, name).replace('_', '-')}" for name in (*given, *changes))
        raise ConfigurationError(f"--file {args.file} and {also}: the file says all of the bus; change it there")
    return BusFile.load(args.file, works=False).timing


def run(args: argparse.Namespace) -> int:
    found = described(args)
    print(json.dumps(as_object(found)) if args.json else table(found))
    return 0 if found.works else 1
