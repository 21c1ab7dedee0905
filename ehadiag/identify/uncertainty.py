"""How sure: from the curvature of the likelihood, inflated for what the gaps show."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.least_squares import Refinement
from ehadiag.identify.refine.residual_model import CAP, FAULT_COUNT

__all__ = ["covariance", "interval95", "normal_matrix"]

NORMAL = NormalDist()
CUT = float(np.sqrt(CAP))
LAGS = 20
"""Ticks over which gaps are held to be correlated."""
TIMING_STD = 0.15e-6
"""s; half a step of a plant that is integrated at 0.25 µs is of this size."""
DISCREPANCY_STD = 3e-5
"""Fault constant; what estimates from a plant integrated by other means differ by beyond noise."""
UNIFORM_STD = 1.0 / np.sqrt(12.0)
"""Standard deviation of a constant of which nothing is known but 0 … 1."""


def normal_matrix(refinement: Refinement) -> NDArray[np.float64]:
    """JᵀJ of the weighted gaps by (Kintas, FSS, FDJ, offsets), shape (5, 5)."""
    rows = refinement.jacobian[:, refinement.used]
    return np.asarray(rows @ rows.T)


def covariance(refinement: Refinement) -> NDArray[np.float64]:
    """Covariance of the three fault constants, shape (3, 3).

    The larger of two, constant by constant: the inverse curvature times the reduced sum of squares
    (never below 1), and the sandwich estimate with gaps correlated over some ticks (Newey and
    West, Econometrica 55(3), 1987), which grows with what the model does not explain.
    A constant that the test does not show has the variance of a uniform density. On top comes what
    the unknown instant of sampling does: where the converters read `TIMING_STD` earlier or later
    than the model holds, the estimate moves in proportion; and `DISCREPANCY_STD`, for what either
    side's integration is off.
    """
    normal = normal_matrix(refinement)
    # A weak prior keeps a constant that nothing shows finite: uniform on 0 … 1.
    prior = np.zeros(len(normal))
    prior[:FAULT_COUNT] = 1.0 / UNIFORM_STD**2
    inverse = np.linalg.pinv(normal + np.diag(prior), hermitian=True)
    count = int(refinement.used.sum())
    reduced = float((refinement.gaps[refinement.used] ** 2).sum()) / max(count - len(normal), 1)
    curved = inverse * max(reduced / EXPECTED_CAPPED, 1.0)
    sandwich = inverse @ _meat(refinement) @ inverse
    factor = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(curved), 1e-300), 1.0))
    shift = inverse @ _late(refinement) * TIMING_STD
    out = curved * np.outer(factor, factor) + np.outer(shift, shift)
    out += DISCREPANCY_STD**2 * np.eye(len(out))
    return np.asarray(out[:FAULT_COUNT, :FAULT_COUNT])


EXPECTED_CAPPED = 1.0 - 2.0 * CUT * NORMAL.pdf(CUT) / (2.0 * NORMAL.cdf(CUT) - 1.0)
"""Mean square of a normal variable of which values beyond three deviations are left out."""


def _late(refinement: Refinement) -> NDArray[np.float64]:
    """Gradient that sampling 1 s later adds, shape (5,); from the spool, which moves fastest."""
    used = refinement.used[0]
    return np.asarray(refinement.jacobian[:, 0, used] @ refinement.spool_rate[used])


def _meat(refinement: Refinement) -> NDArray[np.float64]:
    """Covariance of the gradient, gaps of both channels taken together at each tick."""
    gaps = np.where(refinement.used, refinement.gaps, 0.0)
    score = (refinement.jacobian * gaps).sum(axis=1)
    total = score @ score.T
    for lag in range(1, LAGS + 1):
        weight = 1.0 - lag / (LAGS + 1.0)
        cross = score[:, lag:] @ score[:, :-lag].T
        total = total + weight * (cross + cross.T)
    return np.asarray(total)


def interval95(value: float, std: float) -> tuple[float, float]:
    """Central 95 % interval of a normal density, cut at the bounds 0 and 1.

    For an estimate at a bound the interval begins there: the density beyond it carries nothing.
    """
    half = NORMAL.inv_cdf(0.975) * std
    return max(0.0, value - half), min(1.0, value + half)
