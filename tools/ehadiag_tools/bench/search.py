"""Benchmark of the genetic search against other searches, to the same final cost.

All start from the first approximation with the pipeline's deviation. The compact genetic algorithm
runs to its end; what it reaches is the goal. Each rival then runs until it is there.
"""

from __future__ import annotations

import importlib
import importlib.util
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from ehadiag.identify.search.compact_ga import state_bytes
from ehadiag.identify.search.first_approximation import first_approximation, first_inputs
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import CompactGa, PygadGa
from ehadiag.identify.search.stages import DEVIATION
from ehadiag.model.parameters import FAULTS
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import experiment, search_window

__all__ = ["Goal", "ReachedError", "measure"]

SECTION = "search"
POPULATION = 24
"""Of the rivals but pygad: eight for each severity."""
SLACK = 1e-3
"""A rival is there when its cost is at most so much above (share)."""

Vector = NDArray[np.float64]


class ReachedError(BaseException):
    """Stops a rival that is there; pygad turns exceptions of the usual kind into an exit."""


class Goal(Objective):
    """The objective; ends the search that reaches the goal, or has spent its evaluations."""

    def __init__(self, of: Objective, goal: float, budget: int) -> None:
        super().__init__(of.model, of.cap)
        self.goal, self.best = goal, np.inf
        self._before, self._budget = of.evaluations, budget

    @property
    def spent(self) -> int:
        """Evaluations since it was made."""
        return self.evaluations - self._before

    def __call__(self, population: Vector) -> Vector:
        """As the objective; raises ReachedError once the goal is reached."""
        return self.judged(super().__call__(population))

    def judged(self, values: Vector) -> Vector:
        """Return the costs, unless the search is to end."""
        self.best = min(self.best, float(values.min()))
        if self.best <= self.goal or self.spent >= self._budget:
            raise ReachedError
        return values


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    objective = Objective(search_window(sizes.logs))
    first = first_approximation(first_inputs([experiment(sizes.logs)])).values
    start = np.array([first[item.name] for item in FAULTS])
    goals, own = [], []
    for seed in range(sizes.seeds):
        found = CompactGa().minimise(objective, start, DEVIATION, seed)
        goals.append(found.cost * (1.0 + SLACK))
        there = int(np.flatnonzero(found.history <= goals[-1])[0]) + 1
        solver = CompactGa()
        short = solver.with_budget(1 + there * solver.samples)
        begin = time.thread_time()
        short.minimise(objective, start, DEVIATION, seed)
        own.append((time.thread_time() - begin, short.budget, True))
    # Each rival's libraries are loaded before its clock runs.
    rivals = {"pygad": _pygad, "scipy differential evolution": _evolution}
    absent = []
    for name, module, rival in (("pymoo GA", "pymoo", _pymoo), ("pycma", "cma", _cma)):
        if importlib.util.find_spec(module) is None:
            absent.append(Figure(SECTION, name, None, "ms", f"left out: {module} not installed"))
        else:
            rivals[name] = rival
    base = statistics.median(spent for spent, _, _ in own)
    out = [
        Figure(SECTION, "compact GA to its own optimum", base * 1e3, "ms", _remark(own)),
        Figure(SECTION, "compact GA's state", state_bytes(len(start)), "bytes", _STATE),
    ]
    for name, rival in rivals.items():
        spent = _race(rival, objective, start, goals, sizes)
        middle = statistics.median(item[0] for item in spent)
        out.append(Figure(SECTION, f"{name} to the same cost", middle * 1e3, "ms", _remark(spent)))
        arrived = all(item[2] for item in spent)
        remark = "" if arrived else "at least: some seeds spent their evaluations before"
        out.append(
            Figure(SECTION, f"compact GA faster than {name}", middle / base, "times", remark)
        )
    return out + absent


_STATE = "whatever the generations and the virtual population; 768 bytes more hold a generation"


def _remark(runs: list[tuple[float, int, bool]]) -> str:
    evaluations = statistics.median(item[1] for item in runs)
    there = sum(item[2] for item in runs)
    return f"{evaluations:.0f} evaluations; {there} of {len(runs)} seeds arrived"


def _race(
    rival: Callable[[Objective, Vector, int, int], None],
    objective: Objective,
    start: Vector,
    goals: list[float],
    sizes: Sizes,
) -> list[tuple[float, int, bool]]:
    """Time, evaluations and arrival of each seed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _to_end(rival, Goal(objective, -1.0, 2 * POPULATION), start, 0, sizes.budget)
        out = []
        for seed, goal in enumerate(goals):
            race = Goal(objective, goal, sizes.budget)
            begin = time.thread_time()
            _to_end(rival, race, start, seed, sizes.budget)
            spent = time.thread_time() - begin
            out.append((spent, race.spent, race.best <= goal))
    return out


def _to_end(
    rival: Callable[[Objective, Vector, int, int], None],
    race: Goal,
    start: Vector,
    seed: int,
    budget: int,
) -> None:
    try:
        rival(race, start, seed, budget)
    except ReachedError:
        return


def _first(start: Vector, seed: int) -> Vector:
    """First population: about the start, which is one of it."""
    rng = np.random.default_rng(seed)
    rows = np.clip(rng.normal(start, DEVIATION, (POPULATION, len(start))), 0.0, 1.0)
    rows[0] = start
    return np.asarray(rows)


def _pygad(objective: Objective, start: Vector, seed: int, budget: int) -> None:
    PygadGa().with_budget(2 * budget).minimise(objective, start, DEVIATION, seed)


def _evolution(objective: Objective, start: Vector, seed: int, budget: int) -> None:
    differential_evolution(
        lambda columns: objective(columns.T),
        [(0.0, 1.0)] * len(start),
        init=_first(start, seed),
        maxiter=budget,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=np.random.default_rng(seed),
    )


def _pymoo(objective: Objective, start: Vector, seed: int, budget: int) -> None:
    base: Any = importlib.import_module("pymoo.core.problem").Problem
    algorithm: Any = importlib.import_module("pymoo.algorithms.soo.nonconvex.ga").GA
    minimize: Any = importlib.import_module("pymoo.optimize").minimize

    def evaluate(_: Any, rows: Vector, out: dict[str, Vector], *__: Any, **___: Any) -> None:
        out["F"] = objective(rows)[:, None]

    problem = type("Problem", (base,), {"_evaluate": evaluate})(
        n_var=len(start), n_obj=1, xl=0.0, xu=1.0
    )
    minimize(
        problem,
        algorithm(pop_size=POPULATION, sampling=_first(start, seed)),
        ("n_eval", 2 * budget),
        seed=seed,
        verbose=False,
    )


def _cma(objective: Objective, start: Vector, seed: int, budget: int) -> None:
    cma: Any = importlib.import_module("cma")
    settings = {
        "bounds": [0.0, 1.0],
        "popsize": POPULATION,
        "seed": seed + 1,
        "verbose": -9,
        "maxfevals": 2 * budget,
    }
    evolution = cma.CMAEvolutionStrategy(start, DEVIATION, settings)
    while not evolution.stop():
        rows = evolution.ask()
        evolution.tell(rows, objective(np.array(rows)))
