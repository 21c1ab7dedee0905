"""Search of the on-board identification: models side by side, grids, genetic search, noise.

A pass advances seven models over windows of the recording, tick by tick. It may stop after any
tick: its sums are in the memory (`onboard_memory`). The jack's severity is searched with the jack
alone, driven by the measured spool, as in `ehadiag.identify.staged_search`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from ehadiag.compile.elementary import logarithm
from ehadiag.compile.jit import Array, bare_kernel, inlined_exact, merged
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.core.criteria import ESTIMATION, FIT, REFINEMENT
from ehadiag.identify.compact_ga import CompactGaState, draw_generation, update_state
from ehadiag.identify.residual_lines import line_along
from ehadiag.identify.staged_search import SEARCH_STAGES
from ehadiag.model.plant import PLANT_FIELDS
from ehadiag.model.sensors import read_pressure
from ehadiag.model.simd_jack import drive_jacks
from ehadiag.model.simd_layout import BLOCK, ROWS, block_part, sensor_law_of_lane
from ehadiag.monitor.monitor_memory import (
    MONITOR,
    MONITOR_PLAN_SETTINGS,
    MONITOR_SIZE,
    MONITOR_UNIT_SIZE,
    MonitorSettings,
    control_law_of,
    model_at,
    prepare_monitor_by,
    reset_monitor,
)
from ehadiag.monitor.push_kernel import push_tick
from ehadiag.onboard.onboard_memory import (
    HISTOGRAM_BINS,
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_MODELS,
    ONBOARD_PARAMETERS,
    ONBOARD_PLAN_SIZE,
    ONBOARD_UNKNOWNS,
    PLAN_DIRECTIONS,
    UNIT_PRESSURE_OFFSET,
    UNIT_SPOOL_OFFSET,
    UNIT_SUPPLY,
    UNIT_VISCOSITY,
    verdict_rules_of,
)

PLAN_SPOOL_WEIGHT = MONITOR_PLAN_SETTINGS + MonitorSettings._fields.index("spool_weight")
PLAN_PRESSURE_WEIGHT = MONITOR_PLAN_SETTINGS + MonitorSettings._fields.index("pressure_weight")
"""Places of the reciprocal noise in the plan."""
ANCHOR_SMALL_PLACE = MONITOR.settings + MonitorSettings._fields.index("anchor_small")
ANCHOR_LARGE_PLACE = MONITOR.settings + MonitorSettings._fields.index("anchor_large")
HALVINGS_PLACE = MONITOR.settings + MonitorSettings._fields.index("halvings")
KINTAS, FSS, FDJ = range(ONBOARD_GENES)
"""Places of the severities."""


class SeverityGrid(NamedTuple):
    """One grid of the first approximation."""

    severity: int
    half: float
    """Half of its range about the best point so far, 1."""
    passes: int
    """Passes of seven points each."""


GRIDS: Final = (
    SeverityGrid(FDJ, 1.0, 2), SeverityGrid(FDJ, 0.08, 1), SeverityGrid(FDJ, 0.027, 1),
    SeverityGrid(KINTAS, 1.0, 4), SeverityGrid(KINTAS, 0.04, 1), SeverityGrid(FSS, 1.0, 4),
    SeverityGrid(KINTAS, 0.2, 2), SeverityGrid(KINTAS, 0.03, 1), SeverityGrid(FSS, 0.06, 2),
    SeverityGrid(KINTAS, 0.06, 1), SeverityGrid(KINTAS, 0.02, 1), SeverityGrid(FSS, 0.02, 1),
)  # fmt: skip
"""The three searches of `ehadiag.identify.staged_search`, as fine as the refinement needs."""
GRID_SEVERITIES = tuple(item.severity for item in GRIDS)
GRID_HALVES = tuple(item.half for item in GRIDS)
GRID_PASSES = tuple(item.passes for item in GRIDS)


class OnboardSearchRules(NamedTuple):
    """Histograms and genetic search on board."""

    histogram_range: float = 12.0
    """Range of the histograms, in units of the plan's noise; what lies beyond counts as at the
    end."""
    min_noise: float = 0.5
    """Least noise, in units of the plan's: a converter's rounding alone makes more."""
    min_rest_samples: float = float(ESTIMATION.min_samples)
    """Least number of samples at rest from which an offset is taken, 1."""
    most_held: float = 20.0
    """Distance of the spool at rest from its mean in closed loop, in units of the plan's noise,
    from which on it is held beside its middle: of seven units the mean was within 9 of the offset,
    and a spool that was held up to 230 off."""
    run_in_s: float = SEARCH_STAGES.run_in_s
    """Run-in before a window, s."""
    std: float = 0.4
    """Standard deviation of a severity at the start of the genetic search, 1: that of the last
    attempt in `ehadiag.identify`."""
    generations: int = 40
    """Largest number of generations, 1."""
    virtual_population: float = 42.0
    """Size of the population that the probability vector stands for, 1."""
    tolerance: float = 1e-4
    """Standard deviation of the severities at convergence, 1."""
    cap: float = SEARCH_STAGES.spool_cap
    """Largest square of one residual, in variances, where the model runs free."""
    noise_cost: float = FIT.expected_cauchy_cost
    """Mean of Cauchy's cost of noise, 1."""


SEARCH = OnboardSearchRules()
CENTRE_BEST, CENTRE_PLACE, CENTRE_LEFT, CENTRE_RIGHT, CENTRE_LAST, CENTRE_BEFORE = range(
    ONBOARD.centre + ONBOARD_GENES, ONBOARD.centre + ONBOARD_GENES + 6
)
"""Places of a grid's lowest cost, of the severity there, of the costs of the points before and
behind it, of the cost of the last point, and of whether the last point had the lowest."""
COSTS = ONBOARD.population + ONBOARD_MODELS * ONBOARD_GENES
"""Place of the costs of all models."""


@merged
def parameters_at(address: int, place: int) -> Array:
    """Return one number for each parameter, from a place of the memory on."""
    return array_at(address + BYTES_PER_NUMBER * place, (ONBOARD_PARAMETERS,))


@merged
def unknowns_at(address: int, place: int) -> Array:
    """Return one number for each unknown, from a place of the memory on."""
    return array_at(address + BYTES_PER_NUMBER * place, (ONBOARD_UNKNOWNS,))


@inlined_exact
def monitor_at(address: int, lane: int) -> int:
    """Address of a model."""
    return address + BYTES_PER_NUMBER * (ONBOARD.monitors + lane * MONITOR_SIZE)


@inlined_exact
def start_model(address: int, plan_address: int, plan: Array, lane: int, point: Array) -> int:
    """Prepare a model at a point."""
    constants = identified_constants(plan_address, plan)
    return int(start_model_by(address, constants, plan_address, plan, lane, point))


@inlined_exact
def identified_constants(plan_address: int, plan: Array) -> int:
    """Address of the constants of the identification; behind the plan if exponents have a range."""
    if not verdict_rules_of(plan).exponents > 0.0:
        return plan_address
    behind = ONBOARD_PLAN_SIZE + int(plan[PLAN_DIRECTIONS]) * PLANT_FIELDS
    return plan_address + BYTES_PER_NUMBER * behind


@bare_kernel
def start_model_by(
    address: int, constants_address: int, plan_address: int, plan: Array, lane: int, point: Array
) -> int:
    """Prepare a model at a point, by other constants than the plan's."""
    unit = array_at(address + BYTES_PER_NUMBER * ONBOARD.unit, (MONITOR_UNIT_SIZE,))
    for i in range(ONBOARD_GENES):
        unit[i] = min(max(point[i], 0.0), 1.0)
    unit[UNIT_SPOOL_OFFSET] = point[ONBOARD_GENES] / plan[PLAN_SPOOL_WEIGHT]
    unit[UNIT_PRESSURE_OFFSET] = point[ONBOARD_GENES + 1] / plan[PLAN_PRESSURE_WEIGHT]
    viscosity, supply, rules = unit[UNIT_VISCOSITY], unit[UNIT_SUPPLY], verdict_rules_of(plan)
    unit[UNIT_VISCOSITY] = viscosity * (1.0 + rules.viscosity_std * point[ONBOARD_PARAMETERS])
    unit[UNIT_SUPPLY] = supply + rules.supply_std * point[ONBOARD_PARAMETERS + 1]
    state = address + BYTES_PER_NUMBER * ONBOARD.unit
    model = monitor_at(address, lane)
    wrong = int(prepare_monitor_by(model, constants_address, plan_address, state))
    unit[UNIT_VISCOSITY], unit[UNIT_SUPPLY] = viscosity, supply
    array_at(model, (MONITOR_SIZE,))[HALVINGS_PLACE] = 1.0
    return wrong


@inlined_exact
def loosen_anchor(address: int, lane: int, factor: float) -> None:
    """Multiply the spool errors beyond which a model is re-anchored; math.inf: it never is."""
    numbers = array_at(monitor_at(address, lane), (MONITOR_SIZE,))
    numbers[ANCHOR_SMALL_PLACE] *= factor
    numbers[ANCHOR_LARGE_PLACE] *= factor


@bare_kernel
def start_models(
    address: int, plan_address: int, plan: Array, point: Array, trial: Array, along: Array
) -> None:
    """Prepare a model at a point, and two on each severity's axis through it.

    trial: overwritten by the mean of all points; along, shape (ONBOARD_GENES, 3): places on the
    axes, from the mean of the three.
    """
    p = array_at(address, (ONBOARD.end,))
    for i in range(ONBOARD_UNKNOWNS):
        trial[i] = point[i]
    start_model(address, plan_address, plan, 0, trial)
    for i in range(ONBOARD_GENES):
        width = 0.0
        for j in range(ONBOARD_GENES):
            width += p[ONBOARD.density + i * ONBOARD_GENES + j] ** 2
        width = math.sqrt(REFINEMENT.cross_variances * width)
        above, below = min(width, 1.0 - point[i]), min(width, point[i])
        if below < REFINEMENT.min_bound_distance * width:
            below = -0.5 * above
        elif above < REFINEMENT.min_bound_distance * width:
            above = -0.5 * below
        trial[i] = point[i] + above
        start_model(address, plan_address, plan, 1 + 2 * i, trial)
        trial[i] = point[i] - below
        start_model(address, plan_address, plan, 2 + 2 * i, trial)
        trial[i] = point[i]
        middle = (above - below) / 3.0
        along[i, 0], along[i, 1], along[i, 2] = -middle, above - middle, -below - middle
    for i in range(ONBOARD_GENES):
        trial[i] += 3.0 * -along[i, 0] / ONBOARD_MODELS
    for lane in range(ONBOARD_MODELS):
        loosen_anchor(address, lane, p[ONBOARD.noise])


@bare_kernel
def push_models(address: int, ticks: Array, k: int) -> int:
    """Advance all models by tick k."""
    sample = ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]
    for lane in range(ONBOARD_MODELS):
        push_tick(monitor_at(address, lane), sample)
    return 0


@bare_kernel
def push_first_model(address: int, ticks: Array, k: int) -> int:
    """Advance the first model by tick k."""
    sample = ticks[k, 0], ticks[k, 1], ticks[k, 2], ticks[k, 3], ticks[k, 4]
    return int(push_tick(monitor_at(address, 0), sample))


@inlined_exact
def fitted_lines(p: Array, channel: int, along: Array, slope: Array) -> tuple[float, float]:
    """Mean residual of a channel (0 spool, 1 pressure) at all points, and scatter about its lines.

    p: numbers of the identification, its models advanced; along: see `start_models`; slope:
    overwritten by the slopes, in units of the noise.
    """
    noise, at = p[ONBOARD.noise + channel], ONBOARD.monitors + MONITOR.residual + channel
    middle = p[at] / noise
    total, scatter = 0.0, 0.0
    for i in range(ONBOARD_GENES):
        above = p[at + (1 + 2 * i) * MONITOR_SIZE] / noise - middle
        below = p[at + (2 + 2 * i) * MONITOR_SIZE] / noise - middle
        total += above + below
        slope[i], part = line_along(along[i, 0], along[i, 1], along[i, 2], above, below)
        scatter += part
    slope[ONBOARD_GENES] = slope[ONBOARD_GENES + 1] = 0.0
    slope[ONBOARD_GENES + channel] = -1.0 / noise
    return middle + total / ONBOARD_MODELS, scatter / ONBOARD_GENES


ROOT_OF_SIX = math.sqrt(6.0)
"""Deviation of a second difference of white noise of deviation 1."""


@inlined_exact
def clear_histograms(p: Array) -> None:
    """Begin to count."""
    for i in range(4 * HISTOGRAM_BINS):
        p[ONBOARD.histograms + i] = 0.0


LARGEST_SECOND_DIFFERENCE: Final = ROOT_OF_SIX * SEARCH.histogram_range
"""Largest second difference of residuals that a histogram holds, in units of the plan's noise."""


@inlined_exact
def count_residual(p: Array, channel: int, now: float, before: float, earlier: float) -> None:
    """Count a residual and its second difference, in units of the plan's noise; NaN counts not."""
    if math.isfinite(now):
        place = min(
            max(
                (now + SEARCH.histogram_range) * (HISTOGRAM_BINS / (2.0 * SEARCH.histogram_range)),
                0.0,
            ),
            HISTOGRAM_BINS - 1.0,
        )
        p[ONBOARD.histograms + channel * HISTOGRAM_BINS + int(place)] += 1.0
    second = abs(now - 2.0 * before + earlier)
    if math.isfinite(second):
        place = min(second * (HISTOGRAM_BINS / LARGEST_SECOND_DIFFERENCE), HISTOGRAM_BINS - 1.0)
        p[ONBOARD.histograms + (2 + channel) * HISTOGRAM_BINS + int(place)] += 1.0


@inlined_exact
def shown_noise(p: Array, channel: int) -> float:
    """Noise, by the second differences without their largest 2 %, in units of the plan's."""
    total, seen, mean = 0.0, 0.0, 0.0
    first = ONBOARD.histograms + (2 + channel) * HISTOGRAM_BINS
    for i in range(HISTOGRAM_BINS):
        total += p[first + i]
    if total < 1.0:
        return 1.0
    for i in range(HISTOGRAM_BINS):
        taken = min(p[first + i], ESTIMATION.noise_kept_share * total - seen)
        if taken > 0.0:
            # Of a bin that is cut the lower part is taken.
            share = taken / p[first + i]
            mean += (
                taken * (i + 0.5 * share) * (ROOT_OF_SIX * SEARCH.histogram_range / HISTOGRAM_BINS)
            )
            seen += taken
    return max(mean / (seen * ESTIMATION.noise_kept_mean * ROOT_OF_SIX), SEARCH.min_noise)


@inlined_exact
def shown_excess(p: Array, channel: int, differences: float) -> float:
    """Cost of the residuals over that of noise, see `ehadiag.identify.estimates.excess_cost`.

    differences: sum of the residuals' second differences, capped as in the histogram. It corrects
    the histogram's noise, a few percent off where a converter's steps miss the bins' middles.
    """
    total, cost, binned = 0.0, 0.0, 0.0
    width = 2.0 * SEARCH.histogram_range / HISTOGRAM_BINS
    for i in range(HISTOGRAM_BINS):
        binned += p[ONBOARD.histograms + (2 + channel) * HISTOGRAM_BINS + i] * (i + 0.5)
    binned *= ROOT_OF_SIX * SEARCH.histogram_range / HISTOGRAM_BINS
    scale = ESTIMATION.cauchy_scale * shown_noise(p, channel) * differences / max(binned, 1.0)
    if not scale > 0.0:
        return 1.0
    for i in range(HISTOGRAM_BINS):
        share = ((i + 0.5) * width - SEARCH.histogram_range) / scale
        samples = p[ONBOARD.histograms + channel * HISTOGRAM_BINS + i]
        total += samples
        cost += samples * logarithm(1.0 + share * share)
    return ESTIMATION.cauchy_scale**2 / SEARCH.noise_cost * cost / max(total, 1.0)


@inlined_exact
def _median(p: Array, channel: int) -> float:
    """Median of the residuals, in units of the plan's noise."""
    total, seen = 0.0, 0.0
    first = ONBOARD.histograms + channel * HISTOGRAM_BINS
    for i in range(HISTOGRAM_BINS):
        total += p[first + i]
    for i in range(HISTOGRAM_BINS):
        if seen + p[first + i] >= 0.5 * total and total > 0.0:
            share = (0.5 * total - seen) / p[first + i]
            return (i + share) * (
                2.0 * SEARCH.histogram_range / HISTOGRAM_BINS
            ) - SEARCH.histogram_range
        seen += p[first + i]
    return 0.0


@inlined_exact
def grid_point(p: Array, grid: int, index: int) -> float:
    """A point of a grid."""
    centre, half = p[ONBOARD.centre + GRID_SEVERITIES[grid]], GRID_HALVES[grid]
    low, high = max(centre - half, 0.0), min(centre + half, 1.0)
    return low + (high - low) * index / (GRID_PASSES[grid] * ONBOARD_MODELS - 1.0)


@bare_kernel
def start_grid(address: int, plan_address: int, plan: Array, grid: int, done: int) -> None:
    """Prepare all models at the next points of a grid; done: its passes so far."""
    p, trial = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.trial)
    severity = GRID_SEVERITIES[grid]
    if done == 0:
        p[CENTRE_BEST] = p[CENTRE_LEFT] = p[CENTRE_RIGHT] = p[CENTRE_LAST] = math.inf
        p[CENTRE_BEFORE] = 0.0
    for i in range(ONBOARD_UNKNOWNS):
        trial[i] = p[ONBOARD.centre + i] if i < ONBOARD_GENES else p[ONBOARD.point + i]
    for lane in range(ONBOARD_MODELS):
        trial[severity] = grid_point(p, grid, done * ONBOARD_MODELS + lane)
        start_model(address, plan_address, plan, lane, trial)
        if severity == KINTAS:
            loosen_anchor(address, lane, math.inf)
        p[COSTS + lane] = 0.0


@inlined_exact
def begin_window(address: int, spool: float) -> None:
    """Restart all models from rest; spool: their spool's position, m."""
    for lane in range(ONBOARD_MODELS):
        reset_monitor(monitor_at(address, lane), spool)


@inlined_exact
def next_spool(ticks: Array, k: int, end: int, before: float) -> float:
    """Spool at the end of a tick, as measured; a lost sample is interpolated to the next one."""
    ahead = k
    while ahead < end and not math.isfinite(ticks[ahead, 2]):
        ahead += 1
    if ahead == end:
        return before
    return before + (ticks[ahead, 2] - before) / (ahead - k + 1)


@bare_kernel
def drive_models(address: int, plan: Array, spool: float, before: float, pressure: float) -> None:
    """Advance the jacks of all models by a tick of the measured spool, and add to their costs."""
    costs = array_at(address + BYTES_PER_NUMBER * COSTS, (ONBOARD_MODELS,))
    for lane in range(ONBOARD_MODELS):
        place = monitor_at(address, lane)
        tick, model = control_law_of(array_at(place, (MONITOR.model,))).tick, model_at(place)
        rate = (spool - before) / tick
        drive_jacks(model, 1, tick, before, spool, rate, rate)
        shown = read_pressure(
            sensor_law_of_lane(block_part(model, BLOCK.coefficients, BLOCK.moving), 0),
            block_part(model, BLOCK.state, BLOCK.path)[ROWS.pressure_sampled],
        )
        residual = (pressure - shown) * plan[PLAN_PRESSURE_WEIGHT]
        if math.isfinite(residual):
            costs[lane] += min(residual * residual, SEARCH_STAGES.pressure_cap)


@bare_kernel
def add_costs(address: int, spool_cap: float, pressure_cap: float) -> None:
    """Add the squares of the models' residuals, capped, to their costs; no pressure at cap 0."""
    p = array_at(address, (ONBOARD.end,))
    for lane in range(ONBOARD_MODELS):
        at = ONBOARD.monitors + lane * MONITOR_SIZE + MONITOR.residual
        if math.isfinite(p[at]):
            p[COSTS + lane] += min(p[at] * p[at], spool_cap)
        if pressure_cap > 0.0 and math.isfinite(p[at + 1]):
            p[COSTS + lane] += min(p[at + 1] * p[at + 1], pressure_cap)


@bare_kernel
def end_grid(address: int, grid: int, done: int) -> bool:
    """Take the costs of a pass; True at the grid's end: a parabola's vertex is the new centre."""
    p = array_at(address, (ONBOARD.end,))
    for lane in range(ONBOARD_MODELS):
        cost = p[COSTS + lane]
        if cost < p[CENTRE_BEST]:
            p[CENTRE_BEST], p[CENTRE_LEFT], p[CENTRE_RIGHT] = cost, p[CENTRE_LAST], math.inf
            p[CENTRE_PLACE] = grid_point(p, grid, done * ONBOARD_MODELS + lane)
            p[CENTRE_BEFORE] = 1.0
        elif p[CENTRE_BEFORE] != 0.0:
            p[CENTRE_RIGHT], p[CENTRE_BEFORE] = cost, 0.0
        p[CENTRE_LAST] = cost
    if done + 1 < GRID_PASSES[grid]:
        return False
    bent = p[CENTRE_LEFT] - 2.0 * p[CENTRE_BEST] + p[CENTRE_RIGHT]
    spacing = grid_point(p, grid, 1) - grid_point(p, grid, 0)
    if 0.0 < bent < math.inf:
        p[CENTRE_PLACE] += 0.5 * (p[CENTRE_LEFT] - p[CENTRE_RIGHT]) / bent * spacing
    p[ONBOARD.centre + GRID_SEVERITIES[grid]] = p[CENTRE_PLACE]
    return True


@inlined_exact
def _search_state(address: int) -> CompactGaState:
    return CompactGaState(
        array_at(address + BYTES_PER_NUMBER * ONBOARD.mean, (ONBOARD_GENES,)),
        array_at(address + BYTES_PER_NUMBER * ONBOARD.spread, (ONBOARD_GENES,)),
        array_at(address + BYTES_PER_NUMBER * ONBOARD.elite, (ONBOARD_GENES,)),
        array_at(address + BYTES_PER_NUMBER * ONBOARD.generator, (1,)),
        array_at(address + BYTES_PER_NUMBER * (ONBOARD.generator + 1), (1,)).view(np.uint64),
    )


@bare_kernel
def start_generation(address: int, plan_address: int, plan: Array, generation: int) -> None:
    """Draw a generation and prepare its models; the first about the best point."""
    p, trial = array_at(address, (ONBOARD.end,)), unknowns_at(address, ONBOARD.trial)
    population = array_at(
        address + BYTES_PER_NUMBER * ONBOARD.population, (ONBOARD_MODELS, ONBOARD_GENES)
    )
    if generation == 0:
        for i in range(ONBOARD_GENES):
            p[ONBOARD.mean + i] = p[ONBOARD.elite + i] = p[ONBOARD.point + i]
            p[ONBOARD.spread + i] = SEARCH.std
        p[ONBOARD.generator], p[ONBOARD.generator + 1] = math.inf, 0.0
    draw_generation(_search_state(address), population)
    for lane in range(ONBOARD_MODELS):
        for i in range(ONBOARD_UNKNOWNS):
            trial[i] = p[ONBOARD.point + i]
        for i in range(ONBOARD_GENES):
            if generation == 0 and lane == 0:
                population[0, i] = trial[i]
            trial[i] = population[lane, i]
        start_model(address, plan_address, plan, lane, trial)
        loosen_anchor(address, lane, math.inf)
        p[COSTS + lane] = 0.0


@bare_kernel
def end_generation(address: int, generation: int) -> bool:
    """Learn from a generation; True after the last one: its elite is now the best point."""
    p = array_at(address, (ONBOARD.end,))
    update_state(
        _search_state(address),
        array_at(address + BYTES_PER_NUMBER * ONBOARD.population, (ONBOARD_MODELS, ONBOARD_GENES)),
        array_at(address + BYTES_PER_NUMBER * COSTS, (ONBOARD_MODELS,)),
        SEARCH.virtual_population,
        SEARCH.tolerance,
        array_at(address + BYTES_PER_NUMBER * ONBOARD.before, (ONBOARD_GENES,)),
    )
    widest = max(p[ONBOARD.spread], p[ONBOARD.spread + 1], p[ONBOARD.spread + 2])
    if widest > SEARCH.tolerance and generation + 1 < SEARCH.generations:
        return False
    for i in range(ONBOARD_GENES):
        p[ONBOARD.point + i] = p[ONBOARD.elite + i]
    return True


@bare_kernel
def start_noise(address: int, plan_address: int, plan: Array) -> None:
    """Prepare the first model at the best point, not re-anchored, to judge noise and offsets."""
    p = array_at(address, (ONBOARD.end,))
    start_model(address, plan_address, plan, 0, unknowns_at(address, ONBOARD.point))
    loosen_anchor(address, 0, math.inf)
    clear_histograms(p)


@bare_kernel
def end_noise(address: int, std: float) -> None:
    """Take noise and offsets from the histograms; std: of the severities about the point."""
    p = array_at(address, (ONBOARD.end,))
    for channel in range(2):
        p[ONBOARD.noise + channel] = shown_noise(p, channel)
        p[ONBOARD.point + ONBOARD_GENES + channel] += _median(p, channel)
    set_density(p, std)


@inlined_exact
def set_density(p: Array, std: float) -> None:
    """Set the refinement's density: each severity has this deviation, none is correlated."""
    for i in range(ONBOARD_GENES):
        for j in range(ONBOARD_GENES):
            p[ONBOARD.density + i * ONBOARD_GENES + j] = std if i == j else 0.0
