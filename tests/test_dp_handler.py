# SPDX-License-Identifier: MIT
"""The master's slave handler row by row: protocol page J.2, and what the page calls disputed, both ways.

A row is: how to get there, what the answer is, where the slave stands then and what is asked next. Octets: dp_bus.py.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
from dp_bus import FREE, READY, RS, SC, Bus, diagnosis, frame, lose
from wire import MS, lib, octets

DIAG, PRM, CFG, DX = 0x3C, 0x3D, 0x3E, None
IDENT = (0x0A, 0x35)
UE, RR, NR = (bytes([0x10, 2, 8, code, 10 + code, 0x16]) for code in (1, 2, 9))
DATA = frame(0x08, b"\x55")
DH = frame(0x0A, b"\x55")
NONE = b""
BUSY = diagnosis(0x02, 0x0C, 0, 2, *IDENT)
STATIC = diagnosis(0x00, 0x0E, 0, 2, *IDENT)
LOCKED = diagnosis(0x00, 0x0C, 0, 7, *IDENT)
OTHER = diagnosis(0x02, 0x05, 0, 0xFF, 0x00, 0xCA)

IN_PRM, IN_CFG = (FREE,), (FREE, SC)
IN_DIAG2, IN_DATA = (FREE, SC, SC), (FREE, SC, SC, READY)
IN_DIAG1 = (FREE, RS)  # Set_Prm was refused

ROWS = [
    # OFFLINE: "Slave_Diag with FCB=1,FCV=0, no retry"
    ("OFFLINE, free", (), FREE, "PRM", PRM),
    ("OFFLINE, own master", (), diagnosis(0x00, 0x0C, 0, 2, *IDENT), "PRM", PRM),
    ("OFFLINE, none: stay", (), NONE, "OFFLINE", DIAG),
    # DIAG1: "Master_Add FF or own -> PRM. Other master's address: Master_Lock=1, stay here"
    ("DIAG1, free", IN_DIAG1, FREE, "PRM", PRM),
    ("DIAG1, own master", IN_DIAG1, diagnosis(0x00, 0x0C, 0, 2, *IDENT), "PRM", PRM),
    ("DIAG1, another's", IN_DIAG1, LOCKED, "DIAG1", DIAG),
    ("DIAG1, none: OFFLINE after max_retry", IN_DIAG1, NONE, "OFFLINE", DIAG),
    # PRM: "SC -> CFG"; "RS/UE/RR -> DIAG1; none -> OFFLINE"
    ("PRM, SC", IN_PRM, SC, "CFG", CFG),
    *((f"PRM, {name}", IN_PRM, answer, "DIAG1", DIAG) for name, answer in (("RS", RS), ("UE", UE), ("RR", RR))),
    ("PRM, none", IN_PRM, NONE, "OFFLINE", DIAG),
    # CFG: "SC -> DIAG2"; "as above"
    ("CFG, SC", IN_CFG, SC, "DIAG2", DIAG),
    *((f"CFG, {name}", IN_CFG, answer, "DIAG1", DIAG) for name, answer in (("RS", RS), ("UE", UE), ("RR", RR))),
    ("CFG, none", IN_CFG, NONE, "OFFLINE", DIAG),
    # DIAG2: "Prm_Fault, Cfg_Fault, Prm_Req or Master_Lock -> report, DIAG1/PRM again (with pause)"
    ("DIAG2, Prm_Fault", IN_DIAG2, diagnosis(0x42, 0x05, 0, 0xFF, *IDENT), "DIAG1", DIAG),
    ("DIAG2, Cfg_Fault, master mm", IN_DIAG2, diagnosis(0x06, 0x05, 0, 2, *IDENT), "DIAG1", DIAG),
    ("DIAG2, Cfg_Fault, master FF", IN_DIAG2, diagnosis(0x06, 0x05, 0, 0xFF, *IDENT), "DIAG1", DIAG),  # H.1: disputed
    ("DIAG2, Prm_Req", IN_DIAG2, FREE, "DIAG1", DIAG),
    ("DIAG2, Master_Lock", IN_DIAG2, LOCKED, "DIAG1", DIAG),  # I.1, disputed: SC and ignored instead of RS
    # "Station_Not_Ready or Stat_Diag -> repeat diag next cycle; else -> DATA"; none: OFFLINE
    ("DIAG2, Station_Not_Ready", IN_DIAG2, BUSY, "DIAG2", DIAG),
    ("DIAG2, Stat_Diag", IN_DIAG2, STATIC, "DIAG2", DIAG),
    ("DIAG2, ready", IN_DIAG2, READY, "DATA", DX),
    ("DIAG2, none", IN_DIAG2, NONE, "OFFLINE", DIAG),
    # DATA: "DL: inputs; DH: inputs valid, then Slave_Diag in the next slot"
    ("DATA, DL", IN_DATA, DATA, "DATA", DX),
    ("DATA, DH", IN_DATA, DH, "DATA", DIAG),
    # "RS -> slave left: DIAG1; none after retries -> OFFLINE"; I.1, disputed: a wrong output length gives RS or UE
    ("DATA, RS", IN_DATA, RS, "DIAG1", DIAG),
    ("DATA, UE", IN_DATA, UE, "DIAG1", DIAG),
    ("DATA, RR", IN_DATA, RR, "DIAG1", DIAG),
    ("DATA, none", IN_DATA, NONE, "OFFLINE", DIAG),
    # "wrong length / RDL / RDH / NR -> Invalid_Slave_Response, DIAG1"
    *((f"DATA, {name}", IN_DATA, answer, "DIAG1", DIAG) for name, answer in (
        ("too long", frame(0x08, b"\1\2")), ("SC", SC), ("NR", NR), ("RDL", frame(0x0C, b"\1")), ("RDH", frame(0x0D, b"\1")))),
    # "In DATA after a fetched diag": "Prm_Req/Prm_Fault/Cfg_Fault/Not_Ready -> PRM or DIAG1"
    *((f"DATA, diagnosis with {name}", (*IN_DATA, DH), diagnosis(*status, *IDENT), "DIAG1", DIAG) for name, status in (
        ("Prm_Req", (0, 0x0D, 0, 2)), ("Prm_Fault", (0x40, 0x0C, 0, 2)), ("Cfg_Fault", (4, 0x0C, 0, 2)),
        ("Station_Not_Ready", (2, 0x0C, 0, 2)))),
    # "Stat_Diag -> keep reading diag every cycle, no data; Ext_Diag only -> continue exchange"
    ("DATA, diagnosis with Stat_Diag", (*IN_DATA, DH), STATIC, "DATA", DIAG),
    ("DATA, diagnosis with Ext_Diag", (*IN_DATA, DH), diagnosis(8, 0x0C, 0, 2, *IDENT, extended=b"\x02\x01"), "DATA", DX),
]


def sap(telegram: bytes) -> int | None:
    """The service asked for; None: Data_Exchange."""
    assert telegram[0] in (0x10, 0x68), telegram.hex(" ")
    return telegram[7] if telegram[0] == 0x68 and telegram[4] & 0x80 else None


@pytest.mark.parametrize(("way", "answer", "state", "then"), [row[1:] for row in ROWS], ids=[row[0] for row in ROWS])
def test_each_row_of_j2(way: tuple[bytes, ...], answer: bytes, state: str, then: int | None) -> None:
    bus = Bus(configuration="10")
    for reply in way:
        bus.next()
        bus.script.answer(reply)
    asked = bus.next()
    if answer:
        bus.script.answer(answer)
    else:
        tries = 1
        while sap(again := bus.next()) == sap(asked) and again == asked and bus.slave.statistics.unanswered == 0:
            tries += 1
        assert tries == (2 if way else 1), "max_retry_limit 1; a first contact is not repeated"
        assert bus.slave.diagnosis[0] & 0x01 or not way, "Station_Non_Existent"
        assert again[6:8] == b"\x6d\x3c", "FCB=1, FCV=0"
        assert bus.state == getattr(lib, f"DPM_ST_{state}")
        return
    assert bus.state == getattr(lib, f"DPM_ST_{state}")
    assert sap(bus.next()) == then


def test_one_request_per_slave_and_cycle() -> None:
    """J.2, scheduler: "one cycle = each active slave once"."""
    bus = Bus()
    before = bus.master.status.cycle
    for n, reply in enumerate((FREE, SC, SC, READY, SC, SC)):
        bus.next()
        assert bus.master.status.cycle == before + n
        bus.script.answer(reply)


# --- disputed: a setting each, both ways -------------------------------------------------------------------------------


@pytest.mark.parametrize("any_ident", [False, True])
def test_ident_differs(any_ident: bool) -> None:
    """J.2: "Ident differs -> still try Set_Prm (slave then reports Prm_Fault)": check_ident=False; by default it is not."""
    bus = Bus(slave={"any_ident": any_ident})
    bus.next()
    bus.script.answer(OTHER)
    if not any_ident:
        assert sap(bus.next()) == DIAG and bus.slave.reason == lib.DPM_WHY_IDENT
        return
    assert bus.next()[7:15] == octets("3D 3E B8 1E 01 00 0A 35"), "with the ident number that was given"
    for reply in (SC, SC):
        bus.script.answer(reply)
        bus.next()
    bus.script.answer(diagnosis(0x42, 0x05, 0, 0xFF, 0x00, 0xCA))
    assert bus.slave.reason == lib.DPM_WHY_PRM_FAULT


def test_a_slave_that_takes_parameters_for_another_ident_exchanges() -> None:
    bus = Bus(slave={"any_ident": True})
    for reply in (OTHER, SC, SC, diagnosis(0, 0x0C, 0, 2, 0x00, 0xCA), SC):
        bus.next()
        bus.script.answer(reply)
    assert bus.state == lib.DPM_ST_DATA


@pytest.mark.parametrize("poll", [0, 50 * MS])
def test_a_slave_that_cannot_announce_is_asked_now_and_then(poll: int) -> None:
    """I.2: "PYPB polls output-only slaves' diag periodically because of this": diagnosis_poll; by default it is trusted to
    announce. A poll takes the place of one exchange."""
    bus = Bus(slave={"diagnosis_poll": poll})
    bus.start()
    asked = []
    end = bus.script.now + 500 * MS
    while bus.script.now < end:
        if sap(bus.next()) == DIAG:
            asked.append(bus.script.last.start)
            bus.script.answer(READY)
        else:
            bus.script.answer(SC)
    if poll:
        assert 9 <= len(asked) <= 10 and all(50 * MS <= b - a < 52 * MS for a, b in pairwise(asked))
    else:
        assert asked == []


@pytest.mark.parametrize("patience", [0, 200 * MS])
def test_chk_cfg_again_after_not_ready(patience: int) -> None:
    """J.2: "A slave may need seconds between Chk_Cfg and ready. Do not time out fast": ready_timeout; by default never."""
    bus = Bus(slave={"ready_timeout": patience})
    for reply in (FREE, SC, SC):
        bus.next()
        bus.script.answer(reply)
    began = bus.script.now
    while bus.script.now < began + 2000 * MS and sap(bus.next()) == DIAG:
        bus.script.answer(BUSY)
    if not patience:
        assert bus.state == lib.DPM_ST_DIAG2
        return
    assert sap(bus.script.last.octets) == PRM and patience < bus.script.now - began < patience + 30 * MS
    for reply in (SC, SC, READY):
        bus.script.answer(reply)
        bus.next()
    assert bus.state == lib.DPM_ST_DATA


def test_retries_of_data_exchange_of_its_own() -> None:
    """J.4: "separate Max-Retry-Limit(DX) may be 0 to keep cycle constant": data_retries. It is lost as soon as ever."""
    bus = Bus(data_retries=0)
    bus.start()
    missed = bus.exchange()
    assert bus.next() != missed
    again = bus.next()
    assert sap(again) is DX and again[6] == 0x6D, "no repetition: the next cycle's exchange, as a first contact"
    assert bus.state == lib.DPM_ST_DATA and bus.slave.statistics.unanswered == 1
    bus.script.answer(SC)
    for _ in range(10):
        bus.exchange()
        bus.next()  # every second one is lost
        assert sap(bus.next()) is DX
        bus.script.answer(SC)
    assert bus.slave.statistics.losses == 0 and bus.slave.statistics.repetitions == 0
    lose(bus)
    assert bus.slave.reason == lib.DPM_WHY_NO_ANSWER


def test_by_default_data_exchange_is_repeated_as_all_others() -> None:
    bus = Bus()
    bus.start()
    first = bus.next()
    assert bus.next() == first
    bus.script.answer(SC)
    assert bus.slave.statistics.repetitions == 1


@pytest.mark.parametrize("answer", [octets("10 02 08 0A 14 16"), frame(0x0A, b"\0"), frame(0x0A, b"\xFF")],
                         ids=["SD1 with 0A", "dummy octet 00", "dummy octet FF"])
def test_every_way_to_announce_without_inputs(answer: bytes) -> None:
    """I.2: "SD1 frame FC 0A (STM comment), a dummy data octet with DH": accept all."""
    bus = Bus()
    bus.start(answer)
    assert sap(bus.next()) == DIAG
    bus.script.answer(READY)
    assert sap(bus.next()) is DX


@pytest.mark.parametrize("answer", [frame(0x0C, b""), octets("10 02 08 0D 17 16"), frame(0x08, b"\0"), frame(0x0A, b"\0\0")],
                         ids=["RDL", "RDH", "an octet with DL", "two octets with DH"])
def test_what_a_slave_without_inputs_may_not_answer(answer: bytes) -> None:
    bus = Bus()
    bus.start()
    bus.exchange(answer)
    assert bus.state == lib.DPM_ST_DIAG1 and bus.slave.reason == lib.DPM_WHY_INVALID_ANSWER


# --- configurations (G.2) ----------------------------------------------------------------------------------------------

LONGEST = "C0 FF FF C0 F9 F9"  # 64 + 58 words each way: 244 octets

CONFIGURATIONS = [
    ("21", 2, 0), ("11", 0, 2), ("00", 0, 0), ("00 10 20 00", 1, 1), ("00 00", 0, 0), ("F3 F1", 12, 12), ("D3 E1", 4, 8),
    ("41 83 AA", 0, 4), ("C3 CF C7 01 02 03", 32, 16), ("C0 83 41", 4, 4), ("80 BF", 64, 0),
    (LONGEST, 244, 244), ("40 FF 40 F9", 0, 244), ("80 FF 80 F9", 244, 0),
]


@pytest.mark.parametrize(("configuration", "outputs", "inputs"), CONFIGURATIONS)
def test_any_configuration_exchanges(configuration: str, outputs: int, inputs: int) -> None:
    """F.2: "No outputs -> SD1 request. No inputs -> SC"; G.2: special formats, empty slots, at most 244 octets each way."""
    bus = Bus(configuration=configuration)
    answer = frame(0x08, bytes(n & 0xFF for n in range(inputs))) if inputs else SC
    for reply in (FREE, SC):
        bus.next()
        bus.script.answer(reply)
    check = bus.next()
    assert check[9:-2] == octets(configuration), "Chk_Cfg carries it octet for octet"
    bus.script.answer(SC)
    bus.next()
    bus.script.answer(READY)
    bus.next()
    bus.script.answer(answer)
    bus.master.mode(lib.DPM_MODE_OPERATE, bus.script.now)
    sent = bytes(0xFF - (n & 0xFF) for n in range(outputs))
    number = bus.master.commit(0, sent, bus.script.now) if outputs else 0
    telegram = bus.next()
    assert (telegram[7:-2] == sent and telegram[0] == 0x68) if outputs else telegram[0] == 0x10
    bus.script.answer(answer)
    assert bus.state == lib.DPM_ST_DATA
    if outputs:
        assert bus.master.was_sent(0, number) == 1
    frame_ = bus.master.inputs(0)
    assert frame_.valid and frame_.length == inputs and bytes(frame_.octets[0:inputs]) == bytes(n & 0xFF for n in range(inputs))
