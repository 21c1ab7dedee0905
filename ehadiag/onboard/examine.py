"""A last pass at the optimum: how well it explains the recording, and what follows from that.

What the refinement of the package leaves to `ehadiag.identify.refine.least_squares.described`,
`ehadiag.identify.uncertainty` and `ehadiag.assess.acceptance`, in one pass and fixed memory.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.identify.refine.derivatives import CAP
from ehadiag.identify.refine.first_part import AGAIN, JUDGEMENTS, NOISE_SETTLED
from ehadiag.identify.refine.least_squares import CLEAR
from ehadiag.monitor.layout import MOVING, NUMBER, RESIDUAL, Moving
from ehadiag.onboard.conclude import deviate, judge
from ehadiag.onboard.layout import (
    BELIEF,
    DONE,
    GENES,
    LAGS,
    LANES,
    MONITORS,
    NOISE,
    NORMAL,
    PARAMETERS,
    POINT,
    REFINEMENT,
    RUNS,
    SCORES,
    SCRATCH,
    SIZE,
    TRIAL,
    Advance,
    Outcome,
    advance_of,
    keep_advance,
    keep_outcome,
)
from ehadiag.onboard.noise import clear_histograms, count_residual, shown_noise
from ehadiag.onboard.plausible import carries_verdict
from ehadiag.onboard.rules import rules_of
from ehadiag.onboard.run import (
    PRESSURE_WEIGHT,
    SPOOL_WEIGHT,
    lines,
    push_lanes,
    start_cross,
    vector_at,
)

__all__ = ["examine"]

Array = NDArray[np.float64]
SQUARE = PARAMETERS * PARAMETERS
VELOCITY = LANES + MOVING + Moving._fields.index("vs")
LEAD_STD = 0.15e-6
"""s: what is not known of the instant of sampling, see `CONSIDERED` of the package."""


@inlined_exact
def _spread_scores(scores: Array, meat: Array, k: int) -> None:
    """Add a tick's pull to the gradient's covariance, and keep it for the ticks to come."""
    now = k % (LAGS + 1)
    for lag in range(min(k, LAGS) + 1):
        weight = 1.0 - lag / (LAGS + 1.0)
        then = (k - lag) % (LAGS + 1)
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                product = scores[now, i] * scores[then, j]
                if lag > 0:
                    product += scores[now, j] * scores[then, i]
                meat[i, j] += weight * product


@brief_kernel
def examine(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """Run the models at the optimum; conclude, or refine again by the noise that they show."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    a, rules = advance_of(p), rules_of(plan)
    point = vector_at(address, POINT)
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    shift = vector_at(address, NORMAL + SQUARE)
    slope = vector_at(address, SCRATCH)
    along = array_at(address + NUMBER * (SCRATCH + PARAMETERS), (GENES, 3))
    meat = array_at(address + NUMBER * (SCRATCH + 2 * SQUARE), (PARAMETERS, PARAMETERS))
    last = array_at(address + NUMBER * (SCRATCH + 3 * SQUARE), (7, 2))
    scores = array_at(address + NUMBER * SCORES, (LAGS + 1, PARAMETERS))
    for i in range(SQUARE + PARAMETERS):
        p[NORMAL + i] = 0.0
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            meat[i, j] = 0.0
    # Residuals before, the ones before those, capped squares, samples, gap, longest gap, beyond.
    for c in range(2):
        last[0, c] = last[1, c] = math.nan
        last[2, c] = last[3, c] = last[4, c] = last[5, c] = last[6, c] = 0.0
    clear_histograms(p)
    start_cross(address, plan_address, plan, point, vector_at(address, TRIAL), along)
    squares, used = 0.0, 0.0
    for k in range(count):
        push_lanes(address, (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]))
        now = k % (LAGS + 1)
        for i in range(PARAMETERS):
            scores[now, i] = 0.0
        for c in range(2):
            raw = p[LANES + RESIDUAL + c]
            count_residual(p, c, raw, last[0, c], last[1, c])
            last[1, c], last[0, c] = last[0, c], raw
            last[4, c] = 0.0 if math.isfinite(raw) else last[4, c] + 1.0
            last[5, c] = max(last[5, c], last[4, c])
            if not math.isfinite(raw):
                continue
            _, scatter = lines(p, c, along, slope)
            r = raw / p[NOISE + c]
            last[2, c] += min(r * r, CAP)
            last[3, c] += 1.0
            if r * r >= CAP:
                last[6, c] += 1.0
                continue
            if scatter >= CLEAR:
                continue
            squares += r * r
            used += 1.0
            lead = LEAD_STD * p[VELOCITY] * plan[SPOOL_WEIGHT] / p[NOISE] if c == 0 else 0.0
            for i in range(PARAMETERS):
                scores[now, i] += slope[i] * r
                shift[i] += slope[i] * lead
                for j in range(PARAMETERS):
                    normal[i, j] += slope[i] * slope[j]
        _spread_scores(scores, meat, k)
    p[RUNS] += float(MONITORS)
    judged, changed = a.judged + 1.0, False
    for c in range(2):
        shown = shown_noise(p, c)
        changed = changed or abs(shown - p[NOISE + c]) > NOISE_SETTLED * p[NOISE + c]
        last[0, c] = shown
    if changed and judged < JUDGEMENTS:
        for c in range(2):
            p[NOISE + c] = last[0, c]
        for i in range(GENES):
            for j in range(GENES):
                p[BELIEF + i * GENES + j] = AGAIN if i == j else 0.0
        keep_advance(p, Advance(REFINEMENT, 0.0, a.best, judged, a.settled))
        return
    samples, most = last[3, 0] + last[3, 1], (1.0 - rules.most_lost) * count
    keep_outcome(
        p,
        Outcome(
            point[0], point[1], point[2], 0.0, 0.0, 0.0,
            point[3] / plan[SPOOL_WEIGHT], point[4] / plan[PRESSURE_WEIGHT],
            0.0, last[2, 0] + last[2, 1], samples, (last[6, 0] + last[6, 1]) / max(samples, 1.0),
            math.sqrt(last[2, 0] / max(last[3, 0], 1.0)),
            math.sqrt(last[2, 1] / max(last[3, 1], 1.0)),
            p[RUNS], a.settled,
        ),
    )  # fmt: skip
    deviate(address, normal, meat, shift, squares / max(used - PARAMETERS, 1.0))
    complete = min(last[3, 0], last[3, 1]) >= most
    complete = complete and max(last[5, 0], last[5, 1]) <= rules.longest_gap
    judge(address, plan, complete and carries_verdict(address, plan, ticks, count))
    keep_advance(p, Advance(DONE, a.steps, a.best, judged, a.settled))
