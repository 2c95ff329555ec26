# SPDX-License-Identifier: MIT
"""The wire inside the segment hub (csrc/linux/wire.c) on virtual time: pace, overlap, order and faults, one event at a time.

The file is private to the library, so it is compiled here by itself; it needs nothing else, which is a rule of its room.
"""

from __future__ import annotations

import random
import re
import shlex
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import pytest
from cffi import FFI

from dpmaster import _build

pytestmark = pytest.mark.tree

ROOT = Path(__file__).resolve().parent.parent
CHARACTER = 22_000  # ns: 11 bits at 500 kbit/s


@pytest.fixture(scope="module")
def c(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    target = tmp_path_factory.mktemp("wire") / "wire.so"
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    subprocess.run([compiler, "-std=c11", "-shared", "-fPIC", "-O1", "-I", ROOT / "include", "-I", ROOT / "csrc", "-o", target,
                    ROOT / "csrc" / "linux" / "wire.c"], check=True)
    text = re.sub(r"/\*.*?\*/", " ", (ROOT / "csrc" / "linux" / "wire.h").read_text(), flags=re.DOTALL)
    private = "\n".join(line for line in text.splitlines()
                        if not line.startswith("#") or re.match(r"#define \w+ \d", line))
    ffi = FFI()
    ffi.cdef(_build.declarations() + private)
    return ffi, ffi.dlopen(str(target))


class Wire:
    """A wire with two ports and the attached slaves (source 2)."""

    def __init__(self, c: tuple[Any, Any], paced: bool = True, **faults: int) -> None:
        self.ffi, self.lib = c
        self.lanes = self.ffi.new("dpm_lane[]", 3)
        self.wire = self.ffi.new("dpm_wire *")
        rate = self.ffi.new("dpm_parameters *", {"rate_num": 500_000, "rate_den": 1})
        self.lib.dpm_wire_init(self.wire, rate, paced, self.lanes, 3)
        self.lib.dpm_wire_set_faults(self.wire, self.ffi.new("dpm_segment_faults *", faults))

    def put(self, source: int, now: int, octets: bytes, errors: bytes | None = None) -> int:
        assert self.lib.dpm_wire_room(self.wire, source)
        return int(self.lib.dpm_wire_put(self.wire, source, now, octets, errors or self.ffi.NULL, len(octets)))

    def due(self) -> int:
        return int(self.lib.dpm_wire_due(self.wire))

    def take(self, now: int) -> tuple[int, int, bytes] | None:
        """(source, due, octets as heard)"""
        source = self.ffi.new("unsigned *")
        flight = self.lib.dpm_wire_take(self.wire, now, source)
        return (source[0], flight.due, bytes(flight.heard[0 : flight.n])) if flight else None

    def errors(self, now: int) -> bytes | None:
        """The line errors of the transmission due first, None where it says that there are none."""
        flight = self.lib.dpm_wire_take(self.wire, now, self.ffi.new("unsigned *"))
        return bytes(flight.errors[0 : flight.n]) if flight.bad else None

    def damage(self, octets: bytes) -> bytes:
        return self.damage_told(octets)[0]

    def damage_told(self, octets: bytes) -> tuple[bytes, bytes]:
        """The octets that are left and their line errors."""
        out, errors = (self.ffi.new("uint8_t[]", 3 * len(octets)) for _ in range(2))
        left = self.lib.dpm_wire_damage(self.wire, octets, len(octets), out, errors)
        return bytes(out[0:left]), bytes(errors[0:left])


def test_a_transmission_is_due_when_its_last_octet_has_ended(c: Any) -> None:
    wire = Wire(c)
    assert wire.put(0, 1000, b"abc") == 1000
    assert wire.due() == 1000 + 3 * CHARACTER
    assert wire.take(1000 + 3 * CHARACTER - 1) is None
    assert wire.take(1000 + 3 * CHARACTER) == (0, 1000 + 3 * CHARACTER, b"abc")
    assert wire.due() == wire.lib.DPM_NEVER


def test_a_write_read_in_two_pieces_is_one_transmission(c: Any) -> None:
    wire = Wire(c)
    wire.put(0, 0, b"ab")
    assert wire.put(0, 2 * CHARACTER, b"cd") == 2 * CHARACTER  # the very end: contiguous
    assert wire.take(4 * CHARACTER) == (0, 4 * CHARACTER, b"abcd")
    assert wire.wire.transmissions == 1
    wire.put(0, 10 * CHARACTER, b"e")
    assert wire.wire.transmissions == 2 and wire.due() == 11 * CHARACTER


def test_a_source_does_not_talk_over_itself(c: Any) -> None:
    wire = Wire(c)
    full = bytes(255)
    for _ in range(3):
        wire.put(0, 0, full)  # 765 octets: no room in this transmission for more
    assert wire.put(0, 0, full) == 765 * CHARACTER
    assert wire.wire.collisions == 0
    taken = [wire.take(10**12), wire.take(10**12)]
    assert [due for _, due, _ in filter(None, taken)] == [765 * CHARACTER, 1020 * CHARACTER]


def test_a_source_whose_transmissions_are_all_under_way_has_no_room(c: Any) -> None:
    wire = Wire(c)
    while wire.lib.dpm_wire_room(wire.wire, 0):
        wire.put(0, 0, bytes(255))
        assert wire.wire.octets <= 4 * 768
    assert wire.lib.dpm_wire_room(wire.wire, 1)
    wire.take(10**12)
    assert wire.lib.dpm_wire_room(wire.wire, 0)


def test_sources_are_delivered_in_the_order_of_their_ends(c: Any) -> None:
    wire = Wire(c)
    wire.put(0, 0, b"a" * 10)
    wire.put(1, CHARACTER, b"b")
    assert [taken[0] for _ in range(2) if (taken := wire.take(10**9))] == [1, 0]


def test_octets_that_share_time_are_garbled_on_both_sides_and_others_are_not(c: Any) -> None:
    wire = Wire(c)
    wire.put(0, 0, b"\xf0" * 4)
    wire.put(1, 2 * CHARACTER + 1, b"\x0f" * 3)  # shares octets 2 and 3 of the first
    assert wire.take(10**9) == (0, 4 * CHARACTER, b"\xf0\xf0\x00\x00")
    assert wire.take(10**9) == (1, 5 * CHARACTER + 1, b"\x00\x00\x0f")
    assert wire.wire.collisions == 2


def test_a_collision_is_a_line_error_where_it_happens(c: Any) -> None:
    wire = Wire(c)
    parity = wire.lib.DPM_LINE_PARITY
    wire.put(0, 0, b"\xf0" * 4)
    wire.put(1, 2 * CHARACTER + 1, b"\x0f" * 3)
    assert wire.errors(10**9) == bytes([0, 0, parity, parity])
    assert wire.errors(10**9) == bytes([parity, parity, 0])
    wire.put(0, 10**9, b"\xf0" * 4)
    assert wire.errors(10**10) is None, "those of an earlier transmission"


def test_line_errors_stay_with_their_octets(c: Any) -> None:
    wire = Wire(c)
    wire.put(0, 0, b"ab", bytes([0, 1]))
    wire.put(0, 1, b"cd")
    wire.put(0, 2, b"e", bytes([8]))
    assert wire.errors(10**9) == bytes([0, 1, 0, 0, 8])


def test_transmissions_that_touch_do_not_collide(c: Any) -> None:
    wire = Wire(c)
    wire.put(0, 0, b"\xff")
    wire.put(1, CHARACTER, b"\x00")
    assert wire.take(10**9) == (0, CHARACTER, b"\xff")
    assert wire.wire.collisions == 0


def test_a_collision_of_three_counts_each_once(c: Any) -> None:
    wire = Wire(c)
    for source, octets in enumerate((b"\xfe\xfe", b"\xfd\xfd", b"\xfb\xfb")):
        wire.put(source, 0, octets)
    assert [taken[2] for _ in range(3) if (taken := wire.take(10**9))] == [b"\xf8\xf8"] * 3
    assert wire.wire.collisions == 3


def test_garbling_equals_a_slow_model(c: Any) -> None:
    """Every octet is heard as the AND of all that share time with it, whatever the starts and lengths."""
    seed = random.randrange(1 << 32)
    print("seed", seed)
    draw = random.Random(seed)
    for _ in range(200):
        wire = Wire(c)
        talks = [(draw.randrange(20 * CHARACTER), draw.randbytes(draw.randint(1, 40))) for _ in range(3)]
        for source in sorted(range(3), key=lambda source: talks[source][0]):
            wire.put(source, *talks[source])
        heard = {taken[0]: taken[2] for _ in range(3) if (taken := wire.take(10**9))}
        for source, (start, octets) in enumerate(talks):
            expected = bytearray(octets)
            for i in range(len(octets)):
                for other, (begin, others) in enumerate(talks):
                    for j, octet in enumerate(others):
                        if other != source and abs((start + i * CHARACTER) - (begin + j * CHARACTER)) < CHARACTER:
                            expected[i] &= octet
            assert heard[source] == bytes(expected)


def test_nothing_is_called_quiet_behind_the_start_of_what_is_under_way(c: Any) -> None:
    wire = Wire(c)
    heard = wire.lib.dpm_wire_heard
    wire.put(0, 100, b"ab")
    assert heard(wire.wire, 5000, 2) == 100
    assert heard(wire.wire, 50, 2) == 50
    assert heard(wire.wire, 5000, 0) == 5000  # its own


def test_delay_is_added_to_the_end(c: Any) -> None:
    for paced, end in (True, CHARACTER), (False, 0):
        wire = Wire(c, paced, delay=7)
        assert not wire.lib.dpm_wire_direct(wire.wire)
        wire.put(0, 0, b"a")
        assert wire.due() == end + 7
    prompt = Wire(c, False)
    assert prompt.lib.dpm_wire_direct(prompt.wire)


def test_rates_are_fractions_and_roundings_do_not_add_up(c: Any) -> None:
    """45.45 kbit/s is 500000/11: a character lasts 242 us exactly; at 12 Mbit/s twelve last 11 us exactly."""
    wire = Wire(c)
    wire.wire.rate_num, wire.wire.rate_den = 500_000, 11
    assert wire.lib.dpm_wire_time(wire.wire, 255) == 255 * 242_000
    wire.wire.rate_num, wire.wire.rate_den = 12_000_000, 1
    assert wire.lib.dpm_wire_time(wire.wire, 12) == 11_000


ALL = 1_000_000


def test_each_fault_does_what_it_says(c: Any) -> None:
    octets = bytes(range(100))
    assert Wire(c, lose=ALL).damage(octets) == b""
    assert Wire(c, lose_telegram=ALL).damage(octets) == b""
    assert Wire(c, duplicate=ALL).damage(octets) == bytes(o for o in octets for _ in range(2))
    assert Wire(c, insert=ALL).damage(octets)[1::2] == octets
    flipped = Wire(c, flip=ALL).damage(octets)
    assert all((a ^ b).bit_count() == 1 for a, b in zip(octets, flipped, strict=True))
    assert Wire(c, flip=ALL).damage_told(octets)[1] == bytes(100), "the parity bit went along"
    wire = Wire(c, parity=ALL, duplicate=ALL)
    bad, told = wire.damage_told(octets)
    assert all((a ^ b).bit_count() == 1 for a, b in zip(octets, bad[::2], strict=True)) and bad[1::2] == bad[::2]
    assert told == bytes([wire.lib.DPM_LINE_PARITY]) * 200
    assert len(Wire(c, insert=ALL, duplicate=ALL).damage(bytes(255))) == 3 * 255 == 765  # what a transmission must hold


def test_the_same_seed_makes_the_same_faults_however_the_octets_are_cut(c: Any) -> None:
    octets = bytes(random.Random(1).randbytes(250))
    chances = {"lose": 50_000, "flip": 50_000, "parity": 50_000, "insert": 50_000, "duplicate": 50_000}
    whole = Wire(c, seed=5, **chances).damage(octets)
    pieces = Wire(c, seed=5, **chances)
    assert b"".join(pieces.damage(octets[i : i + 7]) for i in range(0, 250, 7)) == whole != octets
    assert Wire(c, seed=6, **chances).damage(octets) != whole
    assert pieces.wire.touched > 0


def test_chances_are_kept(c: Any) -> None:
    """10 % of 25 500 octets, 7 sigma either way."""
    wire = Wire(c, seed=1, flip=100_000)
    for _ in range(100):
        wire.damage(bytes(255))
    assert abs(wire.wire.touched - 2550) < 7 * (25_500 * 0.1 * 0.9) ** 0.5
