# SPDX-License-Identifier: MIT
"""A Yaskawa card on virtual time with the slave before it reduced to what the card sees of it: octets in, octets out."""

from __future__ import annotations

from typing import Any

from dpmaster.emulator.card import Card, Exchange, SlaveState


class CardHost:
    """The card in exchange in its configuration number `index` of `size` octets, its CPU up."""

    def __init__(self, card: Card, index: int, size: int) -> None:
        self.card: Any = card
        self.index, self.size = index, size
        self.outputs = bytearray(size)
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

    def drive(self, command: int, hz: float | None = None) -> bytes:
        """The command word, and the frequency reference in 0.01 Hz."""
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
