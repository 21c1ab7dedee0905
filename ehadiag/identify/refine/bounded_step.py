"""A step of least squares within bounds: the lowest point of a parabola in a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["bounded_step"]

TINY = 1e-9
"""Share of the largest gradient that counts as none."""


def bounded_step(
    x: NDArray[np.float64],
    normal: NDArray[np.float64],
    gradient: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Point at which a parabola about x is lowest within the bounds, shape (k,).

    It is where each coordinate at a bound is pushed out of it and all others are free: the parabola
    being convex there is one such point (Karush, Kuhn, Tucker). It is found by an active set: what
    oversteps its bound most is held there, what is pulled back inside is let go.

    Parameters
    ----------
    x : shape (k,)
        Within the bounds.
    normal, gradient : shapes (k, k) and (k,)
        Of the parabola, positive definite.
    lower, upper : shape (k,)
        Bounds, infinite where there are none.
    """
    allowed = TINY * float(np.abs(gradient).max(initial=0.0))
    held = np.zeros(len(x), dtype=np.bool_)
    ends = x.copy()
    out = x
    for _ in range(4 * len(x) + 4):
        step = np.where(held, ends - x, 0.0)
        pull = gradient[~held] + normal[np.ix_(~held, held)] @ step[held]
        step[~held] = -np.linalg.solve(normal[np.ix_(~held, ~held)], pull)
        out = np.where(held, ends, x + step)
        over = np.where(held, 0.0, np.maximum(out - upper, lower - out))
        worst = int(np.argmax(over))
        if over[worst] > 0.0:
            held[worst] = True
            ends[worst] = upper[worst] if out[worst] > upper[worst] else lower[worst]
            continue
        slope = gradient + normal @ step
        inward = np.where(held, np.where(ends == lower, -slope, slope), -np.inf)
        worst = int(np.argmax(inward))
        if not inward[worst] > allowed:
            break
        held[worst] = False
    return np.clip(out, lower, upper)
