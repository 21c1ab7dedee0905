"""The last step of the refinement: what the end of a test adds to an optimum without it.

The optimum of the first part stands with its information, the normal matrix of its residuals; one
Gauss-Newton step on the residuals of the last part, weighed by the information of both, leads to
the optimum of the whole (a measurement update of the information filter). Where the last part is
small the step is a fraction of a deviation, over which derivatives hold. From where a longer one
leads the whole is refined, in few rounds; where it does not lead down the last round is about where
the first part ended. One that is none of a small part is not taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.bounded_step import bounded_step
from ehadiag.identify.refine.derivatives import Derivatives, Slope
from ehadiag.identify.refine.first_part import (
    FirstPart,
    anchored_derivatives,
    anchored_model,
    derivatives_of,
)
from ehadiag.identify.refine.last_round import last_round
from ehadiag.identify.refine.least_squares import SPREAD, Refinement, refine
from ehadiag.identify.refine.linearisation import Belief
from ehadiag.identify.refine.posterior import FEW
from ehadiag.identify.search.stages import LEAD_S

__all__ = ["add_last_part"]

FARTHEST = 3.0
"""Length of the step, in deviations of the first part, beyond which it is none of a small part."""
LONG = 1.0
"""The same of a severity: the optimum of the whole is not where one step leads, and is looked for
from there."""
WORSE = 4.0
"""Cost by which the step may lead up: what break-aways make of a way down."""
FEWER = replace(FEW, most_rounds=4, whole_rounds=2)
"""Rounds of the whole where it is refined: the test is over by then, and the verdict awaited."""
FREE = 1e-12
"""Information on what nothing shows."""


def add_last_part(
    experiments: Sequence[Experiment], until: Sequence[int], first_part: FirstPart
) -> Refinement | None:
    """Optimum on all of the tests, from that on their first parts; None where it is elsewhere.

    Parameters
    ----------
    experiments : sequence of Experiment
        With the noise as the first part judged it.
    until : sequence of int
        Ticks of the first part of each test.
    """
    first, rows = first_part.refined, _Rows.of(experiments, until)
    levels = np.full(sum(item.ticks for item in experiments), -1, dtype=np.int64)
    levels[rows.first] = first_part.levels
    if len(rows.last):
        last = anchored_model(experiments, rows.spans, lead=LEAD_S)
        levels[rows.last] = last.levels[rows.counted]
    whole = anchored_derivatives(experiments, levels=levels)
    x, normal, settled = first.x * first.scale / whole.scale, first.normal, first.converged
    others: list[NDArray[np.float64]] = []
    evaluations = 0
    if len(rows.last):
        model = derivatives_of(last, experiments)
        slope = model.trusted_slope(x)
        taken = slope.used & (last.batch.weight > 0.0)
        moved, normal = _stepped(x, first, slope, taken, model)
        step = first.jacobian[:, first.used].T @ (moved - x)
        if step @ step > FARTHEST**2:
            return None
        std = _deviations(first.normal)
        others, evaluations = [x], model.evaluations
        if np.any(np.abs(moved - x)[whole.faults] > LONG * std[whole.faults]):
            names = (item.name for item in whole.estimated)
            start = dict(zip(names, (moved * whole.scale).tolist(), strict=True))
            width = FEW.width * (std * whole.scale)[whole.curved]
            found = refine(whole, start, width, pace=FEWER)
            others, moved, normal, settled = [], found.x, found.normal, found.converged
        x = moved
    width = FEW.width * _deviations(normal)[whole.curved]
    root = np.diag(np.minimum(width, SPREAD / whole.scale[whole.curved]))
    found, (cost, *before) = last_round(whole, Belief(x, root), settled, *others)
    if before and cost > before[0] + WORSE:
        found, _ = last_round(whole, Belief(others[0], root), settled)
    return replace(found, evaluations=evaluations + found.evaluations)


def _stepped(
    x: NDArray[np.float64],
    first: Refinement,
    slope: Slope,
    taken: NDArray[np.bool_],
    model: Derivatives,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the residuals of the last part lead to, and the information of both parts.

    taken: those that count, shape (signals, n).
    """
    before, now = first.jacobian[:, first.used], slope.jacobian[:, taken]
    stands, pulls = before @ first.residuals[first.used], now @ slope.residuals[taken]
    # At the optimum of the first part nothing pulls, but into a bound.
    at_bound = (x == model.lower) | (x == model.upper)
    normal = before @ before.T + now @ now.T + FREE * np.eye(len(x))
    gradient = np.where(at_bound, stands, 0.0) + pulls
    return bounded_step(x, normal, gradient, model.lower, model.upper), normal


def _deviations(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations of the estimates by their information."""
    return np.sqrt(np.diag(np.linalg.inv(normal + FREE * np.eye(len(normal)))))


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Where first and last parts stand among the ticks of all tests.

    spans: s, the last part of each test; none of one that ends too early.
    first, last: ticks of the whole tests.
    counted: the last parts among the ticks of their own batch, which have a run-in.
    """

    spans: list[list[tuple[float, float]]]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    counted: NDArray[np.int64]

    @classmethod
    def of(cls, experiments: Sequence[Experiment], ends: Sequence[int]) -> _Rows:
        """Rows of the tests one behind the other."""
        spans: list[list[tuple[float, float]]] = []
        first, last, counted = [], [], []
        begin = run = 0
        for item, until in zip(experiments, ends, strict=True):
            first.append(begin + np.arange(until))
            spans.append([])
            if item.ticks - until > 1:
                spans[-1].append((until * item.tick, item.ticks * item.tick))
                last.append(begin + np.arange(until, item.ticks))
                lead = min(round(LEAD_S / item.tick), until)
                counted.append(run + lead + np.arange(item.ticks - until))
                run += lead + item.ticks - until
            begin += item.ticks
        return cls(spans, *(np.concatenate([np.zeros(0, int), *p]) for p in (first, last, counted)))
