"""Moves gaps among late frames to where the measured signals run smoothly.

Late stamps leave open which of a few frames is the one before a loss. Where the signals move, they
tell: a frame on the wrong side of a gap makes a corner in each of them. Where they do not move, it
does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["settle_gaps"]

FARTHEST = 12
"""Frames by which a gap may be moved."""
AROUND = 3
"""Frames beyond them that are looked at."""
STRANGE = 25.0
"""Most that one corner counts, in variances: what is stranger is no matter of placing."""
LONGEST = 4
"""Spacings of a gap that signals bridge."""
LEAST_LATE = 0.05
"""Usual lateness, ticks, below which stamps tell by themselves."""

Ticks = NDArray[np.int64]
Floats = NDArray[np.float64]


def settle_gaps(tick: Ticks, late: Floats, every: int, signals: Sequence[Floats]) -> Ticks:
    """Move gaps to where time stamps and signals together put them.

    Parameters
    ----------
    tick : Ticks
        Tick of each frame; each gap as early as the stamps allow, shape (n,).
    late : Floats
        Delay of each stamp, ticks, shape (n,).
    every : int
        Ticks between two frames.
    signals : Sequence[Floats]
        What the frames measured, NaN where nothing, shape (n,) each.

    Returns
    -------
    Ticks
        The ticks, shape (n,).
    """
    spread = float(np.sqrt(np.mean(late**2))) if len(late) else 0.0
    step = np.diff(tick)
    gaps = np.flatnonzero((step > every) & (step <= LONGEST * every)) + 1
    scaled = [item for item in map(_scaled, signals) if item is not None]
    if spread < LEAST_LATE or len(gaps) == 0 or not scaled:
        return tick
    out = tick.copy()
    for index, gap in enumerate(gaps.tolist()):
        end = int(gaps[index + 1]) if index + 1 < len(gaps) else len(tick)
        most = min(FARTHEST, end - gap - 1)
        jump = int(step[gap - 1]) - every
        low, high = max(gap - AROUND, 0), min(gap + most + AROUND, len(tick))
        costs = []
        for moved in range(most + 1):
            placed = out[low:high].copy()
            placed[gap - low : gap - low + moved] -= jump
            delay = late[gap : gap + moved]
            unlikely = float(np.sum((delay + jump) ** 2 - delay**2)) / spread**2
            costs.append(unlikely + sum(_corners(placed, item[low:high]) for item in scaled))
        best = int(np.argmin(costs))
        out[gap : gap + best] -= jump
    return out


def _scaled(values: Floats) -> Floats | None:
    """Values in units of the noise of their second differences; None of a signal that stands."""
    second = np.abs(values[2:] - 2.0 * values[1:-1] + values[:-2])
    seen = second[np.isfinite(second)]
    noise = float(np.median(seen)) if len(seen) else 0.0
    return values / noise if noise > 0.0 else None


def _corners(tick: Ticks, values: Floats) -> float:
    """Sum of squares by which each value lies off the line between its neighbours."""
    known = np.isfinite(values)
    at, seen = tick[known].astype(np.float64), values[known]
    if len(seen) < 3:
        return 0.0
    weight = (at[1:-1] - at[:-2]) / np.maximum(at[2:] - at[:-2], 1.0)
    off = seen[1:-1] - (1.0 - weight) * seen[:-2] - weight * seen[2:]
    # In units of a second difference, twice what the middle value lies off the line.
    return float(np.minimum(4.0 * off**2, STRANGE).sum())
