# SPDX-License-Identifier: MIT
"""Configuration identifiers against the table of protocol page G.2 and the format it describes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpmaster._core import ffi, lib

# Protocol page G.2, the table: octets, then per identifier (inputs, outputs, unit, consistent over the whole length).
TABLE = [
    ("00", [(0, 0, 0, False)]),
    ("10 20", [(1, 0, 1, False), (0, 1, 1, False)]),
    ("21", [(0, 2, 1, False)]),
    ("30", [(1, 1, 1, False)]),
    ("72", [(6, 6, 2, False)]),
    ("5F 6F", [(32, 0, 2, False), (0, 32, 2, False)]),
    ("55 65", [(12, 0, 2, False), (0, 12, 2, False)]),
    ("F3 F1", [(8, 8, 2, True), (4, 4, 2, True)]),
    ("F3 F5", [(8, 8, 2, True), (12, 12, 2, True)]),
    ("F1", [(4, 4, 2, True)]),
    ("F5", [(12, 12, 2, True)]),
    ("F3 F9", [(8, 8, 2, True), (20, 20, 2, True)]),
    ("73 71", [(8, 8, 2, False), (4, 4, 2, False)]),
    ("FF", [(32, 32, 2, True)]),
    ("D3 E1", [(8, 0, 2, True), (0, 4, 2, True)]),
]


def decode(octets: bytes) -> dict[str, int | bool]:
    identifier = ffi.new("dpm_identifier *")
    code = lib.dpm_identifier_decode(octets, len(octets), identifier)
    assert code == identifier.octets
    return {name: getattr(identifier, name) for name, _ in ffi.typeof("dpm_identifier").fields}


def lengths(octets: bytes) -> tuple[int, int, int]:
    inputs, outputs = ffi.new("uint16_t *", 0xAAAA), ffi.new("uint16_t *", 0xAAAA)
    code = lib.dpm_configuration_lengths(octets, len(octets), inputs, outputs)
    assert code >= 0 or (inputs[0], outputs[0]) == (0xAAAA, 0xAAAA), "a refused configuration has no lengths"
    return code, inputs[0], outputs[0]


@pytest.mark.parametrize(("text", "rows"), TABLE)
def test_general_format(text: str, rows: list[tuple[int, int, int, bool]]) -> None:
    octets = bytes.fromhex(text)
    assert len(octets) == len(rows)
    for octet, (inputs, outputs, unit, consistent) in zip(octets, rows, strict=True):
        assert decode(bytes([octet])) == {
            "octets": 1, "inputs": inputs, "outputs": outputs, "specific": 0,
            "input_unit": unit if inputs else 0, "output_unit": unit if outputs else 0,
            "input_consistent": consistent and inputs > 0, "output_consistent": consistent and outputs > 0,
        }
    assert lengths(octets) == (len(rows), sum(row[0] for row in rows), sum(row[1] for row in rows))


def test_special_format_input_with_a_makers_octet() -> None:
    """Protocol page G.2: 41 83 AA."""
    assert decode(b"\x41\x83\xaa") == {
        "octets": 3, "inputs": 4, "outputs": 0, "input_unit": 1, "output_unit": 0,
        "input_consistent": True, "output_consistent": False, "specific": 1}


def test_special_format_both_ways_outputs_first() -> None:
    """Protocol page G.2: C3 CF C7 x x x, 16 words out and 8 words in; C0 83 41, 4 bytes out consistent and 2 words in."""
    assert decode(bytes.fromhex("C3CFC7010203")) == {
        "octets": 6, "inputs": 16, "outputs": 32, "input_unit": 2, "output_unit": 2,
        "input_consistent": True, "output_consistent": True, "specific": 3}
    assert decode(bytes.fromhex("C08341")) == {
        "octets": 3, "inputs": 4, "outputs": 4, "input_unit": 2, "output_unit": 1,
        "input_consistent": False, "output_consistent": True, "specific": 0}


def test_special_format_extremes() -> None:
    """"Bits 5..0 = units - 1 (1..64)": 128 octets; an empty slot may carry maker's octets; 15 is not a number of them."""
    assert decode(b"\x80\xff")["outputs"] == 128
    assert decode(b"\x40\x3f")["inputs"] == 64
    assert decode(b"\x0e" + bytes(14))["octets"] == 15
    assert decode(b"\xce" + bytes(16))["octets"] == 17
    assert decode(b"\x4f\x00") == {**decode(b"\x40\x00"), "octets": 2}


def test_empty_slots_count() -> None:
    """Protocol page G.2: "count every identifier, also 00"."""
    assert lengths(b"\x00\x00\x00\x10\x20") == (5, 1, 1)
    assert lengths(b"") == (0, 0, 0)


@pytest.mark.parametrize("text", ["40", "80", "C0", "C0 83", "41 83", "03 01 02", "C3 CF C7 01 02"])
def test_an_identifier_that_is_cut_short_is_refused(text: str) -> None:
    octets = bytes.fromhex(text)
    identifier = ffi.new("dpm_identifier *")
    assert lib.dpm_identifier_decode(octets, len(octets), identifier) == lib.DPM_E_CONFIGURATION
    assert lengths(b"\x10" + octets)[0] == lib.DPM_E_CONFIGURATION


def test_nothing_is_no_identifier() -> None:
    assert lib.dpm_identifier_decode(b"", 0, ffi.new("dpm_identifier *")) == lib.DPM_E_CONFIGURATION


def test_sums_end_at_244() -> None:
    """Protocol page G.2: "Sum of inputs <= 244, outputs <= 244"."""
    full = b"\xc0\xff\xff" + b"\xc0\xf9\xf9"  # 128 + 116
    assert lengths(full) == (2, 244, 244)
    assert lengths(full + b"\x10")[0] == lengths(full + b"\x20")[0] == lib.DPM_E_CONFIGURATION
    assert lengths(full + b"\x00") == (3, 244, 244)


@given(st.binary(max_size=300))
def test_any_octets_are_walked_to_their_end_or_refused(octets: bytes) -> None:
    slots, inputs, outputs = lengths(octets)
    if slots < 0:
        assert slots == lib.DPM_E_CONFIGURATION
    else:
        assert slots <= len(octets) and inputs <= 244 and outputs <= 244
