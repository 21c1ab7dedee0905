"""Second stage, jack and surface over a whole record: kernel of the monitoring model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.jack import JackState, jack_tick
from ehadiag.model.laws import jack_law
from ehadiag.model.plant import PlantConstants

__all__ = ["jack_response"]


@kernel
def jack_response(
    constants: PlantConstants,
    origin: float,
    nodes: NDArray[np.float64],
    node_end: NDArray[np.int64],
    pressure: NDArray[np.float64],
    position: NDArray[np.float64],
) -> None:
    """Differential pressure and jack position at the end of every tick, from rest in the middle.

    Parameters
    ----------
    origin: spool position before the first tick, m.
    nodes, node_end: the spool's path, see `ehadiag.model.scalar.spool.spool_response`.
    pressure: out, Pa, shape (n,).
    position: out, m, shape (n,).
    """
    law = jack_law(constants)
    jack = JackState(0.0, 0.0, 0.0, 0.0)
    spool, first = origin, 0
    for k in range(node_end.shape[0]):
        end = node_end[k]
        pressure[k], jack, spool = jack_tick(law, nodes, first, end, jack, spool)
        position[k] = jack.place
        spool += nodes[end - 1, 4]
        first = end
