"""What commands print: results to standard output, all else to standard error."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO, cast

from ehadiag.core.errors import InputOutputError, reason_of
from ehadiag.core.printable import printable, printable_lines
from ehadiag.facade.compiling import compiling_notice

if TYPE_CHECKING:
    from rich.console import Console

    from firmware_iface.transport.interface import Transport

__all__ = [
    "abandon",
    "counting_bar",
    "damage",
    "emit",
    "failure_said",
    "progress_bar",
    "put",
    "rendered",
    "say",
    "say_if_compiling",
]

LEAST_WIDTH = 100
PIPE_WIDTH = 200


def say(text: str) -> None:
    """Print one line to standard error; that nobody can read it is no reason to fail."""
    try:
        print(f"ehadiag: {printable(text)}", file=sys.stderr, flush=True)
    except OSError:
        abandon(sys.stderr)


def put(text: str) -> None:
    """Print lines of plain text to standard output.

    Parameters
    ----------
    text : str
        The text to print.

    Raises
    ------
    InputOutputError
        It is closed, or full.
    """
    emit(printable_lines(text) + "\n")


def emit(text: str) -> None:
    """As `put`, of text that is already fit for the terminal, its last line ended."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        abandon(sys.stdout)
        raise InputOutputError(f"standard output: {reason_of(error)}") from None


@contextmanager
def failure_said(codes: list[int]) -> Iterator[None]:
    """Say what could not be brought out, add its exit code, and go on with the rest."""
    try:
        yield
    except InputOutputError as error:
        codes.append(error.exit_code)
        say(str(error))


def abandon(stream: TextIO) -> None:
    """Send the rest of a stream nowhere: else what is left in it fails again at the exit."""
    with contextlib.suppress(OSError, ValueError):  # a stream of a test has no number
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def damage(transport: Transport) -> str:
    """What the transport lost, for the end of a sentence; empty for nothing."""
    return f"; {transport.detail}" if transport.detail else ""


def say_if_compiling(*, simulation: bool = False, identification: bool = True) -> None:
    """Tell that the first run takes longer, where what it needs is not in the cache."""
    notice = compiling_notice(simulation=simulation, identification=identification)
    if notice:
        say(notice)


def rendered(draw: Callable[[Console], None]) -> str:
    """Return what is drawn on a console like standard output's, for `emit`.

    Wide enough for our tables: a pipe must not cut them. Not written by the console itself, which
    ends the program where a pipe is closed.
    """
    from rich.console import Console  # noqa: PLC0415 - only who prints tables needs it

    there = Console()
    width = max(there.width, LEAST_WIDTH) if there.is_terminal else PIPE_WIDTH
    out = io.StringIO()
    # Names of others are no markup.
    draw(
        Console(
            file=out,
            force_terminal=there.is_terminal,
            highlight=False,
            markup=False,
            emoji=False,
            width=width,
        )
    )
    return out.getvalue()


@contextmanager
def progress_bar(*, shown: bool = True) -> Iterator[Callable[[str, float], None]]:
    """Show stage and share done on standard error, where that is a terminal and it is `shown`."""
    if not (shown and sys.stderr.isatty()):
        yield lambda _stage, _share: None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    columns = TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()
    terminal = Console(file=cast("TextIO", _Forgiving(sys.stderr)))
    with Progress(*columns, console=terminal, transient=True) as display:
        task = display.add_task("", total=1.0)
        yield lambda stage, share: display.update(task, description=stage, completed=share)


@contextmanager
def counting_bar(total: int) -> Iterator[Callable[[], None]]:
    """Show how many of so many are done, and how fast, on standard error, if a terminal."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    terminal = Console(file=cast("TextIO", _Forgiving(sys.stderr)))
    columns = (
        MofNCompleteColumn(),
        BarColumn(),
        TextColumn("{task.fields[rate]}", markup=False),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=terminal, transient=True) as display:
        task = display.add_task("", total=total, rate="")

        def tell() -> None:
            speed = display.tasks[0].speed
            rate = "" if speed is None else f"{speed:.1f} recordings/s"
            display.update(task, advance=1, rate=rate)

        yield tell


class _Forgiving:
    """A terminal that may go away: a test must not end because nobody sees its progress."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.encoding = stream.encoding

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._stream.fileno()
