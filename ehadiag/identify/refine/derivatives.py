"""Residuals and their derivatives, without samples where a jump spoils the derivative.

A break-away that comes a tick earlier on one side of a difference than on the other makes a jump
that looks like information but is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.interface import ResidualModel
from ehadiag.model.parameters import Kind, Parameter

__all__ = ["CAP", "STEP", "Considered", "Derivatives", "Slope", "capped", "scale_of"]

CAP = 9.0
"""Largest square of one weighted residual that counts."""
STEP = 5e-5
"""Half-width of the differences, in units of the parameters' scales."""
WIDE_STEP = 2e-4
AGREEMENT = 0.2
"""Share by which derivatives over two widths may differ (beside the typical derivative)."""
KINK = 0.3
"""Two-sided differences that disagree by more (in units of noise) mark a break-away."""


JUMP = 1.0
"""Change by a considered parameter (in units of noise) that only another break-away makes."""


@dataclass(frozen=True, slots=True)
class Considered:
    """A parameter that is not estimated but whose uncertainty counts (Schmidt's consider filter).

    Attributes
    ----------
    parameter : Parameter
    std : float
        Standard deviation of what is not known of it, in its unit.
    rows : tuple of int, optional
        Signals on which it counts; all unless given.
    by_rate : bool
        Whether it is an instant of sampling (s before the end of a tick), too short for the signals
        to bend: what it does is worked out from how fast they change, without a run of the model.
    """

    parameter: Parameter
    std: float
    rows: tuple[int, ...] | None = None
    by_rate: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Slope:
    """Residuals at a point and how they change about it.

    Attributes
    ----------
    x : shape (k,)
        The point, in units of the scales.
    residuals : shape (signals, N)
        Weighted, there.
    cost : float
        Their capped sum of squares.
    jacobian : shape (k, signals, N)
        Derivatives of the residuals.
    smooth : shape (signals, N)
        Rows whose derivatives hold.
    """

    x: NDArray[np.float64]
    residuals: NDArray[np.float64]
    cost: float
    jacobian: NDArray[np.float64]
    smooth: NDArray[np.bool_]

    @property
    def used(self) -> NDArray[np.bool_]:
        """Rows that a step goes by, shape (signals, N)."""
        return self.smooth & (self.residuals**2 < CAP)


class Derivatives:
    """A model seen in scaled coordinates, with differences.

    Parameters
    ----------
    model : ResidualModel
        Its unknowns are those that are estimated, then those considered.
    noise : tuple of float
        Of the signals: the scale in which their sensors' constant errors are sought.
    considered : sequence of Considered
        The last unknowns of the model.
    """

    def __init__(
        self, model: ResidualModel, noise: tuple[float, ...], considered: Sequence[Considered] = ()
    ) -> None:
        self.model = model
        free = model.unknowns.free
        self.considered = tuple(considered)
        self.estimated: tuple[Parameter, ...] = free[: len(free) - len(considered)]
        """Parameters in the order of a point's coordinates."""
        self.scale = np.array([scale_of(item, noise) for item in self.estimated])
        self.lower = np.array([item.lower for item in self.estimated]) / self.scale
        self.upper = np.array([item.upper for item in self.estimated]) / self.scale
        self.curved: NDArray[np.int64] = np.array(
            [k for k, item in enumerate(self.estimated) if item.adds_to is None], dtype=np.int64
        )
        """Coordinates that act through the model."""
        self.faults = np.array([item.kind is Kind.FAULT for item in self.estimated])
        """Which coordinates are severities, shape (k,)."""

    @property
    def evaluations(self) -> int:
        """Runs of the model so far."""
        return self.model.evaluations

    def many(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted residuals of points, shape (n, signals, N) for points of shape (n, k)."""
        return self.model.residuals(self.values(points))[0]

    def at(
        self, x: NDArray[np.float64], *others: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], int, NDArray[np.float64]]:
        """Residuals at a point, what the considered parameters do there, how often anchored.

        Returns
        -------
        residuals : shape (signals, N)
        considered : shape (c, signals, N)
            Change of the residuals by a standard deviation of each considered parameter.
        anchored : int
        runs : shape (n, signals, N)
            Residuals at other points, run in the same blocks.
        """
        by_runs = [j for j, item in enumerate(self.considered) if not item.by_rate]
        points = self.values(np.vstack([x, *[x] * len(by_runs), *others]))
        for row, j in enumerate(by_runs):
            points[1 + row, len(x) + j] = self.considered[j].std
        runs, anchored = self.model.residuals(points)
        changes = np.empty((len(self.considered), *runs.shape[1:]))
        changes[by_runs] = runs[1 : 1 + len(by_runs)] - runs[0]
        for change, item in zip(changes, self.considered, strict=True):
            if item.by_rate:
                change[:] = item.std * self._rates(runs[0])
        considered = np.where(np.abs(changes) < JUMP, changes, 0.0)
        for change, item in zip(considered, self.considered, strict=True):
            if item.rows is not None:
                change[np.isin(np.arange(len(change)), item.rows, invert=True)] = 0.0
        return runs[0], considered, int(anchored[0]), runs[1 + len(by_runs) :]

    def _rates(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """How fast the modelled signals change, weighted, from their residuals; 1/s.

        By the samples beside each one; 0 where one of them is missing.
        """
        batch, out = self.model.batch, np.zeros(residuals.shape)
        measured = batch.spool, batch.pressure, batch.position
        for rate, values, row, weight in zip(out, measured, residuals, batch.weight, strict=False):
            counts = weight > 0.0
            share = np.divide(row, weight, out=np.full(row.shape, np.nan), where=counts)
            modelled = values - share
            for a, b, tick in zip(batch.start[:-1], batch.start[1:], batch.tick, strict=True):
                rate[a:b] = np.gradient(modelled[a:b], tick) * weight[a:b]
        return np.nan_to_num(out, copy=False)

    def slopes(self, centres: Sequence[NDArray[np.float64]]) -> list[Slope]:
        """Residuals and derivatives at several points, all runs of the model together."""
        sides = [self._sides(x, STEP) for x in centres]
        points = [np.vstack([x[None, :], at]) for x, at in zip(centres, sides, strict=True)]
        runs = np.split(self.many(np.vstack(points)), len(centres))
        out = []
        for x, at, run in zip(centres, sides, runs, strict=True):
            jacobian, smooth = self._differences(x, run[0], at, run[1:])
            out.append(Slope(x, run[0], capped(run[0]), jacobian, smooth))
        return out

    def trusted_slope(self, x: NDArray[np.float64]) -> Slope:
        """Residuals and derivatives at a point, rows left out as by `trusted`; in one block."""
        at = self._sides(x, STEP)
        runs = self.many(np.vstack([x[None, :], at, self.wide_sides(x)]))
        jacobian, smooth = self._differences(x, runs[0], at, runs[1 : 1 + len(at)])
        slope = Slope(x, runs[0], capped(runs[0]), jacobian, smooth)
        return self.trusted(slope, runs[1 + len(at) :])

    def trusted(self, slope: Slope, runs: NDArray[np.float64] | None = None) -> Slope:
        """Leave rows out where derivatives over a wider difference disagree.

        `runs`: residuals at `wide_sides` of the slope's point, if they are known.
        """
        sides = self.wide_sides(slope.x)
        if runs is None:
            runs = self.many(sides)
        wide, wide_smooth = self._differences(slope.x, slope.residuals, sides, runs)
        typical = np.sqrt(np.mean(wide**2, axis=(1, 2), keepdims=True))
        allowed = AGREEMENT * np.maximum(np.abs(slope.jacobian), np.abs(wide)) + typical
        agree = np.all(np.abs(slope.jacobian - wide) <= allowed, axis=0)
        return replace(slope, smooth=slope.smooth & wide_smooth & agree)

    def wide_sides(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points about x for derivatives over a wider difference, see `_sides`."""
        return self._sides(x, WIDE_STEP)

    def values(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values of all unknowns of the model, the considered ones at 0."""
        out = np.zeros((len(points), len(self.estimated) + len(self.considered)))
        out[:, : len(self.estimated)] = points * self.scale
        return out

    def _sides(self, x: NDArray[np.float64], width: float) -> NDArray[np.float64]:
        """Points above and below x in each curved coordinate, within its bounds."""
        out = np.repeat(x[None, :], 2 * len(self.curved), axis=0)
        for row, j in enumerate(self.curved):
            above, below = x[j] + width, x[j] - width
            out[2 * row, j] = above if above <= self.upper[j] else x[j] - 2.0 * width
            out[2 * row + 1, j] = below if below >= self.lower[j] else x[j] + 2.0 * width
        return out

    def _differences(
        self,
        x: NDArray[np.float64],
        residuals: NDArray[np.float64],
        sides: NDArray[np.float64],
        runs: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Derivatives from runs on both sides, and the rows where these agree with the middle."""
        out = self.additive_slopes()
        smooth = np.ones(residuals.shape, dtype=np.bool_)
        for row, j in enumerate(self.curved):
            above, below = sides[2 * row, j], sides[2 * row + 1, j]
            high, low = runs[2 * row], runs[2 * row + 1]
            out[j] = (high - low) / (above - below)
            straight = low + out[j] * (x[j] - below)
            smooth &= np.abs(residuals - straight) < KINK
        return out, smooth

    def additive_slopes(self) -> NDArray[np.float64]:
        """Derivatives by what is simply added to a signal, 0 by all else, shape (k, signals, N)."""
        weight = self.model.batch.weight
        out = np.zeros((len(self.estimated), *weight.shape))
        for j, item in enumerate(self.estimated):
            if item.adds_to is not None and item.adds_to < len(weight):
                out[j, item.adds_to] = -weight[item.adds_to] * self.scale[j]
        return out


def scale_of(item: Parameter, noise: Sequence[float]) -> float:
    """Unit in which a parameter is sought: its scale, or the noise of the signal it adds to."""
    return item.scale if item.adds_to is None else noise[item.adds_to]


def capped(residuals: NDArray[np.float64]) -> float:
    """Sum of squares of weighted residuals, each at most `CAP`."""
    return float(np.minimum(residuals**2, CAP).sum())
