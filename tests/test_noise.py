# SPDX-License-Identifier: MIT
"""Noise on the wire between the master and an SI-P1: outputs are only ever what was written, and the exchange comes back.

Every octet of every telegram of a start-up and of the exchange that follows is changed, lost, doubled, or gets a stranger
before it, one at a time, in runs of their own on virtual time. What the card may see is computed by a decoder that shares
nothing with the one under test: what was written, zeros, and, where octets were added, what a telegram among the octets
received says that passes every check.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

import pytest
from slow_decoder import verdict
from wire import MS, Master, Sent, Slaves, Wire, default_parameters, ffi, lib

ADDRESS, IDENT, BASIC = 5, 0x00CA, b"\x72"  # SI-P1 manual, chapter 2: YASK00CA.GSD, "Basic data"
LENGTH = 6
SAFE = bytes(LENGTH)
SEED = 20260


class Bench:
    """A master in Operate that commits a new value after every telegram, the card, and a watch over its outputs."""

    def __init__(self) -> None:
        parameters = default_parameters(500_000)
        self.master = Master(parameters=parameters, address=1, slaves=1, control_interval=2 * MS)
        self.slaves = Slaves(parameters=parameters, slaves=1)
        self.master.add(ADDRESS, IDENT, BASIC, watchdog=(1, 10), group=1)
        self.slaves.add(ADDRESS, IDENT, BASIC, user=(0, 0))
        self.wire = Wire(parameters, self.master.machine, self.slaves.machine)
        self.written: set[bytes] = {SAFE}
        self.count = 0
        self.heard = b""  # by the slave, the last telegrams
        self.added = False
        self.master.mode(lib.DPM_MODE_OPERATE)

    def commit(self) -> None:
        self.count += 1
        value = self.count.to_bytes(2, "big") * 3
        if self.master.commit(0, value, self.wire.now) > 0:
            self.written.add(value)

    def smuggled(self) -> set[bytes]:
        """Outputs in telegrams among the octets heard that pass every check (Data_Exchange from 1 to 5)."""
        found = set()
        for at in range(len(self.heard)):
            length = verdict(self.heard[at:])
            telegram = self.heard[at : at + length] if isinstance(length, int) else b""
            if telegram[:1] == b"\x68" and telegram[4:6] == bytes([ADDRESS, 1]) and len(telegram) == LENGTH + 9:
                found.add(telegram[7:-2])
        return found

    def step(self) -> Sent:
        sent = self.wire.step()
        assert sent
        frame = self.slaves.outputs(0)
        seen = bytes(frame.octets[0 : frame.length]) if frame.length else SAFE
        if seen not in self.written:
            assert self.added and seen in self.smuggled(), f"the card saw {seen.hex(' ')}"
        if sent.source == 0:
            self.commit()
        return sent

    def run(self, transmissions: int) -> list[Sent]:
        return [self.step() for _ in range(transmissions)]

    @property
    def exchanges(self) -> int:
        return int(self.slaves.report(0).exchanges)

    def recover(self) -> int:
        """Transmissions until new outputs have arrived three times over."""
        goal = self.exchanges + 3
        for n in range(400):
            if self.exchanges >= goal:
                frame = self.slaves.outputs(0)
                assert frame.valid and int.from_bytes(bytes(frame.octets[0:2]), "big") >= self.count - 3
                return n
            self.step()
        tail = "\n".join(f"{s.source}: {s.hex}" for s in self.wire.log[-30:])
        raise AssertionError(f"no exchange any more:\n{tail}")


RUN = 34  # transmissions: the claim, the start-up, and some cycles with Global_Control


def with_fault(index: int, change: Callable[[bytes], bytes], added: bool) -> int:
    """One run with the `index`-th transmission changed; how long it took to come back."""
    bench = Bench()
    heard: list[bytes] = []

    def mangle(sent: Sent) -> bytes | None:
        changed = change(sent.octets) if len(bench.wire.log) == index + 1 else None
        if sent.source == 0:
            heard.append(sent.octets if changed is None else changed)
            bench.heard = b"".join(heard[-4:])
        return changed

    bench.wire.mangle = mangle
    bench.added = added
    bench.run(index + 1)
    return bench.recover()


def telegrams() -> list[bytes]:
    return [sent.octets for sent in Bench().run(RUN)]


def test_the_run_shows_every_kind_of_telegram():
    """What the tests below break: token, Global_Control, each step of the start-up, SC, data both ways."""
    log = telegrams()
    assert {t[7] for t in log if t[0] == 0x68 and t[4] == 0x80 | ADDRESS} == {60, 61, 62}
    assert sum(t[0] == 0x68 and t[4] == ADDRESS for t in log) >= 5
    assert {t[0] for t in log} == {0x68, 0xDC, 0xE5}


def faults(log: list[bytes], kind: str) -> Iterator[tuple[int, Callable[[bytes], bytes]]]:
    """Every place in every telegram of the run, with what is done to it there."""
    rng = random.Random(SEED)
    for index, telegram in enumerate(log):
        for at in range(len(telegram)):
            if kind == "changed":
                for bit in range(8):
                    yield index, lambda t, a=at, b=bit: t[:a] + bytes([t[a] ^ 1 << b]) + t[a + 1 :]
                other = (telegram[at] + rng.randrange(1, 256)) % 256
                yield index, lambda t, a=at, v=other: t[:a] + bytes([v]) + t[a + 1 :]
            elif kind == "lost":
                yield index, lambda t, a=at: t[:a] + t[a + 1 :]
            elif kind == "doubled":
                yield index, lambda t, a=at: t[: a + 1] + t[a:]
            else:
                for value in {0x68, 0x10, 0xA2, 0xDC, 0xE5, 0x16, 0xFF, 0x00, rng.randrange(256)}:
                    yield index, lambda t, a=at, v=value: t[:a] + bytes([v]) + t[a:]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", ["changed", "lost", "doubled", "inserted"])
def test_one_octet_of_any_telegram(kind):
    """One fault costs a repetition, at worst a new start; the bound is a start-up's telegrams and some cycles."""
    log = telegrams()
    worst = 0
    cases = list(faults(log, kind))
    for index, change in cases:
        worst = max(worst, with_fault(index, change, added=kind in ("doubled", "inserted")))
    print(f"{kind}: {len(cases)} cases, seed {SEED}, at most {worst} telegrams until the exchange was back")
    assert worst <= 60


@pytest.mark.timeout(300)
def test_a_noisy_line_for_a_long_time():
    """One octet in 300 is hit, for 20 000 telegrams: the outputs stay true, and most exchanges still succeed."""
    rng = random.Random(SEED)
    print(f"seed {SEED}")
    bench = Bench()
    bench.added = True
    heard: list[bytes] = []

    def mangle(sent: Sent) -> bytes | None:
        data = bytearray()
        for octet in sent.octets:
            chance = rng.random() * 300
            if chance < 0.25:
                continue
            data.append(octet if chance >= 0.5 else octet ^ 1 << rng.randrange(8))
            if 0.5 <= chance < 0.75:
                data.append(octet)
            elif 0.75 <= chance < 1:
                data.insert(-1, rng.randrange(256))
        if sent.source == 0:
            heard.append(bytes(data))
            bench.heard = b"".join(heard[-8:])
        return bytes(data)

    bench.wire.mangle = mangle
    bench.run(20_000)
    bench.recover()
    fdl = bench.master.status.fdl
    print(f"{fdl.requests} requests, {fdl.repetitions} repetitions, {fdl.unanswered} given up")
    assert fdl.answers > 0.9 * fdl.requests


@pytest.mark.parametrize("source", [0, 1], ids=["request", "answer"])
def test_counters_name_what_was_thrown_away(source):
    bench = Bench()
    bench.run(RUN)
    spoilt: list[Sent] = []

    def mangle(sent: Sent) -> bytes | None:
        if spoilt or sent.source != source or sent.octets[0] != 0x68:
            return None
        spoilt.append(sent)
        return sent.octets[:-2] + bytes([sent.octets[-2] ^ 1]) + sent.octets[-1:]

    bench.wire.mangle = mangle
    bench.run(20)
    slave = ffi.unpack(lib.dpm_slaves_rejected(bench.slaves.slaves), lib.DPM_REJECT_COUNT)
    master = list(bench.master.status.fdl.rejected)
    assert (slave if source == 0 else master)[lib.DPM_REJECT_FCS] >= 1
    assert (master if source == 0 else slave)[lib.DPM_REJECT_FCS] == 0
