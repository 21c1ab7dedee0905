"""Memory of the on-board identification: places of its numbers, rules of its verdict, oil data."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from ehadiag.compile.elementary import exponential, logarithm
from ehadiag.compile.jit import brief_kernel, inlined_exact
from ehadiag.compile.vector import array_at, packer, places, unpacker
from ehadiag.core.criteria import ESTIMATION
from ehadiag.model.plant import WALTHER_POINTS
from ehadiag.monitor.monitor_memory import (
    MONITOR_PLAN_SIZE,
    MONITOR_SIZE,
    MONITOR_UNIT_FIELDS,
    MONITOR_UNIT_SIZE,
    LibraryIdentity,
)

ONBOARD_GENES: Final = 3
"""Severities that are identified on board: Kintas, FSS, FDJ; others stay as given."""
ONBOARD_PARAMETERS: Final = 5
"""Severities, then the offsets of spool and pressure in units of their noise."""
ONBOARD_UNKNOWNS: Final = ONBOARD_PARAMETERS + 2
"""With the oil's viscosity and the supply of the day, in deviations of what the sensors say."""
ONBOARD_MODELS: Final = 1 + 2 * ONBOARD_GENES
"""Models that run side by side: at the point, and two more on each severity's axis through it;
points of a grid, and a generation of the genetic search."""
HISTOGRAM_BINS: Final = 128
"""Of each histogram that noise and offsets are read from."""
MATRIX_SIZE: Final = ONBOARD_PARAMETERS * ONBOARD_PARAMETERS
"""Numbers of a square matrix of all parameters, 1."""
UNKNOWNS_MATRIX_SIZE: Final = ONBOARD_UNKNOWNS * ONBOARD_UNKNOWNS
DIRECTIONS_OF_PASS: Final = ONBOARD_MODELS - 1 - ONBOARD_GENES
"""Directions in which a pass has models off, 1."""


class OnboardOutcome(NamedTuple):
    """What an identification has found; the first members of its memory."""

    Kintas: float
    """Severities, 0 … 1; NaN, like all that is estimated, beside NOT TESTED."""
    FSS: float
    FDJ: float
    std_Kintas: float
    """Their standard deviations."""
    std_FSS: float
    std_FDJ: float
    spool_offset: float
    """Constant error of the spool's sensor, m."""
    pressure_offset: float
    """Constant error of the sensor of differential pressure, Pa."""
    verdict: float
    """0 healthy, 10 degraded, 20 fault, 30 not tested."""
    reasons: float
    """Why it is not tested: a sum of `OnboardReasons`."""
    cost: float
    """Capped sum of squares of the residuals, in units of noise."""
    samples: float
    """Residuals that it is of."""
    outliers: float
    """Share of them beyond three deviations of noise and of the faults' laws."""
    spool_rms: float
    """Rms of the spool's residuals, squares capped, in such deviations."""
    pressure_rms: float
    """The same of the pressure's."""
    runs: float
    """Runs of the model so far: ticks of all models over those of the recording."""
    converged: float
    """Not 0: the refinement came to rest by itself."""


class OnboardReasons(NamedTuple):
    """Reasons of NOT TESTED; a sum of powers of two."""

    length: float = 1.0
    """The recording is not as long as the library's test of these commands."""
    lost: float = 2.0
    """Too many samples are missing, or too many in a row."""
    frozen: float = 4.0
    """Spool or pressure never moves."""
    saturated: float = 8.0
    """Too many samples at an end of a converter."""
    supply: float = 16.0
    """The supply is too low."""
    changed: float = 32.0
    """The recording is not the same in every call."""
    unexplained: float = 64.0
    """The model does not explain the recording."""
    hidden: float = 128.0
    """The test does not show a severity."""
    wide: float = 256.0
    """An interval reaches from below the advisory level to above the limit."""


REASONS = OnboardReasons()


class OnboardProgress(NamedTuple):
    """Places of how far an identification is."""

    phase: int
    """See `OnboardPhases`."""
    stage: int
    """Grid of the first approximation."""
    steps: int
    """Passes over the recording within phase or grid."""
    window: int
    """Window of the pass."""
    tick: int
    """Next tick of the pass; negative: its window is to be begun."""
    ticks: int
    """Ticks of the recording; 0 before the first of them."""
    digest: int
    """Digest of the recording, when it was looked at first."""
    passed: int
    """Digest of the ticks that the pass has seen."""
    spool: int
    """Measured spool at the end of the tick before, m."""
    judged: int
    """How often the noise was judged."""
    settled: int
    """Not 0: the refinement came to rest."""
    attempts: int
    """Searches so far; one more than there are: the best one's optimum is looked at again."""
    score: int
    """Least score of an optimum so far: its cost, comparable where the noise differs."""


class OnboardPhases(NamedTuple):
    """Phases of an identification, see `continue_identification`."""

    recording: float = 0.0
    """Look at the recording: whether it can carry a verdict."""
    grids: float = 1.0
    """Searches of single severities on grids."""
    search: float = 2.0
    """Genetic search, where the refinement did not explain the recording."""
    noise: float = 3.0
    """Judgement of noise and offsets."""
    refinement: float = 4.0
    """Rounds of the refinement."""
    day: float = 5.0
    """A calibrated unit's step with viscosity and supply of the day."""
    conclusion: float = 6.0
    """Whether the optimum explains the recording."""
    last_day: float = 7.0
    """The step of the day about what is judged: unknowns that move together."""
    considered: float = 8.0
    """What it moves by where what is held is off; then standard deviations and verdict."""
    done: float = 9.0
    """Nothing is left to compute."""


PHASES = OnboardPhases()


class OnboardPlaces(NamedTuple):
    """Places of the parts of an identification's memory."""

    outcome: int
    identity: int
    """`LibraryIdentity` of the library that has begun it."""
    progress: int
    unit: int
    """State of the unit in a run."""
    point: int
    """Best point so far."""
    kept: int
    """Point of the best optimum, then its noise and whether it settled."""
    trial: int
    """Mean of the points of a round."""
    centre: int
    """Of the next grid, severities, then the lowest cost on it, and its neighbours' and place."""
    mean: int
    spread: int
    elite: int
    before: int
    generator: int
    """Cost of the elite, then the state of the random numbers."""
    population: int
    """Severities of all models, then their costs."""
    density: int
    """Root of the covariance of the severities."""
    believed: int
    """Variances of the severities that the last round has left."""
    influence: int
    """Columns of the unknowns' covariance that are of the severities."""
    moved: int
    """Shifts of the severities by a deviation of each direction of the pass, then the costs of the
    break-aways that each moves."""
    considered: int
    """Sum of their squares by all directions of what is held but not certain, then the largest of
    those costs."""
    noise: int
    """Noise of spool and pressure as the residuals show it, in units of the plan's."""
    normal: int
    """Normal matrix, then the gradient, or its shift by the instant of sampling."""
    pull: int
    """Gradient of a step of the day."""
    meat: int
    """Covariance of the gradient."""
    slope: int
    along: int
    """Slopes of a residual, and places on the axes that they are of."""
    scores: int
    """Gradients of the last ticks."""
    channels: int
    """Of spool and pressure (and position): what a pass counts, see `ChannelSums`."""
    sums: int
    """What else a pass adds up."""
    histograms: int
    """Of spool and pressure: residuals, then their second differences."""
    scratch: int
    """Matrices and vectors of a step."""
    monitors: int
    end: int


class ChannelSums(NamedTuple):
    """What a pass counts of a channel."""

    last: float
    """Residual of the tick before, and of the one before that."""
    earlier: float
    squares: float
    """Capped squares of residuals; in a look at the recording the sum of its samples."""
    samples: float
    gap: float
    """Ticks without a sample since the last one, and the longest such time."""
    longest: float
    outliers: float
    least: float
    most: float
    """Least and largest sample."""
    cut: float
    """Samples at an end of the converter."""
    rest: float
    """Sum of the samples at rest, and how many they are; in a conclusion the sum of the residuals'
    second differences, whatever their sign."""
    rested: float


CHANNEL_SUMS: Final = len(ChannelSums._fields)
CHANNEL_COUNT: Final = 3
"""Spool, pressure, position."""
CORRELATED_TICKS: Final = ESTIMATION.correlation_lags + 1
"""Ticks over which residuals are correlated, 1."""
SUMS: Final = 8
"""Further sums of a pass, 1."""
ONBOARD: Final = OnboardPlaces(
    *places(OnboardOutcome, LibraryIdentity, OnboardProgress, MONITOR_UNIT_SIZE,
            ONBOARD_UNKNOWNS, ONBOARD_UNKNOWNS + 3, ONBOARD_UNKNOWNS, ONBOARD_GENES + 6,
            ONBOARD_GENES, ONBOARD_GENES, ONBOARD_GENES, ONBOARD_GENES, 2,
            ONBOARD_MODELS * (ONBOARD_GENES + 1), ONBOARD_GENES * ONBOARD_GENES, ONBOARD_GENES,
            ONBOARD_GENES * ONBOARD_UNKNOWNS, DIRECTIONS_OF_PASS * (ONBOARD_GENES + 1),
            ONBOARD_GENES + 1, 2,
            UNKNOWNS_MATRIX_SIZE + ONBOARD_UNKNOWNS, ONBOARD_UNKNOWNS, UNKNOWNS_MATRIX_SIZE,
            ONBOARD_UNKNOWNS, 3 * ONBOARD_GENES,
            CORRELATED_TICKS * ONBOARD_UNKNOWNS, CHANNEL_COUNT * CHANNEL_SUMS, SUMS,
            4 * HISTOGRAM_BINS, 4 * MATRIX_SIZE + 8 * ONBOARD_PARAMETERS,
            ONBOARD_MODELS * MONITOR_SIZE)
)  # fmt: skip
ONBOARD_VERDICT: Final = OnboardOutcome._fields.index("verdict")
ONBOARD_RUNS: Final = OnboardOutcome._fields.index("runs")

outcome_of, keep_outcome = (
    unpacker(OnboardOutcome, ONBOARD.outcome),
    packer(OnboardOutcome, ONBOARD.outcome),
)
PROGRESS: Final = OnboardProgress(
    *range(ONBOARD.progress, ONBOARD.progress + len(OnboardProgress._fields))
)


class VerdictRules(NamedTuple):
    """Limits of `ehadiag diagnose`, as numbers; see `ehadiag.assess` for each."""

    advisory: float
    """Severity from which on a unit is degraded."""
    limit: float
    """… and at fault."""
    false_healthy: float
    """Largest chance of a severity at or above the advisory level for HEALTHY."""
    fault_chance: float
    """Least chance of a severity at or above the limit for FAULT."""
    most_outliers: float
    """Share of residuals beyond three deviations that an explained recording may have."""
    most_rms: float
    """Rms residual that it may have, in units of noise."""
    most_excess: float
    """Excess of the residuals over noise that it may have, 1."""
    search_outliers: float
    """Share of residuals beyond three deviations that needs no further attempt."""
    most_anchored: float
    """Times that the model may be put back on the spool without a further attempt."""
    most_std: float
    """Standard deviation from which on the test does not show a severity."""
    most_lost: float
    """Share of a channel's samples that may be missing."""
    longest_gap: float
    """Ticks without a sample that there may be."""
    most_saturated: float
    """Share of a channel's samples that may stand at its converter's ends."""
    least_supply: float
    """Supply above return, Pa, below which nothing is judged."""
    discrepancy_Kintas: float
    """Deviations of the severities by what no model has."""
    discrepancy_FSS: float
    discrepancy_FDJ: float
    law_Kintas: float
    """Deviations of the severities by wrong laws of the faults, over the severity."""
    law_FSS: float
    law_FDJ: float
    viscosity_std: float
    """Deviations of what is said of oil and supply, relative and Pa: by the sensors of a calibrated
    unit, else by the bus's steps."""
    supply_std: float
    exponents: float
    """Length of the range of exponents of clogging; it is identified with the largest one."""
    first_stage: float
    """Deviation of the clogging by it over the friction with the least one, 1."""
    friction_new: float
    """With a range, the spool's friction as new over that at the limit: severities of friction are
    searched from no friction on."""
    spool_low: float
    """Ends of the converters: m of the spool, Pa of the pressure, m of the jack."""
    spool_high: float
    pressure_low: float
    pressure_high: float
    position_low: float
    position_high: float


PLAN_WINDOWS: Final = 4
"""Windows of a search that a library holds, at most."""
PLAN_SEARCHES: Final = 4
"""Searches with windows of their own: FDJ, Kintas, FSS, genetic search."""
PLAN_TEST_SIZE: Final = 1 + 2 * PLAN_WINDOWS * PLAN_SEARCHES
"""Ticks of a test; first tick and end of the windows of each search, 0 and 0 where there is none.
"""
PLAN_IDENTITY: Final = MONITOR_PLAN_SIZE + len(VerdictRules._fields)
PLAN_TESTS: Final = PLAN_IDENTITY + len(LibraryIdentity._fields)
PLAN_DIRECTIONS: Final = PLAN_TESTS + 2 * PLAN_TEST_SIZE
"""Place of the number of directions in which a calibration may be off; 0: there is none."""
ONBOARD_PLAN_SIZE: Final = PLAN_DIRECTIONS + 1
"""Of a monitor's plan with these rules, an identity and the tests behind it, in open loop first. In
a library the plant's constants a deviation off in each direction follow, PLANT_FIELDS numbers each;
with a range of exponents, then those with which it is identified.
"""
verdict_rules_of = unpacker(VerdictRules, MONITOR_PLAN_SIZE)


UNIT_SPOOL_OFFSET, UNIT_PRESSURE_OFFSET, UNIT_VISCOSITY, UNIT_SUPPLY, UNIT_CLOSED = (
    MONITOR_UNIT_FIELDS.index(name)
    for name in ("spool_offset", "pressure_offset", "viscosity", "supply", "closed")
)
KELVIN_OFFSET = 273.15
"""K, of 0 degC."""
LN10 = math.log(10.0)
(WALTHER_T1, WALTHER_V1), (WALTHER_T2, WALTHER_V2) = WALTHER_POINTS
WALTHER_Y1, WALTHER_Y2 = (
    math.log10(math.log10(WALTHER_V1 + 0.7)),
    math.log10(math.log10(WALTHER_V2 + 0.7)),
)
WALTHER_SLOPE = (WALTHER_Y1 - WALTHER_Y2) / (
    math.log10(WALTHER_T2 + KELVIN_OFFSET) - math.log10(WALTHER_T1 + KELVIN_OFFSET)
)
MIN_OIL_TEMPERATURE_C, MAX_OIL_TEMPERATURE_C = -60.0, 200.0
"""Range of the oil, degC."""


@brief_kernel
def set_environment(unit_address: int, environment: tuple[float, float, float]) -> int:
    """Set viscosity and supply of a unit, see `ehadiag.model.plant.plant_constants`.

    environment: oil temperature, -60 … 200 degC; supply and return pressure, Pa. Returns 0, or 1
    where a number is out of its range and nothing was written.
    """
    oil, supply = environment[0], environment[1] - environment[2]
    if not (MIN_OIL_TEMPERATURE_C <= oil <= MAX_OIL_TEMPERATURE_C and 0.0 < supply < math.inf):
        return 1
    unit = array_at(unit_address, (MONITOR_UNIT_SIZE,))
    unit[UNIT_VISCOSITY] = _viscosity(oil)
    unit[UNIT_SUPPLY] = supply
    return 0


@inlined_exact
def _viscosity(oil: float) -> float:
    """Relative viscosity by Walther's law, see `ehadiag.model.plant.relative_viscosity`."""
    y = WALTHER_Y1 - WALTHER_SLOPE * (
        logarithm((oil + KELVIN_OFFSET) / (WALTHER_T1 + KELVIN_OFFSET)) / LN10
    )
    return (exponential(LN10 * exponential(LN10 * y)) - 0.7) / WALTHER_V1


def _relative_viscosity(oil: float) -> float:
    """Relative viscosity as `_viscosity`, for a constant."""
    share = (oil + KELVIN_OFFSET) / (WALTHER_T1 + KELVIN_OFFSET)
    y = WALTHER_Y1 - WALTHER_SLOPE * math.log10(share)
    return (math.pow(10.0, math.pow(10.0, y)) - 0.7) / WALTHER_V1


MIN_VISCOSITY = 0.999 * _relative_viscosity(MAX_OIL_TEMPERATURE_C)
MAX_VISCOSITY = 1.001 * _relative_viscosity(MIN_OIL_TEMPERATURE_C)
"""Range of the relative viscosity, 1: that of the oil's temperatures, and rounding."""
