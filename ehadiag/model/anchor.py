"""Re-anchoring: corrects the modelled spool and jack towards the measured ones, tick by tick."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined

__all__ = ["FREE_RUN", "Anchor", "re_anchored"]


@dataclass(frozen=True, slots=True)
class Anchor:
    """Re-anchoring of the modelled spool and jack on the measured ones, once a tick.

    The innovation is filtered, f += gain (e - f); a sample further off than `large` moves the model
    onto it, a filtered innovation above `small` moves it by that. It undoes a break-away that went
    the other way, and leaves a model that runs true alone.

    The jack integrates what the valve lets pass, and with it every small error. It is moved by a
    share of its innovation each tick: what is left of that is its fast part.
    """

    gain: float
    small: float
    """m."""
    large: float
    """m."""
    follow: float = 0.0
    """Share of the jack's innovation by which it is moved, 0 … 1; where its position counts."""

    def as_array(self) -> NDArray[np.float64]:
        """The form that kernels take."""
        return np.array([self.gain, self.small, self.large, self.follow])


FREE_RUN = Anchor(0.0, np.inf, np.inf)


@inlined
def re_anchored(
    error: float,
    gain: float,
    small: float,
    large: float,
    xs: float,
    filtered: float,
    bound: float,
) -> tuple[float, float, bool]:
    """Spool position and filtered innovation after a tick, m, and whether the spool was moved.

    Parameters
    ----------
    error: innovation, measured less modelled position, m; NaN where the sample is missing.
    gain, small, large: see `Anchor`.
    xs, filtered: before, m.
    bound: the spool's stroke either way, m.
    """
    if not math.isfinite(error):
        return xs, filtered, False
    filtered += gain * (error - filtered)
    if abs(error) > large:
        return min(max(xs + error, -bound), bound), 0.0, True
    if abs(filtered) > small:
        return min(max(xs + filtered, -bound), bound), 0.0, True
    return xs, filtered, False
