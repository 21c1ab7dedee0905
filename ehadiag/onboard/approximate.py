"""First approximation: offsets while nothing is commanded, then two grids of severities."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.onboard.layout import (
    ELITE,
    GENERATOR,
    GENES,
    GRIDS,
    JACK,
    MEAN,
    POINT,
    SEARCH,
    SIZE,
    SPREAD,
    TRIAL,
    Advance,
    advance_of,
    keep_advance,
)
from ehadiag.onboard.run import PRESSURE_WEIGHT, SPOOL_WEIGHT, run_model, vector_at

__all__ = ["approximate", "take_offsets"]

Array = NDArray[np.float64]
GRID = 5
"""Values of Kintas and of FSS on the first grid."""
JACK_GRID = 9
"""Values of FDJ on the second."""
CAP = 1e4
"""Largest square of one residual that counts: the model runs free."""
WIDE = 0.15
"""Deviation with which the genetic search begins."""
LEAST_REST = 20.0
"""Samples at rest that give an offset."""


@inlined_exact
def take_offsets(p: Array, plan: Array, ticks: Array, count: int) -> None:
    """Take the offsets from what the sensors show while nothing is commanded, if that is long."""
    for channel in range(2):
        total, seen = 0.0, 0.0
        for k in range(count):
            if ticks[k, 0] != 0.0:
                break
            value = ticks[k, 2 + channel]
            if math.isfinite(value):
                total += value
                seen += 1.0
        weight = plan[SPOOL_WEIGHT] if channel == 0 else plan[PRESSURE_WEIGHT]
        offset = total / seen * weight if seen >= LEAST_REST else 0.0
        p[POINT + GENES + channel] = p[TRIAL + GENES + channel] = offset


@brief_kernel
def approximate(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int
) -> None:
    """One run of the first approximation."""
    p = array_at(address, (SIZE,))
    point, trial = vector_at(address, POINT), vector_at(address, TRIAL)
    a = advance_of(p)
    k = int(a.steps)
    if a.phase == GRIDS:
        trial[0], trial[1] = (k // GRID) / (GRID - 1), (k % GRID) / (GRID - 1)
    else:
        trial[2] = k / (JACK_GRID - 1)
    spool, pressure = run_model(address, plan_address, plan, ticks_address, count, trial, CAP)
    cost = spool if a.phase == GRIDS else pressure
    best = a.best
    if cost < best:
        best = cost
        for i in range(GENES):
            point[i] = trial[i]
    phase, done = a.phase, a.steps + 1.0
    if phase == GRIDS and done == GRID * GRID:
        phase, done, best = JACK, 0.0, math.inf
        trial[0], trial[1] = point[0], point[1]
    elif phase == JACK and done == JACK_GRID:
        phase, done, best = SEARCH, 0.0, math.inf
        for i in range(GENES):
            p[MEAN + i] = p[ELITE + i] = point[i]
            p[SPREAD + i] = WIDE
        p[GENERATOR] = math.inf
        p[GENERATOR + 1] = 0.0
    keep_advance(p, Advance(phase, done, best, 0.0, 0.0))
