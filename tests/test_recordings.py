# SPDX-License-Identifier: MIT
"""The master beside masters of the trade: what an S7 and a PC master put on a real bus, and what ours does in their place.

Our master is given the recorded slave's parameters and the recorded slave's answers, at the recorded Tsdr; what it sends is
compared with the recording octet by octet. Where it lawfully differs:

- The S7 broadcasts its bus parameters (SDN to SAP 63) every 7 s, for FDL stations that take parameters from others:
  nobody here does. In these replays ours is a sole master, which looks after no GAP; the GAP scan has a test of its own.
- The S7 sends one telegram per token. Ours asks every slave of the cycle with one token.
- Global_Control is repeated at times of each master's own, by both; and ours tells its mode again as soon as a slave has
  joined. A repetition of the same command says nothing new, so only changes of the command are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import pytest
from recordings import CHARACTER, PC, RATE, S7, Line, recorded
from wire import Master, Offer, Script, Slaves, feed, lib, octets

SLAVE, IDENT = 26, 0x0B0D
GLOBAL_CONTROL = octets("46 3A 3E")  # FC SDN high, SAP 58, SAP 62


def is_control(telegram: bytes) -> bool:
    return telegram[6:9] == GLOBAL_CONTROL


def kind_of(telegram: bytes) -> str:
    """What a master's telegram that nobody answered was."""
    return "token" if telegram[0] == 0xDC else "control" if is_control(telegram) else "no answer"


@dataclass(frozen=True)
class Step:
    """A request to the slave, its answer if there was one, and the Global_Control that lay before it."""

    request: bytes
    answer: bytes = b""
    tsdr: float = 0.0


def steps(lines: list[Line]) -> list[Step]:
    """What was said to the slave, Global_Control between it where it said something new."""
    found: list[Step] = []
    for line, following in zip(lines, [*lines[1:], None], strict=True):
        if line.to(SLAVE):
            answered = following is not None and following.slave
            found.append(Step(line.octets, following.octets, following.idle) if answered and following else Step(line.octets))
        elif is_control(line.octets):
            found.append(Step(line.octets))
    return without_repetitions(found)


def without_repetitions(found: list[Step]) -> list[Step]:
    command = b""
    kept = []
    for step in found:
        if is_control(step.request):
            if step.request == command:
                continue
            command = step.request
        kept.append(step)
    return kept


@dataclass
class Player:
    """Our master on the recorded slave's bus: it is let to speak, and the slave's next recorded answer follows."""

    master: Master
    sent: list[bytes] = field(default_factory=list)
    idle: dict[str, list[float]] = field(default_factory=dict)  # Tbit before our telegrams, by what was before them

    def __post_init__(self) -> None:
        self.script = Script(self.master)
        self.before = "nothing"

    def next(self) -> bytes:
        """Our next telegram that is no token."""
        while True:
            since = self.script.now
            telegram = self.script.next(tokens=True)
            assert telegram, "our master has fallen silent"
            assert self.script.last
            self.idle.setdefault(self.before, []).append((self.script.last.start - since) * RATE / 1e9)
            self.before = kind_of(telegram)
            if telegram[0] != 0xDC:
                self.sent.append(telegram)
                return telegram

    def request(self) -> bytes:
        """Our next telegram to the slave."""
        while is_control(telegram := self.next()):
            pass
        return telegram

    def answer(self, step: Step) -> None:
        if step.answer:
            self.script.answer(step.answer, tsdr=step.tsdr)
            self.before = "answer"

    @property
    def spoken(self) -> list[bytes]:
        """What we sent, without Global_Control that says what was said before."""
        return [step.request for step in without_repetitions([Step(telegram) for telegram in self.sent])]


def master_like(lines: list[Line], address: int) -> Master:
    """Our master at the recorded one's address, the slave configured as Set_Prm and Chk_Cfg of the recording have it."""
    requests = [line.octets for line in lines if line.to(SLAVE)]
    prm = next(r[9:-2] for r in requests if r[7:8] == b"\x3d" and r[8] == 0x3E)
    cfg = next(r[9:-2] for r in requests if r[7:9] == b"\x3e\x3e")
    master = Master(RATE, address=address)
    index = master.add(SLAVE, int.from_bytes(prm[4:6], "big"), cfg, prm[7:], station_status=prm[0] & 0x30,
                       watchdog=(prm[1], prm[2]), min_tsdr=prm[3], group=prm[6])
    assert index == 0 and int.from_bytes(prm[4:6], "big") == IDENT
    return master


def from_clear(lines: list[Line]) -> list[Step]:
    """From the Global_Control Clear with which both masters begin."""
    begin = next(i for i, line in enumerate(lines) if is_control(line.octets) and line.octets[9] == 0x02)
    return steps(lines[begin:])


# -- (a), (b) The S7 ---------------------------------------------------------------------------------------------------


def play_s7(count: int | None = None) -> tuple[Player, list[Step]]:
    """Our master through `count` steps of the S7's recording: its commits are what the S7's program wrote."""
    lines = recorded(S7)
    wanted = [step for step in from_clear(lines) if step.answer or is_control(step.request)][:count]
    player = Player(master_like(lines, 2))
    player.master.mode(lib.DPM_MODE_CLEAR)
    for step in wanted:
        if is_control(step.request):
            if step.request[9] == 0x00:  # when to operate is the program's decision: the S7's after two exchanges
                player.master.mode(lib.DPM_MODE_OPERATE, player.script.now)
            continue
        outputs = step.request[7:-2]
        if step.request[4] == SLAVE and any(outputs):
            player.master.commit(0, outputs, player.script.now)
        player.request()
        player.answer(step)
        if step.answer[4:7] == octets("02 1A 08"):
            assert bytes(player.master.inputs(0).octets[0:52]) == step.answer[7:-2]
    return player, wanted


START = (  # lines 90 to 116 of the recording, GAP polls and tokens left out; kept here so that the test can be read
    "68 07 07 68 FF 82 46 3A 3E 02 00 41 16",  # Global_Control Clear
    "68 05 05 68 9A 82 6D 3C 3E 03 16",  # Slave_Diag: first contact, FCB 1, FCV 0
    "68 19 19 68 9A 82 5D 3D 3E B8 15 16 0B 0B 0D 00 00 00 00 04 00 01 01 00 FF 00 00 00 01 00 16",  # Set_Prm
    "68 0B 0B 68 9A 82 7D 3E 3E 13 25 1F 1F 1F 27 D1 16",  # Chk_Cfg
    "68 05 05 68 9A 82 5D 3C 3E F3 16",  # Slave_Diag
    "68 11 11 68 1A 02 7D 00 00 00 00 00 00 00 00 00 00 00 00 00 00 99 16",  # Data_Exchange, zeros
    "68 11 11 68 1A 02 5D 00 00 00 00 00 00 00 00 00 00 00 00 00 00 79 16",
    "68 07 07 68 FF 82 46 3A 3E 00 00 3F 16",  # Global_Control Operate
    "68 11 11 68 1A 02 7D 00 00 00 00 00 00 00 00 00 00 00 00 00 00 99 16",
)


def test_the_start_up_is_the_s7s_octet_for_octet_and_in_its_order() -> None:
    """Clear, Slave_Diag, Set_Prm, Chk_Cfg, Slave_Diag, two Data_Exchanges, Operate, Data_Exchange."""
    player, wanted = play_s7(len(START))
    assert [step.request for step in wanted] == [octets(text) for text in START], "the recording is the one this test means"
    assert player.spoken == [octets(text) for text in START]


def test_the_whole_exchange_is_the_s7s() -> None:
    """133 exchanges with changing outputs: FC with its FCB, data and sum of every one."""
    player, wanted = play_s7()
    assert len(wanted) > 130
    assert player.spoken == [step.request for step in wanted]
    status = player.master.slave(0)
    assert (status.state, status.statistics.repetitions, status.statistics.invalid) == (lib.DPM_ST_DATA, 0, 0)


def recorded_idle(lines: list[Line]) -> dict[str, float]:
    """Median idle before the recorded master's telegrams, Tbit, by what was before them."""
    idle: dict[str, list[float]] = {}
    for before, line in pairwise(lines):
        if line.slave or line.idle < 0:
            continue
        kind = "answer" if before.slave else kind_of(before.octets)
        if before.octets[6:7] != b"\x44":  # the bus parameters, another broadcast
            idle.setdefault(kind, []).append(line.idle)
    return {kind: median(values) for kind, values in idle.items()}


def test_our_idle_times_beside_the_s7s() -> None:
    """9600 bit/s: 37 Tbit (Tid1) after token and answer, 60 (Tid2 = max Tsdr) after Global_Control, 100 (Tsl) after silence.

    The S7's are measured to within a bit: its clock and its slave's are not one. Ours are exact, and never shorter.
    """
    theirs = recorded_idle(recorded(S7))
    player, _ = play_s7()
    while player.before != "no answer":
        player.next()
    player.next()  # the slave has fallen silent: the repetition, a slot time later
    ours = {kind: (min(values), median(values)) for kind, values in player.idle.items() if kind != "nothing"}
    assert ours.keys() == theirs.keys() == {"token", "answer", "control", "no answer"}
    for kind, least in {"token": 37, "answer": 37, "control": 60, "no answer": 100}.items():
        assert least <= ours[kind][0] and ours[kind][1] < least + 0.1, kind
        assert abs(ours[kind][1] - theirs[kind]) <= 1.0, kind


# -- (c) FCB -----------------------------------------------------------------------------------------------------------


def by_the_rules(requests: list[bytes]) -> list[str]:
    """What the responder's rules of protocol page C.2 make of one master's requests; a contradiction fails."""
    stored: int | None = None
    kinds = []
    for before, request in zip([b"", *requests], requests, strict=False):
        fc = request[6] if request[0] == 0x68 else request[3]
        fcb, fcv = bool(fc & 0x20), bool(fc & 0x10)
        if not fcv:
            assert fcb, f"SRD with neither FCB nor FCV: {request.hex(' ')}"
            kinds.append("first")
        elif fcb != stored:
            kinds.append("new")
        else:
            assert request == before, f"a repetition that differs: {request.hex(' ')}"
            kinds.append("repetition")
        stored = fcb
    return kinds


@pytest.mark.parametrize(("name", "configuration", "user"), [(S7, "13 25 1F 1F 1F 27", 13), (PC, "00", 8)])
def test_recorded_requests_obey_the_fcb_rules_as_our_slave_judges_them(name: str, configuration: str, user: int) -> None:
    """Our slave hears all of it, tokens and polls included; it takes for a repetition what the rules call so, and no more."""
    lines = recorded(name)
    slaves = Slaves(RATE, slaves=1)
    slaves.add(SLAVE, IDENT, octets(configuration), user=(user, user))
    machine = slaves.machine
    judged = []
    for line, following in zip(lines, [*lines[1:], lines[-1]], strict=True):
        if line.slave:
            continue
        machine.quiet(machine, line.start - 1)
        before = slaves.report(0)
        feed(machine, line.octets, line.end, CHARACTER)
        offer = Offer(machine, line.end)
        if offer.octets:
            start = following.start if following.slave else offer.not_before
            machine.sent(machine, start, *[start + len(offer.octets) * CHARACTER] * 2, lib.DPM_SENT_WHOLE)
        if line.to(SLAVE):
            after = slaves.report(0)
            assert after.requests == before.requests + 1 and offer.octets
            judged.append(after.repetitions > before.repetitions)
    kinds = by_the_rules([line.octets for line in lines if line.to(SLAVE)])
    assert judged == [kind == "repetition" for kind in kinds]
    assert kinds.count("repetition") == (1 if name == PC else 0) and len(kinds) > 130
    exchanges = [line for line in lines if line.to(SLAVE) and line.octets[4 if line.octets[0] == 0x68 else 1] == SLAVE]
    assert slaves.report(0).exchanges == len(exchanges), "each Data_Exchange was a new one"


# -- (d) The PC master -------------------------------------------------------------------------------------------------


def play_pc() -> tuple[Player, list[Step]]:
    """Our master at the PC's address 1 through its start-up and exchange."""
    lines = recorded(PC)
    wanted = from_clear(lines)
    player = Player(master_like(lines, 1))
    player.master.mode(lib.DPM_MODE_CLEAR)
    for step in wanted:
        if not is_control(step.request):
            assert player.request() == step.request, f"step {len(player.spoken)} of {len(wanted)}"
            player.answer(step)
        elif step.request[9] == 0x00:
            player.master.mode(lib.DPM_MODE_OPERATE, player.script.now)
    player.next()
    return player, wanted


def test_the_pc_masters_way_is_ours_octet_for_octet() -> None:
    """No answer, RS to Slave_Diag 18 times (asked again with toggling FCB), a lost answer, start-up, DH, 134 SCs."""
    player, wanted = play_pc()
    sent = player.spoken
    assert len(wanted) > 150
    assert sent[: len(wanted)] == [step.request for step in wanted]


def test_every_answer_of_the_recorded_slave_is_taken() -> None:
    """What each answer did: nothing was called invalid, and each kind counted for what it was."""
    player, wanted = play_pc()
    status = player.master.slave(0)
    answers = [step.answer for step in wanted]
    short, rs = answers.count(b"\xe5"), answers.count(octets("10 01 1A 03 1E 16"))
    dummy = answers.count(octets("68 04 04 68 01 1A 0A 00 25 16"))
    assert (rs, dummy) == (18, 1) and short > 130
    statistics = status.statistics
    assert status.state == lib.DPM_ST_DATA and status.reason == lib.DPM_WHY_NONE
    assert (statistics.refused, statistics.invalid, statistics.starts, statistics.losses) == (rs, 0, 1, 0)
    assert statistics.exchanges == short - 2 + dummy, "every SC but those to Set_Prm and Chk_Cfg, and DH with a dummy octet"
    assert statistics.diagnoses == sum(answer[7:9] == octets("3E 3C") for answer in answers)
    # DH was followed by the extended diagnosis: 08 Ext_Diag, 0C WD_On, master 1, three octets of the device's own.
    assert bytes(status.diagnosis[0 : status.diagnosis_length]) == octets("08 0C 00 01 0B 0D 03 82 3D")
    assert statistics.tsdr_min >= 11 * 1e9 / RATE and statistics.tsdr_max < 13 * 1e9 / RATE


@pytest.mark.parametrize(("function", "dsap", "request_", "fc", "data"), [
    ("FDL_STATUS", -1, "10 1A 01 49 64 16", 0x00, ""),
    ("SRD_HIGH", 60, "68 05 05 68 9A 81 6D 3C 3E 02 16", 0x08, "02 05 00 FF 0B 0D"),
    ("SRD_HIGH", 59, "68 05 05 68 9A 81 5D 3B 3E F1 16", 0x08, "00"),
], ids=["FDL status", "Slave_Diag", "Get_Cfg"])
def test_services_by_hand(function: str, dsap: int, request_: str, fc: int, data: str) -> None:
    """What the PC asked before it configured anything, asked by a program of ours in Stop: the same octets, and the answer."""
    lines = recorded(PC)
    asked, answered = next((a, b) for a, b in pairwise(lines) if b.slave and a.octets == octets(request_))
    master = Master(RATE, address=1)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    if dsap == 59:  # not the first contact: Slave_Diag came before it
        master.request(SLAVE, lib.DPM_SRD_HIGH, dsap=60, ssap=62)
        script.next()
        script.answer("68 0B 0B 68 81 9A 08 3E 3C 02 05 00 FF 0B 0D BB 16")
    raw = master.request(SLAVE, getattr(lib, f"DPM_{function}"), dsap=dsap, ssap=62 if dsap >= 0 else -1)
    assert script.next() == asked.octets
    script.answer(answered.octets, tsdr=answered.idle)
    assert raw.done and (raw.status, raw.fc, raw.tries) == (lib.DPM_CONF_ANSWER, fc, 1)
    assert bytes(raw.answer[0 : raw.answer_length]) == octets(data)


def test_the_cold_start_in_the_ring_is_the_s7s_claim_and_gap_scan():
    """Two tokens to itself, then one GAP poll per token over all addresses; idle 37 behind a token, Tsl behind a poll that
    nobody answers (protocol page E.1, E.3). The S7 sends a third token and its bus parameters before it polls."""
    recording = [line for line in recorded(S7) if line.octets[0] in (0xDC, 0x10) and not line.slave][3:200]
    assert [line.octets[0] for line in recording[:4]] == [0x10, 0xDC, 0x10, 0xDC]
    master = Master(RATE, address=2, role=lib.DPM_ROLE_RING)
    master.mode(lib.DPM_MODE_STOP)
    script = Script(master)
    assert script.next(tokens=True) == script.next(tokens=True) == octets("DC 02 02")
    scan = [line for line in recording if line.octets[1] != SLAVE][:90]
    for n, line in enumerate(scan):
        end = script.last.end
        telegram = script.next(tokens=True)
        if telegram[0] == 0x10 and telegram[1] == SLAVE:  # the one that answers in the recording
            end = script.answer(bytes([0x10, 2, SLAVE, 0, 2 + SLAVE, 0x16]), tsdr=11.5)
            telegram = script.next(tokens=True)
        assert telegram == line.octets, n
        if n and line.octets[0] == 0xDC and scan[n - 1].octets[1] != SLAVE - 1:
            # Alone, ours adds a bit time for each address behind a poll that nobody answered: two, here.
            assert script.idle_bits(end) == pytest.approx(line.idle, abs=2.01), line
