"""Which health history a command works with, and keeping diagnoses in it."""

from __future__ import annotations

import argparse
import hashlib
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli.options import positive_number
from firmware_iface.errors import ConfigurationError, InputOutputError

if TYPE_CHECKING:
    from ehadiag.history.records import Usage
    from ehadiag.history.store import History, HistorySnapshot
    from ehadiag.result import Result

HISTORY_VARIABLE = "EHADIAG_HISTORY"


def add_history_option(parser: argparse.ArgumentParser, *, again: bool = False) -> None:
    """Add `--history`.

    parser: of a command, or of a verb of one; again: the command has it already: without it here
    what was said there holds.
    """
    parser.add_argument(
        "--history",
        metavar="FILE",
        default=argparse.SUPPRESS if again else None,
        help=f"health history, SQLite (default: {HISTORY_VARIABLE}, else the user's own once"
        " `ehadiag history init` was called)",
    )


def add_usage_options(
    parser: argparse.ArgumentParser, when: str = "since it was new, for the health history"
) -> None:
    """Add `--hours` and `--cycles`; when: at what time the unit has them."""
    for name, what in (("hours", "operating hours"), ("cycles", "cycles")):
        parser.add_argument(
            f"--{name}",
            type=partial(positive_number, or_zero=True),
            metavar="N",
            help=f"{what} of the unit {when}",
        )


def add_history_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of commands that append their diagnoses to a history."""
    add_history_option(parser)
    parser.add_argument(
        "--no-history", action="store_true", help="append nothing to any health history"
    )
    add_usage_options(parser)


def usage_from_options(arguments: argparse.Namespace) -> Usage:
    """Return the hours and cycles that were named."""
    from ehadiag.history.records import Usage  # noqa: PLC0415

    return Usage(arguments.hours, arguments.cycles)


def history_path(arguments: argparse.Namespace) -> Path | None:
    """Return the file that was named, else the user's own if there is one."""
    named = arguments.history or os.environ.get(HISTORY_VARIABLE)
    if named:
        return Path(named)
    from ehadiag.history.records import user_history_path  # noqa: PLC0415

    own = user_history_path()
    return own if own is not None and own.exists() else None


def open_named_history(arguments: argparse.Namespace) -> History:
    """Open the history that there is; ConfigurationError where there is none."""
    place = history_path(arguments)
    if place is None:
        raise ConfigurationError(
            f"no health history: name one by --history or {HISTORY_VARIABLE}, or begin one by"
            " ehadiag history init"
        )
    from ehadiag.history.store import History  # noqa: PLC0415

    return History(place)


def units_of(history: History, actuator: str | None) -> list[tuple[str, int]]:
    """Return actuator and serial number of all units, or of those of an actuator that was named."""
    units = history.units()
    if actuator is not None and all(kind != actuator for kind, _ in units):
        known = ", ".join(dict.fromkeys(kind for kind, _ in units)) or "none"
        raise ConfigurationError(f"--actuator {actuator}: there is {known}")
    return [unit for unit in units if actuator in (None, unit[0])]


def append_result(
    place: Path, result: Result, usage: Usage, *, simulated: bool = False, create: bool = True
) -> None:
    """Append a result to a history; InputOutputError where it cannot be, and nothing of it is."""
    from ehadiag.history.records import history_entry  # noqa: PLC0415
    from ehadiag.history.store import History  # noqa: PLC0415

    entry = history_entry(result, usage, simulated=simulated)
    try:
        with History(place, create=create) as history:
            history.append(entry)
    except ConfigurationError as error:  # exchanged since the call began
        raise InputOutputError(str(error)) from None


class HistoryWriter:
    """Appends the diagnoses of one call to the history, where there is one.

    arguments: the parsed command line. ConfigurationError: hours or cycles without a history; the
    file is none; InputOutputError: the history cannot be opened.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._kept: set[bytes] | None = None
        """Digests of what was in it when that was asked first."""
        self.place = self._place()
        """Of the history; None: nothing is kept."""
        if self.place is not None:
            self._try()
        elif arguments.hours is not None or arguments.cycles is not None:
            raise ConfigurationError(
                "--hours, --cycles: no health history to keep them in: name one by --history, or"
                " begin one by ehadiag history init"
            )

    def keep(self, result: Result) -> None:
        """Append a result; InputOutputError where it cannot be, and then nothing of it is."""
        if self.place is None:
            return
        append_result(
            self.place, result, usage_from_options(self._arguments), simulated=self._simulated
        )

    def snapshot(self) -> HistorySnapshot | None:
        """Return the history as it is now; None where there is none."""
        if self.place is None or not self.place.exists():
            return None
        from ehadiag.history.store import HistorySnapshot  # noqa: PLC0415

        with self._open() as history:
            return HistorySnapshot(self.place, history.last_number)

    def has(self, result: Result) -> bool:
        """Whether a result need not be appended: it was, or there is no history."""
        if self.place is None:
            return True
        if not self.place.exists():
            return False
        if self._kept is None:
            with self._open() as history:
                self._kept = {_line_digest(kept) for kept in history.results()}
        return _line_digest(result.to_json()) in self._kept

    @property
    def _simulated(self) -> bool:
        return bool(getattr(self._arguments, "simulate", False))

    def _place(self) -> Path | None:
        if self._arguments.no_history:
            if self._arguments.history:
                raise ConfigurationError("--history and --no-history exclude each other")
            return None
        if self._simulated and not self._arguments.history:
            return None  # a simulated unit is none of the fleet's unless somebody wants it there
        return history_path(self._arguments)

    def _try(self) -> None:
        """Say before a test begins or a log is read what is wrong; make no file yet."""
        assert self.place is not None
        if os.path.lexists(self.place):
            self._open().close()
        elif not os.access(self.place.parent, os.W_OK | os.X_OK):
            raise InputOutputError(
                f"history {self.place}: cannot be opened: no such folder, or no right to it"
            )

    def _open(self) -> History:
        from ehadiag.history.store import History  # noqa: PLC0415

        assert self.place is not None
        return History(self.place, create=True)


def _line_digest(line: str) -> bytes:
    return hashlib.sha256(line.encode()).digest()
