"""Prior densities of the parameters: usual sizes, tolerances of data, a unit's calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator, Calibration
from ehadiag.core.conventions import FRICTION_NAME
from ehadiag.core.conversion import actuator_channels
from ehadiag.identify.estimates import (
    ExplanationTest,
    calibrated_explanation_test,
    independent_covariance,
    is_noise,
)
from ehadiag.identify.linearisation import Derivatives, ParameterDensity
from ehadiag.model.parameter import Parameter, ParameterKind, scaled_to_channels
from ehadiag.model.plant import PlantConstants, bridge_stop, plant_constants
from ehadiag.model.registry import FAULT_NAMES, FAULTS, REGISTRY, Unknowns, parameter
from ehadiag.model.severities import FAULT_LAWS, doubling_severity
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import Channels

SPOOL_OFFSET_ALIAS = "null_bias"
"""Alias of a constant error of the spool's sensor: only the pressure distinguishes them, and
where it saturates the search may stop at a wrong pair."""


class PriorWidths(msgspec.Struct, frozen=True):
    """Widths of densities about starts, as shares of the prior's or of an earlier search's."""

    near: float = 0.1
    """Spread about a place that was found, or about no effect, 1: so wide a search found an optimum
    beyond one break-away (one unit had been 17 deviations off), and one about its end left 1 of 40
    units beside the optimum, not 13 (ADR 23)."""
    loosened: float = 0.3
    """Change of an effect since the calibration, in its usual deviations; spread of what it knows
    about the end of the spool's search, with 0.1 of which one of 24 recordings was not explained,
    with 1 a start took up to fifteen rounds."""


WIDTHS = PriorWidths()


class ParameterPrior(msgspec.Struct, frozen=True):
    """Prior of one parameter: a normal density, in its unit."""

    mean: float
    std: float


class JointPrior(msgspec.Struct, frozen=True, eq=False):
    """Prior of several parameters together: a normal density, in their units."""

    names: tuple[str, ...]
    mean: Array
    """Shape (m,)."""
    covariance: Array
    """Positive definite; shape (m, m)."""

    def covariance_among(self, names: Sequence[str]) -> Array:
        """Covariance of parameters in this order, 0 of those without prior."""
        out = np.zeros((len(names), len(names)))
        mine = [k for k, name in enumerate(names) if name in self.names]
        places = [self.names.index(names[k]) for k in mine]
        out[np.ix_(mine, mine)] = self.covariance[np.ix_(places, places)]
        return out


def basic_nuisances_of(oil: float) -> tuple[Parameter, ...]:
    """Nuisances that an identification may free besides the constant errors of the sensors.

    oil: stiffness of the unit's oil (`PlantConstants.OIL`), Pa/m³; 0: it does not yield.
    """
    return tuple(
        item for item in REGISTRY if item.basic and (oil > 0.0 or not item.needs_yielding_oil)
    )


def prior_density(
    model: Derivatives, priors: Mapping[str, ParameterPrior], joint: JointPrior | None = None
) -> ParameterDensity:
    """Density with which the search begins: the priors, else the usual sizes."""
    mean, covariance = _density(model, priors, joint)
    x = np.clip(mean, model.lower, model.upper)
    root = np.linalg.cholesky(covariance[np.ix_(model.curved, model.curved)])
    return ParameterDensity(x, np.asarray(root, dtype=np.float64))


def density_about(
    model: Derivatives,
    density: ParameterDensity,
    values: Mapping[str, float],
    *,
    known: bool = False,
) -> ParameterDensity:
    """Density about values by name, 0 where not named: narrower than `density`.

    known: whether `density` is as narrow as what is known of all but the severities, and stays so.
    """
    shares = np.where(model.faults | (not known), WIDTHS.near, 1.0)[model.curved]
    x = np.array([values.get(item.name, 0.0) for item in model.estimated]) / model.scale
    return ParameterDensity(np.clip(x, model.lower, model.upper), shares[:, None] * density.root)


def small_effects_density(model: Derivatives, density: ParameterDensity) -> ParameterDensity:
    """Density of a unit with hardly any effects: all but the severities are close to 0.

    The second start of a search. With hardly any hysteresis the noise of closed loop keeps the
    spool breaking away, and a search from the usual sizes ends where hysteresis that does not exist
    smoothes that.
    """
    faults = np.array([item.kind is ParameterKind.FAULT for item in model.estimated])
    x = np.where(faults, density.x, 0.0)
    shares = np.where(faults, 1.0, WIDTHS.near)[model.curved]
    return ParameterDensity(np.clip(x, model.lower, model.upper), density.root * shares[:, None])


def prior_information(
    model: Derivatives, priors: Mapping[str, ParameterPrior], joint: JointPrior | None = None
) -> Array:
    """Inverse covariance of the priors, and a little of the usual sizes, shape (k, k).

    The latter keeps parameters finite that no recording shows. A constant error of a sensor without
    prior may have any size.
    """
    _, covariance = _density(model, priors, joint)
    named = {*priors, *(joint.names if joint else ())}
    shown = [
        k for k, item in enumerate(model.estimated) if item.adds_to is None or item.name in named
    ]
    out = np.zeros_like(covariance)
    out[np.ix_(shown, shown)] = np.linalg.inv(covariance[np.ix_(shown, shown)])
    return out


def _density(
    model: Derivatives, priors: Mapping[str, ParameterPrior], joint: JointPrior | None
) -> tuple[Array, Array]:
    """Mean and covariance of all coordinates, in units of the model's scales."""
    each = [priors.get(item.name) or usual_prior(item) for item in model.estimated]
    mean = np.array([item.mean for item in each])
    covariance = np.diag([item.std**2 for item in each])
    if joint is not None:
        names = [item.name for item in model.estimated]
        mine = [k for k, name in enumerate(names) if name in joint.names]
        mean[mine] = [joint.mean[joint.names.index(names[k])] for k in mine]
        covariance[np.ix_(mine, mine)] = joint.covariance_among([names[k] for k in mine])
    return mean / model.scale, covariance / np.outer(model.scale, model.scale)


def usual_prior(item: Parameter) -> ParameterPrior:
    """Prior of a parameter of any unit: its usual size."""
    return ParameterPrior(*item.prior)


MOTOR_GAIN_NAME = "torque_motor_gain"
"""Effect that is the same as an error of GM."""
FAULT_OF_DATUM = {
    item.datum: item.passes_for
    for item in REGISTRY
    if item.datum is not None and item.passes_for is not None
}
"""Data with the same effect as a severity, which no recording distinguishes."""
DAILY_PRIORS = {
    item.name: ParameterPrior(0.0, item.day_std) for item in REGISTRY if item.day_std is not None
}
"""Priors of what no calibration can keep."""
ALIAS_DIFFERENCE_STEP = 1e-6
"""Step of a derivative by a datum or a severity, 1: a double keeps ten digits of the difference."""
CALIBRATED_SEVERITY_STD = 1e-4
"""Of a severity: what two optima on noise of their own, a calibration's and a diagnosis's, differ
by beyond their covariances. Errors of calibrated random units were 1.3 to 2.7 times what these
alone state (`tools/study units --data calibrated`), at a discrepancy of 0.003 %."""
UNEXPLAINED_SEVERITY_STD = 3e-3
"""Of a severity, where the calibration's residuals have twice the cost of noise: what a unit's
effects that no model has do to an estimate. It grows with the root of what is left, as a deviation
does with a share of the residual (a model discrepancy: Kennedy and O'Hagan, J. R. Stat. Soc. B
63(3), 2001; Brynjarsdóttir and O'Hagan, Inverse Problems 30, 2014)."""
_NAMES = frozenset(item.name for item in REGISTRY if item.kind is not ParameterKind.FAULT)
_USUAL = frozenset(item.name for item in REGISTRY if item.basic)
_FURTHER = frozenset(item.name for item in REGISTRY if item.kind is ParameterKind.NUISANCE) - _USUAL


class DatumAlias(msgspec.Struct, frozen=True):
    """A datum that is held, and how far it may be off: the severity is off by as much."""

    datum: Parameter
    fault: Parameter
    std: float
    """Deviation of the datum, relative."""

    def shift(self, constants: PlantConstants, severity: float) -> float:
        """Change of the severity that does what a deviation of the datum does."""
        unknowns = Unknowns((self.datum, self.fault), (constants,), {})
        points = np.array(
            [
                [0.0, severity],
                [ALIAS_DIFFERENCE_STEP, severity],
                [0.0, severity + ALIAS_DIFFERENCE_STEP],
            ]
        )
        there, datum, fault = unknowns.candidates(points)[:, 0]
        # Where the datum acts: a fault may act elsewhere, too.
        place = int(np.argmax(np.abs(datum - there)))
        return float((datum - there)[place] / (fault - there)[place]) * self.std


class UnitPrior(msgspec.Struct, frozen=True, eq=False):
    """Prior of a unit before a recording of it is seen."""

    free: tuple[Parameter, ...] = ()
    """Parameters that are estimated because of it, besides severities and nuisances."""
    priors: Mapping[str, ParameterPrior] = msgspec.field(default_factory=dict)
    """Prior of each of them alone, by name."""
    joint: JointPrior | None = None
    """Prior of several together."""
    aliases: tuple[DatumAlias, ...] = ()
    about: Mapping[str, float] = msgspec.field(default_factory=dict)
    """Effects that the unit's constants already have, by name, SI: what is free is a deviation from
    them."""
    std: Mapping[str, float] = msgspec.field(default_factory=dict)
    """Further standard deviation of severities by name, 1."""
    explains: ExplanationTest = is_noise
    """Of residuals, shape (signals, N): whether no more is left than of the unit as new."""
    explains_unit_as_new: bool = False
    """Whether a calibration explained the unit as new to the noise."""
    severities: tuple[Parameter, ...] = FAULTS
    """The faults, with the bounds of their search."""
    discrepancy: Mapping[str, float] = msgspec.field(default_factory=dict)
    """Deviation of severities by wrong laws of the faults, by name, over the severity, 1."""
    exponents: tuple[float, float] = (0.0, 0.0)
    """Least and largest exponent of the pressure gain behind a clogged filter, 1."""
    bridge: float = 0.0
    """The constant `BRG` that the unit has with an exponent above 0, 1."""

    def loosened(self) -> UnitPrior:
        """Return the prior where the unit's effects have changed since the calibration."""
        if self.joint is None:
            return self
        names = self.joint.names
        extra = [
            0.0 if name.startswith("datum_") else WIDTHS.loosened * usual_prior(parameter(name)).std
            for name in names
        ]
        covariance = self.joint.covariance + np.diag(np.square(extra))
        return replace(self, joint=JointPrior(names, self.joint.mean, covariance))

    @property
    def has_inexact_data(self) -> bool:
        """Whether the data are not to be taken for exact."""
        return bool(self.free or self.aliases or self.exponents[0] < self.exponents[1])

    @property
    def explains_sound_units(self) -> bool:
        """Whether it explains each recording of a sound unit: data that are not in doubt, or a
        calibration that explained the unit as new."""
        return not self.has_inexact_data or self.explains_unit_as_new

    def with_free(self, others: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """Return other parameters and the free ones, each once."""
        mine = {item.name for item in self.free}
        return (*(item for item in others if item.name not in mine), *self.free)

    def spread(
        self, parameters: Sequence[Parameter], values: Mapping[str, float], base: PlantConstants
    ) -> Array:
        """Covariance that aliases and a calibration add to that of estimates, SI, shape (k, k)."""
        out = independent_covariance(parameters, self.std)
        names = [item.name for item in parameters]
        for item in self.aliases:
            place = names.index(item.fault.name)
            shift = item.shift(base, values[item.fault.name])
            out[place, place] += shift**2
            if item.fault.name == "Kintas":
                place = names.index("FSS")
                out[place, place] += self._friction_shift(shift, values, base) ** 2
        return out

    def _friction_shift(
        self, shift: float, values: Mapping[str, float], base: PlantConstants
    ) -> float:
        """Change of the spool's friction by one of the clogging, whose pressure moves the spool."""
        change = FAULT_LAWS["Kintas"].change
        share = 1.0 + change * values["Kintas"]
        friction = base.FSS / (base.FSS1 - base.FSS) + values["FSS"]
        return float(self.exponents[1] * -change * shift / share * friction)

    def discrepancy_covariance(
        self, parameters: Sequence[Parameter], values: Mapping[str, float], excess: float
    ) -> Array:
        """Covariance by wrong laws of the faults, SI, shape (k, k).

        A spool's friction takes of the speed by which clogging is known: its law counts there, too.
        excess: of the residuals over noise: a law that the residuals show to be wrong is off by
        more.
        """
        more = 1.0 + math.sqrt(max(excess - 1.0, 0.0))
        worn = {**values, "Kintas": math.hypot(values["Kintas"], values[FRICTION_NAME])}
        std = {name: size * more * worn[name] for name, size in self.discrepancy.items()}
        return independent_covariance(parameters, std)


EXACT_UNIT_PRIOR = UnitPrior()
"""The data are exact."""


def unit_prior(actuator: Actuator) -> UnitPrior:
    """Prior of a unit by its actuator file; ConfigurationError: unknown calibrated parameter."""
    low, high = actuator.servovalve.clogging_range
    found = _data_prior(actuator)
    severities = found.severities
    if low < high:  # the largest exponent makes of friction as new less than that
        valve = actuator.servovalve
        least = -valve.FSS0 / (valve.FSS1 - valve.FSS0)
        severities = tuple(
            replace(item, lower=min(item.lower, least)) if item.name == "FSS" else item
            for item in severities
        )
    return replace(
        found,
        severities=severities,
        exponents=(low, high),
        bridge=bridge_stop(actuator.servovalve),
        discrepancy={name: getattr(actuator.discrepancy, name) for name in FAULT_NAMES},
    )


def _data_prior(actuator: Actuator) -> UnitPrior:
    """Prior of a unit's data by its actuator file.

    A tolerance is a uniform range: the density before a recording has its deviation, the estimate
    its bounds (JCGM 100:2008, 4.3.7). A calibration is a normal density of all that it determined.
    """
    if actuator.calibration is not None:
        return _calibrated_prior(actuator.calibration, actuator_channels(actuator))
    free, priors, aliases = [], {}, []
    for symbol in actuator.tolerance.names:
        half_width = actuator.tolerance.of(symbol)
        std = half_width / math.sqrt(3.0)
        item = parameter(datum_name(symbol))
        if symbol in FAULT_OF_DATUM:
            aliases.append(DatumAlias(item, parameter(FAULT_OF_DATUM[symbol]), std))
        elif item.name == MOTOR_GAIN_NAME:
            free.append(item)
            priors[item.name] = ParameterPrior(0.0, math.hypot(std, usual_prior(item).std))
        else:
            free.append(replace(item, lower=-half_width, upper=half_width))
            priors[item.name] = ParameterPrior(0.0, std)
    tolerances = {symbol: actuator.tolerance.of(symbol) for symbol in FAULT_OF_DATUM}
    severities = faults_below_zero(actuator, tolerances)
    return UnitPrior(tuple(free), priors, None, tuple(aliases), severities=severities)


def faults_below_zero(actuator: Actuator, errors: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Return the faults, with bounds below 0 by the errors of data with the same effect.

    A unit with less friction than its data sheet's is not explained by any severity from 0 up, and
    other effects would stand in for it.

    errors : mapping
        Largest relative errors by symbol.
    """
    shares = severity_of_datum(actuator)
    reach = {FAULT_OF_DATUM[name]: shares[name] * error for name, error in errors.items()}
    return tuple(replace(item, lower=item.lower - reach.get(item.name, 0.0)) for item in FAULTS)


def data_errors_of_severities(actuator: Actuator, values: Mapping[str, float]) -> dict[str, float]:
    """Relative errors of data, by parameter name, that do what these severities do.

    values : mapping
        By name; others than severities are passed over.
    """
    return {
        datum_name(symbol): values[FAULT_OF_DATUM[symbol]] / share
        for symbol, share in severity_of_datum(actuator).items()
        if FAULT_OF_DATUM[symbol] in values
    }


def severity_of_datum(actuator: Actuator) -> dict[str, float]:
    """Severity that does what a datum that passes for a fault does where it is twice as large."""
    constants = plant_constants(actuator)
    return {symbol: doubling_severity(fault, constants) for symbol, fault in FAULT_OF_DATUM.items()}


def _calibrated_prior(calibration: Calibration, channels: Channels) -> UnitPrior:
    """Prior by a calibration: of deviations from the values that it found, so about 0."""
    for name in (*calibration.effects, *calibration.parameters):
        if name not in _NAMES:
            raise ConfigurationError(f"actuator file: calibration: no parameter {name!r} is known")
    free = []
    for name in calibration.parameters:
        item, value = (
            scaled_to_channels(parameter(name), channels),
            calibration.effects.get(name, 0.0),
        )
        free.append(
            replace(item, lower=item.lower - value, upper=item.upper - value, sized_by=None)
        )
    joint = JointPrior(
        calibration.parameters, np.zeros(len(free)), calibration_covariance(calibration)
    )
    free += [parameter(name) for name in DAILY_PRIORS]
    left = UNEXPLAINED_SEVERITY_STD * math.sqrt(calibration.fit.left)
    beside_noise = 0.0
    # What a real valve leaves is of effects that no model has, whichever of them were learned.
    of_orifices = "bulk_modulus" in calibration.parameters and left > 0.0
    if has_further_effects(calibration) or of_orifices:
        beside_noise = math.sqrt(max(calibration.fit.excess - 1.0, 0.0))
    std = {
        name: math.hypot(CALIBRATED_SEVERITY_STD, left, law.further_std * beside_noise)
        for name, law in FAULT_LAWS.items()
    }
    explains = calibrated_explanation_test(calibration.fit)
    return UnitPrior(
        free=tuple(free),
        priors=DAILY_PRIORS,
        joint=joint,
        about=calibration.effects,
        std=std,
        explains=explains,
        explains_unit_as_new=calibration.fit.left == 0.0,
    )


def has_further_effects(calibration: Calibration) -> bool:
    """Whether effects were learned that an identification does not free by itself."""
    return any(name in _FURTHER for name in calibration.parameters)


def calibration_covariance(calibration: Calibration) -> Array:
    """Covariance of a calibration's parameters, SI, shape (k, k)."""
    lower = np.zeros((len(calibration.std), len(calibration.std)))
    for k, row in enumerate(calibration.root):
        lower[k, : k + 1] = row
    lower *= np.array(calibration.std)[:, None]
    return np.asarray(lower @ lower.T)


def datum_name(symbol: str) -> str:
    """Name of the parameter that is the relative error of a datum."""
    return MOTOR_GAIN_NAME if symbol == "GM" else f"datum_{symbol}"
