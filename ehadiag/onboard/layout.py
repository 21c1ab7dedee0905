"""Where the numbers of an identification stand in its one flat array."""

from __future__ import annotations

from typing import Final, NamedTuple

from ehadiag.compile.rows import packer, unpacker
from ehadiag.monitor.layout import SIZE as MONITOR_SIZE
from ehadiag.monitor.prepare import UNIT_SIZE

__all__ = [
    "ADVANCE",
    "CONVERGED",
    "DONE",
    "ELITE",
    "GENERATOR",
    "GENES",
    "GRADIENT",
    "GRIDS",
    "JACK",
    "LANES",
    "MEAN",
    "MONITORS",
    "NORMAL",
    "OUTCOME",
    "PARAMETERS",
    "POINT",
    "POPULATION",
    "REFINEMENT",
    "RUNS",
    "SAMPLES",
    "SCRATCH",
    "SEARCH",
    "SIZE",
    "SPREAD",
    "STEP",
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
MONITORS: Final = 1 + 2 * PARAMETERS
"""Models that run side by side for derivatives: at the point, and either side in each direction."""


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
    runs : float
        Runs of the model so far.
    converged : float
        Not 0: the refinement came to an end by itself.
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
    runs: float
    converged: float


class Advance(NamedTuple):
    """How far an identification is.

    Attributes
    ----------
    phase : float
        0 grid of the spool's severities, 1 grid of the jack's, 2 genetic search, 3 refinement,
        4 done.
    steps : float
        Runs or steps within the phase.
    best : float
        Least cost of the phase so far.
    damping : float
        Of the refinement's next step.
    """

    phase: float
    steps: float
    best: float
    damping: float


GRIDS: Final = 0.0
"""Phases, see `Advance`."""
JACK, SEARCH, REFINEMENT, DONE = 1.0, 2.0, 3.0, 4.0
STEP: Final = 5e-5
"""Half-width of the differences, and distance from the ends of a severity's range."""


def _behind(start: int, length: int) -> int:
    return start + length


OUTCOME: Final = 0
VERDICT: Final = OUTCOME + Outcome._fields.index("verdict")
RUNS: Final = OUTCOME + Outcome._fields.index("runs")
CONVERGED: Final = OUTCOME + Outcome._fields.index("converged")
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
NORMAL: Final = _behind(POPULATION, SAMPLES * (GENES + 1))
"""Normal matrix and gradient at the best point."""
GRADIENT: Final = _behind(NORMAL, PARAMETERS * PARAMETERS)
SCRATCH: Final = _behind(GRADIENT, PARAMETERS)
"""The same at the trial, a matrix, two vectors, and the elite before a generation."""
LANES: Final = _behind(SCRATCH, 2 * PARAMETERS * PARAMETERS + 4 * PARAMETERS + GENES)
SIZE: Final = _behind(LANES, MONITORS * MONITOR_SIZE)

outcome_of, keep_outcome = unpacker(Outcome, OUTCOME), packer(Outcome, OUTCOME)
advance_of, keep_advance = unpacker(Advance, ADVANCE), packer(Advance, ADVANCE)
