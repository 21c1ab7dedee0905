"""Lines through residuals, and their weighted sums: one pass over the samples, side by side.

A vector holds as many samples here. On board, where kernels have one lane, the sums of a tick are
those of the same function.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, kernel
from ehadiag.compile.vector import VECTOR_WIDTH, load, packed, store
from ehadiag.core.criteria import ESTIMATION
from ehadiag.model.simd_layout import aligned_numbers

CAUCHY_VARIANCES: Final = ESTIMATION.cauchy_scale**2
"""Square of the residual from which Cauchy's cost counts it little, in variances."""


@packed
def add_weighed(
    slopes: Array, count: int, residual: float, at: float, scatter: float, sums: Array
) -> None:
    """Add samples to the sums of their lines, each weighted.

    It has less weight where it scatters about its line, and where it is large at the point that the
    weights are of. slopes: `count` of them for each sample; residual, at, scatter: of each. Sums:
    lower triangle of the normal matrix, in whole rows, gradient, squares, and what squares would be
    of noise and scatter alone.
    """
    weight = 1.0 / (1.0 + scatter + at * at / CAUCHY_VARIANCES)
    gradient = count * count
    for i in range(count):
        pull = weight * load(slopes, i * VECTOR_WIDTH)
        place = (gradient + i) * VECTOR_WIDTH
        store(sums, place, load(sums, place) + pull * residual)
        for j in range(i + 1):
            place = (i * count + j) * VECTOR_WIDTH
            store(sums, place, load(sums, place) + pull * load(slopes, j * VECTOR_WIDTH))
    place = (gradient + count) * VECTOR_WIDTH
    store(sums, place, load(sums, place) + residual * residual * weight)
    store(
        sums, place + VECTOR_WIDTH, load(sums, place + VECTOR_WIDTH) + (1.0 + scatter) * weight
    )


@packed
def line_along(
    here: float, up: float, down: float, above: float, below: float
) -> tuple[float, float]:
    """Slope of a line through three residuals, and their squares about it.

    here, up, down: where the three are on a coordinate, from the mean of these places; above,
    below: the second and third less the first, so that what has no effect has no slope either.
    """
    unit = 1.0 / (here * here + up * up + down * down)
    across = (down - here) * above + (here - up) * below
    return (up * above + down * below) * unit, across * across * (unit / 3.0)


@packed
def _take(source: Array, place: int, here: int, target: Array, at: int) -> None:
    """Copy the numbers of `here` samples, 0 beyond them."""
    if here == VECTOR_WIDTH:
        store(target, at, load(source, place))
    else:
        for i in range(VECTOR_WIDTH):
            target[at + i] = source[place + i] if i < here else 0.0


@packed
def _put(source: Array, at: int, here: int, target: Array, place: int) -> None:
    """Copy the numbers of `here` samples back."""
    if here == VECTOR_WIDTH:
        store(target, place, load(source, at))
    else:
        for i in range(here):
            target[place + i] = source[at + i]


@kernel
def fill_lines(
    runs: Array, offsets: Array, curved: NDArray[np.int64],
    jacobian: Array, scatter: Array, mean: Array, work: Array,
) -> None:  # fmt: skip
    """Write slopes, scatter and means of residuals on a cross, all flat; see `cross_lines`."""
    samples, count = mean.shape[0], curved.shape[0]
    for k in range(0, samples, VECTOR_WIDTH):
        here = min(VECTOR_WIDTH, samples - k)
        for i in range(1 + 2 * count):
            _take(runs, i * samples + k, here, work, i * VECTOR_WIDTH)
        middle = load(work, 0)
        total = left = middle * 0.0
        for i in range(count):
            above = load(work, (1 + 2 * i) * VECTOR_WIDTH) - middle
            below = load(work, (2 + 2 * i) * VECTOR_WIDTH) - middle
            total = total + (above + below)
            slope, part = line_along(
                offsets[3 * i], offsets[3 * i + 1], offsets[3 * i + 2], above, below
            )
            left = left + part
            store(work, VECTOR_WIDTH, slope)
            _put(work, VECTOR_WIDTH, here, jacobian, curved[i] * samples + k)
        store(work, 0, left / float(count))
        _put(work, 0, here, scatter, k)
        store(work, 0, middle + total / float(1 + 2 * count))
        _put(work, 0, here, mean, k)


@kernel
def fill_sums(
    jacobian: Array, more: Array, residuals: Array, scatter: Array, step: Array,
    work: Array, sums: Array, out: Array,
) -> None:  # fmt: skip
    """Write the weighted sums of lines, all flat; see `weighed_sums`."""
    samples, count, total = residuals.shape[0], step.shape[0], out.shape[0]
    known = jacobian.shape[0] // samples
    sums[:] = 0.0
    for k in range(0, samples, VECTOR_WIDTH):
        here = min(VECTOR_WIDTH, samples - k)
        _take(residuals, k, here, work, count * VECTOR_WIDTH)
        _take(scatter, k, here, work, (count + 1) * VECTOR_WIDTH)
        residual = load(work, count * VECTOR_WIDTH)
        at = residual
        for i in range(count):
            if i < known:
                _take(jacobian, i * samples + k, here, work, i * VECTOR_WIDTH)
            else:
                _take(more, (i - known) * samples + k, here, work, i * VECTOR_WIDTH)
            at = at + step[i] * load(work, i * VECTOR_WIDTH)
        add_weighed(work, count, residual, at, load(work, (count + 1) * VECTOR_WIDTH), sums)
    for i in range(total):
        out[i] = 0.0
        for lane in range(VECTOR_WIDTH):
            out[i] += sums[i * VECTOR_WIDTH + lane]
    out[total - 1] -= float(-samples % VECTOR_WIDTH)  # what is beyond the samples has no scatter


def cross_lines(
    runs: Array, offsets: Array, curved: NDArray[np.int64], jacobian: Array
) -> tuple[Array, Array]:
    """Mean and scatter about their lines of residuals on a cross, shape (1 + 2 c, signals, N).

    offsets: see `line_along`, from the mean of the three, shape (c, 3). The slopes are written to
    the rows `curved` of a jacobian.
    """
    mean, scatter = np.empty((2, *runs.shape[1:]))
    fill_lines(
        runs.ravel(), offsets.ravel(), curved, jacobian.ravel(), scatter.ravel(), mean.ravel(),
        aligned_numbers(len(runs) * VECTOR_WIDTH),
    )  # fmt: skip
    return mean, scatter


class WeighedSums(NamedTuple):
    """Sums over weighted samples."""

    normal: Array
    """Shape (k, k)."""
    gradient: Array
    """Shape (k,)."""
    excess: float
    """Squares of the residuals over those of noise and scatter alone."""


NO_ROWS = np.zeros(0)


def weighed_sums(
    jacobian: Array, residuals: Array, scatter: Array, more: Array = NO_ROWS,
    step: Array | None = None,
) -> WeighedSums:  # fmt: skip
    """Sum lines of weighted residuals, see `add_weighed`.

    jacobian: rows of shape (signals, N); more: further rows; step: shape (k,), by which the lines
    move the residuals for the weights.
    """
    count = len(jacobian) + len(more)
    out = np.empty(count * count + count + 2)
    fill_sums(
        jacobian.ravel(), more.ravel(), residuals.ravel(), scatter.ravel(),
        np.zeros(count) if step is None else step,
        aligned_numbers((count + 2) * VECTOR_WIDTH), aligned_numbers(len(out) * VECTOR_WIDTH), out,
    )  # fmt: skip
    lower = out[: count * count].reshape(count, count)
    normal = np.tril(lower) + np.tril(lower, -1).T
    gradient = out[count * count : -2]
    return WeighedSums(normal, gradient, float(out[-2] / out[-1]))
