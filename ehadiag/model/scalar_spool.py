"""Torque motor, first stage and spool of one candidate, tick by tick: scalar kernels.

Between events flapper and spool obey linear equations with constant coefficients (PHY-4, PHY-5), so
the state moves by a transition matrix without error. A step that contains an event is halved until
the event is located.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.elementary import exponential
from ehadiag.compile.jit import Array, Array2, Array3, bare_kernel, inlined, kernel
from ehadiag.model.batch import anchored_spool
from ehadiag.model.laws import (
    DriveLaw,
    SpoolLaw,
    clamped_spool_velocity,
    drive_law,
    flapper_rest,
    held_flapper,
    lagged_current,
    motor_deflection,
    play_output,
    spool_law,
    spool_rest_position,
    steady_spool_velocity,
)
from ehadiag.model.plant import PlantConstants
from ehadiag.model.sensors import (
    MAX_INSTANT_SHARE,
    SensorLaw,
    cubic_through_ends,
    filter_output,
    filter_step,
    has_sensor_dynamics,
    read_spool,
    sensor_law,
)
from ehadiag.model.spool_events import (
    EVENTS,
    SpoolState,
    StepTransition,
    clamped_event,
    creep_step,
    is_wire_carried,
    moving_event,
    state_after_event,
    stuck_event,
)


class SpoolGrid(NamedTuple):
    """Steps, tables and path of the spool in a tick."""

    finest_level: int = 10
    """Halvings of a tick to which events are located, 1: 1 µs at 1 kHz."""
    base_level: int = 3
    """Halvings of a tick that make the ordinary step, 1."""
    node_level: int = 5
    """Halvings of a tick at whose multiples nodes are written away from events, 1."""
    nodes: int = 128
    """Room for nodes of one tick, 1."""
    columns: int = 5
    """Numbers of a node, 1."""
    last_bend: float = 0.002e-6
    """Bend of the path from which a node is written at the end of a tick, m; elsewhere that of
    `SpoolLaw.bend`."""
    taylor_order: int = 12
    """Order of the series of a transition, 1."""
    taylor_halvings: int = 3
    """Halvings of the finest step for that series, 1."""
    scratch: int = 4
    """Matrices that computing the tables takes as scratch, 1."""


SPOOL_GRID = SpoolGrid()


MAX_PLAYS = 16
"""Largest number of plays of the hysteresis, 1."""


class SpoolTables(NamedTuple):
    """Coefficients of one candidate; of the arrays one row a level.

    moving: 4 x 4, flapper free, spool moving; state (XF, DXF, XS, DXS). loose: the same without the
    feedback wire. stuck: 2 x 2, flapper free, spool at rest; state (XF, DXF). decay: exp(-h / tau)
    of the spool velocity with the flapper on a stop.
    """

    moving: Array
    loose: Array
    stuck: Array
    decay: Array
    law: SpoolLaw


@bare_kernel
def _product(left: Array, right: Array, n: int, out: Array) -> None:
    """Array product of two small squares; a library's would be loaded at each start for it."""
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
            for k in range(n):
                out[i, j] += left[i, k] * right[k, j]


@bare_kernel
def _fill_transition(rates: Array, n: int, tick: float, scratch: Array, out: Array) -> None:
    """exp(rates h) for h = tick / 2^level, level 0 … finest_level: Taylor at a small h, then
    squaring.

    rates: of which the first n rows and columns count; scratch: shape (SPOOL_GRID.scratch, 4, 4),
    overwritten.
    """
    levels = SPOOL_GRID.finest_level + SPOOL_GRID.taylor_halvings
    shortest = tick / float(1 << levels)
    term, power, product = scratch[0], scratch[1], scratch[2]
    for i in range(n):
        for j in range(n):
            term[i, j] = power[i, j] = 1.0 if i == j else 0.0
    for order in range(1, SPOOL_GRID.taylor_order + 1):
        _product(term, rates, n, product)
        for i in range(n):
            for j in range(n):
                term[i, j] = product[i, j] * (shortest / order)
                power[i, j] += term[i, j]
    for level in range(levels, -1, -1):
        if level <= SPOOL_GRID.finest_level:
            for i in range(n):
                for j in range(n):
                    out[level, i, j] = power[i, j]
        _product(power, power, n, product)
        power, product = product, power


@bare_kernel
def fill_tables(
    constants: PlantConstants,
    law: SpoolLaw,
    tick: float,
    scratch: Array,
    moving: Array,
    loose: Array,
    stuck: Array,
    decay: Array,
) -> None:
    """Write the transition matrices of a candidate, see `SpoolTables`, allocating nothing.

    scratch: shape (SPOOL_GRID.scratch, 4, 4), overwritten.
    """
    c, rates = constants, scratch[3]
    for i in range(4):
        for j in range(4):
            rates[i, j] = 0.0
    rates[0, 1] = 1.0
    rates[1, 0] = -c.KF / c.JF
    rates[1, 1] = -c.CF / c.JF
    _fill_transition(rates, 2, tick, scratch, stuck)
    rates[2, 3] = 1.0
    rates[3, 0] = law.force / c.MS
    rates[3, 3] = -law.damping / c.MS
    _fill_transition(rates, 4, tick, scratch, loose)
    rates[1, 2] = -c.KSF / c.JF
    _fill_transition(rates, 4, tick, scratch, moving)
    for level in range(SPOOL_GRID.finest_level + 1):
        decay[level] = exponential(-(tick * law.damping / c.MS) / float(1 << level))


class SpoolScratch(NamedTuple):
    """Memory of `spool_response`: arrays of `SpoolTables`, and what it computes them in."""

    moving: Array3
    loose: Array3
    stuck: Array3
    decay: Array
    matrices: Array3
    held: Array
    """What the plays hold, A."""


def spool_scratch() -> SpoolScratch:
    """Memory of `spool_response`."""
    levels = SPOOL_GRID.finest_level + 1
    return SpoolScratch(
        moving=np.empty((levels, 4, 4)),
        loose=np.empty((levels, 4, 4)),
        stuck=np.empty((levels, 2, 2)),
        decay=np.empty(levels),
        matrices=np.empty((SPOOL_GRID.scratch, 4, 4)),
        held=np.empty(MAX_PLAYS + 1),
    )


@inlined
def motor_tick(law: DriveLaw, held: Array, current: float) -> float:
    """Flapper deflection (m) that the torque of a current (A) alone makes (PHY-4, PHY-29, PHY-30).

    held: what the plays hold, and last what flows behind the driver's lag, A, shape (plays + 1,),
        changed in place.
    """
    plays = held.shape[0] - 1
    flowing = held[plays]
    held[plays] = lagged_current(law.left, flowing, current)
    value = lagged_current(law.late, flowing, current) + law.bias
    for i in range(plays):
        held[i] = play_output(held[i], value, law.spacing * (i + 0.5))
    return held_deflection(law, held)


@inlined
def held_deflection(law: DriveLaw, held: Array) -> float:
    """Flapper deflection by the current that acts, m."""
    total, weight = 0.0, 1.0
    for i in range(held.shape[0] - 1):
        total += weight * held[i]
        weight *= law.fade
    return float(motor_deflection(law, total))


TICK_UNITS = 1 << SPOOL_GRID.finest_level
"""A tick in units of the finest step."""
LAST_STEP_START = TICK_UNITS - (TICK_UNITS >> SPOOL_GRID.base_level)
"""Start of the last ordinary step: pressure at the end of a tick hangs on the last piece most."""


@inlined
def _rests(t: SpoolLaw, deflection: float, s: SpoolState) -> bool:
    """Whether a spool at rest stays so while this current lasts: the flapper rings too little."""
    if t.ring_rate <= 0.0:
        return False
    still = flapper_rest(t.ratio, deflection, s.wire)
    a = s.xf - still
    b = (s.wf + t.ring_damping * a) / t.ring_rate
    return abs(still) + math.sqrt(a * a + b * b) < min(t.breakaway, t.flapper_stop)


@inlined
def _slide(t: SpoolLaw, m: Array, deflection: float, s: SpoolState) -> SpoolState:
    """Flapper free, spool moving: a step about the point where both would rest."""
    rest_xf = t.dry * s.direction
    rest_xs = spool_rest_position(t, deflection, float(s.direction))
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
def _slide_loose(t: SpoolLaw, m: Array, h: float, deflection: float, s: SpoolState) -> SpoolState:
    """Flapper free, spool moving within its backlash: the wire stays, the flapper rings."""
    still = flapper_rest(t.ratio, deflection, s.wire)
    steady = steady_spool_velocity(t, still, float(s.direction))
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
def _ring(t: SpoolLaw, n: Array, deflection: float, s: SpoolState) -> SpoolState:
    """Flapper free, spool at rest: a step of the flapper about its rest."""
    still = flapper_rest(t.ratio, deflection, s.wire)
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
    steady = clamped_spool_velocity(t, s.xf, float(s.direction))
    xs = s.xs + steady * h + (s.vs - steady) * (1.0 - fade) * t.mass / t.damping
    vs = steady + (s.vs - steady) * fade
    return SpoolState(s.xf, s.wf, xs, vs, s.wire, s.direction, s.clamped)


@inlined
def _creep(
    tables: SpoolTables, level: int, h: float, deflection: float, loose: bool, s: SpoolState
) -> tuple[SpoolState, bool]:
    """Spool moving with friction that falls with its velocity, flapper free or on its stop."""
    m = tables.loose[level] if loose else tables.moving[level]
    transition = StepTransition(
        m[0, 0], m[0, 1], m[0, 2], m[0, 3], m[1, 0], m[1, 1], m[1, 2], m[1, 3],
        m[2, 0], m[2, 1], m[2, 2], m[2, 3], m[3, 0], m[3, 1], m[3, 2], m[3, 3],
    )  # fmt: skip
    return creep_step(tables.law, transition, h, tables.decay[level], deflection, loose, s)


@inlined
def _node_wanted(t: SpoolLaw, event: int, done: int, bend: float) -> bool:
    """Whether the path is to have a node here."""
    if event > EVENTS.none or done == TICK_UNITS:
        return True
    if done & ((TICK_UNITS >> SPOOL_GRID.node_level) - 1) != 0:
        return False
    return bend > t.bend or (done == LAST_STEP_START and bend > SPOOL_GRID.last_bend)


@inlined
def spool_rest(t: SpoolLaw, deflection: float, origin: float) -> SpoolState:
    """Flapper and spool at rest, the spool at `origin` (m) within its stroke."""
    xs = min(max(origin, -t.stroke), t.stroke)
    return SpoolState(held_flapper(t, deflection, xs), 0.0, xs, 0.0, xs, 0, False)


@inlined
def spool_tick(
    tables: SpoolTables, deflection: float, tick: float, state: SpoolState, nodes: Array, first: int
) -> tuple[SpoolState, int]:
    """Flapper and spool over one tick: the state at its end, and the index one past the last node.

    deflection: of the flapper by the current alone, held over the tick, m; tick: s; first: index of
    the tick's first node. Writes nodes, one row a piece of the path: duration (s), position
    at its end (m), velocity at its start and at its end (m/s); the last column, the jump after the
    piece (m), is set to 0.
    """
    t = tables.law
    full = first + SPOOL_GRID.nodes - 1
    count, done, since, level = first, 0, 0, SPOOL_GRID.base_level
    s = state
    if s.direction == 0 and not s.clamped and _rests(t, deflection, s):
        level = 0
    begin, slowest, fastest = s.vs, s.vs, s.vs
    while done < TICK_UNITS:
        while (TICK_UNITS >> level) > TICK_UNITS - done:
            level += 1
        h = tick / (1 << level)
        new, sure = s, True
        loose = s.direction != 0 and not is_wire_carried(t, s.direction, s.xs, s.wire)
        creeps = s.direction != 0 and t.extra > 0.0
        if creeps:
            new, sure = _creep(tables, level, h, deflection, loose, s)
        if s.clamped:
            if s.direction != 0 and not creeps:
                new = _slide_clamped(t, h, tables.decay[level], s)
            wire = play_output(s.wire, new.xs, t.backlash)
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
            event = EVENTS.none  # `_rests` has excluded it
        elif event == EVENTS.none and not sure:
            event = EVENTS.possible
        if event != EVENTS.none and level < SPOOL_GRID.finest_level:
            level += 1
            continue
        end = new.vs
        s = state_after_event(t, event, new)
        done += TICK_UNITS >> level
        since += TICK_UNITS >> level
        slowest, fastest = min(slowest, end), max(fastest, end)
        span = tick * since / TICK_UNITS
        wanted = _node_wanted(t, event, done, 0.125 * (fastest - slowest) * span)
        if wanted and (done == TICK_UNITS or count < full):
            nodes[count, 0] = span
            nodes[count, 1] = s.xs
            nodes[count, 2] = begin
            nodes[count, 3] = end
            nodes[count, 4] = 0.0
            count += 1
            begin, slowest, fastest = s.vs, s.vs, s.vs
            since = 0
        if level > SPOOL_GRID.base_level and done & ((TICK_UNITS >> (level - 1)) - 1) == 0:
            level -= 1
    return s, count


@inlined
def sampled_spool(
    law: SensorLaw, tick: float, nodes: Array, first: int, end: int, before: float, lagged: float
) -> tuple[float, float]:
    """Spool as its sensor samples it in a tick, and behind the filter at the tick's end, m.

    nodes, first, end: the tick's path; before: position before it, m; lagged: behind the filter, m.
    """
    if not has_sensor_dynamics(law):
        return nodes[end - 1, 1], nodes[end - 1, 1]
    due, seen, x0 = tick - min(law.lead, tick), lagged, before
    for node in range(first, end):
        span, x1 = nodes[node, 0], nodes[node, 1]
        cubic = cubic_through_ends(x0, x1, span * nodes[node, 2], span * nodes[node, 3])
        if 0.0 < due <= MAX_INSTANT_SHARE * span:
            seen = filter_output(filter_step(law.lag, span, due), lagged, cubic)
        lagged = filter_output(filter_step(law.lag, span, span), lagged, cubic)
        due -= span
        x0 = x1
    return seen, lagged


@kernel
def spool_response(
    constants: PlantConstants,
    bend: float,
    scratch: SpoolScratch,
    current: Array,
    tick: float,
    origin: float,
    history: Array,
    measured: Array,
    anchor: Array,
    spool: Array,
    nodes: Array2,
    node_end: NDArray[np.int64],
) -> int:
    """Spool position at the end of every tick, from rest; returns the number of re-anchorings.

    bend: see `spool_law`; current: of each tick, A, shape (n,); tick: s; origin: spool position
    before the first tick, m; history: current of all ticks before, A: it has loaded the hysteresis,
    and the flapper is in equilibrium with its last; measured: spool position to re-anchor on, m,
    NaN where missing; anchor: see `ehadiag.model.batch.Anchor`. Writes spool, m, as it is sampled,
    before any re-anchoring; nodes, shape of `spool_tick`, the path as it writes it, with the jump
    by a re-anchoring after a tick's last piece; node_end, index one past the last node of each
    tick.
    """
    law, motor, sensor = (
        spool_law(constants, bend),
        drive_law(constants, tick),
        sensor_law(constants),
    )
    moving, loose, stuck, decay = scratch.moving, scratch.loose, scratch.stuck, scratch.decay
    fill_tables(constants, law, tick, scratch.matrices, moving, loose, stuck, decay)
    tables = SpoolTables(moving, loose, stuck, decay, law)
    held = scratch.held[: int(constants.NPL) + 1]
    held[:] = 0.0
    for k in range(history.shape[0]):
        motor_tick(motor, held, history[k])
    s = spool_rest(law, held_deflection(motor, held), origin)
    count, anchored, filtered, lagged = 0, 0, 0.0, s.xs
    for k in range(current.shape[0]):
        before, first = s.xs, count
        s, count = spool_tick(tables, motor_tick(motor, held, current[k]), tick, s, nodes, count)
        node_end[k] = count
        spool[k], lagged = sampled_spool(sensor, tick, nodes, first, count, before, lagged)
        xs, filtered, moved = anchored_spool(
            measured[k] - read_spool(sensor, spool[k]),
            anchor[0], anchor[1], anchor[2], s.xs, filtered, law.stroke,
        )  # fmt: skip
        if moved:
            nodes[count - 1, 4] = xs - s.xs
            lagged += xs - s.xs
            s = SpoolState(s.xf, s.wf, xs, s.vs, s.wire + (xs - s.xs), s.direction, s.clamped)
            anchored += 1
    return anchored
