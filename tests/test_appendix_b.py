# SPDX-License-Identifier: MIT
"""The SI-P1's words on the wire, octet by octet: appendix B and the run commands of chapter 3 (manual TM.V7.12).

The drive class commands, both C cores exchange, the emulated card answers; what is compared is what lay on the wire, from
the start delimiter to the end delimiter. Golden octets are the manual's tables; telegrams around them are made by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby, pairwise

import pytest
from appendix_b import B2_READ, B3_READ_ERROR, B4_WRITE, B5_WRITE_ERROR, Table, by_row
from v7_wire import Pair, WireV7
from wire import octets

from dpmaster.errors import ParameterAccessError

HANDSHAKE_WITHOUT_WD = 0xE1
STATUS, RECEIVED = 0x60, 0x60

CHANNEL = {"Extended Data 1": (16, 31), "Extended Data 2": (4, 11)}
"""Octets of function code and handshake register: tables 3.1 and 3.7 (as settled: 12 octets, so 11)."""
LENGTH = {"Basic data": 6, "Extended Data 1": 32, "Extended Data 2": 12}


def check_frame(telegram: bytes, da: int, sa: int, fcs: tuple[int, ...], length: int) -> bytes:
    """An SD2 with neither SAPs nor anything but `length` octets of data; returns these. Protocol page B.1, B.3."""
    assert telegram[:6] == bytes([0x68, length + 3, length + 3, 0x68, da, sa])
    assert telegram[6] in fcs
    assert telegram[-2:] == bytes([sum(telegram[4:-2]) & 0xFF, 0x16])
    return telegram[7:-2]


def check_exchanges(pairs: list[Pair], configuration: str) -> list[tuple[bytes, bytes]]:
    """Each Data_Exchange is a whole good telegram, SRD high with FCV, FCB toggling; its answer DL. The data of each."""
    length = LENGTH[configuration]
    data = [(check_frame(p.request, 5, 1, (0x5D, 0x7D), length), check_frame(p.answer, 1, 5, (0x08,), length)) for p in pairs]
    assert all(a.request[6] ^ b.request[6] == 0x20 for a, b in pairwise(pairs)), "FCB toggles with every new request"
    return data


# -- Appendix B --------------------------------------------------------------------------------------------------------


def rows(data: list[tuple[bytes, bytes]], configuration: str) -> Table:
    """Distinct consecutive rows as the manual prints them.

    A slave's answer is ready before the request is there, so the first response that can know of a command is that of the
    next telegram: command n is paired with response n + 1.
    """
    where, handshake = CHANNEL[configuration]
    found = []
    for (command, _), (_, response) in pairwise(data):
        hs = response[handshake] & HANDSHAKE_WITHOUT_WD
        message = response[where:where + 6].hex() if hs & STATUS == RECEIVED else ""
        found.append((f"{command[where:where + 6].hex()} {command[handshake]:02x}", f"{message} {hs:02x}"))
    return [row for row, _ in groupby(found)]


def read_0037(drive: WireV7) -> None:
    assert drive.read_parameter(0x0037) == 0x15


def refused(call: Callable[[WireV7], object]) -> Callable[[WireV7], None]:
    def attempt(drive: WireV7) -> None:
        with pytest.raises(ParameterAccessError, match="error 02h, address error"):
            call(drive)
    return attempt


SEQUENCES = {
    "table B.2, read": ((0x0100,), read_0037, B2_READ),
    "table B.3, read error": ((0x0100, 0x0100), refused(lambda d: d.read_parameter(0x1000)), B3_READ_ERROR),
    "table B.4, write": ((0x0100, 0x0100), lambda d: d.write_parameter(0x0105, 1), B4_WRITE),
    "table B.5, write error": ((0x0037,), refused(lambda d: d.write_parameter(0x1000, 1)), B5_WRITE_ERROR),
}


@pytest.mark.parametrize("rate", [1_500_000, 12_000_000])
@pytest.mark.parametrize("configuration", CHANNEL)
@pytest.mark.parametrize("table", SEQUENCES)
def test_appendix_b_on_the_wire(table: str, configuration: str, rate: int) -> None:
    """`before` are the reads that leave the response in which the table begins (its first row)."""
    before, access, expected = SEQUENCES[table]
    drive = WireV7(configuration, rate)
    drive.card.registers[0x0037] = 0x15 if access is read_0037 else 0
    for register in before:
        assert drive.read_parameter(register) == 0
    begin = len(drive.bus.log)
    access(drive)
    data = check_exchanges(drive.exchanges(begin), configuration)
    assert by_row(rows(data, configuration)) == by_row(expected)
    assert drive.card.registers["n005"] == (1 if "B.4" in table else 0)
    # "Reserved" octets and data 2 to 4 are 0 both ways, in commands and in answers of one word.
    where, handshake = CHANNEL[configuration]
    assert not any(any(octets_[where + 6:handshake]) for pair in data for octets_ in pair)


def test_a_whole_telegram_of_each_row_of_table_b_2() -> None:
    """Delimiters, lengths, addresses, FC, data, sum: written out for Extended Data 2, where a telegram fits a line."""
    drive = WireV7("Extended Data 2")
    drive.card.registers[0x0037] = 0x15
    drive.read_parameter(0x0100)
    begin = len(drive.bus.log)
    drive.read_parameter(0x0037)
    requests = [pair.request for pair in drive.exchanges(begin)]
    golden = (("68 0F 0F 68 05 01 5D 00 00 00 00 00 00 00 00 00 00 00 80 E3 16",
               "68 0F 0F 68 05 01 7D 00 00 00 00 00 00 00 00 00 00 00 80 03 16"),  # Initialize: HS as the response's
              ("68 0F 0F 68 05 01 5D 00 00 00 00 03 00 37 02 00 00 00 80 1F 16",
               "68 0F 0F 68 05 01 7D 00 00 00 00 03 00 37 02 00 00 00 80 3F 16"),  # Set the message
              ("68 0F 0F 68 05 01 5D 00 00 00 00 03 00 37 02 00 00 00 00 9F 16",
               "68 0F 0F 68 05 01 7D 00 00 00 00 03 00 37 02 00 00 00 00 BF 16"))  # Toggle, and wait
    step = 0
    for request in requests:
        if request not in map(octets, golden[step]):
            step += 1
        assert request in map(octets, golden[step]), request.hex(" ")
    assert step == len(golden) - 1
    answers = [pair.answer for pair in drive.exchanges(begin)]
    # 04 22: table 3.9, bits 10 Local/Remote, 5 Drive Ready, 1 @ Zero Speed. The last octet of the data has WD in it.
    assert answers[-1][:-3] == octets("68 0F 0F 68 01 05 08 04 22 00 00 03 00 37 02 00 15 00")
    assert answers[-1][-3] & HANDSHAKE_WITHOUT_WD == 0x60


# -- Commands and status (tables 3.1 to 3.3, 3.7 to 3.9, 3.12 to 3.14) --------------------------------------------------


def fast(data: bytes) -> str:
    return data[0:4].hex(" ")


def status(drive: WireV7, mask: int = 0xFFFF) -> int:
    """The status word of the last answer on the wire: "0 Drive Status MSB, 1 Drive Status LSB"."""
    return int.from_bytes(drive.exchanges(len(drive.bus.log) - 12)[-1].answer[7:9], "big") & mask


COMMANDS = (
    # Tables 3.2, 3.8, 3.13: bit 0 Fwd Run/Stop, 1 Rev Run/Stop, 8 External Fault, 9 Fault Reset; bytes 2 and 3 Frequency
    # Reference MSB, LSB, 0.01 Hz: 30.00 Hz = 3000 = 0BB8h.
    "00 00 00 00",
    "00 01 0b b8",  # run_forward(30.00): command and reference in one telegram, never one without the other
    "00 02 0b b8",  # run_reverse
    "00 00 0b b8",  # stop: the set-point stays
    "01 00 0b b8",  # external_fault
    "00 00 0b b8",  # external_fault(False)
    "02 00 0b b8",  # fault_reset: "1 = Reset Fault", an edge
    "00 00 0b b8",
)


@pytest.mark.parametrize("configuration", LENGTH)
def test_run_reverse_stop_external_fault_and_reset_on_the_wire(configuration: str) -> None:
    drive = WireV7(configuration, 500_000)
    drive.card.registers["n019"] = drive.card.registers["n020"] = 3  # 0.3 s up and down
    # Tables 3.3, 3.9, 3.14: bit 0 Running, 1 @ Zero Speed, 2 @ Reverse, 3 Reset Signal, 4 @ Frequency Agree, 5 Drive Ready,
    # 7 Major Fault, 10 Local/Remote, 11 to 13 Multi-function Output 1 to 3 (n057 = 0 fault, n058 = 1 running, n059 = 2
    # frequency agree).
    assert status(drive) == 0x0422
    drive.run_forward(30.00)
    drive.wait_until(lambda s: s.running and not s.frequency_agree, timeout=1.0)
    assert status(drive, 0x00FF) == 0x0021
    drive.wait_until(lambda s: s.frequency_agree, timeout=2.0)
    assert status(drive) == 0x3431
    forward = drive.exchanges(len(drive.bus.log) - 12)[-1]
    drive.run_reverse(30.00)
    drive.wait_until(lambda s: s.frequency_agree, timeout=2.0)
    assert status(drive) == 0x3435
    drive.stop()
    drive.wait_until(lambda s: not s.running, timeout=2.0)
    assert status(drive, 0x00FF & ~0x04) == 0x0022
    drive.external_fault()
    drive.wait_until(lambda s: s.major_fault, timeout=1.0)
    assert status(drive) == 0x0C82 and drive.card.fault == "EF0"
    drive.external_fault(False)
    drive.wait_until(lambda s: s.valid, timeout=1.0)
    begin = len(drive.bus.log)
    drive.fault_reset()
    seen = [pair.answer[8] for pair in drive.exchanges(begin)]
    assert any(octet & 0x08 for octet in seen), "Reset Signal is shown while the bit is there"
    drive.let_pass(0.02)
    assert status(drive) == 0x0422 and drive.card.fault is None

    data = check_exchanges(drive.exchanges(), configuration)
    assert tuple(command for command, _ in groupby(fast(command) for command, _ in data)) == COMMANDS
    check_values(configuration, forward)


def check_values(configuration: str, forward: Pair) -> None:
    """What lay on the wire while the drive turned at 30.00 Hz."""
    command, response = forward.request[7:-2], forward.answer[7:-2]
    match configuration:
        case "Basic data":  # table 3.12: status, frequency reference, torque reference; the whole telegram
            assert forward.request in (octets("68 09 09 68 05 01 5D 00 01 0B B8 00 00 27 16"),
                                       octets("68 09 09 68 05 01 7D 00 01 0B B8 00 00 47 16"))
            assert response[:4] == octets("34 31 0B B8")
        case "Extended Data 1":  # table 3.1: 4 to 13 reserved, "must be set 0"; 8 reference, 10 output frequency
            assert command[:16] == octets("00 01 0B B8") + bytes(12)
            assert response[:12] == octets("34 31 00 00 00 00 00 00 0B B8 0B B8")
        case _:  # table 3.7: 2 and 3 Frequency Feedback
            assert command[:4] == octets("00 01 0B B8") and response[:4] == octets("34 31 0B B8")
