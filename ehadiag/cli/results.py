"""Brings a diagnosis out: first to the disk, then to standard output, the picture last."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.assess.verdict import Levels
from ehadiag.cli.history_file import Keeper
from ehadiag.cli.interrupt import keep_signals
from ehadiag.cli.matplotlib_alone import matplotlib_alone
from ehadiag.cli.output import emit, rendered, say
from ehadiag.cli.report_page import need_report_library, report_of
from ehadiag.core.errors import ConfigurationError, InputOutputError
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.printable import plain_name

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.report.spent import Spent

__all__ = ["Results", "make_folder"]

MAX_RESULT_BYTES = 1 << 20


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
        It cannot be created, or is a link.
    """
    path = Path(name)
    try:
        if path.is_symlink():
            raise InputOutputError(f"output folder {name}: is a link; name the folder it leads to")
        path.mkdir(parents=True, exist_ok=True)
        return Folder.at(path, RESULT_MODE)
    except OSError as error:
        raise InputOutputError(f"output folder {name}: {error.strerror or error}") from None


class Results:
    """Where the results of one call go.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.
    folder : Folder | None
        For JSON and pictures; None: nothing is written.
    """

    def __init__(self, arguments: argparse.Namespace, folder: Folder | None) -> None:
        self._arguments = arguments
        self._folder = folder
        self._names: set[str] = set()
        self._keeper = Keeper(arguments)
        if arguments.report:
            need_report_library()
            if folder is None:
                raise ConfigurationError("--report: name by --out the folder where the page goes")
        self.stopped = False
        """Whether a signal came while a result was brought out."""

    def load(self) -> None:
        """Load what printing needs: a verdict must not wait for it."""
        if self._arguments.json:
            import ehadiag.report.json_line  # noqa: PLC0415
        else:
            import ehadiag.report.table  # noqa: PLC0415

            rendered(lambda _: None)
        if self._arguments.report:
            import ehadiag.report.page  # noqa: F401, PLC0415

    def deliver(self, diagnosis: Diagnosis, spent: Spent, name: str) -> int:
        """Write and print one result; return its exit code.

        That is the verdict's, or 3 where something could not be written and 3 is more. From here on
        signals do not change it: the first leaves the picture out, the second what is not out yet.

        name: of the files, without suffix; made safe, and numbered where it is taken.
        """
        from ehadiag.report.json_line import json_line  # noqa: PLC0415

        came = keep_signals()
        codes = [int(diagnosis.verdict)]
        line = json_line(diagnosis, spent, self._arguments.solver, self._arguments.seed)
        with contextlib.suppress(KeyboardInterrupt):
            written = []
            stem = None
            with _said(codes):
                stem = self._write_json(line, plain_name(name))
            with _said(codes):
                self._keeper.keep(diagnosis, line)
            if stem is not None:
                written.append(f"{stem}.json")
            with _said(codes):
                self._print(diagnosis, line, spent)
            if stem is not None and _can_be_drawn(diagnosis) and not came.is_set():
                with _said(codes):
                    self._draw(diagnosis, f"{stem}.png")
                    written.append(f"{stem}.png")
            if stem is not None and self._arguments.report and not came.is_set():
                with _said(codes):
                    self._report(diagnosis, line, f"{stem}.html")
                    written.append(f"{stem}.html")
            if self._folder is not None and written:
                say("wrote " + ", ".join(str(self._folder.path / item) for item in written))
        self.stopped = self.stopped or came.is_set()
        return max(codes)

    def _print(self, diagnosis: Diagnosis, line: str, spent: Spent) -> None:
        if self._arguments.json:
            emit(line + "\n")
            return
        from ehadiag.report.table import print_diagnosis  # noqa: PLC0415

        emit(rendered(lambda console: print_diagnosis(diagnosis, console, spent)))

    def _write_json(self, line: str, wanted: str) -> str | None:
        """Write the object under the first name that no other recording's result has."""
        folder = self._folder
        if folder is None:
            return None
        content = line.encode() + b"\n"
        candidates = (wanted if n == 1 else f"{wanted}-{n}" for n in itertools.count(1))
        for stem in candidates:
            if stem in self._names:
                continue
            name = f"{stem}.json"
            try:
                if _same_recording(folder, name, line):
                    folder.write(name, content)
                    for suffix in (".png", ".html"):  # of the result that is no more
                        folder.remove(f"{stem}{suffix}")
                elif folder.exists(f"{stem}.png"):
                    continue
                else:
                    folder.write_new(name, content)
            except FileExistsError:
                continue
            except OSError as error:
                place = folder.path / name
                raise InputOutputError(f"result {place}: {error.strerror or error}") from None
            self._names.add(stem)
            return stem
        raise AssertionError("numbers have no end")

    def _draw(self, diagnosis: Diagnosis, name: str) -> None:
        assert self._folder is not None
        with matplotlib_alone():
            from ehadiag.report.picture import draw_diagnosis  # noqa: PLC0415 - matplotlib is slow
        try:
            self._folder.write(name, draw_diagnosis(diagnosis))
        except OSError as error:
            place = self._folder.path / name
            raise InputOutputError(f"picture {place}: {error.strerror or error}") from None

    def _report(self, diagnosis: Diagnosis, line: str, name: str) -> None:
        assert self._folder is not None
        levels = Levels(self._arguments.advisory, self._arguments.limit)
        page = report_of(line, levels, self._keeper.place, diagnosis)
        try:
            self._folder.write(name, page)
        except OSError as error:
            place = self._folder.path / name
            raise InputOutputError(f"report {place}: {error.strerror or error}") from None


def _can_be_drawn(diagnosis: Diagnosis) -> bool:
    """Whether there is a modelled response, of numbers."""
    found = diagnosis.identification
    return found is not None and all(math.isfinite(item.value) for item in found.estimates)


@contextlib.contextmanager
def _said(codes: list[int]) -> Iterator[None]:
    """Say what could not be brought out, and go on with the rest."""
    try:
        yield
    except InputOutputError as error:
        codes.append(error.exit_code)
        say(str(error))


def _same_recording(folder: Folder, name: str, line: str) -> bool:
    """Whether a file is the result of the same recording, of an earlier call."""
    try:
        there = json.loads(folder.read(name, MAX_RESULT_BYTES))
        return bool(there["source"] == json.loads(line)["source"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False
