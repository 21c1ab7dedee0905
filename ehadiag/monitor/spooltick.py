"""First stage and spool over one tick."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined, kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.spool import (
    BASE,
    BEND,
    BREAKAWAY,
    FLAPPER_STOP,
    LAST,
    LAST_BEND,
    NODE_LEVEL,
    NODES_PER_TICK,
    NOTHING,
    RELEASE,
    REVERSAL,
    SPOOL_STOP,
    WHOLE,
    _clamped_event,
    _moving_event,
    _rests,
    _stuck_event,
)
from ehadiag.model.transition import FINEST, SpoolScalars
from ehadiag.monitor.layout import CLAMPED, DIRECTION, VS, WF, XF, XS

__all__ = ["spool_tick"]

Vector = NDArray[np.float64]


@inlined
def _slide(
    c: PlantConstants,
    t: SpoolScalars,
    m: Vector,
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
    c: PlantConstants, n: Vector, torque: float, xf: float, wf: float, xs: float
) -> tuple[float, float]:
    """Flapper free, spool at rest: a step of the flapper about its rest."""
    rest_xf = (torque - c.KSF * xs) / c.KF
    a = xf - rest_xf
    return rest_xf + n[0, 0] * a + n[0, 1] * wf, n[1, 0] * a + n[1, 1] * wf


@inlined
def _switch(
    c: PlantConstants,
    t: SpoolScalars,
    event: int,
    xf: float,
    wf: float,
    xs: float,
    vs: float,
    direction: int,
    clamped: bool,
) -> tuple[float, float, float, float, int, bool]:
    """State after an event."""
    if event == REVERSAL:
        vs, direction = 0.0, 0
        if abs(xf) > t.breakaway:
            direction = 1 if xf > 0.0 else -1
    elif event == SPOOL_STOP:
        xs, vs, direction = math.copysign(c.XSM, xs), 0.0, 0
    elif event == BREAKAWAY:
        direction = 1 if xf > 0.0 else -1
    elif event == FLAPPER_STOP:
        xf, wf, clamped = math.copysign(c.XFM, xf), 0.0, True
    elif event == RELEASE:
        clamped = False
    return xf, wf, xs, vs, direction, clamped


@inlined
def _node_wanted(event: int, done: int, bend: float) -> bool:
    """Whether the path is to have a node here."""
    if event > NOTHING or done == WHOLE:
        return True
    if done & ((WHOLE >> NODE_LEVEL) - 1) != 0:
        return False
    return bend > BEND or (done == LAST and bend > LAST_BEND)


@kernel
def spool_tick(
    c: PlantConstants,
    t: SpoolScalars,
    moving: Vector,
    stuck: Vector,
    decay: Vector,
    torque: float,
    tick: float,
    state: Vector,
    nodes: Vector,
) -> int:
    """Advance flapper and spool by one tick, in place; returns the number of nodes written.

    For the form of nodes see `ehadiag.model.spool.spool_response`; jumps are left out.
    """
    xf, wf, xs, vs = state[XF], state[WF], state[XS], state[VS]
    direction, clamped = int(state[DIRECTION]), state[CLAMPED] != 0.0
    count, done, since, level = 0, 0, 0, BASE
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
            event = _clamped_event(c, t, torque, xf, new_xs, new_vs, direction)
        elif direction != 0:
            new_xf, new_wf, new_xs, new_vs = _slide(
                c, t, moving[level], torque, xf, wf, xs, vs, direction
            )
            event = _moving_event(c, t, h, xf, wf, new_xf, new_wf, new_xs, new_vs, direction)
        else:
            new_xf, new_wf = _ring(c, stuck[level], torque, xf, wf, xs)
            event = _stuck_event(c, t, h, xf, wf, new_xf, new_wf, xs)
        if level == 0:
            event = NOTHING  # `_rests` has looked
        if event != NOTHING and level < FINEST:
            level += 1
            continue
        end = new_vs
        xf, wf, xs, vs, direction, clamped = _switch(
            c, t, event, new_xf, new_wf, new_xs, new_vs, direction, clamped
        )
        done += WHOLE >> level
        since += WHOLE >> level
        slowest, fastest = min(slowest, end), max(fastest, end)
        span = tick * since / WHOLE
        wanted = _node_wanted(event, done, 0.125 * (fastest - slowest) * span)
        if wanted and (done == WHOLE or count < NODES_PER_TICK - 1):
            nodes[count, 0] = span
            nodes[count, 1] = xs
            nodes[count, 2] = begin
            nodes[count, 3] = end
            count += 1
            begin, slowest, fastest = vs, vs, vs
            since = 0
        if level > BASE and done & ((WHOLE >> (level - 1)) - 1) == 0:
            level -= 1
    state[XF], state[WF], state[XS], state[VS] = xf, wf, xs, vs
    state[DIRECTION], state[CLAMPED] = direction, 1.0 if clamped else 0.0
    return count
