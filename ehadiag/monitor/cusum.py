"""Design of the two-sided cumulative sums: reference value and threshold for a false-alarm rate.

Upper sum S+ = max(0, S+ + z - k), lower sum S- = max(0, S- - z - k), alarm beyond h; z is the
residual in units of its noise (Page, Biometrika 41, 1954). The mean number of samples between
false alarms of one sum follows Siegmund, Sequential Analysis, Springer 1985, section 2.6:

    ARL = (exp(2 k b) - 2 k b - 1) / (2 k²),    b = h + 1.166,

for independent standard normal z. Sums that run side by side add their rates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ehadiag.core.errors import ConfigurationError

__all__ = ["SUMS", "CusumDesign", "design_cusum", "mean_run_length"]

SUMS = 4
"""Two channels, each with an upper and a lower sum."""
OVERSHOOT = 1.166
"""What a normal sum oversteps its two barriers by on average (Siegmund)."""
SETTLED = 1e-12
SHIFTS = (0.1, 5.0)
HOURS = (1e-4, 1e7)


@dataclass(frozen=True, slots=True)
class CusumDesign:
    """Both in units of the noise."""

    reference: float
    """k: half the shift of the mean that is to be found soonest."""
    threshold: float
    """h."""


def mean_run_length(design: CusumDesign) -> float:
    """Mean number of samples between false alarms of one sum on white noise."""
    k = design.reference
    x = 2.0 * k * (design.threshold + OVERSHOOT)
    return (math.expm1(x) - x) / (2.0 * k * k)


def design_cusum(hours: float, tick: float, shift: float = 1.0) -> CusumDesign:
    """Choose k and h for a mean time between false alarms of a monitor, all its sums together.

    Parameters
    ----------
    hours : float
        Mean time between false alarms, 1e-4 … 1e7 h.
    tick : float
        s.
    shift : float
        Of the mean, in units of the noise, that is to be found soonest; 0.1 … 5.

    Returns
    -------
    CusumDesign
        Reference value and threshold.

    Raises
    ------
    ConfigurationError
        A value out of its range, or so short a time that no threshold gives it.
    """
    if not HOURS[0] <= hours <= HOURS[1]:
        raise ConfigurationError(f"hours between false alarms {hours:g}: need {HOURS[0]:g} … 1e7")
    if not SHIFTS[0] <= shift <= SHIFTS[1]:
        raise ConfigurationError(f"CUSUM shift {shift:g}: need {SHIFTS[0]:g} … {SHIFTS[1]:g}")
    k = 0.5 * shift
    length = SUMS * hours * 3600.0 / tick
    # exp(x) = 2 k² length + x + 1 with x = 2 k b: the right side grows so slowly that to repeat
    # it converges.
    x = before = 0.0
    for _ in range(200):
        x, before = math.log(2.0 * k * k * length + x + 1.0), x
        if abs(x - before) < SETTLED:
            break
    threshold = x / (2.0 * k) - OVERSHOOT
    if threshold <= 0.0:
        raise ConfigurationError(
            f"{hours:g} h between false alarms: no threshold is so low for a shift of {shift:g}"
        )
    return CusumDesign(k, threshold)
