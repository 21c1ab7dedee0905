"""Jack of one lane over a step in which it stops or starts, by the pieces of the spool's path."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined
from ehadiag.model.jack_state import JackState, Piece, Probe
from ehadiag.model.second_stage import jack_piece
from ehadiag.model.sensors import sensing
from ehadiag.model.simd.layout import (
    BUSY,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_VELOCITY,
    LAGGED,
    LANES,
    NODES,
    PRESSURE,
    PRESSURE_SEEN,
    SLOPE,
    jack_law_of_lane,
    sensor_law_of_lane,
)

__all__ = ["jack_events", "keep_lane_jack", "lane_jack"]


@inlined
def lane_jack(state: NDArray[np.float64], i: int) -> JackState:
    """Jack of lane `i`."""
    return JackState(
        state[JACK * LANES + i],
        state[JACK_VELOCITY * LANES + i],
        state[JACK_DIRECTION * LANES + i],
        state[FRESH * LANES + i],
        state[PRESSURE * LANES + i],
        state[LAGGED * LANES + i],
        state[PRESSURE_SEEN * LANES + i],
    )


@inlined
def keep_lane_jack(jack: JackState, state: NDArray[np.float64], i: int) -> None:
    """Write the jack of lane `i`."""
    state[JACK * LANES + i] = jack.place
    state[JACK_VELOCITY * LANES + i] = jack.velocity
    state[JACK_DIRECTION * LANES + i] = jack.direction
    state[FRESH * LANES + i] = jack.fresh
    state[PRESSURE * LANES + i] = jack.pressure
    state[LAGGED * LANES + i] = jack.lagged
    state[PRESSURE_SEEN * LANES + i] = jack.seen


@bare_kernel
def jack_events(
    count: int,
    level: int,
    step: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of BUSY lanes, of the first `count`, over one of the 2^level steps of a tick.

    Piece by piece of the spool's path.
    """
    span, steps = tick / NODES, 1 << level
    begin, stop = step * NODES / steps, (step + 1) * NODES / steps
    first, last = int(begin), math.ceil(stop)
    for i in range(count):
        if state[BUSY * LANES + i] == 0.0:
            continue
        j, jack = jack_law_of_lane(coefficients, i), lane_jack(state, i)
        sensor = sensor_law_of_lane(coefficients, i)
        due, senses = tick - min(sensor.lead, tick), sensing(sensor)
        for n in range(first, last):
            a, b = n * LANES + i, (n + 1) * LANES + i
            rise0, rise1 = span * path[SLOPE * LANES + a], span * path[SLOPE * LANES + b]
            piece = Piece(span, path[a], path[b], rise0, rise1)
            probe = Probe(sensor.lag, due - n * span)
            jack = jack_piece(
                j, probe, senses, piece, max(begin - n, 0.0), min(stop - n, 1.0), jack
            )
        keep_lane_jack(jack, state, i)
