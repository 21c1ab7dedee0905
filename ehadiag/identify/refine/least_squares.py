"""Refinement: robust least squares from the optimum of a search.

A belief about the optimum is sharpened (`ehadiag.identify.refine.posterior`) on the weighted
residuals of spool and pressure, the model re-anchored on the measured spool. Linearising over the
width of what is not yet known looks past the steps that break-aways make in the cost, and where
there are none it is a Gauss-Newton descent. Constant errors of both sensors are estimated beside
the severities; being constant they are told apart from the faults, which act alike in both
directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.derivatives import CAP, Derivatives, capped
from ehadiag.identify.refine.linearisation import Belief, Linearised, crossed
from ehadiag.identify.refine.posterior import FEW, Pace, nothing, sharpen
from ehadiag.model.interface import ResidualModel
from ehadiag.model.parameters import Parameter

__all__ = [
    "CLEAR",
    "SPREAD",
    "Refinement",
    "by_lines",
    "described",
    "median_offsets",
    "refine",
]

SPREAD = np.array([2e-3, 1e-3, 4e-4])
"""Of the severities, in the order of `FAULTS`, about the optimum of a search, which is mostly
nearer."""
CLEAR = 1.0
"""Scatter about the linear model, in variances of the noise, from which a row tells nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Optimum of the robust least squares; k parameters, N ticks.

    Attributes
    ----------
    parameters : tuple of Parameter
        What was estimated.
    x : shape (k,)
        The optimum, in units of `scale`.
    scale : shape (k,)
    cost : float
        Capped sum of squares there.
    residuals : shape (signals, N)
        Weighted, there; 0 where no sample.
    jacobian : shape (k, signals, N)
        Derivative of the residuals by x; 0 in rows left out.
    considered : shape (c, signals, N)
        Change of the residuals by a standard deviation of each considered parameter.
    used : shape (signals, N)
        Rows that took part.
    weighted : shape (signals, N)
        Rows that have a sample.
    evaluations : int
        Runs of the model.
    converged : bool
        Whether the search came to rest.
    anchored : int
        How often the model was re-anchored at the optimum.
    information : shape (k, k), optional
        What was known beforehand: inverse covariance, in units of `scale`.
    """

    parameters: tuple[Parameter, ...]
    x: NDArray[np.float64]
    scale: NDArray[np.float64]
    cost: float
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    considered: NDArray[np.float64]
    used: NDArray[np.bool_]
    weighted: NDArray[np.bool_]
    evaluations: int
    converged: bool
    anchored: int
    information: NDArray[np.float64] | None = None

    @property
    def values(self) -> dict[str, float]:
        """Estimates by name, SI."""
        values = (self.x * self.scale).tolist()
        return {item.name: value for item, value in zip(self.parameters, values, strict=True)}

    @property
    def normal(self) -> NDArray[np.float64]:
        """JᵀJ of the rows that took part, in units of `scale`, shape (k, k)."""
        rows = self.jacobian.reshape(len(self.jacobian), -1)  # 0 where none took part
        return np.asarray(rows @ rows.T)


def refine(
    model: Derivatives,
    start: Mapping[str, float],
    spread: NDArray[np.float64] | float = SPREAD,
    between: Callable[[], None] = nothing,
    pace: Pace = FEW,
) -> Refinement:
    """Sharpen a belief about a start, values by name (0 where not named).

    spread: of the severities about it, shape (c,), or of each of them.
    between, pace: see `sharpen`.
    """
    x = np.array([start.get(item.name, 0.0) for item in model.estimated]) / model.scale
    curved = model.curved
    begin = Belief(
        np.clip(x, model.lower, model.upper),
        np.diag(np.broadcast_to(spread, curved.shape) / model.scale[curved]),
    )
    found = sharpen(model, begin, begin, np.zeros((len(x), len(x))), crossed, pace, between)
    return by_lines(model, found.belief.x, found.linear, settled=found.settled)


def by_lines(
    model: Derivatives, x: NDArray[np.float64], linear: Linearised, *, settled: bool
) -> Refinement:
    """Put together what is known at an optimum beside the middle of the last round.

    Its residuals are the middle's, moved by the lines where these hold: no run of the model.
    """
    jacobian = np.where(linear.scatter < CLEAR, linear.jacobian, 0.0)
    residuals = linear.middle + np.tensordot(x - linear.at, jacobian, 1)
    # The last round counts how often it was re-anchored, and knows what is considered.
    considered = np.zeros((0, *residuals.shape))
    return _put_together(model, x, linear, residuals, considered, anchored=0, settled=settled)


def described(
    model: Derivatives,
    x: NDArray[np.float64],
    linear: Linearised,
    *,
    settled: bool,
    information: NDArray[np.float64] | None = None,
) -> Refinement:
    """Put together what is known at an optimum.

    linear: the model about it, over the width of what is known.
    """
    residuals, considered, anchored, _ = model.at(x)
    found = _put_together(
        model, x, linear, residuals, considered, anchored=anchored, settled=settled
    )
    return replace(found, information=information)


def _put_together(
    model: Derivatives,
    x: NDArray[np.float64],
    linear: Linearised,
    residuals: NDArray[np.float64],
    considered: NDArray[np.float64],
    *,
    anchored: int,
    settled: bool,
) -> Refinement:
    """What residuals at an optimum and the lines about it make known."""
    weighted = model.model.batch.weight > 0.0
    used = (linear.scatter < CLEAR) & (residuals**2 < CAP) & weighted
    return Refinement(
        parameters=model.estimated,
        x=x,
        scale=model.scale,
        cost=capped(residuals),
        residuals=residuals,
        jacobian=np.where(used, linear.jacobian, 0.0),
        considered=considered,
        used=used,
        weighted=weighted,
        evaluations=model.evaluations,
        converged=settled,
        anchored=anchored,
    )


def median_offsets(model: ResidualModel, residuals: NDArray[np.float64]) -> dict[str, float]:
    """Median residual of each signal as the constant error of its sensor, SI by name.

    For a model that runs free: re-anchoring would take most of an offset away. A signal that is
    left out has none.
    """
    out = {}
    for item in model.unknowns.free:
        if item.adds_to is not None and item.adds_to < len(model.batch.weight):
            weight = model.batch.weight[item.adds_to]
            used = weight > 0.0
            shares = residuals[item.adds_to, used] / weight[used]
            out[item.name] = float(np.median(shares)) if used.any() else 0.0
    return out
