# SPDX-License-Identifier: MIT
"""What a GSD file contradicts itself in, or leaves out: findings about the whole of a model that was read.

Also settles the references between its parts. Changes nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator

from dpmaster.gsd.model import USER_PRM_MAX, Device, Module, _Prm
from dpmaster.gsd.reader import Reader
from dpmaster.gsd.source import Severity

ERROR, WARNING, NOTE = Severity.ERROR, Severity.WARNING, Severity.NOTE
TSDR = (11, 1023)  # Tbit: min Tsdr, and what max Tsdr can be
Said = tuple[Severity, int | None, str]


def check(device: Device, reader: Reader) -> None:
    for part in (_texts, _device, _prm, _modules, _slots):
        for severity, offset, text in part(device, reader):
            reader.source.note(severity, offset, text)


def _texts(device: Device, reader: Reader) -> Iterator[Said]:
    for parameter in device.parameters.values():
        if parameter.text_reference is None:
            continue
        found = device.prm_texts.get(parameter.text_reference)
        if found is None:
            yield (ERROR, reader.given.get((id(parameter), "text_reference", None)),
                   f"{parameter.name!r}: there is no PrmText {parameter.text_reference}")
        else:
            parameter.texts = found.texts


def _device(device: Device, reader: Reader) -> Iterator[Said]:
    for name, value in (("Ident_Number", device.ident_number), ("Vendor_Name", device.vendor), ("Model_Name", device.model),
                        ("GSD_Revision", device.gsd_revision)):
        if value is None or value == "":
            yield ERROR if name == "Ident_Number" else WARNING, None, f"{name} is missing"
    ident = reader.given.get((id(device), "ident_number", None))
    if device.ident_number is not None and not 0 <= device.ident_number <= 0xFFFF:
        yield ERROR, ident, f"Ident_Number = {device.ident_number}: 0 to 0xFFFF"
        device.ident_number = None
    if not device.baudrates:
        yield WARNING, None, "it supports no rate: no keyword like 500_supp = 1"
    for rate, bits in device.max_tsdr.items():
        if not TSDR[0] <= bits <= TSDR[1] and device.rates.get(rate):
            yield (WARNING, reader.given.get((id(device), "max_tsdr", rate)),
                   f"MaxTsdr {bits} Tbit at {rate} bit/s: {TSDR[0]} to {TSDR[1]}; the nearest that a master can use is taken")
    if device.station_type:
        yield NOTE, reader.given.get((id(device), "station_type", None)), "this is a master, no slave"


def _prm(device: Device, reader: Reader) -> Iterator[Said]:
    yield from _references(device, device, reader, USER_PRM_MAX, f"user parameters have {USER_PRM_MAX} octets at most")
    if device.user_prm is not None and device.user_prm_length not in (None, len(device.user_prm)):
        yield (ERROR, reader.given.get((id(device), "user_prm", None)),
               f"User_Prm_Data has {len(device.user_prm)} octets, User_Prm_Data_Len is {device.user_prm_length}")


def _references(device: Device, block: _Prm, reader: Reader, length: int, rule: str) -> Iterator[Said]:
    """Constants and references of one block that can not be put into it."""
    for at, (offset, octets) in enumerate(block.constants):
        if offset + len(octets) > length:
            yield (ERROR, reader.given.get((id(block.constants), "", at)),
                   f"Ext_User_Prm_Data_Const({offset}) ends behind octet {length - 1}: {rule}")
    for at, (offset, number) in enumerate(block.references):
        place = reader.given.get((id(block.references), "", at))
        parameter = device.parameters.get(number)
        if parameter is None:
            yield ERROR, place, f"Ext_User_Prm_Data_Ref({offset}): there is no ExtUserPrmData {number}"
        elif offset + parameter.octets > length:
            yield ERROR, place, f"Ext_User_Prm_Data_Ref({offset}) = {number} ends behind octet {length - 1}: {rule}"


def _modules(device: Device, reader: Reader) -> Iterator[Said]:
    seen: dict[int, Module] = {}
    if not device.modules:
        yield WARNING, None, "it has no Module: nothing can be configured from it"
    for module in device.modules:
        if module.prm_length is not None and not 0 <= module.prm_length <= USER_PRM_MAX:
            yield (ERROR, reader.given.get((id(module), "prm_length", None)),
                   f"Ext_Module_Prm_Data_Len of {module.name!r} is {module.prm_length}, 0 to {USER_PRM_MAX}: not taken")
            module.prm_length = None
        if module.prm_length is not None:
            yield from _references(device, module, reader, module.prm_length,
                                   f"Ext_Module_Prm_Data_Len of {module.name!r} is {module.prm_length}")
        if module.reference is None:
            continue
        other = seen.setdefault(module.reference, module)
        if other is not module:
            yield (WARNING, reader.given.get((id(module), "reference", None)),
                   f"Module_Reference {module.reference} of {module.name!r} is that of {other.name!r} already")


def _slots(device: Device, reader: Reader) -> Iterator[Said]:
    known = {module.reference for module in device.modules}
    for slot in device.slots.values():
        place = reader.given.get((id(device), "slots", slot.number))
        if slot.default not in known:
            yield ERROR, place, f"Slot {slot.number} {slot.name!r}: its default {slot.default} is no module's reference"
        elif not slot.allows(slot.default):
            yield WARNING, place, f"Slot {slot.number} {slot.name!r}: its default {slot.default} is none of those it allows"
        missing = [low for low, high in slot.allowed if low == high and low not in known]
        if missing:
            yield WARNING, place, f"Slot {slot.number} {slot.name!r}: no module has reference {', '.join(map(str, missing))}"
