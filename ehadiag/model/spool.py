"""First stage and spool, integrated exactly: kernel of the monitoring model.

Between events, flapper and spool obey linear equations with constant coefficients (model.md
section 1, the current being held over a tick), so the state moves by a transition matrix, without
error. Events switch the equations: the flapper meets or leaves a stop; the spool sticks, breaks
away or meets a stop. A step that contains an event is halved until the event is located.
Coefficients depend on one fault constant only, `Kintas`, so the matrices are made once for each
candidate (`ehadiag.model.transition`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined, kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.transition import FINEST, SpoolScalars, SpoolTables

__all__ = ["NODES_PER_TICK", "NODE_COLUMNS", "spool_response"]

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

NOTHING = 0
UNSURE = -1
"""An event may hide inside the step: halve it, but it is none if it is still unsure at the end."""
REVERSAL = 1
SPOOL_STOP = 2
BREAKAWAY = 3
FLAPPER_STOP = 4
RELEASE = 5


@inlined
def _held(c: PlantConstants, t: SpoolScalars, xf: float, xs: float) -> bool:
    """Whether a spool at rest stays: friction holds it, or its stop does."""
    return abs(xf) <= t.breakaway or (abs(xs) >= c.XSM and xs * xf > 0.0)


@inlined
def _clamped_event(
    c: PlantConstants,
    t: SpoolScalars,
    torque: float,
    xf: float,
    xs: float,
    vs: float,
    direction: int,
) -> int:
    """What ends a step with the flapper on its stop, which it leaves when the torque turns."""
    if (torque - c.KSF * xs - c.KF * xf) * xf < 0.0:
        return RELEASE
    if direction == 0:
        return NOTHING if _held(c, t, xf, xs) else BREAKAWAY
    if vs * direction <= 0.0:
        return REVERSAL
    return SPOOL_STOP if abs(xs) >= c.XSM and xs * direction > 0.0 else NOTHING


@inlined
def _moving_event(
    c: PlantConstants,
    t: SpoolScalars,
    h: float,
    before_xf: float,
    before_wf: float,
    xf: float,
    wf: float,
    xs: float,
    vs: float,
    direction: int,
) -> int:
    """What ends a step with flapper free and spool moving."""
    if vs * direction <= 0.0:
        return REVERSAL
    if abs(xs) >= c.XSM and xs * direction > 0.0:
        return SPOOL_STOP
    if abs(xf) >= c.XFM:
        return FLAPPER_STOP
    if before_wf * wf < 0.0:
        # An extreme of the flapper lies inside: the spool may stop there, or the flapper touch.
        swing = 0.25 * h * max(abs(before_wf), abs(wf))
        lowest = min(before_xf * direction, xf * direction) - t.dynamic / t.force - swing
        if lowest <= 0.0 or max(abs(before_xf), abs(xf)) + swing >= c.XFM:
            return UNSURE
    return NOTHING


@inlined
def _stuck_event(
    c: PlantConstants,
    t: SpoolScalars,
    h: float,
    before_xf: float,
    before_wf: float,
    xf: float,
    wf: float,
    xs: float,
) -> int:
    """What ends a step with flapper free and spool at rest."""
    if not _held(c, t, xf, xs):
        return BREAKAWAY
    if abs(xf) >= c.XFM:
        return FLAPPER_STOP
    if before_wf * wf < 0.0:
        swing = 0.25 * h * max(abs(before_wf), abs(wf))
        if max(abs(before_xf), abs(xf)) + swing > min(t.breakaway, c.XFM):
            return UNSURE
    return NOTHING


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


@kernel
def spool_response(
    constants: PlantConstants,
    tables: SpoolTables,
    current: NDArray[np.float64],
    tick: float,
    origin: float,
    current_before: float,
    measured: NDArray[np.float64],
    anchor: NDArray[np.float64],
    spool: NDArray[np.float64],
    nodes: NDArray[np.float64],
    node_end: NDArray[np.int64],
) -> int:
    """Spool position at the end of every tick, from rest.

    Parameters
    ----------
    current: servovalve current of each tick, A, shape (n,).
    tick: s.
    origin: spool position before the first tick, m.
    current_before: current before the first tick, A; the flapper is in equilibrium with both.
    measured: measured spool position, m, shape (n,), NaN where missing; used only to re-anchor.
    anchor: (gain, small, large): after each tick the innovation e is filtered, f += gain (e - f);
        where abs(e) > large the model is moved by e, where abs(f) > small by f. All m but gain.
        Large = inf and small = inf: the model runs free.
    spool: out, m, shape (n,), the prediction before any re-anchoring.
    nodes: out, shape (n * NODES_PER_TICK, NODE_COLUMNS), one row a piece of the path: duration
        (s), position at its end (m), velocity at its start and at its end (m/s), and the jump of
        position that a re-anchoring adds after it (m).
    node_end: out, shape (n,), index one past the last node of each tick.

    Returns
    -------
    How many times the model was re-anchored.
    """
    c, t = constants, tables.scalars
    moving, stuck, decay = tables.moving, tables.stuck, tables.decay
    xs = min(max(origin, -c.XSM), c.XSM)
    xf = (c.GM * current_before - c.KSF * xs) / c.KF
    xf = min(max(xf, -t.breakaway), t.breakaway)
    wf, vs = 0.0, 0.0
    direction = 0  # of the spool's motion, +1 or -1; 0 at rest
    clamped = False  # flapper on its stop
    count, anchored, filtered = 0, 0, 0.0
    for k in range(current.shape[0]):
        torque = c.GM * current[k]
        full = count + NODES_PER_TICK - 1
        done, since, level = 0, 0, BASE
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
                # About the point where both would rest.
                rest_xf = t.dynamic * direction / t.force
                rest_xs = (torque - c.KF * rest_xf) / c.KSF
                a, b = xf - rest_xf, xs - rest_xs
                m = moving[level]
                new_xf = rest_xf + m[0, 0] * a + m[0, 1] * wf + m[0, 2] * b + m[0, 3] * vs
                new_wf = m[1, 0] * a + m[1, 1] * wf + m[1, 2] * b + m[1, 3] * vs
                new_xs = rest_xs + m[2, 0] * a + m[2, 1] * wf + m[2, 2] * b + m[2, 3] * vs
                new_vs = m[3, 0] * a + m[3, 1] * wf + m[3, 2] * b + m[3, 3] * vs
                event = _moving_event(c, t, h, xf, wf, new_xf, new_wf, new_xs, new_vs, direction)
            else:
                rest_xf = (torque - c.KSF * xs) / c.KF
                a = xf - rest_xf
                n = stuck[level]
                new_xf = rest_xf + n[0, 0] * a + n[0, 1] * wf
                new_wf = n[1, 0] * a + n[1, 1] * wf
                event = _stuck_event(c, t, h, xf, wf, new_xf, new_wf, xs)
            if level == 0:
                event = NOTHING  # `_rests` has looked
            if event != NOTHING and level < FINEST:
                level += 1
                continue
            xf, wf, xs, vs = new_xf, new_wf, new_xs, new_vs
            end = vs
            if event == REVERSAL:
                vs = 0.0
                direction = 0
                if abs(xf) > t.breakaway:
                    direction = 1 if xf > 0.0 else -1
            elif event == SPOOL_STOP:
                xs = math.copysign(c.XSM, xs)
                vs = 0.0
                direction = 0
            elif event == BREAKAWAY:
                direction = 1 if xf > 0.0 else -1
            elif event == FLAPPER_STOP:
                xf = math.copysign(c.XFM, xf)
                wf = 0.0
                clamped = True
            elif event == RELEASE:
                clamped = False
            done += WHOLE >> level
            since += WHOLE >> level
            slowest, fastest = min(slowest, end), max(fastest, end)
            span = tick * since / WHOLE
            bend = 0.125 * (fastest - slowest) * span
            wanted = event > NOTHING or (
                done & ((WHOLE >> NODE_LEVEL) - 1) == 0
                and (bend > BEND or (done == LAST and bend > LAST_BEND))
            )
            if done == WHOLE or (wanted and count < full):
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
        node_end[k] = count
        spool[k] = xs
        error = measured[k] - xs
        if not math.isfinite(error):
            continue
        filtered += anchor[0] * (error - filtered)
        move = 0.0
        if abs(error) > anchor[2]:
            move = error
        elif abs(filtered) > anchor[1]:
            move = filtered
        if move != 0.0:
            xs = min(max(xs + move, -c.XSM), c.XSM)
            nodes[count - 1, 4] = xs - spool[k]
            filtered = 0.0
            anchored += 1
    return anchored
