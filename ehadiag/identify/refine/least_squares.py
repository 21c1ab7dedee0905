"""Deterministic refinement: robust least squares from the optimum of a search.

Damped Gauss-Newton on the weighted residuals of spool and pressure, the model re-anchored on the
measured spool. Residuals beyond three times the noise are left out of a step (their square is
capped), and so are rows whose two-sided differences disagree: there a break-away goes one way on
one side and the other way on the other. Constant errors of both sensors are estimated beside the
severities; being constant they are told apart from the faults, which act alike in both directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.bounded_step import bounded_step
from ehadiag.identify.refine.derivatives import CAP, Derivatives, Slope, capped
from ehadiag.identify.refine.plateau import centre, vertex
from ehadiag.model.interface import ResidualModel
from ehadiag.model.parameters import Parameter

__all__ = ["Refinement", "describe", "median_offsets", "refine"]

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
        Whether the last step was below 1e-6.
    jagged : bool
        Break-aways make steps in the cost about the optimum: a descent may stop beside it.
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
    jagged: bool
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
        rows = self.jacobian[:, self.used]
        return np.asarray(rows @ rows.T)


def refine(model: Derivatives, start: Mapping[str, float]) -> Refinement:
    """Minimise the capped sum of squares from a start, values by name (0 where not named)."""
    x = np.array([start.get(item.name, 0.0) for item in model.estimated]) / model.scale
    slope = model.slopes([np.clip(x, model.lower, model.upper)])[0]
    damping = LEAST_DAMPING
    converged = False
    for _ in range(ITERATIONS):
        cautious = max(MORE * damping, CAUTIOUS_DAMPING)
        trials = _stepped(model, slope, (damping, cautious))
        size = float(np.abs(trials[0] - slope.x)[model.curved].max())
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
    bowl = vertex(model, slope)
    return _described(model, bowl.x, bowl.slope, converged=converged, jagged=not bowl.smooth)


def _stepped(
    model: Derivatives, slope: Slope, dampings: Sequence[float]
) -> list[NDArray[np.float64]]:
    """Points that damped Gauss-Newton steps lead to, within the bounds."""
    x, used = slope.x, slope.used
    rows = slope.jacobian[:, used]
    normal, gradient = rows @ rows.T, rows @ slope.residuals[used]
    return [
        bounded_step(
            x,
            normal + np.diag(damping * np.diag(normal) + 1e-12),
            gradient,
            model.lower,
            model.upper,
        )
        for damping in dampings
    ]


def describe(model: Derivatives, start: Mapping[str, float], *, converged: bool) -> Refinement:
    """What `refine` returns, for a point beside steps in the cost that something else has found.

    The point is moved to the middle of the plateau that the steps leave.
    """
    x = np.array([start.get(item.name, 0.0) for item in model.estimated]) / model.scale
    slope = model.trusted_slope(x)
    x = centre(model, slope)
    if x is not slope.x:
        slope = model.trusted_slope(x)
    return _described(model, x, slope, converged=converged, jagged=True)


def _described(
    model: Derivatives, x: NDArray[np.float64], slope: Slope, *, converged: bool, jagged: bool
) -> Refinement:
    """Put together what is known at x; `slope` is that of a point so near that it holds there."""
    residuals, considered, anchored, _ = model.at(x)
    weighted = model.model.batch.weight > 0.0
    used = slope.smooth & (residuals**2 < CAP) & weighted
    return Refinement(
        parameters=model.estimated,
        x=x,
        scale=model.scale,
        cost=capped(residuals),
        residuals=residuals,
        jacobian=np.where(used, slope.jacobian, 0.0),
        considered=considered,
        used=used,
        weighted=weighted,
        evaluations=model.evaluations,
        converged=converged,
        jagged=jagged,
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
