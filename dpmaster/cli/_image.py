# SPDX-License-Identifier: MIT
"""What ``read-inputs`` and ``read-outputs`` share: an image in rows of 16 octets, and why there may be none."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from dpmaster import Master
from dpmaster.cli import _master as common
from dpmaster.errors import StationError

ROW = 16


def rows(octets: bytes) -> list[str]:
    return [f"  {at:3}  {octets[at:at + ROW].hex(' ').upper()}" for at in range(0, len(octets), ROW)]


def read(args: argparse.Namespace, what: str, service: Callable[[Master, int], bytes]) -> int:
    with common.opened(args) as master:
        try:
            octets = service(master, args.station)
        except StationError as error:
            if not error.reason.startswith("RS"):
                raise
            raise StationError(f"{error}: it has {what} only while a master exchanges data with it; 'dpmaster diag' tells",
                               address=error.address, reason=error.reason) from None
    head = f"station {args.station}: {len(octets)} octets of {what}" if octets else f"station {args.station}: no {what}"
    common.show(args, {"station": args.station, what: octets.hex()}, "\n".join([head, *rows(octets)]))
    return 0
