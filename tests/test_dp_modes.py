# SPDX-License-Identifier: MIT
"""The DP master's modes and what goes with them, one event at a time: steps, Auto_Clear, Global_Control by order, the lists.

Protocol pages F.2 (Global_Control), I.4 (Sync, Freeze, Clear) and J.1 (modes). Stations and telegrams: dp_bus.py.
"""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from dp_bus import CLEAR, FREE, OPERATE, READY, SC, Bus, diagnosis, lose
from wire import MS, Master, S, Script, Slaves, Wire, default_parameters, ffi, lib, octets

UNFREEZE, FREEZE, UNSYNC, SYNC = 0x04, 0x08, 0x10, 0x20
MODES = (lib.DPM_MODE_OFFLINE, lib.DPM_MODE_STOP, lib.DPM_MODE_CLEAR, lib.DPM_MODE_OPERATE)
CHANNEL = octets("10 02 08 0A 14 16")  # DH of a slave without inputs: protocol page I.2


def control(command: int, group: int = 0, da: int = 127) -> bytes:
    """Global_Control of master 2 by hand."""
    body = bytes([da | 0x80, 0x82, 0x46, 0x3A, 0x3E, command, group])
    return bytes([0x68, 7, 7, 0x68]) + body + bytes([sum(body) & 0xFF, 0x16])


class Several:
    """A master with Festo terminals at 8, 9 and 10, in groups 1, 2 and 1+2; a hand that answers all alike."""

    def __init__(self, mode: int = lib.DPM_MODE_OPERATE, **options) -> None:
        self.master = Master(500_000, address=2, **options)
        for address, group in ((8, 1), (9, 2), (10, 3)):
            self.master.add(address, 0x0A35, b"\x21", group=group)
        self.script = Script(self.master)
        self.absent: set[int] = set()
        self.told: list[bytes] = []  # Global_Control, in order
        self.log: list[tuple[int, int | None, int]] = []  # address, SAP (None: Data_Exchange), start
        self.master.mode(lib.DPM_MODE_CLEAR)
        self.until(lambda: all(self.state(i) == lib.DPM_ST_DATA for i in range(3)))
        self.run(5)
        if mode == lib.DPM_MODE_OPERATE:
            self.master.mode(mode, self.script.now)
            self.run(5)
        self.told.clear()
        self.log.clear()

    def state(self, index: int) -> int:
        return self.master.slave(index).state

    def step(self) -> bytes:
        telegram = self.script.next()
        assert telegram, "the master fell silent"
        if telegram[6:9] == b"\x46\x3a\x3e":
            self.told.append(telegram)
            return telegram
        address, sap = telegram[4] & 0x7F, telegram[7] if telegram[4] & 0x80 else None
        self.log.append((address, sap, self.script.last.start))
        if address in self.absent:
            return telegram
        index = (8, 9, 10).index(address)
        ready = self.state(index) in (lib.DPM_ST_DIAG2, lib.DPM_ST_DATA)
        answer = diagnosis(*((0, 4, 0, 2) if ready else (2, 5, 0, 255)), 0x0A, 0x35, sa=address)
        self.script.answer(answer if sap == 60 else SC)
        return telegram

    def until(self, condition, limit: int = 5000) -> None:
        for _ in range(limit):
            if condition():
                return
            self.step()
        raise AssertionError("it did not come to that")

    def run(self, telegrams: int) -> list[bytes]:
        return [self.step() for _ in range(telegrams)]


# --- modes (J.1) -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", MODES)
@pytest.mark.parametrize("start", MODES)
def test_steps_only_between_neighbours(start, target):
    """J.1: "Steps only between neighbours: Offline-Stop-Clear-Operate"."""
    bus = Bus()
    bus.master.mode(start)
    bus.script.next(limit=20 * MS)
    list(bus.master.events())
    bus.master.mode(target, bus.script.now)
    for _ in range(4):
        bus.script.next(limit=20 * MS)
    assert bus.master.status.mode == target
    steps = [(e.b, e.a) for e in bus.master.events() if e.kind == lib.DPM_EV_MODE]
    between = [mode for mode in MODES if min(start, target) <= mode <= max(start, target)]
    assert steps == list(pairwise(between if start < target else reversed(between)))


def test_stop_starts_no_slave_and_only_passes_the_token():
    """J.1: "Stop: no slave start-up, no data exchange"."""
    bus = Bus(mode=lib.DPM_MODE_STOP)
    assert bus.script.next(limit=1 * S) == b""
    assert bus.script.next(limit=1 * S, tokens=True) == octets("DC 02 02"), "B.4 #34"


def test_offline_has_no_bus_activity_at_all():
    """J.1."""
    bus = Bus(mode=lib.DPM_MODE_OFFLINE)
    assert bus.script.next(limit=10 * S, tokens=True) == b""


@pytest.mark.parametrize(("way", "told"), [((lib.DPM_MODE_OPERATE, lib.DPM_MODE_CLEAR), (OPERATE, CLEAR)),
                                           ((lib.DPM_MODE_OPERATE, lib.DPM_MODE_STOP), (OPERATE, CLEAR)),
                                           ((lib.DPM_MODE_OPERATE, lib.DPM_MODE_OFFLINE), (OPERATE, CLEAR)),
                                           ((lib.DPM_MODE_STOP,), (CLEAR,))])
def test_every_change_is_told_before_the_next_request_to_a_slave(way, told):
    """J.1: "Global_Control is sent on every mode change"; leaving Operate says Clear before anybody is unlocked."""
    bus = Bus(control_interval=200 * S)
    bus.start()
    bus.exchange()
    for mode, expected in zip(way, told, strict=True):
        bus.master.mode(mode, bus.script.now)
        assert bus.script.next() == expected
        telegram = bus.script.next()
        assert telegram[7:9] == b"\0\0" if mode >= lib.DPM_MODE_CLEAR else telegram[7:10] == b"\x3d\x3e\x40"
        bus.script.answer(SC)


def test_clear_exchanges_and_reads_inputs():
    """J.1: "slaves are parameterised, configured, exchanged cyclically; inputs read"."""
    bus = Bus(configuration="11")
    inputs = octets("68 05 05 68 02 08 08 12 34 58 16")
    bus.start(inputs)
    assert bus.master.status.mode == lib.DPM_MODE_CLEAR
    assert bytes(bus.master.inputs(0).octets[0:2]) == b"\x12\x34" and bus.master.inputs(0).valid


# --- Auto_Clear and the lists -----------------------------------------------------------------------------------------


def addresses(octets_) -> set[int]:
    bits = int.from_bytes(bytes(octets_), "little")
    return {n for n in range(128) if bits >> n & 1}


def test_auto_clear_leaves_operate_when_a_station_was_not_in_data_transfer():
    """J.1: "if any activated slave was not in data transfer during Data_Control_Time, Operate -> Clear"."""
    bus = Several(control_interval=100 * MS, auto_clear=True)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.absent = {9}
    gone = bus.script.now
    bus.until(lambda: bus.master.status.mode == lib.DPM_MODE_CLEAR)
    assert gone + 298 * MS < bus.script.now < gone + 303 * MS
    assert bus.master.status.auto_cleared == 9
    assert [(e.kind, e.address) for e in bus.master.events() if e.kind == lib.DPM_EV_AUTO_CLEAR] == [(lib.DPM_EV_AUTO_CLEAR, 9)]
    assert all(t[7:9] == b"\0\0" for t in bus.run(20) if t[4] == 8), "the others are safe"
    assert CLEAR in bus.told
    # "Clear -> Operate only when all were in data exchange within Data_Control_Time."
    assert lib.dpm_master_set_mode(bus.master.master, lib.DPM_MODE_OPERATE, bus.script.now) == lib.DPM_E_MODE
    bus.absent = set()
    bus.until(lambda: 9 in addresses(bus.master.status.data_transfer))
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    assert bus.master.status.auto_cleared == -1
    assert all(t[7:9] == b"\0\0" for t in bus.run(20) if t[4] == 8), "what was written before is never sent again"


def test_a_short_absence_is_no_reason_for_auto_clear():
    bus = Several(control_interval=100 * MS, auto_clear=True)
    bus.absent = {9}
    bus.until(lambda: bus.state(1) == lib.DPM_ST_OFFLINE)
    bus.absent = set()
    end = bus.script.now + 1 * S
    bus.until(lambda: bus.script.now > end)
    assert bus.master.status.mode == lib.DPM_MODE_OPERATE


def test_without_the_flag_it_stays_in_operate():
    """J.1: "Flag off: stay in Operate"."""
    bus = Several(control_interval=100 * MS)
    bus.absent = {9}
    end = bus.script.now + 1 * S
    bus.until(lambda: bus.script.now > end)
    assert bus.master.status.mode == lib.DPM_MODE_OPERATE


def test_a_deactivated_station_is_none_that_auto_clear_waits_for():
    bus = Several(control_interval=100 * MS, auto_clear=True)
    lib.dpm_master_activate(bus.master.master, 1, False, bus.script.now)
    end = bus.script.now + 1 * S
    bus.until(lambda: bus.script.now > end)
    assert bus.master.status.mode == lib.DPM_MODE_OPERATE
    bus.absent = {9}
    lib.dpm_master_activate(bus.master.master, 1, True, bus.script.now)
    began = bus.script.now
    bus.until(lambda: bus.master.status.mode == lib.DPM_MODE_CLEAR)
    assert began + 298 * MS < bus.script.now < began + 310 * MS, "it has Data_Control_Time to get there"


def test_the_lists_name_who_transfers_and_who_needs_a_look():
    """J.2: Data_Transfer_List and System_Diagnostic, a bit per address."""
    bus = Several(control_interval=100 * MS)
    assert addresses(bus.master.status.data_transfer) == {8, 9, 10}
    assert addresses(bus.master.status.system_diagnostic) == set()
    bus.absent = {9}
    bus.until(lambda: bus.state(1) == lib.DPM_ST_OFFLINE)
    assert addresses(bus.master.status.system_diagnostic) == {9}
    assert 9 in addresses(bus.master.status.data_transfer), "it was, within Data_Control_Time"
    end = bus.script.now + 301 * MS
    bus.until(lambda: bus.script.now > end)
    assert addresses(bus.master.status.data_transfer) == {8, 10}
    lib.dpm_master_activate(bus.master.master, 1, False, bus.script.now)
    bus.run(5)
    assert addresses(bus.master.status.system_diagnostic) == set(), "nobody looks for one that is deactivated"
    status = bus.master.slave(1)
    assert status.diagnosis[1] & 0x80, "H.1: Deactivated is the master's own bit"


def test_a_diagnosis_with_a_fault_is_in_system_diagnostic_while_data_go_on():
    bus = Bus()
    bus.start()
    bus.exchange(CHANNEL)
    bus.next()
    bus.script.answer(diagnosis(0x08, 0x0C, 0, 2, 0x0A, 0x35, extended=octets("88 41 21")))
    assert bus.state == lib.DPM_ST_DATA
    assert addresses(bus.master.status.system_diagnostic) == {8} == addresses(bus.master.status.data_transfer)
    bus.exchange(CHANNEL)
    bus.next()
    bus.script.answer(READY)
    assert addresses(bus.master.status.system_diagnostic) == set()


# --- Global_Control by order (F.2, I.4) --------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [SYNC, UNSYNC, FREEZE, UNFREEZE, SYNC | FREEZE, UNSYNC | UNFREEZE, SYNC | UNFREEZE])
@pytest.mark.parametrize("mode", [lib.DPM_MODE_CLEAR, lib.DPM_MODE_OPERATE])
def test_a_command_carries_the_modes_own_clear_bit(mode, command):
    """F.2: bit 1 Clear_Data, 2 Unfreeze, 3 Freeze, 4 Unsync, 5 Sync; J.1: in Clear Clear_Data is 1."""
    bus = Several(mode, control_interval=200 * S)
    order = bus.master.order(bus.script.now, command=command, group=2)
    bus.until(lambda: order.done)
    assert bus.told == [control(command | (2 if mode == lib.DPM_MODE_CLEAR else 0), 2)]
    bus.run(50)
    assert len(bus.told) == 1, "a command is sent once"


def test_to_one_station():
    """F.2: "DA 127 (or a single slave)"."""
    bus = Several(control_interval=200 * S)
    order = bus.master.order(bus.script.now, command=FREEZE, da=9)
    bus.until(lambda: order.done)
    assert bus.told == [control(FREEZE, 0, da=9)]


def test_an_order_that_cannot_be_sent_is_refused():
    """A telegram to oneself would come back as invalid, cycle after cycle, and no slave would have its turn."""
    bus = Several(control_interval=200 * S)
    order = ffi.new("dpm_control *", {"da": 2, "command": SYNC, "clear": -1})
    assert lib.dpm_master_order(bus.master.master, order, bus.script.now) == lib.DPM_E_ARGUMENT


def test_the_cyclic_repetition_neither_cancels_nor_repeats_a_sync():
    """I.4: "each further Sync transfers once; Unsync returns to normal": what is repeated bears neither."""
    bus = Several(control_interval=20 * MS)
    order = bus.master.order(bus.script.now, command=SYNC)
    bus.until(lambda: order.done)
    bus.told.clear()
    bus.until(lambda: len(bus.told) == 10)
    assert set(bus.told) == {OPERATE}


@pytest.mark.parametrize("under_way", [False, True])
@pytest.mark.parametrize("before", range(3))
def test_sync_goes_out_once_each_station_has_what_was_committed_before(before, under_way):
    """I.4: "the currently buffered outputs go to the terminals": those of one moment, in whatever part of the cycle it is
    ordered; at a defined place, before the cycle's first Data_Exchange."""
    bus = Several(control_interval=200 * S)
    bus.run(before)
    if under_way:
        bus.script.next()  # with the outputs of before
    for index in range(3):
        bus.master.commit(index, bytes([index + 1] * 2), bus.script.now)
    order = bus.master.order(bus.script.now, command=SYNC)
    if under_way:
        bus.script.answer(SC)
    seen: dict[int, bytes] = {}
    while not order.done:
        telegram = bus.step()
        if telegram not in bus.told:
            seen[telegram[4]] = telegram[7:9]
    assert seen == {8: b"\1\1", 9: b"\2\2", 10: b"\3\3"}
    assert [bus.step()[4] for _ in range(3)] == [8, 9, 10]


def test_a_diagnosis_in_place_of_the_exchange_holds_a_sync_back():
    """J.2: DH, "then Slave_Diag in the next slot of the cycle"; what was committed follows it, and then Sync."""
    bus = Bus(control_interval=200 * S)
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.exchange(CHANNEL)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    order = bus.master.order(bus.script.now, command=SYNC)
    assert bus.script.next()[7] == 0x3C
    bus.script.answer(READY)
    assert not order.done
    assert bus.script.next()[7:9] == b"\x11\x11"
    bus.script.answer(SC)
    assert bus.script.next() == control(SYNC)
    assert order.done


def test_a_station_that_is_lost_holds_no_order_back():
    bus = Several(control_interval=200 * S)
    bus.absent = {9}
    order = bus.master.order(bus.script.now, command=SYNC)
    bus.until(lambda: order.done, limit=40)


@pytest.mark.parametrize(("da", "group", "cleared"), [(127, 0, {8, 9, 10}), (127, 2, {9, 10}), (9, 0, {9}), (127, 0x80, set())])
def test_clear_by_order_makes_those_concerned_safe_until_it_is_ended(da, group, cleared):
    """F.2: Clear_Data by group and by station; "ends with the next normal Data_Exchange" (I.4), so there is none."""
    bus = Several(control_interval=20 * MS)

    def commit(value: int) -> None:
        for index in range(3):
            bus.master.commit(index, bytes([value, value]), bus.script.now)

    def outputs() -> dict[int, bytes]:
        return {t[4]: t[7:9] for t in bus.run(9) if t[4] < 127}

    commit(0x11)
    assert set(outputs().values()) == {b"\x11\x11"}
    bus.told.clear()
    order = bus.master.order(bus.script.now, da=da, group=group, clear=1)
    first = outputs()
    assert {at for at, value in first.items() if value == b"\0\0"} == cleared, "from the next Data_Exchange on"
    assert order.done and control(2, group, da) in bus.told
    commit(0x22)
    end = bus.script.now + 100 * MS
    while bus.script.now < end:
        found = outputs()
        assert {at for at, value in found.items() if value == b"\0\0"} == cleared
        assert {value for at, value in found.items() if at not in cleared} <= {b"\x22\x22"}
    # The repetition to all says Operate; those cleared are told again.
    at = bus.told.index(OPERATE)
    assert bus.told[at + 1:at + 1 + len(cleared)] == [control(2, 0, da=address) for address in sorted(cleared)]
    order = bus.master.order(bus.script.now, da=da, group=group, clear=0)
    bus.until(lambda: order.done)
    assert bus.told[-1] == control(0, group, da)
    commit(0x33)
    bus.run(6)
    assert set(outputs().values()) == {b"\x33\x33"}


def test_a_repetition_does_not_outlive_clear_by_order():
    """ "What was written before is never sent again": not as the repetition of the telegram under way either."""
    bus = Bus()
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    assert bus.next()[7:9] == b"\x11\x11"
    bus.master.order(bus.script.now, da=8, clear=1)
    assert bus.next()[7:9] == b"\0\0"


def test_the_next_change_of_mode_ends_a_clear_by_order():
    bus = Several(control_interval=200 * S)
    bus.master.order(bus.script.now, da=8, clear=1)
    bus.run(6)
    bus.master.mode(lib.DPM_MODE_CLEAR, bus.script.now)
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.run(6)
    assert b"\x11\x11" in {t[7:9] for t in bus.run(6) if t[4] == 8}


@pytest.mark.parametrize(("mode", "fields", "code"), [
    (lib.DPM_MODE_OPERATE, {"command": 0x01}, "ARGUMENT"), (lib.DPM_MODE_OPERATE, {"command": 0x40}, "ARGUMENT"),
    (lib.DPM_MODE_OPERATE, {"command": 0x02}, "ARGUMENT"), (lib.DPM_MODE_OPERATE, {"da": 128}, "ARGUMENT"),
    (lib.DPM_MODE_OPERATE, {"clear": 2}, "ARGUMENT"), (lib.DPM_MODE_CLEAR, {"clear": 0}, "MODE"),
    (lib.DPM_MODE_STOP, {"command": SYNC}, "MODE"),
])
def test_orders_that_cannot_be_carried_out(mode, fields, code):
    """F.2: bits 0, 6 and 7 are reserved."""
    bus = Bus(mode=mode)
    order = ffi.new("dpm_control *", {"da": 127, "clear": -1} | fields)
    assert lib.dpm_master_order(bus.master.master, order, 0) == getattr(lib, f"DPM_E_{code}")


def test_one_order_at_a_time_and_a_revoked_one_is_not_sent():
    bus = Several(control_interval=200 * S)
    order = bus.master.order(bus.script.now, command=FREEZE)
    other = ffi.new("dpm_control *", {"da": 127, "command": SYNC, "clear": -1})
    assert lib.dpm_master_order(bus.master.master, other, bus.script.now) == lib.DPM_E_BUSY
    lib.dpm_master_revoke(bus.master.master, order)
    bus.run(20)
    assert bus.told == [] and not order.done
    assert lib.dpm_master_order(bus.master.master, other, bus.script.now) == 0
    bus.until(lambda: other.done)


# --- stations come and go while the bus runs ---------------------------------------------------------------------------


def exchanges(bus: Several, address: int, since: int = 0) -> list[int]:
    return [start for at, sap, start in bus.log if at == address and sap is None and start >= since]


def longest(times: list[int]) -> int:
    return max(b - a for a, b in pairwise(times))


def undisturbed(bus: Several) -> int:
    """ns, a cycle of all three."""
    bus.run(30)
    return longest(exchanges(bus, 10))


@pytest.mark.parametrize("change", ["new_prm", "deactivate", "activate", "add", "remove"])
def test_the_others_exchange_goes_on_while_one_changes(change):
    """Its place in the cycle is all it costs them: the telegrams of start-up and leaving, one per cycle, nothing else."""
    bus = Several(control_interval=200 * S)
    usual = undisturbed(bus)
    master, now = bus.master, bus.script.now
    changed = 1
    if change == "new_prm":
        assert lib.dpm_master_new_prm(master.master, 1, now) == 0
    elif change == "add":
        lib.dpm_master_activate(master.master, 1, False, now)
        bus.until(lambda: bus.state(1) == lib.DPM_ST_INACTIVE)
        assert lib.dpm_master_remove(master.master, 1) == 0
        now = bus.script.now
        changed = master.add(9, 0x0A35, b"\x21", group=2)
        assert changed == 1, "the place that was left"
    else:
        lib.dpm_master_activate(master.master, 1, False, now)
        bus.until(lambda: bus.state(1) == lib.DPM_ST_INACTIVE)
        if change == "activate":
            bus.run(10)
            now = bus.script.now
            lib.dpm_master_activate(master.master, 1, True, now)
        elif change == "remove":
            assert lib.dpm_master_remove(master.master, 1) == 0
    if change in ("new_prm", "activate", "add"):
        bus.until(lambda: bus.state(changed) == lib.DPM_ST_DATA)
        bus.run(10)
    bus.run(30)
    longest_telegram = bus.script.bits(11 * (16 + 17 + 2))  # Set_Prm or a diagnosis in place of a Data_Exchange; Global_Control
    for address in (8, 10):
        assert longest(exchanges(bus, address, now - usual)) <= usual + longest_telegram + bus.script.bits(400)
        assert master.slave(0 if address == 8 else 2).statistics.losses == 0


def test_a_deactivated_station_is_unlocked_and_never_asked():
    """J.2: "Active=0: not handled; DATA never reached"."""
    bus = Several(control_interval=200 * S)
    bus.master.commit(1, b"\x11\x11", bus.script.now)
    bus.run(6)
    bus.log.clear()
    lib.dpm_master_activate(bus.master.master, 1, False, bus.script.now)
    bus.run(30)
    assert [sap for at, sap, _ in bus.log if at == 9] == [61], "Set_Prm with Unlock, and nothing else"
    assert bus.state(1) == lib.DPM_ST_INACTIVE and not bus.master.inputs(1).valid
    assert bus.master.slave(1).statistics.losses == 0, "it was left on purpose"
    # A repetition of what was asked before brings no state back, and activation no output.
    lib.dpm_master_activate(bus.master.master, 1, True, bus.script.now)
    bus.until(lambda: bus.state(1) == lib.DPM_ST_DATA)
    assert all(t[7:9] == b"\0\0" for t in bus.run(12) if t[4] == 9)


def test_deactivated_with_outputs_under_way_they_are_not_sent_again():
    bus = Bus(slave={"hold": True})
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    assert bus.next()[7:9] == b"\x11\x11"
    lib.dpm_master_activate(bus.master.master, 0, False, bus.script.now)
    assert bus.next()[7:10] == b"\x3d\x3e\x40"
    bus.script.answer(SC)
    lib.dpm_master_activate(bus.master.master, 0, True, bus.script.now)
    for answer in (FREE, SC, SC, READY):
        bus.next()
        bus.script.answer(answer)
    assert bus.next()[7:9] == b"\0\0", "hold is for losses, not for what the program did itself"


def test_deactivated_and_activated_before_the_unlock_is_out():
    bus = Several(control_interval=200 * S)
    lib.dpm_master_activate(bus.master.master, 1, False, bus.script.now)
    lib.dpm_master_activate(bus.master.master, 1, True, bus.script.now)
    bus.until(lambda: bus.state(1) == lib.DPM_ST_DATA)


@pytest.mark.parametrize("hold", [False, True])
def test_new_prm_goes_from_data_to_set_prm_and_on(hold):
    """J.2: "New_Prm flag: from DATA send Set_Prm (go PRM), then on"."""
    bus = Bus(slave={"hold": hold})
    bus.start()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    bus.master.commit(0, b"\x11\x11", bus.script.now)
    bus.exchange()
    new = ffi.new("dpm_slave_set *", {"address": 8, "ident_number": 0x0A35, "configuration": b"\x21", "configuration_length": 1,
                                      "user_parameters": b"\x42", "user_parameters_length": 1, "hold": hold})
    assert lib.dpm_master_change(bus.master.master, 0, new) == 0
    assert bus.exchange()[7:9] == b"\x11\x11", "at the next Set_Prm, and no sooner"
    assert lib.dpm_master_new_prm(bus.master.master, 0, bus.script.now) == 0
    telegram = bus.next()
    assert telegram[7:-2] == octets("3D 3E 80 01 01 00 0A 35 00 42")
    bus.script.answer(SC)
    assert bus.next()[7] == 0x3E
    bus.script.answer(SC)
    assert bus.next()[7] == 0x3C
    bus.script.answer(READY)
    assert bus.next()[7:9] == b"\0\0", "it comes back with safe outputs"
    assert bus.slave.statistics.losses == 0


def test_only_an_inactive_station_can_be_removed_and_its_place_is_free_then():
    master = Master(500_000, address=2, slaves=1)
    assert master.add(8, 0x0A35, b"\x21") == 0
    assert lib.dpm_master_remove(master.master, 0) == lib.DPM_E_BUSY
    assert lib.dpm_master_activate(master.master, 0, False, 0) == 0
    assert lib.dpm_master_remove(master.master, 0) == 0
    for call in (lib.dpm_master_remove, lambda m, i: lib.dpm_master_new_prm(m, i, 0),
                 lambda m, i: lib.dpm_master_activate(m, i, True, 0)):
        assert call(master.master, 0) == lib.DPM_E_ARGUMENT
    assert lib.dpm_master_get_slave(master.master, 0, ffi.new("dpm_slave_status *")) == lib.DPM_E_ARGUMENT
    master.mode(lib.DPM_MODE_OPERATE)
    assert master.add(9, 0x0A35, b"\x21") == 0
    script = Script(master)
    while (telegram := script.next())[4] == 0xFF:
        pass
    assert telegram[4] == 0x89


# --- requests by hand beside the cycle ----------------------------------------------------------------------------------


def test_a_diagnosis_by_hand_is_the_handlers_too():
    """I.2: the flag is withdrawn when the own master has fetched Slave_Diag, whoever in it asked."""
    bus = Bus()
    bus.start()
    before = bus.slave.diagnosis_number
    request = bus.master.request(8, 0x0D, dsap=60, ssap=62)
    while (telegram := bus.next())[4] == 8:
        bus.script.answer(SC)
    assert telegram[7] == 0x3C
    bus.script.answer(diagnosis(0x08, 0x0C, 0, 2, 0x0A, 0x35, extended=octets("42 01")))
    assert request.done and bytes(request.answer[0:8]) == octets("08 0C 00 02 0A 35 42 01")
    assert bus.slave.diagnosis_number == before + 1 and bus.slave.diagnosis_length == 8
    assert bus.state == lib.DPM_ST_DATA


@pytest.mark.parametrize("interval", [0, 5, 50])
def test_min_slave_interval_holds_for_requests_by_hand(interval):
    """P8: "the master must keep this distance for every master-slave function"; and such a request is not kept out by it."""
    bus = Bus(slave={"min_slave_interval": interval})
    bus.start()
    last = bus.script.last.start
    for _ in range(5):
        request = bus.master.request(8, 0x0D, dsap=59, ssap=62)
        for _ in range(3):
            telegram = bus.next()
            assert bus.script.last.start - last >= interval * 100_000
            last = bus.script.last.start
            bus.script.answer(SC if telegram[4] == 8 else octets("68 06 06 68 82 88 08 3E 3B 21 AC 16"))
            if request.done:
                break
        assert request.done
    assert bus.state == lib.DPM_ST_DATA


@pytest.mark.parametrize("raw", [False, True], ids=["Data_Exchange", "by hand"])
def test_min_slave_interval_counts_from_a_repetition(raw):
    """It may be the first that the slave has heard."""
    bus = Bus(slave={"min_slave_interval": 30})
    bus.start()
    if raw:
        bus.master.request(8, 0x0D, dsap=59, ssap=62)
    first, repeated = bus.next(), bus.next()
    assert first == repeated
    last = bus.script.last.start
    bus.script.answer(octets("68 06 06 68 82 88 08 3E 3B 21 AC 16") if first[4] == 0x88 else SC)
    assert bus.next()[4] in (0x08, 0x88)
    assert bus.script.last.start - last >= 3 * MS


class Slow:
    """Our master and three of our slaves with a Min_Slave_Intervall of 25, 0 and 3 ms."""

    def __init__(self, cycle_time: int = 0) -> None:
        parameters = default_parameters()
        self.master = Master(parameters=parameters, address=2, cycle_time=cycle_time)
        self.slaves = Slaves(parameters=parameters)
        for address, interval in ((8, 250), (9, 0), (10, 30)):
            for machine in (self.master, self.slaves):
                machine.add(address, 0x00CA, b"\x72", min_slave_interval=interval)
        self.wire = Wire(parameters, self.master.machine, self.slaves.machine)
        self.master.mode(lib.DPM_MODE_OPERATE)

    def until_exchanging(self) -> None:
        self.wire.run_until(lambda: all(self.master.slave(i).state == lib.DPM_ST_DATA for i in range(3)))

    def check(self) -> None:
        assert [self.slaves.report(i).too_soon for i in range(3)] == [0, 0, 0]


@pytest.mark.parametrize("raw", [False, True], ids=["", "with a request by hand waiting"])
@pytest.mark.parametrize("cycle_time", [0, 1 * S])
def test_leaving_keeps_min_slave_interval_and_waits_for_nothing_else(cycle_time, raw):
    """At every place of the cycle, and in the middle of a telegram: never a cycle time, never an Unlock too soon."""
    for telegrams in range(16):
        bus = Slow(cycle_time)
        bus.until_exchanging()
        for _ in range(telegrams):
            bus.wire.step()
        if raw:
            bus.master.request(8, 0x0D, dsap=60, ssap=62)
            bus.wire.step(bus.wire.now + MS // 10)
        bus.master.mode(lib.DPM_MODE_STOP, bus.wire.now)
        begin = bus.wire.now
        bus.wire.run_until(lambda bus=bus: bus.master.status.mode == lib.DPM_MODE_STOP)
        assert bus.wire.now - begin < 25 * MS + 3 * MS
        assert [bus.slaves.report(i).state for i in range(3)] == [lib.DPM_SL_WAIT_PRM] * 3
        bus.wire.run(bus.wire.now + 30 * MS)
        bus.check()


def test_leaving_does_not_wait_for_an_interval_of_seconds():
    """Min_Slave_Intervall may be 6.5 s: the way out is bounded, the Unlock comes sooner then."""
    bus = Bus(slave={"min_slave_interval": 65535})
    bus.script.next(limit=60 * S)
    for answer in (FREE, SC, SC, READY):
        bus.script.answer(answer)
        bus.next(limit=60 * S)
    bus.script.answer(SC)
    begin = bus.script.now
    bus.master.mode(lib.DPM_MODE_STOP, begin)
    assert bus.next()[7:10] == b"\x3d\x3e\x40"
    assert bus.script.last.start - begin < 110 * MS


@pytest.mark.parametrize("seed", range(20))
def test_min_slave_interval_holds_whatever_a_program_does(seed):
    """Stations that come, go and are parameterised anew, requests by hand and changes of the mode, at any moment."""
    print(f"seed {seed}")
    dice = random.Random(seed)
    bus = Slow()
    for _ in range(60):
        now, index = bus.wire.now, dice.randrange(3)
        match dice.randrange(5):
            case 0:
                lib.dpm_master_activate(bus.master.master, index, dice.random() < 0.6, now)
            case 1:
                lib.dpm_master_new_prm(bus.master.master, index, now)
            case 2:
                bus.master.mode(dice.choice((lib.DPM_MODE_STOP, lib.DPM_MODE_CLEAR, lib.DPM_MODE_OPERATE)), now)
            case _:
                bus.master.request(8 + index, 0x0D, dsap=dice.choice((59, 60)), ssap=62)
        bus.wire.run(now + dice.randrange(40 * MS))
        bus.check()
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.wire.now)
    for index in range(3):
        lib.dpm_master_activate(bus.master.master, index, True, bus.wire.now)
    bus.until_exchanging()
    bus.check()


def test_a_request_that_was_waiting_for_a_station_that_left_blocks_nobody():
    bus = Bus(slave={"min_slave_interval": 50})
    bus.start()
    request = bus.master.request(8, 0x0D, dsap=59, ssap=62)
    bus.script.next(limit=1 * MS)
    lib.dpm_master_cancel(bus.master.master, request)
    lose(bus)
    bus.script.silence(20 * MS)
    assert bus.next()[6:8] == b"\x6d\x3c"


def test_services_of_another_masters_slave():
    """F.2: Slave_Diag, Get_Cfg, RD_Inp and RD_Outp are for any master; its own goes on meanwhile."""
    parameters = default_parameters()
    own, other = (Master(parameters=parameters, address=address, role=lib.DPM_ROLE_RING) for address in (1, 2))
    slaves = Slaves(parameters=parameters)
    slaves.add(8, 0x0A35, b"\x31")
    slaves.put_inputs(0, b"\x12\x34")
    wire = Wire(parameters, own.machine, other.machine, slaves.machine)
    own.add(8, 0x0A35, b"\x31")
    own.mode(lib.DPM_MODE_OPERATE)
    other.mode(lib.DPM_MODE_STOP)
    wire.run_until(lambda: own.las == other.las == {1, 2} and own.slave(0).state == lib.DPM_ST_DATA)
    number = own.commit(0, b"\x55\x66", wire.now)
    wire.run_until(lambda: own.was_sent(0, number) == 1)
    for sap, expected in ((60, octets("00 04 00 01 0A 35")), (59, b"\x31"), (56, b"\x12\x34"), (57, b"\x55\x66")):
        request = other.request(8, 0x0D, dsap=sap, ssap=62)
        wire.run_until(lambda request=request: request.done)
        assert bytes(request.answer[0 : request.answer_length]) == expected
    assert own.slave(0).state == lib.DPM_ST_DATA and own.slave(0).statistics.losses == 0
