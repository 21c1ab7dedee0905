"""Finds the resolution of a converter in the values that it gave."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["LEAST_LEVELS", "step_seen"]

LEAST_LEVELS = 30
"""Different values that it takes to know the step between them."""
ONE_STEP = 1.6
"""Least distances: a bus that rounds codes again moves each by half its own step at most."""
SAME = 1e-6
"""Share of the range within which two values are the same: what single precision leaves of it."""
AWAY = 0.26
"""Steps by which values may be off a whole number of steps: a bus that rounds to half a step."""
SURE = 0.99
"""Share of the values that must lie so near."""


def step_seen(values: NDArray[np.float64]) -> float | None:
    """Return the step of which all values are whole numbers, but for a constant.

    Parameters
    ----------
    values : NDArray[np.float64]
        Samples of one channel, shape (n,); what is not finite does not count.

    Returns
    -------
    float | None
        In the unit of the values; None where too few different values, or none of such a step,
        are there: resampled or exact data.
    """
    known = values[np.isfinite(values)]
    levels = np.unique(known)
    if levels.size < LEAST_LEVELS:
        return None
    apart = np.diff(levels)
    apart = apart[apart > SAME * (levels[-1] - levels[0]) / LEAST_LEVELS]
    if apart.size < LEAST_LEVELS - 1:
        return None
    least = float(apart.min())
    step = float(apart[apart < ONE_STEP * least].mean())
    # Neighbours first: an error of the step grows with the distance that it is used over.
    for _ in range(3):
        number = np.cumsum(np.concatenate([[0.0], np.rint(np.diff(levels) / step)]))
        centred = number - number.mean()
        step = float(centred @ (levels - levels.mean())) / float(centred @ centred)
    origin = float(np.median(levels - number * step))
    off = np.abs(levels - origin - number * step) / step
    return step if float(np.quantile(off, SURE)) <= AWAY else None
