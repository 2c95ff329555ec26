# SPDX-License-Identifier: MIT
"""What slaves made of software demand beyond what a lax one checks, one named test for each demand.

The demands were seen with slaves of others on ptys and with a logic analyser. Those of the slave handler, one event at a time,
are in test_dp_master; here is what needs a slave with a mind of its own, or several of them. `DEMANDS` says where each
demand is shown.
"""

from __future__ import annotations

import random

import pytest
from named_tests import check_named
from wire import MS, Master, S, Script, lib, octets

DEMANDS = {
    "37 Tbit of idle before every request": "test_soft_slaves.py::test_a_slave_that_wants_37_bits_of_idle_hears_every_request",
    "37 Tbit of idle, at the FDL": "test_fdl.py::test_idle_before_a_request_is_never_under_37_bits_at_low_rates",
    "no pause inside a telegram": "test_port.py::test_a_telegram_is_one_write",
    "no outputs before Operate": "test_soft_slaves.py::test_no_outputs_before_operate_was_said",
    "no outputs before Operate, mode changed in mid-cycle": "test_soft_slaves.py::test_no_outputs_in_the_rest_of_the_cycle",
    "RS before Set_Prm": "test_dp_master.py::test_rs_ue_rr_at_each_step_lead_back_to_slave_diag",
    "RS before Set_Prm, recorded": "test_recordings.py::test_the_pc_masters_way_is_ours_octet_for_octet",
    "answers that do not fit": "test_dp_master.py::test_an_answer_that_does_not_fit_is_invalid_and_changes_no_input",
    "empty SD2 answers": "test_dp_master.py::test_an_empty_sd2_is_an_answer_without_data",
    "Prm_Fault in one diagnosis only": "test_dp_master.py::test_a_prm_fault_shown_in_one_diagnosis_only_is_still_a_refusal",
    "silence instead of SC": "test_dp_master.py::test_silence_instead_of_sc_names_the_step",
    "the always-1 bit missing": "test_dp_master.py::test_the_always_one_bit_may_be_missing",
    "Stat_Diag kept": "test_dp_master.py::test_a_slave_that_is_not_ready_is_asked_until_it_is",
    "Stat_Diag kept in exchange": "test_dp_master.py::test_static_diagnosis_in_data_exchange_is_read_until_it_is_gone",
    "answers from 6 to 90 Tbit": "test_dp_master.py::test_answers_from_6_to_90_bits_after_the_request",
    "any of them together": "test_soft_slaves.py::test_soft_slaves_of_every_kind_come_into_exchange",
}


def test_every_demand_names_a_test() -> None:
    check_named(DEMANDS)


SC = octets("E5")
OPERATE = octets("46 3A 3E 00 00")
OUTPUTS = octets("11 22")


def frame(da: int, sa: int, fc: int, data: bytes = b"", saps: bytes = b"") -> bytes:
    """An SD2 made by hand."""
    body = bytes([da | (0x80 if saps else 0), sa | (0x80 if saps else 0), fc]) + saps + data
    return bytes([0x68, len(body), len(body), 0x68]) + body + bytes([sum(body) & 0xFF, 0x16])


class Soft:
    """A slave written for a test, with two octets of output: it answers as its options say and keeps what it saw."""

    def __init__(self, address: int, *, always_one: bool = True, stat_diags: int = 0, early_rs: int = 0,
                 empty_sd2: bool = False, tsdr: float = 11) -> None:
        self.address = address
        self.always_one = 0x04 if always_one else 0
        self.stat_diags = stat_diags
        self.early_rs = early_rs
        self.empty_sd2 = empty_sd2
        self.tsdr = tsdr
        self.state = "WAIT-PRM"
        self.operate = False
        self.outputs: list[bytes] = []
        self.complaints: list[str] = []

    def hear(self, telegram: bytes, idle: float) -> bytes:
        """The answer to a telegram with so many Tbit of idle before it."""
        if telegram[6:9] == OPERATE[:3]:
            self.operate = telegram[6:11] == OPERATE and self.state == "DATA-EXCH"
            return b""
        if telegram[0] != 0x68 or telegram[4] & 0x7F != self.address:
            return b""
        if idle < 36.7:
            return b""  # it is not listening yet
        if self.early_rs and self.state == "WAIT-PRM" and telegram[7:8] == b"\x3c":
            self.early_rs -= 1
            return bytes([0x10, 1, self.address, 0x03, 1 + self.address + 3, 0x16])
        sap = telegram[7] if telegram[4] & 0x80 else 0
        return {0x3C: self.diagnosis, 0x3D: self.prm, 0x3E: self.cfg}.get(sap, self.data)(telegram)

    def diagnosis(self, telegram: bytes) -> bytes:
        ready = self.state == "DATA-EXCH"
        static = ready and self.stat_diags > 0
        self.stat_diags -= static
        two = self.always_one | (0x02 if static else 0) | (0x08 if ready else 0x01)
        six = bytes([0x00 if ready else 0x02, two, 0, 1 if ready else 0xFF, 0x0A, 0x35])
        return frame(1, self.address, 0x08, six, b"\x3e\x3c")

    def prm(self, telegram: bytes) -> bytes:
        self.state = "WAIT-CFG"
        return SC

    def cfg(self, telegram: bytes) -> bytes:
        self.state = "DATA-EXCH"
        self.operate = False
        return SC

    def data(self, telegram: bytes) -> bytes:
        outputs = telegram[7:-2]
        if any(outputs) and not self.operate:
            self.complaints.append(f"outputs {outputs.hex(' ')} before Global_Control Operate")
        self.outputs.append(outputs)
        return frame(1, self.address, 0x08) if self.empty_sd2 else SC


class Bench:
    """A master and soft slaves, one telegram at a time."""

    def __init__(self, *slaves: Soft, rate: int = 19_200) -> None:
        self.rate = rate
        self.slaves = slaves
        self.absent: set[int] = set()
        self.master = Master(rate, address=1)
        for slave in slaves:
            self.master.add(slave.address, 0x0A35, b"\x21", watchdog=(100, 1))
        self.script = Script(self.master)
        self.end = 0

    def step(self) -> bytes:
        """The master's next telegram, tokens included, and what the slaves make of it."""
        telegram = self.script.next(tokens=True)
        assert telegram and self.script.last
        idle = (self.script.last.start - self.end) * self.rate / 1e9
        self.end = self.script.last.end
        for slave in self.slaves:
            if slave.address not in self.absent and (answer := slave.hear(telegram, idle)):
                self.end = self.script.answer(answer, tsdr=slave.tsdr)
        return telegram

    def until(self, address: int) -> None:
        """Up to and including a Data_Exchange with that slave."""
        while self.step()[4:5] != bytes([address]):
            pass

    def run(self, duration: int) -> None:
        end = self.script.now + duration
        while self.script.now < end:
            self.step()

    def mode(self, mode: int) -> None:
        self.master.mode(mode, self.script.now)

    def state(self, index: int) -> int:
        return int(self.master.slave(index).state)


@pytest.mark.parametrize("rate", [9_600, 19_200, 93_750, 500_000])
def test_a_slave_that_wants_37_bits_of_idle_hears_every_request(rate: int) -> None:
    """One ignores a request after 36.7 Tbit: then there would be repetitions."""
    soft = Soft(8)
    bench = Bench(soft, rate=rate)
    bench.mode(lib.DPM_MODE_OPERATE)
    for _ in range(400):
        bench.step()
    status = bench.master.slave(0)
    assert status.state == lib.DPM_ST_DATA and len(soft.outputs) > 100
    assert (status.statistics.repetitions, status.statistics.unanswered) == (0, 0)


def test_no_outputs_before_operate_was_said() -> None:
    """A slave that joins an operating master: zeros, then Operate, then what was committed - whenever that was."""
    soft, late = Soft(8), Soft(9)
    bench = Bench(soft, late)
    bench.absent.add(9)
    bench.mode(lib.DPM_MODE_OPERATE)
    bench.until(8)
    for index in range(2):
        bench.master.commit(index, OUTPUTS, bench.script.now)
    bench.run(500 * MS)
    assert soft.outputs[-1] == OUTPUTS
    bench.absent.clear()
    bench.run(2 * S)
    assert late.outputs[0] == bytes(2) and late.outputs[-1] == OUTPUTS
    assert soft.complaints == late.complaints == []
    # The same once more after a loss: the commit is made in the moment in which the slave is ready again.
    bench.absent.add(9)
    bench.run(500 * MS)
    bench.absent.clear()
    late.state, heard = "WAIT-PRM", len(late.outputs)
    while bench.state(1) != lib.DPM_ST_DATA:
        bench.step()
    bench.master.commit(1, OUTPUTS, bench.script.now)
    bench.run(500 * MS)
    assert late.outputs[heard] == bytes(2) and late.outputs[-1] == OUTPUTS
    assert soft.complaints == late.complaints == []


def test_no_outputs_in_the_rest_of_the_cycle() -> None:
    """The mode is changed between two slaves of one cycle: the second one has not heard of it yet."""
    slaves = Soft(8), Soft(9), Soft(10)
    bench = Bench(*slaves)
    bench.mode(lib.DPM_MODE_CLEAR)
    bench.run(1 * S)
    for index in range(3):
        bench.master.commit(index, OUTPUTS, bench.script.now)
    bench.until(8)
    bench.mode(lib.DPM_MODE_OPERATE)
    bench.run(500 * MS)
    for slave in slaves:
        assert slave.complaints == [] and slave.outputs[-1] == OUTPUTS


def test_soft_slaves_of_every_kind_come_into_exchange() -> None:
    """The demands together, as chance combines them."""
    seed = random.SystemRandom().randrange(1 << 32)
    print(f"seed {seed}")
    dice = random.Random(seed)
    for _ in range(12):
        slaves = [Soft(8 + i, always_one=dice.random() < 0.5, stat_diags=dice.randrange(5), early_rs=dice.randrange(4),
                       empty_sd2=dice.random() < 0.5, tsdr=dice.uniform(6, 90)) for i in range(dice.randint(1, 5))]
        bench = Bench(*slaves, rate=dice.choice([9_600, 19_200, 187_500, 500_000]))
        bench.mode(lib.DPM_MODE_OPERATE)
        for index in range(len(slaves)):
            bench.master.commit(index, OUTPUTS, 0)
        bench.run(3 * S if bench.rate < 100_000 else 300 * MS)
        for index, slave in enumerate(slaves):
            status = bench.master.slave(index)
            assert status.state == lib.DPM_ST_DATA and slave.complaints == [], vars(slave)
            assert (slave.outputs[0], slave.outputs[-1]) == (bytes(2), OUTPUTS)
            assert (status.statistics.repetitions, status.statistics.invalid, status.statistics.losses) == (0, 0, 0)
