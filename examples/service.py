# SPDX-License-Identifier: MIT
"""A drive under systemd: ready when it exchanges data, alive with every bus cycle, at rest when it is told to stop.

    python service.py /dev/profibus [BAUDRATE [ADDRESS]]

For dpmaster.service beside it. Without systemd it runs as well, until Ctrl-C.
"""

import os
import signal
import socket
import sys
import time

from dpmaster import DPError, Master
from dpmaster.drives import YaskawaV7

ALIVE = 0.5  # s between two signs of life: a quarter of WatchdogSec


def notify(state: str) -> None:
    """sd_notify(3): one datagram to the service manager, where there is one."""
    path = os.environ.get("NOTIFY_SOCKET")
    if path:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.sendto(state.encode(), path.replace("@", "\0", 1))


def main(port: str, baudrate: int = 500_000, address: int = 5) -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with Master(port, baudrate, cycle_time=0.01) as master:
        try:
            drive = master.add(YaskawaV7(address))
            master.operate(timeout=30.0)
            notify("READY=1\nSTATUS=in Data_Exchange")
            drive.run_forward(20.00)
            told = 0.0
            for _ in master.cycles():
                if time.monotonic() - told > ALIVE:
                    told = time.monotonic()
                    # A drive that was lost comes back by itself, at rest: whether it may run again is the plant's to say.
                    notify(f"WATCHDOG=1\nSTATUS={drive.state.name}, {drive.status.output_frequency or 0:.1f} Hz")
        except KeyboardInterrupt:  # leaving the block stops the drive
            notify("STOPPING=1")


if __name__ == "__main__":
    try:
        main(sys.argv[1], *map(int, sys.argv[2:]))
    except DPError as error:  # no drive in time, or the port vanished: systemd starts it anew
        sys.exit(f"service.py: {error}")
