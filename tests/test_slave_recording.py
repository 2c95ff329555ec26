# SPDX-License-Identifier: MIT
"""A real bus replayed: an S7's cold start, scan, start-up and exchange, answered octet for octet as the real slave did."""

from __future__ import annotations

from recordings import CHARACTER, S7, recorded
from slave_rig import DATA_EXCH, MS, Rig, SlaveConfig, octets


def test_an_s7_and_the_slave_it_knows() -> None:
    """Address 26, ident 0B0D; 52 octets of inputs, 14 of outputs (Chk_Cfg 13 25 1f 1f 1f 27)."""
    lines = recorded(S7)
    rig = Rig((SlaveConfig(26, 0x0B0D, (octets("13 25 1f 1f 1f 27"),), user_parameters=(3, 20)),),
              changes={"rate_num": 9600, "max_tsdr": 60, "tsl": 100}, time=0)
    answered = 0
    for line, following in zip(lines, [*lines[1:], lines[-1]], strict=True):
        if line.slave:
            continue
        if following.slave and following.octets[:4] == octets("68 37 37 68"):
            rig.put_inputs(following.octets[7:-2])  # what the real slave had to tell
        rig.quiet(line.start - 1)
        rig.hear(line.octets, line.end, spacing=CHARACTER)
        offer = rig.ask(line.end)
        assert offer.octets == (following.octets if following.slave else b""), f"to {line.octets.hex(' ')} at {line.start} ns"
        if offer.octets:
            assert offer.not_before <= following.start + MS // 10 <= offer.not_after  # the recording's clock is that coarse
            rig.sent(offer, following.start)
            answered += 1
        # What was written is what the terminals show from this telegram on.
        if offer.octets[:1] == b"\x68" and line.octets[4:6] == octets("1a 02"):
            assert rig.outputs().octets == line.octets[7:-2]
    report = rig.report()
    assert (report.state, report.watchdog_expired, report.late_dropped) == (DATA_EXCH, 0, 0)
    assert report.exchanges > 100
    assert answered == report.answers == sum(line.slave for line in lines)
