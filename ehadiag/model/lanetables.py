"""Coefficients of many candidates at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanelayout import (
    BREAK,
    DAMPING,
    DRY,
    DYNAMIC,
    JACK_FRICTION,
    LANES,
    MOVE,
    PRESSURE_OFFSET,
    REST,
    ROOM,
    SPOOL_OFFSET,
)
from ehadiag.model.lanevector import WIDTH, load, store
from ehadiag.model.transition import FINEST, TAYLOR_HALVINGS

__all__ = ["GRID", "MOVING_SIZE", "STUCK_SIZE", "tabulate"]

GRID = 1 << FINEST >> 3
"""Finest steps in an eighth of a tick: the longest step of a tick with events."""
MOVING_SIZE = LANES * (GRID + 1) * 16
STUCK_SIZE = (GRID + 1) * 4
TAYLOR_ORDER = 8


@kernel
def _product(
    a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64], n: int, scale: float
) -> None:
    """Product of the n x n matrices of all lanes, times `scale`; flat, element by element."""
    for r in range(n):
        for q in range(n):
            for o in range(0, LANES, WIDTH):
                total = load(a, r * n * LANES + o) * load(b, q * LANES + o)
                for k in range(1, n):
                    x, y = load(a, (r * n + k) * LANES + o), load(b, (k * n + q) * LANES + o)
                    total = total + x * y
                store(out, (r * n + q) * LANES + o, total * scale)


@kernel
def _smallest(rates: NDArray[np.float64], n: int, tick: float) -> NDArray[np.float64]:
    """exp(rates h) for the finest step: Taylor at a still smaller one, then squaring."""
    scaled = rates * (tick / 2.0 ** (FINEST + TAYLOR_HALVINGS))
    term, power, spare = np.zeros_like(rates), np.zeros_like(rates), np.zeros_like(rates)
    for r in range(n):
        start = (r * n + r) * LANES
        term[start : start + LANES] = 1.0
        power[start : start + LANES] = 1.0
    for order in range(1, TAYLOR_ORDER + 1):
        _product(term, scaled, spare, n, 1.0 / order)
        term, spare = spare, term
        power += term
    for _ in range(TAYLOR_HALVINGS):
        _product(power, power, spare, n, 1.0)
        power, spare = spare, power
    return power


@kernel
def tabulate(
    c: PlantConstants,
    tick: float,
    candidates: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Coefficients of all lanes.

    Parameters
    ----------
    candidates: (Kintas, FSS, FDJ, spool offset in m, pressure offset in Pa), shape (LANES, 5).
    coefficients: out, shape (COEFFICIENT_ROWS * LANES,).
    moving: out, transition over j finest steps with the spool moving, lane by lane, shape
        (LANES * (GRID + 1) * 16,).
    stuck: out, the same with the spool at rest, for all lanes, shape ((GRID + 1) * 4,).
    """
    rates, ring = np.zeros(16 * LANES), np.zeros(4 * LANES)
    force = c.AS * c.GPF
    for i in range(LANES):
        flow_gain = c.GQF * (1.0 - 0.8 * candidates[i, 0])
        damping = c.GPF / flow_gain * c.AS * c.AS + c.CS
        static = c.FSS0 + candidates[i, 1] * (c.FSS1 - c.FSS0)
        coefficients[DRY * LANES + i] = 0.5 * static / force
        coefficients[BREAK * LANES + i] = static / force
        coefficients[ROOM * LANES + i] = min(static / force, c.XFM)
        coefficients[DAMPING * LANES + i] = damping
        coefficients[DYNAMIC * LANES + i] = 0.5 * static
        coefficients[JACK_FRICTION * LANES + i] = c.FDJ0 + candidates[i, 2] * (c.FDJ1 - c.FDJ0)
        coefficients[SPOOL_OFFSET * LANES + i] = candidates[i, 3]
        coefficients[PRESSURE_OFFSET * LANES + i] = candidates[i, 4]
        rates[1 * LANES + i], rates[11 * LANES + i] = 1.0, 1.0
        rates[4 * LANES + i], rates[5 * LANES + i], rates[6 * LANES + i] = (
            -c.KF / c.JF,
            -c.CF / c.JF,
            -c.KSF / c.JF,
        )
        rates[12 * LANES + i], rates[15 * LANES + i] = force / c.MS, -damping / c.MS
        ring[1 * LANES + i], ring[2 * LANES + i], ring[3 * LANES + i] = (
            1.0,
            -c.KF / c.JF,
            -c.CF / c.JF,
        )
    one, spare = _smallest(rates, 4, tick), np.empty(16 * LANES)
    power = one.copy()
    for j in range(1, GRID + 1):
        for i in range(LANES):
            for e in range(16):
                moving[(i * (GRID + 1) + j) * 16 + e] = power[e * LANES + i]
        if j < GRID:
            _product(power, one, spare, 4, 1.0)
            power, spare = spare, power
    _product(power, power, spare, 4, 1.0)
    coefficients[MOVE * LANES : (MOVE + 16) * LANES] = spare
    one, spare = _smallest(ring, 2, tick), np.empty(4 * LANES)
    power = one.copy()
    for j in range(1, GRID + 1):
        for e in range(4):
            stuck[j * 4 + e] = power[e * LANES]
        if j < GRID:
            _product(power, one, spare, 2, 1.0)
            power, spare = spare, power
    for _ in range(3):
        _product(power, power, spare, 2, 1.0)
        power, spare = spare, power
    coefficients[REST * LANES : (REST + 4) * LANES] = power
