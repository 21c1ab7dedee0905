"""Entry point of `ehadiag`: one parser, and one place where errors become exit codes."""

from __future__ import annotations

import argparse
import io
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from ehadiag.cli.commands import (
    bit,
    calibrate,
    completion,
    design,
    diagnose,
    export,
    history,
    init,
    monitor,
    replay,
    report,
    rul,
    serve,
    sim,
    tests,
    warmup,
)
from ehadiag.cli.commands import check_bus as checkbus
from ehadiag.cli.defaults import NAME, apply_defaults
from ehadiag.cli.exit_codes import FAILED, worst_code
from ehadiag.cli.interrupt import ignore_signals, interrupt_on_signals, signals_restored
from ehadiag.cli.output import abandon, say
from ehadiag.cli.verbose import tell_all
from ehadiag.cli.version import ShowVersions
from ehadiag.core.errors import EhadiagError, reason_of
from ehadiag.core.printable import printable

__all__ = ["main", "process"]

EPILOG = """\
exit codes: 0 healthy, 10 degraded, 20 fault, 30 not tested (reason given),
2 wrong usage or configuration, 3 input/output failure; several logs: the worst."""
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and where to read on."""

    def error(self, message: str) -> NoReturn:
        command = self.prog.partition(" ")[2]
        where = f"{command}: " if command else ""
        self.exit(2, f"ehadiag: {where}{printable(message)}; see {self.prog} --help\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code.

    Parameters
    ----------
    argv : Sequence[str] | None
        Arguments after the program's name; None: those of the process.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    SystemExit
        Wrong usage (code 2), `--help` and `--version`.
    """
    with signals_restored():
        return _run(argv, interrupt_on_signals())


def process() -> NoReturn:
    """Run the command line as this process: a signal after the verdict does not hide its code."""
    code = _run(None, interrupt_on_signals())
    ignore_signals()
    sys.exit(code)


def _run(argv: Sequence[str] | None, interrupted: threading.Event) -> int:
    _fill_closed_streams()
    _print_whatever_comes()
    code = 0
    try:
        arguments = _parsed(argv)
        code = int(arguments.run(arguments))
        sys.stdout.flush()
    except EhadiagError as error:
        say(str(error))
        return error.exit_code
    except BrokenPipeError:
        # Whoever read our output has gone.
        abandon(sys.stdout)
        return worst_code((code, FAILED))
    except OSError as error:
        abandon(sys.stdout)
        say(f"{error.filename or 'standard output'}: {reason_of(error)}")
        return worst_code((code, FAILED))
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED
    except RuntimeError:
        if not interrupted.is_set():
            raise
        say("interrupted")
        return INTERRUPTED
    return code


def _parsed(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line; more logs (results) may follow the options that follow logs."""
    parser, commands = _parser_and_commands()
    given = sys.argv[1:] if argv is None else list(argv)
    used, ignored = apply_defaults(commands, given)
    for text in ignored:
        say(text)
    arguments, rest = parser.parse_known_args(given)
    late = [item for item in rest if item == "-" or not item.startswith("-")]
    files = _repeated(commands, given)
    if files is not None and len(late) == len(rest):
        getattr(arguments, files).extend(late)
    elif rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if used and (arguments.verbose or NAME in used):
        say(f"defaults from {', '.join(used)}")
    if arguments.verbose:
        tell_all(arguments)
    return arguments


def _repeated(commands: Mapping[str, argparse.ArgumentParser], given: Sequence[str]) -> str | None:
    """Where the arguments of the command are that may be repeated; None where it has none."""
    command = next((item for item in given if not item.startswith("-")), "")
    actions = commands[command]._actions if command in commands else []
    return next(
        (item.dest for item in actions if item.nargs == "+" and not item.option_strings), None
    )


def _print_whatever_comes() -> None:
    """Let a name that the terminal's encoding lacks be printed as numbers, not end the program."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _fill_closed_streams() -> None:
    """Open what the caller closed: else the next file opened is taken for a standard stream."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115


def _parser() -> argparse.ArgumentParser:
    return _parser_and_commands()[0]


def _parser_and_commands() -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    parser: argparse.ArgumentParser = _Parser(
        prog="ehadiag",
        description="Diagnosis of electrohydraulic actuators: clogging of the first-stage filter\n"
        "(Kintas), spool friction (FSS), jack friction (FDJ), each 0 (as new) … 1 (limit).",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version",
        action=ShowVersions,
        nargs=0,
        help="print versions, also of libraries, and exit",
    )
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser] = parser.add_subparsers(
        metavar="COMMAND", required=True
    )
    for command in (
        bit, diagnose, monitor, serve, calibrate, design, sim, tests, checkbus, replay, history,
        rul, report, export, warmup, init,
    ):  # fmt: skip
        command.add_parser(subparsers)
    completion.add_parser(subparsers, _parser)
    for item in subparsers.choices.values():
        item.add_argument("-v", "--verbose", action="store_true", help="tell more on the way")
    return parser, subparsers.choices
