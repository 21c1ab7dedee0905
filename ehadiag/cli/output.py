"""What commands print and write: results to standard output, all else to standard error."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.core.errors import InputOutputError

if TYPE_CHECKING:
    from rich.console import Console

    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.report.spent import Spent
    from firmware_iface.transport.interface import Transport

__all__ = [
    "damage",
    "load_report",
    "make_folder",
    "progress_bar",
    "say",
    "say_if_compiling",
    "show",
    "wide_console",
    "write_report",
]

LEAST_WIDTH = 100
PIPE_WIDTH = 200
IDENTIFICATION, SIMULATION = "ehadiag_identify", "ehadiag_sim"
"""Packages of kernels, as the names of their cache files hold them."""


def say(text: str) -> None:
    """Print one line to standard error."""
    print(f"ehadiag: {text}", file=sys.stderr, flush=True)


def damage(transport: Transport) -> str:
    """What the transport lost, for the end of a sentence; empty for nothing."""
    return f"; {transport.detail}" if transport.detail else ""


def say_if_compiling(*, simulation: bool = False, identification: bool = True) -> None:
    """Tell that the first run takes longer, where what it needs is not in the cache."""
    from ehadiag.compile.kernels import cache_folder  # noqa: PLC0415 - loads numba

    needed = [SIMULATION] * simulation + [IDENTIFICATION] * identification
    if not all(any(cache_folder().glob(f"*{kind}*.nbi")) for kind in needed):
        say("compiling the model's kernels, once for this installation (up to half a minute)")


def wide_console() -> Console:
    """Standard output wide enough for our tables: a pipe must not cut them."""
    from rich.console import Console  # noqa: PLC0415 - only who prints tables needs it

    console = Console(highlight=False)
    width = max(console.width, LEAST_WIDTH) if console.is_terminal else PIPE_WIDTH
    return Console(highlight=False, width=width)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show stage and share done on standard error, where that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _stage, _share: None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as display:
        task = display.add_task("", total=1.0)
        yield lambda stage, share: display.update(task, description=stage, completed=share)


def load_report(arguments: argparse.Namespace) -> None:
    """Load what `show` needs: a verdict must not wait for it."""
    if arguments.json:
        import ehadiag.report.json_line  # noqa: PLC0415
    else:
        import ehadiag.report.table  # noqa: F401, PLC0415

        wide_console()


def show(diagnosis: Diagnosis, arguments: argparse.Namespace, spent: Spent) -> None:
    """Print a diagnosis as JSON or as a table."""
    if arguments.json:
        from ehadiag.report.json_line import json_line  # noqa: PLC0415

        print(json_line(diagnosis, spent, arguments.solver, arguments.seed), flush=True)
    else:
        from ehadiag.report.table import print_diagnosis  # noqa: PLC0415

        print_diagnosis(diagnosis, wide_console(), spent)


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
    diagnosis: Diagnosis, stem: Path, arguments: argparse.Namespace, spent: Spent
) -> None:
    """Write `stem`.json and, where a model was fitted, `stem`.png.

    Raises
    ------
    InputOutputError: one of them cannot be written.
    """
    from ehadiag.report.json_line import json_line  # noqa: PLC0415

    line = json_line(diagnosis, spent, arguments.solver, arguments.seed)
    path = stem.with_name(stem.name + ".json")
    try:
        path.write_text(line + "\n", encoding="utf-8")
    except OSError as error:
        raise InputOutputError(f"result {path}: {error.strerror or error}") from None
    written = [path]
    if diagnosis.identification is not None:
        from ehadiag.compile.kernels import cache_folder  # noqa: PLC0415 - loads numba

        # Its own folder cannot be written without a home, which it would say at length.
        os.environ.setdefault("MPLCONFIGDIR", str(cache_folder().parent / "matplotlib"))
        from ehadiag.report.picture import draw_diagnosis  # noqa: PLC0415 - matplotlib is slow

        picture = stem.with_name(stem.name + ".png")
        draw_diagnosis(diagnosis, picture)
        written.append(picture)
    say("wrote " + ", ".join(str(item) for item in written))
