"""Result of an identification: severities, nuisances, quality of fit and time spent."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec
import numpy as np

from ehadiag.compile.jit import Array
from ehadiag.model.plant import PlantConstants
from ehadiag.model.registry import SENSOR_OFFSETS, Unknowns, parameter


class Estimate(msgspec.Struct, frozen=True):
    """One severity as each stage left it."""

    name: str
    first: float
    """After the first approximation; NaN where a refinement began from an earlier diagnosis."""
    search: float
    """After the genetic search; NaN where an earlier diagnosis made it needless."""
    value: float
    """After the refinement: the estimate."""
    std: float
    interval95: tuple[float, float]
    at_bound: bool
    """The estimate stands at a bound."""
    shown: bool
    """Whether the test shows this fault at all."""


class Nuisance(msgspec.Struct, frozen=True):
    """An effect of the installation, as estimated; SI."""

    value: float
    std: float
    at_bound: bool
    """The estimate stands at a bound."""


class Fit(msgspec.Struct, frozen=True):
    """How well the model explains the recording."""

    spool_rms: float
    pressure_rms: float
    """Rms residual in units of the signal's own noise, squares capped at nine; about 1 where the
    model explains all."""
    outliers: float
    """Share of residuals beyond three deviations, both channels (0.003 for noise alone)."""
    spool_noise: float
    pressure_noise: float
    """Noise of the channels, m and Pa."""
    spool_offset: float
    pressure_offset: float
    """Constant errors of the channels, m and Pa."""
    anchored: int
    """How often the model had to be put back on the measured spool."""
    unexplained_outliers: float
    unexplained_rms: float
    """As `outliers`, and the larger `…_rms`, where the faults' laws may be off by the discrepancy
    of the actuator file (`explained_deviations`)."""
    spool_rms_uncapped: float = math.nan
    pressure_rms_uncapped: float = math.nan
    """Rms residual in units of the signal's own noise, every residual counted in full: far above
    the capped one where a few samples are far off."""


class IdentificationTiming(msgspec.Struct, frozen=True):
    """Seconds spent."""

    first: float
    search: float
    refine: float


class Identification(msgspec.Struct, frozen=True, eq=False):
    """Faults of the actuator as the recordings show them."""

    estimates: tuple[Estimate, ...]
    nuisances: Mapping[str, Nuisance]
    """Effects that were estimated with the severities, by name; all others were held."""
    about: Mapping[str, float]
    """Effects that a calibration knew: the constants of the experiments already have them."""
    covariance: Array
    """Of the severities, in the order of `estimates`, shape (k, k)."""
    fit: Fit
    solver: str
    seed: int
    evaluations: int
    """Runs of the model in all stages."""
    generations: int
    cost: float
    residuals: Array
    """Over the noise, 0 where no sample counts, shape (signals, N)."""
    converged: bool
    attempts: int
    """Searches that it took; more than one where the first did not explain the recording."""
    timing: IdentificationTiming
    slip_speed: float = 0.0
    """Speed of the jack, m/s, below which the pressure was left out; 0: none was."""
    better_exponent: float | None = None
    """Exponent of clogging, 1, that explains far more than the actuator file's; None: none does."""
    exponent_doubted: bool = False
    """Whether the file's exponent 0 is not borne out, so that `FSS` is that of all exponents."""
    frictions: tuple[float, ...] = ()
    """`FSS` with each of evenly spaced exponents of clogging that the actuator file allows, the
    largest first; empty where it states one."""
    ambiguous: bool = False
    """Whether the searches for effects in closed loop leave more than noise: another place, far
    away, may explain it."""
    begun_from: str = ""
    """Earlier diagnosis that the refinement began from, in words; empty: the recordings' own
    search."""
    response: Mapping[str, float] = msgspec.field(default_factory=dict)
    """What the identified response has in place of estimates that are of a range, by name, SI."""

    def named(self, name: str) -> Estimate:
        """Return the estimate of that name; KeyError if there is none."""
        for item in self.estimates:
            if item.name == name:
                return item
        raise KeyError(name)

    @property
    def values(self) -> dict[str, float]:
        """All that was estimated, by name, SI."""
        severities = {item.name: item.value for item in self.estimates}
        return severities | {name: item.value for name, item in self.nuisances.items()}

    def constants(self, base: PlantConstants) -> PlantConstants:
        """Constants of the unit as it was found; `base`: of its experiments, so as new."""
        about = self.about
        found = {**self.values, **self.response}
        values = {name: value - about.get(name, 0.0) for name, value in found.items()}
        free = tuple(parameter(name) for name in values)
        return Unknowns(free, (base,), {}).constants(np.array(list(values.values())))

    @property
    def freed(self) -> tuple[str, ...]:
        """Names of the effects that were estimated besides severities and offsets."""
        offsets = {item.name for item in SENSOR_OFFSETS}
        return tuple(name for name in self.nuisances if name not in offsets)

    @property
    def rescued(self) -> bool:
        """Whether the first search did not explain the recording."""
        return self.attempts > 1
