"""First stage and spool of all lanes at once over a tick with events, located by halving.

A lane alone (`ehadiag.model.simd_spool_events`) takes as long as all of them here: most of the
candidates of a search break away and stop within the same ticks. Lanes step together, a quarter of
the tick, an eighth, … down to the finest step; a lane takes a step in which no event may hide, and
leaves it to shorter ones where one may. Past its event it goes on by the longest steps up to the
next node of the path, in which the next event is looked for alike.

What is rare is left to a lane alone: stops, a flapper on its stop, friction that falls with the
velocity, more than `MAX_TICK_EVENTS` events in a tick. Which way a lane goes does not depend on its
neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

from ehadiag.compile.jit import Array, bare_kernel, inlined
from ehadiag.compile.vector import (
    LANES,
    VECTOR_WIDTH,
    Mask,
    Vector,
    absolute,
    any_lane,
    load,
    maximum,
    minimum,
    packed,
    store,
    store_where,
    where,
)
from ehadiag.model.laws import (
    SpoolLaw,
    bridge_bend,
    flapper_rest,
    play_output,
    spool_rest_position,
    with_friction,
)
from ehadiag.model.simd_jack_pieces import PIECE_NUMBERS, jack_over_pieces
from ehadiag.model.simd_layout import (
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_SLOPE,
    MAX_TICK_EVENTS,
    QUARTER_HALVINGS,
    QUARTER_UNITS,
    ROWS,
    TICK_UNITS,
    BlockTraits,
    spool_laws,
)
from ehadiag.model.spool_events import WIRE_TOLERANCE


class _Motion(NamedTuple):
    """Flapper and spool of VECTOR_WIDTH lanes at an instant:
    `ehadiag.model.spool_events.SpoolState`."""

    xf: Vector
    wf: Vector
    xs: Vector
    vs: Vector
    wire: Vector
    d: Vector


class _Tables(NamedTuple):
    """Transitions over 2^0 … 2^QUARTER_HALVINGS finest steps (`ehadiag.model.simd_layout`).

    slides, loose: moving, with the feedback wire and without it; rings: at rest.
    """

    slides: Array
    loose: Array
    rings: Array


@packed
def _slid(
    t: SpoolLaw, m: Array, o: int, longest: int, shortest: int, rest: Vector,
    h: Vector, fine: bool, deflection: Vector, s: _Motion,
) -> tuple[Vector, Vector, Vector, Vector, Mask, Mask]:  # fmt: skip
    """Moving spool, with the wire, after `rest` finest steps or `h` seconds, by its binary digits.

    Returns the state, where the spool has stopped or (unless the step is the finest) may have
    within it, and where spool or flapper has met a stop.
    """
    d, base = s.d, spool_rest_position(t, deflection, s.d)
    a, w, b, v = s.xf * d - t.dry, s.wf * d, (s.xs - base) * d, s.vs * d
    na, nw, nb, nv = a, w, b, v
    for level in range(longest, shortest - 1, -1):
        units, k = float(1 << level), level * 16 * LANES + o
        takes = rest >= units
        if VECTOR_WIDTH == 1 and not any_lane(takes):
            continue
        rest = where(takes, rest - units, rest)
        ka = load(m, k) * na + load(m, k + LANES) * nw
        ka = ka + load(m, k + 2 * LANES) * nb + load(m, k + 3 * LANES) * nv
        kw = load(m, k + 4 * LANES) * na + load(m, k + 5 * LANES) * nw
        kw = kw + load(m, k + 6 * LANES) * nb + load(m, k + 7 * LANES) * nv
        kb = load(m, k + 8 * LANES) * na + load(m, k + 9 * LANES) * nw
        kb = kb + load(m, k + 10 * LANES) * nb + load(m, k + 11 * LANES) * nv
        kv = load(m, k + 12 * LANES) * na + load(m, k + 13 * LANES) * nw
        kv = kv + load(m, k + 14 * LANES) * nb + load(m, k + 15 * LANES) * nv
        na, nw = where(takes, ka, na), where(takes, kw, nw)
        nb, nv = where(takes, kb, nb), where(takes, kv, nv)
    size = absolute(na + t.dry)
    stops = (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
    found = nv <= 0.0
    if not fine:
        # Where an extreme of the flapper lies inside the step the spool may stop, it may touch.
        swing = 0.25 * h * maximum(absolute(w), absolute(nw))
        low = minimum(a, na) - swing <= 0.0
        far = maximum(absolute(a + t.dry), size) + swing >= t.flapper_stop
        found = found | ((w * nw < 0.0) & (low | far))
    return (na + t.dry) * d, nw * d, nb * d + base, nv * d, found, stops


@packed
def _slid_loose(
    t: SpoolLaw, m: Array, o: int, longest: int, shortest: int, rest: Vector,
    h: Vector, fine: bool, still: Vector, s: _Motion,
) -> tuple[Vector, Vector, Vector, Vector, Mask, Mask]:  # fmt: skip
    """As `_slid` within the backlash, without the wire, which it may meet."""
    d = s.d
    lift = still * d
    steady = (t.force * lift - t.dynamic) / t.damping
    a, w, v = s.xf * d - lift, s.wf * d, s.vs * d - steady
    na, nw, nb, nv = a, w, steady * h, v
    for level in range(longest, shortest - 1, -1):
        units, k = float(1 << level), level * 16 * LANES + o
        takes = rest >= units
        if VECTOR_WIDTH == 1 and not any_lane(takes):
            continue
        rest = where(takes, rest - units, rest)
        ka = load(m, k) * na + load(m, k + LANES) * nw
        kw = load(m, k + 4 * LANES) * na + load(m, k + 5 * LANES) * nw
        kb = nb + load(m, k + 8 * LANES) * na + load(m, k + 9 * LANES) * nw
        kb = kb + load(m, k + 11 * LANES) * nv
        kv = load(m, k + 12 * LANES) * na + load(m, k + 13 * LANES) * nw
        kv = kv + load(m, k + 15 * LANES) * nv
        na, nw = where(takes, ka, na), where(takes, kw, nw)
        nb, nv = where(takes, kb, nb), where(takes, kv, nv)
    nv = nv + steady
    size = absolute(na + lift)
    stops = (nb >= t.stroke - s.xs * d) | (size >= t.flapper_stop)
    found = (nv <= 0.0) | (nb >= t.backlash - WIRE_TOLERANCE - (s.xs - s.wire) * d)
    if not fine:
        swing = 0.25 * h * maximum(absolute(w), absolute(nw))
        low = minimum(a, na) - swing <= t.dry - lift
        far = maximum(absolute(a + lift), size) + swing >= t.flapper_stop
        found = found | ((w * nw < 0.0) & (low | far))
    return (na + lift) * d, nw * d, nb * d + s.xs, nv * d, found, stops


@packed
def _rung(
    t: SpoolLaw, m: Array, o: int, longest: int, shortest: int, rest: Vector,
    h: Vector, fine: bool, still: Vector, s: _Motion,
) -> tuple[Vector, Vector, Mask, Mask]:  # fmt: skip
    """As `_slid` for a spool at rest, which breaks away: flapper and its rate."""
    a, w = s.xf - still, s.wf
    for level in range(longest, shortest - 1, -1):
        units, k = float(1 << level), level * 4 * LANES + o
        takes = rest >= units
        if VECTOR_WIDTH == 1 and not any_lane(takes):
            continue
        rest = where(takes, rest - units, rest)
        ka = load(m, k) * a + load(m, k + LANES) * w
        kw = load(m, k + 2 * LANES) * a + load(m, k + 3 * LANES) * w
        a, w = where(takes, ka, a), where(takes, kw, w)
    xf = a + still
    size = absolute(xf)
    found = size > t.breakaway
    if not fine:
        swing = 0.25 * h * maximum(absolute(s.wf), absolute(w))
        far = maximum(absolute(s.xf), size) + swing > minimum(t.breakaway, t.flapper_stop)
        found = found | ((s.wf * w < 0.0) & far)
    return xf, w, found, size >= t.flapper_stop


@packed
def _advanced(
    t: SpoolLaw, tables: _Tables, o: int, longest: int, shortest: int, rest: Vector, unit: float,
    fine: bool, has: BlockTraits, deflection: Vector, going: Mask, s: _Motion,
) -> tuple[_Motion, Mask, Mask]:  # fmt: skip
    """Lanes that go, after `rest` steps of `unit` seconds in one go.

    longest, shortest: which of their binary digits may be 1. fine: whether it is the finest step;
    has: what any lane has.

    Returns the state, in which of them an event has come or may hide, and in which there is a stop.
    """
    h = rest * unit
    xf, wf, xs, vs = s.xf, s.wf, s.xs, s.vs
    found_in = going & ~going
    stops_in = found_in
    moves, rests = going & (s.d != 0.0), going & (s.d == 0.0)
    if has.bridge:
        # By its bend in the middle of the step; a spool at rest has none.
        t = with_friction(t, -bridge_bend(t, (s.xf + 0.5 * h * s.wf) * s.d - t.dry))
    if has.backlash:
        free = moves & (s.d * (s.xs - s.wire) < t.backlash - WIRE_TOLERANCE)
        moves = moves & ~free
        if any_lane(free):
            still = flapper_rest(t.ratio, deflection, s.wire)
            nxf, nwf, nxs, nvs, found, stops = _slid_loose(
                t, tables.loose, o, longest, shortest, rest, h, fine, still, s
            )
            xf, wf = where(free, nxf, xf), where(free, nwf, wf)
            xs, vs = where(free, nxs, xs), where(free, nvs, vs)
            found_in, stops_in = free & found, free & stops
    if any_lane(moves):
        nxf, nwf, nxs, nvs, found, stops = _slid(
            t, tables.slides, o, longest, shortest, rest, h, fine, deflection, s
        )
        xf, wf = where(moves, nxf, xf), where(moves, nwf, wf)
        xs, vs = where(moves, nxs, xs), where(moves, nvs, vs)
        found_in, stops_in = found_in | (moves & found), stops_in | (moves & stops)
    if any_lane(rests):
        still = flapper_rest(t.ratio, deflection, s.wire)
        nxf, nwf, found, stops = _rung(
            t, tables.rings, o, longest, shortest, rest, h, fine, still, s
        )
        xf, wf = where(rests, nxf, xf), where(rests, nwf, wf)
        found_in, stops_in = found_in | (rests & found), stops_in | (rests & stops)
    return _Motion(xf, wf, xs, vs, play_output(s.wire, xs, t.backlash), s.d), found_in, stops_in


@packed
def _chosen(these: Mask, new: _Motion, old: _Motion) -> _Motion:
    """State of which these lanes are new."""
    return _Motion(
        where(these, new.xf, old.xf), where(these, new.wf, old.wf), where(these, new.xs, old.xs),
        where(these, new.vs, old.vs), where(these, new.wire, old.wire), old.d,
    )  # fmt: skip


@packed
def _cut(pieces: Array, count: int, span: Vector, xs: Vector, before: Vector, end: Vector) -> None:
    """Write a piece of the path: its duration (s, 0 in lanes that have none), place, velocities."""
    o = count * PIECE_NUMBERS
    store(pieces, o, span)
    store(pieces, o + VECTOR_WIDTH, xs)
    store(pieces, o + 2 * VECTOR_WIDTH, before)
    store(pieces, o + 3 * VECTOR_WIDTH, end)


@inlined
def _halved(
    o: int,
    tick: float,
    has: BlockTraits,
    with_jack: bool,
    state: Array,
    path: Array,
    coefficients: Array,
    tables: _Tables,
    pieces: Array,
) -> None:
    """Lanes from `o`."""
    unit = tick / float(TICK_UNITS)
    t, deflection = spool_laws(coefficients, o), load(state, ROWS.deflection * LANES + o)
    busy = load(state, ROWS.busy * LANES + o)
    s = _Motion(
        load(state, ROWS.flapper * LANES + o), load(state, ROWS.flapper_rate * LANES + o),
        load(state, ROWS.spool * LANES + o), load(state, ROWS.spool_rate * LANES + o),
        load(state, ROWS.wire * LANES + o), load(state, ROWS.direction * LANES + o),
    )  # fmt: skip
    mine = (busy != 0.0) & (load(state, ROWS.clamped * LANES + o) == 0.0) & (t.extra == 0.0)
    mine = mine & (absolute(s.xs) < t.stroke)
    if not any_lane(mine):
        return
    zero = s.d * 0.0
    good = where(mine, 1.0, zero)
    before, since, events, kinks = s.vs, zero, zero, zero
    cuts, quarter = 0, float(QUARTER_UNITS)
    for node in range(LANE_NODES):
        done, limit, hunts, begin = zero, quarter + zero, good, QUARTER_HALVINGS
        while any_lane(hunts != 0.0):
            # On to the node at once, where no event may hide before it (the first time); where one
            # may, by shorter and shorter steps up to it, the last of them twice.
            for n in range(QUARTER_HALVINGS - begin, QUARTER_HALVINGS + 2):
                level = max(QUARTER_HALVINGS - n, 0)
                units, fine = float(1 << level), n > QUARTER_HALVINGS
                wants = (hunts != 0.0) & (done + units <= limit)
                new, found, stops = _advanced(
                    t, tables, o, level, level, zero + units, unit, fine, has,
                    deflection, wants, s,
                )  # fmt: skip
                good, hunts = where(stops, 0.0, good), where(stops, 0.0, hunts)
                if not fine:
                    limit = where(found, done + units, limit)
                    wants = wants & ~found
                s = _chosen(wants, new, s)
                since = where(wants, since + units, since)
                done = where(wants, done + units, done)
                if level == QUARTER_HALVINGS and not any_lane(found):
                    break
                if fine and any_lane(found):
                    _cut(pieces, cuts, where(found, since * unit, 0.0), s.xs, before, s.vs)
                    cuts += 1
                    # A spool that stops rests, or moves back; one at rest breaks away; else it
                    # meets the wire.
                    turns = found & (s.vs * s.d <= 0.0)
                    side = where(s.xf > 0.0, 1.0, zero - 1.0)
                    side = where(absolute(s.xf) > t.breakaway, side, 0.0)
                    vs, d = where(turns, 0.0, s.vs), where(turns, side, s.d)
                    s = _Motion(s.xf, s.wf, s.xs, vs, s.wire, d)
                    kinks = where(turns & (d != 0.0), 1.0, kinks)
                    before, since = where(found, vs, before), where(found, 0.0, since)
                    events = where(found, events + 1.0, events)
                    good = where(events > MAX_TICK_EVENTS * 1.0, 0.0, good)
            going, begin = (good != 0.0) & (done < quarter), QUARTER_HALVINGS - 1
            hunts = zero
            if any_lane(going):
                # Past an event on to the node at once, and so on.
                rest = where(going, quarter - done, 0.0)
                new, found, stops = _advanced(
                    t,
                    tables,
                    o,
                    QUARTER_HALVINGS - 1,
                    0,
                    rest,
                    unit,
                    False,
                    has,
                    deflection,
                    going,
                    s,
                )
                good = where(stops, 0.0, good)
                goes = going & ~found
                s = _chosen(goes, new, s)
                since = where(goes, since + rest, since)
                done = where(goes, quarter, done)
                hunts = where(going & found & (good != 0.0), 1.0, zero)
                limit = quarter + zero
        _cut(pieces, cuts, since * unit, s.xs, before, s.vs)
        cuts += 1
        since, before = zero, s.vs
        place, slope = (LANE_PATH + node + 1) * LANES + o, (LANE_PATH_SLOPE + node + 1) * LANES + o
        store(path, place, where(good != 0.0, s.xs, load(path, place)))
        store(path, slope, where(good != 0.0, s.vs, load(path, slope)))
    mine = good != 0.0
    store_where(state, ROWS.flapper * LANES + o, mine, s.xf)
    store_where(state, ROWS.flapper_rate * LANES + o, mine, s.wf)
    store_where(state, ROWS.spool * LANES + o, mine, s.xs)
    store_where(state, ROWS.spool_rate * LANES + o, mine, s.vs)
    store_where(state, ROWS.wire * LANES + o, mine, s.wire)
    store_where(state, ROWS.direction * LANES + o, mine, s.d)
    store(state, ROWS.busy * LANES + o, where(mine, 0.0, busy))
    if with_jack:
        kinks = where(mine, kinks, 0.0)
        if any_lane(kinks != 0.0):
            jack_over_pieces(o, kinks, cuts, tick, state, path, coefficients, pieces)


@bare_kernel
def halved_lanes(
    end: int,
    tick: float,
    has: BlockTraits,
    with_jack: bool,
    state: Array,
    path: Array,
    coefficients: Array,
    slides: Array,
    free_slides: Array,
    rings: Array,
    pieces: Array,
) -> bool:
    """Flapper and spool of the busy lanes before `end` over a tick with events.

    Events are located to tick / 2^`FINEST_LEVEL`. Lanes that must be computed alone stay busy and
    unchanged; returns whether there are any. with_jack: whether the jack takes the pieces of the
    spool's path that events cut; has: what any lane has; slides, free_slides, rings:
    transitions over 2^0 … 2^QUARTER_HALVINGS finest steps, see `ehadiag.model.simd_layout`.
    """
    any_busy, tables = False, _Tables(slides, free_slides, rings)
    for o in range(0, end, VECTOR_WIDTH):
        _halved(o, tick, has, with_jack, state, path, coefficients, tables, pieces)
        if any_lane(load(state, ROWS.busy * LANES + o) != 0.0):
            any_busy = True
    return any_busy
