"""Refinement of the severities alone, of a unit assumed to match its data file.

It begins on the first part of a test while that runs; two rounds on the whole lead from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.criteria import ESTIMATION, FIT
from ehadiag.identify.experiment import (
    ANCHOR_THRESHOLDS_LSB,
    Experiment,
    WindowSpans,
    lay_out_spans,
    unknowns_of,
    with_residual_noise,
)
from ehadiag.identify.least_squares import (
    NEAR,
    SEARCH_OPTIMUM_STD,
    Refinement,
    last_round,
    median_offsets,
    near_spread,
    refine_severities,
    refined_by_step,
    rest_near,
    start_density,
)
from ehadiag.identify.linearisation import (
    ConsideredParameter,
    CoordinateCross,
    Derivatives,
)
from ehadiag.identify.posterior import (
    no_interruption,
)
from ehadiag.identify.solvers import SearchResult
from ehadiag.identify.staged_search import (
    STAGE_SHARES,
    first_approximation_ready_at,
    stage_ready_at,
)
from ehadiag.model.batch import SPOOL_ROW
from ehadiag.model.parameter import Parameter
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, parameter
from ehadiag.model.residual_models import SimdModel
from ehadiag.model.simd_layout import MAX_JACK_HALVINGS
from ehadiag.model.simd_residuals import jack_levels

CONSIDERED_PARAMETERS = (
    ConsideredParameter(
        parameter("sampling_lead"), ESTIMATION.sampling_lead_std, (SPOOL_ROW,), by_rate=True
    ),
)
"""Half a step of a plant that is integrated at 0.25 µs is of this size; sized on the spool, which
moves fastest."""


class FirstPart(msgspec.Struct, frozen=True, eq=False):
    """Optimum on the first part of one or more tests."""

    refined: Refinement
    noise: tuple[tuple[float, ...], ...]
    """Of the signals of each test (m, Pa, m), as the residuals show it."""
    evaluations: int
    """Runs of the model in all."""

    def judged(self, experiments: Sequence[Experiment]) -> list[Experiment]:
        """Return the experiments with the noise that was found."""
        return [item.with_noise(noise) for item, noise in zip(experiments, self.noise, strict=True)]


class StartResiduals(msgspec.Struct, frozen=True, eq=False):
    """Residuals of a free-running model on the first parts of the tests at some severities."""

    residuals: Array
    """Weighted, no offsets taken off; shape (signals, N)."""
    offsets: Mapping[str, float]
    """Constant errors of the sensors, as medians show them, SI by name."""
    weight: Array
    """Shape (signals, N)."""
    levels: NDArray[np.int64]
    """Halvings of the jack's ticks for models nearby, shape (N,): one more than the paths that were
    run ask for. With as few jack friction is half a deviation off, with more 0.03."""

    @property
    def outlier_share(self) -> float:
        """Share of residuals beyond the cap, offsets aside.

        Above `FIT.max_start_outliers` a refinement from there will not explain them.
        """
        residuals = self.residuals.copy()
        for item in SENSOR_OFFSETS:
            if item.adds_to is not None:
                residuals[item.adds_to] -= self.offsets[item.name] * self.weight[item.adds_to]
        return float(np.mean(residuals[self.weight > 0.0] ** 2 >= ESTIMATION.residual_cap))


def start_residuals(
    experiments: Sequence[Experiment], until: Sequence[int], start: Mapping[str, float]
) -> StartResiduals:
    """Run the first `until` ticks of each test at severities by name."""
    free, residuals = free_run_residuals(experiments, first_part_spans(experiments, until), start)
    return _start_residuals(free, residuals)


def _start_residuals(free: SimdModel, residuals: Array) -> StartResiduals:
    """Residuals of a model that was run once, its ticks cut by its own paths."""
    levels = np.minimum(free.levels + 1, MAX_JACK_HALVINGS)
    return StartResiduals(residuals, median_offsets(free, residuals), free.batch.weight, levels)


def refine_first_part(
    experiments: Sequence[Experiment],
    until: Sequence[int],
    start: Mapping[str, float],
    between: Callable[[], None] = no_interruption,
    at_start: StartResiduals | None = None,
) -> FirstPart:
    """Refine on the first `until` ticks of each test, weighing by the noise that residuals show.

    `start`: severities by name. `between`: called between rounds; what it raises ends the search.
    `at_start`: of `start_residuals` there, if they are known.
    """
    spans = first_part_spans(experiments, until)
    at_start = at_start or start_residuals(experiments, until, start)
    start = {**start, **at_start.offsets}
    experiments = _with_judged_noise(experiments, until, at_start.residuals)
    levels = at_start.levels
    best = _refined_spans(experiments, spans, start, levels, SEARCH_OPTIMUM_STD, between)
    evaluations = 1 + best.evaluations
    for _ in range(ESTIMATION.max_noise_judgements):
        before = [item.noise for item in experiments]
        judged = _with_judged_noise(experiments, until, best.residuals)
        after = [item.noise for item in judged]
        if np.allclose(before, after, rtol=ESTIMATION.noise_tolerance, atol=0.0):
            break
        experiments = judged
        best = _refined_spans(
            experiments, spans, best.values, levels, ESTIMATION.refined_std, between
        )
        evaluations += best.evaluations
    noise = tuple(item.noise for item in experiments)
    return FirstPart(best, noise, evaluations)


def free_run_residuals(
    experiments: Sequence[Experiment], spans: WindowSpans | None, start: Mapping[str, float]
) -> tuple[SimdModel, Array]:
    """A model that runs free, and its residuals at severities by name, no offsets taken off."""
    batch = lay_out_spans(experiments, spans)
    model = SimdModel(batch, unknowns_of(experiments), levels=np.full(len(batch.spool), -1))
    point = np.array([[start.get(item.name, 0.0) for item in model.unknowns.free]])
    return model, model.residuals(point)[0][0]


def _refined_spans(
    experiments: Sequence[Experiment],
    spans: WindowSpans,
    start: Mapping[str, float],
    levels: NDArray[np.int64],
    spread: Array | float,
    between: Callable[[], None],
) -> Refinement:
    batch = lay_out_spans(experiments, spans, anchor_lsb=ANCHOR_THRESHOLDS_LSB)
    # What is considered is worked out with the last part.
    model = SimdModel(batch, unknowns_of(experiments), levels=levels)
    derivatives = Derivatives(model, experiments[0].noise)
    return refine_severities(derivatives, start, spread, between)


def refine_near(
    experiments: Sequence[Experiment], start: Mapping[str, float], between: Callable[[], None]
) -> tuple[Refinement, list[Experiment]] | None:
    """Refine whole tests from severities by name that are nearly right, in a few half blocks.

    The first one, of a model that runs free, shows noise and offsets, and leads near the optimum.
    Returns the experiments with the noise, too. None where so near there is no rest, or where the
    start leaves more outliers than a refinement ends with.
    """
    batch = lay_out_spans(experiments)
    # Its lanes are so alike that their own paths say how the jack's ticks are to be cut.
    free = SimdModel(batch, unknowns_of(experiments), levels=np.full(len(batch.spool), -1))
    model = Derivatives(free, experiments[0].noise)
    cross = CoordinateCross.about(model, start_density(model, start, NEAR.look_std))
    runs = model.many(cross.points)
    at_start = _start_residuals(free, runs[0])
    if at_start.outlier_share > FIT.max_outliers_near:
        return None
    between()
    judged = _with_judged_noise(experiments, [item.ticks for item in experiments], runs[0])
    linear, offsets = cross.lines(model, runs), start_density(model, at_start.offsets, 0.0).x
    linear = replace(
        linear,
        x=linear.x + offsets,
        residuals=linear.residuals + np.tensordot(offsets, linear.jacobian, 1),
    )
    near = refined_by_step(model, linear, runs[:0], 0)
    whole = anchored_derivatives(judged, levels=at_start.levels)
    found = rest_near(whole, near.values, near_spread(near))
    if found is None:
        return None
    return replace(found, evaluations=model.evaluations + found.evaluations), judged


def anchored_derivatives(
    experiments: Sequence[Experiment],
    spans: WindowSpans | None = None,
    levels: NDArray[np.int64] | None = None,
) -> Derivatives:
    """Spans of the tests, re-anchored on the spool, in coordinates scaled by the noise.

    levels: of a model of the same spans, if there was one.
    """
    batch = lay_out_spans(experiments, spans, anchor_lsb=ANCHOR_THRESHOLDS_LSB)
    considered = considered_parameters(experiments)
    held = [item.parameter for item in considered]
    unknowns = unknowns_of(experiments, (*FAULTS, *SENSOR_OFFSETS, *held))
    model = SimdModel(batch, unknowns, levels=levels)
    return Derivatives(model, experiments[0].noise, considered)


def considered_instants(free: Sequence[Parameter]) -> tuple[ConsideredParameter, ...]:
    """`CONSIDERED_PARAMETERS` but for those that are free: held as well they would stay at 0."""
    names = {item.name for item in free}
    return tuple(item for item in CONSIDERED_PARAMETERS if item.parameter.name not in names)


def considered_parameters(
    experiments: Sequence[Experiment], free: Sequence[Parameter] = ()
) -> tuple[ConsideredParameter, ...]:
    """Parameters that move in the last round alone, each with a density of its own about 0.

    `considered_instants`, and oil and supply by their steps on the bus, unless they are free.
    """
    stds = {
        "oil_viscosity": max(item.viscosity_std for item in experiments),
        "supply_pressure": max(item.supply_std for item in experiments),
    }
    names = {item.name for item in free}
    return (
        *considered_instants(free),
        *(
            ConsideredParameter(parameter(name), std)
            for name, std in stds.items()
            if std > 0.0 and name not in names
        ),
    )


def first_part_spans(experiments: Sequence[Experiment], until: Sequence[int]) -> WindowSpans:
    """The first ticks of each test as spans."""
    return [[(0.0, ticks * item.tick)] for item, ticks in zip(experiments, until, strict=True)]


def _with_judged_noise(
    experiments: Sequence[Experiment], until: Sequence[int], residuals: Array
) -> list[Experiment]:
    """Weigh all experiments by the noise that residuals show, shape (signals, sum of `until`)."""
    parts = np.split(residuals, np.cumsum(until)[:-1], axis=1)
    return [with_residual_noise(item, part) for item, part in zip(experiments, parts, strict=True)]


def add_last_part(
    experiments: Sequence[Experiment],
    first_part: FirstPart,
    between: Callable[[], None] = no_interruption,
) -> Refinement:
    """Optimum on all of the tests from that on their first parts.

    It is near (`rest_near`); where a break-away is within the width of a round two rounds lead
    there, and where the second does not come to rest all is refined. experiments: with the noise as
    the first part shows it.
    """
    first = first_part.refined
    spans = first_part_spans(experiments, [item.ticks for item in experiments])
    free = lay_out_spans(experiments, spans)
    point = np.array([[first.values[item.name] for item in FAULTS]])
    paths = jack_levels(free, unknowns_of(experiments, FAULTS).candidates(point))
    levels = np.minimum(paths + 1, MAX_JACK_HALVINGS)
    whole = anchored_derivatives(experiments, levels=levels)

    def round_about(end: Refinement, *, settled: bool = True) -> Refinement:
        return last_round(
            whole, start_density(whole, end.values, near_spread(end)), settled=settled
        )

    found = rest_near(whole, first.values, near_spread(first))
    if found is None:
        near = round_about(first)
        found = round_about(near)
        if not found.converged:
            rest = refine_severities(whole, near.values, near_spread(near), between)
            found = round_about(rest, settled=rest.converged)
    return replace(found, evaluations=1 + found.evaluations)


class SeverityAttempt(msgspec.Struct, frozen=True, eq=False):
    """One search and its refinement."""

    found: SearchResult
    refined: Refinement
    experiments: Sequence[Experiment]
    """With their noise as judged."""
    evaluations: int
    """Of the refinement."""


def refined_attempt(
    experiments: Sequence[Experiment],
    found: SearchResult,
    first: FirstPart,
    between: Callable[[], None] = no_interruption,
) -> SeverityAttempt:
    """Refine whole tests from their first parts, after a search; what `between` raises between
    rounds ends it."""
    judged = first.judged(experiments)
    best = add_last_part(judged, first, between)
    evaluations = first.evaluations + best.evaluations
    return SeverityAttempt(found, best, judged, evaluations)


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
