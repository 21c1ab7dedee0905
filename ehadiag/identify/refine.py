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

from ehadiag.identify.batch import Batch, Workspace, residuals, spool_rates, workspace

__all__ = ["CAP", "Refinement", "median_offsets", "refine"]

CAP = 9.0
STEP = 5e-5
"""Half-width of the differences, fault constants."""
KINK = 0.3
"""Two-sided differences that disagree by more (in units of noise) mark a break-away."""
ITERATIONS = 20
CONVERGED = 1e-6
FAULT_COUNT = 3


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
    anchored: int


class _Model:
    """Gaps of a candidate; counts evaluations."""

    def __init__(self, batch: Batch, noise: tuple[float, float]) -> None:
        self.batch = batch
        self.work: Workspace = workspace(batch)
        self.evaluations = 0
        self.anchored = 0
        self.scale = np.array([1.0, 1.0, 1.0, *noise])

    def gaps(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted gaps at x (fault constants, offsets in units of noise), shape (2, N)."""
        out = np.empty((2, len(self.batch.current)))
        self.anchored = residuals(self.batch, x * self.scale, self.work, out)
        self.evaluations += 1
        return out

    def spool_rate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted velocity of the spool at the end of each tick, 1/s, shape (N,)."""
        out = np.empty(len(self.batch.current))
        spool_rates(self.batch, x * self.scale, self.work, out)
        return out * self.batch.weight[0]

    def jacobian(
        self, x: NDArray[np.float64], gaps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Derivatives, shape (5, 2, N), and the rows whose derivatives hold, shape (2, N)."""
        out = np.zeros((len(x), *gaps.shape))
        smooth = np.ones(gaps.shape, dtype=np.bool_)
        for j in range(FAULT_COUNT):
            above, below = x.copy(), x.copy()
            above[j] = x[j] + STEP if x[j] + STEP <= 1.0 else x[j] - 2.0 * STEP
            below[j] = x[j] - STEP if x[j] - STEP >= 0.0 else x[j] + 2.0 * STEP
            high, low = self.gaps(above), self.gaps(below)
            out[j] = (high - low) / (above[j] - below[j])
            straight = low + out[j] * (x[j] - below[j])
            smooth &= np.abs(gaps - straight) < KINK
        out[3, 0] = -self.batch.weight[0] * self.scale[3]
        out[4, 1] = -self.batch.weight[1] * self.scale[4]
        return out, smooth


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
    model = _Model(batch, noise)
    x = np.concatenate([np.clip(start, 0.0, 1.0), offsets / np.array(noise)])
    gaps = model.gaps(x)
    cost = _capped(gaps)
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
            trial_cost = _capped(trial_gaps)
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
    gaps = model.gaps(x)
    anchored = model.anchored
    jacobian, smooth = model.jacobian(x, gaps)
    weighted = batch.weight > 0.0
    used = smooth & (gaps**2 < CAP) & weighted
    jacobian[:, ~used] = 0.0
    return Refinement(
        values=x[:FAULT_COUNT],
        offsets=x[FAULT_COUNT:] * np.array(noise),
        cost=cost,
        gaps=gaps,
        jacobian=jacobian,
        spool_rate=model.spool_rate(x),
        used=used,
        weighted=weighted,
        evaluations=model.evaluations,
        converged=converged,
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


def _capped(gaps: NDArray[np.float64]) -> float:
    return float(np.minimum(gaps**2, CAP).sum())
