"""Entry point of `ehadiag`: one parser, and one place where errors become exit codes.

Also `--version` and `--verbose`.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import io
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import ehadiag
from ehadiag.cli.command_parser import (
    DEFAULTS_FILE_NAME,
    CommandParser,
    apply_defaults,
    refuse_former_options,
)
from ehadiag.core.interruption import (
    INTERRUPTED_EXIT_CODE,
    ignore_signals,
    interrupt_on_signals,
    is_computing,
    signals_restored,
)
from ehadiag.terminal.output import (
    INPUT_OUTPUT_EXIT_CODE,
    discard_stream,
    print_status,
    worst_exit_code,
)
from firmware_iface.errors import EhadiagError, reason_of

COMMANDS = {
    "bit": ("bit_command", "request a built-in test on a bus, record and diagnose it"),
    "diagnose": ("diagnose_commands", "diagnose recordings"),
    "monitor": ("bus_commands", "watch an actuator on a bus, and raise an alarm when it changes"),
    "serve": ("serve_command", "show the bus, tests, reports and history on a local web page"),
    "calibrate": (
        "calibrate_commands",
        "learn a unit from recordings of it as new, as an actuator file",
    ),
    "design": ("calibrate_commands", "score a test by what it can show, propose a better one"),
    "sim": ("bus_commands", "run the emulated flight-control computer on a bus"),
    "tests": ("setup_commands", "list the stored tests"),
    "check-bus": ("bus_commands", "listen to a bus and report what maps, rates, gaps, range use"),
    "replay": ("bus_commands", "play a recording onto a bus"),
    "history": (
        "history_commands",
        "health history: list, show, export, import, plot, init, event, withdraw",
    ),
    "rul": ("rul_command", "remaining useful life of a unit, or of all, from the health history"),
    "report": ("diagnose_commands", "write reports (HTML) from stored results"),
    "export": ("setup_commands", "write the kernels as a library for another computer"),
    "warmup": ("setup_commands", "compile the kernels now"),
    "init": (
        "setup_commands",
        "write a commented template of an actuator, test, mapping or defaults file",
    ),
    "completion": ("setup_commands", "print a shell's completion script"),
}
"""Commands: the module, loaded when the command is called, and the help's line."""


class VersionAction(argparse.Action):
    """Print one line and end: the package's version first, then those of Python and libraries."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        """Print and end; only who asks waits for the look-up."""
        print(versions_text())
        parser.exit()


def versions_text() -> str:
    """Return the versions of this package, of Python, and of the libraries that matter."""
    import platform  # noqa: PLC0415 - only who asks
    from importlib.metadata import version  # noqa: PLC0415 - reads a file for each library

    from ehadiag.compile.libraries import compiler_versions  # noqa: PLC0415

    parts = [f"Python {platform.python_version()}"]
    parts += [
        f"numpy {version('numpy')}",
        f"numba {compiler_versions().get('numba', 'absent')}",
        f"python-can {version('python-can')}",
    ]
    return f"ehadiag {ehadiag.__version__} ({', '.join(parts)})"


def print_verbose(arguments: argparse.Namespace) -> None:
    """Say versions and options, and let what libraries log reach standard error."""
    import logging  # noqa: PLC0415 - only who wants to see it

    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
    print_status(versions_text())
    given = {key: value for key, value in vars(arguments).items() if key not in ("run", "verbose")}
    print_status(", ".join(f"{key}={value!r}" for key, value in sorted(given.items())))


EPILOG = """\
exit codes: 0 healthy, 10 degraded, 20 fault, 30 not tested (reason given),
2 wrong usage or configuration, 3 input/output failure; several logs: the worst."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code.

    argv: arguments after the program's name; None: those of the process. Returns exit code.
    SystemExit: wrong usage (code 2), `--help` and `--version`.
    """
    with signals_restored():
        return _run(argv, interrupt_on_signals())


def process() -> NoReturn:
    """Run the command line as this process: a signal after the verdict does not hide its code."""
    # Before numpy is loaded: products of so few rows take twice the processor time on two threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = _run(None, interrupt_on_signals())
    ignore_signals()
    if is_computing():
        # Compiled code that goes on while the interpreter is taken down may crash, and the code
        # with it.
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    sys.exit(code)


def _run(argv: Sequence[str] | None, interrupted: threading.Event) -> int:
    _fill_closed_streams()
    _escape_unprintable()
    code = 0
    try:
        arguments = parse_arguments(argv)
        code = int(arguments.run(arguments))
        sys.stdout.flush()
    except EhadiagError as error:
        print_status(str(error))
        return error.exit_code
    except BrokenPipeError:
        # Whoever read our output has gone.
        discard_stream(sys.stdout)
        return worst_exit_code((code, INPUT_OUTPUT_EXIT_CODE))
    except OSError as error:
        discard_stream(sys.stdout)
        print_status(f"{error.filename or 'standard output'}: {reason_of(error)}")
        return worst_exit_code((code, INPUT_OUTPUT_EXIT_CODE))
    except (KeyboardInterrupt, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not interrupted.is_set():
            raise  # else the compiler has turned an interruption into this error
        print_status("interrupted")
        return INTERRUPTED_EXIT_CODE
    return code


def parse_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse a command line with its defaults; more logs (results) may follow the options.

    argv: arguments after the program's name; None: those of the process. Returns with the function
    `run` of the command. ConfigurationError: a default that no option takes; SystemExit: wrong
    usage, `--help` and `--version`.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    command = next((item for item in given if not item.startswith("-")), "")
    if given[:1] in (["-h"], ["--help"]):
        command = ""
    parser, commands = parser_and_commands(command)
    if not given:
        parser.print_help()
        parser.exit(2)
    called = commands.get(command, parser)
    assert isinstance(called, CommandParser)
    refuse_former_options(called, given)
    used: Sequence[str] = ()
    if command in commands:
        used, ignored = apply_defaults(command, called, given, lambda: parser_and_commands()[1])
        for text in ignored:
            print_status(text)
    arguments, rest = parser.parse_known_args(given)
    late = [item for item in rest if item == "-" or not item.startswith("-")]
    files = _repeatable_argument(called)
    if files is not None and len(late) == len(rest):
        getattr(arguments, files).extend(late)
    elif rest:
        called.refuse_unknown(rest)
    if used and (arguments.verbose or DEFAULTS_FILE_NAME in used):
        print_status(f"defaults from {', '.join(used)}")
    if arguments.verbose:
        print_verbose(arguments)
    return arguments


def _repeatable_argument(command: argparse.ArgumentParser) -> str | None:
    """Where the arguments of a command are that may be repeated; None where it has none."""
    return next(
        (item.dest for item in command._actions if item.nargs == "+" and not item.option_strings),
        None,
    )


def _escape_unprintable() -> None:
    """Let a name that the terminal's encoding lacks be printed as numbers, not end the program."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _fill_closed_streams() -> None:
    """Open what the caller closed: else the next file opened is taken for a standard stream."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115


def parser_and_commands(
    command: str | None = None,
) -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """Make the parser, and those of the commands.

    command: the only one that is wanted; "" or another word: all without their options; None: all.
    """
    parser: argparse.ArgumentParser = CommandParser(
        prog="ehadiag",
        description="Diagnosis of electrohydraulic actuators: clogging of the first-stage filter\n"
        "(Kintas), spool friction (FSS), jack friction (FDJ), each 0 (as new) … 1 (full damage).",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version",
        action=VersionAction,
        nargs=0,
        help="print versions, also of libraries, and exit",
    )
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser] = parser.add_subparsers(
        metavar="COMMAND", required=True
    )
    # A parser takes 1 ms to make.
    for name in COMMANDS if command not in COMMANDS else [command]:
        module, text = COMMANDS[name]
        made = subparsers.add_parser(name, help=text, allow_abbrev=False)
        if command in (name, None):
            functions = vars(import_module(f"ehadiag.cli.{module}"))
            key = name.replace("-", "_")
            made.set_defaults(run=functions[f"run_{key}"])
            functions[f"define_{key}"](made)
            made.add_argument(
                "-v", "--verbose", action="store_true",
                help="print versions, options in force and their origin, and logs of libraries",
            )  # fmt: skip
    return parser, subparsers.choices
