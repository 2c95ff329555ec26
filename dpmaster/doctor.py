# SPDX-License-Identifier: MIT
"""What is good and what is bad about a port for a PROFIBUS master, and about the computer behind it, with the remedy for each.

It sends nothing, so that it may be asked about the port of a bus that runs. What only a telegram of one's own can tell (echo,
how late the host hears) is for `calibration`.
"""

from __future__ import annotations

import os
import platform
import resource
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from dpmaster import cable
from dpmaster._core import block
from dpmaster.errors import PortError
from dpmaster.listener import Listener
from dpmaster.parameters import BusParameters
from dpmaster.ports import Port, Rate
from dpmaster.realtime import Realtime, lock

__all__ = ["Diagnosis", "Level", "Remark", "examine", "examine_computer"]

LOCKED = 1 << 20  # octets: more than a bus thread's stack and blocks


class Level(Enum):
    """How much a remark matters."""

    GOOD = "ok"
    NOTE = "note"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Remark:
    """One finding. `remedy` is empty where nothing needs to be done."""

    level: Level
    subject: str
    text: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """All that was found."""

    port: Port
    rates: tuple[Rate, ...]
    remarks: tuple[Remark, ...]

    @property
    def works(self) -> bool:
        return all(remark.level is not Level.BAD for remark in self.remarks)


def examine(path: str, baudrate: int | None = None, listen: float = 1.0) -> Diagnosis:
    """Look at a port and the computer; with `baudrate` (bit/s) also hear the bus for `listen` s. Raises PortError when there is
    no such port, ConfigurationError for a rate that is none."""
    if baudrate is not None:
        BusParameters.default(baudrate)
    port = Port.at(path)
    rates: tuple[Rate, ...] = ()
    remarks = [*_identity(port), *_access(port)]
    if port.permitted:
        try:
            rates, believed = port.rates(), not port.repeats
            remarks += [*_rates(port, rates, baudrate, believed), *_direction(port), *_delivery(port), *_echo(port)]
            if baudrate is not None:
                if Rate(baudrate, None) not in rates:
                    remarks += _heard(port, baudrate, listen)
                remarks += _cable(baudrate)
        except PortError as error:
            text, _, remedy = str(error).removeprefix(f"port {path}: ").partition(": ")
            remarks.append(Remark(Level.BAD, "port", text, remedy))
    return Diagnosis(port, rates, (*remarks, *examine_computer(serial=port.kind != "pty")))


# ---- the port


def _identity(port: Port) -> Iterator[Remark]:
    what = {"uart": "a UART", "usb": "a USB adapter", "pty": "a pty"}[port.kind]
    words = [what, port.description, f"driver {port.driver}" if port.driver else ""]
    yield Remark(Level.GOOD, "port", ", ".join(word for word in words if word))
    if port.kind == "usb" and not any("by-id" in link for link in port.links):
        yield Remark(Level.NOTE, "name", "it has no lasting name: after plugging in anew it may be called otherwise",
                     "a udev rule that makes a link, as examples/99-dpmaster.rules does")
    elif port.links:
        yield Remark(Level.GOOD, "name", f"also {', '.join(port.links)}")


def _access(port: Port) -> Iterator[Remark]:
    if not port.permitted:
        yield Remark(Level.BAD, "permission", *(
            (f"this user may not open it, the group {port.group} may",
             f"sudo usermod -aG {port.group} {os.environ.get('USER', '$USER')}, then log in again") if port.group else
            ("only root may open it",
             "free it of the console (see there), and reboot: the system's rules give it to dialout then" if port.console else
             'a udev rule with GROUP="dialout", MODE="0660", as in examples/99-dpmaster.rules')))
    if port.console:
        yield Remark(Level.BAD, "console", "the kernel's console is on it: its messages would go to the bus",
                     "take console= of this port out of the kernel's command line (on a Raspberry Pi: raspi-config, Serial "
                     "Port, no login shell) and disable its serial-getty")


def _kilo(rate: int) -> str:
    return f"{rate / 1000:g}k" if rate < 1_000_000 else f"{rate / 1_000_000:g}M"


def _rates(port: Port, rates: tuple[Rate, ...], wanted: int | None, believed: bool = True) -> Iterator[Remark]:
    made = [rate.nominal for rate in rates if rate.made is not None]
    lacks = [rate.nominal for rate in rates if rate.made is None]
    if port.kind == "pty":
        yield Remark(Level.NOTE, "rates", "a pty takes every rate and drops parity: octets have no length on it")
    elif not made:
        yield Remark(Level.BAD, "rates", "it makes none of PROFIBUS's rates within 0.3 %", "another adapter: FT232R, FT232H")
    elif not believed:
        yield Remark(Level.NOTE, "rates",
                     "its driver says yes to every rate, 100 Mbit/s among them: which of them it makes is not known",
                     "the data sheet of its chip, then a slave that answers; FT232R and FT232H tell what they make")
    else:
        without = f"; not {', '.join(map(_kilo, lacks))} bit/s" if lacks else ""
        yield Remark(Level.GOOD, "rates", f"{', '.join(map(_kilo, made))} bit/s with even parity{without}")
    if wanted in lacks:
        yield Remark(Level.BAD, "rate", f"{_kilo(wanted)} bit/s is not among them", "another rate, or an adapter that makes it")


def _direction(port: Port) -> Iterator[Remark]:
    if port.kind == "pty":
        return
    can, does = port.rs485()
    if does:
        yield Remark(Level.GOOD, "direction", "the driver switches it (RS-485 mode is on)")
    elif can:
        yield Remark(Level.NOTE, "direction", "the driver can switch it, and does not now",
                     'direction="rs485" where RTS leads to the transceiver\'s driver enable; nothing where the hat switches by '
                     "itself")
    else:
        yield Remark(Level.NOTE, "direction", "the driver cannot switch it", "a hat or an adapter that switches by itself")


def _delivery(port: Port) -> Iterator[Remark]:
    timer = port.read("device/latency_timer")
    if timer.isdecimal() and int(timer) > 1:
        yield Remark(Level.BAD, "latency", f"the adapter keeps octets for up to {timer} ms before it hands them over",
                     f"echo 1 | sudo tee {port.sys}/device/latency_timer, or the udev rule of examples/99-dpmaster.rules")
    elif port.kind == "usb":
        yield Remark(Level.GOOD if timer else Level.NOTE, "latency",
                     "the latency timer is 1 ms" if timer else "this adapter's delay cannot be set",
                     "" if timer else "dpmaster calibrate measures it; an FT232R or FT232H can be set to 1 ms")
    trigger = port.read("rx_trig_bytes")
    if trigger.isdecimal() and int(trigger) > 1:
        yield Remark(Level.NOTE, "FIFO", f"{trigger} octets wait in the receive FIFO, or four characters' silence",
                     f"echo 1 | sudo tee {port.sys}/rx_trig_bytes; a master of root does so at rates up to 187.5 kbit/s")


def _echo(port: Port) -> Iterator[Remark]:
    yield Remark(Level.NOTE, "echo", "whether the port hears itself, and how late, only a telegram of one's own can tell",
                 f"dpmaster calibrate {port.path}, on a bus that no other master has")


def _heard(port: Port, baudrate: int, seconds: float) -> Iterator[Remark]:
    """What a listener makes of the bus."""
    try:
        with Listener(port.path, baudrate) as listener:
            listener.wait(seconds)
            status = listener._bus.status()
            heard, errors = listener._bus.statistics().octets_in, listener._bus.statistics().line_errors
            good = status.fdl.foreign
            master = listener.foreign
    except PortError as error:
        yield Remark(Level.BAD, "bus", str(error))
        return
    if not heard:
        yield Remark(Level.NOTE, "bus", f"silent for {seconds:g} s",
                     "nothing, if no master is on; else look at A, B and the ground")
    elif master is not None or good:
        who = f", master {master} has it" if master is not None else ""
        yield Remark(Level.GOOD if not errors else Level.BAD, "bus", f"telegrams are heard{who}; {errors} line errors",
                     "look at termination, stubs and the ground between the stations" if errors else "")
    else:
        yield Remark(Level.BAD, "bus", f"{heard} octets heard and no telegram in them, {errors} with line errors",
                     "another rate (dpmaster doctor --baudrate), A and B exchanged, or no bias while the line is idle")


def _cable(baudrate: int) -> Iterator[Remark]:
    most = cable.limits(float(BusParameters.default(baudrate).rate))
    kind = ", ".join(map(" ".join, cable.CABLE.items()))
    yield Remark(Level.GOOD, "cable", f"at {_kilo(baudrate)} bit/s: {most}; {cable.STATIONS} stations a segment, "
                                      f"{cable.SPACING} m at least between two; {kind}")


# ---- the computer


def examine_computer(serial: bool = True) -> tuple[Remark, ...]:
    """The kernel, what this user may ask of it, and the CPU's clock. `serial`: for a serial port, not for a pty."""
    return (*_kernel(), *_limits(Level.BAD if serial else Level.NOTE), *_governor())


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _kernel() -> Iterator[Remark]:
    version = _read("/proc/version")
    release = f"Linux {platform.release()} on {platform.machine()}"
    if _read("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        yield Remark(Level.GOOD, "kernel", f"{release}, PREEMPT_RT: threads wake within tens of microseconds")
    else:
        kind = next((word for word in version.split() if word.startswith("PREEMPT")), "no PREEMPT")
        yield Remark(Level.NOTE, "kernel", f"{release}, {kind}: under load threads may wake milliseconds late",
                     "nothing, for a master alone on its bus; in a ring, a kernel with PREEMPT_RT (Debian: linux-image-rt-*)")


def _granted(priority: int) -> bool:
    """Whether a thread of this program may have it."""
    granted = []

    def ask() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            granted.append(True)
        except OSError:
            pass

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return bool(granted)


def _limits(level: Level) -> Iterator[Remark]:
    """`level`: how much a refusal matters. On a pty nothing of this is asked for unless the program says so. What is granted
    is tried: a container or a control group refuses root, too, and what the limits would grant."""
    wanted = Realtime().priority
    allowed = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if _read("/proc/sys/kernel/sched_rt_runtime_us") == "0":  # one that is tried would not come back
        yield Remark(Level.BAD, "priority", "sched_rt_runtime_us is 0: real-time threads never run",
                     "sysctl kernel.sched_rt_runtime_us=950000")
    elif _granted(wanted):
        yield Remark(Level.GOOD, "priority", f"SCHED_FIFO {wanted} is granted")
    elif os.geteuid() and 0 <= allowed < wanted:
        yield Remark(level, "priority", f"SCHED_FIFO ends at {allowed} for this user, the bus thread asks for {wanted}",
                     "'@dialout - rtprio 60' in /etc/security/limits.d/dpmaster.conf, LimitRTPRIO=60 in a systemd unit")
    else:
        yield Remark(level, "priority",
                     f"SCHED_FIFO {wanted} is refused, whoever this user is: by a container or a control group",
                     "a container with --cap-add SYS_NICE or --ulimit rtprio=60; else a master outside of it")
    if lock([block(LOCKED)]):
        memory = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        limit = f", the limit is {memory // 1024} KiB" if memory >= 0 else ""
        yield Remark(level, "memory", f"{LOCKED // 1024} KiB may not be locked for the bus thread{limit}",
                     "'@dialout - memlock unlimited', LimitMEMLOCK=infinity, a container with --ulimit memlock=-1")


def _governor() -> Iterator[Remark]:
    governor = _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor and governor != "performance":
        yield Remark(Level.NOTE, "CPU clock", f"governor {governor}: a CPU that slept wakes slowly",
                     "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor")
    elif governor:
        yield Remark(Level.GOOD, "CPU clock", "governor performance")
