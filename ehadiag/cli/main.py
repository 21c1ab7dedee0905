"""Entry point of `ehadiag`: one parser, and one place where errors become exit codes."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from ehadiag.cli.commands import bit, diagnose, history, replay, report, rul, sim, tests, warmup
from ehadiag.cli.commands import check_bus as checkbus
from ehadiag.cli.interrupt import ignore_signals, interrupt_on_signals, signals_restored
from ehadiag.cli.output import abandon, say
from ehadiag.cli.version import ShowVersions
from ehadiag.core.errors import EhadiagError, InputOutputError
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
        interrupt_on_signals()
        return _run(argv)


def process() -> NoReturn:
    """Run the command line as this process: a signal after the verdict does not hide its code."""
    interrupt_on_signals()
    code = _run(None)
    ignore_signals()
    sys.exit(code)


def _run(argv: Sequence[str] | None) -> int:
    _fill_closed_streams()
    _print_whatever_comes()
    code = 0
    try:
        arguments = _parser().parse_args(argv)
        code = int(arguments.run(arguments))
        sys.stdout.flush()
    except EhadiagError as error:
        say(str(error))
        return error.exit_code
    except BrokenPipeError:
        # Whoever read our output has gone.
        abandon(sys.stdout)
        return max(code, InputOutputError.exit_code)
    except OSError as error:
        abandon(sys.stdout)
        say(f"{error.filename or 'standard output'}: {error.strerror or error}")
        return max(code, InputOutputError.exit_code)
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED
    return code


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
    parser = _Parser(
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
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in (bit, diagnose, sim, tests, checkbus, replay, history, rul, report, warmup):
        command.add_parser(subparsers)
    return parser


if __name__ == "__main__":
    process()
