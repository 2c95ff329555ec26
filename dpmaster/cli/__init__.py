# SPDX-License-Identifier: MIT
"""The command line, ``dpmaster COMMAND``. A command is one file of this room with

- ``NAME`` and ``HELP`` (one line), ``add_arguments(parser)``, and
- ``run(args) -> int``, which returns the exit code and raises DPError for what went wrong.

Commands only call what a program could call. Exit codes, the same for all of them: 0 done; 1 it failed; 2 the arguments are
wrong, by their form or because what they ask for breaks a rule (ConfigurationError); 130 Ctrl-C; 143 SIGTERM. With 1 and 2
one line on stderr names the thing and the remedy.
"""

from __future__ import annotations

import argparse
import importlib
import io
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

import dpmaster
from dpmaster.errors import ConfigurationError, DPError

# Every command, in the order of the help.
COMMANDS: tuple[str, ...] = (
    "demo", "run", "segment", "emulate", "scan", "drive", "diag", "cfg", "read_inputs", "read_outputs", "set_address",
    "control", "ports", "bridge", "doctor", "calibrate", "perf", "decode", "gsd", "timing",
)

OK, FAILED, USAGE, INTERRUPTED, TERMINATED = 0, 1, 2, 128 + signal.SIGINT, 128 + signal.SIGTERM


class Terminated(KeyboardInterrupt):
    """SIGTERM came: leave as after Ctrl-C, through stop word and Clear. A command that ends well by it catches it."""


class _Parser(argparse.ArgumentParser):
    """Its sub-commands' parsers are of this class, too."""

    def error(self, message: str) -> NoReturn:
        super().error(f"{message} ('{self.prog} --help' tells more)")


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """Of the command that is named, or of all: on a small computer importing the others takes longer than most work."""
    parser = _Parser(
        prog="dpmaster",
        description="A PROFIBUS-DP master, emulated drives to run it against, and instruments for the bus.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong arguments, 130 Ctrl-C, 143 SIGTERM.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {dpmaster.__version__}")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for name in [name for name in COMMANDS if argv[:1] == [name.replace("_", "-")]] or COMMANDS:
        command = importlib.import_module(f"dpmaster.cli.{name}")
        subparser = subparsers.add_parser(command.NAME, help=command.HELP, description=command.HELP)
        subparser.set_defaults(run=command.run, command=command.NAME)
        command.add_arguments(subparser)
    return parser


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise Terminated


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; wrong arguments leave by SystemExit(2), as argparse does it."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a maker's text may have characters that the terminal does not
        sys.stdout.reconfigure(errors="backslashreplace")
    # While a command is imported nothing is open, and a signal may end the program as it is, without a traceback.
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        args = _parser(sys.argv[1:] if argv is None else argv).parse_args(argv)
        # SIGINT too: a shell script starts what it puts behind `&` with it ignored, and "until SIGINT" would be never.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, _terminate)
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except DPError as error:
        print(f"dpmaster {args.command}: {error}", file=sys.stderr)
        return USAGE if isinstance(error, ConfigurationError) else FAILED
    except OSError as error:
        # Our output cannot be written: its reader left (`| head`), which needs no words, or its disk is full.
        if not isinstance(error, BrokenPipeError):
            print(f"dpmaster {args.command}: {error.strerror or error}", file=sys.stderr)
        # The interpreter must not try to flush it once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Terminated:
        return TERMINATED
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
