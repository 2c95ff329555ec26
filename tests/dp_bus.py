# SPDX-License-Identifier: MIT
"""A DP master played by hand, for tests: golden octets, telegrams made by hand, and the way into Data_Exchange.

Golden octets: captures of protocol page B.4; station 8 is the Festo valve terminal of rows 17 to 23 (ident 0A35, two octets
of output, no input) unless a test says otherwise. The master's address is 2.
"""

from __future__ import annotations

from wire import Master, Script, lib, octets

DIAG_REQUEST = octets("68 05 05 68 88 82 6D 3C 3E F1 16")  # 17
FREE = octets("68 0B 0B 68 82 88 08 3E 3C 02 05 00 FF 0A 35 D1 16")  # 18
SET_PRM = octets("68 13 13 68 88 82 5D 3D 3E B8 1E 01 00 0A 35 01 00 00 00 82 00 00 00 7B 16")  # 19
CHK_CFG = octets("68 06 06 68 88 82 7D 3E 3E 21 24 16")  # 20
READY = octets("68 0B 0B 68 82 88 08 3E 3C 00 0C 00 02 0A 35 D9 16")  # 22
RS = octets("10 02 08 03 0D 16")  # 23
SC = octets("E5")
OPERATE = octets("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16")  # 52
CLEAR = octets("68 07 07 68 FF 82 46 3A 3E 02 00 41 16")  # 51


def frame(fc: int, data: bytes, *, da: int = 2, sa: int = 8, saps: bytes = b"") -> bytes:
    """An SD2 made by hand: address, control, data, sum."""
    body = bytes([da | (0x80 if saps else 0), sa | (0x80 if saps else 0), fc]) + saps + data
    return bytes([0x68, len(body), len(body), 0x68]) + body + bytes([sum(body) & 0xFF, 0x16])


def diagnosis(*six: int, extended: bytes = b"", da: int = 2, sa: int = 8) -> bytes:
    return frame(0x08, bytes(six) + extended, da=da, sa=sa, saps=b"\x3e\x3c")


class Bus:
    """A master in Clear or Operate with the Festo at 8, played by hand: `auto` answers what a test does not care about."""

    def __init__(self, *, configuration: str = "21", mode: int | None = None, ident: int = 0x0A35, slave=None, **options):
        self.master = Master(500_000, address=2, **options)
        given = {"min_tsdr": 0, "group": 1, "station_status": 0x30, "watchdog": (0x1E, 1)} | (slave or {})
        self.index = self.master.add(8, ident, octets(configuration), octets("00 00 00 82 00 00 00"), **given)
        assert self.index == 0
        self.master.mode(lib.DPM_MODE_CLEAR if mode is None else mode)
        self.script = Script(self.master)

    def next(self, **options) -> bytes:
        """The next telegram that is not Global_Control."""
        while True:
            telegram = self.script.next(**options)
            if telegram[6:9] != b"\x46\x3a\x3e":
                return telegram

    @staticmethod
    def is_exchange(telegram: bytes) -> bool:
        """A request to station 8 without SAPs: SD2 with outputs, SD1 without."""
        return telegram[4 if telegram[0] == 0x68 else 1] == 8

    def start(self, answer: bytes = SC) -> None:
        """Into Data_Exchange, whose first request `answer` answers."""
        assert self.next()[7] == 0x3C
        self.script.answer(FREE)
        assert self.next()[7] == 0x3D
        self.script.answer(SC)
        assert self.next()[7] == 0x3E
        self.script.answer(SC)
        assert self.next()[7] == 0x3C
        self.script.answer(READY)
        assert self.is_exchange(self.next())
        self.script.answer(answer)
        assert self.state == lib.DPM_ST_DATA

    def exchange(self, answer: bytes = SC) -> bytes:
        """One Data_Exchange: the telegram, answered."""
        telegram = self.next()
        assert self.is_exchange(telegram), telegram.hex(" ")
        self.script.answer(answer)
        return telegram

    @property
    def slave(self):
        return self.master.slave(self.index)

    @property
    def state(self) -> int:
        return self.slave.state


def lose(bus: Bus) -> None:
    """No answer, repeated once, no answer."""
    bus.next()
    bus.next()
    bus.script.silence(bus.script.bits(201))
    assert bus.state == lib.DPM_ST_OFFLINE


def restart(bus: Bus, answer: bytes = SC) -> bytes:
    """Back into Data_Exchange; the first telegram of it."""
    first = bus.next()
    assert first[6:8] == b"\x6d\x3c", "FCB = 1, FCV = 0: first contact"
    for reply in (FREE, SC, SC, READY):
        bus.script.answer(reply)
        telegram = bus.next()
    bus.script.answer(answer)
    return telegram
