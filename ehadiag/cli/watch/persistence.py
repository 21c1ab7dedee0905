"""Tells a change that lasts from a single break-away at another moment than the model's.

In free motion a spool or jack that is about to move may break away some ticks sooner or later than
its model, or stop elsewhere. The sums then alarm for some ticks, at times for seconds, and fall
silent. What has changed in the unit goes on to show in its motion.
"""

from __future__ import annotations

from collections import deque

__all__ = ["NEEDED", "OF", "SPAN_S", "Persistence"]

SPAN_S = 5.0
NEEDED, OF = 3, 6
"""Alarms in so many of so many spans in a row are of something that lasts."""


class Persistence:
    """Counts the spans of time in which the sums alarmed.

    Parameters
    ----------
    rate : float
        Ticks a second.
    """

    def __init__(self, rate: float) -> None:
        self._length = round(SPAN_S * rate)
        self._spans: deque[int] = deque(maxlen=NEEDED)

    def take(self, tick: int) -> bool:
        """Take an alarm at a tick, in order; return whether the alarms last.

        Parameters
        ----------
        tick : int
            Since any zero.

        Returns
        -------
        bool
            Whether there were enough of them.
        """
        span = tick // self._length
        if not self._spans or self._spans[-1] != span:
            self._spans.append(span)
        return len(self._spans) == NEEDED and span - self._spans[0] < OF
