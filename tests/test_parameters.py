# SPDX-License-Identifier: MIT
"""Bus parameters against protocol pages D.1 (ranges), D.2 (the standard table) and D.3 (predicted times)."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from math import ceil, floor
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpmaster._core import ffi, lib
from dpmaster.errors import ConfigurationError
from dpmaster.parameters import BAUDRATES, BusParameters

RATES = (9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000, 3000000, 6000000, 12000000)
LOW = (100, 60, 0, 1, 37, 60, 1)
# Protocol page D.2, column by column: Tsl, max Tsdr, Tqui, Tset, Tid1, Tid2, max_retry_limit.
TABLE = {
    **dict.fromkeys(RATES[:6], LOW),
    500000: (200, 100, 0, 1, 37, 100, 1),
    1500000: (300, 150, 0, 1, 37, 150, 1),
    3000000: (400, 250, 3, 4, 46, 250, 2),
    6000000: (600, 450, 6, 8, 57, 450, 3),
    12000000: (1000, 800, 9, 16, 76, 800, 4),
}


def default(rate: int, max_tsdr: int = 0) -> Any:
    parameters = ffi.new("dpm_parameters *")
    assert lib.dpm_parameters_default(parameters, rate, max_tsdr) == 0
    return parameters


def refusal(parameters: Any, address: int = 1) -> tuple[str, int, int, int] | None:
    found = ffi.new("dpm_refusal *")
    if lib.dpm_parameters_check(parameters, address, found) == 0:
        return None
    assert lib.dpm_parameters_check(parameters, address, ffi.NULL) == lib.DPM_E_PARAMETER
    assert ffi.string(found.rule)
    return ffi.string(found.parameter).decode(), found.value, found.minimum, found.maximum


def changed(rate: int = 1500000, **fields: int) -> Any:
    parameters = default(rate)
    for name, value in fields.items():
        setattr(parameters, name, value)
    return parameters


def test_the_nominal_rates() -> None:
    assert tuple(lib.dpm_parameters_rate(n) for n in range(12)) == (*RATES, 0)


@pytest.mark.parametrize("rate", RATES)
def test_the_standard_set(rate: int) -> None:
    p = default(rate)
    assert (p.tsl, p.max_tsdr, p.tqui, p.tset, lib.dpm_tid1(p), lib.dpm_tid2(p), p.max_retry_limit) == TABLE[rate]
    assert (p.min_tsdr, p.hsa) == (11, 126)
    assert p.ttr >= 5000 * p.hsa, 'protocol page D.1: "user profile >= 5000*HSA"'
    assert refusal(p) is None
    assert lib.dpm_tto(p, 2) == 10 * p.tsl, 'protocol page D.2: "TTO for n=2 (10*TSL)"'


@pytest.mark.parametrize("rate", [45450, 45454, 45455])
def test_the_odd_rate_is_a_fraction(rate: int) -> None:
    p = default(rate)
    assert (p.rate_num, p.rate_den) == (500000, 11)


@pytest.mark.parametrize("rate", [0, 9599, 115200, 45451, 12000001, 0xFFFFFFFF])
def test_any_other_rate_has_no_standard_set(rate: int) -> None:
    assert lib.dpm_parameters_default(ffi.new("dpm_parameters *"), rate, 0) == lib.DPM_E_PARAMETER


@pytest.mark.parametrize(("rate", "max_tsdr", "expected", "tsl"), [
    (500000, 0, 100, 200),
    (500000, 99, 100, 200),
    (500000, 185, 185, 200),
    (500000, 186, 186, 201),
    (93750, 1000, 1000, 1015),  # protocol page D.2: a DP/PA coupler's MaxTsdr_93.75=1000
    (45450, 250, 250, 265),     # and MaxTsdr_45.45=250
])
def test_a_slow_station_raises_tsl(rate: int, max_tsdr: int, expected: int, tsl: int) -> None:
    """Protocol page D.1: "TSL >= max TSDR + 15"."""
    p = default(rate, max_tsdr)
    assert (p.max_tsdr, p.tsl) == (expected, tsl)
    assert refusal(p) is None


@pytest.mark.parametrize("max_tsdr", [1024, 65535])
def test_a_station_slower_than_the_standard_allows_is_refused_by_name(max_tsdr: int) -> None:
    assert refusal(default(1500000, max_tsdr)) == ("max_tsdr", max_tsdr, 37, 1023)


# Protocol page D.1 and the comments of parameters.h: parameter, the rest of the set, lowest and highest value. A highest
# value of 255 in an octet has nothing past it.
BOUNDS: list[tuple[str, dict[str, int], int, int]] = [
    ("tset", {"max_tsdr": 1000, "tsl": 1015}, 1, 255),
    ("tqui", {"min_tsdr": 36}, 0, 31),
    ("tqui", {"min_tsdr": 11}, 0, 10),
    ("max_tsdr", {"tsl": 16383}, 37, 1023),
    ("max_tsdr", {"tsl": 16383, "tset": 16, "tqui": 9}, 76, 1023),
    ("min_tsdr", {}, 11, 36),
    ("min_tsdr", {"max_tsdr": 300, "tsl": 400, "tset": 100}, 11, 234),
    ("min_tsdr", {"max_tsdr": 300, "tsl": 400, "tset": 110}, 11, 254),
    ("min_tsdr", {"max_tsdr": 300, "tsl": 400, "tset": 111}, 11, 255),
    ("tsl", {}, 165, 16383),
    ("tsl", {"max_tsdr": 37}, 52, 16383),
    ("ttr", {}, 256, 16777960),
    ("g", {}, 1, 100),
    ("hsa", {}, 1, 126),
    ("max_retry_limit", {}, 0, 15),
]


@pytest.mark.parametrize(("name", "rest", "lowest", "highest"), BOUNDS)
def test_a_value_on_its_bound_passes_and_one_past_it_is_named(name: str, rest: dict[str, int], lowest: int,
                                                              highest: int) -> None:
    for value in (lowest, highest):
        assert refusal(changed(**{**rest, name: value})) is None
    if lowest > 0:
        found = refusal(changed(**{**rest, name: lowest - 1}))
        assert found is not None and found[:3] == (name, lowest - 1, lowest)
    if highest < 255 or name in ("tsl", "ttr", "max_tsdr"):
        found = refusal(changed(**{**rest, name: highest + 1}))
        assert found is not None and (*found[:2], found[3]) == (name, highest + 1, highest)


def test_a_slot_time_too_short_for_the_slowest_station() -> None:
    assert refusal(changed(max_tsdr=285, tsl=300)) is None
    assert refusal(changed(max_tsdr=286, tsl=300)) == ("tsl", 300, 301, 16383)


@pytest.mark.parametrize("address", [126, 127, 255])
def test_a_master_has_an_address_up_to_125(address: int) -> None:
    assert refusal(default(500000), address) == ("address", address, 0, 125)
    assert refusal(default(500000), 125) is None


def test_hsa_is_not_below_the_own_address() -> None:
    assert refusal(changed(hsa=9), 9) is None
    assert refusal(changed(hsa=9), 10) == ("hsa", 9, 10, 126)


@pytest.mark.parametrize(("num", "den", "good"), [
    (9600, 1, True), (9599, 1, False), (12000000, 1, True), (12000001, 1, False), (500000, 11, True),
    (500000, 0, False), (0, 1, False), (105599, 11, False), (105600, 11, True), (250000, 1, True)])
def test_the_rate_is_between_9600_and_12_million(num: int, den: int, good: bool) -> None:
    found = refusal(changed(rate_num=num, rate_den=den))
    assert (found is None) if good else (found is not None and found[0] == "rate")


@given(st.sampled_from(RATES), st.integers(0, 2**31))
def test_nanoseconds_are_exact_and_rounded_up_or_down(rate: int, bits: int) -> None:
    p = default(rate)
    exact = Fraction(bits * 10**9 * p.rate_den, p.rate_num)
    assert lib.dpm_bits_up(p, bits) == ceil(exact)
    assert lib.dpm_bits_down(p, bits) == floor(exact)


def test_slot_times_of_the_table_in_real_time() -> None:
    """Protocol page D.2: "10.4 ms @9.6k; 2.2 ms @45.45k; 400 us" at 500 kbit/s, "83 us" at 12 Mbit/s."""
    assert [lib.dpm_bits_up(default(rate), TABLE[rate][0]) for rate in (9600, 45450, 500000, 12000000)] == [
        10_416_667, 2_200_000, 400_000, 83_334]
    assert lib.dpm_bits_down(default(12000000), 1000) == 83_333


def test_predicted_times() -> None:
    """Protocol page D.3: 4 out + 4 in at 1.5 Mbit/s with Tsdr 50 is "11*26 + 50 + 37 = 373 Tbit"; the worst Tsdr is 150."""
    p = default(1500000)
    assert lib.dpm_predict_exchange(p, 4, 4) == 373 - 50 + 150
    assert lib.dpm_predict_exchange(p, 0, 4) == 11 * (6 + 13) + 150 + 37, '"L_out = 0 -> 6, SD1"'
    assert lib.dpm_predict_exchange(p, 4, 0) == 11 * (13 + 1) + 150 + 37, '"L_in = 0 -> 1, SC"'
    assert lib.dpm_predict_exchange(p, 244, 244) == 11 * 506 + 187
    assert lib.dpm_predict_failure(p, 4) == 11 * 13 + 300
    assert lib.dpm_predict_failure(p, 0) == 11 * 6 + 300
    assert lib.dpm_predict_token(p) == 33 + 37
    assert lib.dpm_predict_global_control(p) == 143 + 150


def test_tid1_is_never_below_min_tsdr() -> None:
    """Protocol page D.1: TID1 = max(TSYN+TSM, min TSDR, ...), TID2 = max(TSYN+TSM, max TSDR)."""
    assert lib.dpm_tid1(changed(min_tsdr=200)) == 200
    assert lib.dpm_tid2(changed(max_tsdr=36)) == 37


@pytest.mark.parametrize("rate", RATES)
def test_the_python_face_holds_the_same_set(rate: int) -> None:
    ours = BusParameters.default(rate)
    assert (ours.tsl, ours.max_tsdr, ours.tqui, ours.tset, ours.tid1, ours.tid2, ours.max_retry_limit) == TABLE[rate]
    assert ours.tto(2) == 10 * ours.tsl
    ours.check(1)
    assert bytes(ffi.buffer(ours.to_c())) == bytes(ffi.buffer(default(rate)))


def test_seconds_of_a_fractional_rate() -> None:
    assert BusParameters.default(45450).rate == Fraction(500000, 11)
    assert BusParameters.default(45450).seconds(100) == pytest.approx(2.2e-3)


@pytest.mark.parametrize(("change", "address", "words"), [
    ({"tsl": 300, "max_tsdr": 286}, 1, ["tsl = 300", "301 to 16383", "max Tsdr + 15", "BusParameters.default"]),
    ({"tset": 0}, 1, ["tset = 0", "1 to 255", "standard set"]),
    ({"tsl": 70000}, 1, ["tsl = 70000", "whole number"]),
    ({"g": -1}, 1, ["g = -1", "whole number"]),
    ({"ttr": 1.5}, 1, ["ttr = 1.5", "whole number"]),
    ({"rate": Fraction(2**40)}, 1, ["rate = 1099511627776", "whole number"]),
    ({"rate": Fraction(9000)}, 1, ["rate = 9000", "9600 to 12000000"]),
    ({}, 126, ["address = 126", "0 to 125", "another address"]),
    ({}, -1, ["address = -1", "0 to 125"]),
    ({}, 1000, ["address = 1000", "0 to 125"]),
    ({}, "5", ["address '5'", "0 to 125"]),
    ({"hsa": 3}, 4, ["hsa = 3", "4 to 126", "raise hsa"]),
])
def test_a_refusal_names_parameter_value_rule_and_remedy(change: dict[str, Any], address: Any, words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        replace(BusParameters.default(1500000), **change).check(address)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(("baudrate", "max_tsdr", "words"), [
    (115200, 0, ["115200", "9600, 19200, 31250"]),
    (-1, 0, ["-1"]),
    (2**32, 0, ["4294967296"]),
    ("fast", 0, ["'fast'"]),
    (500000, 2000, ["max_tsdr = 2000", "1023", "GSD"]),
    (500000, 70000, ["max_tsdr 70000", "1023"]),
    (500000, -5, ["max_tsdr -5"]),
    (500000, "slow", ["max_tsdr 'slow'"]),
])
def test_a_set_that_does_not_exist_is_refused(baudrate: Any, max_tsdr: Any, words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        BusParameters.default(baudrate, max_tsdr)
    for word in words:
        assert word in str(caught.value)


def test_predicted_times_by_name() -> None:
    ours = BusParameters.default(500000)
    assert ours.predict_exchange(6, 6) == 11 * (9 + 6 + 9 + 6) + 100 + 37
    assert ours.predict_failure(6) == 11 * 15 + 200
    assert ours.predict_token() == 33 + 37
    assert ours.predict_global_control() == 143 + 100


@pytest.mark.parametrize("rate", BAUDRATES)
def test_the_default_g_keeps_a_gap_round_within_two_per_cent(rate):
    """GAP update time G * Ttr (protocol page D.1); a round polls 125 addresses, 66 Tbit and a slot each (E.3, D.3)."""
    p = BusParameters.default(rate)
    polls = 125 * (66 + p.tsl)
    assert polls <= 0.02 * p.g * p.ttr < polls + 0.02 * p.ttr + 50 * 2
