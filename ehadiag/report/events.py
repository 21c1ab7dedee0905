"""What a reader looks for in a modelled motion: where it breaks away, turns, meets an end stop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["NO_EVENTS", "Events", "events_of"]

Ticks = NDArray[np.intp]
AT_STOP = 1e-9
"""m; a body so near to its stop is on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """Ticks at which something happens to a body, shape (any,) each."""

    breakaways: Ticks
    """It begins to move after friction held it for a tick or longer."""
    reversals: Ticks
    """It turns without a rest."""
    stops: Ticks
    """It meets its end stop."""

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return bool(self.breakaways.size or self.reversals.size or self.stops.size)


NO_EVENTS = Events(*(np.zeros(0, dtype=np.intp) for _ in range(3)))


def events_of(place: NDArray[np.float64], stop: float) -> Events:
    """Find the events of a modelled motion, as its ticks show them.

    Parameters
    ----------
    place : NDArray[np.float64]
        Modelled position, m, shape (n,). The model holds a body that rests exactly where it is, so
        two equal neighbours are a rest.
    stop : float
        End stop on either side, m.

    Returns
    -------
    Events
        Indices of ticks, ascending.
    """
    if len(place) < 3:
        return NO_EVENTS
    stopped = np.abs(place) >= stop - AT_STOP
    way = np.sign(np.diff(place))
    before, after = way[:-1], way[1:]
    free = ~stopped[1:-1]
    return Events(
        breakaways=np.flatnonzero((before == 0.0) & (after != 0.0) & free) + 1,
        reversals=np.flatnonzero(before * after < 0.0) + 1,
        stops=np.flatnonzero(stopped[1:] & ~stopped[:-1]) + 1,
    )
