"""Uncertainty of estimates: curvature of the likelihood, inflated for what residuals show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.derivatives import CAP
from ehadiag.identify.refine.least_squares import Refinement
from ehadiag.model.parameters import Kind, Parameter

__all__ = [
    "DISCREPANCY_STD",
    "EXPECTED_CAPPED",
    "UNIFORM_STD",
    "covariance",
    "independent",
    "interval95",
]

NORMAL = NormalDist()
CUT = float(np.sqrt(CAP))
LAGS = 20
"""Ticks over which residuals are held to be correlated."""
DISCREPANCY_STD = 3e-5
"""Severity; what estimates from a plant integrated by other means differ by beyond noise."""
UNIFORM_STD = 1.0 / np.sqrt(12.0)
"""Standard deviation of a severity of which nothing is known but 0 … 1."""


def covariance(refinement: Refinement) -> NDArray[np.float64]:
    """Covariance of the estimates, SI, shape (k, k), in the order of the refinement's parameters.

    The larger of two, parameter by parameter: the inverse curvature times the reduced sum of
    squares (never below 1), and the sandwich estimate with residuals correlated over some ticks
    (Newey and West, Econometrica 55(3), 1987), which grows with what the model does not explain.
    A severity that the test does not show has the variance of a uniform density, or of what was
    known beforehand. On top comes what
    the considered parameters do: where one of them is off by a deviation the estimate moves in
    proportion (Schmidt, Advances in Control Systems 3, 1966); and `DISCREPANCY_STD`, for what
    either side's integration is off.
    """
    normal = refinement.normal
    information = refinement.information
    if information is None:
        # A weak prior keeps a severity that nothing shows finite: uniform on its range.
        severities = np.array([item.kind is Kind.FAULT for item in refinement.parameters])
        information = np.diag(np.where(severities, 1.0 / UNIFORM_STD**2, 0.0))
    inverse = np.linalg.pinv(normal + information, hermitian=True)
    count = int(refinement.used.sum())
    squares = float((refinement.residuals[refinement.used] ** 2).sum())
    reduced = squares / max(count - len(normal), 1)
    curved = inverse * max(reduced / EXPECTED_CAPPED, 1.0)
    meat = _meat(refinement)
    if refinement.information is not None:
        meat = meat + information  # what was known is like one more sample of each parameter
    sandwich = inverse @ meat @ inverse
    factor = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(curved), 1e-300), 1.0))
    out = curved * np.outer(factor, factor)
    rows = refinement.jacobian[:, refinement.used]
    for change in refinement.considered:
        shift = inverse @ (rows @ change[refinement.used])
        out += np.outer(shift, shift)
    out += DISCREPANCY_STD**2 * np.eye(len(out))
    return np.asarray(out * np.outer(refinement.scale, refinement.scale))


EXPECTED_CAPPED = 1.0 - 2.0 * CUT * NORMAL.pdf(CUT) / (2.0 * NORMAL.cdf(CUT) - 1.0)
"""Mean square of a normal variable of which values beyond three deviations are left out."""


def _meat(refinement: Refinement) -> NDArray[np.float64]:
    """Covariance of the gradient, residuals of both signals taken together at each tick."""
    residuals = np.where(refinement.used, refinement.residuals, 0.0)
    score = (refinement.jacobian * residuals).sum(axis=1)
    total = score @ score.T
    for lag in range(1, LAGS + 1):
        weight = 1.0 - lag / (LAGS + 1.0)
        cross = score[:, lag:] @ score[:, :-lag].T
        total = total + weight * (cross + cross.T)
    return np.asarray(total)


def independent(parameters: Sequence[Parameter], std: Mapping[str, float]) -> NDArray[np.float64]:
    """Covariance of deviations by name that have nothing to do with each other, shape (k, k).

    std: in the parameters' units; 0 of those that are not named.
    """
    return np.diag([std.get(item.name, 0.0) ** 2 for item in parameters])


def interval95(value: float, std: float) -> tuple[float, float]:
    """Central 95 % interval of a normal density, cut at the bounds 0 and 1.

    For an estimate at a bound the interval begins there: the density beyond it carries nothing.
    """
    half = NORMAL.inv_cdf(0.975) * std
    return max(0.0, value - half), min(1.0, value + half)
