"""Keeps a call from writing over what it reads, and from work whose result cannot be written."""

from __future__ import annotations

import argparse
import errno
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ehadiag.cli.defaults import NAME, user_file
from ehadiag.cli.history_file import history_place
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder

__all__ = ["Output", "names_taken", "refuse_overwriting", "refuse_unwritable"]

READ_BY_OPTIONS = ("actuator", "mapping", "dbc", "test")
"""Options, of any command, that name files to be read."""
BESIDE_HISTORY = ("", "-wal", "-shm", "-journal")
"""What SQLite appends to the name of a database for its own files."""
OF_RESULTS = (".json", ".png", ".html")
"""Suffixes of the files that an output folder has for each result."""


@dataclass(frozen=True, slots=True)
class Output:
    """A file that a call is to write whole, and by which option it was named."""

    option: str
    name: str

    def __str__(self) -> str:
        return f"{self.option} {self.name}"


def refuse_overwriting(
    arguments: argparse.Namespace,
    outputs: Iterable[Output],
    reads: Iterable[tuple[str, str]] = (),
) -> None:
    """Refuse a call one of whose outputs is an input of it, the health history, or another output.

    Files are the same by what the system says of them (also by links and other spellings), those
    that are not there yet by their resolved paths.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line: what it reads by options that commands share, and its history.
    outputs : Iterable[Output]
        What it will write.
    reads : Iterable[tuple[str, str]]
        What else it will read: its kind and its name.

    Raises
    ------
    ConfigurationError
        An output is named twice, or would replace what the call reads.
    """
    taken: dict[object, str] = {}
    for place in _history(arguments):
        taken[_identity(place)] = f"the health history {place}"
    for output in outputs:
        _refuse(str(output), taken.get(_identity(output.name)))
        taken[_identity(output.name)] = str(output)
    if not taken:
        return
    for kind, name in (*reads, *_by_options(arguments)):
        key = _identity(name)
        if key in taken and isinstance(key, tuple):  # it is there
            _refuse(taken[key], f"{kind} {name}")


def refuse_unwritable(outputs: Iterable[Output]) -> None:
    """Refuse a call one of whose outputs is to be in a folder in which nothing can be written.

    Parameters
    ----------
    outputs : Iterable[Output]
        What it will write.

    Raises
    ------
    InputOutputError
        There is no such folder, or no right to write in it.
    """
    for output in outputs:
        folder = Path(output.name).parent
        try:
            Folder.at(folder, RESULT_MODE, follow=True).close()
            if not os.access(folder, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        except (OSError, ValueError) as error:
            raise InputOutputError(f"{output}: {reason_of(error)}") from None


def names_taken(folder: Path, outputs: Iterable[Output]) -> set[str]:
    """Return the names, without suffix, that no result in a folder may have for these outputs."""
    there = os.path.realpath(folder)
    paths = [Path(output.name) for output in outputs]
    return {
        path.stem
        for path in paths
        if path.suffix in OF_RESULTS and os.path.realpath(path.parent) == there
    }


def _refuse(output: str, other: str | None) -> None:
    if other is not None:
        raise ConfigurationError(f"{output}: is {other} as well; name another file")


def _history(arguments: argparse.Namespace) -> list[str]:
    """Files of the history that the call works with, or could."""
    if not hasattr(arguments, "history"):
        return []
    place = history_place(arguments)
    return [] if place is None else [f"{place}{end}" for end in BESIDE_HISTORY]


def _by_options(arguments: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Files that options name, and those of defaults, each with what it is."""
    for key in READ_BY_OPTIONS:
        given = getattr(arguments, key, None) or []
        for name in [given] if isinstance(given, str) else given:
            yield f"--{key}", name
    for path in (Path(NAME), user_file()):
        if path is not None:
            yield "the defaults file", str(path)


def _identity(name: str) -> object:
    """What two names of one file have in common."""
    try:
        info = os.stat(name)
    except (OSError, ValueError):  # not there yet; ValueError: a name with a null character
        return os.path.normcase(os.path.realpath(name)) if "\0" not in name else name
    return (info.st_dev, info.st_ino)
