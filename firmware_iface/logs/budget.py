"""Limits what reading a recording may cost: frames, bytes, seconds, memory."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from ehadiag.core.errors import InputOutputError

__all__ = ["Budget", "Spending"]


@dataclass(frozen=True, slots=True)
class Budget:
    """What reading one recording may cost; a recording that costs more is refused in one line.

    Attributes
    ----------
    frames : int
        Of the recording, foreign ones included; the default is some three hours of this bus.
    size : int
        Bytes of the file, and of what a compressed one unpacks to.
    seconds : float
        Wall time of reading.
    held : int
        Frames held in memory at once, some 25 bytes each and ten times as many while they are
        decoded; a test that is longer is cut off and said to be.
    """

    frames: int = 20_000_000
    size: int = 4 << 30
    seconds: float = 900.0
    held: int = 500_000


class Spending:
    """Counts what reading `path` has cost so far.

    Parameters
    ----------
    path : Path
        File to read.
    budget : Budget
        What may be spent.

    Raises
    ------
    InputOutputError
        By each method, once a budget is spent; it names the option that allows more.
    """

    def __init__(self, path: Path, budget: Budget) -> None:
        self._path = path
        self._budget = budget
        self._deadline = time.monotonic() + budget.seconds
        self.frames = 0
        self._bytes = 0

    def add_frames(self, count: int) -> None:
        """Count frames, and look at the clock."""
        self.frames += count
        if self.frames > self._budget.frames:
            self._refuse(f"more than {self._budget.frames} frames", "--max-frames")
        self.look_at_clock()

    def add_bytes(self, count: int) -> None:
        """Count unpacked bytes, and look at the clock."""
        self._bytes += count
        if self._bytes > self._budget.size:
            self._refuse(f"unpacks to more than {_mebibytes(self._budget.size)}", "--max-log-size")
        self.look_at_clock()

    def check_size(self, size: int) -> None:
        """Compare the size of the file, bytes."""
        if size > self._budget.size:
            self._refuse(f"larger than {_mebibytes(self._budget.size)}", "--max-log-size")

    def look_at_clock(self) -> None:
        """Compare the time since the beginning."""
        if time.monotonic() > self._deadline:
            self._refuse(f"not read within {self._budget.seconds:g} s", "--max-read-time")

    def _refuse(self, what: str, option: str) -> None:
        raise InputOutputError(f"log {self._path}: {what}; split it, or allow more by {option}")


def _mebibytes(size: int) -> str:
    return f"{size / (1 << 20):.4g} MiB"
