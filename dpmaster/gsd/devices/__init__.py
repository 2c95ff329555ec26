# SPDX-License-Identifier: MIT
"""GSD files of the option cards that this package has drives and emulators for, written by this project.

What a manual's listing states is taken from it; what it does not state says so in the file. A real card's own file, from its
maker, goes before these.
"""

from pathlib import Path

from dpmaster.errors import ConfigurationError

_FOLDER = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in _FOLDER.glob("*.gsd")))
"""The cards: "si-p1", "si-p3", "vw3a3607"."""


def path(name: str) -> Path:
    """The file of a card, one of `NAMES`. Raises ConfigurationError for any other."""
    if name not in NAMES:
        raise ConfigurationError(f"no GSD file of {name!r} here: there are those of {', '.join(NAMES)}")
    return _FOLDER / f"{name}.gsd"
