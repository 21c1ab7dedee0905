"""Small linear algebra in given memory: a step within bounds, inverses, axes of an ellipsoid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel

__all__ = ["bounded_step", "eigenvectors", "invert", "invert_small", "similar"]

Array = NDArray[np.float64]
PIVOT = 1e-300
SMALL = 3
SWEEPS = 8
"""Of rotations; five bring what is off the diagonal of three rows below the last digit."""


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
    point: Array, normal: Array, gradient: Array, bounded: int,
    low: float, high: float, matrix: Array, step: Array, out: Array,
) -> bool:  # fmt: skip
    """Write the point that a Gauss-Newton step leads to, its first coordinates bounded.

    A coordinate that a step would carry out of its bounds is held there and the rest solved anew.

    Parameters
    ----------
    point : Array
        Shape (n,).
    normal : Array
        Shape (n, n).
    gradient : Array
        Shape (n,).
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
            matrix[i, i] = 1.0 if held else normal[i, i] + 1e-12
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
    """Write a column of an inverse and return its element on the diagonal; NaN: there is none."""
    n = normal.shape[0]
    for i in range(n):
        column[i] = 1.0 if i == place else 0.0
        for j in range(n):
            matrix[i, j] = normal[i, j]
    if not solve(matrix, column, n):
        return float(np.nan)
    return float(column[place])


@bare_kernel
def invert_small(matrix: Array, out: Array) -> None:
    """Write the inverse of a matrix of three rows, by its cofactors."""
    for i in range(SMALL):
        for j in range(SMALL):
            a, b, c, d = (i + 1) % SMALL, (i + 2) % SMALL, (j + 1) % SMALL, (j + 2) % SMALL
            out[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    whole = 0.0
    for j in range(SMALL):
        whole += matrix[0, j] * out[j, 0]
    for i in range(SMALL):
        for j in range(SMALL):
            out[i, j] /= whole


@bare_kernel
def similar(turn: Array, matrix: Array, room: Array) -> None:
    """Make a matrix of three rows M to T M Tᵀ."""
    for i in range(SMALL):
        for j in range(SMALL):
            room[i, j] = 0.0
            for k in range(SMALL):
                room[i, j] += turn[i, k] * matrix[k, j]
    for i in range(SMALL):
        for j in range(SMALL):
            matrix[i, j] = 0.0
            for k in range(SMALL):
                matrix[i, j] += room[i, k] * turn[j, k]


@bare_kernel
def eigenvectors(matrix: Array, axes: Array) -> None:
    """Turn a symmetric matrix of three rows to its axes: Jacobi's rotations.

    Parameters
    ----------
    matrix : Array
        Shape (3, 3), overwritten: its eigenvalues are on its diagonal then.
    axes : Array
        Shape (3, 3), overwritten by its eigenvectors, as columns.
    """
    for i in range(SMALL):
        for j in range(SMALL):
            axes[i, j] = 1.0 if i == j else 0.0
    for turn in range(SWEEPS * SMALL):
        i, j = turn % SMALL, (turn + 1) % SMALL
        if matrix[i, j] == 0.0:
            continue
        tilt = (matrix[j, j] - matrix[i, i]) / (2.0 * matrix[i, j])
        tangent = math.copysign(1.0, tilt) / (abs(tilt) + math.sqrt(1.0 + tilt * tilt))
        cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        for k in range(SMALL):
            a, b = matrix[i, k], matrix[j, k]
            matrix[i, k], matrix[j, k] = cosine * a - sine * b, sine * a + cosine * b
        for k in range(SMALL):
            a, b = matrix[k, i], matrix[k, j]
            matrix[k, i], matrix[k, j] = cosine * a - sine * b, sine * a + cosine * b
            a, b = axes[k, i], axes[k, j]
            axes[k, i], axes[k, j] = cosine * a - sine * b, sine * a + cosine * b
