# SPDX-License-Identifier: MIT
"""A GSD file as a program meets it: loaded, looked at, configured. The only file of this room that opens files."""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from dpmaster.errors import ConfigurationError
from dpmaster.gsd.check import check
from dpmaster.gsd.configuration import Chosen, Configuration, configure, default_modules
from dpmaster.gsd.model import LANGUAGES, Device, Module
from dpmaster.gsd.reader import Reader
from dpmaster.gsd.source import Severity, Source, decode
from dpmaster.gsd.texts import Texts

SIZE_MAX = 64 << 20  # octets; real files are under one megabyte


class GSD(Device):
    """A device's description by its maker.

    Whatever the file contains, it is read: what is wrong or odd is in `findings`. Only `strict` makes an error of the first
    finding that is one.
    """

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, encoding: str | None = None, strict: bool = False) -> GSD:
        """Read a file. encoding: its code page, when what it says or is guessed by (`encoding`) is wrong.

        Raises ConfigurationError when there is no such file, or it can not be read, or `strict` and it is broken.
        """
        name = os.fspath(path)
        try:
            if not os.path.isfile(name) and os.path.exists(name):
                raise ConfigurationError(f"{name} is no file: give the path of a GSD file")
            with open(name, "rb") as file:
                octets = file.read(SIZE_MAX + 1)
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise ConfigurationError(f"{name!r}: {why}: give the path of a GSD file") from None
        if len(octets) > SIZE_MAX:
            raise ConfigurationError(f"{name} has more than {SIZE_MAX >> 20} MB: that is no GSD file")
        return cls._read(octets, name, encoding, strict)

    @classmethod
    def parse(cls, text: str | bytes, *, encoding: str | None = None, strict: bool = False) -> GSD:
        """Read what a file contains, as text or as its octets."""
        return cls._read(text, "", encoding, strict)

    def configure(self, modules: Iterable[Chosen] | None = None, parameters: Mapping[Any, Any] | None = None, *,
                  names: Mapping[str, int] | None = None, dpv1: bool | None = None, fail_safe: bool | None = None,
                  alarms: Iterable[str] = ()) -> Configuration:
        """The station with these modules and parameters, checked against the file's limits.

        modules: names, Module_References or `Module` objects in the order of the slots, or pairs of a slot and one of these.
        Slots count from 1, or from the first one of SlotDefinition; slots in between, and behind them those defined, hold their
        default. Modules that FixPresetModules makes part of the station need not be named. None: `default_modules`.

        parameters: settings by name; those of a module in a mapping by its slot or name:
        ``{"Redundancy mode": "on", 2: {"Filter": "50 Hz"}}``. names: a name of one's own for a slot, ``{"Drive": 1}``.

        dpv1: set DPV1_Enable; None: when the slave has MS1 (C1_Read_Write_supp). fail_safe: as for `Station`; None: as the file
        says. alarms: those to enable besides the required ones, "pull_plug", "process", "diagnostic", "manufacturer", "status",
        "update".

        Raises ConfigurationError that names what is wrong and what is allowed.
        """
        return configure(self, modules, parameters, names, dpv1=dpv1, fail_safe=fail_safe, alarms=alarms)

    @property
    def texts(self) -> Texts:
        """For `Diagnosis.explain`: the maker's words; those of a `Configuration` know the modules too."""
        return Texts(self)

    def default_modules(self) -> list[Module]:
        """What the file settles by itself: preset modules, or its only one; [] when its slots have defaults. Else, and that is
        a guess, the first module that has data."""
        return default_modules(self)

    @classmethod
    def _read(cls, content: str | bytes, path: str, encoding: str | None, strict: bool) -> GSD:
        gsd = cls(path=path)
        if isinstance(content, str):
            text = content.removeprefix("\ufeff")
        else:
            try:
                text, gsd.encoding = decode(bytes(content), encoding and codecs.lookup(encoding).name)
            except (LookupError, TypeError, ValueError):
                raise ConfigurationError(f"encoding {encoding!r}: a code page that Python knows, like 'cp1252'") from None
        source = Source(text)
        lost = text.find("\ufffd")
        if lost >= 0:
            source.note(Severity.WARNING, lost, "characters were lost (U+FFFD): saved in another code page, or read as one")
        reader = Reader(gsd, source)
        reader.read()
        check(gsd, reader)
        gsd.findings = source.sorted()
        broken = next((finding for finding in gsd.findings if finding.severity is Severity.ERROR), None)
        if strict and broken is not None:
            raise ConfigurationError(f"{path or 'GSD'}:{broken}")
        return gsd


def variants(path: str | os.PathLike[str]) -> dict[str, Path]:
    """The files beside `path` with the same name and another language's suffix, by language; "" is the .gsd itself."""
    given = Path(path)
    found = {}
    for other in sorted(given.parent.iterdir()):
        suffix = other.suffix.lower()
        if other.stem.lower() == given.stem.lower() and (suffix == ".gsd" or suffix in LANGUAGES):
            found[LANGUAGES.get(suffix, "")] = other
    return found

