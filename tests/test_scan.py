# SPDX-License-Identifier: MIT
"""The live list and ``dpmaster scan``: whom they find, that they disturb nobody, how it looks."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator

import pytest
from children import child
from waiting import until

from dpmaster import EventKind, Live, LiveEntry, Master, Station, StationState, cli
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

IDENT = 0x00CA  # YASK00CA.GSD


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment() as made:
        yield made


def there(found) -> dict[int, LiveEntry]:
    return {at: entry for at, entry in found.items() if entry.kind not in (Live.NONE, Live.UNKNOWN)}


# ---- master.live_list()


def test_it_finds_slaves_and_their_ident_numbers(wire: Segment) -> None:
    for address in (5, 17):
        wire.attach(SIP1(address=address))
    with Master(wire.port()) as master:
        events = master.events()
        found = master.live_list(highest=20)
        assert set(found) == set(range(21)) - {1}
        assert there(found) == {5: LiveEntry(Live.SLAVE), 17: LiveEntry(Live.SLAVE)}
        assert all(entry.kind != Live.UNKNOWN for entry in found.values())
        assert there(master.live_list(highest=20, identify=True)) == {at: LiveEntry(Live.SLAVE, IDENT) for at in (5, 17)}
        asked = master.statistics.requests
        assert there(master.live_list(highest=20, identify=True)) and master.statistics.requests == asked, "all is known"
        live = [event for event in iter(lambda: events.take(0), None) if event.kind == EventKind.LIVE]
        assert [str(event) for event in live] == [f"station {n}: live list: unknown -> slave" for n in (5, 17)]


def test_refresh_asks_again(wire: Segment) -> None:
    card = wire.attach(SIP1(address=5))
    with Master(wire.port()) as master:
        assert there(master.live_list(highest=8))
        wire.unplug(card)
        assert there(master.live_list(highest=8)), "known, and not asked again"
        assert not there(master.live_list(highest=8, refresh=True))


def test_what_there_is_no_time_for_stays_unknown(wire: Segment) -> None:
    with Master(wire.port()) as master:
        assert {entry.kind for entry in master.live_list(timeout=0).values()} == {Live.UNKNOWN}


def test_the_cycle_goes_on_meanwhile() -> None:
    """Real time where the system grants it: a loaded computer's lateness is no loss."""
    with (Segment(realtime=True) as wire,
          Master(wire.port(), output_watchdog=None, realtime=True, allowance=0.05) as master):
        card = wire.attach(SIP1(address=5))
        wire.attach(SIP1(address=6))
        drive = master.add(YaskawaV7(address=5, watchdog=5.0))
        master.operate()
        found = master.live_list(highest=12, identify=True)
        assert there(found) == {5: LiveEntry(Live.SLAVE, IDENT), 6: LiveEntry(Live.SLAVE, IDENT)}
        assert drive.state == StationState.DATA and wire.report(card).watchdog_expired == 0
        assert drive.statistics.losses == 0


def test_a_lost_station_leaves_the_list(wire: Segment) -> None:
    """The cycle's own requests tell, too: nobody needs to ask."""
    card = wire.attach(SIP1(address=5))
    with Master(wire.port()) as master:
        station: Station = master.add(YaskawaV7(address=5))
        master.operate()
        events = master.events()
        wire.unplug(card)
        assert "station 5: live list: slave -> nobody" in iter(lambda: str(events.take(5.0)), "None")
        until(lambda: station.state != StationState.DATA)


def test_slave_diag_does_not_take_a_slave_from_its_master() -> None:
    """In a ring: one master exchanges, the other asks for the ident number."""
    from test_ring_pty import PARAMETERS, RATE

    with Segment(RATE, realtime=True) as wire:
        card = wire.attach(SIP1(address=11))
        with (Master(wire.port(), parameters=PARAMETERS, address=1, output_watchdog=None, realtime=True) as owner,
              Master(wire.port(), parameters=PARAMETERS, address=2, realtime=True) as guest):
            drive = owner.add(YaskawaV7(address=11))
            owner.operate()
            found = guest.live_list(identify=True, highest=12)
            assert there(found) == {1: LiveEntry(Live.MASTER_IN_RING), 11: LiveEntry(Live.SLAVE, IDENT)}
            assert drive.state == StationState.DATA and drive.statistics.starts == 1 and drive.statistics.losses == 0
            assert wire.report(card).master == 1


# ---- dpmaster scan


def test_the_grid_fits_a_terminal_and_names_what_is_there(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    wire.attach(SIP1(address=5))
    port = wire.port()
    assert cli.main(["scan", port, "--hsa", "17"]) == 0
    assert capsys.readouterr().out == f"""\
{port}, 500 kbit/s: 1 station

       0 1 2 3 4 5 6 7 8 9
    0  @ . . . . s . . . .
   10  . . . . . . . .
       @ this program   . nobody   s slave

    5  slave   00CAh  Yaskawa V7, SI-P1
"""


def test_a_slave_far_away_is_found_with_the_allowance_it_needs(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    """As behind a converter on the network; a pty's own allowance is 25 ms."""
    wire.attach(SIP1(address=3))
    wire.faults(delay=0.03)
    assert cli.main(["scan", wire.port(), "--hsa", "3", "--allowance", "400"]) == 0
    assert "3  slave   00CAh" in capsys.readouterr().out


def test_json(wire: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    wire.attach(SIP1(address=5))
    port = wire.port()
    assert cli.main(["scan", port, "--hsa", "8", "--master", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "port": port, "baudrate": 500_000, "address": 3, "foreign_master": None, "unknown": [],
        "stations": [{"address": 5, "kind": "slave", "ident_number": IDENT, "name": "Yaskawa V7, SI-P1"}]}


def test_on_a_bus_with_a_master_it_only_listens(wire: Segment, capsys: pytest.CaptureFixture[str],
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    from dpmaster.cli import scan

    monkeypatch.setattr(scan, "EAVESDROP", 0.3)
    card = wire.attach(SIP1(address=5))
    with Master(wire.port(), address=2, output_watchdog=None) as master:
        drive = master.add(YaskawaV7(address=5))
        master.operate()
        assert cli.main(["scan", wire.port(), "--hsa", "9"]) == 0
        assert drive.statistics.losses == 0 and wire.report(card).master == 2
        assert master.statistics.foreign is None, "not a bit was sent"
    out = capsys.readouterr().out
    assert "2 stations; master 2 has the bus, so this program only listens" in out
    assert "    0  ? ? M ? ? s ? ? ? ?\n" in out
    assert "? not heard   s slave   M master in the ring" in out


@pytest.mark.parametrize("argv", [["--hsa", "127"], ["--master", "126"], ["--hsa", "x"], []])
def test_wrong_arguments_are_usage(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["scan", *(["/dev/null", *argv] if argv else [])])
    assert left.value.code == 2


@pytest.mark.parametrize(("argv", "words", "code"), [
    (["/dev/nowhere"], "/dev/nowhere", 1), (["/dev/nowhere", "--baudrate", "1200"], "1200", 2),
])
def test_what_fails_is_one_line(argv: list[str], words: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["scan", *argv]) == code
    err = capsys.readouterr().err
    assert words in err and err.count("\n") == 1


def test_watch_prints_changes_until_the_signal(wire: Segment) -> None:
    card = wire.attach(SIP1(address=5))
    with child("-m", "dpmaster", "scan", wire.port(), "--hsa", "6", "--json", "--watch",
               env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}) as program:
        first = json.loads(program.stdout.readline())
        wire.unplug(card)
        second = json.loads(program.stdout.readline())
        assert [len(seen["stations"]) for seen in (first, second)] == [1, 0]
        program.send_signal(signal.SIGINT)
        assert program.wait(10) == 0
