# SPDX-License-Identifier: MIT
"""Build the compiled module ``dpmaster._dpm``: the C library and its cffi binding (API mode).

The declarations come from ``include/dpmaster/*.h``, which are the only place they are written down: comments, includes
and the export mark are stripped, literal defines stay. The headers are therefore plain C (see ``api.h``).

Environment: ``DPM_CFLAGS`` and ``DPM_LDFLAGS`` are appended (sanitizers, coverage).
"""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

from cffi import FFI

ROOT = Path(__file__).resolve().parent.parent
# In the order of use: a header needs only those before it.
HEADERS = (
    "api", "error", "telegram", "machine", "receiver", "parameters", "identifier", "image", "history", "event",
    "station", "master", "slave", "port", "realtime", "bus", "segment", "simulation",
)


def declarations() -> str:
    """The public headers as text that cffi's parser reads."""
    text = "\n".join((ROOT / "include" / "dpmaster" / f"{name}.h").read_text() for name in HEADERS)
    text = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL)
    lines = []
    for line in text.splitlines():
        if re.match(r"\s*#\s*define\s+\w+\s+(-?\d|0x)", line) or not line.lstrip().startswith("#"):
            lines.append(line.replace("DPM_API ", ""))
    return "\n".join(lines)


def sources() -> list[str]:
    """Every C file of the library, relative to the project's root."""
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / "csrc").rglob("*.c"))


def headers() -> list[str]:
    """Every header, public and private: what a source distribution needs to build."""
    return sorted(str(path.relative_to(ROOT)) for room in ("include", "csrc") for path in (ROOT / room).rglob("*.h"))


def binding() -> FFI:
    """The binding, ready to be compiled. Made when it is asked for: an installed package has no headers."""
    ffi = FFI()
    ffi.cdef(declarations())
    ffi.set_source(
        "dpmaster._dpm",
        "\n".join(f'#include "dpmaster/{name}.h"' for name in HEADERS),
        sources=sources(),
        include_dirs=["include", "csrc"],
        depends=headers(),
        # The extension exports nothing but its init function; mismatched pointers in the binding are errors, not warnings.
        define_macros=[("DPM_API", ""), ("_GNU_SOURCE", "1")],
        extra_compile_args=[
            "-std=c11", "-O2", "-fvisibility=hidden", "-Werror=incompatible-pointer-types", "-Werror=int-conversion",
            *shlex.split(os.environ.get("DPM_CFLAGS", "")),
        ],
        extra_link_args=["-pthread", *shlex.split(os.environ.get("DPM_LDFLAGS", ""))],
    )
    return ffi


if __name__ == "__main__":
    binding().compile(verbose=True)
