"""Refinement of the on-board identification in fixed memory, with its linear algebra.

What `ehadiag.identify.posterior` does for few unknowns, on seven models side by side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehadiag.compile.elementary import exponential, logarithm
from ehadiag.compile.jit import Array, bare_kernel
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.core.criteria import ESTIMATION, REFINEMENT
from ehadiag.identify.posterior import FEW_UNKNOWNS_SCHEDULE, MANY_UNKNOWNS_SCHEDULE
from ehadiag.identify.residual_lines import add_weighed, mirror
from ehadiag.model.parameter import USUAL
from ehadiag.onboard.onboard_memory import (
    MATRIX_SIZE,
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_PARAMETERS,
    PROGRESS,
    SUMS,
)
from ehadiag.onboard.onboard_search import fitted_lines, parameters_at, start_models, unknowns_at

MIN_PIVOT = 1e-300
"""Least pivot of a matrix with an inverse, 1."""
SMALL_MATRIX_ROWS = 3
"""Rows of the small matrices, 1."""
JACOBI_SWEEPS = 8
"""Sweeps of rotations, 1: five reduce the off-diagonal elements of three rows to rounding."""


@bare_kernel
def solve_symmetric(matrix: Array, right: Array, n: int) -> bool:
    """Solve a symmetric positive system in place; false if it is none."""
    for i in range(n):
        if not matrix[i, i] > MIN_PIVOT:
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
def onboard_bounded_step(
    point: Array, normal: Array, gradient: Array, bounded: int,
    low: float, high: float, matrix: Array, step: Array, out: Array,
) -> bool:  # fmt: skip
    """Write the end of a Gauss-Newton step, its first coordinates within bounds; false if there is
    none.

    A coordinate that would leave its bounds is held there and the others are solved with it.
    matrix, shape (n, n), and step, shape (n,), are overwritten.
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
        if not solve_symmetric(matrix, step, n):
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
def inverse_column(normal: Array, place: int, matrix: Array, column: Array) -> float:
    """Write a column of an inverse and return its element on the diagonal; NaN: there is none."""
    n = normal.shape[0]
    for i in range(n):
        column[i] = 1.0 if i == place else 0.0
        for j in range(n):
            matrix[i, j] = normal[i, j]
    if not solve_symmetric(matrix, column, n):
        return float(np.nan)
    return float(column[place])


@bare_kernel
def inverse_3x3(matrix: Array, out: Array) -> None:
    """Write the inverse of a matrix of three rows, by its cofactors."""
    for i in range(SMALL_MATRIX_ROWS):
        for j in range(SMALL_MATRIX_ROWS):
            a, b, c, d = (
                (i + 1) % SMALL_MATRIX_ROWS,
                (i + 2) % SMALL_MATRIX_ROWS,
                (j + 1) % SMALL_MATRIX_ROWS,
                (j + 2) % SMALL_MATRIX_ROWS,
            )
            out[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    whole = 0.0
    for j in range(SMALL_MATRIX_ROWS):
        whole += matrix[0, j] * out[j, 0]
    for i in range(SMALL_MATRIX_ROWS):
        for j in range(SMALL_MATRIX_ROWS):
            out[i, j] /= whole


@bare_kernel
def transformed_3x3(turn: Array, matrix: Array, room: Array) -> None:
    """Make a matrix of three rows M to T M Tᵀ."""
    for i in range(SMALL_MATRIX_ROWS):
        for j in range(SMALL_MATRIX_ROWS):
            room[i, j] = 0.0
            for k in range(SMALL_MATRIX_ROWS):
                room[i, j] += turn[i, k] * matrix[k, j]
    for i in range(SMALL_MATRIX_ROWS):
        for j in range(SMALL_MATRIX_ROWS):
            matrix[i, j] = 0.0
            for k in range(SMALL_MATRIX_ROWS):
                matrix[i, j] += room[i, k] * turn[j, k]


@bare_kernel
def eigenvectors_3x3(matrix: Array, axes: Array) -> None:
    """Diagonalise a symmetric matrix of three rows by Jacobi's rotations.

    The matrix is overwritten by its eigenvalues on the diagonal, axes by its eigenvectors as
    columns.
    """
    for i in range(SMALL_MATRIX_ROWS):
        for j in range(SMALL_MATRIX_ROWS):
            axes[i, j] = 1.0 if i == j else 0.0
    for turn in range(JACOBI_SWEEPS * SMALL_MATRIX_ROWS):
        i, j = turn % SMALL_MATRIX_ROWS, (turn + 1) % SMALL_MATRIX_ROWS
        if matrix[i, j] == 0.0:
            continue
        tilt = (matrix[j, j] - matrix[i, i]) / (2.0 * matrix[i, j])
        tangent = math.copysign(1.0, tilt) / (abs(tilt) + math.sqrt(1.0 + tilt * tilt))
        cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        for k in range(SMALL_MATRIX_ROWS):
            a, b = matrix[i, k], matrix[j, k]
            matrix[i, k], matrix[j, k] = cosine * a - sine * b, sine * a + cosine * b
        for k in range(SMALL_MATRIX_ROWS):
            a, b = matrix[k, i], matrix[k, j]
            matrix[k, i], matrix[k, j] = cosine * a - sine * b, sine * a + cosine * b
            a, b = axes[k, i], axes[k, j]
            axes[k, i], axes[k, j] = cosine * a - sine * b, sine * a + cosine * b


class RoundRules(NamedTuple):
    """Rounds of the refinement on board; `ehadiag.identify.posterior.SearchSchedule` on the
    host."""

    most: float = 16.0
    """Largest number of rounds, 1."""
    full: float = 8.0
    """Rounds that are taken in full, 1; more of them than on the host, which begins nearer."""
    start_std: float = 0.01
    """Standard deviation of a severity about the first approximation, 1."""
    wide_std: float = USUAL.severity_std
    """The same after an attempt that does not explain the recording: offset and friction of the
    spool begin far off together where it does not rest in its middle."""
    wide_rounds: float = float(MANY_UNKNOWNS_SCHEDULE.most_rounds)
    """Largest number of rounds of such an attempt, 1; all are taken in full."""
    wide_ratio: float = MANY_UNKNOWNS_SCHEDULE.least_ratio
    """Least ratio of widths in a round of it, 1."""
    settled_ratio: float = FEW_UNKNOWNS_SCHEDULE.settled_ratio
    """Least ratio of widths of a round at convergence, 1."""
    settled_step: float = FEW_UNKNOWNS_SCHEDULE.settled_step
    """Largest step of a round at convergence, in widths."""
    width: float = FEW_UNKNOWNS_SCHEDULE.width**2
    """Width of the density, in variances of the linear problem."""
    min_ratio: float = FEW_UNKNOWNS_SCHEDULE.least_ratio
    """Least ratio of widths in a round, 1."""
    max_ratio: float = FEW_UNKNOWNS_SCHEDULE.most_ratio
    """Largest one."""
    min_linear_ratio: float = REFINEMENT.min_linear_ratio
    """Least ratio of widths where the model is linear over the density, 1."""
    cauchy_variances: float = ESTIMATION.cauchy_scale**2
    """Square of the residual from which Cauchy's cost counts it little, in variances."""


ROUNDS = RoundRules()


MOVED_POINT_PLACE = ONBOARD.scratch + 2 * MATRIX_SIZE + ONBOARD_PARAMETERS
SMALL_MATRICES_PLACE = MOVED_POINT_PLACE + ONBOARD_PARAMETERS
"""Places of what a step works on."""
WEIGHED_SUMS = MATRIX_SIZE + ONBOARD_PARAMETERS + 2
"""Numbers of `add_weighed`: normal matrix, gradient, unexplained squares and their expectation."""
LEFT, WEIGHED = ONBOARD.normal + WEIGHED_SUMS - 2, ONBOARD.normal + WEIGHED_SUMS - 1
JUMPED, COUNTED = ONBOARD.sums, ONBOARD.sums + 1
"""Sums of a round: samples where the model jumps, and all."""


@bare_kernel
def start_round(address: int, plan_address: int, plan: Array) -> None:
    """Prepare the models of a round over the density, and clear what it adds up."""
    p = array_at(address, (ONBOARD.end,))
    for i in range(WEIGHED_SUMS):
        p[ONBOARD.normal + i] = 0.0
    for i in range(SUMS):
        p[ONBOARD.sums + i] = 0.0
    start_models(
        address,
        plan_address,
        plan,
        unknowns_at(address, ONBOARD.point),
        unknowns_at(address, ONBOARD.trial),
        array_at(address + BYTES_PER_NUMBER * ONBOARD.along, (ONBOARD_GENES, 3)),
    )


@bare_kernel
def add_lines(address: int, ticks: Array, k: int) -> None:
    """Add a tick, to which the models are advanced, to normal matrix and gradient."""
    p, slope = array_at(address, (ONBOARD.end,)), parameters_at(address, ONBOARD.slope)
    sums = array_at(address + BYTES_PER_NUMBER * ONBOARD.normal, (WEIGHED_SUMS,))
    along = array_at(address + BYTES_PER_NUMBER * ONBOARD.along, (ONBOARD_GENES, 3))
    for channel in range(2):
        if not math.isfinite(ticks[k, 2 + channel]):
            continue
        residual, scatter = fitted_lines(p, channel, along, slope)
        add_weighed(
            slope, ONBOARD_PARAMETERS, residual, residual, scatter, ROUNDS.cauchy_variances, sums
        )
        p[COUNTED] += 1.0
        if scatter > REFINEMENT.max_linear_scatter:
            p[JUMPED] += 1.0


@bare_kernel
def _narrow(address: int, excess: float, least: float, part: float) -> tuple[float, float]:
    """Step and narrow the density: the least ratio of its widths, the step's length.

    The ratio is negative where there is no step. least: ratio that is kept; part: how many times a
    whole round this one is of, 1 or more.
    """
    normal = array_at(
        address + BYTES_PER_NUMBER * ONBOARD.normal, (ONBOARD_PARAMETERS, ONBOARD_PARAMETERS)
    )
    gradient = parameters_at(address, ONBOARD.normal + MATRIX_SIZE)
    point, trial = parameters_at(address, ONBOARD.point), parameters_at(address, ONBOARD.trial)
    held = array_at(
        address + BYTES_PER_NUMBER * ONBOARD.scratch, (ONBOARD_PARAMETERS, ONBOARD_PARAMETERS)
    )
    matrix = array_at(
        address + BYTES_PER_NUMBER * (ONBOARD.scratch + MATRIX_SIZE),
        (ONBOARD_PARAMETERS, ONBOARD_PARAMETERS),
    )
    column, out = (
        parameters_at(address, ONBOARD.scratch + 2 * MATRIX_SIZE),
        parameters_at(address, MOVED_POINT_PLACE),
    )
    root = array_at(address + BYTES_PER_NUMBER * ONBOARD.density, (ONBOARD_GENES, ONBOARD_GENES))
    inverse = array_at(
        address + BYTES_PER_NUMBER * SMALL_MATRICES_PLACE, (ONBOARD_GENES, ONBOARD_GENES)
    )
    spread = array_at(
        address + BYTES_PER_NUMBER * (SMALL_MATRICES_PLACE + ONBOARD_GENES * ONBOARD_GENES),
        (ONBOARD_GENES, ONBOARD_GENES),
    )
    axes = array_at(
        address + BYTES_PER_NUMBER * (SMALL_MATRICES_PLACE + 2 * ONBOARD_GENES * ONBOARD_GENES),
        (ONBOARD_GENES, ONBOARD_GENES),
    )
    believed = array_at(address + BYTES_PER_NUMBER * ONBOARD.believed, (ONBOARD_GENES,))
    inverse_3x3(root, inverse)
    for i in range(ONBOARD_PARAMETERS):
        for j in range(ONBOARD_PARAMETERS):
            held[i, j] = normal[i, j] + (REFINEMENT.min_information if i == j else 0.0)
            for k in range(ONBOARD_GENES if i < ONBOARD_GENES and j < ONBOARD_GENES else 0):
                held[i, j] += REFINEMENT.damping * inverse[k, i] * inverse[k, j]
    if not onboard_bounded_step(
        trial, held, gradient, ONBOARD_GENES, 0.0, 1.0, matrix, column, out
    ):
        return -1.0, 0.0
    step = 0.0
    for i in range(ONBOARD_GENES):
        along = 0.0
        for j in range(ONBOARD_GENES):
            along += inverse[i, j] * (out[j] - point[j])
        step = max(step, abs(along))
    for i in range(ONBOARD_PARAMETERS):
        point[i] = out[i] if part == 1.0 else point[i] + (out[i] - point[i]) / part
    # The covariance that is left, in units of the density's own root.
    for i in range(ONBOARD_PARAMETERS):
        normal[i, i] += REFINEMENT.min_information * held[i, i]
    for j in range(ONBOARD_GENES):
        if not math.isfinite(inverse_column(normal, j, matrix, column)):
            return -1.0, 0.0
        believed[j] = max(excess, 1.0) * column[j]
        for i in range(ONBOARD_GENES):
            spread[i, j] = ROUNDS.width * max(excess, 1.0) * column[i]
    transformed_3x3(inverse, spread, axes)
    eigenvectors_3x3(spread, axes)
    narrowest = 1.0
    for j in range(ONBOARD_GENES):
        ratio = math.sqrt(max(spread[j, j], 0.0))
        narrowest = min(narrowest, ratio)
        kept = min(max(ratio, least), ROUNDS.max_ratio)
        if part > 1.0:
            kept = exponential(logarithm(kept) / part)
        for i in range(ONBOARD_GENES):
            inverse[i, j] = 0.0
            for k in range(ONBOARD_GENES):
                inverse[i, j] += root[i, k] * axes[k, j] * kept
    for i in range(ONBOARD_GENES):
        for j in range(ONBOARD_GENES):
            root[i, j] = inverse[i, j]
    return narrowest, step


@bare_kernel
def end_round(address: int, done: float) -> tuple[bool, bool]:
    """Step and narrow the density, so many rounds done: whether it was the last, and it settled."""
    p = array_at(address, (ONBOARD.end,))
    normal = array_at(address + BYTES_PER_NUMBER * ONBOARD.normal, (MATRIX_SIZE,))
    mirror(normal, ONBOARD_PARAMETERS)
    excess = p[LEFT] / max(p[WEIGHED], 1.0)
    linear = p[JUMPED] < REFINEMENT.max_nonlinear_share * max(p[COUNTED], 1.0)
    most, full, least = ROUNDS.most, ROUNDS.full, ROUNDS.min_ratio
    if p[PROGRESS.attempts] > 1.0:
        most, full, least = ROUNDS.wide_rounds, ROUNDS.wide_rounds, ROUNDS.wide_ratio
    if linear:
        least = ROUNDS.min_linear_ratio
    ratio, step = _narrow(address, excess, least, 1.0 + max(done - full, 0.0))
    settled = ratio > ROUNDS.settled_ratio and step < ROUNDS.settled_step
    if done >= most:
        settled = ratio > ROUNDS.settled_ratio and step < REFINEMENT.max_mean_step * (
            1.0 + most - full
        )
    return settled or ratio < 0.0 or done >= most, settled
