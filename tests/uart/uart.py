# SPDX-License-Identifier: MIT
"""The library on UART drivers of a real kernel: Debian's arm64 kernel in QEMU, with the PL011 of a Raspberry Pi and a 16550.

``make test-uart`` runs it. The guest has one program, guest.c, as its init; each of its UARTs is joined to a segment here, with
an emulated SI-P1 and its motor. What the guest finds it prints, and the tests judge it. QEMU's UARTs send at once, whatever
their rate: that the rate of a real line is measured is shown here, not that the figure is right.
"""

from __future__ import annotations

import json
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from foreign import apt, require, run

from dpmaster._core import lib
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

ROOT = Path(__file__).resolve().parent.parent.parent
BUILD = ROOT / "build" / "uart"
KERNEL = BUILD / "vmlinuz"
COMPILER, QEMU = "aarch64-linux-gnu-gcc", "qemu-system-aarch64"
EXCHANGES = {"pl011": 300, "16550": 60}  # as guest.c asks for
OCTETS = bytes(range(256)) + bytes.fromhex("FF 00 41 FF FF 00 00 FF")  # what its try_octets waits for
BOUND = 100.0  # s for all of it, on any machine
pytestmark = pytest.mark.timeout(600)  # s; the first time the kernel is fetched
UARTS = {"pl011": 500_000, "16550": 19_200}  # with the rate of the master's bus
RATES = (9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000, 3000000, 6000000, 12000000)


def fetch_kernel() -> None:
    """Debian's newest kernel of this release for arm64."""
    with apt(BUILD / "apt", "arm64") as settings:
        fields = run("apt-cache", "show", "linux-image-arm64", **settings).splitlines()
        package = next(line for line in fields if line.startswith("Depends:")).split()[1]
        run("apt-get", "download", "--quiet", package, cwd=BUILD, timeout=500, **settings)
    (archive,) = BUILD.glob(f"{package}_*.deb")
    unpack = f"dpkg-deb --fsys-tarfile {archive.name} | tar -x --to-stdout --wildcards './boot/vmlinuz-*'"
    run("sh", "-c", f"{unpack} > new", cwd=BUILD)
    archive.unlink()
    (BUILD / "new").rename(KERNEL)


def initramfs(program: bytes) -> bytes:
    """A cpio archive (newc) with one file, /init."""

    def entry(name: str, mode: int, content: bytes) -> bytes:
        numbers = (1, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08X" % number for number in numbers) + name.encode() + b"\0"
        return b"".join(part + bytes(-len(part) % 4) for part in (head, content))

    return entry("init", 0o100755, program) + entry("TRAILER!!!", 0, b"")


def build_guest() -> None:
    sources = [*ROOT.glob("csrc/*/*.c"), Path(__file__).with_name("guest.c")]
    run(COMPILER, "-std=c11", "-O2", "-D_GNU_SOURCE", "-Wall", "-Wextra", "-Werror", "-static", "-pthread",
        f"-I{ROOT / 'include'}", f"-I{ROOT / 'csrc'}", *sources, "-o", BUILD / "init")
    (BUILD / "initramfs").write_bytes(initramfs((BUILD / "init").read_bytes()))


class Guest:
    """The machine while it runs, and the facts its program prints."""

    def __init__(self, folder: Path, pl011: str = "null", uart16550: str = "null", options: tuple[str, ...] = ()) -> None:
        control = folder / "qmp"
        self.begin = time.monotonic()
        self.process = subprocess.Popen(
            [QEMU, "-M", "virt", "-cpu", "cortex-a53", "-m", "256", "-nodefaults", "-nographic", "-no-reboot",
             "-kernel", KERNEL, "-initrd", BUILD / "initramfs", "-append", "console=ttyS0 quiet panic=-1",
             "-qmp", f"unix:{control},server=on,wait=off",
             "-chardev", f"{pl011},id=uartpl011", "-serial", "chardev:uartpl011",
             "-chardev", "stdio,id=console,signal=off", "-device", "pci-serial,chardev=console",
             "-chardev", f"{uart16550},id=uart16550", "-device", "pci-serial,chardev=uart16550", *options],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
        self.control = control
        self.console: list[str] = []
        self.timer = threading.Timer(BOUND, self.process.kill)
        self.timer.start()

    def facts(self) -> Iterator[tuple[str, list[str]]]:
        """Each fact as it is printed: its subject and its words."""
        assert self.process.stdout
        for line in self.process.stdout:
            self.console.append(line)
            if line.startswith("@"):
                name, *words = line[1:].split()
                yield name, words

    def send_break(self, uart: str) -> None:
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(10)
            link.connect(str(self.control))
            stream = link.makefile("rw")
            stream.readline()
            for command in ({"execute": "qmp_capabilities"}, {"execute": "chardev-send-break", "arguments": {"id": uart}}):
                stream.write(json.dumps(command) + "\n")
                stream.flush()
                answer = json.loads(stream.readline())
                assert "return" in answer, answer

    def close(self) -> None:
        self.timer.cancel()
        self.process.kill()
        self.process.communicate()


def prepare() -> None:
    """Build the guest, or skip, and say so, where the machine cannot run it."""
    require({QEMU: "qemu-system-arm", COMPILER: "gcc-aarch64-linux-gnu libc6-dev-arm64-cross"})
    BUILD.mkdir(parents=True, exist_ok=True)
    if not KERNEL.exists():
        try:
            fetch_kernel()
        except (AssertionError, OSError, StopIteration, ValueError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"not run: no arm64 kernel to be had from apt: {error}")
    build_guest()


@pytest.fixture(scope="module")
def facts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, list[str]]]:
    """What the guest found, and under "motor.NAME" what the motor here did meanwhile."""
    prepare()
    found: dict[str, list[str]] = {}
    with ExitStack() as stack:
        # QEMU's UARTs send at once. Segments that pace make a real line of it, on which no answer overtakes its request.
        wires = {uart: stack.enter_context(Segment(rate, ports=2, cards=1)) for uart, rate in UARTS.items()}
        cards = {uart: wire.attach(SIP1(address=5)) for uart, wire in wires.items()}
        guest = Guest(tmp_path_factory.mktemp("guest"), *(f"serial,path={wire.port()}" for wire in wires.values()))
        talkers = {uart: wire.port() for uart, wire in wires.items()}
        try:
            for name, words in guest.facts():
                found[name] = words
                print(f"{time.monotonic() - guest.begin:6.2f} s  {name} {' '.join(words)}")
                uart, _, what = name.partition(".")
                if what == "wants-octets":
                    Path(talkers[uart]).write_bytes(OCTETS)
                elif what == "wants-break":
                    guest.send_break(f"uart{uart}")
                elif what == "running":
                    deadline = time.monotonic() + 5
                    motor = cards[uart].motor
                    while motor.frequency < 1 and time.monotonic() < deadline:
                        time.sleep(0.01)
                    found[f"motor.{uart}"] = [f"{motor.frequency:.2f}"]
        finally:
            guest.close()
        assert "done" in found, "the guest did not reach its end; its console:\n" + "".join(guest.console[-40:])
    yield found


@pytest.mark.usefixtures("facts")
def test_the_guest_boots_in_two_seconds(tmp_path: Path) -> None:
    """By its own clock, with 1 ns for each instruction, so that it is no matter how fast this machine is and how busy."""
    guest = Guest(tmp_path, options=("-icount", "shift=0,sleep=off"))
    try:
        name, (clock,) = next(guest.facts())
    finally:
        guest.close()
    assert name == "up"
    assert int(clock) < 2e9


@pytest.mark.parametrize("rate", RATES)
def test_every_rate_the_uart_can_make_is_made_and_others_are_refused(facts: dict[str, list[str]], rate: int) -> None:
    """A PL011 at 24 MHz reaches 1.5 Mbit/s (clock / 16). A 16550 at 1.8432 MHz: "9.6k, 19.2k only" (protocol page N.1)."""
    for uart, possible in (("pl011", rate <= 1_500_000), ("16550", rate in (9600, 19200))):
        code, made, parity, *words = facts[f"{uart}.rate.{rate}"]
        if possible:
            assert (int(code), int(parity)) == (0, 1)
            assert abs(int(made) / rate - 1) < 0.003
        else:
            assert int(code) == lib.DPM_E_RATE
            assert " ".join(words).startswith("the port does not make this rate within 0.3 %: choose a lower one")


@pytest.mark.parametrize("uart", UARTS)
def test_a_port_has_one_user(facts: dict[str, list[str]], uart: str) -> None:
    """And keeps it: the guest's program is root, whom TIOCEXCL does not stop."""
    code, exclusive = map(int, facts[f"{uart}.second"])
    assert (code, exclusive) == (lib.DPM_E_IN_USE, 1)


def test_rs485_mode_is_taken_by_the_pl011_and_refused_for_the_16550(facts: dict[str, list[str]]) -> None:
    for direction in (lib.DPM_DIRECTION_RS485, lib.DPM_DIRECTION_RS485_INVERTED):
        assert facts[f"pl011.rs485.{direction}"][:2] == ["0", "1"]
        code, _, *words = facts[f"16550.rs485.{direction}"]
        assert int(code) == lib.DPM_E_RS485
        assert " ".join(words).startswith("the driver of this port has no RS-485 mode: leave the direction to a hat")


def test_of_the_rs485_mode_only_what_is_meant_is_set(facts: dict[str, list[str]]) -> None:
    """Protocol page N.2: ENABLED 1, RTS_ON_SEND 2, RTS_AFTER_SEND 4, RX_DURING_TX 16; delays in ms are "useless: leave 0"."""
    assert facts["pl011.mode"] == ["0", "21", "3", "5"]
    assert facts[f"pl011.mode.{lib.DPM_ECHO_AUTO}"] == ["19", "0", "0"]
    assert facts[f"pl011.mode.{lib.DPM_ECHO_OFF}"] == ["3", "0", "0"]
    assert facts[f"pl011.mode.{lib.DPM_ECHO_ON}"] == ["19", "0", "0"]
    assert facts["16550.mode"][0] == "-1"


def test_what_the_drivers_offer_is_used(facts: dict[str, list[str]]) -> None:
    """The end of a transmission and counters by both; the FIFO's trigger by the 8250 only, 1 at 19.2 kbit/s."""
    assert facts["pl011.driver"][:2] == facts["16550.driver"][:2] == ["1", "1"]
    assert facts["pl011.driver"][3] == "0"
    assert facts["16550.driver"][3] == "1"


@pytest.mark.parametrize("uart", UARTS)
def test_every_octet_passes_a_driver_that_marks_errors(facts: dict[str, list[str]], uart: str) -> None:
    """Termios(3), PARMRK: a real FF comes as FF FF."""
    assert facts[f"{uart}.octets"] == ["0", OCTETS.hex()]


@pytest.mark.parametrize("uart", UARTS)
def test_a_break_reaches_the_receiver_as_a_line_error(facts: dict[str, list[str]], uart: str) -> None:
    errors, octets, line_errors, breaks, others = map(int, facts[f"{uart}.break"])
    assert errors & lib.DPM_LINE_BREAK
    assert (octets, line_errors, breaks, others) == (1, 1, 1, 0)


@pytest.mark.parametrize("uart", UARTS)
def test_the_driver_tells_the_end_of_a_transmission(facts: dict[str, list[str]], uart: str) -> None:
    computed, earliest, latest = map(int, facts[f"{uart}.end"])
    assert computed <= earliest + 1000 <= latest + 1000
    assert latest < computed + 1_000_000_000
    code, nominal, measured = map(int, facts[f"{uart}.measure"])
    assert code == 0
    assert 0 < measured < nominal + 1_000_000_000


@pytest.mark.parametrize("uart", UARTS)
def test_a_master_in_c_runs_the_drive_on_the_host(facts: dict[str, list[str]], uart: str) -> None:
    assert facts[f"{uart}.start"] == ["0"]
    data, ran, _ = facts[f"{uart}.running"]
    assert (data, ran) == ("1", "1")
    assert float(facts[f"motor.{uart}"][0]) > 1
    state, exchanges, losses, _, line_errors = map(int, facts[f"{uart}.master"])
    assert state == lib.DPM_ST_DATA
    assert exchanges > EXCHANGES[uart]
    assert (losses, line_errors) == (0, 0)
    assert int(facts[f"{uart}.exchange"][0]) > 0.9 * EXCHANGES[uart]


@pytest.mark.parametrize("uart", UARTS)
def test_the_bus_thread_is_a_real_time_thread(facts: dict[str, list[str]], uart: str) -> None:
    assert facts[f"{uart}.realtime"] == ["0", "0", "0"]
