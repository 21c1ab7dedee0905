"""Deterministic refinement: robust least squares on all of the test, and what it leaves.

Damped Gauss-Newton on the weighted gaps of spool and pressure, the model re-anchored on the
measured spool. Gaps beyond three times the noise are left out of a step (their square is capped),
and so are rows whose two-sided differences disagree: there a break-away goes one way on one side
and the other way on the other. Constant offsets of both sensors are estimated beside the faults;
being constant they are told apart from the faults, which act alike in both directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch, residuals, workspace
from ehadiag.identify.gapmodel import CAP, FAULT_COUNT, STEP, GapModel, capped
from ehadiag.identify.settle import centre, settle

__all__ = ["Refinement", "describe", "median_offsets", "refine"]

ITERATIONS = 20
CONVERGED = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Optimum of the robust least squares.

    Attributes
    ----------
    values: Kintas, FSS, FDJ, shape (3,).
    offsets: spool (m) and pressure (Pa), shape (2,).
    cost: capped sum of squares there.
    gaps: weighted gaps there, shape (2, N), 0 where no sample.
    jacobian: derivative of the gaps by the fault constants and, scaled by the noise, by the
        offsets; 0 in rows left out; shape (5, 2, N).
    spool_rate: velocity of the modelled spool at the end of each tick, weighted like its gap, 1/s,
        shape (N,).
    used: rows that took part, shape (2, N).
    weighted: rows that have a sample, shape (2, N).
    evaluations: runs of the model.
    converged: whether the last step was below 1e-6.
    jagged: break-aways make steps in the cost about the optimum: a descent may stop beside it.
    anchored: how often the model was re-anchored at the optimum.
    """

    values: NDArray[np.float64]
    offsets: NDArray[np.float64]
    cost: float
    gaps: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    spool_rate: NDArray[np.float64]
    used: NDArray[np.bool_]
    weighted: NDArray[np.bool_]
    evaluations: int
    converged: bool
    jagged: bool
    anchored: int


def refine(
    batch: Batch,
    start: NDArray[np.float64],
    offsets: NDArray[np.float64],
    noise: tuple[float, float],
) -> Refinement:
    """Minimise the capped sum of squares.

    Parameters
    ----------
    start: fault constants, shape (3,).
    offsets: of spool (m) and pressure (Pa) at the start, shape (2,).
    noise: that of spool (m) and pressure (Pa), the unit in which offsets are sought.
    """
    model = GapModel(batch, noise)
    x = np.concatenate([np.clip(start, 0.0, 1.0), offsets / np.array(noise)])
    gaps = model.gaps(x)
    cost = capped(gaps)
    damping = 1e-5
    converged = False
    for _ in range(ITERATIONS):
        jacobian, smooth = model.jacobian(x, gaps)
        used = smooth & (gaps**2 < CAP)
        rows = jacobian[:, used]
        normal, gradient = rows @ rows.T, rows @ gaps[used]
        free = ~((x == 0.0) & (gradient > 0.0) | (x == 1.0) & (gradient < 0.0))
        free[FAULT_COUNT:] = True
        moved = False
        for _ in range(8):
            step = np.zeros(len(x))
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
            trial = x + step
            trial[:FAULT_COUNT] = np.clip(trial[:FAULT_COUNT], 0.0, 1.0)
            trial_gaps = model.gaps(trial)
            trial_cost = capped(trial_gaps)
            if trial_cost <= cost:
                moved = True
                break
            damping = max(damping * 10.0, 1e-6)
        if not moved:
            # No step improves: the optimum, to within the jumps that break-aways make.
            converged = bool(np.abs(step[:FAULT_COUNT]).max() < STEP)
            break
        size = float(np.abs(trial - x)[:FAULT_COUNT].max())
        x, gaps, cost = trial, trial_gaps, trial_cost
        damping = max(damping / 10.0, 1e-9)
        if size < CONVERGED:
            converged = True
            break
    x, smooth_bowl = settle(model, x, gaps, cost)
    return _described(model, x, converged=converged, jagged=not smooth_bowl)


def describe(
    batch: Batch,
    values: NDArray[np.float64],
    offsets: NDArray[np.float64],
    noise: tuple[float, float],
    *,
    converged: bool,
) -> Refinement:
    """What `refine` returns, for a point beside steps in the cost that something else has found.

    The point is moved to the middle of the ground that the steps leave.
    """
    model = GapModel(batch, noise)
    x = np.concatenate([values, offsets / np.array(noise)])
    x = centre(model, x)
    return _described(model, x, converged=converged, jagged=True)


def _described(
    model: GapModel, x: NDArray[np.float64], *, converged: bool, jagged: bool
) -> Refinement:
    gaps = model.gaps(x)
    anchored = model.anchored
    weighted = model.batch.weight > 0.0
    jacobian, steady = model.trusted_jacobian(x, gaps)
    used = steady & (gaps**2 < CAP) & weighted
    jacobian[:, ~used] = 0.0
    return Refinement(
        values=x[:FAULT_COUNT],
        offsets=x[FAULT_COUNT:] * model.scale[FAULT_COUNT:],
        cost=capped(gaps),
        gaps=gaps,
        jacobian=jacobian,
        spool_rate=model.spool_rate(x),
        used=used,
        weighted=weighted,
        evaluations=model.evaluations,
        converged=converged,
        jagged=jagged,
        anchored=anchored,
    )


def median_offsets(batch: Batch, faults: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median gap of spool (m) and pressure (Pa), shape (2,), at fault constants of shape (3,).

    For a batch that runs free: re-anchoring would take most of an offset away.
    """
    gaps = np.empty((2, len(batch.current)))
    residuals(batch, np.concatenate([faults, [0.0, 0.0]]), workspace(batch), gaps)
    out = np.zeros(2)
    for channel in range(2):
        weight = batch.weight[channel]
        used = weight > 0.0
        if used.any():
            out[channel] = float(np.median(gaps[channel, used] / weight[used]))
    return out
