# SPDX-License-Identifier: MIT
"""Serial ports of this computer: which there are, what is behind a path, which rates and modes its driver really has.

pyserial finds them; what a driver does is tried by the library itself, since some drivers say yes to everything. Nothing here
sends a bit.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from dpmaster import _arguments
from dpmaster._core import block, ffi, lib
from dpmaster.bus import direction_code, port_error
from dpmaster.errors import PortError
from dpmaster.parameters import BAUDRATES, BusParameters

__all__ = ["Port", "Rate", "ports"]

PTYS, USB = range(136, 144), (166, 188)  # major numbers: Documentation/admin-guide/devices.txt
TTYS = Path("/sys/class/tty")
LEVELS = ("device", "device/..", "device/../..")  # since Linux 6.5 two devices of the serial core lie in between
SERIAL_CORE = ("port", "ctrl")
TCGETS2, TCSETS2, TIOCGRS485, TIOCSRS485 = 0x802C542A, 0x402C542B, 0x542E, 0x542F
RS485_ENABLED, MODE_RS422 = 0x001, 0x200
NOBODY_MAKES = Fraction(100_000_000)  # bit/s; USB adapters of high speed end at 12 Mbit/s
# What the serial core calls a UART that it has found, by the number in its file "type": include/uapi/linux/serial.h.
NO_UART = "0"
CHIPS = {"1": "8250", "2": "16450", "3": "16550", "4": "16550A", "6": "16650", "7": "16650V2", "8": "16750", "10": "16950"}


@dataclass(frozen=True, slots=True)
class Rate:
    """A PROFIBUS rate on a port, bit/s: what the driver makes of it or, where it `repeats`, was asked for; None: it refuses, or
    is off by more than 0.3 %."""

    nominal: int
    made: int | None


@dataclass(frozen=True, slots=True)
class Port:
    """A serial port as the system describes it; None and empty where it does not."""

    path: str
    kind: str
    """"uart", "usb" or "pty": the profile that a `Master` takes for it."""
    driver: str = ""
    description: str = ""
    links: tuple[str, ...] = ()
    """Paths that lead to it and stay the same when it is plugged in elsewhere, or later."""
    sys: Path | None = None
    """Its directory under /sys/class/tty."""

    @classmethod
    def at(cls, path: str) -> Port:
        """The port at `path`. Raises PortError when there is none."""
        path = _arguments.path(path)
        try:
            status = os.stat(path)
        except OSError as error:
            raise port_error(path, lib.DPM_E_PERMISSION if error.errno == errno.EACCES else lib.DPM_E_NO_PORT) from None
        if not stat.S_ISCHR(status.st_mode):
            raise port_error(path, lib.DPM_E_NOT_TTY)
        major, minor = os.major(status.st_rdev), os.minor(status.st_rdev)
        if major in PTYS:
            return cls(path, "pty", description="a pseudo-terminal: a virtual segment, or another program")
        sys = Path(f"/sys/dev/char/{major}:{minor}")
        if not (sys / "device").exists():
            raise port_error(path, lib.DPM_E_NOT_TTY)
        return cls(path, "usb" if major in USB else "uart", _driver(sys), _description(path), _links(path), sys.resolve())

    def read(self, name: str) -> str:
        """A file of its directory under /sys, "" where there is none."""
        try:
            return (self.sys / name).read_text().strip() if self.sys else ""
        except OSError:
            return ""

    @property
    def console(self) -> bool:
        """The kernel writes its messages there, or a login waits on it."""
        return Path(self.path).resolve().name in _words(TTYS / "console/active")

    @property
    def permitted(self) -> bool:
        """This user may open it."""
        return os.access(self.path, os.R_OK | os.W_OK)

    @property
    def group(self) -> str:
        """The group whose members may open it, "" where only root may."""
        status = os.stat(self.path)
        if not status.st_gid or ~status.st_mode & (stat.S_IRGRP | stat.S_IWGRP):
            return ""
        try:
            return grp.getgrgid(status.st_gid).gr_name
        except KeyError:
            return str(status.st_gid)

    def rates(self) -> tuple[Rate, ...]:
        """Every PROFIBUS rate, set and read back; then the line is as it was. Raises PortError where it cannot be opened."""
        with self._line_kept():
            return tuple(Rate(nominal, self._try(BusParameters.default(nominal).rate)) for nominal in BAUDRATES)

    @property
    def repeats(self) -> bool:
        """The driver tells what it was asked for, whatever it makes of it (a CH340's, a CDC ACM adapter's): it claims
        100 Mbit/s, too. Raises PortError as `rates`."""
        with self._line_kept():
            return self._try(NOBODY_MAKES) is not None

    @contextmanager
    def _line_kept(self) -> Iterator[None]:
        try:
            with self._kept(TCGETS2, TCSETS2, 44):
                yield
        except PortError:
            raise
        except OSError as error:
            raise port_error(self.path, lib.DPM_E_IN_USE if error.errno == errno.EBUSY else lib.DPM_E_NO_PORT) from None

    def _try(self, rate: Fraction, direction: str | None = None) -> int | None:
        info = ffi.new("dpm_port_info *")
        try:
            with opened(self.path, rate, direction) as port:
                lib.dpm_port_get_info(port, info)
        except PortError as error:
            if error.dpm_code in (lib.DPM_E_RATE, lib.DPM_E_RS485):
                return None
            raise
        return int(info.rate)

    def rs485(self) -> tuple[bool, bool]:
        """Whether the driver can switch the direction, and whether it does already. What it was set to is put back."""
        try:
            with self._kept(TCGETS2, TCSETS2, 44), self._kept(TIOCGRS485, TIOCSRS485, 32) as before:
                can = self._try(Fraction(9600), "rs485") is not None
                (flags,) = struct.unpack_from("I", before)
                return can, flags & (RS485_ENABLED | MODE_RS422) == RS485_ENABLED
        except PortError:
            raise
        except OSError:  # it does not know the question
            return False, False

    @contextmanager
    def _kept(self, get: int, put: int, size: int) -> Iterator[bytes]:
        """What the driver says to the ioctl `get`, and is told again in the end: somebody may use the port, or a console."""
        fds: list[int] = []
        try:
            # In one call: what a Ctrl-C while the port is opened leaves behind has its place already.
            fds.extend(map(os.open, (self.path,), (os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC,)))
            before = fcntl.ioctl(fds[0], get, bytes(size))
            try:
                yield before
            finally:
                fcntl.ioctl(fds[0], put, before)
        finally:
            for fd in fds:
                os.close(fd)


@contextmanager
def opened(path: str, rate: Fraction, direction: str | None) -> Iterator[Any]:
    """A ``dpm_port`` of one's own, without a thread. Raises PortError, ConfigurationError."""
    where = ffi.new("char[]", os.fsencode(path))
    config = ffi.new("dpm_port_config *", {"path": where, "rate_num": rate.numerator, "rate_den": rate.denominator,
                                           "direction": direction_code(direction), "allowance": -1})
    memory, out = block(lib.dpm_port_size()), ffi.new("dpm_port **")
    try:
        code = lib.dpm_port_open(memory, len(memory), config, out)  # a Ctrl-C meanwhile is raised behind it
        if code < 0:
            raise port_error(path, code)
        yield out[0]
    finally:
        if out[0]:
            lib.dpm_port_close(out[0])


def ports() -> tuple[Port, ...]:
    """The serial ports of this computer, by path; ptys are not among them. Entries of the kernel with no UART are left out.

    pyserial goes by names, and leaves out the UARTs of many a board; the kernel knows them all (ttySC0 of a hat, ttymxc0).
    """
    paths = {str(entry.device) for entry in list_ports.comports()}
    paths |= {f"/dev/{each.parent.name}" for each in TTYS.glob("*/device")}
    found = []
    for path in sorted(paths):
        try:
            port = Port.at(path)
        except PortError:  # gone since, or not for a program
            continue
        if port.read("type") != NO_UART:
            found.append(port)
    return tuple(found)


def _driver(sys: Path) -> str:
    names = [(sys / level / "driver").resolve().name for level in LEVELS if (sys / level / "driver").exists()]
    return next((name for name in names if name not in SERIAL_CORE), "")


def _description(path: str) -> str:
    """What an adapter says of itself, the device tree of a UART, or its driver."""
    device = str(Path(path).resolve())
    entry = next((entry for entry in list_ports.comports() if entry.device == device), None)
    if entry is None or entry.vid is None:
        sys = TTYS / Path(device).name
        for node in (sys / level / "of_node/compatible" for level in LEVELS):
            if node.exists():
                return node.read_bytes().split(b"\0")[0].decode()
        return CHIPS.get("".join(_words(sys / "type")), "")
    words = (entry.manufacturer, entry.product, entry.serial_number)
    return f"{' '.join(word for word in words if word)} ({entry.vid:04x}:{entry.pid:04x})"


def _links(path: str) -> tuple[str, ...]:
    device = Path(path).resolve()
    folders = (Path("/dev/serial/by-id"), Path("/dev"))
    return tuple(sorted(str(link) for folder in folders if folder.is_dir() for link in folder.iterdir()
                        if link.is_symlink() and link.resolve() == device and not link.name.startswith("std")))


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []
