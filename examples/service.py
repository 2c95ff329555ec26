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

from dpmaster import Master
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
        drive = master.add(YaskawaV7(address))
        master.operate(timeout=30.0)
        notify("READY=1\nSTATUS=in Data_Exchange")
        try:
            drive.run_forward(20.00)
            told = 0.0
            for _ in master.cycles():
                if time.monotonic() - told > ALIVE:
                    told = time.monotonic()
                    # A port that vanished, or a drive that is lost, is waited for: both come back by themselves.
                    notify(f"WATCHDOG=1\nSTATUS={drive.state.name}, {drive.status.output_frequency or 0:.1f} Hz")
        except KeyboardInterrupt:
            notify("STOPPING=1")
            drive.stop()


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
