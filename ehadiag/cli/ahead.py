"""Runs the identification in a thread while `ehadiag bit` is still running the test."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import DiagnosisSession
    from ehadiag.cli.deadline import Deadline
    from ehadiag.core.recording import Recording
    from ehadiag.core.stored_test import StoredTest
    from firmware_iface.session.assembler import Assembler
    from firmware_iface.session.tester import Progress
    from firmware_iface.transport.frames import FrameTable

__all__ = ["Ahead", "working_ahead"]

POLL_S = 0.05
MARGIN_S = 0.02
"""Frames of a tick are there that long after it."""


class Ahead:
    """Takes snapshots of a running test, and has them worked on."""

    def __init__(self, session: DiagnosisSession, assembler: Assembler, test: StoredTest) -> None:
        self._session = session
        self._assembler = assembler
        self._test = test
        self._due = list(session.due_s(test))
        self._abandoned = False
        self._work: queue.SimpleQueue[FrameTable | None] = queue.SimpleQueue()
        self.ended_at: float | None = None
        """When the word came that the test is complete, on `time.perf_counter`."""
        self.whole: Recording | None = None
        """The test as it was then, if nothing was still under way."""
        self._thread = threading.Thread(target=self._run, name="ehadiag-ahead", daemon=True)
        self._thread.start()

    def watch(self, progress: Progress) -> None:
        """Hand over what has come once a stage can run; in the thread that collects frames."""
        due = False
        while self._due and progress.elapsed >= self._due[0] + MARGIN_S:
            self._due.pop(0)
            due = True
        if due:
            self._work.put(self._assembler.table())

    def all_there(self) -> bool:
        """Put the complete test together; return whether nothing of it is still under way."""
        from ehadiag.assess.acceptance import nothing_is_under_way  # noqa: PLC0415 - loads numba

        self.ended_at = time.perf_counter()
        recording = self._assembler.recording()
        if nothing_is_under_way(recording, self._test):
            self.whole = recording
        return self.whole is not None

    def finish(self, deadline: Deadline, stop: threading.Event) -> bool:
        """Wait for the work under way, and for that on the newest snapshot; return whether it came.

        The newest one holds all that those before it hold.
        """
        newest = None
        with contextlib.suppress(queue.Empty):
            while True:
                newest = self._work.get_nowait()
        if newest is not None:
            self._work.put(newest)
        self._work.put(None)
        while self._thread.is_alive() and not (deadline.passed or stop.is_set()):
            self._thread.join(POLL_S)
        return not self._thread.is_alive()

    def abandon(self) -> None:
        """Leave what is not done yet; what is under way ends by itself."""
        self._abandoned = True
        self._work.put(None)

    def _run(self) -> None:
        while (table := self._work.get()) is not None:
            if self._abandoned:
                return
            # Whatever is wrong with the recording, its diagnosis will tell: this is only ahead.
            with contextlib.suppress(Exception):
                self._session.feed(self._assembler.recording_of(table))


@contextmanager
def working_ahead(
    session: DiagnosisSession, assembler: Assembler, test: StoredTest
) -> Iterator[Ahead]:
    """Work ahead; where the context ends by an exception, the work is abandoned."""
    ahead = Ahead(session, assembler, test)
    try:
        yield ahead
    except BaseException:
        ahead.abandon()
        raise
