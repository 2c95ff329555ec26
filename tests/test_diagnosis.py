# SPDX-License-Identifier: MIT
"""Slave_Diag: real answers of protocol page B.4 and H, and blocks that lie."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import PC, S7, recorded

from dpmaster import _core
from dpmaster.diagnosis import (
    AlarmBlock,
    ChannelBlock,
    DeviceBlock,
    Diag,
    Diagnosis,
    DiagnosisArea,
    DiagnosisTables,
    DiagnosisTexts,
    IdentifierBlock,
    ModuleState,
    Reason,
    RevisionBlock,
    StationState,
    StatusBlock,
    decode_blocks,
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
    assert isinstance(status, StatusBlock)
    assert len(status.octets) == 20
    assert (status.type_text, dict(status.modules)) == ("module status", {})
    assert [str(block) for block in diagnosis.blocks] == ["no module has diagnosis", "module status: all modules valid"]


def test_an_alarm_is_recognised_as_such() -> None:
    # B.4 #66: "Ext_Diag and a DPV1 process alarm (type 2, slot 3, spec 09 = seq 1, appears)"
    (alarm,) = decode("08 0C 00 02 09 59 09 02 03 09 50 00 00 00 00").blocks
    assert isinstance(alarm, AlarmBlock)
    assert (alarm.type, alarm.type_text, alarm.slot, alarm.sequence_number) == (2, "process alarm", 3, 1)
    assert (alarm.appears, alarm.additional_acknowledge, alarm.data) == ("appears", False, bytes.fromhex("50 00 00 00 00"))
    assert str(alarm) == "process alarm 1 appears, slot 3: 50 00 00 00 00"


@pytest.mark.parametrize(("block", "text"), [
    # H.2, alarm types and specifier: "bits 7..3 Seq_Nr, bit2 Add_Ack, bits 1..0 ..., 3 disappears (slot still disturbed)"
    ("04 01 05 FF", "diagnostic alarm 31 disappears, others remain, wants an additional acknowledge, slot 5"),
    ("04 03 01 00", "pull alarm 0, slot 1"),
    ("04 04 01 0A", "plug alarm 1 disappears, slot 1"),
    # H.2, status types: "1 status message, 2 module status, 3 DxB link status, 30 PrmCmdAck, 31 Red_State"
    ("05 81 00 01 0F", "status message comes, slot 0: 0F"),
    ("04 9E 00 00", "PrmCmd acknowledge, slot 0"),
    ("04 9F 00 02", "redundancy state goes, slot 0"),
    # H.2: "slot 1 = bits 1..0 of the first octet: 01 data invalid, 10 wrong module, 11 no module"
    ("05 82 00 00 09", "module status: slot 1 has invalid data, slot 2 holds another module than configured"),
    ("05 82 00 00 C0", "module status: slot 4 holds no module"),
])
def test_alarms_and_statuses_in_words(block: str, text: str) -> None:
    assert decode("08 0C 00 02 09 59" + block).explain()[-1] == text


def test_the_states_of_modules() -> None:
    (status,) = decode("08 0C 00 02 09 59 05 82 00 00 C9").blocks
    assert isinstance(status, StatusBlock)
    assert status.modules == {1: ModuleState.INVALID, 2: ModuleState.WRONG, 4: ModuleState.MISSING}


@pytest.mark.parametrize(("block", "plain", "with_dpv1"), [
    ("04 10 20 30", DeviceBlock, AlarmBlock),  # H.2: "04 10 20 30 device data"; alarm type 16 is reserved
    ("06 08 33 06 F4 01", DeviceBlock, AlarmBlock),  # devices page, VW3A3607: LFT, ETA, speed; not a block of DP-V1
    ("05 A0 01 00 7F", DeviceBlock, StatusBlock),  # status 32, the maker's
    ("05 81 00 10 7F", DeviceBlock, StatusBlock),  # a reserved bit of the specifier
    ("05 02 FF 00 7F", DeviceBlock, DeviceBlock),  # H.2: "slot (0..254)"
    ("05 00 01 00 7F", DeviceBlock, DeviceBlock),  # H.2: alarm "0/127 reserved"
    ("03 02 01", DeviceBlock, DeviceBlock),  # H.2: "header (length 4..63)"
])
def test_what_is_taken_for_an_alarm_or_a_status(block: str, plain: type, with_dpv1: type) -> None:
    octets = bytes.fromhex(block)
    assert [type(decode_blocks(octets, dpv1)[0][0]) for dpv1 in (False, True)] == [plain, with_dpv1]


# Unit_Diag_Bit of the GSD file printed in the SI-P3's manual, chapter 10
SI_P3 = DiagnosisTables(bits={24: "Undervoltage Condition", 25: "Inverter Communications Error",
                              26: "PNU915: Illegal PNU configured", 27: "PNU916: Illegal PNU configured"})


@pytest.mark.parametrize(("last", "text"), [
    ("01", "status message, slot 0: Undervoltage Condition"),
    ("02", "status message, slot 0: Inverter Communications Error"),
    ("0C", "status message, slot 0: PNU915: Illegal PNU configured; PNU916: Illegal PNU configured"),
    ("00", "status message, slot 0: 00"),
])
def test_the_makers_bits(last: str, text: str) -> None:
    """Devices page, SI-P3: "bits 24..27 count from after the header, so the block is 05 81 00 00 0x (a status block)"."""
    diagnosis = decode("08 0C 00 02 00 CA 05 81 00 00" + last)
    assert diagnosis.explain(SI_P3)[-1] == text
    assert "Undervoltage" not in str(diagnosis)


def test_the_makers_areas_bits_that_are_clear_and_types() -> None:
    tables = DiagnosisTables(
        clear_bits={0: "no supply", 7: "no sensor", 99: "beyond the block"}, bits={99: "beyond, too"},
        areas=(DiagnosisArea(4, 9, {0b10_1010: "mode 42"}), DiagnosisArea(10, 11, {1: "another value"}),
               DiagnosisArea(12, 40, {0: "beyond the block"})),
        types={1: DiagnosisTables(bits={24: "of a status message"})},
    )
    # M.2: "bit counted over the device-specific block after the header"; bits 4 to 9 are in A0h and 02h
    assert decode("08 0C 00 02 09 59 03 A0 02").explain(tables)[-1] == "device diagnosis: no supply; mode 42"
    assert decode("08 0C 00 02 09 59 05 81 00 00 01").explain(tables)[-1] == "status message, slot 0: of a status message"
    with pytest.raises(ConfigurationError, match="7 to 5"):
        DiagnosisArea(7, 5, {})


def test_modules_and_channels_by_the_makers_names() -> None:
    tables = DiagnosisTables(channel_errors={16: "parameter error", 1: "never asked for"},
                             modules=("head", "8 DI"))
    texts = decode("08 0C 00 02 09 59 42 0E 81 41 30 82 C5 81").explain(tables)[-3:]
    assert texts == ("diagnosis in module 1 (8 DI), module 2, module 3",
                     "module 1 (8 DI), input channel 1 (bit): parameter error",
                     "module 2, input and output channel 5 (byte): short circuit")


def test_every_recorded_diagnosis_is_read_whole() -> None:
    """Among those of the PC master: DH, and then an extended diagnosis of three octets, whose data are the slave's own."""
    found = {line.octets[9:-2] for name in (S7, PC) for line in recorded(name)
             if line.slave and line.octets[0] == 0x68 and line.octets[7:9] == b"\x3e\x3c"}
    assert len(found) == 4
    assert {text for octets in found for text in Diagnosis(octets).explain()} == {
        "is not ready for Data_Exchange yet", "must be parameterised and configured anew", "has its watchdog on",
        "reports a fault in its extended diagnosis", "device diagnosis: 82 3D"}
    assert {Diagnosis(octets).ident_number for octets in found} == {0x0B0D}


class Altivar:
    """What a drive knows of its own block (VW3A3607 manual, diagnostic): a page of texts is not the only way to say it."""

    def device(self, block: DeviceBlock) -> tuple[str, ...]:
        return (f"LFT {block.octets[1]}", f"ETA {int.from_bytes(block.octets[2:4], 'little'):04X}h")

    def channel_error(self, block: ChannelBlock) -> None:
        return None

    def module(self, identifier: int) -> None:
        return None


def test_a_drive_may_have_words_of_its_own() -> None:
    texts: DiagnosisTexts = Altivar()
    assert decode("08 0C 00 02 09 59 06 08 33 06 F4 01").explain(texts)[-1] == "device diagnosis: LFT 8; ETA 0633h"


def test_a_whole_diagnosis_in_words() -> None:
    """H.1 and H.2: whose lock, every block, and what is no block."""
    assert str(decode("88 0C 00 07 09 59  44 00 01 00  88 41 21  04 10 20 30  C5  7F 01")) == (
        "ident 0959h, master 7: reports a fault in its extended diagnosis; is locked by master 7; has its watchdog on; "
        "diagnosis in module 8; module 8, input channel 1 (bit): short circuit; device diagnosis: 10 20 30; "
        "revision 5 of the diagnosis data; 2 octets that are no block, a length is wrong: 7F 01")


@pytest.mark.parametrize("lie", ["00", "01", "40", "41", "05 01", "7F 00", "80 01", "BF"])
def test_a_block_that_lies_ends_the_blocks(lie: str) -> None:
    # H.2: "A length of 0/1 or beyond the telegram: stop parsing, show raw."
    diagnosis = decode("08 0C 00 02 09 59 04 10 20 30 " + lie)
    assert [type(block) for block in diagnosis.blocks] == [DeviceBlock]
    assert diagnosis.rest == bytes.fromhex(lie)


def likely_blocks() -> st.SearchStrategy[bytes]:
    """Octets that are more often blocks than chance makes them, whole and cut short."""
    header = st.sampled_from([2, 4, 5, 9, 0x42, 0x44, 0x81, 0xC1, 0x3F, 0])
    pieces = st.builds(lambda first, rest: bytes([first]) + rest, header, st.binary(max_size=9))
    return st.lists(pieces, max_size=30).map(lambda parts: b"".join(parts)[:244])


@given(st.binary(max_size=244) | likely_blocks(), st.booleans())
def test_no_octets_are_lost_or_made_up(octets: bytes, dpv1: bool) -> None:
    blocks, rest = decode_blocks(octets, dpv1)
    assert b"".join(block.octets for block in blocks) + rest == octets
    tables = DiagnosisTables(bits={0: "a", 24: "b"}, clear_bits={1: "c"}, areas=(DiagnosisArea(3, 12, {7: "d"}),))
    for block in blocks:
        assert str(block)
        assert block.explain(tables)
    if len(octets) >= 6:
        diagnosis = Diagnosis(octets, dpv1=dpv1)
        assert b"".join(block.octets for block in diagnosis.blocks) + diagnosis.rest == diagnosis.extended
        assert str(diagnosis)


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
