# SPDX-License-Identifier: MIT
"""A drive behind an RS-485 hat: run it for some seconds and watch.

    python hat.py /dev/ttyAMA0 [BAUDRATE [ADDRESS [SECONDS]]]

Without a drive: `dpmaster emulate si-p1 --address 5 --link /tmp/drive` in another window, and /tmp/drive as the port.
"""

import sys
import time

from dpmaster import Master
from dpmaster.drives import YaskawaV7


def main(port: str, baudrate: int = 500_000, address: int = 5, seconds: float = 3.0) -> None:
    # direction="rs485" where RTS leads to the hat's driver enable; a hat that switches by itself needs nothing.
    with Master(port, baudrate, cycle_time=0.005) as master:
        drive = master.add(YaskawaV7(address))
        master.operate()
        print("how the bus thread runs:", master.statistics.port.scheduling)
        drive.run_forward(30.00)
        end = time.monotonic() + seconds
        for cycle in master.cycles():  # each wait tells the output watchdog that this program lives
            if cycle.number % 20 == 0:
                print(f"\r{drive.status.output_frequency or 0:6.2f} Hz", end="", flush=True)
            if time.monotonic() > end:
                break
        drive.stop()
        print(f"\n{drive.statistics.exchanges} exchanges, {drive.statistics.repetitions} repeated")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:4]), *map(float, sys.argv[4:]))
