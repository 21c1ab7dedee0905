"""What commands print and write: results to standard output, all else to standard error."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ehadiag.diagnosis import Diagnosis
from ehadiag.errors import InputOutputError
from ehadiag.jit import cache_is_cold
from ehadiag.report.jsonline import json_line
from ehadiag.report.table import print_diagnosis

__all__ = [
    "make_folder",
    "progress_bar",
    "say",
    "say_if_compiling",
    "show",
    "wide_console",
    "write_report",
]

LEAST_WIDTH = 100


def say(text: str) -> None:
    """Print one line to standard error."""
    print(f"ehadiag: {text}", file=sys.stderr, flush=True)


def say_if_compiling() -> None:
    """Tell that the first run takes longer."""
    if cache_is_cold():
        say("compiling the model's kernels, once for this installation (up to half a minute)")


def wide_console() -> Console:
    """Standard output at least as wide as our tables: a pipe must not cut them."""
    return Console(highlight=False, width=max(Console().width, LEAST_WIDTH))


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show stage and share done on standard error, where that is a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _stage, _share: None
        return
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as display:
        task = display.add_task("", total=1.0)
        yield lambda stage, share: display.update(task, description=stage, completed=share)


def show(diagnosis: Diagnosis, arguments: argparse.Namespace, read_s: float) -> None:
    """Print a diagnosis as JSON or as a table."""
    if arguments.json:
        print(json_line(diagnosis, read_s, arguments.solver, arguments.seed), flush=True)
    else:
        print_diagnosis(diagnosis, wide_console())


def make_folder(name: str) -> Path:
    """Create the output folder.

    Raises
    ------
    InputOutputError: it cannot be created.
    """
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputOutputError(f"output folder {name}: {error.strerror or error}") from None
    return folder


def write_report(
    diagnosis: Diagnosis, stem: Path, arguments: argparse.Namespace, read_s: float
) -> None:
    """Write `stem`.json and, where a model was fitted, `stem`.png."""
    line = json_line(diagnosis, read_s, arguments.solver, arguments.seed)
    path = stem.with_name(stem.name + ".json")
    try:
        path.write_text(line + "\n", encoding="utf-8")
    except OSError as error:
        raise InputOutputError(f"result {path}: {error.strerror or error}") from None
    written = [path]
    if diagnosis.identification is not None:
        from ehadiag.report.picture import draw_diagnosis  # noqa: PLC0415 - matplotlib is slow

        picture = stem.with_name(stem.name + ".png")
        draw_diagnosis(diagnosis, picture)
        written.append(picture)
    say("wrote " + ", ".join(str(item) for item in written))
