"""A step of least squares that keeps the fault constants within 0 … 1."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.residual_model import FAULT_COUNT

__all__ = ["bounded_step"]

HELD = sorted(
    itertools.product((None, 0.0, 1.0), repeat=FAULT_COUNT),
    key=lambda bounds: FAULT_COUNT - bounds.count(None),
)
"""Bounds that fault constants may be held at, fewest first."""
TINY = 1e-9
"""Share of the largest gradient that counts as none."""


def bounded_step(
    x: NDArray[np.float64], normal: NDArray[np.float64], gradient: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Point at which a parabola about x is lowest within the bounds, shape (n,).

    It is where each constant held at a bound is pushed out of it and all others are free: the
    parabola being convex there is one such point (Karush, Kuhn, Tucker).

    Parameters
    ----------
    x: fault constants within 0 … 1, then others without bounds, shape (n,).
    normal, gradient: of the parabola, positive definite, shapes (n, n) and (n,).
    """
    allowed = TINY * float(np.abs(gradient).max(initial=0.0))
    out = x
    for bounds in HELD:
        held = np.zeros(len(x), dtype=np.bool_)
        held[:FAULT_COUNT] = [bound is not None for bound in bounds]
        ends = np.array([bound for bound in bounds if bound is not None])
        step = np.zeros(len(x))
        step[held] = ends - x[held]
        pull = gradient[~held] + normal[np.ix_(~held, held)] @ step[held]
        step[~held] = -np.linalg.solve(normal[np.ix_(~held, ~held)], pull)
        out = x + step
        out[held] = ends
        faults = out[:FAULT_COUNT]
        slope = (gradient + normal @ step)[held]
        outward = np.where(ends == 0.0, slope, -slope)
        if np.all((faults >= 0.0) & (faults <= 1.0)) and np.all(outward >= -allowed):
            break
    return np.concatenate([np.clip(out[:FAULT_COUNT], 0.0, 1.0), out[FAULT_COUNT:]])
