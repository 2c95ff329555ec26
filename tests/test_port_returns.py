# SPDX-License-Identifier: MIT
"""A port that disappears under a running master and comes back: told at once, resumed by itself, safe until a new commit.

A segment's ports are behind symbolic links here, as ``dpmaster segment --link`` makes them: the stable path of a pty.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_master_pty import CONFIGURATION, IDENT, SAFE, Echo
from waiting import until

from dpmaster import EventKind, Master, Mode, PortError, Station, StationState
from dpmaster.emulator import Segment


class Unplugged:
    """A wire with an echo card at 5 and 6, behind a link that outlives it."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.plug()

    def plug(self) -> None:
        self.wire = Segment()
        self.cards = [self.wire.attach(Echo(address)) for address in (5, 6)]
        anew = self.link.with_suffix(".anew")
        anew.symlink_to(self.wire.port())
        anew.rename(self.link)

    def pull(self) -> None:
        self.wire.close()


@pytest.fixture
def adapter(tmp_path: Path) -> Iterator[Unplugged]:
    made = Unplugged(tmp_path / "ttyBUS")
    yield made
    made.wire.close()


def test_the_exchange_resumes_by_itself_with_safe_outputs(adapter: Unplugged) -> None:
    with Master(str(adapter.link), output_watchdog=0.5) as master:
        stations = [master.add(Station(address, IDENT, CONFIGURATION)) for address in (5, 6)]
        master.operate()
        first = stations[0]
        first.wait_sent(first.update(0, b"runs"))
        with master.events() as events:
            adapter.pull()
            while (event := events.take(5)) is not None and event.kind is not EventKind.PORT:
                pass
        assert event is not None and "vanished" in str(event)
        with pytest.raises(PortError, match=r"ttyBUS: the port vanished.*by itself"):
            first.wait(lambda frame: True, 0.1)
        before, cpu = master.statistics.port, time.process_time()
        time.sleep(1.0)  # longer than the output watchdog's time: a program that waits for its port has not hung
        after = master.statistics.port
        assert after.wakeups - before.wakeups < 150 and after.cpu_time - before.cpu_time < 0.1, "no busy loop in between"
        assert time.process_time() - cpu < 0.5
        away = first.update(0, b"away")

        adapter.plug()
        until(lambda: all(s.state == StationState.DATA for s in stations))
        assert master.mode == Mode.OPERATE and not master.master_status.latched
        assert first.rd_outp() == SAFE and adapter.cards[0].written == [], "nothing of before, nothing of meanwhile"
        assert away > 0 and first.outputs == SAFE
        first.wait_sent(first.update(0, b"anew"))
        until(lambda: adapter.cards[0].written == [b"anew"])


def test_it_comes_and_goes_many_times(adapter: Unplugged) -> None:
    with Master(str(adapter.link)) as master:
        station = master.add(Station(5, IDENT, CONFIGURATION))
        for _ in range(3):
            master.operate()
            station.wait_sent(station.update(0, b"runs"))
            adapter.pull()
            until(lambda: station.state == StationState.OFFLINE)
            adapter.plug()
            until(lambda: station.state == StationState.DATA)
        assert station.statistics.losses == 3


def test_closing_without_a_port_is_bounded(adapter: Unplugged) -> None:
    master = Master(str(adapter.link))
    station = master.add(Station(5, IDENT, CONFIGURATION))
    master.operate()
    adapter.pull()
    until(lambda: station.state == StationState.OFFLINE)
    begin = time.monotonic()
    master.close()
    assert time.monotonic() - begin < 3
