# SPDX-License-Identifier: MIT
"""PPO and PKW of the profile for variable-speed drives: octets of protocol page L and of printed examples, and both ends of
the parameter channel against each other with every delay between them."""

from __future__ import annotations

import math
import random

import pytest

from dpmaster.errors import ConfigurationError
from dpmaster.profiles import pkw, ppo
from dpmaster.profiles.pkw import Error, Message, Refusal, Requester, Responder, Response, Task, Value, serve

# -- PPO ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "size", "pzd", "words", "consistent", "plain"), [
    (1, 12, 8, 2, "f3f1", "7371"), (2, 20, 8, 6, "f3f5", "7375"), (3, 4, 0, 2, "f1", "71"), (4, 12, 0, 6, "f5", "75"),
    (5, 28, 8, 10, "f3f9", "7379")])
def test_the_five_types(kind: int, size: int, pzd: int, words: int, consistent: str, plain: str) -> None:
    """Protocol page L: PPO1 = 4 PKW + 2 PZD ...; page G.2 and the SI-P3's GSD file: the identifier octets."""
    found = ppo.TYPES[kind]
    assert (found.size, found.pzd, found.words) == (size, pzd, words)
    assert (found.identifier().hex(), found.identifier(consistent=False).hex()) == (consistent, plain)
    assert [found.offset(n) for n in (1, 2, words)] == [pzd, pzd + 2, size - 2]
    for number in (0, words + 1):
        with pytest.raises(ConfigurationError, match=f"PZD{number}: PPO type {kind} has PZD1 to PZD{words}"):
            found.offset(number)


@pytest.mark.parametrize(("share", "full", "word"), [
    (1.0, ppo.FULL_SCALE, 0x4000), (-1.0, ppo.FULL_SCALE, 0xC000), (0.5, ppo.FULL_SCALE, 0x2000), (0.0, ppo.FULL_SCALE, 0),
    (1.0, 10_000, 0x2710), (-1.0, 10_000, 0xD8F0), (-0.0001, 10_000, 0xFFFF)])
def test_scaling(share: float, full: int, word: int) -> None:
    assert ppo.to_word(share, full) == word
    assert ppo.to_share(word, full) == share


def test_what_a_word_cannot_hold_is_an_error() -> None:
    assert ppo.to_word(-2.0) == 0x8000
    for share in (2.0, -2.01):
        with pytest.raises(ConfigurationError, match="-200% to 200%"):
            ppo.to_word(share)


def test_bits_of_the_control_and_status_words() -> None:
    control, status = ppo.ControlWord, ppo.StatusWord
    assert [flag.value.bit_length() - 1 for flag in control] == list(range(11))
    assert [flag.value.bit_length() - 1 for flag in status] == list(range(11))
    assert (control.ENABLE_OPERATION, control.FAULT_RESET, control.JOG_1, control.CONTROL) == (1 << 3, 1 << 7, 1 << 8, 1 << 10)
    assert (status.OPERATION_ENABLED, status.FAULT, status.ALARM, status.CONTROL) == (1 << 2, 1 << 3, 1 << 7, 1 << 9)


# -- PKW: the octets ---------------------------------------------------------------------------------------------------

EXAMPLES = [  # SI-P3 manual, the command settings and responses printed in chapter 8
    ("6384 0005 00000000", Message(Task.REQUEST_ELEMENT, 900, 5)),
    ("4384 0005 00000000", Message(Response.ELEMENT, 900, 5)),
    ("638b 0005 00000000", Message(6, 907, 5)),
    ("438b 0005 00000000", Message(4, 907, 5)),
    ("1388 0000 00000001", Message(Response.WORD, 904, 0, 1)),
    ("701f 0001 0000000a", Message(Task.CHANGE_ELEMENT, 31, 1, 10)),
    ("6029 0011 00000000", Message(6, 41, 17)),
    ("4029 0011 00000258", Message(4, 41, 17, 600)),
    ("212c 0000 00000000", Message(Task.CHANGE, 300)),
    ("112c 0000 00000000", Message(Response.WORD, 300)),
    ("3808 0000 12345678", Message(Task.CHANGE_DOUBLE, 8, 0, 0x12345678, spm=True)),
]


@pytest.mark.parametrize(("octets", "message"), EXAMPLES)
def test_messages(octets: str, message: Message) -> None:
    assert message.encode() == bytes.fromhex(octets)
    assert Message.decode(bytes.fromhex(octets)) == message


def test_a_sub_index_of_one_byte_is_the_high_octet_of_ind() -> None:
    """Protocol page L: "PROFIBUS puts the subindex in the HIGH byte of IND (octet 3 of PKW)"; the other is reserved."""
    assert Message(6, 41, 17).encode("byte") == bytes.fromhex("6029 1100 00000000")
    assert Message.decode(bytes.fromhex("6029 11ff 00000000"), "byte") == Message(6, 41, 17)


def test_octets_that_are_missing_count_as_no_task() -> None:
    assert Message.decode(b"") == Message(Task.NONE)


@pytest.mark.parametrize(("message", "text"), [
    (Message(16), "identifier 16: 0 to 15"), (Message(1, 2048), "pnu 2048: 0 to 2047"),
    (Message(6, 1, 256), "index 256: 0 to 255 with a sub-index of one byte"), (Message(2, 1, 0, -1), "value -1"),
    (Message(3, 1, 0, 1 << 32), "value 4294967296")])
def test_what_does_not_fit_is_an_error(message: Message, text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        message.encode("byte")


@pytest.mark.parametrize(("task", "good"), [
    (0, "0"), (1, "12"), (2, "1"), (3, "2"), (4, "3"), (6, "45"), (7, "4"), (8, "5"), (9, "6")])
def test_which_response_answers_which_task(task: int, good: str) -> None:
    """Protocol page L: "Allowed pairs: 1->1/2; 2->1; 3->2; 4->3; 6->4/5; 7->4; 8->5; 9->6; each ->7 or 8"."""
    request = Message(task, 31, 1)
    found = [str(n) for n in range(16) if Message(n, 31, 1).answers(request)]
    assert found == [*good, "7", "8"]
    assert not any(Message(n, 31, 2).answers(request) or Message(n, 32, 1).answers(request) for n in range(16))


# -- PKW: the slave's end ----------------------------------------------------------------------------------------------


class Device:
    """PNU 5 a word, 6 a double word, 7 an array of 3 words whose last is a double word."""

    def __init__(self) -> None:
        self.values = {(5, 0): Value(50), (6, 0): Value(60_000_000, True), (7, 0): Value(70), (7, 1): Value(71),
                       (7, 2): Value(72, True)}

    def elements(self, pnu: int) -> int | None:
        if pnu not in (5, 6, 7):
            raise Refusal(Error.PNU)
        return 3 if pnu == 7 else None

    def read(self, pnu: int, index: int) -> Value:
        if (pnu, index) not in self.values:
            raise Refusal(Error.INDEX)
        return self.values[pnu, index]

    def write(self, pnu: int, index: int, value: Value) -> None:
        if value.double != self.read(pnu, index).double:
            raise Refusal(Error.TYPE)
        self.values[pnu, index] = value


@pytest.mark.parametrize(("request_", "response"), [
    ("0123 0004 00000005", "0000 0000 00000000"),  # no task, no response
    ("1005 0000 00000000", "1005 0000 00000032"), ("1006 0000 00000000", "2006 0000 03938700"),
    ("6007 0001 00000000", "4007 0001 00000047"), ("6007 0002 00000000", "5007 0002 00000048"),
    ("9007 0000 00000000", "6007 0000 00000003"),
    ("2005 0000 00001234", "1005 0000 00000000"), ("3006 0000 12345678", "2006 0000 00000000"),
    ("7007 0001 0000ffff", "4007 0001 00000000"), ("8007 0002 ffffffff", "5007 0002 00000000"),
    ("1008 0000 00000000", "7008 0000 00000000"),  # 0 illegal PNU
    ("2005 0000 00010000", "7005 0000 00000002"),  # 2 limit: no word
    ("6007 0003 00000000", "7007 0003 00000003"), ("1005 0001 00000000", "7005 0001 00000003"),  # 3 sub-index
    ("6005 0000 00000000", "7005 0000 00000004"), ("9005 0000 00000000", "7005 0000 00000004"),  # 4 no array
    ("1007 0001 00000000", "7007 0001 00000005"), ("3005 0000 00000001", "7005 0000 00000005"),  # 5 wrong type
    ("4005 0000 00000000", "7005 0000 0000006a"), ("f005 0000 00000000", "7005 0000 0000006a")])  # 106 not implemented
def test_tasks_and_their_responses(request_: str, response: str) -> None:
    device = Device()
    before = dict(device.values)
    request = Message.decode(bytes.fromhex(request_))
    assert serve(request, device).encode() == bytes.fromhex(response)
    changed = {key: value for key, value in device.values.items() if value != before[key]}
    wanted = {(request.pnu, request.index): request.value} if request.identifier in pkw.CHANGES and response[0] != "7" else {}
    assert {key: value.value for key, value in changed.items()} == wanted


def test_a_maker_with_a_short_list_of_errors() -> None:
    assert serve(Message(6, 5), Device(), {Error.NO_ARRAY: Error.INDEX}).error == 3
    assert serve(Message(1, 5), Device()).error is None


def test_a_standing_task_is_carried_out_once_and_its_response_stays() -> None:
    seen: list[Message] = []
    responder = Responder(lambda request: seen.append(request) or serve(request, Device()), lambda: 0.010)
    read = Message(1, 5).encode()
    responder.see(read, 1.0)
    responder.see(Message(1, 6).encode(), 1.005)  # not looked at while busy
    assert (responder.octets, responder.due) == (bytes(8), 1.010)
    responder.advance(1.010)
    assert responder.octets == Message(1, 5, 0, 50).encode() and responder.due == math.inf
    for now in (1.011, 9.0):
        responder.see(read, now)
    assert seen == [Message(1, 5)] and responder.octets == Message(1, 5, 0, 50).encode()
    responder.see(bytes(8), 9.1)
    assert responder.octets == bytes(8)  # response 0 at once: the same task again is a new one now
    responder.see(read, 9.2)
    assert responder.due == pytest.approx(9.210)


# -- PKW: both ends ----------------------------------------------------------------------------------------------------


class Bus:
    """Both ends with a bus between: what one puts the other sees up to `lag` cycles of 1 ms later."""

    def __init__(self, seed: int, index_size: pkw.IndexSize = "word") -> None:
        self.chance = random.Random(seed)
        self.device = Device()
        self.requester = Requester(index_size, settle=0.030)
        self.carried_out: list[Message] = []
        self.responder = Responder(self.carry_out, lambda: self.chance.uniform(0.0, 0.020), index_size)
        self.now = 0.0
        self.outputs = [bytes(8)] * 3
        self.inputs = [bytes(8)] * 3

    def carry_out(self, request: Message) -> Message:
        if request.identifier != Task.NONE:
            self.carried_out.append(request)
        return serve(request, self.device)

    def cycle(self) -> bytes:
        self.now += 0.001
        if self.responder.due <= self.now:
            self.responder.advance(self.responder.due)
        self.outputs = [self.requester.octets, *self.outputs[:2]]
        self.inputs = [self.responder.octets, *self.inputs[:2]]
        self.responder.see(self.outputs[self.chance.randrange(2)], self.now)
        return self.inputs[self.chance.randrange(2)]

    def request(self, request: Message, cycles: int = 200) -> Message | None:
        self.requester.start(request)
        for _ in range(cycles):
            self.requester.see(self.cycle(), self.now)
            if not self.requester.busy:
                return self.requester.answer
        self.requester.give_up()
        return None


@pytest.mark.parametrize("seed", range(20))
def test_no_answer_is_taken_for_anothers_whatever_is_given_up(seed: int) -> None:
    """Reads and writes of one parameter answer alike but for the value; some are given up in the middle."""
    bus = Bus(seed, ("word", "byte")[seed % 2])
    for n in range(150):
        patience = bus.chance.choice([3, 8, 15, 200])
        if n % 3:
            before = bus.device.values[5, 0].value
            answer = bus.request(Message(Task.REQUEST, 5), patience)
            assert answer in (None, Message(Response.WORD, 5, 0, before)), f"seed {seed}, request {n}"
        else:
            value = bus.chance.randrange(1, 0x10000)
            answer = bus.request(Message(Task.CHANGE, 5, 0, value), patience)
            assert answer in (None, Message(Response.WORD, 5)), f"seed {seed}, request {n}"
            if answer:
                assert bus.device.values[5, 0].value == value
            else:  # it may still be carried out: the next request waits for that
                bus.request(Message(Task.REQUEST, 6))
        assert answer or patience < 200, f"seed {seed}, request {n}: the channel is stuck"


def test_each_request_is_carried_out_once() -> None:
    bus = Bus(1)
    wanted = [Message(Task.CHANGE_ELEMENT, 7, 1, 9)] * 5
    assert [bus.request(message) for message in wanted] == [Message(Response.ELEMENT, 7, 1)] * 5
    assert bus.carried_out == wanted


def test_a_request_that_does_not_fit_changes_nothing() -> None:
    requester = Requester("byte")
    with pytest.raises(ConfigurationError, match="sub-index of one byte"):
        requester.start(Message(6, 0, 0x200))
    assert not requester.busy and requester.octets == bytes(8)
