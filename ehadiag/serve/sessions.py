"""Runs one session at a time, watching or testing, and hands its snapshots on.

Each is a process of its own: neither a page nor its readers can cost the bus a frame."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import IO

from ehadiag.core.errors import EhadiagError
from ehadiag.core.printable import printable
from ehadiag.live.snapshot import Snapshot

__all__ = ["BusyError", "News", "Sessions"]

LONGEST_LINE = 1 << 20
"""Bytes of one snapshot; a longer line is none."""
SAID = 20
"""Lines of a session that are kept to be shown."""
PAUSE_S = 3.0
"""Before a watch that ended by itself begins again."""
ABORT_S = 15.0
"""In which a test that is told to stop has asked for the abort and written what it has."""


PROGRAM = (sys.executable, "-m", "ehadiag")


class BusyError(EhadiagError):
    """A test is running already, or none is."""


@dataclass(frozen=True, slots=True)
class News:
    """How the sessions are.

    Attributes
    ----------
    number : int
        Counts the changes.
    snapshot : bytes
        The newest one, a line of JSON; `null` before the first.
    running : str | None
        Name of the test that runs.
    said : tuple[str, ...]
        What the sessions said last, fit for a page.
    """

    number: int
    snapshot: bytes
    running: str | None
    said: tuple[str, ...]


class Sessions:
    """Watches the bus while no test runs, and runs a test when asked.

    Parameters
    ----------
    watch : Sequence[str] | None
        Command line of the session that only listens; None: nothing is watched between tests.
    tests : Mapping[str, Sequence[str]]
        Command line for each test that may be started, by name.
    program : Sequence[str]
        What the command lines are handed to.
    """

    def __init__(
        self,
        watch: Sequence[str] | None,
        tests: Mapping[str, Sequence[str]],
        program: Sequence[str] = PROGRAM,
    ) -> None:
        self._program = program
        self._watch = watch
        self.tests = dict(tests)
        self._changed = threading.Condition()
        self._asked: str | None = None
        self._ending = False
        self._process: subprocess.Popen[bytes] | None = None
        self._running: str | None = None
        self._number = 1
        self._snapshot = b"null"
        self._said: deque[str] = deque(maxlen=SAID)
        self._thread = threading.Thread(target=self._run, name="ehadiag-sessions", daemon=True)

    def __enter__(self) -> Sessions:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def running(self) -> str | None:
        """Name of the test that runs; None: none does."""
        return self._running

    @property
    def ended(self) -> bool:
        """Whether no more snapshots come."""
        return self._ending

    def wait(self, after: int, timeout_s: float) -> News | None:
        """Wait for news.

        Parameters
        ----------
        after : int
            Number of the last news; 0: none yet.
        timeout_s : float
            Longest wait.

        Returns
        -------
        News | None
            The newest; None where none came.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._number > after or self._ending, timeout_s)
            if self._number <= after:
                return None
            return News(self._number, self._snapshot, self._running, tuple(self._said))

    def start(self, test: str) -> None:
        """Ask for a test; it begins once the watch has let go of the bus.

        Parameters
        ----------
        test : str
            Name among `tests`.

        Raises
        ------
        KeyError
            It may not be started.
        BusyError
            Another one is under way.
        """
        if test not in self.tests:
            raise KeyError(test)
        with self._changed:
            if self._running is not None or self._asked is not None:
                raise BusyError("a test is under way: wait for its end, or abort it")
            self._asked = test
            self._stop_process()
            self._tell()

    def abort(self) -> None:
        """Tell the running test to ask for its abort.

        Raises
        ------
        BusyError
            No test is under way.
        """
        with self._changed:
            if self._asked is not None:
                self._asked = None
                return
            if self._running is None:
                raise BusyError("no test is under way")
            self._stop_process()

    def close(self) -> None:
        """End all; a running test asks for its abort first."""
        with self._changed:
            self._ending = True
            self._asked = None
            self._stop_process()
            self._tell()
        self._thread.join(ABORT_S)
        process = self._process
        if process is not None and process.poll() is None:
            process.kill()

    def _run(self) -> None:
        while not self._ending:
            with self._changed:
                test, self._asked = self._asked, None
                self._running = test
                command = self.tests[test] if test is not None else self._watch
                process = None if command is None else self._begun(command)
                if process is None:
                    self._changed.wait_for(lambda: self._asked is not None or self._ending)
                    continue
            self._follow(process)
            with self._changed:
                self._process, self._running = None, None
                self._tell()
                if test is None:
                    self._changed.wait_for(lambda: self._asked is not None or self._ending, PAUSE_S)

    def _begun(self, command: Sequence[str]) -> subprocess.Popen[bytes] | None:
        self._said.append(printable(f"$ ehadiag {' '.join(command)}"))
        # On Windows only a group of its own can be sent Ctrl-Break.
        flags = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
        self._process = subprocess.Popen(
            [*self._program, *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            creationflags=flags,
            start_new_session=sys.platform != "win32",
        )
        self._tell()
        return self._process

    def _tell(self) -> None:
        self._number += 1
        self._changed.notify_all()

    def _follow(self, process: subprocess.Popen[bytes]) -> None:
        """Read what a session says until it ends."""
        assert process.stdout is not None
        assert process.stderr is not None
        words = threading.Thread(target=self._listen, args=(process.stderr,), daemon=True)
        with process:
            words.start()
            while line := process.stdout.readline(LONGEST_LINE):
                try:
                    snapshot = Snapshot.from_json(line)
                except ValueError:
                    continue
                with self._changed:
                    self._snapshot = snapshot.to_json()
                    self._tell()
            code = process.wait()
            words.join()
        with self._changed:
            self._said.append(f"ended with exit code {code}")
            self._tell()

    def _listen(self, stream: IO[bytes]) -> None:
        while line := stream.readline(LONGEST_LINE):
            text = printable(line.decode("utf-8", errors="backslashreplace").rstrip())
            with self._changed:
                self._said.append(text)
                self._tell()

    def _stop_process(self) -> None:
        """Send what Ctrl-C sends: the session asks for an abort, writes what it has, ends."""
        process = self._process
        if process is not None and process.poll() is None:
            kind = getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT)
            process.send_signal(kind)
