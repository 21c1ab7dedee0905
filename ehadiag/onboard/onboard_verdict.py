"""Standard deviations and verdict of the on-board identification."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Final

from ehadiag.compile.elementary import normal_cdf
from ehadiag.compile.jit import Array, bare_kernel, inlined_exact, merged
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.core.estimation_rules import ESTIMATION
from ehadiag.onboard.onboard_memory import (
    MATRIX_SIZE,
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_PARAMETERS,
    ONBOARD_VERDICT,
    REASONS,
    OnboardOutcome,
    VerdictRules,
    outcome_of,
    verdict_rules_of,
)
from ehadiag.onboard.onboard_refinement import (
    inverse_column,
)
from ehadiag.onboard.onboard_search import (
    FDJ,
    FSS,
    parameters_at,
)

NOT_TESTED: Final = 30.0
NORMAL_HALF_WIDTH_95 = NormalDist().inv_cdf(0.975)
"""Half of the central 95 % of a normal density, in deviations."""


@bare_kernel
def write_deviations(address: int, plan: Array, directions: int, reduced: float) -> int:
    """Write the deviations of the severities, see `ehadiag.identify.estimates.estimate_covariance`.

    Of the memory, its normal matrix (the uniform prior is added to it) with the shift of the
    gradient by the instant of sampling, the gradient's covariance, the variances that the search
    has left, and shifts by so many directions; reduced: mean square of the residuals that count.
    Returns 0, or 1 where there is no inverse and the deviations are those of a uniform density.
    """
    p, rules = array_at(address, (ONBOARD.end,)), verdict_rules_of(plan)
    matrix, normal, meat = (
        square_at(address, ONBOARD.scratch),
        square_at(address, ONBOARD.normal),
        square_at(address, ONBOARD.meat),
    )
    column = parameters_at(address, ONBOARD.scratch + MATRIX_SIZE)
    failed = 0
    for i in range(ONBOARD_GENES):
        normal[i, i] += 1.0 / ESTIMATION.uniform_std**2
    for i in range(ONBOARD_GENES):
        variance = inverse_column(normal, i, matrix, column)
        if not variance > 0.0:
            failed = 1
            p[ONBOARD_GENES + i] = ESTIMATION.uniform_std
            continue
        sandwich, considered = 0.0, 0.0
        for j in range(ONBOARD_PARAMETERS):
            for k in range(ONBOARD_PARAMETERS):
                sandwich += column[j] * meat[j, k] * column[k]
        for direction in range(-1, directions):
            shift = ONBOARD.considered + direction * ONBOARD_PARAMETERS
            if direction < 0:
                shift = ONBOARD.normal + MATRIX_SIZE
            moved = 0.0
            for j in range(ONBOARD_PARAMETERS):
                moved += column[j] * p[shift + j]
            considered += moved * moved
        discrepancy = rules.discrepancy_Kintas
        if i == FSS:
            discrepancy = rules.discrepancy_FSS
        elif i == FDJ:
            discrepancy = rules.discrepancy_FDJ
        variance *= max(reduced / ESTIMATION.capped_variance, 1.0)
        variance = max(variance, sandwich, p[ONBOARD.believed + i])
        p[ONBOARD_GENES + i] = math.sqrt(
            variance + considered + ESTIMATION.discrepancy_std**2 + discrepancy * discrepancy
        )
    return failed


@merged
def square_at(address: int, place: int) -> Array:
    """Return a square matrix of all parameters, from a place of the memory on."""
    return array_at(address + BYTES_PER_NUMBER * place, (ONBOARD_PARAMETERS, ONBOARD_PARAMETERS))


@bare_kernel
def write_verdict(address: int, plan: Array) -> int:
    """Write the verdict, see `ehadiag.assess.verdict.judge`; numbers of none are not believed."""
    p, rules = array_at(address, (ONBOARD.end,)), verdict_rules_of(plan)
    o = outcome_of(p)
    above, at_limit, hidden, blind = 0.0, False, False, False
    for i in range(ONBOARD_GENES):
        std = p[ONBOARD_GENES + i]
        hidden = hidden or not std < rules.most_std
        at_limit = at_limit or onboard_chance_above(p[i], std, rules.limit) >= rules.fault_chance
        above += onboard_chance_above(p[i], std, rules.advisory)
        low, high = p[i] - NORMAL_HALF_WIDTH_95 * std, p[i] + NORMAL_HALF_WIDTH_95 * std
        blind = blind or (low < rules.advisory and high > rules.limit)
    reasons = 0.0
    if not _is_explained(o.outliers, o.spool_rms, o.pressure_rms, rules):
        reasons += REASONS.unexplained
    if hidden:
        reasons += REASONS.hidden
    if blind and not at_limit:
        reasons += REASONS.wide
    if reasons > 0.0:
        return refuse_verdict(address, reasons)
    p[ONBOARD_VERDICT] = 20.0 if at_limit else (10.0 if above > rules.false_healthy else 0.0)
    return 0


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
