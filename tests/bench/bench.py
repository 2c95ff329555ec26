# SPDX-License-Identifier: MIT
"""``make bench``: what the master costs above the bare bus, everything in one run of under a minute.

Telegrams of 15 octets each way (6 + 6 of data). Three ways to exchange them:

(a) bare.c: one write, ppoll and read, keeping Tid1 and min Tsdr. Unpaced on one pty; paced on two ports of the segment.
(b) dpmaster with one SI-P1, Basic data, on a segment of one port, the card's application idle.
(c) the package pyprofibus, a process of its own, against the same card (paced only).

Time is from the request written to the answer complete, plus Tid1; the token, Global_Control and all else between two
exchanges are left out of it and shown as `cycle`. CPU is the initiator's thread, for (c) its process. Blocks alternate, so
that what else the machine does hits all; a ratio is the median of its blocks' ratios, shown with the least and the
largest; percentiles are over all blocks. (b) against (c) compares the rates that these times give. What each reaches by the
clock is shown too: there (c) gains by what it leaves out, for it keeps no Tid1 and sends no token.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dpmaster import Master, Station
from dpmaster._core import check, ffi, lib
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
OCTETS = 15
UNPACED_RATE = 12_000_000
IDLE_RATE = 500_000  # the Master's default
UNPACED_BLOCKS, UNPACED_EXCHANGES = 10, 10_000
PACED_RATES, PACED_BLOCKS, PACED_SECONDS = (500_000, 1_500_000), 5, 0.3
FIRST = 5  # address of the first card

# Key, what it is, the goal's sign and figure.
GOALS = (
    ("unpaced_ratio_median", "median, (b) to (a)", "<=", 1.2),
    ("unpaced_ratio_p999", "99.9th percentile, (b) to (a)", "<=", 1.5),
    ("unpaced_ratio_cpu", "CPU, (b) to (a)", "<=", 1.3),
    ("paced_500k_ratio", "500 kbit/s, (b) to (a)", "<=", 1.1),
    ("paced_1500k_ratio", "1.5 Mbit/s, (b) to (a)", "<=", 1.1),
    ("paced_500k_vs_pyprofibus", "500 kbit/s, rate of (b) to (c)", ">", 1.0),
    ("paced_1500k_vs_pyprofibus", "1.5 Mbit/s, rate of (b) to (c)", ">", 1.0),
    ("stations_32_vs_8", "cost per station, 32 to 8", "<=", 1.1),
    ("idle_cpu_share", "10 ms cycle, 500 kbit/s, share of a core", "<", 0.05),
    ("decode_per_second", "SD2 of 20 octets decoded a second", ">=", 5e6),
)


@dataclass(frozen=True)
class Block:
    """One block of exchanges. Times in ns."""

    times: Sequence[int]
    """Of each exchange, Tid1 included."""
    cpu: float
    """Per exchange."""
    period: float
    """From one exchange to the next, everything between them included."""

    @property
    def median(self) -> float:
        return statistics.median(self.times)


class Parameters:
    """The standard set for a rate, and the times in ns that follow from it."""

    def __init__(self, rate: int) -> None:
        self._set = ffi.new("dpm_parameters *")
        check(lib.dpm_parameters_default(self._set, rate, 0), "bus parameters")
        self.tid1 = self.bits(lib.dpm_tid1(self._set))
        self.ideal = self.bits(2 * OCTETS * lib.DPM_CHARACTER_BITS + self._set.min_tsdr) + self.tid1
        """An exchange on a line without a computer's delays."""

    def bits(self, n: int) -> int:
        return int(lib.dpm_bits_up(self._set, n))


# --- the three ways --------------------------------------------------------------------------------------------------


class Bare:
    """(a): the program bare.c, compiled here."""

    def __init__(self, directory: str) -> None:
        self.path = str(Path(directory) / "bare")
        sources = [HERE / "bare.c", *sorted((ROOT / "csrc").rglob("*.c"))]
        compiler = shlex.split(os.environ.get("CC", "cc"))
        flags = ["-std=c11", "-O2", "-D_GNU_SOURCE", f"-I{ROOT / 'include'}", f"-I{ROOT / 'csrc'}", "-pthread"]
        subprocess.run([*compiler, *flags, "-o", self.path, *map(str, sources)], check=True)

    def exchange(self, rate: int, count: int, *ports: str) -> Block:
        done = subprocess.run([self.path, "exchange", str(count), str(rate), *ports], stdout=subprocess.PIPE, check=True)
        figures = array("q", done.stdout)
        tid1 = Parameters(rate).tid1
        return Block([ns + tid1 for ns in figures[2:]], figures[0] / count, figures[1] / count)

    def decode(self, count: int) -> float:
        done = subprocess.run([self.path, "decode", str(count)], stdout=subprocess.PIPE, check=True)
        return float(done.stdout.split()[0])


@contextmanager
def operating(
    rate: int, *, paced: bool, stations: int = 1, cycle_time: float | None = None
) -> Iterator[tuple[Segment, Master, list[Station]]]:
    """(b): cards on a segment and the master in Operate. The program has nothing to say: no output watchdog."""
    with Segment(baudrate=rate if paced else None) as wire:
        for address in range(FIRST, FIRST + stations):
            wire.attach(SIP1(address=address))
        with Master(wire.port(), baudrate=rate, address=1, cycle_time=cycle_time, output_watchdog=None) as master:
            members = [
                master.add(Station(address, 0x00CA, configuration=b"\x72", min_slave_interval=0, watchdog=5.0))
                for address in range(FIRST, FIRST + stations)
            ]
            master.operate(timeout=10.0)
            yield wire, master, members


def cpu_time(master: Master) -> int:
    """ns that the bus thread has used."""
    info = ffi.new("dpm_bus_info *")
    check(lib.dpm_bus_get_info(master._bus._handle, info), "bus info")
    return int(info.cpu_time)


def exchanges(stations: Sequence[Station]) -> int:
    return sum(station.statistics.exchanges for station in stations)


def master_block(rate: int, count: int, *, paced: bool) -> tuple[Block, Any]:
    """`count` exchanges of (b), and what the segment has to say of itself."""
    with operating(rate, paced=paced) as (wire, master, stations):
        durations = ffi.new("int64_t[]", count)
        cpu, number, begin = cpu_time(master), exchanges(stations), time.monotonic_ns()
        check(lib.dpm_bus_record(master._bus._handle, durations, count), "recording")
        limit = time.monotonic() + 30.0
        while not durations[count - 1]:
            time.sleep(0.005)
            if time.monotonic() > limit:
                sys.exit(f"bench: the station was lost: {stations[0].state}, {stations[0].reason}")
        cpu, number, elapsed = cpu_time(master) - cpu, exchanges(stations) - number, time.monotonic_ns() - begin
        check(lib.dpm_bus_record(master._bus._handle, ffi.NULL, 0), "recording")
        tid1 = Parameters(rate).tid1
        return Block([ns + tid1 for ns in durations], cpu / number, elapsed / number), wire.info


def peer_block(rate: int, seconds: float) -> Block:
    with Segment(baudrate=rate) as wire:
        wire.attach(SIP1(address=FIRST))
        command = [sys.executable, str(HERE / "peer.py"), wire.port(), str(rate), str(FIRST), str(seconds)]
        done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"bench: pyprofibus failed: {done.stderr.strip()}")
    result = json.loads(done.stdout)
    count = max(1, result["exchanges"])
    tid1 = Parameters(rate).tid1
    return Block([ns + tid1 for ns in result["durations"]], result["cpu"] * 1e9 / count, result["seconds"] * 1e9 / count)


# --- what is measured ------------------------------------------------------------------------------------------------


def show(name: str, blocks: Sequence[Block]) -> None:
    """A line of the table, in us."""
    times = sorted(ns for block in blocks for ns in block.times)

    def at(share: float) -> str:
        return f"{times[min(len(times) - 1, int(share * len(times)))] / 1000:8.1f}"

    cpu = statistics.median(block.cpu for block in blocks) / 1000
    period = statistics.median(block.period for block in blocks) / 1000
    print(f"  {name:<30}{at(0.5)} {at(0.99)} {at(0.999)} {cpu:8.1f} {period:8.1f} {1e6 / period:9.0f}", flush=True)


def ratio(name: str, above: Sequence[float], below: Sequence[float]) -> float:
    """The median of the blocks' ratios; says how far they lie apart."""
    each = [a / b for a, b in zip(above, below, strict=True)]
    middle = statistics.median(each)
    print(f"    {name:<42}{middle:6.3f}   blocks {min(each):.3f} .. {max(each):.3f}")
    return middle


def percentile(blocks: Sequence[Block], share: float) -> int:
    times = sorted(ns for block in blocks for ns in block.times)
    return times[int(share * len(times))]


def unpaced(bare: Bare) -> dict[str, float]:
    a, b = [], []
    for _ in range(UNPACED_BLOCKS):
        a.append(bare.exchange(UNPACED_RATE, UNPACED_EXCHANGES))
        b.append(master_block(UNPACED_RATE, UNPACED_EXCHANGES, paced=False)[0])
    print(f"unpaced, bus parameters of 12 Mbit/s, {UNPACED_BLOCKS * UNPACED_EXCHANGES} exchanges each")
    show("(a) bare", a)
    show("(b) dpmaster", b)
    p999 = percentile(b, 0.999) / percentile(a, 0.999)
    each = [percentile([y], 0.999) / percentile([x], 0.999) for x, y in zip(a, b, strict=True)]
    result = {
        "unpaced_ratio_median": ratio("(b)/(a) median", [x.median for x in b], [x.median for x in a]),
        "unpaced_ratio_p999": p999,
        "unpaced_ratio_cpu": ratio("(b)/(a) CPU", [x.cpu for x in b], [x.cpu for x in a]),
    }
    print(f"    {'(b)/(a) 99.9th percentile over all':<42}{p999:6.3f}   blocks {min(each):.3f} .. {max(each):.3f}")
    return result


def paced(bare: Bare, rate: int) -> dict[str, float]:
    ideal = Parameters(rate).ideal
    count = int(PACED_SECONDS * 1e9 / ideal)
    a, b, c, hubs = [], [], [], []
    for _ in range(PACED_BLOCKS):
        with Segment(baudrate=rate) as wire:
            a.append(bare.exchange(rate, count, wire.port(), wire.port()))
            hubs.append(wire.info)
        block, hub = master_block(rate, count, paced=True)
        b.append(block)
        hubs.append(hub)
        c.append(peer_block(rate, PACED_SECONDS))
    late = sum(hub.late_mean * hub.deliveries for hub in hubs) / max(1, sum(hub.deliveries for hub in hubs))
    worst = max(hub.late_max for hub in hubs)
    print(f"paced as {rate / 1000:g} kbit/s: {ideal / 1000:.1f} us on an ideal line; "
          f"the hub delivers {late * 1e6:.1f} us late on average, {worst * 1e6:.0f} us at worst")
    show("(a) bare", a)
    show("(b) dpmaster", b)
    show("(c) pyprofibus", c)
    name = f"paced_{rate // 1000}k"
    ratio("(b)/(c) rate by the clock", [x.period for x in c], [x.period for x in b])
    return {
        f"{name}_ratio": ratio("(b)/(a) median", [x.median for x in b], [x.median for x in a]),
        f"{name}_vs_pyprofibus": ratio("(b)/(c) rate", [x.median for x in c], [x.median for x in b]),
    }


def cost_per_station(stations: int, seconds: float) -> float:
    """ns of bus for one exchange when so many cards answer."""
    with operating(UNPACED_RATE, paced=False, stations=stations) as (_, _, members):
        number, begin = exchanges(members), time.monotonic_ns()
        time.sleep(seconds)
        return (time.monotonic_ns() - begin) / (exchanges(members) - number)


def many_stations() -> float:
    few, many = [], []
    for _ in range(3):
        few.append(cost_per_station(8, 0.7))
        many.append(cost_per_station(32, 0.7))
    of_8, of_32 = statistics.median(few) / 1000, statistics.median(many) / 1000
    print(f"stations, unpaced: {of_8:.1f} us each of 8, {of_32:.1f} us each of 32")
    return ratio("32 to 8", many, few)


def idle_share(rate: int, seconds: float) -> float:
    """The higher the rate, the shorter Tto and the more often the idle bus wants a token."""
    with operating(rate, paced=False, cycle_time=0.010) as (_, master, stations):
        cpu, number, begin = cpu_time(master), exchanges(stations), time.monotonic_ns()
        time.sleep(seconds)
        elapsed = time.monotonic_ns() - begin
        share = (cpu_time(master) - cpu) / elapsed
        cycle = elapsed / max(1, exchanges(stations) - number)
    print(f"one station in a cycle of 10 ms, {rate // 1000} kbit/s: {share:.2%} of a core, cycle {cycle / 1e6:.3f} ms")
    return share


def machine() -> str:
    names = [line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
             if line.lower().startswith(("model name", "model\t"))]
    model = next((name for name in names if not name.isdigit()), platform.machine())
    return f"{model}, {os.cpu_count()} cores, Linux {platform.release()}, Python {platform.python_version()}"


def main() -> None:
    logging.getLogger("dpmaster").setLevel(logging.ERROR)  # not each time that the output watchdog is off
    begin = time.monotonic()
    figures: dict[str, float | str] = {}
    print(f"{machine()}\n  {'times in us':<30}{'median':>8} {'p99':>8} {'p99.9':>8} {'CPU':>8} {'cycle':>8} {'per s':>9}")
    with tempfile.TemporaryDirectory(prefix="dpmaster-bench-") as directory:
        bare = Bare(directory)
        figures |= unpaced(bare)
        for rate in PACED_RATES:
            figures |= paced(bare, rate)
        figures["stations_32_vs_8"] = many_stations()
        figures["idle_cpu_share"] = idle_share(IDLE_RATE, 2.0)
        idle_share(UNPACED_RATE, 1.0)
        figures["decode_per_second"] = statistics.median(bare.decode(2_000_000) for _ in range(5))
    print(f"\ngoals, after {time.monotonic() - begin:.0f} s")
    for key, what, sign, goal in GOALS:
        value = float(figures[key])
        met = {"<=": value <= goal, "<": value < goal, ">": value > goal, ">=": value >= goal}[sign]
        print(f"  {what:<42}{value:>14,.3f}  {sign:>2} {goal:<12,g}{'met' if met else 'MISSED'}")
    figures = {key: round(value, 4) if isinstance(value, float) else value for key, value in figures.items()}
    print("bench:", json.dumps({**figures, "machine": machine()}))


if __name__ == "__main__":
    main()
