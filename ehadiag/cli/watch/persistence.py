"""Tells a change that lasts from a single break-away at another moment than the model's.

In free motion a spool or jack that is about to move may break away some ticks sooner or later than
its model, or stop elsewhere. The sums then alarm for some ticks, at times for seconds, and fall
silent. What has changed in the unit goes on to show in its motion.
"""

from __future__ import annotations

from collections import deque

__all__ = ["NEEDED", "OF", "SPAN_S", "Persistence"]

SPAN_S = 5.0
NEEDED, OF = 4, 6
"""Spans that alarmed, of so many in a row, are of something that lasts."""
INSTANT_S = 0.1
INSTANTS = 2
"""Instants with an alarm that a span needs to count: a break-away by itself mostly makes one."""


class Persistence:
    """Counts the spans of time in which the sums alarmed more than once.

    Parameters
    ----------
    rate : float
        Ticks a second.
    """

    def __init__(self, rate: float) -> None:
        self._span_ticks = round(SPAN_S * rate)
        self._instant_ticks = round(INSTANT_S * rate)
        self._span = self._instant = -1
        self._instants = 0
        self._counted: deque[int] = deque(maxlen=NEEDED)

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
        span, instant = tick // self._span_ticks, tick // self._instant_ticks
        if span != self._span:
            self._span, self._instants = span, 0
        elif instant == self._instant:
            return self._lasts()
        self._instant = instant
        self._instants += 1
        if self._instants == INSTANTS:
            self._counted.append(span)
        return self._lasts()

    def _lasts(self) -> bool:
        counted = self._counted
        if len(counted) < NEEDED or counted[-1] != self._span:
            return False
        return self._span - counted[0] < OF
