# SPDX-License-Identifier: MIT
"""Telegrams: golden octets, the three-valued decoder against a slow one, the encoder against the decoder, and the names."""

from __future__ import annotations

import io
import json
import pickle
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from slow_decoder import ED, SC, SD1, SD2, SD3, SD4, build, total, verdict

from dpmaster import errors
from dpmaster._core import ffi, lib
from dpmaster.cli import decode as cli
from dpmaster.cli import main
from dpmaster.telegram import Format, Rejected, Telegram, TelegramError, decode, decode_all

GOLDEN = [
    (int(row), bytes.fromhex(octets))
    for row, _, octets in (
        line.partition(" ") for line in (Path(__file__).parent / "telegrams.txt").read_text().splitlines() if line[0] != "#"
    )
]
ROW = dict(reversed(GOLDEN))  # the first telegram of a row
NAMES = {-reason: ffi.string(lib.dpm_reject_name(reason)).decode() for reason in range(1, lib.DPM_REJECT_COUNT)}


def c_decode(octets: bytes) -> int:
    """dpm_decode on a buffer of exactly these octets."""
    verdict: int = lib.dpm_decode(ffi.from_buffer("uint8_t[]", octets), len(octets), ffi.new("dpm_telegram *"))
    return verdict


def same_verdict(octets: bytes) -> None:
    fast, slow = c_decode(octets), verdict(octets)
    if isinstance(slow, int):
        assert fast == slow
    else:
        assert NAMES.get(fast) in slow


# --- golden octets -----------------------------------------------------------------------------------------------------

def test_the_page_is_here() -> None:
    assert len(GOLDEN) == 80
    assert {row for row, _ in GOLDEN} == set(range(1, 73)) - {6, 11, 13, 32, 33}  # shortened on the page


@pytest.mark.parametrize(("row", "octets"), GOLDEN)
def test_golden_telegrams_decode_and_encode_to_the_same_octets(row: int, octets: bytes) -> None:
    telegram, n = decode(octets)
    assert n == len(octets), f"protocol page B.4 #{row}"
    assert telegram.encode() == octets
    assert verdict(octets) == len(octets)


@pytest.mark.parametrize(("row", "octets"), GOLDEN)
def test_every_prefix_is_incomplete_and_nothing_behind_is_taken(row: int, octets: bytes) -> None:
    for n in range(len(octets)):
        assert c_decode(octets[:n]) == 0
    for behind in range(256):
        assert c_decode(octets + bytes([behind])) == len(octets)


@pytest.mark.parametrize(("row", "octets"), GOLDEN)
def test_one_flipped_bit_is_never_taken_for_another_telegram_of_that_length(row: int, octets: bytes) -> None:
    """Hamming distance 4 holds for what has FCS (protocol page B.1); a token has none, its delimiter alone is protected."""
    for bit in range(8 * len(octets)):
        wrong = bytearray(octets)
        wrong[bit // 8] ^= 1 << bit % 8
        if octets[0] != SD4 or bit < 8:
            assert c_decode(bytes(wrong)) <= 0


@pytest.mark.parametrize(("row", "line"), [
    (1, "FDL_Status 2 -> 5 FCB=0 FCV=0"),
    (2, "OK 5 -> 2 slave"),
    (5, "SRD_high 2 -> 5 FCB=1 FCV=0 Slave_Diag (60 <- 62)"),
    (8, "SC"),
    (9, "SRD_high 2 -> 5 FCB=1 FCV=1 Chk_Cfg (62 <- 62) [00 10 20]"),
    (15, "DL 2 -> 99 Slave_Diag (62 <- 60) [02 05 00 FF 0C DA]"),
    (23, "RS 8 -> 2"),
    (26, "SDN_high 1 -> 127 FCB=0 FCV=0 Global_Control (58 <- 62) [00 00]"),
    (35, "Token 2 -> 5"),
    (37, "OK 5 -> 2 master_not_ready"),
    (38, "OK 5 -> 2 master_ready"),
    (39, "OK 5 -> 2 master_in_ring"),
    (40, "Ident 2 -> 8 FCB=0 FCV=0"),
    (41, "SRD_high 2 -> 8 FCB=0 FCV=1 Data_Exchange [04 7F 00 00]"),
    (42, "DL 8 -> 2 Data_Exchange [02 37 00 00]"),
    (43, "DH 8 -> 2 Data_Exchange [02 37 00 00]"),
    (44, "SRD_high 2 -> 8 FCB=1 FCV=1 Data_Exchange"),
    (46, "SRD_high 2 -> 8 FCB=0 FCV=1 Data_Exchange [01 02 03 04 05 06 07 08]"),
    (48, "UE 8 -> 2"),
    (49, "RR 8 -> 2"),
    (50, "NR 8 -> 2"),
    (56, "SRD_high 2 -> 126 FCB=1 FCV=0 Set_Slave_Add (55 <- 62) [08 0A 35 00]"),
    (67, "SRD_low 2 -> 8 FCB=1 FCV=0 MS1 (51 <- 51) [5E 00 2F F0]"),
    (71, "SRD_low 1 -> 8 FCB=1 FCV=0 MS2_Initiate (49 <- 50) [57 00 00 00 00 64 01 00 00 00 00 00 00 02 00 02 00 00 00 00]"),
    (72, "SRD_low 1 -> 8 FCB=0 FCV=1 MS2_48 (48 <- 50) [48]"),
])
def test_a_telegram_in_words(row: int, line: str) -> None:
    assert decode(ROW[row])[0].describe() == line, f"protocol page B.4 #{row}"


def test_fields() -> None:
    assert decode(ROW[5])[0] == Telegram(da=5, sa=2, fc=0x6D, dsap=60, ssap=62, format=Format.SD2)
    assert decode(ROW[41])[0] == Telegram(da=8, sa=2, fc=0x5D, data=bytes.fromhex("047F0000"), format=Format.SD2)
    assert decode(ROW[35])[0] == Telegram(da=5, sa=2, format=Format.SD4)
    assert decode(ROW[8])[0] == Telegram(format=Format.SC)


# --- bad octets --------------------------------------------------------------------------------------------------------

REJECTED = [  # octets that are just enough to know, and why
    ("delimiter", "00"), ("delimiter", "16"), ("delimiter", "FF"),
    ("length", "68 02"), ("length", "68 FA"), ("length", "68 00"),
    ("length twice", "68 05 06"),
    ("second delimiter", "68 05 05 10"),
    ("FCS", "10 05 02 49 51"), ("FCS", "68 05 05 68 85 82 6D 3C 3E EF"),
    ("end delimiter", "10 05 02 49 50 17"), ("end delimiter", "68 05 05 68 85 82 6D 3C 3E EE 00"),
    ("address", "10 05 7F"), ("address", "68 05 05 68 85 FF"), ("address", "A2 05 7F"),
    ("address", "DC 7E"), ("address", "DC 02 7F"), ("address", "DC 82"),
    ("extension", "10 85"), ("extension", "10 05 82"), ("extension", "68 03 03 68 85"), ("extension", "68 04 04 68 85 82"),
    ("extension", "68 05 05 68 85 02 5D BC"),        # a SAP with one more behind it
    ("extension", "68 06 06 68 85 02 5D C1 41"),     # segment, segment
    ("extension", "68 06 06 68 85 02 5D C1 BC"),     # segment, SAP, one more
    ("extension", "68 05 05 68 85 82 5D C1"),        # DA's second octet leaves no room for SA's first
    ("extension", "68 05 05 68 85 82 5D 3C C1"),     # the chain runs past the data
]


@pytest.mark.parametrize(("reason", "text"), REJECTED)
def test_each_reason_is_given_by_the_first_octet_that_cannot_be_right(reason: str, text: str) -> None:
    octets = bytes.fromhex(text)
    assert c_decode(octets[:-1]) == 0
    assert NAMES[c_decode(octets)] == reason
    same_verdict(octets)
    with pytest.raises(TelegramError, match=reason) as caught:
        decode(octets)
    assert caught.value.reason == reason
    assert isinstance(caught.value, errors.DPError)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize("octets", ["", "68", "68 05 05 68 85 82 6D 3C 3E EE", "DC 02"])
def test_too_few_octets_are_incomplete(octets: str) -> None:
    assert c_decode(bytes.fromhex(octets)) == 0
    with pytest.raises(TelegramError, match="incomplete"):
        decode(bytes.fromhex(octets))


def test_limits_of_le() -> None:
    """LE 3..249 is accepted, though 3 is an SD1's business (protocol page B.1)."""
    assert decode(build(SD2, 8, 2, 0x08))[0].data == b""
    assert decode(build(SD2, 8, 2, 0x5D, bytes(246)))[1] == 255


def test_addresses_on_the_edge() -> None:
    assert decode(build(SD1, 127, 126, 0x49))[0].da == 127
    assert decode(bytes([SD4, 125, 125]))[0].sa == 125


def test_segment_addresses() -> None:
    telegram, _ = decode(build(SD2, 0x85, 0x82, 0x5D, bytes([0xC1, 0x3C, 0x42, 0xAA])))
    assert telegram == Telegram(5, 2, 0x5D, b"\xaa", dsap=60, dsegment=1, ssegment=2, format=Format.SD2)
    assert telegram.describe() == "SRD_high 2 -> 5 FCB=0 FCV=1 Slave_Diag (segment 1.60 <- segment 2) [AA]"


def test_an_sd3_counts_its_extensions_among_the_eight() -> None:
    octets = build(SD3, 0x88, 0x82, 0x5D, bytes([0x3D, 0x3E, 1, 2, 3, 4, 5, 6]))
    telegram, n = decode(octets)
    assert (n, telegram.dsap, telegram.ssap, telegram.data) == (14, 61, 62, bytes(range(1, 7)))
    assert telegram.encode() == octets


# --- against the slow decoder ------------------------------------------------------------------------------------------

DELIMITERS = [SD1, SD2, SD3, SD4, SC, ED]
octet = st.integers(0, 255) | st.sampled_from(DELIMITERS)


@st.composite
def good_telegrams(draw: st.DrawFn) -> bytes:
    """Good by construction, from raw octets: any address, any extension chain the rules allow, any data."""
    sd = draw(st.sampled_from([SD1, SD2, SD2, SD2, SD3, SD4, SC]))
    if sd in (SD4, SC):
        return build(sd, draw(st.integers(0, 125)), draw(st.integers(0, 125)))
    number = st.integers(0, 63)
    chains = st.just([]) if sd == SD1 else st.one_of(
        st.just([]), st.tuples(number), st.tuples(number.map(lambda s: s | 64)),
        st.tuples(number.map(lambda s: s | 192), number))
    to, by = list(draw(chains)), list(draw(chains))
    extensions = bytes(to + by)
    if sd == SD3:
        data = draw(st.binary(min_size=8 - len(extensions), max_size=8 - len(extensions)))
    else:
        data = b"" if sd == SD1 else draw(st.binary(max_size=20) | st.binary(max_size=246 - len(extensions)))
    da = draw(st.integers(0, 127)) | (128 if to else 0)
    sa = draw(st.integers(0, 126)) | (128 if by else 0)
    return build(sd, da, sa, draw(st.integers(0, 255)), extensions + data)


@given(st.lists(octet, max_size=24).map(bytes))
def test_same_verdict_on_arbitrary_octets(octets: bytes) -> None:
    same_verdict(octets)


@given(st.integers(3, 20).flatmap(lambda le: st.lists(octet, max_size=le + 2).map(
    lambda body: bytes([SD2, le, le, SD2, *body]))))
def test_same_verdict_on_arbitrary_octets_behind_a_good_head(octets: bytes) -> None:
    for n in range(len(octets) + 1):
        same_verdict(octets[:n])


@given(st.sampled_from([SD1, SD2, SD3]), st.lists(octet, min_size=3, max_size=12).map(bytes))
def test_same_verdict_on_bodies_with_a_good_sum(sd: int, body: bytes) -> None:
    """So that addresses and extensions are judged, not always the sum first."""
    same_verdict(build(sd, body[0], body[1], body[2], body[3:]))


@given(good_telegrams(), st.data())
def test_same_verdict_on_mutated_good_telegrams(octets: bytes, data: st.DataObject) -> None:
    assert c_decode(octets) == verdict(octets) == len(octets)
    at = data.draw(st.integers(0, len(octets) - 1))
    value = data.draw(octet)
    same_verdict(octets[:at] + bytes([value]) + octets[at + 1 :])  # changed
    same_verdict(octets[:at] + octets[at + 1 :])  # lost
    same_verdict(octets[:at] + bytes([value]) + octets[at:])  # inserted
    same_verdict(octets[:at] + octets[at : at + 1] + octets[at:])  # doubled


# --- encoder -----------------------------------------------------------------------------------------------------------

@given(good_telegrams())
def test_what_is_decoded_encodes_to_the_same_octets(octets: bytes) -> None:
    telegram, _ = decode(octets)
    if octets[0] == SD2 and octets[1] == 3:
        with pytest.raises(errors.ConfigurationError):  # LE 3 is accepted, never sent
            telegram.encode()
    else:
        assert telegram.encode() == octets


side = st.none() | st.integers(0, 64)


@given(st.builds(
    Telegram, da=st.integers(0, 129), sa=st.integers(0, 129), fc=st.integers(0, 255),
    data=st.binary(max_size=9) | st.binary(min_size=240, max_size=248), dsap=side, ssap=side, dsegment=side, ssegment=side,
    format=st.none() | st.sampled_from(Format)))
def test_what_is_encoded_decodes_to_the_same_fields_or_is_refused(telegram: Telegram) -> None:
    try:
        octets = telegram.encode()
    except errors.ConfigurationError:
        return
    again, n = decode(octets)
    assert n == len(octets)
    chosen = telegram.format or (Format.SD2 if octets[0] == SD2 else Format.SD1)
    assert again == Telegram(telegram.da, telegram.sa, telegram.fc, telegram.data, telegram.dsap, telegram.ssap,
                             telegram.dsegment, telegram.ssegment, chosen)


@pytest.mark.parametrize("telegram", [
    Telegram(da=128), Telegram(sa=127), Telegram(da=-1), Telegram(fc=256), Telegram(dsap=64), Telegram(ssap=-1),
    Telegram(data=bytes(247)), Telegram(data=bytes(245), dsap=1, ssap=2),
    Telegram(format=Format.SD1, data=b"\0"), Telegram(format=Format.SD1, dsap=60),
    Telegram(format=Format.SD2), Telegram(format=Format.SD3, data=bytes(7)), Telegram(format=Format.SD3, data=bytes(8), dsap=1),
    Telegram(format=Format.SD4, da=126), Telegram(format=Format.SD4, fc=0x49), Telegram(format=Format.SD4, data=b"\0"),
    Telegram(format=Format.SC, da=1), Telegram(format=Format.SC, data=b"\0"),
])
def test_what_the_decoder_would_not_give_back_is_refused(telegram: Telegram) -> None:
    with pytest.raises(errors.ConfigurationError):
        telegram.encode()


def test_the_encoder_keeps_to_the_room_it_is_given() -> None:
    """It needs exactly as many octets as it writes and never touches one behind them."""
    for _, octets in GOLDEN:
        raw = ffi.new("dpm_telegram *")
        source = ffi.from_buffer("uint8_t[]", octets)
        assert lib.dpm_decode(source, len(octets), raw) == len(octets)
        out = ffi.new("uint8_t[]", b"\xa5" * 300)
        assert lib.dpm_encode(raw, out, len(octets) - 1) == lib.DPM_E_LENGTH
        assert bytes(ffi.buffer(out, 300)) == b"\xa5" * 300
        assert lib.dpm_encode(raw, out, len(octets)) == len(octets)
        assert bytes(ffi.buffer(out, 300)) == octets + b"\xa5" * (300 - len(octets))


def test_only_a_good_telegram_is_written() -> None:
    raw = ffi.new("dpm_telegram *", {"da": 99, "length": 7})
    for text in ("68 05 05 68 85 82 6D 3C 3E", "10 05 02 49 51 16", "DC 7E 02", "00"):
        octets = bytes.fromhex(text)
        assert lib.dpm_decode(octets, len(octets), raw) <= 0
        assert (raw.da, raw.length) == (99, 7)


def test_no_data_is_an_sd1_and_data_an_sd2() -> None:
    """SD2 for eight octets too: some slaves drop SD3 (protocol page B.1)."""
    assert Telegram(da=8, sa=2, fc=0x7D).encode() == ROW[44]
    assert Telegram(da=8, sa=2, fc=0x5D, data=bytes(range(1, 9))).encode() == ROW[47]


# --- many telegrams ----------------------------------------------------------------------------------------------------

def test_decode_all_finds_telegrams_between_noise() -> None:
    octets = b"\x00\xff" + ROW[5] + ROW[8] + ROW[1][:-2] + b"\x51\x16" + ROW[35] + ROW[41][:-1]
    found = list(decode_all(octets))
    assert [type(item) for item in found] == [Rejected, Telegram, Telegram, Rejected, Telegram, Rejected]
    assert [item.reason for item in found if isinstance(item, Rejected)] == ["delimiter", "FCS", "incomplete"]


@given(st.lists(good_telegrams() | st.lists(octet, max_size=8).map(bytes), max_size=6).map(b"".join))
def test_decode_all_leaves_no_octet_out(octets: bytes) -> None:
    at = 0
    for item in decode_all(octets):
        if isinstance(item, Rejected):
            assert octets[at:].startswith(item.octets)
            n = len(item.octets)
        else:
            telegram, n = decode(octets[at:])
            assert telegram == item
        assert item.describe()
        at += n
    assert at == len(octets)


def test_sums_are_modulo_256() -> None:
    assert ROW[31][-2] == 0 == total(ROW[31][4:-2])  # protocol page B.4 #31: "FCS 00!"


def test_unknown_codes_have_names_too() -> None:
    assert ffi.string(lib.dpm_reject_name(lib.DPM_REJECT_COUNT)) == b"unknown"
    assert ffi.string(lib.dpm_strerror(1)) == ffi.string(lib.dpm_strerror(-1000)) == b"unknown error code"
    assert len({ffi.string(lib.dpm_strerror(-code)) for code in range(25)}) == 25


# --- command line ------------------------------------------------------------------------------------------------------

def run(*words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = main(["decode", *words])
    return code, capsys.readouterr().out


@pytest.mark.parametrize("words", [
    ("10 05 02 49 50 16 E5",), ("100502495016", "e5"), ("10:05:02:49:50:16", "E5"), ("0x10, 0x05,0x02 0x49 0x50 0x16 0xE5",),
])
def test_hex_in_the_ways_people_write_it(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*words, capsys=capsys) == (0, "SD1 FDL_Status 2 -> 5 FCB=0 FCV=0\nSC  SC\n")


def test_bad_octets_give_the_reason_and_exit_code_1(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = run("10 05 02 49 51 16", capsys=capsys)
    assert code == 1
    assert out.startswith("rejected, FCS: ") and out.endswith("[10 05 02 49 51 16]\n")


def test_json_has_the_fields(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = run("--json", ROW[5].hex(), "00", capsys=capsys)
    assert code == 1
    first, second = map(json.loads, out.splitlines())
    assert first | {"da": 5, "sa": 2, "fc": 0x6D, "dsap": 60, "ssap": 62, "format": "SD2", "function": "SRD_high", "fcb": True,
                    "fcv": False, "service": "Slave_Diag", "data": ""} == first
    assert second == {"rejected": "delimiter", "octets": "00"}


def test_standard_input(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("10 05 02\n49 50 16\n"))
    assert run("-", capsys=capsys)[0] == 0


@pytest.mark.parametrize("words", [("1",), ("xyz",), ("10 0502 4",), ("",)])
def test_what_is_no_hex_is_one_clear_error(words: tuple[str, ...]) -> None:
    with pytest.raises(errors.ConfigurationError, match="10 05 02 49 50 16"):
        cli.parse(" ".join(words))
