# SPDX-License-Identifier: MIT
"""The segment hub over real ptys: who hears what, clients that come and go, faults, attached cards, and its end.

What is on the wire when is proven on virtual time in test_segment_wire.py; here only bounds that a late host cannot break.
"""

from __future__ import annotations

import fcntl
import os
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from leftovers import nothing_left_behind
from waiting import until

from dpmaster import errors
from dpmaster.emulator import Card, Exchange, Line, PortPath, Segment, SlaveState

FDL_STATUS = bytes.fromhex("10 05 02 49 50 16")  # protocol page B.4 #1
FDL_STATUS_ANSWER = bytes.fromhex("10 02 05 00 07 16")  # B.4 #2
SLAVE_DIAG = bytes.fromhex("68 05 05 68 85 82 6D 3C 3E EE 16")  # B.4 #5
PATIENCE = 5.0  # s; only a failing test waits so long


class Client:
    """A program at a port."""

    def __init__(self, path: str, segment: Segment | None = None) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        if segment is not None:
            _ = segment.info  # runs on the hub's thread behind the open: from here on it is heard

    def write(self, octets: bytes) -> None:
        assert os.write(self.fd, octets) == len(octets)

    def read(self, n: int) -> bytes:
        """Exactly n octets, or what came within PATIENCE."""
        octets, deadline = b"", time.monotonic() + PATIENCE
        while len(octets) < n and select.select([self.fd], [], [], max(0.0, deadline - time.monotonic()))[0]:
            octets += os.read(self.fd, n - len(octets))
        return octets

    def empty(self) -> bool:
        return not select.select([self.fd], [], [], 0)[0]

    def close(self) -> None:
        os.close(self.fd)


@pytest.fixture
def open_port() -> Iterator[Callable[..., Client]]:
    clients: list[Client] = []

    def opened(path: str, segment: Segment | None = None) -> Client:
        clients.append(Client(path, segment))
        return clients[-1]

    yield opened
    for client in clients:
        client.close()


@pytest.fixture(autouse=True)
def tidy() -> Iterator[None]:
    with nothing_left_behind():
        yield


class Echo(Card):
    """Gives back its outputs, inverted."""

    ident_number = 0x4711
    configurations = (bytes([0x10, 0x20]), bytes([0x11, 0x21]))  # one or two octets each way
    user_parameters = (0, 8)

    def __init__(self, address: int = 5) -> None:
        self.address = address
        self.steps: list[Exchange] = []
        self.resets = 0
        self.fault: Exception | None = None

    def step(self, now: float, exchange: Exchange) -> bytes:
        self.steps.append(exchange)
        if self.fault:
            raise self.fault
        return bytes(octet ^ 0xFF for octet in exchange.outputs)

    def next_step(self, now: float) -> float:
        return now + 0.02

    def reset(self, now: float) -> None:
        self.resets += 1



# --- who hears what


def test_what_one_port_writes_all_others_hear(open_port: Callable[..., Client]) -> None:
    with Segment(cards=0) as wire:
        a, b, c = (open_port(wire.port(), wire) for _ in range(3))
        a.write(FDL_STATUS)
        assert b.read(6) == c.read(6) == FDL_STATUS
        b.write(FDL_STATUS_ANSWER)
        assert a.read(6) == FDL_STATUS_ANSWER and c.read(6) == FDL_STATUS_ANSWER
        assert b.empty(), "without echo nobody hears itself"
        assert (wire.info.transmissions, wire.info.octets) == (2, 12)


def test_every_octet_passes_unchanged(open_port: Callable[..., Client]) -> None:
    """A line discipline that is not raw would eat XON, ^C, CR or the like."""
    with Segment(cards=0) as wire:
        a, b = (open_port(wire.port(), wire) for _ in range(2))
        a.write(bytes(range(256)))
        assert b.read(256) == bytes(range(256))
        assert a.empty()


@pytest.mark.parametrize("baudrate", [None, 500_000])
def test_echo(baudrate: int | None, open_port: Callable[..., Client]) -> None:
    with Segment(baudrate, echo=True, cards=0) as wire:
        a, b = (open_port(wire.port(), wire) for _ in range(2))
        a.write(FDL_STATUS)
        assert a.read(6) == b.read(6) == FDL_STATUS


def test_order_is_kept(open_port: Callable[..., Client]) -> None:
    with Segment(12_000_000, cards=0) as wire:
        a, b = (open_port(wire.port(), wire) for _ in range(2))
        sent = b"".join(number.to_bytes(2, "big") for number in range(2000))
        for i in range(0, len(sent), 100):
            a.write(sent[i : i + 100])
        assert b.read(len(sent)) == sent


# --- pace


def test_nothing_is_delivered_before_its_last_octet_would_have_ended(open_port: Callable[..., Client]) -> None:
    """6 characters of 11 bits at 9600 bit/s last 6.875 ms."""
    with Segment(9600, cards=0) as wire:
        a, b = (open_port(wire.port(), wire) for _ in range(2))
        for _ in range(5):
            begin = time.monotonic()
            a.write(FDL_STATUS)
            assert b.read(1) == FDL_STATUS[:1]
            assert time.monotonic() - begin >= 6 * 11 / 9600
            assert b.read(5) == FDL_STATUS[1:], "the telegram comes whole"
        assert wire.info.deliveries == 5 and wire.info.late_max >= wire.info.late_mean >= 0


def test_two_that_talk_at_once_garble_each_other(open_port: Callable[..., Client]) -> None:
    with Segment(9600, cards=0) as wire:
        a, b, c = (open_port(wire.port(), wire) for _ in range(3))
        a.write(b"\xf0" * 200)  # 229 ms: the other certainly begins meanwhile
        until(lambda: wire.info.transmissions)
        b.write(b"\x0f" * 10)
        first = c.read(10)
        second = c.read(200)
        assert b"\x00" in first and len(first + second) == 210
        assert 10 <= (first + second).count(0) <= 22
        assert wire.info.collisions == 2


# --- clients


def test_a_client_that_dies_leaves_the_port_to_the_next(open_port: Callable[..., Client]) -> None:
    """Also after TIOCEXCL and a cooked line discipline, which a killed program cannot undo."""
    with Segment(cards=0) as wire:
        path, other = wire.port(), open_port(wire.port(), wire)
        for _ in range(3):
            client = Client(path, wire)
            settings = termios.tcgetattr(client.fd)
            settings[3] |= termios.ECHO | termios.ICANON
            termios.tcsetattr(client.fd, termios.TCSANOW, settings)
            fcntl.ioctl(client.fd, termios.TIOCEXCL)
            client.write(FDL_STATUS)
            assert other.read(6) == FDL_STATUS
            client.close()
            _ = wire.info
            other.write(b"while nobody is there")
            until(lambda: wire.info.octets % 27 == 0)
        client = open_port(path, wire)
        assert not exclusive(client.fd)
        assert not termios.tcgetattr(client.fd)[3] & (termios.ECHO | termios.ICANON)
        other.write(FDL_STATUS_ANSWER)
        assert client.read(6) == FDL_STATUS_ANSWER, "and nothing that was said before it came"


def exclusive(fd: int) -> bool:
    return bool(int.from_bytes(fcntl.ioctl(fd, 0x80045440, bytes(4)), sys.byteorder))  # TIOCGEXCL


def test_an_abandoned_port_costs_no_cpu() -> None:
    """A master end whose slave end is closed is readable for ever (EIO): the hub must not spin on it."""
    with Segment(cards=0) as wire:
        Client(wire.port(), wire).close()
        _ = wire.info
        task = Path("/proc/self/task")
        before = sum(ticks(path) for path in task.iterdir())
        select.select([], [], [], 0.3)
        assert sum(ticks(path) for path in task.iterdir()) - before <= 0.1 * os.sysconf("SC_CLK_TCK")


def ticks(task: Path) -> int:
    fields = (task / "stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def test_a_reader_that_never_reads_blocks_nobody(open_port: Callable[..., Client]) -> None:
    with Segment(cards=0) as wire:
        a, b = (open_port(wire.port(), wire) for _ in range(2))
        open_port(wire.port(), wire)  # never reads
        for _ in range(1000):
            a.write(bytes(200))
            assert len(b.read(200)) == 200
        assert wire.info.undelivered > 0


def test_cut_and_join(open_port: Callable[..., Client]) -> None:
    with Segment(cards=0) as wire:
        paths = [wire.port() for _ in range(3)]
        a, b, c = (open_port(path, wire) for path in paths)
        wire.cut(paths[1])
        a.write(b"1")
        assert c.read(1) == b"1"
        b.write(b"lost")
        until(lambda: wire.info.undelivered == 4)
        wire.join(paths[1])
        b.write(b"3")
        assert a.read(1) == c.read(1) == b"3"
        a.write(b"2")
        assert b.read(1) == b"2"
        with pytest.raises(errors.ConfigurationError, match=r"/dev/nothing.*none of this segment's"):
            wire.cut("/dev/nothing")


# --- faults


@pytest.mark.parametrize("baudrate", [None, 12_000_000])
def test_the_same_seed_makes_the_same_faults(baudrate: int | None, open_port: Callable[..., Client]) -> None:
    heard = []
    for seed in (1, 1, 2):
        with Segment(baudrate, cards=0) as wire:
            a, b = (open_port(wire.port(), wire) for _ in range(2))
            wire.faults(seed=seed, lose=0.05, flip=0.05, insert=0.05, duplicate=0.05)
            a.write(bytes(range(200)))
            until(lambda wire=wire: wire.info.octets)  # type: ignore[misc]
            heard.append(b.read(wire.info.octets))
            assert wire.info.faults > 0
            wire.faults()
            a.write(FDL_STATUS)
            assert b.read(6) == FDL_STATUS, "no fault when they are off"
    assert heard[0] == heard[1] != heard[2]


def test_delay(open_port: Callable[..., Client]) -> None:
    with Segment(cards=0) as wire:
        a, b = (open_port(wire.port(), wire) for _ in range(2))
        wire.faults(delay=0.05)
        begin = time.monotonic()
        a.write(b"x")
        assert b.read(1) == b"x" and time.monotonic() - begin >= 0.05


@pytest.mark.parametrize("fault", [{"lose": 1.5}, {"flip": -0.1}, {"delay": -1.0}, {"delay": 11.0}])
def test_a_fault_out_of_range_is_named(fault: dict[str, float]) -> None:
    name, value = next(iter(fault.items()))
    with Segment(cards=0) as wire, pytest.raises(errors.ConfigurationError, match=f"{name} {value}"):
        wire.faults(**fault)  # type: ignore[arg-type]


# --- cards


@pytest.mark.parametrize("baudrate", [None, 500_000])
def test_an_attached_card_answers_fdl_status(baudrate: int | None, open_port: Callable[..., Client]) -> None:
    """Protocol page B.4 #1 and #2."""
    with Segment(baudrate) as wire:
        wire.attach(Echo(5))
        master, monitor = (open_port(wire.port(), wire) for _ in range(2))
        for _ in range(3):
            master.write(FDL_STATUS)
            assert master.read(6) == FDL_STATUS_ANSWER
        assert monitor.read(36) == (FDL_STATUS + FDL_STATUS_ANSWER) * 3


def test_an_unplugged_card_is_silent_and_a_plugged_one_answers(open_port: Callable[..., Client]) -> None:
    with Segment() as wire:
        card, other = wire.attach(Echo(5)), wire.attach(Echo(8))
        master = open_port(wire.port(), wire)
        wire.unplug(card)
        master.write(FDL_STATUS)
        master.write(bytes.fromhex("10 08 02 49 53 16"))  # B.4 #36: the other one still answers
        assert master.read(6) == bytes.fromhex("10 02 08 00 0A 16")
        assert wire.report(card).state is SlaveState.OFF and wire.report(other).state is SlaveState.WAIT_PRM
        wire.plug(card)
        master.write(FDL_STATUS)
        assert master.read(6) == FDL_STATUS_ANSWER


def start_up(master: Client) -> None:
    """Set_Prm (lock, no watchdog, ident 4711) and Chk_Cfg 11 21 from master 2 to slave 5, first octets of B.4 #25, #9."""
    master.write(sd2("85 82 5D 3D 3E 80 01 01 00 47 11 00"))
    assert master.read(1) == b"\xe5"
    master.write(sd2("85 82 7D 3E 3E 11 21"))
    assert master.read(1) == b"\xe5"


def sd2(text: str) -> bytes:
    body = bytes.fromhex(text)
    return bytes([0x68, len(body), len(body), 0x68]) + body + bytes([sum(body) & 0xFF, 0x16])


def test_a_card_sees_its_exchange_and_its_octets_go_back(open_port: Callable[..., Client]) -> None:
    with Segment() as wire:
        card = wire.attach(Echo(5))
        master = open_port(wire.port(), wire)
        start_up(master)
        assert (wire.report(card).master, wire.report(card).configuration) == (2, 1)
        master.write(bytes.fromhex("68 05 05 68 85 82 5D 3C 3E DE 16"))  # B.4 #10: Slave_Diag, then the exchange may begin
        assert master.read(4)[0] == 0x68 and len(master.read(13)) == 13
        master.write(sd2("05 02 7D 0F F0"))
        assert len(master.read(11)) == 11
        until(lambda: card.steps[-1].outputs == b"\x0f\xf0")
        last = card.steps[-1]
        assert (last.state, last.configuration, last.master) == (SlaveState.DATA_EXCH, 1, 2)
        until(lambda: wire._slots[0].octets == b"\xf0\x0f")
        master.write(sd2("05 02 5D 0F F0"))
        assert master.read(11)[7:9] == b"\xf0\x0f"


def test_an_idle_card_is_stepped_by_its_own_time() -> None:
    with Segment() as wire:
        card = wire.attach(Echo())
        until(lambda: len(card.steps) > 3)


def test_reset_restarts_the_card(open_port: Callable[..., Client]) -> None:
    with Segment() as wire:
        card = wire.attach(Echo(5))
        start_up(open_port(wire.port(), wire))
        wire.reset(card)
        assert card.resets == 1 and wire.report(card).state is SlaveState.WAIT_PRM
        until(lambda: card.steps and card.steps[-1].master is None)


def test_a_card_that_fails_is_unplugged_and_its_error_comes_out(caplog: pytest.LogCaptureFixture) -> None:
    wire = Segment()
    card, other = wire.attach(Echo(5)), wire.attach(Echo(6))
    card.fault = ZeroDivisionError("the firmware")
    until(lambda: wire.info.failures)
    assert wire.report(card).state is SlaveState.OFF and wire.report(other).state is not SlaveState.OFF
    with pytest.raises(errors.DPError, match="the firmware"):
        wire.check()
    with pytest.raises(errors.DPError, match="the firmware"):
        wire.close()
    wire.close()
    assert "Echo at address 5 failed" in caplog.text


def test_a_second_card_at_an_address_is_refused() -> None:
    with Segment() as wire:
        wire.attach(Echo(5))
        with pytest.raises(errors.ConfigurationError, match=r"address 5.*taken"):
            wire.attach(Echo(5))
        with pytest.raises(errors.ConfigurationError, match="0 to 126"):
            wire.attach(Echo(127))


def test_more_than_was_asked_for_is_refused_with_the_remedy() -> None:
    with Segment(ports=1, cards=1) as wire:
        wire.port()
        with pytest.raises(errors.ConfigurationError, match=r"Segment\(ports=2\)"):
            wire.port()
        wire.attach(Echo(5))
        with pytest.raises(errors.ConfigurationError, match=r"Segment\(cards=2\)"):
            wire.attach(Echo(6))


# --- life


@pytest.mark.parametrize("argument", [{"ports": 65}, {"ports": -1}, {"cards": 127}, {"baudrate": 12345}])
def test_a_bad_argument_is_named(argument: dict[str, int]) -> None:
    name, value = next(iter(argument.items()))
    with pytest.raises(errors.ConfigurationError, match=f"{name} {value}"):
        Segment(**argument)  # type: ignore[arg-type]


def test_ports_know_their_wire() -> None:
    with Segment(500_000, cards=0) as paced, Segment(cards=0) as unpaced:
        port = paced.port()
        assert isinstance(port, PortPath) and port.paced and port.baudrate == 500_000
        assert port.startswith("/dev/pts/") and not unpaced.port().paced


def test_close_hangs_up_and_every_call_behind_it_raises(open_port: Callable[..., Client]) -> None:
    wire = Segment()
    card, path = wire.attach(Echo()), wire.port()
    client = open_port(path, wire)
    wire.close()
    wire.close()
    with pytest.raises(OSError, match=r"Input/output|Errno 5"):
        client.write(b"x")
    calls: list[Callable[[], object]] = [wire.port, wire.faults, lambda: wire.cut(path), lambda: wire.attach(Echo(7)),
                                         lambda: wire.report(card), lambda: wire.reset(card), wire.check, wire.__enter__]
    for call in calls:
        with pytest.raises(errors.ClosedError):
            call()
    assert wire.info.octets == 0, "the last counters stay"


def test_after_fork_every_call_raises_and_close_touches_nothing(open_port: Callable[..., Client]) -> None:
    with Segment() as wire:
        card = wire.attach(Echo(5))
        client = open_port(wire.port(), wire)
        child = os.fork()
        if child == 0:
            code = 1
            try:
                calls: list[Callable[[], object]] = [wire.port, lambda: wire.info, lambda: wire.report(card), wire.check]
                for call in calls:
                    with pytest.raises(errors.ClosedError, match="forked"):
                        call()
                wire.close()
                code = 0
            finally:
                os._exit(code)
        assert os.waitpid(child, 0)[1] == 0
        client.write(FDL_STATUS)
        assert client.read(6) == FDL_STATUS_ANSWER


def test_a_segment_left_open_does_not_hold_the_interpreter() -> None:
    program = ("from dpmaster.emulator import Segment\nfrom dpmaster.emulator.cards import SIP1\n"
               "wire = Segment(); wire.attach(SIP1(address=5)); print(wire.port())")
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20)
    assert (result.returncode, result.stderr) == (0, "") and result.stdout.startswith("/dev/pts/")


def test_signals_are_left_to_the_program() -> None:
    """The hub's thread blocks all signals: a signal to the process reaches Python's main thread."""
    with Segment():
        masks = {path.name: int(line.split()[1], 16) for path in Path("/proc/self/task").iterdir()
                 for line in (path / "status").read_text().splitlines() if line.startswith("SigBlk")}
        hub = [mask for mask in masks.values() if mask & (1 << (signal.SIGTERM - 1)) and mask & (1 << (signal.SIGINT - 1))]
        assert len(hub) == 1 and len(masks) >= 3 and threading.active_count() == 2


# --- the commands, as real processes


class Command:
    """A running ``dpmaster`` command."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen([sys.executable, "-m", "dpmaster", *map(str, arguments)], stdout=subprocess.PIPE,
                                        stderr=subprocess.PIPE, text=True)

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().rstrip("\n")

    def end(self, number: signal.Signals) -> tuple[int, str, str]:
        self.process.send_signal(number)
        out, error = self.process.communicate(timeout=20)
        return self.process.returncode, out, error


@pytest.fixture
def run() -> Iterator[Callable[..., Command]]:
    commands: list[Command] = []

    def started(*arguments: object) -> Command:
        commands.append(Command(*arguments))
        return commands[-1]

    yield started
    for command in commands:
        if command.process.poll() is None:
            command.process.kill()
        command.process.communicate()


def answers(client: Client) -> None:
    """FDL status until the card is there: it may join the wire a moment after its command says so."""
    deadline = time.monotonic() + PATIENCE
    while True:
        client.write(FDL_STATUS)
        if select.select([client.fd], [], [], 0.2)[0]:
            assert client.read(6) == FDL_STATUS_ANSWER
            return
        assert time.monotonic() < deadline, "no answer"


@pytest.mark.parametrize(("number", "card"), [
    (signal.SIGTERM, ["si-p1", "--set", "n019=50"]), (signal.SIGINT, ["si-p3", "--set", "F6-33=1"])])
def test_emulate_on_a_pty_of_its_own(number: signal.Signals, card: list[str], tmp_path: Path, run: Callable[..., Command],
                                     open_port: Callable[..., Client]) -> None:
    link = tmp_path / "drive"
    command = run("emulate", *card, "--address", 5, "--link", link)
    path = command.line()
    assert os.readlink(link) == path and path.startswith("/dev/pts/")
    answers(open_port(str(link)))
    assert command.end(number) == (0, "", "")
    assert not link.is_symlink()


def test_segment_and_a_card_on_one_of_its_ports(tmp_path: Path, run: Callable[..., Command],
                                                open_port: Callable[..., Client]) -> None:
    folder = tmp_path / "wire"
    segment = run("segment", "--ports", 3, "--link", folder)
    for number in range(3):
        link = folder / f"p{number}"
        assert segment.line() == f"{link} -> {os.readlink(link)}"
    card = run("emulate", "si-p1", "--address", 5, "--on", folder / "p2", "--parameters", "factory")
    assert card.line() == str(folder / "p2")
    assert card.line().startswith("the master needs Tsl ")
    answers(open_port(str(folder / "p0")))
    assert card.end(signal.SIGTERM) == (0, "", "")
    card = run("emulate", "si-p1", "--address", 5, "--on", folder / "p2")
    card.line()
    card.line()
    assert segment.end(signal.SIGTERM) == (0, "", "")
    assert not folder.exists()
    out, error = card.process.communicate(timeout=20)
    assert (card.process.returncode, out) == (1, "") and error.count("\n") == 1 and str(folder / "p2") in error


def test_segment_makes_the_faults_it_is_told(tmp_path: Path, run: Callable[..., Command],
                                             open_port: Callable[..., Client]) -> None:
    folder = tmp_path / "wire"
    segment = run("segment", "--ports", 2, "--link", folder, "--fault", "duplicate=1.0", "--fault", "seed=3")
    for _ in range(2):
        segment.line()
    a, b = (open_port(str(folder / name)) for name in ("p0", "p1"))
    a.write(b"xyz")
    assert b.read(6) == b"xxyyzz"
    assert segment.end(signal.SIGTERM) == (0, "", "")


@pytest.mark.parametrize(("wrong", "why"), [
    *((wrong, f"{wrong!r}: NAME=VALUE with a number") for wrong in ("paritty=1", "lose", "lose=often", "seed=0.5")),
    ("lose=1.5", "lose 1.5: a chance is 0.0 to 1.0")])
def test_a_fault_that_there_is_none_of_is_refused(wrong: str, why: str, tmp_path: Path, run: Callable[..., Command]) -> None:
    segment = run("segment", "--ports", 1, "--link", tmp_path / "wire", "--fault", wrong)
    out, error = segment.process.communicate(timeout=20)
    assert (segment.process.returncode, out) == (2, "") and why in error


def test_a_link_that_is_there_already_is_left_alone(tmp_path: Path, run: Callable[..., Command]) -> None:
    link = tmp_path / "drive"
    link.write_text("mine")
    command = run("emulate", "si-p1", "--address", 5, "--link", link)
    out, error = command.process.communicate(timeout=20)
    assert (command.process.returncode, out) == (1, "")
    assert error == f"dpmaster emulate: --link {link}: it exists; remove it or name another\n"
    assert link.read_text() == "mine"


def test_a_link_that_a_killed_command_left_is_replaced(tmp_path: Path, run: Callable[..., Command]) -> None:
    link = tmp_path / "drive"
    link.symlink_to("/dev/pts/of-a-dead-one")
    command = run("emulate", "si-p1", "--address", 5, "--link", link)
    assert command.line() == os.readlink(link)
    assert command.end(signal.SIGTERM)[0] == 0


# --- cards on somebody else's wire


def test_cards_of_a_line_answer_on_a_port_of_a_segment(open_port: Callable[..., Client]) -> None:
    with Segment(500_000, cards=0) as wire, Line(wire.port(), Echo(5), Echo(8), baudrate=500_000) as line:
        master = open_port(wire.port(), wire)
        answers(master)
        master.write(bytes.fromhex("10 08 02 49 53 16"))  # B.4 #36
        until(lambda: master.read(6) == bytes.fromhex("10 02 08 00 0A 16"))  # behind what else address 5 was late with
        line.check()
        assert line.failures == ()


def test_a_line_whose_port_vanishes_says_so() -> None:
    with Segment(cards=0) as wire:
        path = wire.port()
        line = Line(path, Echo(5), baudrate=500_000)
    with pytest.raises(errors.PortError, match=path):
        until(line.check)
    line.close()
    with pytest.raises(errors.ClosedError):
        line.check()


def test_a_line_that_cannot_be_opened_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(errors.PortError, match="nothing"):
        Line(str(tmp_path / "nothing"), Echo(5), baudrate=500_000)
    with pytest.raises(errors.ConfigurationError, match="at least one card"):
        Line(str(tmp_path / "nothing"), baudrate=500_000)
    with Segment(cards=0) as wire, pytest.raises(errors.ConfigurationError, match="taken"):
        Line(wire.port(), Echo(5), Echo(5), baudrate=500_000)
