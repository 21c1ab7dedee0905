"""Jack of a lane alone, with a linear second stage, over a piece of the spool's path.

A piece is cut into steps of the collocation (`ehadiag.model.sensors`). Stops and starts are
located inside of it. `ehadiag.model.simd_jack_pieces.linear_events` is the same side by side, but
for how roots are found: they agree to their tolerance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ehadiag.compile.jit import bare_kernel, large_part
from ehadiag.compile.vector import packed
from ehadiag.model.laws import JackLaw, excess_force, stage_pressure, stage_resistance
from ehadiag.model.sensors import (
    RADAU,
    JackState,
    PathPiece,
    PressureProbe,
    cubic_through_stages,
    position_on_piece,
    radau_creep_pressures,
    radau_pressures,
    radau_velocity,
    sample_pressure,
)


class JackSteps(NamedTuple):
    """Steps of a jack with a linear second stage over a piece."""

    travel: float = 3.0e-6
    """Spool travel within a step, m."""
    travel_share: float = 0.3
    """Spool travel within a step, as a share of its distance from the middle, 1."""
    decay: float = 3.0
    """Decay of the jack's velocity within a step where it starts or stops, as a power of e, 1."""
    creep_limit: float = 10.0
    """Velocity at which a jack no longer creeps, in Stribeck velocities."""
    fade: float = 0.5
    """Change of a creeping velocity within a step, in Stribeck velocities."""
    most: int = 32
    """Largest number of steps of a piece, 1."""
    iterations: int = 30
    """Largest number of iterations for a stop or a start, 1."""
    least_share: float = 1e-6
    """Share of a piece that is neglected, 1."""
    force_tolerance: float = 1e-9
    """Share of the holding force that is no excess, 1."""
    least_rate: float = 1e-30
    """Rate that is none, 1/m: not to divide by 0, nor beyond numbers of single precision."""
    least_velocity: float = 1e-12
    """Velocity that counts as none, m/s."""


JACK_STEPS = JackSteps()


@packed
def _velocity(
    creeps: bool, j: JackLaw, p: PathPiece, load: float, d: float, velocity: float,
    begin: float, end: float,
) -> float:  # fmt: skip
    """Velocity of the moving jack at the share `end` of a piece, `velocity` at `begin`, m/s.

    creeps: whether friction may have Stribeck's part; a constant where this is compiled.
    """
    h = (end - begin) * p.span
    x1, x2 = (
        position_on_piece(p, begin + RADAU.c1 * (end - begin)),
        position_on_piece(p, begin + RADAU.c2 * (end - begin)),
    )
    x3 = position_on_piece(p, end)
    e1, e2, e3 = stage_resistance(j, x1), stage_resistance(j, x2), stage_resistance(j, x3)
    if creeps and j.extra > 0.0:
        return _creeping_velocity(j, h, load, d, velocity, x1, x2, x3, e1, e2, e3)
    return radau_velocity(j, h, load, velocity, x1, x2, x3, e1, e2, e3)


@bare_kernel
def _creeping_velocity(
    j: JackLaw, h: float, load: float, d: float, velocity: float,
    x1: float, x2: float, x3: float, e1: float, e2: float, e3: float,
) -> float:  # fmt: skip
    """With Stribeck's friction; apart, so that the plain one stays small."""
    p3 = radau_creep_pressures(j, h, load, d, velocity, x1, x2, x3, e1, e2, e3)[2]
    return j.flow * x3 - e3 * p3


@packed
def _stop(
    creeps: bool, j: JackLaw, p: PathPiece, load: float, velocity: float, d: float, later: float,
    begin: float, end: float,
) -> float:  # fmt: skip
    """Share of a piece at which the jack stops, `velocity` at `begin`, `later` at `end`.

    Chandrupatla, "A new hybrid quadratic/bisection algorithm", Advances in Engineering Software
    28(3), 1997.
    """
    newest, other, at_newest, at_other = end, begin, later * d, velocity * d
    share = at_newest / (at_newest - at_other)
    for _ in range(JACK_STEPS.iterations):
        q = newest + share * (other - newest)
        value = _velocity(creeps, j, p, load, d, velocity, begin, q) * d
        if (value > 0.0) == (at_newest > 0.0):
            oldest, at_oldest = newest, at_newest
        else:
            oldest, at_oldest = other, at_other
            other, at_other = newest, at_newest
        newest, at_newest = q, value
        least = JACK_STEPS.least_share / abs(other - newest)
        if least > 0.5 or abs(value) < JACK_STEPS.least_velocity:
            return newest
        x = (newest - other) / (oldest - other)
        y = (at_newest - at_other) / (at_oldest - at_other)
        share = 0.5
        if y * y < x and (1.0 - y) * (1.0 - y) < 1.0 - x:
            share = at_newest / (at_other - at_newest) * at_oldest / (at_other - at_oldest)
            share += (
                (oldest - newest) / (other - newest)
                * at_newest / (at_oldest - at_newest) * at_other / (at_oldest - at_other)
            )  # fmt: skip
        share = min(max(share, least), 1.0 - least)
    return newest


@packed
def _break_away(j: JackLaw, p: PathPiece, hold: float, d: float, begin: float, end: float) -> float:
    """Share of a piece at which the force on the resting jack exceeds `hold` in direction d.

    It does so at `end`; regula falsi of the Illinois kind.
    """
    low, high = begin, end
    at_low = excess_force(j, position_on_piece(p, low), hold) * d
    at_high = excess_force(j, position_on_piece(p, high), hold) * d
    if at_low >= 0.0:
        return low
    for _ in range(JACK_STEPS.iterations):
        q = low + (high - low) * at_low / (at_low - at_high)
        x = position_on_piece(p, q)
        value = excess_force(j, x, hold) * d
        if value < 0.0:
            low, at_low = q, value
            at_high *= 0.5
        else:
            high, at_high = q, value
            at_low *= 0.5
        if abs(value) < JACK_STEPS.force_tolerance * abs(hold) * stage_resistance(j, x):
            # Not `high`: where the path is straight the first q is the root, from either side.
            return q
        if high - low < JACK_STEPS.least_share:
            break
    return high


@packed
def _steps(
    creeps: bool, j: JackLaw, p: PathPiece, begin: float, stop: float, state: JackState
) -> int:
    """Into how many steps a piece is cut."""
    near = min(abs(p.x0), abs(p.x1)) if p.x0 * p.x1 > 0.0 else 0.0
    travel, fine = (
        (stop - begin) * abs(p.x1 - p.x0),
        max(JACK_STEPS.travel, JACK_STEPS.travel_share * near),
    )
    if creeps and j.by_stribeck > 0.0 and near * j.flow * j.by_stribeck < JACK_STEPS.creep_limit:
        # A compiler may divide before it looks whether it has to.
        fine = min(fine, JACK_STEPS.fade / max(j.flow * j.by_stribeck, JACK_STEPS.least_rate))
    slides = state.direction != 0.0 and state.fresh == 0.0
    if slides and travel < fine:
        return 1  # most pieces: no division
    wanted = travel / fine
    if not slides:
        # The collocation is slow to forget what a start or a stop leaves.
        rate = (j.area / stage_resistance(j, near) + j.viscosity) * j.by_mass
        wanted = max(wanted, (stop - begin) * p.span * rate / JACK_STEPS.decay)
    return min(JACK_STEPS.most, 1 + int(wanted))


@packed
def limited_pressure(j: JackLaw, p12: float) -> float:
    """Pressure within what the supply allows, Pa."""
    return min(max(p12, -j.supply), j.supply)


@packed
def pressure_at_rest(j: JackLaw, x: float) -> float:
    """Pressure at a resting jack, Pa."""
    return limited_pressure(j, stage_pressure(j, x, 0.0))


@bare_kernel
def _sensed(
    j: JackLaw, probe: PressureProbe, p: PathPiece, load: float, d: float, velocity: float,
    begin: float, end: float, lagged: float, seen: float,
) -> tuple[float, float]:  # fmt: skip
    """Pressure behind the filter at the share `end` of a piece, and when it was sampled, Pa.

    lagged, seen: before; velocity: of the jack at `begin`, m/s.
    """
    step = end - begin
    x0, x1 = position_on_piece(p, begin), position_on_piece(p, begin + RADAU.c1 * step)
    x2, x3 = position_on_piece(p, begin + RADAU.c2 * step), position_on_piece(p, end)
    if d != 0.0:
        h, e1, e2, e3 = (
            step * p.span,
            stage_resistance(j, x1),
            stage_resistance(j, x2),
            stage_resistance(j, x3),
        )
        if j.extra > 0.0:
            p1, p2, p3 = radau_creep_pressures(j, h, load, d, velocity, x1, x2, x3, e1, e2, e3)
        else:
            p1, p2, p3 = radau_pressures(j, h, load, velocity, x1, x2, x3, e1, e2, e3)
        cubic = cubic_through_stages(
            limited_pressure(j, stage_pressure(j, x0, velocity)),
            limited_pressure(j, p1), limited_pressure(j, p2), limited_pressure(j, p3),
        )  # fmt: skip
    else:
        cubic = cubic_through_stages(
            pressure_at_rest(j, x0), pressure_at_rest(j, x1),
            pressure_at_rest(j, x2), pressure_at_rest(j, x3),
        )  # fmt: skip
    return sample_pressure(probe, cubic, begin * p.span, step * p.span, lagged, seen)


def _pieces(senses: bool) -> Any:
    """Compiled jack over a piece; senses: with the sensor of pressure and Stribeck's friction."""

    @(bare_kernel if senses else large_part)
    def piece(
        j: JackLaw, probe: PressureProbe, p: PathPiece, begin: float, stop: float, state: JackState
    ) -> JackState:
        place, velocity, d, fresh, p12, lagged, seen = state
        if d == 0.0:
            x, load = position_on_piece(p, stop), j.spring * place
            if excess_force(j, x, load + j.static) <= 0.0 <= excess_force(j, x, load - j.static):
                if senses:
                    lagged, seen = _sensed(j, probe, p, 0.0, 0.0, 0.0, begin, stop, lagged, seen)
                return JackState(place, velocity, 0.0, 0.0, p12, lagged, seen)
        steps = _steps(senses, j, p, begin, stop, state)
        q, step, fresh = begin, 1, 0.0
        while step <= steps:
            end = stop if step == steps else begin + (stop - begin) * step / steps
            spring = j.spring * place
            if d == 0.0:
                x = position_on_piece(p, end)
                up, down = (
                    excess_force(j, x, spring + j.static),
                    excess_force(j, x, spring - j.static),
                )
                if (up <= 0.0 and down >= 0.0) or (
                    abs(place) >= j.stroke and place * (up + down) > 0.0
                ):
                    if senses:
                        lagged, seen = _sensed(j, probe, p, 0.0, 0.0, 0.0, q, end, lagged, seen)
                    q, step = end, step + 1
                    continue
                d = 1.0 if up > 0.0 else -1.0
                away = _break_away(j, p, spring + j.static * d, d, q, end)
                if senses and away > q:
                    lagged, seen = _sensed(j, probe, p, 0.0, 0.0, 0.0, q, away, lagged, seen)
                q, velocity, fresh = away, 0.0, 1.0
            load = j.load + spring + d * j.friction
            later = _velocity(senses, j, p, load, d, velocity, q, end)
            if later * d > 0.0:
                if senses and end > q:
                    lagged, seen = _sensed(j, probe, p, load, d, velocity, q, end, lagged, seen)
                place += 0.5 * (end - q) * p.span * (velocity + later)
                velocity = later
                if abs(place) >= j.stroke and place * velocity > 0.0:
                    place = math.copysign(j.stroke, place)
                    velocity, d = 0.0, 0.0
                q, step = end, step + 1
                continue
            stopped = (
                _stop(senses, j, p, load, velocity, d, later, q, end) if velocity != 0.0 else end
            )
            if senses and stopped > q:
                lagged, seen = _sensed(
                    j,
                    probe,
                    p,
                    load,
                    d if velocity != 0.0 else 0.0,
                    velocity,
                    q,
                    stopped,
                    lagged,
                    seen,
                )
            place += 0.5 * (stopped - q) * p.span * velocity
            q, velocity, d, fresh = stopped, 0.0, 0.0, 1.0
            if end - q < JACK_STEPS.least_share:
                q, step = end, step + 1
        return JackState(place, velocity, d, fresh, p12, lagged, seen)

    return piece


linear_piece, sensed_linear_piece = _pieces(False), _pieces(True)
"""Compiled: jack over the shares begin … stop of a piece; the second one with what the plain one
leaves out."""
