"""Entry point of `ehadiag`: one parser, and one place where errors become exit codes."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from ehadiag.cli.commands import bit, diagnose, replay, sim, tests, warmup
from ehadiag.cli.commands import check_bus as checkbus
from ehadiag.cli.version import ShowVersions
from ehadiag.core.errors import EhadiagError, InputOutputError

__all__ = ["main"]

EPILOG = """\
exit codes: 0 healthy, 10 degraded, 20 fault, 30 not tested (reason given),
2 wrong usage or configuration, 3 input/output failure; several logs: the worst."""
BROKEN_PIPE = 3
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and where to read on."""

    def error(self, message: str) -> NoReturn:
        command = self.prog.partition(" ")[2]
        where = f"{command}: " if command else ""
        self.exit(2, f"ehadiag: {where}{message}; see {self.prog} --help\n")


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
    _fill_closed_streams()
    arguments = _parser().parse_args(argv)
    try:
        code = arguments.run(arguments)
        sys.stdout.flush()
        return int(code)
    except EhadiagError as error:
        print(f"ehadiag: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        # Whoever read our output has gone; what is left of it must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        print(f"ehadiag: standard output: {error.strerror or error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return InputOutputError.exit_code
    except KeyboardInterrupt:
        print("ehadiag: interrupted", file=sys.stderr)
        return INTERRUPTED


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
    for command in (bit, diagnose, sim, tests, checkbus, replay, warmup):
        command.add_parser(subparsers)
    return parser


if __name__ == "__main__":
    sys.exit(main())
