"""Judgement of an optimum on board: what explains it, what is held but not certain, the result."""

from __future__ import annotations

import math

from ehadiag.compile.elementary import logarithm
from ehadiag.compile.jit import Array, bare_kernel, inlined_exact
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.core.estimation_rules import ESTIMATION
from ehadiag.identify.linearisation import DIFFERENCES
from ehadiag.model.plant import PLANT_FIELDS
from ehadiag.model.simd_layout import ROWS
from ehadiag.monitor.monitor_memory import (
    MODEL,
    MONITOR,
    MONITOR_SIZE,
)
from ehadiag.onboard.onboard_memory import (
    MATRIX_SIZE,
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_MODELS,
    ONBOARD_PARAMETERS,
    ONBOARD_PLAN_SIZE,
    ONBOARD_RUNS,
    PHASES,
    PLAN_DIRECTIONS,
    PROGRESS,
    OnboardOutcome,
    keep_outcome,
    verdict_rules_of,
)
from ehadiag.onboard.onboard_recording import (
    EARLIER,
    LAST,
    OUTLIERS,
    SAMPLES,
    SQUARES,
    channel_sums_at,
    clear_channels,
)
from ehadiag.onboard.onboard_refinement import (
    ROUNDS,
    start_round,
)
from ehadiag.onboard.onboard_search import (
    PLAN_PRESSURE_WEIGHT,
    PLAN_SPOOL_WEIGHT,
    SEARCH,
    clear_histograms,
    count_residual,
    fitted_lines,
    loosen_anchor,
    parameters_at,
    set_density,
    shown_noise,
    start_model_by,
)
from ehadiag.onboard.onboard_verdict import (
    square_at,
    write_deviations,
    write_verdict,
)

SPOOL_VELOCITY_PLACE = ONBOARD.monitors + MODEL.state + ROWS.spool_rate


@inlined_exact
def _spread_scores(scores: Array, meat: Array, k: int) -> None:
    """Add a tick's pull to the gradient's covariance, and keep it for the ticks to come."""
    now = k % (ESTIMATION.correlation_lags + 1)
    for lag in range(min(k, ESTIMATION.correlation_lags) + 1):
        weight = 1.0 - lag / (ESTIMATION.correlation_lags + 1.0)
        then = (k - lag) % (ESTIMATION.correlation_lags + 1)
        for i in range(ONBOARD_PARAMETERS):
            for j in range(ONBOARD_PARAMETERS):
                product = scores[now, i] * scores[then, j]
                if lag > 0:
                    product += scores[now, j] * scores[then, i]
                meat[i, j] += weight * product


DIRECTIONS_OF_PASS = ONBOARD_MODELS - 1 - ONBOARD_GENES
"""Directions in which a pass has models off, 1."""
MAX_STEP = 0.1
"""Largest step along a severity in such a pass, 1: a test shows no severity that is less certain.
"""
MAX_DIRECTION_CHANGE = 3.0
"""Change of a residual by a direction, in deviations, from which on it is a break-away, 1: three
times what a considered parameter of the package may have, since a calibration's directions are
larger than those."""
ATTEMPTS = 1.0 + len(SEARCH.stds)
"""Searches that there are, 1: the first approximation, then the genetic ones."""
ANCHORED_PLACE = ONBOARD.monitors + MODEL.state + ROWS.anchor_count
USED_SQUARES, USED = ONBOARD.sums, ONBOARD.sums + 1
"""Sums of the last pass: squares of residuals that the deviations go by, and how many they are."""


@bare_kernel
def start_conclusion(address: int, plan_address: int, plan: Array) -> None:
    """Prepare the models about an optimum, to judge it."""
    p = array_at(address, (ONBOARD.end,))
    start_round(address, plan_address, plan)
    for i in range(MATRIX_SIZE):
        p[ONBOARD.meat + i] = 0.0
    clear_channels(channel_sums_at(address))
    clear_histograms(p)


@bare_kernel
def add_evidence(address: int, plan: Array, ticks: Array, k: int) -> None:
    """Add a tick, to which the models are advanced, to what judges an optimum."""
    p, sums = array_at(address, (ONBOARD.end,)), channel_sums_at(address)
    normal = square_at(address, ONBOARD.normal)
    shift = parameters_at(address, ONBOARD.normal + MATRIX_SIZE)
    slope = parameters_at(address, ONBOARD.slope)
    along = array_at(address + BYTES_PER_NUMBER * ONBOARD.along, (ONBOARD_GENES, 3))
    scores = array_at(
        address + BYTES_PER_NUMBER * ONBOARD.scores,
        (ESTIMATION.correlation_lags + 1, ONBOARD_PARAMETERS),
    )
    now = k % (ESTIMATION.correlation_lags + 1)
    for i in range(ONBOARD_PARAMETERS):
        scores[now, i] = 0.0
    for c in range(2):
        raw = p[ONBOARD.monitors + MONITOR.residual + c]
        count_residual(p, c, raw, sums[c, LAST], sums[c, EARLIER])
        sums[c, EARLIER], sums[c, LAST] = sums[c, LAST], raw
        if not math.isfinite(raw) or not math.isfinite(ticks[k, 2 + c]):
            continue
        _, scatter = fitted_lines(p, c, along, slope)
        r = raw / p[ONBOARD.noise + c]
        sums[c, SQUARES] += min(r * r, ESTIMATION.residual_cap)
        sums[c, SAMPLES] += 1.0
        if r * r >= ESTIMATION.residual_cap:
            sums[c, OUTLIERS] += 1.0
            continue
        if scatter >= ESTIMATION.max_row_scatter:
            continue
        p[USED_SQUARES] += r * r
        p[USED] += 1.0
        lead = (
            ESTIMATION.sampling_lead_std
            * p[SPOOL_VELOCITY_PLACE]
            * plan[PLAN_SPOOL_WEIGHT]
            / p[ONBOARD.noise]
            if c == 0
            else 0.0
        )
        for i in range(ONBOARD_PARAMETERS):
            scores[now, i] += slope[i] * r
            shift[i] += slope[i] * lead
            for j in range(ONBOARD_PARAMETERS):
                normal[i, j] += slope[i] * slope[j]
    _spread_scores(scores, square_at(address, ONBOARD.meat), k)


@inlined_exact
def _noise_changes(p: Array, judged: float) -> bool:
    """Take the noise that the residuals show where it is another; whether to refine again."""
    changed = False
    for c in range(2):
        off = abs(shown_noise(p, c) - p[ONBOARD.noise + c])
        changed = changed or off > ESTIMATION.noise_tolerance * p[ONBOARD.noise + c]
    changed = changed and judged < ESTIMATION.max_noise_judgements
    for c in range(2 if changed else 0):
        p[ONBOARD.noise + c] = shown_noise(p, c)
    return changed


@inlined_exact
def _keeps_best(address: int) -> bool:
    """Keep an optimum that is the best so far, by its score; whether it is."""
    p, sums, point = (
        array_at(address, (ONBOARD.end,)),
        channel_sums_at(address),
        parameters_at(address, ONBOARD.point),
    )
    score = sums[0, SQUARES] + sums[1, SQUARES]
    for c in range(2):
        score += 2.0 * sums[c, SAMPLES] * logarithm(p[ONBOARD.noise + c])
    if not score < p[PROGRESS.score]:
        return False
    p[PROGRESS.score] = score
    for i in range(ONBOARD_PARAMETERS):
        p[ONBOARD.kept + i] = point[i]
    for c in range(2):
        p[ONBOARD.kept + ONBOARD_PARAMETERS + c] = p[ONBOARD.noise + c]
    p[ONBOARD.kept + ONBOARD_PARAMETERS + 2] = p[PROGRESS.settled]
    return True


@inlined_exact
def _take_best(address: int) -> None:
    """Go back to the best optimum so far."""
    p, point = array_at(address, (ONBOARD.end,)), parameters_at(address, ONBOARD.point)
    for i in range(ONBOARD_PARAMETERS):
        point[i] = p[ONBOARD.kept + i]
    for c in range(2):
        p[ONBOARD.noise + c] = p[ONBOARD.kept + ONBOARD_PARAMETERS + c]
    p[PROGRESS.settled] = p[ONBOARD.kept + ONBOARD_PARAMETERS + 2]
    set_density(p, ESTIMATION.refined_std)


@bare_kernel
def end_conclusion(address: int, plan: Array) -> float:
    """Judge an optimum; the phase that follows.

    The noise is another: refine again. The recording is not explained: search wider, as long as
    there is an attempt left; then the best optimum is the result.
    """
    p, sums = array_at(address, (ONBOARD.end,)), channel_sums_at(address)
    rules, point = verdict_rules_of(plan), parameters_at(address, ONBOARD.point)
    attempts = p[PROGRESS.attempts]
    p[PROGRESS.judged] += 1.0
    if attempts <= ATTEMPTS and _noise_changes(p, p[PROGRESS.judged]):
        set_density(p, ESTIMATION.refined_std)
        return PHASES.refinement
    samples = sums[0, SAMPLES] + sums[1, SAMPLES]
    cost, outliers = sums[0, SQUARES] + sums[1, SQUARES], sums[0, OUTLIERS] + sums[1, OUTLIERS]
    explained = (
        outliers <= rules.search_outliers * samples and p[ANCHORED_PLACE] <= rules.most_anchored
    )
    if attempts <= ATTEMPTS and not explained:
        best = _keeps_best(address)
        p[PROGRESS.judged] = 0.0
        p[PROGRESS.attempts] += 1.0
        if attempts < ATTEMPTS:
            return PHASES.search
        if not best:
            _take_best(address)
            return PHASES.conclusion
    keep_outcome(
        p,
        OnboardOutcome(
            point[0], point[1], point[2], 0.0, 0.0, 0.0,
            point[3] / plan[PLAN_SPOOL_WEIGHT], point[4] / plan[PLAN_PRESSURE_WEIGHT],
            0.0, 0.0, cost, samples, outliers / max(samples, 1.0),
            math.sqrt(sums[0, SQUARES] / max(sums[0, SAMPLES], 1.0)),
            math.sqrt(sums[1, SQUARES] / max(sums[1, SAMPLES], 1.0)),
            p[ONBOARD_RUNS], p[PROGRESS.settled],
        ),
    )  # fmt: skip
    return PHASES.considered


@inlined_exact
def direction_count(plan: Array) -> int:
    """Directions in which what is held may be off."""
    return int(plan[PLAN_DIRECTIONS])


@bare_kernel
def start_directions(address: int, plan_address: int, plan: Array, done: int) -> None:
    """Prepare models at the optimum, beside it along each severity, and with what is held off.

    done: passes, of DIRECTIONS_OF_PASS directions each.
    """
    p, trial = array_at(address, (ONBOARD.end,)), parameters_at(address, ONBOARD.trial)
    step = array_at(address + BYTES_PER_NUMBER * ONBOARD.along, (ONBOARD_GENES,))
    for lane in range(ONBOARD_MODELS):
        for i in range(ONBOARD_PARAMETERS):
            trial[i] = p[ONBOARD.point + i]
        constants = plan_address
        if 0 < lane <= ONBOARD_GENES:
            i = lane - 1
            width = min(math.sqrt(ROUNDS.width * p[ONBOARD.believed + i]), MAX_STEP)
            step[i] = width if trial[i] + width <= 1.0 else -width
            trial[i] += step[i]
        direction = done * DIRECTIONS_OF_PASS + lane - 1 - ONBOARD_GENES
        if lane > ONBOARD_GENES and direction < direction_count(plan):
            constants += BYTES_PER_NUMBER * (ONBOARD_PLAN_SIZE + direction * PLANT_FIELDS)
            for i in range(ONBOARD_PARAMETERS):
                p[ONBOARD.considered + direction * ONBOARD_PARAMETERS + i] = 0.0
        start_model_by(address, constants, plan_address, plan, lane, trial)
        loosen_anchor(address, lane, p[ONBOARD.noise])


@bare_kernel
def add_directions(address: int, plan: Array, done: int) -> None:
    """Add a tick, to which the models are advanced, to the shifts of the gradient."""
    p, slope = array_at(address, (ONBOARD.end,)), parameters_at(address, ONBOARD.slope)
    first = done * DIRECTIONS_OF_PASS
    for c in range(2):
        at, noise = ONBOARD.monitors + MONITOR.residual + c, p[ONBOARD.noise + c]
        middle = p[at] / noise
        smooth = math.isfinite(middle) and middle * middle < ESTIMATION.residual_cap
        for i in range(ONBOARD_GENES):
            change = p[at + (1 + i) * MONITOR_SIZE] / noise - middle
            smooth = smooth and abs(change) < DIFFERENCES.max_considered
            slope[i] = change / p[ONBOARD.along + i]
        slope[ONBOARD_GENES] = slope[ONBOARD_GENES + 1] = 0.0
        slope[ONBOARD_GENES + c] = -1.0 / noise
        if not smooth:
            continue
        for k in range(min(DIRECTIONS_OF_PASS, direction_count(plan) - first)):
            change = p[at + (1 + ONBOARD_GENES + k) * MONITOR_SIZE] / noise - middle
            if not abs(change) < MAX_DIRECTION_CHANGE:
                continue
            for i in range(ONBOARD_PARAMETERS):
                place = ONBOARD.considered + (first + k) * ONBOARD_PARAMETERS + i
                p[place] += slope[i] * change


@bare_kernel
def write_result(address: int, plan: Array) -> None:
    """Write deviations and verdict."""
    p = array_at(address, (ONBOARD.end,))
    write_deviations(
        address, plan, direction_count(plan), p[USED_SQUARES] / max(p[USED] - ONBOARD_PARAMETERS, 1)
    )
    write_verdict(address, plan)
