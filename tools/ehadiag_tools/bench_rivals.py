"""The whole estimate against others' solvers on the same compiled objective.

They get what this package would be without its method: model and objective of the whole test, but
the whole cube to search, and neither a first approximation nor a refinement.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import differential_evolution

from ehadiag.identify.experiment import make_batch
from ehadiag.identify.objective import Objective
from ehadiag.identify.result import Identification
from ehadiag.identify.solvers import PygadGa
from ehadiag_tools.bench_figures import Figure, Sizes
from ehadiag_tools.bench_problem import experiment
from ehadiag_tools.bench_search import Goal, ReachedError

__all__ = ["rivals"]

SECTION = "estimate"
SAME = 1.0
"""Cost above that of our estimate; so much is one standard deviation."""
POPULATION = 32


def rivals(sizes: Sizes, ours: Identification, whole: float) -> list[Figure]:
    """CPU time of each until it has found a point as good as our estimate.

    `whole`: CPU time of our estimate, s.
    """
    objective = Objective(make_batch([experiment(sizes.logs)]))
    goal = float(objective(np.array([item.value for item in ours.estimates]))[0]) + SAME
    solvers: dict[str, Callable[[Objective, int, int], object]] = {
        "pygad": _pygad,
        "scipy differential evolution": _evolution,
    }
    out = []
    for name, solve in solvers.items():
        with contextlib.suppress(ReachedError):
            solve(Goal(objective, -1.0, 1), 0, POPULATION)  # loads its library
        spent, used, arrived = [], [], 0
        for seed in range(sizes.seeds):
            race = Goal(objective, goal, sizes.budget)
            begin = time.process_time()
            with contextlib.suppress(ReachedError):
                solve(race, seed, sizes.budget)
            spent.append(time.process_time() - begin)
            used.append(race.evaluations)
            arrived += race.best <= goal
        remark = (
            f"{statistics.median(used):.0f} evaluations; {arrived} of {sizes.seeds} seeds there"
        )
        middle = statistics.median(spent)
        least = "" if arrived == sizes.seeds else "at least: not all seeds arrived"
        out += [
            Figure(SECTION, f"{name} from the whole cube, CPU", middle * 1e3, "ms", remark),
            Figure(SECTION, f"estimate faster than {name}", middle / whole, "times", least),
        ]
    return out


def _pygad(objective: Objective, seed: int, budget: int) -> None:
    middle = np.full(3, 0.5)
    PygadGa().with_budget(2 * budget).minimise(objective, middle, middle, seed)


def _evolution(objective: Objective, seed: int, budget: int) -> None:
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
