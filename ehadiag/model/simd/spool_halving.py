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

from typing import Any

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
from ehadiag.model.simd.jack_pieces import ALONE, PIECE, jack_over_pieces
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
def _step4(
    m: NDArray[np.float64], k: int, a: Vector, w: Vector, b: Vector, v: Vector
) -> tuple[Vector, Vector, Vector, Vector]:
    """Moving flapper and spool after a step, by the transitions from `k` on."""
    na = load(m, k) * a + load(m, k + LANES) * w
    na = na + load(m, k + 2 * LANES) * b + load(m, k + 3 * LANES) * v
    nw = load(m, k + 4 * LANES) * a + load(m, k + 5 * LANES) * w
    nw = nw + load(m, k + 6 * LANES) * b + load(m, k + 7 * LANES) * v
    nb = load(m, k + 8 * LANES) * a + load(m, k + 9 * LANES) * w
    nb = nb + load(m, k + 10 * LANES) * b + load(m, k + 11 * LANES) * v
    nv = load(m, k + 12 * LANES) * a + load(m, k + 13 * LANES) * w
    nv = nv + load(m, k + 14 * LANES) * b + load(m, k + 15 * LANES) * v
    return na, nw, nb, nv


@packed
def _moving_may_end(
    t: SpoolLaw, h: Any, fine: bool, a: Vector, w: Vector, na: Vector, nw: Vector, nv: Vector
) -> Mask:
    """Whether a moving spool stops in a step of `h` seconds, or may unless the step is the finest.

    Positive along the motion, a and na beyond the flapper deflection that balances dry friction.
    """
    found = nv <= 0.0
    if not fine:
        # Where an extreme of the flapper lies inside the step the spool may stop, it may touch.
        swing = 0.25 * h * most(magnitude(w), magnitude(nw))
        low = least(a, na) - swing <= 0.0
        far = most(magnitude(a + t.dry), magnitude(na + t.dry)) + swing >= t.flapper_stop
        found = found | ((w * nw < 0.0) & (low | far))
    return found


@packed
def _rest_may_end(
    t: SpoolLaw, h: Any, fine: bool, xf: Vector, wf: Vector, new_xf: Vector, new_wf: Vector
) -> Mask:
    """As `_moving_may_end` of a spool at rest, which breaks away."""
    size = magnitude(new_xf)
    found = size > t.breakaway
    if not fine:
        swing = 0.25 * h * most(magnitude(wf), magnitude(new_wf))
        far = most(magnitude(xf), size) + swing > least(t.breakaway, t.flapper_stop)
        found = found | ((wf * new_wf < 0.0) & far)
    return found


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
    count: int,
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
    cuts = 0
    for node in range(NODES):
        done, limit, first = zero, zero, True
        going = good != 0.0
        while anywhere(going):
            # On to the node at once, where no event may hide before it.
            rest = where(going, QUARTER - done, 0.0)
            may_end = zero
            new_xf, new_wf, new_xs, new_vs = xf, wf, xs, vs
            moves, rests = going & (d != 0.0), going & (d == 0.0)
            if anywhere(moves):
                base = slide_base(t, deflection, d)
                a, w, b, v = xf * d - t.dry, wf * d, (xs - base) * d, vs * d
                na, nw, nb, nv = a, w, b, v
                if first:
                    na, nw, nb, nv = _step4(slides, HALVINGS * 16 * LANES + o, a, w, b, v)
                else:
                    left = rest
                    for level in range(HALVINGS - 1, -1, -1):
                        units = float(1 << level)
                        takes = left >= units
                        left = where(takes, left - units, left)
                        ka, kw, kb, kv = _step4(slides, level * 16 * LANES + o, na, nw, nb, nv)
                        na, nw = where(takes, ka, na), where(takes, kw, nw)
                        nb, nv = where(takes, kb, nb), where(takes, kv, nv)
                size = magnitude(na + t.dry)
                stops = (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
                good = where(moves & stops, 0.0, good)
                found = _moving_may_end(t, rest * unit, False, a, w, na, nw, nv)
                may_end = where(moves & found, 1.0, may_end)
                new_xf, new_wf = where(moves, (na + t.dry) * d, xf), where(moves, nw * d, wf)
                new_xs, new_vs = where(moves, nb * d + base, xs), where(moves, nv * d, vs)
            if anywhere(rests):
                still = still_flapper(t.ratio, deflection, wire)
                a, w = xf - still, wf
                left = rest
                for level in range(HALVINGS, -1, -1):
                    units = float(1 << level)
                    takes = left >= units
                    left = where(takes, left - units, left)
                    k = level * 4 * LANES + o
                    na = load(rings, k) * a + load(rings, k + LANES) * w
                    nw = load(rings, k + 2 * LANES) * a + load(rings, k + 3 * LANES) * w
                    a, w = where(takes, na, a), where(takes, nw, w)
                    if first:
                        break
                good = where(rests & (magnitude(a + still) >= t.flapper_stop), 0.0, good)
                found = _rest_may_end(t, rest * unit, False, xf, wf, a + still, w)
                may_end = where(rests & found, 1.0, may_end)
                new_xf, new_wf = where(rests, a + still, new_xf), where(rests, w, new_wf)
            goes = going & (may_end == 0.0)
            xf, wf = where(goes, new_xf, xf), where(goes, new_wf, wf)
            xs, vs = where(goes, new_xs, xs), where(goes, new_vs, vs)
            wire = where(goes, xs, wire)
            since = where(goes, since + rest, since)
            done = where(goes, QUARTER, done)
            limit = QUARTER + zero
            first = False
            hunted = (may_end != 0.0) & (good != 0.0)
            if anywhere(hunted):
                hunts = where(hunted, 1.0, zero)
                for n in range(HALVINGS + 1):
                    level = max(HALVINGS - 1 - n, 0)
                    units = float(1 << level)
                    fine = level == 0
                    wants = (hunts != 0.0) & (done + units <= limit)
                    suspected = zero
                    new_xf, new_wf, new_xs, new_vs = xf, wf, xs, vs
                    moves, rests = wants & (d != 0.0), wants & (d == 0.0)
                    if anywhere(moves):
                        base = slide_base(t, deflection, d)
                        a, w, b, v = xf * d - t.dry, wf * d, (xs - base) * d, vs * d
                        na, nw, nb, nv = _step4(slides, level * 16 * LANES + o, a, w, b, v)
                        size = magnitude(na + t.dry)
                        stops = (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
                        good = where(moves & stops, 0.0, good)
                        found = _moving_may_end(t, units * unit, fine, a, w, na, nw, nv)
                        suspected = where(moves & found, 1.0, suspected)
                        new_xf = where(moves, (na + t.dry) * d, xf)
                        new_wf = where(moves, nw * d, wf)
                        new_xs, new_vs = where(moves, nb * d + base, xs), where(moves, nv * d, vs)
                    if anywhere(rests):
                        still = still_flapper(t.ratio, deflection, wire)
                        a, w = xf - still, wf
                        k = level * 4 * LANES + o
                        na = load(rings, k) * a + load(rings, k + LANES) * w
                        nw = load(rings, k + 2 * LANES) * a + load(rings, k + 3 * LANES) * w
                        good = where(rests & (magnitude(na + still) >= t.flapper_stop), 0.0, good)
                        found = _rest_may_end(t, units * unit, fine, xf, wf, na + still, nw)
                        suspected = where(rests & found, 1.0, suspected)
                        new_xf, new_wf = where(rests, na + still, new_xf), where(rests, nw, new_wf)
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
                            _cut(pieces, cuts, where(switches, since * unit, 0.0), xs, before, vs)
                            cuts += 1
                            since = where(switches, 0.0, since)
                            vs = where(switches, 0.0, vs)
                            before = where(switches, vs, before)
                            side = where(xf > 0.0, 1.0, zero - 1.0)
                            side = where(magnitude(xf) > t.breakaway, side, 0.0)
                            d = where(switches, side, d)
                            kinks = where(switches & (d != 0.0), 1.0, kinks)
                            hunts = where(switches, 0.0, hunts)
                            events = where(switches, events + 1.0, events)
                            good = where(events > MOST_EVENTS * 1.0, 0.0, good)
            going = (good != 0.0) & (done < QUARTER)
        _cut(pieces, cuts, since * unit, xs, before, vs)
        cuts += 1
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
    if with_jack:
        store(pieces, ALONE, where(mine, kinks, 0.0))
        for lane in range(max(count - o, 0), WIDTH):
            pieces[ALONE + lane] = 0.0
        kinks = load(pieces, ALONE)
        if anywhere(kinks != 0.0):
            jack_over_pieces(o, kinks, cuts, tick, state, path, coefficients, pieces)


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
    count: lanes that hold a candidate; the jacks of others are left as they were.
    with_jack: whether the jack is to go along the pieces of the spool's path that events cut.
    slides, rings: transitions over 2^0 … 2^HALVINGS finest steps, see
        `ehadiag.model.simd.coefficients`.
    pieces: scratch, see `ehadiag.model.simd.jack_pieces`.
    """
    any_busy = False
    for o in range(0, end, WIDTH):
        _halved(o, count, tick, with_jack, state, path, coefficients, slides, rings, pieces)
        if anywhere(load(state, BUSY * LANES + o) != 0.0):
            any_busy = True
    return any_busy
