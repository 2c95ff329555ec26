# SPDX-License-Identifier: MIT
"""Services beside the cycle, and stations that come and go, as a program and a technician see them: a segment with cards.

What goes over the wire octet for octet is in test_dp_modes.py; here is who gets what, and in which words.
"""

from __future__ import annotations

import gc
import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from children import child
from test_master_pty import CONFIGURATION, IDENT, SAFE, Drive, Echo
from waiting import until

from dpmaster import (
    Answer,
    ConfigurationError,
    DPTimeout,
    EventKind,
    Master,
    Mode,
    NotOperatingError,
    Service,
    Station,
    StationError,
    StationState,
)
from dpmaster.bus import FdlState
from dpmaster.cli import main
from dpmaster.diagnosis import Diag
from dpmaster.emulator import Segment, SlaveState
from dpmaster.emulator.card import Habits
from dpmaster.services import Services


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment() as made:
        yield made


class Able(Echo):
    sync = freeze = True
    max_diagnosis = 62


@pytest.fixture
def cards(wire: Segment) -> list[Echo]:
    return [wire.attach(Able(address)) for address in (5, 6)]


@pytest.fixture
def master(wire: Segment) -> Iterator[Master]:
    with Master(wire.port()) as made:
        yield made


@pytest.fixture
def pair(master: Master, cards: list[Echo]) -> list[Station]:
    """Two stations in Operate, in groups 1 and 2, with Sync and Freeze."""
    made = [master.add(Station(address, IDENT, CONFIGURATION, group=group, sync=True, freeze=True))
            for address, group in ((5, 1), (6, 2))]
    master.operate()
    return made


def printed(capsys: pytest.CaptureFixture[str], *argv: str, code: int = 0) -> str:
    assert main(argv) == code
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return out if code == 0 else err


# ---- Slave_Diag, Get_Cfg, RD_Inp, RD_Outp


def test_services_of_a_station_in_the_cycle_disturb_nobody(master: Master, pair: list[Station]) -> None:
    first = pair[0]
    first.wait_sent(first.update(0, b"abcd"))
    first.wait(lambda frame: frame.octets == b"abcd", 2)
    for ask in (first, master):
        where = () if ask is first else (5,)
        diagnosis = ask.slave_diag(*where)
        assert (diagnosis.ident_number, diagnosis.master, diagnosis.ready) == (IDENT, 1, True)
        assert ask.get_cfg(*where) == CONFIGURATION
        assert ask.rd_inp(*where) == b"abcd"
        assert ask.rd_outp(*where) == b"abcd"
    assert first.inputs == b"abcd" and all(s.state == StationState.DATA for s in pair)


def test_a_diagnosis_by_hand_is_the_cycles_too(wire: Segment, cards: list[Echo], pair: list[Station]) -> None:
    wire.set_diagnosis(cards[0], b"\x02\x42", ext_diag=True, announce=False)
    assert pair[0].slave_diag().extended == b"\x02\x42"
    held = pair[0].diagnosis
    assert held is not None and held.extended == b"\x02\x42"
    assert pair[0].state == StationState.DATA


def test_services_of_a_station_that_is_nobodys(master: Master, cards: list[Echo]) -> None:
    assert master.slave_diag(5).master is None
    assert master.get_cfg(5) == CONFIGURATION
    for service in (master.rd_inp, master.rd_outp):
        with pytest.raises(StationError, match=r"station 5 refuses RD_(Inp|Outp): RS") as caught:
            service(5)
        assert caught.value.address == 5
    with pytest.raises(StationError, match="station 9 does not answer: is it powered"):
        master.slave_diag(9)
    with pytest.raises(ConfigurationError, match="address 127"):
        master.get_cfg(127)
    assert master.mode == Mode.STOP, "it was opened for this"


# ---- Global_Control


def flags(station: Station) -> Diag:
    return station.slave_diag().flags & (Diag.SYNC_MODE | Diag.FREEZE_MODE)


def test_sync_and_freeze_reach_the_group_and_end(master: Master, pair: list[Station]) -> None:
    """Page I.4: Diag.Sync_Mode and Freeze_Mode say what is active."""
    master.global_control(sync=True, group=1)
    assert [flags(s) for s in pair] == [Diag.SYNC_MODE, Diag(0)]
    master.global_control(freeze=True, station=pair[1])
    assert [flags(s) for s in pair] == [Diag.SYNC_MODE, Diag.FREEZE_MODE]
    master.global_control(sync=False, freeze=False)
    assert [flags(s) for s in pair] == [Diag(0), Diag(0)]


def test_sync_shows_what_was_committed_before_it(master: Master, pair: list[Station], cards: list[Echo]) -> None:
    master.global_control(sync=True)
    for value in (b"aaaa", b"bbbb", b"cccc"):
        for station in pair:
            station.update(0, value)
        assert [s.rd_outp() for s in pair] != [value, value], "held"
        master.global_control(sync=True)
        assert [s.rd_outp() for s in pair] == [value, value]
    master.global_control(sync=False)


def test_clear_of_one_station_holds_until_it_is_ended(master: Master, pair: list[Station]) -> None:
    for station in pair:
        station.wait_sent(station.update(0, b"runs"))
    master.global_control(clear=True, station=5)
    pair[1].wait_sent(pair[1].update(0, b"on.."))
    pair[0].update(0, b"runs")
    for _ in range(20):
        master.wait_cycle()
    assert [s.rd_outp() for s in pair] == [SAFE, b"on.."]
    master.global_control(clear=False, station=5)
    pair[0].wait_sent(pair[0].update(0, b"back"))
    assert pair[0].rd_outp() == b"back"


def test_in_stop_it_is_sent_at_once(master: Master, cards: list[Echo]) -> None:
    master.stop()
    sent = master.statistics.sdn
    master.global_control(freeze=True)
    assert master.statistics.sdn == sent + 1


@pytest.mark.parametrize(("options", "kind", "words"), [
    ({}, ConfigurationError, "without a command"), ({"sync": 1.5}, ConfigurationError, r"sync 1\.5: True, False"),
    ({"sync": True, "group": 256}, ConfigurationError, "group 256"),
    ({"sync": True, "group": 1, "station": 5}, ConfigurationError, "group 01h, station 5: give one"),
    ({"sync": True, "station": 126}, ConfigurationError, "station 126"),
    ({"sync": True, "station": "pump"}, ConfigurationError, "station 'pump'"),
    ({"freeze": True, "group": 4}, ConfigurationError, "no active station of this master is in group 04h"),
    ({"freeze": True, "station": 9}, ConfigurationError, "no active station of this master is at address 9"),
    ({"clear": False}, NotOperatingError, r"Clear.*operate\(\) first"),
])
def test_commands_that_make_no_sense(master: Master, cards: list[Echo], options: dict[str, Any], kind: type[Exception],
                                     words: str) -> None:
    master.add(Station(5, IDENT, CONFIGURATION, group=1, sync=True))
    master.clear()
    with pytest.raises(kind, match=words):
        master.global_control(**options)


def test_a_command_that_nobody_was_told_of(master: Master, cards: list[Echo]) -> None:
    master.add(Station(5, IDENT, CONFIGURATION, sync=True))
    master.clear()
    master.global_control(sync=True)
    with pytest.raises(ConfigurationError, match=r"freeze=True: Set_Prm told no station"):
        master.global_control(freeze=True)


# ---- Set_Slave_Add


class Slave(Services):
    """A slave behind a `request`: SAPs 55 and 60 and FDL status. `stores`: what it makes of Set_Slave_Add."""

    address = 1
    mode = Mode.STOP
    stations = ()

    def __init__(self, at: int = 126, owner: int = 0xFF, taken: tuple[int, ...] = (), stores: str = "at once") -> None:
        self.at, self.owner, self.taken, self.stores = at, owner, taken, stores
        self.set: list[bytes] = []
        self._bus = self  # type: ignore[assignment]

    def _start(self) -> None:
        pass

    def wait(self, ready: Callable[[], object], timeout: float) -> None:
        if self.stores == "late" and self.set:
            self.at = self.set[-1][0]

    def request(self, address: int, service: Any = Service.SRD, dsap: int | None = None, ssap: int | None = None,
                data: bytes = b"", timeout: float | None = 1.0) -> Answer:
        if address != self.at and address not in self.taken:
            raise StationError(f"station {address} does not answer", address=address, reason="does not answer")
        if service == Service.FDL_STATUS:
            return Answer(0x00, b"", None, 1)
        if dsap == 55:
            self.set.append(data)
            if self.stores == "at once":
                self.at = data[0]
            elif self.stores == "at power-on":
                self.at = -1
            return Answer(None, b"", None, 1)
        assert dsap == 60
        return Answer(0x08, bytes((0x02, 0x05, 0, self.owner, 0x0A, 0xCF)), None, 1)


@pytest.mark.parametrize("stores", ["at once", "late"])
@pytest.mark.parametrize(("lock", "octet"), [(False, 0x00), (True, 0xFF)])
def test_an_address_is_set_and_seen(stores: str, lock: bool, octet: int) -> None:
    """Page F.2: New_Slave_Add, Ident_Number, No_Add_Chg 00 or 01..FF, Rem_Slave_Data."""
    slave = Slave(stores=stores)
    slave.set_slave_add(126, 7, 0x0ACF, lock, rem_slave_data=b"\x55")
    assert slave.set == [bytes((7, 0x0A, 0xCF, octet, 0x55))] and slave.at == 7


@pytest.mark.parametrize(("slave", "words"), [
    (Slave(taken=(7,)), "address 7 has a station already"), (Slave(at=3), "station 126 does not answer"),
    (Slave(owner=2), "station 126 belongs to master 2"),
])
def test_an_address_is_not_set_where_that_would_break_something(slave: Slave, words: str) -> None:
    with pytest.raises(StationError, match=words):
        slave.set_slave_add(126, 7, 0x0ACF)
    assert slave.set == []


def test_another_device_keeps_its_address() -> None:
    slave = Slave()
    with pytest.raises(StationError, match="ident number 0ACFh and not 00CAh: nothing was changed"):
        slave.set_slave_add(126, 7, 0x00CA)
    assert slave.set == []


@pytest.mark.parametrize(("stores", "words"), [("never", "kept its address.*locked"),
                                               ("at power-on", "neither address.*switched off")])
def test_an_address_that_is_not_taken_is_told(stores: str, words: str) -> None:
    with pytest.raises(StationError, match=words):
        Slave(stores=stores).set_slave_add(126, 7, 0x0ACF, timeout=0.01)


@pytest.mark.parametrize(("arguments", "words"), [
    ((127, 7, 0), "old 127: 0 to 126"), ((5, 126, 0), "new 126: 0 to 125"), ((5, 5, 0), "two different"), ((5, 1, 0), "own"),
    ((5, 7, 0x10000), "ident_number 65536"),
])
def test_addresses_that_cannot_be(arguments: tuple[int, int, int], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Slave().set_slave_add(*arguments)


def test_a_station_in_the_cycle_keeps_its_address(master: Master, pair: list[Station]) -> None:
    with pytest.raises(NotOperatingError, match=r"station 5 at address 5 is in the master's cycle: deactivate\(\)"):
        master.set_slave_add(5, 9, IDENT)


class Movable(Echo):
    set_address = True


def test_an_address_is_set_over_the_wire_and_locked(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    """From the factory's 126 to a station that exchanges."""
    card = wire.attach(Movable(126))
    port = wire.port()
    assert "station 126 is station 7 now: 1234h, locked" in printed(
        capsys, "set-address", port, "126", "7", "--ident", "1234", "--lock")
    assert "kept its address" in printed(capsys, "set-address", port, "7", "8", "--ident", "1234", code=1)
    with Master(port) as master:
        station = master.add(Station(7, IDENT, CONFIGURATION))
        master.operate()
        assert station.state == StationState.DATA and wire.report(card).address == 7


# ---- slaves without inputs


class Valve(Echo):
    configurations = (b"\x23",)
    max_diagnosis = 62

    def __init__(self, habits: Habits) -> None:
        super().__init__(5)
        self.habits = habits


@pytest.mark.parametrize(("announce", "poll"), [("sd1", None), ("octet", None), ("never", 0.02), ("never", None)])
def test_diagnosis_of_a_slave_without_inputs(wire: Segment, announce: Any, poll: float | None) -> None:
    """Page I.2: disputed how it announces: every way is understood, and diagnosis_poll is for none at all."""
    card = wire.attach(Valve(Habits(announce=announce)))
    with Master(wire.port()) as master:
        station = master.add(Station(5, IDENT, b"\x23", diagnosis_poll=poll))
        master.operate()
        station.wait_sent(station.update(0, b"open"))
        wire.set_diagnosis(card, b"\x02\x42", ext_diag=True)
        if announce == "never" and poll is None:
            for _ in range(50):
                master.wait_cycle()
            assert station.diagnosis is not None and station.diagnosis.extended == b""
        else:
            until(lambda: station.diagnosis is not None and station.diagnosis.extended == b"\x02\x42")
            assert master.system_diagnostic == {5}
        assert station.state == StationState.DATA


# ---- stations come, go and change while the bus runs (that the others' exchange goes on is shown in test_dp_modes.py)


def runs(drive: Station) -> None:
    """Its card's application has seen it."""
    drive.update(0, b"RUN!")
    drive.wait(lambda frame: frame.octets == b"RUN!", 5)


def test_a_station_is_deactivated_and_activated(wire: Segment, master: Master, cards: list[Echo]) -> None:
    drive, other = master.add(Drive(5)), master.add(Station(6, IDENT, CONFIGURATION))
    master.operate()
    runs(drive)
    drive.deactivate()
    assert (drive.state, drive.active, len(drive.rested)) == (StationState.INACTIVE, False, 1)
    assert cards[0].written == [b"RUN!", b"STOP"]
    assert wire.report(cards[0]).master is None and wire.report(cards[0]).state == SlaveState.WAIT_PRM
    assert drive.slave_diag().master is None, "services by hand go on"
    drive.activate()
    until(lambda: drive.state == StationState.DATA)
    assert drive.outputs == SAFE
    assert other.state == StationState.DATA


def test_the_time_to_be_released_in_counts_from_the_next_cycle(wire: Segment, cards: list[Echo]) -> None:
    with Master(wire.port(), cycle_time=0.6) as master:
        station = master.add(Station(6, IDENT, CONFIGURATION, watchdog=10.0))
        master.clear()
        until(lambda: station.state not in (StationState.OFFLINE, StationState.INACTIVE))  # a cycle has just begun
        station.deactivate(timeout=0.3)
        assert station.state == StationState.INACTIVE


def test_a_station_is_removed_and_another_takes_its_place(wire: Segment, cards: list[Echo]) -> None:
    with Master(wire.port(), max_stations=2) as master:
        drive, other = master.add(Drive(5)), master.add(Station(6, IDENT, CONFIGURATION))
        master.operate()
        runs(drive)
        for next_ in (Drive(5), drive, drive):
            was = master.stations[1] if master.stations[0] is other else master.stations[0]
            master.remove(was)
            assert master.stations == (other,) and wire.report(cards[0]).master is None
            with pytest.raises(ConfigurationError, match="belongs to no master"):
                was.update(0, b"RUN!")
            master.add(next_)
            until(lambda: other.state == StationState.DATA and master.data_transfer_list == {5, 6})
        with pytest.raises(ConfigurationError, match="none of this master's stations"):
            master.remove(Drive(5))
    assert cards[0].written[:2] == [b"RUN!", b"STOP"]


def test_before_the_bus_begins_stations_just_change(master: Master) -> None:
    pump = master.add(Station(5, IDENT, CONFIGURATION))
    pump.deactivate()
    assert pump.state == StationState.INACTIVE
    pump.activate()
    pump.reparameterise(b"\x01")
    assert pump.state == StationState.OFFLINE and pump.user_parameters == b"\x01"
    master.remove(pump)
    assert master.stations == () and master.mode == Mode.OFFLINE


def test_new_parameters_reach_a_running_station(wire: Segment, master: Master, cards: list[Echo]) -> None:
    drive, other = master.add(Drive(5)), master.add(Station(6, IDENT, CONFIGURATION))
    master.operate()
    runs(drive)
    drive.group = 4
    drive.reparameterise(b"\x10\x20")
    report = wire.report(cards[0])
    assert (report.user_parameters, report.group, drive.state) == (b"\x10\x20", 4, StationState.DATA)
    assert (len(drive.rested), drive.outputs) == (1, SAFE), "it stood still for it, and waits for a new commit"
    runs(drive)
    assert other.state == StationState.DATA


def test_new_parameters_that_are_refused(master: Master, pair: list[Station]) -> None:
    with pytest.raises(ConfigurationError, match="user_parameters of 238 octets"):
        pair[0].reparameterise(bytes(238))
    with pytest.raises(StationError, match=r"station 5 is not back in Data_Exchange: it refuses its parameters"):
        pair[0].reparameterise(bytes(5))
    pair[0].reparameterise(b"")
    until(lambda: pair[0].state == StationState.DATA)


# ---- modes


def test_operate_does_not_wait_for_who_refuses_for_good(master: Master, cards: list[Echo]) -> None:
    master.add(Station(5, IDENT, b"\x34"))
    begin = time.monotonic()
    with pytest.raises(StationError, match="Cfg_Fault"):
        master.operate(timeout=60)
    assert time.monotonic() - begin < 20


def test_operate_waits_for_who_may_come(master: Master, cards: list[Echo]) -> None:
    master.add(Station(5, IDENT, b"\x34"))
    master.add(Station(9, IDENT, CONFIGURATION))
    begin = time.monotonic()
    with pytest.raises(StationError, match="2 of 2 stations"):
        master.operate(timeout=1.5)
    assert time.monotonic() - begin >= 1.5


def test_auto_clear(wire: Segment, cards: list[Echo]) -> None:
    """Page J.1, Error_Action_Flag: Operate -> Clear, and back only with all."""
    with Master(wire.port(), auto_clear=True, data_control_time=0.2) as master:
        pair = [master.add(Station(address, IDENT, CONFIGURATION)) for address in (5, 6)]
        with pytest.raises(ConfigurationError, match=r"partial=True with auto_clear=True"):
            master.operate(partial=True)
        master.operate()
        assert master.data_transfer_list == {5, 6} and master.system_diagnostic == frozenset()
        pair[0].wait_sent(pair[0].update(0, b"runs"))
        with master.events() as events:
            wire.unplug(cards[1])
            while (event := events.take(5)) is not None and event.kind is not EventKind.AUTO_CLEAR:
                pass
            assert event is not None and event.address == 6 and "auto_clear went to Clear" in str(event)
        until(lambda: pair[0].rd_outp() == SAFE)
        assert (master.mode, master.system_diagnostic) == (Mode.CLEAR, {6})
        status = master.master_status
        assert (status.mode, status.auto_cleared, status.latched) == (Mode.CLEAR, 6, False)
        assert status.fdl_state > FdlState.LISTEN_TOKEN
        with pytest.raises(DPTimeout, match=r"since station 6 was not in data transfer \(auto_clear\): operate\(\) again"):
            pair[0].wait_sent(pair[0].update(0, b"no.."), timeout=0.05)
        with pytest.raises(DPTimeout, match="1 of 2 stations"):
            master.operate(timeout=0.1)
        wire.plug(cards[1])
        master.operate()
        assert master.mode == Mode.OPERATE and master.master_status.auto_cleared is None


@pytest.mark.parametrize(("name", "value", "words"), [
    ("data_control_time", 0, "data_control_time 0 s: 0.01 to 655.35"), ("data_retries", 16, "data_retries 16: 0 to 15"),
])
def test_settings_of_the_cycle_out_of_range(wire: Segment, name: str, value: Any, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Master(wire.port(), **{name: value})


@pytest.mark.parametrize(("name", "value", "words"), [
    ("diagnosis_poll", 0, "diagnosis_poll 0 s: 0.01 to 3600 s, or None"), ("ready_timeout", "1", "ready_timeout '1' s"),
])
def test_settings_of_a_station_out_of_range(name: str, value: Any, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Station(5, IDENT, CONFIGURATION, **{name: value})


# ---- the log, and the end


def test_log_lines_name_the_master(wire: Segment, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dpmaster")
    with Master(wire.port(), address=3, output_watchdog=None) as master:
        master.add(Station(9, IDENT, CONFIGURATION, name="pump"))
        with pytest.raises(DPTimeout):
            master.operate(timeout=0.1)
    lines = [record.getMessage() for record in caplog.records if record.name == "dpmaster.master"]
    assert len(lines) > 2 and all(line.startswith(f"master 3 on {master._bus.path}: ") for line in lines)


HURRIED = """
import sys
from dpmaster import Master, Station
class Drive(Station):
    def _rest(self):
        print("rests", flush=True)
        self.wait(lambda frame: False, None)  # unlike one long sleep, it sees a signal that came straight before it
with Master(sys.argv[1]) as master:
    drive = master.add(Drive(5, 0x1234, bytes([0x33]), watchdog=None))
    master.operate()
    drive.wait_sent(drive.update(0, b"RUN!"))
    print("runs", flush=True)
    drive.wait(lambda frame: False, None)
"""


def test_a_second_ctrl_c_skips_the_stop_word_but_not_clear_and_unlock(wire: Segment, cards: list[Echo]) -> None:
    """Its watchdog is off: only Clear and Unlock stop it."""
    with child("-c", HURRIED, wire.port()) as program:
        for line in ("runs\n", "rests\n"):
            assert program.stdout.readline() == line
            program.send_signal(2)
        program.communicate(timeout=20)
    until(lambda: (wire.report(cards[0]).state, wire.report(cards[0]).master) == (SlaveState.WAIT_PRM, None))


def test_a_master_nobody_keeps_unlocks_its_stations(wire: Segment, cards: list[Echo]) -> None:
    master = Master(wire.port())
    master.add(Station(5, IDENT, CONFIGURATION, watchdog=None))
    master.operate()
    assert wire.report(cards[0]).master == 1
    del master

    def unlocked() -> bool:
        gc.collect()  # again and again: the thread that logs may have held it for the moment of the first
        return wire.report(cards[0]).master is None

    until(unlocked)


def test_a_wait_for_events_comes_back_though_none_came(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal between Python's last look for one and the system call is seen with the next look."""
    monkeypatch.setattr("dpmaster.events.LOOK", 0.01)
    with Master(wire.port()) as master, master.events() as events:
        events._poll(None)
        assert events.take(0.05) is None


# ---- the command line


def test_a_technician_reads_a_station(wire: Segment, cards: list[Echo], capsys: pytest.CaptureFixture[str]) -> None:
    port = wire.port()
    text = printed(capsys, "diag", port, "5")
    assert "station 5: 1234h, free" in text and "is not ready for Data_Exchange yet" in text
    found = json.loads(printed(capsys, "diag", port, "5", "--json"))
    assert found | {"station": 5, "ident_number": 0x1234, "master": None, "ready": False} == found
    assert "STATION_NOT_READY" in found["flags"]
    assert "slot  1: 4 octets of outputs" in printed(capsys, "cfg", port, "5")
    found = json.loads(printed(capsys, "cfg", port, "5", "--json"))
    assert (found["configuration"], found["input_length"], found["output_length"]) == ("33", 4, 4)
    assert "'dpmaster diag' tells" in printed(capsys, "read-inputs", port, "5", code=1)
    assert "does not answer" in printed(capsys, "read-outputs", port, "9", code=1)


@pytest.mark.usefixtures("pair")
@pytest.mark.parametrize(("command", "request_"), [(("diag", "5"), "the request to station 5"), (("control", "--freeze"), "")])
def test_a_technician_beside_a_master_is_told_why_nothing_is_asked(wire: Segment, command: tuple[str, ...], request_: str,
                                                                   capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, command[0], wire.port(), *command[1:], code=1)
    assert f"{request_} had no turn on the bus in 1 s; master 1 has the bus, and this one is silent beside it" in text


def test_a_technician_reads_images(cards: list[Echo], wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a slave that its master has just left alone: within its watchdog's time it is in Data_Exchange still."""
    with Master(wire.port()) as master:
        station = master.add(Station(5, IDENT, CONFIGURATION, watchdog=None, active=False))
        station.set_prm(watchdog=None)
        station.chk_cfg()
        station.data_exchange(b"abcd")
        until(lambda: station.data_exchange(b"abcd") == b"abcd")
    port = wire.port()
    for what in ("inputs", "outputs"):
        assert "61 62 63 64" in printed(capsys, f"read-{what}", port, "5")
        assert json.loads(printed(capsys, f"read-{what}", port, "5", "--json"))[what] == "61626364"
    assert "sync sent to group 1 and 3 as master 1" in printed(
        capsys, "control", port, "--master", "1", "--sync", "--group", "3", "--group", "1")
    assert json.loads(printed(capsys, "control", port, "--master", "1", "--clear", "--station", "5", "--json"))["station"] == 5
    until(lambda: wire.report(cards[0]).clear)
    assert "00 00 00 00" in printed(capsys, "read-outputs", port, "5"), "the slave obeyed its master's address"


def test_a_technician_sets_an_address(wire: Segment, cards: list[Echo], capsys: pytest.CaptureFixture[str]) -> None:
    port = wire.port()
    assert "address 6 has a station already" in printed(capsys, "set-address", port, "5", "6", "--ident", "1234", code=1)
    assert "1234h and not 0ACFh" in printed(capsys, "set-address", port, "5", "7", "--ident", "0x0acf", code=1)
    assert "two different" in printed(capsys, "set-address", port, "5", "5", "--ident", "1234h", code=2)


@pytest.mark.parametrize("argv", [["diag", "p", "127"], ["diag", "p"], ["control", "p", "--sync", "--unsync"],
                                  ["set-address", "p", "5", "6", "--ident", "pump"], ["set-address", "p", "5", "6"],
                                  ["control", "p", "--sync", "--group", "9"]])
def test_wrong_arguments(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(argv)
    assert left.value.code == 2 and "usage: dpmaster" in capsys.readouterr().err


def test_a_control_without_a_command_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert "no command" in printed(capsys, "control", "/dev/null", code=2)


def test_threads_order_one_after_the_other(master: Master, pair: list[Station]) -> None:
    def order() -> None:
        for _ in range(5):
            master.global_control(freeze=True, timeout=10)

    threads = [threading.Thread(target=order) for _ in range(4)]
    sent = master.statistics.sdn
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert master.statistics.sdn >= sent + 20
