# SPDX-License-Identifier: MIT
"""``dpmaster cfg PORT STATION``: the modules a station really has (Get_Cfg). It changes nothing on the station."""

from __future__ import annotations

import argparse

from dpmaster.cli import _master as common
from dpmaster.identifier import Data, Identifier, decode

NAME = "cfg"
HELP = "read the configuration of a station (Get_Cfg)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_station(parser)


def _data(what: str, data: Data | None) -> list[str]:
    if data is None:
        return []
    unit = "words" if data.unit == 2 else "bytes"
    held = "as a whole" if data.consistent else "per unit"
    return [f"{data.octets} octets of {what} from {data.offset} ({data.octets // data.unit} {unit}, consistent {held})"
            if data.octets > data.unit else f"{data.octets} octet{'s' * (data.octets > 1)} of {what} from {data.offset}"]


def describe(slot: Identifier) -> str:
    parts = _data("outputs", slot.outputs) + _data("inputs", slot.inputs)
    if slot.specific:
        parts.append(f"maker's octets {slot.specific.hex(' ').upper()}")
    return f"slot {slot.slot:2}: {'; '.join(parts) or 'empty'}"


def run(args: argparse.Namespace) -> int:
    with common.opened(args) as master:
        octets = master.get_cfg(args.station)
    slots = decode(octets)
    outputs, inputs = (sum(data.octets for data in found if data) for found in
                       ([slot.outputs for slot in slots], [slot.inputs for slot in slots]))
    head = f"station {args.station}: {outputs} octets of outputs, {inputs} of inputs, configuration {octets.hex(' ').upper()}"
    lines = [head, *(f"  {describe(slot)}" for slot in slots)]
    common.show(args, {
        "station": args.station, "configuration": octets.hex(), "output_length": outputs, "input_length": inputs,
        "slots": [{"slot": slot.slot, "outputs": slot.outputs.octets if slot.outputs else 0,
                   "inputs": slot.inputs.octets if slot.inputs else 0, "specific": slot.specific.hex()} for slot in slots],
    }, "\n".join(lines))
    return 0
