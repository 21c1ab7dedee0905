"""The registry of parameters: what can be estimated, and what each does to the physical constants.

This is the one place that knows what a fault is. Kernels take physical constants; a `Parameter`
holds the pure function that turns its value into them, and everything else (bounds, units, names in
tables and files) follows from the registry.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.data_errors import DATA
from ehadiag.model.nuisances import NUISANCES
from ehadiag.model.parameter import Kind, Parameter
from ehadiag.model.plant import FIELDS, PlantConstants, Value, plant_row
from ehadiag.model.severity import clogged, worn

__all__ = [
    "FAULTS",
    "FAULT_NAMES",
    "OFFSETS",
    "REGISTRY",
    "Kind",
    "Parameter",
    "Unknowns",
    "parameter",
]

FAULTS: tuple[Parameter, ...] = (
    Parameter(
        name="Kintas",
        symbol="Kintas",
        unit="1",
        lower=0.0,
        upper=1.0,
        kind=Kind.FAULT,
        scale=1.0,
        short="filter clogging",
        meaning="clogging of the valve's first-stage filter",
        changes=lambda c, value: {"GQF": clogged(c.GQF, value)},
    ),
    Parameter(
        name="FSS",
        symbol="FSS",
        unit="1",
        lower=0.0,
        upper=1.0,
        kind=Kind.FAULT,
        scale=1.0,
        short="spool friction",
        meaning="dry friction between spool and sleeve",
        changes=lambda c, value: {"FSS": worn(c.FSS, c.FSS1, value)},
    ),
    Parameter(
        name="FDJ",
        symbol="FDJ",
        unit="1",
        lower=0.0,
        upper=1.0,
        kind=Kind.FAULT,
        scale=1.0,
        short="jack friction",
        meaning="dry friction between jack and cylinder",
        changes=lambda c, value: {"FDJ": worn(c.FDJ, c.FDJ1, value)},
    ),
)
"""The progressive faults of the paper (PHY-13 to PHY-15)."""

REGISTRY: tuple[Parameter, ...] = (*DATA, *NUISANCES, *FAULTS)
"""All that can be estimated, in the order in which it is applied."""
FAULT_NAMES: tuple[str, ...] = tuple(item.name for item in FAULTS)
OFFSETS: tuple[Parameter, ...] = tuple(
    item for item in REGISTRY if item.adds_to in (SPOOL_ROW, PRESSURE_ROW)
)
"""Constant errors of the sensors of spool and pressure, which a test shows directly."""


def parameter(name: str) -> Parameter:
    """Return the parameter of that name.

    Raises
    ------
    KeyError
        There is none.
    """
    return _BY_NAME[name]


_BY_NAME = {item.name: item for item in REGISTRY}


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Which parameters are estimated, and about which constants: the space that is searched.

    Attributes
    ----------
    free : tuple of Parameter
        In the order of the coordinates of a point.
    base : tuple of PlantConstants
        Of the unit in each test, with nothing of any parameter in it.
    held : mapping
        Parameters that are not free and have another value than 0.
    """

    free: tuple[Parameter, ...]
    base: tuple[PlantConstants, ...]
    held: Mapping[str, float]

    @property
    def lower(self) -> NDArray[np.float64]:
        """Lower bounds, shape (k,)."""
        return np.array([item.lower for item in self.free])

    @property
    def upper(self) -> NDArray[np.float64]:
        """Upper bounds, shape (k,)."""
        return np.array([item.upper for item in self.free])

    def holding(self, values: Mapping[str, float]) -> Unknowns:
        """Return the space with parameters held at these values, and not free."""
        free = tuple(item for item in self.free if item.name not in values)
        return Unknowns(free, self.base, {**self.held, **values})

    def candidates(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Physical constants of points, in each test.

        Parameters
        ----------
        points : shape (n, k)

        Returns
        -------
        Shape (n, tests, FIELDS), what kernels take.
        """
        out = np.empty((len(points), len(self.base), FIELDS))
        for index, constants in enumerate(self.base):
            out[:, index] = plant_row(constants)
            _apply(PlantConstants(*out[:, index].T), self._values(points))
        return out

    def constants(self, point: NDArray[np.float64], test: int = 0) -> PlantConstants:
        """Physical constants of one point in a test, plain numbers."""
        return PlantConstants(*self.candidates(point[None, :])[0, test].tolist())

    def _values(self, points: NDArray[np.float64]) -> Iterable[tuple[Parameter, Value]]:
        """Parameters in the order of the registry, with their values."""
        columns: dict[str, Value] = dict(self.held)
        columns.update((item.name, points[:, k]) for k, item in enumerate(self.free))
        return ((item, columns[item.name]) for item in REGISTRY if item.name in columns)


def _apply(columns: PlantConstants, values: Iterable[tuple[Parameter, Value]]) -> None:
    """Change the constants, arrays of shape (n,), in place."""
    for item, value in values:
        changed = item.changes(columns, value)
        for name, new in changed.items():
            getattr(columns, name)[:] = new
