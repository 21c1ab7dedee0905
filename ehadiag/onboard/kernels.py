"""The identification itself, as two kernels: begin, and go on for some runs of the model.

First approximation: a grid of filter and spool friction by the spool alone, then one of the jack's
friction by the pressure. The compact genetic algorithm goes on from there, and a damped
Gauss-Newton refines severities and both offsets together. One run of the model is a pass of the
streaming monitor over the recording.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.identify.search.compact_ga import CompactGaState, draw, learn_from
from ehadiag.monitor.kernel import push_tick
from ehadiag.monitor.layout import NUMBER, RESIDUAL, SETTINGS, Settings
from ehadiag.monitor.layout import SIZE as MONITOR_SIZE
from ehadiag.monitor.prepare import PLAN_SETTINGS, PLAN_SIZE, prepare
from ehadiag.onboard.bounded import bounded_step, invert
from ehadiag.onboard.elementary import normal_below
from ehadiag.onboard.layout import (
    ELITE,
    GENERATOR,
    GENES,
    GRADIENT,
    LANES,
    MEAN,
    MONITORS,
    NORMAL,
    PARAMETERS,
    POINT,
    POPULATION,
    SAMPLES,
    SCRATCH,
    SIZE,
    SPREAD,
    TRIAL,
    UNIT,
    Advance,
    Outcome,
    advance_of,
    keep_advance,
    keep_outcome,
    outcome_of,
)

__all__ = ["begin_identification", "identify_some"]

Array = NDArray[np.float64]

GRID = 5
"""Values of Kintas and of FSS on the first grid."""
JACK_GRID = 9
"""Values of FDJ on the second."""
WIDE = 0.15
"""Deviation with which the genetic search begins."""
GENERATIONS = 40
VIRTUAL_POPULATION = 42.0
TOLERANCE = 1e-4
FAR_CAP, NEAR_CAP = 1e4, 100.0
"""The same while the model runs free: in the first approximation, in the search."""
CAP = 9.0
"""Largest square of one residual that counts."""
STEP = 5e-5
"""Half-width of the differences."""
KINK = 0.3
"""Two-sided differences that disagree by more (in units of noise) mark a break-away."""
ITERATIONS = 16
LEAST_GAIN = 1e-2
LEAST_DAMPING, MOST_DAMPING = 1e-6, 10.0
MOST_OUTLIERS = 0.15
ADVISORY, LIMIT = 0.25, 0.75
"""See `ehadiag.assess.verdict`."""
FALSE_HEALTHY, FAULT_CHANCE = 0.025, 0.5
GRIDS, JACK, SEARCH, REFINEMENT, DONE = 0.0, 1.0, 2.0, 3.0, 4.0
SPOOL_WEIGHT = PLAN_SETTINGS + Settings._fields.index("spool_weight")
PRESSURE_WEIGHT = PLAN_SETTINGS + Settings._fields.index("pressure_weight")
ANCHOR_SMALL = SETTINGS + Settings._fields.index("anchor_small")
ANCHOR_LARGE = SETTINGS + Settings._fields.index("anchor_large")
LEAST_REST = 20.0


@brief_kernel
def begin_identification(address: int, plan_address: int, unit_address: int) -> int:
    """Begin an identification; the unit's severities and offsets are where the offsets start.

    Parameters
    ----------
    address : int
        Of the SIZE numbers of `ehadiag.onboard.layout`.
    plan_address : int
        Of a monitor's plan.
    unit_address : int
        Of the numbers of a `Unit`: viscosity, supply and kind of the commands hold.

    Returns
    -------
    int
        0; 1: a number of the unit is out of its range.
    """
    p, unit = array_at(address, (SIZE,)), array_at(unit_address, (8,))
    if prepare(address + NUMBER * LANES, plan_address, unit_address) != 0:
        return 1
    for i in range(LANES):
        p[i] = 0.0
    for i in range(8):
        p[UNIT + i] = unit[i]
    keep_advance(p, Advance(GRIDS, 0.0, math.inf, LEAST_DAMPING))
    p[POINT + 2] = 0.3
    for i in range(GENES):
        p[TRIAL + i] = p[POINT + i]
    return 0


@brief_kernel
def identify_some(
    address: int, plan_address: int, ticks_address: int, amounts: tuple[float, float]
) -> int:
    """Go on with an identification for at least so many runs of the model, or to its end.

    Parameters
    ----------
    address : int
        Of an identification that was begun.
    plan_address : int
        Of the plan that it was begun with.
    ticks_address : int
        Of the recorded test, five numbers a tick, the same in every call.
    amounts : tuple[float, float]
        Ticks of the recording, at least 100 and at most 1e6; runs of the model.

    Returns
    -------
    int
        0: done; 1: to be gone on with; 2: an amount is out of its range.
    """
    if not (100.0 <= amounts[0] <= 1e6 and amounts[1] >= 1.0):
        return 2
    p, plan = array_at(address, (SIZE,)), array_at(plan_address, (PLAN_SIZE,))
    count = int(amounts[0])
    ticks = array_at(ticks_address, (count, 5))
    until = p[12] + amounts[1]
    while p[12] < until:
        a = advance_of(p)
        if a.phase == GRIDS and a.steps == 0.0:
            _take_offsets(p, plan, ticks, count)
        if a.phase in (GRIDS, JACK):
            _approximate(address, plan_address, plan, ticks_address, count)
        elif a.phase == SEARCH:
            _search(address, plan_address, plan, ticks_address, count)
        elif a.phase == REFINEMENT:
            _refine(address, plan_address, plan, ticks_address, count)
        else:
            break
    return 0 if advance_of(p).phase == DONE else 1


@inlined_exact
def _vector(address: int, place: int) -> Array:
    return array_at(address + NUMBER * place, (PARAMETERS,))


@inlined_exact
def _take_offsets(p: Array, plan: Array, ticks: Array, count: int) -> None:
    """Take the offsets from what the sensors show while nothing is commanded, if that is long."""
    for channel in range(2):
        total, seen = 0.0, 0.0
        for k in range(count):
            if ticks[k, 0] != 0.0:
                break
            value = ticks[k, 2 + channel]
            if math.isfinite(value):
                total += value
                seen += 1.0
        weight = plan[SPOOL_WEIGHT] if channel == 0 else plan[PRESSURE_WEIGHT]
        offset = total / seen * weight if seen >= LEAST_REST else 0.0
        p[POINT + GENES + channel] = p[TRIAL + GENES + channel] = offset


@brief_kernel
def _start_lane(address: int, plan_address: int, plan: Array, lane: int, point: Array) -> int:
    """Prepare a model at a point."""
    unit = array_at(address + NUMBER * UNIT, (8,))
    for i in range(GENES):
        unit[i] = min(max(point[i], 0.0), 1.0)
    unit[3] = point[3] / plan[SPOOL_WEIGHT]
    unit[4] = point[4] / plan[PRESSURE_WEIGHT]
    place = address + NUMBER * (LANES + lane * MONITOR_SIZE)
    return int(prepare(place, plan_address, address + NUMBER * UNIT))


@brief_kernel
def _run(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int, point: Array,
    anchored: bool, cap: float,
) -> tuple[float, float]:  # fmt: skip
    """Run the model once at a point: capped sums of squares of spool and pressure."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    _start_lane(address, plan_address, plan, 0, point)
    place = address + NUMBER * LANES
    lane = array_at(place, (MONITOR_SIZE,))
    if not anchored:
        lane[ANCHOR_SMALL] = lane[ANCHOR_LARGE] = math.inf
    spool, pressure = 0.0, 0.0
    for k in range(count):
        push_tick(place, (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]))
        a, b = lane[RESIDUAL], lane[RESIDUAL + 1]
        if math.isfinite(a):
            spool += min(a * a, cap)
        if math.isfinite(b):
            pressure += min(b * b, cap)
    p[12] += 1.0
    return spool, pressure


@brief_kernel
def _approximate(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int
) -> None:
    """One run of the first approximation."""
    p = array_at(address, (SIZE,))
    point, trial = _vector(address, POINT), _vector(address, TRIAL)
    a = advance_of(p)
    k = int(a.steps)
    if a.phase == GRIDS:
        trial[0], trial[1] = (k // GRID) / (GRID - 1), (k % GRID) / (GRID - 1)
    else:
        trial[2] = k / (JACK_GRID - 1)
    spool, pressure = _run(address, plan_address, plan, ticks_address, count, trial, False, FAR_CAP)
    cost = spool if a.phase == GRIDS else pressure
    best = a.best
    if cost < best:
        best = cost
        for i in range(GENES):
            point[i] = trial[i]
    phase, done = a.phase, a.steps + 1.0
    if phase == GRIDS and done == GRID * GRID:
        phase, done, best = JACK, 0.0, math.inf
        trial[0], trial[1] = point[0], point[1]
    elif phase == JACK and done == JACK_GRID:
        phase, done, best = SEARCH, 0.0, math.inf
        for i in range(GENES):
            p[MEAN + i] = p[ELITE + i] = point[i]
            p[SPREAD + i] = WIDE
        p[GENERATOR] = math.inf
        p[GENERATOR + 1] = 0.0
    keep_advance(p, Advance(phase, done, best, a.damping))


@brief_kernel
def _search(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """One run of the genetic search; a generation is drawn before its first, learnt from after."""
    p = array_at(address, (SIZE,))
    a = advance_of(p)
    state = CompactGaState(
        array_at(address + NUMBER * MEAN, (GENES,)),
        array_at(address + NUMBER * SPREAD, (GENES,)),
        array_at(address + NUMBER * ELITE, (GENES,)),
        array_at(address + NUMBER * GENERATOR, (1,)),
        array_at(address + NUMBER * (GENERATOR + 1), (1,)).view(np.uint64),
    )
    population = array_at(address + NUMBER * POPULATION, (SAMPLES, GENES))
    costs = array_at(address + NUMBER * (POPULATION + SAMPLES * GENES), (SAMPLES,))
    trial = _vector(address, TRIAL)
    k = int(a.steps) % SAMPLES
    if k == 0:
        draw(state, population)
        if a.steps == 0.0:
            for i in range(GENES):
                population[0, i] = p[POINT + i]
    for i in range(GENES):
        trial[i] = population[k, i]
    spool, pressure = _run(
        address, plan_address, plan, ticks_address, count, trial, False, NEAR_CAP
    )
    costs[k] = spool + pressure
    done, phase = a.steps + 1.0, a.phase
    if k == SAMPLES - 1:
        before = array_at(address + NUMBER * (LANES - GENES), (GENES,))
        learn_from(state, population, costs, VIRTUAL_POPULATION, TOLERANCE, before)
        narrow = max(p[SPREAD], p[SPREAD + 1], p[SPREAD + 2]) <= TOLERANCE
        if narrow or done >= GENERATIONS * SAMPLES:
            phase, done = REFINEMENT, 0.0
            for i in range(GENES):
                trial[i] = min(max(p[ELITE + i], STEP), 1.0 - STEP)
    keep_advance(p, Advance(phase, done, math.inf if phase != a.phase else a.best, a.damping))


@brief_kernel
def _derive(
    address: int, plan_address: int, plan: Array, ticks_address: int, count: int
) -> tuple[float, float, float]:
    """Normal matrix and gradient at the trial: cost, residuals, and those beyond the cap."""
    p, ticks = array_at(address, (SIZE,)), array_at(ticks_address, (count, 5))
    trial = _vector(address, TRIAL)
    normal = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    gradient = _vector(address, SCRATCH + PARAMETERS * PARAMETERS)
    slope = _vector(address, SCRATCH + PARAMETERS * (PARAMETERS + 1))
    for i in range(PARAMETERS):
        gradient[i] = 0.0
        for j in range(PARAMETERS):
            normal[i, j] = 0.0
    for lane in range(MONITORS):
        which, side = (lane - 1) // 2, STEP if lane % 2 == 1 else -STEP
        if lane > 0:
            kept = trial[which]
            trial[which] = kept + side
            _start_lane(address, plan_address, plan, lane, trial)
            trial[which] = kept
        else:
            _start_lane(address, plan_address, plan, lane, trial)
    cost, samples, beyond = 0.0, 0.0, 0.0
    for k in range(count):
        sample = (ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4])
        for lane in range(MONITORS):
            push_tick(address + NUMBER * (LANES + lane * MONITOR_SIZE), sample)
        for channel in range(2):
            at = LANES + RESIDUAL + channel
            r = p[at]
            if not math.isfinite(r):
                continue
            samples += 1.0
            cost += min(r * r, CAP)
            smooth = r * r < CAP
            if not smooth:
                beyond += 1.0
            for i in range(PARAMETERS):
                up = p[at + (1 + 2 * i) * MONITOR_SIZE]
                down = p[at + (2 + 2 * i) * MONITOR_SIZE]
                if not abs(up - r - (r - down)) <= KINK:
                    smooth = False
                slope[i] = (up - down) / (2.0 * STEP)
            if smooth:
                for i in range(PARAMETERS):
                    gradient[i] += slope[i] * r
                    for j in range(PARAMETERS):
                        normal[i, j] += slope[i] * slope[j]
    p[12] += float(MONITORS)
    return cost, samples, beyond


@brief_kernel
def _refine(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """One step of the refinement: derivatives at the trial, and the next trial."""
    p = array_at(address, (SIZE,))
    a = advance_of(p)
    point, trial = _vector(address, POINT), _vector(address, TRIAL)
    cost, samples, beyond = _derive(address, plan_address, plan, ticks_address, count)
    best, damping, done = a.best, a.damping, a.steps + 1.0
    ended = False
    if cost < best:
        ended = best - cost < LEAST_GAIN
        best, damping = cost, max(damping / 10.0, LEAST_DAMPING)
        for i in range(PARAMETERS):
            point[i] = trial[i]
        for i in range(PARAMETERS * (PARAMETERS + 1)):
            p[NORMAL + i] = p[SCRATCH + i]
        o = outcome_of(p)
        keep_outcome(
            p,
            Outcome(
                point[0], point[1], point[2], 0.0, 0.0, 0.0,
                point[3] / plan[SPOOL_WEIGHT], point[4] / plan[PRESSURE_WEIGHT],
                0.0, cost, samples, beyond / max(samples, 1.0), o.runs, 0.0,
            ),
        )  # fmt: skip
    else:
        ended = damping >= MOST_DAMPING
        damping = max(100.0 * damping, 0.1)
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    gradient = _vector(address, GRADIENT)
    matrix = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    step = _vector(address, SCRATCH + PARAMETERS * PARAMETERS)
    sound = bounded_step(
        point, normal, gradient, damping, GENES, STEP, 1.0 - STEP, matrix, step, trial
    )
    phase = REFINEMENT
    if ended or not sound or done >= ITERATIONS:
        phase = DONE
        _conclude(address, ended)
    keep_advance(p, Advance(phase, done, best, damping))


@brief_kernel
def _conclude(address: int, converged: bool) -> None:
    """Deviations and verdict."""
    p = array_at(address, (SIZE,))
    normal = array_at(address + NUMBER * NORMAL, (PARAMETERS, PARAMETERS))
    matrix = array_at(address + NUMBER * SCRATCH, (PARAMETERS, PARAMETERS))
    column = _vector(address, SCRATCH + PARAMETERS * PARAMETERS)
    o = outcome_of(p)
    excess = max(1.0, o.cost / max(o.samples - PARAMETERS, 1.0))
    known = o.outliers <= MOST_OUTLIERS and o.samples > 0.0
    above, at_limit, blind = 0.0, False, False
    for i in range(GENES):
        variance = invert(normal, i, matrix, column) * excess
        if not variance > 0.0:
            known = False
        std = math.sqrt(variance) if variance > 0.0 else 0.0
        p[GENES + i] = std
        if std > 0.0:
            at_limit = at_limit or _chance_above(p[i], std, LIMIT) >= FAULT_CHANCE
            above += _chance_above(p[i], std, ADVISORY)
            low, high = p[i] - 1.96 * std, p[i] + 1.96 * std
            blind = blind or (low < ADVISORY and high > LIMIT)
    verdict = 0.0
    if not known:
        verdict = 30.0
    elif at_limit:
        verdict = 20.0
    elif blind:
        verdict = 30.0
    elif above > FALSE_HEALTHY:
        verdict = 10.0
    p[8] = verdict
    p[13] = 1.0 if converged else 0.0


@inlined_exact
def _chance_above(value: float, std: float, level: float) -> float:
    """Chance that a severity is at or above a level: of a normal density within 0 … 1."""
    low = normal_below(-value / std)
    at = normal_below((level - value) / std)
    high = normal_below((1.0 - value) / std)
    if high > low:
        return (high - at) / (high - low)
    return 1.0 if value >= level else 0.0
