# SPDX-License-Identifier: MIT
"""Tables that say which test shows what stay true: every "file::test" in them is looked for in the sources."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

TESTS = Path(__file__).parent


def check_named(table: Mapping[str, str]) -> None:
    """Fail with the entries whose test there is not."""
    missing = []
    for what, names in table.items():
        for name in names.split():
            file, _, function = name.partition("::")
            path = TESTS / file
            if not path.is_file() or not re.search(rf"^(async )?def {re.escape(function)}\(", path.read_text(), re.MULTILINE):
                missing.append(f"{what}: {name}")
    assert not missing, missing
