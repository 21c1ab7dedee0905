"""First approximation: three deterministic one-dimensional searches, FDJ, Kintas, FSS.

Each works on the windows of the test and the signal that its fault shows most:

- FDJ on the differential pressure while the jack creeps. The jack is driven by the *measured*
  spool, so neither of the other faults enters.
- Kintas on the path of the spool while it slews as fast as the first stage can feed it (maximum
  velocity, overshoot).
- FSS on the path of the spool on slow ramps (break-away, hysteresis, limit cycle), the model put
  back on the measured spool where it left it: so each break-away counts once, and one that comes at
  another tick does not spoil the rest of the ramp.

Friction slows the slewing spool a little, so the last two searches are repeated in ever smaller
ranges, each with the other's value.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import ANCHOR_LSB, Experiment, make_batch
from ehadiag.identify.objective import Objective
from ehadiag.identify.scalar import minimise_scalar
from ehadiag.jit import kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.jack import jack_response

__all__ = ["FirstApproximation", "first_approximation"]

GRID = 25
"""Points of the coarse search over 0 … 1."""
RANGES = ((0.2, 0.06), (0.05, 0.02))
"""Half-widths of the repeated searches, Kintas and FSS."""
FINER_GRID = 11
TOLERANCE = 2e-4
LEAD_S = 0.05
CREEP_CAP = 100.0
"""A stick-slip jump at another tick counts no more than ten times the noise."""


@dataclass(frozen=True, slots=True)
class FirstApproximation:
    """Result of the three searches."""

    values: tuple[float, float, float]
    """Kintas, FSS, FDJ."""
    evaluations: int


def first_approximation(experiments: Sequence[Experiment]) -> FirstApproximation:
    """Search FDJ, then Kintas, then FSS; then Kintas and FSS twice more."""
    counter = _Counter()
    jacks = [_JackSearch(experiment) for experiment in experiments]
    fdj = _search(
        counter, lambda grid: np.sum([jack(grid) for jack in jacks], axis=0), 0.0, 1.0, GRID
    )

    slewing = Objective(
        make_batch(
            experiments,
            [experiment.test.windows.Kintas for experiment in experiments],
            lead=LEAD_S,
            channels=(True, False),
        ),
        cap=np.inf,
    )
    creeping = Objective(
        make_batch(
            experiments,
            [experiment.test.windows.FSS for experiment in experiments],
            lead=LEAD_S,
            channels=(True, False),
            anchor_lsb=ANCHOR_LSB,
        ),
        cap=CREEP_CAP,
    )

    def kintas_cost(grid: NDArray[np.float64], fss: float) -> NDArray[np.float64]:
        return slewing(np.column_stack([grid, np.full_like(grid, fss), np.zeros_like(grid)]))

    def fss_cost(grid: NDArray[np.float64], kintas: float) -> NDArray[np.float64]:
        return creeping(np.column_stack([np.full_like(grid, kintas), grid, np.zeros_like(grid)]))

    kintas = _search(counter, lambda grid: kintas_cost(grid, 0.0), 0.0, 1.0, GRID)
    fss = _search(counter, lambda grid: fss_cost(grid, kintas), 0.0, 1.0, GRID)
    for kintas_range, fss_range in RANGES:
        kintas = _search(
            counter,
            functools.partial(kintas_cost, fss=fss),
            kintas - kintas_range,
            kintas + kintas_range,
            FINER_GRID,
        )
        fss = _search(
            counter,
            functools.partial(fss_cost, kintas=kintas),
            fss - fss_range,
            fss + fss_range,
            FINER_GRID,
        )
    return FirstApproximation((kintas, fss, fdj), counter.count)


class _Counter:
    def __init__(self) -> None:
        self.count = 0


def _search(
    counter: _Counter,
    cost: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    low: float,
    high: float,
    points: int,
) -> float:
    """Minimum of a scalar function on [low, high] within 0 … 1: grid, then golden section."""
    grid = np.linspace(max(low, 0.0), min(high, 1.0), points)
    values = cost(grid)
    best = int(np.argmin(values))
    bracket = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, points - 1)])
    fine = minimise_scalar(lambda x: float(cost(np.array([x]))[0]), *bracket, TOLERANCE)
    counter.count += points + fine.evaluations
    return fine.x if fine.value <= values[best] else float(grid[best])


class _JackSearch:
    """Pressure gap of candidates for FDJ in one experiment, spool as measured."""

    CAP = 25.0

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        ticks = np.arange(experiment.ticks)
        seen = np.isfinite(experiment.spool)
        spool = np.interp(ticks, ticks[seen], experiment.spool[seen])
        self.pieces: list[tuple[NDArray[np.float64], float, NDArray[np.float64]]] = []
        for start, end in experiment.test.windows.FDJ:
            a = round(start / experiment.tick)
            b = min(round(end / experiment.tick), experiment.ticks)
            if b - a > 1:
                before = float(spool[a - 1]) if a else 0.0
                nodes = _straight_path(spool[a:b], before, experiment.tick)
                self.pieces.append((nodes, before, experiment.pressure[a:b]))

    def __call__(self, grid: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.zeros(len(grid))
        for nodes, before, pressure in self.pieces:
            out += _pressure_costs(
                self.experiment.constants,
                grid,
                before,
                nodes,
                pressure,
                self.experiment.pressure_noise,
                self.CAP,
            )
        return out


def _straight_path(spool: NDArray[np.float64], before: float, tick: float) -> NDArray[np.float64]:
    """Straight pieces from sample to sample, in the form that the jack's kernel takes."""
    rate = np.diff(spool, prepend=before) / tick
    length = np.full(len(spool), tick)
    return np.ascontiguousarray(np.column_stack([length, spool, rate, rate, 0.0 * length]))


@kernel
def _pressure_costs(
    constants: PlantConstants,
    grid: NDArray[np.float64],
    before: float,
    nodes: NDArray[np.float64],
    measured: NDArray[np.float64],
    noise: float,
    cap: float,
) -> NDArray[np.float64]:
    """Capped squared pressure gap for each FDJ of the grid, shape (len(grid),)."""
    n = measured.shape[0]
    node_end = np.arange(1, n + 1)
    pressure, position = np.empty(n), np.empty(n)
    out = np.zeros(grid.shape[0])
    for i in range(grid.shape[0]):
        jack_response(constants, grid[i], before, nodes, node_end, pressure, position)
        for k in range(n):
            gap = (measured[k] - pressure[k]) / noise
            if math.isfinite(gap):
                out[i] += min(gap * gap, cap)
    return out
