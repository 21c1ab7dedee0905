"""Lines through residuals, and their weighted sums: one pass over the samples, side by side.

A vector holds as many samples here. On board, where kernels have one lane, the sums of a tick are
those of the same function.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, kernel
from ehadiag.compile.vector import VECTOR_WIDTH, load, packed, store


@packed
def add_weighed(
    slopes: Array, count: int, residual: Any, at: Any, scatter: Any, large: float, sums: Array
) -> None:
    """Add samples to the sums of their lines, each weighted.

    A sample has less weight where it scatters about its line, and where its residual is large at
    the point that weights are of. slopes: `count` of each sample; residual: where the lines are of;
    at: at that point; large: square of a residual from which Cauchy's cost counts it little. Sums:
    normal matrix, of which the lower triangle is filled; gradient; squares, and those of noise and
    scatter alone.
    """
    weight = 1.0 / (1.0 + scatter + at * at / large)
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
    store(sums, place + VECTOR_WIDTH, load(sums, place + VECTOR_WIDTH) + (1.0 + scatter) * weight)


@packed
def mirror(normal: Array, count: int) -> None:
    """Fill the upper triangle of a normal matrix from the lower one."""
    for i in range(count):
        for j in range(i):
            normal[j * count + i] = normal[i * count + j]


@packed
def line_along(here: float, up: float, down: float, above: Any, below: Any) -> tuple[Any, Any]:
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
    """Write slopes, scatter and means of residuals on a cross, all flat.

    runs: of the middle, then above and below on each coordinate; offsets: of `line_along` on each;
    curved: rows of the jacobian that are of the coordinates; work: scratch.
    """
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
    jacobian: Array, more: Array, residuals: Array, scatter: Array, step: Array, large: float,
    work: Array, sums: Array, out: Array,
) -> None:  # fmt: skip
    """Write the weighted sums of lines, all flat, see `add_weighed`.

    jacobian, more: slopes; step: by which the lines move the residuals for the weights; work, sums:
    scratch.
    """
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
        add_weighed(work, count, residual, at, load(work, (count + 1) * VECTOR_WIDTH), large, sums)
    for i in range(total):
        out[i] = 0.0
        for lane in range(VECTOR_WIDTH):
            out[i] += sums[i * VECTOR_WIDTH + lane]
    mirror(out, count)
    out[total - 1] -= float(-samples % VECTOR_WIDTH)  # what is beyond the samples has no scatter
