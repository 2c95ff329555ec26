# SPDX-License-Identifier: MIT
"""From a GSD file to a station: configuration octets, the map of inputs and outputs, user parameters, limits.

The octets expected of the makers' files were counted by hand in the files' text: constants first, then each reference's bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
from gsd_files import load, needs_files

from dpmaster import ConfigurationError, Diagnosis, Master, Station, StationState
from dpmaster.diagnosis import DeviceBlock
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1, SIP3
from dpmaster.emulator.cards.generic import GenericSlave
from dpmaster.gsd import GSD, Configuration, Span, devices

ALL = (9600, 19200, 45450, 93750, 187500, 500_000, 1_500_000, 3_000_000, 6_000_000, 12_000_000)


@dataclass(frozen=True)
class Expected:
    """A makers' file as a person reads it, and a station made of it."""

    file: str
    vendor: str
    model: str
    ident: int
    modules: int
    slots: int
    rates: tuple[int, ...]
    user_parameters: str
    chosen: list[Any] | None = None
    parameters: dict[Any, Any] = field(default_factory=dict)


FILES = [
    # 1415: 19 constants, C0 = DPV1_Enable and Fail_Safe; module 8330: 80 21 00. Settings: bit 1 of octet 7, bit 3 of CB, bits
    # 0 to 2 of 43.
    Expected("B756_P33.GSD", "WAGO Kontakttechnik GmbH & Co.KG", "WAGO 750-833 (FW: 09 ...) PRO", 0xB756, 1295, 1, ALL,
             "C0 00 00 00 00 00 00 00 00 C3 42 C3 7F 00 01 00 00 00 00 80 21 00", [],
             {"Device Diagnosis": "disabled", "Process Data Representation": 0, "Response to PROFIBUS DP Failure":
              "Output image is stored"}),
    # 3006 and 3467: three presets, so the module is in slot 4, which is its [SlotNumber]. Wire break of group 2 is bit 2 of
    # octet 6, group 1's integration time bits 2 and 3 of AA, the lower limit a Signed16 at octet 15.
    Expected("SIEM801D.GSE", "SIEMENS", "ET 200M (IM153-1)", 0x801D, 114, 0, ALL,
             "40 20 00 15 5F 04 00 10 00 04 00 A2 19 19 19 19 7F FF FF FF 7F FF 80 00", ["6ES7 331-7KF00-0AB0        8AI"],
             {"Process Interrupt": 0, 4: {"Diag:wire break Chgr2": 1, "Meas:integration time(ms) Chgr1": 0,
                                          "Limit value channel 0: lower": -1}}),
    Expected("SIEM801A.GSE", "SIEMENS", "B-4/8AI-2      DP", 0x801A, 9, 0, ALL,
             "00 60 09 07 5F 04 00 02 00 00 13 5F 04 01 0E 80 A6 14 14 14 14 FF FE 00 00 00 00 00 00",
             ["Configuration 1:     8AI"],
             {"Upper Limit Value      CH 0": -2, "Limit Value Alarm": 1, "Integration Time       CH 2- 3": 1,
              "Display Measured Value": 0}),
    # 699: four presets, the module is in slot 5
    Expected("SIEM803D.GSE", "SIEMENS", "ET 200X 8DI-5  DP", 0x803D, 35, 0, ALL, "40 40 00 09 5F 05 01 04 01 05 23 23",
             ["6ES7 144-1GB30-0XB0 2AI   20mA"],
             {"Diagnostics Alarm": 0, 5: {"Format of the analog values": 1, "Interf. frequency suppression": 5,
                                          "Measurement type/area I0/1": 8995}}),
    # 1489: one preset of three octets, then the module of four
    Expected("SIEM8118.GSE", "SIEMENS", "ET200pro (IM154-1)", 0x8118, 44, 0, ALL,
             "C0 01 00 0C 21 00 00 00 02 00 00 00 00 00 00 20 01 00 40 21 02 04", ["6ES7 142-4BF00-0AA0 8DO DC24V"],
             {"Operation for ref.<>actual conf.": 1, "Submodule status": 1,
              2: {"Diagnosis short circuit to M": 1, "Behavior at CPU-STOP": 2, "Substitute value Q2": 1}}),
    Expected("siem8139.gsd", "SIEMENS AG", "DP/AS-i LINK Advanced", 0x8139, 24, 0, ALL,
             "C0 00 00 07 81 00 00 1C 00 00 FF 11", ["ASi-1: 1 Word In"],
             {"ASi-1: 1 Word In": {"AS-i Slave Address": "AS-i Slave Address = 17"}}),
    # 127: FF is the constant, eight bits whose default is 0 lie in it
    Expected("siem80a8.gse", "SIEMENS", "ET200R", 0x80A8, 2, 0, ALL, "00 00 00 08", None, {"channel type for i/o 3": 1}),
    Expected("lego0005.gsd", "KU Leuven", "LEGO Mindstorms NXT", 0x0005, 4, 0, (9600, 19200, 31250, 45450, 93750, 500_000),
             "05 00 20 08 40", ["8 bit Input Module", "8 bit Output Module"],
             {"HW version (High)": 5, "8 bit Output Module": {"Substitute value CH1": "1 - Active (High)",
                                                              "Substitute value CH7": "# - Keep last value"}}),
    Expected("abb_acs880_pb_slave.gsd", "ABB Oy", "ABB Drives FPBA-01 DP-V0", 0x0959, 22, 0, ALL,
             "00 00 08 1A 81 00 00 06 01 F4 04 7E" + " 00" * 16 + " FF FF", None,
             {"Fail Safe mode": 2, "Control-zero mode": 1, "Failsafe Timeout(0 = No timeout)": 500,
              "PZD10 Failsafe value": 65535}),
    Expected("SAMS071D.gsd", "SAMSON AG", "Positioner 373x-4", 0x071D, 10, 3, (31250, 45450, 93750),
             "80 00 08 05 41 00 00 00", [], {"Condensed Status": "Disabled"}),
    # 1349 is 0545h: it lies over the constants 04 and 035, which is 35
    Expected("pa05B312.gsd", "Profile Process Control Devices", "Pressure-type flow (PhyL 0)", 0xB312, 5, 4, ALL,
             "80 00 08 05 42 00 00 01 08 44 01 00 04 71 05 45 07 43 04 00 04 0E 01", [],
             {"Startup parameters": "Applied", "Unit (Pressure)": "bar", "4": {"Unit (Volume)": "L"}}),
    Expected("SI028131.GSD", "SIEMENS", "FDC 157-0", 0x8131, 2, 0, (31250, 45450), "C0 00 08 08 81 00 00 60 00 04 01", None,
             {"Redundancy mode": "ring redundancy", "status lifelist": "enable"}),
    Expected("wagob757.gsd", "WAGO Kontakttechnik GmbH", "WAGO 750-343", 0xB757, 168, 1,
             (9600, 19200, 93750, 187500, 500_000, 1_500_000, 3_000_000, 6_000_000, 12_000_000),
             "00 00 00 00 00 00 00 02 00 CB 53 00 00 00 01 00 00 00 00 80 2B 00", [],
             {"Process Data Representation": 1, "Response to K-Bus Failure": 2}),
    Expected("mini.gsd", "", "", 0, 1, 0, (), "12 34 00 00", None, {1: {"Substitude Value Channel 3": 0x1234}}),
    Expected("PRU_0CDA.GSD", "Texas Instruments Inc", "AM335x Evaluation Module (EVM)", 0x0CDA, 1, 0, ALL, "C0 00 00"),
    Expected("SIEM8060.GSD", "SIEMENS AG", "SIPOS 5 (1-kanalig 12MBaud)", 0x8060, 2, 0, ALL, "", ["PPO 2"]),
    Expected("AVR_C0DE.GSD", "ProFreeBus", "AVR Softslave", 0xC0DE, 10, 0, (45450,), "", ["1 Byte Input", "1 Byte Output"]),
]


@needs_files
@pytest.mark.parametrize("expected", FILES, ids=lambda expected: expected.file)
def test_a_makers_file_says_and_configures_what_a_person_reads_in_it(expected: Expected) -> None:
    gsd = load(expected.file)
    assert (gsd.vendor, gsd.model, gsd.ident_number or 0) == (expected.vendor, expected.model, expected.ident)
    assert (len(gsd.modules), len(gsd.slots), gsd.baudrates) == (expected.modules, expected.slots, expected.rates)
    configuration = gsd.configure(expected.chosen, expected.parameters)
    assert configuration.user_parameters.hex(" ") == expected.user_parameters.lower()


# ---- a file of our own, with one of everything


RACK = """#Profibus_DP
GSD_Revision = 5
Vendor_Name = "Test"
Model_Name = "Rack"
Ident_Number = 0x4242
9.6_supp = 1
500_supp = 1
12M_supp = 1
MaxTsdr_9.6 = 15
MaxTsdr_500 = 123
MaxTsdr_12M = 5000
MaxTsdr_1.5M = 150
Freeze_Mode_supp = 1
Fail_Safe = 1
Min_Slave_Intervall = 20
Modular_Station = 1
Max_Module = 4
Max_Input_Len = 20
Max_Output_Len = 8
Max_Data_Len = 24
Max_User_Prm_Data_Len = 12
PrmText = 1
Text(0) = "off"
Text(1) = "on"
EndPrmText
ExtUserPrmData = 1 "Redundancy mode"
Bit(3) 1 0-1
Prm_Text_Ref = 1
EndExtUserPrmData
ExtUserPrmData = 2 "Filter"
BitArea(4-6) 2 0,2,5-6
EndExtUserPrmData
ExtUserPrmData = 3 "Limit"
Signed16 -5 -32768-32767
EndExtUserPrmData
ExtUserPrmData = 4 "Fixed"
Unsigned8 7 7-7
Changeable = 0
EndExtUserPrmData
ExtUserPrmData = 5 "Channel"
Bit(0) 0 0-1
EndExtUserPrmData
ExtUserPrmData = 6 "Channel"
Bit(1) 0 0-1
EndExtUserPrmData
ExtUserPrmData = 7 "Wide"
BitArea(4-11) 0 0-255
EndExtUserPrmData
ExtUserPrmData = 8 "None"
Bit(0) 0 0-0
EndExtUserPrmData
Ext_User_Prm_Data_Const(0) = 0xFF, 0x81
Ext_User_Prm_Data_Ref(0) = 1
Ext_User_Prm_Data_Ref(0) = 2
Ext_User_Prm_Data_Ref(2) = 3
Unit_Diag_Bit(0) = "hot"
Unit_Diag_Bit(9) = "wet"
Unit_Diag_Not_Bit(1) = "not fed"
Unit_Diag_Area = 2-4
Value(5) = "phase lost"
Unit_Diag_Area_End
Channel_Diag(16) = "fuse"
Module = "In" 0x41, 0x83, 0x07
1
Channel_Diag(16) = "sensor fuse"
EndModule
Module = "Out 2" 0xE0
2
Ext_Module_Prm_Data_Len = 2
Ext_User_Prm_Data_Const(0) = 0x10, 0xF0
Ext_User_Prm_Data_Ref(1) = 5
Ext_User_Prm_Data_Ref(1) = 6
EndModule
Module = "Both" 0x72, 0x10
3
Ext_Module_Prm_Data_Len = 3
Ext_User_Prm_Data_Ref(0) = 7
Ext_User_Prm_Data_Ref(2) = 4
EndModule
Module = "Empty" 0x00
4
EndModule
"""


@pytest.fixture
def rack() -> GSD:
    gsd = GSD.parse(RACK)
    (finding,) = gsd.findings
    assert finding.text.startswith("MaxTsdr 5000 Tbit at 12000000 bit/s: 11 to 1023")
    return gsd


def test_the_map_of_inputs_and_outputs(rack: GSD) -> None:
    """protocol page G.2: 41 83 07 is 4 octets of consistent inputs, E0 one consistent word of outputs, 72 three words in and
    out."""
    configuration = rack.configure(["Both", "in", "out 2"])
    assert configuration.octets == bytes.fromhex("72 10 41 83 07 E0")
    assert (configuration.input_length, configuration.output_length) == (6 + 1 + 4, 6 + 2)
    assert [(place.slot, place.name, place.inputs, place.outputs) for place in configuration] == [
        (1, "Both", Span(0, 7), Span(0, 6)), (2, "In", Span(7, 4), Span(6, 0)), (3, "Out 2", Span(11, 0), Span(6, 2))]
    words, octet = configuration[1].identifiers
    assert words.inputs and words.outputs and octet.inputs
    assert (words.inputs.offset, words.inputs.unit, words.inputs.consistent, octet.inputs.offset) == (0, 2, False, 6)
    (word,) = configuration["Out 2"].identifiers
    assert word.outputs and (word.outputs.offset, word.slot) == (6, 4)
    (special,) = configuration["In"].identifiers
    assert special.inputs and (special.inputs.offset, special.inputs.consistent) == (7, True)
    assert (special.slot, special.specific) == (3, b"\7")


def test_slots_may_be_left_empty_and_named(rack: GSD) -> None:
    configuration = rack.configure([(2, "In"), [4, 2]], names={"Feed": 2})
    assert configuration.octets == bytes.fromhex("00 41 83 07 00 E0")
    assert configuration["feed"] is configuration[2] and configuration["in"] is configuration[2]
    assert [place.name for place in configuration] == ["(empty slot)", "Feed", "(empty slot)", "Out 2"]


@pytest.mark.parametrize(("setting", "value", "octets"), [
    ("Redundancy mode", "OFF", "a7 81 ff fb"), ("redundancy  mode ", 0, "a7 81 ff fb"),
    ("Redundancy mode", False, "a7 81 ff fb"), ("Filter", 5, "df 81 ff fb"), ("Filter", "0", "8f 81 ff fb"),
    ("Limit", -32768, "af 81 80 00"), ("Limit", 258, "af 81 01 02"),
])
def test_a_setting_changes_its_own_bits_and_no_other(rack: GSD, setting: str, value: object, octets: str) -> None:
    """Peers page: `Bit` cannot be cleared, `BitArea` wipes its neighbours, negative Signed16 refused. By default FF is AF here:
    bit 3 is 1, bits 4 to 6 are 2."""
    configuration = rack.configure(["In"])
    assert configuration.user_parameters.hex(" ") == "af 81 ff fb"
    configuration.parameters[setting] = value
    assert configuration.user_parameters.hex(" ") == octets
    assert list(configuration.parameters.changed) == [configuration.parameters.find(setting).name]


def test_reading_gives_texts_and_numbers(rack: GSD) -> None:
    parameters = rack.configure(["In"]).parameters
    assert dict(parameters) == {"Redundancy mode": "on", "Filter": 2, "Limit": -5}
    assert parameters["redundancy mode"] == "on" and "nothing" not in parameters and parameters.changed == {}


def test_a_modules_parameters_are_a_block_of_their_own(rack: GSD) -> None:
    """protocol page M.2: "one block of Ext_Module_Prm_Data_Len each, appended after the station block in slot order". A BitArea
    over bit 7 lies in a big-endian word: 4 to 11 with A5h is 0A 50."""
    configuration = rack.configure(["Both", "Out 2"], {"Limit": 0, 1: {"Wide": 0xA5}, "Out 2": {"Channel#2": True}})
    assert configuration.user_parameters.hex(" ") == "af 81 00 00 0a 50 07 10 f2"
    assert dict(configuration[2].parameters) == {"Channel#1": 0, "Channel#2": 1}


@pytest.mark.parametrize(("modules", "parameters", "text"), [
    (["Both"], {"Redundancy mode": "maybe"}, r"'Redundancy mode' = 'maybe': \"off\" \(0\), \"on\" \(1\)$"),
    (["Both"], {"Filter": 3}, "'Filter' = 3: 0, 2, 5 to 6$"), (["Both"], {"Limit": 40000}, "-32768 to 32767"),
    (["Both"], {"Limit": 1.5}, "1.5"), (["Both"], {"Limit": None}, "None"),
    (["Both"], {"Nothing": 1}, "'Redundancy mode', 'Filter'"),
    (["Both"], {1: {"Fixed": 8}}, "'Fixed' = 8: 7"), (["Out 2"], {1: {"Channel": 1}}, "'Channel#1', 'Channel#2'"),
    (["Both"], {7: {"Wide": 8}}, "no module 7: its slots are, 1 'Both'"), (["In"], {1: {"Wide": 8}}, "there is none"),
    (["Boht"], {}, "no module 'Boht': 'Both'"), ([9], {}, "no module 9"), ("Both", {}, "give a list of names"),
    ([("x", "Both")], {}, "a slot's number and a name"), ([(2, "In"), (2, "In")], {}, "slot 2 is taken by 'In'"),
    ([(0, "In")], {}, "slots begin with 1"), ([(10**9, "In")], {}, "end with 254"), (5, {}, "give a list of names"),
    (["In"] * 5, {}, "5 modules, and Max_Module is 4"), ([(5, "In")], {}, "5 modules"),
    (["Both", "Both", "Both"], {}, "21 octets of inputs, and Max_Input_Len is 20"),
    (["Out 2"] * 4 + ["Both"], {}, "Max_Module"), (["Both", "Out 2", "Out 2"], {}, "10 octets of outputs"),
    (["Both", "In", "In", "Out 2"], {}, None), (["Both", "Both"], {}, "12 octets of outputs, and Max_Output_Len is 8"),
    ([], {}, "no module is chosen; choose of 'In'"),
])
def test_what_is_not_allowed_is_named_with_what_is(rack: GSD, modules: Any, parameters: Any, text: str | None) -> None:
    if text is None:
        rack.configure(modules, parameters)
        return
    with pytest.raises(ConfigurationError, match=text):
        rack.configure(modules, parameters)


def test_user_parameters_fit_a_telegram() -> None:
    def station(modules: int) -> Configuration:
        text = RACK + f'Module = "Long" 0x10\n5\nExt_Module_Prm_Data_Len = {modules}\nEndModule'
        return GSD.parse(text.replace("Max_User_Prm_Data_Len = 12", limit)).configure(["Long"])

    limit = "Max_User_Prm_Data_Len = 237"
    assert len(station(233).user_parameters) == 237
    with pytest.raises(ConfigurationError, match="238 octets of user parameters, and a telegram holds 237"):
        station(234)
    limit = "Max_User_Prm_Data_Len = 12"
    assert len(station(8).user_parameters) == 12
    with pytest.raises(ConfigurationError, match="13 octets of user parameters, and Max_User_Prm_Data_Len is 12"):
        station(9)


def test_an_abandoned_setting_leaves_no_trace(rack: GSD) -> None:
    """What a watcher refuses is undone."""
    configuration = rack.configure(["In"])

    def refuse(octets: bytes) -> None:
        raise ConfigurationError("not now")

    configuration.watch(refuse)
    with pytest.raises(ConfigurationError, match="not now"):
        configuration.parameters["Limit"] = 1
    assert configuration.parameters["Limit"] == -5


# ---- slots and presets


SLOTS = """#Profibus_DP
Ident_Number = 1
Modular_Station = 1
Max_Module = 9
Module = "Nothing" 0x00
0
EndModule
Module = "A" 0x10
1
EndModule
Module = "B" 0x20
2
Preset = 1
EndModule
Module = "C" 0x30
3
Preset = 1
EndModule
"""


def test_slots_take_what_they_allow_and_hold_their_default() -> None:
    gsd = GSD.parse(SLOTS + 'SlotDefinition\nSlot(1) = "one" 1 1-2\nSlot(2) = "two" 0 0,3\nSlot(3) = "three" 3 1,3\n'
                    "EndSlotDefinition")
    assert gsd.default_modules() == [] and gsd.configure().octets == b"\x10\x00\x30"
    assert gsd.configure(["B", "C"]).octets == b"\x20\x30\x30"
    assert gsd.configure([(2, "C"), (5, "A")]).octets == b"\x10\x30\x30\x00\x10"
    with pytest.raises(ConfigurationError, match="slot 2 'two' does not take 'A': it takes 'Nothing', 'C'"):
        gsd.configure(["A", "A"])


def test_fixed_presets_stay_in_the_first_slots() -> None:
    gsd = GSD.parse(SLOTS + "FixPresetModules = 1")
    assert gsd.configure().octets == gsd.configure([]).octets == b"\x20\x30"
    for modules in (["A"], ["B", "C", "A"], [(3, "A")]):
        assert gsd.configure(modules).octets == b"\x20\x30\x10"
    with pytest.raises(ConfigurationError, match="slot 1 is taken by 'B'"):
        gsd.configure([(1, "A")])
    assert GSD.parse(SLOTS).configure(["A"]).octets == b"\x10"  # presets that are not fixed are only a proposal


def test_modules_of_one_name_are_told_apart_by_their_references() -> None:
    gsd = GSD.parse(SLOTS + 'Module = "A" 0x11\n7\nEndModule')
    with pytest.raises(ConfigurationError, match="2 modules 'A': give one by its reference, 1, 7"):
        gsd.configure(["A"])
    assert gsd.configure([7]).octets == b"\x11"


def test_what_tools_call_slotnumber_is_the_slots_number() -> None:
    """Two makers' files have it in the slot's octet of a structured block, with a default of 1 for each slot."""
    gsd = GSD.parse(SLOTS + 'ExtUserPrmData = 1 "[SlotNumber]"\nUnsigned8 1 1-11\nEndExtUserPrmData\nModule = "P" 0x10\n'
                    "Ext_Module_Prm_Data_Len = 2\nExt_User_Prm_Data_Ref(1) = 1\nEndModule")
    configuration = gsd.configure([(2, "P"), (3, "P")])
    assert configuration.user_parameters == bytes([0, 2, 0, 3]) and configuration[3].parameters.changed == {}


# ---- DP-V1 octets and old files


DPV1 = "#Profibus_DP\nIdent_Number = 1\nDPV1_Slave = 1\nModule = \"m\" 0x10\nEndModule\n"


@pytest.mark.parametrize(("lines", "options", "octets"), [
    ("", {}, "00 00 00"), ("", {"dpv1": True}, "80 00 00"), ("C1_Read_Write_supp = 1", {}, "80 00 00"),
    ("C1_Read_Write_supp = 1", {"dpv1": False}, "00 00 00"), ("Fail_Safe = 1", {}, "40 00 00"),
    ("Fail_Safe = 1", {"fail_safe": False}, "00 00 00"), ("User_Prm_Data = 0x80", {}, "80 00 00"),
    ("Ext_User_Prm_Data_Const(0) = 0x84,0x01,0x08,0x55", {}, "80 01 08 55"), ("Prm_Block_Structure_req = 1", {}, "00 00 08"),
    ("Diagnostic_Alarm_required = 1", {}, "00 20 00"),
    ("Process_Alarm_supp = 1\nPull_Plug_Alarm_supp = 1", {"alarms": ["process", "pull_plug"]}, "00 c0 00"),
    ("C1_Read_Write_supp = 1\nExtUserPrmData = 1 \"DPV1\"\nBit(7) 0 0-1\nEndExtUserPrmData\nExt_User_Prm_Data_Ref(0) = 1", {},
     "00 00 00"),
])
def test_the_status_octets_of_dpv1(lines: str, options: dict[str, Any], octets: str) -> None:
    """protocol page G.1. Peers page: "DPV1 without user parameters refused": there are three octets always. WD_Base_1ms (04) is
    never sent, as the factors count 10 ms; bits that the file makes a parameter of are the parameter's."""
    configuration = GSD.parse(DPV1 + lines).configure(**options)
    assert configuration.user_parameters.hex(" ") == octets
    assert configuration.dpv1 == (octets[0] in "8c")


def test_an_alarm_that_a_slave_does_not_have() -> None:
    with pytest.raises(ConfigurationError, match="has no 'status': it has process"):
        GSD.parse(DPV1 + "Process_Alarm_supp = 1").configure(alarms=["status"])


@pytest.mark.parametrize(("lines", "octets"), [
    ("User_Prm_Data_Len = 3\nUser_Prm_Data = 1,2,3", "01 02 03"), ("User_Prm_Data = 1\nMax_User_Prm_Data_Len = 3", "01"),
    ("User_Prm_Data = 1,2,3\nExt_User_Prm_Data_Const(1) = 9", "00 09"), ("", ""),
])
def test_old_user_parameters_count_where_there_are_no_new_ones(lines: str, octets: str) -> None:
    text = f'#Profibus_DP\nIdent_Number = 1\n{lines}\nModule = "m" 0x10\nEndModule\n'
    assert GSD.parse(text).configure().user_parameters.hex(" ") == octets


@needs_files
def test_structured_parameters_are_blocks() -> None:
    """protocol page G.1: length, type, slot, reserved, data. pa05B312.gsd gives the blocks 66, 68 and, for slot 4, 67."""
    blocks = load("pa05B312.gsd").configure().prm_blocks
    assert [(block.type, block.slot, block.data.hex()) for block in blocks] == [
        (66, 0, "00"), (68, 1, "046d0545"), (67, 4, "040a01")]


# ---- texts


def test_diagnosis_in_the_makers_words(rack: GSD) -> None:
    """Unit_Diag_Bit(0) is the first bit behind the header; bits 2 to 4 of 15h are 5, bit 1 is clear."""
    texts = rack.configure(["Both", "In"]).texts
    said = Diagnosis(bytes.fromhex("08 04 00 02 42 42 04 15 02 00 42 04 82 41 B0")).explain(texts)
    assert said[1:] == ("device diagnosis: hot; not fed; phase lost; wet", "diagnosis in module 2 (In)",
                        "module 2 (In), input channel 1 (word): sensor fuse")
    assert Diagnosis(bytes.fromhex("08 04 00 02 42 42 81 41 B0")).explain(texts)[1].endswith(": fuse")


@needs_files
def test_a_status_is_read_by_its_type() -> None:
    """SI028131.GSD: in a module status (82h) bits 24 and 25, the first two behind the specifier, are slot 1; 2 is a wrong
    module."""
    gsd = load("SI028131.GSD")
    assert gsd.texts.device(DeviceBlock(bytes.fromhex("05 82 00 00 02"))) == ("Slot 1: incorrect module",)
    assert gsd.texts.device(DeviceBlock(bytes.fromhex("05 81 00 00 02"))) == ()


# ---- a station


def test_a_station_takes_from_the_file_what_it_needs(rack: GSD) -> None:
    station = Station.from_gsd(rack, 7, ["Both", "Out 2"], {"Filter": 0}, name="rack", freeze=True)
    assert (station.address, station.ident_number, station.configuration) == (7, 0x4242, bytes.fromhex("72 10 E0"))
    assert (station.fail_safe, station.min_slave_interval, station.name, station.freeze) == (True, 20, "rack", True)
    assert station.max_tsdr == {9600: 37, 500_000: 123, 12_000_000: 1023}  # in what a Station takes; 1.5M is not supported
    station["Out 2"].parameters["Channel#1"] = 1
    assert station.user_parameters.hex(" ") == "8f 81 ff fb 00 00 07 10 f1"
    station.parameters["Redundancy mode"] = "off"
    assert station.user_parameters.hex(" ") == "87 81 ff fb 00 00 07 10 f1"


def test_what_the_program_says_goes_before_the_file(rack: GSD) -> None:
    station = Station.from_gsd(rack, 7, ["In"], fail_safe=False, max_tsdr={}, min_slave_interval=3)
    assert (station.fail_safe, station.max_tsdr, station.min_slave_interval) == (False, {}, 3)


@needs_files
def test_profisafe_is_kept_and_said_not_to_be_sent() -> None:
    configuration = load("B756_P33.GSD").configure([(2, "75x-660 8FDI/24V DC")])
    assert configuration.user_parameters.hex(" ").endswith("80 21 00 20 de 00")
    (note,) = configuration.notes
    assert note.startswith("slot 2, 75x-660 8FDI/24V DC, has PROFIsafe parameters")


@pytest.mark.parametrize(("options", "text"), [({"sync": True}, "sync=True: Test Rack can not"), ({"address": 126}, "126"),
                                               ({"modules": ["x"]}, "no module 'x'"), ({"nonsense": 1}, "nonsense")])
def test_a_station_that_cannot_be(rack: GSD, options: dict[str, Any], text: str) -> None:
    with pytest.raises((ConfigurationError, TypeError), match=text):
        Station.from_gsd(rack, **{"address": 7, "modules": ["In"], **options})


def test_a_station_needs_an_ident_number() -> None:
    with pytest.raises(ConfigurationError, match="no Ident_Number"):
        Station.from_gsd(GSD.parse('#Profibus_DP\nModule = "m" 0x10'), 7)


def test_modules_of_a_station_on_the_bus(rack: GSD) -> None:
    with Segment() as wire, Master(wire.port()) as master:
        identifiers = [module.configuration for module in map(rack.module, ("Both", "In", "Out 2"))]
        slave = wire.attach(GenericSlave(7, 0x4242, identifiers, user_parameters=(9, 9), fail_safe=True, freeze=True))
        station = master.add(Station.from_gsd(rack, 7, ["Both", "In", "Out 2"], names={"Drive": 3}))
        master.operate()
        station["Drive"].outputs = b"\x12\x34"
        station.wait_sent(station["Both"].update(4, b"\x56\x78"))
        assert station.outputs.hex() == "0000000056781234" and station["Drive"].outputs == b"\x12\x34"
        slave.inputs = bytes(range(1, 12))
        station.wait(lambda frame: frame.octets[-1] == 11, 5.0)
        assert station["both"].inputs == bytes(range(1, 8)) and station["In"].inputs == bytes([8, 9, 10, 11])
        assert station[3].inputs == b""
        for wrong in (lambda: station["Drive"].update(1, b"\0\0"), lambda: setattr(station["Drive"], "outputs", b"\0"),
                      lambda: station["In"].update(0, b"\0"), lambda: station["Nothing"]):
            with pytest.raises(ConfigurationError):
                wrong()


# ---- our own files


def test_our_own_files_hold_what_the_manuals_and_the_devices_page_say() -> None:
    assert devices.NAMES == ("si-p1", "si-p3", "vw3a3607")
    cards = {name: GSD.load(devices.path(name), strict=True) for name in devices.NAMES}
    assert all(card.findings == [] and card.baudrates == ALL for card in cards.values())
    assert [card.ident_number for card in cards.values()] == [0x00CA, 0x0ACF, 0x0E2F]
    sip1, sip3, altivar = cards.values()
    assert [module.configuration.hex(" ") for module in sip1.modules] == ["72", "5f 6f", "55 65"]
    assert sip1.max_tsdr[45450] == 250 and sip1.configure(["Basic data"]).user_parameters == b"" and not sip1.fail_safe
    assert [module.configuration.hex(" ") for module in sip3.modules[3:]] == [
        "f3 f1", "f3 f5", "f1", "f5", "f3 f9", "73 71", "73 75", "71", "75", "73 79"]
    ppo = sip3.configure(["PPO Type 2"])
    assert ppo.user_parameters == bytes.fromhex("40 01 00 01") and ppo.fail_safe and not ppo.dpv1
    assert sip3.texts.device(DeviceBlock(bytes.fromhex("05 81 00 00 01"))) == ("Undervoltage Condition",)
    assert [module.configuration.hex(" ") for module in altivar.modules] == ["f1", "f3 f1", "f3 f5", "f5", "f3 f7", "f3 ff"]
    telegram = altivar.configure(["Telegram 101"], {"Extended diagnosis": "on", 1: {"OCA3": 9001}})
    assert telegram.user_parameters.hex(" ") == "80 00 00 01 21 35 21 9a 23 29" + " 00" * 6 + " 0c 81 21 9c" + " 00" * 8
    with pytest.raises(ConfigurationError, match="there are those of si-p1, si-p3, vw3a3607"):
        devices.path("si-p2")


LISTINGS: dict[str, tuple[type[SIP1] | type[SIP3], dict[str, object]]] = {
    "si-p1": (SIP1, {  # SI-P1 manual, chapter 2, "GSD File"
        "model": "PROFIBUS-DP INTERFACE CARD SI-P1", "revision": "Version 3.3", "ident_number": 0x00CA,
        "hardware_release": "Version 1.3", "software_release": "Version 3.3", "implementation": "SPC3",
        "max_tsdr": dict(zip(ALL, (60, 60, 250, 60, 60, 100, 150, 250, 450, 800), strict=True)),
        "freeze": True, "sync": True, "auto_baud": True, "set_slave_add": False, "fail_safe": False, "min_slave_interval": 1,
        "max_diag_length": 6, "module_offset": 1, "max_user_prm_length": None, "dpv1": False}),
    "si-p3": (SIP3, {  # SI-P3 manual, chapter 8, "SI-P3 Device Data"
        "model": "PROFIBUS-DP INTERFACE CARD SI-P3", "revision": "V1.0", "ident_number": 0x0ACF, "hardware_release": "V1.0",
        "software_release": "V1.0", "implementation": "DPC31", "gsd_revision": 3, "slave_family": "3", "redundancy": False,
        "max_tsdr": dict(zip(ALL, (60, 60, 60, 60, 60, 100, 150, 250, 450, 800), strict=True)),
        "freeze": True, "sync": True, "auto_baud": True, "set_slave_add": True, "fail_safe": True, "min_slave_interval": 5,
        "max_diag_length": 11, "max_user_prm_length": 4, "dpv1": True, "data_types": True, "c1_read_write": False,
        "c2_read_write": True, "c2_max_data_length": 240, "c2_response_timeout": 100, "c2_read_write_required": False,
        "max_initiate_length": 52}),
}


@pytest.mark.parametrize("name", LISTINGS)
def test_figure_by_figure_the_manuals_listings_and_the_emulated_cards(name: str) -> None:
    kind, figures = LISTINGS[name]
    gsd, card = GSD.load(devices.path(name)), kind(5)
    figures |= {"vendor": "YASKAWA ELECTRIC", "protocol_ident": 0, "station_type": 0, "fms": False, "repeater_control": 2,
                "pins_24v": 0, "modular": True, "max_modules": 1, "max_inputs": 32, "max_outputs": 32, "max_data": 64}
    assert {figure: getattr(gsd, figure) for figure in figures} == figures
    assert (card.ident_number, card.sync, card.freeze, card.set_address, card.fail_safe, card.min_slave_interval,
            card.max_diagnosis, card.user_parameters[1]) == (
        gsd.ident_number, gsd.sync, gsd.freeze, gsd.set_slave_add, gsd.fail_safe, gsd.min_slave_interval,
        gsd.max_diag_length, gsd.max_user_prm_length or 0)
    assert card.configurations == tuple(module.configuration for module in gsd.modules)


def test_our_own_file_starts_its_emulated_card() -> None:
    with Segment() as wire, Master(wire.port()) as master:
        wire.attach(SIP1(5))
        station = master.add(Station.from_gsd(devices.path("si-p1"), 5, ["Extended Data 2"]))
        master.operate()
        assert station.state == StationState.DATA and len(station[1].inputs) == 12
