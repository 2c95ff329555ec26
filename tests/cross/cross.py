# SPDX-License-Identifier: MIT
"""The library on other processors: arm64 and armhf under QEMU's user emulation, a Cortex-M for the core.

``make cross`` runs it. On the two ARMs of embedded Linux a master and a slave exchange data on ptys, the two-thread programs
race, and the tests of the core, of ports and of the bus thread run in Debian's Python of that processor. What user emulation
lacks (UARTs, termios2) is for uart.py, which boots a kernel. For a Cortex-M the core is compiled freestanding, and what it asks
of its surroundings compared.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import pytest
from foreign import apt, require, run

from dpmaster import _build

ROOT = Path(__file__).resolve().parent.parent.parent
HERE = Path(__file__).resolve().parent
BUILD = ROOT / "build" / "cross"
SOURCES = sorted(ROOT.glob("csrc/*/*.c"))
CORE = sorted(ROOT.glob("csrc/core/*.c"))
INCLUDES = (f"-I{ROOT / 'include'}", f"-I{ROOT / 'csrc'}")
WRAPPED = ("malloc", "calloc", "realloc", "aligned_alloc", "ioctl")
# Telegrams, the receiver, parameters, images, events, the FDL station and its ring, the DP master and slaves, recorded buses:
# all on virtual time. Then what lies in csrc/linux: ports, the bus thread, the hub, on ptys.
TESTS = ("test_telegram", "test_receiver", "test_parameters", "test_identifier", "test_image", "test_event", "test_errors",
         "test_fdl", "test_ring", "test_idle_times", "test_dp_master", "test_dp_modes", "test_dp_handler", "test_slave",
         "test_slave_services", "test_slave_address", "test_slave_baud", "test_slave_settings", "test_soft_slaves",
         "test_recordings", "test_slave_recording", "test_simulation",
         "test_port", "test_port_returns", "test_realtime", "test_cycles", "test_history")
TERMIOS2 = "not test_any_rate_is_set"  # it asks the system itself, which here has no termios2
PACKAGES = ("python3-minimal", "libpython3-stdlib", "python3-cffi-backend", "libpython3-dev", "python3-serial",
            "python3-pytest", "python3-hypothesis", "python3-pytest-timeout")
# An emulated processor is ten times slower: random tests draw less, and no time is too long for one draw. Programs that a
# test starts are emulated, too.
PROFILE = """
import sys
from pathlib import Path
from hypothesis import HealthCheck, settings
sys.executable = str(Path(__file__).with_name("python"))
settings.register_profile("emulated", deadline=None, max_examples=20, suppress_health_check=list(HealthCheck))
settings.load_profile("emulated")
"""


@dataclass(frozen=True)
class Target:
    debian: str
    compiler: str
    emulator: str
    packages: str


TARGETS = (Target("arm64", "aarch64-linux-gnu-gcc", "qemu-aarch64-static", "gcc-aarch64-linux-gnu libc6-dev-arm64-cross"),
           Target("armhf", "arm-linux-gnueabihf-gcc", "qemu-arm-static", "gcc-arm-linux-gnueabihf libc6-dev-armhf-cross"))


@pytest.fixture(params=TARGETS, ids=lambda target: target.debian)
def target(request: pytest.FixtureRequest) -> Target:
    found: Target = request.param
    require({found.compiler: found.packages, found.emulator: "qemu-user-static"})
    (BUILD / found.debian).mkdir(parents=True, exist_ok=True)
    return found


def build(target: Target, name: str, *arguments: str | Path) -> Path:
    program = BUILD / target.debian / name
    run(target.compiler, "-std=c11", "-O2", "-D_GNU_SOURCE", "-static", "-pthread", *INCLUDES, *arguments, "-o", program)
    return program


def test_a_master_and_a_slave_exchange_on_ptys(target: Target) -> None:
    """Bus threads, futexes, eventfds and ptys of that processor's system calls; and still nothing is allocated."""
    wraps = [f"-Wl,--wrap={name}" for name in WRAPPED]
    program = build(target, "allocation", ROOT / "tests/allocation.c", HERE / "old_ioctl.c", *SOURCES, *wraps, "-fno-builtin")
    exchanges, allocations = map(int, run(target.emulator, program).split())
    assert exchanges >= 3000
    assert allocations == 0


@pytest.mark.parametrize(("race", "argument"), [("event", "16"), ("image", "1")])
def test_two_threads_never_see_half_of_a_write(target: Target, race: str, argument: str) -> None:
    program = build(target, race, ROOT / "tests/race" / f"{race}.c")
    for _ in range(10):  # it says 75 when its threads have hardly met
        done = subprocess.run([target.emulator, program, argument], capture_output=True, text=True, timeout=120)
        if done.returncode != 75:
            break
    assert done.returncode == 0, done.stdout + done.stderr


def fetch_python(target: Target, root: Path) -> None:
    """Debian's Python for the processor with what the tests need, unpacked into `root`."""
    new = root.with_suffix(".new")
    with apt(BUILD / target.debian / "apt", target.debian) as settings:
        run("apt-get", "install", "--quiet", "--yes", "--download-only", "--no-install-recommends", *PACKAGES,
            timeout=500, **settings)
        for archive in sorted((BUILD / target.debian / "apt" / "archives").glob("*.deb")):
            run("dpkg-deb", "--extract", archive, new)
    new.rename(root)


def build_package(target: Target, root: Path, place: Path) -> Path:
    """The package with its module for the processor, and the tests, as a tree of its own; returns the Python to run them."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(ROOT / "dpmaster", place / "dpmaster", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("tests", "include", "csrc"):
        (place / name).symlink_to(ROOT / name)
    (place / "emulated.py").write_text(PROFILE)
    (place / "pytest.ini").write_text("[pytest]\nmarkers = tree\n")  # not the tree's own: Debian's pytest is older
    (place.parent / "shared").unlink(missing_ok=True)
    if (ROOT.parent / "shared").exists():
        (place.parent / "shared").symlink_to(ROOT.parent / "shared")
    binding = place / "_dpm.c"
    _build.binding().emit_c_code(str(binding))
    (headers,) = (root / "usr/include").glob("python3.*")
    run(target.compiler, "-shared", "-fPIC", "-std=c11", "-O2", "-D_GNU_SOURCE", "-DDPM_API=", "-DPy_LIMITED_API=0x030b0000",
        f"-I{headers}", f"-I{root / 'usr/include'}", *INCLUDES, binding, *SOURCES, HERE / "old_ioctl.c", "-Wl,--wrap=ioctl",
        "-pthread", "-o", place / "dpmaster" / "_dpm.abi3.so")
    python = place / "python"
    python.write_text(f'#!/bin/sh\nexec {target.emulator} -L {root} {root}/usr/bin/{headers.name} "$@"\n')
    python.chmod(0o755)
    return python


@pytest.mark.timeout(1200)
def test_the_library_s_tests_pass_in_python(target: Target) -> None:
    folder = BUILD / target.debian
    root, place = folder / f"root-{crc32(' '.join(PACKAGES).encode()):08x}", folder / "package"
    if not root.exists():
        try:
            fetch_python(target, root)
        except (AssertionError, OSError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"not run: no Python for {target.debian} to be had from apt: {error}")
    python = build_package(target, root, place)
    ran = run(python, "-m", "pytest", "--quiet", "-p", "no:cacheprovider", "-p", "emulated", "-W", "ignore", "-k", TERMIOS2,
              *(f"tests/{name}.py" for name in TESTS), cwd=place, timeout=1200,
              env=os.environ | {"PYTHONPATH": str(place), "PYTHONDONTWRITEBYTECODE": "1"})
    print(ran)
    assert " passed" in ran and "failed" not in ran


def test_no_lock_hides_in_an_atomic_of_the_first_raspberry_pis() -> None:
    """Raspberry Pi OS of 32 bits is for ARMv6, which has no atomics of 64 bits: they would be calls of libatomic."""
    target = TARGETS[1]
    require({target.compiler: target.packages})
    place = BUILD / target.debian
    place.mkdir(parents=True, exist_ok=True)
    for source in SOURCES:
        run(target.compiler, "-std=c11", "-O2", "-D_GNU_SOURCE", "-march=armv6+fp", "-marm", *INCLUDES, "-c", source,
            "-o", place / "armv6.o")
        assert "__atomic" not in run(target.compiler.replace("gcc", "nm"), "--undefined-only", place / "armv6.o"), source


@pytest.mark.parametrize("cpu", ["cortex-m3", "cortex-m4"])
def test_the_core_builds_freestanding_for_a_cortex_m(cpu: str) -> None:
    """design page: "it compiles for a microcontroller". It asks for what every compiler calls by itself (memcpy and its like,
    the arithmetic of 64 bits), and for no libatomic."""
    require({"arm-none-eabi-gcc": "gcc-arm-none-eabi"})
    place = BUILD / cpu
    place.mkdir(parents=True, exist_ok=True)
    objects = []
    for source in CORE:
        objects.append(place / f"{source.stem}.o")
        run("arm-none-eabi-gcc", "-std=c11", "-Os", f"-mcpu={cpu}", "-mthumb", "-ffreestanding", "-isystem", HERE, *INCLUDES,
            "-Wall", "-Wextra", "-Werror", "-c", source, "-o", objects[-1])
    run("arm-none-eabi-ld", "-r", *objects, "-o", place / "core.o")
    foreign = {line.split()[-1] for line in run("arm-none-eabi-nm", "--undefined-only", place / "core.o").splitlines()}
    assert {name for name in foreign if not name.startswith("__aeabi_")} <= {
        "memcpy", "memmove", "memset", "memcmp"}
    code, data, bss = map(int, run("arm-none-eabi-size", place / "core.o").splitlines()[1].split()[:3])
    print(f"{cpu}: {code} octets of code")
    assert (data, bss) == (0, 0)
