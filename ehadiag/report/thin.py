"""Thins a long signal for a plot: of each short time its extremes, as they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["EXTREMES", "thinned"]

EXTREMES = 4
"""Ticks that are kept of each short time: of the least and the greatest of two signals."""

Array = NDArray[np.float64]


def thinned(first: Array, second: Array, most: int) -> NDArray[np.intp]:
    """Choose the ticks to draw of two signals with the same times.

    Nothing is averaged: what is drawn was there, and no extreme is lost.

    Parameters
    ----------
    first : Array
        Shape (n,); NaN where missing.
    second : Array
        The same.
    most : int
        Of ticks.

    Returns
    -------
    NDArray[np.intp]
        Ascending: all, where they are not more than `most`; else of each of equal parts of the time
        those of the least and the greatest value of either.
    """
    ticks = len(first)
    if ticks <= most:
        return np.arange(ticks)
    width = -(-ticks // max(1, most // EXTREMES))
    parts = -(-ticks // width)
    begin = width * np.arange(parts)
    kept = []
    for values in (first, second):
        table = np.full(parts * width, np.nan)
        table[:ticks] = values
        for extreme, beyond in ((np.argmin, np.inf), (np.argmax, -np.inf)):
            # The first of a part where all is missing.
            seen = np.where(np.isnan(table), beyond, table).reshape(parts, width)
            kept.append(begin + extreme(seen, axis=1))
    return np.unique(np.concatenate(kept).astype(np.intp))
