"""Spans of recorded tests laid out for the kernels: what candidates are held against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["PRESSURE_ROW", "SIGNALS", "SPOOL_ROW", "Batch", "longest_span"]

SPOOL_ROW, PRESSURE_ROW = 0, 1
SIGNALS = 2
"""Rows of weights and residuals: the signals that a candidate has to explain."""


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
    history : shape (m,)
        Ticks of its test before the first one of each span.
    since : shape (m,)
        Place of each span's first tick in `current`.
    current : shape (M,)
        Of the tests from their beginning, each once, A: what comes before a span has loaded the
        hysteresis.
    spool, pressure : shape (N,)
        Measured, m and Pa, NaN where missing.
    weight : shape (SIGNALS, N)
        Reciprocal noise of spool and pressure, 0 where not used.
    anchor : shape (m, 3)
        Re-anchoring in each span, see `ehadiag.model.anchor.Anchor`.
    """

    test: NDArray[np.int64]
    tick: NDArray[np.float64]
    start: NDArray[np.int64]
    origin: NDArray[np.float64]
    history: NDArray[np.int64]
    since: NDArray[np.int64]
    current: NDArray[np.float64]
    spool: NDArray[np.float64]
    pressure: NDArray[np.float64]
    weight: NDArray[np.float64]
    anchor: NDArray[np.float64]


def longest_span(batch: Batch) -> int:
    """Ticks of the longest span."""
    return int(np.diff(batch.start).max())
