# SPDX-License-Identifier: MIT
"""A station as a description: its ranges, its Set_Prm, its watchdog's factors. No bus."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dpmaster import ConfigurationError, Station
from dpmaster._core import ffi
from dpmaster.station import watchdog_factors

PPO1 = bytes.fromhex("F3 F1")  # protocol page B.4 #60; 4 + 2 words both ways

PRODUCTS = sorted({a * b for a in range(1, 256) for b in range(1, 256)})


@given(st.floats(min_value=0.0001, max_value=650.25))
@example(0.3)  # B.4 #7: WD 30 * 1 * 10 ms = 300 ms
@example(1.95)  # B.4 #29: 13 * 15 * 10 ms
@example(0.07)  # 7.000000000000001 ticks in floating point
@example(650.25)
def test_watchdog_factors_are_the_shortest_that_is_long_enough(seconds: float) -> None:
    first, second = watchdog_factors(seconds)
    assert 1 <= first <= 255
    assert 1 <= second <= 255
    assert first * second * 0.01 >= seconds - 1e-6
    assert not [p for p in PRODUCTS if seconds <= p * 0.01 - 1e-6 and p < first * second]


@pytest.mark.parametrize(("seconds", "product"), [(0.3, 30), (1.95, 195), (0.07, 7), (0.001, 1), (2.57, 258)])
def test_watchdog_factors_by_example(seconds: float, product: int) -> None:
    first, second = watchdog_factors(seconds)
    assert first * second == product


@pytest.mark.parametrize("seconds", [0, -1, 650.26, float("nan")])
def test_watchdogs_that_no_factors_say(seconds: float) -> None:
    with pytest.raises(ConfigurationError, match="watchdog"):
        watchdog_factors(seconds)


def test_no_watchdog_is_no_factors() -> None:
    assert watchdog_factors(None) == (0, 0)


def test_lengths_come_from_the_configuration() -> None:
    station = Station(5, 0x0959, PPO1)
    assert (station.input_length, station.output_length) == (12, 12)


@pytest.mark.parametrize(("arguments", "words"), [
    ({"address": 126}, ["126", "Set_Slave_Add"]),
    ({"address": 127}, ["127", "0 to 125"]),
    ({"address": -1}, ["-1"]),
    ({"ident_number": 0x10000}, ["ident_number"]),
    ({"configuration": b""}, ["configuration", "1 to 244"]),
    ({"configuration": bytes(245)}, ["245"]),
    ({"configuration": b"\xC0\x83"}, ["C0 83"]),  # output and input lengths announced, one is there
    ({"user_parameters": bytes(238)}, ["238", "237"]),
    ({"min_tsdr": 10}, ["min_tsdr", "11"]),
    ({"max_tsdr": {500_000: 2000}}, ["max_tsdr at 500000", "1023"]),
    ({"group": 256}, ["group"]),
    ({"min_slave_interval": 65536}, ["min_slave_interval"]),
    ({"resume": "run"}, ["resume", "'run'"]),
    ({"watchdog": "never"}, ["watchdog", "'never'"]),
    ({"watchdog": 0.0}, ["watchdog"]),
])
def test_bad_arguments_are_named_with_value_and_rule(arguments: dict[str, Any], words: list[str]) -> None:
    good = {"address": 5, "ident_number": 0x0959, "configuration": PPO1}
    with pytest.raises(ConfigurationError) as caught:
        Station(**(good | arguments))
    for word in words:
        assert word in str(caught.value)


def test_settings_carry_everything() -> None:
    station = Station(8, 0x0A35, b"\x21\x24", b"\x00\x00\x00\x82\x00\x00\x00", watchdog=0.3, min_tsdr=0, group=1, sync=True,
                      freeze=True, fail_safe=True, min_slave_interval=6, resume="hold", active=False)
    station._watch(lambda: 1.0)
    s = station._settings()
    # B.4 #19: B8 1E 01 00 0A 35 01: Sync_Req 20h and Freeze_Req 10h are the station's, Lock and WD_On the handler's
    assert (s.station_status, s.wd_fact_1 * s.wd_fact_2, s.min_tsdr, s.ident_number, s.group) == (0x30, 30, 0, 0x0A35, 1)
    assert bytes(ffi.buffer(s.user_parameters, s.user_parameters_length)) == b"\x00\x00\x00\x82\x00\x00\x00"
    assert bytes(ffi.buffer(s.configuration, s.configuration_length)) == b"\x21\x24"
    assert (s.address, s.fail_safe, s.hold, s.active, s.min_slave_interval) == (8, True, True, False, 6)


def test_the_default_watchdog_is_asked_for_only_by_default() -> None:
    by_default, fixed, off = (Station(5, 1, PPO1, watchdog=w) for w in ("default", 2.0, None))
    assert by_default._watch(lambda: 0.1)
    assert by_default._factors == watchdog_factors(0.1)
    assert not by_default._watch(lambda: 0.1)
    assert fixed._watch(lambda: 0.1)
    assert fixed._factors == watchdog_factors(2.0)
    assert not off._watch(lambda: 0.1)


@pytest.mark.parametrize("use", ["frame", "inputs", "outputs", "state", "diagnosis", "reason", "statistics"])
def test_a_station_without_a_master_says_so(use: str) -> None:
    with pytest.raises(ConfigurationError, match="belongs to no master"):
        getattr(Station(5, 1, PPO1), use)


def test_a_commit_without_a_master_says_so() -> None:
    station = Station(5, 1, PPO1, name="pump")
    with pytest.raises(ConfigurationError, match="pump belongs to no master"):
        station.outputs = bytes(12)
