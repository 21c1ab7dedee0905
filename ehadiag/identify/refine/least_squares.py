"""Deterministic refinement: robust least squares on a test, and what it leaves.

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

from ehadiag.identify.refine.bounded_step import bounded_step
from ehadiag.identify.refine.plateau import centre, settle
from ehadiag.identify.refine.residual_model import CAP, FAULT_COUNT, GapModel, Slope, capped
from ehadiag.model.scalar.residuals import Batch, residuals, workspace

__all__ = ["Refinement", "describe", "gaps_of", "median_offsets", "refine"]

ITERATIONS = 20
CONVERGED = 1e-6
LEAST_GAIN = 1e-3
"""Cost; the optimum is then nearer than some hundredths of a deviation."""
LEAST_DAMPING = 1e-6
CAUTIOUS_DAMPING = 0.3
"""Two steps are tried at once, the second one damped at least so much."""
MORE = 100.0
"""Ratio of their damping at least."""
MOST_DAMPING = 10.0


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
    slope = model.slopes([x])[0]
    damping = LEAST_DAMPING
    converged = False
    for _ in range(ITERATIONS):
        cautious = max(MORE * damping, CAUTIOUS_DAMPING)
        trials = [_stepped(slope, damping), _stepped(slope, cautious)]
        size = float(np.abs(trials[0] - slope.x)[:FAULT_COUNT].max())
        if size < CONVERGED:
            converged = True
            break
        best = min(model.slopes(trials), key=lambda trial: trial.cost)
        gained = slope.cost - best.cost
        if gained > 0.0:
            slope = best
            if gained < LEAST_GAIN:
                converged = True
                break
            damping = max(damping / 10.0, LEAST_DAMPING)
        elif damping >= MOST_DAMPING:
            # No step improves: the optimum, to within the jumps that break-aways make.
            converged = True
            break
        else:
            damping = MOST_DAMPING
    bowl = settle(model, slope)
    return _described(model, bowl.x, bowl.slope, converged=converged, jagged=not bowl.smooth)


def _stepped(slope: Slope, damping: float) -> NDArray[np.float64]:
    """Point that a damped Gauss-Newton step leads to, within the bounds."""
    x, used = slope.x, slope.used
    rows = slope.jacobian[:, used]
    normal = rows @ rows.T
    normal += np.diag(damping * np.diag(normal) + 1e-12)
    return bounded_step(x, normal, rows @ slope.gaps[used])


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
    slope = model.trusted_slope(np.concatenate([values, offsets / np.array(noise)]))
    x = centre(model, slope)
    if x is not slope.x:
        slope = model.trusted_slope(x)
    return _described(model, x, slope, converged=converged, jagged=True)


def _described(
    model: GapModel, x: NDArray[np.float64], slope: Slope, *, converged: bool, jagged: bool
) -> Refinement:
    """Put together what is known at x; `slope` is that of a point so near that it holds there."""
    gaps, anchored = model.one(x)
    weighted = model.batch.weight > 0.0
    used = slope.smooth & (gaps**2 < CAP) & weighted
    jacobian = np.where(used, slope.jacobian, 0.0)
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


def gaps_of(batch: Batch, faults: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted gaps, shape (2, N), at fault constants of shape (3,), no offsets taken off."""
    gaps = np.empty((2, len(batch.current)))
    residuals(batch, np.concatenate([faults, [0.0, 0.0]]), workspace(batch), gaps)
    return gaps


def median_offsets(batch: Batch, gaps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median gap of spool (m) and pressure (Pa), shape (2,), of weighted gaps of shape (2, N).

    For a batch that runs free: re-anchoring would take most of an offset away.
    """
    out = np.zeros(2)
    for channel in range(2):
        weight = batch.weight[channel]
        used = weight > 0.0
        if used.any():
            out[channel] = float(np.median(gaps[channel, used] / weight[used]))
    return out
