"""Layout of a block of candidates for vector kernels, and their coefficients.

VECTOR_WIDTH candidates stand in a vector, LANES in a block. Arrays are flat, row r of lane i at r *
LANES + i.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehadiag.compile.jit import Array, bare_kernel, inlined, merged
from ehadiag.compile.vector import (
    BYTES_PER_NUMBER,
    LANES,
    VECTOR_WIDTH,
    array_at,
    lane_of,
    lane_packer,
    lanes_of,
    lanes_packer,
    load,
    minimum,
    packed,
    places,
    store,
)
from ehadiag.model.laws import DriveLaw, JackLaw, SpoolLaw, drive_law, jack_law, plant_of, spool_law
from ehadiag.model.plant import PlantConstants
from ehadiag.model.sensors import (
    FilterStep,
    SensorLaw,
    filter_step,
    has_sensor_dynamics,
    sensor_law,
)

FINEST_LEVEL = 10
"""Halvings of a tick to which events are located, 1: 1 µs at 1 kHz."""
TICK_UNITS = 1 << FINEST_LEVEL
"""Finest steps of a tick, 1."""
MAX_PLAYS = 16
"""Largest number of plays of the hysteresis, 1."""
LANE_NODES = 4
"""Pieces of the spool's path in a tick, 1."""
QUARTER_UNITS = TICK_UNITS // LANE_NODES
"""Finest steps of a quarter of a tick, 1."""


class LaneRows(NamedTuple):
    """Rows of the state of a block."""

    flapper: int
    """Flapper deflection, m."""
    flapper_rate: int
    """Rate of the flapper, m/s."""
    spool: int
    """Spool position, m."""
    spool_rate: int
    """Spool velocity, m/s."""
    direction: int
    """Direction of the spool's motion, ±1; 0 at rest."""
    clamped: int
    """Not 0 where the flapper is on its stop."""
    busy: int
    """Not 0 where an event may hide in the tick."""
    jack: int
    """Jack position, m."""
    jack_velocity: int
    """Jack velocity, m/s."""
    jack_direction: int
    """Direction of the jack's motion, ±1; 0 at rest."""
    filtered: int
    """Filtered innovation, m."""
    fresh: int
    """Not 0 where the jack has just started or stopped."""
    done: int
    """Not 0 where the jack has taken this tick with the spool."""
    deflection: int
    """Flapper deflection by the current alone, m."""
    wire: int
    """End of the feedback wire, m."""
    spool_sampled: int
    """Spool as it is sampled, m."""
    spool_lagged: int
    """Spool behind the filter at the end of the tick, m."""
    pressure: int
    """Pressure in the oil of an orifice stage, Pa."""
    pressure_lagged: int
    """Pressure behind the filter at the end of the tick, Pa."""
    pressure_sampled: int
    """Pressure as it is sampled, Pa."""
    position_sampled: int
    """Jack as it is sampled, m."""
    anchor_count: int
    """Number of re-anchorings so far, 1."""
    current: int
    """Current behind its driver's lag, A."""
    plays: int
    """First of the plays of the hysteresis, A, which are the last rows."""


ROWS = LaneRows(*range(len(LaneRows._fields)))


LANE_STATE_ROWS = ROWS.plays + MAX_PLAYS
LANE_PATH, LANE_PATH_SLOPE = 0, LANE_NODES + 1
"""First rows of the path, 1: position and velocity of the spool at the nodes 0 … LANE_NODES."""
LANE_PATH_ROWS = 2 * LANE_PATH_SLOPE

MAX_JACK_HALVINGS = 4
"""Largest number of halvings of the jack's ticks, 1."""
LANE_FILTER_ROWS = 2 * len(FilterStep._fields) + 1
"""Rows of the filter for one number of halvings, 1: its response to a whole step, up to the instant
of sampling, and the number of the step in which that lies."""


class LaneCoefficients(NamedTuple):
    """Rows of the coefficients of a block, each the first of a part."""

    drive_law: int
    spool_law: int
    jack_law: int
    sensor_law: int
    rest_limit: int
    """Flapper deflection within which a resting spool stays, m."""
    ring_time: int
    """Reciprocal of the ringing's rate, s."""
    rest: int
    """Transition over a tick at rest, 2 x 2."""
    move: int
    """Transition over a quarter of a tick, moving, 4 x 4."""
    loose: int
    """The same without the feedback wire."""
    idle: int
    """1 in a lane without a candidate, whose events are ignored."""
    filter: int
    """Filter before the converters, for each number of halvings."""
    end: int


COEFFICIENTS = LaneCoefficients(
    *places(DriveLaw, SpoolLaw, JackLaw, SensorLaw, 1, 1, 4, 16, 16, 1,
            (MAX_JACK_HALVINGS + 1) * LANE_FILTER_ROWS)
)  # fmt: skip
drive_laws = lanes_of(DriveLaw, COEFFICIENTS.drive_law, LANES)
spool_laws = lanes_of(SpoolLaw, COEFFICIENTS.spool_law, LANES)
jack_laws = lanes_of(JackLaw, COEFFICIENTS.jack_law, LANES)
sensor_laws = lanes_of(SensorLaw, COEFFICIENTS.sensor_law, LANES)
full_filter_steps = lanes_of(FilterStep, COEFFICIENTS.filter, LANES)
sampled_filter_steps = lanes_of(FilterStep, COEFFICIENTS.filter + len(FilterStep._fields), LANES)
"""Compiled, of an array and a lane: laws of the VECTOR_WIDTH lanes from there. For the filter a
lane stands for one of a number of halvings, n LANE_FILTER_ROWS LANES further on."""
spool_law_of_lane = lane_of(SpoolLaw, COEFFICIENTS.spool_law, LANES)
jack_law_of_lane = lane_of(JackLaw, COEFFICIENTS.jack_law, LANES)
sensor_law_of_lane = lane_of(SensorLaw, COEFFICIENTS.sensor_law, LANES)
"""Compiled, of an array and a lane: laws of that lane."""
keep_drive_law = lane_packer(DriveLaw, COEFFICIENTS.drive_law, LANES)
keep_spool_law = lane_packer(SpoolLaw, COEFFICIENTS.spool_law, LANES)
keep_jack_law = lane_packer(JackLaw, COEFFICIENTS.jack_law, LANES)
keep_sensor_law = lane_packer(SensorLaw, COEFFICIENTS.sensor_law, LANES)
"""Compiled, of an array, a lane and a law: write that lane's."""
keep_full_filter_steps = lanes_packer(FilterStep, COEFFICIENTS.filter, LANES)
keep_sampled_filter_steps = lanes_packer(
    FilterStep, COEFFICIENTS.filter + len(FilterStep._fields), LANES
)
"""The same of the VECTOR_WIDTH lanes from there."""


MAX_TICK_EVENTS = 6
"""Of a lane in a tick. Each cuts a piece of the path for all lanes of a vector; so do the nodes."""
MAX_EVENT_PIECES = 32
"""Pieces of the path of a lane alone in a tick, 1."""


def max_path_pieces(width: int) -> int:
    """Pieces of the path that events of a vector of lanes may cut in a tick, together or alone."""
    return max(LANE_NODES + (MAX_TICK_EVENTS + 1) * width, MAX_EVENT_PIECES)


STEP_SHIFTS = (FINEST_LEVEL - 3, FINEST_LEVEL - 6, 0)
"""Lengths of the steps of a tick with events, as powers of two of the finest: an eighth of the
tick, an eighth of that, and the finest; STEPS of each, one behind the other."""
STEPS_EXPONENT = 3
STEPS = 1 << STEPS_EXPONENT
"""Steps of one length, 1: a lane alone looks for an event after each of them."""
MOVING_ROWS, STUCK_ROWS = 18, 4
"""Vectors for steps of one length: 4 x 4 transitions, time in s, decay of the spool's velocity with
the flapper on its stop; 2 x 2 transitions."""
QUARTER_HALVINGS = FINEST_LEVEL - 2
"""Of a quarter of the tick, down to the finest step."""


class BlockPlaces(NamedTuple):
    """Places of the parts of a block's memory."""

    state: int
    path: int
    """Behind the rows of the path what `ehadiag.model.simd_spool_events` works on."""
    coefficients: int
    moving: int
    loose: int
    stuck: int
    """Transitions over the steps of `STEP_SHIFTS`, see `tabulate_coefficients`."""
    slides: int
    free_slides: int
    rings: int
    """Transitions over 2^0 … 2^QUARTER_HALVINGS finest steps."""
    pieces: int
    """See `ehadiag.model.simd_jack_pieces`."""
    scratch: int
    """Nine matrices of all lanes, while the others are made."""
    end: int


def block_places(lanes: int, start: int = 0) -> BlockPlaces:
    """Places of the memory of a block of so many candidates, from a start on."""
    width, halvings = min(lanes, 8), QUARTER_HALVINGS + 1
    moving = lanes * len(STEP_SHIFTS) * MOVING_ROWS * STEPS
    sizes = (
        LANE_STATE_ROWS * lanes, LANE_PATH_ROWS * lanes + 4 * STEPS,
        COEFFICIENTS.end * lanes, moving, moving, lanes * len(STEP_SHIFTS) * STUCK_ROWS * STEPS,
        halvings * 16 * lanes, halvings * 16 * lanes, halvings * 4 * lanes,
        (4 * max_path_pieces(width) + 1) * width, 9 * 16 * lanes,
    )  # fmt: skip
    return BlockPlaces(*(start + item for item in places(*sizes)))


BLOCK = block_places(LANES)
CACHE_LINE_BYTES = 64
"""Size of a line of the cache, bytes: that of a vector of lanes."""


def aligned_numbers(size: int) -> Array:
    """Zeros that begin where a line of the cache does: a vector that straddles two takes longer."""
    raw = np.zeros(size + CACHE_LINE_BYTES // BYTES_PER_NUMBER)
    first = -raw.ctypes.data % CACHE_LINE_BYTES // raw.itemsize
    return raw[first : first + size]


@merged
def block_part(address: int, start: int, end: int) -> Array:
    """Numbers of a block's memory; to cut them out of an array calls the runtime."""
    return array_at(address + BYTES_PER_NUMBER * start, (end - start,))


TAYLOR_ORDER, TAYLOR_HALVINGS = 8, 3
"""Order of the series of a transition, and halvings of the finest step for it, 1."""
NO_RING_TIME = 1e30
"""Ring time of a flapper that does not ring, s."""


@packed
def _copy(source: Array, target: Array, start: int) -> None:
    """Write all of `source` into `target` from `start`."""
    for o in range(0, source.shape[0], VECTOR_WIDTH):
        store(target, start + o, load(source, o))


@packed
def _add(source: Array, target: Array) -> None:
    """Add `source` to `target`."""
    for o in range(0, source.shape[0], VECTOR_WIDTH):
        store(target, o, load(target, o) + load(source, o))


@merged
def _part(scratch: Array, index: int, n: int) -> Array:
    """A matrix n x n of all lanes in the scratch."""
    return scratch[16 * LANES * index : 16 * LANES * index + n * n * LANES]


@bare_kernel
def _product(a: Array, b: Array, out: Array, n: int, scale: float) -> None:
    """Product of the n x n matrices of all lanes, times `scale`; flat, element by element."""
    for r in range(n):
        for q in range(n):
            for o in range(0, LANES, VECTOR_WIDTH):
                total = load(a, r * n * LANES + o) * load(b, q * LANES + o)
                for k in range(1, n):
                    x, y = load(a, (r * n + k) * LANES + o), load(b, (k * n + q) * LANES + o)
                    total = total + x * y
                store(out, (r * n + q) * LANES + o, total * scale)


@bare_kernel
def _smallest(rates: Array, n: int, tick: float, scratch: Array, out: Array) -> None:
    """exp(rates h) for the finest step: Taylor at a still smaller one, then squaring."""
    scaled, term = _part(scratch, 0, n), _part(scratch, 1, n)
    power, spare = _part(scratch, 2, n), _part(scratch, 3, n)
    short = tick / 2.0 ** (FINEST_LEVEL + TAYLOR_HALVINGS)
    for i in range(rates.shape[0]):
        scaled[i] = rates[i] * short
        term[i] = power[i] = 0.0
    for r in range(n):
        start = (r * n + r) * LANES
        term[start : start + LANES] = 1.0
        power[start : start + LANES] = 1.0
    for order in range(1, TAYLOR_ORDER + 1):
        _product(term, scaled, spare, n, 1.0 / order)
        term, spare = spare, term
        _add(term, power)
    for _ in range(TAYLOR_HALVINGS):
        _product(power, power, spare, n, 1.0)
        power, spare = spare, power
    _copy(power, out, 0)


@bare_kernel
def _doubled(smallest: Array, n: int, out: Array, scratch: Array) -> None:
    """Transitions over 2^0 … 2^QUARTER_HALVINGS finest steps: out, a matrix of all lanes behind
    another."""
    power, spare = _part(scratch, 0, n), _part(scratch, 1, n)
    _copy(smallest, power, 0)
    _copy(power, out, 0)
    for level in range(1, QUARTER_HALVINGS + 1):
        _product(power, power, spare, n, 1.0)
        power, spare = spare, power
        _copy(power, out, level * n * n * LANES)


@bare_kernel
def _powers(
    smallest: Array, n: int, rows: int, table: Array, scratch: Array, quarter: Array, whole: Array
) -> None:
    """Transitions over the steps of `STEP_SHIFTS`.

    smallest: over the finest step, overwritten.
    table: out, shape (LANES, 3, rows, STEPS), flat; the first n² rows are written.
    quarter, whole: out, transitions of all lanes over a quarter of a tick and over a whole one.
    """
    size = n * n
    one, power, spare = smallest, _part(scratch, 0, n), _part(scratch, 1, n)
    for level in range(len(STEP_SHIFTS) - 1, -1, -1):
        _copy(one, power, 0)
        for step in range(STEPS):
            for i in range(LANES):
                for e in range(size):
                    place = ((i * len(STEP_SHIFTS) + level) * rows + e) * STEPS + step
                    table[place] = power[e * LANES + i]
            if level == 0 and step == 1:
                _copy(power, quarter, 0)
            if step < STEPS - 1:
                _product(power, one, spare, n, 1.0)
                power, spare = spare, power
        if level > 0:
            for _ in range(STEP_SHIFTS[level - 1] - STEP_SHIFTS[level] - STEPS_EXPONENT):
                _product(power, power, spare, n, 1.0)
                power, spare = spare, power
            one, power = power, one
    _copy(power, whole, 0)


@inlined
def _laws(c: PlantConstants, tick: float, i: int, out: Array) -> SpoolLaw:
    """Write the laws of lane `i`, tick: s; returns that of the spool."""
    t = spool_law(c)
    keep_drive_law(out, i, drive_law(c, tick))
    keep_spool_law(out, i, t)
    keep_jack_law(out, i, jack_law(c))
    keep_sensor_law(out, i, sensor_law(c))
    out[COEFFICIENTS.rest_limit * LANES + i] = min(t.breakaway, t.flapper_stop)
    # A flapper that does not ring is never taken to rest: slower, not wrong.
    out[COEFFICIENTS.ring_time * LANES + i] = (
        1.0 / t.ring_rate if t.ring_rate > 0.0 else NO_RING_TIME
    )
    return t


@packed
def _filters(tick: float, o: int, out: Array) -> None:
    """Write how the lanes from `o` follow their signals before the converters, tick: s."""
    law = sensor_laws(out, o)
    due = tick - minimum(law.lead, tick)
    for level in range(MAX_JACK_HALVINGS + 1):
        span, place = tick / (1 << level), level * LANE_FILTER_ROWS * LANES + o
        samples_in = (COEFFICIENTS.filter + LANE_FILTER_ROWS - 1) * LANES + place
        for i in range(VECTOR_WIDTH):
            before = tick - min(sensor_law_of_lane(out, o + i).lead, tick)
            out[samples_in + i] = max(math.ceil(before / span) - 1, 0)
        keep_full_filter_steps(out, place, filter_step(law.lag, span, due * 0.0 + span))
        upto = due - load(out, samples_in) * span
        keep_sampled_filter_steps(out, place, filter_step(law.lag, span, upto))


class BlockTraits(NamedTuple):
    """What any lane of a block has."""

    backlash: bool
    creeps: bool
    """Friction that falls with the velocity."""
    shaped: bool
    """Lands of a shape."""
    senses: bool
    """A sensor with dynamics."""
    orifice: bool
    """Orifices in its second stage."""
    bridge: bool
    """A bridge of orifices in its first stage."""
    plays: int
    """Number of plays of the hysteresis."""


@inlined
def lane_traits(coefficients: Array, i: int, plays: int) -> BlockTraits:
    """What lane `i` has."""
    spool, jack = spool_law_of_lane(coefficients, i), jack_law_of_lane(coefficients, i)
    return BlockTraits(
        spool.backlash > 0.0,
        spool.extra > 0.0,
        jack.shaped != 0.0,
        has_sensor_dynamics(sensor_law_of_lane(coefficients, i)) or jack.by_stribeck > 0.0,
        jack.oil > 0.0,
        spool.by_bend > 0.0,
        plays,
    )


@bare_kernel
def tabulate_coefficients(address: int, candidates: Array, tick: float) -> BlockTraits:
    """Write coefficients and transition tables of a block of candidates for ticks of one length, s.

    address: of the block; candidates: rows of constants, shape (LANES, PLANT_FIELDS). Written are
    the coefficients, transitions over the steps of `STEP_SHIFTS` of a moving spool (with and
    without the feedback wire) and of one at rest, and over 2^0 … 2^QUARTER_HALVINGS finest steps.
    """
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    moving = block_part(address, BLOCK.moving, BLOCK.loose)
    loose = block_part(address, BLOCK.loose, BLOCK.stuck)
    stuck = block_part(address, BLOCK.stuck, BLOCK.slides)
    slides = block_part(address, BLOCK.slides, BLOCK.free_slides)
    free_slides = block_part(address, BLOCK.free_slides, BLOCK.rings)
    rings = block_part(address, BLOCK.rings, BLOCK.pieces)
    scratch = block_part(address, BLOCK.scratch, BLOCK.end)
    rates, ring = _part(scratch, 4, 4), _part(scratch, 5, 2)
    smallest, quarter, whole = _part(scratch, 6, 4), _part(scratch, 7, 4), _part(scratch, 8, 4)
    smallest_ring = _part(scratch, 6, 2)
    rates[:] = 0.0
    ring[:] = 0.0
    plays = int(plant_of(candidates[0]).NPL)
    any_of = BlockTraits(False, False, False, False, False, False, plays)
    for i in range(LANES):
        c = plant_of(candidates[i])
        t = _laws(c, tick, i, coefficients)
        has = lane_traits(coefficients, i, plays)
        coefficients[COEFFICIENTS.idle * LANES + i] = 0.0
        any_of = BlockTraits(
            any_of.backlash or has.backlash, any_of.creeps or has.creeps,
            any_of.shaped or has.shaped, any_of.senses or has.senses,
            any_of.orifice or has.orifice, any_of.bridge or has.bridge, plays,
        )  # fmt: skip
        stiffness, friction = -c.KF / c.JF, -c.CF / c.JF
        rates[1 * LANES + i], rates[11 * LANES + i] = 1.0, 1.0
        rates[4 * LANES + i], rates[5 * LANES + i] = stiffness, friction
        rates[6 * LANES + i] = -c.KSF / c.JF
        rates[12 * LANES + i] = t.force / t.mass
        rates[15 * LANES + i] = -t.damping / t.mass
        ring[1 * LANES + i], ring[2 * LANES + i], ring[3 * LANES + i] = 1.0, stiffness, friction
    _smallest(rates, 4, tick, scratch, smallest)
    _doubled(smallest, 4, slides, scratch)
    _powers(smallest, 4, MOVING_ROWS, moving, scratch, quarter, whole)
    _copy(quarter, coefficients, COEFFICIENTS.move * LANES)
    for i in range(LANES):
        t = spool_law_of_lane(coefficients, i)
        rate = t.damping / t.mass
        for level, shift in enumerate(STEP_SHIFTS):
            for step in range(STEPS):
                time = tick / (1 << FINEST_LEVEL) * ((step + 1) << shift)
                place = ((i * len(STEP_SHIFTS) + level) * MOVING_ROWS + 16) * STEPS + step
                moving[place] = time
                moving[place + STEPS] = math.exp(-time * rate)
    _smallest(ring, 2, tick, scratch, smallest_ring)
    _doubled(smallest_ring, 2, rings, scratch)
    _powers(smallest_ring, 2, STUCK_ROWS, stuck, scratch, quarter, whole)
    _copy(whole[: 4 * LANES], coefficients, COEFFICIENTS.rest * LANES)
    if any_of.senses:
        for o in range(0, LANES, VECTOR_WIDTH):
            _filters(tick, o, coefficients)
    if any_of.backlash:
        rates[6 * LANES : 7 * LANES] = 0.0
        _smallest(rates, 4, tick, scratch, smallest)
        _doubled(smallest, 4, free_slides, scratch)
        _powers(smallest, 4, MOVING_ROWS, loose, scratch, quarter, whole)
        _copy(quarter, coefficients, COEFFICIENTS.loose * LANES)
        for i in range(LANES):
            for level in range(len(STEP_SHIFTS)):
                place = ((i * len(STEP_SHIFTS) + level) * MOVING_ROWS + 16) * STEPS
                for step in range(STEPS):
                    loose[place + step] = moving[place + step]
    return any_of
