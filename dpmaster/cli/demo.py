# SPDX-License-Identifier: MIT
"""``dpmaster demo``: a card with its motor, the wire and the master in one program, and a drive that turns.

It shows what a program does with a drive, in that order: start the bus, read and write parameters, run and watch, see
a refusal explained, stop. It calls what any program calls.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import shutil
import sys
import textwrap
import time
from collections.abc import Callable
from typing import TextIO

from dpmaster import Master
from dpmaster.drives import YaskawaV7
from dpmaster.drives.yaskawa_v7 import V7Status
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1
from dpmaster.errors import ParameterAccessError

NAME = "demo"
HELP = "start an emulated drive on a virtual bus, follow its ramp, read and write parameters, stop it"

ADDRESS = 5
SUBJECT = 12  # columns of the first word of a line
BAR = 20
COLUMNS = 79  # of a line on a terminal: a picture that is wider than the terminal cannot be drawn over
REDRAW = 0.05  # s between two pictures of the ramp on a terminal, and between two lines elsewhere
LINE = 0.5
SLOW = 19_200  # bit/s; up to here ten cycles of one drive can take longer than 1 s
FLAGS = ("running", "reverse", "frequency_agree", "zero_speed")

SAFETY = """\
In a program of your own: when it ends, the drive is stopped first. When it is
killed, the slave's watchdog stops the drive. When it hangs, or waits at an
interactive prompt, for longer than the output watchdog (1 s), outputs go safe
until operate() is called again: master.feed() says that you are there,
output_watchdog=None switches that watchdog off."""


def number(low: float, high: float) -> Callable[[str], float]:
    """The type of an argument above `low` and up to `high`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low < value <= high:
            raise argparse.ArgumentTypeError(f"{text!r}: a number above {low:g} and up to {high:g}")
        return value

    return parse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    # 60 Hz is n011, the drive's maximum frequency; 600 s the most that n019 takes.
    parser.add_argument("--frequency", type=number(0, 60), default=30.0, metavar="HZ", help="how fast to run (default 30)")
    parser.add_argument("--reverse", action="store_true", help="run in reverse")
    parser.add_argument("--acceleration", type=number(0, 600), default=4.0, metavar="S",
                        help="seconds from 0 to 60 Hz and back, written to n019 and n020 (default 4)")
    parser.add_argument("--baudrate", type=int, default=500_000, metavar="B", help="bit/s (default 500000)")
    parser.add_argument("--paced", action="store_true", help="let every octet take the time it takes on a real wire")
    parser.add_argument("--json", action="store_true", help="print the summary only, as one JSON object")


class Show:
    """What a person sees: lines, and on a terminal a bar that moves. Silent with --json."""

    def __init__(self, stream: TextIO, frequency: float, silent: bool) -> None:
        self.stream = stream
        self.frequency = frequency
        self.silent = silent
        self.moving = not silent and stream.isatty()
        self.next = 0.0

    @property
    def width(self) -> int:
        return min(COLUMNS, shutil.get_terminal_size().columns - 1)

    def line(self, subject: str, text: str) -> None:
        if not self.silent:
            if self.moving:
                rows = textwrap.wrap(text, max(SUBJECT, self.width - SUBJECT), break_on_hyphens=False)
                text = f"\n{'':{SUBJECT}}".join(rows)
            print(f"{subject:<{SUBJECT}}{text}", file=self.stream, flush=True)

    def ramp(self, status: V7Status) -> None:
        """The drive's frequency now, if it is time for a new picture."""
        now = time.monotonic()
        if self.silent or now < self.next:
            return
        self.next = now + (REDRAW if self.moving else LINE)
        self._draw(status, "" if self.moving else "\n")

    def settled(self, status: V7Status) -> None:
        """The last picture of a ramp; it stays."""
        if not self.silent:
            self._draw(status, "\n")

    def end(self) -> None:
        """Leave the picture that was being drawn, for what follows."""
        if self.moving:
            print(file=self.stream, flush=True)

    def _draw(self, status: V7Status, end: str) -> None:
        hz, amperes = status.output_frequency or 0.0, status.current or 0.0
        filled = min(BAR, round(BAR * hz / self.frequency))
        flags = [name.replace("_", " ") for name in FLAGS if getattr(status, name)]
        text = f"  [{'#' * filled}{'.' * (BAR - filled)}] {hz:6.2f} Hz {amperes:5.1f} A  {', '.join(flags)}"
        if self.moving:
            text = "\r" + text[:self.width].ljust(self.width)
        print(text, end=end, file=self.stream, flush=True)


def parameters(drive: YaskawaV7, show: Show, seconds: float) -> None:
    """Read what commissioning set, then write both ramps and read one back."""
    show.line("parameters", f"n003 = {drive.read_parameter('n003')} (run and stop come from the bus), "
                            f"n004 = {drive.read_parameter('n004')} (so does the frequency)")
    before = drive.read_parameter("n019")
    # Two registers in one access: n019 and n020, in 0.1 s.
    drive.write_parameter("n019", [round(seconds * 10)] * 2)
    show.line("", f"n019, acceleration time: {before / 10:.1f} s, written {seconds:.1f} s, "
                  f"read back {drive.read_parameter('n019') / 10:.1f} s")


def refusal(drive: YaskawaV7, show: Show) -> int:
    """What the drive says to a write that it must refuse while it runs."""
    try:
        drive.write_parameter("n003", 3)
    except ParameterAccessError as error:
        show.line("refused", f"writing n003 while it runs: code {error.code:02X}h, {error.meaning}")
        return error.code
    return 0


def ramp(drive: YaskawaV7, show: Show, done: str, timeout: float) -> float:
    """Follow the drive until the flag `done` is set; the seconds that took."""
    begin = time.monotonic()

    def arrived(status: V7Status) -> bool:
        show.ramp(status)
        return bool(getattr(status, done))

    show.settled(drive.wait_until(arrived, timeout=timeout))
    return time.monotonic() - begin


def session(args: argparse.Namespace, show: Show) -> dict[str, object]:
    """The whole of it; returns the summary."""
    with Segment(baudrate=args.baudrate if args.paced else None, nominal=args.baudrate) as wire:
        card = wire.attach(SIP1(address=ADDRESS))
        port = wire.port()
        show.line("wire", f"{port}, {args.baudrate / 1000:g} kbit/s, {'paced' if args.paced else 'unpaced'}; "
                          f"a Yaskawa V7 with its card SI-P1 at address {ADDRESS}")
        # A machine that is busy with something else must not spoil the show: a lost answer is waited for longer, so the
        # watchdog is, too. The lowest rates take longer than a second; see --paced.
        with Master(port, baudrate=args.baudrate, address=1, cycle_time=0.005, allowance=0.1) as master:
            watchdog = 1.0 if args.baudrate > SLOW else 5.0
            drive = master.add(YaskawaV7(address=ADDRESS, configuration="Extended Data 1", watchdog=watchdog))
            begin = time.monotonic()
            master.operate(timeout=5.0)
            start = time.monotonic() - begin
            show.line("bus", f"in Data_Exchange after {start * 1000:.0f} ms: found, parameterised, configuration accepted")
            parameters(drive, show, args.acceleration)
            show.line("run", f"{'reverse' if args.reverse else 'forward'} at {args.frequency:.2f} Hz")
            (drive.run_reverse if args.reverse else drive.run_forward)(args.frequency)
            up = ramp(drive, show, "frequency_agree", args.acceleration + 5.0)
            code = refusal(drive, show)
            turning = abs(card.motor.frequency)
            show.line("stop", "the ramp down")
            drive.stop()
            down = ramp(drive, show, "zero_speed", args.acceleration + 5.0)
            counts = drive.statistics
            elapsed = time.monotonic() - begin
    return {
        "frequency": args.frequency, "motor_frequency": round(turning, 2), "seconds_to_start": round(start, 3),
        "seconds_up": round(up, 3), "seconds_down": round(down, 3), "refusal_code": code, "seconds": round(elapsed, 3),
        "exchanges": counts.exchanges, "exchanges_per_second": round(counts.exchanges / elapsed, 1),
        "repetitions": counts.repetitions, "losses": counts.losses,
    }


def run(args: argparse.Namespace) -> int:
    show = Show(sys.stdout, args.frequency, args.json)
    if show.moving:  # what is logged takes the place of the picture, which is drawn anew below it
        logging.basicConfig(format=f"\r%(message)-{show.width}s")
    try:
        summary = session(args, show)
    except KeyboardInterrupt:  # the `with` blocks have been left: the drive has its stop word
        show.end()
        show.line("interrupted", "the drive was given its stop word, then Clear, and was released")
        raise
    if args.json:
        print(json.dumps(summary))
        return 0
    show.line("summary", "{exchanges} exchanges in {seconds} s ({exchanges_per_second} a second), {repetitions} repeated, "
                         "{losses} losses; {seconds_up} s up, {seconds_down} s down".format(**summary))
    print(f"\n{SAFETY}")
    return 0
