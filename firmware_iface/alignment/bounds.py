"""Finds the rows of a table that can hold a test's frames, without going through all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.alignment.episodes import Episode
from firmware_iface.alignment.ticks import TickAxis

__all__ = ["Bounds"]


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Finds the frames of a span of ticks without going through all of them.

    Attributes
    ----------
    axis : TickAxis
        The control ticks of the recording.
    highest : NDArray[np.int64]
        Highest tick up to each axis frame; ascending.
    lowest : NDArray[np.int64]
        Lowest tick from each axis frame on; ascending.
    """

    axis: TickAxis
    highest: NDArray[np.int64]
    lowest: NDArray[np.int64]

    @classmethod
    def of(cls, axis: TickAxis) -> Bounds:
        """Bounds of an axis.

        Parameters
        ----------
        axis : TickAxis
            The control ticks of a recording.

        Returns
        -------
        Bounds
            Where each tick's frames may stand.
        """
        lowest = np.minimum.accumulate(axis.tick[::-1])[::-1]
        return cls(axis, np.maximum.accumulate(axis.tick), lowest)

    def rows(self, episode: Episode, rows: int) -> tuple[int, int]:
        """Rows of the table that belong to a test: from neighbour to neighbour.

        They end with the word that the test has ended, if it has all its frames then: a live test
        is judged on that word, and its recording goes on for a while.

        Parameters
        ----------
        episode : Episode
            The test.
        rows : int
            Of the whole table.

        Returns
        -------
        tuple[int, int]
            The first row, and one past the last.
        """
        stop = episode.first + episode.ticks
        low = int(np.searchsorted(self.highest, episode.first))
        high = int(np.searchsorted(self.lowest, stop))
        tick = self.axis.tick[low:high]
        hits = np.flatnonzero((tick >= episode.first) & (tick < stop))
        if len(hits) == 0:
            return 0, rows
        first, last = low + int(hits[0]), low + int(hits[-1])
        begin = int(self.axis.row[first - 1]) + 1 if first > 0 else 0
        end = int(self.axis.row[last + 1]) if last + 1 < len(self.axis.row) else rows
        if episode.ended is not None:
            end = min(end, max(episode.ended, int(self.axis.row[last])) + 1)
        return begin, end
