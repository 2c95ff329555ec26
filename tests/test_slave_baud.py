# SPDX-License-Identifier: MIT
"""The rate and the watchdog's state machine of an ASIC (protocol page I.6), and the distance between requests (I.5).

The rig's wire runs at 500 kbit/s. A search begins at 12 Mbit/s and stays at each rate for 10 ms and 5000 bit times.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from simulation import Simulation
from slave_rig import (
    CHARACTER,
    DATA_EXCH,
    MS,
    NEVER,
    OUT,
    SLAVE_DIAG,
    TBIT,
    WAIT_PRM,
    ZEROS,
    Initiator,
    Rig,
    SlaveConfig,
    octets,
    telegram,
)
from wire import Master, Slaves, Wire, default_parameters

from dpmaster._core import lib

RATES = (12_000_000, 6_000_000, 3_000_000, 1_500_000, 500_000, 187_500, 93_750, 500_000 / 11, 31_250, 19_200, 9_600)
STAYS = [10 * MS + math.ceil(5000 * 1e9 / rate) for rate in RATES]
BEGIN = sum(STAYS[:4])  # of 500 kbit/s: 46.25 ms after power-on
END = BEGIN + STAYS[4]  # 20 ms later
ROUND = sum(STAYS)  # 1.3 s
US, LENGTH = 1_000, 6 * CHARACTER  # of TO_ANOTHER
SEARCH, CONTROL, DP = lib.DPM_BAUD_SEARCH, lib.DPM_BAUD_CONTROL, lib.DPM_DP_CONTROL
STATUS, ANSWER = octets("10 08 02 49 53 16"), octets("10 02 08 00 0A 16")  # B.4 #36
TO_ANOTHER = telegram(99, 2, 0x49)


def cold(baud_control: int = 0, **changes: int) -> tuple[Rig, int]:
    """A slave that was switched on just now, and when that was."""
    rig = Rig((SlaveConfig(more={"auto_baud": True, "baud_control": baud_control}),), changes=changes)
    lib.dpm_slaves_reset(rig.slaves, 0, rig.time)
    return rig, rig.time


def found(baud_control: int = 0) -> Rig:
    rig, on = cold(baud_control)
    rig.hear(TO_ANOTHER, on + round(BEGIN) + 5 * MS)
    assert rig.report().baud_state == CONTROL
    return rig


def hears_at(rig: Rig, time: float, telegram_: bytes = TO_ANOTHER) -> bool:
    """Whether a telegram that ends `time` after power-on tells the slave its rate."""
    rig.hear(telegram_, round(time))
    return bool(rig.report().baud_state == CONTROL)


@pytest.mark.parametrize("turn", [0, ROUND, 1000 * ROUND])
@pytest.mark.parametrize(("end", "hears"), [
    (BEGIN + LENGTH + US, True), (BEGIN + LENGTH - US, False), (END - US, True), (END + US, False), (BEGIN - US, False),
])
def test_a_search_hears_only_at_the_wires_rate(turn: float, end: float, hears: bool) -> None:
    """Page I.6 "BAUD_SEARCH: starts at 12M, goes down after a monitoring time without an error-free telegram": a telegram
    of 6 octets that lies whole in the wire's turn is heard, one that is cut by it is garbage; after 9600 it starts anew."""
    rig, on = cold()
    assert hears_at(rig, on + turn + end) is hears


@pytest.mark.parametrize("rate", [12_000_000, 6_000_000, 3_000_000, 1_500_000, 500_000, 187_500, 93_750, 45_450, 19_200, 9_600])
def test_every_rate_is_found_in_its_turn(rate: int) -> None:
    """The slower the wire, the longer until it is heard: the way goes down."""
    parameters = default_parameters(rate)
    fields = ("rate_num", "rate_den", "tsl", "max_tsdr", "tqui", "tset", "max_retry_limit")
    changes = {name: getattr(parameters, name) for name in fields}
    character = int(lib.dpm_bits_up(parameters, 11))
    begin = sum(STAYS[: [round(r) for r in RATES].index(45_455 if rate == 45_450 else rate)])
    for late, hears in ((-2 * MS, False), (0, True)):
        rig, on = cold(**changes)
        rig.hear(TO_ANOTHER, on + round(begin) + 6 * character + 2_000 + late, spacing=character)
        assert (rig.report().baud_state == CONTROL) is hears, late


def test_an_odd_rate_is_never_found() -> None:
    rig, on = cold(rate_num=400_000)
    for i in range(1, 3000):
        assert not hears_at(rig, on + i * MS)


def test_the_first_good_telegram_is_not_answered_the_next_one_is() -> None:
    """Page I.6 "a cold auto-baud slave needs several frames addressed near it before it answers at all"."""
    rig, on = cold()
    assert rig.exchange(STATUS) == b"", "still at 12 Mbit/s"
    rig.time = on + round(BEGIN)
    assert rig.exchange(STATUS) == b"", "it only tells the rate"
    assert rig.report().requests == 0
    assert rig.exchange(STATUS) == ANSWER


@pytest.mark.parametrize(("octets_", "tells"), [
    (TO_ANOTHER, True), (ANSWER, True), (telegram(99, 2, 0x6D, b"", SLAVE_DIAG), True),
    (telegram(127, 2, 0x46, b"\x00\x00", 58), True), (octets("A2 63 02 5D 01 02 03 04 05 06 07 08 E6 16"), True),
    (octets("DC 02 02"), False), (b"\xe5", False),
    (octets("10 63 02 49 AF 16"), False), (b"\x00\xff\x55", False),
])
def test_what_tells_the_rate(octets_: bytes, tells: bool) -> None:
    """Page I.6 "an error-free SD1/SD2/SD3 telegram (of anybody)": no token, no SC, nothing with an error."""
    rig, on = cold()
    rig.hear(octets_, on + round(BEGIN) + 5 * MS)
    rig.quiet(rig.time + MS)
    assert (rig.report().baud_state == CONTROL) is tells


def test_a_slave_that_searches_takes_part_in_nothing() -> None:
    """It hears only garbage: no request, no broadcast, no watchdog fed."""
    rig, _ = cold()
    master = Initiator(rig)
    assert master.srd(SLAVE_DIAG) == b""
    master.control(0x02)
    assert (rig.report().requests, rig.report().state) == (0, WAIT_PRM)
    assert rig.ask(rig.time).wake == NEVER, "a search costs the host nothing"


def test_unplugged_it_finds_nothing() -> None:
    rig, on = cold()
    lib.dpm_slaves_connect(rig.slaves, 0, False)
    assert not hears_at(rig, on + BEGIN + 5 * MS)
    lib.dpm_slaves_connect(rig.slaves, 0, True)
    assert hears_at(rig, on + BEGIN + 6 * MS)


def test_baud_control_is_kept_by_telegrams_to_the_own_address() -> None:
    """Page I.6 "BAUD_CONTROL: WD_Baud_Control_Val (10 ms base) retriggered by each error-free telegram to the own address;
    expiry -> BAUD_SEARCH"."""
    rig = found(baud_control=5)
    for _ in range(3):
        assert rig.exchange(STATUS, after=49 * MS) == ANSWER
    heard = rig.ask(rig.time).wake - 50 * MS
    for passing in range(1, 5):
        rig.hear(TO_ANOTHER, heard + passing * 10 * MS)  # "to the own address"
    progress = rig.progress
    rig.quiet(heard + 50 * MS - 1)
    assert rig.report().baud_state == CONTROL
    rig.quiet(heard + 50 * MS)
    assert (rig.report().baud_state, rig.progress) == (SEARCH, progress + 1)
    # The search begins anew at 12 Mbit/s at the moment of the expiry.
    assert not hears_at(rig, heard + 50 * MS + BEGIN - MS)
    assert hears_at(rig, heard + 50 * MS + BEGIN + MS)


def test_without_baud_control_the_rate_once_found_stays() -> None:
    rig = found(baud_control=0)
    assert rig.ask(rig.time).wake == NEVER
    rig.quiet(rig.time + 3_600_000 * MS)
    assert rig.exchange(STATUS) == ANSWER


def test_dp_control_belongs_to_the_watchdog() -> None:
    """Page I.6 "DP_CONTROL: entered when Set_Prm with WD_On=1 was accepted; timer = TWD; expiry -> WAIT-PRM, then
    BAUD_CONTROL"; then BAUD_SEARCH."""
    rig = found(baud_control=5)
    master = Initiator(rig)
    master.start(0x88, (30, 1))
    assert rig.report().baud_state == DP
    master.srd(None, OUT)
    expiry = rig.ask(rig.time).wake
    assert expiry == rig.report().exchange_time + 300 * MS, "the rate is not supervised meanwhile"
    rig.quiet(expiry)
    assert (rig.report().state, rig.report().baud_state) == (WAIT_PRM, CONTROL)
    assert rig.ask(rig.time).wake == expiry + 50 * MS
    rig.quiet(expiry + 50 * MS)
    assert rig.report().baud_state == SEARCH


def test_a_long_silence_goes_through_all_of_it_at_its_own_times() -> None:
    """A host that was away for a minute: watchdog, rate and search are those of the moments they ran out."""
    rig = found(baud_control=5)
    Initiator(rig).start(0x88, (30, 1))
    expiry = rig.ask(rig.time).wake
    rig.quiet(expiry + 60_000 * MS)
    assert (rig.report().watchdog_expired, rig.report().baud_state, rig.outputs().valid) == (1, SEARCH, False)
    since = expiry + 50 * MS
    turns = (rig.time - since) // round(ROUND) + 1
    assert hears_at(rig, since + turns * ROUND + BEGIN + MS)


@pytest.mark.parametrize("prm", [{"status": 0x40}, {"status": 0x80}])
def test_without_watchdog_it_is_baud_control_again(prm: dict[str, Any]) -> None:
    """Page I.6 "another master takes over: BAUD_CONTROL (WD_On=0) or stays in DP_CONTROL (WD_On=1)"."""
    rig = found(baud_control=5)
    master = Initiator(rig)
    master.start(0x88, (30, 1))
    master.prm(**prm)
    assert rig.report().baud_state == CONTROL
    if prm["status"] == 0x40:
        Initiator(rig, address=3).prm(0x88, (30, 1))
        assert (rig.report().baud_state, rig.report().master) == (DP, 3)


def test_a_rate_lost_without_watchdog_leaves_the_outputs() -> None:
    """Pages I.1 "DATA-EXCH | baud lost / bus off | watchdog as above" and I.3 "WD_On=0: outputs stay forever"."""
    rig = found(baud_control=5)
    master = Initiator(rig)
    master.start(0x80)
    master.srd(None, OUT)
    rig.quiet(rig.time + 51 * MS)
    assert rig.report().baud_state == SEARCH
    assert (rig.report().state, rig.outputs().octets, rig.outputs().valid) == (DATA_EXCH, OUT, True)
    assert master.srd(None, OUT) == b""
    lost = rig.report().exchange_time
    assert hears_at(rig, lost + 50 * MS + ROUND + BEGIN + 5 * MS)
    assert master.srd(None, OUT) == master.data(ZEROS)


def test_a_slave_with_a_fixed_rate_is_never_deaf() -> None:
    rig = Rig((SlaveConfig(more={"baud_control": 1}),))
    rig.quiet(rig.time + 1000 * MS)
    assert rig.report().baud_state == CONTROL
    assert rig.exchange(STATUS) == ANSWER
    Initiator(rig).start(0x88, (30, 1))
    assert rig.report().baud_state == DP


@pytest.mark.parametrize("rate", [500_000, 19_200])
@pytest.mark.parametrize("others", [0, 1])
def test_our_master_finds_a_cold_slave(rate: int, others: int) -> None:
    """Alone, and beside one that is not held up by it."""
    parameters = default_parameters(rate)
    master, slaves = Master(parameters=parameters), Slaves(parameters=parameters)
    for i in range(others + 1):
        master.add(8 + i, 0x00CA, b"\x72", watchdog=(100, 1))
        slaves.add(8 + i, 0x00CA, b"\x72", auto_baud=i == others, baud_control=30)
    wire = Wire(parameters, master.machine, slaves.machine)
    master.mode(lib.DPM_MODE_OPERATE)
    wire.run(wire.now + 4_000 * MS)
    assert [slaves.report(i).state for i in range(others + 1)] == [DATA_EXCH] * (others + 1)
    assert [slaves.report(i).watchdog_expired for i in range(others + 1)] == [0] * (others + 1)
    assert slaves.report(others).baud_state == DP


def test_cold_slaves_break_no_rule_of_the_bus() -> None:
    """Six that were switched on one after the other, each when it was its turn, on the segment with the onlooker."""
    parameters = default_parameters(500_000)
    master, slaves = Master(parameters=parameters), Slaves(parameters=parameters)
    for i in range(6):
        master.add(8 + i, 0x00CA, b"\x72", watchdog=(100, 1))
        slaves.add(8 + i, 0x00CA, b"\x72", auto_baud=True, baud_control=30)
    bus = Simulation(parameters, master, slaves)
    master.mode(lib.DPM_MODE_OPERATE)
    for i in range(6):
        assert lib.dpm_slaves_reset(slaves.slaves, i, bus.now) == 0
        bus.run(217 * MS)
    bus.run(2_000 * MS)
    bus.check()
    assert [slaves.report(i).state for i in range(6)] == [DATA_EXCH] * 6


# ---- the distance between requests, page I.5 ----


@pytest.mark.parametrize(("distance", "soon"), [(2 * MS, 0), (2 * MS - 1, 9)])
def test_requests_that_come_too_soon_are_counted_and_answered(distance: int, soon: int) -> None:
    """Page I.5 "the master must keep this distance for every master-slave function except Global_Control", from request to
    request; a repetition and a status request are none."""
    rig = Rig((SlaveConfig(more={"min_slave_interval": 20}),))
    master = Initiator(rig)
    at = rig.time + 100 * MS
    for _ in range(10):
        rig.hear(telegram(8, 2, master.fc(), b"", SLAVE_DIAG), at)
        assert rig.ask(rig.time).octets != b""
        rig.hear(telegram(8, 2, 0x49), at + MS // 2)
        rig.hear(telegram(127, 2, 0x46, b"\x00\x00", 58), at + MS)
        at += distance
    rig.hear(telegram(8, 2, 0x40 | 0x0D | (0x20 if master.fcb else 0) | 0x10, b"", SLAVE_DIAG), at - MS)
    assert (rig.report().too_soon, rig.report().repetitions) == (soon, 1)


def test_only_what_is_certain_is_held_against_a_master() -> None:
    """Octets of a port that delivers in chunks have times within bounds: the first request may have come early, the second
    late."""
    rig = Rig((SlaveConfig(more={"min_slave_interval": 20}),))
    master = Initiator(rig)
    at = rig.time + 100 * MS
    for doubt, distance in ((0, 2 * MS - TBIT), (MS, 2 * MS), (0, 2 * MS - TBIT), (0, 0)):
        rig.hear(telegram(8, 2, master.fc(), b"", SLAVE_DIAG), at, doubt=doubt)
        at += distance
    assert rig.report().too_soon == 1, "the last one"


def test_nothing_is_too_soon_behind_power_on() -> None:
    """Not even a request that had begun before."""
    rig = Rig((SlaveConfig(more={"min_slave_interval": 20}),))
    master = Initiator(rig)
    request = telegram(8, 2, master.fc(), b"", SLAVE_DIAG)
    begin = rig.time + 100 * MS
    assert lib.dpm_slaves_reset(rig.slaves, 0, begin + TBIT) == 0
    rig.hear(request, begin)
    assert rig.report().too_soon == 0


def test_our_master_keeps_the_distance() -> None:
    """In start-up, exchange, diagnosis and retries."""
    parameters = default_parameters(500_000)
    master, slaves = Master(parameters=parameters), Slaves(parameters=parameters)
    master.add(8, 0x00CA, b"\x72", watchdog=(100, 1), min_slave_interval=20)
    slaves.add(8, 0x00CA, b"\x72", min_slave_interval=20)
    wire = Wire(parameters, master.machine, slaves.machine)
    master.mode(lib.DPM_MODE_OPERATE)
    wire.run(wire.now + 100 * MS)
    lib.dpm_slaves_diagnosis(slaves.slaves, 0, b"\x02\x01", 2, True, True, False)
    wire.run(wire.now + 100 * MS)
    report = slaves.report(0)
    assert report.exchanges > 50
    assert report.too_soon == 0
