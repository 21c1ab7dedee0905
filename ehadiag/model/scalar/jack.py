"""Second stage, jack and surface over a whole record: kernel of the monitoring model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.jack_tick import jack_tick

__all__ = ["jack_response"]


@kernel
def jack_response(
    constants: PlantConstants,
    fdj: float,
    origin: float,
    nodes: NDArray[np.float64],
    node_end: NDArray[np.int64],
    pressure: NDArray[np.float64],
    position: NDArray[np.float64],
) -> None:
    """Differential pressure and jack position at the end of every tick, from rest in the middle.

    Parameters
    ----------
    fdj: fault constant `FDJ`, 0 … 1.
    origin: spool position before the first tick, m.
    nodes, node_end: the spool's path, see `ehadiag.model.scalar.spool.spool_response`.
    pressure: out, Pa, shape (n,).
    position: out, m, shape (n,).
    """
    c = constants
    dynamic = c.FDJ0 + fdj * (c.FDJ1 - c.FDJ0)
    velocity, place, direction = 0.0, 0.0, 0.0
    spool = origin
    first = 0
    for k in range(node_end.shape[0]):
        end = node_end[k]
        pressure[k], velocity, place, direction, spool = jack_tick(
            c, dynamic, nodes, first, end, velocity, place, direction, spool
        )
        position[k] = place
        spool += nodes[end - 1, 4]
        first = end
