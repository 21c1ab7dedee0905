"""Judgement of an optimum on board: what explains it, what is held but not certain, deviations,
verdict, the result.
"""

from __future__ import annotations

import math
from typing import Final

from ehadiag.compile.elementary import exponential, logarithm, normal_cdf
from ehadiag.compile.jit import Array, bare_kernel, inlined_exact, merged
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.core.conventions import FRICTION_NAME
from ehadiag.core.criteria import BREAK_AWAYS, ESTIMATION, FIT, NORMAL_HALF_WIDTH_95
from ehadiag.identify.linearisation import DIFFERENCES
from ehadiag.model.plant import PLANT_FIELDS
from ehadiag.model.severities import FAULT_CHANGES, FAULT_LAWS
from ehadiag.model.simd_layout import ROWS
from ehadiag.monitor.monitor_memory import (
    MODEL,
    MONITOR,
    MONITOR_SIZE,
)
from ehadiag.onboard.onboard_memory import (
    CORRELATED_TICKS,
    DIRECTIONS_OF_PASS,
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_MODELS,
    ONBOARD_PARAMETERS,
    ONBOARD_PLAN_SIZE,
    ONBOARD_RUNS,
    ONBOARD_UNKNOWNS,
    ONBOARD_VERDICT,
    PHASES,
    PLAN_DIRECTIONS,
    PROGRESS,
    REASONS,
    UNIT_VISCOSITY,
    UNKNOWNS_MATRIX_SIZE,
    OnboardOutcome,
    VerdictRules,
    keep_outcome,
    outcome_of,
    verdict_rules_of,
)
from ehadiag.onboard.onboard_recording import (
    EARLIER,
    LAST,
    OUTLIERS,
    REST,
    SAMPLES,
    SQUARES,
    channel_sums_at,
    clear_channels,
)
from ehadiag.onboard.onboard_refinement import (
    ROUNDS,
    inverse_column,
    onboard_bounded_step,
    start_round,
)
from ehadiag.onboard.onboard_search import (
    FDJ,
    FSS,
    KINTAS,
    LARGEST_SECOND_DIFFERENCE,
    PLAN_PRESSURE_WEIGHT,
    PLAN_SPOOL_WEIGHT,
    clear_histograms,
    count_residual,
    fitted_lines,
    identified_constants,
    loosen_anchor,
    parameters_at,
    set_density,
    shown_excess,
    shown_noise,
    start_model,
    start_model_by,
    unknowns_at,
)

NOT_TESTED: Final = 30.0


@bare_kernel
def write_deviations(address: int, plan: Array, unknowns: int, reduced: float) -> int:
    """Write the deviations of the severities, see `ehadiag.identify.estimates.estimate_covariance`.

    Of the memory, its normal matrix (the uniform prior is added to it) with the shift of the
    gradient by the instant of sampling, the gradient's covariance, the variances that the search
    has left, and what directions shift; unknowns: of the matrices; reduced: mean square of the
    residuals that count. Returns 0, or 1 where there is no inverse and the deviations are those of
    a uniform density.
    """
    p, rules = array_at(address, (ONBOARD.end,)), verdict_rules_of(plan)
    matrix, normal, meat = (
        square_at(address, ONBOARD.scratch, unknowns),
        square_at(address, ONBOARD.normal, unknowns),
        square_at(address, ONBOARD.meat, unknowns),
    )
    column = array_at(
        address + BYTES_PER_NUMBER * (ONBOARD.scratch + UNKNOWNS_MATRIX_SIZE), (unknowns,)
    )
    failed = 0
    for i in range(ONBOARD_GENES):
        normal[i, i] += 1.0 / ESTIMATION.uniform_std**2
    for i in range(ONBOARD_GENES):
        variance = inverse_column(normal, i, matrix, column)
        if not variance > 0.0:
            failed = 1
            p[ONBOARD_GENES + i] = ESTIMATION.uniform_std
            continue
        sandwich, moved = 0.0, 0.0
        for j in range(unknowns):
            for k in range(unknowns):
                sandwich += column[j] * meat[j, k] * column[k]
            moved += column[j] * p[ONBOARD.normal + unknowns * unknowns + j]
        considered = moved * moved + p[ONBOARD.considered + i]
        discrepancy = rules.discrepancy_Kintas
        if i == FSS:
            discrepancy = rules.discrepancy_FSS
            if p[BREAK_AWAY_PLACE] > EVENT_COST:
                considered += AMBIGUOUS_FRICTION_STD**2
        elif i == FDJ:
            discrepancy = rules.discrepancy_FDJ
        variance *= max(reduced / ESTIMATION.capped_variance, 1.0)
        variance = max(variance, sandwich, p[ONBOARD.believed + i])
        p[ONBOARD_GENES + i] = math.sqrt(
            variance + considered + ESTIMATION.discrepancy_std**2 + discrepancy * discrepancy
        )
    return failed


@merged
def scores_at(address: int) -> Array:
    """Return the pulls of the last ticks, the latest first."""
    return array_at(
        address + BYTES_PER_NUMBER * ONBOARD.scores, (CORRELATED_TICKS, ONBOARD_UNKNOWNS)
    )


@merged
def square_at(address: int, place: int, rows: int) -> Array:
    """Return a square matrix, from a place of the memory on."""
    return array_at(address + BYTES_PER_NUMBER * place, (rows, rows))


@bare_kernel
def write_verdict(address: int, plan: Array) -> int:
    """Write the verdict, see `ehadiag.assess.verdict.judge`; numbers of none are not believed.

    The deviations get what laws of the faults and a range of exponents do to them.
    """
    p, rules = array_at(address, (ONBOARD.end,)), verdict_rules_of(plan)
    o = outcome_of(p)
    above, at_limit, hidden = 0.0, False, False
    for i in range(ONBOARD_GENES):
        hidden = hidden or not p[ONBOARD_GENES + i] < rules.most_std
    excess = _doubt_laws(p, channel_sums_at(address), rules)
    friction, blind = CERTAIN, False
    if rules.exponents > 0.0:
        friction = _over_exponents(p, rules)
        blind = friction == LIKELY_FAULT
    for i in range(ONBOARD_GENES):
        std = p[ONBOARD_GENES + i]
        if i != FSS or friction == CERTAIN:
            chance = onboard_chance_above(p[i], std, rules.limit)
            at_limit = at_limit or chance >= rules.fault_chance
        above += onboard_chance_above(p[i], std, rules.advisory)
        low, high = p[i] - NORMAL_HALF_WIDTH_95 * std, p[i] + NORMAL_HALF_WIDTH_95 * std
        blind = blind or (low < rules.advisory and high > rules.limit)
    reasons = 0.0
    explained = _is_explained(o.outliers, o.spool_rms, o.pressure_rms, rules)
    if not (explained and excess <= rules.most_excess):
        reasons += REASONS.unexplained
    if hidden:
        reasons += REASONS.hidden
    if blind and not at_limit:
        reasons += REASONS.wide
    if reasons > 0.0:
        return refuse_verdict(address, reasons)
    p[ONBOARD_VERDICT] = 20.0 if at_limit else (10.0 if above > rules.false_healthy else 0.0)
    return 0


CERTAIN, UNLIKELY_FAULT, LIKELY_FAULT = range(3)
"""Whether friction is a fault: the same with each exponent; with fewer than half of them; not."""


@inlined_exact
def _doubt_laws(p: Array, sums: Array, rules: VerdictRules) -> float:
    """Widen the deviations, see `ehadiag.identify.prior.UnitPrior.discrepancy_covariance`.

    Returns the excess of the residuals over noise.
    """
    excess = max(shown_excess(p, 0, sums[0, REST]), shown_excess(p, 1, sums[1, REST]), 1.0)
    more = 1.0 + math.sqrt(excess - 1.0)
    clogging, friction = p[KINTAS], p[FSS]
    for i in range(ONBOARD_GENES):
        doubt = rules.law_Kintas * math.sqrt(clogging * clogging + friction * friction)
        if i == FSS:
            doubt = rules.law_FSS * friction
        elif i == FDJ:
            doubt = rules.law_FDJ * p[FDJ]
        if doubt != 0.0:
            std = p[ONBOARD_GENES + i]
            p[ONBOARD_GENES + i] = math.sqrt(std * std + more * doubt * more * doubt)
    return excess


@inlined_exact
def _over_exponents(p: Array, rules: VerdictRules) -> int:
    """Write the friction of all exponents, see `ehadiag.identify.estimates.over_exponents`.

    Returns whether it is a fault.
    """
    new = rules.friction_new / (1.0 - rules.friction_new)
    least = min(max(p[FSS], 0.0), 1.0)
    shown, half = least + new, NORMAL_HALF_WIDTH_95 * p[ONBOARD_GENES + FSS]
    share = logarithm(1.0 + FAULT_CHANGES[KINTAS] * p[KINTAS])
    ratio = exponential(-rules.exponents * share)
    middle = min(shown * exponential(-0.5 * rules.exponents * share) - new, 1.0)
    most = min(shown * ratio - new, 1.0)
    bottom, top = least - half, min(most + half * ratio, max(least + half, 1.0))
    p[FSS], p[ONBOARD_GENES + FSS] = (
        (bottom + top) / 2.0, (top - bottom) / 2.0 / NORMAL_HALF_WIDTH_95
    )  # fmt: skip
    std, wider = p[ONBOARD_GENES + KINTAS], rules.first_stage * most
    p[ONBOARD_GENES + KINTAS] = math.sqrt(std * std + wider * wider)
    if least >= rules.limit or most < rules.limit:
        return CERTAIN
    return LIKELY_FAULT if middle >= rules.limit else UNLIKELY_FAULT


ESTIMATES: Final = OnboardOutcome._fields.index("verdict")
"""Numbers of an outcome that are estimates, the first ones, 1."""
ONBOARD_REASONS: Final = OnboardOutcome._fields.index("reasons")


@inlined_exact
def refuse_verdict(address: int, reasons: float) -> int:
    """Write NOT TESTED, and no number as an estimate."""
    p = array_at(address, (ONBOARD.end,))
    for i in range(ESTIMATES):
        p[i] = math.nan
    p[ONBOARD_VERDICT], p[ONBOARD_REASONS] = NOT_TESTED, reasons
    return 0


@inlined_exact
def _is_explained(outliers: float, spool: float, pressure: float, rules: VerdictRules) -> bool:
    """Whether the model explains the recording; a NaN is none."""
    return bool(
        outliers <= rules.most_outliers and spool <= rules.most_rms and pressure <= rules.most_rms
    )


@inlined_exact
def onboard_chance_above(value: float, std: float, level: float) -> float:
    """Chance that a severity is at or above a level: of a normal density within 0 … 1."""
    if not std > 0.0:
        return 1.0 if value >= level else 0.0
    low = normal_cdf(-value / std)
    at = normal_cdf((level - value) / std)
    high = normal_cdf((1.0 - value) / std)
    if high > low:
        return (high - at) / (high - low)
    return 1.0 if value >= level else 0.0


AMBIGUOUS_FRICTION_STD = FAULT_LAWS[FRICTION_NAME].ambiguous_std
EVENT_COST = BREAK_AWAYS.event_cost
BREAK_AWAY_COSTS_PLACE = ONBOARD.moved + DIRECTIONS_OF_PASS * ONBOARD_GENES
BREAK_AWAY_PLACE = ONBOARD.considered + ONBOARD_GENES
SPOOL_VELOCITY_PLACE = ONBOARD.monitors + MODEL.state + ROWS.spool_rate


@inlined_exact
def _begin_scores(scores: Array) -> None:
    """Keep the pulls of the last ticks, and begin with none of this one."""
    for i in range(scores.shape[1]):
        for lag in range(CORRELATED_TICKS - 1, 0, -1):
            scores[lag, i] = scores[lag - 1, i]
        scores[0, i] = 0.0


@inlined_exact
def _spread_scores(scores: Array, meat: Array, total: Array) -> None:
    """Add the pulls of the last ticks to the gradient's covariance; total: scratch.

    Sums over so many ticks weigh pulls that are some ticks apart as
    `ehadiag.identify.estimates.estimate_covariance` does.
    """
    for i in range(scores.shape[1]):
        total[i] = 0.0
        for lag in range(CORRELATED_TICKS):
            total[i] += scores[lag, i]
        for j in range(i + 1):
            meat[i, j] += total[i] * total[j] / CORRELATED_TICKS
            meat[j, i] = meat[i, j]


MIN_VARIANCE = 1e-12
"""Least variance of a severity by which a step goes, 1: where its column has no inverse."""
MAX_STEP = 0.1
"""Largest step along a severity in such a pass, 1: a test shows no severity that is less certain.
"""
MAX_DIRECTION_CHANGE = 3.0
"""Change of a residual by a direction, in deviations, from which on it is a break-away, 1: a
calibration's directions are larger than what the package considers, 0.3 for an eighth of a
deviation. Where one comes at another tick with a direction that is off, no line shows what that
does: the optimum is in another dip, and the friction as doubtful as in the package there."""
MAX_DAY = 20.0
"""Largest viscosity and supply by the sensors of a calibrated unit, in deviations, 1: there is some
viscosity left."""
MAX_ROUNDING = math.sqrt(3.0)
"""Largest one by the bus's steps, in deviations, 1: half a step. A break-away may ask for more."""
DAY_MODELS = 1 + ONBOARD_GENES + ONBOARD_UNKNOWNS - ONBOARD_PARAMETERS
"""Models of a step of the day: at the point, and one for each unknown but the offsets."""
NEAR_OUTLIERS = FIT.max_outliers_near
"""Largest share of outliers at which residuals show the noise, 1."""
ATTEMPTS = 3.0
"""Attempts that there are, 1: from the first approximation, over the usual sizes about where that
leads, and from the genetic search."""
ANCHORED_PLACE = ONBOARD.monitors + MODEL.state + ROWS.anchor_count
USED_SQUARES, USED, UNEXPLAINED, UNEXPLAINED_SQUARES, _, LAWS, _ = range(
    ONBOARD.sums, ONBOARD.sums + 7
)
"""Sums of the last pass: squares of residuals that the deviations go by, and how many they are;
residuals beyond three deviations of noise and of the faults' laws, and of spool and pressure capped
squares in such deviations and the latest variance by the laws."""


@bare_kernel
def start_conclusion(address: int, plan_address: int, plan: Array) -> None:
    """Prepare the models about an optimum, to judge it."""
    p = array_at(address, (ONBOARD.end,))
    start_round(address, plan_address, plan)
    clear_channels(channel_sums_at(address))
    clear_histograms(p)


@bare_kernel
def add_evidence(address: int, plan: Array, ticks: Array, k: int) -> None:
    """Add a tick, to which the models are advanced, to what judges an optimum."""
    p, sums = array_at(address, (ONBOARD.end,)), channel_sums_at(address)
    rules = verdict_rules_of(plan)
    slope = parameters_at(address, ONBOARD.slope)
    along = array_at(address + BYTES_PER_NUMBER * ONBOARD.along, (ONBOARD_GENES, 3))
    for c in range(2):
        raw = p[ONBOARD.monitors + MONITOR.residual + c]
        count_residual(p, c, raw, sums[c, LAST], sums[c, EARLIER])
        second = abs(raw - 2.0 * sums[c, LAST] + sums[c, EARLIER])
        if math.isfinite(second):
            sums[c, REST] += min(second, LARGEST_SECOND_DIFFERENCE)
        sums[c, EARLIER], sums[c, LAST] = sums[c, LAST], raw
        if not math.isfinite(raw) or not math.isfinite(ticks[k, 2 + c]):
            continue
        _, scatter = fitted_lines(p, c, along, slope)
        r = raw / p[ONBOARD.noise + c]
        if r * r < ESTIMATION.residual_cap and scatter < ESTIMATION.max_row_scatter:
            p[LAWS + c] = (
                (rules.law_Kintas * p[ONBOARD.point + KINTAS] * slope[KINTAS]) ** 2
                + (rules.law_FSS * (p[ONBOARD.point + FSS] - rules.friction_new) * slope[FSS]) ** 2
                + (rules.law_FDJ * p[ONBOARD.point + FDJ] * slope[FDJ]) ** 2
            )
        share = r * r / (1.0 + p[LAWS + c])
        p[UNEXPLAINED_SQUARES + c] += min(share, ESTIMATION.residual_cap)
        if share >= ESTIMATION.residual_cap:
            p[UNEXPLAINED] += 1.0
        sums[c, SQUARES] += min(r * r, ESTIMATION.residual_cap)
        sums[c, SAMPLES] += 1.0
        if r * r >= ESTIMATION.residual_cap:
            sums[c, OUTLIERS] += 1.0
            continue
        if scatter >= ESTIMATION.max_row_scatter:
            continue
        p[USED_SQUARES] += r * r
        p[USED] += 1.0


@inlined_exact
def _sampling_shift(p: Array, plan: Array) -> float:
    """Change of the spool's residual by a deviation of the instant of sampling."""
    shift = ESTIMATION.sampling_lead_std * p[SPOOL_VELOCITY_PLACE] * plan[PLAN_SPOOL_WEIGHT]
    return float(shift / p[ONBOARD.noise])


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
        unknowns_at(address, ONBOARD.point),
    )
    score = sums[0, SQUARES] + sums[1, SQUARES]
    for c in range(2):
        score += 2.0 * sums[c, SAMPLES] * logarithm(p[ONBOARD.noise + c])
    if not score < p[PROGRESS.score]:
        return False
    p[PROGRESS.score] = score
    for i in range(ONBOARD_UNKNOWNS):
        p[ONBOARD.kept + i] = point[i]
    for c in range(2):
        p[ONBOARD.kept + ONBOARD_UNKNOWNS + c] = p[ONBOARD.noise + c]
    p[ONBOARD.kept + ONBOARD_UNKNOWNS + 2] = p[PROGRESS.settled]
    return True


@inlined_exact
def _take_best(address: int) -> None:
    """Go back to the best optimum so far."""
    p, point = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.point)
    for i in range(ONBOARD_UNKNOWNS):
        point[i] = p[ONBOARD.kept + i]
    for c in range(2):
        p[ONBOARD.noise + c] = p[ONBOARD.kept + ONBOARD_UNKNOWNS + c]
    p[PROGRESS.settled] = p[ONBOARD.kept + ONBOARD_UNKNOWNS + 2]
    set_density(p, ESTIMATION.refined_std)


@bare_kernel
def end_conclusion(address: int, plan: Array) -> float:
    """Judge an optimum; the phase that follows.

    The noise is another, near an optimum: refine again. The recording is not explained: search
    wider, as long as there is an attempt left; then the best optimum is the result.
    """
    p, sums = array_at(address, (ONBOARD.end,)), channel_sums_at(address)
    rules, attempts = verdict_rules_of(plan), p[PROGRESS.attempts]
    p[PROGRESS.judged] += 1.0
    samples, outliers = sums[0, SAMPLES] + sums[1, SAMPLES], sums[0, OUTLIERS] + sums[1, OUTLIERS]
    near = outliers <= NEAR_OUTLIERS * samples
    if attempts <= ATTEMPTS and near and _noise_changes(p, p[PROGRESS.judged]):
        set_density(p, ESTIMATION.refined_std)
        return PHASES.refinement
    explained = (
        outliers <= rules.search_outliers * samples and p[ANCHORED_PLACE] <= rules.most_anchored
    )
    if attempts <= ATTEMPTS and not explained:
        best = _keeps_best(address)
        p[PROGRESS.judged] = 0.0
        p[PROGRESS.attempts] += 1.0
        if attempts == 1.0:
            set_density(p, ROUNDS.wide_std)
            return PHASES.refinement
        if attempts < ATTEMPTS:
            return PHASES.search
        if not best:
            _take_best(address)
            return PHASES.conclusion
    return PHASES.last_day


@inlined_exact
def direction_count(plan: Array) -> int:
    """Directions in which a calibration may be off."""
    return int(plan[PLAN_DIRECTIONS])


@inlined_exact
def _moved_by(lane: int) -> int:
    """Which unknown a model of a step of the day has moved."""
    return lane - 1 if lane <= ONBOARD_GENES else ONBOARD_PARAMETERS + lane - 1 - ONBOARD_GENES


@bare_kernel
def start_day(address: int, plan_address: int, plan: Array) -> None:
    """Prepare models at a point, and beside it along each severity, viscosity and supply."""
    p, trial = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.trial)
    point, step = unknowns_at(address, ONBOARD.point), unknowns_at(address, ONBOARD.along)
    for i in range(CORRELATED_TICKS * ONBOARD_UNKNOWNS):
        p[ONBOARD.scores + i] = 0.0
    for i in range(UNKNOWNS_MATRIX_SIZE):
        p[ONBOARD.meat + i] = p[ONBOARD.normal + i] = 0.0
    for i in range(ONBOARD_UNKNOWNS):
        p[ONBOARD.normal + UNKNOWNS_MATRIX_SIZE + i] = p[ONBOARD.pull + i] = 0.0
    for lane in range(ONBOARD_MODELS):
        for i in range(ONBOARD_UNKNOWNS):
            trial[i] = point[i]
        i = _moved_by(lane)
        if 0 < lane < DAY_MODELS:
            # Of cold oil less: what viscosity does to the pressure grows with it.
            step[i] = DIFFERENCES.considered_step / max(p[ONBOARD.unit + UNIT_VISCOSITY], 1.0)
            if lane <= ONBOARD_GENES:
                width = min(math.sqrt(ROUNDS.width * p[ONBOARD.believed + i]), MAX_STEP)
                step[i] = width if trial[i] + width <= 1.0 else -width
            trial[i] += step[i]
        start_model(address, plan_address, plan, lane, trial)
        loosen_anchor(address, lane, p[ONBOARD.noise])


@bare_kernel
def add_day(address: int, plan: Array) -> None:
    """Add a tick, to which the models are advanced, to the step of the day."""
    p, slope = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.slope)
    normal = square_at(address, ONBOARD.normal, ONBOARD_UNKNOWNS)
    shift = unknowns_at(address, ONBOARD.normal + UNKNOWNS_MATRIX_SIZE)
    pull = unknowns_at(address, ONBOARD.pull)
    scores = scores_at(address)
    _begin_scores(scores)
    for c in range(2):
        at, noise = ONBOARD.monitors + MONITOR.residual + c, p[ONBOARD.noise + c]
        r = p[at] / noise
        smooth = math.isfinite(r) and r * r < ESTIMATION.residual_cap
        for lane in range(1, DAY_MODELS):
            i, change = _moved_by(lane), p[at + lane * MONITOR_SIZE] / noise - r
            smooth = smooth and abs(change) < DIFFERENCES.max_kink
            slope[i] = change / p[ONBOARD.along + i]
        slope[ONBOARD_GENES] = slope[ONBOARD_GENES + 1] = 0.0
        slope[ONBOARD_GENES + c] = -1.0 / noise
        if not smooth:
            continue
        lead = _sampling_shift(p, plan) if c == 0 else 0.0
        for i in range(ONBOARD_UNKNOWNS):
            scores[0, i] += slope[i] * r
            pull[i] += slope[i] * r
            shift[i] += slope[i] * lead
            for j in range(ONBOARD_UNKNOWNS):
                normal[i, j] += slope[i] * slope[j]
    if p[PROGRESS.phase] == PHASES.last_day:  # by the first step nothing is judged
        _spread_scores(
            scores,
            square_at(address, ONBOARD.meat, ONBOARD_UNKNOWNS),
            unknowns_at(address, ONBOARD.scratch),
        )


@bare_kernel
def end_day(address: int, plan: Array) -> None:
    """Step with viscosity and supply, see `ehadiag.identify.least_squares.refined_with_day`.

    The severities' columns of the covariance that is left are in the memory then.
    """
    p, out = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.trial)
    normal = square_at(address, ONBOARD.normal, ONBOARD_UNKNOWNS)
    matrix = square_at(address, ONBOARD.scratch, ONBOARD_UNKNOWNS)
    column = unknowns_at(address, ONBOARD.scratch + UNKNOWNS_MATRIX_SIZE)
    scores, meat = scores_at(address), square_at(address, ONBOARD.meat, ONBOARD_UNKNOWNS)
    for _ in range(CORRELATED_TICKS - 1 if p[PROGRESS.phase] == PHASES.last_day else 0):
        _begin_scores(scores)
        _spread_scores(scores, meat, column)
    point, pull = unknowns_at(address, ONBOARD.point), unknowns_at(address, ONBOARD.pull)
    for i in range(ONBOARD_PARAMETERS):
        pull[i] = 0.0  # the refinement has settled them
    for i in range(ONBOARD_PARAMETERS, ONBOARD_UNKNOWNS):
        normal[i, i] += 1.0
        pull[i] += point[i]
    far = MAX_DAY if direction_count(plan) > 0 else MAX_ROUNDING
    if onboard_bounded_step(point, normal, pull, ONBOARD_GENES, 0.0, 1.0, matrix, column, out):
        share = 1.0
        for i in range(ONBOARD_PARAMETERS, ONBOARD_UNKNOWNS):
            ahead = math.copysign(far, out[i] - point[i]) - point[i]
            if abs(out[i]) > far:
                share = min(share, max(ahead / (out[i] - point[i]), 0.0))
        for i in range(ONBOARD_UNKNOWNS):
            point[i] += share * (out[i] - point[i])
    p[BREAK_AWAY_PLACE] = 0.0
    for i in range(ONBOARD_GENES):
        shown = inverse_column(normal, i, matrix, column) > 0.0
        p[ONBOARD.considered + i] = 0.0
        for j in range(ONBOARD_UNKNOWNS):
            p[ONBOARD.influence + i * ONBOARD_UNKNOWNS + j] = column[j] if shown else 0.0
    # The rounds hold the day: what its step, by lines, has taken off an estimate counts where it
    # may be long, as the sensors of a calibrated unit err by more than the bus's steps.
    for day in range(ONBOARD_PARAMETERS, ONBOARD_UNKNOWNS if direction_count(plan) > 0 else 0):
        variance = inverse_column(normal, day, matrix, column)
        for i in range(ONBOARD_GENES if variance > 0.0 else 0):
            p[ONBOARD.considered + i] += (point[day] * column[i] / variance) ** 2


@bare_kernel
def start_directions(address: int, plan_address: int, plan: Array, done: int) -> None:
    """Prepare models at the optimum, beside it along each severity, and with what is held off.

    All unknowns move with a severity, so that a residual's slope is what an estimate takes of it.
    done: passes, of DIRECTIONS_OF_PASS directions each.
    """
    p, trial = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.trial)
    step = array_at(address + BYTES_PER_NUMBER * ONBOARD.along, (ONBOARD_GENES,))
    for i in range(DIRECTIONS_OF_PASS * (ONBOARD_GENES + 1)):
        p[ONBOARD.moved + i] = 0.0
    for lane in range(ONBOARD_MODELS):
        for i in range(ONBOARD_UNKNOWNS):
            trial[i] = p[ONBOARD.point + i]
        constants = identified_constants(plan_address, plan)
        if 0 < lane <= ONBOARD_GENES:
            i = lane - 1
            column = ONBOARD.influence + i * ONBOARD_UNKNOWNS
            variance = max(p[column + i], MIN_VARIANCE)
            width = min(math.sqrt(ROUNDS.width * variance), MAX_STEP)
            step[i] = (width if trial[i] + width <= 1.0 else -width) / variance
            for j in range(ONBOARD_UNKNOWNS):
                trial[j] += step[i] * p[column + j]
        direction = done * DIRECTIONS_OF_PASS + lane - 1 - ONBOARD_GENES
        if lane > ONBOARD_GENES and direction < direction_count(plan):
            behind = ONBOARD_PLAN_SIZE + direction * PLANT_FIELDS
            constants = plan_address + BYTES_PER_NUMBER * behind
        start_model_by(address, constants, plan_address, plan, lane, trial)
        loosen_anchor(address, lane, p[ONBOARD.noise])


@bare_kernel
def add_directions(address: int) -> None:
    """Add a tick, to which the models are advanced, to what the directions move."""
    p, slope = array_at(address, (ONBOARD.end,)), parameters_at(address, ONBOARD.slope)
    for c in range(2):
        at, noise = ONBOARD.monitors + MONITOR.residual + c, p[ONBOARD.noise + c]
        middle = p[at] / noise
        smooth = math.isfinite(middle) and middle * middle < ESTIMATION.residual_cap
        for i in range(ONBOARD_GENES):
            change = p[at + (1 + i) * MONITOR_SIZE] / noise - middle
            smooth = smooth and abs(change) < DIFFERENCES.max_kink
            slope[i] = change / p[ONBOARD.along + i]
        for k in range(DIRECTIONS_OF_PASS if math.isfinite(middle) else 0):
            change = p[at + (1 + ONBOARD_GENES + k) * MONITOR_SIZE] / noise - middle
            if not abs(change) < MAX_DIRECTION_CHANGE:
                p[BREAK_AWAY_COSTS_PLACE + k] += ROUNDS.cauchy_variances * logarithm(
                    1.0 + change * change / ROUNDS.cauchy_variances
                )
                continue
            for i in range(ONBOARD_GENES if smooth else 0):
                p[ONBOARD.moved + k * ONBOARD_GENES + i] += slope[i] * change


@bare_kernel
def end_directions(address: int) -> None:
    """Take what the directions of a pass move; one that there is not moves nothing."""
    p = array_at(address, (ONBOARD.end,))
    for k in range(DIRECTIONS_OF_PASS):
        p[BREAK_AWAY_PLACE] = max(p[BREAK_AWAY_PLACE], p[BREAK_AWAY_COSTS_PLACE + k])
        for i in range(ONBOARD_GENES):
            p[ONBOARD.considered + i] += p[ONBOARD.moved + k * ONBOARD_GENES + i] ** 2


@bare_kernel
def write_result(address: int, plan: Array) -> None:
    """Write estimates, deviations and verdict."""
    p, new = array_at(address, (ONBOARD.end,)), verdict_rules_of(plan).friction_new
    sums, point = channel_sums_at(address), parameters_at(address, ONBOARD.point)
    samples = sums[0, SAMPLES] + sums[1, SAMPLES]
    keep_outcome(
        p,
        OnboardOutcome(
            point[0], point[1], point[2], 0.0, 0.0, 0.0,
            point[3] / plan[PLAN_SPOOL_WEIGHT], point[4] / plan[PLAN_PRESSURE_WEIGHT],
            0.0, 0.0, sums[0, SQUARES] + sums[1, SQUARES], samples,
            p[UNEXPLAINED] / max(samples, 1.0),
            math.sqrt(p[UNEXPLAINED_SQUARES] / max(sums[0, SAMPLES], 1.0)),
            math.sqrt(p[UNEXPLAINED_SQUARES + 1] / max(sums[1, SAMPLES], 1.0)),
            p[ONBOARD_RUNS], p[PROGRESS.settled],
        ),
    )  # fmt: skip
    write_deviations(
        address,
        plan,
        ONBOARD_UNKNOWNS,
        p[USED_SQUARES] / max(p[USED] - ONBOARD_PARAMETERS, 1),
    )
    p[FSS], p[ONBOARD_GENES + FSS] = (
        (p[FSS] - new) / (1.0 - new),
        p[ONBOARD_GENES + FSS] / (1.0 - new),
    )
    write_verdict(address, plan)
