"""Noise of the measured signals, from what no slow motion explains: second differences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.channels import Channel

__all__ = [
    "KEPT_MEAN",
    "KEPT_SHARE",
    "QUIET_BLOCK",
    "TYPICAL_NOISE_LSB",
    "noise_of_signal",
    "relative_noise",
    "rounding_noise",
]

KEPT_SHARE = 0.98
KEPT_MEAN = 0.75978
"""Mean absolute value of a standard normal variable, the largest 2 % left out."""
TYPICAL_NOISE_LSB = float(np.sqrt(0.5**2 + 1.0 / 12.0))
"""Noise of a 12-bit channel (PHY-21, PHY-22), LSB: thresholds in LSB are meant at this noise."""
QUIET_BLOCK = 100
"""Ticks over which noise is judged."""
QUIET_SHARE = 0.867
"""Deviation of white noise in the quietest fifth of such blocks (0.864 to 0.869 for 2 to 5.5 s)."""


def rounding_noise(channel: Channel) -> float:
    """Standard deviation that the converter's rounding alone makes, SI unit of the channel."""
    return channel.lsb / float(np.sqrt(12.0))


def noise_of_signal(values: NDArray[np.float64], channel: Channel) -> float:
    """Noise of a channel from the quietest blocks of what is handed in, SI unit of the channel.

    Second differences do not see a steady slope; the quietest fifth of the blocks is where the
    actuator rests or creeps. Never below what the converter's rounding alone makes.
    """
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    blocks = second[: len(second) // QUIET_BLOCK * QUIET_BLOCK].reshape(-1, QUIET_BLOCK)
    enough = np.isfinite(blocks).sum(axis=1) > QUIET_BLOCK // 2
    if not enough.any():
        return float(channel.lsb * TYPICAL_NOISE_LSB)
    power = np.sort(np.nanmean(blocks[enough] ** 2, axis=1)) / 6.0
    quiet = power[: max(1, len(power) // 5)]
    return float(max(np.sqrt(np.median(quiet)) / QUIET_SHARE, rounding_noise(channel)))


def relative_noise(residuals: NDArray[np.float64]) -> float:
    """Noise that weighted residuals show, in units of the noise that weighs them.

    Second differences hold what is noise; what the model fails to explain moves slowly and stays
    out, so that it still shows as a residual that the noise does not cover.

    Parameters
    ----------
    residuals : shape (n,)
        0 where no sample counts.
    """
    known = residuals != 0.0
    second = residuals[2:] - 2.0 * residuals[1:-1] + residuals[:-2]
    second = second[known[2:] & known[1:-1] & known[:-2]]
    kept = int(KEPT_SHARE * second.size)
    if not kept:
        return 1.0
    least = np.partition(np.abs(second), kept - 1)[:kept]
    return float(np.mean(least) / (KEPT_MEAN * np.sqrt(6.0)))
