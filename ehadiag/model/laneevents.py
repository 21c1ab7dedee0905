"""First stage and spool of one lane over a tick with events, and the jack beside them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined, kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanelayout import (
    BREAK,
    BUSY,
    CLAMPED,
    DAMPING,
    DIRECTION,
    DONE,
    DRY,
    DYNAMIC,
    FLAPPER,
    FLAPPER_RATE,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_FRICTION,
    JACK_VELOCITY,
    LANES,
    NODES,
    PATH_ROWS,
    PLACE,
    SLOPE,
    SPOOL,
    SPOOL_RATE,
)
from ehadiag.model.lanestops import jack_piece
from ehadiag.model.lanetables import GRID
from ehadiag.model.spoolevents import (
    BREAKAWAY,
    FLAPPER_STOP,
    NOTHING,
    RELEASE,
    REVERSAL,
    SPOOL_STOP,
    clamped_event,
    moving_event,
    stuck_event,
)
from ehadiag.model.transition import FINEST, SpoolScalars

__all__ = ["PIECES_SIZE", "event_ticks"]

WHOLE = 1 << FINEST
MOST_PIECES = 32
PIECES_SIZE = 4 * MOST_PIECES
"""Room behind the rows of the path: pieces (duration in s, place at the end, velocities)."""


@kernel
def event_ticks(
    c: PlantConstants,
    torque: float,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Flapper and spool of BUSY lanes over a tick with events, located to tick / 2^FINEST.

    A step to the next node that ends with an event is shortened, by regula falsi on the quantity
    that decides the event where there is one and by halving else, until the event is one finest
    step away; then that step is taken.
    """
    for i in range(LANES):
        if state[BUSY * LANES + i] != 0.0:
            _event_tick(c, i, torque, tick, state, path, coefficients, moving, stuck)


@inlined
def _event_tick(
    c: PlantConstants,
    i: int,
    torque: float,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Lane `i`."""
    force, unit = c.AS * c.GPF, tick / WHOLE
    damping, dry = coefficients[DAMPING * LANES + i], coefficients[DRY * LANES + i]
    limit = coefficients[BREAK * LANES + i]
    t = SpoolScalars(force, damping, coefficients[DYNAMIC * LANES + i], limit, 0.0, 0.0)
    xf, wf = state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i]
    xs, vs = state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i]
    direction, clamped = int(state[DIRECTION * LANES + i]), state[CLAMPED * LANES + i] != 0.0
    done, single = 0, False
    from_xs, from_vs, since = xs, vs, 0
    starts, count = False, 0
    while done < WHOLE:
        grid = GRID - (done & (GRID - 1))
        step = 1 if single else grid
        settled, single = single, False
        low, high = 0, grid + 1
        at_low = vs * direction if direction != 0 else limit - abs(xf)
        at_high = 1.0
        while True:
            new_xf, new_wf, new_xs, new_vs = xf, wf, xs, vs
            h = step * unit
            decides = 1.0
            if clamped:
                if direction != 0:
                    steady = (force * xf - t.dynamic * direction) / damping
                    fade = math.exp(-h * damping / c.MS)
                    new_xs += steady * h + (vs - steady) * (1.0 - fade) * c.MS / damping
                    new_vs = steady + (vs - steady) * fade
                event = clamped_event(c, t, torque, xf, new_xs, new_vs, direction)
            elif direction != 0:
                rest_xf = dry * direction
                rest_xs = (torque - c.KF * rest_xf) / c.KSF
                a, b = xf - rest_xf, xs - rest_xs
                m = (i * (GRID + 1) + step) * 16
                new_xf = rest_xf + moving[m] * a + moving[m + 1] * wf
                new_xf += moving[m + 2] * b + moving[m + 3] * vs
                new_wf = moving[m + 4] * a + moving[m + 5] * wf
                new_wf += moving[m + 6] * b + moving[m + 7] * vs
                new_xs = rest_xs + moving[m + 8] * a + moving[m + 9] * wf
                new_xs += moving[m + 10] * b + moving[m + 11] * vs
                new_vs = moving[m + 12] * a + moving[m + 13] * wf
                new_vs += moving[m + 14] * b + moving[m + 15] * vs
                event = moving_event(c, t, h, xf, wf, new_xf, new_wf, new_xs, new_vs, direction)
                decides = new_vs * direction
            else:
                rest_xf = (torque - c.KSF * xs) / c.KF
                a = xf - rest_xf
                new_xf = rest_xf + stuck[step * 4] * a + stuck[step * 4 + 1] * wf
                new_wf = stuck[step * 4 + 2] * a + stuck[step * 4 + 3] * wf
                event = stuck_event(c, t, h, xf, wf, new_xf, new_wf, xs)
                decides = limit - abs(new_xf)
            if settled:
                break
            if event == NOTHING:
                if step == grid:
                    break
                low, at_low = step, decides
                at_high *= 0.5
            else:
                high, at_high = step, decides
                at_low *= 0.5
            if high - low == 1:
                settled = True
                if low == 0:
                    break
                step, single = low, True
            elif at_low > 0.0 and at_high < 0.0:
                guess = low + int((high - low) * at_low / (at_low - at_high) + 0.5)
                step = min(max(guess, low + 1), high - 1)
            else:
                step = (low + high) >> 1
        done += step
        since += step
        end_vs = new_vs
        xf, wf, xs, vs = new_xf, new_wf, new_xs, new_vs
        if event == REVERSAL:
            vs, direction = 0.0, 0
            if abs(xf) > limit:
                direction = 1 if xf > 0.0 else -1
        elif event == SPOOL_STOP:
            xs, vs, direction = math.copysign(c.XSM, xs), 0.0, 0
        elif event == BREAKAWAY:
            direction = 1 if xf > 0.0 else -1
        elif event == FLAPPER_STOP:
            xf, wf, clamped = math.copysign(c.XFM, xf), 0.0, True
        elif event == RELEASE:
            clamped = False
        starts = starts or (event > NOTHING and direction != 0 and vs == 0.0)
        at_node = done & (2 * GRID - 1) == 0
        if (event > NOTHING and count < MOST_PIECES - NODES) or at_node:
            o = PATH_ROWS * LANES + 4 * count
            path[o], path[o + 1], path[o + 2], path[o + 3] = since * unit, xs, from_vs, end_vs
            from_vs, since = vs, 0
            count += 1
        if at_node:
            path[(PLACE + done // (2 * GRID)) * LANES + i] = xs
            path[(SLOPE + done // (2 * GRID)) * LANES + i] = vs
    if starts:
        friction = coefficients[JACK_FRICTION * LANES + i]
        place, velocity = state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i]
        d, fresh = state[JACK_DIRECTION * LANES + i], state[FRESH * LANES + i]
        for n in range(count):
            o = PATH_ROWS * LANES + 4 * n
            span = path[o]
            place, velocity, d, fresh = jack_piece(
                c, friction, span, 0.0, 1.0, from_xs, path[o + 1],
                path[o + 2] * span, path[o + 3] * span, place, velocity, d, fresh,
            )  # fmt: skip
            from_xs = path[o + 1]
        state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i] = place, velocity
        state[JACK_DIRECTION * LANES + i], state[FRESH * LANES + i] = d, fresh
        state[DONE * LANES + i] = 1.0
    state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i] = xf, wf
    state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i] = xs, vs
    state[DIRECTION * LANES + i] = direction
    state[CLAMPED * LANES + i] = 1.0 if clamped else 0.0
