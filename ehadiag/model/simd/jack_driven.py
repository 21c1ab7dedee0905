"""Jacks of many candidates along one path of the spool, as it was measured."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.compile.vector import WIDTH, least, load, store
from ehadiag.model.lands import opens
from ehadiag.model.laws import jack_law
from ehadiag.model.plant import plant_of
from ehadiag.model.sensors import read_pressure, sensor_law
from ehadiag.model.simd.jack import pressures, rest_jacks
from ehadiag.model.simd.jack_pieces import PIECES_SIZE, jack_over_pieces
from ehadiag.model.simd.layout import (
    COEFFICIENT_ROWS,
    LANES,
    NODES,
    PATH_ROWS,
    PLACE,
    PRESSURE_SEEN,
    STATE_ROWS,
    jack_laws,
    keep_jack_law,
    keep_sensor_law,
    sensor_laws,
)

__all__ = ["driven_costs"]


@kernel
def driven_costs(
    candidates: NDArray[np.float64],
    nodes: NDArray[np.float64],
    before: float,
    pressure: NDArray[np.float64],
    noise: float,
    cap: float,
) -> NDArray[np.float64]:
    """Capped squared pressure residuals of candidates, from rest: shape (n,).

    Parameters
    ----------
    candidates: rows of physical constants, shape (n, FIELDS).
    nodes: the spool's path, a piece each tick: duration (s), position at its end (m), velocities at
        start and end (m/s); shape (ticks, 4 or more).
    before: position before, m.
    pressure: measured, Pa, shape (ticks,), NaN where missing.
    noise: of it, Pa.
    """
    out, sums = np.zeros(candidates.shape[0]), np.zeros(LANES)
    state, path = np.zeros(STATE_ROWS * LANES), np.zeros(PATH_ROWS * LANES)
    coefficients, pieces = np.zeros(COEFFICIENT_ROWS * LANES), np.zeros(PIECES_SIZE)
    for first in range(0, candidates.shape[0], LANES):
        here = min(LANES, candidates.shape[0] - first)
        end = WIDTH if here <= WIDTH else LANES
        for i in range(LANES):
            c = plant_of(candidates[first + min(i, here - 1)])
            keep_jack_law(coefficients, i, jack_law(c))
            keep_sensor_law(coefficients, i, sensor_law(c))
        state[:] = 0.0
        sums[:] = 0.0
        rest_jacks(end, before, 0.0, state, coefficients)
        from_xs = before
        for k in range(nodes.shape[0]):
            tick, to_xs = nodes[k, 0], nodes[k, 1]
            for lane in range(WIDTH):
                pieces[lane], pieces[WIDTH + lane] = tick, to_xs
                pieces[2 * WIDTH + lane] = nodes[k, 2]
                pieces[3 * WIDTH + lane] = nodes[k, 3]
            for o in range(0, end, WIDTH):
                j = jack_laws(coefficients, o)
                every = j.load * 0.0 + 1.0
                store(path, PLACE * LANES + o, every * from_xs)
                jack_over_pieces(o, every, 1, tick, state, path, coefficients, pieces)
                store(path, (PLACE + NODES) * LANES + o, opens(j, every * to_xs))
            from_xs = to_xs
            if math.isfinite(pressure[k]):
                pressures(end, True, state, path, coefficients)
                for o in range(0, end, WIDTH):
                    seen = load(state, PRESSURE_SEEN * LANES + o)
                    shown = read_pressure(sensor_laws(coefficients, o), seen)
                    residual = (pressure[k] - shown) * (1.0 / noise)
                    store(sums, o, load(sums, o) + least(residual * residual, cap))
        for i in range(here):
            out[first + i] = sums[i]
    return out
