"""Brings a diagnosis out: first to the disk, then to standard output, the picture last."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.assess.verdict import Levels
from ehadiag.cli.exit_codes import worst_code
from ehadiag.cli.history_file import Keeper
from ehadiag.cli.interrupt import keep_signals
from ehadiag.cli.output import emit, failure_said, put, rendered, say
from ehadiag.cli.report_page import need_report_library, report_of
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.printable import plain_name

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.report.spent import Spent

__all__ = ["Results", "make_folder"]

MAX_RESULT_BYTES = 1 << 20
BESIDE = (".png", ".html")
"""Suffixes of what stands beside a result: picture and report."""


def make_folder(name: str) -> Folder:
    """Open the output folder, created if need be.

    Parameters
    ----------
    name : str
        As the user named it.

    Returns
    -------
    Folder
        The folder, held open.

    Raises
    ------
    InputOutputError
        It cannot be created or written in, or is a link.
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


class Results:
    """Where the results of one call go.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.
    folder : Folder | None
        For JSON and pictures; None: nothing is written.
    taken : Iterable[str]
        Names, without suffix, that other files of the call have there.
    """

    def __init__(
        self, arguments: argparse.Namespace, folder: Folder | None, taken: Iterable[str] = ()
    ) -> None:
        self._arguments = arguments
        self._folder = folder
        self._names = set(taken)
        self._keeper = Keeper(arguments)
        if arguments.report:
            need_report_library()
            if folder is None:
                raise ConfigurationError("--report: name by --out the folder where the page goes")
        self.stopped = False
        """Whether a signal came while a result was brought out."""

    @property
    def history(self) -> Path | None:
        """Health history that the results are kept in; None: in none."""
        return self._keeper.place

    def load(self) -> None:
        """Load what printing needs: a verdict must not wait for it."""
        if self._arguments.json:
            import ehadiag.report.json_line  # noqa: PLC0415
        else:
            import ehadiag.report.table  # noqa: PLC0415

            rendered(lambda _: None)
        if self._arguments.report:
            import ehadiag.report.page  # noqa: F401, PLC0415

    def deliver(
        self,
        diagnosis: Diagnosis,
        line: str,
        spent: Spent,
        name: str,
        draw: Callable[[], bytes] | None,
    ) -> int:
        """Write and print one result; return its exit code.

        That is the verdict's, or 3 where something could not be written and that is worse (see
        `worst_code`). From here on signals do not change it: the first leaves the picture out, the
        second what is not out yet.

        line: JSON object. name: of the files, without suffix; made safe, and numbered where it is
        taken. draw: makes the picture; None: there is none.
        """
        came = keep_signals()
        codes = [int(diagnosis.verdict)]
        with contextlib.suppress(KeyboardInterrupt):
            written = []
            stem = None
            with failure_said(codes):
                stem = self._write_json(self._said_as(line), plain_name(name))
            with failure_said(codes):
                self._keeper.keep(diagnosis, line)
            if stem is not None:
                written.append(f"{stem}.json")
            with failure_said(codes):
                self._print(diagnosis, line, spent)
            if stem is not None and draw is not None and self.pictures and not came.is_set():
                with failure_said(codes):
                    self._draw(draw, f"{stem}.png")
                    written.append(f"{stem}.png")
            if stem is not None and self._arguments.report and not came.is_set():
                with failure_said(codes):
                    self._report(diagnosis, line, f"{stem}.html")
                    written.append(f"{stem}.html")
            if self._folder is not None and written:
                say("wrote " + ", ".join(str(self._folder.path / item) for item in written))
        self.stopped = self.stopped or came.is_set()
        return worst_code(codes)

    def refuse(self, line: str, error: str) -> None:
        """Say what is wrong with an input, and print its object; `ehadiag.diagnosis/1` has none."""
        say(error)
        if self._arguments.json and self._arguments.json_version > 1:
            emit(line + "\n")

    def repeat(self, line: str, tree: dict[str, Any]) -> None:
        """Print a result that an earlier call found: its object, or one line."""
        if self._arguments.json:
            emit(self._said_as(line) + "\n")
        else:
            put(
                f"{tree['verdict'].replace('_', ' ')}  {tree['source']}  (found by an earlier call)"
            )

    def has(self, line: str, name: str) -> bool:
        """Whether all that this call is to write of a result is there from an earlier one.

        line: JSON object. name: of the files, without suffix, as for `deliver`.
        """
        return self._keeper.has(line) and self._has_files(line, plain_name(name))

    def _has_files(self, line: str, wanted: str) -> bool:
        folder = self._folder
        if folder is None:
            return True
        content = self._said_as(line).encode() + b"\n"
        suffixes = [".png"] * self.pictures + [".html"] * bool(self._arguments.report)
        for stem in _numbered(wanted):
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

    def _said_as(self, line: str) -> str:
        """Return the object in the version that was asked for."""
        from ehadiag.report.json_line import first_version  # noqa: PLC0415

        return first_version(line) if self._arguments.json_version == 1 else line

    def _print(self, diagnosis: Diagnosis, line: str, spent: Spent) -> None:
        if self._arguments.json:
            emit(self._said_as(line) + "\n")
            return
        from ehadiag.report.table import print_diagnosis  # noqa: PLC0415

        emit(rendered(lambda console: print_diagnosis(diagnosis, console, spent)))

    def _write_json(self, line: str, wanted: str) -> str | None:
        """Write the object under the first name that no other recording's result has."""
        folder = self._folder
        if folder is None:
            return None
        content = line.encode() + b"\n"
        for stem in _numbered(wanted):
            if stem in self._names:
                continue
            name = f"{stem}.json"
            try:
                if _same_recording(folder, name, line):
                    folder.write(name, content)
                    for suffix in BESIDE:  # of the result that is no more
                        folder.remove(f"{stem}{suffix}")
                elif any(folder.exists(f"{stem}{suffix}") for suffix in BESIDE):
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

    def _draw(self, draw: Callable[[], bytes], name: str) -> None:
        assert self._folder is not None
        content = draw()
        try:
            self._folder.write(name, content)
        except OSError as error:
            place = self._folder.path / name
            raise InputOutputError(f"picture {place}: {reason_of(error)}") from None

    def _report(self, diagnosis: Diagnosis, line: str, name: str) -> None:
        assert self._folder is not None
        levels = Levels(self._arguments.advisory, self._arguments.limit)
        page = report_of(line, levels, self._keeper.place, diagnosis)
        try:
            self._folder.write(name, page)
        except OSError as error:
            place = self._folder.path / name
            raise InputOutputError(f"report {place}: {reason_of(error)}") from None


def _numbered(name: str) -> Iterator[str]:
    """Names to try one after another."""
    return (name if n == 1 else f"{name}-{n}" for n in itertools.count(1))


def _same_recording(folder: Folder, name: str, line: str) -> bool:
    """Whether a file is the result of the same recording, of an earlier call.

    The same name is not enough: logs of two folders may have one. What was read and what it held
    must be the same too.
    """
    try:
        there, here = json.loads(folder.read(name, MAX_RESULT_BYTES)), json.loads(line)
        if "recordings" in there and "recordings" in here:
            return [_identity(item) for item in there["recordings"]] == [
                _identity(item) for item in here["recordings"]
            ]
        return all(there[key] == here[key] for key in ("source", "test", "serial", "quality"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _identity(recording: dict[str, Any]) -> tuple[object, ...]:
    """What tells one recording of the JSON object from others."""
    return tuple(recording[key] for key in ("source", "date", "serial", "log"))
