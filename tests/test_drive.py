# SPDX-License-Identifier: MIT
"""What every drive has in common, on virtual time: one face for a program, words changed in one step, requests in turn."""

from __future__ import annotations

import functools
import inspect
import re
import threading
from typing import Any

import pytest
from drive_bench import VirtualSIP3, VirtualV7

from dpmaster.drives import Drive, DriveStatus, YaskawaSIP3, YaskawaV7
from dpmaster.emulator.cards import SIP1, SIP3
from dpmaster.errors import ConfigurationError, DPError, DPTimeout, StationError
from dpmaster.profiles import yaskawa_1000 as profile
from dpmaster.profiles.yaskawa_v7 import Command

FACES: dict[str, type[Drive[Any]]] = {"v7": YaskawaV7, "si-p3": YaskawaSIP3}


def sip3(configuration: str = "PPO Type 2", **arguments: Any) -> VirtualSIP3:
    if configuration in ("PPO Type 3", "PPO Type 4"):
        arguments["maximum_frequency"] = 60.0
    return VirtualSIP3(SIP3(5, settings={"C1-01": 10, "C1-02": 10}), configuration, cycle=0.004, **arguments)


def v7(configuration: str = "Extended Data 1", **arguments: Any) -> VirtualV7:
    card = SIP1(5)
    card.registers["n019"] = card.registers["n020"] = 10  # ramps of a second
    return VirtualV7(card, configuration, cycle=0.004, **arguments)


CONVENTIONAL = ("Extended Data 1", "Extended Data 2", "Basic data")
PPOS = tuple(f"PPO Type {n}" for n in range(1, 6))
BENCHES = {f"v7, {name}": functools.partial(v7, name) for name in CONVENTIONAL} | {
    f"si-p3, {name}": functools.partial(sip3, name) for name in (*CONVENTIONAL, *PPOS)}


@pytest.fixture(params=BENCHES)
def drive(request: pytest.FixtureRequest) -> Any:
    return BENCHES[request.param]()


# -- One face ---------------------------------------------------------------------------------------------------------------


def turn(drive: Drive[Any]) -> list[float | None]:
    """A program that knows a drive and not which: each way at a speed, and the frequencies that it saw."""
    seen = []
    for reverse in (False, True):
        drive.run(24.0, reverse=reverse)
        status: DriveStatus = drive.wait_at_speed(timeout=20.0)
        assert status.running and status.ready and status.remote and status.valid and status.reverse == reverse
        assert not status.fault and not status.alarm and not status.zero_speed
        seen.append(status.output_frequency)
        drive.stop()
        status = drive.wait_stopped(timeout=20.0)
        assert status.zero_speed and not status.running and drive.frequency == 24.0
    return seen


def test_a_program_need_not_know_which_drive_it_has(drive: Any) -> None:
    assert set(turn(drive)) <= {24.0, None}  # None: the configuration has no such word
    assert drive.faults() == ()


def test_with_neither_hertz_nor_per_cent_it_runs_at_the_setpoint_there_is(drive: Any) -> None:
    drive.frequency = 15.0
    drive.let_pass(0.1)
    assert not drive.status.running, "a set-point starts nothing"
    drive.run()
    drive.wait_at_speed(20.0)
    assert abs(drive.card.motor.frequency) == 15.0
    drive.run(reverse=True)
    drive.wait_at_speed(20.0)
    assert drive.card.motor.frequency == -15.0
    drive.frequency = 12.0
    drive.wait_at_speed(20.0)
    assert drive.card.motor.frequency == -12.0, "a set-point does not turn the drive round"


def test_per_cent_are_of_the_highest_frequency() -> None:
    drive = v7()
    drive.run(percent=50.0)
    drive.wait_at_speed(20.0)
    assert (drive.card.motor.frequency, drive.frequency, drive.percent) == (30.0, 30.0, 50.0)  # n011 is 60 Hz
    drive.percent = 25.0
    assert drive.frequency == 15.0


def test_a_drive_without_a_command_to_store_says_so_before_it_writes() -> None:
    drive = v7()
    with pytest.raises(ConfigurationError, match="no command to store"):
        Drive.write(drive, {"n019": 40}, store=True)
    assert drive.card.registers["n019"] == 10


@pytest.mark.parametrize(("arguments", "text"), [
    ({"hz": 20.0, "percent": 20.0}, "give one of them"), ({"percent": 100.5}, "percent 100.5: the limit is 100"),
    ({"percent": -1}, "percent -1.0 %: give a positive number"), ({"hz": "20"}, "frequency '20' Hz: give a number"),
    ({"percent": True}, "percent True %: give a number"), ({"hz": float("inf")}, "the limit is"),
])
def test_setpoints_out_of_range(arguments: dict[str, Any], text: str) -> None:
    drive = v7()
    with pytest.raises(ConfigurationError, match=text):
        drive.run(**arguments)
    assert drive.outputs[:4] == bytes(4)


def test_a_fault_ends_the_wait_for_the_speed(drive: Any) -> None:
    drive.run(20.0)
    drive.let_pass(0.1)
    drive.lose(0.1)
    drive.run(20.0)
    with pytest.raises(StationError, match="shows a fault"):
        drive.wait_at_speed(20.0)
    assert drive.faults() != ()
    drive.fault_reset()
    assert drive.faults() == ()
    drive.run(20.0)
    drive.wait_at_speed(20.0)


@pytest.mark.parametrize("name", FACES)
def test_the_face_is_whole_in_every_drive_class(name: str) -> None:
    drive = FACES[name]
    assert not inspect.isabstract(drive)
    for member in ("run", "run_forward", "run_reverse", "stop", "frequency", "percent", "status", "wait_until", "wait_at_speed",
                   "wait_stopped", "faults", "fault_reset", "__getitem__", "__setitem__"):
        assert inspect.getdoc(getattr(drive, member)), member


# -- A word is read and committed in one step -------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [lambda d: d._change("command", clear=1 << 15), lambda d: setattr(d, "frequency", 5.0)])
def test_a_loss_while_a_word_is_changed_carries_no_run_command_over(change: Any, drive: Any) -> None:
    """design page: "only a commit made after its return reaches it", and what it says was said after it, too."""
    drive.run(20.0)
    drive.wait_at_speed(20.0)
    plain, armed = drive.update, [True]

    def late(*arguments: Any, **keywords: Any) -> int:
        """The bus loses the drive and finds it again in the last moment before the commit."""
        if armed.pop() if armed else False:
            drive.lose(0.05)
        return plain(*arguments, **keywords)

    drive.update = late
    change(drive)
    assert not armed
    assert not drive._output_word("command") & (profile.RUN if "PPO" in drive.layout else Command.RUN)


# -- Requests in turn -------------------------------------------------------------------------------------------------------


def test_requests_are_served_in_the_order_they_came() -> None:
    channel = v7()._channel
    assert channel
    order: list[int] = []
    queued = threading.Semaphore(0)

    def request(number: int) -> None:
        queued.release()
        with channel._turn():
            order.append(number)

    threads = [threading.Thread(target=request, args=(number,)) for number in range(10)]
    with channel._turn():
        for place, thread in enumerate(threads):
            thread.start()
            assert queued.acquire(timeout=30.0)
            with channel._moved:
                assert channel._moved.wait_for(lambda: len(channel._queue) == place + 2, 30.0)  # noqa: B023
    for thread in threads:
        thread.join(30.0)
    assert order == list(range(10))


def test_a_signals_handler_in_the_middle_of_an_access_is_told_so_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its request would wait for the one that it interrupts. That one goes on, where the handler deals with the error."""
    drive = v7()
    update, refused = drive.update, []

    def signalled(*arguments: Any) -> int:
        with pytest.raises(DPError, match=r"in an access already.*signal.*ask behind the access, or in another thread"):
            drive.read_parameter("n004")
        refused.append(True)
        return update(*arguments)

    monkeypatch.setattr(drive, "update", signalled)
    assert drive.read_parameter("n003") == 3
    assert len(refused) > 2
    monkeypatch.undo()
    assert drive.read_parameter("n004") == drive.card.registers["n004"]


@pytest.mark.parametrize("name", [name for name in BENCHES if re.search(r"Extended|Type [125]", name)])
def test_what_was_given_up_is_not_done_later(name: str) -> None:
    """A card that looks at its channel only after the time-out finds nothing to do there, and serves the next request."""
    drive = BENCHES[name]()
    write, read, parameter = ((drive.write_parameter, drive.read_parameter, "n019") if isinstance(drive, YaskawaV7)
                              else (drive.write_register, drive.read_register, "C1-01"))
    job = drive.card._job
    see, job.see = job.see, lambda *_: None
    with pytest.raises(DPTimeout):
        write(parameter, 50, timeout=0.3)
    drive.exchange()
    job.see = see
    drive.let_pass(1.0)
    assert drive.card.registers[parameter] == 10
    write(parameter, 60)
    assert read(parameter) == 60 == drive.card.registers[parameter]


@pytest.mark.parametrize("timeout", [0, -1, "1", None])
def test_a_request_has_a_time_out(timeout: Any) -> None:
    with pytest.raises(ConfigurationError, match="timeout"):
        v7().read_parameter("n003", timeout=timeout)
