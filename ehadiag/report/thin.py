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
    parts = np.array_split(np.arange(ticks), max(1, most // EXTREMES))
    kept = [
        part[0] + choice
        for part in parts
        for values in (first[part], second[part])
        for choice in _extremes(values)
    ]
    return np.unique(np.array(kept, dtype=np.intp))


def _extremes(values: Array) -> tuple[int, int]:
    """Where the least and the greatest are; the first where all is missing."""
    least, greatest = np.where(np.isnan(values), np.inf, values), np.nan_to_num(values, nan=-np.inf)
    return int(least.argmin()), int(greatest.argmax())
