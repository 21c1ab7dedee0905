"""Torque motor of one candidate: what its hysteresis makes of the current, tick by tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined
from ehadiag.model.laws import DriveLaw, driven, lagged, play

__all__ = ["deflection_held", "drive"]


@inlined
def drive(law: DriveLaw, held: NDArray[np.float64], current: float) -> float:
    """Flapper deflection (m) that the torque of a current (A) alone makes (PHY-4, PHY-29, PHY-30).

    held: what the plays hold, and last what flows behind the driver's lag, A, shape (plays + 1,),
        changed in place.
    """
    plays = held.shape[0] - 1
    flowing = held[plays]
    held[plays] = lagged(law.left, flowing, current)
    value = lagged(law.late, flowing, current) + law.bias
    for i in range(plays):
        held[i] = play(held[i], value, law.spacing * (i + 0.5))
    return deflection_held(law, held)


@inlined
def deflection_held(law: DriveLaw, held: NDArray[np.float64]) -> float:
    """Flapper deflection by the current that acts, m."""
    total, weight = 0.0, 1.0
    for i in range(held.shape[0] - 1):
        total += weight * held[i]
        weight *= law.fade
    return float(driven(law, total))
