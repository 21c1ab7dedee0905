"""Calls a command of the user's for each alarm: a list of arguments, never a shell."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Sequence
from typing import Any

from ehadiag.cli.output import say
from ehadiag.core.errors import ConfigurationError, reason_of

__all__ = ["AlarmCommand"]

PATIENCE_S = 5.0
"""How long the end of the session waits for a call that still runs."""


class AlarmCommand:
    """Runs a command with the alarm's JSON object on its standard input, one call at a time.

    An alarm that comes while a call still runs makes none: the log has them all. What the command
    prints goes nowhere.

    Parameters
    ----------
    arguments : Sequence[str]
        Program and arguments; empty: nothing is called.

    Raises
    ------
    ConfigurationError
        There is no such program.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        if arguments and shutil.which(arguments[0]) is None:
            raise ConfigurationError(f"--on-alarm {arguments[0]}: no such program")
        self._arguments = list(arguments)
        self._thread: threading.Thread | None = None
        self.calls = 0
        """Begun so far."""
        self.failed = ""
        """What went wrong last; empty for nothing."""

    def call(self, event: dict[str, Any]) -> None:
        """Begin a call, in a thread of its own: nobody waits for it."""
        if not self._arguments or (self._thread is not None and self._thread.is_alive()):
            return
        self.calls += 1
        self._thread = threading.Thread(
            target=self._run, args=(event,), name="ehadiag-on-alarm", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Wait for a call that runs, but not for long."""
        if self._thread is not None:
            self._thread.join(PATIENCE_S)
        if self.failed:
            say(f"--on-alarm {self._arguments[0]}: {self.failed}")

    def _run(self, event: dict[str, Any]) -> None:
        try:
            done = subprocess.run(
                self._arguments,
                input=json.dumps(event).encode() + b"\n",
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                check=False,
            )
            if done.returncode:
                self.failed = f"ended with code {done.returncode}"
        except (OSError, ValueError) as error:
            self.failed = reason_of(error)
