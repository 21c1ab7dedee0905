"""`ehadiag completion`: prints what makes a shell complete commands, options and files."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from ehadiag.cli.output import put
from ehadiag.core.errors import ConfigurationError

__all__ = ["add_parser", "run"]

FILES, FOLDERS = ("FILE", "LOG"), ("DIR",)
"""Metavariables whose values are paths."""


def add_parser(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser],
    whole: Callable[[], argparse.ArgumentParser],
) -> None:
    """Add the command; `whole` makes the parser of all commands."""
    parser = subparsers.add_parser(
        "completion",
        help="print a shell's completion script",
        description="Print a completion script: for bash, put its output into"
        " ~/.local/share/bash-completion/completions/ehadiag.",
        allow_abbrev=False,
    )
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="which shell")
    parser.set_defaults(run=lambda arguments: run(arguments, whole()))


def run(arguments: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Print the script."""
    try:
        import shtab  # noqa: PLC0415 - optional
    except ImportError:
        raise ConfigurationError(
            "completion: needs shtab, pip install 'ehadiag[completion]'"
        ) from None
    for action in _actions(parser):
        names = action.metavar if isinstance(action.metavar, str) else ""
        if names.endswith(FILES):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif names.endswith(FOLDERS):
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    put(shtab.complete(parser, arguments.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """All options and arguments, of all commands."""
    found: list[argparse.Action] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                found += _actions(command)
        else:
            found.append(action)
    return found
