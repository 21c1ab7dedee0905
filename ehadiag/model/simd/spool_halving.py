"""First stage and spool of all lanes at once over a tick with events, located by halving.

A lane alone (`ehadiag.model.simd.spool_events`) takes as long as all of them here: most of the
candidates of a search break away and stop within the same ticks. Lanes step together, a quarter of
the tick, an eighth, … down to the finest step; a lane takes a step in which no event may hide, and
leaves it to shorter ones where one may. Past its event it goes on by the longest steps up to the
next node of the path, in which the next event is looked for alike.

What is rare is left to a lane alone: stops, a flapper on its stop, backlash, friction that falls
with the velocity, more than `MOST_EVENTS` events in a tick. Which way a lane goes does not depend
on its neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined
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
from ehadiag.model.laws import SpoolLaw, slide_base, still_flapper
from ehadiag.model.scalar.transition import FINEST
from ehadiag.model.simd.coefficients import HALVINGS
from ehadiag.model.simd.jack_pieces import MOST_PIECES, PIECE, jack_over_pieces
from ehadiag.model.simd.layout import (
    BUSY,
    CLAMPED,
    DEFLECTION,
    DIRECTION,
    FLAPPER,
    FLAPPER_RATE,
    LANES,
    NODES,
    PLACE,
    SLOPE,
    SPOOL,
    SPOOL_RATE,
    WIRE,
    spool_laws,
)

__all__ = ["MOST_EVENTS", "halved_lanes"]

WHOLE = float(1 << FINEST)
QUARTER = float(1 << HALVINGS)
"""Finest steps between two nodes of the path."""
MOST_EVENTS = 5
"""Of a lane in a tick. Each cuts a piece of the path for all lanes of a vector; so do the nodes."""


@packed
def _slid(
    t: SpoolLaw, m: NDArray[np.float64], k: int, h: float, fine: bool, deflection: Vector,
    xf: Vector, wf: Vector, xs: Vector, vs: Vector, d: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Mask, Mask]:  # fmt: skip
    """Moving spool and flapper after a step of `h` seconds, by the transitions from `k` on.

    Returns the state, where an event has come or may hide (unless the step is the finest), and
    where spool or flapper has met a stop.
    """
    base = slide_base(t, deflection, d)
    a, w, b, v = xf * d - t.dry, wf * d, (xs - base) * d, vs * d
    na = load(m, k) * a + load(m, k + LANES) * w
    na = na + load(m, k + 2 * LANES) * b + load(m, k + 3 * LANES) * v
    nw = load(m, k + 4 * LANES) * a + load(m, k + 5 * LANES) * w
    nw = nw + load(m, k + 6 * LANES) * b + load(m, k + 7 * LANES) * v
    nb = load(m, k + 8 * LANES) * a + load(m, k + 9 * LANES) * w
    nb = nb + load(m, k + 10 * LANES) * b + load(m, k + 11 * LANES) * v
    nv = load(m, k + 12 * LANES) * a + load(m, k + 13 * LANES) * w
    nv = nv + load(m, k + 14 * LANES) * b + load(m, k + 15 * LANES) * v
    size = magnitude(na + t.dry)
    stops = (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
    found = (nv <= 0.0) | stops
    if not fine:
        # Where an extreme of the flapper lies inside the step the spool may stop, it may touch.
        swing = 0.25 * h * most(magnitude(w), magnitude(nw))
        low = least(a, na) - swing <= 0.0
        far = most(magnitude(a + t.dry), size) + swing >= t.flapper_stop
        found = found | ((w * nw < 0.0) & (low | far))
    return (na + t.dry) * d, nw * d, nb * d + base, nv * d, found, stops


@packed
def _rung(
    t: SpoolLaw, m: NDArray[np.float64], k: int, h: float, fine: bool, still: Vector,
    xf: Vector, wf: Vector,
) -> tuple[Vector, Vector, Mask, Mask]:  # fmt: skip
    """As `_slid` for a spool at rest, whose flapper rings about `still`, m: flapper and rate."""
    a = xf - still
    new_xf = load(m, k) * a + load(m, k + LANES) * wf + still
    new_wf = load(m, k + 2 * LANES) * a + load(m, k + 3 * LANES) * wf
    size = magnitude(new_xf)
    stops = size >= t.flapper_stop
    found = (size > t.breakaway) | stops
    if not fine:
        swing = 0.25 * h * most(magnitude(wf), magnitude(new_wf))
        far = most(magnitude(xf), size) + swing > least(t.breakaway, t.flapper_stop)
        found = found | ((wf * new_wf < 0.0) & far)
    return new_xf, new_wf, found, stops


@packed
def _cut(
    pieces: NDArray[np.float64], count: int, span: Vector, xs: Vector, before: Vector, end: Vector
) -> None:
    """Write a piece of the path: its duration (s, 0 in lanes that have none), place, velocities."""
    o = count * PIECE
    store(pieces, o, span)
    store(pieces, o + WIDTH, xs)
    store(pieces, o + 2 * WIDTH, before)
    store(pieces, o + 3 * WIDTH, end)


@inlined
def _halved(
    o: int,
    tick: float,
    with_jack: bool,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    slides: NDArray[np.float64],
    rings: NDArray[np.float64],
    pieces: NDArray[np.float64],
) -> None:
    """Lanes from `o`."""
    unit = tick / WHOLE
    t = spool_laws(coefficients, o)
    busy, d = load(state, BUSY * LANES + o), load(state, DIRECTION * LANES + o)
    xf, wf = load(state, FLAPPER * LANES + o), load(state, FLAPPER_RATE * LANES + o)
    xs, vs = load(state, SPOOL * LANES + o), load(state, SPOOL_RATE * LANES + o)
    wire, deflection = load(state, WIRE * LANES + o), load(state, DEFLECTION * LANES + o)
    mine = (busy != 0.0) & (load(state, CLAMPED * LANES + o) == 0.0) & (t.extra == 0.0)
    mine = mine & (t.backlash == 0.0) & (magnitude(xs) < t.stroke)
    if not anywhere(mine):
        return
    zero = d * 0.0
    good = where(mine, 1.0, zero)
    before, since, events, kinks = vs, zero, zero, zero
    count = 0
    for node in range(NODES):
        done, limit = zero, zero + QUARTER
        top = HALVINGS
        while True:
            going = (good != 0.0) & (done < QUARTER)
            if not anywhere(going):
                break
            # Where an event was suspected in vain.
            limit = where(done < limit, limit, QUARTER)
            for n in range(top + 2):
                level = max(top - n, 0)
                units = float(1 << level)
                fine = level == 0
                wants = (good != 0.0) & (done + units <= limit)
                if n > top:  # the second half of the last halving
                    wants = wants & (limit < QUARTER)
                if not anywhere(wants):
                    continue
                moves = wants & (d != 0.0)
                rests = wants & (d == 0.0)
                new_xf, new_wf, new_xs, new_vs = xf, wf, xs, vs
                suspected = zero
                if anywhere(moves):
                    k = level * 16 * LANES + o
                    m_xf, m_wf, m_xs, m_vs, found, stops = _slid(
                        t, slides, k, units * unit, fine, deflection, xf, wf, xs, vs, d
                    )
                    new_xf, new_wf = where(moves, m_xf, xf), where(moves, m_wf, wf)
                    new_xs, new_vs = where(moves, m_xs, xs), where(moves, m_vs, vs)
                    suspected = where(moves & found, 1.0, suspected)
                    good = where(moves & stops, 0.0, good)
                if anywhere(rests):
                    k = level * 4 * LANES + o
                    still = still_flapper(t.ratio, deflection, wire)
                    r_xf, r_wf, found, stops = _rung(
                        t, rings, k, units * unit, fine, still, xf, wf
                    )
                    new_xf, new_wf = where(rests, r_xf, new_xf), where(rests, r_wf, new_wf)
                    suspected = where(rests & found, 1.0, suspected)
                    good = where(rests & stops, 0.0, good)
                if not fine:
                    limit = where(suspected != 0.0, done + units, limit)
                    wants = wants & (suspected == 0.0)
                xf, wf = where(wants, new_xf, xf), where(wants, new_wf, wf)
                xs, vs = where(wants, new_xs, xs), where(wants, new_vs, vs)
                wire = where(wants, xs, wire)
                done = where(wants, done + units, done)
                since = where(wants, since + units, since)
                if fine:
                    switches = suspected != 0.0
                    if anywhere(switches):
                        # A spool that stops rests, or moves back; one at rest breaks away.
                        _cut(pieces, count, where(switches, since * unit, 0.0), xs, before, vs)
                        count += 1
                        since = where(switches, 0.0, since)
                        vs = where(switches, 0.0, vs)
                        before = where(switches, vs, before)
                        side = where(xf > 0.0, 1.0, zero - 1.0)
                        side = where(magnitude(xf) > t.breakaway, side, 0.0)
                        d = where(switches, side, d)
                        kinks = where(switches & (d != 0.0), 1.0, kinks)
                        limit = where(switches, QUARTER, limit)
                        events = where(switches, events + 1.0, events)
                        good = where(events > MOST_EVENTS * 1.0, 0.0, good)
            top = HALVINGS - 1
        _cut(pieces, count, since * unit, xs, before, vs)
        count += 1
        since, before = zero, vs
        place, slope = (PLACE + node + 1) * LANES + o, (SLOPE + node + 1) * LANES + o
        store(path, place, where(good != 0.0, xs, load(path, place)))
        store(path, slope, where(good != 0.0, vs, load(path, slope)))
    mine = good != 0.0
    store(state, FLAPPER * LANES + o, where(mine, xf, load(state, FLAPPER * LANES + o)))
    store(state, FLAPPER_RATE * LANES + o, where(mine, wf, load(state, FLAPPER_RATE * LANES + o)))
    store(state, SPOOL * LANES + o, where(mine, xs, load(state, SPOOL * LANES + o)))
    store(state, SPOOL_RATE * LANES + o, where(mine, vs, load(state, SPOOL_RATE * LANES + o)))
    store(state, WIRE * LANES + o, where(mine, wire, load(state, WIRE * LANES + o)))
    store(state, DIRECTION * LANES + o, where(mine, d, load(state, DIRECTION * LANES + o)))
    store(state, BUSY * LANES + o, where(mine, 0.0, busy))
    if with_jack and anywhere(mine & (kinks != 0.0)):
        jack_over_pieces(
            o, where(mine, kinks, 0.0), count, tick, state, path, coefficients, pieces
        )


@bare_kernel
def halved_lanes(
    count: int,
    end: int,
    tick: float,
    with_jack: bool,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    slides: NDArray[np.float64],
    rings: NDArray[np.float64],
    pieces: NDArray[np.float64],
) -> bool:
    """Flapper and spool of the BUSY lanes before `end` over a tick with events.

    Events are located to tick / 2^FINEST. Lanes that must go alone stay BUSY and as they were;
    returns whether there are any.

    Parameters
    ----------
    count: lanes that hold a candidate; others take no events.
    with_jack: whether the jack is to go along the pieces of the spool's path that events cut.
    slides, rings: transitions over 2^0 … 2^HALVINGS finest steps, see
        `ehadiag.model.simd.coefficients`.
    pieces: scratch, see `ehadiag.model.simd.jack_pieces`.
    """
    for i in range(count, end):
        state[BUSY * LANES + i] = 0.0
    any_busy = False
    for o in range(0, end, WIDTH):
        _halved(o, tick, with_jack, state, path, coefficients, slides, rings, pieces)
        if anywhere(load(state, BUSY * LANES + o) != 0.0):
            any_busy = True
    return any_busy
