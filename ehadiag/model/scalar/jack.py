"""Second stage, jack and surface over a whole record: kernel of the monitoring model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.jack_state import JackState
from ehadiag.model.laws import jack_law
from ehadiag.model.plant import PlantConstants
from ehadiag.model.second_stage import jack_rest, jack_tick
from ehadiag.model.sensors import sensor_law

__all__ = ["jack_response"]


@kernel
def jack_response(
    constants: PlantConstants,
    tick: float,
    origin: float,
    place: float,
    follow: float,
    measured: NDArray[np.float64],
    nodes: NDArray[np.float64],
    node_end: NDArray[np.int64],
    pressure: NDArray[np.float64],
    position: NDArray[np.float64],
) -> None:
    """Differential pressure and jack position of every tick, as they are sampled, from rest.

    Parameters
    ----------
    tick: s.
    origin: spool position before the first tick, m.
    place: jack position there, m.
    follow: see `ehadiag.model.anchor.Anchor`.
    measured: measured jack position, m, shape (n,), NaN where missing; used only to re-anchor.
    nodes, node_end: the spool's path, see `ehadiag.model.scalar.spool.spool_response`.
    pressure: out, Pa, shape (n,).
    position: out, m, shape (n,), before any re-anchoring of the tick.
    """
    law, sensor = jack_law(constants), sensor_law(constants)
    jack = jack_rest(law, place, origin)
    spool, first = origin, 0
    for k in range(node_end.shape[0]):
        end = node_end[k]
        pressure[k], jack, spool = jack_tick(law, sensor, tick, nodes, first, end, jack, spool)
        position[k] = jack.place - sensor.lead * jack.velocity
        move = follow * (measured[k] - sensor.position_offset - sensor.position_gain * position[k])
        if math.isfinite(move):
            jack = JackState(
                min(max(jack.place + move, -law.stroke), law.stroke),
                jack.velocity, jack.direction, jack.fresh,
                jack.pressure, jack.lagged, jack.seen,
            )  # fmt: skip
        spool += nodes[end - 1, 4]
        first = end
