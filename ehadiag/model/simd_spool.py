"""First stage and spool of a block of candidates over a tick without events.

Between events flapper and spool obey linear equations with constant coefficients (PHY-4, PHY-5):
they go by exact quarters of a tick, with constant friction or with one that falls with the
velocity. A lane in which an event may hide is left to `ehadiag.model.simd_spool_halving` and
`ehadiag.model.simd_spool_events`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
    where,
)
from ehadiag.model.laws import (
    SpoolLaw,
    bridge_bend,
    clamped_spool_velocity,
    flapper_rest,
    lagged_current,
    motor_deflection,
    play_output,
    spool_rest_position,
    steady_spool_velocity,
    with_friction,
)
from ehadiag.model.sensors import cubic_through_ends, filter_output, read_spool
from ehadiag.model.simd_layout import (
    COEFFICIENTS,
    LANE_FILTER_ROWS,
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_SLOPE,
    MOVING_ROWS,
    ROWS,
    STEPS,
    BlockTraits,
    drive_laws,
    full_filter_steps,
    sampled_filter_steps,
    sensor_laws,
    spool_laws,
)
from ehadiag.model.spool_events import (
    MAX_CREEP_ERROR,
    WIRE_TOLERANCE,
    SpoolState,
    creep_friction,
    is_wire_carried,
)


class LaneSpoolLimits(NamedTuple):
    """Numerical limits of a spool without events."""

    no_event: float = 1e30
    """Distance from an event where there is none, m."""
    rounding: float = -1e-14
    """Rounding of a spool that creeps towards rest, m and (times 10) m/s."""
    velocity: float = 1e-18
    """Least velocity of a moving spool, m/s: by the equations a creeping one never stops, and
    slower ones would be denormal numbers, which cost a hundred times as much."""
    held_s: float = 3e-4
    """Longest time with constant friction of a creeping spool, s; the flapper rings with a period
    of about 1 ms."""
    creep_velocity: float = 1e-13
    """Least velocity of a creeping spool, m/s."""
    quarter_level: int = 2
    """Halvings of a tick that make its pieces, 1."""


SPOOL_LIMITS = LaneSpoolLimits()


@packed
def drive_lanes(end: int, current: float, plays: int, state: Array, coefficients: Array) -> None:
    """Flapper deflection that the current (A) of a tick alone makes, all lanes, into the state."""
    for o in range(0, end, VECTOR_WIDTH):
        law = drive_laws(coefficients, o)
        flowing = load(state, ROWS.current * LANES + o)
        store(state, ROWS.current * LANES + o, lagged_current(law.left, flowing, current))
        value = law.bias + lagged_current(law.late, flowing, current)
        total, weight = value * 0.0, value * 0.0 + 1.0
        for i in range(plays):
            row = (ROWS.plays + i) * LANES + o
            held = play_output(load(state, row), value, law.spacing * (i + 0.5))
            store(state, row, held)
            total = total + weight * held
            weight = weight * law.fade
        store(state, ROWS.deflection * LANES + o, motor_deflection(law, total))


@packed
def deflect_lanes(end: int, plays: int, state: Array, coefficients: Array) -> None:
    """Flapper deflection by what the plays hold, all lanes, into the state."""
    for o in range(0, end, VECTOR_WIDTH):
        law = drive_laws(coefficients, o)
        total, weight = law.bias * 0.0, law.bias * 0.0 + 1.0
        for i in range(plays):
            total = total + weight * load(state, (ROWS.plays + i) * LANES + o)
            weight = weight * law.fade
        store(state, ROWS.deflection * LANES + o, motor_deflection(law, total))


@packed
def rest_spool_lanes(end: int, origin: float, state: Array, coefficients: Array) -> None:
    """All lanes at rest, the spool at `origin` (m), the flapper in equilibrium if it can be.

    The deflection by the current is in the state; the count of re-anchorings goes on.
    """
    state[: ROWS.deflection * LANES] = 0.0
    for o in range(0, end, VECTOR_WIDTH):
        t = spool_laws(coefficients, o)
        xs = maximum(minimum(t.stroke * 0.0 + origin, t.stroke), -t.stroke)
        still = flapper_rest(t.ratio, load(state, ROWS.deflection * LANES + o), xs)
        store(state, ROWS.flapper * LANES + o, maximum(minimum(still, t.breakaway), -t.breakaway))
        store(state, ROWS.spool * LANES + o, xs)
        store(state, ROWS.wire * LANES + o, xs)
        store(state, ROWS.spool_lagged * LANES + o, xs)


@packed
def _quarter_matrix(coefficients: Array, o: int) -> tuple[Vector, ...]:
    """Matrix of `_quarter_step`, 4 by 4, row by row."""
    k = COEFFICIENTS.move * LANES + o
    return (
        load(coefficients, k), load(coefficients, k + LANES),
        load(coefficients, k + 2 * LANES), load(coefficients, k + 3 * LANES),
        load(coefficients, k + 4 * LANES), load(coefficients, k + 5 * LANES),
        load(coefficients, k + 6 * LANES), load(coefficients, k + 7 * LANES),
        load(coefficients, k + 8 * LANES), load(coefficients, k + 9 * LANES),
        load(coefficients, k + 10 * LANES), load(coefficients, k + 11 * LANES),
        load(coefficients, k + 12 * LANES), load(coefficients, k + 13 * LANES),
        load(coefficients, k + 14 * LANES), load(coefficients, k + 15 * LANES),
    )  # fmt: skip


@packed
def _quarter_step(
    m: tuple[Vector, ...], a: Vector, w: Vector, b: Vector, v: Vector,
    bow: float, dry: Any, slowest: Vector, lowest: Vector, widest: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """One step of the moving spool, positive along its motion, and how near it came to an event."""
    na = m[0] * a + m[1] * w + m[2] * b + m[3] * v
    nw = m[4] * a + m[5] * w + m[6] * b + m[7] * v
    nb = m[8] * a + m[9] * w + m[10] * b + m[11] * v
    nv = m[12] * a + m[13] * w + m[14] * b + m[15] * v
    swing = bow * maximum(absolute(w), absolute(nw))
    # Where the flapper turns inside the step, the spool might stop there.
    inside = where(w * nw < 0.0, minimum(a, na) - swing, SPOOL_LIMITS.no_event)
    widest = maximum(widest, absolute(na + dry) + swing)
    return na, nw, nb, nv, minimum(slowest, nv), minimum(lowest, inside), widest


@packed
def _bent_quarter_step(
    bends: bool, t: SpoolLaw, m: tuple[Vector, ...], a: Vector, w: Vector, b: Vector, v: Vector,
    bow: float, slowest: Vector, lowest: Vector, widest: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """As `_quarter_step`, by the bridge's bend in the middle of the step where any lane has one."""
    if not bends:
        return _quarter_step(m, a, w, b, v, bow, t.dry, slowest, lowest, widest)
    bend = bridge_bend(t, a + 2.0 * bow * w)
    na, nw, nb, nv, slowest, lowest, widest = _quarter_step(
        m, a + bend, w, b - t.reach * bend, v, bow, t.dry - bend, slowest, lowest, widest
    )
    return na - bend, nw, nb + t.reach * bend, nv, slowest, lowest, widest


@packed
def _loose_quarter_step(
    m: tuple[Vector, ...], a: Vector, w: Vector, b: Vector, v: Vector, bow: float,
    lift: Vector, dry: Vector, slowest: Vector, lowest: Vector, widest: Vector, steady: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """As `_quarter_step` within the backlash; a from the flapper's rest, b and v from `steady`."""
    na, nw = m[0] * a + m[1] * w, m[2] * a + m[3] * w
    nb = b + m[4] * a + m[5] * w + m[6] * v
    nv = m[7] * a + m[8] * w + m[9] * v
    swing = bow * maximum(absolute(w), absolute(nw))
    inside = where(w * nw < 0.0, minimum(a, na) + lift - dry - swing, SPOOL_LIMITS.no_event)
    widest = maximum(widest, absolute(na + lift) + swing)
    return na, nw, nb, nv, minimum(slowest, nv + steady), minimum(lowest, inside), widest


@packed
def spool_lanes(
    end: int, tick: float, has: BlockTraits, state: Array, path: Array, coefficients: Array
) -> bool:
    """Flapper and spool of all lanes over a tick without events; has: what any lane has.

    Lanes in which an event may hide are marked busy and left as they were; returns whether there
    are any.
    """
    any_busy, backlash, bends = False, has.backlash, has.bridge
    bow = tick / 16.0
    for o in range(0, end, VECTOR_WIDTH):
        xf, wf = load(state, ROWS.flapper * LANES + o), load(state, ROWS.flapper_rate * LANES + o)
        xs, vs = load(state, ROWS.spool * LANES + o), load(state, ROWS.spool_rate * LANES + o)
        d, clamped = load(state, ROWS.direction * LANES + o), load(state, ROWS.clamped * LANES + o)
        deflection, wire = (
            load(state, ROWS.deflection * LANES + o),
            load(state, ROWS.wire * LANES + o),
        )
        t = spool_laws(coefficients, o)
        dry = t.dry
        # At rest, if the flapper rings too little to end that.
        still = flapper_rest(t.ratio, deflection, wire)
        ra = xf - still
        rb = (wf + t.ring_damping * ra) * load(coefficients, COEFFICIENTS.ring_time * LANES + o)
        room = load(coefficients, COEFFICIENTS.rest_limit * LANES + o) - absolute(still)
        free, idle = clamped == 0.0, load(coefficients, COEFFICIENTS.idle * LANES + o)
        rests = (d == 0.0) & free & (room > 0.0) & (ra * ra + rb * rb < room * room)
        k = COEFFICIENTS.rest * LANES + o
        rest_xf = still + load(coefficients, k) * ra + load(coefficients, k + LANES) * wf
        rest_wf = load(coefficients, k + 2 * LANES) * ra + load(coefficients, k + 3 * LANES) * wf
        new_xf, new_wf = where(rests, rest_xf, xf), where(rests, rest_wf, wf)
        zero = d * 0.0
        x1, x2, x3, x4 = xs, xs, xs, xs
        v1, v2, v3, v4 = zero, zero, zero, vs
        fine = rests
        if any_lane(d != 0.0):
            # Moving, about the point where both would rest.
            m = _quarter_matrix(coefficients, o)
            base = spool_rest_position(t, deflection, d)
            a, w, b, v = xf * d - dry, wf * d, (xs - base) * d, vs * d
            s, n, x = zero + SPOOL_LIMITS.no_event, zero + SPOOL_LIMITS.no_event, zero
            a, w, b, v, s, n, x = _bent_quarter_step(bends, t, m, a, w, b, v, bow, s, n, x)
            b1, u1 = base + d * b, d * v
            a, w, b, v, s, n, x = _bent_quarter_step(bends, t, m, a, w, b, v, bow, s, n, x)
            b2, u2 = base + d * b, d * v
            a, w, b, v, s, n, x = _bent_quarter_step(bends, t, m, a, w, b, v, bow, s, n, x)
            b3, u3 = base + d * b, d * v
            a, w, b, v, s, n, x = _bent_quarter_step(bends, t, m, a, w, b, v, bow, s, n, x)
            b4, u4 = base + d * b, d * maximum(v, SPOOL_LIMITS.velocity)
            loose = d * (xs - wire) < t.backlash - WIRE_TOLERANCE
            # A spool whose friction falls with its velocity: `creep_lanes`.
            plain = free & (t.extra == 0.0)
            moves = (
                (d != 0.0)
                & plain
                & ~loose
                & (s > 10.0 * SPOOL_LIMITS.rounding)
                & (n > SPOOL_LIMITS.rounding)
            )
            moves = moves & (x < t.flapper_stop) & (d * b4 < t.stroke)
            w = where(absolute(w) > SPOOL_LIMITS.velocity, w, 0.0)
            x1, x2 = where(moves, b1, xs), where(moves, b2, xs)
            x3, x4 = where(moves, b3, xs), where(moves, b4, xs)
            v1, v2 = where(moves, u1, 0.0), where(moves, u2, 0.0)
            v3, v4 = where(moves, u3, 0.0), where(moves, u4, vs)
            new_xf, new_wf = where(moves, (a + dry) * d, new_xf), where(moves, w * d, new_wf)
            fine = moves | rests
            if backlash and any_lane(loose & (d != 0.0) & free):
                k = COEFFICIENTS.loose * LANES + o
                q = (
                    load(coefficients, k), load(coefficients, k + LANES),
                    load(coefficients, k + 4 * LANES), load(coefficients, k + 5 * LANES),
                    load(coefficients, k + 8 * LANES), load(coefficients, k + 9 * LANES),
                    load(coefficients, k + 11 * LANES), load(coefficients, k + 12 * LANES),
                    load(coefficients, k + 13 * LANES), load(coefficients, k + 15 * LANES),
                )  # fmt: skip
                # All positive along the motion; the flapper rings about `still`.
                lift, step = still * d, 0.25 * tick
                driving = lift
                if bends:
                    driving = lift + bridge_bend(t, lift - dry)
                steady = (t.force * driving - t.dynamic) / t.damping
                a, w, b, v = xf * d - lift, wf * d, zero, vs * d - steady
                s, n, x = zero + SPOOL_LIMITS.no_event, zero + SPOOL_LIMITS.no_event, zero
                a, w, b, v, s, n, x = _loose_quarter_step(
                    q, a, w, b, v, bow, lift, dry, s, n, x, steady
                )
                b1, u1 = xs + d * (b + step * steady), d * (v + steady)
                a, w, b, v, s, n, x = _loose_quarter_step(
                    q, a, w, b, v, bow, lift, dry, s, n, x, steady
                )
                b2, u2 = xs + d * (b + 2.0 * step * steady), d * (v + steady)
                a, w, b, v, s, n, x = _loose_quarter_step(
                    q, a, w, b, v, bow, lift, dry, s, n, x, steady
                )
                b3, u3 = xs + d * (b + 3.0 * step * steady), d * (v + steady)
                a, w, b, v, s, n, x = _loose_quarter_step(
                    q, a, w, b, v, bow, lift, dry, s, n, x, steady
                )
                b4, u4 = xs + d * (b + 4.0 * step * steady), d * (v + steady)
                slips = (
                    (d != 0.0)
                    & plain
                    & loose
                    & (s > 10.0 * SPOOL_LIMITS.rounding)
                    & (n > SPOOL_LIMITS.rounding)
                )
                slips = slips & (x < t.flapper_stop) & (d * b4 < t.stroke)
                slips = slips & (d * (b4 - wire) < t.backlash - WIRE_TOLERANCE)
                x1, x2 = where(slips, b1, x1), where(slips, b2, x2)
                x3, x4 = where(slips, b3, x3), where(slips, b4, x4)
                v1, v2 = where(slips, u1, v1), where(slips, u2, v2)
                v3, v4 = where(slips, u3, v3), where(slips, u4, v4)
                new_xf = where(slips, (a + lift) * d, new_xf)
                new_wf = where(slips, w * d, new_wf)
                fine = fine | slips
        store(state, ROWS.wire * LANES + o, play_output(wire, x4, t.backlash))
        store(path, LANE_PATH * LANES + o, xs)
        store(path, LANE_PATH_SLOPE * LANES + o, vs)
        store(path, (LANE_PATH + 1) * LANES + o, x1)
        store(path, (LANE_PATH + 2) * LANES + o, x2)
        store(path, (LANE_PATH + 3) * LANES + o, x3)
        store(path, (LANE_PATH + 4) * LANES + o, x4)
        store(path, (LANE_PATH_SLOPE + 1) * LANES + o, v1)
        store(path, (LANE_PATH_SLOPE + 2) * LANES + o, v2)
        store(path, (LANE_PATH_SLOPE + 3) * LANES + o, v3)
        store(path, (LANE_PATH_SLOPE + 4) * LANES + o, v4)
        store(state, ROWS.flapper * LANES + o, new_xf)
        store(state, ROWS.flapper_rate * LANES + o, new_wf)
        store(state, ROWS.spool * LANES + o, x4)
        store(state, ROWS.spool_rate * LANES + o, v4)
        fine = fine | (idle != 0.0)
        store(state, ROWS.busy * LANES + o, where(fine, 0.0, 1.0))
        store(state, ROWS.done * LANES + o, idle)
        if any_lane(~fine):
            any_busy = True
    return any_busy


@packed
def sample_spool_lanes(
    end: int, tick: float, state: Array, path: Array, coefficients: Array
) -> None:
    """Spool of all lanes as it is sampled in a tick, behind its filter or early, into the state."""
    for o in range(0, end, VECTOR_WIDTH):
        at_end = load(path, (LANE_PATH + LANE_NODES) * LANES + o)
        law = sensor_laws(coefficients, o)
        place = SPOOL_LIMITS.quarter_level * LANE_FILTER_ROWS * LANES + o
        step = load(coefficients, (COEFFICIENTS.filter + LANE_FILTER_ROWS - 1) * LANES + place)
        whole, upto = (
            full_filter_steps(coefficients, place),
            sampled_filter_steps(coefficients, place),
        )
        lagged, early = load(state, ROWS.spool_lagged * LANES + o), at_end
        for n in range(LANE_NODES):
            a, b = n * LANES + o, (n + 1) * LANES + o
            cubic = cubic_through_ends(
                load(path, a), load(path, b),
                0.25 * tick * load(path, LANE_PATH_SLOPE * LANES + a),
                0.25 * tick * load(path, LANE_PATH_SLOPE * LANES + b),
            )  # fmt: skip
            early = where(step == n * 1.0, filter_output(upto, lagged, cubic), early)
            lagged = filter_output(whole, lagged, cubic)
        store(state, ROWS.spool_lagged * LANES + o, lagged)
        seen = where(law.lag + law.lead == 0.0, at_end, early)
        store(state, ROWS.spool_sampled * LANES + o, seen)


@packed
def anchor_spool_lanes(
    end: int,
    read: int,
    measured: float,
    gain: float,
    small: float,
    large: float,
    state: Array,
    coefficients: Array,
) -> None:
    """Re-anchor the spool of all lanes at the end of a tick (`ehadiag.model.batch.Anchor`).

    read: row of the state that has the spool as it is sampled.
    """
    for o in range(0, end, VECTOR_WIDTH):
        xs, filtered = load(state, ROWS.spool * LANES + o), load(state, ROWS.filtered * LANES + o)
        law = sensor_laws(coefficients, o)
        error = measured - read_spool(law, load(state, read * LANES + o))
        filtered = filtered + gain * (error - filtered)
        move = where(absolute(filtered) > small, filtered, 0.0)
        move = where(absolute(error) > large, error, move)
        jumps = move != 0.0
        store(state, ROWS.filtered * LANES + o, where(jumps, 0.0, filtered))
        store(
            state,
            ROWS.anchor_count * LANES + o,
            load(state, ROWS.anchor_count * LANES + o) + where(jumps, 1.0, 0.0),
        )
        stroke = spool_laws(coefficients, o).stroke
        placed = maximum(minimum(xs + move, stroke), -stroke)
        store(state, ROWS.spool * LANES + o, placed)
        store(state, ROWS.wire * LANES + o, load(state, ROWS.wire * LANES + o) + (placed - xs))
        if read == ROWS.spool_sampled:
            lagged = load(state, ROWS.spool_lagged * LANES + o)
            store(state, ROWS.spool_lagged * LANES + o, lagged + (placed - xs))


@packed
def _creep_quarter_step(
    t: SpoolLaw, m: tuple[Vector, ...], span: float, a: Vector, w: Vector, b: Vector, v: Vector,
    slowest: Vector, lowest: Vector, widest: Vector, doubt: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """One step, positive along the motion, and how near it came to an event.

    a, b: from where flapper and spool would rest by the dynamic friction alone.
    """
    bend = bridge_bend(t, a + 0.5 * span * w)
    a, b = a + bend, b - t.reach * bend
    free = m[12] * a + m[13] * w + m[14] * b + m[15] * v
    swing = m[4] * a + m[5] * w + m[6] * b + m[7] * v - w
    mean, largest, less, miss = creep_friction(t, span, v, free, m[12] - m[14] * t.reach, swing)
    a, b = a - mean, b + t.reach * mean
    mean = mean - bend
    na = m[0] * a + m[1] * w + m[2] * b + m[3] * v + mean
    nw = m[4] * a + m[5] * w + m[6] * b + m[7] * v
    nb = m[8] * a + m[9] * w + m[10] * b + m[11] * v - t.reach * mean
    nv = m[12] * a + m[13] * w + m[14] * b + m[15] * v - less
    swing = 0.25 * span * maximum(absolute(w), absolute(nw))
    inside = where(w * nw < 0.0, minimum(a + mean, na) - largest - swing, SPOOL_LIMITS.no_event)
    widest = maximum(widest, absolute(na + t.dry) + swing)
    return (
        na,
        nw,
        nb,
        nv,
        minimum(slowest, nv),
        minimum(lowest, inside),
        widest,
        maximum(doubt, miss),
    )


@bare_kernel
def creep_lanes(end: int, tick: float, state: Array, path: Array, coefficients: Array) -> bool:
    """Flapper and spool of the busy lanes before `end` that creep, over a tick without events.

    Lanes in which an event may hide stay busy and as they were; returns whether there are any.
    """
    any_busy = False
    span = 0.25 * tick
    for o in range(0, end, VECTOR_WIDTH):
        t = spool_laws(coefficients, o)
        busy, d = load(state, ROWS.busy * LANES + o), load(state, ROWS.direction * LANES + o)
        tries = (busy != 0.0) & (d != 0.0) & (load(state, ROWS.clamped * LANES + o) == 0.0)
        tries = tries & (t.extra > 0.0)
        if any_lane(tries):
            m = _quarter_matrix(coefficients, o)
            xf, wf = (
                load(state, ROWS.flapper * LANES + o),
                load(state, ROWS.flapper_rate * LANES + o),
            )
            xs, vs = load(state, ROWS.spool * LANES + o), load(state, ROWS.spool_rate * LANES + o)
            wire = load(state, ROWS.wire * LANES + o)
            base = spool_rest_position(t, load(state, ROWS.deflection * LANES + o), d)
            a, w, b, v = xf * d - t.dry, wf * d, (xs - base) * d, vs * d
            zero = d * 0.0
            s, n, x, y = zero + SPOOL_LIMITS.no_event, zero + SPOOL_LIMITS.no_event, zero, zero
            a, w, b, v, s, n, x, y = _creep_quarter_step(t, m, span, a, w, b, v, s, n, x, y)
            b1, v1 = base + d * b, d * v
            a, w, b, v, s, n, x, y = _creep_quarter_step(t, m, span, a, w, b, v, s, n, x, y)
            b2, v2 = base + d * b, d * v
            a, w, b, v, s, n, x, y = _creep_quarter_step(t, m, span, a, w, b, v, s, n, x, y)
            b3, v3 = base + d * b, d * v
            a, w, b, v, s, n, x, y = _creep_quarter_step(t, m, span, a, w, b, v, s, n, x, y)
            b4, v4 = base + d * b, d * v
            goes = tries & (d * (xs - wire) >= t.backlash - WIRE_TOLERANCE)
            goes = goes & (s > SPOOL_LIMITS.creep_velocity) & (n > 0.0) & (y <= MAX_CREEP_ERROR)
            goes = goes & (x < t.flapper_stop) & (d * b4 < t.stroke)
            _keep_creep(path, state, goes, o, b1, b2, b3, b4, v1, v2, v3, v4)
            store(state, ROWS.flapper * LANES + o, where(goes, (a + t.dry) * d, xf))
            store(state, ROWS.flapper_rate * LANES + o, where(goes, w * d, wf))
            store(
                state, ROWS.wire * LANES + o, where(goes, play_output(wire, b4, t.backlash), wire)
            )
            busy = where(goes, 0.0, busy)
            store(state, ROWS.busy * LANES + o, busy)
        if any_lane(busy != 0.0):
            any_busy = True
    return any_busy


@packed
def _keep_creep(
    path: Array, state: Array, goes: Mask, o: int,
    b1: Vector, b2: Vector, b3: Vector, b4: Vector, v1: Vector, v2: Vector, v3: Vector, v4: Vector,
) -> None:  # fmt: skip
    """Write places and velocities at the nodes of the lanes that came through."""
    p, q = (LANE_PATH + 1) * LANES + o, (LANE_PATH_SLOPE + 1) * LANES + o
    store(path, p, where(goes, b1, load(path, p)))
    store(path, p + LANES, where(goes, b2, load(path, p + LANES)))
    store(path, p + 2 * LANES, where(goes, b3, load(path, p + 2 * LANES)))
    store(path, p + 3 * LANES, where(goes, b4, load(path, p + 3 * LANES)))
    store(path, q, where(goes, v1, load(path, q)))
    store(path, q + LANES, where(goes, v2, load(path, q + LANES)))
    store(path, q + 2 * LANES, where(goes, v3, load(path, q + 2 * LANES)))
    store(path, q + 3 * LANES, where(goes, v4, load(path, q + 3 * LANES)))
    store(state, ROWS.spool * LANES + o, where(goes, b4, load(state, ROWS.spool * LANES + o)))
    store(
        state,
        ROWS.spool_rate * LANES + o,
        where(goes, v4, load(state, ROWS.spool_rate * LANES + o)),
    )


@inlined
def held_friction(
    t: SpoolLaw, moving: Array, loose: Array, place: int, steps: int,
    h: float, deflection: float, s: SpoolState,
) -> tuple[SpoolLaw, float, bool]:  # fmt: skip
    """Law of a moving spool with the mean friction of some steps of one length.

    moving, loose: transitions, see `ehadiag.model.simd_layout`; place: of the lane and the length
    of the steps in them; steps: 1 … STEPS; h: length of a step, s; s: state before. Returns
    the law, the velocity (m/s) by which the end is slower along the motion, and whether the
    friction may be held for so long.
    """
    d, swing = float(s.direction), 0.0
    k = place * MOVING_ROWS * STEPS + steps - 1
    if steps * h > SPOOL_LIMITS.held_s:
        return t, 0.0, False
    if s.clamped:
        rest, fade = clamped_spool_velocity(t, s.xf, d), moving[k + 17 * STEPS]
        free, pull = rest + (s.vs - rest) * fade, t.force / t.damping * (1.0 - fade)
    elif is_wire_carried(t, s.direction, s.xs, s.wire):
        a, b = s.xf - t.dry * d, s.xs - spool_rest_position(t, deflection, d)
        free = moving[k + 12 * STEPS] * a + moving[k + 13 * STEPS] * s.wf
        free += moving[k + 14 * STEPS] * b + moving[k + 15 * STEPS] * s.vs
        swing = moving[k + 4 * STEPS] * a + moving[k + 5 * STEPS] * s.wf - s.wf
        swing += moving[k + 6 * STEPS] * b + moving[k + 7 * STEPS] * s.vs
        pull = moving[k + 12 * STEPS] - moving[k + 14 * STEPS] * t.reach
    else:
        still = flapper_rest(t.ratio, deflection, s.wire)
        rest, fade = steady_spool_velocity(t, still, d), loose[k + 15 * STEPS]
        free = rest + (s.vs - rest) * fade
        free += loose[k + 12 * STEPS] * (s.xf - still) + loose[k + 13 * STEPS] * s.wf
        swing = loose[k + 4 * STEPS] * (s.xf - still) + loose[k + 5 * STEPS] * s.wf - s.wf
        pull = t.force / t.damping * (1.0 - fade)
    mean, _, less, doubt = creep_friction(t, steps * h, s.vs * d, free * d, pull, swing * d)
    return with_friction(t, mean), less, doubt <= MAX_CREEP_ERROR
