"""Standard deviations and verdict of an identification that has come to its end."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.monitor.layout import NUMBER
from ehadiag.onboard.bounded import invert
from ehadiag.onboard.elementary import normal_below
from ehadiag.onboard.layout import (
    CONVERGED,
    GENES,
    NORMAL,
    PARAMETERS,
    SCRATCH,
    SIZE,
    VERDICT,
    outcome_of,
)
from ehadiag.onboard.run import vector_at

__all__ = [
    "ADVISORY",
    "FALSE_HEALTHY",
    "FAULT_CHANCE",
    "LIMIT",
    "MOST_OUTLIERS",
    "chance_above",
    "conclude",
]

Array = NDArray[np.float64]
MOST_OUTLIERS = 0.15
ADVISORY, LIMIT = 0.25, 0.75
"""See `ehadiag.assess.verdict`."""
FALSE_HEALTHY, FAULT_CHANCE = 0.025, 0.5


@brief_kernel
def conclude(address: int, converged: bool) -> None:
    """Deviations and verdict."""
    p = array_at(address, (SIZE,))
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    matrix = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    column = vector_at(address, SCRATCH + PARAMETERS * PARAMETERS)
    o = outcome_of(p)
    excess = max(1.0, o.cost / max(o.samples - PARAMETERS, 1.0))
    known = o.outliers <= MOST_OUTLIERS and o.samples > 0.0
    above, at_limit, blind = 0.0, False, False
    for i in range(GENES):
        variance = invert(normal, i, matrix, column) * excess
        if not variance > 0.0:
            known = False
        std = math.sqrt(variance) if variance > 0.0 else 0.0
        p[GENES + i] = std
        if std > 0.0:
            at_limit = at_limit or chance_above(p[i], std, LIMIT) >= FAULT_CHANCE
            above += chance_above(p[i], std, ADVISORY)
            low, high = p[i] - 1.96 * std, p[i] + 1.96 * std
            blind = blind or (low < ADVISORY and high > LIMIT)
    verdict = 0.0
    if not known:
        verdict = 30.0
    elif at_limit:
        verdict = 20.0
    elif blind:
        verdict = 30.0
    elif above > FALSE_HEALTHY:
        verdict = 10.0
    p[VERDICT] = verdict
    p[CONVERGED] = 1.0 if converged else 0.0


@inlined_exact
def chance_above(value: float, std: float, level: float) -> float:
    """Chance that a severity is at or above a level: of a normal density within 0 … 1."""
    low = normal_below(-value / std)
    at = normal_below((level - value) / std)
    high = normal_below((1.0 - value) / std)
    if high > low:
        return (high - at) / (high - low)
    return 1.0 if value >= level else 0.0
