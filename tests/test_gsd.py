# SPDX-License-Identifier: MIT
"""Reading GSD files: the syntax with all that makers do to it, what is found wrong, and the makers' own files."""

from __future__ import annotations

import pytest
from gsd_files import NAMES, needs_files, path

from dpmaster import identifier
from dpmaster.gsd import GSD, Severity

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
    gsd = GSD.load(path(name))
    assert gsd.modules and len(gsd.findings) < 50
    wrong = [str(found) for found in gsd.findings if found.severity is not Severity.NOTE]
    expected = BROKEN.get(name, [])
    assert [text for text in expected if not any(text in found for found in wrong)] == []
    assert [found for found in wrong if not any(text in found for text in expected)] == []


@needs_files
def test_every_module_of_every_file_decodes_and_encodes_to_its_own_octets() -> None:
    seen = 0
    for name in NAMES:
        for module in GSD.load(path(name)).modules:
            assert identifier.encode(identifier.decode(module.configuration)) == module.configuration, (name, module.name)
            seen += 1
    assert seen > 4600
