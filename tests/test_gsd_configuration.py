# SPDX-License-Identifier: MIT
"""From a GSD file to a station: configuration octets, the map of inputs and outputs, user parameters, limits.

The octets expected of the makers' files were counted by hand in the files' text: constants first, then each reference's bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
from gsd_files import load, needs_files

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
