# SPDX-License-Identifier: MIT
"""``dpmaster read-outputs PORT STATION``: the present outputs of a station (RD_Outp), whoever its master is."""

from __future__ import annotations

import argparse

from dpmaster import Master
from dpmaster.cli import _image
from dpmaster.cli import _master as common

NAME = "read-outputs"
HELP = "read the outputs of a station that exchanges data with some master (RD_Outp)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_station(parser)


def run(args: argparse.Namespace) -> int:
    return _image.read(args, "outputs", Master.rd_outp)
