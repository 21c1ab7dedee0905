"""First stage and spool over one tick, integrated exactly: kernel of the monitoring model.

Between events, flapper and spool obey linear equations with constant coefficients (model.md
section 1, the current being held over a tick), so the state moves by a transition matrix, without
error. Events switch the equations: the flapper meets or leaves a stop; the spool sticks, breaks
away or meets a stop. A step that contains an event is halved until the event is located.
Coefficients depend on one fault constant only, `Kintas`, so the matrices are made once for each
candidate (`ehadiag.model.scalar.transition`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.spool_events import (
    NOTHING,
    clamped_event,
    moving_event,
    stuck_event,
    switch,
)
from ehadiag.model.scalar.transition import FINEST, SpoolScalars

__all__ = ["NODES_PER_TICK", "NODE_COLUMNS", "spool_rest", "spool_tick"]

Matrix = NDArray[np.float64]
BASE = 3
"""Level of the ordinary step: tick / 8."""
WHOLE = 1 << FINEST
"""A tick in units of the finest step."""
NODE_LEVEL = 5
"""Away from events a node is written only at multiples of tick / 2^NODE_LEVEL."""
NODES_PER_TICK = 128
"""Room for nodes of one tick."""
NODE_COLUMNS = 5
LAST = WHOLE - (WHOLE >> BASE)
"""Start of the last ordinary step: pressure at the end of a tick hangs on the last piece most."""
LAST_BEND = 0.002e-6
BEND = 0.05e-6
"""A node is written where the path bends away from its chord by about this much, m."""


@inlined
def _rests(
    c: PlantConstants, t: SpoolScalars, torque: float, xf: float, wf: float, xs: float
) -> bool:
    """Whether a spool at rest stays so while this torque lasts: the flapper rings too little."""
    if t.ring_rate <= 0.0:
        return False
    rest_xf = (torque - c.KSF * xs) / c.KF
    a = xf - rest_xf
    b = (wf + t.ring_damping * a) / t.ring_rate
    return abs(rest_xf) + math.sqrt(a * a + b * b) < min(t.breakaway, c.XFM)


@inlined
def _slide(
    c: PlantConstants,
    t: SpoolScalars,
    m: Matrix,
    torque: float,
    xf: float,
    wf: float,
    xs: float,
    vs: float,
    direction: int,
) -> tuple[float, float, float, float]:
    """Flapper free, spool moving: a step about the point where both would rest."""
    rest_xf = t.dynamic * direction / t.force
    rest_xs = (torque - c.KF * rest_xf) / c.KSF
    a, b = xf - rest_xf, xs - rest_xs
    return (
        rest_xf + m[0, 0] * a + m[0, 1] * wf + m[0, 2] * b + m[0, 3] * vs,
        m[1, 0] * a + m[1, 1] * wf + m[1, 2] * b + m[1, 3] * vs,
        rest_xs + m[2, 0] * a + m[2, 1] * wf + m[2, 2] * b + m[2, 3] * vs,
        m[3, 0] * a + m[3, 1] * wf + m[3, 2] * b + m[3, 3] * vs,
    )


@inlined
def _ring(
    c: PlantConstants, n: Matrix, torque: float, xf: float, wf: float, xs: float
) -> tuple[float, float]:
    """Flapper free, spool at rest: a step of the flapper about its rest."""
    rest_xf = (torque - c.KSF * xs) / c.KF
    a = xf - rest_xf
    return rest_xf + n[0, 0] * a + n[0, 1] * wf, n[1, 0] * a + n[1, 1] * wf


@inlined
def _node_wanted(event: int, done: int, bend: float) -> bool:
    """Whether the path is to have a node here."""
    if event > NOTHING or done == WHOLE:
        return True
    if done & ((WHOLE >> NODE_LEVEL) - 1) != 0:
        return False
    return bend > BEND or (done == LAST and bend > LAST_BEND)


@inlined
def spool_rest(
    c: PlantConstants, t: SpoolScalars, current: float, origin: float
) -> tuple[float, float]:
    """Positions of flapper and spool (m) at rest with a current (A) and the spool at `origin`."""
    xs = min(max(origin, -c.XSM), c.XSM)
    xf = (c.GM * current - c.KSF * xs) / c.KF
    return min(max(xf, -t.breakaway), t.breakaway), xs


@inlined
def spool_tick(
    c: PlantConstants,
    t: SpoolScalars,
    moving: Matrix,
    stuck: Matrix,
    decay: Matrix,
    torque: float,
    tick: float,
    xf: float,
    wf: float,
    xs: float,
    vs: float,
    direction: int,
    clamped: bool,
    nodes: Matrix,
    first: int,
) -> tuple[float, float, float, float, int, bool, int]:
    """Flapper and spool over one tick.

    Parameters
    ----------
    moving, stuck, decay: see `ehadiag.model.scalar.transition.SpoolTables`.
    torque: of the motor, N, held over the tick.
    tick: s.
    xf, wf, xs, vs: position and velocity of flapper and spool, m and m/s.
    direction: of the spool's motion, +1 or -1; 0 at rest.
    clamped: whether the flapper is on its stop.
    nodes: out, shape (at least first + NODES_PER_TICK, NODE_COLUMNS), one row a piece of the path:
        duration (s), position at its end (m), velocity at its start and at its end (m/s); the last
        column, the jump after the piece (m), is set to 0.
    first: index of the tick's first node.

    Returns
    -------
    xf, wf, xs, vs, direction and clamped at the end, and the index one past the last node.
    """
    full = first + NODES_PER_TICK - 1
    count, done, since, level = first, 0, 0, BASE
    if direction == 0 and not clamped and _rests(c, t, torque, xf, wf, xs):
        level = 0
    begin, slowest, fastest = vs, vs, vs
    while done < WHOLE:
        while (WHOLE >> level) > WHOLE - done:
            level += 1
        h = tick / (1 << level)
        new_xf, new_wf, new_xs, new_vs = xf, wf, xs, vs
        if clamped:
            if direction != 0:
                steady = (t.force * xf - t.dynamic * direction) / t.damping
                fade = decay[level]
                new_xs += steady * h + (vs - steady) * (1.0 - fade) * c.MS / t.damping
                new_vs = steady + (vs - steady) * fade
            event = clamped_event(c, t, torque, xf, new_xs, new_vs, direction)
        elif direction != 0:
            new_xf, new_wf, new_xs, new_vs = _slide(
                c, t, moving[level], torque, xf, wf, xs, vs, direction
            )
            event = moving_event(c, t, h, xf, wf, new_xf, new_wf, new_xs, new_vs, direction)
        else:
            new_xf, new_wf = _ring(c, stuck[level], torque, xf, wf, xs)
            event = stuck_event(c, t, h, xf, wf, new_xf, new_wf, xs)
        if level == 0:
            event = NOTHING  # `_rests` has looked
        if event != NOTHING and level < FINEST:
            level += 1
            continue
        end = new_vs
        xf, wf, xs, vs, direction, clamped = switch(
            c, t, event, new_xf, new_wf, new_xs, new_vs, direction, clamped
        )
        done += WHOLE >> level
        since += WHOLE >> level
        slowest, fastest = min(slowest, end), max(fastest, end)
        span = tick * since / WHOLE
        wanted = _node_wanted(event, done, 0.125 * (fastest - slowest) * span)
        if wanted and (done == WHOLE or count < full):
            nodes[count, 0] = span
            nodes[count, 1] = xs
            nodes[count, 2] = begin
            nodes[count, 3] = end
            nodes[count, 4] = 0.0
            count += 1
            begin, slowest, fastest = vs, vs, vs
            since = 0
        if level > BASE and done & ((WHOLE >> (level - 1)) - 1) == 0:
            level -= 1
    return xf, wf, xs, vs, direction, clamped, count
