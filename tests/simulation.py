# SPDX-License-Identifier: MIT
"""The simulated segment of the core for tests (``simulation.h``): machines on one wire of virtual time, and the rules.

`Simulation` is a thin face; its `check()` fails with the rule that was broken and the telegrams around it. `Talker` is a
machine of the test's own: it says what it is told, when it is told, and writes down what it hears.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from wire import NEVER, S

from dpmaster._core import block, ffi, lib

KIND = {lib.DPM_TRAFFIC_TOKEN: "token", lib.DPM_TRAFFIC_REQUEST: "request", lib.DPM_TRAFFIC_SDN: "SDN",
        lib.DPM_TRAFFIC_ANSWER: "answer", lib.DPM_TRAFFIC_OTHER: "octets"}
FLAGS = {lib.DPM_TAP_LOST: "lost", lib.DPM_TAP_TOUCHED: "touched", lib.DPM_TAP_COLLIDED: "collided",
         lib.DPM_TAP_INJECTED: "injected", lib.DPM_TAP_CUT: "cut"}


def rule_name(rule: int) -> str:
    return ffi.string(lib.dpm_rule_name(rule)).decode()


@dataclass(frozen=True)
class Transmission:
    """One transmission as the onlooker saw it."""

    number: int
    start: int
    end: int
    wire_end: int
    port: int
    side: int
    flags: int
    kind: str
    da: int
    sa: int
    octets: bytes

    def __str__(self) -> str:
        flags = "".join(f" {name}" for bit, name in FLAGS.items() if self.flags & bit)
        return f"{self.start / 1000:14.2f} us  side {self.side} port {self.port:3}  {self.kind:8}{self.octets.hex(' ')}{flags}"


@dataclass(frozen=True)
class Violation:
    """A rule broken; times in bit times."""

    rule: int
    port: int
    address: int
    time: int
    value: float
    limit: float
    transmission: int

    def __str__(self) -> str:
        return (f"{rule_name(self.rule)}: port {self.port} (address {self.address}) at {self.time / 1000:.2f} us, "
                f"{self.value} against {self.limit}, transmission {self.transmission}")


# Values that are no times: octets or addresses.
PLAIN = (lib.DPM_RULE_WHOLE, lib.DPM_RULE_UNASKED, lib.DPM_RULE_RIGHT)


class Simulation:
    """Machines on one wire. `attach` takes anything with a `machine`, and keeps it."""

    def __init__(self, parameters: Any, *owners: Any, ports: int = 32, tap: int = 256, grace: int = 0) -> None:
        self.parameters = parameters
        config = ffi.new("dpm_simulation_config *", {"ports": ports, "tap": tap, "grace": grace})
        config.parameters = parameters[0]
        size = lib.dpm_simulation_size(config)
        self._block = block(size)
        out = ffi.new("dpm_simulation **")
        result = lib.dpm_simulation_init(self._block, size, config, out)
        if result:
            raise ValueError(ffi.string(lib.dpm_strerror(result)).decode())
        self.c = out[0]
        self.owners: list[Any] = []
        for owner in owners:
            self.attach(owner)

    @property
    def now(self) -> int:
        return int(lib.dpm_simulation_now(self.c))

    def bits(self, n: float) -> int:
        """ns of `n` bit times, rounded up."""
        return -(-int(lib.dpm_bits_up(self.parameters, round(n * 1000))) // 1000)

    def attach(self, owner: Any, **host: Any) -> int:
        """Put a machine on the wire: its port. Host: seed, lateness, chunk (ns), echo."""
        port = int(lib.dpm_simulation_attach(self.c, owner.machine, ffi.new("dpm_simulation_host *", host)))
        assert port >= 0, port
        self.owners.append(owner)
        return port

    def power(self, port: int, on: bool) -> None:
        assert lib.dpm_simulation_power(self.c, port, on) == 0

    def place(self, side: int, *ports: int) -> None:
        """Move ports to a side of the cut wire; 0 joins them to the rest."""
        for port in ports:
            assert lib.dpm_simulation_place(self.c, port, side) == 0

    def faults(self, **chances: int) -> None:
        """Chances per million, noise in ns; seed. None of them: no faults."""
        lib.dpm_simulation_set_faults(self.c, ffi.new("dpm_simulation_faults *", chances))

    def plan(self, traffic: int, fault: int, *, nth: int = 1, address: int = -1, after: int = 0, octets: bytes = b"") -> int:
        """The nth telegram of a kind from now on meets a fault."""
        plan = ffi.new("dpm_simulation_plan *", {"traffic": traffic, "fault": fault, "nth": nth, "address": address,
                                                 "after": after, "n": len(octets), "octets": octets})
        index = int(lib.dpm_simulation_add_plan(self.c, plan))
        assert index >= 0, index
        return index

    def plan_time(self, index: int) -> int:
        return int(lib.dpm_simulation_plan_time(self.c, index))

    def inject(self, time: int, octets: bytes, side: int = 0) -> None:
        """Octets out of nowhere."""
        assert lib.dpm_simulation_inject(self.c, side, time, octets, len(octets)) == 0

    def run(self, duration: int = NEVER, *, until: int = NEVER, violation: bool = True, tokens: int = 0,
            transmissions: int = 0) -> int:
        """Run for a time or until a time, to a violation, to a number of tokens or transmissions: which one it was."""
        stop = ffi.new("dpm_simulation_stop *", {"violation": violation, "tokens": tokens, "transmissions": transmissions})
        end = min(until, self.now + duration) if duration != NEVER else until
        assert end != NEVER or tokens or transmissions, "a run needs an end"
        return int(lib.dpm_simulation_run(self.c, end if end != NEVER else self.now + 3600 * S, stop))

    def violations(self) -> list[Violation]:
        """The first 64 rules broken."""
        found = []
        breach = ffi.new("dpm_simulation_breach *")
        while lib.dpm_simulation_violation(self.c, len(found), breach):
            scale = 1 if breach.rule in PLAIN else 1000
            found.append(Violation(breach.rule, breach.port, breach.address, breach.time, breach.value / scale,
                                   breach.limit / scale, breach.transmission))
        return found

    def rules_broken(self) -> list[str]:
        return [rule_name(v.rule) for v in self.violations()]

    def check(self) -> None:
        """Fail on any violation, with the telegrams around the first one."""
        found = self.violations()
        if found:
            around = "\n".join(f"{'>>' if t.number == found[0].transmission else '  '} {t}" for t in self.tap()
                               if abs(t.number - found[0].transmission) <= 12)
            raise AssertionError(f"{self.statistics.violations} rules broken, the first: {found[0]}\n{around}")

    def tap(self, n: int = 1 << 16) -> list[Transmission]:
        """The last transmissions, oldest first."""
        found = []
        t = ffi.new("dpm_transmission *")
        while len(found) < n and lib.dpm_simulation_tap(self.c, len(found), t):
            found.append(Transmission(t.number, t.start, t.end, t.wire_end, t.port, t.side, t.flags, KIND[t.traffic],
                                      t.da, t.sa, bytes(t.octets[0 : t.n])))
        return found[::-1]

    @property
    def statistics(self) -> Any:
        statistics = ffi.new("dpm_simulation_statistics *")
        lib.dpm_simulation_get_statistics(self.c, statistics)
        return statistics

    def share(self, address: int) -> Any:
        share = ffi.new("dpm_simulation_share *")
        lib.dpm_simulation_get_share(self.c, address, share)
        return share

    def clear(self) -> None:
        lib.dpm_simulation_clear(self.c)


@dataclass
class Heard:
    """A span as a machine got it."""

    octets: bytes
    errors: bytes
    earliest: int
    latest: int
    spacing: int
    echo: bool
    at: int = 0


@dataclass
class Talker:
    """Says octets at times: `say` before the run. An octet heard before its time revokes what is offered, if `polite`."""

    polite: bool = False
    heard: list[Heard] = field(default_factory=list)
    quiet: int = -1

    def __post_init__(self) -> None:
        self._texts: list[tuple[int, bytes]] = []
        self._kept: Any = None
        self._calls = (
            ffi.callback("void(dpm_machine *, const dpm_span *)")(self._octets),
            ffi.callback("void(dpm_machine *, int64_t)")(self._quiet),
            ffi.callback("void(dpm_machine *, int64_t, int64_t, int64_t, int)")(self._sent),
            ffi.callback("void(dpm_machine *, int64_t, dpm_offer *)")(self._ask),
        )
        self.machine = ffi.new("dpm_machine *")
        self.machine.octets, self.machine.quiet, self.machine.sent, self.machine.ask = self._calls

    def say(self, time: int, octets: bytes) -> None:
        self._texts.append((time, octets))

    def _octets(self, machine: Any, span: Any) -> None:
        errors = bytes(ffi.buffer(span.errors, span.n)) if span.errors else bytes(span.n)
        self.heard.append(Heard(bytes(ffi.buffer(span.octets, span.n)), errors, span.earliest, span.latest, span.spacing,
                                span.echo))
        if self.polite and not span.echo:
            self._texts.clear()

    def _quiet(self, machine: Any, until: int) -> None:
        self.quiet = until

    def _sent(self, machine: Any, start: int, earliest: int, latest: int, result: int) -> None:
        self._texts.pop(0)

    def _ask(self, machine: Any, now: int, offer: Any) -> None:
        for heard in self.heard[::-1]:
            if heard.at:
                break
            heard.at = now
        offer.n, offer.wake, offer.not_after = 0, NEVER, NEVER
        if self._texts:
            offer.not_before, octets = self._texts[0]
            self._kept = ffi.new("uint8_t[]", octets)
            offer.octets, offer.n = self._kept, len(octets)
