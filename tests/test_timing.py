# SPDX-License-Identifier: MIT
"""The planner against figures of protocol page D, reckoned by hand, and against a bus on virtual time; then its command."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from fractions import Fraction
from itertools import pairwise
from typing import Any

import pytest
import wire
from hypothesis import given
from hypothesis import strategies as st

from dpmaster import Master, Station, cli
from dpmaster._core import ffi, lib
from dpmaster.cli import timing as command
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.errors import ConfigurationError
from dpmaster.parameters import BAUDRATES, BusParameters
from dpmaster.timing import Finding, Slave, Timing, plan, profile_allowance

DX4 = Slave(5, 4, 4, max_tsdr=50)


def the_one(timing: Timing) -> Finding:
    assert len(timing.findings) == 1, timing.findings
    return timing.findings[0]


def part(timing: Timing, name: str) -> tuple[int, float]:
    found = next(each for each in timing.cycle.parts if each.name == name)
    return found.bits, found.seconds


# ---- the cycle


def test_the_worked_example() -> None:
    """Protocol page D.3: "1.5 Mbit/s, 4 out + 4 in, TSDR 50: 11*26 + 50 + 37 = 373 Tbit = 249 us"."""
    bits, seconds = part(plan(1_500_000, [DX4]), "station 5")
    assert bits == 373
    assert seconds == pytest.approx(249e-6, abs=0.5e-6)


def test_the_parts_of_a_cycle_and_their_sum() -> None:
    """Protocol page D.3 at 500 kbit/s: T_token 33 + 37, T_GC 143 + 100, T_gap 66 + 200; 2 us a Tbit; host 2 ms late."""
    timing = plan(500_000, [Slave(5, 6, 6), Slave(6), Slave(7, 0, 2, max_tsdr=60)])
    bits = {each.name: each.bits for each in timing.cycle.parts}
    assert bits == {
        "station 5": 11 * 30 + 100 + 37,
        "station 6": 11 * 7 + 100 + 37,  # "L_out = 0 -> 6, SD1", "L_in = 0 -> 1, SC"
        "station 7": 11 * (6 + 11) + 60 + 37,
        "Global_Control": 243, "token": 70, "GAP poll": 266, "host": 1000, "other masters": 0, "wait": 0,
    }
    exchanges = 467 + 214 + 284
    assert timing.cycle.steady == pytest.approx((exchanges + 70) * 2e-6)
    assert timing.cycle.time == pytest.approx((exchanges + 243 + 70 + 266) * 2e-6 + 2e-3)


def test_a_lost_answer_costs_the_request_the_slot_and_what_the_host_waits_longer() -> None:
    """Protocol page D.3: "11*n_req + TSL"; a sole master waits Tsl + allowance."""
    c = plan(500_000, [Slave(5, 6, 6), Slave(7)], allowance=1e-3).cycle
    assert c.lost_answer - c.time == pytest.approx((11 * 15 + 200) * 2e-6 + 1e-3)
    assert c.repeated == pytest.approx(c.lost_answer), "max_retry_limit is 1 here"
    assert c.worst - c.time == pytest.approx((11 * 15 + 11 * 6 + 400) * 2e-6 + 4e-3), "late for 2 slots and 2 answers"
    assert c.watched - c.time == pytest.approx((11 * 15 + 200) * 2e-6)


def test_each_repetition_counts() -> None:
    """12 Mbit/s: max_retry_limit 4, Tsl 1000."""
    c = plan(12_000_000, [Slave(5, 6, 6)], allowance=0.0).cycle
    assert c.repeated - c.time == pytest.approx(4 * (11 * 15 + 1000) / 12e6)
    assert c.worst == pytest.approx(c.repeated)


def test_waits_fill_a_cycle_up() -> None:
    by_interval = plan(12_000_000, [Slave(5, 6, 6, min_slave_interval=60)], allowance=0.0)
    assert by_interval.cycle.time == by_interval.cycle.steady == by_interval.cycle.lost_answer == pytest.approx(6e-3)
    by_time = plan(12_000_000, [DX4], cycle_time=0.05)
    assert by_time.cycle.time == pytest.approx(0.05)
    assert by_time.watchdog == pytest.approx(0.5)


def test_other_masters_take_as_long_as_ours_or_what_is_said() -> None:
    alone = plan(500_000, [Slave(5, 6, 6)], ring=True)
    three = plan(500_000, [Slave(5, 6, 6)], masters=3)
    assert three.cycle.time == pytest.approx(3 * alone.cycle.time)
    assert three.cycle.steady == pytest.approx(3 * (467 + 70) * 2e-6)
    told = plan(500_000, [Slave(5, 6, 6)], masters=3, others=4e-3)
    assert told.cycle.time == pytest.approx(alone.cycle.time + 8e-3)


class Bus:
    """A master and one slave on virtual time, 4 octets each way at 1.5 Mbit/s; the slave's own Tsdr is 50."""

    def __init__(self, allowance: int = 0) -> None:
        self.master = wire.Master(1_500_000, address=2, allowance=allowance)
        self.slaves = wire.Slaves(1_500_000)
        self.master.add(5, 0x1234, b"\x33", min_tsdr=0)
        self.slaves.add(5, 0x1234, b"\x33", min_tsdr=50)
        self.wire = wire.Wire(self.master.parameters, self.master.machine, self.slaves.machine)
        self.master.mode(lib.DPM_MODE_OPERATE)
        self.wire.run_until(lambda: self.master.slave(0).state == lib.DPM_ST_DATA)

    def exchanges(self, duration: int) -> list[wire.Sent]:
        """The Data_Exchange requests of that time (SD2 without SAPs to 5)."""
        return [sent for sent in self.wire.run(self.wire.now + duration) if sent.octets[4:6] == b"\x05\x02"]


def test_a_bus_on_virtual_time_keeps_the_prediction() -> None:
    """A turn of a sole master is several exchanges of 373 Tbit; one with the token takes 443, with Global_Control more."""
    c = plan(1_500_000, [Slave(5, 4, 4, 50, min_slave_interval=0)], allowance=0.0).cycle
    assert c.steady == pytest.approx((373 + 70) / 1.5e6)
    periods = sorted((b.start - a.start) * 1e-9 for a, b in pairwise(Bus().exchanges(wire.S)))
    assert periods[0] == pytest.approx(373 / 1.5e6, abs=100e-9)
    assert periods[len(periods) * 9 // 10] <= c.steady + 100e-9
    assert c.steady < periods[-1] <= c.time


def test_a_lost_answer_on_virtual_time() -> None:
    c = plan(1_500_000, [DX4], allowance=2e-3).cycle
    bus = Bus(allowance=2 * wire.MS)
    lost = iter([b""])
    bus.wire.mangle = lambda sent: next(lost, None) if sent.source == 1 else None
    first, second = bus.exchanges(5 * wire.MS)[:2]
    assert first.octets == second.octets, "the repetition is the request"
    # From the request's first bit to the repetition's first: the request and Tsl + allowance.
    assert (second.start - first.start) * 1e-9 == pytest.approx(c.lost_answer - c.time, abs=100e-9)


# ---- bus parameters


@pytest.mark.parametrize(("rate", "tsl", "max_tsdr", "tid1", "tto"), [
    (9_600, 100, 60, 37, 104e-3), (187_500, 100, 60, 37, 5.3e-3), (500_000, 200, 100, 37, 4e-3),
    (1_500_000, 300, 150, 37, 2e-3), (3_000_000, 400, 250, 46, 1.33e-3), (6_000_000, 600, 450, 57, 1e-3),
    (12_000_000, 1000, 800, 76, 833e-6)])
def test_the_table(rate: int, tsl: int, max_tsdr: int, tid1: int, tto: float) -> None:
    """Protocol page D.2; "TTO for n=2 (10*TSL)" in real time."""
    p = plan(rate, [Slave(5, 6, 6)]).parameters
    assert (p.tsl, p.max_tsdr, p.tid1, p.tid2) == (tsl, max_tsdr, tid1, max_tsdr)
    assert p.seconds(p.tto(2)) == pytest.approx(tto, rel=0.01)


def test_a_cold_master() -> None:
    """Protocol page E.4: "at 19.2 k, TSL 300, addr 2: 10*300 Tbit = 156 ms until its first frame"."""
    p = plan(19_200, addresses=[2], changes={"tsl": 300}).parameters
    assert p.seconds(p.tto(2)) == pytest.approx(156e-3, abs=0.5e-3)


def test_the_slowest_station_at_this_rate_settles_tsl() -> None:
    """Protocol page D.2: a DP/PA coupler has MaxTsdr_93.75 = 1000, and MaxTsdr_45.45 = 250."""
    coupler = Slave(5, 6, 6, max_tsdr={93_750: 1000, 45_450: 250})
    assert plan(93_750, [coupler]).parameters.tsl == 1015
    assert plan(45_450, [coupler]).parameters.tsl == 265
    assert plan(500_000, [coupler]).parameters.tsl == 200
    two = plan(93_750, [coupler, Slave(6, 6, 6)])
    assert part(two, "station 5")[0] - part(two, "station 6")[0] == 1000 - 60, "each with its own Tsdr"


@pytest.mark.parametrize(("rate", "per_km"), [(500_000, "2.5"), (1_500_000, "7.5"), (93_750, "0.47")])
def test_cable_and_repeaters(rate: int, per_km: str) -> None:
    """SIMATIC NET PROFIBUS networks 10.2: 0.47, 2.50 and 7.50 bit times for each km, 9 for an infrared link."""
    timing = plan(rate, [Slave(5, 6, 6, max_tsdr=600)], length=8_000, repeaters=3)
    assert timing.ttd == math.ceil(8 * Fraction(per_km) + 27)
    assert timing.parameters.tsl == timing.tsl_needed == 600 + 15 + 2 * timing.ttd
    bare = plan(rate, [Slave(5, 6, 6, max_tsdr=600)])
    assert part(timing, "station 5")[0] - part(bare, "station 5")[0] == 2 * timing.ttd, '"+ 2*TTD"'


def test_the_profiles_know_their_lateness() -> None:
    late = {profile: profile_allowance(profile) for profile in ("uart", "usb", "pty")}
    assert all(0 < seconds < 0.1 for seconds in late.values()) and late["uart"] == min(late.values())
    with pytest.raises(ConfigurationError, match=r"profile 'net'.*uart, usb, pty"):
        profile_allowance("net")
    assert lib.dpm_profile_traits(lib.DPM_PROFILE_AUTO, ffi.new("dpm_port_traits *")) == lib.DPM_E_ARGUMENT


def test_in_a_ring_the_allowance_lies_inside_tsl() -> None:
    """Max Tsdr 100 + 15 + 10 ms at 500 kbit/s, which is 5000 Tbit. A sole master waits longer by itself."""
    ring = plan(500_000, [Slave(5, 6, 6)], masters=2, allowance=0.010)
    assert ring.parameters.tsl == ring.tsl_needed == 5115
    assert ring.works and "5115" in the_one(ring).text and "every other master" in the_one(ring).remedy
    assert ring.cycle.lost_answer - ring.cycle.time == pytest.approx((11 * 15 + 5115) * 2e-6), "and is not counted twice"
    polls = 126 * (66 + 5115)
    assert 0.02 * (ring.parameters.g - 1) * 630_000 <= polls <= 0.02 * ring.parameters.g * 630_000, "2 % of the bus for the GAP"
    sole = plan(500_000, [Slave(5, 6, 6)], allowance=0.010)
    assert sole.parameters.tsl == 200 and not sole.findings


def test_ttr_grows_with_what_all_masters_need() -> None:
    """Default 5000 x HSA = 630000 Tbit; 100 slaves with 244 + 244 octets are 11*506 + 100 + 37 = 5703 Tbit each."""
    slaves = [Slave(n, 244, 244, watchdog=5.0) for n in range(3, 103)]
    assert plan(500_000, slaves, allowance=0.0).parameters.ttr == 630_000
    # Global_Control 243, token 70, GAP poll 266; one request of 253 characters repeated once, Tsl 200
    assert plan(500_000, slaves, masters=2, allowance=0.0).parameters.ttr == 2 * (570_300 + 243 + 70 + 266) + 11 * 253 + 200


# ---- what will not work


def found(timing: Timing, *words: str) -> None:
    assert not timing.works
    finding = the_one(timing)
    assert finding.fatal
    for word in words:
        assert word in finding.text + "; " + finding.remedy


def test_a_slot_that_is_too_short() -> None:
    slow = [Slave(5, 6, 6, 250)]
    found(plan(500_000, slow, changes={"tsl": 264}), "Tsl 264", "265", "max Tsdr 250 + 15", "Tsl 265 Tbit or more")
    assert plan(500_000, slow, changes={"tsl": 265}).works
    found(plan(500_000, slow, changes={"tsl": 265}, repeaters=1), "283", "2 TTD 18")


def test_a_host_allowance_that_eats_the_slot() -> None:
    found(plan(500_000, [DX4], masters=2, allowance=1e-3, changes={"tsl": 614}), "Tsl 614", "615", "does not enter",
          "1 ms late", "smaller allowance")
    assert plan(500_000, [DX4], masters=2, allowance=1e-3, changes={"tsl": 615}).works
    assert plan(500_000, [DX4], allowance=1e-3, changes={"tsl": 115}).works, "a sole master waits it out behind the slot"


def test_a_slot_longer_than_the_standard_has() -> None:
    """16383 Tbit: at 3 Mbit/s 10 ms are 30000, at 1.5 Mbit/s 15000."""
    found(plan(3_000_000, [DX4], ring=True, allowance=0.010), "30265", "16383", "1500 kbit/s")


def test_a_station_slower_than_the_standard_allows() -> None:
    found(plan(500_000, [Slave(5, 6, 6, 1023), Slave(6, 6, 6, 1024)]), "station 6 1024", "1023", "GSD")


@pytest.mark.parametrize(("watchdog", "works"), [(0.010, False), (0.013, True)])
def test_a_watchdog_shorter_than_the_cycle_with_retries(watchdog: float, works: bool) -> None:
    """467 + 243 + 70 + 266 Tbit and 5 ms, then 11*15 + 200 Tbit and 5 ms once more: 12.8 ms."""
    timing = plan(500_000, [Slave(5, 6, 6, watchdog=watchdog)], allowance=5e-3)
    assert timing.cycle.repeated == pytest.approx(12.822e-3)
    assert timing.works is works
    if not works:
        found(timing, "station 5", "10 ms", "12.82 ms", "give it 100 ms")


def test_a_watchdog_that_is_off_is_a_note() -> None:
    timing = plan(500_000, [Slave(5, 6, 6, watchdog=None)])
    assert timing.works and "stay when the master dies" in the_one(timing).text


def test_ten_cycles_over_a_second_need_a_watchdog_of_their_own() -> None:
    found(plan(500_000, [Slave(5, 6, 6)], cycle_time=0.2), "2.00 s", "watchdog=2.0")
    assert plan(500_000, [Slave(5, 6, 6, watchdog=2.0)], cycle_time=0.2).works


def test_a_ttr_too_short_for_all_masters() -> None:
    """3 times 467 + 243 + 70 + 266, and a repetition of 11*15 + 200."""
    of_three = {"masters": 3, "allowance": 0.0}
    found(plan(500_000, [Slave(5, 6, 6)], changes={"ttr": 3502}, **of_three), "Ttr 3502", "all 3 masters", "3503")
    assert plan(500_000, [Slave(5, 6, 6)], changes={"ttr": 3503}, **of_three).works
    assert plan(500_000, [Slave(5, 6, 6)], changes={"ttr": 3503}, cycle_time=0.05, **of_three).works, "waiting holds no token"


def test_what_the_library_refuses_is_a_finding() -> None:
    found(plan(500_000, [DX4], addresses=[9], changes={"hsa": 5}), "hsa = 5", "raise hsa")
    found(plan(500_000, [DX4], changes={"tset": 0}), "tset = 0", "standard set")
    found(plan(500_000, [DX4], changes={"tsl": 20_000}), "tsl = 20000", "16383")


def test_a_rate_few_ports_reach_is_a_note() -> None:
    timing = plan(12_000_000, [DX4])
    assert timing.works and "12 Mbit/s" in the_one(timing).text
    assert not plan(12_000_000, [DX4], profile="pty").findings


def test_a_set_of_somebody_else() -> None:
    """Protocol page D.2, COM PROFIBUS at 1.5 Mbit/s: Tsl 200, max Tsdr 100, Ttr 27201, Tid1 37, Tid2 100."""
    theirs = BusParameters(Fraction(1_500_000), 200, 11, 100, 0, 1, 27_201, 10, 1, 1)
    timing = plan(slaves=[Slave(5, 6, 6)], parameters=theirs)
    assert timing.parameters == theirs and timing.works
    assert (theirs.tid1, theirs.tid2) == (37, 100)
    assert part(timing, "station 5")[0] == 11 * 30 + 100 + 37


@pytest.mark.parametrize(("arguments", "words"), [
    ({"baudrate": 115_200}, ["115200", "9600, 19200"]),
    ({"slaves": [DX4, Slave(5, 1, 1)]}, ["address 5", "twice"]),
    ({"slaves": [DX4], "addresses": [5]}, ["address 5", "twice"]),
    ({"addresses": []}, ["one master"]),
    ({"addresses": [126]}, ["126", "0 to 125"]),
    ({"masters": 0, "addresses": [1.5]}, ["1.5"]),
    ({"masters": 127}, ["masters 127", "126"]),
    ({"slaves": [Slave(n) for n in range(2, 120)], "masters": 20}, ["126 addresses"]),
    ({"profile": "net"}, ["'net'", "uart"]),
    ({"allowance": -1}, ["allowance -1", "0 to 1"]),
    ({"others": math.nan}, ["others nan"]),
    ({"cycle_time": "1"}, ["cycle_time '1'"]),
    ({"length": -1.0}, ["length -1.0"]),
    ({"repeaters": -1}, ["repeaters -1"]),
    ({"changes": {"slot": 1}}, ["'slot'", "tsl"]),
    ({"changes": {"tsl": 70_000}}, ["tsl = 70000"]),
    ({"changes": {"max_tsdr": "100"}}, ["max_tsdr '100'"]),
    ({"masters": "2"}, ["masters '2'"]),
])
def test_what_is_no_bus_is_refused(arguments: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        plan(**arguments)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("fields", [{"address": 126}, {"outputs": 245}, {"inputs": -1}, {"max_tsdr": 0}, {"watchdog": "soon"},
                                    {"max_tsdr": {500_000: 70_000}}, {"min_slave_interval": 65_536}, {"watchdog": 0.0}])
def test_what_is_no_slave_is_refused(fields: Mapping[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(fields))):
        Slave(**{"address": 5, **fields})


lengths = st.integers(0, 244)
some = st.builds(Slave, st.integers(2, 60), lengths, lengths, st.none() | st.integers(11, 1100), st.integers(0, 100),
                 st.sampled_from(["default", None, 0.01, 1.0]))
slaves = st.lists(some, max_size=6, unique_by=lambda slave: slave.address)


@given(st.sampled_from(BAUDRATES), slaves, st.integers(1, 4), st.booleans(), st.floats(0, 0.03), st.integers(0, 9),
       st.none() | st.integers(40, 20_000))
def test_what_holds_of_every_plan(rate: int, slaves: list[Slave], masters: int, ring: bool, allowance: float, repeaters: int,
                                  tsl: int | None) -> None:
    timing = plan(rate, slaves, masters=masters, ring=ring, allowance=allowance, repeaters=repeaters,
                  changes={} if tsl is None else {"tsl": tsl})
    c = timing.cycle
    assert c.time == pytest.approx(sum(each.seconds for each in c.parts))
    order = (c.steady, c.time, c.lost_answer, c.repeated, c.worst)
    assert all(less <= more + 1e-9 for less, more in pairwise(order))
    assert c.time <= c.watched <= c.repeated + 1e-9
    if timing.works:
        timing.parameters.check(1)
        assert timing.tsl_needed <= timing.parameters.tsl
        assert all(slave.watchdog in ("default", None) or slave.watchdog >= c.repeated for slave in slaves)
        assert timing.parameters.seconds(timing.parameters.ttr) >= c.rotation - 1e-9
    assert command.table(timing)
    assert json.loads(json.dumps(command.as_object(timing)))["works"] is timing.works


# ---- the master takes its figures from here


def test_the_masters_default_watchdog_is_the_planners() -> None:
    stations = [Station(5, 1, b"\x33"), Station(6, 1, b"\x31", max_tsdr={500_000: 400}, min_slave_interval=30)]
    with Segment(ports=1, cards=0) as hub, Master(hub.port(), allowance=0.02) as master:
        for station in stations:
            master.add(station)
        timing = plan(500_000, list(map(Slave.of, stations)), allowance=0.02)
        assert master.parameters == timing.parameters
        assert master._default_watchdog() == timing.watchdog > 0.2


def test_a_station_within_tsl_but_over_the_tables_max_tsdr_counts() -> None:
    with Segment(ports=1, cards=0) as hub, Master(hub.port()) as master:
        master.add(Station(5, 1, b"\x33", max_tsdr={500_000: 180}))
        assert (master.parameters.max_tsdr, master.parameters.tsl) == (180, 200)


# ---- the command


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str]:
    code = cli.main(["timing", *argv])
    out, err = capsys.readouterr()
    assert err == ""
    assert max(map(len, out.splitlines())) <= 80 or "--json" in argv
    return code, out


def test_the_table_shows_bit_times_beside_real_time(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = run(capsys, "--baudrate", "1500000", "--station", "5:4/4:max_tsdr=50", "--address", "2")
    assert code == 0
    rows = [line.split() for line in out.splitlines()]
    assert ["T_DX", "5:", "4", "out,", "4", "in", "373", "248.7", "us"] in rows
    assert ["Tsl", "slot", "time", "300", "200", "us"] in rows, 'protocol page D.2: "TSL in real time 200 us"'
    assert next(row for row in rows if row[:1] == ["Tto"])[-3:] == ["3000", "2", "ms"]
    assert "WILL NOT WORK" not in out


def test_equal_slaves_share_a_row(capsys: pytest.CaptureFixture[str]) -> None:
    _, out = run(capsys, "--station", "5-8:6/6", "--station", "20:6/6", "--station", "9:v7", "--address", "1,2")
    assert "T_DX 5-8, 20: 6 out, 6 in, 5 x 467" in out
    assert "2335" in out
    assert "T_DX 9: 32 out, 32 in" in out
    assert "master at 1 " in out and "master at 2 " in out


def test_a_drive_by_name_is_what_its_class_says(capsys: pytest.CaptureFixture[str]) -> None:
    """SI-P1: MaxTsdr_45.45 is 250 in its GSD file."""
    _, out = run(capsys, "--baudrate", "45450", "--station", "9:v7:basic data:watchdog=500", "--json")
    told = json.loads(out)
    drive = YaskawaV7(9, "Basic data")
    assert told["parameters"]["tsl"] == 265
    only = told["cycle"]["exchanges"][0]
    assert (only["address"], only["outputs"], only["inputs"]) == (9, drive.output_length, drive.input_length)


def test_what_will_not_work_is_said_with_a_remedy_and_1(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = run(capsys, "--station", "5:6/6:watchdog=1", "--masters", "2", "--profile", "pty", "--tsl", "200")
    assert code == 1
    assert out.count("WILL NOT WORK") == 2 and out.count("remedy:") == 2
    assert "15420" in out  # 100 + 15 + 25 ms + 255 characters at 500 kbit/s


def test_json_says_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = run(capsys, "--station", "5:6/6", "--masters", "2", "--allowance", "40", "--json")
    told = json.loads(out)
    assert code == 1 and told["works"] is False
    assert told["parameters"]["tsl"] == 16_383 and told["tsl_needed"] == 20_115
    assert "20115" in told["findings"][0]["text"] and told["findings"][0]["fatal"] is True


@pytest.mark.parametrize("argv", [
    ["--station", "5"], ["--station", "5:6"], ["--station", "5:6/6/6"], ["--station", "5:pump"], ["--station", "x:6/6"],
    ["--station", "9-5:6/6"], ["--station", "5:6/245"], ["--station", "126:1/1"], ["--station", "5:6/6:speed=1"],
    ["--station", "5:6/6:max_tsdr=x"], ["--station", "5:v7:nothing"], ["--station", "5:v7:basic data:more"],
    ["--station", "5:6/6:more"], ["--address", "x"], ["--allowance", "x"], ["--profile", "net"]])
def test_arguments_that_are_none(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["timing", *argv])
    assert left.value.code == 2
    assert argv[1] in capsys.readouterr().err


def test_a_rate_that_is_none_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["timing", "--baudrate", "115200"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and "115200" in err
