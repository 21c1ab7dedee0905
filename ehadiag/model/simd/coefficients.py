"""Coefficients of a block of candidates, from their physical constants."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined, kernel
from ehadiag.compile.vector import WIDTH, load, packed, store
from ehadiag.model.laws import SpoolLaw, drive_law, jack_law, spool_law
from ehadiag.model.plant import PlantConstants, plant_of
from ehadiag.model.scalar.transition import FINEST, TAYLOR_HALVINGS
from ehadiag.model.sensors import SensorLaw, following, sensing, sensor_law
from ehadiag.model.simd.layout import (
    LANES,
    LOOSE,
    MOST_HALVINGS,
    MOVE,
    REST,
    RING_TIME,
    ROOM,
    SENSING,
    SENSING_ROWS,
    jack_law_of_lane,
    keep_drive_law,
    keep_jack_law,
    keep_sampled_step,
    keep_sensor_law,
    keep_spool_law,
    keep_whole_step,
    spool_law_of_lane,
)

__all__ = [
    "HALVINGS",
    "MOVING_SIZE",
    "RINGS_SIZE",
    "SHIFTS",
    "SLIDES_SIZE",
    "STUCK_SIZE",
    "tabulate",
]

SHIFTS = (FINEST - 3, FINEST - 6, 0)
"""Lengths of the steps of a tick with events, as powers of two of the finest: an eighth of the
tick, an eighth of that, and the finest; WIDTH of each, one behind the other."""
PLACES = 3
"""WIDTH as a power of two."""
MOVING_ROWS, STUCK_ROWS = 18, 4
"""Vectors for steps of one length: 4 x 4 transitions, time in s, decay of the spool's velocity with
the flapper on its stop; 2 x 2 transitions."""
MOVING_SIZE = LANES * len(SHIFTS) * MOVING_ROWS * WIDTH
STUCK_SIZE = LANES * len(SHIFTS) * STUCK_ROWS * WIDTH
HALVINGS = FINEST - 2
"""Of a quarter of the tick, down to the finest step."""
SLIDES_SIZE, RINGS_SIZE = (HALVINGS + 1) * 16 * LANES, (HALVINGS + 1) * 4 * LANES
TAYLOR_ORDER = 8
NEVER = 1e30


@packed
def _copy(source: NDArray[np.float64], target: NDArray[np.float64], start: int) -> None:
    """Write all of `source` into `target` from `start`."""
    for o in range(0, source.shape[0], WIDTH):
        store(target, start + o, load(source, o))


@packed
def _add(source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    """Add `source` to `target`."""
    for o in range(0, source.shape[0], WIDTH):
        store(target, o, load(target, o) + load(source, o))


@bare_kernel
def _product(
    a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64], n: int, scale: float
) -> None:
    """Product of the n x n matrices of all lanes, times `scale`; flat, element by element."""
    for r in range(n):
        for q in range(n):
            for o in range(0, LANES, WIDTH):
                total = load(a, r * n * LANES + o) * load(b, q * LANES + o)
                for k in range(1, n):
                    x, y = load(a, (r * n + k) * LANES + o), load(b, (k * n + q) * LANES + o)
                    total = total + x * y
                store(out, (r * n + q) * LANES + o, total * scale)


@kernel
def _smallest(rates: NDArray[np.float64], n: int, tick: float) -> NDArray[np.float64]:
    """exp(rates h) for the finest step: Taylor at a still smaller one, then squaring."""
    scaled = rates * (tick / 2.0 ** (FINEST + TAYLOR_HALVINGS))
    term, power, spare = np.zeros_like(rates), np.zeros_like(rates), np.zeros_like(rates)
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
    return power


@kernel
def _doubled(smallest: NDArray[np.float64], n: int, out: NDArray[np.float64]) -> None:
    """Transitions over 2^0 … 2^HALVINGS finest steps: out, a matrix of all lanes behind another."""
    power, spare = smallest.copy(), np.empty_like(smallest)
    _copy(power, out, 0)
    for level in range(1, HALVINGS + 1):
        _product(power, power, spare, n, 1.0)
        power, spare = spare, power
        _copy(power, out, level * n * n * LANES)


@kernel
def _powers(
    smallest: NDArray[np.float64], n: int, rows: int, table: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Transitions over the steps of `SHIFTS`.

    smallest: over the finest step, overwritten.
    table: out, shape (LANES, 3, rows, WIDTH), flat; the first n² rows are written.
    Returns transitions of all lanes over a quarter of a tick and over a whole one.
    """
    size = n * n
    one, power = smallest, np.empty_like(smallest)
    spare, quarter = np.empty_like(smallest), np.empty_like(smallest)
    for level in range(len(SHIFTS) - 1, -1, -1):
        _copy(one, power, 0)
        for step in range(WIDTH):
            for i in range(LANES):
                for e in range(size):
                    place = ((i * len(SHIFTS) + level) * rows + e) * WIDTH + step
                    table[place] = power[e * LANES + i]
            if level == 0 and step == 1:
                _copy(power, quarter, 0)
            if step < WIDTH - 1:
                _product(power, one, spare, n, 1.0)
                power, spare = spare, power
        if level > 0:
            for _ in range(SHIFTS[level - 1] - SHIFTS[level] - PLACES):
                _product(power, power, spare, n, 1.0)
                power, spare = spare, power
            one, power = power, one
    return quarter, power


@inlined
def _laws(c: PlantConstants, tick: float, i: int, out: NDArray[np.float64]) -> SpoolLaw:
    """Write the laws of lane `i`, tick: s; returns that of the spool."""
    t = spool_law(c)
    keep_drive_law(out, i, drive_law(c, tick))
    keep_spool_law(out, i, t)
    keep_jack_law(out, i, jack_law(c))
    keep_sensor_law(out, i, sensor_law(c))
    out[ROOM * LANES + i] = min(t.breakaway, t.flapper_stop)
    # A flapper that does not ring is never taken to rest: slower, not wrong.
    out[RING_TIME * LANES + i] = 1.0 / t.ring_rate if t.ring_rate > 0.0 else NEVER
    return t


@inlined
def _filter(law: SensorLaw, tick: float, i: int, out: NDArray[np.float64]) -> None:
    """Write how lane `i` follows its signals before the converters."""
    due = tick - min(law.lead, tick)
    for level in range(MOST_HALVINGS + 1):
        span = tick / (1 << level)
        step = max(math.ceil(due / span) - 1, 0)
        place = level * SENSING_ROWS * LANES + i
        keep_whole_step(out, place, following(law.lag, span, span))
        keep_sampled_step(out, place, following(law.lag, span, due - step * span))
        out[(SENSING + SENSING_ROWS - 1) * LANES + place] = step


@kernel
def tabulate(
    candidates: NDArray[np.float64],
    tick: float,
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    loose: NDArray[np.float64],
    stuck: NDArray[np.float64],
    slides: NDArray[np.float64],
    free_slides: NDArray[np.float64],
    rings: NDArray[np.float64],
) -> tuple[bool, bool, bool, bool]:
    """Coefficients of all lanes; returns whether any has backlash, Stribeck's friction of the
    spool, lands of a shape of their own, and a filter, a lead or Stribeck's friction of the jack.

    Parameters
    ----------
    candidates: a row of physical constants a lane, shape (LANES, FIELDS).
    tick: s.
    coefficients: out, shape (COEFFICIENT_ROWS * LANES,).
    moving: out, what goes on over 1 … WIDTH steps of each length of `SHIFTS` with the spool moving,
        shape (LANES, 3, MOVING_ROWS, WIDTH), flat.
    loose: out, the same without the feedback wire, where a lane has backlash.
    stuck: out, the same with the spool at rest, shape (LANES, 3, STUCK_ROWS, WIDTH), flat.
    slides, free_slides, rings: out, transitions over 2^0 … 2^HALVINGS finest steps, moving with the
        feedback wire and (where a lane has backlash) without it, and at rest; shapes
        (HALVINGS + 1, 16, LANES) and (HALVINGS + 1, 4, LANES), flat.
    """
    rates, ring = np.zeros(16 * LANES), np.zeros(4 * LANES)
    any_backlash = any_creep = any_shape = any_other = False
    for i in range(LANES):
        c = plant_of(candidates[i])
        t = _laws(c, tick, i, coefficients)
        any_backlash = any_backlash or t.backlash > 0.0
        any_creep = any_creep or t.extra > 0.0
        any_shape = any_shape or jack_law_of_lane(coefficients, i).shaped != 0.0
        any_other = any_other or sensing(sensor_law(c)) or c.VSJ > 0.0
        stiffness, friction = -c.KF / c.JF, -c.CF / c.JF
        rates[1 * LANES + i], rates[11 * LANES + i] = 1.0, 1.0
        rates[4 * LANES + i], rates[5 * LANES + i] = stiffness, friction
        rates[6 * LANES + i] = -c.KSF / c.JF
        rates[12 * LANES + i] = t.force / t.mass
        rates[15 * LANES + i] = -t.damping / t.mass
        ring[1 * LANES + i], ring[2 * LANES + i], ring[3 * LANES + i] = 1.0, stiffness, friction
    smallest = _smallest(rates, 4, tick)
    _doubled(smallest, 4, slides)
    quarter, _ = _powers(smallest, 4, MOVING_ROWS, moving)
    _copy(quarter, coefficients, MOVE * LANES)
    for i in range(LANES):
        t = spool_law_of_lane(coefficients, i)
        rate = t.damping / t.mass
        for level, shift in enumerate(SHIFTS):
            for step in range(WIDTH):
                time = tick / (1 << FINEST) * ((step + 1) << shift)
                place = ((i * len(SHIFTS) + level) * MOVING_ROWS + 16) * WIDTH + step
                moving[place] = time
                moving[place + WIDTH] = math.exp(-time * rate)
    smallest = _smallest(ring, 2, tick)
    _doubled(smallest, 2, rings)
    _, whole = _powers(smallest, 2, STUCK_ROWS, stuck)
    _copy(whole, coefficients, REST * LANES)
    if any_other:
        for i in range(LANES):
            _filter(sensor_law(plant_of(candidates[i])), tick, i, coefficients)
    if any_backlash:
        rates[6 * LANES : 7 * LANES] = 0.0
        smallest = _smallest(rates, 4, tick)
        _doubled(smallest, 4, free_slides)
        quarter, _ = _powers(smallest, 4, MOVING_ROWS, loose)
        _copy(quarter, coefficients, LOOSE * LANES)
        for i in range(LANES):
            for level in range(len(SHIFTS)):
                place = ((i * len(SHIFTS) + level) * MOVING_ROWS + 16) * WIDTH
                loose[place : place + WIDTH] = moving[place : place + WIDTH]
    return any_backlash, any_creep, any_shape, any_other
