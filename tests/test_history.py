# SPDX-License-Identifier: MIT
"""A slave's last diagnoses: in order, whole, the same one told once, and when there is no room the oldest are dropped."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_dp_master import FREE, READY, SC, Bus, diagnosis, frame
from test_master_pty import CONFIGURATION, IDENT, Echo
from waiting import until

from dpmaster import Master, Station
from dpmaster._core import block, ffi, lib
from dpmaster.emulator import Segment
from dpmaster.station import DIAGNOSES


class History:
    def __init__(self, records: int) -> None:
        size = lib.dpm_history_size(records)
        self.memory = block(size)
        self.it = lib.dpm_history_init(self.memory, size, records)

    def put(self, number: int, octets: bytes) -> None:
        lib.dpm_history_put(self.it, number, 10 * number, octets, len(octets))

    def get(self, after: int = 0, room: int = 100) -> list[Any]:
        records = ffi.new("dpm_diagnosis[]", room)
        found = lib.dpm_history_get(self.it, after, records, room)
        return [ffi.new("dpm_diagnosis *", records[i]) for i in range(found)]


def octets(record: Any) -> bytes:
    return bytes(ffi.buffer(record.octets, record.length))


def test_answers_are_kept_in_order_and_the_oldest_goes_first() -> None:
    history = History(3)
    assert history.get() == []
    for number in range(1, 6):
        history.put(number, bytes([number]) * 6)
    assert [(r.number, r.count, octets(r)[0]) for r in history.get()] == [(3, 1, 3), (4, 1, 4), (5, 1, 5)]
    assert [r.number for r in history.get(after=4)] == [5]
    assert [r.number for r in history.get(room=2)] == [3, 4]


def test_the_same_answer_again_is_one_record_that_counts() -> None:
    history = History(3)
    for number, octet in enumerate(b"AAABBA", start=1):
        history.put(number, bytes([octet]) * 6)
    assert [(octets(r)[:1], r.count, r.number, r.first, r.time) for r in history.get()] == [
        (b"A", 3, 3, 10, 30), (b"B", 2, 5, 40, 50), (b"A", 1, 6, 60, 60)]
    history.put(7, b"A" * 7)
    assert history.get()[-1].count == 1, "another length is another answer"


@given(st.integers(1, 5), st.lists(st.sampled_from(b"ABC"), max_size=30), st.integers(0, 30))
def test_what_is_kept_and_what_was_dropped_is_all_there_was(room: int, answers: list[int], after: int) -> None:
    """Against a list: nothing but the oldest runs is missing, and numbers say how many answers these were."""
    history = History(room)
    for number, octet in enumerate(answers, start=1):
        history.put(number, bytes([octet]) * 244)
    records = history.get()
    dropped = records[0].number - records[0].count if records else 0
    assert [octet for r in records for octet in octets(r)[:1] * r.count] == answers[dropped:]
    assert len(records) == room or dropped == 0
    assert [r.number for r in history.get(after)] == [r.number for r in records if r.number > after]


@pytest.mark.parametrize("records", [0])
def test_a_history_of_nothing_is_refused(records: int) -> None:
    assert lib.dpm_history_size(records) == 0
    assert lib.dpm_history_init(block(4096), 4096, records) == ffi.NULL


def test_a_block_too_small_is_refused() -> None:
    size = lib.dpm_history_size(4)
    assert lib.dpm_history_init(block(size), size - 1, 4) == ffi.NULL


def test_the_master_keeps_every_answer_to_slave_diag() -> None:
    """From the first contact on, the master's own bits added; a slave that is not ready is one record, however often asked."""
    history = History(8)
    bus = Bus(slave={"history": history.it})
    bus.next()
    bus.script.answer(FREE)
    bus.next()
    bus.script.answer(SC)
    bus.next()
    bus.script.answer(SC)
    for _ in range(5):
        bus.next()
        bus.script.answer(diagnosis(0x02, 0x0C, 0, 2, 0x0A, 0x35))
    bus.next()
    bus.script.answer(READY)
    bus.exchange(frame(0x0A, b"", sa=8))  # DH: diagnosis is fetched next
    bus.next()
    bus.script.answer(diagnosis(0x08, 0x0C, 0, 7, 0x0A, 0x35, extended=b"\x03\x01\x02"))
    records = history.get()
    assert [(octets(r).hex(" "), r.count, r.number) for r in records] == [
        ("02 05 00 ff 0a 35", 1, 1), ("02 0c 00 02 0a 35", 5, 6), ("00 0c 00 02 0a 35", 1, 7),
        ("88 0c 00 07 0a 35 03 01 02", 1, 8)]
    assert records[1].first < records[1].time < records[2].time
    assert bus.slave.diagnosis_number == 8


class Talkative(Echo):
    max_diagnosis = 32


def test_a_program_misses_no_diagnosis_and_is_told_of_those_dropped() -> None:
    """With nobody subscribed, and no read while they come: what the room holds is there, the rest is counted."""
    with Segment() as wire:
        card = wire.attach(Talkative(5))
        with Master(wire.port(), output_watchdog=None) as master:
            station = master.add(Station(5, IDENT, CONFIGURATION))
            assert (station.diagnosis_history, station.diagnosis_history.overflow) == ((), 0)
            before = datetime.now().astimezone()
            master.operate()
            known = station.diagnosis_history[-1].diagnosis.number

            def announce(numbers: range) -> None:
                for n in numbers:
                    fetched = station.statistics.diagnoses
                    wire.set_diagnosis(card, bytes([4, n, n, n]), ext_diag=True)
                    until(lambda before=fetched: station.statistics.diagnoses > before)

            announce(range(1, 21))
            history = station.diagnosis_history
            news = [record for record in history if record.diagnosis.number > known]
            assert [record.diagnosis.extended[1] for record in news] == list(range(1, 21))
            assert [record.diagnosis.number for record in news] == list(range(known + 1, known + 21))
            assert history.overflow == 0
            assert history[-1].diagnosis == station.diagnosis
            announce(range(21, DIAGNOSES + 31))
            history = station.diagnosis_history
            assert len(history) == DIAGNOSES
            assert history[-1].diagnosis.number - sum(record.count for record in history) == history.overflow > 0
            after = datetime.now().astimezone()
            times = [time for record in history for time in (record.since, record.until)]
            slack = timedelta(milliseconds=5)  # two clocks that are read one after the other
            assert times == sorted(times)
            assert before - slack < times[0] < times[-1] < after + slack
            assert "device diagnosis: 5E 5E 5E" in str(history[-1])
