"""First stage and spool over one tick, integrated exactly: kernel of the monitoring model.

Between events, flapper and spool obey linear equations with constant coefficients (PHY-4,
PHY-5, the current being held over a tick), so the state moves by a transition matrix, without
error. Events switch the equations: the flapper meets or leaves a stop; the spool sticks, breaks
away or meets a stop. A step that contains an event is halved until the event is located.
The matrices are made once for each candidate (`ehadiag.model.scalar.transition`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined
from ehadiag.model.laws import (
    SpoolLaw,
    flapper_held,
    play,
    slide_base,
    steady_rate,
    still_flapper,
)
from ehadiag.model.scalar.transition import FINEST, SpoolTables
from ehadiag.model.sensors import LATE, SensorLaw, followed, following, sensing, through_ends
from ehadiag.model.spool_creep import Transition, creeping_step
from ehadiag.model.spool_events import (
    NOTHING,
    UNSURE,
    SpoolState,
    carried,
    clamped_event,
    moving_event,
    stuck_event,
    switch,
)

__all__ = ["NODES_PER_TICK", "NODE_COLUMNS", "sensed_path", "spool_rest", "spool_tick"]

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
"""A node is written where the path bends away from its chord by `SpoolLaw.bend`, at the end of a
tick by this much, m."""


@inlined
def _rests(t: SpoolLaw, deflection: float, s: SpoolState) -> bool:
    """Whether a spool at rest stays so while this current lasts: the flapper rings too little."""
    if t.ring_rate <= 0.0:
        return False
    still = still_flapper(t.ratio, deflection, s.wire)
    a = s.xf - still
    b = (s.wf + t.ring_damping * a) / t.ring_rate
    return abs(still) + math.sqrt(a * a + b * b) < min(t.breakaway, t.flapper_stop)


@inlined
def _slide(t: SpoolLaw, m: Matrix, deflection: float, s: SpoolState) -> SpoolState:
    """Flapper free, spool moving: a step about the point where both would rest."""
    rest_xf = t.dry * s.direction
    rest_xs = slide_base(t, deflection, float(s.direction))
    a, w, b, v = s.xf - rest_xf, s.wf, s.xs - rest_xs, s.vs
    return SpoolState(
        rest_xf + m[0, 0] * a + m[0, 1] * w + m[0, 2] * b + m[0, 3] * v,
        m[1, 0] * a + m[1, 1] * w + m[1, 2] * b + m[1, 3] * v,
        rest_xs + m[2, 0] * a + m[2, 1] * w + m[2, 2] * b + m[2, 3] * v,
        m[3, 0] * a + m[3, 1] * w + m[3, 2] * b + m[3, 3] * v,
        s.wire,
        s.direction,
        s.clamped,
    )


@inlined
def _slide_loose(t: SpoolLaw, m: Matrix, h: float, deflection: float, s: SpoolState) -> SpoolState:
    """Flapper free, spool moving within its backlash: the wire stays, the flapper rings."""
    still = still_flapper(t.ratio, deflection, s.wire)
    steady = steady_rate(t, still, float(s.direction))
    a, w, v = s.xf - still, s.wf, s.vs - steady
    return SpoolState(
        still + m[0, 0] * a + m[0, 1] * w,
        m[1, 0] * a + m[1, 1] * w,
        s.xs + steady * h + m[2, 0] * a + m[2, 1] * w + m[2, 3] * v,
        steady + m[3, 0] * a + m[3, 1] * w + m[3, 3] * v,
        s.wire,
        s.direction,
        s.clamped,
    )


@inlined
def _ring(t: SpoolLaw, n: Matrix, deflection: float, s: SpoolState) -> SpoolState:
    """Flapper free, spool at rest: a step of the flapper about its rest."""
    still = still_flapper(t.ratio, deflection, s.wire)
    a = s.xf - still
    return SpoolState(
        still + n[0, 0] * a + n[0, 1] * s.wf,
        n[1, 0] * a + n[1, 1] * s.wf,
        s.xs,
        s.vs,
        s.wire,
        s.direction,
        s.clamped,
    )


@inlined
def _slide_clamped(t: SpoolLaw, h: float, fade: float, s: SpoolState) -> SpoolState:
    """Flapper on its stop, spool moving: its velocity decays towards a steady one."""
    steady = steady_rate(t, s.xf, float(s.direction))
    xs = s.xs + steady * h + (s.vs - steady) * (1.0 - fade) * t.mass / t.damping
    vs = steady + (s.vs - steady) * fade
    return SpoolState(s.xf, s.wf, xs, vs, s.wire, s.direction, s.clamped)


@inlined
def _creep(
    tables: SpoolTables, level: int, h: float, deflection: float, loose: bool, s: SpoolState
) -> tuple[SpoolState, bool]:
    """Spool moving with friction that falls with its velocity, flapper free or on its stop."""
    m = tables.loose[level] if loose else tables.moving[level]
    transition = Transition(
        m[0, 0], m[0, 1], m[0, 2], m[0, 3], m[1, 0], m[1, 1], m[1, 2], m[1, 3],
        m[2, 0], m[2, 1], m[2, 2], m[2, 3], m[3, 0], m[3, 1], m[3, 2], m[3, 3],
    )  # fmt: skip
    return creeping_step(tables.law, transition, h, tables.decay[level], deflection, loose, s)


@inlined
def _node_wanted(t: SpoolLaw, event: int, done: int, bend: float) -> bool:
    """Whether the path is to have a node here."""
    if event > NOTHING or done == WHOLE:
        return True
    if done & ((WHOLE >> NODE_LEVEL) - 1) != 0:
        return False
    return bend > t.bend or (done == LAST and bend > LAST_BEND)


@inlined
def spool_rest(t: SpoolLaw, deflection: float, origin: float) -> SpoolState:
    """Flapper and spool at rest, the spool at `origin` (m) within its stroke."""
    xs = min(max(origin, -t.stroke), t.stroke)
    return SpoolState(flapper_held(t, deflection, xs), 0.0, xs, 0.0, xs, 0, False)


@inlined
def spool_tick(
    tables: SpoolTables,
    deflection: float,
    tick: float,
    state: SpoolState,
    nodes: Matrix,
    first: int,
) -> tuple[SpoolState, int]:
    """Flapper and spool over one tick.

    Parameters
    ----------
    deflection: of the flapper by the current alone, held over the tick, m.
    tick: s.
    state: before.
    nodes: out, shape (at least first + NODES_PER_TICK, NODE_COLUMNS), one row a piece of the path:
        duration (s), position at its end (m), velocity at its start and at its end (m/s); the last
        column, the jump after the piece (m), is set to 0.
    first: index of the tick's first node.

    Returns
    -------
    State at the end, and the index one past the last node.
    """
    t = tables.law
    full = first + NODES_PER_TICK - 1
    count, done, since, level = first, 0, 0, BASE
    s = state
    if s.direction == 0 and not s.clamped and _rests(t, deflection, s):
        level = 0
    begin, slowest, fastest = s.vs, s.vs, s.vs
    while done < WHOLE:
        while (WHOLE >> level) > WHOLE - done:
            level += 1
        h = tick / (1 << level)
        new, sure = s, True
        loose = s.direction != 0 and not carried(t, s.direction, s.xs, s.wire)
        creeps = s.direction != 0 and t.extra > 0.0
        if creeps:
            new, sure = _creep(tables, level, h, deflection, loose, s)
        if s.clamped:
            if s.direction != 0 and not creeps:
                new = _slide_clamped(t, h, tables.decay[level], s)
            wire = play(s.wire, new.xs, t.backlash)
            event = clamped_event(t, deflection, s.xf, new.xs, new.vs, wire, s.direction)
        elif s.direction != 0:
            if loose and not creeps:
                new = _slide_loose(t, tables.loose[level], h, deflection, s)
            elif not creeps:
                new = _slide(t, tables.moving[level], deflection, s)
            event = moving_event(
                t, h, s.xf, s.wf, new.xf, new.wf, new.xs, new.vs, s.wire, loose, s.direction
            )
        else:
            new = _ring(t, tables.stuck[level], deflection, s)
            event = stuck_event(t, h, s.xf, s.wf, new.xf, new.wf, s.xs)
        if level == 0:
            event = NOTHING  # `_rests` has looked
        elif event == NOTHING and not sure:
            event = UNSURE
        if event != NOTHING and level < FINEST:
            level += 1
            continue
        end = new.vs
        s = switch(t, event, new)
        done += WHOLE >> level
        since += WHOLE >> level
        slowest, fastest = min(slowest, end), max(fastest, end)
        span = tick * since / WHOLE
        wanted = _node_wanted(t, event, done, 0.125 * (fastest - slowest) * span)
        if wanted and (done == WHOLE or count < full):
            nodes[count, 0] = span
            nodes[count, 1] = s.xs
            nodes[count, 2] = begin
            nodes[count, 3] = end
            nodes[count, 4] = 0.0
            count += 1
            begin, slowest, fastest = s.vs, s.vs, s.vs
            since = 0
        if level > BASE and done & ((WHOLE >> (level - 1)) - 1) == 0:
            level -= 1
    return s, count


@inlined
def sensed_path(
    law: SensorLaw, tick: float, nodes: Matrix, first: int, end: int, before: float, lagged: float
) -> tuple[float, float]:
    """Spool as its sensor samples it in a tick, and behind the filter at the tick's end, m.

    nodes, first, end: the tick's path; before: position before it, m; lagged: behind the filter, m.
    """
    if not sensing(law):
        return nodes[end - 1, 1], nodes[end - 1, 1]
    due, seen, x0 = tick - min(law.lead, tick), lagged, before
    for node in range(first, end):
        span, x1 = nodes[node, 0], nodes[node, 1]
        cubic = through_ends(x0, x1, span * nodes[node, 2], span * nodes[node, 3])
        if 0.0 < due <= LATE * span:
            seen = followed(following(law.lag, span, due), lagged, cubic)
        lagged = followed(following(law.lag, span, span), lagged, cubic)
        due -= span
        x0 = x1
    return seen, lagged
