# SPDX-License-Identifier: MIT
"""What holds of the tree as a whole: it builds from its source distribution, the binding is the headers, the core needs no
operating system, rooms touch only what they may, and `make` names what is missing."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from contextlib import nullcontext
from pathlib import Path

import pytest
from foreign import require

import dpmaster
from dpmaster._dpm import ffi, lib  # type: ignore[import-not-found, unused-ignore]

ROOT = Path(__file__).resolve().parent.parent
HEADERS = sorted((ROOT / "include" / "dpmaster").glob("*.h"))
STUBS = ROOT / "csrc" / "stubs.c"  # never committed; lets a tree build in which a function is still missing
CORE = sorted((ROOT / "csrc" / "core").glob("*.c"))
LINUX = sorted((ROOT / "csrc" / "linux").glob("*.c"))

pytestmark = pytest.mark.tree


def run(*command: str | Path, cwd: Path = ROOT, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command], cwd=cwd, env={**os.environ, **env}, capture_output=True, text=True, timeout=110
    )


def without_comments(path: Path) -> str:
    return re.sub(r"/\*.*?\*/", " ", path.read_text(), flags=re.DOTALL)


# --- the source distribution -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution of a copy of the tree, unpacked."""
    pytest.importorskip("setuptools", minversion="77", reason="building needs setuptools 77 or later")
    place = tmp_path_factory.mktemp("sdist")
    leave = shutil.ignore_patterns(
        ".git", ".venv", "build", "dist", "*.egg-info", "__pycache__", "*.so", "_dpm.c", ".*_cache", ".hypothesis"
    )
    shutil.copytree(ROOT, place / "tree", ignore=leave)
    done = run(
        sys.executable, "-c", "from setuptools import build_meta; print(build_meta.build_sdist('..'))", cwd=place / "tree"
    )
    assert done.returncode == 0, done.stderr
    with tarfile.open(place / done.stdout.split()[-1]) as archive:
        # Debian 12's Python, 3.11.2, knows no filters yet, and ignores this.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(place)
    (unpacked,) = place.glob("dpmaster-*/")
    return unpacked


def test_the_source_distribution_holds_every_source_and_what_a_packager_wants(sdist: Path) -> None:
    def files(room: str) -> set[str]:
        return {
            str(path.relative_to(ROOT)) for path in (ROOT / room).rglob("*")
            if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".so", ".o") and path.name != "_dpm.c"
        }

    wanted = set().union(*map(files, ("csrc", "include", "dpmaster", "tests", "docs", "examples")))
    wanted |= {"Makefile", "setup.py", "pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md"}
    assert len(wanted) > 30
    assert sorted(name for name in wanted if not (sdist / name).is_file()) == []


def test_the_source_distribution_builds_by_itself(sdist: Path, tmp_path: Path) -> None:
    done = run(
        sys.executable, "setup.py", "--quiet", "build", "--build-base", tmp_path / "base", "--build-lib", tmp_path / "lib",
        cwd=sdist, DPM_CFLAGS="-O0",
    )
    assert done.returncode == 0, done.stderr
    assert ": warning:" not in done.stderr, done.stderr  # the compiler's: the first thing that a user sees of it
    # From another directory, so that neither the tree nor its compiled module can be what is imported. Every module can be.
    program = ("import importlib, pkgutil, dpmaster, dpmaster._dpm as built; from dpmaster.gsd import devices; "
               "[importlib.import_module(m.name) for m in pkgutil.walk_packages(dpmaster.__path__, 'dpmaster.')]; "
               "print(built.__file__, built.ffi.string(built.lib.dpm_strerror(0)), *devices.NAMES)")
    done = run(sys.executable, "-W", "error", "-c", program, cwd=tmp_path, PYTHONPATH=str(tmp_path / "lib"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "lib"))
    assert done.stdout.split()[-3:] == ["si-p1", "si-p3", "vw3a3607"]  # a wheel holds what is built


# --- the binding -----------------------------------------------------------------------------------------------------


def test_the_binding_offers_what_the_headers_declare_and_nothing_else() -> None:
    text = "\n".join(without_comments(path) for path in HEADERS)
    functions = set(re.findall(r"DPM_API\s[^;(]*?\b(dpm_\w+)\s*\(", text))
    defines = set(re.findall(r"^\s*#\s*define\s+(\w+)\s+-?(?:0x)?\d", text, flags=re.MULTILINE))
    constants = set()
    for body in re.findall(r"\benum\s+\w*\s*\{([^}]*)\}", text):
        constants |= set(re.findall(r"\bDPM_\w+(?=\s*[=,}]|\s*$)", body))
    assert len(functions) > 100 and len(constants) > 100 and "DPM_TELEGRAM_MAX" in defines
    assert set(dir(lib)) == functions | defines | constants


def test_the_binding_knows_every_structure_with_its_fields() -> None:
    text = "\n".join(without_comments(path) for path in HEADERS)
    structures = re.findall(r"typedef\s+struct\s+(\w+)\s*\{([^}]*)\}\s*\1\s*;", text)
    assert len(structures) > 15
    for name, body in structures:
        kind = ffi.typeof(name)
        # "int x;", "int x[3];", "int (*x)(void);"
        parts = [re.sub(r"\(\s*\*\s*(\w+)\s*\).*", r" \1", part, flags=re.DOTALL) for part in body.split(";") if part.strip()]
        declared = [re.findall(r"\w+", re.sub(r"\[\w+\]", "", part))[-1] for part in parts]
        assert declared == [field for field, _ in kind.fields], name
        assert ffi.sizeof(name) > 0  # the compiler's layout was compared with the declaration when it was built


def test_every_header_stands_alone(tmp_path: Path) -> None:
    compiler = shutil.which("cc") or pytest.skip("no C compiler")
    for header in HEADERS:
        source = tmp_path / f"{header.stem}.c"
        source.write_text(f'#include "dpmaster/{header.name}"\n#include "dpmaster/{header.name}"\nextern int used;\n')
        done = run(compiler, "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{ROOT / 'include'}", "-fsyntax-only", source)
        assert done.returncode == 0, done.stderr


# --- the rooms -------------------------------------------------------------------------------------------------------


def symbols(source: Path, place: Path, *flags: str) -> dict[str, str]:
    """The symbols of one compiled file with their kinds, as `nm` prints them."""
    compiler, nm = shutil.which("cc"), shutil.which("nm")
    if not compiler or not nm:
        pytest.skip("no C compiler or no nm")
    target = place / f"{source.stem}.o"
    done = run(compiler, "-std=c11", "-O2", *flags, f"-I{ROOT / 'include'}", f"-I{ROOT / 'csrc'}", "-c", source, "-o", target)
    assert done.returncode == 0, done.stderr
    lines = (line.split() for line in run(nm, target).stdout.splitlines())
    return {words[-1]: words[-2] for words in lines}


def test_the_library_is_two_rooms() -> None:
    assert set((ROOT / "csrc").rglob("*.c")) - {STUBS} == set(CORE) | set(LINUX)
    assert CORE and LINUX


@pytest.mark.parametrize("source", CORE, ids=lambda path: path.name)
def test_the_core_has_no_system_no_allocation_and_no_globals(source: Path, tmp_path: Path) -> None:
    """design page: "no operating system, no allocation, no globals". What a compiler may call by itself is all it calls."""
    found = symbols(source, tmp_path, "-ffreestanding", "-fno-pic")  # a table of texts is read-only then
    foreign = {name for name, kind in found.items() if kind == "U" and not name.startswith("dpm_")}
    assert foreign <= {"memcpy", "memmove", "memset", "memcmp"}
    assert {name: kind for name, kind in found.items() if kind in "BbDdCSs"} == {}


@pytest.mark.parametrize("source", CORE + LINUX, ids=lambda path: path.name)
def test_the_library_never_allocates(source: Path, tmp_path: Path) -> None:
    found = symbols(source, tmp_path, "-D_GNU_SOURCE")
    allocators = {"malloc", "calloc", "realloc", "aligned_alloc", "posix_memalign", "free", "strdup", "fopen", "printf", "mmap"}
    assert allocators & set(found) == set()


@pytest.mark.parametrize("source", CORE + LINUX, ids=lambda path: path.name)
def test_every_name_that_leaves_a_file_begins_with_dpm(source: Path, tmp_path: Path) -> None:
    found = symbols(source, tmp_path, "-D_GNU_SOURCE")
    assert {name for name, kind in found.items() if kind in "TDBRVW" and not name.startswith("dpm_")} == set()


def imports(path: Path) -> set[str]:
    """The modules of this package that a file names, those under TYPE_CHECKING and inside functions too."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) + "." if node.level else ""
            module = (base + (node.module or "")).rstrip(".")
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] == "dpmaster"}


PYTHON = sorted((ROOT / "dpmaster").rglob("*.py"))


def forbidden(room: str, *others: str) -> list[str]:
    """Where a file of `room` names a module of `others`."""
    found = []
    for path in PYTHON:
        if str(path.relative_to(ROOT / "dpmaster")).startswith(room):
            for name in sorted(imports(path)):
                if any(name == other or name.startswith(other + ".") for other in others):
                    found.append(f"{path.relative_to(ROOT)}: {name}")
    return found


BINDING = ("dpmaster._dpm", "dpmaster._core")


def test_what_a_drive_may_touch() -> None:
    """design page: "nothing in drives/ knows a port"; a drive knows neither the binding nor the emulated cards."""
    others = (*BINDING, "dpmaster.master", "dpmaster.emulator", "dpmaster.cli")
    assert forbidden("drives", *others) + forbidden("profiles", *others) == []


def test_what_a_card_may_touch() -> None:
    """card.py: "may touch nothing but the standard library"; a card is its own side of the wire, not the master's."""
    others = (*BINDING, "dpmaster.master", "dpmaster.station", "dpmaster.drives", "dpmaster.cli")
    assert forbidden("emulator/card", *others) == []


def test_what_a_command_may_touch() -> None:
    """design page: "the CLI only calls what a program could call"."""
    assert forbidden("cli", *BINDING) == []


def test_nothing_but_the_commands_knows_the_commands() -> None:
    assert [line for line in forbidden("", "dpmaster.cli") if not line.startswith(("dpmaster/cli/", "dpmaster/__main__"))] == []


# --- the project's files ---------------------------------------------------------------------------------------------


def test_the_version_is_written_in_one_place() -> None:
    """In dpmaster/__init__.py, where pyproject.toml and with it every distribution finds it; the changelog goes by it."""
    version = re.escape(dpmaster.__version__)
    sources = [ROOT / "pyproject.toml", ROOT / "setup.py", ROOT / "Makefile", *PYTHON, *HEADERS, *CORE, *LINUX]
    holders = [path for path in sources if re.search(rf"(?<![\d.]){version}(?![\d.])", path.read_text())]
    assert holders == [ROOT / "dpmaster" / "__init__.py"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert newest is not None and newest.group(1) == dpmaster.__version__


def test_every_source_names_its_licence_in_the_first_line() -> None:
    rooms = ("dpmaster", "csrc", "include", "tests", "examples")
    sources = [path for room in rooms for path in (ROOT / room).rglob("*") if path.suffix in (".py", ".c", ".h")]
    sources = [path for path in [*sources, ROOT / "Makefile", ROOT / "setup.py"] if path.name != "_dpm.c" and path != STUBS]
    assert len(sources) > 30
    unmarked = [str(path) for path in sources if "SPDX-License-Identifier: MIT" not in path.read_text().split("\n")[0]]
    assert unmarked == []


@pytest.mark.skipif(not shutil.which("make"), reason="no make")
@pytest.mark.parametrize(("variable", "package"), [("CC=no-such-compiler", "gcc"), ("PYTHON=no-such-python", "python3-venv")])
def test_make_names_what_is_missing_and_the_remedy(variable: str, package: str) -> None:
    done = run("make", variable)
    assert done.returncode != 0
    assert f"missing: {variable.split('=')[1]}" in done.stdout.replace("a C compiler (", "").replace(")", "")
    (remedy,) = [line for line in done.stdout.splitlines() if line.startswith("to install:")]
    assert "sudo apt-get install" in remedy and package in remedy.split()


@pytest.mark.skipif(not shutil.which("make"), reason="no make")
def test_make_alone_names_the_targets() -> None:
    done = run("make", f"PYTHON={sys.executable}")
    if "to install:" in done.stdout:
        pytest.skip(f"this system lacks something: {done.stdout}")
    assert done.returncode == 0, done.stderr
    targets = set(re.findall(r"^make (\w+)", done.stdout, flags=re.MULTILINE))
    assert targets == {"demo", "test", "cross", "lint", "soak", "bench", "fuzz", "sanitize", "dist", "clean"}


@pytest.mark.parametrize("status", [0, 1])
def test_a_cross_compiler_without_its_c_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int) -> None:
    """Debian only recommends libc6-dev-arm64-cross with gcc-aarch64-linux-gnu."""
    compiler = tmp_path / "any-linux-gnu-gcc"
    compiler.write_text(f"#!/bin/sh\nexit {status}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with pytest.raises(pytest.skip.Exception, match="not run: apt-get install any libc") if status else nullcontext():
        require({compiler.name: "any libc"})
