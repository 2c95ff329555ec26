# SPDX-License-Identifier: MIT
"""Appendix B of the V7 PROFIBUS-DP Option manual, TM.V7.12: the four tables, row by row, for every test that pins them.

A row is (command, response), each "message handshake" in hex: function code, starting address MSB and LSB, data quantity,
data 1 MSB and LSB; then the handshaking octet with WD masked (AND E1h). Rows that say "ignore all response message data"
have no message. Where the printed binary and hex disagree the hex is right; STATUS 00, 01, 10, 11 are bits 6 and 5.
"""

from __future__ import annotations

ROWS = (
    "Initialize Data Structures",
    "Set PROFIBUS-DP Master Command Message",
    "Toggle the PROFIBUS-DP Master Handshake Bit",
    "Wait for Response (sent to the drive)",
    "Wait for Response (the drive processes it)",
    "Process Response",
)

Table = list[tuple[str, str]]

B2_READ: Table = [
    ("000000000000 80", "030100020000 e0"),
    ("030037020000 80", "030100020000 e0"),
    ("030037020000 00", " 00"),
    ("030037020000 00", " 20"),
    ("030037020000 00", " 40"),
    ("030037020000 00", "030037020015 60"),  # the manual's text has lost this row's handshake
]
B3_READ_ERROR: Table = [
    ("000000000000 00", "030100020000 60"),
    ("031000020000 00", "030100020000 60"),
    ("031000020000 80", " 80"),
    ("031000020000 80", " a0"),
    ("031000020000 80", " c0"),
    ("031000020000 80", "830000020002 e0"),
]
B4_WRITE: Table = [
    ("000000000000 00", "030100020000 60"),
    ("100105020001 00", "030100020000 60"),  # the printed response handshake 00 cannot be: the old answer stands
    ("100105020001 80", " 80"),
    ("100105020001 80", " a0"),
    ("100105020001 80", " c0"),
    ("100105020001 80", "100105020000 e0"),
]
B5_WRITE_ERROR: Table = [
    ("000000000000 80", "030037020000 e0"),  # the response is that of the printed second row: the old answer stands
    ("101000020001 80", "030037020000 e0"),
    ("101000020001 00", " 00"),
    ("101000020001 00", " 20"),
    ("101000020001 00", " 40"),
    ("101000020001 00", "900000020002 60"),
]


def by_row(table: Table) -> list[tuple[str, str, str]]:
    """The table with the manual's name of each row, so that a difference names it."""
    return [(ROWS[i] if i < len(ROWS) else "no such row", *row) for i, row in enumerate(table)]
