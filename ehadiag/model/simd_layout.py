"""Layout of a block of candidates for vector kernels, and their coefficients.

VECTOR_WIDTH candidates stand in a vector, LANES in a block. Arrays are flat, row r of lane i at r *
LANES + i.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.compile.jit import Array, bare_kernel, inlined, merged
from ehadiag.compile.vector import (
    VECTOR_WIDTH,
    lane_of,
    lane_packer,
    lanes_of,
    load,
    packed,
    places,
    store,
)
from ehadiag.model.laws import DriveLaw, JackLaw, SpoolLaw, drive_law, jack_law, plant_of, spool_law
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar_spool import MAX_PLAYS, SPOOL_GRID
from ehadiag.model.sensors import (
    FilterStep,
    SensorLaw,
    filter_step,
    has_sensor_dynamics,
    sensor_law,
)

LANES = 2 * VECTOR_WIDTH
LANE_NODES = 4
"""Pieces of the spool's path in a tick, 1."""


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
keep_full_filter_step = lane_packer(FilterStep, COEFFICIENTS.filter, LANES)
keep_sampled_filter_step = lane_packer(
    FilterStep, COEFFICIENTS.filter + len(FilterStep._fields), LANES
)
"""Compiled, of an array, a lane and a law: write that lane's."""


STEP_SHIFTS = (SPOOL_GRID.finest_level - 3, SPOOL_GRID.finest_level - 6, 0)
"""Lengths of the steps of a tick with events, as powers of two of the finest: an eighth of the
tick, an eighth of that, and the finest; VECTOR_WIDTH of each, one behind the other."""
VECTOR_WIDTH_EXPONENT = VECTOR_WIDTH.bit_length() - 1
"""Exponent of VECTOR_WIDTH as a power of two, 1."""
MOVING_ROWS, STUCK_ROWS = 18, 4
"""Vectors for steps of one length: 4 x 4 transitions, time in s, decay of the spool's velocity with
the flapper on its stop; 2 x 2 transitions."""
MOVING_SIZE = LANES * len(STEP_SHIFTS) * MOVING_ROWS * VECTOR_WIDTH
STUCK_SIZE = LANES * len(STEP_SHIFTS) * STUCK_ROWS * VECTOR_WIDTH
QUARTER_HALVINGS = SPOOL_GRID.finest_level - 2
"""Of a quarter of the tick, down to the finest step."""
SLIDES_SIZE, RINGS_SIZE = (QUARTER_HALVINGS + 1) * 16 * LANES, (QUARTER_HALVINGS + 1) * 4 * LANES
LANE_TAYLOR_ORDER = 8
"""Order of the series of a transition, 1."""
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


MATRIX_SCRATCH_SIZE = 9 * 16 * LANES
"""Numbers that `tabulate_coefficients` takes as scratch: nine matrices of all lanes."""


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
    short = tick / 2.0 ** (SPOOL_GRID.finest_level + SPOOL_GRID.taylor_halvings)
    for i in range(rates.shape[0]):
        scaled[i] = rates[i] * short
        term[i] = power[i] = 0.0
    for r in range(n):
        start = (r * n + r) * LANES
        term[start : start + LANES] = 1.0
        power[start : start + LANES] = 1.0
    for order in range(1, LANE_TAYLOR_ORDER + 1):
        _product(term, scaled, spare, n, 1.0 / order)
        term, spare = spare, term
        _add(term, power)
    for _ in range(SPOOL_GRID.taylor_halvings):
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
    table: out, shape (LANES, 3, rows, VECTOR_WIDTH), flat; the first n² rows are written.
    quarter, whole: out, transitions of all lanes over a quarter of a tick and over a whole one.
    """
    size = n * n
    one, power, spare = smallest, _part(scratch, 0, n), _part(scratch, 1, n)
    for level in range(len(STEP_SHIFTS) - 1, -1, -1):
        _copy(one, power, 0)
        for step in range(VECTOR_WIDTH):
            for i in range(LANES):
                for e in range(size):
                    place = ((i * len(STEP_SHIFTS) + level) * rows + e) * VECTOR_WIDTH + step
                    table[place] = power[e * LANES + i]
            if level == 0 and step == 1:
                _copy(power, quarter, 0)
            if step < VECTOR_WIDTH - 1:
                _product(power, one, spare, n, 1.0)
                power, spare = spare, power
        if level > 0:
            for _ in range(STEP_SHIFTS[level - 1] - STEP_SHIFTS[level] - VECTOR_WIDTH_EXPONENT):
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


@inlined
def _filter(law: SensorLaw, tick: float, i: int, out: Array) -> None:
    """Write how lane `i` follows its signals before the converters."""
    due = tick - min(law.lead, tick)
    for level in range(MAX_JACK_HALVINGS + 1):
        span = tick / (1 << level)
        step = max(math.ceil(due / span) - 1, 0)
        place = level * LANE_FILTER_ROWS * LANES + i
        keep_full_filter_step(out, place, filter_step(law.lag, span, span))
        keep_sampled_filter_step(out, place, filter_step(law.lag, span, due - step * span))
        out[(COEFFICIENTS.filter + LANE_FILTER_ROWS - 1) * LANES + place] = step


@bare_kernel
def tabulate_coefficients(
    candidates: Array,
    tick: float,
    coefficients: Array,
    moving: Array,
    loose: Array,
    stuck: Array,
    slides: Array,
    free_slides: Array,
    rings: Array,
    scratch: Array,
) -> tuple[bool, bool, bool, bool]:
    """Write coefficients and transition tables of a block of candidates for ticks of one length, s.

    candidates: rows of constants, shape (LANES, PLANT_FIELDS). Written are the coefficients,
    transitions over the steps of `STEP_SHIFTS` of a moving spool (with and without the feedback
    wire) and of one at rest, and over 2^0 … 2^QUARTER_HALVINGS finest steps. Returns whether any
    lane has backlash, friction that falls with the velocity, lands of a shape, and a sensor with
    dynamics.
    """
    rates, ring = _part(scratch, 4, 4), _part(scratch, 5, 2)
    smallest, quarter, whole = _part(scratch, 6, 4), _part(scratch, 7, 4), _part(scratch, 8, 4)
    smallest_ring = _part(scratch, 6, 2)
    rates[:] = 0.0
    ring[:] = 0.0
    any_backlash = any_creep = any_shape = any_other = False
    for i in range(LANES):
        c = plant_of(candidates[i])
        t = _laws(c, tick, i, coefficients)
        any_backlash = any_backlash or t.backlash > 0.0
        any_creep = any_creep or t.extra > 0.0
        any_shape = any_shape or jack_law_of_lane(coefficients, i).shaped != 0.0
        any_other = any_other or has_sensor_dynamics(sensor_law(c)) or c.VSJ > 0.0
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
            for step in range(VECTOR_WIDTH):
                time = tick / (1 << SPOOL_GRID.finest_level) * ((step + 1) << shift)
                place = ((i * len(STEP_SHIFTS) + level) * MOVING_ROWS + 16) * VECTOR_WIDTH + step
                moving[place] = time
                moving[place + VECTOR_WIDTH] = math.exp(-time * rate)
    _smallest(ring, 2, tick, scratch, smallest_ring)
    _doubled(smallest_ring, 2, rings, scratch)
    _powers(smallest_ring, 2, STUCK_ROWS, stuck, scratch, quarter, whole)
    _copy(whole[: 4 * LANES], coefficients, COEFFICIENTS.rest * LANES)
    if any_other:
        for i in range(LANES):
            _filter(sensor_law(plant_of(candidates[i])), tick, i, coefficients)
    if any_backlash:
        rates[6 * LANES : 7 * LANES] = 0.0
        _smallest(rates, 4, tick, scratch, smallest)
        _doubled(smallest, 4, free_slides, scratch)
        _powers(smallest, 4, MOVING_ROWS, loose, scratch, quarter, whole)
        _copy(quarter, coefficients, COEFFICIENTS.loose * LANES)
        for i in range(LANES):
            for level in range(len(STEP_SHIFTS)):
                place = ((i * len(STEP_SHIFTS) + level) * MOVING_ROWS + 16) * VECTOR_WIDTH
                store(loose, place, load(moving, place))
    return any_backlash, any_creep, any_shape, any_other
