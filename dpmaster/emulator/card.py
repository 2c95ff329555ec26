# SPDX-License-Identifier: MIT
"""What a card behind an emulated slave is: a pure machine on given time, with no thread and no binding.

The host (a segment or a line) owns the DP slave itself - states, checks, watchdog, stored answer - and shows the card
what has become of the exchange; the card gives back the octets for the master. Times are seconds from any monotonic
origin, so that a test can let hours pass in no time. A card reaches its slave only through the `Slave` it is given when it
is attached. This room may touch nothing but the standard library.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import ClassVar, Literal, Protocol, get_args, get_type_hints

from dpmaster._names import Named
from dpmaster.errors import ConfigurationError


class SlaveState(Named):
    """State of the DP slave in front of the card; the numbers are those of `enum dpm_slave_state` in slave.h."""

    OFF = 0
    WAIT_PRM = 1
    WAIT_CFG = 2
    DATA_EXCH = 3


class BaudState(Named):
    """What a slave knows of the rate; the numbers are those of `enum dpm_baud_state` in slave.h."""

    SEARCH = 0  # it listens at one rate after the other and hears nothing elsewhere
    CONTROL = 1  # the rate is known
    DP_CONTROL = 2  # and the watchdog is on


@dataclass(frozen=True)
class Habits:
    """What a slave does where the standard's readers disagree; the first of each is the default.

    Raises ConfigurationError for a word that is none of the field's.
    """

    wrong_length: Literal["rs", "ue"] = "rs"
    """The answer to outputs of a wrong length; either way it leaves Data_Exchange."""
    set_prm: Literal["wait-cfg", "stay"] = "wait-cfg"
    """Where a good Set_Prm in Data_Exchange leads that changes neither user parameters nor sync nor freeze."""
    other_master: Literal["rs", "sc"] = "rs"
    """The answer to another master's Set_Prm, Chk_Cfg and Data_Exchange while locked; none of them is executed."""
    announce: Literal["sd1", "octet", "never"] = "sd1"
    """How new diagnosis is announced where there are no inputs to carry the flag: SD1 with DH, a dummy octet, not at all."""
    global_control: Literal["unheard", "feeds"] = "unheard"
    """Whether the own master's Global_Control retriggers the watchdog."""
    cfg_fault: Literal["free", "kept"] = "free"
    """Diag.Master_Add after a wrong Chk_Cfg: FF, or the master's."""
    open_set_prm: Literal["tsdr", "user"] = "tsdr"
    """What Set_Prm without Lock and Unlock changes: min Tsdr only, or the user parameters too."""

    WORDS: ClassVar[dict[str, tuple[str, ...]]]
    """The words of each field, the default first."""

    def __post_init__(self) -> None:
        for name, words in self.WORDS.items():
            if getattr(self, name) not in words:
                raise ConfigurationError(f"habit {name} {getattr(self, name)!r}: {' or '.join(words)}")


Habits.WORDS = {field.name: get_args(get_type_hints(Habits)[field.name]) for field in fields(Habits)}


@dataclass(frozen=True, slots=True)
class Exchange:
    """What the slave knows of its exchange at the moment of a step."""

    state: SlaveState = SlaveState.WAIT_PRM
    outputs: bytes = b""
    """Octets of the last good Data_Exchange."""
    valid: bool = False
    """False in Clear or after the exchange was lost: `outputs` then count as zeros."""
    number: int = 0
    """Number of the output frame; it changes with every new one."""
    configuration: int = -1
    """Index of the accepted configuration in `Card.configurations`, -1 none."""
    master: int | None = None
    """Address of the master that has locked the slave."""
    watchdog_expired: int = 0
    """How often the slave's watchdog has run out."""
    address: int | None = None
    """The station address, which Set_Slave_Add may have changed."""
    baudrate: int = 12_000_000
    """bit/s of the wire."""


class Slave(Protocol):
    """A card's own slave. Any thread may call; behind the host's close() nothing happens."""

    def refresh(self) -> None:
        """Step the card now and take over its octets: something that only the card knows of has changed."""

    def diagnose(self, octets: bytes, *, announce: bool, ext_diag: bool, static_diag: bool) -> None:
        """Diagnosis behind the six standard octets; what does not fit is cut off and reported as overflow."""

    def set_ready(self, ready: bool) -> None:
        """While not ready the slave says Station_Not_Ready."""


class Card(ABC):
    """An application behind a DP slave. The host reads the attributes once, when it attaches the card."""

    address: int
    ident_number: int
    configurations: tuple[bytes, ...]
    """Identifier octets of every configuration that Chk_Cfg accepts; the first is the one Get_Cfg tells before that."""
    user_parameters: tuple[int, int] = (0, 0)
    """Fewest and most octets of User_Prm_Data that Set_Prm accepts."""
    fail_safe: bool = False
    sync: bool = False
    freeze: bool = False
    max_diagnosis: int = 6
    min_slave_interval: int = 0
    """100 us between two requests of a master; what comes sooner is answered and counted (`SlaveReport.too_soon`)."""
    identity: tuple[str, str, str, str] | None = None
    """What Ident is answered: vendor, controller, hardware and software release, at most 60 characters together. None: RS."""
    auto_baud: bool = False
    """It searches the wire's rate when switched on, from 12 Mbit/s down, and hears nothing before."""
    baud_control: float = 0.0
    """So long without a request to it, and it searches the rate anew: s, 0.01 to 2.55; 0: never."""
    habits: Habits = Habits()

    # What the device's EEPROM holds. The host writes it when Set_Slave_Add was executed.
    set_address: bool = False
    """Set_Slave_Add is there; without it RS."""
    address_locked: bool = False
    """The address was set with No_Add_Chg: only `Host.set_address` changes it."""
    remote_data: bytes = b""
    """Rem_Slave_Data of the last Set_Slave_Add, 0 to 240 octets."""

    slave: Slave | None = None
    """Set when the host has the card on its wire."""

    def attached(self, slave: Slave) -> None:
        """The host has the card on its wire."""
        self.slave = slave

    def detached(self) -> None:
        """The host is closed."""
        self.slave = None

    @abstractmethod
    def step(self, now: float, exchange: Exchange) -> bytes:
        """Live until `now` and return the input octets of that moment.

        Called whenever the outputs or the slave's state changed, and at `next_step` at the latest. Between two calls
        the card has held the outputs of the earlier one.
        """

    @abstractmethod
    def next_step(self, now: float) -> float:
        """The time at which the card wants its next step at the latest. An idle card asks rarely."""

    @abstractmethod
    def reset(self, now: float) -> None:
        """Cycle the power: everything volatile is lost, what the device stores in its EEPROM stays."""
