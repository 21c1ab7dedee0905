"""Where the numbers of an identification stand in its one flat array."""

from __future__ import annotations

from typing import Final, NamedTuple

from ehadiag.compile.rows import packer, unpacker
from ehadiag.monitor.layout import SIZE as MONITOR_SIZE
from ehadiag.monitor.prepare import UNIT_SIZE

__all__ = [
    "ADVANCE",
    "BELIEF",
    "BINS",
    "CONCLUSION",
    "DONE",
    "ELITE",
    "GENERATOR",
    "GENES",
    "GRIDS",
    "HISTOGRAMS",
    "JACK",
    "LAGS",
    "LANES",
    "LOOK",
    "MEAN",
    "MONITORS",
    "NOISE",
    "NORMAL",
    "OUTCOME",
    "PARAMETERS",
    "POINT",
    "POPULATION",
    "REFINEMENT",
    "RUNS",
    "SAMPLES",
    "SCORES",
    "SCRATCH",
    "SEARCH",
    "SIZE",
    "SPREAD",
    "TRIAL",
    "UNIT",
    "VERDICT",
    "Advance",
    "Outcome",
    "advance_of",
    "keep_advance",
    "keep_outcome",
    "outcome_of",
]

GENES: Final = 3
"""Severities: Kintas, FSS, FDJ."""
PARAMETERS: Final = 5
"""Severities, then the offsets of spool and pressure in units of their noise."""
SAMPLES: Final = 8
"""Of a generation of the compact genetic algorithm."""
MONITORS: Final = 1 + 2 * GENES
"""Models that run side by side: at the point, and two more on each severity's axis through it."""
BINS: Final = 128
"""Of each histogram that noise and offsets are read from."""
LAGS: Final = 20
"""Ticks over which residuals are held to be correlated, see `ehadiag.identify.uncertainty`."""


class Outcome(NamedTuple):
    """What an identification has found; the first members of its memory.

    Attributes
    ----------
    Kintas : float
        Severities, 0 … 1.
    FSS : float
        See `Kintas`.
    FDJ : float
        See `Kintas`.
    std_Kintas : float
        Their standard deviations.
    std_FSS : float
        See `std_Kintas`.
    std_FDJ : float
        See `std_Kintas`.
    spool_offset : float
        Constant error of the spool's sensor, m.
    pressure_offset : float
        Constant error of the sensor of differential pressure, Pa.
    verdict : float
        0 healthy, 10 degraded, 20 fault, 30 not tested.
    cost : float
        Capped sum of squares of the residuals, in units of noise.
    samples : float
        Residuals that it is of.
    outliers : float
        Share of them beyond three deviations.
    spool_rms : float
        Rms of the spool's residuals, squares capped, in units of the noise that they show.
    pressure_rms : float
        The same of the pressure's.
    runs : float
        Runs of the model so far.
    converged : float
        Not 0: the refinement came to rest by itself.
    """

    Kintas: float
    FSS: float
    FDJ: float
    std_Kintas: float
    std_FSS: float
    std_FDJ: float
    spool_offset: float
    pressure_offset: float
    verdict: float
    cost: float
    samples: float
    outliers: float
    spool_rms: float
    pressure_rms: float
    runs: float
    converged: float


class Advance(NamedTuple):
    """How far an identification is.

    Attributes
    ----------
    phase : float
        0 grid of the spool's severities, 1 grid of the jack's, 2 genetic search, 3 look at noise
        and offsets, 4 refinement, 5 conclusion, 6 done.
    steps : float
        Runs or steps within the phase.
    best : float
        Least cost of the phase so far.
    judged : float
        How often the noise was judged.
    settled : float
        Not 0: the refinement came to rest.
    """

    phase: float
    steps: float
    best: float
    judged: float
    settled: float


GRIDS: Final = 0.0
"""Phases, see `Advance`."""
JACK, SEARCH, LOOK, REFINEMENT, CONCLUSION, DONE = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0


def _behind(start: int, length: int) -> int:
    return start + length


OUTCOME: Final = 0
VERDICT: Final = OUTCOME + Outcome._fields.index("verdict")
RUNS: Final = OUTCOME + Outcome._fields.index("runs")
ADVANCE: Final = _behind(OUTCOME, len(Outcome._fields))
UNIT: Final = _behind(ADVANCE, len(Advance._fields))
"""What the monitor's kernels are told of the unit, severities and offsets of the run."""
POINT: Final = _behind(UNIT, UNIT_SIZE)
"""Best point so far."""
TRIAL: Final = _behind(POINT, PARAMETERS)
"""Point of the next run."""
MEAN: Final = _behind(TRIAL, PARAMETERS)
SPREAD: Final = _behind(MEAN, GENES)
ELITE: Final = _behind(SPREAD, GENES)
GENERATOR: Final = _behind(ELITE, GENES)
"""Cost of the elite, then the state of the random numbers."""
POPULATION: Final = _behind(GENERATOR, 2)
"""A generation, then its costs."""
BELIEF: Final = _behind(POPULATION, SAMPLES * (GENES + 1))
"""Root of the covariance of the severities as they are believed."""
NOISE: Final = _behind(BELIEF, GENES * GENES)
"""Noise of spool and pressure as the residuals show it, in units of the plan's."""
NORMAL: Final = _behind(NOISE, 2)
"""Normal matrix, then what pulls at the parameters."""
SCORES: Final = _behind(NORMAL, PARAMETERS * (PARAMETERS + 1))
"""Pull of each of the last ticks."""
HISTOGRAMS: Final = _behind(SCORES, (LAGS + 1) * PARAMETERS)
"""Of spool and pressure: residuals, then their second differences."""
SCRATCH: Final = _behind(HISTOGRAMS, 4 * BINS)
"""Matrices and vectors of a step."""
LANES: Final = _behind(SCRATCH, 4 * PARAMETERS * PARAMETERS + 8 * PARAMETERS)
SIZE: Final = _behind(LANES, MONITORS * MONITOR_SIZE)

outcome_of, keep_outcome = unpacker(Outcome, OUTCOME), packer(Outcome, OUTCOME)
advance_of, keep_advance = unpacker(Advance, ADVANCE), packer(Advance, ADVANCE)
