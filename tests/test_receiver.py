# SPDX-License-Identifier: MIT
"""The stream receiver on virtual time: one rule at a time, against a slow model, and on recordings of real buses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from slow_decoder import ED, SC, SD1, SD2, SD3, SD4, Found, Line, build, receive

from dpmaster._core import ffi, lib
from dpmaster.telegram import Telegram, decode

BIT = 2000  # ns: 500 kbit/s
CHARACTER = 11 * BIT
PATIENCE = 33 * BIT
GAP = 4 * BIT

STATUS = build(SD1, 5, 2, 0x49)
ANSWER = build(SD2, 2, 5, 0x08, bytes([4, 2, 55, 0, 0]))
EXCHANGE = build(SD2, 5, 2, 0x5D, bytes(range(11)))
NAMES = [ffi.string(lib.dpm_reject_name(reason)).decode() for reason in range(lib.DPM_REJECT_COUNT)]


@dataclass
class Received:
    octets: bytes
    start_latest: int
    end_earliest: int
    end_latest: int


@dataclass
class Receiver:
    """The C receiver and what it found. A span is thrown away after each call, as a port's buffer would be."""

    character: int = CHARACTER
    patience: int = PATIENCE
    gap: int = GAP
    found: list[Received] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.raw: Any = ffi.new("dpm_receiver *")
        self.received: Any = ffi.new("dpm_received *")
        lib.dpm_receiver_init(self.raw, self.character, self.patience, self.gap)

    def _note(self) -> None:
        r = self.received
        octets = bytes(ffi.buffer(r.octets, r.n))
        telegram, n = decode(octets)
        assert n == r.n and r.telegram.length == len(telegram.data)
        assert bytes(ffi.buffer(r.telegram.data, r.telegram.length)) == telegram.data
        self.found.append(Received(octets, r.start_latest, r.end_earliest, r.end_latest))

    def take(self, octets: bytes, at: int, width: int = 0, errors: bytes | None = None, spacing: int | None = None) -> None:
        """Octets of which the first ends within [at, at + width]."""
        memory = ffi.new("uint8_t[]", octets)
        bad = ffi.NULL if errors is None else ffi.new("uint8_t[]", errors)
        span = ffi.new("dpm_span *", {
            "octets": memory, "errors": bad, "n": len(octets), "earliest": at, "latest": at + width,
            "spacing": self.character if spacing is None else spacing})
        while lib.dpm_receiver_take(self.raw, span, self.received):
            self._note()
        assert span.n == 0

    def quiet(self, until: int) -> None:
        while lib.dpm_receiver_quiet(self.raw, until, self.received):
            self._note()

    @property
    def telegrams(self) -> list[bytes]:
        return [received.octets for received in self.found]

    @property
    def rejected(self) -> dict[str, int]:
        return {NAMES[reason]: self.raw.rejected[reason] for reason in range(1, len(NAMES)) if self.raw.rejected[reason]}

    @property
    def pending(self) -> int:
        return int(self.raw.end - self.raw.begin)

    @property
    def deadline(self) -> int:
        return int(lib.dpm_receiver_deadline(self.raw))


# --- one rule at a time ------------------------------------------------------------------------------------------------

def test_a_telegram_and_its_times() -> None:
    receiver = Receiver()
    receiver.take(STATUS, at=CHARACTER, width=7)
    assert receiver.found == [Received(STATUS, 7, 6 * CHARACTER, 6 * CHARACTER + 7)]
    assert (receiver.rejected, receiver.raw.rejected[0], receiver.deadline) == ({}, 1, lib.DPM_NEVER)


def test_several_in_one_span_and_one_in_several_spans() -> None:
    receiver = Receiver()
    receiver.take(STATUS + ANSWER + STATUS[:2], at=0)
    assert receiver.telegrams == [STATUS, ANSWER]
    for i, octet in enumerate(STATUS[2:]):
        receiver.take(bytes([octet]), at=(len(STATUS + ANSWER) + 2 + i) * CHARACTER)
    assert receiver.telegrams == [STATUS, ANSWER, STATUS]
    assert receiver.found[2].start_latest == (len(STATUS + ANSWER) - 1) * CHARACTER


@pytest.mark.parametrize("noise", ["00", "FF", "68", "16", "10", "DC 85", "68 05", "68 05 05", "A2", "00 FF 16", "68 0B 0B 68"])
def test_the_telegram_after_noise_is_found(noise: str) -> None:
    """At once when the noise is proved bad, else when the bus has fallen silent: a master still has it in its slot."""
    stray = bytes.fromhex(noise)
    receiver = Receiver()
    receiver.take(stray + ANSWER, at=0)
    receiver.quiet((len(stray + ANSWER) - 1) * CHARACTER + PATIENCE)
    assert receiver.telegrams == [ANSWER]
    assert sum(receiver.rejected.values()) == len(stray)
    assert receiver.pending == 0


@pytest.mark.parametrize("noise", ["00", "FF", "16", "68", "68 05", "10", "DC 85"])
def test_noise_that_is_proved_bad_costs_no_patience(noise: str) -> None:
    receiver = Receiver()
    receiver.take(bytes.fromhex(noise) + ANSWER, at=0)
    assert receiver.telegrams == [ANSWER]


def test_a_stray_dc_makes_a_token_that_passes_every_check() -> None:
    """SD4 has no FCS and no ED: only addresses above 125 could give it away. The telegram it began with is lost."""
    receiver = Receiver()
    receiver.take(b"\xdc" + ANSWER + STATUS, at=0)
    assert receiver.telegrams == [b"\xdc" + ANSWER[:2], STATUS]


def test_octets_inside_a_telegram_are_none_of_their_own() -> None:
    """A Data_Exchange whose data are an FDL status request, octet by octet."""
    telegram = build(SD2, 5, 2, 0x5D, STATUS + b"\xe5\xdc\x02\x02")
    receiver = Receiver()
    for i, octet in enumerate(telegram):
        receiver.take(bytes([octet]), at=i * CHARACTER)
    receiver.quiet(1 << 40)
    assert (receiver.telegrams, receiver.rejected) == ([telegram], {})


def test_patience_ends_an_unfinished_telegram_and_not_a_moment_before() -> None:
    receiver = Receiver()
    receiver.take(EXCHANGE[:-1], at=0, width=9)
    last = (len(EXCHANGE) - 2) * CHARACTER + 9
    assert receiver.deadline == last + PATIENCE
    receiver.quiet(last + PATIENCE - 1)
    assert receiver.pending == len(EXCHANGE) - 1
    receiver.quiet(last + PATIENCE)
    assert (receiver.pending, receiver.deadline) == (0, lib.DPM_NEVER)
    assert (receiver.telegrams, receiver.rejected) == ([], {"incomplete": len(EXCHANGE) - 1})


def test_a_line_error_spoils_the_telegram_that_has_it_and_no_other() -> None:
    for at in range(len(ANSWER)):
        errors = bytearray(3 * len(ANSWER))
        errors[len(ANSWER) + at] = lib.DPM_LINE_PARITY
        receiver = Receiver()
        receiver.take(3 * ANSWER, at=0, errors=bytes(errors))
        receiver.quiet(1 << 40)
        # What is left behind the error may look like a beginning, and silence gives the good telegram back.
        assert receiver.telegrams == [ANSWER, ANSWER]
        assert sum(receiver.rejected.values()) == len(ANSWER)
        assert receiver.rejected["line error"] >= at + 1


def test_a_certain_gap_breaks_a_telegram_and_the_next_is_found_at_once() -> None:
    receiver = Receiver()
    receiver.take(EXCHANGE[:7], at=0)
    receiver.take(ANSWER, at=7 * CHARACTER + GAP + 1)
    assert (receiver.telegrams, receiver.rejected) == ([ANSWER], {"gap": 7})


def test_a_pause_of_exactly_the_gap_is_allowed() -> None:
    receiver = Receiver()
    receiver.take(EXCHANGE[:7], at=0)
    receiver.take(EXCHANGE[7:], at=7 * CHARACTER + GAP)
    assert (receiver.telegrams, receiver.raw.gaps_unknown) == ([EXCHANGE], 0)


def test_an_uncertain_pause_is_counted_and_never_a_reason_to_drop() -> None:
    receiver = Receiver()
    receiver.take(EXCHANGE[:7], at=0, width=2)
    receiver.take(EXCHANGE[7:], at=7 * CHARACTER + GAP + 1, width=1)
    assert (receiver.telegrams, receiver.raw.gaps_unknown) == ([EXCHANGE], 1)


def test_a_pause_between_telegrams_is_no_gap() -> None:
    receiver = Receiver()
    receiver.take(STATUS, at=0)
    receiver.take(ANSWER, at=100 * CHARACTER, width=100 * CHARACTER)
    assert (receiver.telegrams, receiver.rejected) == ([STATUS, ANSWER], {})


def test_octets_that_lie_apart_inside_one_span() -> None:
    receiver = Receiver()
    receiver.take(STATUS, at=0, spacing=CHARACTER + GAP + 1)
    receiver.quiet(1 << 40)
    assert (receiver.telegrams, receiver.rejected["gap"]) == ([], 1)


def test_without_a_gap_no_pause_is_judged() -> None:
    """A pty: the pace of the writer is nobody's business."""
    receiver = Receiver(character=0, gap=0)
    receiver.take(EXCHANGE[:7], at=0)
    receiver.take(EXCHANGE[7:], at=10**9)
    assert (receiver.telegrams, receiver.raw.gaps_unknown) == ([EXCHANGE], 0)
    assert receiver.found[0].start_latest == 0


def test_flush_counts_what_it_throws_away() -> None:
    receiver = Receiver()
    receiver.take(EXCHANGE[:7], at=0)
    lib.dpm_receiver_flush(receiver.raw)
    assert (receiver.pending, receiver.rejected) == (0, {"incomplete": 7})
    receiver.take(ANSWER, at=7 * CHARACTER)
    assert receiver.telegrams == [ANSWER]


def test_the_longest_telegrams_back_to_back_never_overrun_the_store() -> None:
    longest = build(SD2, 5, 2, 0x5D, bytes([SC] * 246))
    stream = b"".join(longest + STATUS[: i % 3] for i in range(12))
    for chunk in (1, 254, 255, 256, 511, 512, 513, len(stream)):
        receiver = Receiver()
        for at in range(0, len(stream), chunk):
            receiver.take(stream[at : at + chunk], at=at * CHARACTER)
        receiver.quiet(1 << 40)
        assert receiver.telegrams == [longest] * 12
        assert sum(receiver.rejected.values()) == sum(i % 3 for i in range(12))


# --- against the slow model --------------------------------------------------------------------------------------------

octet = st.integers(0, 255) | st.sampled_from([SD1, SD2, SD3, SD4, SC, ED])
good = st.sampled_from([STATUS, ANSWER, EXCHANGE, bytes([SC]), bytes([SD4, 5, 2]), build(SD2, 5, 2, 0x5D, STATUS * 2),
                        build(SD3, 5, 2, 0x5D, b"\x68\x05\x05\x68" * 2)])
spoiled = st.tuples(good, st.integers(0, 300), octet).map(
    lambda t: t[0][: t[1] % len(t[0])] + bytes([t[2]]) + t[0][t[1] % len(t[0]) + 1 :])
piece = good | spoiled | st.lists(octet, max_size=5).map(bytes) | good.map(lambda telegram: telegram[:-1])
pause = st.sampled_from([0, 0, 0, GAP, GAP + 1, GAP + 40, PATIENCE - 1, PATIENCE, 3 * PATIENCE])


@dataclass
class Chunk:
    octets: bytes
    errors: bytes | None
    at: int
    width: int
    quiet: int | None


@st.composite
def traffic(draw: st.DrawFn) -> list[Chunk]:
    """Pieces good and bad, cut anywhere, some with errors, with pauses, seen more or less sharply, with and without quiet."""
    stream = b"".join(draw(st.lists(piece, max_size=7)))
    bad = draw(st.sets(st.integers(0, max(0, len(stream) - 1)), max_size=2)) if draw(st.booleans()) else set()
    cuts = draw(st.sets(st.integers(0, len(stream)), max_size=8)) | {0, len(stream)}
    chunks = []
    time = 0
    for first, end in zip(sorted(cuts), sorted(cuts)[1:], strict=False):
        errors = bytes(int(i in bad) for i in range(first, end))
        time += draw(pause)
        width = draw(st.sampled_from([0, 0, 30, 2 * PATIENCE]))
        last = time + width + (end - first) * CHARACTER
        quiet = draw(st.none() | st.sampled_from([0, PATIENCE - 1, PATIENCE]).map(last.__add__))
        chunks.append(Chunk(stream[first:end], errors if any(errors) else None, time + CHARACTER, width, quiet))
        time += (end - first) * CHARACTER
    return chunks


def model(chunks: list[Chunk], gap: int) -> tuple[Found, Line]:
    line = Line()
    for chunk in chunks:
        for i, value in enumerate(chunk.octets):
            line.octets.append(value)
            line.errors.append(chunk.errors[i] if chunk.errors else 0)
            line.earliest.append(chunk.at + i * CHARACTER)
            line.latest.append(chunk.at + chunk.width + i * CHARACTER)
        if chunk.quiet is not None:
            line.silences[len(line.octets)] = chunk.quiet
    return receive(line, CHARACTER, PATIENCE, gap), line


@given(traffic(), st.sampled_from([0, GAP]))
def test_finds_exactly_what_the_slow_model_finds(chunks: list[Chunk], gap: int) -> None:
    receiver = Receiver(gap=gap)
    for chunk in chunks:
        receiver.take(chunk.octets, chunk.at, chunk.width, chunk.errors)
        if chunk.quiet is not None:
            receiver.quiet(chunk.quiet)
    found, line = model(chunks, gap)
    assert receiver.found == [
        Received(bytes(line.octets[first : first + n]), line.latest[first] - CHARACTER, line.earliest[first + n - 1],
                 line.latest[first + n - 1]) for first, n in found.telegrams]
    assert receiver.pending == found.pending
    barriers = ("line error", "gap", "incomplete")
    counted = Counter({name: n for name, n in receiver.rejected.items() if name in barriers})
    counted["proved bad"] = sum(n for name, n in receiver.rejected.items() if name not in barriers)
    assert counted == found.rejected
    pairs = [(first + i, first + i + 1) for first, n in found.telegrams for i in range(n - 1)]
    unknown = sum(line.latest[b] - CHARACTER - line.earliest[a] > gap for a, b in pairs)
    assert receiver.raw.gaps_unknown == (unknown if gap else 0)


@given(st.lists(piece, max_size=7).map(b"".join), st.lists(st.integers(1, 9), min_size=1, max_size=6))
def test_cutting_changes_nothing(stream: bytes, sizes: list[int]) -> None:
    whole, cut = Receiver(), Receiver()
    whole.take(stream, at=0)
    at = 0
    while at < len(stream):
        n = sizes[at % len(sizes)]
        cut.take(stream[at : at + n], at=at * CHARACTER)
        at += n
    assert (cut.found, cut.rejected, cut.pending) == (whole.found, whole.rejected, whole.pending)


# --- recordings of real buses ------------------------------------------------------------------------------------------

TRACES = Path(__file__).parents[2] / "shared" / "traces"


@dataclass
class Recorded:
    time: int  # ns, first start bit
    octets: bytes
    text: str


def recording(name: str) -> Iterator[Recorded]:
    path = TRACES / name
    if not path.exists():
        pytest.skip(f"{path} is not here: recordings are no part of the project")
    for line in path.read_text().splitlines():
        head, octets, text = line.split("|")
        yield Recorded(round(float(head.split()[0]) * 1e9), bytes.fromhex(octets), text.strip())


def words(telegram: Telegram) -> str:
    """In the words of the recordings' own decoder, which is not ours. It names Data_Exchange by rules of its own."""
    if telegram.function == "Token":
        return f"token {telegram.sa}->{telegram.da}"
    if telegram.function == "SC":
        return "SC"
    text = f"{telegram.sa}->{telegram.da} fc={telegram.fc:02x} {telegram.function}"
    if telegram.is_request:
        text += f" fcb={telegram.fcb:d} fcv={telegram.fcv:d}"
    if telegram.dsap is not None:
        text += f" sap {telegram.ssap}->{telegram.dsap} {telegram.service or 'SAP63'}"
    return f"{text} du[{len(telegram.data)}]"


@pytest.mark.parametrize("name", ["SiemensToBlue.9600.txt", "PCtoBLUE.9600.txt"])
def test_real_buses(name: str) -> None:
    """Every telegram that the analyser read cleanly comes out of the receiver, with its time, and says the same."""
    bit = 1e9 / 9600
    character = round(11 * bit)
    receiver = Receiver(character=character, patience=round(33 * bit), gap=round(4 * bit))
    lines = list(recording(name))
    for line in lines:
        receiver.take(line.octets, at=line.time + character)
    receiver.quiet(1 << 62)
    clean = [line for line in lines if line.text != "BAD"]
    assert len(clean) == len(lines) - 1 > 1000
    assert [(found.octets, found.start_latest) for found in receiver.found] == [(line.octets, line.time) for line in clean]
    for line in clean:
        telegram, _ = decode(line.octets)
        assert words(telegram).casefold() == line.text.replace(" Data_Exchange", "").casefold()
        assert telegram.encode() == line.octets
    assert set(receiver.rejected) == {"incomplete"}  # the recording's last telegram is cut short
