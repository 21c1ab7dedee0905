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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.spans import ANCHOR_LSB, lay_out, unknowns_of
from ehadiag.model.batch import Batch
from ehadiag.model.parameters import FAULTS, Unknowns
from ehadiag.model.simd.jack_driven import driven_costs
from ehadiag.model.simd.model import SimdModel

__all__ = ["PRECISION", "FirstApproximation", "FirstInputs", "first_approximation", "first_inputs"]

GRID = 32
"""Points of the coarse search over 0 … 1."""
RANGES = ((0.2, 0.06), (0.05, 0.02))
"""Half-widths of the repeated searches, Kintas and FSS."""
FINER_GRID = 16
TOLERANCE = 6e-4
"""Spacing of the last grid."""
FSS_SPACINGS = (0.04, 0.01, TOLERANCE)
"""The same of the three searches for FSS, whose runs are the dearest."""
FDJ_SPACING = 4.5e-3
"""The same of FDJ, whose cost is nearly a parabola."""
LEAD_S = 0.05
PRECISION: Mapping[str, float] = {"Kintas": 1.0, "FSS": 1.0, "FDJ": 0.2}
"""Typical errors of the three searches in proportion to each other: FDJ is known best."""
CREEP_PRESSURE_CAP = 25.0
CREEP_CAP = 100.0
"""A stick-slip jump at another tick counts no more than ten times the noise."""


@dataclass(frozen=True, slots=True)
class FirstApproximation:
    """Result of the three searches."""

    values: Mapping[str, float]
    """Severities by name."""
    evaluations: int


@dataclass(frozen=True, slots=True, eq=False)
class FirstInputs:
    """All that the three searches look at."""

    unknowns: Unknowns
    """Of the severities."""
    creeps: tuple[_Creep, ...]
    slewing: Batch
    creeping: Batch

    def arrays(self) -> Iterator[NDArray[np.float64] | NDArray[np.int64]]:
        """Return every number in it."""
        yield np.array(self.unknowns.base)
        for creep in self.creeps:
            yield np.array([creep.test, creep.before, creep.noise])
            yield creep.nodes
            yield creep.pressure
        yield from self.slewing
        yield from self.creeping


def first_inputs(experiments: Sequence[Experiment]) -> FirstInputs:
    """Lay out the windows of the three searches."""
    return FirstInputs(
        unknowns=unknowns_of(experiments, FAULTS),
        creeps=tuple(
            piece
            for test, experiment in enumerate(experiments)
            for piece in _creeps(experiment, test)
        ),
        slewing=lay_out(
            experiments,
            [experiment.test.windows.Kintas for experiment in experiments],
            lead=LEAD_S,
            channels=(True, False),
        ),
        creeping=lay_out(
            experiments,
            [experiment.test.windows.FSS for experiment in experiments],
            lead=LEAD_S,
            channels=(True, False),
            anchor_lsb=ANCHOR_LSB,
        ),
    )


def first_approximation(inputs: FirstInputs) -> FirstApproximation:
    """Search FDJ, then Kintas, then FSS; then Kintas and FSS twice more."""
    counter = _Counter()
    slewing = Objective(SimdModel(inputs.slewing, inputs.unknowns), cap=np.inf)
    creeping = Objective(SimdModel(inputs.creeping, inputs.unknowns), cap=CREEP_CAP)

    def fdj_cost(grid: NDArray[np.float64]) -> NDArray[np.float64]:
        candidates = inputs.unknowns.candidates(_points(inputs.unknowns, FDJ=grid))
        costs = [
            driven_costs(
                np.ascontiguousarray(candidates[:, creep.test]),
                creep.nodes,
                creep.before,
                creep.pressure,
                creep.noise,
                CREEP_PRESSURE_CAP,
            )
            for creep in inputs.creeps
        ]
        return np.asarray(np.sum(costs, axis=0))

    def kintas_cost(grid: NDArray[np.float64], fss: float) -> NDArray[np.float64]:
        return slewing(_points(inputs.unknowns, Kintas=grid, FSS=fss))

    def fss_cost(grid: NDArray[np.float64], kintas: float) -> NDArray[np.float64]:
        return creeping(_points(inputs.unknowns, Kintas=kintas, FSS=grid))

    fdj = _search(counter, fdj_cost, 0.0, 1.0, GRID, FDJ_SPACING)
    kintas = _search(counter, lambda grid: kintas_cost(grid, 0.0), 0.0, 1.0, GRID)
    fss = _search(counter, lambda grid: fss_cost(grid, kintas), 0.0, 1.0, GRID, FSS_SPACINGS[0])
    for (kintas_range, fss_range), spacing in zip(RANGES, FSS_SPACINGS[1:], strict=True):
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
            spacing,
        )
    return FirstApproximation({"Kintas": kintas, "FSS": fss, "FDJ": fdj}, counter.count)


def _points(unknowns: Unknowns, **severities: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Points in the space of the severities, those not named at 0; shape (n, k)."""
    columns = [np.asarray(severities.get(item.name, 0.0)) for item in unknowns.free]
    return np.column_stack(np.broadcast_arrays(*columns))


class _Counter:
    def __init__(self) -> None:
        self.count = 0


def _search(
    counter: _Counter,
    cost: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    low: float,
    high: float,
    points: int,
    coarsest: float = TOLERANCE,
) -> float:
    """Minimum of a scalar function on [low, high] within 0 … 1.

    Ever finer grids about the lowest point, down to a spacing of `coarsest`, all points of one at
    once; at last the vertex of the parabola through the three lowest neighbours.
    """
    while True:
        grid = np.linspace(max(low, 0.0), min(high, 1.0), points)
        values = cost(grid)
        counter.count += points
        best = int(np.argmin(values))
        spacing = float(grid[1] - grid[0])
        if spacing <= coarsest:
            return _vertex(grid, values, best)
        low, high = float(grid[best]) - spacing, float(grid[best]) + spacing
        points = FINER_GRID


def _vertex(grid: NDArray[np.float64], values: NDArray[np.float64], best: int) -> float:
    """Vertex of the parabola through the lowest point and its neighbours, if it has some."""
    if not 0 < best < len(grid) - 1:
        return float(grid[best])
    left, middle, right = values[best - 1 : best + 2]
    bent = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bent if bent > 0.0 else 0.0
    return float(grid[best] + shift * (grid[1] - grid[0]))


class _Creep(NamedTuple):
    """Span in which the jack creeps, driven by the spool as it was measured.

    test: which of the tests it is of.
    before: spool position before the span, m.
    nodes: the spool's path in the form that the jack's kernel takes.
    pressure: measured, Pa, shape (n,).
    noise: of the pressure, Pa.
    """

    test: int
    before: float
    nodes: NDArray[np.float64]
    pressure: NDArray[np.float64]
    noise: float


def _creeps(experiment: Experiment, test: int) -> Iterator[_Creep]:
    ticks = np.arange(experiment.ticks)
    seen = np.isfinite(experiment.spool)
    spool = np.interp(ticks, ticks[seen], experiment.spool[seen])
    for start, end in experiment.test.windows.FDJ:
        a = round(start / experiment.tick)
        b = min(round(end / experiment.tick), experiment.ticks)
        if b - a > 1:
            before = float(spool[a - 1]) if a else 0.0
            yield _Creep(
                test,
                before,
                _straight_path(spool[a:b], before, experiment.tick),
                experiment.pressure[a:b],
                experiment.pressure_noise,
            )


def _straight_path(spool: NDArray[np.float64], before: float, tick: float) -> NDArray[np.float64]:
    """Straight pieces from sample to sample, in the form that the jack's kernel takes."""
    rate = np.diff(spool, prepend=before) / tick
    length = np.full(len(spool), tick)
    return np.ascontiguousarray(np.column_stack([length, spool, rate, rate, 0.0 * length]))
