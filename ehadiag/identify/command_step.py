"""Finds the resolution of a commanded position that no frame told, by the current that followed.

The flight-control computer acts on a command that its bus or its word length has rounded. By less
than a step of the current's converter, tick by tick; yet over a whole test the measured current
shows which rounding it followed, if any.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["step_by_current"]

STEPS = np.sort(np.concatenate([digit * 10.0 ** np.arange(-7, -4) for digit in (1, 2, 2.5, 5)]))
"""m: resolutions that buses have."""
POWERS = 2.0 ** -np.arange(9)
"""Of the converter's step: those of a computer that calculates in its codes."""
CLEAR = 30.0
"""Sum of squares, in variances, by which a rounding must explain the current better than none."""
STRANGEST = 3.0
"""Residuals, in deviations, beyond which one counts no more than this."""

Floats = NDArray[np.float64]


def step_by_current(
    stored: Floats, current_of: Callable[[Floats], Floats], measured: Floats, converter: float
) -> float:
    """Resolution of the command that explains the measured current best; 0: none is needed.

    Parameters
    ----------
    stored : Floats
        Command of the stored test, m, shape (n,).
    current_of : Callable[[Floats], Floats]
        What the control law makes of a command, A, shape (n,).
    measured : Floats
        Current, A; NaN where it tells nothing, shape (n,).
    converter : float
        Step of the jack position's converter, m.

    Returns
    -------
    float
        Resolution, m.
    """
    told = np.isfinite(measured)
    if not told.any():
        return 0.0

    def residual(command: Floats) -> Floats:
        away = (measured - current_of(command))[told]
        return np.asarray(away - np.median(away))

    plain = residual(stored)
    scale = 1.4826 * float(np.median(np.abs(plain)))
    if scale == 0.0:
        return 0.0

    def misfit(away: Floats) -> float:
        return float(np.sum(np.clip(away / scale, -STRANGEST, STRANGEST) ** 2))

    steps = np.concatenate([STEPS, converter * POWERS])
    found = [misfit(residual(np.round(stored / step) * step)) for step in steps]
    best = int(np.argmin(found))
    return float(steps[best]) if found[best] < misfit(plain) - CLEAR else 0.0
