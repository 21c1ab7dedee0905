"""One tick of the streaming monitor: the scalar model from a state carried between calls.

Spool, jack and control law are those of `ehadiag.model`; here stand what a lost sample does, and
the sums.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined, inlined_exact
from ehadiag.model.anchor import re_anchored
from ehadiag.model.control import ControlLaw, ControlState, control
from ehadiag.model.scalar.drive import drive
from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK, sensed_path, spool_tick
from ehadiag.model.scalar.transition import FINEST, SpoolTables
from ehadiag.model.second_stage import jack_tick
from ehadiag.model.sensors import read_pressure, read_spool
from ehadiag.model.spool_events import SpoolState
from ehadiag.monitor.layout import (
    CUSUM,
    DECAY,
    LOOSE,
    NODES,
    NUMBER,
    PLAYS,
    PREDICTED,
    RESIDUAL,
    RING,
    SIZE,
    SLIDE,
    Followed,
    Moving,
    Settings,
    control_law_of,
    control_of,
    drive_law_of,
    followed_of,
    jack_law_of,
    jack_of,
    keep_control,
    keep_followed,
    keep_jack,
    keep_moving,
    moving_of,
    sensor_law_of,
    settings_of,
    spool_law_of,
)

__all__ = ["push_tick"]

Vector = NDArray[np.float64]

LONGEST = 5.0
"""Ticks that a lost command is taken to go on straight; then it stands."""


@inlined
def _follow(f: Followed, command: float) -> tuple[Followed, bool]:
    """Command of the tick, and whether it is known: a lost one goes on straight for some ticks."""
    if math.isfinite(command):
        slope = command - f.command if f.lost == 0.0 else 0.0
        return Followed(f.seen, command, slope, 0.0), True
    lost = f.lost + 1.0
    ahead = f.command + f.slope if lost <= LONGEST else f.command
    return Followed(f.seen, ahead, f.slope, lost), False


@inlined_exact
def _position_seen(
    s: Settings, law: ControlLaw, state: ControlState, f: Followed, current: float
) -> float:
    """Digitised jack position that the control law of this tick worked on, m."""
    if math.isfinite(f.seen):
        return float(f.seen)
    if not math.isfinite(current) or law.GAP <= 0.0:
        return float(f.command - state.before)
    place = f.command - current / law.GAP
    if s.invertible != 0.0 and abs(current) < s.linear:
        # One code of position is many codes of current.
        return float(np.round(place / s.code_position) * s.code_position)
    return float(place)


@inlined_exact
def _commanded(p: Vector, s: Settings, command: float, current: float, position: float) -> float:
    """Servovalve current of the tick, A.

    The measured one carries noise: it stands in only where the command is lost and does not go on
    as it was.
    """
    law = control_law_of(p)
    f, known = _follow(followed_of(p), command)
    if s.closed == 0.0:
        out = min(max(f.command, -law.IM), law.IM)
    else:
        state = control_of(p)
        seen = _position_seen(s, law, state, f, current)
        out, state = control(law, state, f.command - seen)
        keep_control(p, state)
    slope = f.slope
    followed = f.command
    if not known and abs(current - out) > s.deviation:
        out = min(max(current, -law.IM), law.IM)
        if s.closed == 0.0:
            followed, slope = out, 0.0
    keep_followed(p, Followed(position, followed, slope, f.lost))
    return float(out)


@inlined
def _part(address: int, place: int, shape: tuple[int, ...]) -> Vector:
    """What begins at a place of the layout; to cut it out of an array calls the runtime."""
    return array_at(address + NUMBER * place, shape)


@inlined
def _accumulate(p: Vector, s: Settings, channel: int) -> int:
    """Advance both sums of a channel; a sum that gives alarm begins anew, a lost sample rests.

    Returns the sums that gave alarm: 1 for the upper, 2 for the lower one, 3 for both.
    """
    z = p[RESIDUAL + channel]
    if not math.isfinite(z):
        return 0
    step = min(max(z, -s.limit), s.limit)
    alarms = 0
    for side in range(2):
        at = CUSUM + 2 * channel + side
        p[at] = max(0.0, p[at] + (step if side == 0 else -step) - s.reference)
        if p[at] > s.threshold:
            alarms += 1 + side
            p[at] = 0.0
    return alarms


@brief_kernel
def push_tick(address: int, sample: tuple[float, float, float, float, float]) -> int:
    """Advance model and sums by one tick, in place.

    Parameters
    ----------
    address : int
        Of the SIZE numbers of `ehadiag.monitor.layout`.
    sample : tuple[float, float, float, float, float]
        Command, current, spool, pressure and position of the tick, SI, NaN where lost.

    Returns
    -------
    int
        The sums that gave alarm: 1 spool's upper, 2 its lower, 4 pressure's upper, 8 its lower
        one.
    """
    command, current, spool, pressure, position = sample
    p = _part(address, 0, (SIZE,))
    nodes = _part(address, NODES, (NODES_PER_TICK, NODE_COLUMNS))
    s, law, m = settings_of(p), spool_law_of(p), moving_of(p)
    tables = SpoolTables(
        _part(address, SLIDE, (FINEST + 1, 4, 4)),
        _part(address, LOOSE, (FINEST + 1, 4, 4)),
        _part(address, RING, (FINEST + 1, 2, 2)),
        _part(address, DECAY, (FINEST + 1,)),
        law,
    )
    held = _part(address, PLAYS, (int(s.plays) + 1,))
    deflection = drive(drive_law_of(p), held, _commanded(p, s, command, current, position))
    before = SpoolState(m.xf, m.wf, m.xs, m.vs, m.wire, int(m.direction), m.clamped != 0.0)
    after, count = spool_tick(tables, deflection, control_law_of(p).tick, before, nodes, 0)
    sensor, tick = sensor_law_of(p), control_law_of(p).tick
    seen, lagged = sensed_path(sensor, tick, nodes, 0, count, m.xs, m.lagged)
    innovation = spool - read_spool(sensor, seen)
    p12, jack, jack_spool = jack_tick(
        jack_law_of(p), sensor, tick, nodes, 0, count, jack_of(p), m.jack_spool
    )
    keep_jack(p, jack)
    p[PREDICTED], p[PREDICTED + 1] = seen, p12
    p[PREDICTED + 2] = jack.place - sensor.lead * jack.velocity
    p[RESIDUAL] = innovation * s.spool_weight
    missed = pressure - read_pressure(sensor, p12)
    p[RESIDUAL + 1] = missed * s.pressure_weight
    xs, filtered, _ = re_anchored(
        innovation, s.anchor_gain, s.anchor_small, s.anchor_large, after.xs, m.filtered, law.stroke
    )
    clamped = 1.0 if after.clamped else 0.0
    keep_moving(
        p,
        Moving(
            after.xf,
            after.wf,
            xs,
            after.vs,
            after.wire + (xs - after.xs),
            float(after.direction),
            clamped,
            filtered,
            jack_spool + (xs - after.xs),
            lagged + (xs - after.xs),
        ),
    )
    return _accumulate(p, s, 0) + 4 * _accumulate(p, s, 1)
