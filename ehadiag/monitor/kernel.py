"""One tick of the monitoring model from a state carried between calls: kernel of the monitor.

Spool and jack are those of `ehadiag.model`; here stand the current, what a
lost sample does, and the sums.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined, inlined_exact
from ehadiag.model.anchor import re_anchored
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.jack_tick import jack_tick
from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK, spool_tick
from ehadiag.model.scalar.transition import FINEST, SpoolScalars
from ehadiag.monitor.layout import (
    ANCHOR_GAIN,
    ANCHOR_LARGE,
    ANCHOR_SMALL,
    CLAMPED,
    CLOSED,
    CODE_POSITION,
    COMMAND,
    CUSUM,
    DECAY,
    DEVIATION,
    DIRECTION,
    DYNAMIC,
    ERROR_BEFORE,
    FILTERED,
    GAD,
    GAI,
    GAP,
    IM,
    INTEGRAL,
    INVERTIBLE,
    JACK_DIRECTION,
    JACK_POSITION,
    JACK_SPOOL,
    JACK_VELOCITY,
    LIMIT,
    LINEAR,
    LOST,
    MOVING,
    NODES,
    NUMBER,
    OFFSETS,
    PREDICTED,
    REFERENCE,
    RESIDUAL,
    SCALARS,
    SEEN,
    SIZE,
    SLOPE,
    STARTED,
    STUCK,
    THRESHOLD,
    TICK,
    VS,
    WEIGHTS,
    WF,
    XF,
    XS,
)

__all__ = ["push_tick"]

Vector = NDArray[np.float64]

LONGEST = 5.0
"""Ticks that a lost command is taken to go on straight; then it stands."""


@inlined
def _plant(p: Vector) -> PlantConstants:
    return PlantConstants(
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11], p[12],
        p[13], p[14], p[15], p[16], p[17], p[18], p[19], p[20], p[21], p[22], p[23], p[24],
    )  # fmt: skip


@inlined
def _scalars(p: Vector) -> SpoolScalars:
    a = SCALARS
    return SpoolScalars(p[a], p[a + 1], p[a + 2], p[a + 3], p[a + 4], p[a + 5])


@inlined
def _followed(s: Vector, command: float) -> tuple[float, bool]:
    """Command of the tick, and whether it is known: a lost one goes on straight for some ticks."""
    if math.isfinite(command):
        s[SLOPE] = command - s[COMMAND] if s[LOST] == 0.0 else 0.0
        s[COMMAND], s[LOST] = command, 0.0
        return command, True
    s[LOST] += 1.0
    if s[LOST] <= LONGEST:
        s[COMMAND] += s[SLOPE]
    return float(s[COMMAND]), False


@inlined_exact
def _position_seen(p: Vector, s: Vector, command: float, current: float) -> float:
    """Digitised jack position that the control law of this tick worked on, m."""
    if math.isfinite(s[SEEN]):
        return float(s[SEEN])
    if not math.isfinite(current) or p[GAP] <= 0.0:
        return float(command - s[ERROR_BEFORE])
    place = command - current / p[GAP]
    if p[INVERTIBLE] != 0.0 and abs(current) < p[LINEAR]:
        # One code of position is many codes of current.
        return float(np.round(place / p[CODE_POSITION]) * p[CODE_POSITION])
    return float(place)


@inlined_exact
def _control_law(p: Vector, s: Vector, error: float) -> float:
    """Demanded current, A; as `ehadiag.identify.commanded_current` has it."""
    wanted = p[GAP] * error
    if s[STARTED] != 0.0:
        wanted += p[GAD] * (error - s[ERROR_BEFORE]) / p[TICK]
    trial = s[INTEGRAL] + error * p[TICK]
    wanted += p[GAI] * trial
    out = min(max(wanted, -p[IM]), p[IM])
    # Conditional integration: the integral rests while it would push further into saturation.
    if wanted == out or (wanted - out) * error < 0.0:
        s[INTEGRAL] = trial
    s[ERROR_BEFORE] = error
    s[STARTED] = 1.0
    return float(out)


@inlined_exact
def _commanded(p: Vector, s: Vector, command: float, current: float, position: float) -> float:
    """Servovalve current of the tick, A.

    The measured one carries noise: it stands in only where the command is lost and does not go on
    as it was.
    """
    followed, known = _followed(s, command)
    if p[CLOSED] == 0.0:
        out = min(max(followed, -p[IM]), p[IM])
    else:
        out = _control_law(p, s, followed - _position_seen(p, s, followed, current))
    if not known and abs(current - out) > p[DEVIATION]:
        out = min(max(current, -p[IM]), p[IM])
        if p[CLOSED] == 0.0:
            s[COMMAND], s[SLOPE] = out, 0.0
    s[SEEN] = position
    return float(out)


@inlined
def _part(address: int, place: int, shape: tuple[int, ...]) -> Vector:
    """What begins at a place of the layout; to cut it out of an array calls the runtime."""
    return array_at(address + NUMBER * place, shape)


@inlined
def _spool(address: int, p: Vector, s: Vector, torque: float, nodes: Vector) -> int:
    """Flapper and spool over the tick; returns the number of nodes of the path."""
    xf, wf, xs, vs, direction, clamped, count = spool_tick(
        _plant(p),
        _scalars(p),
        _part(address, MOVING, (FINEST + 1, 4, 4)),
        _part(address, STUCK, (FINEST + 1, 2, 2)),
        _part(address, DECAY, (FINEST + 1,)),
        torque,
        p[TICK],
        s[XF],
        s[WF],
        s[XS],
        s[VS],
        int(s[DIRECTION]),
        s[CLAMPED] != 0.0,
        nodes,
        0,
    )
    s[XF], s[WF], s[XS], s[VS] = xf, wf, xs, vs
    s[DIRECTION], s[CLAMPED] = direction, 1.0 if clamped else 0.0
    return count


@inlined
def _jack(p: Vector, s: Vector, nodes: Vector, count: int) -> float:
    """Second stage and jack over the spool's path; returns the pressure at its end, Pa."""
    pressure, velocity, place, direction, spool = jack_tick(
        _plant(p),
        p[DYNAMIC],
        nodes,
        0,
        count,
        s[JACK_VELOCITY],
        s[JACK_POSITION],
        s[JACK_DIRECTION],
        s[JACK_SPOOL],
    )
    s[JACK_VELOCITY], s[JACK_POSITION], s[JACK_DIRECTION] = velocity, place, direction
    s[JACK_SPOOL] = spool
    return pressure


@inlined
def _accumulate(p: Vector, s: Vector, channel: int) -> int:
    """Advance both sums of a channel; a sum that gives alarm begins anew, a lost sample rests.

    Returns the sums that gave alarm: 1 for the upper, 2 for the lower one, 3 for both.
    """
    z = s[RESIDUAL + channel]
    if not math.isfinite(z):
        return 0
    step = min(max(z, -p[LIMIT]), p[LIMIT])
    alarms = 0
    for side in range(2):
        at = CUSUM + 2 * channel + side
        s[at] = max(0.0, s[at] + (step if side == 0 else -step) - p[REFERENCE])
        if s[at] > p[THRESHOLD]:
            alarms += 1 + side
            s[at] = 0.0
    return alarms


@brief_kernel
def push_tick(address: int, sample: tuple[float, float, float, float, float]) -> int:
    """Advance model and sums by one tick, in place.

    Parameters
    ----------
    address: of the SIZE numbers of `ehadiag.monitor.layout`.
    sample: command, current, spool, pressure and position of the tick, SI, NaN where lost.

    Returns
    -------
    The sums that gave alarm: 1 spool's upper, 2 its lower, 4 pressure's upper, 8 its lower one.
    """
    command, current, spool, pressure, position = sample
    p = s = _part(address, 0, (SIZE,))
    nodes = _part(address, NODES, (NODES_PER_TICK, NODE_COLUMNS))
    torque = _plant(p).GM * _commanded(p, s, command, current, position)
    count = _spool(address, p, s, torque, nodes)
    s[PREDICTED] = s[XS]
    gap = spool - p[OFFSETS] - s[XS]
    s[RESIDUAL] = gap * p[WEIGHTS]
    s[PREDICTED + 1] = _jack(p, s, nodes, count)
    s[PREDICTED + 2] = s[JACK_POSITION]
    s[RESIDUAL + 1] = (pressure - p[OFFSETS + 1] - s[PREDICTED + 1]) * p[WEIGHTS + 1]
    s[XS], s[FILTERED], _ = re_anchored(
        gap, p[ANCHOR_GAIN], p[ANCHOR_SMALL], p[ANCHOR_LARGE], s[XS], s[FILTERED], _plant(p).XSM
    )
    s[JACK_SPOOL] += s[XS] - s[PREDICTED]
    return _accumulate(p, s, 0) + 4 * _accumulate(p, s, 1)
