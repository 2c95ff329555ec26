# SPDX-License-Identifier: MIT
"""``dpmaster read-inputs PORT STATION``: the present inputs of a station (RD_Inp), whoever its master is."""

from __future__ import annotations

import argparse

from dpmaster import Master
from dpmaster.cli import _image
from dpmaster.cli import _master as common

NAME = "read-inputs"
HELP = "read the inputs of a station that exchanges data with some master (RD_Inp)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_station(parser)


def run(args: argparse.Namespace) -> int:
    return _image.read(args, "inputs", Master.rd_inp)
