"""Tests whether residuals are only noise, judged by the noise level in the recording itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.calibration import CHANGED, NOISE_ALONE, Goodness
from ehadiag.identify.noise import relative_noise
from ehadiag.identify.refine.posterior import TAIL

__all__ = [
    "Explains",
    "excess",
    "excess_of_signals",
    "is_hopeless",
    "is_noise",
    "is_of_the_pressure",
    "leaves_no_more",
    "misses_only_pressure",
    "outliers_of",
]

Explains = Callable[[NDArray[np.float64]], bool]
"""Of weighted residuals, shape (signals, N): whether there is nothing better to look for."""

EXPECTED = 0.8618
"""Mean of Cauchy's cost for a standard normal residual, TAIL² E ln(1 + (r/TAIL)²)."""
MOST_EXCESS = NOISE_ALONE
"""1.02 to 1.15 at the optimum of 80 simulated tests: rounding makes some noise that lasts."""
MOST_OUTLIERS = 0.01
"""Share of residuals beyond three deviations."""


HOPELESS = (0.3, 0.05)
"""Share of residuals beyond three deviations after one start, and after two, from which on no more
is looked for: 0.003 at most after the first one on sound units, 0.08 and more on broken ones."""
HOPELESS_ASTRAY = (0.6, 0.42, 0.42, 0.2)
"""The same in closed loop, where searches that went astray on sound units left 0.45 after a first
start, 0.38 after one or two that took their time, and 0.07 after three; further ones explained each
of them."""
HOPELESS_SPOOL = 30.0
"""Excess of the spool there after two starts: 19 at most on those units."""
HOPELESS_PRESSURE = 0.1
"""Share of outliers there after two starts if the pressure is explained worse than the spool, which
shows it where a search went astray: 0.07 at most on those units, 0.16 and more on broken ones."""
HOPELESS_EXCESS = 3.0
"""Excess in open loop after two starts: 1.6 at most on sound units that a further start explained,
2.0 with a load that is not estimated. In closed loop that of the pressure, for the rule above, or
of the spool while the pressure is explained, which would show a break-away at a wrong tick, too."""
SPOOL_EXPLAINED = 1.25


def excess(residuals: NDArray[np.float64]) -> float:
    """Cost of residuals over that of noise alone, of the signal where the ratio is the larger.

    The noise is that of second differences, which do not see what a model leaves out.

    Parameters
    ----------
    residuals : shape (signals, N)
        Weighted; 0 where no sample counts.
    """
    return max(excess_of_signals(residuals), default=0.0)


def excess_of_signals(residuals: NDArray[np.float64]) -> list[float]:
    """Return the same of each signal; 0 of one without samples."""
    out = []
    for row in residuals:
        known = row != 0.0
        share = row[known] / (TAIL * relative_noise(row)) if known.any() else np.zeros(1)
        out.append(float(TAIL**2 * np.log1p(share**2).mean() / EXPECTED))
    return out


def is_noise(residuals: NDArray[np.float64]) -> bool:
    """Whether nothing is left to explain."""
    return outliers_of(residuals) <= MOST_OUTLIERS and excess(residuals) <= MOST_EXCESS


def leaves_no_more(fit: Goodness) -> Explains:
    """Whether nothing is left beside what a unit's calibration could not explain either."""
    if not fit.left:
        return is_noise
    most_outliers = MOST_OUTLIERS + CHANGED * fit.outliers
    return lambda residuals: (
        outliers_of(residuals) <= most_outliers and excess(residuals) <= fit.most_excess
    )


def is_hopeless(residuals: NDArray[np.float64], starts: int, *, astray: bool = False) -> bool:
    """Whether so much is left after so many starts that further ones will not explain it.

    astray: whether a search may well end beside the optimum.
    """
    most = HOPELESS_ASTRAY if astray else HOPELESS
    outliers = outliers_of(residuals)
    if outliers > most[min(starts, len(most)) - 1]:
        return True
    if starts < 2:
        return False
    spool, *others = excess_of_signals(residuals)
    pressure = max(others, default=0.0)
    if not astray:
        return max(spool, pressure) > HOPELESS_EXCESS
    if pressure > max(spool, HOPELESS_EXCESS):
        return outliers > HOPELESS_PRESSURE
    return spool > (HOPELESS_EXCESS if 0.0 < pressure <= SPOOL_EXPLAINED else HOPELESS_SPOOL)


def misses_only_pressure(residuals: NDArray[np.float64]) -> bool:
    """Whether the spool is explained, so that break-aways come at the right ticks."""
    excesses = excess_of_signals(residuals)
    return excesses[0] <= SPOOL_EXPLAINED and max(excesses[1:], default=0.0) > SPOOL_EXPLAINED


def is_of_the_pressure(residuals: NDArray[np.float64]) -> bool:
    """Whether the spool, where break-aways happen, is explained and the pressure is far from it."""
    spool, pressure = excess_of_signals(residuals)[:2]
    return spool <= SPOOL_EXPLAINED and pressure > HOPELESS_EXCESS


def outliers_of(residuals: NDArray[np.float64]) -> float:
    """Share of residuals beyond three deviations."""
    known = residuals != 0.0
    return float(np.mean(residuals[known] ** 2 >= TAIL**2)) if known.any() else 1.0
