"""Standard deviations and verdict of an identification whose refinement has come to its end."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.identify.uncertainty import DISCREPANCY_STD, EXPECTED_CAPPED, UNIFORM_STD
from ehadiag.monitor.layout import NUMBER
from ehadiag.onboard.bounded import invert
from ehadiag.onboard.elementary import normal_below
from ehadiag.onboard.layout import GENES, PARAMETERS, SCRATCH, SIZE, VERDICT, outcome_of
from ehadiag.onboard.rules import Rules, rules_of
from ehadiag.onboard.run import vector_at

__all__ = ["chance_above", "deviate", "judge"]

Array = NDArray[np.float64]
HALF_95 = 1.959963984540054
"""Half of the central 95 % of a normal density, in deviations."""
SQUARE = PARAMETERS * PARAMETERS


@brief_kernel
def deviate(address: int, normal: Array, meat: Array, shift: Array, reduced: float) -> int:
    """Write the deviations of the severities, see `ehadiag.identify.uncertainty.covariance`.

    Parameters
    ----------
    address : int
        Of the identification.
    normal : Array
        Shape (PARAMETERS, PARAMETERS); what is known of a severity beforehand is added to it.
    meat : Array
        Covariance of the gradient, residuals correlated over some ticks.
    shift : Array
        Pull of what is considered but not estimated, a deviation off.
    reduced : float
        Mean square of the residuals that count.

    Returns
    -------
    int
        0; 1: there is no inverse, and the deviations are those of a uniform density.
    """
    p = array_at(address, (SIZE,))
    matrix = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    column = vector_at(address, SCRATCH + SQUARE)
    failed = 0
    for i in range(GENES):
        normal[i, i] += 1.0 / UNIFORM_STD**2
    for i in range(GENES):
        variance = invert(normal, i, matrix, column)
        if not variance > 0.0:
            failed = 1
            p[GENES + i] = UNIFORM_STD
            continue
        sandwich, moved = 0.0, 0.0
        for j in range(PARAMETERS):
            moved += column[j] * shift[j]
            for k in range(PARAMETERS):
                sandwich += column[j] * meat[j, k] * column[k]
        variance *= max(reduced / EXPECTED_CAPPED, 1.0)
        p[GENES + i] = math.sqrt(max(variance, sandwich) + moved**2 + DISCREPANCY_STD**2)
    return failed


@brief_kernel
def judge(address: int, plan: Array, complete: bool) -> int:
    """Write the verdict, see `ehadiag.assess.verdict.judge`; complete: enough samples are there."""
    p, rules = array_at(address, (SIZE,)), rules_of(plan)
    o = outcome_of(p)
    known = complete and _explained(o.outliers, o.spool_rms, o.pressure_rms, rules)
    above, at_limit, blind = 0.0, False, False
    for i in range(GENES):
        std = p[GENES + i]
        known = known and std < rules.most_std
        at_limit = at_limit or chance_above(p[i], std, rules.limit) >= rules.fault_chance
        above += chance_above(p[i], std, rules.advisory)
        low, high = p[i] - HALF_95 * std, p[i] + HALF_95 * std
        blind = blind or (low < rules.advisory and high > rules.limit)
    verdict = 0.0
    if not known:
        verdict = 30.0
    elif at_limit:
        verdict = 20.0
    elif blind:
        verdict = 30.0
    elif above > rules.false_healthy:
        verdict = 10.0
    p[VERDICT] = verdict
    return 0


@inlined_exact
def _explained(outliers: float, spool: float, pressure: float, rules: Rules) -> bool:
    """Whether the model explains the recording; a NaN is none."""
    return bool(
        outliers <= rules.most_outliers and spool <= rules.most_rms and pressure <= rules.most_rms
    )


@inlined_exact
def chance_above(value: float, std: float, level: float) -> float:
    """Chance that a severity is at or above a level: of a normal density within 0 … 1."""
    if not std > 0.0:
        return 1.0 if value >= level else 0.0
    low = normal_below(-value / std)
    at = normal_below((level - value) / std)
    high = normal_below((1.0 - value) / std)
    if high > low:
        return (high - at) / (high - low)
    return 1.0 if value >= level else 0.0
