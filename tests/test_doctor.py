# SPDX-License-Identifier: MIT
"""Instruments for ports: ``ports``, ``doctor``, ``calibrate``, ``perf``, the cable's limits. Real drivers are uart.py's."""

from __future__ import annotations

import errno
import grp
import json
import os
import pty
import resource
import stat
import struct
import termios
import threading
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dpmaster import BusParameters, ConfigurationError, DPError, Master, PortError, cable, calibration, cli, doctor, perf
from dpmaster._core import lib
from dpmaster.calibration import Calibration, calibrate
from dpmaster.cli import calibrate as command
from dpmaster.doctor import Level, examine
from dpmaster.emulator import Line, Segment
from dpmaster.emulator.cards import SIP1
from dpmaster.ports import Port, Rate, _description, ports
from dpmaster.timing import Slave, plan, profile_allowance

RATE = 500_000


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment(ports=2) as made:
        yield made


# ---- ports


def test_a_path_is_a_port_or_an_error() -> None:
    for path, words in (("/dev/no-such-port", "no such port"), ("/dev/null", "not a serial port"), (__file__, "not a serial")):
        with pytest.raises(PortError, match=words):
            Port.at(path)
    far, near = pty.openpty()
    assert Port.at(os.ttyname(near)).kind == "pty"
    os.close(far)
    os.close(near)


def test_ports_are_listed_as_a_person_and_as_a_program_reads_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["ports"]) == 0
    shown = capsys.readouterr().out
    found = ports()
    assert all(port.path in shown and port.kind in ("uart", "usb") for port in found)
    assert found or shown == "no serial ports; 'dpmaster segment' makes virtual ones\n"
    assert cli.main(["ports", "--json"]) == 0
    assert [entry["path"] for entry in json.loads(capsys.readouterr().out)["ports"]] == [port.path for port in found]


def test_the_uart_of_a_hat_is_listed_and_an_entry_without_one_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial 3.5 knows no ttySC0, and since Linux 6.5 takes each ttyS of the 8250 for a port."""
    for name, kind in (("ttySC0", "108"), ("ttyS3", "0"), ("ttyUSB0", None)):  # PORT_SC16IS7XX, PORT_UNKNOWN; an adapter's none
        (tmp_path / name / "device").mkdir(parents=True)
        if kind:
            (tmp_path / name / "type").write_text(f"{kind}\n")
    (tmp_path / "tty1").mkdir()  # a console of the screen
    monkeypatch.setattr("dpmaster.ports.TTYS", tmp_path)
    monkeypatch.setattr("dpmaster.ports.list_ports", SimpleNamespace(comports=lambda: [SimpleNamespace(device="/dev/ttyS3")]))
    monkeypatch.setattr(Port, "at", lambda path: Port(path, "uart", sys=tmp_path / Path(path).name))
    assert [port.path for port in ports()] == ["/dev/ttySC0", "/dev/ttyUSB0"]


@pytest.mark.parametrize(("node", "kind", "words"), [
    (None, "4", "16550A"), (None, "0", ""), ("arm,pl011\0arm,primecell\0", "32", "arm,pl011")])
def test_a_uart_is_called_what_device_tree_or_driver_call_it(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, node: str | None, kind: str, words: str) -> None:
    """include/uapi/linux/serial.h: PORT_16550A 4, PORT_UNKNOWN 0."""
    monkeypatch.setattr("dpmaster.ports.TTYS", tmp_path)
    tree = tmp_path / "ttyX7" / "device" / "of_node"
    tree.mkdir(parents=True)
    (tmp_path / "ttyX7" / "type").write_text(f"{kind}\n")
    if node is not None:
        (tree / "compatible").write_text(node)
    assert _description("/dev/ttyX7") == words


@pytest.fixture
def adapter(tmp_path: Path) -> Port:
    """A USB adapter as its directory under /sys describes it."""
    (tmp_path / "device").mkdir()
    return Port("/dev/ttyUSB0", "usb", "ftdi_sio", "FTDI FT232R (0403:6001)", ("/dev/serial/by-id/usb-FTDI",), tmp_path)


def remarks(found: Iterator[doctor.Remark]) -> dict[str, doctor.Remark]:
    return {remark.subject: remark for remark in found}


def test_a_slow_latency_timer_is_bad_and_a_fast_one_good(adapter: Port) -> None:
    """Protocol page N.3: "FTDI: 16 ms latency timer default; latency_timer = 1"."""
    assert adapter.sys is not None
    timer = adapter.sys / "device" / "latency_timer"
    timer.write_text("16\n")
    (slow,) = doctor._delivery(adapter)
    assert slow.level is Level.BAD and "up to 16 ms" in slow.text and "echo 1" in slow.remedy and "udev" in slow.remedy
    timer.write_text("1\n")
    (fast,) = doctor._delivery(adapter)
    assert (fast.level, fast.remedy) == (Level.GOOD, "")
    timer.unlink()
    (unknown,) = doctor._delivery(adapter)
    assert unknown.level is Level.NOTE and "cannot be set" in unknown.text


def test_rates_are_told_with_those_that_lack(adapter: Port) -> None:
    rates = (Rate(9600, 9600), Rate(19200, 19231), Rate(RATE, None))
    found = remarks(doctor._rates(adapter, rates, RATE))
    assert found["rates"].text == "9.6k, 19.2k bit/s with even parity; not 500k bit/s"
    assert found["rate"].level is Level.BAD and "500k bit/s is not among them" in found["rate"].text
    assert remarks(doctor._rates(adapter, (Rate(9600, None),), None))["rates"].level is Level.BAD


def test_a_driver_that_says_yes_to_everything_is_not_believed(adapter: Port) -> None:
    found = remarks(doctor._rates(adapter, (Rate(12_000_000, 12_000_000),), RATE, believed=False))["rates"]
    assert found.level is Level.NOTE and "100 Mbit/s among them" in found.text


@pytest.mark.parametrize(("mode", "gid", "text", "remedy"), [
    (0o660, "tty", "this user may not open it, the group tty may", "sudo usermod -aG tty "),
    (0o620, "tty", "only root may open it", "a udev rule"),  # as a getty leaves it
    (0o660, "root", "only root may open it", "a udev rule"),
])
def test_who_may_not_open_a_port_is_told_how_to(
        monkeypatch: pytest.MonkeyPatch, mode: int, gid: str, text: str, remedy: str) -> None:
    """Nobody is sent into the group root, or into one that may not open it either."""
    status = SimpleNamespace(st_mode=stat.S_IFCHR | mode, st_gid=grp.getgrnam(gid).gr_gid)
    monkeypatch.setattr("dpmaster.ports.os", SimpleNamespace(
        stat=lambda path: status, access=lambda path, how: False, R_OK=os.R_OK, W_OK=os.W_OK))
    found = remarks(doctor._access(Port("/dev/no-such-port", "uart")))["permission"]
    assert (found.level, found.text) == (Level.BAD, text) and found.remedy.startswith(remedy)


@pytest.mark.parametrize(("user", "allowed", "remedy"), [
    (1000, 0, "'@dialout - rtprio 60'"), (1000, 39, "'@dialout - rtprio 60'"),
    (1000, 40, "--cap-add SYS_NICE"), (1000, resource.RLIM_INFINITY, "--cap-add SYS_NICE"), (0, 0, "--cap-add SYS_NICE")])
def test_a_priority_that_is_refused_has_a_remedy(
        monkeypatch: pytest.MonkeyPatch, user: int, allowed: int, remedy: str) -> None:
    """The limit's, or where that is high enough, the container's."""
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(doctor, "_granted", lambda priority: False)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (allowed, allowed))
    found = remarks(iter(doctor.examine_computer()))["priority"]
    assert found.level is Level.BAD and remedy in found.remedy
    monkeypatch.setattr(doctor, "_granted", lambda priority: True)
    assert remarks(iter(doctor.examine_computer()))["priority"].level is Level.GOOD


def test_a_virtual_wire_works_without_priority(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a pty the bus thread does not ask for it (`Realtime`)."""
    monkeypatch.setattr(doctor, "_granted", lambda priority: False)
    monkeypatch.setattr(doctor, "lock", lambda blocks: errno.ENOMEM)
    found = examine(wire.port())
    noted = remarks(iter(found.remarks))
    assert found.works and noted["priority"].level is noted["memory"].level is Level.NOTE


def test_the_doctor_sends_nothing_and_names_what_it_hears(wire: Segment) -> None:
    port = wire.port()
    assert remarks(iter(examine(port, RATE, listen=0.05).remarks))["bus"].text == "silent for 0.05 s"
    assert wire.info.transmissions == 0
    with Master(wire.port(), RATE, address=3) as master:
        master.stop()
        found = examine(port, RATE, listen=0.5)
    assert remarks(iter(found.remarks))["bus"].text == "telegrams are heard, master 3 has it; 0 line errors"
    assert found.works


def test_the_doctor_leaves_a_line_as_it_was() -> None:
    """It may be somebody's console."""
    far, near = pty.openpty()
    try:
        before = termios.tcgetattr(near)
        port = Port(os.ttyname(near), "uart")
        assert len(port.rates()) == 11
        assert port.rs485() == (False, False)
        assert termios.tcgetattr(near) == before
    finally:
        os.close(far)
        os.close(near)


@pytest.mark.parametrize(("flags", "does"), [(0x000, False), (0x003, True), (0x201, False)])
def test_a_port_in_rs422_mode_does_not_switch_its_direction(monkeypatch: pytest.MonkeyPatch, flags: int, does: bool) -> None:
    """Protocol page N.2: ENABLED 1; include/uapi/linux/serial.h: SER_RS485_MODE_RS422 is bit 9 (Linux 6.8)."""
    monkeypatch.setattr(Port, "_kept", lambda *_: nullcontext(struct.pack("8I", flags, *bytes(7))))
    monkeypatch.setattr(Port, "_try", lambda *_: 9600)
    assert Port("/dev/ttyS7", "uart").rs485() == (True, does)


def test_a_bus_without_telegrams_is_another_rate_or_exchanged_wires(wire: Segment) -> None:
    port, other = wire.port(), os.open(wire.port(), os.O_RDWR | os.O_NOCTTY)
    ended = threading.Event()

    def noise() -> None:
        while not ended.wait(0.005):
            os.write(other, b"\x00\xf0\x3c")

    talker = threading.Thread(target=noise)
    talker.start()
    try:
        found = remarks(iter(examine(port, RATE, listen=0.3).remarks))["bus"]
    finally:
        ended.set()
        talker.join()
        os.close(other)
    assert found.level is Level.BAD and "no telegram in them" in found.text and "A and B exchanged" in found.remedy


def test_a_rate_that_is_not_made_is_one_remark(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody is sent to the doctor by the doctor."""
    monkeypatch.setattr(Port, "rates", lambda port: (Rate(9600, 9600), Rate(RATE, None)))
    found = remarks(iter(examine(wire.port(), RATE).remarks))
    assert found["rate"].level is Level.BAD and "cable" in found and "bus" not in found


def test_a_port_in_use_is_a_remark_with_its_remedy(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    port = wire.port()
    with Master(port):
        assert cli.main(["doctor", port, "--baudrate", "1234"]) == 2
        assert "baudrate 1234: PROFIBUS has no such rate" in capsys.readouterr().err
        assert cli.main(["doctor", port]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "bad port another program" in shown and f"fuser -v {port}" in shown


def test_doctor_as_json(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", wire.port(), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "pty" and found["works"]
    assert {"kernel", "priority", "echo"} <= {r["subject"] for r in found["remarks"]}
    assert cli.main(["doctor", "/dev/no-such-port"]) == 1


# ---- cable


@pytest.mark.parametrize(("rate", "segment", "network", "stubs"), [
    (9_600, 1200, 10_000, 500), (187_500, 1000, 10_000, 100), (500_000, 400, 4_000, 33), (1_500_000, 200, 2_000, 20),
    (3_000_000, 100, 1_000, 0), (6_000_000, 100, 1_000, 0), (12_000_000, 100, 1_000, 0)])
def test_lengths_and_stubs_are_those_of_the_manual(rate: int, segment: int, network: int, stubs: int) -> None:
    """SI-P1 manual, tables C.4 and C.5; the segments are also SI-P3 manual, table 6."""
    assert cable.limits(rate) == cable.Limits(segment, network, stubs)


@pytest.mark.parametrize("rate", [19_200, 45_450, 500_000 / 11, 93_750])
def test_rates_that_one_manual_leaves_out_are_in_the_other(rate: float) -> None:
    """SI-P3 manual, table 6: 1200 m at 19.2, 45.45 and 93.75 kbit/s."""
    assert cable.limits(rate).segment == 1200
    assert cable.limits(rate).stubs == 100


def notes(**bus: Any) -> list[str]:
    return [finding.text + "; " + finding.remedy for finding in plan(RATE, **bus).findings]


def test_timing_tells_of_a_cable_that_is_too_long() -> None:
    """SI-P1 manual, table C.4: 400 m a segment and 4000 m in all at 500 kbit/s."""
    assert notes(length=400) == notes(length=1200, repeaters=2) == []
    (text,) = notes(length=1201, repeaters=2)
    assert "400 m a segment, 4000 m in all" in text and "; 3 of them, or fibre" in text
    assert any("; fibre, or" in text for text in notes(length=4001, repeaters=9))


def test_timing_tells_of_stubs_that_are_too_long() -> None:
    """SI-P1 manual, table C.5: 33 m together at 500 kbit/s, none above 1.5 Mbit/s."""
    assert notes(stubs=33) == []
    (text,) = notes(stubs=34)
    assert "34 m of stubs is too long at 500 kbit/s" in text and "stubs 33 m together" in text
    assert any("no stubs" in finding.text for finding in plan(3_000_000, stubs=1).findings)


def test_timing_tells_of_too_many_stations_and_repeaters() -> None:
    """SI-P1 manual, appendix C: 31 devices on a segment without a repeater, masters included; nine repeaters in line."""
    slaves = [Slave(address) for address in range(10, 41)]
    assert notes(slaves=slaves[1:]) == notes(slaves=slaves, repeaters=9) == []
    (text,) = notes(slaves=slaves)
    assert "32 stations without a repeater: 31 are the most" in text
    (text,) = notes(repeaters=10)
    assert "9 are the most in line" in text


# ---- a card on a real line


def test_a_line_names_the_tsl_of_its_master(wire: Segment) -> None:
    """Design page: "A slave on Linux answers not before min Tsdr and not after max Tsdr + its port's allowance"; + 15 Tbit."""
    with Line(wire.port(), SIP1(5), baudrate=RATE) as line:
        assert line.tsl == BusParameters.default(RATE).ring_tsl(profile_allowance("pty"))
    with Line(wire.port(), SIP1(5), baudrate=RATE, allowance=0.001) as line:
        assert line.tsl == 100 + 500 + 15


# ---- calibrate


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty slot costs 75 ms, not 250."""
    monkeypatch.setattr(calibration, "PATIENCE", 3.0)


def test_an_echo_is_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    with Segment(echo=True) as wire:
        port = wire.port()
        for patience in (3.0, 10.0, 10.0):  # as a busy computer needs it
            monkeypatch.setattr(calibration, "PATIENCE", patience)
            if cli.main(["calibrate", port, "--count", "20", "--output", str(file)]) == 0:
                break
    assert ", by echo, " in capsys.readouterr().out
    found = Calibration.load(file)
    assert (found.by, found.rate) == ("echo", None)
    assert 10 <= found.samples <= 20  # a busy host may miss one
    assert 0 <= found.mean <= found.p99 <= found.worst
    assert 3 * found.worst <= found.allowance <= 3 * found.worst + 1.01e-4


def test_a_slave_s_answers_are_measured_and_the_result_runs_a_master(wire: Segment) -> None:
    wire.attach(SIP1(address=7))
    found = calibrate(wire.port(), RATE, station=7, count=20)
    assert found.by == "station 7" and 10 <= found.samples <= 20
    with Master(wire.port(), RATE, allowance=min(1.0, found.allowance)) as master:
        master.stop()
        assert master.statistics.port.allowance == pytest.approx(min(1.0, found.allowance))


class Paced:
    """The library on a UART that makes `rate` bit/s, whatever it is asked for."""

    def __init__(self, rate: int) -> None:
        self.rate = rate

    def dpm_port_measure(self, port: object, octets: bytes, n: int, limit: int, took: Any) -> int:
        assert n == len(octets) and n * 11 / RATE >= 0.05, "shorter than what the host may be late matters"
        took[0] = n * 11 * 10**9 // self.rate
        return 0

    def __getattr__(self, name: str) -> Any:
        return getattr(lib, name)


@pytest.mark.parametrize(("made", "words"), [
    (501_000, "501 kbit/s measured, +0.20 %\n"), (3_000_000, "3000 kbit/s measured, +500.00 %: no line is paced by it")])
def test_the_rate_that_a_uart_makes_is_measured(
        wire: Segment, monkeypatch: pytest.MonkeyPatch, made: int, words: str) -> None:
    """Protocol page A: a character has 11 bits."""
    monkeypatch.setattr(calibration, "lib", Paced(made))
    rate = calibration._rate(wire.port(), RATE, None)
    assert rate == pytest.approx(made)
    assert words in command.text(Calibration("p", RATE, "echo", 1, 0.0, 0.0, 0.0, 0.001, rate, "m"))


def test_what_no_ring_can_wait_for_is_said() -> None:
    """Design page: "max Tsdr + 15 + allowance > Tsl does not enter"; Tsl ends at 16383 Tbit."""
    found = Calibration("p", RATE, "echo", 1, 0.0, 0.0, 0.01, 0.02, None, "m")
    assert found.tsl(500_000) == 100 + 15 + 10_000 == BusParameters.for_ring(500_000, allowance=0.02).tsl
    assert found.tsl(1_500_000) is None
    assert max(found.ring_rates) == 500_000


@pytest.mark.parametrize("count", [0, -5, 1.5])
def test_calibrate_measures_something(wire: Segment, count: int) -> None:
    with pytest.raises(ConfigurationError, match=rf"count {count}: 1 to 1000000 requests"):
        calibrate(wire.port(), RATE, count=count)


def test_calibrate_does_not_disturb_another_master(wire: Segment) -> None:
    with Master(wire.port(), RATE, address=3) as master:
        master.stop()
        with pytest.raises(DPError, match="master 3 has the bus"):
            calibrate(wire.port(), RATE)


def test_calibrate_on_an_empty_bus_says_what_it_needs(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "SEARCH", 0.04)  # 1 ms for each of 126 addresses
    with pytest.raises(DPError, match=r"neither an echo nor a slave: connect one that is powered, or name one .*--station N"):
        calibrate(wire.port(), RATE)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"port": 1, "more": 2}'])
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "f").write_text(content)
    with pytest.raises(ConfigurationError, match="give a file that 'dpmaster calibrate --output' wrote"):
        Calibration.load(tmp_path / "f")


# ---- perf


def test_perf_counts_cycles_and_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "p.svg"
    for _ in range(5):  # a bus that stood still as long as a token may take begins a new raster
        assert cli.main(["perf", "--seconds", "0.3", "--cycle-time", "5", "--svg", str(picture), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        if found["cycles"] + found["skipped"] >= 40:
            break
    assert found["cycles"] + found["skipped"] >= 40 and found["cycles"] == sum(each["cycles"] for each in found["classes"])
    assert ElementTree.parse(picture).getroot().tag.endswith("svg")


def test_a_picture_that_cannot_be_written_does_not_cost_the_measurement(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["perf", "--seconds", "0.1", "--svg", "/no/such/folder/p.svg"]) == 1
    shown = capsys.readouterr()
    assert "99.9 % within" in shown.out and "name a file that can be written" in shown.err


def test_perf_makes_no_histogram_of_a_port_that_vanished(wire: Segment) -> None:
    port = wire.port()
    pull = threading.Timer(0.5, wire.pull_out, [port])
    pull.start()
    with pytest.raises(PortError, match="vanished"):
        perf.measure(port, duration=1.0, realtime=False)
    pull.join()


def test_perf_without_a_cycle_has_no_half_of_them(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["perf", wire.port(), "--cycle-time", "9999", "--seconds", "0.001", "--priority", "0"]) == 1
    assert "no cycle of 9999 ms began within 0.001 s" in capsys.readouterr().err


def test_perf_s_shares() -> None:
    classes = (perf.Class(2, 90), perf.Class(4, 9), perf.Class(None, 1))
    found = perf.Punctuality("p", 0.002, 100, 0, 0.1, classes, perf.Scheduling(), "m")
    assert (found.within(0.5), found.within(0.99), found.within(0.999)) == (2, 4, None)
