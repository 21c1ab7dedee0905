"""Spans of recorded tests to compare candidates with, and re-anchoring of models on them.

A candidate is one set of physical constants that may be those of the unit.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2


class Anchor(msgspec.Struct, frozen=True):
    """Re-anchoring of the modelled spool and jack on the measured ones, once a tick.

    The innovation is filtered, f += gain (e - f); a sample further off than `large` moves the model
    onto it, a filtered innovation above `small` moves it by that. It undoes a break-away that went
    the other way, and leaves a model that runs true alone.

    The jack integrates what the valve lets pass, and with it every small error. It is moved by a
    share of its innovation each tick: what is left of that is its fast part.
    """

    gain: float
    """Gain of the filter, 1."""
    small: float
    """Filtered innovation that moves the model, m."""
    large: float
    """Innovation of one sample that moves it, m."""
    follow: float = 0.0
    """Share of the jack's innovation by which it is moved, 0 … 1; where its position counts."""
    until: float = np.inf
    """Ticks of a span after which the spool runs free."""

    def as_array(self) -> Array:
        """The form that kernels take."""
        return np.array([self.gain, self.small, self.large, self.follow, self.until])


NO_ANCHOR = Anchor(0.0, np.inf, np.inf)


SIGNAL_ROWS = 3
"""Rows of weights and residuals: the signals that a candidate has to explain. Weights without the
last row leave the jack's position out, and residuals are then without it too."""
SPOOL_ROW, PRESSURE_ROW, POSITION_ROW = range(SIGNAL_ROWS)


class Batch(NamedTuple):
    """Recordings (or spans of them) to explain; m spans, N ticks in all.

    Spans stand one behind the other in flat arrays, so that one compiled function serves any
    number of them.
    """

    test: NDArray[np.int64]
    """Which test a span is of: the candidate's constants for that test hold in it; shape (m,)."""
    tick: Array
    """Length of a tick, s; shape (m,)."""
    start: NDArray[np.int64]
    """First tick of each span in the flat arrays, then N; shape (m + 1,)."""
    origin: Array
    """Spool position before the first tick of each span, m; shape (m,)."""
    place: Array
    """Jack position before the first tick of each span, m; shape (m,)."""
    history: NDArray[np.int64]
    """Ticks of its test before the first one of each span; shape (m,)."""
    since: NDArray[np.int64]
    """Place of each span's first tick in `current`; shape (m,)."""
    current: Array
    """Of the tests from their beginning, each once, A: what comes before a span has loaded the
    hysteresis; shape (M,)."""
    spool: Array
    pressure: Array
    position: Array
    """Measured, m, Pa, m; NaN where missing; shape (N,)."""
    weight: Array2
    """Reciprocal noise of spool and pressure, and of the position if it counts; 0 where not used;
    shape (signals, N)."""
    anchor: Array2
    """Re-anchoring in each span, see `ehadiag.model.batch.Anchor`; shape (m, 5)."""
