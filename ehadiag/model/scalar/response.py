"""The monitoring model: current in, spool position, differential pressure, jack position out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.anchor import FREE_RUN, Anchor
from ehadiag.model.laws import BEND
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.jack import jack_response
from ehadiag.model.scalar.spool import spool_response
from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK
from ehadiag.model.scalar.transition import spool_tables

__all__ = ["FREE_RUN", "Anchor", "Response", "respond"]


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Modelled response of each tick when it is sampled, arrays of shape (n,)."""

    spool: NDArray[np.float64]
    """m, before any re-anchoring of the tick."""
    pressure: NDArray[np.float64]
    """Pa."""
    position: NDArray[np.float64]
    """m."""
    anchored: int
    """How many times the model was re-anchored."""


def respond(
    constants: PlantConstants,
    current: NDArray[np.float64],
    tick: float,
    *,
    origin: float = 0.0,
    place: float = 0.0,
    history: NDArray[np.float64] | None = None,
    measured: NDArray[np.float64] | None = None,
    anchor: Anchor = FREE_RUN,
) -> Response:
    """Run the monitoring model from rest.

    Parameters
    ----------
    constants: of the candidate; offsets and gains of its sensors are not in the response.
    current: servovalve current of each tick, A, shape (n,).
    tick: length of a tick, s.
    origin, place: spool and jack position before the first tick, m.
    history: current before the first tick, A, shape (h,); None: the hysteresis is unloaded.
    measured: spool position to re-anchor on, m, shape (n,), NaN where missing.
    """
    n = len(current)
    spool, pressure, position = np.empty(n), np.empty(n), np.empty(n)
    nodes = np.empty((n * NODES_PER_TICK, NODE_COLUMNS))
    node_end = np.empty(n, dtype=np.int64)
    plant = PlantConstants(*(float(value) for value in constants))
    tables = spool_tables(plant, tick, BEND)
    reference = np.full(n, np.nan) if measured is None else measured
    anchored = spool_response(
        plant,
        tables,
        current,
        tick,
        origin,
        np.zeros(0) if history is None else history,
        reference,
        anchor.as_array(),
        spool,
        nodes,
        node_end,
    )
    unseen = np.full(n, np.nan)
    jack_response(plant, tick, origin, place, 0.0, unseen, nodes, node_end, pressure, position)
    return Response(spool, pressure, position, anchored)
