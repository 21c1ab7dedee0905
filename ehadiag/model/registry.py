"""Registry of all parameters, spaces of unknowns, interface between solvers and models.

This is the one place that knows what a fault is. Kernels take physical constants; bounds, units and
names in tables and files follow from the registry. `unit_constants` are those of a unit with its
calibration.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.model.batch import POSITION_ROW, PRESSURE_ROW, SPOOL_ROW, Batch
from ehadiag.model.parameter import (
    DATA_ERROR_PARAMETERS,
    ConstantChanges,
    Parameter,
    ParameterKind,
)
from ehadiag.model.plant import (
    PLANT_FIELDS,
    ConstantValue,
    PlantConstants,
    plant_constants,
    plant_row,
)
from ehadiag.model.severities import FAULT_LAWS, FaultLaw, damaged_constant
from firmware_iface.recording import Environment

MAX_LAP_SHARE = 0.8
"""Largest lap, 1: share of the travel that opens a land; one as wide as that would turn the
pressure about the middle."""
ANY_SIZE = (-np.inf, np.inf)


def _nuisance(
    name: str,
    symbol: str,
    unit: str,
    bounds: tuple[float, float],
    scale: float,
    short: str,
    meaning: str,
    constant: str,
    **further: Any,
) -> Parameter:
    """Nuisance that is added to a field of the constants, unless `changes` states otherwise."""

    def changes(c: PlantConstants, value: ConstantValue) -> ConstantChanges:
        return {constant: getattr(c, constant) + value}

    kind = ParameterKind.NUISANCE
    return Parameter(
        name, symbol, unit, *bounds, kind, scale, short, meaning,
        **{"changes": changes, **further},
    )  # fmt: skip


def _gain(signal: str, symbol: str, sensor: str) -> Parameter:
    """Relative error of a sensor's gain."""
    return _nuisance(
        f"{signal}_gain", symbol, "1", (-0.5, 0.5), 0.01, f"{signal} sensor gain",
        f"relative error of the gain of {sensor}", symbol,
    )  # fmt: skip


# fmt: off
NUISANCE_PARAMETERS: tuple[Parameter, ...] = (
    _nuisance("spool_offset", "OXS", "m", ANY_SIZE, 1e-5, "spool sensor offset",
              "constant error of the spool's sensor", "OXS",
              adds_to=SPOOL_ROW, sized_by="spool"),
    _nuisance("pressure_offset", "OPD", "Pa", ANY_SIZE, 5e5, "pressure sensor offset",
              "constant error of the sensor of differential pressure", "OPD",
              adds_to=PRESSURE_ROW, sized_by="pressure"),
    _nuisance("position_offset", "OXJ", "m", ANY_SIZE, 1.2e-3, "position sensor offset",
              "constant error of the jack's sensor", "OXJ",
              adds_to=POSITION_ROW, sized_by="position"),
    _gain("spool", "GXS", "the spool's sensor"),
    _gain("pressure", "GPD", "the sensor of differential pressure"),
    _gain("position", "GXJ", "the jack's sensor"),
    _nuisance("spool_bend", "BX2", "1", (-0.1, 0.1), 0.01, "spool sensor bend",
              "even part of the curve of the spool's sensor at its stop, over the position there",
              "BX2"),
    _nuisance("spool_bow", "BX3", "1", (-0.1, 0.1), 0.01, "spool sensor bow",
              "odd part of the curve of the spool's sensor at its stop, over the position there",
              "BX3"),
    _nuisance("pressure_bend", "BP2", "1", (-0.1, 0.1), 0.01, "pressure sensor bend",
              "even part of the pressure sensor's curve at the supply, over the pressure there",
              "BP2"),
    _nuisance("pressure_bow", "BP3", "1", (-0.1, 0.1), 0.01, "pressure sensor bow",
              "odd part of the pressure sensor's curve at the supply, over the pressure there",
              "BP3"),
    _nuisance("filter_time", "τ", "s", (0.0, 5e-4), 1e-4, "analogue filter",
              "time constant of the filter before the converters of spool and pressure", "TAU"),
    _nuisance("sampling_lead", "DLY", "s", (0.0, 2e-4), 1e-4, "sampling instant",
              "time before the end of the tick at which the channels are sampled", "DLY"),
    _nuisance("driver_lag", "LAG", "s", (0.0, 5e-3), 2e-4, "driver lag",
              "time constant of the driver of the current and of the coil", "LAG"),
    _nuisance("clogging_exponent", "dm", "1", (-2.0, 2.0), 1.0, "clogging exponent",
              "exponent of the pressure gain behind a clogged filter, less the actuator file's",
              "CLE"),
    _nuisance("first_stage_null", "XFN", "m", (-5e-6, 5e-6), 5e-7, "null of the first stage",
              "the first stage's null from the middle between the flapper's stops", "XFN"),
    _nuisance("null_bias", "ib", "A", (-5e-4, 5e-4), 2e-4, "null bias",
              "current that the torque motor adds to the commanded one", "IB",
              sized_by="current", limit="null_bias", basic=True),
    _nuisance("torque_motor_gain", "dGM", "1", (-0.2, 0.2), 0.1, "torque-motor gain",
              "relative change of the torque motor's gain", "GM",
              changes=lambda c, value: {"GM": c.GM * (1.0 + value)},
              limit="torque_motor_gain", datum="GM", datum_unit="N m/A",
              condition="gain_change", basic=True),
    _nuisance("hysteresis", "hyst", "1", (0.0, 0.1), 0.04, "torque-motor hysteresis",
              "width of the torque motor's hysteresis over rated current", "HYS",
              limit="hysteresis", basic=True),
    _nuisance("hysteresis_skew", "k", "1", (-12.0, 12.0), 3.0, "hysteresis skew",
              "by how much a wide play of a smooth hysteresis counts less than a narrow one",
              "SKW"),
    _nuisance("torque_even", "TQ2", "1", (-0.3, 0.3), 0.05, "torque curve, even",
              "even part of the torque's curve at rated current, over the torque there", "TQ2"),
    _nuisance("torque_odd", "TQ3", "1", (-0.5, 0.5), 0.05, "torque curve, odd",
              "odd part of the torque's curve at rated current, over the torque there", "TQ3"),
    _nuisance("spool_stribeck", "vSS", "m/s", (0.0, 0.2), 0.01, "spool Stribeck velocity",
              "velocity over which the spool's friction falls from static to dynamic; 0: none",
              "VSS"),
    _nuisance("backlash", "b", "m", (0.0, 2e-5), 5e-6, "feedback backlash",
              "half-width of the backlash between spool and feedback spring", "BKL",
              sized_by="spool", limit="backlash", basic=True),
    _nuisance("land_shift", "XLD", "m", (-5e-5, 5e-5), 2e-6, "shift of the lands",
              "spool position at which the metering lands are closed", "XLD", sized_by="spool"),
    _nuisance("land_even", "LD2", "1", (-0.5, 0.5), 0.02, "lands, even",
              "opening of the lands to the plus side over the mean of both sides, less 1", "LD2"),
    _nuisance("land_odd", "LD3", "1", (-0.5, 0.5), 0.02, "lands, odd",
              "odd part of the opening of the lands at the spool's stop, over the travel there",
              "LD3"),
    _nuisance("land_lap", "LAP", "m", (-8e-6, 8e-6), 1e-6, "lap of the lands",
              "travel that the overlap of the lands takes, below 0 an underlap", "LAP",
              changes=lambda c, value: {
                  "LAP": np.minimum(c.LAP + value, MAX_LAP_SHARE * c.PSR / c.GP)}),
    _nuisance("jack_stribeck", "vSJ", "m/s", (0.0, 0.2), 0.01, "jack Stribeck velocity",
              "velocity over which the jack's friction falls from static to dynamic; 0: none",
              "VSJ"),
    _nuisance("friction_way", "WAY", "1", (-0.5, 0.5), 0.05, "friction by direction",
              "friction of a jack that moves out over the mean of both ways, less 1", "WAY"),
    _nuisance("load", "FR", "N", (-2e4, 2e4), 100.0, "load",
              "constant load on the jack beside that of the actuator file", "FR"),
    _nuisance("load_spring", "ka", "N/m", (0.0, 1e6), 1e4, "load spring",
              "stiffness of a load that draws the jack to its middle", "KA"),
)
# fmt: on
"""In the order of the chain, the sensors first."""


def _fault(name: str, law: FaultLaw) -> Parameter:
    """Severity of a fault, from 0 to 1."""

    def changes(c: PlantConstants, value: ConstantValue) -> ConstantChanges:
        new, limit = getattr(c, law.constant), getattr(c, law.limit or law.constant)
        found = {law.constant: damaged_constant(new, limit, law.change, value)}
        if law.pressure:
            share = damaged_constant(1.0, 1.0, law.change, value)
            found[law.pressure] = getattr(c, law.pressure) * share ** getattr(c, law.exponent)
        return found

    return Parameter(
        name, name, "1", 0.0, 1.0, ParameterKind.FAULT, 1.0, law.short, law.meaning, changes
    )


FAULTS: tuple[Parameter, ...] = tuple(_fault(*item) for item in FAULT_LAWS.items())
"""The progressive faults of the paper (PHY-13 to PHY-15)."""

REGISTRY: tuple[Parameter, ...] = (*DATA_ERROR_PARAMETERS, *NUISANCE_PARAMETERS, *FAULTS)
"""All that can be estimated, in the order in which it is applied."""
FAULT_NAMES: tuple[str, ...] = tuple(item.name for item in FAULTS)
SENSOR_OFFSETS: tuple[Parameter, ...] = tuple(
    item for item in REGISTRY if item.adds_to in (SPOOL_ROW, PRESSURE_ROW)
)
"""Constant errors of the sensors of spool and pressure, which a test shows directly."""


def parameter(name: str) -> Parameter:
    """Return the parameter of that name; KeyError if there is none."""
    return _BY_NAME[name]


_BY_NAME = {item.name: item for item in REGISTRY}


class Unknowns(msgspec.Struct, frozen=True, eq=False):
    """Which parameters are estimated, and about which constants: the space that is searched."""

    free: tuple[Parameter, ...]
    """In the order of the coordinates of a point."""
    base: tuple[PlantConstants, ...]
    """Of the unit in each test, with nothing of any parameter in it."""
    held: Mapping[str, float]
    """Parameters that are not free and have another value than 0."""

    @property
    def lower(self) -> Array:
        """Lower bounds, shape (k,)."""
        return np.array([item.lower for item in self.free])

    @property
    def upper(self) -> Array:
        """Upper bounds, shape (k,)."""
        return np.array([item.upper for item in self.free])

    def holding(self, values: Mapping[str, float]) -> Unknowns:
        """Return the space with parameters held at these values, and not free."""
        free = tuple(item for item in self.free if item.name not in values)
        return Unknowns(free, self.base, {**self.held, **values})

    def candidates(self, points: Array) -> Array:
        """Physical constants of points (n, k) in each test, shape (n, tests, PLANT_FIELDS)."""
        out = np.empty((len(points), len(self.base), PLANT_FIELDS))
        for index, constants in enumerate(self.base):
            out[:, index] = plant_row(constants)
            _apply(PlantConstants(*out[:, index].T), self._values(points))
        return out

    def constants(self, point: Array, test: int = 0) -> PlantConstants:
        """Physical constants of one point in a test, plain numbers."""
        return PlantConstants(*self.candidates(point[None, :])[0, test].tolist())

    def _values(self, points: Array) -> Iterable[tuple[Parameter, ConstantValue]]:
        """Parameters in the order of the registry, with their values."""
        columns: dict[str, ConstantValue] = dict(self.held)
        columns.update((item.name, points[:, k]) for k, item in enumerate(self.free))
        return ((item, columns[item.name]) for item in REGISTRY if item.name in columns)


def _apply(columns: PlantConstants, values: Iterable[tuple[Parameter, ConstantValue]]) -> None:
    """Change the constants, arrays of shape (n,), in place."""
    for item, value in values:
        changed = item.changes(columns, value)
        for name, new in changed.items():
            getattr(columns, name)[:] = new


class ResidualModel(Protocol):
    """A model that explains recorded tests, for points in the space of the unknowns.

    All numbers of one model come from one kernel: costs are compared with costs of the same model
    only.
    """

    @property
    def batch(self) -> Batch:
        """What is to be explained."""
        ...

    @property
    def unknowns(self) -> Unknowns:
        """What points are."""
        ...

    @property
    def evaluations(self) -> int:
        """Points that were evaluated so far."""
        ...

    def residuals(self, points: Array) -> tuple[Array, NDArray[np.int64]]:
        """Weighted residuals, measured less modelled, and numbers of re-anchorings, shape (n,).

        Residuals have shape (n, signals, N) for points (n, k), rows as the batch's weights; in
        units of noise, 0 where no sample counts.
        """
        ...

    def costs(self, points: Array, cap: float) -> Array:
        """Sum of squared residuals of points, each square at most `cap`, shape (n,)."""
        ...


def unit_constants(actuator: Actuator, environment: Environment | None = None) -> PlantConstants:
    """Constants of the unit as new, see `plant_constants`, with its calibrated effects in them."""
    base = plant_constants(actuator, environment)
    calibration = actuator.calibration
    if calibration is None:
        return base
    base = base._replace(NPL=float(calibration.plays))
    return Unknowns((), (base,), calibration.effects).constants(np.empty(0))
