# SPDX-License-Identifier: MIT
"""Behind a USB adapter: octets come only now and then, on virtual time and on a segment of ptys, and it may be pulled out."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
from simulation import Simulation
from waiting import until
from wire import MS, S, Slaves, default_parameters, lib
from wire import Master as CoreMaster

from dpmaster import BusParameters, ConfigurationError, DPError, Master, PortError, StationState
from dpmaster.calibration import calibrate
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.card import SlaveState
from dpmaster.emulator.cards import SIP1
from dpmaster.timing import Slave, plan

RATE = 500_000
FIRST = 10  # address of the slaves; each has SI-P1's Basic data, 6 octets each way


def simulated(rate: int, chunk: int, slaves: int) -> float:
    """Mean cycle, s, of a master whose octets come at multiples of `chunk` ns."""
    parameters = default_parameters(rate)
    there = Slaves(parameters=parameters, slaves=slaves)
    master = CoreMaster(parameters=parameters, slaves=slaves, control_interval=1200 * S, allowance=3 * chunk, granularity=chunk)
    for address in range(FIRST, FIRST + slaves):
        there.add(address, 0x00CA, b"\x72", user=(0, 0))
        master.add(address, 0x00CA, b"\x72")
    wire = Simulation(parameters)
    wire.attach(master, chunk=chunk)
    wire.attach(there)
    master.mode(lib.DPM_MODE_OPERATE)
    while any(master.slave(i).state != lib.DPM_ST_DATA for i in range(slaves)):
        wire.run(50 * MS)
    wire.run(S // 2)
    begin, cycle = wire.now, master.status.cycle
    wire.run(2 * S)
    assert all(master.slave(i).statistics.losses == 0 for i in range(slaves))
    wire.check()
    return (wire.now - begin) / (master.status.cycle - cycle) / S


@pytest.mark.parametrize("slaves", [1, 4, 8])
@pytest.mark.parametrize("chunk", [1, 16])
@pytest.mark.parametrize("rate", [93_750, 500_000, 1_500_000])
def test_timing_predicts_the_cycle_behind_an_adapter(rate: int, chunk: int, slaves: int) -> None:
    """Protocol page N.3: USB frames of 1 ms, an FTDI's latency timer of 16 ms."""
    found = plan(rate, [Slave(FIRST + i, 6, 6) for i in range(slaves)], allowance=3 * chunk / 1000, chunk=chunk / 1000)
    assert found.cycle.steady == pytest.approx(simulated(rate, chunk * MS, slaves), rel=0.1)


@pytest.mark.parametrize("chunk", [0.001, 0.016])
def test_exchange_stands_behind_an_adapter_with_the_measured_allowance(chunk: float) -> None:
    """A busy computer may be later than it was while it was measured: one of five attempts has to be without a loss."""
    for _ in range(5):
        with Segment(RATE, realtime=True) as wire:
            card = wire.attach(SIP1(address=7))
            wire.faults(chunk=chunk)
            port = wire.port()
            found = calibrate(port, RATE, station=7, count=30)
            assert found.worst > chunk / 4, "nothing was late: octets were not gathered"
            with Master(port, RATE, allowance=min(1.0, found.allowance), realtime=True) as master:
                drive = master.add(YaskawaV7(address=7, watchdog=5.0))
                master.operate()
                begin = drive.statistics
                deadline = time.monotonic() + 10
                while drive.statistics.exchanges < begin.exchanges + 20 and time.monotonic() < deadline:
                    master.wait_cycle()
                end = drive.statistics
                assert end.exchanges >= begin.exchanges + 20
                if end.losses == 0 and wire.report(card).watchdog_expired == 0:
                    return
    raise AssertionError(f"losses in each attempt, the last with allowance {found.allowance}: {end}")


@pytest.mark.parametrize("chunk", [0.001, 0.016])
def test_an_echo_behind_an_adapter_is_found_and_measured(chunk: float) -> None:
    """Later than the next transmissions begin."""
    with Segment(RATE, echo=True, realtime=True) as wire:
        wire.faults(chunk=chunk)
        for _ in range(3):  # as above
            try:
                found = calibrate(wire.port(), RATE, count=10)
            except DPError as error:
                assert "heard back whole" in str(error)
                continue
            assert found.by == "echo" and found.worst > chunk / 4
            return
    raise AssertionError("a busy computer, three times")


@pytest.mark.parametrize(("chunk", "echo"), [(0.0, False), (0.001, True)])
def test_exchange_stands_on_a_bad_line_and_the_statistics_name_it(chunk: float, echo: bool) -> None:
    """Octets late, in chunks, with parity errors, among one's own: each shows where it belongs, and no station is lost."""
    patient = replace(BusParameters.default(RATE), max_retry_limit=5)
    for _ in range(5):  # as above: the computer's own lateness is no fault of the line
        with Segment(RATE, echo=echo, realtime=True) as wire:
            card = wire.attach(SIP1(address=7))
            with Master(wire.port(), RATE, allowance=0.03, parameters=patient, realtime=True) as master:
                drive = master.add(YaskawaV7(address=7, watchdog=2.0))
                master.operate()
                wire.faults(seed=1, parity=0.003, delay=0.001, chunk=chunk)
                for _ in range(100):
                    master.wait_cycle(timeout=20)
                counts, end = master.statistics, drive.statistics
                assert counts.port.line_errors > 0 and counts.rejected["line error"] > 0
                assert end.repetitions > 0
                assert (counts.port.echo_octets > 0) is echo
                assert wire.info.faults >= counts.port.line_errors
                if end.losses == 0 and wire.report(card).watchdog_expired == 0:
                    return
    raise AssertionError(f"losses in each attempt: {end}")


# ---- an adapter that is pulled out


def test_a_port_that_is_pulled_out_and_plugged_in_is_found_by_its_link(tmp_path: Path) -> None:
    """The master looks for a port that was made anew under its link; the drive comes back with safe outputs."""
    link = tmp_path / "profibus"
    with Segment(ports=1, cards=1) as wire:
        card = wire.attach(SIP1(address=5))
        port = wire.port()
        link.symlink_to(port)
        with Master(str(link), RATE, output_watchdog=None) as master:
            drive = master.add(YaskawaV7(address=5))
            master.operate()
            wire.pull_out(port)
            until(lambda: drive.state == StationState.OFFLINE)
            with pytest.raises(PortError, match=f"port {link}: the port vanished"):
                master.operate(timeout=5)
            link.unlink()
            link.symlink_to(wire.plug_in(port))
            until(lambda: drive.state == StationState.DATA)
            assert drive.statistics.losses == 1
            assert wire.report(card).state == SlaveState.DATA_EXCH


def test_a_port_that_is_out_has_no_reader_and_stops_nobody() -> None:
    with Segment(ports=3, cards=1) as wire:
        wire.attach(SIP1(address=5))
        out, other = wire.port(), wire.port()
        wire.pull_out(out)
        wire.pull_out(out)
        with Master(other, RATE) as master:
            master.add(YaskawaV7(address=5))
            master.operate()
        assert wire.plug_in(out).number == out.number
        with pytest.raises(ConfigurationError, match="is none of this segment's"):
            wire.pull_out("/dev/pts/no-such")

