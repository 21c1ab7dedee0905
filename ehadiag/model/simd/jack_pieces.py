"""Jack of all lanes at once over the pieces that events cut of the spool's path in a tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel
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
    store_where,
    where,
)
from ehadiag.model.collocation import C1, C2, radau_velocity
from ehadiag.model.jack import FINE_RATIO, FINE_TRAVEL, FRESH_DECAY, MOST_STEPS
from ehadiag.model.jack_state import Piece, Probe, place_on
from ehadiag.model.lands import open_piece
from ehadiag.model.laws import JackLaw, excess, resistance
from ehadiag.model.second_stage import jack_piece
from ehadiag.model.sensors import sensing
from ehadiag.model.simd.jack_events import keep_lane_jack, lane_jack
from ehadiag.model.simd.layout import (
    DONE,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_VELOCITY,
    LANES,
    PLACE,
    jack_law_of_lane,
    jack_laws,
    sensor_law_of_lane,
    sensor_laws,
)

__all__ = ["ALONE", "MOST_PIECES", "PIECE", "PIECES_SIZE", "jack_over_pieces"]

PIECE = 4 * WIDTH
"""Numbers of a piece, WIDTH lanes each: duration (s; 0 in a lane that has no such piece), place at
the end, velocities at start and end."""
MOST_PIECES = 56
ALONE = MOST_PIECES * PIECE
"""Behind them: not 0 in lanes that go alone."""
PIECES_SIZE = ALONE + WIDTH


@packed
def jack_over_pieces(
    o: int,
    these: Vector,
    count: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    pieces: NDArray[np.float64],
) -> None:
    """Jack over a tick, by `count` pieces, of the lanes from `o` in which `these` is not 0.

    After a start or a stop it takes some steps a piece. A lane in which it starts or stops within a
    piece goes over that alone, and one whose second stage, lands or sensor are not the plain ones
    over all of them.
    """
    j, law = jack_laws(coefficients, o), sensor_laws(coefficients, o)
    place, velocity = load(state, JACK * LANES + o), load(state, JACK_VELOCITY * LANES + o)
    d, fresh = load(state, JACK_DIRECTION * LANES + o), load(state, FRESH * LANES + o)
    plain = (j.oil == 0.0) & (j.extra == 0.0) & (j.shaped == 0.0) & (law.lag + law.lead == 0.0)
    plain = plain & (these != 0.0)
    if anywhere((these != 0.0) & ~plain):
        store(pieces, ALONE, where(plain, 0.0, these))
        _alone(o, 0, count, tick, state, path, coefficients, pieces)
    x0 = load(path, PLACE * LANES + o)
    for n in range(count):
        k = n * PIECE
        span, x1 = load(pieces, k), load(pieces, k + WIDTH)
        here = plain & (span > 0.0)
        if anywhere(here):
            hold = j.spring * place
            up, down = excess(j, x1, hold + j.static), excess(j, x1, hold - j.static)
            rests = here & (d == 0.0) & (up <= 0.0) & (down >= 0.0)
            slides = here & (d != 0.0)
            if anywhere(slides):
                piece = Piece(
                    span, x0, x1, load(pieces, k + 2 * WIDTH) * span,
                    load(pieces, k + 3 * WIDTH) * span,
                )  # fmt: skip
                near = where(x0 * x1 > 0.0, least(magnitude(x0), magnitude(x1)), 0.0)
                fine = most(near * FINE_RATIO, FINE_TRAVEL)
                many = slides & ((fresh != 0.0) | (magnitude(x1 - x0) >= fine))
                slides = slides & ~many
                if anywhere(many):
                    rate = (j.area / resistance(j, near) + j.viscosity) * j.by_mass
                    wanted = magnitude(x1 - x0) / fine
                    decay = where(fresh != 0.0, span * rate * (1.0 / FRESH_DECAY), 0.0)
                    many, place, velocity = _in_steps(
                        j, piece, many, most(wanted, decay), d, place, velocity
                    )
                xa, xb = place_on(piece, C1), place_on(piece, C2)
                later = radau_velocity(
                    j, span, j.load + hold + d * j.friction, velocity, xa, xb, x1,
                    resistance(j, xa), resistance(j, xb), resistance(j, x1),
                )  # fmt: skip
                moved = place + 0.5 * span * (velocity + later)
                slides = slides & (later * d > 0.0) & (magnitude(moved) < j.stroke)
                place, velocity = where(slides, moved, place), where(slides, later, velocity)
                slides = slides | many
            alone = here & ~rests & ~slides
            fresh = where(rests | slides, 0.0, fresh)
            if anywhere(alone):
                _keep(o, plain, place, velocity, d, fresh, state)
                store(pieces, ALONE, where(alone, 1.0, 0.0))
                _alone(o, n, n + 1, tick, state, path, coefficients, pieces)
                place = load(state, JACK * LANES + o)
                velocity = load(state, JACK_VELOCITY * LANES + o)
                d, fresh = load(state, JACK_DIRECTION * LANES + o), load(state, FRESH * LANES + o)
            x0 = where(span > 0.0, x1, x0)
    _keep(o, plain, place, velocity, d, fresh, state)
    store(state, DONE * LANES + o, where(these != 0.0, 1.0, load(state, DONE * LANES + o)))


@packed
def _in_steps(
    j: JackLaw, piece: Piece, these: Mask, wanted: Vector, d: Vector, place: Vector,
    velocity: Vector,
) -> tuple[Mask, Vector, Vector]:  # fmt: skip
    """Sliding jack over a piece in as many steps as a lane alone would take, 1 + wanted of them.

    Returns in which of the lanes it goes on sliding, and theirs moved.
    """
    zero = d * 0.0
    count, most_steps = zero + 1.0, 1
    while most_steps < MOST_STEPS and anywhere(these & (wanted >= most_steps * 1.0)):
        count = where(wanted >= most_steps * 1.0, count + 1.0, count)
        most_steps += 1
    begin, at, speed, by_count = zero, place, velocity, (zero + 1.0) / count
    for step in range(1, most_steps + 1):
        goes = these & (count >= step * 1.0)
        end = where(count == step * 1.0, 1.0, by_count * (step * 1.0))
        width = end - begin
        xa, xb = place_on(piece, begin + C1 * width), place_on(piece, begin + C2 * width)
        xe, h = place_on(piece, end), width * piece.span
        later = radau_velocity(
            j, h, j.load + j.spring * at + d * j.friction, speed, xa, xb, xe,
            resistance(j, xa), resistance(j, xb), resistance(j, xe),
        )  # fmt: skip
        moved = at + 0.5 * h * (speed + later)
        these = these & (~goes | ((later * d > 0.0) & (magnitude(moved) < j.stroke)))
        at, speed = where(goes, moved, at), where(goes, later, speed)
        begin = end
    return these, where(these, at, place), where(these, speed, velocity)


@packed
def _keep(
    o: int, mine: Mask, place: Vector, velocity: Vector, d: Vector, fresh: Vector,
    state: NDArray[np.float64],
) -> None:  # fmt: skip
    """Write the jack of these lanes."""
    store_where(state, JACK * LANES + o, mine, place)
    store_where(state, JACK_VELOCITY * LANES + o, mine, velocity)
    store_where(state, JACK_DIRECTION * LANES + o, mine, d)
    store_where(state, FRESH * LANES + o, mine, fresh)


@bare_kernel
def _alone(
    o: int,
    first: int,
    count: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    pieces: NDArray[np.float64],
) -> None:
    """Jack of the lanes marked ALONE, one after the other, over the pieces first … count - 1."""
    for lane in range(WIDTH):
        if pieces[ALONE + lane] == 0.0:
            continue
        i = o + lane
        j, jack = jack_law_of_lane(coefficients, i), lane_jack(state, i)
        sensor = sensor_law_of_lane(coefficients, i)
        due, senses = tick - min(sensor.lead, tick), sensing(sensor)
        from_xs = path[PLACE * LANES + i]
        for n in range(count):
            k = n * PIECE + lane
            span, to_xs = pieces[k], pieces[k + WIDTH]
            if span > 0.0:
                if n >= first:
                    rise0, rise1 = pieces[k + 2 * WIDTH] * span, pieces[k + 3 * WIDTH] * span
                    piece = open_piece(j, Piece(span, from_xs, to_xs, rise0, rise1))
                    jack = jack_piece(j, Probe(sensor.lag, due), senses, piece, 0.0, 1.0, jack)
                due -= span
                from_xs = to_xs
        keep_lane_jack(jack, state, i)
