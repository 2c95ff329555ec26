# SPDX-License-Identifier: MIT
"""Drives of all classes and configurations on one busy wire of ptys: they turn, and their parameter channels keep questions and
answers together while telegrams are spoiled and stations come and go."""

from __future__ import annotations

import contextlib
import logging
import random
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from dpmaster import Master
from dpmaster.drives import Drive, YaskawaSIP3, YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1, SIP3
from dpmaster.errors import DPTimeout, StationError
from dpmaster.profiles import yaskawa_1000, yaskawa_v7

PATIENCE = 30.0


class Bus:
    """Sixteen drives, each in a configuration of its own, in Operate."""

    def __init__(self, allowance: float = 0.1) -> None:
        self.wire = Segment(ports=1, cards=32)
        self.cards: dict[str, Any] = {}
        drives: dict[str, Drive[Any]] = {}
        for address, layout in enumerate(yaskawa_v7.CONFIGURATIONS, 10):
            card = self.wire.attach(SIP1(address))
            card.registers["n019"] = card.registers["n020"] = 5
            drives[f"V7, {layout.name}"], self.cards[f"V7, {layout.name}"] = YaskawaV7(address, layout.name, watchdog=5.0), card
        for address, module in enumerate(yaskawa_1000.CONFIGURATIONS, 20):
            maximum = 60.0 if module.name.startswith(("PPO Type 3", "PPO Type 4")) else None
            self.cards[module.name] = self.wire.attach(SIP3(address, settings={"C1-01": 5, "C1-02": 5}))
            drives[module.name] = YaskawaSIP3(address, module.name, maximum_frequency=maximum, watchdog=5.0)
        self.master = Master(self.wire.port(), cycle_time=0.005, allowance=allowance)
        self.drives = {name: self.master.add(drive) for name, drive in drives.items()}
        self.master.operate(PATIENCE)

    def run(self, hz: float, **arguments: Any) -> None:
        """All of them; each asks its drive first, so each has a thread of its own."""
        with ThreadPoolExecutor(len(self.drives)) as pool:
            list(pool.map(lambda drive: drive.run(hz, **arguments), self.drives.values()))

    def close(self) -> None:
        self.master.close()
        self.wire.close()


@pytest.fixture
def bus(request: pytest.FixtureRequest) -> Iterator[Bus]:
    made = Bus(*getattr(request, "param", ()))
    with contextlib.closing(made):
        yield made


def test_one_program_turns_them_all(bus: Bus) -> None:
    for reverse in (False, True):
        bus.run(24.0, reverse=reverse)
        for name, drive in bus.drives.items():
            status = drive.wait_at_speed(PATIENCE)
            assert status.running and status.remote and status.reverse == reverse, name
            assert bus.cards[name].motor.frequency == (-24.0 if reverse else 24.0), name
    for drive in bus.drives.values():
        drive.stop()
    for name, drive in bus.drives.items():
        assert drive.wait_stopped(PATIENCE).zero_speed and drive.faults() == (), name


def test_leaving_says_the_stop_word_to_each_of_them(bus: Bus) -> None:
    bus.run(24.0)
    for drive in bus.drives.values():
        drive.wait_at_speed(PATIENCE)
    for card in bus.cards.values():
        card.registers["C1-02" if isinstance(card, SIP3) else "n020"] = 6000  # the ramp alone will not bring them to rest
    said: dict[str, bool] = {}
    for name, drive in bus.drives.items():
        rest = drive._rest

        def witnessed(name: str = name, rest: Any = rest) -> None:
            rest()
            said[name] = bus.master.mode.name == "OPERATE"

        drive._rest = witnessed  # type: ignore[method-assign]
    bus.master.clear()
    assert said == dict.fromkeys(bus.drives, True)


def test_the_stop_words_of_many_drives_go_out_in_one_cycle(caplog: pytest.LogCaptureFixture) -> None:
    with Segment(cards=20) as wire, Master(wire.port(), cycle_time=0.1) as master:
        for address in range(10, 30):
            wire.attach(SIP1(address))
            master.add(YaskawaV7(address, watchdog=10.0))
        master.operate(PATIENCE)
        master.clear()
    assert "stop word" not in caplog.text


def test_a_drive_on_a_slow_cycle_is_given_its_stop_word(monkeypatch: pytest.MonkeyPatch,
                                                        caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr("dpmaster.drives.drive.REST", 0.2)
    with Segment(cards=1) as wire, Master(wire.port(), cycle_time=0.3) as master:
        wire.attach(SIP1(5))
        drive = master.add(YaskawaV7(5, watchdog=10.0))
        master.operate(PATIENCE)
        drive.wait_sent(drive.update(0, bytes(2)), PATIENCE)  # the next exchange is a cycle away
        master.clear()
    assert "stop word" not in caplog.text


SLOW = 0.05  # s


@pytest.fixture
def slow() -> Iterator[tuple[Master, YaskawaV7, YaskawaSIP3]]:
    """A master with a fixed cycle time, and a drive with each kind of parameter channel."""
    with Segment(cards=2) as wire, Master(wire.port(), cycle_time=SLOW, output_watchdog=None) as master:
        wire.attach(SIP1(5))
        wire.attach(SIP3(6))
        yield master, master.add(YaskawaV7(5, watchdog=10.0)), master.add(YaskawaSIP3(6, "PPO Type 2", watchdog=10.0))


def test_the_times_of_a_call_count_beside_the_cycles_it_takes(slow: tuple[Master, YaskawaV7, YaskawaSIP3],
                                                              monkeypatch: pytest.MonkeyPatch) -> None:
    """A default of a second would be over before a cycle of two has come."""
    master, v7, sip3 = slow
    calls: list[tuple[float, int, Callable[[], object]]] = [  # default and, as seen on slow wires, cycles at the most
        (5.0, 6, master.operate),
        (1.0, 1, master.wait_cycle),
        (1.0, 1, lambda: next(master.cycles())),
        (1.0, 2, lambda: v7.wait_sent(v7.update(0, bytes(2)))),
        (1.0, 2, lambda: master.global_control(clear=True)),
        (1.0, 2, lambda: master.global_control(clear=False)),
        (1.0, 5, lambda: v7.read_parameter("n003")),
        (1.0, 5, lambda: v7.write_parameter("n019", 50)),
        (1.0, 3, lambda: sip3.read("C1-01")),
        (1.0, 1, v7.fault_reset),
        (5.0, 4, v7.reparameterise),
        (1.0, 1, sip3.deactivate),
    ]
    granted: list[float] = []
    wait = master._bus.wait
    monkeypatch.setattr(master._bus, "wait", lambda ready, timeout: granted.append(timeout) or wait(ready, timeout))
    for number, (default, cycles, call) in enumerate(calls):
        granted.clear()
        call()
        assert default + (cycles - 0.1) * SLOW < max(granted) < default + 11 * SLOW, f"call {number}"
    with pytest.raises(DPTimeout):
        v7.wait_sent(v7.update(0, bytes(2)), 0)


@pytest.mark.parametrize("bus", [(0.02,)], indirect=True)  # a lost answer shall cost no more
def test_ten_parameters_at_once_on_a_busy_bus_under_faults(bus: Bus, caplog: pytest.LogCaptureFixture) -> None:
    """Ten threads on each of three channels, one of each kind; telegrams are lost, octets are flipped, and one
    of the three is unplugged for a while. Every read gets its own value, every write is done or says that it is not known."""
    caplog.set_level(logging.CRITICAL, "dpmaster")
    seed = random.randrange(1 << 32)
    print("seed", seed)
    bus.wire.faults(seed=seed, lose_telegram=0.004, flip=0.0001)
    channels = {"PPO Type 5": "d1-{:02d}", "Extended Data 1": "d1-{:02d}", "V7, Extended Data 2": "{:04X}h"}
    wrong: list[str] = []
    done = dict.fromkeys(channels, 0)

    def ask(layout: str, number: int) -> None:
        drive: Any = bus.drives[layout]
        name = channels[layout].format(number if "d1" in channels[layout] else 0x0200 + number)
        read, write = ((drive.read_parameter, drive.write_parameter) if isinstance(drive, YaskawaV7)
                       else (drive.read_register, drive.write_register))
        try:
            for turn in range(3):
                value, known = 1000 * number + turn, True
                try:
                    write(name, value, timeout=PATIENCE)
                except StationError as error:
                    assert "not known" in str(error)
                    known = False
                if (got := read(name, timeout=PATIENCE)) != value and (known or (got // 1000 != number and got)):
                    wrong.append(f"{layout}, {name}: {got}, not {value}")
                done[layout] += 2
        except Exception as error:
            wrong.append(f"{layout}, {name}: {error!r}")

    threads = [threading.Thread(target=ask, args=(layout, number)) for number in range(1, 11) for layout in channels]
    begin = time.monotonic()
    for thread in threads:
        thread.start()
    lost = bus.cards["Extended Data 1"]
    bus.wire.unplug(lost)
    with contextlib.suppress(StationError):
        bus.master.wait_cycle(PATIENCE)
    while bus.drives["Extended Data 1"].frame.valid:
        bus.master.wait_cycle(PATIENCE)
    bus.wire.plug(lost)
    for thread in threads:
        thread.join(3 * PATIENCE)
        assert not thread.is_alive()
    took = time.monotonic() - begin
    bus.wire.faults()
    assert wrong == [] and done == dict.fromkeys(channels, 60)
    repetitions = sum(drive.statistics.repetitions for drive in bus.drives.values())
    losses = bus.drives["Extended Data 1"].statistics.losses
    print(f"{3 * 60 / took:.0f} requests a second over three channels, {repetitions} repetitions, {losses} losses")
    assert repetitions and losses


def test_a_drive_that_would_run_on_is_named_at_operate(caplog: pytest.LogCaptureFixture) -> None:
    """design page: "a drive set to hold or ignore a loss is named at operate()"."""
    with Segment(ports=1, cards=2) as wire:
        wire.attach(SIP3(5, settings={"F6-01": 3}))
        wire.attach(SIP3(6, settings={"F6-31": 1}))
        with Master(wire.port()) as master, caplog.at_level(logging.WARNING):
            master.add(YaskawaSIP3(5, "PPO Type 1"))
            master.add(YaskawaSIP3(6, "Extended Data 2", name="pump"))
            master.operate(PATIENCE)
            assert "drive 5: F6-01 is 3, alarm only: it runs on" in caplog.text
            assert "pump: F6-31 is 1, in Clear it holds" in caplog.text


def test_the_diagnosis_of_an_undervoltage_in_words() -> None:
    with Segment(ports=1, cards=1) as wire:
        card = wire.attach(SIP3(5))
        with Master(wire.port()) as master:
            drive = master.add(YaskawaSIP3(5, "PPO Type 1"))
            master.operate(PATIENCE)
            card.undervoltage = True
            drive.run(percent=10)
            deadline = time.monotonic() + PATIENCE
            while "undervoltage" not in drive.explain_diagnosis() and time.monotonic() < deadline:
                master.wait_cycle(PATIENCE)
            assert "undervoltage" in drive.explain_diagnosis()
