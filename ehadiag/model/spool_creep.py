"""Spool whose friction falls with its velocity (Stribeck), over steps within which it is held.

The equations stay linear where friction is constant, so over a step the part of it that fades with
the velocity is taken for the mean of start and end, which the end's own velocity decides: an
implicit trapezium. What that is off by is bounded, and steps that are too long for it are halved
as if they held an event.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ehadiag.compile.kernels import inlined
from ehadiag.compile.vector import least, magnitude, most, packed
from ehadiag.model.laws import SpoolLaw, faded, slide_base, steady_rate, still_flapper
from ehadiag.model.spool_events import SpoolState

__all__ = ["DOUBT", "Transition", "creep", "creeping_step"]

DOUBT = 2e-9
"""Distance (m) by which a step may be off; a hundredth of a converter's step."""
ROUNDS = 3
"""Of Newton's method."""
LEAST_SLOPE = 0.2
"""Of the equation of the end's friction: below, the velocity runs away within the step."""


class Transition(NamedTuple):
    """What a step without friction makes of flapper and spool, by rows XF, DXF, XS, DXS."""

    m00: Any
    m01: Any
    m02: Any
    m03: Any
    m10: Any
    m11: Any
    m12: Any
    m13: Any
    m20: Any
    m21: Any
    m22: Any
    m23: Any
    m30: Any
    m31: Any
    m32: Any
    m33: Any


@packed
def creep(t: SpoolLaw, span: float, before: Any, free: Any, pull: Any, swing: Any) -> Any:
    """Friction of a step beyond the dynamic one, as the flapper deflection (m) that balances it.

    Parameters
    ----------
    span: of the step, s.
    before: velocity at its start along the motion, m/s.
    free: velocity at its end if there were none of it, m/s.
    pull: how much less that is by each of it, 1/s.
    swing: by how much the flapper's rate grows along the motion over the step, m/s.

    Returns
    -------
    Its mean; the larger of start and end; the velocity (m/s) that the end has less than with the
    mean; by how much the step may be off, m, beyond `DOUBT` where it cannot be told.
    """
    first = t.extra * faded(most(before, 0.0) * t.by_stribeck)
    # The velocity follows what acts within microseconds: the end's goes by the end's friction.
    length = span * t.damping / t.mass
    kept = faded(length)
    weight = (1.0 - (1.0 - kept) / length) / (1.0 - kept)
    last, slope, move = first, first * 0.0 + 1.0, first * 0.0
    for _ in range(ROUNDS):
        after = free - pull * (first + weight * (last - first))
        there = t.extra * faded(most(after, 0.0) * t.by_stribeck)
        slope = 1.0 - weight * t.by_stribeck * pull * there
        move = (there - last) / most(slope, LEAST_SLOPE)
        last = most(least(last + move, t.extra), 0.0)
    after = free - pull * (first + weight * (last - first))
    change = least(magnitude(after - before) * t.by_stribeck, 1.0)
    largest = most(first, last)
    # The last move is far more than what is left after it.
    miss = largest * change * change * (1.0 / 12.0) + 0.1 * magnitude(move)
    # The flapper rings within the step: what the derivatives at its ends say of the mean (Euler
    # and Maclaurin), the velocity following the flapper at once.
    fall = t.by_stribeck * 0.5 * (first + last) * t.force / t.damping
    ringing = span * (1.0 / 12.0) * fall * swing / most(1.0 - fall, LEAST_SLOPE)
    miss = miss + 0.05 * magnitude(ringing)
    unsure = most((LEAST_SLOPE - slope) * 1e9, 0.0) * DOUBT
    # What friction does early in the step the feedback wire has partly undone at its end.
    undone = least(span * t.ratio * t.force / t.damping, first * 0.0 + 1.0) * (1.0 / 12.0)
    miss = miss + undone * magnitude(last - first)
    doubt = span * t.force / t.damping * miss + unsure
    mean = most(least(0.5 * (first + last) + ringing, t.extra), 0.0)
    return mean, largest, pull * (weight - 0.5) * (last - first), doubt


@inlined
def creeping_step(
    t: SpoolLaw, m: Transition, h: float, fade: float, deflection: float, loose: bool,
    s: SpoolState,
) -> tuple[SpoolState, bool]:  # fmt: skip
    """Flapper and moving spool after a step of `h` seconds, and whether it was short enough.

    m: with the feedback wire, or without it where `loose`; fade: of the spool's velocity with the
    flapper on its stop, over the step.
    """
    d = float(s.direction)
    if s.clamped:
        rest = steady_rate(t, s.xf, d)
        pull = t.force / t.damping * (1.0 - fade)
        free = rest + (s.vs - rest) * fade
        mean, _, less, doubt = creep(t, h, s.vs * d, free * d, pull, 0.0)
        steady = steady_rate(t, s.xf - mean * d, d)
        xs = s.xs + steady * h + (s.vs - steady) * (1.0 - fade) * t.mass / t.damping
        vs = steady + (s.vs - steady) * fade - less * d
        after = SpoolState(s.xf, s.wf, xs, vs, s.wire, s.direction, s.clamped)
    elif loose:
        still = still_flapper(t.ratio, deflection, s.wire)
        rest = steady_rate(t, still, d)
        a, w = s.xf - still, s.wf
        pull = t.force / t.damping * (1.0 - m.m33)
        free = rest + m.m30 * a + m.m31 * w + m.m33 * (s.vs - rest)
        swing = (m.m10 * a + m.m11 * w - w) * d
        mean, _, less, doubt = creep(t, h, s.vs * d, free * d, pull, swing)
        steady = steady_rate(t, still - mean * d, d)
        v = s.vs - steady
        after = SpoolState(
            still + m.m00 * a + m.m01 * w,
            m.m10 * a + m.m11 * w,
            s.xs + steady * h + m.m20 * a + m.m21 * w + m.m23 * v,
            steady + m.m30 * a + m.m31 * w + m.m33 * v - less * d,
            s.wire,
            s.direction,
            s.clamped,
        )
    else:
        base = slide_base(t, deflection, d)
        a, w, b, v = s.xf - t.dry * d, s.wf, s.xs - base, s.vs
        free = m.m30 * a + m.m31 * w + m.m32 * b + m.m33 * v
        pull = m.m30 - m.m32 * t.reach
        swing = (m.m10 * a + m.m11 * w + m.m12 * b + m.m13 * v - w) * d
        mean, _, less, doubt = creep(t, h, s.vs * d, free * d, pull, swing)
        rest_xf, rest_xs = (t.dry + mean) * d, base - mean * t.reach * d
        a, b = s.xf - rest_xf, s.xs - rest_xs
        after = SpoolState(
            rest_xf + m.m00 * a + m.m01 * w + m.m02 * b + m.m03 * v,
            m.m10 * a + m.m11 * w + m.m12 * b + m.m13 * v,
            rest_xs + m.m20 * a + m.m21 * w + m.m22 * b + m.m23 * v,
            m.m30 * a + m.m31 * w + m.m32 * b + m.m33 * v - less * d,
            s.wire,
            s.direction,
            s.clamped,
        )
    return after, doubt <= DOUBT
