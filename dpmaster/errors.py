# SPDX-License-Identifier: MIT
"""The family of errors. Everything the package raises on purpose is a `DPError`; this file touches nothing else.

Each sub-class answers one question of a program: is it my argument, the port, the station, the time or the state? Those
that have a built-in counterpart derive from it too, so that ``except TimeoutError`` works.
"""

from __future__ import annotations

__all__ = [
    "ClosedError",
    "CommissioningError",
    "ConfigurationError",
    "DPError",
    "DPTimeout",
    "NotOperatingError",
    "OutputsDiscarded",
    "ParameterAccessError",
    "PortError",
    "StationError",
]


class DPError(Exception):
    """Root of the family. ``dpm_code`` is the C library's code (`enum dpm_error`) where one is behind it."""

    def __init__(self, message: str, *, dpm_code: int | None = None) -> None:
        super().__init__(message)
        self.dpm_code = dpm_code


class ConfigurationError(DPError, ValueError):
    """An argument, a parameter or a configuration breaks a rule; the message names it, its value and the rule."""


class PortError(DPError, OSError):
    """A port cannot be opened, does not keep its settings, or vanished. ``path`` is the port's."""

    def __init__(self, message: str, *, path: str | None = None, errno: int | None = None,
                 dpm_code: int | None = None) -> None:
        super().__init__(message, dpm_code=dpm_code)
        self.path = path
        # OSError shows "[Errno n] text" only when strerror is set as well: the message stays ours.
        self.errno = errno


class ClosedError(DPError):
    """The object was closed, or belongs to the parent process (after fork)."""


class DPTimeout(DPError, TimeoutError):
    """What was waited for did not happen in the time given."""


class NotOperatingError(DPError):
    """Outputs cannot be given now: the output watchdog latched them safe, or the mode does not allow it."""


class OutputsDiscarded(DPError):
    """A commit that no telegram will carry any more: outputs went safe before it was sent. ``number`` is the commit's."""

    def __init__(self, message: str, *, number: int | None = None, dpm_code: int | None = None) -> None:
        super().__init__(message, dpm_code=dpm_code)
        self.number = number


class StationError(DPError):
    """A station refuses, does not answer, or was lost. ``address`` is its own, ``reason`` says in words why."""

    def __init__(self, message: str, *, address: int | None = None, reason: str = "",
                 dpm_code: int | None = None) -> None:
        super().__init__(message, dpm_code=dpm_code)
        self.address = address
        self.reason = reason


class ParameterAccessError(DPError):
    """A drive refused to read or write a parameter: its ``code``, the code's ``meaning``, the ``register`` asked for."""

    def __init__(self, message: str, *, code: int, meaning: str = "", register: int | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.meaning = meaning
        self.register = register

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_access_error, (str(self), self.code, self.meaning, self.register)


def _rebuild_access_error(message: str, code: int, meaning: str, register: int | None) -> ParameterAccessError:
    """Pickle calls an exception with its positional arguments only."""
    return ParameterAccessError(message, code=code, meaning=meaning, register=register)


class CommissioningError(DPError):
    """Parameters of the drive stand in the way; ``parameters`` names them, the message says what they should be."""

    def __init__(self, message: str, *, parameters: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.parameters = parameters
