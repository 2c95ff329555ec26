# SPDX-License-Identifier: MIT
"""Slave_Diag: real answers of protocol page B.4 and H, and blocks that lie."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpmaster import _core
from dpmaster.diagnosis import (
    ChannelBlock,
    DeviceBlock,
    Diag,
    Diagnosis,
    IdentifierBlock,
    Reason,
    RevisionBlock,
    StationState,
    why,
)
from dpmaster.errors import ConfigurationError


def decode(text: str) -> Diagnosis:
    return Diagnosis(bytes.fromhex(text))


@pytest.mark.parametrize(("octets", "flags", "master", "ident", "ready"), [
    # B.4 #15: a slave after power-on, minimal diagnosis
    ("02 05 00 FF 0C DA", Diag.STATION_NOT_READY | Diag.PRM_REQ | Diag.ALWAYS_1, None, 0x0CDA, False),
    # B.4 #22: ready, watchdog on, master 2
    ("00 0C 00 02 0A 35", Diag.ALWAYS_1 | Diag.WD_ON, 2, 0x0A35, True),
    # B.4 #24: an old Cfg_Fault
    ("06 05 00 FF 0F 84", Diag.STATION_NOT_READY | Diag.CFG_FAULT | Diag.PRM_REQ | Diag.ALWAYS_1, None, 0x0F84, False),
    # B.4 #32: Stat_Diag
    ("00 0E 00 01 80 E0", Diag.ALWAYS_1 | Diag.WD_ON | Diag.STAT_DIAG, 1, 0x80E0, False),
    # B.4 #64: Prm_Fault
    ("42 05 00 FF 09 59", Diag.STATION_NOT_READY | Diag.PRM_FAULT | Diag.PRM_REQ | Diag.ALWAYS_1, None, 0x0959, False),
    # H.1: bits of octets 2 and 3 that no capture shows
    ("80 B4 80 03 00 01", Diag.MASTER_LOCK | Diag.ALWAYS_1 | Diag.FREEZE_MODE | Diag.SYNC_MODE | Diag.DEACTIVATED
     | Diag.EXT_DIAG_OVERFLOW, 3, 1, False),
])
def test_standard_octets(octets: str, flags: Diag, master: int | None, ident: int, ready: bool) -> None:
    diagnosis = decode(octets)
    assert (diagnosis.flags, diagnosis.master, diagnosis.ident_number) == (flags, master, ident)
    assert diagnosis.ready is ready
    assert diagnosis.blocks == ()
    assert diagnosis.rest == b""


def test_the_words_of_a_refusal() -> None:
    assert decode("42 05 00 FF 09 59").texts == (
        "is not ready for Data_Exchange yet", "refuses the parameters", "must be parameterised and configured anew")
    assert str(decode("00 0C 00 02 0A 35")) == "ident 0A35h, master 2: has its watchdog on"


def test_blocks_of_the_standards_kinds() -> None:
    # H.2: "44 00 01 00 identifier block, bit 8 -> 9th module; 88 41 21 module 8, input channel 1, bit, short circuit;
    # 04 10 20 30 device data"; a revision is one octet
    diagnosis = decode("08 0C 00 02 09 59  44 00 01 00  88 41 21  04 10 20 30  C5")
    modules, channel, device, revision = diagnosis.blocks
    assert isinstance(modules, IdentifierBlock)
    assert modules.identifiers == (8,)
    assert isinstance(channel, ChannelBlock)
    assert (channel.identifier, channel.channel, channel.direction, channel.channel_type) == (8, 1, "input", 1)
    assert (channel.error, channel.error_text) == (1, "short circuit")
    assert isinstance(device, DeviceBlock)
    assert device.data == bytes.fromhex("10 20 30")
    assert isinstance(revision, RevisionBlock)
    assert revision.revision == 5
    assert diagnosis.rest == b""


@pytest.mark.parametrize(("code", "text"), [
    (0, "reserved error 0"), (6, "line break"), (9, "error"), (10, "reserved error 10"), (16, "maker's error 16"),
])
def test_channel_errors(code: int, text: str) -> None:
    assert ChannelBlock(bytes([0x80, 0x40, code])).error_text == text


def test_a_whole_capture() -> None:
    # B.4 #6: identifier block of 64 modules, all well, then the module status of an ET 200S
    diagnosis = decode("02 05 00 FF 80 6A 49 00 00 00 00 00 00 00 00 14 82 00 00" + " 00" * 16)
    modules, status = diagnosis.blocks
    assert isinstance(modules, IdentifierBlock)
    assert modules.identifiers == ()
    assert isinstance(status, DeviceBlock)
    assert len(status.octets) == 20


@pytest.mark.parametrize("lie", ["00", "01", "40", "41", "05 01", "7F 00", "80 01", "BF"])
def test_a_block_that_lies_ends_the_blocks(lie: str) -> None:
    # H.2: "A length of 0/1 or beyond the telegram: stop parsing, show raw."
    diagnosis = decode("08 0C 00 02 09 59 04 10 20 30 " + lie)
    assert [type(block) for block in diagnosis.blocks] == [DeviceBlock]
    assert diagnosis.rest == bytes.fromhex(lie)


@given(st.binary(min_size=6, max_size=244))
def test_no_octets_are_lost_or_made_up(octets: bytes) -> None:
    diagnosis = Diagnosis(octets)
    assert b"".join(block.octets for block in diagnosis.blocks) + diagnosis.rest == diagnosis.extended
    assert str(diagnosis)
    for block in diagnosis.blocks:
        if isinstance(block, ChannelBlock):
            assert block.error_text


@pytest.mark.parametrize("length", [0, 5, 245])
def test_a_diagnosis_has_6_to_244_octets(length: int) -> None:
    with pytest.raises(ConfigurationError, match=str(length)):
        Diagnosis(bytes(length))


@pytest.mark.parametrize(("reason", "detail", "words"), [
    (Reason.NO_ANSWER, StationState.OFFLINE, ["does not answer", "powered"]),
    (Reason.NO_ANSWER, StationState.DATA, ["no longer answers", "Data_Exchange"]),
    (Reason.INVALID_ANSWER, 12, ["12 octets"]),
    (Reason.IDENT, 0x0CDA, ["0CDAh", "1234h"]),
    (Reason.PRM_FAULT, 0, ["Prm_Fault", "0959h", "1234h"]),
    (Reason.CFG_FAULT, 0, ["Cfg_Fault", "F3 F1"]),
    (Reason.NOT_SUPPORTED, 0, ["Not_Supported"]),
    (Reason.LOCKED, 7, ["master 7"]),
    (Reason.NOT_READY, 0, ["Station_Not_Ready"]),
    (Reason.STATIC_DIAG, 0, ["Stat_Diag"]),
    (Reason.PRM_REQ, 0, ["Prm_Req", "watchdog"]),
    (Reason.BUS, 0, ["left the bus"]),
    (99, 1, ["99"]),
])
def test_every_reason_in_words(reason: int, detail: int, words: list[str]) -> None:
    text = why(reason, detail, ident_number=0x1234, configuration=b"\xF3\xF1", diagnosis=decode("42 05 00 FF 09 59"))
    for word in words:
        assert word in text


@pytest.mark.parametrize(("octets", "word"), [("42 05 00 FF 12 34", "Prm_Fault"), ("06 05 00 FF 12 34", "Cfg_Fault"),
                                              ("12 05 00 FF 12 34", "Not_Supported"), ("02 05 00 FF 12 34", "RS")])
def test_the_diagnosis_says_what_a_refused_service_does_not(octets: str, word: str) -> None:
    assert word in why(Reason.SERVICE, 0x03, ident_number=0x1234, configuration=b"\x33", diagnosis=decode(octets))


def test_nothing_against_a_station_is_no_text() -> None:
    assert why(Reason.NONE, 0, ident_number=1) == ""


@pytest.mark.parametrize(("enumeration", "prefix"), [(Reason, "DPM_WHY_"), (StationState, "DPM_ST_")])
def test_numbers_are_the_librarys(enumeration: type[Reason] | type[StationState], prefix: str) -> None:
    theirs = {name.removeprefix(prefix): getattr(_core.lib, name) for name in dir(_core.lib) if name.startswith(prefix)}
    assert {member.name: member.value for member in enumeration} == theirs
