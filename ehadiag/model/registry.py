"""Registry of all parameters, spaces of unknowns, interface between solvers and models.

This is the one place that knows what a fault is. Kernels take physical constants; bounds, units and
names in tables and files follow from the registry. `unit_constants` are those of a unit with its
calibration.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW, Batch
from ehadiag.model.nuisances import NUISANCE_PARAMETERS
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


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
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
