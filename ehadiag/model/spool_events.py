"""Events of flapper and spool: which one ends a step, and the state after it."""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.compile.kernels import inlined
from ehadiag.model.laws import SpoolLaw, play, still_flapper

__all__ = [
    "BREAKAWAY",
    "ENGAGE",
    "FLAPPER_STOP",
    "NOTHING",
    "RELEASE",
    "REVERSAL",
    "SPOOL_STOP",
    "UNSURE",
    "SpoolState",
    "carried",
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
ENGAGE = 6
"""The feedback wire meets the other side of its backlash."""
TOUCH = 1e-12
"""m; what rounding may make of a wire that the spool carries along."""


class SpoolState(NamedTuple):
    """Flapper and spool at an instant.

    Attributes
    ----------
    xf, wf: flapper deflection and its rate, m and m/s.
    xs, vs: spool position and velocity, m and m/s.
    wire: end of the feedback wire, which is the spool's but for the backlash, m.
    direction: of the spool's motion, +1 or -1; 0 at rest.
    clamped: whether the flapper is on its stop.
    """

    xf: float
    wf: float
    xs: float
    vs: float
    wire: float
    direction: int
    clamped: bool


@inlined
def held(t: SpoolLaw, xf: float, xs: float) -> bool:
    """Whether a spool at rest stays: friction holds it, or its stop does."""
    return abs(xf) <= t.breakaway or (abs(xs) >= t.stroke and xs * xf > 0.0)


@inlined
def carried(t: SpoolLaw, direction: int, xs: float, wire: float) -> bool:
    """Whether a spool that moves carries the feedback wire along."""
    return direction * (xs - wire) >= t.backlash - TOUCH


@inlined
def clamped_event(
    t: SpoolLaw,
    deflection: float,
    xf: float,
    xs: float,
    vs: float,
    wire: float,
    direction: int,
) -> int:
    """What ends a step with the flapper on its stop, which it leaves when the torque turns."""
    if (still_flapper(t.ratio, deflection, wire) - xf) * xf < 0.0:
        return RELEASE
    if direction == 0:
        return NOTHING if held(t, xf, xs) else BREAKAWAY
    if vs * direction <= 0.0:
        return REVERSAL
    return SPOOL_STOP if abs(xs) >= t.stroke and xs * direction > 0.0 else NOTHING


@inlined
def moving_event(
    t: SpoolLaw,
    h: float,
    before_xf: float,
    before_wf: float,
    xf: float,
    wf: float,
    xs: float,
    vs: float,
    wire: float,
    loose: bool,
    direction: int,
) -> int:
    """What ends a step with flapper free and spool moving; loose: without the feedback wire."""
    if vs * direction <= 0.0:
        return REVERSAL
    if loose and carried(t, direction, xs, wire):
        return ENGAGE
    if abs(xs) >= t.stroke and xs * direction > 0.0:
        return SPOOL_STOP
    if abs(xf) >= t.flapper_stop:
        return FLAPPER_STOP
    if before_wf * wf < 0.0:
        # An extreme of the flapper lies inside: the spool may stop there, or the flapper touch.
        swing = 0.25 * h * max(abs(before_wf), abs(wf))
        lowest = min(before_xf * direction, xf * direction) - t.dry - swing
        if lowest <= 0.0 or max(abs(before_xf), abs(xf)) + swing >= t.flapper_stop:
            return UNSURE
    return NOTHING


@inlined
def stuck_event(
    t: SpoolLaw,
    h: float,
    before_xf: float,
    before_wf: float,
    xf: float,
    wf: float,
    xs: float,
) -> int:
    """What ends a step with flapper free and spool at rest."""
    if not held(t, xf, xs):
        return BREAKAWAY
    if abs(xf) >= t.flapper_stop:
        return FLAPPER_STOP
    if before_wf * wf < 0.0:
        swing = 0.25 * h * max(abs(before_wf), abs(wf))
        if max(abs(before_xf), abs(xf)) + swing > min(t.breakaway, t.flapper_stop):
            return UNSURE
    return NOTHING


@inlined
def switch(t: SpoolLaw, event: int, s: SpoolState) -> SpoolState:
    """State after a step that an event ends, or none."""
    xf, wf, xs, vs, wire, direction, clamped = s
    if event == REVERSAL:
        vs, direction = 0.0, 0
        if abs(xf) > t.breakaway:
            direction = 1 if xf > 0.0 else -1
    elif event == SPOOL_STOP:
        xs, vs, direction = math.copysign(t.stroke, xs), 0.0, 0
    elif event == BREAKAWAY:
        direction = 1 if xf > 0.0 else -1
    elif event == FLAPPER_STOP:
        xf, wf, clamped = math.copysign(t.flapper_stop, xf), 0.0, True
    elif event == RELEASE:
        clamped = False
    return SpoolState(xf, wf, xs, vs, play(wire, xs, t.backlash), direction, clamped)
