"""First stage and spool, integrated exactly: kernel of the monitoring model.

Between events, flapper and spool obey linear equations with constant coefficients (model.md
section 1, the current being held over a tick), so the state moves by a transition matrix, without
error. Events switch the equations: the flapper meets or leaves a stop; the spool sticks, breaks
away or meets a stop. A step that contains an event is halved until the event is located.
Coefficients depend on one fault constant only, `Kintas`, so the matrices are made once for each
candidate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import kernel
from ehadiag.model.constants import PlantConstants

__all__ = [
    "FINEST",
    "NODES_PER_TICK",
    "NODE_COLUMNS",
    "SpoolTables",
    "spool_response",
    "spool_tables",
]

FINEST = 10
"""Steps are tick / 2^level; events are located to tick / 2^FINEST (1 µs at 1 kHz)."""
BASE = 3
"""Level of the ordinary step: tick / 8."""
NODE_LEVEL = 5
"""Away from events a node is written only at multiples of tick / 2^NODE_LEVEL."""
NODES_PER_TICK = 128
"""Room for nodes of one tick."""
BEND = 0.02e-6
"""A node is written where the path bends away from its chord by about this much, m."""
NODE_COLUMNS = 5

TAYLOR_ORDER = 12
TAYLOR_HALVINGS = 3


class SpoolTables(NamedTuple):
    """Transition coefficients of one candidate, one row a level.

    moving: shape (FINEST + 1, 4, 4), flapper free, spool moving; state (XF, DXF, XS, DXS).
    stuck: shape (FINEST + 1, 2, 2), flapper free, spool at rest; state (XF, DXF).
    decay: shape (FINEST + 1,), exp(-h / tau) of the spool velocity with the flapper on a stop.
    damping: viscous coefficient of the moving spool, N s/m.
    static, dynamic: dry friction of the spool, N.
    """

    moving: NDArray[np.float64]
    stuck: NDArray[np.float64]
    decay: NDArray[np.float64]
    damping: float
    static: float
    dynamic: float


@kernel
def _transition(rates: NDArray[np.float64], tick: float) -> NDArray[np.float64]:
    """exp(rates h) for h = tick / 2^level, level 0 … FINEST: Taylor at a small h, then squaring."""
    n = rates.shape[0]
    levels = FINEST + TAYLOR_HALVINGS
    scaled = rates * (tick / 2.0**levels)
    term = np.eye(n)
    power = np.eye(n)
    for order in range(1, TAYLOR_ORDER + 1):
        term = np.dot(term, scaled) / order
        power = power + term
    out = np.empty((FINEST + 1, n, n))
    for level in range(levels, -1, -1):
        if level <= FINEST:
            out[level] = power
        power = np.dot(power, power)
    return out


@kernel
def spool_tables(constants: PlantConstants, kintas: float, fss: float, tick: float) -> SpoolTables:
    """Transition coefficients for a candidate's `Kintas` and `FSS` (0 … 1), tick in s."""
    c = constants
    flow_gain = c.GQF * (1.0 - 0.8 * kintas)
    damping = c.GPF / flow_gain * c.AS * c.AS + c.CS
    static = c.FSS0 + fss * (c.FSS1 - c.FSS0)
    rates = np.zeros((4, 4))
    rates[0, 1] = 1.0
    rates[1, 0] = -c.KF / c.JF
    rates[1, 1] = -c.CF / c.JF
    rates[1, 2] = -c.KSF / c.JF
    rates[2, 3] = 1.0
    rates[3, 0] = c.AS * c.GPF / c.MS
    rates[3, 3] = -damping / c.MS
    decay = np.exp(-(tick * damping / c.MS) / 2.0 ** np.arange(FINEST + 1))
    return SpoolTables(
        moving=_transition(rates, tick),
        stuck=_transition(rates[:2, :2].copy(), tick),
        decay=decay,
        damping=damping,
        static=static,
        dynamic=0.5 * static,
    )


@kernel
def spool_response(
    constants: PlantConstants,
    tables: SpoolTables,
    current: NDArray[np.float64],
    tick: float,
    origin: float,
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
    origin: spool position before the first tick, m; the flapper is in equilibrium there.
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
    c = constants
    force = c.AS * c.GPF
    breakaway = tables.static / force
    xs = min(max(origin, -c.XSM), c.XSM)
    xf = (c.GM * current[0] - c.KSF * xs) / c.KF
    xf = min(max(xf, -breakaway), breakaway)
    wf, vs = 0.0, 0.0
    spool_dir = 0  # direction of motion, 0 at rest
    clamp = 0  # flapper on its stop: +1, -1; free: 0
    whole = 1 << FINEST
    count = 0
    filtered = 0.0
    anchored = 0
    begin, slowest, fastest = 0.0, 0.0, 0.0  # velocity at the start of the piece, its range
    for k in range(current.shape[0]):
        torque = c.GM * current[k]
        position = 0
        level = BASE
        since = 0
        first = count
        while position < whole:
            while (whole >> level) > whole - position:
                level += 1
            span = whole >> level
            h = tick / (1 << level)
            event = 0
            nxf, nwf, nxs, nvs = xf, wf, xs, vs
            if clamp != 0:
                # Flapper on its stop; it leaves when the torque on it turns.
                if spool_dir != 0:
                    steady = (force * xf - tables.dynamic * spool_dir) / tables.damping
                    fade = tables.decay[level]
                    nvs = steady + (vs - steady) * fade
                    nxs = xs + steady * h + (vs - steady) * (1.0 - fade) * c.MS / tables.damping
                    if nvs * spool_dir <= 0.0:
                        event = 1
                    elif abs(nxs) >= c.XSM and nxs * spool_dir > 0.0:
                        event = 2
                elif (abs(force * xf) > tables.static and abs(xs) < c.XSM) or (
                    abs(force * xf) > tables.static and xs * xf < 0.0
                ):
                    event = 3
                if (torque - c.KSF * nxs - c.KF * nxf) * clamp < 0.0:
                    event = 5
            elif spool_dir != 0:
                m = tables.moving[level]
                exf = tables.dynamic * spool_dir / force
                exs = (torque - c.KF * exf) / c.KSF
                a, b = xf - exf, xs - exs
                nxf = exf + m[0, 0] * a + m[0, 1] * wf + m[0, 2] * b + m[0, 3] * vs
                nwf = m[1, 0] * a + m[1, 1] * wf + m[1, 2] * b + m[1, 3] * vs
                nxs = exs + m[2, 0] * a + m[2, 1] * wf + m[2, 2] * b + m[2, 3] * vs
                nvs = m[3, 0] * a + m[3, 1] * wf + m[3, 2] * b + m[3, 3] * vs
                if nvs * spool_dir <= 0.0:
                    event = 1
                elif abs(nxs) >= c.XSM and nxs * spool_dir > 0.0:
                    event = 2
                elif abs(nxf) >= c.XFM:
                    event = 4
                elif wf * nwf < 0.0:
                    # An extreme of the flapper lies inside: the spool may stop there, or the
                    # flapper touch. Bound both by the motion at the larger of the end rates.
                    swing = 0.25 * h * max(abs(wf), abs(nwf))
                    low = min((xf - exf) * spool_dir, (nxf - exf) * spool_dir) - swing
                    high = max(abs(xf), abs(nxf)) + swing
                    if low <= 0.0 or high >= c.XFM:
                        event = -1
            else:
                m = tables.stuck[level]
                exf = (torque - c.KSF * xs) / c.KF
                a = xf - exf
                nxf = exf + m[0, 0] * a + m[0, 1] * wf
                nwf = m[1, 0] * a + m[1, 1] * wf
                inward = abs(xs) < c.XSM or nxf * xs < 0.0
                if abs(nxf) > breakaway and inward:
                    event = 3
                elif abs(nxf) >= c.XFM:
                    event = 4
                elif wf * nwf < 0.0:
                    swing = 0.25 * h * max(abs(wf), abs(nwf))
                    if max(abs(xf), abs(nxf)) + swing > min(breakaway, c.XFM):
                        event = -1
            if event != 0 and level < FINEST:
                level += 1
                continue
            xf, wf, xs, vs = nxf, nwf, nxs, nvs
            end = vs
            if event == 1:
                vs = 0.0
                spool_dir = 0
                if abs(force * xf) > tables.static:
                    spool_dir = 1 if xf > 0.0 else -1
            elif event == 2:
                xs = c.XSM * spool_dir
                vs = 0.0
                spool_dir = 0
            elif event == 3:
                spool_dir = 1 if xf > 0.0 else -1
            elif event == 4:
                clamp = 1 if xf > 0.0 else -1
                xf = c.XFM * clamp
                wf = 0.0
            elif event == 5:
                clamp = 0
            position += span
            since += span
            slowest, fastest = min(slowest, end), max(fastest, end)
            wanted = event > 0 or (
                position & ((whole >> NODE_LEVEL) - 1) == 0
                and 0.125 * (fastest - slowest) * (tick * since / whole) > BEND
            )
            if position == whole or (wanted and count - first < NODES_PER_TICK - 1):
                nodes[count, 0] = tick * since / whole
                nodes[count, 1] = xs
                nodes[count, 2] = begin
                nodes[count, 3] = end
                nodes[count, 4] = 0.0
                begin, slowest, fastest = vs, vs, vs
                count += 1
                since = 0
            if level > BASE and position & ((whole >> (level - 1)) - 1) == 0:
                level -= 1
        node_end[k] = count
        spool[k] = xs
        error = measured[k] - xs
        if math.isfinite(error):
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
