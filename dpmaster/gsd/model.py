# SPDX-License-Identifier: MIT
"""What a GSD file says, as objects: each field that a keyword fills names that keyword and the form of its value.

This is the one table of keywords: `reader.py` knows none that is not declared here. A field is None, empty or at its default
when the file does not have the keyword. Numbers are the file's own, in the units given; names follow the specification's, with
its two misspellings put right. Touches only the decoder of identifiers and errors.
"""

from __future__ import annotations

import difflib
import operator
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any

from dpmaster import identifier
from dpmaster.errors import ConfigurationError
from dpmaster.gsd.source import Finding

SLOT_MAX = 254  # as DP-V1 numbers them
USER_PRM_MAX = 237  # octets of User_Prm_Data in Set_Prm

RATES: dict[str, int] = {
    "9.6": 9600, "19.2": 19200, "31.25": 31250, "45.45": 45450, "93.75": 93750, "187.5": 187500, "500": 500_000,
    "1.5M": 1_500_000, "3M": 3_000_000, "6M": 6_000_000, "12M": 12_000_000,
}
"""Rates in bit/s by the name they have in keywords; 31.25 is that of MBP (PROFIBUS PA)."""


class Form(Enum):
    """How a keyword's value is written, and so the type of its field."""

    FLAG = "0 or 1"
    WHOLE = "a number"
    TEXT = "a text in quotes"
    RAW = "anything"
    OCTETS = "numbers from 0 to 255 with commas between them"
    TEXTS = "a number in brackets, and a text in quotes"
    CONSTANTS = "an offset in brackets, and numbers from 0 to 255 with commas between them"
    REFERENCES = "an offset in brackets, and a number"
    WHOLES = "a number; the keyword may stand several times"
    BY_RATE = "a number for each rate"
    RATE = "0 or 1 for each rate"


def keyword(name: str, form: Form, default: object = None) -> Any:
    """A field that `name` fills."""
    metadata = {"keyword": name, "form": form}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def flag(name: str) -> Any:
    return keyword(name, Form.FLAG, False)


# ---- parameters

_WIDTHS = {"unsigned8": 1, "unsigned16": 2, "unsigned32": 4, "signed8": 1, "signed16": 2, "signed32": 4}
TYPES: Mapping[str, str] = {name.lower(): name for name in (
    "Bit", "BitArea", "Unsigned8", "Unsigned16", "Unsigned32", "Signed8", "Signed16", "Signed32")}
"""The types of ExtUserPrmData, by their names in lower case."""


@dataclass(slots=True)
class PrmText:
    """Names for the values of parameters."""

    number: int
    texts: dict[int, str] = keyword("Text", Form.TEXTS, dict)


@dataclass(slots=True)
class Parameter:
    """One ExtUserPrmData: a value in the user parameters that a person may set."""

    number: int
    name: str
    type: str = "Unsigned8"
    """Bit, BitArea, Unsigned8, 16 or 32, Signed8, 16 or 32; 16 and 32 bits are big-endian."""
    first: int = 0
    """First bit of a Bit or BitArea; bit 0 is the least significant one of its octet, or of its word when `last` is over 7."""
    last: int = 0
    default: int = 0
    ranges: list[tuple[int, int]] = field(default_factory=list)
    """What is allowed, as ranges with both ends; empty: whatever the type holds."""
    text_reference: int | None = keyword("Prm_Text_Ref", Form.WHOLE)
    changeable: bool = keyword("Changeable", Form.FLAG, True)
    visible: bool = keyword("Visible", Form.FLAG, True)
    texts: dict[int, str] = field(default_factory=dict)
    """The values that have a name, out of the PrmText referred to."""

    @property
    def octets(self) -> int:
        """How many octets it lies in."""
        return _WIDTHS.get(self.type.lower(), self.last // 8 + 1)

    @property
    def limits(self) -> tuple[int, int]:
        """Least and greatest value that the type holds."""
        name = self.type.lower()
        bits = 8 * self.octets if name in _WIDTHS else self.last - self.first + 1
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if name.startswith("signed") else (0, (1 << bits) - 1)

    def allows(self, value: int) -> bool:
        low, high = self.limits
        return low <= value <= high and (not self.ranges or any(a <= value <= b for a, b in self.ranges))

    @property
    def allowed(self) -> str:
        """What may be set, for people: ``"off" (0), "on" (1)`` or ``1 to 254``."""
        named = [f'"{text}" ({value})' for value, text in self.texts.items() if self.allows(value)]
        ranges = [f"{a}" if a == b else f"{a} to {b}" for a, b in self.ranges or [self.limits]]
        if named and all(value in self.texts for a, b in self.ranges for value in range(a, min(b, a + 256) + 1)):
            ranges = []
        return ", ".join(named + ranges)

    def value(self, setting: object) -> int:
        """The number for `setting`: a text of its PrmText (capitals and blanks at the ends do not count), a number, a truth.

        Raises ConfigurationError that names what is allowed.
        """
        found: int | None = None
        if hasattr(setting, "__index__"):
            found = operator.index(setting)
        elif isinstance(setting, str):
            wanted = plain(setting)
            found = next((value for value, text in self.texts.items() if plain(text) == wanted), None)
            if found is None and wanted.removeprefix("-").isdecimal():
                found = int(wanted)
        if found is None or not self.allows(found):
            raise ConfigurationError(f"parameter {self.name!r} = {setting!r}: {self.allowed or 'nothing is allowed'}")
        return found

    def shown(self, value: int) -> str | int:
        """The value's text, or the value when it has none."""
        return self.texts.get(value, value)

    def put(self, octets: bytearray, offset: int, value: int) -> None:
        """Set its own bits at `offset` and leave all others as they are."""
        width = self.octets
        word = int.from_bytes(octets[offset : offset + width], "big")
        word = word & ~self.mask | value << self.first & self.mask
        octets[offset : offset + width] = word.to_bytes(width, "big")

    @property
    def mask(self) -> int:
        """Its bits in the number that its octets are, big-endian."""
        low, high = self.limits
        return (high - low) << self.first


def plain(name: str) -> str:
    """What names are compared by: small letters, and single blanks between words only."""
    return " ".join(name.split()).casefold()


@dataclass
class _Prm:
    constants: list[tuple[int, bytes]] = keyword("Ext_User_Prm_Data_Const", Form.CONSTANTS, list)
    """Offset in the block and octets; written first, in this order."""
    references: list[tuple[int, int]] = keyword("Ext_User_Prm_Data_Ref", Form.REFERENCES, list)
    """Offset in the block and number of the `Parameter` that lies there."""


# ---- diagnosis


@dataclass(slots=True)
class Area:
    """Unit_Diag_Area: bits `first` to `last` of a device-related block are one number."""

    first: int
    last: int
    values: dict[int, str] = keyword("Value", Form.TEXTS, dict)
    helps: dict[int, str] = keyword("Value_Help", Form.TEXTS, dict)


@dataclass
class _Bits:
    bits: dict[int, str] = keyword("Unit_Diag_Bit", Form.TEXTS, dict)
    """Texts of bits that are set. Bit 0 is the least significant one of the octet behind the block's header."""
    bit_helps: dict[int, str] = keyword("Unit_Diag_Bit_Help", Form.TEXTS, dict)
    not_bits: dict[int, str] = keyword("Unit_Diag_Not_Bit", Form.TEXTS, dict)
    """Texts of bits that are clear."""
    not_bit_helps: dict[int, str] = keyword("Unit_Diag_Not_Bit_Help", Form.TEXTS, dict)
    areas: list[Area] = field(default_factory=list)


@dataclass
class UnitDiagType(_Bits):
    """UnitDiagType: what the bits of one kind of alarm (1 to 126) or status (128 to 254) mean; the octet behind the header."""

    number: int = 0


@dataclass
class _Diagnosis(_Bits):
    types: dict[int, UnitDiagType] = field(default_factory=dict)
    channel_errors: dict[int, str] = keyword("Channel_Diag", Form.TEXTS, dict)
    """The maker's names for channel errors, 16 to 31 (and 9)."""
    channel_helps: dict[int, str] = keyword("Channel_Diag_Help", Form.TEXTS, dict)


# ---- modules


@dataclass(slots=True)
class DataArea:
    """Data_Area: what is known of a part of a module's data."""

    name: str = keyword("Area_Name", Form.TEXT, "")
    related_identifier: int | None = keyword("Related_CFG_Identifier", Form.WHOLE)
    """Which identifier of the module, from 1."""
    direction: int | None = keyword("IO_Direction", Form.WHOLE)
    """0 inputs, 1 outputs."""
    length: int | None = keyword("Length", Form.WHOLE)
    consistency: int | None = keyword("Consistency", Form.WHOLE)
    publisher_allowed: bool = flag("Publisher_Allowed")
    dp_master_allowed: bool = flag("DP_Master_Allowed")
    data_types: list[int] = keyword("Data_Type", Form.WHOLES, list)
    """1 Boolean, 2 to 4 Integer8, 16, 32, 5 to 7 Unsigned8, 16, 32, 8 Float, 9 Visible String, 10 Octet String."""


@dataclass
class Module(_Prm, _Diagnosis):
    """One Module: what can be plugged into a slot."""

    name: str = ""
    configuration: bytes = b""
    """Its identifiers for Chk_Cfg, one or several."""
    reference: int | None = None
    """Module_Reference, by which slots and tools name it."""
    preset: bool = flag("Preset")
    info: str = keyword("Info_Text", Form.TEXT, "")
    prm_length: int | None = keyword("Ext_Module_Prm_Data_Len", Form.WHOLE)
    """Octets of its block in the user parameters."""
    data_areas: list[DataArea] = field(default_factory=list)
    f_prm_length: int | None = keyword("F_Ext_Module_Prm_Data_Len", Form.WHOLE)
    """PROFIsafe, as all names with f_: kept, never sent; this master is no F-Host."""
    f_constants: list[tuple[int, bytes]] = keyword("F_Ext_User_Prm_Data_Const", Form.CONSTANTS, list)
    f_references: list[tuple[int, int]] = keyword("F_Ext_User_Prm_Data_Ref", Form.REFERENCES, list)
    f_param_crc: int | None = keyword("F_ParamDescCRC", Form.WHOLE)
    f_io_crc: int | None = keyword("F_IO_StructureDescCRC", Form.WHOLE)

    @cached_property
    def identifiers(self) -> tuple[identifier.Identifier, ...]:
        """Its identifiers, with slots and offsets counted within the module. Raises ConfigurationError when cut short."""
        return tuple(identifier.decode(self.configuration))

    @property
    def whole(self) -> bool:
        """Its identifiers can be read."""
        try:
            return bool(self.identifiers)
        except ConfigurationError:
            return False

    @property
    def input_length(self) -> int:
        return sum(part.inputs.octets for part in self.identifiers if part.inputs)

    @property
    def output_length(self) -> int:
        return sum(part.outputs.octets for part in self.identifiers if part.outputs)


@dataclass(slots=True)
class Slot:
    """One line of SlotDefinition: what a slot is for and what it takes."""

    number: int
    name: str
    default: int | None
    """Module_Reference of what is there unless something else is chosen."""
    allowed: list[tuple[int, int]]
    """Module_References, as ranges with both ends."""

    def allows(self, reference: int | None) -> bool:
        return reference is not None and any(low <= reference <= high for low, high in self.allowed)


@dataclass(slots=True)
class Interface:
    """Physical_Interface: 0 RS-485, 1 MBP (IEC 61158-2), 2 fibre; delays in Tbit for each rate in bit/s."""

    number: int | None
    transmission_delay: dict[int, int] = keyword("Transmission_Delay_", Form.BY_RATE, dict)
    reaction_delay: dict[int, int] = keyword("Reaction_Delay_", Form.BY_RATE, dict)


@dataclass(slots=True)
class Unknown:
    """A keyword, or a whole block, that this library gives no meaning: kept as it stands."""

    keyword: str
    index: int | None
    value: str
    line: int
    within: str
    """The block it stands in, "" outside of all."""
    content: list[Unknown] = field(default_factory=list)
    """A block's statements."""


# ---- the device


@dataclass(eq=False, repr=False)
class Device(_Prm, _Diagnosis):
    """What one GSD file says of its device."""

    # where it comes from
    path: str = ""
    encoding: str = ""
    """What the octets were read as; "" for a text."""
    findings: list[Finding] = field(default_factory=list)
    """In the order of the file, those about the whole of it at the end."""
    unknown: list[Unknown] = field(default_factory=list)

    # device
    gsd_revision: int | None = keyword("GSD_Revision", Form.WHOLE)
    vendor: str = keyword("Vendor_Name", Form.TEXT, "")
    model: str = keyword("Model_Name", Form.TEXT, "")
    revision: str = keyword("Revision", Form.TEXT, "")
    revision_number: int | None = keyword("Revision_Number", Form.WHOLE)
    ident_number: int | None = keyword("Ident_Number", Form.WHOLE)
    protocol_ident: int | None = keyword("Protocol_Ident", Form.WHOLE)
    """0: DP."""
    station_type: int | None = keyword("Station_Type", Form.WHOLE)
    """0: slave, 1: master class 1."""
    fms: bool = flag("FMS_supp")
    hardware_release: str = keyword("Hardware_Release", Form.TEXT, "")
    software_release: str = keyword("Software_Release", Form.TEXT, "")
    implementation: str = keyword("Implementation_Type", Form.TEXT, "")
    """The ASIC."""
    slave_family: str = keyword("Slave_Family", Form.RAW, "")
    """``FAMILY@text@text``: 0 general, 1 drives, 2 switchgear, 3 I/O, 4 valves, 5 controllers, 6 HMI, 7 encoders, 8 NC/RC,
    9 gateway, 10 PLC, 11 ident systems, 12 PA."""
    family_name: str = keyword("Family_Name", Form.TEXT, "")
    order_number: str = keyword("OrderNumber", Form.TEXT, "")
    periphery: str = keyword("Periphery", Form.TEXT, "")
    info: str = keyword("Info_Text", Form.TEXT, "")
    bitmap_device: str = keyword("Bitmap_Device", Form.TEXT, "")
    bitmap_diagnosis: str = keyword("Bitmap_Diag", Form.TEXT, "")
    bitmap_special: str = keyword("Bitmap_SF", Form.TEXT, "")

    # rates and hardware
    rates: dict[int, bool] = keyword("_supp", Form.RATE, dict)
    """Whether it says to support a rate in bit/s."""
    max_tsdr: dict[int, int] = keyword("MaxTsdr_", Form.BY_RATE, dict)
    """Tbit for each rate in bit/s."""
    redundancy: bool = flag("Redundancy")
    repeater_control: int | None = keyword("Repeater_Ctrl_Sig", Form.WHOLE)
    """CNTR-P: 0 not connected, 1 RS-485, 2 TTL."""
    pins_24v: int | None = keyword("24V_Pins", Form.WHOLE)
    """0 not connected, 1 input, 2 output."""
    interfaces: list[Interface] = field(default_factory=list)

    # DP slave
    freeze: bool = flag("Freeze_Mode_supp")
    sync: bool = flag("Sync_Mode_supp")
    auto_baud: bool = flag("Auto_Baud_supp")
    set_slave_add: bool = flag("Set_Slave_Add_supp")
    fail_safe: bool = flag("Fail_Safe")
    """Takes an empty Data_Exchange in Clear."""
    fail_safe_required: bool = flag("Fail_Safe_required")
    min_slave_interval: int | None = keyword("Min_Slave_Intervall", Form.WHOLE)
    """100 us."""
    max_diag_length: int | None = keyword("Max_Diag_Data_Len", Form.WHOLE)
    diag_update_delay: int | None = keyword("Diag_Update_Delay", Form.WHOLE)
    modular: bool = flag("Modular_Station")
    max_modules: int | None = keyword("Max_Module", Form.WHOLE)
    max_inputs: int | None = keyword("Max_Input_Len", Form.WHOLE)
    max_outputs: int | None = keyword("Max_Output_Len", Form.WHOLE)
    max_data: int | None = keyword("Max_Data_Len", Form.WHOLE)
    """Octets of inputs and outputs together."""
    module_offset: int | None = keyword("Modul_Offset", Form.WHOLE)
    """The number that the first identifier has in diagnosis and in the maker's manual."""
    fixed_presets: bool = flag("FixPresetModules")
    """Preset modules take the first slots and can not be taken out."""

    # user parameters
    user_prm_length: int | None = keyword("User_Prm_Data_Len", Form.WHOLE)
    user_prm: bytes | None = keyword("User_Prm_Data", Form.OCTETS)
    """Of revisions before `constants` and `references`; not looked at when there are some."""
    max_user_prm_length: int | None = keyword("Max_User_Prm_Data_Len", Form.WHOLE)
    prm_texts: dict[int, PrmText] = field(default_factory=dict)
    parameters: dict[int, Parameter] = field(default_factory=dict)

    # modules
    modules: list[Module] = field(default_factory=list)
    slots: dict[int, Slot] = field(default_factory=dict)
    data_areas: list[DataArea] = field(default_factory=list)
    jokerblocks: list[Unknown] = field(default_factory=list)
    """Jokerblock_Type, as it stands: which keywords it holds is its type's business."""

    # DP-V1
    dpv1: bool = flag("DPV1_Slave")
    c1_read_write: bool = flag("C1_Read_Write_supp")
    c1_read_write_required: bool = flag("C1_Read_Write_required")
    c1_max_data_length: int | None = keyword("C1_Max_Data_Len", Form.WHOLE)
    c1_response_timeout: int | None = keyword("C1_Response_Timeout", Form.WHOLE)
    """10 ms."""
    c2_read_write: bool = flag("C2_Read_Write_supp")
    c2_read_write_required: bool = flag("C2_Read_Write_required")
    c2_max_data_length: int | None = keyword("C2_Max_Data_Len", Form.WHOLE)
    c2_response_timeout: int | None = keyword("C2_Response_Timeout", Form.WHOLE)
    """10 ms."""
    c2_max_channels: int | None = keyword("C2_Max_Count_Channels", Form.WHOLE)
    max_initiate_length: int | None = keyword("Max_Initiate_PDU_Length", Form.WHOLE)
    diagnostic_alarm: bool = flag("Diagnostic_Alarm_supp")
    process_alarm: bool = flag("Process_Alarm_supp")
    pull_plug_alarm: bool = flag("Pull_Plug_Alarm_supp")
    status_alarm: bool = flag("Status_Alarm_supp")
    update_alarm: bool = flag("Update_Alarm_supp")
    manufacturer_alarm: bool = flag("Manufacturer_Specific_Alarm_supp")
    diagnostic_alarm_required: bool = flag("Diagnostic_Alarm_required")
    process_alarm_required: bool = flag("Process_Alarm_required")
    pull_plug_alarm_required: bool = flag("Pull_Plug_Alarm_required")
    status_alarm_required: bool = flag("Status_Alarm_required")
    update_alarm_required: bool = flag("Update_Alarm_required")
    manufacturer_alarm_required: bool = flag("Manufacturer_Specific_Alarm_required")
    extra_alarm_sap: bool = flag("Extra_Alarm_SAP_supp")
    alarm_sequence_count: int | None = keyword("Alarm_Sequence_Mode_Count", Form.WHOLE)
    alarm_type_mode: bool = flag("Alarm_Type_Mode_supp")
    data_types: bool = flag("DPV1_Data_Types")
    """The maker's octets of special identifiers are data types."""
    wd_base_1ms: bool = flag("WD_Base_1ms_supp")
    check_cfg_mode: bool = flag("Check_Cfg_Mode")
    prm_structure: bool = flag("Prm_Block_Structure_supp")
    prm_structure_required: bool = flag("Prm_Block_Structure_req")
    ident_maintenance: bool = flag("Ident_Maintenance_supp")
    """I&M functions."""

    # DP-V2
    prm_cmd: bool = flag("PrmCmd_supp")
    slave_redundancy: bool = flag("Slave_Redundancy_supp")
    max_switch_over_time: int | None = keyword("Slave_Max_Switch_Over_Time", Form.WHOLE)
    """10 ms."""
    publisher: bool = flag("Publisher_supp")
    subscriber: bool = flag("Subscriber_supp")
    time_sync: bool = flag("Time_Sync_supp")
    isochron: bool = flag("Isochron_Mode_supp")
    isochron_required: bool = flag("Isochron_Mode_required")
    tbase_dp: int | None = keyword("TBASE_DP", Form.WHOLE)
    tdp_min: int | None = keyword("TDP_MIN", Form.WHOLE)
    tdp_max: int | None = keyword("TDP_MAX", Form.WHOLE)
    tpll_w_max: int | None = keyword("T_PLL_W_MAX", Form.WHOLE)
    tbase_io: int | None = keyword("TBASE_IO", Form.WHOLE)
    ti_min: int | None = keyword("TI_MIN", Form.WHOLE)
    to_min: int | None = keyword("TO_MIN", Form.WHOLE)

    @property
    def title(self) -> str:
        """Vendor and model, or what there is in their place."""
        return " ".join(filter(None, (self.vendor, self.model))) or self.path or "GSD"

    @property
    def baudrates(self) -> tuple[int, ...]:
        """The rates it supports, in bit/s, lowest first."""
        return tuple(sorted(rate for rate, supported in self.rates.items() if supported))

    @property
    def language(self) -> str:
        """Of the texts, by the file's suffix; "" when that is .gsd or says nothing."""
        return LANGUAGES.get(self.path[-4:].lower(), "")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.title!r}, ident {self.ident_number or 0:04X}h, {len(self.modules)} modules>"

    def module(self, which: object) -> Module:
        """The module of a name (capitals and blanks at the ends do not count) or of a Module_Reference.

        Raises ConfigurationError that names the nearest ones, or says that several have this name.
        """
        if isinstance(which, Module):
            return which
        if isinstance(which, int):
            found = [module for module in self.modules if module.reference == which]
        else:
            found = [module for module in self.modules if plain(module.name) == plain(str(which))]
        if not found:
            raise ConfigurationError(f"{self.title} has no module {which!r}: {self.instead(str(which))}")
        if len(found) > 1 and len({module.configuration for module in found}) > 1:
            numbers = ", ".join(str(module.reference) for module in found)
            raise ConfigurationError(f"{self.title} has {len(found)} modules {which!r}: give one by its reference, {numbers}")
        return found[0]

    @property
    def most_modules(self) -> int:
        """How many a station can have."""
        if self.max_modules is not None:
            return max(1, self.max_modules)
        return identifier.IO_MAX if self.modular else 1

    def instead(self, name: str = "") -> str:
        """Some modules' names, for a message: those most like `name`."""
        names = [module.name for module in self.modules]
        holding = [other for other in names if name and plain(name) in plain(other)]
        chosen = holding or difflib.get_close_matches(name, names, 5, 0.5) or names
        return ", ".join(map(repr, chosen[:5])) + (f", ... ({len(names)} in all)" if len(names) > 5 else "")


LANGUAGES: Mapping[str, str] = {
    ".gse": "English", ".gsf": "French", ".gsg": "German", ".gsi": "Italian", ".gsp": "Portuguese", ".gss": "Spanish",
}
"""What a GSD file's suffix says of its texts' language; .gsd is the default one."""
