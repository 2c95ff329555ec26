# SPDX-License-Identifier: MIT
"""An emulated SI-P3 on virtual time with the slave before it reduced to what the card sees of it: octets in, octets out."""

from __future__ import annotations

from typing import Any

from dpmaster.emulator.card import Exchange, SlaveState
from dpmaster.emulator.cards import SIP3
from dpmaster.profiles import yaskawa_1000 as profile

HALT, RUN, REVERSE_JOG, JOG, RESET = 0x0408, 0x0418, 0x0608, 0x0508, 0x0488
"""STW as octets on the wire: bit 10 control from PROFIBUS, 3 enable, 4 run, 8 and 9 jog, 7 fault reset."""


class Host:
    """A card in exchange in the configuration of that name, its CPU up."""

    def __init__(self, configuration: str = "PPO Type 2", **arguments: Any) -> None:
        self.card = SIP3(5, **arguments)
        module = profile.configuration(configuration)
        self.index = self.card.configurations.index(module.identifier)
        self.size = module.size
        self.pzd = module.ppo.pzd if isinstance(module, profile.PPOModule) else 0
        self.outputs = bytearray(self.size)
        self.now = 0.0
        self.state = SlaveState.DATA_EXCH
        self.valid = True
        self.expired = 0
        self.baudrate = 1_500_000
        self.inputs = b""
        self.card.step(0.0, Exchange())
        self.after(0.5)

    def step(self) -> bytes:
        exchanging = self.state is SlaveState.DATA_EXCH
        self.inputs = self.card.step(self.now, Exchange(
            self.state, bytes(self.outputs), self.valid and exchanging, 1, self.index if exchanging else -1, 1,
            self.expired, baudrate=self.baudrate))
        return self.inputs

    def after(self, seconds: float) -> bytes:
        """Let time pass, stepping the card whenever it asks for it; the inputs of the end."""
        self.step()
        end = self.now + seconds
        while (wanted := self.card.next_step(self.now)) < end:
            assert wanted > self.now
            self.now = wanted
            self.step()
        self.now = end
        return self.step()

    def put(self, offset: int, *words: int) -> bytes:
        for n, word in enumerate(words):
            self.outputs[offset + 2 * n:offset + 2 * n + 2] = (word & 0xFFFF).to_bytes(2, "big")
        return self.step()

    def word(self, offset: int) -> int:
        return int.from_bytes(self.step()[offset:offset + 2], "big")

    # -- PPO

    def command(self, stw: int, share: float | None = None) -> bytes:
        """STW, and HSW as a share of E1-04."""
        if share is not None:
            self.put(self.pzd + 2, round(share * 10_000))
        return self.put(self.pzd, stw)

    def task(self, octets: str) -> str:
        """One PKW task after a task 0: the response in hex, PKE, IND and PWE apart."""
        self.outputs[0:8] = bytes(8)
        assert self.after(0.001)[0:8] == bytes(8)
        self.outputs[0:8] = bytes.fromhex(octets)
        answer = self.after(0.020)[0:8].hex()
        return f"{answer[:4]} {answer[4:8]} {answer[8:]}"

    # -- conventional

    def drive(self, command: int, hz: float | None = None) -> bytes:
        """Operation command, and the frequency reference."""
        if hz is not None:
            self.put(2, round(hz * 100))
        return self.put(0, command)

    def access(self, message: str) -> str:
        """One MEMOBUS message: hex of function, address, length, data; the answer's likewise."""
        where, words, handshake = (16, 12, 31) if self.size == 32 else (4, 6, 11)
        self.outputs[where:where + words] = bytes.fromhex(message).ljust(words, b"\0")
        self.step()
        self.outputs[handshake] ^= 0x80
        inputs = self.after(0.020)
        assert inputs[handshake] & 0xE1 == self.outputs[handshake] | 0x60
        return inputs[where:where + words].hex()
