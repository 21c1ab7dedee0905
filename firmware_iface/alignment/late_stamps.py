"""Places frames without a counter: their time stamps are late, never early, and they keep order.

A stamp is that of the frame's tick plus a delay: of the bus, of the adapter, which may stamp whole
batches at once, of the host. The earliest stamps lie on the computer's clock, so its phase and
drift are those of their *lower envelope* (as Moon, Skelly and Towsley do for network clocks,
INFOCOM 1999), and a frame is of the latest tick that no frame after it contradicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["LateStamps", "place_late", "spacing_of"]

BLOCK = 500
"""Frames of which the earliest tells the phase."""
HORIZON = 500
"""Frames that a burst of late ones has at most."""
LAG = 200
"""Frames over which the spacing is measured."""
FEW_LOST = 0.2
"""Quantile of the spacings over a lag: losses make them longer, never shorter."""
WHOLE = 0.25
"""Distance from a whole number of ticks that a spacing may have, per tick."""
SURE = 1e-4
"""Chance that all frames of a stretch are late, below which lateness is a loss."""
SHARE_LATE = 0.95
EARLY = 0.15
"""Share of a spacing by which a stamp may be earlier than the earliest ones of its time."""
ROUGHLY = 0.3
"""The same where that time is known roughly."""

Ticks = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LateStamps:
    """Ticks of a message's frames, from 0 at its first one, and how late their stamps are.

    Attributes
    ----------
    tick : Ticks
        Shape (n,).
    phase : Floats
        Stamp of a frame that is not late, less its tick, in ticks, shape (n,).
    late : Floats
        Delay of each stamp beyond the earliest ones, in ticks, shape (n,).
    """

    tick: Ticks
    phase: Floats
    late: Floats

    @property
    def usual(self) -> float:
        """Delay, in ticks, that 95 % of the stamps keep below."""
        return float(np.quantile(self.late, SHARE_LATE)) if len(self.late) else 0.0


def spacing_of(since: Floats, said: float = 0.0) -> int:
    """Ticks between two frames; 0 where several share a tick.

    Parameters
    ----------
    since : Floats
        Time stamps, ticks, in order of arrival, shape (n,), n > 1.
    said : float
        Ticks that the DBC says; 0: nothing.

    Returns
    -------
    int
        The spacing. Late stamps and lost frames do not change it.
    """
    lag = max(min(len(since) // 2, LAG), 1)
    steps = (since[lag:] - since[:-lag]) / lag
    # Jitter of the ends of a short lag is no loss: the median is safe there.
    found = float(np.quantile(steps, FEW_LOST if lag >= LAG // 4 else 0.5))
    if said >= 1.0 and abs(found - said) <= WHOLE * said:
        return round(said)
    return round(found) if found < 1e6 else 1


def place_late(since: Floats, every: int) -> LateStamps:
    """Place frames in order of arrival by their late time stamps.

    Parameters
    ----------
    since : Floats
        Time stamps, ticks, shape (n,), n > 0.
    every : int
        Ticks between two frames, at least 1.

    Returns
    -------
    LateStamps
        Their ticks. Where a frame is lost among late ones, the next few may be a spacing early.
    """
    index = np.arange(len(since), dtype=np.float64)
    slack = (since - since[0]) / every - index
    phase = _envelope(slack)
    over = slack - phase
    whole = np.floor(over + EARLY).astype(np.int64)
    shift = _settled(whole, 1)
    late_share = float(np.mean(over - shift > 1.0 - EARLY))
    if late_share > 0.0:
        sure = int(np.ceil(np.log(SURE) / np.log(min(late_share, 0.95))))
        shift = _settled(whole, max(sure, 1))
    tick = (index.astype(np.int64) + shift) * every
    first = int(tick[0])
    drift = phase * every + first
    return LateStamps(tick - first, drift, (over - shift) * every)


def _settled(shift: Ticks, sure: int) -> Ticks:
    """Each frame's shift is the least of those after it, within the longest burst.

    Of the last `sure` frames nothing proves that they are not late: they keep what was before.
    """
    out = _least_ahead(shift, max(HORIZON, sure))
    if sure > 1 and len(out) > sure:
        end = len(out) - sure
        out[end:] = np.minimum(out[end:], out[end])
    return out


def _least_ahead(values: NDArray[Any], horizon: int) -> NDArray[Any]:
    """Least of each value and the `horizon` ones after it, by doubling."""
    out, reach = values.copy(), 1
    while reach <= horizon:
        step = min(reach, horizon + 1 - reach)
        out[:-step] = np.minimum(out[:-step], out[step:])
        reach += step
    return out


def _envelope(slack: Floats) -> Floats:
    """Slowly drifting phase of the earliest stamps, whole spacings taken off; per frame.

    slack: stamp less index, in spacings; it climbs a stair with each lost frame.
    """
    count = len(slack)
    starts = np.arange(0, max(count - BLOCK // 2, 1), BLOCK)
    stairs = _least_ahead(slack, HORIZON)
    turn = np.add.reduceat(np.exp(2j * np.pi * stairs), starts)
    level = np.unwrap(np.angle(turn) / (2.0 * np.pi), period=1.0)
    centre = starts + 0.5 * np.diff(np.append(starts, count))
    near = np.interp(np.arange(count), centre, level)
    # The stairs' mean lies above their lower edge by what the short ones are late.
    over = slack - near
    late = over - _least_ahead(np.floor(over + ROUGHLY), HORIZON)
    edge = np.minimum.reduceat(late, starts)
    return np.asarray(near + np.interp(np.arange(count), centre, edge))
