"""Second stage and jack over the spool's path, whichever second stage the actuator's file names."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined
from ehadiag.model.jack import limited, linear_piece, sensed_linear_piece, still_pressure
from ehadiag.model.jack_state import JackState, Piece, Probe
from ehadiag.model.lands import open_piece, opens
from ehadiag.model.laws import JackLaw, pressure
from ehadiag.model.orifice import orifice_piece, sensed_orifice_piece
from ehadiag.model.sensors import SensorLaw, sensing

__all__ = ["jack_piece", "jack_rest", "jack_tick"]


@bare_kernel
def _other_piece(
    j: JackLaw, probe: Probe, senses: bool, p: Piece, begin: float, stop: float, state: JackState
) -> JackState:
    """Jack over a piece where it is not the plain one."""
    if j.oil > 0.0:
        if senses:
            return sensed_orifice_piece(j, probe, p, begin, stop, state)
        return orifice_piece(j, probe, p, begin, stop, state)
    return sensed_linear_piece(j, probe, p, begin, stop, state)


@inlined
def jack_piece(
    j: JackLaw, probe: Probe, senses: bool, p: Piece, begin: float, stop: float, state: JackState
) -> JackState:
    """Jack over the shares begin … stop of a piece of the spool's path.

    senses: whether the pressure is to be followed as its sensor sees it.
    """
    if senses or j.oil > 0.0 or j.extra > 0.0:
        return _other_piece(j, probe, senses, p, begin, stop, state)
    return linear_piece(j, p, begin, stop, state)


@inlined
def jack_rest(j: JackLaw, place: float, spool: float) -> JackState:
    """Jack at rest, jack and spool at these positions, m."""
    p12 = still_pressure(j, opens(j, spool))
    return JackState(place, 0.0, 0.0, 0.0, p12, p12, p12)


@inlined
def jack_tick(
    j: JackLaw,
    sensor: SensorLaw,
    tick: float,
    nodes: NDArray[np.float64],
    first: int,
    end: int,
    state: JackState,
    spool: float,
) -> tuple[float, JackState, float]:
    """Second stage and jack over the spool's path of one tick.

    Parameters
    ----------
    tick: s.
    nodes, first, end: the path, rows first … end - 1, see `ehadiag.model.scalar.spool_tick`.
    spool: position before the tick, m.

    Returns
    -------
    Differential pressure when it is sampled (Pa), jack and spool at the end of the tick. Jumps of
    the path are the caller's.
    """
    due, senses = tick - min(sensor.lead, tick), sensing(sensor)
    for node in range(first, end):
        span, x1 = nodes[node, 0], nodes[node, 1]
        piece = Piece(span, spool, x1, span * nodes[node, 2], span * nodes[node, 3])
        piece = open_piece(j, piece)
        state = jack_piece(j, Probe(sensor.lag, due), senses, piece, 0.0, 1.0, state)
        due -= span
        spool = x1
    if senses:
        return state.seen, state, spool
    if j.oil > 0.0:
        return state.pressure, state, spool
    opening = opens(j, spool) if j.shaped != 0.0 else spool
    return limited(j, pressure(j, opening, state.velocity)), state, spool
