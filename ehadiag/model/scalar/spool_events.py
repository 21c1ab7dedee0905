"""What ends a step of flapper and spool."""

from __future__ import annotations

import math

from ehadiag.compile.kernels import inlined
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.transition import SpoolScalars

__all__ = [
    "BREAKAWAY",
    "FLAPPER_STOP",
    "NOTHING",
    "RELEASE",
    "REVERSAL",
    "SPOOL_STOP",
    "UNSURE",
    "clamped_event",
    "held",
    "moving_event",
    "stuck_event",
    "switch",
]

NOTHING = 0
UNSURE = -1
"""An event may hide inside the step: halve it, but it is none if it is still unsure at the end."""
REVERSAL = 1
SPOOL_STOP = 2
BREAKAWAY = 3
FLAPPER_STOP = 4
RELEASE = 5


@inlined
def held(c: PlantConstants, t: SpoolScalars, xf: float, xs: float) -> bool:
    """Whether a spool at rest stays: friction holds it, or its stop does."""
    return abs(xf) <= t.breakaway or (abs(xs) >= c.XSM and xs * xf > 0.0)


@inlined
def clamped_event(
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
        return NOTHING if held(c, t, xf, xs) else BREAKAWAY
    if vs * direction <= 0.0:
        return REVERSAL
    return SPOOL_STOP if abs(xs) >= c.XSM and xs * direction > 0.0 else NOTHING


@inlined
def moving_event(
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
def stuck_event(
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
    if not held(c, t, xf, xs):
        return BREAKAWAY
    if abs(xf) >= c.XFM:
        return FLAPPER_STOP
    if before_wf * wf < 0.0:
        swing = 0.25 * h * max(abs(before_wf), abs(wf))
        if max(abs(before_xf), abs(xf)) + swing > min(t.breakaway, c.XFM):
            return UNSURE
    return NOTHING


@inlined
def switch(
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
