"""Refinement on the first part of a test, done while the rest of the test is still running.

What is left for the whole test is one step (`ehadiag.identify.refine.update`), where that suffices.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.derivatives import CAP, Considered, Derivatives
from ehadiag.identify.refine.least_squares import SPREAD, Refinement, median_offsets, refine
from ehadiag.identify.refine.posterior import nothing
from ehadiag.identify.spans import (
    ANCHOR_LSB,
    Spans,
    even_levels,
    judge_noise,
    lay_out,
    unknowns_of,
)
from ehadiag.model.batch import SPOOL_ROW
from ehadiag.model.parameters import FAULTS, OFFSETS, Parameter, parameter
from ehadiag.model.simd.model import SimdModel

__all__ = [
    "AGAIN",
    "JUDGEMENTS",
    "NOISE_SETTLED",
    "FirstPart",
    "Look",
    "anchored_derivatives",
    "anchored_model",
    "considered_in",
    "derivatives_of",
    "first_spans",
    "look_at",
    "refine_first_part",
    "residuals_at",
]

JUDGEMENTS = 3
"""How often at most the noise is judged anew."""
NOISE_SETTLED = 0.15
AGAIN = 3e-4
"""Spread of the severities about an optimum, of a look with the noise judged anew."""
CONSIDERED = (Considered(parameter("sampling_lead"), 0.15e-6, (SPOOL_ROW,), by_rate=True),)
"""Half a step of a plant that is integrated at 0.25 µs is of this size; sized on the spool, which
moves fastest."""
VISCOSITY = parameter("oil_viscosity")


@dataclass(frozen=True, slots=True, eq=False)
class FirstPart:
    """Optimum on the first part of one or more tests.

    Attributes
    ----------
    refined : Refinement
    noise : tuple
        Of the signals of each test (m, Pa, m), as the residuals show it.
    levels : shape (N,)
        How a model of these spans cuts its ticks (`ehadiag.model.simd.model.SimdModel`).
    evaluations : int
        Runs of the model, all told.
    """

    refined: Refinement
    noise: tuple[tuple[float, ...], ...]
    levels: NDArray[np.int64]
    evaluations: int

    def judged(self, experiments: Sequence[Experiment]) -> list[Experiment]:
        """Return the experiments with the noise that was found."""
        return [item.with_noise(noise) for item, noise in zip(experiments, self.noise, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What a model that runs free leaves of the first parts of the tests at some severities.

    Attributes
    ----------
    residuals : shape (signals, N)
        Weighted, no offsets taken off.
    offsets : mapping
        Constant errors of the sensors, as medians show them, SI by name.
    weight : shape (signals, N)
    """

    residuals: NDArray[np.float64]
    offsets: Mapping[str, float]
    weight: NDArray[np.float64]

    @property
    def unlikeness(self) -> float:
        """Share of residuals beyond the cap, offsets aside.

        Above `ehadiag.identify.textbook.HOPELESS` a refinement from there will not explain them.
        """
        residuals = self.residuals.copy()
        for item in OFFSETS:
            if item.adds_to is not None:
                residuals[item.adds_to] -= self.offsets[item.name] * self.weight[item.adds_to]
        return float(np.mean(residuals[self.weight > 0.0] ** 2 >= CAP))


def look_at(
    experiments: Sequence[Experiment], until: Sequence[int], start: Mapping[str, float]
) -> Look:
    """Run the first `until` ticks of each test at severities by name."""
    free, residuals = residuals_at(experiments, first_spans(experiments, until), start)
    return Look(residuals, median_offsets(free, residuals), free.batch.weight)


def refine_first_part(
    experiments: Sequence[Experiment],
    until: Sequence[int],
    start: Mapping[str, float],
    between: Callable[[], None] = nothing,
    look: Look | None = None,
) -> FirstPart:
    """Refine on the first `until` ticks of each test, weighing by the noise that residuals show.

    `start`: severities by name. `between`: called between rounds; what it raises ends the search.
    `look`: of `look_at` there, if there was one.
    """
    spans = first_spans(experiments, until)
    look = look or look_at(experiments, until, start)
    start = {**start, **look.offsets}
    experiments = _judged(experiments, until, look.residuals)
    levels = anchored_model(experiments, spans).levels
    best = _refine(experiments, spans, start, levels, SPREAD, between)
    evaluations = 1 + best.evaluations
    for _ in range(JUDGEMENTS):
        before = [item.noise for item in experiments]
        judged = _judged(experiments, until, best.residuals)
        after = [item.noise for item in judged]
        if np.allclose(before, after, rtol=NOISE_SETTLED, atol=0.0):
            break
        experiments = judged
        best = _refine(experiments, spans, best.values, levels, AGAIN, between)
        evaluations += best.evaluations
    noise = tuple(item.noise for item in experiments)
    return FirstPart(best, noise, levels, evaluations)


def residuals_at(
    experiments: Sequence[Experiment], spans: Spans | None, start: Mapping[str, float]
) -> tuple[SimdModel, NDArray[np.float64]]:
    """A model that runs free, and its residuals at severities by name, no offsets taken off."""
    batch = lay_out(experiments, spans)
    model = SimdModel(batch, unknowns_of(experiments), levels=even_levels(batch))
    point = np.array([[start.get(item.name, 0.0) for item in model.unknowns.free]])
    return model, model.residuals(point)[0][0]


def _refine(
    experiments: Sequence[Experiment],
    spans: Spans,
    start: Mapping[str, float],
    levels: NDArray[np.int64],
    spread: NDArray[np.float64] | float,
    between: Callable[[], None],
) -> Refinement:
    batch = lay_out(experiments, spans, anchor_lsb=ANCHOR_LSB)
    # What is considered is worked out with the last part.
    model = SimdModel(batch, unknowns_of(experiments), levels=levels)
    return refine(Derivatives(model, experiments[0].noise), start, spread, between)


def anchored_derivatives(
    experiments: Sequence[Experiment],
    spans: Spans | None = None,
    levels: NDArray[np.int64] | None = None,
) -> Derivatives:
    """Spans of the tests, re-anchored on the spool, in coordinates scaled by the noise."""
    return derivatives_of(anchored_model(experiments, spans, levels=levels), experiments)


def derivatives_of(model: SimdModel, experiments: Sequence[Experiment]) -> Derivatives:
    """A model of `anchored_model`, in coordinates scaled by the noise."""
    return Derivatives(model, experiments[0].noise, considered_in(experiments))


def anchored_model(
    experiments: Sequence[Experiment],
    spans: Spans | None = None,
    *,
    lead: float = 0.0,
    levels: NDArray[np.int64] | None = None,
) -> SimdModel:
    """Model of spans of the tests, re-anchored on the spool.

    `levels`: of a model of the same spans, if there was one.
    """
    batch = lay_out(experiments, spans, lead=lead, anchor_lsb=ANCHOR_LSB)
    considered = [item.parameter for item in considered_in(experiments)]
    unknowns = unknowns_of(experiments, (*FAULTS, *OFFSETS, *considered))
    return SimdModel(batch, unknowns, levels=levels)


def considered_in(
    experiments: Sequence[Experiment], free: Sequence[Parameter] = ()
) -> tuple[Considered, ...]:
    """What is held in an identification, with a tolerance that counts in the interval.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        What it is from.
    free : Sequence[Parameter]
        What is estimated.

    Returns
    -------
    tuple[Considered, ...]
        `CONSIDERED`, and the oil's viscosity where the bus rounds its temperature anew.
    """
    std = max(item.viscosity_std for item in experiments)
    if std == 0.0 or VISCOSITY.name in (item.name for item in free):
        return CONSIDERED
    return (*CONSIDERED, Considered(VISCOSITY, std))


def first_spans(experiments: Sequence[Experiment], until: Sequence[int]) -> Spans:
    """The first ticks of each test as spans."""
    return [[(0.0, ticks * item.tick)] for item, ticks in zip(experiments, until, strict=True)]


def _judged(
    experiments: Sequence[Experiment], until: Sequence[int], residuals: NDArray[np.float64]
) -> list[Experiment]:
    """Weigh all experiments by the noise that residuals show, shape (signals, sum of `until`)."""
    parts = np.split(residuals, np.cumsum(until)[:-1], axis=1)
    return [judge_noise(item, part) for item, part in zip(experiments, parts, strict=True)]
