# SPDX-License-Identifier: MIT
"""The process image: whole frames, the newest wins, and only commits of the present epoch are ever sent."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from race_build import SANITIZERS, run_race

from dpmaster._core import block, ffi, lib


class Image:
    def __init__(self) -> None:
        self.memory = block(lib.dpm_image_size())
        self.it = lib.dpm_image_init(self.memory, lib.dpm_image_size())

    def put(self, octets: bytes, **fields: Any) -> int:
        frame = ffi.new("dpm_frame *", {"length": len(octets), "octets": list(octets), **fields})
        return int(lib.dpm_image_put(self.it, frame))

    def get(self) -> tuple[int, bytes]:
        frame = lib.dpm_image_get(self.it)
        return frame.number, bytes(frame.octets[0 : frame.length])


class Outputs:
    def __init__(self, length: int = 4) -> None:
        self.memory = block(lib.dpm_outputs_size())
        self.length = length
        self.it = lib.dpm_outputs_init(self.memory, lib.dpm_outputs_size(), length)

    def commit(self, octets: bytes, offset: int = 0, now: int = 0) -> int:
        return int(lib.dpm_outputs_commit(self.it, offset, octets, len(octets), now))

    def change(self, octets: bytes, keep: bytes, offset: int = 0) -> int:
        return int(lib.dpm_outputs_change(self.it, offset, keep, octets, len(octets), 0))

    def take(self) -> tuple[int, bytes]:
        frame = lib.dpm_outputs_take(self.it)
        return frame.number, bytes(frame.octets[0 : frame.length])

    def exchange(self) -> bytes:
        number, octets = self.take()
        lib.dpm_outputs_answered(self.it, number)
        return octets

    def sent(self, number: int) -> int:
        return int(lib.dpm_outputs_was_sent(self.it, number))

    def safe(self, latch: bool = False) -> None:
        lib.dpm_outputs_make_safe(self.it, latch)

    def peek(self) -> bytes:
        octets = ffi.new("uint8_t[]", self.length)
        lib.dpm_outputs_peek(self.it, octets)
        return bytes(octets)


ZEROS = bytes(4)
DISCARDED = lib.DPM_E_DISCARDED


def test_an_image_begins_with_an_empty_frame() -> None:
    assert Image().get() == (0, b"")


def test_a_frame_arrives_whole_and_stays_until_a_newer_one() -> None:
    image = Image()
    assert image.put(b"\x01\x02", cycle=7, time=-5, valid=True, epoch=3, number=99) == 1
    frame = lib.dpm_image_get(image.it)
    assert (frame.number, frame.cycle, frame.time, frame.valid, frame.epoch) == (1, 7, -5, True, 3)
    assert image.get() == (1, b"\x01\x02") == image.get()


def test_the_newest_frame_wins_and_the_readers_frame_is_left_alone() -> None:
    image = Image()
    image.put(b"one")
    held = lib.dpm_image_get(image.it)
    for n in range(2, 8):
        assert image.put(b"%d" % n) == n
    assert bytes(held.octets[0 : held.length]) == b"one"
    assert image.get() == (7, b"7")


def test_a_block_that_does_not_fit_is_refused() -> None:
    for size, init in ((lib.dpm_image_size(), lib.dpm_image_init),
                       (lib.dpm_outputs_size(), lambda memory, size: lib.dpm_outputs_init(memory, size, 4))):
        memory = block(size + 16)
        assert init(memory, size - 1) == ffi.NULL
        assert init(memory + 8, size) == ffi.NULL
        assert init(ffi.NULL, size) == ffi.NULL
        assert init(memory + 16, size) != ffi.NULL
    memory = block(lib.dpm_outputs_size())
    assert lib.dpm_outputs_init(memory, lib.dpm_outputs_size(), 245) == ffi.NULL
    assert lib.dpm_outputs_init(memory, lib.dpm_outputs_size(), 244) != ffi.NULL


def test_outputs_are_zeros_until_a_commit() -> None:
    outputs = Outputs()
    assert outputs.take() == (0, ZEROS)
    assert outputs.commit(b"\x11\x22\x33\x44", now=77) == 1
    frame = lib.dpm_outputs_take(outputs.it)
    assert (frame.time, frame.epoch, frame.valid) == (77, 1, True)
    assert outputs.take() == (1, b"\x11\x22\x33\x44")


def test_a_part_builds_on_what_was_committed_before() -> None:
    outputs = Outputs()
    outputs.commit(b"\x11\x22\x33\x44")
    assert outputs.commit(b"\xaa", offset=2) == 2
    assert outputs.take() == (2, b"\x11\x22\xaa\x44")
    assert outputs.peek() == b"\x11\x22\xaa\x44"


@pytest.mark.parametrize(("offset", "n"), [(0, 5), (4, 1), (1, 4), (65535, 65535)])
def test_a_commit_past_the_end_changes_nothing(offset: int, n: int) -> None:
    outputs = Outputs()
    assert outputs.commit(b"\xff" * n, offset) == lib.DPM_E_LENGTH
    assert outputs.peek() == ZEROS
    assert outputs.take() == (0, ZEROS)


def test_a_station_without_outputs_can_still_be_committed() -> None:
    outputs = Outputs(0)
    assert lib.dpm_outputs_commit(outputs.it, 0, ffi.NULL, 0, 0) == 1
    assert outputs.take() == (1, b"")


def test_a_commit_was_sent_when_it_or_a_later_one_was_answered() -> None:
    outputs = Outputs()
    outputs.commit(b"\x01")
    assert outputs.sent(1) == 0
    outputs.take()
    assert outputs.sent(1) == 0, "sent is not answered"
    outputs.commit(b"\x02")
    lib.dpm_outputs_answered(outputs.it, 1)
    assert (outputs.sent(1), outputs.sent(2)) == (1, 0)
    outputs.commit(b"\x03")
    assert outputs.exchange() == b"\x03\0\0\0"
    assert [outputs.sent(n) for n in (1, 2, 3)] == [1, 1, 1], "2 was overtaken by 3"


def test_only_numbers_of_commits_can_be_asked_for() -> None:
    outputs = Outputs()
    outputs.commit(b"\x01")
    assert outputs.sent(0) == outputs.sent(2) == lib.DPM_E_ARGUMENT


def test_an_answer_without_a_commit_counts_for_nothing() -> None:
    outputs = Outputs()
    outputs.exchange()
    outputs.commit(b"\x01")
    lib.dpm_outputs_answered(outputs.it, 1)
    assert outputs.sent(1) == 0, "commit 1 was never handed out"


def test_what_was_committed_before_make_safe_is_never_sent_again() -> None:
    outputs = Outputs()
    outputs.commit(b"\x11\x22\x33\x44")
    outputs.exchange()
    outputs.commit(b"\x55")
    outputs.safe()
    assert outputs.take() == (0, ZEROS)
    assert lib.dpm_outputs_take(outputs.it).epoch == 2
    assert (outputs.sent(1), outputs.sent(2)) == (1, DISCARDED)
    assert outputs.peek() == ZEROS
    assert outputs.commit(b"\x66", offset=3) == 3
    assert outputs.take() == (3, b"\0\0\0\x66"), "octets not named begin as zeros in a new epoch"
    assert (outputs.sent(1), outputs.sent(2), outputs.sent(3)) == (1, DISCARDED, 0)


def test_an_answer_after_make_safe_does_not_count() -> None:
    outputs = Outputs()
    outputs.commit(b"\x01")
    number, _ = outputs.take()
    outputs.safe()
    assert outputs.sent(1) == DISCARDED
    lib.dpm_outputs_answered(outputs.it, number)
    assert outputs.sent(1) == DISCARDED, "what was said once stays"
    outputs.commit(b"\x02")
    outputs.take()
    lib.dpm_outputs_answered(outputs.it, number)
    assert (outputs.sent(1), outputs.sent(2)) == (DISCARDED, 0)


def test_the_epoch_before_the_last_commit_is_remembered_and_older_ones_count_as_discarded() -> None:
    outputs = Outputs()
    for octet in (b"\x01", b"\x02", b"\x03"):
        outputs.commit(octet)
        outputs.exchange()
        outputs.safe()
    assert [outputs.sent(n) for n in (1, 2, 3)] == [DISCARDED, 1, 1]


def test_the_latch_refuses_commits_until_it_is_taken_off() -> None:
    outputs = Outputs()
    outputs.commit(b"\x01")
    outputs.safe(latch=True)
    outputs.safe()
    assert outputs.commit(b"\x02") == lib.DPM_E_LATCHED
    assert outputs.commit(b"\x02" * 5) == lib.DPM_E_LENGTH
    assert outputs.take() == (0, ZEROS)
    lib.dpm_outputs_unlatch(outputs.it)
    assert outputs.take() == (0, ZEROS), "taking the latch off brings nothing back"
    assert outputs.commit(b"\x02", offset=1) == 2, "a refused commit has no number"
    assert outputs.take() == (2, b"\0\x02\0\0")


def test_a_change_keeps_the_bits_of_its_own_epoch_only() -> None:
    """design page: "only a commit made after its return reaches it": nor may one made then carry an old run bit over."""
    outputs = Outputs()
    outputs.commit(b"\x0f\x11")
    assert outputs.change(b"\x80\x02", b"\x0e\x00") == 2
    assert outputs.take() == (2, b"\x8e\x02\0\0")
    outputs.safe()
    assert outputs.change(b"\x80\x02", b"\x0e\xff") == 3
    assert outputs.take() == (3, b"\x80\x02\0\0")
    assert outputs.change(b"\0\0", b"\0\0", offset=3) == lib.DPM_E_LENGTH
    outputs.safe(latch=True)
    assert outputs.change(b"\0", b"\0") == lib.DPM_E_LATCHED


STEP = st.one_of(
    st.tuples(st.just("commit"), st.integers(0, 3), st.binary(min_size=1, max_size=4)),
    st.sampled_from([("exchange",), ("take",), ("safe",)]),
)


@given(st.lists(STEP, max_size=60))
def test_outputs_follow_a_model_that_remembers_everything(steps: list[tuple[Any, ...]]) -> None:
    outputs = Outputs()
    epoch, image, carried = 1, bytearray(4), {0: 0}
    commits = {0: (0, ZEROS)}  # number: epoch and octets
    for step in steps:
        if step[0] == "commit":
            offset, octets = step[1], step[2][: 4 - step[1]]
            image[offset : offset + len(octets)] = octets
            number = outputs.commit(octets, offset)
            assert number == len(commits)
            commits[number] = (epoch, bytes(image))
        elif step[0] == "safe":
            outputs.safe()
            epoch, image = epoch + 1, bytearray(4)
        else:
            last = max(commits)
            expected = (last, commits[last][1]) if commits[last][0] == epoch else (0, ZEROS)
            assert outputs.take() == expected
            if step[0] == "exchange":
                lib.dpm_outputs_answered(outputs.it, expected[0])
                carried[expected[0]] = epoch
        assert outputs.peek() == bytes(image)
        previous = sorted({e for e, _ in commits.values() if e})[-2:]
        for number, (made, _) in commits.items():
            if number and made in previous:
                was = any(n >= number and e == made for n, e in carried.items())
                assert outputs.sent(number) == (1 if was else 0 if made == epoch else DISCARDED)


@pytest.mark.tree
@pytest.mark.parametrize("sanitizer", SANITIZERS)
def test_two_threads_never_see_half_a_frame_nor_a_stale_commit(tmp_path: Path, sanitizer: str) -> None:
    seed = random.randrange(1, 1 << 32)
    print("seed", seed)
    run_race("image", tmp_path, sanitizer, str(seed))
