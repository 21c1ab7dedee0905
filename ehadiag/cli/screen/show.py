"""Chooses how a session is shown, and shows it: never in the thread that reads the bus."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ehadiag.cli.output import say
from ehadiag.cli.screen.lines import Lines
from ehadiag.live.publisher import Publisher
from ehadiag.live.snapshot import Snapshot

__all__ = ["add_screen_options", "shown", "wants_screen"]

WAIT_S = 1.0
PATIENCE_S = 5.0
"""How long the end of a session waits for the screen."""
LEAST_COLUMNS, LEAST_LINES = 60, 20
"""A smaller terminal gets plain lines."""


def add_screen_options(parser: argparse.ArgumentParser) -> None:
    """Add `--plain` and `--snapshots`."""
    parser.add_argument(
        "--plain",
        action="store_true",
        help="plain lines instead of the live view (so anyway where standard error is no terminal)",
    )
    parser.add_argument(
        "--snapshots",
        action="store_true",
        help="write what the live view shows to standard output, four JSON lines a second; all else"
        " goes to standard error. The session ends as by Ctrl-C when nobody reads any more",
    )


def wants_screen(*, plain: bool) -> bool:
    """Whether the session is to be shown on a screen that is drawn anew."""
    if plain or not sys.stderr.isatty() or os.environ.get("TERM") in (None, "", "dumb", "unknown"):
        return False
    try:
        size = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return size.columns >= LEAST_COLUMNS and size.lines >= LEAST_LINES


@contextmanager
def shown(
    look: Callable[[int], Snapshot], *, plain: bool, snapshots: bool = False
) -> Iterator[Publisher]:
    """Show a session while the context lasts.

    Parameters
    ----------
    look : Callable[[int], Snapshot]
        Makes a snapshot, see `Publisher`.
    plain : bool
        Plain lines also on a terminal.
    snapshots : bool
        Write snapshots to standard output; whatever else is printed goes to standard error.

    Yields
    ------
    Publisher
        Hands the snapshots also to whoever else wants them.
    """
    with contextlib.ExitStack() as stack:
        publisher = Publisher(look)
        screen = _Screen.begun() if wants_screen(plain=plain or snapshots) else None
        show = screen.take if screen is not None else _Plain().take
        if snapshots:
            show = _Stream(show).take
        reader = threading.Thread(
            target=_follow, args=(publisher, show), name="ehadiag-screen", daemon=True
        )
        if screen is not None:
            stack.callback(screen.close)
        stack.callback(_join, reader)
        stack.enter_context(publisher)
        reader.start()
        yield publisher


def _follow(publisher: Publisher, show: Callable[[Snapshot], None]) -> None:
    seen = 0
    while True:
        snapshot = publisher.wait(seen, WAIT_S)
        if snapshot is not None:
            seen = snapshot.number
            show(snapshot)
        elif publisher.ended:
            return


def _join(reader: threading.Thread) -> None:
    if reader.ident is not None:
        reader.join(PATIENCE_S)


class _Plain:
    """Prints lines to standard error."""

    def __init__(self) -> None:
        self._lines = Lines()

    def take(self, snapshot: Snapshot) -> None:
        for line in self._lines.of(snapshot):
            say(line)


class _Stream:
    """Writes snapshots to what was standard output, and hands them on."""

    def __init__(self, others: Callable[[Snapshot], None]) -> None:
        self._out = sys.stdout.buffer
        sys.stdout = sys.stderr
        self._others = others
        self._gone = False

    def take(self, snapshot: Snapshot) -> None:
        self._others(snapshot)
        if self._gone:
            return
        try:
            self._out.write(snapshot.to_json() + b"\n")
            self._out.flush()
        except (OSError, ValueError):
            # Whoever watched is gone: nothing moves unwatched.
            self._gone = True
            signal.raise_signal(signal.SIGINT)


class _Screen:
    """Hands snapshots to the process that draws them (`ehadiag.cli.screen.terminal`)."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    @classmethod
    def begun(cls) -> _Screen | None:
        """Begin the process; None where it cannot be."""
        # -P: a folder that the user works in is no place to load Python files from.
        command = [sys.executable, "-P", "-m", "ehadiag.cli.screen.terminal"]
        try:
            return cls(
                subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, bufsize=0
                )
            )
        except OSError:
            return None

    def take(self, snapshot: Snapshot) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended: the test goes on
            self._process.stdin.write(snapshot.to_json() + b"\n")

    def close(self) -> None:
        """Let it draw what it has, and end."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:  # a terminal that takes nothing
            self._process.kill()
            self._process.wait()
