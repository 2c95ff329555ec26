# SPDX-License-Identifier: MIT
"""The SI-P3 behind the DP slave in C, telegram by telegram: parametrisation, configurations, PKW and MEMOBUS, diagnosis.

The master's telegrams are made here by hand; what the manual prints (SIEP C730600 42) is compared with the octets on the
wire. The last tests run a card in a segment, for what its host does between slave and card.
"""

from __future__ import annotations

import os
import select

import pytest
from slave_rig import CHK_CFG, SC, Initiator, Rig, SlaveConfig, octets, telegram
from waiting import until

from dpmaster._core import lib
from dpmaster.emulator import Exchange, Segment, SlaveState
from dpmaster.emulator.cards import SIP3
from dpmaster.profiles import yaskawa_1000 as profile

NS = 1_000_000_000
PRM = profile.USER_PARAMETERS
HALT, RUN = "0408", "0418"


class Bench:
    """A card at address 5 and a master at address 2."""

    def __init__(self, **arguments: object) -> None:
        self.card = SIP3(5, **arguments)  # type: ignore[arg-type]
        card = self.card
        self.rig = Rig((SlaveConfig(
            5, card.ident_number, card.configurations, card.user_parameters, card.fail_safe, card.sync, card.freeze,
            card.max_diagnosis, more={"min_slave_interval": card.min_slave_interval}),))
        self.master = Initiator(self.rig, slave=5)
        self.card.attached(self)
        self.live()
        self.rig.quiet(self.rig.time + NS // 2)
        self.live()

    def live(self) -> None:
        """What the card's host does."""
        report, frame = self.rig.report(), self.rig.outputs()
        now = self.rig.time / NS
        self.rig.put_inputs(self.card.step(now, Exchange(
            SlaveState(report.state), frame.octets, frame.valid, frame.number, report.configuration,
            report.master if report.master >= 0 else None, report.watchdog_expired, baudrate=500_000)))

    # what its host gives a card

    def refresh(self) -> None:
        raise AssertionError("this card has nothing of its own to say between two steps")

    def diagnose(self, octets: bytes, *, announce: bool, ext_diag: bool, static_diag: bool) -> None:
        self.rig.diagnosis(octets, announce, ext_diag, static_diag)

    def set_ready(self, ready: bool) -> None:
        assert lib.dpm_slaves_ready(self.rig.slaves, 0, ready) == 0

    # the master

    def power_cycle(self) -> None:
        assert lib.dpm_slaves_reset(self.rig.slaves, 0, self.rig.time) == 0
        self.card.reset(self.rig.time / NS)
        self.live()
        self.rig.quiet(self.rig.time + NS // 2)
        self.live()

    def prm(self, user: bytes = PRM) -> bytes:
        return self.master.prm(ident=0x0ACF, user=user)

    def start(self, name: str) -> None:
        assert self.prm() == SC
        assert self.master.srd(CHK_CFG, profile.configuration(name).identifier) == SC

    def exchange(self, outputs: str, milliseconds: int = 1, fc: int = 0x08) -> bytes:
        """Data_Exchange for that long with the card beside it; the data of the last answer."""
        for _ in range(milliseconds + 1):  # a slave's answer is ready before the request is there
            answer = self.master.srd(None, octets(outputs))
            self.live()
        assert answer == self.master.data(answer[7:-2], fc), answer.hex(" ")
        return answer[7:-2]


# -- Set_Prm, Chk_Cfg, Set_Slave_Add --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("user", "good"), [
    (PRM, True), (b"", False), (PRM[:3], False), (PRM + b"\0", False)])
def test_set_prm_takes_exactly_four_user_octets(user: bytes, good: bool) -> None:
    """Devices page: "exactly four user octets"; longer or shorter is Prm_Fault (bit 6 of status 1)."""
    bench = Bench()
    bench.prm(user)
    assert bool(bench.master.diag()[0] & 0x40) is not good


@pytest.mark.parametrize(("settings", "accepted"), [
    ({}, range(13)), ({"F6-32": 0}, range(3, 13)), ({"F6-32": 1}, range(3))])
def test_the_thirteen_configurations(settings: dict[str, int], accepted: range) -> None:
    """F6-32 against a configuration of the other kind: Cfg_Fault (bit 2 of status 1)."""
    identifiers = ["72", "5F 6F", "55 65", "F3 F1", "F3 F5", "F1", "F5", "F3 F9", "73 71", "73 75", "71", "75", "73 79"]
    lengths = [6, 32, 12, 12, 20, 4, 12, 28, 12, 20, 4, 12, 28]
    for n, identifier in enumerate(identifiers):
        bench = Bench(settings=settings)
        assert bench.prm() == SC
        bench.master.srd(CHK_CFG, octets(identifier))
        assert bool(bench.master.diag()[0] & 0x04) is (n not in accepted)
        if n in accepted:
            bench.live()
            assert len(bench.exchange("00" * lengths[n])) == lengths[n]


# -- PKW on the wire -------------------------------------------------------------------------------------------------------

EXAMPLES = [  # command and response of chapter 8's seven examples; {} is what the example leaves to master and drive
    ("6384 0005 00000000", "4384 0005 0000" + HALT), ("638B 0005 00000000", "438B 0005 00000237"),
    ("6384 0001 00000000", "4384 0001 00006384"), ("1388 0000 00000000", "1388 0000 00000001"),
    ("701F 0001 0000000A", "401F 0001 00000000"), ("6029 0011 00000000", "4029 0011 00000258"),
    ("212C 0000 00000000", "112C 0000 00000000")]


@pytest.mark.parametrize("configuration", ["PPO Type 1", "PPO Type 1 (No Cons.)"])
def test_the_seven_examples_on_the_wire(configuration: str) -> None:
    bench = Bench()
    bench.start(configuration)
    pzd = f"{HALT} 0000"
    for command, response in EXAMPLES:
        assert bench.exchange("00" * 8 + pzd) == octets("00" * 8 + "0237 0000")
        assert bench.exchange(f"{command} {pzd}", 20) == octets(f"{response} 0237 0000")
    assert bench.card.registers.setting("C1-01") == 10


def test_a_whole_telegram_of_an_example() -> None:
    """Reading d1-17 in PPO type 1: 68 LE LEr 68 DA SA FC, PKE IND PWE, STW HSW, FCS ED, and its answer."""
    bench = Bench()
    bench.start("PPO Type 1")
    bench.exchange("00" * 8 + "0408 0000", 2)
    request = octets("6029 0011 00000000 0408 0000")
    answer = b""
    for _ in range(20):
        bench.rig.exchange(telegram(5, 2, bench.master.fc(), request))
        bench.live()
    bench.master.fcb = False
    sent = octets("68 0F 0F 68 05 02 5D 60 29 00 11 00 00 00 00 04 08 00 00 0A 16")
    assert telegram(5, 2, 0x5D, request) == sent
    answer = bench.rig.exchange(sent)
    assert answer == octets("68 0F 0F 68 02 05 08 40 29 00 11 00 00 02 58 02 37 00 00 1C 16")


# -- MEMOBUS on the wire (table 15) ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("configuration", "where", "reserved"), [("Extended Data 1", 16, 9), ("Extended Data 2", 4, 1)])
def test_table_15_on_the_wire(configuration: str, where: int, reserved: int) -> None:
    """The three columns; in Extended Data 2 with one word of data. The last octet is masked with 80h, HS."""
    before, tail = "00" * where, "00" * reserved
    for address, response in (("0280", "10 0280 02 0000"), ("0601", "90 0000 02 0002")):
        bench = Bench()
        bench.start(configuration)
        message = f"10 {address} 02 1770 {tail}"
        bench.exchange(f"{before} {message} 00", 2)
        area = bench.exchange(f"{before} {message} 80", 20)[where:]
        assert area[:-1] == octets(response + tail) and area[-1] & 0x80 == 0x80
        assert bench.card.registers["d1-01"] == (6000 if address == "0280" else 0)


def test_the_bias_of_example_2_on_the_wire() -> None:
    """-5 % for terminal FM: 50 as two's complement, FFCEh."""
    bench = Bench()
    bench.start("Extended Data 2")
    bench.exchange("00000000 10 041F 02 FFCE 00 00", 2)
    assert bench.exchange("00000000 10 041F 02 FFCE 00 80", 20)[4:10] == octets("10 041F 02 0000")
    assert bench.card.registers["H4-03"] == -50


# -- Diagnosis, Clear ------------------------------------------------------------------------------------------------------


def test_the_diagnosis_is_announced_and_gone_again() -> None:
    """Unit_Diag_Bit 26; Ext_Diag is bit 3 of status 1; DH is FC 0A. Max_Diag_Data_Len 11."""
    bench = Bench()
    bench.start("PPO Type 2")
    process = f"{HALT} 0000 0000 0000 0000 0000"
    bench.exchange("7393 0003 00000400" + process, 20, fc=0x0A)
    assert bench.master.diag() == octets("08 04 00 02 0A CF 05 81 00 00 04")
    bench.exchange("00" * 8 + process)
    bench.exchange("7393 0003 00000006" + process, 20, fc=0x0A)
    assert bench.master.diag() == octets("00 04 00 02 0A CF")
    bench.exchange("00" * 8 + process)


def test_an_illegal_pnu_that_was_stored_is_told_after_power_up() -> None:
    bench = Bench()
    bench.start("PPO Type 2")
    process = f"{HALT} 0000 0000 0000 0000 0000"
    bench.exchange("7394 0003 00000100" + process, 20, fc=0x0A)
    bench.exchange("23CB 0000 00000001" + process, 20, fc=0x0A)
    bench.power_cycle()
    bench.start("PPO Type 2")
    assert bench.master.diag()[6:] == octets("05 81 00 00 08")


@pytest.mark.parametrize(("f6_31", "hz"), [(0, 0.0), (1, 30.0)])
def test_clear_is_an_empty_data_exchange(f6_31: int, hz: float) -> None:
    """Fail_Safe: in Clear the card gets no data; F6-31 says what that means. A slave with inputs answers all the same."""
    bench = Bench(settings={"F6-31": f6_31, "C1-01": 1, "C1-02": 1})
    bench.start("PPO Type 3")
    bench.master.control(0x02)  # Clear
    bench.master.control(0x00)  # Operate
    bench.exchange(f"{RUN} 1388", 200)
    assert bench.card.motor.frequency == 30.0
    bench.master.control(0x02)
    for _ in range(200):
        answer = bench.master.srd(None, b"")
        bench.live()
    assert len(answer) == 13 and bench.card.motor.frequency == hz


# -- A card in a segment -----------------------------------------------------------------------------------------------------


class Port:
    """A hand at a port of a segment."""

    def __init__(self, segment: Segment) -> None:
        self.fd = os.open(segment.port(), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        _ = segment.info  # from here on the port is heard

    def ask(self, request: bytes, length: int) -> bytes:
        os.write(self.fd, request)
        found = b""
        while len(found) < length and select.select([self.fd], [], [], 5.0)[0]:
            found += os.read(self.fd, length - len(found))
        return found



def test_set_slave_add_writes_the_node_address() -> None:
    """Set Slave Add supp 1: new address, ident number, No_Add_Chg to SAP 55. It is F6-30 from then on, and a new F6-30 is
    the address from the next power-up on."""
    with Segment(500_000, ports=1, cards=1) as wire:
        card = wire.attach(SIP3(5))
        port = Port(wire)
        try:
            assert port.ask(telegram(5, 2, 0x6D, octets("0C 0A CF 00"), 55), 1) == SC
            until(lambda: card.address == 12)
            assert card.registers["F6-30"] == 12 and wire.report(card).address == 12
            card.registers["F6-30"] = 9
            assert card.address == 12
            wire.reset(card)
            assert card.address == wire.report(card).address == 9
            assert port.ask(octets("10 09 02 49 54 16"), 6) == octets("10 02 09 00 0B 16")  # FDL status
        finally:
            os.close(port.fd)


def test_with_a_node_address_of_0_the_card_is_never_ready() -> None:
    bench = Bench()
    bench.card.registers["F6-30"] = 0
    bench.start("PPO Type 1")
    assert not bench.master.diag()[0] & 0x02  # "Power must be cycled"
    bench.power_cycle()
    bench.start("PPO Type 1")
    assert bench.master.diag()[0] & 0x02  # Station_Not_Ready


def test_the_host_tells_diagnosis_and_rate() -> None:
    with Segment(187_500, ports=1, cards=1) as wire:
        card = wire.attach(SIP3(5))
        port = Port(wire)
        try:
            card.undervoltage = True

            def diagnosis() -> bytes:
                head = port.ask(telegram(5, 2, 0x4D, b"", 60), 4)
                return (head + port.ask(b"", head[1] + 2))[9:-2] if head else b""  # a hub that is late does not answer

            until(lambda: diagnosis()[6:] == octets("05 81 00 00 01"))
            assert card._exchange.baudrate == 187_500
        finally:
            os.close(port.fd)
