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
from scipy.optimize import differential_evolution

from ehadiag.identify.result import Identification
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import PygadGa
from ehadiag.model.interface import ResidualModel
from ehadiag.model.scalar.residuals import ScalarModel
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import whole_test
from ehadiag_tools.bench.search import Goal, ReachedError

__all__ = ["rivals"]

SECTION = "estimate"
SAME = 1.0
"""Cost above that of our estimate; so much is one standard deviation."""
POPULATION = 30
"""Of differential evolution where it asks for a generation: nearly two blocks of lanes."""


@dataclass(frozen=True, slots=True)
class _Rival:
    """A solver, and what it is run on.

    Attributes
    ----------
    name: of the rows.
    solve: minimises the goal from a seed with a budget.
    model: what evaluates its candidates.
    """

    name: str
    solve: Callable[[Objective, int, int], object]
    model: ResidualModel


def rivals(sizes: Sizes, ours: Identification, whole: float) -> list[Figure]:
    """CPU time of each until it has found a point as good as our estimate.

    `whole`: CPU time of our estimate, s.
    """
    lanes = whole_test(sizes.logs, 1)
    scalar = ScalarModel(lanes.batch, lanes.unknowns)
    estimate = np.array([item.value for item in ours.estimates])
    out = []
    for rival in (
        _Rival("pygad, one candidate a call", _pygad, scalar),
        _Rival("pygad, a generation a call", _pygad, lanes),
        _Rival("scipy differential evolution, defaults", _evolution, scalar),
        _Rival("scipy differential evolution, a generation a call", _generations, lanes),
    ):
        # Costs of one kernel are not compared with another's.
        objective = Objective(rival.model)
        goal = float(objective(estimate[None, :])[0]) + SAME
        with contextlib.suppress(ReachedError):
            rival.solve(Goal(objective, -np.inf, 1), 0, POPULATION)  # loads its library
        spent, used, arrived = [], [], 0
        for seed in range(sizes.seeds):
            race = Goal(objective, goal, sizes.budget)
            begin = time.process_time()
            with contextlib.suppress(ReachedError):
                rival.solve(race, seed, sizes.budget)
            spent.append(time.process_time() - begin)
            used.append(race.spent)
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
    middle = 0.5 * (objective.lower + objective.upper)
    PygadGa().with_budget(2 * budget).minimise(objective, middle, middle, seed)


def _evolution(objective: Objective, seed: int, _budget: int) -> None:
    """As it comes, but that it goes on until it is there."""
    differential_evolution(
        lambda candidate: float(objective(candidate[None, :])[0]),
        list(zip(objective.lower, objective.upper, strict=True)),
        tol=0.0,
        rng=np.random.default_rng(seed),
    )


def _generations(objective: Objective, seed: int, budget: int) -> None:
    differential_evolution(
        lambda columns: objective(columns.T),
        list(zip(objective.lower, objective.upper, strict=True)),
        popsize=POPULATION // len(objective.lower),
        maxiter=budget,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=np.random.default_rng(seed),
    )
