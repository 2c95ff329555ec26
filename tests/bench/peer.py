# SPDX-License-Identifier: MIT
"""The package pyprofibus as the other master of the benchmark, in a process of its own: PATH RATE ADDRESS SECONDS.

Prints one JSON line: Data_Exchange answered, the seconds they took, the processor's seconds, and of each exchange the ns from
its request written to its answer complete. The package is under the GPL:
it is installed for the benchmark only, run as this separate program, and nothing of dpmaster imports it.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time

from pyprofibus.dp import DpCfgDataElement
from pyprofibus.dp_master import DPM1, DpSlaveDesc
from pyprofibus.phy_serial import CpPhySerial

IDENT, CONFIGURATION, LENGTH = 0x00CA, 0x72, 6  # SI-P1, Basic data: three words each way


class Phy(CpPhySerial):
    """Its serial port with a watch on it."""

    def __init__(self, port: str) -> None:
        super().__init__(port=port)
        self.begin, self.durations = 0, list[int]()

    def sendData(self, telegramData: bytes, srd: bool) -> None:
        self.begin = time.monotonic_ns()
        super().sendData(telegramData, srd)

    def pollData(self, timeout: float = 0.0) -> bytes | None:
        telegram: bytes | None = super().pollData(timeout)
        if telegram is not None:
            self.durations.append(time.monotonic_ns() - self.begin)
        return telegram


def slave(address: int) -> DpSlaveDesc:
    """What the package would take from a GSD file and its configuration file."""
    desc = DpSlaveDesc()
    desc.name, desc.index, desc.slaveAddr, desc.identNumber = "SI-P1", 0, address, IDENT
    desc.inputSize = desc.outputSize = LENGTH
    desc.setPrmTelegram.da = desc.chkCfgTelegram.da = address
    desc.setPrmTelegram.identNumber = IDENT
    desc.setCfgDataElements([DpCfgDataElement(CONFIGURATION)])
    desc.setWatchdog(1000)
    return desc


def connect(master: DPM1, station: DpSlaveDesc) -> None:
    limit = time.monotonic() + 10.0
    while not station.isConnected():
        if time.monotonic() > limit:
            sys.exit("peer: the card was not brought into Data_Exchange within 10 s")
        master.run()


def exchange(master: DPM1, station: DpSlaveDesc, seconds: float) -> tuple[int, float, float]:
    """As its own examples do it: run the state machine, hand over outputs whenever inputs came."""
    outputs, count = bytes(LENGTH), 0
    station.setMasterOutData(outputs)
    cpu, begin = time.process_time(), time.monotonic()
    while (now := time.monotonic()) < begin + seconds:
        master.run()
        if station.getMasterInData() is not None:
            count += 1
            station.setMasterOutData(outputs)
    return count, now - begin, time.process_time() - cpu


def main(path: str, rate: int, address: int, seconds: float) -> None:
    with contextlib.redirect_stdout(sys.stderr):  # it prints warnings about the rate
        phy = Phy(path)
        phy.setConfig(baudrate=rate)
        master = DPM1(phy=phy, masterAddr=1)
        station = slave(address)
        master.addSlave(station)
        master.initialize()
        connect(master, station)
        phy.durations.clear()
        count, elapsed, cpu = exchange(master, station, seconds)
        master.destroy()
    print(json.dumps({"exchanges": count, "seconds": elapsed, "cpu": cpu, "durations": phy.durations}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
