"""Refinement: a belief about severities and offsets, sharpened round by round.

What `ehadiag.identify.refine.posterior` does for few unknowns, in fixed memory: the model is made
linear over the spread of what is believed, on seven models side by side, so that it looks past the
steps that break-aways make in the cost; the linear problem gives a sharper belief.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel
from ehadiag.model.exponential import exponential
from ehadiag.monitor.layout import NUMBER
from ehadiag.onboard.bounded import (
    bounded_step,
    eigenvectors,
    invert,
    invert_small,
    similar,
)
from ehadiag.onboard.elementary import logarithm
from ehadiag.onboard.layout import (
    BELIEF,
    CONCLUSION,
    GENES,
    MONITORS,
    NORMAL,
    PARAMETERS,
    POINT,
    RUNS,
    SCRATCH,
    SIZE,
    TRIAL,
    Advance,
    advance_of,
    keep_advance,
)
from ehadiag.onboard.run import lines, push_lanes, start_cross, vector_at

__all__ = ["refine"]

Array = NDArray[np.float64]
TAIL = 9.0
"""Variances from which a residual counts little."""
ROUNDS = 16
SETTLED_RATIO, SETTLED_STEP = 0.7, 0.05
"""Of a round after which nothing changes: ratio of the widths, step in units of them."""
WIDTH = 4.0
"""Of the belief, in variances of what the linear problem leaves."""
HELD_BACK, FREE = 0.1, 1e-9
"""Share of the belief's information that a step is held back by."""
LEAST_RATIO, LEAST_RATIO_OF_LINEAR = 0.3, 0.05
"""By which a belief may become narrower in a round; the same where the model is linear over it. It
never becomes wider: in single precision it would not come to rest."""
WHOLE_ROUNDS = 10.0
"""Rounds that are taken whole, see `ehadiag.identify.refine.posterior.Pace`; there are more of them
than there."""
MEAN_STEP = 0.25
"""See `ehadiag.identify.refine.posterior`."""
LINEAR_SCATTER, LINEAR_SHARE = 0.1, 0.01
"""Scatter, and share of samples with more of it, up to which it is."""
SQUARE = PARAMETERS * PARAMETERS
MOVED = SCRATCH + 2 * SQUARE + PARAMETERS
SMALL = MOVED + PARAMETERS
"""Places of what a step works on."""


@brief_kernel
def _linearise(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int
) -> tuple[float, float]:
    """Normal matrix and gradient over the belief: what is left unexplained, and jumps' share."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    gradient = vector_at(address, NORMAL + PARAMETERS * PARAMETERS)
    slope = vector_at(address, SCRATCH)
    along = array_at(address + NUMBER * (SCRATCH + PARAMETERS), (GENES, 3))
    for i in range(PARAMETERS * (PARAMETERS + 1)):
        p[NORMAL + i] = 0.0
    start_cross(
        address, plan_address, plan, vector_at(address, POINT), vector_at(address, TRIAL), along
    )
    left, weighed, jumped, samples = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        push_lanes(address, (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]))
        for channel in range(2):
            if not math.isfinite(ticks[k, 2 + channel]):
                continue
            residual, scatter = lines(p, channel, along, slope)
            weight = 1.0 / (1.0 + scatter + residual * residual / TAIL)
            left += residual * residual * weight
            weighed += (1.0 + scatter) * weight
            samples += 1.0
            if scatter > LINEAR_SCATTER:
                jumped += 1.0
            for i in range(PARAMETERS):
                gradient[i] += weight * slope[i] * residual
                for j in range(PARAMETERS):
                    normal[i, j] += weight * slope[i] * slope[j]
    p[RUNS] += float(MONITORS)
    return left / max(weighed, 1.0), jumped / max(samples, 1.0)


@brief_kernel
def _narrow(address: int, excess: float, linear: bool, rounds: float) -> tuple[float, float]:
    """Step and narrow the belief: the ratio by which it would narrow most, the step's length.

    The ratio is negative where there is no step to make. Of late rounds a share is taken.
    """
    part = 1.0 + max(rounds - WHOLE_ROUNDS, 0.0)
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    gradient = vector_at(address, NORMAL + PARAMETERS * PARAMETERS)
    point, trial = vector_at(address, POINT), vector_at(address, TRIAL)
    held = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    matrix = array_at(address + NUMBER * (SCRATCH + SQUARE), (PARAMETERS, PARAMETERS))
    column, out = vector_at(address, SCRATCH + 2 * SQUARE), vector_at(address, MOVED)
    root = array_at(address + NUMBER * BELIEF, (GENES, GENES))
    inverse = array_at(address + NUMBER * SMALL, (GENES, GENES))
    spread = array_at(address + NUMBER * (SMALL + GENES * GENES), (GENES, GENES))
    axes = array_at(address + NUMBER * (SMALL + 2 * GENES * GENES), (GENES, GENES))
    invert_small(root, inverse)
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            held[i, j] = normal[i, j] + (FREE if i == j else 0.0)
            for k in range(GENES if i < GENES and j < GENES else 0):
                held[i, j] += HELD_BACK * inverse[k, i] * inverse[k, j]
    if not bounded_step(trial, held, gradient, GENES, 0.0, 1.0, matrix, column, out):
        return -1.0, 0.0
    step = 0.0
    for i in range(GENES):
        along = 0.0
        for j in range(GENES):
            along += inverse[i, j] * (out[j] - point[j])
        step = max(step, abs(along))
    for i in range(PARAMETERS):
        point[i] = out[i] if part == 1.0 else point[i] + (out[i] - point[i]) / part
    # The covariance that is left, in units of the belief's own root.
    for i in range(PARAMETERS):
        normal[i, i] += FREE * held[i, i]
    for j in range(GENES):
        if not math.isfinite(invert(normal, j, matrix, column)):
            return -1.0, 0.0
        for i in range(GENES):
            spread[i, j] = WIDTH * max(excess, 1.0) * column[i]
    similar(inverse, spread, axes)
    eigenvectors(spread, axes)
    least, narrowest = LEAST_RATIO_OF_LINEAR if linear else LEAST_RATIO, 1.0
    for j in range(GENES):
        ratio = math.sqrt(max(spread[j, j], 0.0))
        narrowest = min(narrowest, ratio)
        kept = min(max(ratio, least), 1.0)
        if part > 1.0:
            kept = exponential(logarithm(kept) / part)
        for i in range(GENES):
            inverse[i, j] = 0.0
            for k in range(GENES):
                inverse[i, j] += root[i, k] * axes[k, j] * kept
    for i in range(GENES):
        for j in range(GENES):
            root[i, j] = inverse[i, j]
    return narrowest, step


@brief_kernel
def refine(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """One round of the refinement."""
    p = array_at(address, (SIZE,))
    a = advance_of(p)
    excess, jumped = _linearise(address, plan_address, plan, ticks_address, count)
    done = a.steps + 1.0
    ratio, step = _narrow(address, excess, jumped < LINEAR_SHARE, done)
    settled = ratio > SETTLED_RATIO and step < SETTLED_STEP
    if done >= ROUNDS:
        settled = ratio > SETTLED_RATIO and step < MEAN_STEP * (1.0 + ROUNDS - WHOLE_ROUNDS)
    phase = CONCLUSION if settled or ratio < 0.0 or done >= ROUNDS else a.phase
    keep_advance(p, Advance(phase, done, a.best, a.judged, 1.0 if settled else 0.0))
