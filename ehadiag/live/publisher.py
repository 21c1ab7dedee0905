"""Hands the newest snapshot of a session to any number of readers."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ehadiag.live.snapshot import Snapshot

__all__ = ["PERIOD_S", "Publisher"]

PERIOD_S = 0.25
"""Between two snapshots: each costs the thread that reads the bus its caches for a tick or two."""


class Publisher:
    """Asks a session for a snapshot four times a second, in a thread of its own.

    The session only answers `look`, from what its own threads keep anyway: the thread that reads
    the bus neither waits for a reader nor knows of one. Readers ask for `latest` as often as they
    like, or `wait` for a newer one; no reader holds up another.

    Parameters
    ----------
    look : Callable[[int], Snapshot]
        Makes the snapshot of a number; called by one thread at a time.
    period_s : float
        Between two snapshots.
    """

    def __init__(self, look: Callable[[int], Snapshot], period_s: float = PERIOD_S) -> None:
        self._look = look
        self._period_s = period_s
        self._latest: Snapshot | None = None
        self._count = 0
        self._making = threading.Lock()
        self._ending = threading.Event()
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="ehadiag-live", daemon=True)
        self.ended = False
        """Whether the latest snapshot is the last."""

    def __enter__(self) -> Publisher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def latest(self) -> Snapshot | None:
        """The newest snapshot; None before the first. Takes no lock."""
        return self._latest

    def wait(self, after: int, timeout_s: float) -> Snapshot | None:
        """Wait for a snapshot that is newer than one already seen.

        Parameters
        ----------
        after : int
            Number of the one seen last; 0: none yet.
        timeout_s : float
            Longest wait.

        Returns
        -------
        Snapshot | None
            The newest; None where none came in time, or none will come any more.
        """
        with self._news:
            self._news.wait_for(lambda: self._count > after or self.ended, timeout_s)
            latest = self._latest
        return latest if latest is not None and latest.number > after else None

    def refresh(self) -> None:
        """Make a snapshot now: something happened that readers should see at once."""
        with self._making:
            if self.ended:
                return
            snapshot = self._look(self._count + 1)
            with self._news:
                self._latest, self._count = snapshot, snapshot.number
                self._news.notify_all()

    def close(self) -> None:
        """Make the last snapshot and end; may be called twice."""
        self._ending.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()
        self.refresh()
        with self._news:
            self.ended = True
            self._news.notify_all()

    def _run(self) -> None:
        while not self._ending.wait(self._period_s):
            self.refresh()
