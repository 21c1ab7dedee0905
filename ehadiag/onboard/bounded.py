"""Small linear algebra in given memory: a damped step within bounds, and an inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel

__all__ = ["bounded_step", "invert"]

Array = NDArray[np.float64]
PIVOT = 1e-300


@bare_kernel
def solve(matrix: Array, right: Array, n: int) -> bool:
    """Solve a symmetric positive system in place; false if it is none."""
    for i in range(n):
        if not matrix[i, i] > PIVOT:
            return False
        for j in range(i + 1, n):
            share = matrix[j, i] / matrix[i, i]
            for k in range(i, n):
                matrix[j, k] -= share * matrix[i, k]
            right[j] -= share * right[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    return True


@bare_kernel
def bounded_step(
    point: Array, normal: Array, gradient: Array, damping: float, bounded: int,
    low: float, high: float, matrix: Array, step: Array, out: Array,
) -> bool:  # fmt: skip
    """Write the point that a damped Gauss-Newton step leads to, its first coordinates bounded.

    A coordinate that a step would carry out of its bounds is held there and the rest solved anew.

    Parameters
    ----------
    point : Array
        Shape (n,).
    normal : Array
        Shape (n, n).
    gradient : Array
        Shape (n,).
    damping : float
        Share of the diagonal that is added.
    bounded : int
        How many coordinates have bounds.
    low : float
        Their bound below.
    high : float
        Their bound above.
    matrix : Array
        Shape (n, n), overwritten.
    step : Array
        Shape (n,), overwritten.
    out : Array
        Shape (n,), the point.

    Returns
    -------
    bool
        Whether there is one.
    """
    n = point.shape[0]
    for i in range(n):
        out[i] = np.nan
    for _ in range(bounded + 1):
        for i in range(n):
            held = np.isfinite(out[i])
            step[i] = out[i] - point[i] if held else -gradient[i]
            for j in range(n):
                matrix[i, j] = 0.0 if held else normal[i, j]
            matrix[i, i] = 1.0 if held else normal[i, i] * (1.0 + damping) + 1e-12
        for i in range(n):
            if np.isfinite(out[i]):
                for j in range(n):
                    if j != i:
                        step[j] -= matrix[j, i] * step[i]
                        matrix[j, i] = 0.0
        if not solve(matrix, step, n):
            return False
        worst, over = -1, 0.0
        for i in range(bounded):
            beyond = max(point[i] + step[i] - high, low - point[i] - step[i])
            if not np.isfinite(out[i]) and beyond > over:
                worst, over = i, beyond
        if worst < 0:
            break
        out[worst] = high if point[worst] + step[worst] > high else low
    for i in range(n):
        if not np.isfinite(out[i]):
            out[i] = point[i] + step[i]
    return True


@bare_kernel
def invert(normal: Array, place: int, matrix: Array, column: Array) -> float:
    """Return the diagonal element of an inverse, NaN if there is none; the rest is overwritten."""
    n = normal.shape[0]
    for i in range(n):
        column[i] = 1.0 if i == place else 0.0
        for j in range(n):
            matrix[i, j] = normal[i, j]
    if not solve(matrix, column, n):
        return float(np.nan)
    return float(column[place])
