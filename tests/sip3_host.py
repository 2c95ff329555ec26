# SPDX-License-Identifier: MIT
"""An emulated SI-P3 on virtual time, in the configuration of a name, with the words of a PPO and PKW tasks."""

from __future__ import annotations

from typing import Any

from card_host import CardHost

from dpmaster.emulator.cards import SIP3
from dpmaster.profiles import yaskawa_1000 as profile

HALT, RUN, REVERSE_JOG, JOG, RESET = 0x0408, 0x0418, 0x0608, 0x0508, 0x0488
"""STW as octets on the wire: bit 10 control from PROFIBUS, 3 enable, 4 run, 8 and 9 jog, 7 fault reset."""


class Host(CardHost):
    """A card in exchange in the configuration of that name."""

    def __init__(self, configuration: str = "PPO Type 2", **arguments: Any) -> None:
        card = SIP3(5, **arguments)
        module = profile.configuration(configuration)
        self.pzd = module.ppo.pzd if isinstance(module, profile.PPOModule) else 0
        super().__init__(card, card.configurations.index(module.identifier), module.size)

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
