"""Noise and constant errors that the residuals show, read from histograms."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.identify.noise import KEPT_MEAN, KEPT_SHARE
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.layout import NUMBER, RESIDUAL
from ehadiag.onboard.layout import (
    BELIEF,
    BINS,
    GENES,
    HISTOGRAMS,
    LANES,
    NOISE,
    POINT,
    REFINEMENT,
    RUNS,
    SIZE,
    Advance,
    advance_of,
    keep_advance,
)
from ehadiag.onboard.run import loosen, start_lane, vector_at

__all__ = ["clear_histograms", "count_residual", "look", "shown_noise"]

Array = NDArray[np.float64]
WIDEST = 12.0
"""In units of the plan's noise: a residual beyond is counted as one there."""
ROOT_SIX = 2.449489742783178
LEAST_NOISE = 0.5
"""Of the plan's: a converter's rounding alone makes more."""
SPREADS = (2e-3, 1e-3, 4e-4)
"""See `ehadiag.identify.refine.least_squares.SPREAD`."""


@inlined_exact
def clear_histograms(p: Array) -> None:
    """Begin to count."""
    for i in range(4 * BINS):
        p[HISTOGRAMS + i] = 0.0


@inlined_exact
def count_residual(p: Array, channel: int, now: float, before: float, earlier: float) -> None:
    """Count a residual and its second difference, in units of the plan's noise; NaN counts not."""
    if math.isfinite(now):
        place = min(max((now + WIDEST) * (BINS / (2.0 * WIDEST)), 0.0), BINS - 1.0)
        p[HISTOGRAMS + channel * BINS + int(place)] += 1.0
    second = abs(now - 2.0 * before + earlier)
    if math.isfinite(second):
        place = min(second * (BINS / (ROOT_SIX * WIDEST)), BINS - 1.0)
        p[HISTOGRAMS + (2 + channel) * BINS + int(place)] += 1.0


@inlined_exact
def shown_noise(p: Array, channel: int) -> float:
    """Noise that the second differences show, of which the largest 2 % are left out."""
    total, seen, mean = 0.0, 0.0, 0.0
    first = HISTOGRAMS + (2 + channel) * BINS
    for i in range(BINS):
        total += p[first + i]
    if total < 1.0:
        return 1.0
    for i in range(BINS):
        taken = min(p[first + i], KEPT_SHARE * total - seen)
        if taken > 0.0:
            # Of a bin that is cut the lower part is taken.
            share = taken / p[first + i]
            mean += taken * (i + 0.5 * share) * (ROOT_SIX * WIDEST / BINS)
            seen += taken
    return max(mean / (seen * KEPT_MEAN * ROOT_SIX), LEAST_NOISE)


@inlined_exact
def _median(p: Array, channel: int) -> float:
    """Of the residuals, in units of the plan's noise."""
    total, seen = 0.0, 0.0
    first = HISTOGRAMS + channel * BINS
    for i in range(BINS):
        total += p[first + i]
    for i in range(BINS):
        if seen + p[first + i] >= 0.5 * total and total > 0.0:
            share = (0.5 * total - seen) / p[first + i]
            return (i + share) * (2.0 * WIDEST / BINS) - WIDEST
        seen += p[first + i]
    return 0.0


@brief_kernel
def look(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """One run of the model, free, at the optimum of the search: noise, and offsets it shows."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    a = advance_of(p)
    start_lane(address, plan_address, plan, 0, vector_at(address, POINT))
    loosen(address, 0, math.inf)
    clear_histograms(p)
    room = array_at(address + NUMBER * BELIEF, (2, 2))
    for i in range(2):
        room[0, i] = room[1, i] = math.nan
    for k in range(count):
        push_tick(
            address + NUMBER * LANES,
            (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]),
        )
        for channel in range(2):
            now = p[LANES + RESIDUAL + channel]
            count_residual(p, channel, now, room[0, channel], room[1, channel])
            room[1, channel] = room[0, channel]
            room[0, channel] = now
    p[RUNS] += 1.0
    for channel in range(2):
        p[NOISE + channel] = shown_noise(p, channel)
        p[POINT + GENES + channel] += _median(p, channel)
    for i in range(GENES):
        for j in range(GENES):
            p[BELIEF + i * GENES + j] = SPREADS[i] if i == j else 0.0
    keep_advance(p, Advance(REFINEMENT, 0.0, a.best, 0.0, 0.0))
