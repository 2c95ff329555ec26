# SPDX-License-Identifier: MIT
"""A slow decoder and a slow receiver, written from the rules and not from the C: what the fast ones are compared with.

The C decoder walks the octets in order. This one asks two questions instead: what would the whole telegram look like if
everything that is missing were as good as it can be, and which rules does that whole telegram break?
It must stay independent: it imports nothing of the package.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

SD1, SD2, SD3, SD4, SC, ED = 0x10, 0x68, 0xA2, 0xDC, 0xE5, 0x16


def total(octets: bytes) -> int:
    """FCS."""
    return sum(octets) % 256


def sides(da: int, sa: int, behind: bytes) -> tuple[list[list[int]], int] | None:
    """The extension octets of DA's and SA's side and how many there are together; None when they break a rule."""
    rest = list(behind)
    found: list[list[int]] = [[], []]
    for side, address in zip(found, (da, sa), strict=True):
        more = address >= 128
        while more:
            if not rest:
                return None
            side.append(rest.pop(0))
            more = side[-1] >= 128
        kinds = ["segment" if octet & 64 else "sap" for octet in side]
        if kinds not in ([], ["sap"], ["segment"], ["segment", "sap"]):
            return None
    return found, len(behind) - len(rest)


def whole(octets: bytes) -> bytes | None:
    """`octets` and the best that could follow, up to the telegram's end and not beyond; None when SD or LE forbid it."""
    first = octets[:1]
    if first == bytes([SC]):
        return first
    if first == bytes([SD4]):
        return octets[:3].ljust(3, b"\0")
    if first == bytes([SD2]):
        le = octets[1] if len(octets) > 1 else 11
        head = octets[:4] + bytes([SD2, le, le, SD2])[len(octets[:4]):]
    elif first in (bytes([SD1]), bytes([SD3])):
        head, le = first, 3 if first[0] == SD1 else 11
    else:
        return None
    body = octets[len(head) : len(head) + le].ljust(le, b"\0")
    tail = octets[len(head) + le : len(head) + le + 2]
    return head + body + tail + bytes([total(body), ED])[len(tail):]


def faults(telegram: bytes) -> set[str]:
    """The rules that a whole telegram breaks, all of them."""
    sd = telegram[0]
    if sd == SC:
        return set()
    if sd == SD4:
        return {"address"} if max(telegram[1:3]) > 125 else set()
    found = set()
    start = 1
    if sd == SD2:
        start = 4
        if not 3 <= telegram[1] <= 249:
            return {"length"}
        if telegram[1] != telegram[2]:
            found.add("length twice")
        if telegram[3] != SD2:
            found.add("second delimiter")
    body, fcs, end = telegram[start:-2], telegram[-2], telegram[-1]
    if body[1] in (127, 255):
        found.add("address")
    if sides(body[0], body[1], body[3:]) is None:
        found.add("extension")
    if fcs != total(body):
        found.add("FCS")
    if end != ED:
        found.add("end delimiter")
    return found


def verdict(octets: bytes) -> int | set[str]:
    """What begins at octets[0]: its length when good, 0 when more octets could make it good, else the rules broken."""
    if not octets:
        return 0
    if octets[0] not in (SD1, SD2, SD3, SD4, SC):
        return {"delimiter"}
    if octets[0] == SD2 and len(octets) > 1 and not 3 <= octets[1] <= 249:
        return {"length"}
    telegram = whole(octets)
    assert telegram is not None
    return faults(telegram) or (len(telegram) if len(telegram) <= len(octets) else 0)


def build(sd: int, da: int, sa: int, fc: int = 0, behind: bytes = b"") -> bytes:
    """A telegram from its raw octets; DA and SA with their extension bits, `behind` with the extension octets."""
    if sd == SC:
        return bytes([SC])
    if sd == SD4:
        return bytes([SD4, da, sa])
    body = bytes([da, sa, fc]) + behind
    head = bytes([SD2, len(body), len(body), SD2]) if sd == SD2 else bytes([sd])
    return head + body + bytes([total(body), ED])


@dataclass
class Line:
    """What a receiver is told, octet by octet: value, line error, the interval its end lies in, and silences."""

    octets: list[int] = field(default_factory=list)
    errors: list[int] = field(default_factory=list)
    earliest: list[int] = field(default_factory=list)
    latest: list[int] = field(default_factory=list)
    silences: dict[int, int] = field(default_factory=dict)  # after so many octets: nothing unread up to this time


@dataclass
class Found:
    telegrams: list[tuple[int, int]] = field(default_factory=list)  # first octet, octets
    rejected: Counter[str] = field(default_factory=Counter)
    pending: int = 0


def stretches(line: Line, character: int, patience: int, gap: int) -> list[tuple[int, int, str]]:
    """Where nothing can span: (first octet, end, why it ends there; "" at the end of the line)."""
    found = []
    first = 0
    end = len(line.octets)
    for at in range(1, end + 1):
        if at in line.silences and line.silences[at] >= line.latest[at - 1] + patience:
            why = "incomplete"
        elif any(line.errors[at - 1 : at + 1]):
            why = "line error"  # an octet with an error stands alone
        elif at < end and gap and line.earliest[at] - character - line.latest[at - 1] > gap:
            why = "gap"
        else:
            continue
        found.append((first, at, why))
        first = at
    return [*found, (first, end, "")]


def receive(line: Line, character: int, patience: int, gap: int) -> Found:
    """Every good telegram that a receiver must find, and no other."""
    found = Found()
    for first, end, why in stretches(line, character, patience, gap):
        broken = ""  # a barrier has broken the telegram that begins here or before
        while first < end:
            if line.errors[first]:
                found.rejected["line error"] += 1
                first += 1
                continue
            judged = verdict(bytes(line.octets[first:end]))
            if isinstance(judged, int) and judged > 0:
                found.telegrams.append((first, judged))
                first += judged
                broken = ""
                continue
            if judged == 0 and not why:
                found.pending = end - first
                break
            if judged == 0:
                broken = why
            found.rejected[broken or "proved bad"] += 1
            first += 1
    return found
