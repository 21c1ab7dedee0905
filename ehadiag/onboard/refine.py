"""Damped Gauss-Newton on severities and offsets, its derivatives by monitors side by side."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.layout import NUMBER, RESIDUAL
from ehadiag.monitor.layout import SIZE as MONITOR_SIZE
from ehadiag.onboard.bounded import bounded_step
from ehadiag.onboard.conclude import conclude
from ehadiag.onboard.layout import (
    DONE,
    GENES,
    GRADIENT,
    LANES,
    MONITORS,
    NORMAL,
    PARAMETERS,
    POINT,
    REFINEMENT,
    RUNS,
    SCRATCH,
    SIZE,
    STEP,
    TRIAL,
    Advance,
    Outcome,
    advance_of,
    keep_advance,
    keep_outcome,
    outcome_of,
)
from ehadiag.onboard.run import PRESSURE_WEIGHT, SPOOL_WEIGHT, start_lane, vector_at

__all__ = ["LEAST_DAMPING", "refine"]

Array = NDArray[np.float64]
CAP = 9.0
"""Largest square of one residual that counts."""
KINK = 0.3
"""Two-sided differences that disagree by more (in units of noise) mark a break-away."""
ITERATIONS = 16
LEAST_GAIN = 1e-2
LEAST_DAMPING, MOST_DAMPING = 1e-6, 10.0


@brief_kernel
def _derive(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int
) -> tuple[float, float, float]:
    """Normal matrix and gradient at the trial: cost, residuals, and those beyond the cap."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    trial = vector_at(address, TRIAL)
    normal = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    gradient = vector_at(address, SCRATCH + PARAMETERS * PARAMETERS)
    slope = vector_at(address, SCRATCH + PARAMETERS * (PARAMETERS + 1))
    for i in range(PARAMETERS):
        gradient[i] = 0.0
        for j in range(PARAMETERS):
            normal[i, j] = 0.0
    for lane in range(MONITORS):
        which, side = (lane - 1) // 2, STEP if lane % 2 == 1 else -STEP
        if lane > 0:
            kept = trial[which]
            trial[which] = kept + side
            start_lane(address, plan_address, plan, lane, trial)
            trial[which] = kept
        else:
            start_lane(address, plan_address, plan, lane, trial)
    cost, samples, beyond = 0.0, 0.0, 0.0
    for k in range(count):
        sample = (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4])
        for lane in range(MONITORS):
            push_tick(address + NUMBER * (LANES + lane * MONITOR_SIZE), sample)
        for channel in range(2):
            at = LANES + RESIDUAL + channel
            r = p[at]
            if not math.isfinite(r):
                continue
            samples += 1.0
            cost += min(r * r, CAP)
            smooth = r * r < CAP
            if not smooth:
                beyond += 1.0
            for i in range(PARAMETERS):
                up = p[at + (1 + 2 * i) * MONITOR_SIZE]
                down = p[at + (2 + 2 * i) * MONITOR_SIZE]
                if not abs(up - r - (r - down)) <= KINK:
                    smooth = False
                slope[i] = (up - down) / (2.0 * STEP)
            if smooth:
                for i in range(PARAMETERS):
                    gradient[i] += slope[i] * r
                    for j in range(PARAMETERS):
                        normal[i, j] += slope[i] * slope[j]
    p[RUNS] += float(MONITORS)
    return cost, samples, beyond


@brief_kernel
def refine(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """One step of the refinement: derivatives at the trial, and the next trial."""
    p = array_at(address, (SIZE,))
    a = advance_of(p)
    point, trial = vector_at(address, POINT), vector_at(address, TRIAL)
    cost, samples, beyond = _derive(address, plan_address, plan, ticks_address, count)
    best, damping, done = a.best, a.damping, a.steps + 1.0
    ended = False
    if cost < best:
        ended = best - cost < LEAST_GAIN
        best, damping = cost, max(damping / 10.0, LEAST_DAMPING)
        for i in range(PARAMETERS):
            point[i] = trial[i]
        for i in range(PARAMETERS * (PARAMETERS + 1)):
            p[NORMAL + i] = p[SCRATCH + i]
        o = outcome_of(p)
        keep_outcome(
            p,
            Outcome(
                point[0], point[1], point[2], 0.0, 0.0, 0.0,
                point[3] / plan[SPOOL_WEIGHT], point[4] / plan[PRESSURE_WEIGHT],
                0.0, cost, samples, beyond / max(samples, 1.0), o.runs, 0.0,
            ),
        )  # fmt: skip
    else:
        ended = damping >= MOST_DAMPING
        damping = max(100.0 * damping, 0.1)
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    gradient = vector_at(address, GRADIENT)
    matrix = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    step = vector_at(address, SCRATCH + PARAMETERS * PARAMETERS)
    sound = bounded_step(
        point, normal, gradient, damping, GENES, STEP, 1.0 - STEP, matrix, step, trial
    )
    phase = REFINEMENT
    if ended or not sound or done >= ITERATIONS:
        phase = DONE
        conclude(address, ended)
    keep_advance(p, Advance(phase, done, best, damping))
