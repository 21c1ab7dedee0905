"""Identifies the three fault severities alone, on a unit assumed to match its data file.

The optimum of the staged search is refined; where it does not explain the recording the search may
have ended beside the optimum, and further attempts search wider.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.estimates import outliers
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.first_part import FirstPart, refine_first_part, residuals_at
from ehadiag.identify.refine.least_squares import Refinement, median_offsets
from ehadiag.identify.refine.posterior import nothing
from ehadiag.identify.refine.update import add_last_part
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import SearchResult, Solver
from ehadiag.identify.search.stages import (
    DEVIATION_SHARE,
    LEAD_S,
    STAGES,
    Progress,
    first_ends_at,
    stage_ends_at,
)
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.parameters import FAULTS, OFFSETS
from ehadiag.model.simd.model import SimdModel

__all__ = [
    "GUESSED_STD",
    "HOPELESS",
    "Attempt",
    "attempt",
    "explains",
    "first_ticks",
    "is_guessed",
    "named",
    "rescued",
    "searched_whole",
]


@dataclass(frozen=True, slots=True)
class Plan:
    """How a further attempt searches.

    deviation: of the genetic search about its start, severities.
    budget: in budgets of the solver.
    median_offsets: take the median residual at the start for constant errors of the sensors; else
        take only what the actuator at rest showed.
    """

    deviation: float
    budget: float = 1.0
    median_offsets: bool = False


RESCUES = (
    Plan(0.02, median_offsets=True),
    Plan(0.1, budget=2.0),
    Plan(0.1, budget=2.0, median_offsets=True),
    Plan(0.4, budget=3.0),
)
"""One after the other where the staged search does not explain the recording."""
WHOLE = Plan(0.02)
"""Where currents were guessed: break-aways at other ticks lead the stages astray that see a part of
the window."""
POOR_FIT = 0.01
"""Share of residuals beyond three deviations that asks for another attempt."""
HOPELESS = 0.15
"""Such a share after the search: mostly 0.04 at most on a textbook's actuator, 0.29 and more on
others. Between break-aways the search may end away from the optimum (0.18 seen) though it began
near it; then what it began from is looked at too."""
MOST_ANCHORED = 4
"""Times that the model may be put back on the measured spool. Away from the optimum break-aways
come at other ticks; at it the model stays on the spool in all but one of 200 tests."""


GUESSED_STD = 2e-4
"""Of each severity where the model had to be put back more often, as where a tenth of the jack
positions that a control law worked on was guessed: 3e-4 off was seen."""


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One search and its refinement.

    Attributes
    ----------
    found : SearchResult
    refined : Refinement
    experiments : sequence of Experiment
        With their noise as judged.
    evaluations : int
        Of the refinement.
    score : float
        Twice the negative logarithm of the likelihood: comparable where the noise differs.
    search_s : float
        Spent on further searches, s.
    count : int
        Attempts that led here.
    """

    found: SearchResult
    refined: Refinement
    experiments: Sequence[Experiment]
    evaluations: int
    score: float
    search_s: float = 0.0
    count: int = 1


FirstParts = Callable[[Sequence[Experiment], NDArray[np.float64], Callable[[], None]], FirstPart]
"""Refinement on the first parts of the tests, from a start among the severities; the last argument
is called between rounds."""


def attempt(
    experiments: Sequence[Experiment],
    found: SearchResult,
    first_parts: FirstParts,
    between: Callable[[], None] = nothing,
) -> Attempt:
    """Refine the optimum of a search; what `between` raises between rounds ends it."""
    until = [first_ticks(item) for item in experiments]
    first = first_parts(experiments, found.best, between)
    judged = first.judged(experiments)
    best = add_last_part(judged, until, first)
    if best is None:
        ends = [item.ticks for item in experiments]
        whole = refine_first_part(experiments, ends, first.refined.values, between)
        judged = whole.judged(experiments)
        best = add_last_part(judged, ends, whole)
        assert best is not None
        best = replace(best, evaluations=best.evaluations + whole.evaluations)
    evaluations = first.evaluations + best.evaluations
    weight = lay_out(judged).weight
    score = best.cost - 2.0 * float(np.log(weight[weight > 0.0]).sum())
    return Attempt(found, best, judged, evaluations, score)


def rescued(
    experiments: Sequence[Experiment],
    best: Attempt,
    first_parts: FirstParts,
    solver: Solver,
    seed: int,
    tell: Progress,
    clock: Callable[[], float],
) -> Attempt:
    """Return the best of further attempts, as long as none explains the recordings."""
    evaluations, search_s, count = best.evaluations, 0.0, 1
    for plan in RESCUES:
        if explains(best.refined):
            break
        before = clock()
        of_search = seed + len(STAGES) + count
        found = _searched(experiments, best.refined.values, solver, of_search, plan, tell)
        search_s += clock() - before
        tell("refinement", 0.0)
        other = attempt(experiments, found, first_parts, partial(tell, "refinement", 0.0))
        evaluations += found.evaluations + other.evaluations
        count += 1
        if other.score < best.score:
            best = other
    return replace(best, evaluations=evaluations, search_s=search_s, count=count)


def searched_whole(
    experiments: Sequence[Experiment], found: SearchResult, solver: Solver, seed: int
) -> SearchResult:
    """Search the whole window from the optimum of the staged search."""
    start = named(found.best)
    return _searched(experiments, start, solver, seed, WHOLE, lambda _stage, _share: None)


def explains(refinement: Refinement) -> bool:
    """Whether the optimum explains the recording, so that there is none better to look for."""
    return outliers(refinement) <= POOR_FIT and not is_guessed(refinement)


def is_guessed(refinement: Refinement) -> bool:
    """Whether the model left the spool so often that the current was not what it went by."""
    return refinement.anchored > MOST_ANCHORED


def first_ticks(experiment: Experiment) -> int:
    """Ticks that some stage before has seen the end of: windows of the test, in any order."""
    test = experiment.test
    seconds = max(first_ends_at(test), stage_ends_at(test, len(STAGES) - 1))
    return min(round(seconds / experiment.tick), experiment.ticks)


def named(point: NDArray[np.float64]) -> dict[str, float]:
    """Severities by name, of a point among them."""
    return {item.name: float(value) for item, value in zip(FAULTS, point, strict=True)}


def _searched(
    experiments: Sequence[Experiment],
    start: Mapping[str, float],
    solver: Solver,
    seed: int,
    plan: Plan,
    tell: Progress,
) -> SearchResult:
    """Search the whole window anew, wider than before."""
    offsets = {item.name: 0.0 for item in OFFSETS}
    if plan.median_offsets:
        severities = {item.name: start[item.name] for item in FAULTS}
        offsets = median_offsets(*residuals_at(experiments, None, severities))
    windows = [experiment.test.windows.refinement for experiment in experiments]
    unknowns = unknowns_of(experiments, FAULTS).holding(offsets)
    return solver.with_budget(round(solver.budget * plan.budget)).minimise(
        Objective(SimdModel(lay_out(experiments, windows, lead=LEAD_S), unknowns)),
        np.array([start[item.name] for item in FAULTS]),
        plan.deviation * DEVIATION_SHARE,
        seed,
        lambda done, budget: tell("search", done / budget),
    )
