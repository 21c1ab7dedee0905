"""Transition matrices of flapper and spool for steps of tick / 2^level."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, kernel
from ehadiag.model.exponential import exponential
from ehadiag.model.laws import BEND, SpoolLaw, spool_law
from ehadiag.model.plant import PlantConstants

__all__ = ["FINEST", "SCRATCH", "SpoolTables", "fill_tables", "spool_tables"]

FINEST = 10
"""Finest level; events are located to tick / 2^FINEST (1 µs at 1 kHz)."""
TAYLOR_ORDER = 12
TAYLOR_HALVINGS = 3
SCRATCH = 4
"""Matrices that making the tables takes beside them."""


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


@bare_kernel
def _product(
    left: NDArray[np.float64], right: NDArray[np.float64], n: int, out: NDArray[np.float64]
) -> None:
    """Matrix product of two small squares; a library's would be loaded at each start for it."""
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
            for k in range(n):
                out[i, j] += left[i, k] * right[k, j]


@bare_kernel
def _fill_transition(
    rates: NDArray[np.float64],
    n: int,
    tick: float,
    scratch: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """exp(rates h) for h = tick / 2^level, level 0 … FINEST: Taylor at a small h, then squaring.

    rates: of which the first n rows and columns count; scratch: shape (SCRATCH, 4, 4), overwritten.
    """
    levels = FINEST + TAYLOR_HALVINGS
    shortest = tick / 2.0**levels
    term, power, product = scratch[0], scratch[1], scratch[2]
    for i in range(n):
        for j in range(n):
            term[i, j] = power[i, j] = 1.0 if i == j else 0.0
    for order in range(1, TAYLOR_ORDER + 1):
        _product(term, rates, n, product)
        for i in range(n):
            for j in range(n):
                term[i, j] = product[i, j] * (shortest / order)
                power[i, j] += term[i, j]
    for level in range(levels, -1, -1):
        if level <= FINEST:
            for i in range(n):
                for j in range(n):
                    out[level, i, j] = power[i, j]
        _product(power, power, n, product)
        power, product = product, power


@bare_kernel
def fill_tables(
    constants: PlantConstants,
    law: SpoolLaw,
    tick: float,
    scratch: NDArray[np.float64],
    moving: NDArray[np.float64],
    loose: NDArray[np.float64],
    stuck: NDArray[np.float64],
    decay: NDArray[np.float64],
) -> None:
    """Write the transition matrices of a candidate, see `SpoolTables`, allocating nothing.

    scratch: shape (SCRATCH, 4, 4), overwritten.
    """
    c, rates = constants, scratch[3]
    for i in range(4):
        for j in range(4):
            rates[i, j] = 0.0
    rates[0, 1] = 1.0
    rates[1, 0] = -c.KF / c.JF
    rates[1, 1] = -c.CF / c.JF
    _fill_transition(rates, 2, tick, scratch, stuck)
    rates[2, 3] = 1.0
    rates[3, 0] = law.force / c.MS
    rates[3, 3] = -law.damping / c.MS
    _fill_transition(rates, 4, tick, scratch, loose)
    rates[1, 2] = -c.KSF / c.JF
    _fill_transition(rates, 4, tick, scratch, moving)
    for level in range(FINEST + 1):
        decay[level] = exponential(-(tick * law.damping / c.MS) / 2.0**level)


@kernel
def spool_tables(constants: PlantConstants, tick: float, bend: float = BEND) -> SpoolTables:
    """Law and transition matrices of a candidate, tick in s; bend: see `spool_law`."""
    law = spool_law(constants, bend)
    moving, loose = np.empty((FINEST + 1, 4, 4)), np.empty((FINEST + 1, 4, 4))
    stuck, decay = np.empty((FINEST + 1, 2, 2)), np.empty(FINEST + 1)
    fill_tables(constants, law, tick, np.empty((SCRATCH, 4, 4)), moving, loose, stuck, decay)
    return SpoolTables(moving=moving, loose=loose, stuck=stuck, decay=decay, law=law)
