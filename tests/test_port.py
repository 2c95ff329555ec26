# SPDX-License-Identifier: MIT
"""Ports: opening and its refusals, octets with their times, echo, the ends of transmissions, waiting."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from children import child
from leftovers import nothing_left_behind
from waiting import until

from dpmaster import ConfigurationError, Master
from dpmaster._core import block, ffi, lib
from dpmaster.emulator import Segment

ROOT = Path(__file__).resolve().parent.parent
TOKEN = bytes.fromhex("DC 02 02")  # protocol page B: SD4 DA SA


@dataclass
class Recorder:
    """A machine that writes down what it is told."""

    log: list[tuple[Any, ...]] = field(default_factory=list)

    def __post_init__(self) -> None:
        def octets(_: Any, span: Any) -> None:
            errors = bytes(ffi.buffer(span.errors, span.n)) if span.errors else None
            self.log.append(("octets", bytes(ffi.buffer(span.octets, span.n)), errors, span.earliest, span.latest,
                             span.spacing, span.echo))

        def quiet(_: Any, until: int) -> None:
            self.log.append(("quiet", until))

        def sent(_: Any, start: int, earliest: int, latest: int, result: int) -> None:
            self.log.append(("sent", start, earliest, latest, result))

        self._keep = (
            ffi.callback("void(dpm_machine *, const dpm_span *)", octets),
            ffi.callback("void(dpm_machine *, int64_t)", quiet),
            ffi.callback("void(dpm_machine *, int64_t, int64_t, int64_t, int)", sent),
        )
        self.machine = ffi.new("dpm_machine *")
        self.machine.octets, self.machine.quiet, self.machine.sent = self._keep

    def take(self, kind: str) -> list[tuple[Any, ...]]:
        """The entries of one kind, without the kind; the log is emptied."""
        entries = [entry[1:] for entry in self.log if entry[0] == kind]
        self.log.clear()
        return entries

    def received(self, echo: bool = False) -> bytes:
        """Octets of others, or our own heard back; the log is emptied."""
        return b"".join(entry[0] for entry in self.take("octets") if entry[-1] == echo)


class Port:
    """A dpm_port on a pty of its own, or on `path`."""

    def __init__(self, path: str | None = None, *, rate: int | Fraction = 500_000, profile: int = 0, echo: int = 0,
                 pace: int = 0, allowance: int = -1, direction: int = 0) -> None:
        self.far = -1
        if path is None:
            self.far, near = pty.openpty()
            path = os.ttyname(near)
        self.path = path
        self.recorder = Recorder()
        self._path = ffi.new("char[]", path.encode())
        config = ffi.new("dpm_port_config *", {"path": self._path, "rate_num": rate.numerator, "rate_den": rate.denominator,
                                               "profile": profile, "echo": echo, "pace": pace, "allowance": allowance,
                                               "direction": direction})
        size = lib.dpm_port_size()
        self._block = block(size)
        out = ffi.new("dpm_port **")
        self.code = lib.dpm_port_open(self._block, size, config, out)
        self.port = out[0] if self.code == 0 else None
        if self.far >= 0:
            os.close(near)

    @property
    def info(self) -> Any:
        info = ffi.new("dpm_port_info *")
        lib.dpm_port_get_info(self.port, info)
        return info

    def hear(self, octets: bytes, echo: bool = False) -> bytes:
        """Send `octets` from the far end and read them here; returns what the machine was given as others' or as our echo."""
        os.write(self.far, octets)
        assert lib.dpm_port_wait(self.port, -1, lib.dpm_now() + 5_000_000_000) == 1
        assert self.read() == len(octets)
        return self.recorder.received(echo)

    def read(self) -> int:
        return int(lib.dpm_port_read(self.port, self.recorder.machine))

    def write(self, octets: bytes) -> int:
        return int(lib.dpm_port_write(self.port, self.recorder.machine, octets, len(octets)))

    def close(self) -> None:
        if self.port is not None:
            lib.dpm_port_close(self.port)
        self.hang_up()

    def hang_up(self) -> None:
        if self.far >= 0:
            os.close(self.far)
            self.far = -1


Opener = Callable[..., Port]


@pytest.fixture
def opened() -> Iterator[Opener]:
    ports: list[Port] = []

    def opener(*args: Any, **kwargs: Any) -> Port:
        ports.append(Port(*args, **kwargs))
        return ports[-1]

    with nothing_left_behind():
        yield opener
        for port in ports:
            port.close()


# ---- opening ----


@pytest.mark.parametrize(("path", "code"), [
    ("/dev/no-such-port", "NO_PORT"),
    ("/dev/null/port", "NO_PORT"),
    ("/dev/" + "x" * 5000, "NO_PORT"),
    ("/dev/null", "NOT_TTY"),
    ("/", "NOT_TTY"),
    (__file__, "NOT_TTY"),
])
def test_a_path_that_is_no_port_is_refused_for_what_it_is(opened: Opener, path: str, code: str) -> None:
    assert opened(path).code == getattr(lib, f"DPM_E_{code}")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_port_of_somebody_else_is_refused(opened: Opener, tmp_path: Path) -> None:
    path = tmp_path / "port"
    path.touch(mode=0)
    assert opened(str(path)).code == lib.DPM_E_PERMISSION


@pytest.mark.parametrize("wrong", [{"rate": 0}, {"rate": Fraction(1, 2)}, {"profile": 4}, {"profile": -1}, {"echo": 3},
                                   {"pace": 3}, {"direction": 3}])
def test_a_setting_out_of_range_is_refused(opened: Opener, wrong: dict[str, Any]) -> None:
    assert opened(**wrong).code == lib.DPM_E_ARGUMENT


def test_a_port_is_opened_once(opened: Opener) -> None:
    first = opened()
    assert first.code == 0
    assert opened(first.path).code == lib.DPM_E_IN_USE
    lib.dpm_port_close(first.port)
    assert opened(first.path).code == 0


def test_what_one_program_wrote_is_not_thrown_away_by_the_next_that_opens(opened: Opener) -> None:
    """Global_Control has no answer: a program may end straight behind it, before the hub has read it."""
    first = opened(echo=lib.DPM_ECHO_OFF)
    while first.write(bytes(255)) == 0 and first.recorder.take("sent")[0][3] == lib.DPM_SENT_WHOLE:
        pass
    written = first.info.octets_out
    keep = os.open(first.path, os.O_RDWR | os.O_NOCTTY)  # as a hub does, so that the close is not the last
    lib.dpm_port_close(first.port)
    assert opened(first.path).code == 0
    read = 0
    while read < written:
        assert select.select([first.far], [], [], 5.0)[0], f"{read} octets of {written} are left"
        read += len(os.read(first.far, 65536))
    os.close(keep)


def test_a_forked_child_does_not_keep_the_lock(opened: Opener) -> None:
    first = opened()
    ready, go = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(go)
        os.read(ready, 1)  # until the parent is done
        os._exit(0)
    os.close(ready)
    lib.dpm_port_close(first.port)
    assert opened(first.path).code == 0
    os.close(go)
    os.waitpid(child, 0)


def test_the_descriptor_does_not_reach_other_programs(opened: Opener) -> None:
    fd = lib.dpm_port_fd(opened().port)
    listing = subprocess.run([sys.executable, "-c", "import os; print(os.listdir('/proc/self/fd'))"],
                             capture_output=True, check=True, text=True, close_fds=False)
    assert f"'{fd}'" not in listing.stdout


def test_a_small_or_crooked_block_is_refused() -> None:
    start = block(lib.dpm_port_size() + 16)
    config, out = ffi.new("dpm_port_config *"), ffi.new("dpm_port **")
    assert lib.dpm_port_open(start, lib.dpm_port_size() - 1, config, out) == lib.DPM_E_BLOCK
    assert lib.dpm_port_open(ffi.cast("char *", start) + 8, lib.dpm_port_size(), config, out) == lib.DPM_E_BLOCK
    assert lib.dpm_port_open(ffi.NULL, lib.dpm_port_size(), config, out) == lib.DPM_E_BLOCK


def test_the_line_is_raw_and_a_pty_without_parity_is_accepted(opened: Opener) -> None:
    """Protocol page N.1: CS8, no PARODD, CSTOPB or CRTSCTS, CLOCAL and CREAD, VTIME 0. Design: a pty drops parity."""
    port = opened(rate=9600)
    iflag, oflag, cflag, lflag, _, _, cc = termios.tcgetattr(port.far)
    assert (iflag, oflag, lflag) == (0, 0, 0)
    assert cflag & termios.CSIZE == termios.CS8
    assert cflag & termios.CLOCAL and cflag & termios.CREAD
    assert not cflag & (termios.PARODD | termios.CSTOPB | termios.CRTSCTS)
    assert (cc[termios.VMIN], cc[termios.VTIME]) == (1, 0)
    assert port.info.parity == bool(cflag & termios.PARENB) and not port.info.parity


@pytest.mark.parametrize("rate", [9600, 45_450, 93_750, 187_500, 12_000_000])
def test_any_rate_is_set(opened: Opener, rate: int) -> None:
    """Protocol page N.1: struct termios2 with BOTHER. Its last two words are c_ispeed and c_ospeed."""
    termios2 = fcntl.ioctl(opened(rate=rate).far, 0x802C542A, bytes(44))  # TCGETS2
    assert struct.unpack("=36x2I", termios2) == (rate, rate)


@pytest.mark.parametrize("direction", ["RS485", "RS485_INVERTED"])
def test_a_driver_without_rs485_mode_is_an_error_that_leaves_the_port_free(opened: Opener, direction: str) -> None:
    """Protocol page N.2: TIOCSRS485 "returns the accepted set: check". A pty has none; test_uart shows a driver that has."""
    port = opened(direction=getattr(lib, f"DPM_DIRECTION_{direction}"))
    assert port.code == lib.DPM_E_RS485
    assert opened(port.path).code == 0


def test_a_pty_promises_nothing_of_a_driver(opened: Opener) -> None:
    info = opened(rate=93_750).info
    assert info.rate == 93_750
    assert not (info.rs485 or info.drains or info.low_latency or info.fifo_trigger or info.counted)


@pytest.mark.parametrize("direction", ["rts", "gpio17", True])
def test_a_pin_that_a_program_switches_is_refused_with_the_reason(direction: object) -> None:
    with pytest.raises(ConfigurationError, match=r"slaves answer 11 bit times after a request.*would talk over the answer"):
        Master("/dev/no-such-port", direction=direction)  # type: ignore[arg-type]


def test_the_profile_follows_the_path_and_may_be_overruled(opened: Opener) -> None:
    by_path, told = opened(), opened(profile=lib.DPM_PROFILE_USB, allowance=7)
    assert by_path.info.profile == lib.DPM_PROFILE_PTY
    assert by_path.info.traits.allowance > 0
    assert told.info.profile == lib.DPM_PROFILE_USB
    assert told.info.traits.allowance == 7
    assert told.info.traits.granularity > by_path.info.traits.granularity


# ---- receiving ----


def test_octets_come_with_the_interval_in_which_they_ended(opened: Opener) -> None:
    port = opened()
    before = lib.dpm_now()
    os.write(port.far, TOKEN)
    assert lib.dpm_port_wait(port.port, -1, lib.dpm_now() + 5_000_000_000) == 1
    assert port.read() == 3
    after = lib.dpm_now()
    ((octets, errors, earliest, latest, spacing, echo),) = port.recorder.take("octets")
    assert (octets, errors, spacing, echo) == (TOKEN, None, 0, False)
    assert before < latest <= after
    assert earliest == latest - port.info.traits.granularity
    assert port.info.octets_in == 3


def test_quiet_reaches_up_to_the_begin_of_the_read(opened: Opener) -> None:
    port = opened()
    before = lib.dpm_now()
    assert port.read() == 0
    ((until,),) = port.recorder.take("quiet")
    assert before <= until <= lib.dpm_now()


def test_a_port_with_a_fifo_vouches_for_the_past_only(opened: Opener) -> None:
    port = opened(profile=lib.DPM_PROFILE_UART)
    assert port.read() == 0
    ((until,),) = port.recorder.take("quiet")
    assert until <= lib.dpm_now() - port.info.traits.granularity


def test_a_port_that_hung_up_is_gone(opened: Opener) -> None:
    port = opened()
    port.hang_up()
    assert lib.dpm_port_wait(port.port, -1, lib.dpm_now() + 5_000_000_000) == 1
    assert port.read() == lib.DPM_E_GONE
    assert port.write(TOKEN) == lib.DPM_E_GONE
    assert port.recorder.take("sent")[0][3] == lib.DPM_SENT_FAILED


# ---- error marks ----


@pytest.fixture(scope="module")
def unmark(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[tuple[int, int]]]:
    """The decoder on its own, fed octet by octet: hex to pairs of octet and error bits."""
    folder = tmp_path_factory.mktemp("marks")
    program = folder / "unmark"
    source = folder / "main.c"
    source.write_text("""
        #include <stdio.h>
        #include "linux/marks.h"
        int main(void)
        {
            dpm_marks marks = {0};
            uint8_t raw, octets[3], errors[3];
            for (int octet; (octet = getchar()) != EOF;) {
                raw = (uint8_t)octet;
                size_t n = dpm_unmark(&marks, &raw, 1, octets, errors);
                for (size_t i = 0; i < n; i++)
                    printf("%u %u\\n", octets[i], errors[i]);
            }
        }""")
    subprocess.run(["cc", "-std=c11", "-D_GNU_SOURCE", f"-I{ROOT / 'include'}", f"-I{ROOT / 'csrc'}", str(source),
                    str(ROOT / "csrc/linux/marks.c"), "-o", str(program)], check=True)

    def run(raw: str) -> list[tuple[int, int]]:
        out = subprocess.run([str(program)], input=bytes.fromhex(raw), capture_output=True, check=True).stdout
        words = list(map(int, out.split()))
        return list(zip(words[::2], words[1::2], strict=True))

    return run


def test_marks_of_the_driver_become_line_errors(unmark: Callable[[str], list[tuple[int, int]]]) -> None:
    """Termios(3), PARMRK: a bad character arrives as FF 00 xx, a real FF as FF FF, a break as FF 00 00."""
    parity = lib.DPM_LINE_PARITY
    assert unmark("10 02 00 16") == [(0x10, 0), (0x02, 0), (0x00, 0), (0x16, 0)]
    assert unmark("FF FF 00 41") == [(0xFF, 0), (0x00, 0), (0x41, 0)]
    assert unmark("10 FF 00 41 16") == [(0x10, 0), (0x41, parity), (0x16, 0)]
    assert unmark("FF 00 FF FF FF") == [(0xFF, parity), (0xFF, 0)]
    assert unmark("FF 00 00 00") == [(0x00, parity | lib.DPM_LINE_BREAK), (0x00, 0)]
    assert unmark("16 FF") == [(0x16, 0)]
    overrun = lib.DPM_LINE_OVERRUN
    assert unmark("FF 41 10") == [(0xFF, overrun), (0x41, overrun), (0x10, 0)]


# ---- error marks on a pty: the segment hub makes them ----


@dataclass
class Wire:
    """A segment, and a program on it that knows no marks."""

    segment: Segment
    program: int

    def say(self, octets: bytes) -> None:
        os.write(self.program, octets)

    def hear(self, port: Port, n: int) -> list[tuple[int, int]]:
        """The next n octets that a port of ours reads, each with its line errors."""
        heard: list[tuple[int, int]] = []
        while len(heard) < n and lib.dpm_port_wait(port.port, -1, lib.dpm_now() + 5_000_000_000):
            assert port.read() > 0
            for octets, errors, *_ in port.recorder.take("octets"):
                heard += zip(octets, errors or bytes(len(octets)), strict=True)
        return heard


@pytest.fixture
def wire() -> Iterator[Wire]:
    with Segment(cards=0) as segment:
        program = os.open(segment.port(), os.O_RDWR | os.O_NOCTTY)
        tty.setraw(program)
        yield Wire(segment, program)
        os.close(program)


ALL = bytes(range(256)) + bytes.fromhex("FF 00 41 FF FF 00 00 FF")


def test_every_octet_passes_from_a_foreign_program_to_a_port_and_back(wire: Wire, opened: Opener) -> None:
    """Ours reads FF 00 41 as three good octets, the other never sees an FF twice."""
    port = opened(wire.segment.port())
    wire.say(ALL)
    assert wire.hear(port, len(ALL)) == [(octet, 0) for octet in ALL]
    assert port.write(ALL[200:]) == 0
    assert os.read(wire.program, 100) == ALL[200:]
    assert port.info.line_errors == 0


def test_a_parity_error_is_a_line_error_to_a_port_and_a_wrong_octet_to_a_foreign_program(wire: Wire, opened: Opener) -> None:
    """As from a UART: with INPCK the character is marked, without it nobody is told."""
    port = opened(wire.segment.port())
    wire.segment.faults(parity=1.0)
    wire.say(ALL)
    heard = wire.hear(port, len(ALL))
    assert all((octet ^ sent).bit_count() == 1 for (octet, _), sent in zip(heard, ALL, strict=True))
    assert all(errors & lib.DPM_LINE_PARITY for _, errors in heard)
    assert port.info.line_errors == len(ALL)
    assert port.write(TOKEN) == 0
    assert all((a ^ b).bit_count() == 1 for a, b in zip(os.read(wire.program, 10), TOKEN, strict=True))


def test_two_that_talk_at_once_are_line_errors(opened: Opener) -> None:
    """9.6 kbit/s: the second begins while the first, of 290 ms, is on the wire."""
    with Segment(9600, cards=0) as segment:
        a, b, ear = (opened(segment.port(), rate=9600) for _ in range(3))
        assert a.write(bytes(250)) == b.write(bytes(250)) == 0
        assert any(errors & lib.DPM_LINE_PARITY for _, errors in Wire(segment, -1).hear(ear, 400))
        assert ear.info.line_errors > 0


def test_a_port_that_was_killed_leaves_no_marks_to_the_next_program(wire: Wire) -> None:
    path = str(wire.segment.port())
    program = f"from dpmaster import Listener; ear = Listener({path!r}, 500_000); print('open', flush=True); input()"
    with child("-c", program, stdin=subprocess.PIPE) as killed:
        assert killed.stdout.readline() == "open\n"
        wire.segment.faults(parity=1.0)
        wire.say(TOKEN)
        killed.kill()
    wire.segment.faults()
    next_one = os.open(path, os.O_RDWR | os.O_NOCTTY)
    _ = wire.segment.info  # on the hub's thread, behind the open
    termios.tcflush(next_one, termios.TCIFLUSH)
    wire.say(ALL)
    heard = b""
    while len(heard) < len(ALL) and select.select([next_one], [], [], 5)[0]:
        heard += os.read(next_one, 512)
    os.close(next_one)
    assert heard == ALL


def test_what_an_adapter_gathered_for_one_program_is_not_the_next_ones(wire: Wire, opened: Opener) -> None:
    """Nor with the marks that only the first one knows."""
    path = str(wire.segment.port())
    first = opened(path)
    wire.segment.faults(chunk=0.3)
    wire.say(ALL[200:])
    until(lambda: wire.segment.info.deliveries == 1)
    lib.dpm_port_close(first.port)
    next_one = os.open(path, os.O_RDWR | os.O_NOCTTY)
    _ = wire.segment.info
    wire.say(TOKEN)
    assert select.select([next_one], [], [], 5)[0] and os.read(next_one, 512) == TOKEN
    os.close(next_one)


def test_a_pty_without_a_hub_is_read_as_it_is(opened: Opener) -> None:
    """Nobody marks there: FF 00 41 is three octets."""
    assert opened().hear(ALL) == ALL


# ---- sending ----


def test_an_unpaced_transmission_ends_when_write_returns(opened: Opener) -> None:
    port = opened(pace=lib.DPM_PACE_NONE, rate=9600)
    assert port.write(TOKEN) == 0
    ((start, earliest, latest, result),) = port.recorder.take("sent")
    assert start < earliest == latest <= lib.dpm_now()
    assert result == lib.DPM_SENT_WHOLE
    assert os.read(port.far, 16) == TOKEN
    assert port.info.octets_out == 3


def test_a_paced_transmission_ends_after_eleven_bits_a_character(opened: Opener) -> None:
    port = opened(pace=lib.DPM_PACE_BAUD, rate=9600)
    before = lib.dpm_now()
    port.write(TOKEN)
    after = lib.dpm_now()
    ((start, earliest, latest, _),) = port.recorder.take("sent")
    duration = -(-11 * 1_000_000_000 // 9600) * 3
    assert earliest == start + duration
    assert before + duration <= earliest <= latest <= after + duration


def test_of_a_pty_of_unknown_pace_the_end_is_an_interval(opened: Opener) -> None:
    port = opened(rate=9600)
    port.write(TOKEN)
    ((start, earliest, latest, _),) = port.recorder.take("sent")
    assert earliest <= lib.dpm_now()
    assert latest == max(earliest, start + 3 * -(-11 * 1_000_000_000 // 9600))


def test_a_full_port_cuts_or_refuses_a_telegram(opened: Opener) -> None:
    port = opened(echo=lib.DPM_ECHO_OFF)
    results = []
    while lib.DPM_SENT_FAILED not in results:
        assert port.write(bytes(255)) == 0
        results.append(port.recorder.take("sent")[0][3])
    accepted = port.info.octets_out
    assert results.count(lib.DPM_SENT_WHOLE) * 255 <= accepted
    assert results.count(lib.DPM_SENT_CUT) <= 1
    assert (accepted % 255 != 0) == (lib.DPM_SENT_CUT in results)


def writes() -> int:
    """Calls of write(2) by this thread so far, as the kernel counts them."""
    path = Path("/proc/thread-self/io")
    if not path.exists():
        pytest.skip(f"this kernel has no {path}")
    return int(next(line for line in path.read_text().splitlines() if line.startswith("syscw")).split()[1])


def test_a_telegram_is_one_write(opened: Opener) -> None:
    """No pause inside a telegram: what a UART is given in two calls may leave it with a gap, which slaves take for its end."""
    port = opened(echo=lib.DPM_ECHO_OFF)
    lengths = (1, 3, 6, 64, 255)  # SC to the longest SD2
    before = writes()
    for length in lengths:
        assert port.write(bytes(length)) == 0
    assert writes() - before == len(lengths)
    assert [entry[3] for entry in port.recorder.take("sent")] == [lib.DPM_SENT_WHOLE] * len(lengths)


# ---- echo ----


REQUEST = bytes.fromhex("10 05 02 49 50 16")  # Request FDL Status 2 -> 5
ANSWER = bytes.fromhex("10 02 05 00 07 16")
PATIENT = 20_000_000_000  # ns that a computer which is busy with something else may keep an echo waiting


def test_an_echo_is_found_out_and_marked(opened: Opener) -> None:
    """Design: octets carry "where the port knows it, the mark 'echo of ours'"."""
    port = opened(allowance=PATIENT)
    port.write(REQUEST)
    assert port.hear(REQUEST, echo=True) == REQUEST
    assert port.hear(ANSWER) == ANSWER
    assert (port.info.echo_octets, port.info.echo_errors) == (6, 0)


def test_an_echo_and_the_answer_behind_it_are_told_apart_in_one_read(opened: Opener) -> None:
    port = opened(allowance=PATIENT)
    port.write(REQUEST)
    assert port.hear(REQUEST + ANSWER) == ANSWER
    assert port.info.echo_octets == 6


def test_an_echo_may_come_in_pieces(opened: Opener) -> None:
    port = opened(allowance=PATIENT)
    port.write(REQUEST)
    for octet in REQUEST[:-1]:
        assert port.hear(bytes([octet])) == b""
        assert port.read() == 0
        assert port.recorder.take("quiet") == []  # octets are held back: nothing is said about the line
    assert port.hear(REQUEST[-1:]) == b""
    assert port.read() == 0
    assert len(port.recorder.take("quiet")) == 1
    assert port.info.echo_octets == 6


def test_an_echo_is_found_behind_the_next_transmissions(opened: Opener) -> None:
    """Protocol page N.3: USB frames of 1 ms. A claimed token goes out twice and a request follows, each after Tid1."""
    port = opened()
    for octets in (TOKEN, TOKEN, REQUEST):
        port.write(octets)
    assert port.hear(TOKEN[:2], echo=True) == b""
    assert port.hear(TOKEN[2:] + TOKEN + REQUEST + ANSWER) == ANSWER
    assert (port.info.echoes, port.info.echo_octets, port.info.echo_errors) == (3, 12, 0)


@pytest.mark.parametrize("heard", [ANSWER, b"\xE5", TOKEN[:1] + ANSWER, TOKEN[:2] + ANSWER])
def test_where_no_echo_came_an_answer_is_given_whole(opened: Opener, heard: bytes) -> None:
    port = opened()
    for octets in (TOKEN, TOKEN, REQUEST, REQUEST, REQUEST):
        port.write(octets)
    assert port.hear(heard) == heard
    assert port.hear(REQUEST) == REQUEST
    assert (port.info.echo_octets, port.info.echo_errors) == (0, 0)


def test_the_token_to_oneself_heard_back_is_an_echo(opened: Opener) -> None:
    port = opened(allowance=PATIENT)
    port.write(TOKEN)
    assert port.hear(TOKEN) == b""
    assert port.hear(TOKEN) == TOKEN  # the second one is somebody else's
    assert port.info.echo_octets == 3


def test_what_differs_after_some_octets_is_given_whole(opened: Opener) -> None:
    port = opened(allowance=PATIENT)
    port.write(REQUEST)
    assert port.hear(ANSWER) == ANSWER  # both begin with SD1
    assert port.info.echo_octets == port.info.echo_errors == 0
    port.write(REQUEST)
    assert port.hear(REQUEST[:3]) == b""
    assert port.hear(ANSWER) == REQUEST[:3] + ANSWER


def test_octets_held_back_are_given_before_the_next_write(opened: Opener) -> None:
    port = opened(allowance=PATIENT)
    port.write(REQUEST)
    assert port.hear(REQUEST[:3]) == b""
    port.write(REQUEST)
    assert port.recorder.log[0][:2] == ("octets", REQUEST[:3])


def test_octets_held_back_are_given_when_no_echo_can_come_any_more(opened: Opener) -> None:
    port = opened(allowance=0, pace=lib.DPM_PACE_NONE)
    port.write(REQUEST)
    os.write(port.far, REQUEST[:3])
    select.select([lib.dpm_port_fd(port.port)], [], [], 5.0)
    assert port.read() == 3
    assert port.read() == 0
    kinds = [entry[0] for entry in port.recorder.log if entry[0] != "sent"]
    assert kinds == ["octets", "quiet"]
    assert port.recorder.received() == REQUEST[:3]


def test_where_an_echo_is_due_anything_else_is_counted(opened: Opener) -> None:
    port = opened(echo=lib.DPM_ECHO_ON, allowance=PATIENT)
    port.write(REQUEST)
    port.write(REQUEST)
    port.write(REQUEST)  # the one before was not heard at all
    assert port.hear(REQUEST, echo=True) == REQUEST
    port.write(REQUEST)
    assert port.hear(ANSWER) == ANSWER
    assert (port.info.echo_octets, port.info.echo_errors) == (6, 3)


@pytest.mark.parametrize("spoilt", ["10 05 02 49 51 16", "10 FF 02 49 50 16", "10 05 02 49 50 00"])
def test_an_echo_that_differs_here_and_there_is_ours_and_spoilt(opened: Opener, spoilt: str) -> None:
    """A collision or a short: nobody else's telegram, and the machine that has sent it compares."""
    port = opened(echo=lib.DPM_ECHO_ON, allowance=PATIENT)
    port.write(REQUEST)
    assert port.hear(bytes.fromhex(spoilt) + ANSWER) == ANSWER
    port.write(REQUEST)
    assert port.hear(bytes.fromhex(spoilt), echo=True) == bytes.fromhex(spoilt)
    assert (port.info.echo_octets, port.info.echo_errors) == (10, 2)


def test_what_is_left_of_an_echo_is_given_when_no_more_can_come(opened: Opener) -> None:
    port = opened(echo=lib.DPM_ECHO_ON, allowance=0, pace=lib.DPM_PACE_NONE)
    port.write(REQUEST)
    os.write(port.far, REQUEST[:4])
    select.select([lib.dpm_port_fd(port.port)], [], [], 5.0)
    assert port.read() == 4
    assert port.read() == 0
    assert port.recorder.received(echo=True) == REQUEST[:4]
    assert port.info.echo_errors == 1


def test_a_port_that_was_told_of_its_echo_says_so(opened: Opener) -> None:
    assert opened(echo=lib.DPM_ECHO_ON).info.traits.echo
    assert not opened().info.traits.echo


def test_an_echo_once_found_is_expected(opened: Opener) -> None:
    port = opened(allowance=PATIENT)
    port.write(REQUEST)
    assert port.hear(REQUEST) == b""
    port.write(REQUEST)
    assert port.hear(ANSWER) == ANSWER
    assert port.info.echo_errors == 1


def test_with_echo_off_everything_is_given(opened: Opener) -> None:
    port = opened(echo=lib.DPM_ECHO_OFF)
    port.write(REQUEST)
    assert port.hear(REQUEST) == REQUEST
    assert port.info.echo_octets == 0


# ---- waiting ----


def test_a_wait_ends_at_its_deadline_not_before(opened: Opener) -> None:
    port = opened()
    late = []
    for step in (0, 1_000, 30_000, 100_000, 1_000_000, 2_000_000) * 5:
        deadline = lib.dpm_now() + step
        assert lib.dpm_port_wait(port.port, -1, deadline) == 0
        late.append(lib.dpm_now() - deadline)
    assert min(late) >= 0
    # Others may take the processor away at any time, but not at every one of thirty deadlines.
    assert min(late) < 1_000_000


def test_octets_end_a_wait_in_the_sleep_and_in_the_spin(opened: Opener) -> None:
    port = opened()
    os.write(port.far, b"\xE5")
    assert select.select([lib.dpm_port_fd(port.port)], [], [], 5.0)[0]
    for step in (10_000, 5_000_000_000):
        deadline = lib.dpm_now() + step
        assert lib.dpm_port_wait(port.port, -1, deadline) == 1
    assert lib.dpm_now() < deadline
    assert lib.dpm_port_wait(port.port, -1, lib.DPM_NEVER) == 1


def test_the_other_descriptor_ends_a_wait(opened: Opener) -> None:
    port = opened()
    wake = os.eventfd(1, os.EFD_CLOEXEC)
    assert lib.dpm_port_wait(port.port, wake, lib.DPM_NEVER) == 2
    os.write(port.far, b"\xE5")
    select.select([lib.dpm_port_fd(port.port)], [], [], 5.0)
    assert lib.dpm_port_wait(port.port, wake, lib.DPM_NEVER) == 3
    os.close(wake)
