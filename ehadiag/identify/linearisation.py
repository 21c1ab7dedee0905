"""Linear models of residuals: differences at a point, regression over the parameters' spread.

A difference leaves out samples where a break-away makes a jump. A regression over points as far
apart as the parameters are uncertain sees its mean effect (statistical linear regression: Lefebvre,
Bruyninckx, De Schutter, IEEE Trans. Automatic Control 47(8), 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.compile.vector import VECTOR_WIDTH
from ehadiag.core.criteria import ESTIMATION, REFINEMENT
from ehadiag.identify.residual_lines import fill_lines, fill_sums
from ehadiag.model.parameter import Parameter, ParameterKind
from ehadiag.model.registry import ResidualModel
from ehadiag.model.simd_layout import aligned_numbers


class DifferenceRules(NamedTuple):
    """Differences of residuals at a point."""

    step: float = 5e-5
    """Half-width of the differences, in units of the parameters' scales: half the deviation that
    noise leaves of a severity, 1e-4 (docs/explanation/identification-results.md)."""
    wide_step: float = 2e-4
    """Half-width of the differences that check them, in units of the parameters' scales: four times
    as wide, two deviations."""
    max_difference: float = 0.2
    """Largest relative difference of derivatives over the two widths, 1, with the typical
    derivative: it decides which rows a bound counts, and no estimate."""
    max_kink: float = 0.3
    """Largest disagreement of two-sided differences, in deviations; more is a break-away: such a
    disagreement is no noise, since both runs have the same."""
    considered_step: float = 0.125
    """Change of a considered parameter for its effect, in its deviations: half a deviation of oil
    at -20 °C changes the pressure by less than its noise, as a break-away does not."""


DIFFERENCES = DifferenceRules()


class ConsideredParameter(msgspec.Struct, frozen=True):
    """A parameter with a narrow density about 0.

    That of a day moves in the last round alone; that of an instant is held, and its uncertainty
    counts (Schmidt's consider filter).
    """

    parameter: Parameter
    std: float
    """Standard deviation of what is not known of it, in its unit."""
    rows: tuple[int, ...] | None = None
    """Signals on which an instant counts; all unless given."""
    by_rate: bool = False
    """Whether it is an instant of sampling (s before the end of a tick), too short for the signals
    to bend: what it does is worked out from how fast they change, without a run of the model."""


class ResidualSlope(msgspec.Struct, frozen=True, eq=False):
    """Residuals at a point and how they change about it."""

    x: Array
    """The point, in units of the scales; shape (k,)."""
    residuals: Array
    """Weighted, there; shape (signals, N)."""
    cost: float
    """Their capped sum of squares."""
    jacobian: Array
    """Derivatives of the residuals; shape (k, signals, N)."""
    smooth: NDArray[np.bool_]
    """Rows whose derivatives hold; shape (signals, N)."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Rows that a step goes by, shape (signals, N)."""
        return self.smooth & (self.residuals**2 < ESTIMATION.residual_cap)


class Derivatives:
    """A model in scaled coordinates, with differences.

    model: its unknowns are those that are estimated, then those considered. noise: of the signals,
    the scale of their sensors' constant errors. considered: the last unknowns of the model.
    """

    def __init__(
        self,
        model: ResidualModel,
        noise: tuple[float, ...],
        considered: Sequence[ConsideredParameter] = (),
    ) -> None:
        self.model = model
        free = model.unknowns.free
        self.considered = tuple(considered)
        self.daily = np.array([not item.by_rate for item in considered], dtype=np.bool_)
        """Which of the considered parameters the last round moves: oil and supply of the day."""
        self.estimated: tuple[Parameter, ...] = free[: len(free) - len(considered)]
        """Parameters in the order of a point's coordinates."""
        self.scale = np.array([search_scale(item, noise) for item in self.estimated])
        self.lower = np.array([item.lower for item in self.estimated]) / self.scale
        self.upper = np.array([item.upper for item in self.estimated]) / self.scale
        self.curved: NDArray[np.int64] = np.array(
            [k for k, item in enumerate(self.estimated) if item.adds_to is None], dtype=np.int64
        )
        """Coordinates that act through the model."""
        self.faults = np.array([item.kind is ParameterKind.FAULT for item in self.estimated])
        """Which coordinates are severities, shape (k,)."""

    @property
    def evaluations(self) -> int:
        """Runs of the model so far."""
        return self.model.evaluations

    def many(self, points: Array) -> Array:
        """Weighted residuals of points, shape (n, signals, N) for points of shape (n, k)."""
        return self.model.residuals(self.values(points))[0]

    def at(self, x: Array, *others: Array, days: slice = slice(None)) -> tuple[Array, Array, int]:
        """Residuals at points; effect of oil and supply of the day and re-anchorings at the first.

        Shapes (1 + n, signals, N), (d, signals, N) by a standard deviation of each, and scalar; all
        run in the same blocks. days: which of `daily` are run, the effect of the others is 0.
        """
        daily = np.flatnonzero(self.daily)
        by_runs = daily[days].tolist()
        count = 1 + len(others)
        points = self.values(np.vstack([x, *others, *[x] * len(by_runs)]))
        for row, j in enumerate(by_runs, count):
            points[row, len(x) + j] = DIFFERENCES.considered_step * self.considered[j].std
        runs, anchored = self.model.residuals(points)
        effects = np.zeros((len(daily), *runs.shape[1:]))
        effects[days] = runs[count:] - runs[0]
        return runs[:count], _without_kinks(effects), int(anchored[0])

    def held_effects(self, residuals: Array) -> Array:
        """Effect of the considered parameters that are held, where the residuals are these.

        By a standard deviation of each, shape (h, signals, N): without a run of the model.
        """
        held = [item for item in self.considered if item.by_rate]
        effects = np.zeros((len(held), *residuals.shape))
        for change, item in zip(effects, held, strict=True):
            for row in range(len(change)) if item.rows is None else item.rows:
                rates = self._rates(row, residuals[row])
                change[row] = DIFFERENCES.considered_step * item.std * rates
        return _without_kinks(effects)

    def _rates(self, row: int, residuals: Array) -> Array:
        """How fast a modelled signal changes, weighted, from its residuals; 1/s, shape (N,).

        row: of the signal. By the neighbours of each sample; 0 where one of them is missing.
        """
        batch, out = self.model.batch, np.zeros(residuals.shape)
        measured, weight = (batch.spool, batch.pressure, batch.position)[row], batch.weight[row]
        share = np.divide(
            residuals, weight, out=np.full(residuals.shape, np.nan), where=weight > 0.0
        )
        modelled = measured - share
        for a, b, tick in zip(batch.start[:-1], batch.start[1:], batch.tick, strict=True):
            out[a:b] = np.gradient(modelled[a:b], tick) * weight[a:b]
        return np.nan_to_num(out, copy=False)

    def slopes(self, centres: Sequence[Array]) -> list[ResidualSlope]:
        """Residuals and derivatives at several points, all runs of the model together."""
        sides = [self._sides(x, DIFFERENCES.step) for x in centres]
        points = [np.vstack([x[None, :], at]) for x, at in zip(centres, sides, strict=True)]
        runs = np.split(self.many(np.vstack(points)), len(centres))
        out = []
        for x, at, run in zip(centres, sides, runs, strict=True):
            jacobian, smooth = self._differences(x, run[0], at, run[1:])
            out.append(ResidualSlope(x, run[0], capped_cost(run[0]), jacobian, smooth))
        return out

    def trusted_slope(self, x: Array) -> ResidualSlope:
        """Residuals and derivatives at a point, rows left out as by `trusted`; in one block."""
        at = self._sides(x, DIFFERENCES.step)
        runs = self.many(np.vstack([x[None, :], at, self.wide_sides(x)]))
        jacobian, smooth = self._differences(x, runs[0], at, runs[1 : 1 + len(at)])
        slope = ResidualSlope(x, runs[0], capped_cost(runs[0]), jacobian, smooth)
        return self.trusted(slope, runs[1 + len(at) :])

    def trusted(self, slope: ResidualSlope, runs: Array | None = None) -> ResidualSlope:
        """Leave rows out where derivatives over a wider difference disagree.

        `runs`: residuals at `wide_sides` of the slope's point, if they are known.
        """
        sides = self.wide_sides(slope.x)
        if runs is None:
            runs = self.many(sides)
        wide, wide_smooth = self._differences(slope.x, slope.residuals, sides, runs)
        typical = np.sqrt(np.mean(wide**2, axis=(1, 2), keepdims=True))
        allowed = (
            DIFFERENCES.max_difference * np.maximum(np.abs(slope.jacobian), np.abs(wide)) + typical
        )
        agree = np.all(np.abs(slope.jacobian - wide) <= allowed, axis=0)
        return replace(slope, smooth=slope.smooth & wide_smooth & agree)

    def wide_sides(self, x: Array) -> Array:
        """Points about x for derivatives over a wider difference, see `_sides`."""
        return self._sides(x, DIFFERENCES.wide_step)

    def values(self, points: Array) -> Array:
        """Values of all unknowns of the model, the considered ones at 0."""
        out = np.zeros((len(points), len(self.estimated) + len(self.considered)))
        out[:, : len(self.estimated)] = points * self.scale
        return out

    def named(self, x: Array) -> dict[str, float]:
        """Values of the estimated parameters at a point, SI by name."""
        values = (x * self.scale).tolist()
        return {item.name: value for item, value in zip(self.estimated, values, strict=True)}

    def _sides(self, x: Array, width: float) -> Array:
        """Points above and below x in each curved coordinate, within its bounds."""
        out = np.repeat(x[None, :], 2 * len(self.curved), axis=0)
        for row, j in enumerate(self.curved):
            above, below = x[j] + width, x[j] - width
            out[2 * row, j] = above if above <= self.upper[j] else x[j] - 2.0 * width
            out[2 * row + 1, j] = below if below >= self.lower[j] else x[j] + 2.0 * width
        return out

    def _differences(
        self, x: Array, residuals: Array, sides: Array, runs: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Derivatives from runs on both sides, and the rows where these agree with the middle."""
        out = self.additive_slopes()
        smooth = np.ones(residuals.shape, dtype=np.bool_)
        for row, j in enumerate(self.curved):
            above, below = sides[2 * row, j], sides[2 * row + 1, j]
            high, low = runs[2 * row], runs[2 * row + 1]
            out[j] = (high - low) / (above - below)
            straight = low + out[j] * (x[j] - below)
            smooth &= np.abs(residuals - straight) < DIFFERENCES.max_kink
        return out, smooth

    def additive_slopes(self) -> Array:
        """Derivatives by what is simply added to a signal, shape (k, signals, N); the rows of the
        `curved` coordinates are left to be filled."""
        weight = self.model.batch.weight
        out = np.empty((len(self.estimated), *weight.shape))
        for j, item in enumerate(self.estimated):
            if item.adds_to is not None:
                out[j] = 0.0
                if item.adds_to < len(weight):
                    out[j, item.adds_to] = -weight[item.adds_to] * self.scale[j]
        return out


def _without_kinks(effects: Array) -> Array:
    """Effects of considered parameters by a deviation each, 0 where a break-away makes a kink.

    effects: by a step of each, overwritten; shape (c, signals, N).
    """
    effects[np.abs(effects) >= DIFFERENCES.max_kink] = 0.0
    effects /= DIFFERENCES.considered_step
    return effects


def search_scale(item: Parameter, noise: Sequence[float]) -> float:
    """Unit of a parameter in a search: its scale, or the noise of the signal it adds to."""
    return item.scale if item.adds_to is None else noise[item.adds_to]


def capped_cost(residuals: Array) -> float:
    """Sum of squares of weighted residuals, each at most `ESTIMATION.residual_cap`."""
    return float(np.minimum(residuals**2, ESTIMATION.residual_cap).sum())


RUN_BLOCK_SIZE = 16
"""Candidates that a kernel runs side by side, 1 (ADR 22): runs come in blocks of that size."""
MIN_SINGULAR_RATIO = 1e-6
"""Singular value, over the largest, below which a direction is not seen, 1: its square is a
thousand times the rounding of a double."""


class ParameterDensity(msgspec.Struct, frozen=True, eq=False):
    """A normal density of the parameters."""

    x: Array
    """Mean, in units of the model's scales; shape (k,)."""
    root: Array
    """Root of the covariance of the coordinates that act through the model: root rootᵀ; shape (c,
    c)."""


NO_ROWS = np.zeros(0)


class WeighedSums(NamedTuple):
    """Sums of a linear model's samples."""

    normal: Array
    """Shape (k, k)."""
    gradient: Array
    """Shape (k,)."""
    excess: float
    """Squares of the residuals over those of noise and scatter alone."""


class LinearModel(msgspec.Struct, frozen=True, eq=False):
    """Residuals as a linear function about a point."""

    x: Array
    """Mean of the points that were run; shape (k,)."""
    residuals: Array
    """Their mean; shape (signals, N)."""
    jacobian: Array
    """Shape (k, signals, N)."""
    scatter: Array
    """Variance about the linear function; shape (signals, N)."""
    at: Array
    """Mean of the density itself; shape (k,)."""
    middle: Array
    """Residuals there; shape (signals, N)."""

    def sums(self, more: Array = NO_ROWS, step: Array | None = None) -> WeighedSums:
        """Sum all samples, each with less weight where it scatters and where it is large.

        more: further rows of the jacobian; step: shape (k,), from `x` to where it counts whether a
        residual is large.
        """
        count = len(self.x) + len(more)
        out = np.empty(count * count + count + 2)
        fill_sums(
            self.jacobian.ravel(), more.ravel(), self.residuals.ravel(), self.scatter.ravel(),
            np.zeros(count) if step is None else step, ESTIMATION.cauchy_scale**2,
            aligned_numbers((count + 2) * VECTOR_WIDTH), aligned_numbers(len(out) * VECTOR_WIDTH),
            out,
        )  # fmt: skip
        normal, gradient = out[: count * count].reshape(count, count), out[count * count : -2]
        return WeighedSums(normal, gradient, float(out[-2] / out[-1]))


def linearised_by_regression(
    model: Derivatives, density: ParameterDensity, rng: np.random.Generator
) -> LinearModel:
    """Regress the residuals on points drawn about a density.

    The points are the mean and as many as nearly fill whole blocks of runs, in pairs that mirror
    each other, along random orthogonal directions: their mean and covariance are nearly the
    density's own.
    """
    curved, count = model.curved, len(model.curved)
    pairs = RUN_BLOCK_SIZE // 2 * -(-(count + 1) // (RUN_BLOCK_SIZE // 2)) - 1
    shares = _directions(rng, count, pairs)
    points = np.repeat(density.x[None, :], 1 + 2 * pairs, axis=0)
    points[1:, curved] += np.vstack([shares, -shares]) @ density.root.T
    points[:, curved] = _mirrored(points[:, curved], model.lower[curved], model.upper[curved])
    x = points.mean(axis=0)
    runs = model.many(points)
    shape, flat = runs.shape[1:], runs.reshape(len(runs), -1)
    # Offsets in units of the spread, so that the regression is well conditioned.
    inverse = np.linalg.inv(density.root)
    offsets = (points - x)[:, curved] @ inverse.T
    basis, triangle = np.linalg.qr(np.column_stack([np.ones(len(points)), offsets]))
    along = basis.T @ flat
    left = np.einsum("ij,ij->j", flat, flat) - np.einsum("ij,ij->j", along, along)
    scatter = np.maximum(left, 0.0) / max(len(points) - 1 - count, 1)
    slopes = inverse.T @ pseudo_inverse(triangle[1:, 1:])
    jacobian = model.additive_slopes()
    jacobian[curved] = (slopes @ along[1:]).reshape(count, *shape)
    mean = (along[0] * basis[0, 0]).reshape(shape)
    return LinearModel(x, mean, jacobian, scatter.reshape(shape), points[0], runs[0])


def pseudo_inverse(square: Array) -> Array:
    """Pseudo-inverse of a square matrix.

    Random rotations give many equal singular values, with which the library's decomposition (divide
    and conquer) does not converge once in some thousand searches; that of the normal equations
    does.
    """
    try:
        return np.asarray(np.linalg.pinv(square, rcond=MIN_SINGULAR_RATIO))
    except np.linalg.LinAlgError:
        normal = square.T @ square
        return np.asarray(np.linalg.pinv(normal, MIN_SINGULAR_RATIO**2, hermitian=True) @ square.T)


def linearised_on_cross(model: Derivatives, density: ParameterDensity) -> LinearModel:
    """Fit a line to the residuals along each coordinate through the mean of a density.

    For few unknowns: a middle and two points on each coordinate. A coordinate without effect gets
    exactly no slope, which a regression on all points at once does not give. At a bound both points
    are on the same side.
    """
    cross = CoordinateCross.about(model, density)
    return cross.lines(model, model.many(cross.points))


class CoordinateCross(msgspec.Struct, frozen=True, eq=False):
    """Points of `linearised_on_cross`: the mean of a density, and two on each coordinate."""

    points: Array
    """Shape (1 + 2 c, k)."""
    offsets: Array
    """Where on its coordinate the mean and its two points stand, from their mean; shape (c, 3)."""

    @classmethod
    def about(cls, model: Derivatives, density: ParameterDensity) -> CoordinateCross:
        """Lay the points, within the bounds of the model."""
        curved, count = model.curved, len(model.curved)
        reach = np.sqrt(REFINEMENT.cross_variances) * np.sqrt((density.root**2).sum(axis=1))
        points = np.repeat(density.x[None, :], 1 + 2 * count, axis=0)
        offsets = np.zeros((count, 3))
        for k, j in enumerate(curved):
            there, width = density.x[j], reach[k]
            above, below = min(width, model.upper[j] - there), min(width, there - model.lower[j])
            if below < REFINEMENT.min_bound_distance * width:
                below = -0.5 * above
            elif above < REFINEMENT.min_bound_distance * width:
                above = -0.5 * below
            points[1 + 2 * k, j], points[2 + 2 * k, j] = there + above, there - below
            offsets[k, 1:] = above, -below
        return cls(points, offsets - offsets.mean(axis=1, keepdims=True))

    def lines(self, model: Derivatives, runs: Array) -> LinearModel:
        """Fit a line along each coordinate to residuals at the points."""
        jacobian = model.additive_slopes()
        mean, scatter = np.empty((2, *runs.shape[1:]))
        fill_lines(
            runs.ravel(), self.offsets.ravel(), model.curved,
            jacobian.ravel(), scatter.ravel(), mean.ravel(),
            aligned_numbers(len(runs) * VECTOR_WIDTH),
        )  # fmt: skip
        middle = self.points.mean(axis=0)
        return LinearModel(middle, mean, jacobian, scatter, self.points[0], runs[0])


def _directions(rng: np.random.Generator, count: int, pairs: int) -> Array:
    """Rows of random rotations, each as long as a standard normal vector, shape (pairs, count)."""
    turns = [
        np.linalg.qr(rng.standard_normal((count, count)))[0] for _ in range(-(-pairs // count))
    ]
    return np.asarray(np.vstack(turns)[:pairs] * np.sqrt(count))


def _mirrored(points: Array, lower: Array, upper: Array) -> Array:
    """Points beyond a bound as far inside of it."""
    points = np.where(points < lower, 2.0 * lower - points, points)
    points = np.where(points > upper, 2.0 * upper - points, points)
    return np.clip(points, lower, upper)
