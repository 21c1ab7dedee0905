"""Finds the even clock behind a table's time stamps: a logger samples evenly, its host stamps late.

Rows that a data-acquisition system sampled at an even rate carry the stamps of whatever wrote them:
late, in batches, several at once. Their number tells the time better, as long as none is missing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["even_times"]

BLOCK = 200
"""Rows of which the median tells whether the stamps keep to one line."""
LEAST_BLOCKS = 5
UNEVEN = 0.02
"""Of an interval: deviation of stamps from which on they are held not to be the clock's own."""
OFF = 0.5
"""Intervals by which blocks may be off the line: a missing row makes one."""
SURE = 6.0
"""Deviations of a block's median."""

Floats = NDArray[np.float64]


def even_times(time: Floats) -> tuple[Floats, float]:
    """Replace stamps that scatter about even ones by these.

    Parameters
    ----------
    time : Floats
        Stamps in the order of the rows, s, shape (n,).

    Returns
    -------
    tuple[Floats, float]
        Times, shape (n,), and the deviation of the stamps from them, s; the stamps as they are
        and 0 where they are even already, or do not keep to one line: where rows are missing or
        each row has an instant of its own.
    """
    blocks = len(time) // BLOCK
    if blocks < LEAST_BLOCKS or not np.isfinite(time).all():
        return time, 0.0
    index = np.arange(len(time), dtype=np.float64)
    step, level = np.polyfit(index, time - time[0], 1)
    rest = time - time[0] - level - step * index
    scatter = float(np.std(rest))
    if step <= 0.0 or scatter < UNEVEN * step:
        return time, 0.0
    medians = np.median(rest[: blocks * BLOCK].reshape(blocks, BLOCK), axis=1)
    # A median of stamps scatters by a quarter more than their mean.
    allowed = max(OFF * step, SURE * 1.25 * scatter / float(np.sqrt(BLOCK)))
    if float(np.ptp(medians)) > allowed or float(np.abs(rest).max()) > BLOCK * step:
        return time, 0.0
    return time[0] + level + step * index, scatter
