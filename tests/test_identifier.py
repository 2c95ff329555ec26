# SPDX-License-Identifier: MIT
"""Configuration identifiers against the table of protocol page G.2 and the format it describes."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpmaster import identifier
from dpmaster._core import ffi, lib
from dpmaster.errors import ConfigurationError
from dpmaster.identifier import Data, Identifier

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
    found = ffi.new("dpm_identifier *")
    code = lib.dpm_identifier_decode(octets, len(octets), found)
    assert code == found.octets
    return {name: getattr(found, name) for name, _ in ffi.typeof("dpm_identifier").fields}


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
    assert lib.dpm_identifier_decode(octets, len(octets), ffi.new("dpm_identifier *")) == lib.DPM_E_CONFIGURATION
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


def test_decode_gives_slots_and_offsets() -> None:
    """Protocol page G.2: an empty slot, PPO1 (F3 F1) and C0 83 41 behind each other."""
    empty, pkw, pzd, last = identifier.decode(bytes.fromhex("00 F3 F1 C08341"))
    assert empty == Identifier(slot=1, special=True)
    assert pkw == Identifier(inputs=Data(8, 2, True, 0), outputs=Data(8, 2, True, 0), slot=2)
    assert pzd == Identifier(inputs=Data(4, 2, True, 8), outputs=Data(4, 2, True, 8), slot=3)
    assert last == Identifier(inputs=Data(4, 2, False, 12), outputs=Data(4, 1, True, 12), special=True, slot=4)


@pytest.mark.parametrize("text", [*(row[0] for row in TABLE), "41 83 AA", "C3 CF C7 01 02 03", "C0 83 41", "4F 00", "0F"])
def test_the_table_survives_decode_and_encode(text: str) -> None:
    octets = bytes.fromhex(text)
    assert identifier.encode(identifier.decode(octets)) == octets


@pytest.mark.parametrize(("built", "text"), [
    (Identifier(), "00"),
    (Identifier(inputs=Data(1)), "10"),
    (Identifier(outputs=Data(2)), "21"),
    (Identifier(inputs=Data(6, 2), outputs=Data(6, 2)), "72"),
    (Identifier(inputs=Data(32, 2, True), outputs=Data(32, 2, True)), "FF"),
    (Identifier(inputs=Data(4, 1, True), specific=b"\xaa"), "41 83 AA"),
    (Identifier(outputs=Data(4, 1, True), inputs=Data(4, 2)), "C0 83 41"),
    (Identifier(outputs=Data(32, 2, True), inputs=Data(16, 2, True), specific=b"\1\2\3"), "C3 CF C7 01 02 03"),
    (Identifier(inputs=Data(17)), "40 10"),
])
def test_identifiers_are_built_as_the_table_has_them(built: Identifier, text: str) -> None:
    assert built.encode() == bytes.fromhex(text)


PARTS = st.none() | st.builds(lambda units, unit, consistent: Data(units * unit, unit, consistent),
                              st.integers(1, 20) | st.integers(1, 64), st.sampled_from([1, 2]), st.booleans())


def bare(found: Identifier) -> Identifier:
    """Without what depends on the place: the offsets and the slot, and the format."""
    inputs = found.inputs and replace(found.inputs, offset=0)
    outputs = found.outputs and replace(found.outputs, offset=0)
    return replace(found, inputs=inputs, outputs=outputs, slot=0, special=False)


@given(st.builds(Identifier, inputs=PARTS, outputs=PARTS, specific=st.binary(max_size=14), special=st.booleans()))
def test_what_is_built_is_what_is_decoded(built: Identifier) -> None:
    (found,) = identifier.decode(built.encode())
    assert bare(found) == bare(built)


@given(st.binary(max_size=40))
def test_what_decodes_encodes_to_the_same_octets(octets: bytes) -> None:
    try:
        found = identifier.decode(octets)
    except ConfigurationError:
        assert lengths(octets)[0] < 0
        return
    assert identifier.encode(found) == octets
    assert [one.slot for one in found] == list(range(1, len(found) + 1))
    ends = [sum(part.octets for one in found if (part := getattr(one, name))) for name in ("inputs", "outputs")]
    assert lengths(octets) == (len(found), *ends)
    for name in ("inputs", "outputs"):
        at = 0
        for part in (getattr(one, name) for one in found):
            if part:
                assert part.offset == at
                at += part.octets


@pytest.mark.parametrize(("built", "words"), [
    (Identifier(inputs=Data(0)), ["0 octets", "1 to 64"]),
    (Identifier(inputs=Data(65)), ["65 octets", "1 to 64"]),
    (Identifier(inputs=Data(3, 2)), ["3 octets", "units of 2"]),
    (Identifier(inputs=Data(4, 4)), ["units of 4"]),
    (Identifier(specific=bytes(15)), ["15 maker's octets", "at most 14"]),
    (Identifier(specific=b"\1", unchecked=True), ["1 maker's octets", "none"]),
])
def test_what_no_identifier_can_say_is_refused(built: Identifier, words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        built.encode()
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(("text", "words"), [
    ("10 41 83", ["10 41 83", "41 at octet 1"]),
    ("C0 FF FF C0 F9 F9 10", ["245 octets of inputs", "244"]),
    ("C0 FF FF C0 F9 F9 20", ["245 octets of outputs", "244"]),
])
def test_a_bad_configuration_is_refused_by_its_octets(text: str, words: list[str]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        identifier.decode(bytes.fromhex(text))
    for word in words:
        assert word in str(caught.value)
