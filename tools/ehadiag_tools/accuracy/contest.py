"""Compares compact GA, pygad and differential evolution on the same objective and budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from ehadiag.identify.search.first_approximation import first_approximation, first_inputs
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import CompactGa, PygadGa
from ehadiag.identify.search.stages import DEVIATION, LEAD_S
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.parameters import FAULTS
from ehadiag.model.simd.model import SimdModel
from ehadiag_tools.accuracy.runs import Run, experiments_of

__all__ = ["RIVALS", "contest", "print_contest"]

RIVALS = ("cga", "pygad", "scipy DE")
POPULATION = 24
"""Of differential evolution: eight for each severity."""
WORSE = 1e-6
"""Relative difference of the objective from which it counts as worse."""


def contest(run: Run) -> dict[str, Any]:
    """Search with each solver from the same first approximation, deviation, seed and budget."""
    experiments = experiments_of(run)
    first = first_approximation(first_inputs(experiments)).values
    start = np.array([first[item.name] for item in FAULTS])
    windows = [experiment.test.windows.refinement for experiment in experiments]
    batch = lay_out(experiments, windows, lead=LEAD_S)
    objective = Objective(SimdModel(batch, unknowns_of(experiments, FAULTS)))
    budget = CompactGa().budget
    outcome: dict[str, Any] = {}
    for solver in (CompactGa(), PygadGa().with_budget(budget)):
        found = solver.minimise(objective, start, DEVIATION, run.search_seed)
        outcome[solver.name] = _entry(found.best, found.cost, found.evaluations)
    outcome["scipy DE"] = _evolve(objective, start, budget, run.search_seed)
    return {**asdict(run), "outcome": outcome}


def _evolve(
    objective: Objective, start: NDArray[np.float64], budget: int, seed: int
) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    first = np.clip(rng.normal(start, DEVIATION, (POPULATION, len(start))), 0.0, 1.0)
    first[0] = start
    before = objective.evaluations
    result = differential_evolution(
        lambda columns: objective(columns.T),
        [(0.0, 1.0)] * len(start),
        init=first,
        maxiter=budget // POPULATION - 1,
        tol=0.0,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=rng,
    )
    return _entry(result.x, float(result.fun), objective.evaluations - before)


def _entry(best: NDArray[np.float64], cost: float, evaluations: int) -> dict[str, Any]:
    return {"best": [float(x) for x in best], "cost": cost, "evaluations": evaluations}


def print_contest(name: str, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One table for a case; returns what it shows."""
    cost = {rival: np.array([r["outcome"][rival]["cost"] for r in records]) for rival in RIVALS}
    best = {rival: np.array([r["outcome"][rival]["best"] for r in records]) for rival in RIVALS}
    own, lowest = cost["cga"], min(float(values.min()) for values in cost.values())
    print(f"{name}: {len(records)} search seeds, lowest objective of all {lowest:.4f}\n")
    print(
        "| solver | evaluations | objective above the lowest: median | 95 % | largest | "
        "cga no worse, % of runs | distance from cga's optimum, %: median | largest |"
    )
    print("| --- |" + " --- |" * 7)
    shown = {}
    for rival in RIVALS:
        above = cost[rival] - lowest
        no_worse = 100.0 * np.mean(own <= cost[rival] * (1.0 + WORSE))
        apart = 100.0 * np.abs(best[rival] - best["cga"]).max(axis=1)
        used = np.mean([r["outcome"][rival]["evaluations"] for r in records])
        print(
            f"| {rival} | {used:.0f} | {np.median(above):.4f} | {np.percentile(above, 95):.4f} "
            f"| {above.max():.4f} | {no_worse:.0f} | {np.median(apart):.4f} | {apart.max():.4f} |"
        )
        shown[rival] = {
            "no_worse": float(no_worse),
            "above_median": float(np.median(above)),
            "above_largest": float(above.max()),
            "apart_median": float(np.median(apart)),
            "apart_largest": float(apart.max()),
        }
    print(flush=True)
    return shown
