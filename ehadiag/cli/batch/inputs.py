"""Which recordings a command line names: files, folders, patterns, a list on standard input."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ehadiag.cli.batch.own_tables import is_table_of_results
from ehadiag.cli.output import say
from ehadiag.core.errors import ConfigurationError, reason_of

__all__ = ["Input", "expand"]

STANDARD_INPUT = "-"
MOST_LIST_BYTES = 64 << 20
"""A list of a hundred thousand long names is a tenth of it."""


@dataclass(frozen=True, slots=True)
class Input:
    """One recording to diagnose."""

    name: str
    """As it was named, or as it was found."""
    why: str = ""
    """Why there is none; empty for a recording."""


def expand(names: Iterable[str]) -> list[Input]:
    """Return the recordings that arguments stand for, in their order and as often as named.

    A folder stands for all recordings in it and below, in the order of their names, but not for
    hidden ones, what lies in hidden folders or behind links, and tables of results; a pattern
    (`*`, `?`, `[…]`, `**`), where there is no file of that name, for what it matches; `-` for the
    names on standard input, one a line, or ended by null characters.

    Parameters
    ----------
    names : Iterable[str]
        Arguments of the command.

    Returns
    -------
    list[Input]
        What stands for nothing is there too, with the reason.

    Raises
    ------
    ConfigurationError
        The list on standard input is longer than any list of names.
    """
    return [item for name in names for item in _expanded(name)]


def _expanded(name: str) -> Iterator[Input]:
    if name == STANDARD_INPUT:
        for line in _listed():
            yield from _found(line)
    else:
        yield from _found(name)


def _found(name: str) -> Iterator[Input]:
    if os.path.isdir(name):
        yield from _in_folder(name)
    elif glob.has_magic(name) and not os.path.lexists(name):
        matches = sorted(glob.glob(name, recursive=True))
        for match in matches:
            yield from _in_folder(match) if os.path.isdir(match) else iter([Input(match)])
        if not matches:
            yield Input(name, f"pattern {name}: matches no file")
    else:
        yield Input(name)


def _in_folder(folder: str) -> Iterator[Input]:
    from firmware_iface.logs.blocks import SUFFIXES  # noqa: PLC0415 - loads numpy
    from firmware_iface.logs.packed import kind_of  # noqa: PLC0415
    from firmware_iface.signals.tables import DECODED_SUFFIXES  # noqa: PLC0415

    known = {*SUFFIXES, *DECODED_SUFFIXES}
    links: list[str] = []
    inside = []
    closed: list[OSError] = []
    for place, folders, names in os.walk(folder, onerror=closed.append):
        folders[:] = [name for name in folders if not name.startswith(".")]
        links += [path for name in folders if os.path.islink(path := os.path.join(place, name))]
        inside += [
            os.path.join(place, name)
            for name in names
            if not name.startswith(".") and kind_of(Path(name)) in known
        ]
    ours = [name for name in inside if is_table_of_results(Path(name))]
    _tell(folder, links, "a link to a folder is not followed, name the folder to read it")
    _tell(folder, ours, "a table of results is no recording")
    recordings = sorted(set(inside).difference(ours))
    for error in closed:
        yield Input(error.filename, f"folder {error.filename}: {reason_of(error)}")
    if not recordings and not closed:
        yield Input(folder, f"folder {folder}: no recording in it ({', '.join(sorted(known))})")
    yield from map(Input, recordings)


def _tell(folder: str, left_out: list[str], why: str) -> None:
    """Say what of a folder is left out."""
    if left_out:
        more = f" and {len(left_out) - 1} more" if len(left_out) > 1 else ""
        say(f"folder {folder}: {why}: {min(left_out)}{more}")


def _listed() -> list[str]:
    """Names on standard input."""
    stream = getattr(sys.stdin, "buffer", None)
    if stream is None:  # a text put in its place
        content = sys.stdin.read(MOST_LIST_BYTES + 1)
    else:
        content = os.fsdecode(stream.read(MOST_LIST_BYTES + 1))
    if len(content) > MOST_LIST_BYTES:
        raise ConfigurationError(f"standard input: more than {MOST_LIST_BYTES} bytes of names")
    lines = content.split("\0") if "\0" in content else content.splitlines()
    return [line for line in lines if line.strip()]
