"""Benchmark of the whole estimate against other solvers on the same compiled objective.

They get what this package would be without its method: model and objective of the whole test, but
the whole cube to search, and neither a first approximation nor a refinement. Each is run twice:
with candidates evaluated one by one, by the scalar kernel, as both libraries do unless told
otherwise; and told to hand over a whole generation, which the lanes evaluate.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from ehadiag.identify.experiment import make_batch
from ehadiag.identify.result import Identification
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import PygadGa
from ehadiag.model.scalar.residuals import costs, workspace
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import experiment
from ehadiag_tools.bench.search import Goal, ReachedError

__all__ = ["OneByOne", "rivals"]

SECTION = "estimate"
SAME = 1.0
"""Cost above that of our estimate; so much is one standard deviation."""
POPULATION = 30
"""Of differential evolution where it asks for a generation: nearly two blocks of lanes."""


class OneByOne(Goal):
    """The same goal, candidate after candidate by the scalar kernel."""

    def __init__(self, of: Objective, goal: float, budget: int) -> None:
        super().__init__(of, goal, budget)
        self._scratch = workspace(of.batch)
        self._gaps = np.empty((2, len(of.batch.current)))

    def __call__(self, population: NDArray[np.float64]) -> NDArray[np.float64]:
        """As the goal."""
        rows = np.atleast_2d(population)
        candidates, out = np.zeros((len(rows), 5)), np.empty(len(rows))
        candidates[:, :3] = rows
        candidates[:, 3:] = self.offsets
        costs(self.batch, candidates, self.cap, self._scratch, self._gaps, out)
        self.evaluations += len(rows)
        return self.judged(out)


@dataclass(frozen=True, slots=True)
class _Rival:
    """A solver, and what it is run on.

    Attributes
    ----------
    name: of the rows.
    solve: minimises the goal from a seed with a budget.
    kind: of goal.
    """

    name: str
    solve: Callable[[Objective, int, int], object]
    kind: type[Goal]


def rivals(sizes: Sizes, ours: Identification, whole: float) -> list[Figure]:
    """CPU time of each until it has found a point as good as our estimate.

    `whole`: CPU time of our estimate, s.
    """
    objective = Objective(make_batch([experiment(sizes.logs)]))
    estimate = np.array([item.value for item in ours.estimates])
    out = []
    for rival in (
        _Rival("pygad, one candidate a call", _pygad, OneByOne),
        _Rival("pygad, a generation a call", _pygad, Goal),
        _Rival("scipy differential evolution, defaults", _evolution, OneByOne),
        _Rival("scipy differential evolution, a generation a call", _generations, Goal),
    ):
        goal = float(rival.kind(objective, -np.inf, sizes.budget + 1)(estimate)[0]) + SAME
        with contextlib.suppress(ReachedError):
            rival.solve(rival.kind(objective, -np.inf, 1), 0, POPULATION)  # loads its library
        spent, used, arrived = [], [], 0
        for seed in range(sizes.seeds):
            race = rival.kind(objective, goal, sizes.budget)
            begin = time.process_time()
            with contextlib.suppress(ReachedError):
                rival.solve(race, seed, sizes.budget)
            spent.append(time.process_time() - begin)
            used.append(race.evaluations)
            arrived += race.best <= goal
        remark = (
            f"{statistics.median(used):.0f} evaluations; {arrived} of {sizes.seeds} seeds there"
        )
        middle = statistics.median(spent)
        least = "" if arrived == sizes.seeds else "at least: not all seeds arrived"
        out += [
            Figure(SECTION, f"{rival.name}, CPU", middle * 1e3, "ms", remark),
            Figure(SECTION, f"estimate faster than {rival.name}", middle / whole, "times", least),
        ]
    return out


def _pygad(objective: Objective, seed: int, budget: int) -> None:
    middle = np.full(3, 0.5)
    PygadGa().with_budget(2 * budget).minimise(objective, middle, middle, seed)


def _evolution(objective: Objective, seed: int, _budget: int) -> None:
    """As it comes, but that it goes on until it is there."""
    differential_evolution(
        lambda candidate: float(objective(candidate)[0]),
        [(0.0, 1.0)] * 3,
        tol=0.0,
        rng=np.random.default_rng(seed),
    )


def _generations(objective: Objective, seed: int, budget: int) -> None:
    differential_evolution(
        lambda columns: objective(columns.T),
        [(0.0, 1.0)] * 3,
        popsize=POPULATION // 3,
        maxiter=budget,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=np.random.default_rng(seed),
    )
