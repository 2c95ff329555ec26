# SPDX-License-Identifier: MIT
"""The compiled module (built by ``_build.py``); its declarations are those of ``include/dpmaster``."""

from typing import Any

ffi: Any
lib: Any
