"""What an actuator file says of its data's errors: tolerances, or what a calibration learned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.calibration import Calibration
from ehadiag.core.channels import Channels
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.errors import ConfigurationError
from ehadiag.identify.nuisance.explained import Explains, is_noise, leaves_no_more
from ehadiag.identify.nuisance.prior import Joint, Known, nuisances_of, usual
from ehadiag.identify.uncertainty import independent
from ehadiag.model.parameter import sized
from ehadiag.model.parameters import FAULTS, REGISTRY, Kind, Parameter, Unknowns, parameter
from ehadiag.model.plant import PlantConstants
from ehadiag.model.severity import CLOGGED

__all__ = [
    "MOTOR_GAIN",
    "NOTHING",
    "OF_THE_DAY",
    "PASS_FOR_FAULTS",
    "Alias",
    "Knowledge",
    "covariance_of",
    "data_that_pass_for",
    "datum_name",
    "has_further_effects",
    "knowledge_of",
    "severities_below",
]

MOTOR_GAIN = "torque_motor_gain"
"""What an error of GM does: as a datum nothing could tell it from this."""
PASS_FOR_FAULTS = {"GQF": "Kintas", "FSS0": "FSS", "FDJ0": "FDJ"}
"""Data that do what a severity does, so that no recording tells the two apart."""
OF_THE_DAY = {
    "oil_viscosity": Known(0.0, 0.038),
    "supply_pressure": Known(0.0, 0.058e6),
}
"""What no calibration can keep: a probe 2 K (3.3 % of viscosity each) or 0.1 MPa off, evenly."""
LOOSE = 0.3
"""Share of its usual deviation by which an effect may have changed since the calibration."""
SMALL = 1e-6
CALIBRATED_STD = 1e-4
"""Of a severity: what two optima on noise of their own, a calibration's and a diagnosis's, differ
by beyond their covariances. Errors of calibrated random units were 1.3 to 2.7 times what these
alone state (`tools/data_sheet`), at a discrepancy of 0.003 %."""
UNEXPLAINED_STD = 3e-3
"""Of a severity, where the calibration's residuals have twice the cost of noise: what a unit's
effects that no model has do to an estimate. It grows with the root of what is left, as a deviation
does with a share of the residual (a model discrepancy: Kennedy and O'Hagan, J. R. Stat. Soc. B
63(3), 2001; Brynjarsdóttir and O'Hagan, Inverse Problems 30, 2014)."""
FURTHER_STD = {"Kintas": 2.4e-2, "FSS": 4e-2, "FDJ": 1e-2}
"""Of each severity, where effects were learned beyond the usual ones, times the root of what the
calibration's residuals leave beside noise: the effects' laws were seen on the unit as new, with a
thirtieth of the friction at the limit of damage, and are held to when it is worn. With 0.25 left
errors of a recorded unit were up to 2.3, 1.4 and 0.9 %, with 0.09 up to 0.1, 0.2 and 0.04 %
(identification-results.md)."""
_NAMES = frozenset(item.name for item in REGISTRY if item.kind is not Kind.FAULT)
_USUAL = frozenset(item.name for item in nuisances_of(REGISTRY))
_FURTHER = frozenset(item.name for item in REGISTRY if item.kind is Kind.NUISANCE) - _USUAL


@dataclass(frozen=True, slots=True)
class Alias:
    """A datum that is held, and how far it may be off: the severity is off by as much.

    Attributes
    ----------
    datum, fault : Parameter
    std : float
        Deviation of the datum, relative.
    """

    datum: Parameter
    fault: Parameter
    std: float

    def shift(self, constants: PlantConstants, severity: float) -> float:
        """Change of the severity that does what a deviation of the datum does."""
        unknowns = Unknowns((self.datum, self.fault), (constants,), {})
        points = np.array([[0.0, severity], [SMALL, severity], [0.0, severity + SMALL]])
        there, datum, fault = unknowns.candidates(points)[:, 0]
        place = int(np.argmax(np.abs(fault - there)))
        return float((datum - there)[place] / (fault - there)[place]) * self.std


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """What is known of a unit before a recording of it is seen.

    Attributes
    ----------
    free : tuple of Parameter
        What is estimated because of it, beside severities and nuisances.
    known : mapping
        Of each of them alone, by name.
    joint : Joint, optional
        Of several together.
    aliases : tuple of Alias
    about : mapping
        Effects that the unit's constants already have, by name, SI: what is free is a deviation
        from them.
    std : mapping
        Of severities by name, beside all else.
    explains : callable
        Of residuals, shape (signals, N): whether no more is left than of the unit as new.
    leaves_nothing : bool
        Whether a calibration explained the unit as new to the noise.
    severities : tuple of Parameter
        The faults, with the bounds within which they are looked for.
    """

    free: tuple[Parameter, ...] = ()
    known: Mapping[str, Known] = field(default_factory=dict)
    joint: Joint | None = None
    aliases: tuple[Alias, ...] = ()
    about: Mapping[str, float] = field(default_factory=dict)
    std: Mapping[str, float] = field(default_factory=dict)
    explains: Explains = is_noise
    leaves_nothing: bool = False
    severities: tuple[Parameter, ...] = FAULTS

    def loosened(self) -> Knowledge:
        """Return what is left of it where the unit's effects have changed since."""
        if self.joint is None:
            return self
        names = self.joint.names
        extra = [
            0.0 if name.startswith("datum_") else LOOSE * usual(parameter(name)).std
            for name in names
        ]
        covariance = self.joint.covariance + np.diag(np.square(extra))
        return replace(self, joint=Joint(names, self.joint.mean, covariance))

    @property
    def doubts(self) -> bool:
        """Whether the data are not to be taken for exact."""
        return bool(self.free or self.aliases)

    @property
    def explains_sound(self) -> bool:
        """Whether it explains each recording of a sound unit: data that are not in doubt, or a
        calibration that left nothing."""
        return not self.doubts or self.leaves_nothing

    def beside(self, others: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """Return other parameters and what is free because of this, each once."""
        mine = {item.name for item in self.free}
        return (*(item for item in others if item.name not in mine), *self.free)

    def spread(
        self, parameters: Sequence[Parameter], values: Mapping[str, float], base: PlantConstants
    ) -> NDArray[np.float64]:
        """Covariance that aliases and a calibration add to that of estimates, SI, shape (k, k)."""
        out = independent(parameters, self.std)
        names = [item.name for item in parameters]
        for item in self.aliases:
            place = names.index(item.fault.name)
            out[place, place] += item.shift(base, values[item.fault.name]) ** 2
        return out


NOTHING = Knowledge()
"""The data are exact."""


def knowledge_of(actuator: Actuator) -> Knowledge:
    """What an actuator file says.

    A tolerance is a uniform range: the density before a recording has its deviation, the estimate
    its bounds (JCGM 100:2008, 4.3.7). A calibration is a normal density of all that it learned.

    Raises
    ------
    ConfigurationError
        A calibration has a parameter that the model does not have.
    """
    if actuator.calibration is not None:
        return _calibrated(actuator.calibration, actuator_channels(actuator))
    free, known, aliases = [], {}, []
    for symbol in actuator.tolerance.names:
        half_width = actuator.tolerance.of(symbol)
        std = half_width / math.sqrt(3.0)
        item = parameter(datum_name(symbol))
        if symbol in PASS_FOR_FAULTS:
            aliases.append(Alias(item, parameter(PASS_FOR_FAULTS[symbol]), std))
        elif item.name == MOTOR_GAIN:
            free.append(item)
            known[item.name] = Known(0.0, math.hypot(std, usual(item).std))
        else:
            free.append(replace(item, lower=-half_width, upper=half_width))
            known[item.name] = Known(0.0, std)
    tolerances = {symbol: actuator.tolerance.of(symbol) for symbol in PASS_FOR_FAULTS}
    severities = severities_below(actuator, tolerances)
    return Knowledge(tuple(free), known, None, tuple(aliases), severities=severities)


def severities_below(actuator: Actuator, errors: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Return the faults, looked for below 0 by what data that pass for them may be off.

    A unit with less friction than its data sheet's is not explained by any severity from 0 up, and
    other effects would stand in for it.

    errors : mapping
        Largest relative errors by symbol.
    """
    shares = _shares(actuator)
    reach = {PASS_FOR_FAULTS[name]: shares[name] * error for name, error in errors.items()}
    return tuple(replace(item, lower=item.lower - reach.get(item.name, 0.0)) for item in FAULTS)


def data_that_pass_for(actuator: Actuator, values: Mapping[str, float]) -> dict[str, float]:
    """Relative errors of data, by parameter name, that do what these severities do.

    values : mapping
        By name; others than severities are passed over.
    """
    return {
        datum_name(symbol): values[PASS_FOR_FAULTS[symbol]] / share
        for symbol, share in _shares(actuator).items()
        if PASS_FOR_FAULTS[symbol] in values
    }


def _shares(actuator: Actuator) -> dict[str, float]:
    """Severity that does what a datum that passes for a fault does where it is twice as large."""
    valve, jack = actuator.servovalve, actuator.jack
    return {
        "GQF": 1.0 / CLOGGED,
        "FSS0": valve.FSS0 / (valve.FSS1 - valve.FSS0),
        "FDJ0": jack.FDJ0 / (jack.FDJ1 - jack.FDJ0),
    }


def _calibrated(calibration: Calibration, channels: Channels) -> Knowledge:
    """What a calibration says: of deviations from the values that it found, so about 0."""
    for name in (*calibration.effects, *calibration.parameters):
        if name not in _NAMES:
            raise ConfigurationError(f"actuator file: calibration: no parameter {name!r} is known")
    free = []
    for name in calibration.parameters:
        item, value = sized(parameter(name), channels), calibration.effects.get(name, 0.0)
        free.append(
            replace(item, lower=item.lower - value, upper=item.upper - value, sized_by=None)
        )
    joint = Joint(calibration.parameters, np.zeros(len(free)), covariance_of(calibration))
    free += [parameter(name) for name in OF_THE_DAY]
    left = UNEXPLAINED_STD * math.sqrt(calibration.fit.left)
    beside_noise = 0.0
    if has_further_effects(calibration):
        beside_noise = math.sqrt(max(calibration.fit.excess - 1.0, 0.0))
    std = {
        name: math.hypot(CALIBRATED_STD, left, size * beside_noise)
        for name, size in FURTHER_STD.items()
    }
    explains = leaves_no_more(calibration.fit)
    return Knowledge(
        free=tuple(free),
        known=OF_THE_DAY,
        joint=joint,
        about=calibration.effects,
        std=std,
        explains=explains,
        leaves_nothing=calibration.fit.left == 0.0,
    )


def has_further_effects(calibration: Calibration) -> bool:
    """Whether effects were learned that an identification does not free by itself."""
    return any(name in _FURTHER for name in calibration.parameters)


def covariance_of(calibration: Calibration) -> NDArray[np.float64]:
    """Covariance of a calibration's parameters, SI, shape (k, k)."""
    lower = np.zeros((len(calibration.std), len(calibration.std)))
    for k, row in enumerate(calibration.root):
        lower[k, : k + 1] = row
    lower *= np.array(calibration.std)[:, None]
    return np.asarray(lower @ lower.T)


def datum_name(symbol: str) -> str:
    """Name of the parameter that is the relative error of a datum."""
    return MOTOR_GAIN if symbol == "GM" else f"datum_{symbol}"
