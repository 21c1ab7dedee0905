"""Writes the results of a call: first to the disk, then to standard output, the picture last.

No output replaces what the call reads, and none is begun that cannot be written.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import hashlib
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.cli.command_parser import DEFAULTS_FILE_NAME, user_defaults_file
from ehadiag.cli.options import history_path, usage_from_options
from ehadiag.core.conventions import MAX_RESULT_BYTES, SIGNAL_FILE_SUFFIXES
from ehadiag.core.interruption import defer_signals
from ehadiag.report.rendering import diagnosis_html_page, diagnosis_png
from ehadiag.result import Origin, Result
from ehadiag.terminal.output import (
    print_status,
    print_text,
    report_failure,
    terminal_console,
    worst_exit_code,
    write_drawn,
    write_output,
)
from firmware_iface.errors import (
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    plain_name,
    reason_of,
)
from firmware_iface.files import RESULT_MODE, Folder, write_errors

if TYPE_CHECKING:
    from ehadiag.history.records import Usage
    from ehadiag.history.store import History, HistorySnapshot
    from ehadiag.prognosis.units import Prognosis

INPUT_FILE_OPTIONS = ("actuator", "mapping", "dbc", "test", "prior")
"""Options, of any command, that name files to be read."""
SQLITE_SUFFIXES = ("", "-wal", "-shm", "-journal")
"""What SQLite appends to the name of a database for its own files."""
RESULT_SUFFIXES = (".json", ".png", ".html")
"""Suffixes of the files that an output folder has for each result."""


class OutputFile(msgspec.Struct, frozen=True):
    """A file that a call is to write whole, and by which option it was named."""

    option: str
    name: str

    def __str__(self) -> str:
        return f"{self.option} {self.name}"


def refuse_overwriting(
    arguments: argparse.Namespace,
    outputs: Iterable[OutputFile],
    reads: Iterable[tuple[str, str]] = (),
) -> None:
    """Refuse a call one of whose outputs is an input of it, the health history, or another output.

    Files are the same by what the system says of them (also by links and other spellings), those
    that are not there yet by their resolved paths.

    arguments: the parsed command line: what it reads by options that commands share, and its
    history; outputs: what it will write; reads: what else it will read: its kind and its name.
    ConfigurationError: an output is named twice, or would replace what the call reads.
    """
    taken: dict[object, str] = {}
    for place in _history_files(arguments):
        taken[_file_identity(place)] = f"the health history {place}"
    for output in outputs:
        _refuse_same_file(str(output), taken.get(_file_identity(output.name)))
        taken[_file_identity(output.name)] = str(output)
    if not taken:
        return
    for kind, name in (*reads, *_input_files(arguments)):
        key = _file_identity(name)
        if key in taken and isinstance(key, tuple):  # it is there
            _refuse_same_file(taken[key], f"{kind} {name}")


def refuse_unwritable(outputs: Iterable[OutputFile]) -> None:
    """Refuse a call one of whose outputs is to be in a folder in which nothing can be written.

    InputOutputError: there is no such folder, or no right to write in it.
    """
    for output in outputs:
        folder = Path(output.name).parent
        try:
            Folder.at(folder, RESULT_MODE, follow=True).close()
            if not os.access(folder, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        except (OSError, ValueError) as error:
            raise InputOutputError(f"{output}: {reason_of(error)}") from None


def reserved_stems(folder: Path, outputs: Iterable[OutputFile]) -> set[str]:
    """Return the names, without suffix, that no result in a folder may have for these outputs."""
    there = os.path.realpath(folder)
    paths = [Path(output.name) for output in outputs]
    return {
        path.stem
        for path in paths
        if path.suffix in RESULT_SUFFIXES and os.path.realpath(path.parent) == there
    }


def _refuse_same_file(output: str, other: str | None) -> None:
    if other is not None:
        raise ConfigurationError(f"{output}: is {other} as well; name another file")


def _history_files(arguments: argparse.Namespace) -> list[str]:
    """Files of the history that the call works with, or could."""
    if not hasattr(arguments, "history"):
        return []
    place = history_path(arguments)
    return [] if place is None else [f"{place}{end}" for end in SQLITE_SUFFIXES]


def _input_files(arguments: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Files that options name, and those of defaults, each with what it is."""
    for key in INPUT_FILE_OPTIONS:
        given = getattr(arguments, key, None) or []
        for name in [given] if isinstance(given, str) else given:
            yield f"--{key}", name
    for path in (Path(DEFAULTS_FILE_NAME), user_defaults_file()):
        if path is not None:
            yield "the defaults file", str(path)


def _file_identity(name: str) -> object:
    """What two names of one file have in common."""
    try:
        info = os.stat(name)
    except (OSError, ValueError):  # not there yet; ValueError: a name with a null character
        return os.path.normcase(os.path.realpath(name)) if "\0" not in name else name
    return (info.st_dev, info.st_ino)


ATTACHMENT_SUFFIXES = (".png", ".html", *SIGNAL_FILE_SUFFIXES)
"""Suffixes of what stands beside a result: picture, report and signals."""


def open_output_folder(name: str) -> Folder:
    """Open the output folder, created if need be.

    name: as the user named it. Returns the folder, held open. InputOutputError: it cannot be
    created or written in, or is a link.
    """
    path = Path(name)
    try:
        if path.is_symlink():
            raise InputOutputError(f"output folder {name}: is a link; name the folder it leads to")
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK):
            raise InputOutputError(f"output folder {name}: no right to write in it")
        return Folder.at(path, RESULT_MODE)
    except FileExistsError:
        raise InputOutputError(f"output folder {name}: is a file; name a folder") from None
    except OSError as error:
        raise InputOutputError(f"output folder {name}: {reason_of(error)}") from None


class ResultWriter:
    """Where the results of one call go.

    arguments: the parsed command line; folder: for JSON and pictures; None: nothing is written;
    taken: names, without suffix, that other files of the call have there.
    """

    def __init__(
        self, arguments: argparse.Namespace, folder: Folder | None, taken: Iterable[str] = ()
    ) -> None:
        self._arguments = arguments
        self._folder = folder
        self._names = set(taken)
        self.history = HistoryWriter(arguments)
        """Health history that the results are kept in."""
        if arguments.report and folder is None:
            raise ConfigurationError("--report: name by --out the folder where the page goes")
        self._signals = tuple(dict.fromkeys(arguments.signals))
        if self._signals and folder is None:
            raise ConfigurationError("--signals: name by --out the folder where the files go")
        if self._signals:
            from ehadiag.report.signal_files import signal_library  # noqa: PLC0415 - slow

            for kind in self._signals:
                signal_library(kind)
        self.stopped = False
        """Whether a signal came while a result was brought out."""

    def load(self) -> None:
        """Load what printing needs: a verdict must not wait for it."""
        if not self._arguments.json:
            import ehadiag.report.head  # noqa: PLC0415

            terminal_console()
        if self._arguments.report:
            import ehadiag.report.report_pages  # noqa: F401, PLC0415

    def deliver(
        self, result: Result, name: str, picture: bytes | None = None, *, alone: bool = True
    ) -> int:
        """Write and print one result; return its exit code.

        That is the verdict's, or 3 where something could not be written and that is worse (see
        `worst_exit_code`). From here on signals do not change it: the first leaves the picture out,
        the second what is not out yet.

        name: of the files, without suffix; made safe, and numbered where it is taken. picture: PNG;
        None: drawn here, where there are samples. alone: whether a forecast is worth its time.
        """
        came = defer_signals()
        codes = [result.exit_code]
        with contextlib.suppress(KeyboardInterrupt):
            stem = None
            with report_failure(codes):
                stem = self._write_json(result, plain_name(name))
            with report_failure(codes):
                self.history.keep(result)
            written = [f"{stem}.json"]
            with report_failure(codes):
                self._print(result, self._prognosis(result) if alone else None)
            if stem is not None and self._folder is not None:
                for what, suffix, content in self._attachments(result, picture):
                    if came.is_set():
                        break
                    name = f"{stem}{suffix}"
                    with report_failure(codes):
                        made = content()
                        with write_errors(f"{what} {self._folder.path / name}"):
                            self._folder.write(name, made)
                        written.append(name)
                print_status(
                    "wrote " + ", ".join(str(self._folder.path / item) for item in written)
                )
        self.stopped = self.stopped or came.is_set()
        return worst_exit_code(codes)

    def refuse(self, result: Result) -> None:
        """Say what is wrong with an input, and print its object."""
        if result.error is not None:
            print_status(result.error.text)
        if self._arguments.json:
            write_output(result.to_json() + "\n")

    def repeat(self, result: Result) -> None:
        """Print a result that an earlier call found: its object, or one line."""
        if self._arguments.json:
            write_output(result.to_json() + "\n")
        else:
            from ehadiag.report.head import verdict_word  # noqa: PLC0415

            word = verdict_word(result.verdict.name, identified=result.identified)
            print_text(f"{word}  {result.source}  (found by an earlier call)")

    def has(self, result: Result, name: str) -> bool:
        """Whether all that this call is to write of a result is there from an earlier one.

        name: of the files, without suffix, as for `deliver`.
        """
        return self.history.has(result) and self._has_files(result, plain_name(name))

    def _has_files(self, result: Result, wanted: str) -> bool:
        folder = self._folder
        if folder is None:
            return True
        content = result.to_json().encode() + b"\n"
        suffixes = [".png"] * self.pictures + [".html"] * bool(self._arguments.report)
        if any(item.samples_sha256 for item in result.origins):
            suffixes += [f".signals.{kind}" for kind in self._signals]
        for stem in _numbered_stems(wanted):
            try:
                there = folder.read(f"{stem}.json", MAX_RESULT_BYTES)
            except OSError:
                return False
            if there == content:
                return all(folder.exists(f"{stem}{suffix}") for suffix in suffixes)
        raise AssertionError("numbers have no end")

    @property
    def pictures(self) -> bool:
        """Whether pictures are wanted."""
        return self._folder is not None and not self._arguments.no_picture

    def _prognosis(self, result: Result) -> Prognosis | None:
        """Forecast the unit of a result that asks by when, from the history; some 0.3 s."""
        place = self.history.place
        if place is None or result.serial is None or result.verdict is not Verdict.DEGRADED:
            return None
        from ehadiag.prognosis.units import forecast  # noqa: PLC0415 - loads numpy

        request = result.request
        with contextlib.suppress(EhadiagError):  # said when the diagnosis was to be kept
            return forecast(place, result.serial, advisory=request.advisory, limit=request.limit)
        return None

    def _print(self, result: Result, prognosis: Prognosis | None) -> None:
        if self._arguments.json:
            write_output(result.to_json() + "\n")
            return
        from ehadiag.report.head import print_result  # noqa: PLC0415

        verbose = self._arguments.verbose
        console = terminal_console()
        print_result(result, console, prognosis, verbose=verbose)
        write_drawn(console)

    def _write_json(self, result: Result, wanted: str) -> str | None:
        """Write the object under the first name that no other recording's result has."""
        folder = self._folder
        if folder is None:
            return None
        content = result.to_json().encode() + b"\n"
        for stem in _numbered_stems(wanted):
            if stem in self._names:
                continue
            name = f"{stem}.json"
            try:
                if _is_same_recording(folder, name, result):
                    folder.write(name, content)
                    for suffix in ATTACHMENT_SUFFIXES:  # of the result that is no more
                        folder.remove(f"{stem}{suffix}")
                elif any(folder.exists(f"{stem}{suffix}") for suffix in ATTACHMENT_SUFFIXES):
                    continue
                else:
                    folder.write_new(name, content)
            except FileExistsError:
                continue
            except OSError as error:
                place = folder.path / name
                raise InputOutputError(f"result {place}: {reason_of(error)}") from None
            self._names.add(stem)
            return stem
        raise AssertionError("numbers have no end")

    def _attachments(
        self, result: Result, picture: bytes | None
    ) -> Iterator[tuple[str, str, Callable[[], bytes]]]:
        """Kind, suffix and content of what stands beside a result."""
        if self.pictures and (picture is not None or result.can_be_drawn):
            yield "picture", ".png", lambda: picture or diagnosis_png(result)
        if self._arguments.report:
            yield "report", ".html", partial(self._page, result)
        for kind in self._signals if result.can_be_drawn else ():
            yield "signals", f".signals.{kind}", partial(_signals, result, kind)

    def _page(self, result: Result) -> bytes:
        levels = Levels(self._arguments.advisory, self._arguments.limit)
        return diagnosis_html_page(result, levels, self.history.place)


def _signals(result: Result, kind: str) -> bytes:
    from ehadiag.report.signal_files import signal_file  # noqa: PLC0415 - slow

    return signal_file(result, kind)


def _numbered_stems(name: str) -> Iterator[str]:
    """Names to try one after another."""
    return (name if n == 1 else f"{name}-{n}" for n in itertools.count(1))


def _is_same_recording(folder: Folder, name: str, result: Result) -> bool:
    """Whether a file is the result of the same recording, of an earlier call.

    The same name is not enough: logs of two folders may have one. What was read and what it held
    must be the same too.
    """
    try:
        there = Result.from_json(folder.read(name, MAX_RESULT_BYTES))
    except (OSError, ValueError):
        return False
    return list(map(_recording_identity, there.origins)) == list(
        map(_recording_identity, result.origins)
    )


def _recording_identity(origin: Origin) -> tuple[object, ...]:
    """What tells one recording from others."""
    return origin.source, origin.date, origin.serial, origin.log


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
