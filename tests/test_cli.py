# SPDX-License-Identifier: MIT
"""The command line's frame: one list of commands, exit codes, one line for what went wrong, never a traceback."""

from __future__ import annotations

import importlib
import re
import signal
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest
from children import child

import dpmaster
from dpmaster import cli
from dpmaster.errors import DPError, PortError


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[object], int]], None]:
    """Make the command line one of a single command, "try", that runs the given function."""

    def install(run: Callable[[object], int]) -> None:
        module = types.ModuleType("dpmaster.cli.attempt")
        module.__dict__.update(NAME="try", HELP="try it", add_arguments=lambda parser: None, run=run)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(cli, "COMMANDS", ("attempt",))

    return install


def raises(error: BaseException) -> Callable[[object], int]:
    def run(args: object) -> int:
        raise error

    return run


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_on_the_list_keeps_the_agreement(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(f"dpmaster.cli.{name}")
    assert "\n" not in module.HELP and not module.HELP.endswith(".")
    with pytest.raises(SystemExit) as left:
        cli.main([module.NAME, "--help"])
    assert left.value.code == 0
    assert f"usage: dpmaster {module.NAME}" in capsys.readouterr().out


def test_every_command_of_the_room_is_on_the_list() -> None:
    files = [path for entry in cli.__path__ for path in Path(entry).glob("*.py")]
    assert {path.stem for path in files if re.search(r"^NAME = ", path.read_text(), flags=re.MULTILINE)} == set(cli.COMMANDS)


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["--version"])
    assert (left.value.code, capsys.readouterr().out) == (0, f"dpmaster {dpmaster.__version__}\n")


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    for name in cli.COMMANDS:
        module = importlib.import_module(f"dpmaster.cli.{name}")
        assert re.search(rf"^    {module.NAME}\s", text, flags=re.MULTILINE)


@pytest.mark.parametrize("argv", [[], ["no-such-command"], ["--no-such-option"]])
def test_wrong_arguments_leave_with_2_and_the_usage(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(argv)
    assert left.value.code == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("usage: dpmaster") and err.endswith("('dpmaster --help' tells more)\n")


def test_the_commands_own_exit_code_is_returned(command: Callable[[Callable[[object], int]], None]) -> None:
    command(lambda args: 7)
    assert cli.main(["try"]) == 7


@pytest.mark.parametrize("error", [DPError("port /dev/x: gone; plug it in"), PortError("port /dev/x: gone; plug it in")])
def test_what_failed_is_one_line_and_1(
    error: DPError, command: Callable[[Callable[[object], int]], None], capsys: pytest.CaptureFixture[str]
) -> None:
    command(raises(error))
    assert cli.main(["try"]) == 1
    out, err = capsys.readouterr()
    assert out == "" and err == "dpmaster try: port /dev/x: gone; plug it in\n"


def test_ctrl_c_leaves_with_130(command: Callable[[Callable[[object], int]], None]) -> None:
    command(raises(KeyboardInterrupt()))
    assert cli.main(["try"]) == 130


def test_sigterm_unwinds_and_leaves_with_143(command: Callable[[Callable[[object], int]], None]) -> None:
    unwound = []

    def run(args: object) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            unwound.append(True)
        return 0

    before = signal.getsignal(signal.SIGTERM)
    command(run)
    assert cli.main(["try"]) == 143
    assert unwound == [True]
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_programming_error_is_not_hidden(command: Callable[[Callable[[object], int]], None]) -> None:
    command(raises(ZeroDivisionError("a mistake of ours")))
    with pytest.raises(ZeroDivisionError):
        cli.main(["try"])


def test_a_reader_that_leaves_is_no_traceback() -> None:
    """`dpmaster ... | head -1`: the pipe's far end is closed before we write."""
    program = (
        "import sys, types; from dpmaster import cli;"
        "module = types.ModuleType('dpmaster.cli.attempt');"
        "module.__dict__.update(NAME='try', HELP='try it', add_arguments=lambda parser: None,"
        "                       run=lambda args: print('x' * 100000, flush=True) or 0);"
        "sys.modules[module.__name__] = module; cli.COMMANDS = ('attempt',);"
        "sys.exit(cli.main(['try']))"
    )
    with child("-c", program) as process:
        process.stdout.close()
        assert (process.wait(30), process.stderr.read()) == (1, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_command_begins_is_no_traceback(number: signal.Signals) -> None:
    program = (
        "import signal, sys, types; from dpmaster import cli;"
        "module = types.ModuleType('dpmaster.cli.attempt');"
        f"arguments = lambda parser: signal.raise_signal({number:d});"
        "module.__dict__.update(NAME='try', HELP='try it', add_arguments=arguments, run=lambda args: 0);"
        "sys.modules[module.__name__] = module; cli.COMMANDS = ('attempt',);"
        "sys.exit(cli.main(['try']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (-number, "", "")


def test_a_command_does_not_wait_for_the_import_of_the_others() -> None:
    program = ("import sys; from dpmaster import cli; assert cli.main(['decode', 'E5']) == 0;"
               "print(sorted(name for name in sys.modules if name.startswith('dpmaster.cli.') and '._' not in name))")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "['dpmaster.cli.decode']"), done.stderr


def test_python_dash_m_is_the_same_program() -> None:
    done = subprocess.run([sys.executable, "-m", "dpmaster", "--help"], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: dpmaster ")


@pytest.mark.parametrize("argv", [
    ["emulate", "si-p1", "--address", "0"], ["segment", "--ports", "0", "--link", "no-such-directory"],
    ["segment", "--ports", "65", "--link", "no-such-directory"], ["decode", "zz"],
    ["emulate", "si-p3", "--address", "126"], ["emulate", "si-p3", "--address", "5", "--set", "F6-33=2"],
    ["emulate", "si-p1", "--address", "5", "--set", "F6-33=1"],
])
def test_arguments_that_break_a_rule_are_one_line_and_2(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"dpmaster {argv[0]}: ") and err.count("\n") == 1
    assert not Path("no-such-directory").exists()


def test_output_that_cannot_be_written_is_one_line_and_1() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "dpmaster", "decode", "E5"], stdout=full, stderr=subprocess.PIPE,
                              text=True, timeout=30)
    assert (done.returncode, done.stderr) == (1, "dpmaster decode: No space left on device\n")


def test_sigint_ends_a_command_that_a_script_put_behind_an_ampersand(tmp_path: Path) -> None:
    """The shell starts those with SIGINT ignored."""
    script = (f"{sys.executable} -m dpmaster segment --ports 1 --link {tmp_path}/wire > {tmp_path}/out & "
              f"while [ ! -s {tmp_path}/out ]; do sleep 0.05; done; kill -INT $!; wait $!")
    assert subprocess.run(["sh", "-c", script], timeout=30).returncode == 0
    assert not (tmp_path / "wire").exists()
