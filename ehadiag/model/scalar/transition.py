"""Transition matrices of flapper and spool for steps of tick / 2^level."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.laws import SpoolLaw, spool_law
from ehadiag.model.plant import PlantConstants

__all__ = ["FINEST", "SpoolTables", "spool_tables"]

FINEST = 10
"""Finest level; events are located to tick / 2^FINEST (1 µs at 1 kHz)."""
TAYLOR_ORDER = 12
TAYLOR_HALVINGS = 3


class SpoolTables(NamedTuple):
    """Coefficients of one candidate; of the arrays one row a level.

    moving: shape (FINEST + 1, 4, 4), flapper free, spool moving; state (XF, DXF, XS, DXS).
    loose: the same without the feedback wire, shape (FINEST + 1, 4, 4).
    stuck: shape (FINEST + 1, 2, 2), flapper free, spool at rest; state (XF, DXF).
    decay: shape (FINEST + 1,), exp(-h / tau) of the spool velocity with the flapper on a stop.
    """

    moving: NDArray[np.float64]
    loose: NDArray[np.float64]
    stuck: NDArray[np.float64]
    decay: NDArray[np.float64]
    law: SpoolLaw


@kernel
def _product(
    left: NDArray[np.float64], right: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Matrix product of two small squares; a library's would be loaded at each start for it."""
    n = left.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
            for k in range(n):
                out[i, j] += left[i, k] * right[k, j]


@kernel
def _transition(rates: NDArray[np.float64], tick: float) -> NDArray[np.float64]:
    """exp(rates h) for h = tick / 2^level, level 0 … FINEST: Taylor at a small h, then squaring."""
    n = rates.shape[0]
    levels = FINEST + TAYLOR_HALVINGS
    shortest = tick / 2.0**levels
    term, power, product = np.zeros((n, n)), np.zeros((n, n)), np.empty((n, n))
    for i in range(n):
        term[i, i] = power[i, i] = 1.0
    for order in range(1, TAYLOR_ORDER + 1):
        _product(term, rates, product)
        for i in range(n):
            for j in range(n):
                term[i, j] = product[i, j] * (shortest / order)
                power[i, j] += term[i, j]
    out = np.empty((FINEST + 1, n, n))
    for level in range(levels, -1, -1):
        if level <= FINEST:
            for i in range(n):
                for j in range(n):
                    out[level, i, j] = power[i, j]
        _product(power, power, product)
        power, product = product, power
    return out


@kernel
def spool_tables(constants: PlantConstants, tick: float) -> SpoolTables:
    """Law and transition matrices of a candidate, tick in s."""
    c = constants
    law = spool_law(c)
    rates = np.zeros((4, 4))
    rates[0, 1] = 1.0
    rates[1, 0] = -c.KF / c.JF
    rates[1, 1] = -c.CF / c.JF
    rates[1, 2] = -c.KSF / c.JF
    rates[2, 3] = 1.0
    rates[3, 0] = law.force / c.MS
    rates[3, 3] = -law.damping / c.MS
    without = rates.copy()
    without[1, 2] = 0.0
    decay = np.empty(FINEST + 1)
    for level in range(FINEST + 1):
        decay[level] = math.exp(-(tick * law.damping / c.MS) / 2.0**level)
    return SpoolTables(
        moving=_transition(rates, tick),
        loose=_transition(without, tick),
        stuck=_transition(rates[:2, :2].copy(), tick),
        decay=decay,
        law=law,
    )
