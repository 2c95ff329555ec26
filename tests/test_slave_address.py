# SPDX-License-Identifier: MIT
"""A slave's address: Set_Slave_Add (protocol page F.2, I.1), 126, the lock, what outlives a power cycle."""

from __future__ import annotations

import pytest
from slave_rig import (
    CHK_CFG,
    DATA_EXCH,
    GET_CFG,
    MS,
    POWER_UP,
    RD_INP,
    SC,
    SET_SLAVE_ADD,
    WAIT_CFG,
    WAIT_PRM,
    Initiator,
    Rig,
    SlaveConfig,
    octets,
    telegram,
)

from dpmaster._core import lib

IDENT = 0x0A35


def waiting(address: int = 126, **more: object) -> Rig:
    """A slave that takes Set_Slave_Add."""
    return Rig((SlaveConfig(address, IDENT, more={"set_address": True, **more}),))


def there(rig: Rig, address: int) -> bool:
    return rig.exchange(telegram(address, 2, 0x49)) == telegram(2, address, 0x00)


def test_the_telegram_of_row_56() -> None:
    """B.4 #56 "Set_Slave_Add 126 -> 8, ident 0A35, later change allowed; answer E5"; I.1 "WAIT-PRM | Set_Slave_Add ok | SC;
    change address | WAIT-PRM (new address)"."""
    rig = waiting()
    before = rig.progress
    assert rig.exchange(octets("68 09 09 68 FE 82 6D 37 3E 08 0A 35 00 A9 16")) == SC
    assert rig.progress > before, "the application is told"
    assert (rig.report().address, rig.report().address_locked, rig.report().state) == (8, False, WAIT_PRM)
    assert (there(rig, 126), there(rig, 8)) == (False, True)
    master = Initiator(rig)
    assert master.diag() == POWER_UP[:4] + octets("0A 35")
    assert master.prm(ident=IDENT) == SC
    assert master.srd(CHK_CFG, b"\x72") == SC
    assert rig.report().state == DATA_EXCH


def test_a_slave_at_126_waits_and_does_nothing_else() -> None:
    """Page I.1 "without a valid address (0..125) stay passive on 126": it can be found and named, not parameterised."""
    rig = waiting()
    master = Initiator(rig, slave=126)
    assert there(rig, 126)
    assert master.diag() == POWER_UP[:4] + octets("0A 35")
    assert master.answer(GET_CFG) == b"\x72"
    assert master.prm(ident=IDENT) == master.rs()
    assert master.prm(0x00, min_tsdr=30) == master.rs()
    for sap, data in ((CHK_CFG, b"\x72"), (RD_INP, b""), (None, bytes(6))):
        assert master.srd(sap, data) == master.rs()
    assert rig.report().state == WAIT_PRM


@pytest.mark.parametrize("data", [
    octets("08 0A 36 00"),  # "only if the ident matches"
    octets("7E 0A 35 00"),  # New_Slave_Add 0..125
    octets("7F 0A 35 00"),
    octets("FF 0A 35 00"),
    octets("08 0A 35"),     # cut short
    b"",
])
def test_what_is_not_executed_is_acknowledged_all_the_same(data: bytes) -> None:
    """Page F.2 "only in WAIT-PRM, only if the ident matches and address change not locked; else ignored (still SC)"."""
    rig = waiting(5)
    master = Initiator(rig, slave=5)
    before = rig.progress
    assert master.srd(SET_SLAVE_ADD, data) == SC
    assert (rig.report().address, rig.report().address_locked, rig.progress) == (5, False, before)
    assert there(rig, 5)


@pytest.mark.parametrize("state", [WAIT_CFG, DATA_EXCH])
@pytest.mark.parametrize("address", [2, 3])
def test_only_in_wait_prm(state: int, address: int) -> None:
    """The same sentence, for the own master and another."""
    rig = waiting(5)
    own = Initiator(rig, slave=5)
    own.prm(ident=IDENT)
    if state == DATA_EXCH:
        own.srd(CHK_CFG, b"\x72")
    master = own if address == 2 else Initiator(rig, slave=5, address=3)
    assert master.srd(SET_SLAVE_ADD, octets("08 0A 35 00")) == SC
    assert (rig.report().address, rig.report().state) == (5, state)


def test_the_lock_is_stored_and_outlives_power() -> None:
    """Page F.2 "No_Add_Chg: 01..FF = locked until reset to default 126"; "the new address must be stored non-volatile"."""
    rig = waiting()
    Initiator(rig, slave=126).srd(SET_SLAVE_ADD, octets("08 0A 35 01"))
    for _ in range(2):
        report = rig.report()
        assert (report.address, report.address_locked) == (8, True)
        assert Initiator(rig).srd(SET_SLAVE_ADD, octets("09 0A 35 00")) == SC
        assert (there(rig, 8), there(rig, 9)) == (True, False)
        lib.dpm_slaves_reset(rig.slaves, 0, rig.time)

    assert lib.dpm_slaves_set_address(rig.slaves, 0, 126, False, rig.time) == 0  # the reset to 126
    assert (there(rig, 8), there(rig, 126), rig.report().address_locked) == (False, True, False)
    Initiator(rig, slave=126).srd(SET_SLAVE_ADD, octets("09 0A 35 00"))
    assert there(rig, 9)


def test_an_address_that_may_be_changed_can_be_changed_again() -> None:
    rig = waiting()
    for old, new in ((126, 8), (8, 0), (0, 125), (125, 125)):
        assert Initiator(rig, slave=old).srd(SET_SLAVE_ADD, bytes([new]) + octets("0A 35 00")) == SC
        assert there(rig, new)
        assert old == new or not there(rig, old)


def test_the_repetition_of_a_set_slave_add_finds_nobody() -> None:
    """Page F.2 "usable after the SC at the old address": once acknowledged, the old address is nobody's."""
    rig = waiting()
    request = telegram(126, 2, 0x7D, octets("08 0A 35 00"), SET_SLAVE_ADD)
    rig.hear(request, rig.time + MS)
    assert rig.ask(rig.time).octets == SC
    rig.hear(request, rig.time + MS)  # the SC was not heard, or never left
    assert rig.ask(rig.time).octets == b""
    assert there(rig, 8)


@pytest.mark.parametrize("length", [0, 1, 240])
def test_rem_slave_data_are_the_applications(length: int) -> None:
    """Page F.2 "5.. Rem_Slave_Data (0..240 application octets)"; kept over power cycles with the address."""
    rig = waiting()
    remote = bytes(i & 0xFF for i in range(7, 7 + length))
    Initiator(rig, slave=126).srd(SET_SLAVE_ADD, octets("08 0A 35 00") + remote)
    lib.dpm_slaves_reset(rig.slaves, 0, rig.time)
    report = rig.report()
    assert bytes(report.remote[0 : report.remote_length]) == remote


def test_a_slave_without_the_service_refuses() -> None:
    """Page F.1 "SAP not active: SD1 with FC RS"; by SDA too it is executed, where it is there."""
    rig = Rig((SlaveConfig(8, IDENT),))
    master = Initiator(rig)
    assert master.srd(SET_SLAVE_ADD, octets("09 0A 35 00")) == master.rs()
    rig = waiting()
    assert rig.exchange(telegram(126, 2, 0x65, octets("08 0A 35 00"), SET_SLAVE_ADD)) == SC
    assert there(rig, 8)


def test_an_address_of_this_wire_that_is_taken_stays_its_owners() -> None:
    """Two at one address would answer at once; one machine cannot say two things."""
    rig = Rig(tuple(SlaveConfig(address, IDENT, more={"set_address": True}) for address in (5, 126)))
    assert Initiator(rig, slave=126).srd(SET_SLAVE_ADD, octets("05 0A 35 00")) == SC
    assert [rig.report(i).address for i in (0, 1)] == [5, 126]
    assert lib.dpm_slaves_set_address(rig.slaves, 1, 5, False, rig.time) == lib.DPM_E_DUPLICATE
    assert lib.dpm_slaves_set_address(rig.slaves, 1, 127, False, rig.time) == lib.DPM_E_ADDRESS
    assert lib.dpm_slaves_set_address(rig.slaves, 2, 7, False, rig.time) == lib.DPM_E_ARGUMENT
    assert lib.dpm_slaves_set_address(rig.slaves, 0, 5, False, rig.time) == 0, "its own"
    # Moved away, the first one's address is free, and the two do not mix.
    assert lib.dpm_slaves_set_address(rig.slaves, 0, 6, True, rig.time) == 0
    assert Initiator(rig, slave=126).srd(SET_SLAVE_ADD, octets("05 0A 35 00")) == SC
    assert [there(rig, address) for address in (5, 6, 126)] == [True, True, False]
    assert [rig.report(i).address for i in (0, 1)] == [6, 5]
    assert Initiator(rig, slave=6).srd(SET_SLAVE_ADD, octets("07 0A 35 00")) == SC
    assert there(rig, 6), "an address set with its lock"


def test_a_locked_address_is_part_of_the_set_up() -> None:
    """What an EEPROM held before this power-on."""
    rig = waiting(8, address_locked=True)
    assert Initiator(rig).srd(SET_SLAVE_ADD, octets("09 0A 35 00")) == SC
    assert (there(rig, 8), rig.report().address_locked) == (True, True)
