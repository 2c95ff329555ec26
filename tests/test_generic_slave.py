# SPDX-License-Identifier: MIT
"""The slave described by data: its images as a program sees them, diagnosis, what becomes of it on a wire, its console.

Octets and pages are the protocol page's.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from children import child
from gsd_files import NAMES
from gsd_files import path as gsd_path
from slave_rig import octets, telegram
from waiting import until

from dpmaster import ClosedError, ConfigurationError, DPError, DPTimeout, Master, Station, StationState
from dpmaster.cli import main
from dpmaster.emulator import Exchange, Habits, Segment, SlaveState, blocks
from dpmaster.emulator.cards import SIP1, GenericSlave
from dpmaster.emulator.host import slave_config
from dpmaster.gsd import GSD

IDENT = 0x0A35
PATIENCE = 5.0  # s; only a failing test waits so long


def exchanging(outputs: bytes, configuration: int = 0, valid: bool = True, number: int = 1) -> Exchange:
    return Exchange(SlaveState.DATA_EXCH, outputs, valid, number, configuration, 2)


# --- blocks, page H.2


@pytest.mark.parametrize(("block", "expected"), [
    (blocks.identifiers([9], of=24), "44 00 01 00"),  # "identifier block, bit 8 -> 9th module"
    (blocks.channel(9, 1, 1), "88 41 21"),  # "module 8, input channel 1, bit, short circuit"
    (blocks.device(b"\x10\x20\x30"), "04 10 20 30"),
    (blocks.identifiers([], of=64), "49 00 00 00 00 00 00 00 00"),  # B.4 #6
    (blocks.module_status({}, of=64), "14 82 00 00" + " 00" * 16),  # B.4 #6
    (blocks.module_status({1: 3, 2: 1, 6: 2}, of=6), "06 82 00 00 07 08"),  # "slot 1 = bits 1..0 of the first octet"
    (blocks.channel(1, 63, 17, direction="output", type=5), "80 BF B1"),
    (blocks.channel(64, 0, 9, direction="both", type=0), "BF C0 09"),
    (blocks.revision(5), "C5"),  # "ONE octet, bits 5..0 = revision number"
    (blocks.device(bytes(62)), "3F" + " 00" * 62),
])
def test_blocks_octet_by_octet(block: bytes, expected: str) -> None:
    assert block == octets(expected)


@pytest.mark.parametrize("call", [
    lambda: blocks.device(b""), lambda: blocks.device(bytes(63)), lambda: blocks.identifiers([0], of=8),
    lambda: blocks.identifiers([9], of=8), lambda: blocks.identifiers([], of=497), lambda: blocks.channel(65, 0, 1),
    lambda: blocks.channel(1, 64, 1), lambda: blocks.channel(1, 0, 32), lambda: blocks.channel(1, 0, 1, type=8),
    lambda: blocks.channel(1, 0, 1, direction="up"), lambda: blocks.revision(64), lambda: blocks.module_status({1: 4}, of=4),
    lambda: blocks.module_status({5: 1}, of=4), lambda: blocks.module_status({}, of=237),
])
def test_what_no_block_can_say(call: Callable[[], bytes]) -> None:
    with pytest.raises(ConfigurationError):
        call()


# --- images


def test_modules_and_their_part_of_the_images() -> None:
    """Page G.2: 33 = 4 octets both ways, 00 empty, C0 01 00 = 2 octets out, 1 in (output length first), D3 E1 of one module."""
    slave = GenericSlave(5, IDENT, [b"\x33", b"\x00", octets("C0 01 00"), octets("D3 E1"), octets("02 AA BB")])
    assert slave.configurations == (octets("33 00 C0 01 00 D3 E1 02 AA BB"),)
    assert [module.slot for module in slave.modules] == [1, 2, 3, 4, 5]
    assert [module.identifier for module in slave.modules] == [1, 2, 3, 4, 6], "every identifier counts, 00 too"
    assert slave[3] is slave.modules[2]
    assert [len(module.inputs) for module in slave.modules] == [4, 0, 1, 8, 0]
    slave.step(0.0, exchanging(bytes(range(1, 11))))
    assert [module.outputs.hex() for module in slave.modules] == ["01020304", "", "0506", "0708090a", ""]
    slave.modules[2].inputs = b"\x77"
    slave.modules[3].inputs = range(8)
    slave.modules[1].inputs = b""
    assert slave.step(0.0, exchanging(bytes(10))) == octets("00 00 00 00 77 00 01 02 03 04 05 06 07") == slave.inputs
    slave.update(3, b"\xaa\xbb")
    assert slave.inputs == octets("00 00 00 AA BB 00 01 02 03 04 05 06 07")
    slave.inputs = bytes(13)
    assert slave.inputs == bytes(13)


def test_one_bytes_is_one_module_for_each_identifier() -> None:
    slave = GenericSlave(5, IDENT, octets("33 00 C0 01 00 42 83 AA BB"))
    assert [module.octets for module in slave.modules] == [b"\x33", b"\x00", octets("C0 01 00"), octets("42 83 AA BB")]


@pytest.mark.parametrize(("change", "names"), [
    (lambda s: setattr(s, "inputs", bytes(3)), "4"), (lambda s: setattr(s, "inputs", 4), "bytes"),
    (lambda s: s.update(4, b"\x01"), "offset"), (lambda s: s.update(-1, b"\x01"), "offset"),
    (lambda s: s.update(3, b"\x01\x02"), "octet 3"), (lambda s: s.update(0, b""), "1 to 4"),
    (lambda s: setattr(s.modules[0], "inputs", b"\x01"), "slot 1"),
])
def test_inputs_that_do_not_fit(change: Callable[[GenericSlave], None], names: str) -> None:
    slave = GenericSlave(5, IDENT, b"\x33")
    slave.inputs = octets("01 02 03 04")
    with pytest.raises(ConfigurationError, match=names):
        change(slave)
    assert slave.inputs == octets("01 02 03 04")


@pytest.mark.parametrize("arguments", [
    {"modules": b"\x41"}, {"modules": [b"\xff"] * 8}, {"address": 127}, {"ident_number": 0x10000},
    {"max_diagnosis": 5}, {"others": [b"\x41"]}, {"modules": [b"\x41", b"\x31"]},
])
def test_what_no_slave_is(arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        GenericSlave(**{"address": 5, "ident_number": IDENT, "modules": b"\x33", **arguments})


def test_the_master_may_choose_another_configuration() -> None:
    slave = GenericSlave(5, IDENT, b"\x33", others=[octets("11 21")])
    slave.inputs = octets("01 02 03 04")
    assert slave.step(0.0, exchanging(b"\x0a\x0b", configuration=1)) == octets("01 02")
    assert [(module.inputs, module.outputs) for module in slave.modules] == [(octets("01 02"), b""), (b"", octets("0A 0B"))]
    with pytest.raises(ConfigurationError):
        slave.inputs = bytes(4)


def test_outputs_that_do_not_count_are_the_substitute() -> None:
    """Page I.1 "outputs to safe state (0 or substitute)"."""
    for substitute, shown in ((b"", bytes(4)), (octets("7F"), octets("7F 00 00 00")), (bytes(range(9)), bytes(range(4)))):
        slave = GenericSlave(5, IDENT, b"\x33", substitute=substitute)
        assert slave.outputs == shown
        slave.step(0.0, exchanging(octets("01 02 03 04")))
        assert slave.outputs == octets("01 02 03 04")
        slave.step(0.0, exchanging(bytes(4), valid=False, number=2))
        assert slave.outputs == shown


def test_echo_reaches_as_far_as_it_can() -> None:
    for configuration, expected in (("33", "01 02 03 04"), ("11 23", "01 02"), ("15 23", "01 02 03 04 EE EE")):
        slave = GenericSlave(5, IDENT, octets(configuration), echo=True)
        slave.inputs = b"\xee" * len(slave.inputs)
        assert slave.step(0.0, exchanging(octets("01 02 03 04"))) == octets(expected)


def test_on_change_may_set_inputs_that_go_with_the_same_step() -> None:
    def invert(slave: GenericSlave) -> None:
        seen.append(slave.outputs)
        slave.inputs = bytes(~octet & 0xFF for octet in slave.outputs)

    seen: list[bytes] = []
    slave = GenericSlave(5, IDENT, b"\x33", on_change=invert)
    for _ in range(3):
        assert slave.step(0.0, exchanging(octets("01 02 03 04"))) == octets("FE FD FC FB")
    assert seen == [octets("01 02 03 04")], "a step without a change is none"


def test_on_change_cannot_wait_for_itself() -> None:
    """It would for ever: the change is told by the thread that is in it."""
    slave = GenericSlave(5, IDENT, b"\x33", on_change=lambda slave: slave.wait(lambda s: False, None))
    with pytest.raises(DPError, match=r"wait\(\) in on_change.*look at `outputs` there, or wait in a thread of your own"):
        slave.step(0.0, exchanging(octets("01 02 03 04")))
    slave.wait(lambda s: s.outputs == octets("01 02 03 04"), 0)


def test_power_off_forgets_inputs_and_diagnosis() -> None:
    slave = GenericSlave(5, IDENT, b"\x33")
    slave.inputs = octets("01 02 03 04")
    slave.reset(0.0)
    assert slave.inputs == bytes(4)


# --- what the slave's part of the C library is told


def test_every_habit_is_a_field_of_the_slave() -> None:
    """The first word of each is zero, the library's choice."""
    plain = slave_config(GenericSlave(5, IDENT, b"\x33"))
    names = ("wrong_length_ue", "prm_keeps_exchange", "foreign_sc", "announce", "control_feeds", "cfg_fault_keeps_master",
             "prm_open_takes_user")
    assert [getattr(plain, name) for name in names] == [0] * 7
    for field, name in zip(fields(Habits), names, strict=True):
        for number, word in enumerate(Habits.WORDS[field.name]):
            config = slave_config(GenericSlave(5, IDENT, b"\x33", habits=Habits(**{field.name: word})))
            assert [getattr(config, other) for other in names] == [number if other == name else 0 for other in names]
        with pytest.raises(ConfigurationError, match=field.name):
            Habits(**{field.name: "perhaps"})


def test_any_card_may_have_habits() -> None:
    card = SIP1(5)
    card.habits = Habits(wrong_length="ue")
    assert (slave_config(card).wrong_length_ue, slave_config(SIP1(5)).wrong_length_ue) == (True, False)


def test_the_other_settings() -> None:
    slave = GenericSlave(126, IDENT, b"\x33", user_parameters=(3, 9), fail_safe=True, sync=False, freeze=False,
                         max_diagnosis=32, min_slave_interval=7, set_address=True, address_locked=True, auto_baud=True,
                         baud_control=0.3, identity=("ACME", "SPC3", "V1", "V2.0"))
    config = slave_config(slave)
    assert (config.user_parameters_min, config.user_parameters_max, config.max_diagnosis) == (3, 9, 32)
    assert (config.fail_safe, config.sync_supported, config.freeze_supported) == (True, False, False)
    assert (config.min_slave_interval, config.set_address, config.address_locked) == (7, True, True)
    assert (config.auto_baud, config.baud_control) == (True, 30)
    assert bytes(config.identity[0 : config.identity_length]) == octets("04 04 02 04") + b"ACMESPC3V1V2.0"


@pytest.mark.parametrize("wrong", [
    {"modules": [b""]}, {"modules": [b"\0"] * 245}, {"min_slave_interval": -1}, {"baud_control": 2.6},
    {"baud_control": float("nan")}, {"identity": ("x" * 61, "", "", "")},
])
def test_settings_out_of_range(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(wrong)).replace("modules", "configuration")):
        slave_config(GenericSlave(**{"address": 5, "ident_number": IDENT, "modules": b"\x33", **wrong}))


# --- on a wire, with a master


@pytest.fixture
def wire() -> Iterator[Segment]:
    with Segment() as segment:
        yield segment


def station(slave: GenericSlave, **options: Any) -> Station:
    return Station(slave.address, slave.ident_number, slave.configurations[0], **options)


SHAPES = {
    "output-only": [b"\x21"], "input-only": [b"\x11"], "no data": [b"\x00"], "empty places": [b"\x00", b"\x31", b"\x00"],
    "special formats": [octets("C1 81 02 AA"), octets("41 C1 BB"), octets("83 45 01 02 03")],
    "244 each way": [b"\xff"] * 7 + [b"\xf9"], "244 out": [b"\xef"] * 7 + [b"\xe9"], "word consistency": [b"\x72", b"\xd3"],
}


@pytest.mark.parametrize("modules", SHAPES.values(), ids=SHAPES.keys())
def test_every_shape_exchanges(wire: Segment, modules: list[bytes]) -> None:
    """Outputs arrive, inputs set at any time are read, and what a program sees is what the master wrote."""
    slave = wire.attach(GenericSlave(5, IDENT, modules))
    sent, back = bytes(i % 255 + 1 for i in range(len(slave.outputs))), bytes(255 - i for i in range(len(slave.inputs)))
    with Master(wire.port(), 500_000) as master:
        one = master.add(station(slave))
        master.operate()
        if sent:
            one.wait_sent(one.update(0, sent))
            slave.wait(lambda s: s.outputs == sent, PATIENCE)
        slave.wait(lambda s: s.state is SlaveState.DATA_EXCH, PATIENCE)
        slave.inputs = back
        one.wait(lambda frame: frame.octets == back, PATIENCE)
        assert (slave.exchange.master, b"".join(module.outputs for module in slave.modules)) == (1, sent)
        master.clear()
        slave.wait(lambda s: s.exchange.valid is False or not sent, PATIENCE)
        assert slave.outputs == bytes(len(sent))
    slave.wait(lambda s: s.state is SlaveState.WAIT_PRM, PATIENCE)


def test_an_input_is_on_the_wire_with_the_next_answer(wire: Segment) -> None:
    """No step of the host's thread is waited for: behind the call the old octets are never read again."""
    slave = wire.attach(GenericSlave(5, IDENT, b"\x11"))
    with Master(wire.port(), 500_000) as master:
        one = master.add(station(slave))
        master.operate()
        for value in range(1, 50):
            slave.inputs = bytes([value, value])
            cycle = master.wait_cycle()
            while master.wait_cycle() < cycle + 2:
                pass
            assert one.inputs == bytes([value, value])


def test_diagnosis_comes_and_goes(wire: Segment) -> None:
    slave = GenericSlave(5, IDENT, b"\x33", max_diagnosis=12)
    slave.diagnosis(blocks.revision(3), fault=False)  # before it is on a wire: known from its first answer on
    wire.attach(slave)
    with Master(wire.port(), 500_000) as master:
        one = master.add(station(slave))
        master.operate()
        assert one.diagnosis is not None
        assert (one.diagnosis.extended, one.diagnosis.texts) == (b"\xc3", ("has its watchdog on",))

        def tells(extended: bytes, *clauses: str) -> bool:
            found = one.diagnosis
            return found is not None and found.extended == extended and set(clauses) <= set(found.texts)

        slave.diagnosis(blocks.channel(1, 2, 6))
        until(lambda: tells(octets("80 42 26"), "reports a fault in its extended diagnosis"))
        slave.diagnosis(blocks.device(bytes(40)))
        until(lambda: tells(octets("29 00 00 00 00 00"), "has more diagnosis than fits"))
        slave.diagnosis(blocks.device(bytes(2)), static=True)
        until(lambda: tells(octets("03 00 00"), "asks for Slave_Diag to be read instead of data exchanged"))
        slave.diagnosis()
        until(lambda: tells(b"") and one.state is StationState.DATA)
        wire.reset(slave)
        slave.wait(lambda s: s.state is SlaveState.DATA_EXCH, PATIENCE)


def test_not_ready_until_it_says_so(wire: Segment) -> None:
    slave = GenericSlave(5, IDENT, b"\x33")
    slave.ready = False
    wire.attach(slave)
    with Master(wire.port(), 500_000) as master:
        one = master.add(station(slave))
        with pytest.raises(DPTimeout, match="Station_Not_Ready"):
            master.operate(timeout=0.3)
        slave.ready = True
        until(lambda: one.state is StationState.DATA)



def test_a_new_address_is_the_cards_own_and_goes_with_it(wire: Segment) -> None:
    """Page F.2: "must be stored non-volatile"; the application is told."""
    seen: list[int | None] = []
    slave = GenericSlave(126, IDENT, b"\x33", set_address=True, on_change=lambda s: seen.append(s.exchange.address))
    wire.attach(slave)
    port = os.open(wire.port(), os.O_RDWR | os.O_NOCTTY)
    try:
        _ = wire.info
        os.write(port, telegram(126, 2, 0x6D, octets("08 0A 35 01") + b"mine", 55))
        slave.wait(lambda s: s.address == 8, PATIENCE)
        until(lambda: seen[-1:] == [8])
        assert (slave.address_locked, slave.remote_data) == (True, b"mine")
        wire.reset(slave)
        assert (slave.address, wire.report(slave).address, wire.report(slave).address_locked) == (8, 8, True)
    finally:
        os.close(port)
    with Segment() as another:  # the card is carried to another wire
        another.attach(slave)
        assert (another.report(slave).address, another.report(slave).address_locked) == (8, True)
        another.attach(GenericSlave(9, IDENT, b"\x33"))
        another.set_address(slave, 126)
        assert (slave.address, slave.address_locked, another.report(slave).address) == (126, False, 126)
        with pytest.raises(ConfigurationError, match="address"):
            another.set_address(slave, 127)
        with pytest.raises(ConfigurationError, match="9"):
            another.set_address(slave, 9)


def test_waits_end(wire: Segment) -> None:
    slave = wire.attach(GenericSlave(5, IDENT, b"\x33"))
    began = time.monotonic()
    with pytest.raises(DPTimeout, match="WAIT_PRM"):
        slave.wait(lambda s: False, 0.05)
    assert time.monotonic() - began >= 0.05
    with pytest.raises(ConfigurationError, match="timeout"):
        slave.wait(lambda s: True, "now")  # type: ignore[arg-type]
    threading.Timer(0.05, wire.close).start()
    with pytest.raises(ClosedError, match="wire was closed"):
        slave.wait(lambda s: False, None)
    slave.inputs = octets("01 02 03 04")
    slave.diagnosis(blocks.revision(1))
    slave.ready = False  # nothing of it reaches anybody, nothing of it hurts


def test_a_wait_comes_back_to_look_for_signals(wire: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C between Python's last look for one and the system call is seen with the next look."""
    slave = wire.attach(GenericSlave(5, IDENT, b"\x33"))

    def stay(seconds: float) -> None:
        assert seconds <= 1
        raise KeyboardInterrupt

    monkeypatch.setattr(slave._changed, "wait", stay)
    for timeout in (None, 60.0):
        with pytest.raises(KeyboardInterrupt):
            slave.wait(lambda s: False, timeout)


# --- described by a GSD file

ACME = """#Profibus_DP
GSD_Revision = 3
Vendor_Name = "ACME"
Model_Name = "Brick"
Revision = "1"
Ident_Number = 0x0A35
Protocol_Ident = 0
Station_Type = 0
Hardware_Release = "V1"
Software_Release = "V2.0"
19.2_supp = 1
MaxTsdr_19.2 = 60
Freeze_Mode_supp = 1
Sync_Mode_supp = 0
Auto_Baud_supp = 1
Set_Slave_Add_supp = 1
Fail_Safe = 1
Min_Slave_Intervall = 7
Max_Diag_Data_Len = 32
Modular_Station = 1
Max_Module = 4
Max_Input_Len = 20
Max_Output_Len = 20
Max_Data_Len = 40
Max_User_Prm_Data_Len = 4
Ext_User_Prm_Data_Const(0) = 0x11,0x22,0x33
Module = "2 bytes in" 0x11
EndModule
Module = "1 word out" 0x60
EndModule
Module = "Axis" 0xC0,0x01,0x02
Ext_Module_Prm_Data_Len = 1
EndModule
Module = "Blank" 0x00
EndModule
"""


def test_a_slave_is_what_its_file_says() -> None:
    slave = GenericSlave.from_gsd(GSD.parse(ACME), ["2 bytes in", "blank", "Axis"], address=5)
    assert (slave.address, slave.ident_number, slave.configurations) == (5, IDENT, (octets("11 00 C0 01 02"),))
    assert (slave.fail_safe, slave.freeze, slave.sync, slave.set_address) == (True, True, False, True)
    assert (slave.min_slave_interval, slave.max_diagnosis, slave.auto_baud) == (7, 32, False)
    assert slave.user_parameters == (4, 4), "three octets of the station, one of the axis"
    assert [(m.slot, m.identifier, m.name, len(m.inputs), len(m.outputs)) for m in slave.modules] == [
        (1, 1, "2 bytes in", 2, 0), (2, 2, "Blank", 0, 0), (3, 3, "Axis", 3, 2)]
    slave["axis"].inputs = b"\x01\x02\x03"
    assert slave[3].inputs == slave.inputs[2:] == b"\x01\x02\x03"
    for wrong in (4, "axle"):
        with pytest.raises(ConfigurationError, match="its slots are 1 2 bytes in, 2 Blank, 3 Axis"):
            _ = slave[wrong]


def test_options_go_before_the_file() -> None:
    slave = GenericSlave.from_gsd(GSD.parse(ACME), ["Axis"], address=126, user_parameters=(0, 9), sync=True, auto_baud=True)
    assert (slave.user_parameters, slave.sync, slave.auto_baud) == ((0, 9), True, True)


@pytest.mark.parametrize(("change", "modules", "names"), [
    ("Ident_Number = 0x0A35\n", ["Axis"], "Ident_Number"), ("Station_Type = 0", ["Axis"], "master"), ("", ["Wheel"], "Wheel"),
    ("", ["Axis"] * 5, "Max_Module"),
])
def test_a_file_that_describes_no_slave_of_that_kind(change: str, modules: list[str], names: str) -> None:
    text = ACME.replace(change, "Station_Type = 1" if "Station" in change else "") if change else ACME
    with pytest.raises(ConfigurationError, match=names):
        GenericSlave.from_gsd(GSD.parse(text), modules, address=5)


def test_a_station_and_a_slave_of_one_file(wire: Segment) -> None:
    modules = ["1 word out", "Axis"]
    slave = wire.attach(GenericSlave.from_gsd(GSD.parse(ACME), modules, address=5))
    with Master(wire.port(), 500_000) as master:
        one = master.add(Station.from_gsd(GSD.parse(ACME), 5, modules))
        master.operate()
        one["Axis"].outputs = octets("0A 0B")
        slave.wait(lambda s: s["Axis"].outputs == octets("0A 0B"), PATIENCE)
        slave["Axis"].inputs = octets("01 02 03")
        one.wait(lambda frame: one["Axis"].inputs == octets("01 02 03"), PATIENCE)
        master.clear()
        slave.wait(lambda s: not s.exchange.valid, PATIENCE)
        assert wire.report(slave).state is SlaveState.DATA_EXCH, "an empty Data_Exchange is Clear to it"
        assert wire.report(slave).user_parameters[1:3] == octets("22 33")


def test_the_makers_files_all_on_one_wire() -> None:
    """Every file that describes a slave: it comes into Data_Exchange with the station of the same file, and hears it."""
    if not NAMES:
        pytest.skip("the makers' GSD files are not there")
    devices = [device for device in map(GSD.load, map(gsd_path, NAMES)) if device.ident_number and not device.station_type]
    assert len(devices) > 80
    with Segment(cards=126) as wire:
        slaves = [wire.attach(GenericSlave.from_gsd(device, address=2 + i)) for i, device in enumerate(devices)]
        with Master(wire.port(), 500_000, output_watchdog=None) as master:
            stations = [master.add(Station.from_gsd(device, 2 + i, watchdog=10.0)) for i, device in enumerate(devices)]
            master.operate(timeout=30.0)
            for one, slave in zip(stations, slaves, strict=True):
                wanted = bytes(i % 255 + 1 for i in range(len(slave.outputs)))
                if wanted:
                    one.update(0, wanted)
                    slave.wait(lambda s, wanted=wanted: s.outputs == wanted, PATIENCE)


# --- the command


def test_the_console_of_a_gsd_file(tmp_path: Path) -> None:
    file, link = tmp_path / "acme.gsd", tmp_path / "slave"
    file.write_text(ACME)
    arguments = [str(file), "--module", "1 word out", "2 bytes in", "--module", "Axis", "--address", "5", "--link", str(link),
                 "--input", "0=AB CD"]
    with child("-m", "dpmaster", "emulate", "gsd", *arguments, stdin=subprocess.DEVNULL) as command:
        assert command.stdout.readline().rstrip() == os.readlink(link)
        with Master(str(link), 500_000) as master:
            one = master.add(Station.from_gsd(file, 5, ["1 word out", "2 bytes in", "Axis"]))
            master.operate()
            one.wait(lambda frame: frame.octets == octets("AB CD 00 00 00"), PATIENCE)
            one["1 word out"].outputs = octets("12 34")
            assert any(line == "outputs 12 34 00 00\n" for line in command.stdout)
        command.send_signal(signal.SIGINT)
        assert (command.wait(PATIENCE), command.stderr.read()) == (0, "")


def test_the_console(tmp_path: Path) -> None:
    link = tmp_path / "slave"
    arguments = ["--ident", "0A35", "--config", "33 00", "--config", "31", "--address", "5", "--link", str(link),
                 "--input", "2=AB", "--max-diagnosis", "32", "--habit", "wrong_length=ue"]
    with child("-m", "dpmaster", "emulate", "generic", *arguments, stdin=subprocess.PIPE) as command:
        converse(command, link)


def converse(command: subprocess.Popen[Any], link: Path) -> None:
    def say(line: str) -> None:
        print(line, file=command.stdin, flush=True)

    def line_of(what: str) -> str:
        return next(line for line in command.stdout if what in line).rstrip()

    assert command.stdout.readline().rstrip() == os.readlink(link)
    assert line_of("outputs") == "outputs 00 00 00 00 (not valid)"
    with Master(str(link), 500_000) as master:
        one = master.add(Station(5, IDENT, octets("33 00")))
        master.operate()
        assert line_of("DATA_EXCH") == "address 5, DATA_EXCH, master 1, configuration 33 00"
        one.wait(lambda frame: frame.octets == octets("00 00 AB 00"), PATIENCE)
        one.update(0, octets("01 02 03 04"))
        assert line_of("outputs 01") == "outputs 01 02 03 04"
        say("in 0 = 12 34")
        one.wait(lambda frame: frame.octets == octets("12 34 AB 00"), PATIENCE)
        say("in = 01 02 03 04")
        one.wait(lambda frame: frame.octets == octets("01 02 03 04"), PATIENCE)
        say("diag 80 42 26")
        until(lambda: one.diagnosis is not None and one.diagnosis.extended == octets("80 42 26"))
        assert one.diagnosis is not None and one.diagnosis.flags & 8, "Ext_Diag"
        say("diag C1 status")
        until(lambda: one.diagnosis is not None and one.diagnosis.extended == b"\xc1" and not one.diagnosis.flags & 8)
        say("show")
        assert line_of("inputs") == "inputs 01 02 03 04"
        say("unplug")
        until(lambda: one.state is StationState.OFFLINE)
        say("plug")
        until(lambda: one.state is StationState.DATA)
        for wrong in ("in 4 = 12", "in 0 = xy", "in 0", "in x = 12", "foo", "ready perhaps", "diag 1"):
            say(wrong)
            assert command.stderr.readline().startswith("dpmaster emulate: ")
        say("ready off")
        until(lambda: one.state is StationState.DIAG2)
    command.stdin.close()  # goes on without
    assert line_of("WAIT_PRM") == "address 5, WAIT_PRM"
    command.send_signal(signal.SIGTERM)
    assert (command.wait(PATIENCE), command.stderr.read()) == (0, "")


@pytest.mark.parametrize(("options", "names"), [
    (["--ident", "0A35", "--config", "41"], "41"), (["--ident", "G", "--config", "33"], "--ident"),
    (["--ident", "10000", "--config", "33"], "ident_number"), (["--ident", "1", "--config", "3"], "--config"),
    (["--ident", "1", "--config", "33", "--habit", "announce=loud"], "announce"),
    (["--ident", "1", "--config", "33", "--habit", "manners=none"], "manners"),
    (["--ident", "1", "--config", "33", "--input", "4=00"], "offset"),
    (["--ident", "1", "--config", "33", "--input", "4"], "--input"),
    (["--ident", "1", "--config", "33", "--user-parameters", "9-3"], "--user-parameters"),
    (["--ident", "1", "--config", "33", "--identity", "ACME"], "--identity"),
])
def test_wrong_arguments_are_named(options: list[str], names: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["emulate", "generic", "--address", "5", *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and names in error
