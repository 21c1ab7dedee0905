"""Sessions of the local page: a watch of the bus while no test runs, a test when it is started.

One session at a time runs, as a function of the package in a process of its own: neither a page nor
its readers, nor the compiler, can then cost the bus a frame, and a session that hangs can be ended.
The process is spawned by `multiprocessing`; snapshots and lines come back through a pipe, and what
goes the other way, or the end of this process, acts as Ctrl-C does.
"""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

import msgspec

from ehadiag.core.interruption import (
    INTERRUPTED_EXIT_CODE,
    children_with_safe_path,
    interrupt_on_signals,
)
from ehadiag.live import Snapshot
from firmware_iface.errors import EhadiagError, printable

WATCH_RESTART_PAUSE_S = 3.0
"""Time before a watch that ended by itself begins again, s."""


NO_SNAPSHOT = b"null"
"""In place of a snapshot before a session's first."""


class BusyError(EhadiagError):
    """A test is running already, or none is."""


class Session(NamedTuple):
    """What runs in a process of its own."""

    title: str
    function: Callable[..., int]
    """Called with the arguments and with what takes snapshots; a module's function. Returns the
    exit code."""
    arguments: tuple[Any, ...]
    """Arguments that can be sent to another process."""
    with_severities: Callable[[Mapping[str, float]], tuple[Any, ...]] | None = None
    """Gives the arguments for a simulated unit with other severities; None: it is a real one."""


class SessionsStatus(msgspec.Struct, frozen=True):
    """State of the sessions.

    number: counts the changes; snapshot: the newest one, a line of JSON; `null` before the first;
    running: name of the test that runs; lines: latest lines that sessions printed, fit for a page.
    """

    number: int
    snapshot: bytes
    running: str | None
    lines: tuple[str, ...]


class SessionRunner:
    """Watches the bus while no test runs, and runs a test when it is started.

    watch: session that only listens; None: nothing is watched between tests; tests: session for
    each test that may be started, by name.
    """

    def __init__(self, watch: Session | None, tests: Mapping[str, Session]) -> None:
        self._watch = watch
        self.tests = dict(tests)
        self._changed = threading.Condition()
        self._requested: str | None = None
        self._severities: Mapping[str, float] = {}
        self._ending = False
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._running: str | None = None
        self._number = 1
        self._snapshot = NO_SNAPSHOT
        self._lines: deque[str] = deque(maxlen=20)
        self._thread = threading.Thread(target=self._run, name="ehadiag-sessions", daemon=True)

    def __enter__(self) -> SessionRunner:
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

    def wait(self, after: int, timeout_s: float) -> SessionsStatus | None:
        """Wait for a change.

        after: number of the last change; 0: none yet; timeout_s: longest wait. Returns the newest;
        None where there was no change.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._number > after or self._ending, timeout_s)
            if self._number <= after:
                return None
            return SessionsStatus(self._number, self._snapshot, self._running, tuple(self._lines))

    def start(self, test: str, severities: Mapping[str, float] | None = None) -> None:
        """Start a test once the watch has left the bus.

        test: name among `tests`; severities: of the simulated unit, by the names of the faults;
        None: as it is. ValueError: the unit is a real one, or has no such fault; KeyError: it may
        not be started; BusyError: another one is under way.
        """
        if test not in self.tests:
            raise KeyError(test)
        adjust = self.tests[test].with_severities
        if severities and adjust is None:
            raise ValueError("severities: only a simulated unit takes them")
        if severities and adjust is not None:
            adjust(severities)
        with self._changed:
            if self._running is not None or self._requested is not None:
                raise BusyError("a test is under way: wait for its end, or abort it")
            self._requested, self._severities = test, severities or {}
            self._interrupt()
            self._notify()

    def abort(self) -> None:
        """Abort the running test.

        BusyError: no test is under way.
        """
        with self._changed:
            if self._requested is not None:
                self._requested = None
                return
            if self._running is None:
                raise BusyError("no test is under way")
            self._interrupt()

    def close(self) -> None:
        """End all; a running test is aborted first."""
        with self._changed:
            self._ending = True
            self._requested = None
            self._interrupt()
            self._notify()
        # A stopped test aborts and writes its result.
        self._thread.join(15.0)
        process = self._process
        if process is not None and process.is_alive():
            process.kill()

    def _run(self) -> None:
        while not self._ending:
            with self._changed:
                test, self._requested = self._requested, None
                self._running = test
                session = self.tests[test] if test is not None else self._watch
                if session is None:
                    self._changed.wait_for(lambda: self._requested is not None or self._ending)
                    continue
                pipe, process = self._begin(session)
            self._follow(pipe, process)
            with self._changed:
                self._process = self._pipe = self._running = None
                self._notify()
                if test is None:
                    self._changed.wait_for(
                        lambda: self._requested is not None or self._ending, WATCH_RESTART_PAUSE_S
                    )

    def _begin(self, session: Session) -> tuple[Connection, BaseProcess]:
        if self._running is not None:
            self._snapshot = NO_SNAPSHOT
            self._lines.clear()
        if self._running is not None and self._severities and session.with_severities is not None:
            session = session._replace(arguments=session.with_severities(self._severities))
        session = session._replace(with_severities=None)  # it need not be sent
        self._lines.append(printable(session.title))
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        process = context.Process(target=_run_session, args=(session, theirs), daemon=True)
        with children_with_safe_path():
            process.start()
        theirs.close()
        self._pipe, self._process = pipe, process
        self._notify()
        return pipe, process

    def _notify(self) -> None:
        self._number += 1
        self._changed.notify_all()

    def _follow(self, pipe: Connection, process: BaseProcess) -> None:
        """Take what a session sends until it ends."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                content: bytes | str = pipe.recv()
                with self._changed:
                    if isinstance(content, bytes):
                        self._snapshot = content
                    else:
                        self._lines.append(printable(content))
                    self._notify()
        process.join()
        with self._changed:
            pipe.close()
            self._lines.append(f"ended with exit code {process.exitcode}")
            self._notify()

    def _interrupt(self) -> None:
        """Do what Ctrl-C does: the session aborts its test, writes what it has, ends."""
        if self._pipe is not None and not self._pipe.closed:
            with contextlib.suppress(OSError):
                self._pipe.send(None)


def _run_session(session: Session, pipe: Connection) -> None:
    """Run a session in this process, and exit with its code."""
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C on the terminal is for the parent, which then ends the session
    sending = threading.Lock()
    ended = threading.Event()

    def send(content: bytes | str) -> None:
        # Where the parent has gone the pipe's other thread ends the session.
        with contextlib.suppress(OSError), sending:
            pipe.send(content)

    def interrupt_on_message() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                pipe.recv()
                signal.raise_signal(signal.SIGINT)
        if not ended.is_set():  # nobody watches any more: nothing moves unwatched
            signal.raise_signal(signal.SIGINT)

    sys.stdout = sys.stderr = _LineSender(send)
    interrupted = interrupt_on_signals()
    threading.Thread(target=interrupt_on_message, name="ehadiag-parent", daemon=True).start()

    def snapshots(item: Snapshot) -> None:
        send(item.to_json())

    try:
        code = session.function(*session.arguments, snapshots)
    except EhadiagError as error:
        send(f"ehadiag: {error}")
        code = error.exit_code
    except KeyboardInterrupt:
        send("ehadiag: interrupted")
        code = INTERRUPTED_EXIT_CODE
    except RuntimeError:
        if not interrupted.is_set():  # the compiler turns an interruption into this error
            raise
        code = INTERRUPTED_EXIT_CODE
    ended.set()
    sys.exit(code)


class _LineSender(io.TextIOBase):
    """Standard output and error of a session: each line goes to the page."""

    def __init__(self, send: Callable[[str], None]) -> None:
        self._send = send
        self._rest = ""

    def write(self, text: str) -> int:
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            self._send(line.rstrip())
        return len(text)

    def isatty(self) -> bool:
        return False
