# SPDX-License-Identifier: MIT
"""Reading GSD files: the syntax with all that makers do to it, what is found wrong, and the makers' own files."""

from __future__ import annotations

import contextlib
import json
import random
import time
from pathlib import Path

import pytest
from gsd_files import NAMES, load, needs_files, path
from hypothesis import given, settings
from hypothesis import strategies as st

from dpmaster import ConfigurationError, DPError, identifier
from dpmaster.cli.gsd import as_object
from dpmaster.diagnosis import DeviceBlock
from dpmaster.gsd import GSD, Severity, variants

# What is wrong in the makers' files, as a person finds it: the index's odd ones that are more than unusual.
BROKEN = {
    "mini.gsd": ["Ident_Number is missing", "Vendor_Name is missing", "Model_Name is missing", "GSD_Revision is missing",
                 "supports no rate"],
    "siem8037.gsd": ["GSD_Revision is missing"],
    "siem8045.gsd": ["GSD_Revision is missing"],
    "AVR_C0DE.GSD": ["PrmText was given in line 10 already"],
    "STM32F411_Profibus.gsd": ["PrmText was given in line 8 already"],
    "SI0180E0.GSG": ["characters were lost"],
    "lego0005.gsd": ["MaxTsdr 10 Tbit"],
    "SIEM8008.GSE": ["Unit_Diag_!Bit is read as Unit_Diag_Not_Bit"],
    "SIEM8031.GSE": ["Unit_Diag_!Bit is read as Unit_Diag_Not_Bit"],
    "SIEM8060.GSD": ["24V Pins is read as 24V_Pins"],
}


@needs_files
@pytest.mark.parametrize("name", NAMES)
def test_a_makers_file_is_read(name: str) -> None:
    gsd = load(name)
    assert gsd.modules and len(gsd.findings) < 50
    wrong = [str(found) for found in gsd.findings if found.severity is not Severity.NOTE]
    expected = BROKEN.get(name, [])
    assert [text for text in expected if not any(text in found for found in wrong)] == []
    assert [found for found in wrong if not any(text in found for text in expected)] == []


@needs_files
def test_every_module_of_every_file_decodes_and_encodes_to_its_own_octets() -> None:
    seen = 0
    for name in NAMES:
        for module in load(name).modules:
            assert identifier.encode(identifier.decode(module.configuration)) == module.configuration, (name, module.name)
            seen += 1
    assert seen > 4600


# ---- the syntax


def parse(text: str, **options: object) -> GSD:
    """A section with these lines, and what every file has."""
    head = 'Ident_Number = 0x1234\nVendor_Name = "V"\nModel_Name = "M"\nGSD_Revision = 5\n500_supp = 1\n'
    return GSD.parse(f'#Profibus_DP\n{head}{text}\nModule = "m" 0x10\n1\nEndModule\n', **options)  # type: ignore[arg-type]


def texts(gsd: GSD) -> list[str]:
    return [str(finding) for finding in gsd.findings]


def test_the_head_of_these_tests_is_in_order() -> None:
    gsd = parse("")
    assert (gsd.ident_number, gsd.title, gsd.baudrates, gsd.findings) == (0x1234, "V M", (500_000,), [])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\r\r\n"])
def test_every_end_of_a_line_is_one(end: str) -> None:
    """protocol page M.3: CRLF from makers, CR CR LF in one file, no newline at the end of 36."""
    lines = ["; text before", "#Profibus_DP", 'Vendor_Name = "V"', "bad line here", "FMS_supp = 1"]
    gsd = GSD.parse(end.join(lines))
    assert (gsd.vendor, gsd.fms) == ("V", True)
    (bad,) = [finding for finding in gsd.findings if finding.line]
    assert (bad.line, bad.column, bad.severity) == (4, 1, Severity.NOTE)


@pytest.mark.parametrize("marker", ["#Profibus_DP", "#Profibus_DP   ; start", "#PROFIBUS_DP", "  #profibus_dp\t",
                                    "\ufeff#Profibus_DP", "# Profibus_DP", "; old\n#Profibus_DP"])
def test_the_marker_is_not_always_exact(marker: str) -> None:
    """protocol page M.3, and peers page: "a blank after `#Profibus_DP` empties the file"."""
    gsd = GSD.parse(f'FMS_supp = 1\n{marker}\nVendor_Name = "V"\n#Config_Software\nVendor_Name = "W"\n')
    assert (gsd.vendor, gsd.fms) == ("V", False)
    assert not any("#Profibus_DP" in text for text in texts(gsd))
    assert any("#Config_Software is not read" in text for text in texts(gsd))


def test_a_file_without_marker_is_read_from_its_beginning() -> None:
    gsd = GSD.parse('Vendor_Name = "V"')
    assert gsd.vendor == "V" and any("no line #Profibus_DP" in text for text in texts(gsd))


@pytest.mark.parametrize("text", [
    'User_Prm_Data = 1,2, \\\n3', 'User_Prm_Data = 1,2, \\   \n3', 'User_Prm_Data = 1,2,\\ ; two octets; "so far\n3 ; and one',
    "User_Prm_Data = \\\r\n1 \\\r\n,2\\\r\n, 3", "User_Prm_Data = 0x1,0x02,03;x",
])
def test_a_statement_goes_on_behind_a_backslash(text: str) -> None:
    """protocol page M.3: 356 lines have a comment behind it, 4 have blanks."""
    gsd = parse(text)
    assert (gsd.user_prm, gsd.findings) == (b"\1\2\3", [])


@pytest.mark.parametrize(("text", "expected"), [
    ('Info_Text = "one \\\ntwo"', "one two"), ('Info_Text = "one; \\ \ntwo; three" ; four', "one; two; three"),
    ('Info_Text = "one \\ ; behind it\ntwo"', "one two"), ('Info_Text = "C:\\dir\\x"', "C:\\dir\\x"),
    ('Info_Text="it\'s ü"', "it's ü"),
])
def test_a_text_goes_on_in_the_next_line(text: str, expected: str) -> None:
    """protocol page M.3: 1668 lines continue a string inside the quotes."""
    gsd = parse(text)
    assert (gsd.info, gsd.findings) == (expected, [])


def test_places_are_right_behind_continued_lines() -> None:
    gsd = parse('Info_Text = "one \\\ntwo"\n  FMS_supp = maybe')
    assert [(found.line, found.column, found.severity) for found in gsd.findings] == [(9, 3, Severity.ERROR)]


@pytest.mark.parametrize("keyword", ["Auto_Baud_Supp", "AUTO_BAUD_SUPP", "auto_baud_supp"])
def test_capitals_do_not_count(keyword: str) -> None:
    gsd = parse(f"{keyword}=1")
    assert gsd.auto_baud and not gsd.findings


@pytest.mark.parametrize(("text", "field", "value"), [
    ("Min_Slave_Interval = 5", "min_slave_interval", 5), ("Module_Offset = 1", "module_offset", 1),
    ("24V Pins = 2", "pins_24v", 2), ("AutoBaudSupp = 1", "auto_baud", True), ("Order_Number = \"x\"", "order_number", "x"),
])
def test_a_misspelled_keyword_is_read_and_found(text: str, field: str, value: object) -> None:
    gsd = parse(text)
    assert getattr(gsd, field) == value
    (finding,) = gsd.findings
    assert finding.severity is Severity.WARNING and " is read as " in finding.text


def test_a_keyword_that_nobody_knows_is_kept_and_a_near_one_is_named() -> None:
    gsd = parse("ETERDelay = 7, 8\nVendr_Name = \"x\"\nFoo(3) = -1")
    assert [(kept.keyword, kept.index, kept.value, kept.line) for kept in gsd.unknown] == [
        ("ETERDelay", None, "7, 8", 7), ("Vendr_Name", None, '"x"', 8), ("Foo", 3, "-1", 9)]
    assert [finding.severity for finding in gsd.findings] == [Severity.NOTE, Severity.WARNING, Severity.NOTE]
    assert "Vendor_Name is one" in gsd.findings[1].text


@pytest.mark.parametrize(("opens", "ends"), [("Foo = 1", "EndFoo"), ("Foo", "End_Foo"), ("Foo_Beg = 2", "Foo_End"),
                                             ("Foo", "Foo_End;")])
def test_an_unknown_block_is_kept_whole(opens: str, ends: str) -> None:
    gsd = parse(f'{opens}\nVendor_Name = "no"\n  7\nBar = 1 ; x\n{ends}\nFMS_supp = 1')
    (kept,) = gsd.unknown
    assert [inner.keyword or inner.value for inner in kept.content] == ["Vendor_Name", "7", "Bar"]
    assert gsd.vendor == "V" and gsd.fms and [finding.severity for finding in gsd.findings] == [Severity.NOTE]


def test_bare_semicolons_and_ends_with_one() -> None:
    gsd = GSD.parse('#Profibus_DP\n;\n;;\nModule = "a" 0x10;\n1;\nEndModule;\nModule="b"0x20\nEndModule ;x\n')
    found = [(module.name, module.configuration, module.reference) for module in gsd.modules]
    assert found == [("a", b"\x10", 1), ("b", b" ", None)]
    assert not [finding for finding in gsd.findings if finding.line]


def test_a_block_without_end_ends_where_something_stands_that_it_cannot_hold() -> None:
    gsd = parse('PrmText = 1\nText(0) = "off"\nModule = "a" 0x10\n5\nModule = "b" 0x20\nFMS_supp = 1\nEndPrmText')
    assert ([module.name for module in gsd.modules], gsd.prm_texts[1].texts, gsd.fms) == (["a", "b", "m"], {0: "off"}, True)
    assert [finding.line for finding in gsd.findings if finding.severity is Severity.ERROR] == [9, 11, 12, 13]


def test_the_first_of_two_counts() -> None:
    gsd = parse('FMS_supp = 1\nFMS_supp = 0\nUnit_Diag_Bit(0) = "a"\nUnit_Diag_Bit(0) = "b"\nRevision = "1"\nRevision = "1"')
    assert gsd.fms and gsd.bits == {0: "a"}
    assert [finding.line for finding in gsd.findings] == [8, 10]  # the same value twice is nothing to speak of


@pytest.mark.parametrize(("text", "part"), [
    ('Info_Text = "open', "no closing quote"), ("FMS_supp = 7", "0 or 1"), ("Max_Module = x", "a number is missing"),
    ("Unit_Diag_Bit = \"x\"", "a number in brackets"), ("Unit_Diag_Bit(a) = \"x\"", "an index is a number"),
    ("User_Prm_Data = 256", "from 0 to 255"), ("Info_Text = 1.0", "not in quotes"), ("EndModule", "ends nothing"),
    ("12", "no Module_Reference"), ('Module = 0x10', "a name in quotes"), ('Module = "x"', "0 octets of identifiers"),
    ('Module = "x" 0x41', "needs more octets"), ("Ident_Number = 70000", "already"), ("Max_Module = 1 2", "more follows"),
    ("Ext_User_Prm_Data_Ref(0) = 9", "no ExtUserPrmData 9"), ("Ext_User_Prm_Data_Const(236) = 1,2", "behind octet 236"),
    ("User_Prm_Data_Len = 2\nUser_Prm_Data = 1", "User_Prm_Data has 1 octets"), ("MaxTsdr_500 = 9999", "11 to 1023"),
    ('ExtUserPrmData = 1 "x"\nUnsigned8 9 0-5\nEndExtUserPrmData', "default 9 is not one of 0 to 5"),
    ('ExtUserPrmData = 1 "x"\nBit(0) 0-1\nEndExtUserPrmData', "the default is missing"),
    ('ExtUserPrmData = 1 "x"\nBit(40) 0 0-1\nEndExtUserPrmData', "numbered 0 to 31"),
    ('ExtUserPrmData = 1 "x"\nPrm_Text_Ref = 3\nEndExtUserPrmData', "no PrmText 3"),
    ('SlotDefinition\nSlot(1) = "s" 7 1,7\nEndSlotDefinition', "its default 7 is no module's reference"),
    ('ExtUserPrmData = 1 "x"\nUnsigned8 9 0-9\nBitArea(2-9) 0 0-1\nEndExtUserPrmData', "a type already, Unsigned8"),
    ("Unit_Diag_Bit(-1) = \"x\"", "a number in brackets"), ("SlotDefinition\nSlot(255) = \"s\" 1 1", "0 to 254"),
    ('SlotDefinition\nSlot(1) = "s" 1 2-9\nEndSlotDefinition', "none of those it allows"),
    ('Module = "a" 0x10\n7\nExt_Module_Prm_Data_Len = 238', "238, 0 to 237: not taken"),
    ('Module = "a" 0x10\n1\nEndModule', "is that of 'a' already"), ("Unit_Diag_Area = 5-999999999", "0 to 495"),
    ('Module = "a" 0x10\n7\nExt_Module_Prm_Data_Len = 1\nExt_User_Prm_Data_Const(0) = 1,2', "Ext_Module_Prm_Data_Len"),
])
def test_what_is_wrong_is_found(text: str, part: str) -> None:
    gsd = parse(text)
    found = [finding for finding in gsd.findings if part in finding.text]
    assert len(found) == 1 and found[0].severity is not Severity.NOTE
    assert gsd.modules[-1].name == "m"  # and the rest is read


def test_objects_that_are_dropped_leave_nothing_behind() -> None:
    """A second PrmText of one number is read and forgotten; what comes next is not taken for it."""
    gsd = parse("".join(f'PrmText = {n // 2}\nText(0) = "{n}"\nEndPrmText\n' for n in range(200)))
    assert [found.texts for found in gsd.prm_texts.values()] == [{0: f"{2 * n}"} for n in range(100)]
    assert all("PrmText was given" in text for text in texts(gsd)) and len(gsd.findings) == 100


def test_findings_are_bounded_and_errors_are_not_lost_among_notes() -> None:
    gsd = parse("".join(f"Foo{n} = 1\n" for n in range(2000)) + "Max_Module = x")
    assert len(gsd.findings) == 1000 + 1 + 1 and str(gsd.findings[-1]) == "note: and 1000 findings more"
    assert gsd.findings[-2].severity is Severity.ERROR and len(gsd.unknown) == 2000


def test_strict_makes_an_error_of_the_first_error() -> None:
    assert parse("FMS_supp = 7", strict=True).fms  # a warning
    with pytest.raises(ConfigurationError, match=r"^GSD:7:1: error: Max_Module: a number is missing"):
        parse("Max_Module = x", strict=True)


# ---- code pages


@pytest.mark.parametrize(("octets", "encoding", "text"), [
    ("Überlauf".encode("cp1252"), "cp1252", "Überlauf"), ("Überlauf größer".encode("cp437"), "cp437", "Überlauf größer"),
    ("Überlauf".encode(), "utf-8", "Überlauf"), (b"Overflow", "ascii", "Overflow"),
    (b"20 \xb5m \x81", "latin-1", "20 µm \x81"), (b"25 \xb0C \x85 warm", "cp1252", "25 °C \u2026 warm"),
])
def test_a_code_page_is_guessed_by_the_letters_that_come_out(octets: bytes, encoding: str, text: str) -> None:
    gsd = GSD.parse(b'#Profibus_DP\nInfo_Text = "' + octets + b'"\n')
    assert (gsd.encoding, gsd.info) == (encoding, text)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_says_it(encoding: str) -> None:
    assert GSD.parse('#Profibus_DP\nInfo_Text = "Ü"\n'.encode(encoding)).info == "Ü"


def test_a_code_page_can_be_told() -> None:
    octets = b'#Profibus_DP\nInfo_Text = "\x84\x94\x81"'
    assert GSD.parse(octets, encoding="cp437").info == "äöü"
    with pytest.raises(ConfigurationError, match="encoding 'cp9999'"):
        GSD.parse(octets, encoding="cp9999")


@needs_files
def test_language_variants_stand_beside_each_other() -> None:
    assert {language: found.name for language, found in variants(path("SI0180fd.gse")).items()} == {
        "English": "SI0180fd.gse", "French": "SI0180fd.gsf"}
    assert load("SI0180fd.gsf").language == "French" and load("mini.gsd").language == ""


@pytest.mark.parametrize("name", ["nothing.gsd", ".", "a\0b", "/dev/null"])
def test_a_path_that_is_no_file_is_one_clear_error(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="give the path of a GSD file"):
        GSD.load(str(tmp_path / name))


# ---- the model


def test_what_a_parameter_says() -> None:
    gsd = parse("""PrmText = 1
Text(0) = "off"
Text(1) = "on"
EndPrmText
ExtUserPrmData = 1 "bit"
Bit(7) 1 0-1
Prm_Text_Ref = 1
Changeable = 0
Visible = 0
EndExtUserPrmData
ExtUserPrmData = 2 "set"
BitArea(2-5) 3 0,3,5-7
EndExtUserPrmData
ExtUserPrmData = 3 "signed"
Signed16 -5 -32768-32767
EndExtUserPrmData
ExtUserPrmData = 4 "hex"
unsigned32 0x10 0x00-0xFFFFFFFF
EndExtUserPrmData
ExtUserPrmData = 5 "low"
Signed8 -3 -10--1
EndExtUserPrmData
ExtUserPrmData = 6 "one"
Bit(0) 0 0-0
EndExtUserPrmData""")
    assert not gsd.findings
    bit, area, signed, unsigned, low, one = gsd.parameters.values()
    assert (bit.first, bit.default, bit.texts, bit.changeable, bit.visible) == (7, 1, {0: "off", 1: "on"}, False, False)
    assert (area.first, area.last, area.default, area.ranges) == (2, 5, 3, [(0, 0), (3, 3), (5, 7)])
    assert (signed.default, signed.ranges, signed.octets) == (-5, [(-32768, 32767)], 2)
    assert (unsigned.type, unsigned.default, unsigned.ranges) == ("Unsigned32", 16, [(0, 0xFFFFFFFF)])
    assert (low.default, low.ranges) == (-3, [(-10, -1)])
    assert (one.ranges, one.allows(0), one.allows(1)) == ([(0, 0)], True, False)


@needs_files
def test_rare_blocks_of_the_makers_files() -> None:
    coupler = load("SI028131.GSD")
    (area,) = coupler.modules[0].data_areas
    assert (area.name, area.related_identifier, area.length, area.consistency, area.data_types) == ("Inputs", 1, 5, 1, [8, 5])
    assert coupler.modules[0].preset and coupler.fixed_presets and coupler.unknown[0].keyword == "DS248_FCT"
    assert coupler.types[130].areas[0].values[2] == "Slot 1: incorrect module"
    assert coupler.channel_errors[27] == "signal level bad"
    wago = load("B756_P33.GSD")
    safe = next(module for module in wago.modules if module.reference == 6600)
    assert (safe.f_prm_length, safe.f_param_crc, safe.f_io_crc) == (14, 48590, 55196)
    assert safe.f_references[0] == (2, 150) and safe.f_constants == [(0, bytes([14, 5]) + bytes(12))]
    assert wago.types[129].areas[0].values[0x09] == "Generic error"
    assert wago.areas[0].values[0x1007] == "16. Terminal not supported"
    samson = load("SAMS071D.gsd")
    assert [(entry.number, entry.reaction_delay) for entry in samson.interfaces] == [(0, {45450: 0, 93750: 0}), (1, {31250: 0})]
    assert (samson.slots[1].default, samson.slots[1].allows(8), samson.slots[1].allows(9)) == (1, True, False)
    et200u = load("SIEM8008.GSE")
    assert (et200u.bits[0], et200u.not_bits[0]) == ("Slow_Mode Active", "Slow_Mode Inactive")
    assert load("pa05B312.gsd").bit_helps[61] == "Check installation."


def test_a_jokerblock_is_kept_as_it_stands() -> None:
    gsd = parse("Jokerblock_Type = 3\nJokerblock_Slot = 2\nPhysical_Interface = 1\nEnd_Jokerblock_Type")
    (block,) = gsd.jokerblocks
    assert (block.value, [inner.keyword for inner in block.content]) == ("3", ["Jokerblock_Slot", "Physical_Interface"])
    assert not gsd.findings and not gsd.unknown


# ---- however long, whatever it is


@needs_files
def test_1295_modules_are_read_in_a_blink() -> None:
    def seconds(text: str) -> float:
        begin = time.process_time()
        GSD.parse(text)
        return time.process_time() - begin

    whole = path("B756_P33.GSD").read_text()
    assert len(GSD.parse(whole).modules) == 1295
    quarter = whole[: whole.index("Module =", len(whole) // 4)]
    taken = min(seconds(whole) for _ in range(3))
    assert taken < 1.0 and taken < 12 * min(seconds(quarter) for _ in range(3))


HEAD = "#Profibus_DP\n"
JUNK = {
    "octets": lambda n: random.Random(n).randbytes(n),
    "characters": lambda n: "".join(random.Random(n).choices('abX_019 \\;"=(),-#\n', k=n)),
    "quotes": lambda n: HEAD + '"' * n,
    "escapes": lambda n: HEAD + '"' + "\\;" * (n // 2),
    "continued": lambda n: HEAD + 'A="' + "\\\n" * (n // 2),
    "blanks": lambda n: HEAD + 'A="' + "\\   " * (n // 4),
    "brackets": lambda n: HEAD + "(" * n,
    "words": lambda n: HEAD + "a " * (n // 2),
    "digits": lambda n: HEAD + "A=" + "1" * n,
    "returns": lambda n: "\r" * n,
    "ends": lambda n: "a" * n + "_End",
    "lines": lambda n: HEAD + "".join(f"Foo{i} = 1\n" for i in range(n // 10)),
    "blocks": lambda n: HEAD + "PrmText=1\n" * (n // 10),
    "modules": lambda n: HEAD + 'Module="a" 0x10\n' * (n // 16),
    "octet lists": lambda n: HEAD + 'Module="a" ' + "0x10," * (n // 5),
    "references": lambda n: HEAD + 'ExtUserPrmData=1 "a"\n' + "Ext_User_Prm_Data_Ref(0)=1\n" * (n // 27),
}


@pytest.mark.parametrize("kind", JUNK)
def test_junk_of_ten_times_the_length_takes_ten_times_the_time(kind: str) -> None:
    """Not a hundred times: a factor of 40 is room for a busy machine. 10 MB take seconds, by the same line."""
    def seconds(n: int) -> float:
        junk = JUNK[kind](n)
        begin = time.process_time()
        GSD.parse(junk)
        return time.process_time() - begin

    short = max(min(seconds(5_000) for _ in range(3)), 0.001)
    assert min(seconds(50_000) for _ in range(2)) < 40 * short


GRAMMAR = '''#Profibus_DP
PrmText = 1
Text(0) = "off"
EndPrmText
ExtUserPrmData = 1 "p"
Bit(3) 1 0-1
BitArea(2-9) 5 0-7
Signed16 -1 -32768-32767
Unsigned32 0
Prm_Text_Ref = 1
EndExtUserPrmData
Module = "m" 0xC1,0x81,0x83,0x10
Module = "e" 0x00
1
Preset = 1
Ext_Module_Prm_Data_Len = 3
Ext_User_Prm_Data_Const(0) = 1,2,3
Ext_User_Prm_Data_Ref(1) = 1
EndModule
FixPresetModules = 1
SlotDefinition
Slot(1) = "s" 1 1-3
EndSlotDefinition
UnitDiagType = 130
X_Unit_Diag_Area = 24-25
X_Value(1) = "x"
X_Unit_Diag_Area_End
EndUnitDiagType
DPV1_Slave = 1
Max_User_Prm_Data_Len = 5
Modular_Station = 1
Data_Area_Beg
Data_Area_End
Physical_Interface = 0
Jokerblock_Type = 1
End_Jokerblock_Type
Foo = 1
EndFoo
User_Prm_Data = 1,2
500_supp = 1
Ext_User_Prm_Data_Const(99999999999) = 1
Ext_User_Prm_Data_Ref(99999999999) = 1
Ext_Module_Prm_Data_Len = 99999999999
Slot(99999999999) = "s" 1 1-99999999999
Text(-1) = "x"
Unit_Diag_Bit(-1) = "x"
Unit_Diag_Bit(99999999999) = "x"
User_Prm_Data_Len = 99999999999
Max_Module = 99999999999
x = "a \\
"'''
LINES = st.sampled_from(GRAMMAR.split("\n"))


@given(st.lists(st.one_of(LINES, LINES, st.text(max_size=20)), max_size=40).map("\n".join) | st.text() | st.binary())
@settings(max_examples=200)
def test_any_text_gives_a_model_and_findings(content: str | bytes) -> None:
    gsd = GSD.parse(content)
    assert gsd.modules or gsd.findings
    assert all(0 <= finding.line <= len(content) + 1 for finding in gsd.findings)
    json.dumps(as_object(gsd))
    with contextlib.suppress(DPError):
        configuration = gsd.configure()
        assert len(configuration.user_parameters) <= 237 and configuration.prm_blocks is not None
        for bits in range(8):
            configuration.texts.device(DeviceBlock(bytes([8, 1 << bits, 1, 255, 0, 3, 0, 0])))


@needs_files
def test_damaged_files_of_makers_give_a_model_and_findings() -> None:
    seed = random.randrange(1 << 32)
    print(f"seed {seed}")
    chance = random.Random(seed)
    whole = [path(name).read_bytes().decode("latin-1") for name in NAMES if path(name).stat().st_size < 20_000]
    for _ in range(100):
        text = chance.choice(whole)
        for _ in range(chance.randrange(1, 20)):
            at = chance.randrange(len(text))
            cut = chance.choice((0, 0, 1, 30))
            put = chance.choice(("", chr(chance.randrange(256)), GRAMMAR[chance.randrange(len(GRAMMAR)) :][:40]))
            text = text[:at] + put + text[at + cut :]
        gsd = GSD.parse(text)
        for modules in (None, chance.sample(gsd.modules, min(3, len(gsd.modules)))):
            with contextlib.suppress(DPError):
                configuration = gsd.configure(modules)
                for name, value in configuration.parameters.items():
                    if configuration.parameters.find(name).parameter.allows(configuration.parameters.defaults[name]):
                        configuration.parameters[name] = value
                configuration.texts.device(DeviceBlock(b"\t" + chance.randbytes(8)))
