"""Second stage and jack of many candidates over a step, one lane each.

One step of the collocation of `ehadiag.model.jack` for all lanes; a lane whose jack sticks, breaks
away or meets its stop takes that step alone (`ehadiag.model.simd.jack_events`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.vector import (
    WIDTH,
    Mask,
    Vector,
    anywhere,
    least,
    load,
    magnitude,
    most,
    packed,
    store,
    where,
)
from ehadiag.model.collocation import C1, C2, creeping_pressures, radau_pressures, radau_velocity
from ehadiag.model.jack import CREEPING, FINE_FADE
from ehadiag.model.lands import opens, opens_by
from ehadiag.model.laws import JackLaw, opening, pressure, resistance
from ehadiag.model.sensors import followed, through_stages
from ehadiag.model.simd.layout import (
    BUSY,
    DONE,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_VELOCITY,
    LAGGED,
    LANES,
    MOST_HALVINGS,
    NODES,
    PLACE,
    POSITION,
    PRESSURE,
    PRESSURE_SEEN,
    SENSING,
    SENSING_ROWS,
    SLOPE,
    jack_laws,
    sampled_steps,
    sensor_laws,
    whole_steps,
)

__all__ = [
    "END",
    "MIDDLE",
    "STAGE_NUMBERS",
    "START",
    "follow_lanes",
    "follow_pressure",
    "jack_lanes",
    "open_lanes",
    "place_at",
    "positions",
    "pressures",
    "rest_jacks",
    "sensed_jack_lanes",
]

COARSE_TRAVEL = 8.0e-6
"""Spool travel from first to last stage of a step (m, or the distance from the middle) from which
a lane goes alone."""
CORNER_TRAVEL = 4.0e-6
"""The same where the step passes the opening at which the pressure gain saturates, m."""


def _stages() -> NDArray[np.float64]:
    """Where stages, start and middle of steps stand on the spool's path, shape (5, 16, 5, 5), flat.

    For a tick cut into 1, 2, 4, 8 or 16 steps, and each step: the node before, and Hermite's
    weights of place before and after and of slope (by the length of the tick) before and after.
    """
    out = np.zeros((MOST_HALVINGS + 1, 1 << MOST_HALVINGS, 5, 5))
    for level in range(MOST_HALVINGS + 1):
        for step in range(1 << level):
            for stage, share in enumerate((C1, C2, 1.0, 0.0, 0.5)):
                where = (step + share) / (1 << level) * NODES
                node = min(int(where), NODES - 1)
                u = where - node
                out[level, step, stage] = (
                    node,
                    (1.0 + 2.0 * u) * (1.0 - u) ** 2,
                    u * u * (3.0 - 2.0 * u),
                    u * (1.0 - u) ** 2 / NODES,
                    u * u * (u - 1.0) / NODES,
                )
    return out.ravel()


STAGES = _stages()
STAGE_NUMBERS = 25
"""Numbers of a step."""
END, START, MIDDLE = 10, 15, 20
"""Where those of its end, start and middle begin; the other stages' stand before them."""


@packed
def place_at(path: NDArray[np.float64], o: int, k: int, tick: float) -> Vector:
    """Spool at the stage whose place in STAGES is `k`, lanes from `o`."""
    a = int(STAGES[k]) * LANES + o
    b = a + LANES
    slopes = load(path, SLOPE * LANES + a) * STAGES[k + 3]
    slopes = slopes + load(path, SLOPE * LANES + b) * STAGES[k + 4]
    return STAGES[k + 1] * load(path, a) + STAGES[k + 2] * load(path, b) + tick * slopes


@packed
def open_lanes(end: int, path: NDArray[np.float64], coefficients: NDArray[np.float64]) -> None:
    """Make the spool's path of a tick that of the lands' opening, all lanes, in place."""
    for o in range(0, end, WIDTH):
        j = jack_laws(coefficients, o)
        for n in range(NODES + 1):
            place, slope = (PLACE + n) * LANES + o, (SLOPE + n) * LANES + o
            x = load(path, place)
            store(path, slope, opens_by(j, x) * load(path, slope))
            store(path, place, opens(j, x))


@packed
def _limited(j: JackLaw, p12: Vector) -> Vector:
    """Pressure within what the supply allows, Pa."""
    return most(least(p12, j.supply), -j.supply)


@packed
def _sense(
    j: JackLaw, these: Mask, level: int, step: int, o: int,
    p0: Vector, p1: Vector, p2: Vector, p3: Vector,
    state: NDArray[np.float64], coefficients: NDArray[np.float64],
) -> None:  # fmt: skip
    """Follow the pressure of these lanes through their filters, from start and stages of a step."""
    cubic = through_stages(_limited(j, p0), _limited(j, p1), _limited(j, p2), _limited(j, p3))
    follow_pressure(cubic, these, level, step, o, state, coefficients)


@packed
def follow_pressure(
    cubic: Any, these: Mask, level: int, step: int, o: int,
    state: NDArray[np.float64], coefficients: NDArray[np.float64],
) -> None:  # fmt: skip
    """Follow the pressure of these lanes, cubics over a step, through their filters."""
    place = level * SENSING_ROWS * LANES + o
    before, seen = load(state, LAGGED * LANES + o), load(state, PRESSURE_SEEN * LANES + o)
    sampled = load(coefficients, (SENSING + SENSING_ROWS - 1) * LANES + place) == step * 1.0
    at_sampling = followed(sampled_steps(coefficients, place), before, cubic)
    store(state, PRESSURE_SEEN * LANES + o, where(these & sampled, at_sampling, seen))
    at_end = followed(whole_steps(coefficients, place), before, cubic)
    store(state, LAGGED * LANES + o, where(these, at_end, before))


def _lanes(senses: bool) -> Any:
    """Compiled step of the jack of all lanes, with or without the sensor of pressure."""

    @packed
    def lanes(
        end: int,
        level: int,
        step: int,
        tick: float,
        state: NDArray[np.float64],
        path: NDArray[np.float64],
        coefficients: NDArray[np.float64],
    ) -> bool:
        any_busy = False
        h = tick / (1 << level)
        k = ((level << MOST_HALVINGS) + step) * STAGE_NUMBERS
        for o in range(0, end, WIDTH):
            j = jack_laws(coefficients, o)
            place, velocity = load(state, JACK * LANES + o), load(state, JACK_VELOCITY * LANES + o)
            d = load(state, JACK_DIRECTION * LANES + o)
            x3 = place_at(path, o, k + END, tick)
            e3 = resistance(j, x3)
            # At rest: the force of the second stage, times e, against what holds.
            force = j.load + j.spring * place
            push = j.area * j.flow * x3 - force * e3
            held = magnitude(push) <= j.static * e3
            held = held | ((magnitude(place) >= j.stroke) & (place * push > 0.0))
            done = load(state, DONE * LANES + o) != 0.0
            rests = (d == 0.0) & held & ~done
            fine = done | rests
            if senses and anywhere(rests):
                x0, x1, x2 = (
                    place_at(path, o, k + START, tick),
                    place_at(path, o, k, tick),
                    place_at(path, o, k + 5, tick),
                )
                _sense(
                    j, rests, level, step, o,
                    pressure(j, x0, 0.0), pressure(j, x1, 0.0), pressure(j, x2, 0.0),
                    pressure(j, x3, 0.0), state, coefficients,
                )  # fmt: skip
            if anywhere(d != 0.0):
                creeps = senses and anywhere(j.extra > 0.0)
                x1 = place_at(path, o, k, tick)
                x2 = place_at(path, o, k + 5, tick)
                e1, e2, pull = resistance(j, x1), resistance(j, x2), force + d * j.friction
                if senses:
                    if creeps:
                        p1, p2, p3 = creeping_pressures(
                            j, h, pull, d, velocity, x1, x2, x3, e1, e2, e3
                        )
                    else:
                        p1, p2, p3 = radau_pressures(j, h, pull, velocity, x1, x2, x3, e1, e2, e3)
                    later = j.flow * x3 - e3 * p3
                else:
                    later = radau_velocity(j, h, pull, velocity, x1, x2, x3, e1, e2, e3)
                moved = place + 0.5 * h * (velocity + later)
                slides = (later * d > 0.0) & (magnitude(moved) < j.stroke)
                # What the collocation does not follow: a fresh start, a fast way past the closed
                # orifice.
                near = where(x1 * x3 > 0.0, least(magnitude(x1), magnitude(x3)), 0.0)
                travel = magnitude(x3 - x1)
                coarse = travel > most(near, COARSE_TRAVEL)
                coarse = coarse | (
                    (near < j.corner)
                    & (most(opening(j, x1), opening(j, x3)) > j.corner)
                    & (travel > CORNER_TRAVEL)
                )
                if creeps:
                    fade = j.flow * j.by_stribeck
                    coarse = coarse | ((near * fade < CREEPING) & (travel * fade > FINE_FADE))
                slides = slides & ~coarse & (load(state, FRESH * LANES + o) == 0.0)
                slides = slides & ~done
                store(state, JACK * LANES + o, where(slides, moved, place))
                store(state, JACK_VELOCITY * LANES + o, where(slides, later, velocity))
                fine = fine | slides
                if senses and anywhere(slides):
                    p0 = pressure(j, place_at(path, o, k + START, tick), velocity)
                    _sense(j, slides, level, step, o, p0, p1, p2, p3, state, coefficients)
            store(state, BUSY * LANES + o, where(fine, 0.0, 1.0))
            if anywhere(~fine):
                any_busy = True
        return any_busy

    return lanes


jack_lanes, sensed_jack_lanes = _lanes(False), _lanes(True)
"""Compiled: jack of the lanes before `end` over one of the 2^level steps of a tick; with the second
one their pressure as the filter before its converter has it. Lanes with an event are marked BUSY
and left as they were; returns whether there are any."""


@packed
def pressures(
    end: int,
    kept: bool,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Differential pressure of all lanes as it is sampled in a tick, into the state.

    kept: whether any lane has it in the state, stored in the oil or behind a filter.
    """
    for o in range(0, end, WIDTH):
        j = jack_laws(coefficients, o)
        x = load(path, (PLACE + NODES) * LANES + o)
        p12 = _limited(j, pressure(j, x, load(state, JACK_VELOCITY * LANES + o)))
        if kept:
            law = sensor_laws(coefficients, o)
            p12 = where(j.oil > 0.0, load(state, PRESSURE * LANES + o), p12)
            p12 = where(law.lag + law.lead > 0.0, load(state, PRESSURE_SEEN * LANES + o), p12)
        store(state, PRESSURE_SEEN * LANES + o, p12)


@packed
def positions(end: int, state: NDArray[np.float64], coefficients: NDArray[np.float64]) -> None:
    """Jack of all lanes as it is sampled in a tick, into the state."""
    for o in range(0, end, WIDTH):
        before = sensor_laws(coefficients, o).lead * load(state, JACK_VELOCITY * LANES + o)
        store(state, POSITION * LANES + o, load(state, JACK * LANES + o) - before)


@packed
def follow_lanes(
    end: int,
    measured: float,
    follow: float,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Move the jack of all lanes by a share of its innovation."""
    for o in range(0, end, WIDTH):
        law, stroke = sensor_laws(coefficients, o), jack_laws(coefficients, o).stroke
        error = measured - law.position_offset
        error = error - law.position_gain * load(state, POSITION * LANES + o)
        place = load(state, JACK * LANES + o) + follow * error
        store(state, JACK * LANES + o, most(least(place, stroke), -stroke))


@packed
def rest_jacks(
    end: int,
    origin: float,
    place: float,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of all lanes at rest, spool and jack at these positions, m."""
    for o in range(0, end, WIDTH):
        j = jack_laws(coefficients, o)
        store(state, JACK * LANES + o, place)
        p12 = _limited(j, pressure(j, opens(j, j.load * 0.0 + origin), 0.0))
        store(state, LAGGED * LANES + o, p12)
        store(state, PRESSURE * LANES + o, p12)
