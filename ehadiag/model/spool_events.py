"""Events of flapper and spool, and friction that falls with the spool's velocity.

With Stribeck's friction the part that fades with the velocity is held over a step at the mean of
its start and end; steps that are too long for that are halved.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ehadiag.compile.jit import inlined
from ehadiag.compile.vector import absolute, maximum, minimum, packed
from ehadiag.model.laws import (
    SpoolLaw,
    exp_minus,
    flapper_rest,
    play_output,
)


class SpoolEvents(NamedTuple):
    """Codes of what may end a step of flapper and spool."""

    none: int = 0
    """The step has no event."""
    reversal: int = 1
    """The spool reverses or comes to rest."""
    stop: int = 2
    """The spool meets its stop."""
    breakaway: int = 3
    """The spool breaks away."""
    flapper_stop: int = 4
    """The flapper meets its stop."""
    flapper_release: int = 5
    """The flapper leaves its stop."""
    wire_engagement: int = 6
    """The feedback wire meets the other side of its backlash."""


EVENTS = SpoolEvents()


WIRE_TOLERANCE = 1e-12
"""Rounding of a wire that the spool carries along, m."""


class SpoolState(NamedTuple):
    """Flapper and spool at an instant."""

    xf: float
    wf: float
    """Flapper deflection and its rate, m and m/s."""
    xs: float
    vs: float
    """Spool position and velocity, m and m/s."""
    wire: float
    """End of the feedback wire, which is the spool's but for the backlash, m."""
    direction: int
    """Of the spool's motion, +1 or -1; 0 at rest."""
    clamped: bool
    """Whether the flapper is on its stop."""


@inlined
def is_spool_held(t: SpoolLaw, xf: float, xs: float) -> bool:
    """Whether a spool at rest stays: friction holds it, or its stop does."""
    return abs(xf) <= t.breakaway or (abs(xs) >= t.stroke and xs * xf > 0.0)


@inlined
def is_wire_carried(t: SpoolLaw, direction: int, xs: float, wire: float) -> bool:
    """Whether a spool that moves carries the feedback wire along."""
    return direction * (xs - wire) >= t.backlash - WIRE_TOLERANCE


@inlined
def clamped_event(
    t: SpoolLaw, deflection: float, xf: float, xs: float, vs: float, wire: float, direction: int
) -> int:
    """What ends a step with the flapper on its stop, which it leaves when the torque turns."""
    if (flapper_rest(t.ratio, deflection, wire) - xf) * xf < 0.0:
        return EVENTS.flapper_release
    if direction == 0:
        return EVENTS.none if is_spool_held(t, xf, xs) else EVENTS.breakaway
    if vs * direction <= 0.0:
        return EVENTS.reversal
    return EVENTS.stop if abs(xs) >= t.stroke and xs * direction > 0.0 else EVENTS.none


@inlined
def state_after_event(t: SpoolLaw, event: int, s: SpoolState) -> SpoolState:
    """State after a step that an event ends, or none."""
    xf, wf, xs, vs, wire, direction, clamped = s
    if event == EVENTS.reversal:
        vs, direction = 0.0, 0
        if abs(xf) > t.breakaway:
            direction = 1 if xf > 0.0 else -1
    elif event == EVENTS.stop:
        xs, vs, direction = math.copysign(t.stroke, xs), 0.0, 0
    elif event == EVENTS.breakaway:
        direction = 1 if xf > 0.0 else -1
    elif event == EVENTS.flapper_stop:
        xf, wf, clamped = math.copysign(t.flapper_stop, xf), 0.0, True
    elif event == EVENTS.flapper_release:
        clamped = False
    return SpoolState(xf, wf, xs, vs, play_output(wire, xs, t.backlash), direction, clamped)


MAX_CREEP_ERROR = 2e-9
"""Largest error of a creeping step, m: a hundredth of a converter's step."""
CREEP_NEWTON_ROUNDS = 3
"""Rounds of Newton's method, 1."""
MIN_FRICTION_SLOPE = 0.2
"""Least slope of the equation of the end's friction, 1; below, the velocity diverges."""


@packed
def creep_friction(t: SpoolLaw, span: float, before: Any, free: Any, pull: Any, swing: Any) -> Any:
    """Friction of a step beyond the dynamic one, as the flapper deflection (m) that balances it.

    span: of the step, s; before: velocity at its start along the motion, m/s; free: velocity at its
    end without this friction, m/s; pull: its decrease by the friction, 1/s; swing: growth of the
    flapper's rate along the motion over the step, m/s. Returns the mean; the larger of start and
    end; velocity (m/s) by which the end is slower than with the mean; error bound of the step, m,
    beyond `MAX_CREEP_ERROR` where it is unknown.
    """
    first = t.extra * exp_minus(maximum(before, 0.0) * t.by_stribeck)
    # The velocity follows what acts within microseconds: the end's goes by the end's friction.
    length = span * t.damping / t.mass
    kept = exp_minus(length)
    weight = (1.0 - (1.0 - kept) / length) / (1.0 - kept)
    last, slope, move = first, first * 0.0 + 1.0, first * 0.0
    for _ in range(CREEP_NEWTON_ROUNDS):
        after = free - pull * (first + weight * (last - first))
        there = t.extra * exp_minus(maximum(after, 0.0) * t.by_stribeck)
        slope = 1.0 - weight * t.by_stribeck * pull * there
        move = (there - last) / maximum(slope, MIN_FRICTION_SLOPE)
        last = maximum(minimum(last + move, t.extra), 0.0)
    after = free - pull * (first + weight * (last - first))
    change = minimum(absolute(after - before) * t.by_stribeck, 1.0)
    largest = maximum(first, last)
    # The last move is far more than what is left after it.
    miss = largest * change * change * (1.0 / 12.0) + 0.1 * absolute(move)
    # The flapper rings within the step: what the derivatives at its ends say of the mean (Euler
    # and Maclaurin), the velocity following the flapper at once.
    fall = t.by_stribeck * 0.5 * (first + last) * t.force / t.damping
    ringing = span * (1.0 / 12.0) * fall * swing / maximum(1.0 - fall, MIN_FRICTION_SLOPE)
    miss = miss + 0.05 * absolute(ringing)
    unsure = maximum((MIN_FRICTION_SLOPE - slope) * 1e9, 0.0) * MAX_CREEP_ERROR
    # What friction does early in the step the feedback wire has partly undone at its end.
    undone = minimum(span * t.ratio * t.force / t.damping, first * 0.0 + 1.0) * (1.0 / 12.0)
    miss = miss + undone * absolute(last - first)
    doubt = span * t.force / t.damping * miss + unsure
    mean = maximum(minimum(0.5 * (first + last) + ringing, t.extra), 0.0)
    return mean, largest, pull * (weight - 0.5) * (last - first), doubt
