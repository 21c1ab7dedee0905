"""The last step of the refinement: what the end of a test adds to an optimum without it.

The optimum of the first part stands with its information, the normal matrix of its gaps; one
Gauss-Newton step on the gaps of the last part, weighed by the information of both, leads to the
optimum of the whole (a measurement update of the information filter). Where the last part is
small the step is a fraction of a deviation, over which derivatives hold; a longer one, or one that
does not lead down, is not taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.bounded_step import bounded_step
from ehadiag.identify.refine.first_part import Prefix, anchored, prefix_ticks
from ehadiag.identify.refine.least_squares import Refinement
from ehadiag.identify.refine.residual_model import CAP, FAULT_COUNT, GapModel, Slope, capped
from ehadiag.identify.search.stages import LEAD_S
from ehadiag.model.scalar.residuals import residuals, spool_rates, workspace

__all__ = ["add_last_part"]

FARTHEST = 3.0
"""Length of the step, in deviations of the first part, beyond which it is none of a small part."""
WORSE = 4.0
"""Cost by which the step may lead up: what break-aways make of a way down."""


def add_last_part(experiments: Sequence[Experiment], prefix: Prefix) -> Refinement | None:
    """Optimum on all of the tests, from that on their first parts; None where a step is not enough.

    `experiments`: with the noise as the prefix judged it.
    """
    whole, noise = anchored(experiments)
    first = prefix.refined
    scale = np.array([1.0, 1.0, 1.0, *noise])
    x = np.concatenate([first.values, first.offsets]) / scale
    rows = _Rows.of(experiments)
    jacobian = np.zeros((len(x), *whole.weight.shape))
    used = np.zeros(whole.weight.shape, dtype=np.bool_)
    jacobian[:, :, rows.first], used[:, rows.first] = first.jacobian, first.used
    gaps, work = np.empty(whole.weight.shape), workspace(whole)
    count, evaluations = residuals(whole, x * scale, work, gaps), 1
    if len(rows.last):
        model = GapModel(anchored(experiments, rows.spans, LEAD_S)[0], noise)
        slope = model.trusted_slope(x)
        taken = slope.used & (model.batch.weight > 0.0)
        moved = _stepped(x, first, slope, taken)
        step = first.jacobian[:, first.used].T @ (moved - x)
        if step @ step > FARTHEST**2:
            return None
        before = capped(gaps)
        x, count = moved, residuals(whole, moved * scale, work, gaps)
        if capped(gaps) > before + WORSE:
            return None
        evaluations += model.evaluations + 1
        jacobian[:, :, rows.last] = slope.jacobian[:, :, rows.counted]
        used[:, rows.last] = taken[:, rows.counted]
    rates = np.empty(len(whole.current))
    spool_rates(whole, x * scale, work, rates)
    used &= gaps**2 < CAP
    return replace(
        first,
        values=x[:FAULT_COUNT],
        offsets=x[FAULT_COUNT:] * scale[FAULT_COUNT:],
        cost=capped(gaps),
        gaps=gaps,
        jacobian=np.where(used, jacobian, 0.0),
        spool_rate=rates * whole.weight[0],
        used=used,
        weighted=whole.weight > 0.0,
        evaluations=evaluations,
        anchored=count,
    )


def _stepped(
    x: NDArray[np.float64], first: Refinement, slope: Slope, taken: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Where the gaps of the last part lead to; `taken`: those that count, shape (2, n)."""
    before, now = first.jacobian[:, first.used], slope.jacobian[:, taken]
    stands, pulls = before @ first.gaps[first.used], now @ slope.gaps[taken]
    # At the optimum of the first part nothing pulls, but into a bound.
    bound = np.zeros(len(x), dtype=np.bool_)
    bound[:FAULT_COUNT] = (x[:FAULT_COUNT] == 0.0) | (x[:FAULT_COUNT] == 1.0)
    normal = before @ before.T + now @ now.T + 1e-12 * np.eye(len(x))
    return bounded_step(x, normal, np.where(bound, stands, 0.0) + pulls)


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
    def of(cls, experiments: Sequence[Experiment]) -> _Rows:
        """Rows of the tests one behind the other."""
        spans: list[list[tuple[float, float]]] = []
        first, last, counted = [], [], []
        begin = run = 0
        for item in experiments:
            until = prefix_ticks(item)
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
