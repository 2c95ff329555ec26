# SPDX-License-Identifier: MIT
"""The event ring: in order, whole, and when it overflows the oldest are dropped and counted."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from race_build import SANITIZERS, run_race

from dpmaster._core import block, ffi, lib


class Ring:
    def __init__(self, events: int) -> None:
        size = lib.dpm_ring_size(events)
        self.memory = block(size)
        self.it = lib.dpm_ring_init(self.memory, size, events)
        self.lost = ffi.new("uint64_t *")

    def put(self, value: int) -> None:
        lib.dpm_ring_put(self.it, ffi.new("dpm_event *", {"value": value, "number": 1234}))

    def take(self) -> tuple[int, int] | None:
        """Number and value of the next event."""
        event = ffi.new("dpm_event *")
        return (event.number, event.value) if lib.dpm_ring_take(self.it, event, self.lost) else None


def test_an_event_keeps_every_field_and_gets_its_number() -> None:
    ring = Ring(2)
    fields = {"time": -(1 << 62), "kind": lib.DPM_EV_LATE, "address": -1, "a": -2, "b": 1 << 30, "value": 1 << 60}
    lib.dpm_ring_put(ring.it, ffi.new("dpm_event *", fields))
    event = ffi.new("dpm_event *")
    assert lib.dpm_ring_take(ring.it, event, ring.lost) == 1
    assert {name: getattr(event, name) for name in fields} == fields
    assert event.number == 1


def test_an_empty_ring_gives_nothing_and_loses_nothing() -> None:
    ring = Ring(4)
    assert ring.take() is None
    ring.put(10)
    assert ring.take() == (1, 10)
    assert ring.take() is None
    assert ring.lost[0] == 0


def test_a_full_ring_drops_the_oldest_and_says_how_many() -> None:
    ring = Ring(4)
    for n in range(1, 8):
        ring.put(n)
    assert [ring.take() for _ in range(5)] == [(4, 4), (5, 5), (6, 6), (7, 7), None]
    assert ring.lost[0] == 3


@pytest.mark.parametrize("events", [0, 1, 3, 131072, 65537, 1 << 31])
def test_a_size_that_is_no_power_of_two_or_out_of_range_is_refused(events: int) -> None:
    assert lib.dpm_ring_size(events) == 0
    memory = block(4096)
    assert lib.dpm_ring_init(memory, 4096, events) == ffi.NULL


def test_a_block_that_does_not_fit_is_refused() -> None:
    size = lib.dpm_ring_size(8)
    memory = block(size + 16)
    assert lib.dpm_ring_init(memory, size - 1, 8) == ffi.NULL
    assert lib.dpm_ring_init(memory + 8, size, 8) == ffi.NULL
    assert lib.dpm_ring_init(ffi.NULL, size, 8) == ffi.NULL
    assert lib.dpm_ring_init(memory, size, 8) != ffi.NULL
    assert lib.dpm_ring_size(65536) > 65536


@given(st.sampled_from([2, 4, 16]), st.lists(st.booleans(), max_size=200))
def test_the_ring_is_a_bounded_queue(events: int, steps: list[bool]) -> None:
    ring, queue, number, lost = Ring(events), list[int](), 0, 0
    reported = 0
    for put in steps:
        if put:
            number += 1
            ring.put(-number)
            queue.append(number)
            if len(queue) > events:
                queue.pop(0)
                lost += 1
        else:
            assert ring.take() == ((queue[0], -queue.pop(0)) if queue else None)
            reported = lost
        assert ring.lost[0] == reported


@pytest.mark.tree
@pytest.mark.parametrize("sanitizer", SANITIZERS)
@pytest.mark.parametrize("events", [2, 64])
def test_two_threads_never_tear_an_event_and_lose_none_uncounted(tmp_path: Path, sanitizer: str, events: int) -> None:
    run_race("event", tmp_path, sanitizer, str(events))
