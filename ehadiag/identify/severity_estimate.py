"""Identifies the three fault severities alone, on a unit assumed to match its data file.

The optimum of the staged search is refined; where it does not explain the recording the search may
have ended away from the optimum, and further attempts search wider.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.compile.jit import Array
from ehadiag.core.criteria import FIT
from ehadiag.identify.estimates import refinement_outlier_share
from ehadiag.identify.experiment import Experiment, lay_out_spans, unknowns_of
from ehadiag.identify.least_squares import Refinement, median_offsets
from ehadiag.identify.partial_refinement import (
    FirstPart,
    add_last_part,
    free_run_residuals,
    refine_first_part,
)
from ehadiag.identify.posterior import no_interruption
from ehadiag.identify.solvers import Objective, SearchResult, Solver
from ehadiag.identify.staged_search import (
    RUN_IN_S,
    SEVERITY_DEVIATION_SHARES,
    STAGE_SHARES,
    StageProgress,
    first_approximation_ready_at,
    stage_ready_at,
)
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS
from ehadiag.model.residual_models import SimdModel


class AttemptPlan(msgspec.Struct, frozen=True):
    """How a further attempt searches.

    deviation: of the genetic search about its start, severities.
    budget: in budgets of the solver.
    median_offsets: take the median residual at the start for constant errors of the sensors; else
        take only what the actuator at rest showed.
    """

    deviation: float
    budget: float = 1.0
    median_offsets: bool = False


FURTHER_ATTEMPT_PLANS = (
    AttemptPlan(0.02, median_offsets=True),
    AttemptPlan(0.1, budget=2.0),
    AttemptPlan(0.1, budget=2.0, median_offsets=True),
    AttemptPlan(0.4, budget=3.0),
)
"""One after the other where the staged search does not explain the recording."""
FULL_WINDOW_PLAN = AttemptPlan(0.02)
"""Where currents were guessed: break-aways at other ticks lead the stages astray that see a part of
the window."""


class SeverityAttempt(msgspec.Struct, frozen=True, eq=False):
    """One search and its refinement."""

    found: SearchResult
    refined: Refinement
    experiments: Sequence[Experiment]
    """With their noise as judged."""
    evaluations: int
    """Of the refinement."""
    score: float
    """Twice the negative logarithm of the likelihood: comparable where the noise differs."""
    search_s: float = 0.0
    """Spent on further searches, s."""
    count: int = 1
    """Attempts that led here."""


FirstPartRefinement = Callable[[Sequence[Experiment], Array, Callable[[], None]], FirstPart]
"""Refinement on the first parts of the tests, from a start among the severities; the last argument
is called between rounds."""


def refined_attempt(
    experiments: Sequence[Experiment],
    found: SearchResult,
    start: Array,
    first_parts: FirstPartRefinement,
    between: Callable[[], None] = no_interruption,
) -> SeverityAttempt:
    """Refine from a start after a search; what `between` raises between rounds ends it."""
    until = [first_part_ticks(item) for item in experiments]
    first = first_parts(experiments, start, between)
    judged = first.judged(experiments)
    best = add_last_part(judged, until, first)
    if best is None:
        ends = [item.ticks for item in experiments]
        whole = refine_first_part(experiments, ends, first.refined.values, between)
        judged = whole.judged(experiments)
        best = add_last_part(judged, ends, whole)
        assert best is not None  # no part is left that could lead away
        best = replace(best, evaluations=best.evaluations + whole.evaluations)
    evaluations = first.evaluations + best.evaluations
    weight = lay_out_spans(judged).weight
    score = best.cost - 2.0 * float(np.log(weight[weight > 0.0]).sum())
    return SeverityAttempt(found, best, judged, evaluations, score)


NOT_SEARCHED = SearchResult(np.full(len(FAULTS), np.nan), np.nan, 0, 0, np.zeros(0))
"""Of a refinement that needed no search."""


def best_further_attempt(
    experiments: Sequence[Experiment],
    best: SeverityAttempt,
    first_parts: FirstPartRefinement,
    solver: Solver,
    seed: int,
    progress: StageProgress,
    clock: Callable[[], float],
) -> SeverityAttempt:
    """Return the best of further attempts, as long as none explains the recordings."""
    evaluations, search_s, count = best.evaluations, 0.0, 1
    for plan in FURTHER_ATTEMPT_PLANS:
        if explains_recording(best.refined):
            break
        before = clock()
        of_search = seed + len(STAGE_SHARES) + count
        found = _search_wider(experiments, best.refined.values, solver, of_search, plan, progress)
        search_s += clock() - before
        progress("refinement", 0.0)
        other = refined_attempt(
            experiments, found, found.best, first_parts, partial(progress, "refinement", 0.0)
        )
        evaluations += found.evaluations + other.evaluations
        count += 1
        if other.score < best.score:
            best = other
    return replace(best, evaluations=evaluations, search_s=search_s, count=count)


def search_full_window(
    experiments: Sequence[Experiment], found: SearchResult, solver: Solver, seed: int
) -> SearchResult:
    """Search the whole window from the optimum of the staged search."""
    start = severities_by_name(found.best)
    return _search_wider(
        experiments, start, solver, seed, FULL_WINDOW_PLAN, lambda _stage, _share: None
    )


def explains_recording(refinement: Refinement) -> bool:
    """Whether the optimum explains the recording, so that there is none better to look for."""
    return refinement_outlier_share(refinement) <= FIT.max_fit_outliers and not is_current_guessed(
        refinement
    )


def is_current_guessed(refinement: Refinement) -> bool:
    """Whether the model left the spool so often that the current was not what it went by."""
    return refinement.anchored > FIT.max_anchor_count


def first_part_ticks(experiment: Experiment) -> int:
    """Ticks that some stage before has seen the end of: windows of the test, in any order."""
    test = experiment.test
    seconds = max(first_approximation_ready_at(test), stage_ready_at(test, len(STAGE_SHARES) - 1))
    return min(round(seconds / experiment.tick), experiment.ticks)


def severities_by_name(point: Array) -> dict[str, float]:
    """Severities by name, of a point among them."""
    return {item.name: float(value) for item, value in zip(FAULTS, point, strict=True)}


def _search_wider(
    experiments: Sequence[Experiment],
    start: Mapping[str, float],
    solver: Solver,
    seed: int,
    plan: AttemptPlan,
    progress: StageProgress,
) -> SearchResult:
    """Search the whole window, wider than before."""
    offsets = {item.name: 0.0 for item in SENSOR_OFFSETS}
    if plan.median_offsets:
        severities = {item.name: start[item.name] for item in FAULTS}
        offsets = median_offsets(*free_run_residuals(experiments, None, severities))
    windows = [experiment.test.windows.refinement for experiment in experiments]
    unknowns = unknowns_of(experiments, FAULTS).holding(offsets)
    return solver.with_budget(round(solver.budget * plan.budget)).minimise(
        Objective(SimdModel(lay_out_spans(experiments, windows, lead=RUN_IN_S), unknowns)),
        np.array([start[item.name] for item in FAULTS]),
        plan.deviation * SEVERITY_DEVIATION_SHARES,
        seed,
        lambda done, budget: progress("search", done / budget),
    )
