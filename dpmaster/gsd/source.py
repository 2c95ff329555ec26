# SPDX-License-Identifier: MIT
"""A GSD file's octets as text, and the text as statements with their places; what was odd about it as findings.

Knows the syntax and not one keyword. Never raises for what a file contains, and looks at every character a bounded number of
times: patterns take what they match for good (possessive) and stop where the next attempt would begin. Touches nothing else.
"""

from __future__ import annotations

import bisect
import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum

FINDINGS_MAX = 1000  # a file of junk has one for each line; the rest is only counted


class Severity(StrEnum):
    """What a finding means for who uses the file."""

    ERROR = "error"
    """Broken: something is lost or contradicts itself."""
    WARNING = "warning"
    """Not as the specification has it; what is meant is clear, or a guess that the text names."""
    NOTE = "note"
    """In order, and worth knowing: a keyword that only its maker knows."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something odd in a GSD file. `line` and `column` count from 1; both are 0 when it is about the file as a whole."""

    line: int
    column: int
    severity: Severity
    text: str

    def __str__(self) -> str:
        return f"{self.line}:{self.column}: {self.severity}: {self.text}" if self.line else f"{self.severity}: {self.text}"


# ---- octets to text

_BOMS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
# A letter with an accent stands beside letters: in cp437 such letters are 80h to A5h and E1h (sharp s), in cp1252 C0h to FFh.
_CP437 = re.compile(rb"[A-Za-z][\x80-\xa5\xe1]|[\x80-\xa5\xe1][A-Za-z]")
_CP1252 = re.compile(rb"[A-Za-z][\xc0-\xff]|[\xc0-\xff][A-Za-z]")


def decode(octets: bytes, encoding: str | None = None) -> tuple[str, str]:
    """The text and the encoding it was read as: the one given, that of a byte order mark, UTF-8, else cp437 or cp1252 by the
    letters that come out. Octets an encoding does not have become U+FFFD, or in cp1252 what Latin-1 has there."""
    for mark, name in _BOMS:
        if octets.startswith(mark) and encoding in (None, name):
            return octets[len(mark):].decode(name, "replace"), name
    if encoding is not None:
        return octets.decode(encoding, "replace"), encoding
    try:
        return octets.decode("utf-8"), "ascii" if octets.isascii() else "utf-8"
    except UnicodeDecodeError:
        pass
    if len(_CP437.findall(octets)) > len(_CP1252.findall(octets)):
        return octets.decode("cp437"), "cp437"
    try:
        return octets.decode("cp1252"), "cp1252"
    except UnicodeDecodeError:
        return octets.decode("latin-1"), "latin-1"


# ---- text to statements

# (kind, text, where it begins): "text" without its quotes, "number", "word" or "mark", which is one character
Token = tuple[str, str, int]

_START = re.compile(r"^[^\S\n]*+\ufeff?[^\S\n]*+#[^\S\n]*+profibus[_ ]?dp[^\n]*+", re.IGNORECASE | re.MULTILINE)
_CONTINUED = re.compile(r"\\[ \t]*+(?:;[^\"\\\n]*+)?+\n")
_TOKEN = re.compile(r"""
    (?:[^\S\n]|[\0\x1a\ufeff])++                      # blanks; ^Z ends a file of DOS
  | ;[^\n]*+                                          # a comment
  | \\[ \t]*+(?:;[^\n]*+)?+(?:\n|\Z)                  # the statement goes on in the next line
  | (?P<end>\n)
  | (?P<text>"(?:[^"\\\n]++|\\[ \t]*+(?:;[^"\\\n]*+)?+\n|\\)*+"?+)
  | (?P<number>(?:0[xX][0-9A-Fa-f]++|[0-9]++)(?![\w.!@]))
  | (?P<word>[^\s=,()";\\\-]++)
  | (?P<mark>.)
""", re.VERBOSE)


@dataclass(slots=True)
class Statement:
    """``keyword(index) = values``, as it stands in the file. A line of values alone has an empty keyword."""

    keyword: str
    index: int | None
    last: int | None
    """The second number of an index that is a range."""
    values: list[Token]
    raw: str
    """Everything behind the keyword, index and ``=``."""
    offset: int
    equals: bool


@dataclass(slots=True)
class Source:
    """The text of one file, its findings, and the statements of its #Profibus_DP section."""

    text: str
    findings: list[Finding] = field(default_factory=list)
    errors: int = 0
    dropped: int = 0
    """Findings over `FINDINGS_MAX`."""
    _lines: list[int] | None = None

    def __post_init__(self) -> None:
        self.text = self.text.replace("\r\r\n", "\n").replace("\r\n", "\n").replace("\r", "\n")

    def place(self, offset: int) -> tuple[int, int]:
        """Line and column, from 1."""
        if self._lines is None:
            self._lines = [0, *(found.end() for found in re.finditer("\n", self.text))]
        line = bisect.bisect_right(self._lines, offset)
        return line, offset - self._lines[line - 1] + 1

    def note(self, severity: Severity, offset: int | None, text: str) -> None:
        """Add a finding; offset None is for the file as a whole. Errors have room of their own."""
        self.errors += severity is Severity.ERROR
        if len(self.findings) >= FINDINGS_MAX and (severity is not Severity.ERROR or self.errors > FINDINGS_MAX):
            self.dropped += 1
        else:
            self.findings.append(Finding(*((0, 0) if offset is None else self.place(offset)), severity, text))

    def sorted(self) -> list[Finding]:
        """The findings in the order of the file, those about the whole of it behind them."""
        if self.dropped:
            self.findings.append(Finding(0, 0, Severity.NOTE, f"and {self.dropped} findings more"))
        return sorted(self.findings, key=lambda finding: (not finding.line, finding.line, finding.column))

    def section(self) -> tuple[int, int]:
        """Where the #Profibus_DP section begins and ends."""
        start = _START.search(self.text)
        if start is None:
            self.note(Severity.ERROR, None, "no line #Profibus_DP: the file is read from its beginning")
            return 0, len(self.text)
        end = self.text.find("\n#", start.end())
        if end < 0:
            return start.end(), len(self.text)
        name = self.text[end + 2 : end + 42].split("\n")[0].strip()
        self.note(Severity.NOTE, end + 1, f"the section ends here; #{name} is not read")
        return start.end(), end + 1

    def statements(self) -> Iterator[Statement]:
        start, end = self.section()
        line: list[Token] = []
        for found in _TOKEN.finditer(self.text, start, end):
            kind = found.lastgroup
            if kind is None:
                continue
            if kind != "end":
                line.append((kind, self._unquoted(found) if kind == "text" else found.group(), found.start()))
            elif line:
                yield self._statement(line)
                line = []
        if line:
            yield self._statement(line)

    def _unquoted(self, found: re.Match[str]) -> str:
        text = found.group()
        if len(text) < 2 or text[-1] != '"':
            self.note(Severity.ERROR, found.start(), "the text has no closing quote: it is taken to end with its line")
            text += '"'
        return _CONTINUED.sub("", text[1:-1])

    def _statement(self, line: list[Token]) -> Statement:
        words = 0
        while words < len(line) and line[words][0] == "word":
            words += 1
        if words > 1 and (words == len(line) or line[words][1] not in "=("):
            words = 1  # not a keyword of several words, but a word with values
        keyword = " ".join(token[1] for token in line[:words])
        at, index, last = self._index(line, words) if words else (0, None, None)
        equals = words > 0 and at < len(line) and line[at][:2] == ("mark", "=")
        values = line[at + equals :]
        return Statement(keyword, index, last, values, self._raw(values), line[0][2], equals)

    def _raw(self, values: list[Token]) -> str:
        if not values:
            return ""
        kind, text, start = values[-1]
        if kind == "text":
            return self.text[values[0][2] : start] + f'"{text}"'
        return self.text[values[0][2] : start + len(text)]

    def _index(self, line: list[Token], at: int) -> tuple[int, int | None, int | None]:
        """What stands in brackets behind the keyword, and the token behind it."""
        if at >= len(line) or line[at][:2] != ("mark", "("):
            return at, None, None
        close = next((i for i in range(at + 1, min(at + 6, len(line))) if line[i][1] == ")"), None)
        inside = line[at + 1 : close]
        sign = -1 if inside and inside[0][1] == "-" else 1
        kinds = [token[0] for token in inside[sign < 0 :]]
        if close is not None and kinds in (["number"], ["number", "mark", "number"]):
            return close + 1, sign * number(inside[sign < 0][1]), number(inside[-1][1]) if len(kinds) > 1 else None
        self.note(Severity.ERROR, line[at][2], "an index is a number in brackets, or two with - between them")
        return (at + 1 if close is None else close + 1), None, None


def number(text: str) -> int:
    """Decimal, also with leading zeros, or hexadecimal with 0x. Of a number without end only what no field could hold."""
    if text[:2] in ("0x", "0X"):
        return int(text[2:19], 16)
    return int(text) if len(text) < 20 else 10**20
