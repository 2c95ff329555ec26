# SPDX-License-Identifier: MIT
"""Inputs and outputs of a station by name: where a value lies in the process image, what type it has, and its unit.

Values of PROFIBUS are big-endian ("Motorola order", as the profiles and nearly all devices have it). Knows a station only by
its frame and its commits.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from dpmaster import _arguments
from dpmaster.errors import ConfigurationError

if TYPE_CHECKING:
    from dpmaster.station import Frame, Station

__all__ = ["Signal", "Signals", "Value"]

Value = bool | int | float

_FORMATS = {"uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q",
            "float32": "f", "float64": "d"}
TYPES = ("bool", *_FORMATS)


@dataclass(frozen=True, slots=True)
class Signal:
    """A value in the inputs or outputs of a station.

    offset: octets, from the beginning of the station's inputs or outputs. type: "bool", "uint8" .. "int64", "float32",
    "float64". bit: of a bool, 0 to 7, 0 is the least significant. scale: what one count is in `unit`; values are then floats.
    Raises ConfigurationError outside these ranges.
    """

    name: str
    direction: Literal["inputs", "outputs"]
    offset: int
    type: str = "uint16"
    bit: int | None = None
    scale: float | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        if self.direction not in ("inputs", "outputs"):
            raise ConfigurationError(f"direction {self.direction!r} of {self.name!r}: inputs or outputs")
        if self.type not in TYPES:
            raise ConfigurationError(f"type {self.type!r} of {self.name!r}: one of {', '.join(TYPES)}")
        _arguments.whole(f"offset of {self.name!r}", self.offset, 0, 243)
        if (self.type == "bool") != (self.bit is not None):
            raise ConfigurationError(f"{self.name!r} is of type {self.type}: " + (
                "say which bit, 0 to 7" if self.type == "bool" else "only a bool has a bit"))
        if self.bit is not None:
            _arguments.whole(f"bit of {self.name!r}", self.bit, 0, 7)
        if self.scale is not None and (not _arguments.number(self.scale) or self.scale in (0, math.inf, -math.inf)
                                       or self.type == "bool"):
            raise ConfigurationError(f"scale {self.scale!r} of {self.name!r}: a finite number other than 0, and not of a bool")

    @property
    def length(self) -> int:
        """Octets."""
        return 1 if self.bit is not None else struct.calcsize(_FORMATS[self.type])

    def get(self, octets: bytes) -> Value:
        """Its value among all inputs or outputs of the station."""
        if self.bit is not None:
            return bool(octets[self.offset] >> self.bit & 1)
        (value,) = struct.unpack_from(">" + _FORMATS[self.type], octets, self.offset)
        return value if self.scale is None else value * self.scale  # type: ignore[no-any-return]

    def put(self, value: object) -> tuple[bytes, bytes]:
        """Octets at `offset` for a value, and the mask of their bits that are not its own."""
        if self.bit is not None:
            if value not in (False, True):
                raise ConfigurationError(f"{self.name!r} = {value!r}: it is a bool, give True or False")
            return bytes([bool(value) << self.bit]), bytes([0xFF ^ 1 << self.bit])
        if isinstance(value, bool) or not _arguments.number(value):
            raise ConfigurationError(f"{self.name!r} = {value!r}: it is of type {self.type}, give a number")
        number: Any = value  # of any type that is one: numpy's, a Fraction
        count = number if self.scale is None else number / self.scale
        if not self.type.startswith("float") and self.scale is None and count % 1:
            raise ConfigurationError(f"{self.name!r} = {value!r}: it is of type {self.type}, give a whole number")
        return self._pack(count, value), bytes(self.length)

    def _pack(self, count: Any, value: object) -> bytes:
        try:
            if math.isinf(count):  # a float32 could hold it, and no drive knows what it means
                raise OverflowError
            return struct.pack(">" + _FORMATS[self.type], float(count) if self.type.startswith("float") else round(count))
        except (struct.error, OverflowError):
            raise ConfigurationError(f"{self.name!r} = {value!r}: {self._range()}") from None

    def _range(self) -> str:
        if self.type.startswith("float"):
            return f"too much for a {self.type}"
        bits = 8 * self.length
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if self.type.startswith("int") else (0, (1 << bits) - 1)
        ends = sorted((low * (self.scale or 1), high * (self.scale or 1)))
        return f"{self.type} takes {ends[0]:g} to {ends[1]:g}" + (f" {self.unit}" if self.unit else "")

    def shown(self, value: Value) -> str:
        """For people: "12.5 Hz"."""
        if isinstance(value, bool):
            return "on" if value else "off"
        return (f"{value:g}" if isinstance(value, float) else str(value)) + f" {self.unit}".rstrip()


class Signals(Mapping[str, Value]):
    """A station's values by name. Reading an input gives that of the newest frame, an output what the next commit builds on.

    ``signals["Speed"]``, ``signals["Run"] = True``; several in one commit with `commit`. Names are those given, exactly.
    """

    def __init__(self, station: Station, signals: Iterable[Signal] = ()) -> None:
        self._station = station
        self._signals: dict[str, Signal] = {}
        for signal in signals:
            room = getattr(station, signal.direction[:-1] + "_length")
            if signal.offset + signal.length > room:
                last = signal.offset + signal.length - 1
                raise ConfigurationError(f"{signal.name!r}: {station.name} has {room} octets of {signal.direction}, and it "
                                         f"would be octets {signal.offset} to {last}")
            if signal.name in self._signals:
                raise ConfigurationError(f"{station.name} has two signals {signal.name!r}: give one of them another name")
            self._signals[signal.name] = signal

    def __getitem__(self, name: str) -> Value:
        signal = self._signals[name]
        return signal.get(self._station.inputs if signal.direction == "inputs" else self._station.outputs)

    def __setitem__(self, name: str, value: Value) -> None:
        self.commit({name: value})

    def __iter__(self) -> Iterator[str]:
        return iter(self._signals)

    def __len__(self) -> int:
        return len(self._signals)

    def __repr__(self) -> str:
        return f"<Signals of {self._station.name!r}: {', '.join(self._signals) or 'none'}>"

    def signal(self, name: str) -> Signal:
        """What is known of a signal. Raises ConfigurationError that names those there are."""
        if name not in self._signals:
            there = ", ".join(self._signals) or "there are none"
            raise ConfigurationError(f"{self._station.name} has no signal {name!r}: {there}")
        return self._signals[name]

    def read(self, frame: Frame) -> dict[str, Value]:
        """All inputs of one frame, which came in one telegram."""
        return {name: signal.get(frame.octets) for name, signal in self._signals.items() if signal.direction == "inputs"}

    def commit(self, values: Mapping[str, Value]) -> int:
        """Change outputs in one commit; returns its number, for `Station.wait_sent`. All other bits keep what they are.

        Raises ConfigurationError for an input, an unknown name, or a value that the type does not take; what
        `Station.update` raises.
        """
        length = self._station.output_length
        octets, keep = bytearray(length), bytearray(b"\xff" * length)
        for name, value in values.items():
            signal = self.signal(name)
            if signal.direction != "outputs":
                raise ConfigurationError(f"{name!r} of {self._station.name} is an input: only outputs can be set")
            data, mask = signal.put(value)
            for at, (octet, others) in enumerate(zip(data, mask, strict=True), signal.offset):
                octets[at] = octets[at] & others | octet
                keep[at] &= others
        return self._station.update(0, octets, bytes(keep))
