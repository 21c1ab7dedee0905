"""The flat arrays of recorded data, by time span, that candidate models are compared with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["POSITION_ROW", "PRESSURE_ROW", "SIGNALS", "SPOOL_ROW", "Batch", "longest_span"]

SPOOL_ROW, PRESSURE_ROW, POSITION_ROW = 0, 1, 2
SIGNALS = 3
"""Rows of weights and residuals: the signals that a candidate has to explain. Weights without the
last row leave the jack's position out, and residuals are then without it too."""


class Batch(NamedTuple):
    """Recordings (or spans of them) to explain; m spans, N ticks in all.

    Spans stand one behind the other in flat arrays, so that one compiled function serves any
    number of them.

    Attributes
    ----------
    test : shape (m,)
        Which test a span is of: the candidate's constants for that test hold in it.
    tick : shape (m,)
        Length of a tick, s.
    start : shape (m + 1,)
        First tick of each span in the flat arrays, then N.
    origin : shape (m,)
        Spool position before the first tick of each span, m.
    place : shape (m,)
        Jack position before the first tick of each span, m.
    history : shape (m,)
        Ticks of its test before the first one of each span.
    since : shape (m,)
        Place of each span's first tick in `current`.
    current : shape (M,)
        Of the tests from their beginning, each once, A: what comes before a span has loaded the
        hysteresis.
    spool, pressure, position : shape (N,)
        Measured, m, Pa, m; NaN where missing.
    weight : shape (signals, N)
        Reciprocal noise of spool and pressure, and of the position if it counts; 0 where not used.
    anchor : shape (m, 4)
        Re-anchoring in each span, see `ehadiag.model.anchor.Anchor`.
    """

    test: NDArray[np.int64]
    tick: NDArray[np.float64]
    start: NDArray[np.int64]
    origin: NDArray[np.float64]
    place: NDArray[np.float64]
    history: NDArray[np.int64]
    since: NDArray[np.int64]
    current: NDArray[np.float64]
    spool: NDArray[np.float64]
    pressure: NDArray[np.float64]
    position: NDArray[np.float64]
    weight: NDArray[np.float64]
    anchor: NDArray[np.float64]


def longest_span(batch: Batch) -> int:
    """Ticks of the longest span."""
    return int(np.diff(batch.start).max())
