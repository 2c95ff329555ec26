# SPDX-License-Identifier: MIT
"""Values of the process image by name: where they lie, what they take, and that one commit changes nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction

import pytest

from dpmaster import ConfigurationError, Master, Station
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import GenericSlave
from dpmaster.signals import Signal, Signals

IDENT = 0x1234


@pytest.mark.parametrize(("type_", "octets", "value"), [
    # two's complement, IEEE 754 and "Motorola order", by hand
    ("uint8", "FE", 254), ("int8", "FE", -2), ("uint16", "80 01", 32769), ("int16", "80 01", -32767),
    ("uint32", "00 01 00 00", 65536), ("int32", "FF FF FF FF", -1), ("int64", "FF" * 8, -1), ("uint64", "00" * 7 + "05", 5),
    ("float32", "3F C0 00 00", 1.5), ("float64", "C0 00 00 00 00 00 00 00", -2.0)])
def test_types_are_big_endian(type_: str, octets: str, value: float) -> None:
    data = bytes.fromhex(octets)
    signal = Signal("x", "outputs", 1, type_)
    assert signal.get(b"\xaa" + data) == value
    assert signal.put(value) == (data, bytes(len(data)))
    assert signal.length == len(data)


def test_a_bool_is_one_bit() -> None:
    signal = Signal("run", "outputs", 0, "bool", bit=3)
    assert signal.get(b"\x08") is True and signal.get(b"\xf7") is False
    assert signal.put(True) == (b"\x08", b"\xf7") and signal.put(False) == (b"\x00", b"\xf7")


def test_scale_and_unit() -> None:
    speed = Signal("speed", "outputs", 0, "int16", scale=0.01, unit="Hz")
    assert speed.get(b"\xfe\x0c") == -5.0
    assert speed.put(12.5) == (b"\x04\xe2", b"\0\0")
    assert speed.shown(12.5) == "12.5 Hz" and Signal("n", "inputs", 0).shown(7) == "7"
    assert Signal("b", "inputs", 0, "bool", bit=0).shown(True) == "on"


@pytest.mark.parametrize(("signal", "value", "words"), [
    (Signal("a", "outputs", 0, "uint8"), 256, "'a' = 256: uint8 takes 0 to 255"),
    (Signal("a", "outputs", 0, "int16", scale=0.01, unit="Hz"), 400, "'a' = 400: int16 takes -327.68 to 327.67 Hz"),
    (Signal("a", "outputs", 0, "int16"), 1.5, "give a whole number"),
    (Signal("a", "outputs", 0, "int16"), True, "give a number"),
    (Signal("a", "outputs", 0, "int16"), float("nan"), "give a number"),
    (Signal("a", "outputs", 0, "int16"), float("inf"), "give a whole number"),
    (Signal("a", "outputs", 0, "int16", scale=2), float("inf"), "takes -65536 to 65534"),
    (Signal("a", "outputs", 0, "float32"), 1e300, "too much for a float32"),
    (Signal("a", "outputs", 0, "bool", bit=1), 2, "give True or False"),
])
def test_a_value_that_does_not_fit_is_named_with_the_range(signal: Signal, value: object, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        signal.put(value)


@pytest.mark.parametrize("type_", ["int16", "float32"])
def test_any_type_of_number_is_taken_if_it_is_finite(type_: str) -> None:
    signal = Signal("Speed", "outputs", 0, type_, scale=0.5)
    assert signal.put(Fraction(3, 2)) == signal.put(1.5)
    for value in (math.inf, -math.inf, math.nan, 1e300 * 10**200):
        with pytest.raises(ConfigurationError, match="'Speed' = "):
            signal.put(value)
    with pytest.raises(ConfigurationError, match="'Speed' = 1e"):
        Signal("Speed", "outputs", 0, type_, scale=1e-300).put(1e300)
    assert Signal("x", "outputs", 0, "int16").put(Fraction(-2)) == (b"\xff\xfe", bytes(2))


@pytest.mark.parametrize(("fields", "words"), [
    ({"scale": math.inf}, "scale inf of 'x': a finite number"),
    ({"direction": "both"}, "direction 'both' of 'x': inputs or outputs"),
    ({"type": "word"}, "type 'word' of 'x': one of bool, "), ({"offset": 244}, "offset of 'x' 244: 0 to 243"),
    ({"type": "bool"}, "say which bit"), ({"bit": 1}, "only a bool has a bit"),
    ({"type": "bool", "bit": 8}, "bit of 'x' 8: 0 to 7"), ({"scale": 0}, "scale 0 of 'x'")])
def test_a_signal_that_cannot_be(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Signal(**{"name": "x", "direction": "inputs", "offset": 0, **fields})


@pytest.fixture
def bus() -> Iterator[tuple[GenericSlave, Station]]:
    """One station with 4 octets each way, in Operate."""
    with Segment() as wire:
        slave = wire.attach(GenericSlave(5, IDENT, [bytes.fromhex("33")]))
        with Master(wire.port()) as master:
            station = master.add(Station(5, IDENT, bytes.fromhex("33")))
            station.signals = Signals(station, [
                Signal("ready", "inputs", 0, "bool", bit=7), Signal("level", "inputs", 2, scale=0.1, unit="%"),
                Signal("run", "outputs", 0, "bool", bit=0), Signal("lamp", "outputs", 0, "bool", bit=1),
                Signal("speed", "outputs", 2, "int16")])
            master.operate()
            yield slave, station


def test_reading_and_writing_by_name(bus: tuple[GenericSlave, Station]) -> None:
    slave, station = bus
    slave.inputs = bytes.fromhex("80 00 01 F4")
    station.wait(lambda frame: frame.octets[0] == 0x80, 5)
    assert dict(station.signals) == {"ready": True, "level": pytest.approx(50.0), "run": False, "lamp": False, "speed": 0}
    assert station.signals.read(station.frame) == {"ready": True, "level": pytest.approx(50.0)}
    station.signals["lamp"] = True
    station.wait_sent(station.signals.commit({"run": True, "speed": -2}), 5)
    assert station.outputs == bytes.fromhex("03 00 FF FE"), "lamp stays on"
    slave.wait(lambda slave: slave.outputs == station.outputs, 5)
    station.wait_sent(station.signals.commit({"lamp": False}), 5)
    slave.wait(lambda slave: slave.outputs == bytes.fromhex("01 00 FF FE"), 5)


def test_names_that_are_not_there(bus: tuple[GenericSlave, Station]) -> None:
    station = bus[1]
    with pytest.raises(ConfigurationError, match="has no signal 'spede': ready, level, run, lamp, speed"):
        station.signals["spede"] = 1
    with pytest.raises(ConfigurationError, match="'level' of station 5 is an input: only outputs can be set"):
        station.signals["level"] = 1
    with pytest.raises(ConfigurationError, match="has 4 octets of inputs, and it would be octets 3 to 4"):
        Signals(station, [Signal("x", "inputs", 3)])
    with pytest.raises(ConfigurationError, match="two signals 'x'"):
        Signals(station, [Signal("x", "inputs", 0), Signal("x", "outputs", 0)])
