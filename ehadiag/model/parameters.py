"""The registry of parameters: what can be estimated, and what each does to the physical constants.

This is the one place that knows what a fault is. Kernels take physical constants; a `Parameter`
holds the pure function that turns its value into them, and everything else (bounds, units, names in
tables and files) follows from the registry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.plant import FIELDS, PlantConstants, Value, plant_row

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

Changes = Mapping[str, Value]
"""Fields of `PlantConstants` with the values that they take."""


class Kind(Enum):
    """What a parameter is to the diagnosis. The order is that in which they are applied."""

    NUISANCE = "nuisance"
    """Of the installation or of the day: estimated so that it does not pass for a fault."""
    FAULT = "fault"
    """A progressive fault: a severity from 0, as new, to 1, limit of damage."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One scalar that can be estimated.

    Attributes
    ----------
    name : str
        Identifier in tables, files and reports.
    symbol : str
        As the specification writes it.
    unit : str
        SI.
    lower, upper : float
        Bounds.
    kind : Kind
    scale : float
        What is large: points of a search are in units of it, derivatives over a share of it.
    short, meaning : str
        In two words, and in a line.
    changes : callable
        (constants, value) -> the fields of the constants that it changes; pure, and for arrays too.
    adds_to : int or None
        Row of the residuals to which the parameter is simply added (a constant error of a sensor):
        its derivative is known. None: it acts through the model.
    """

    name: str
    symbol: str
    unit: str
    lower: float
    upper: float
    kind: Kind
    scale: float
    short: str
    meaning: str
    changes: Callable[[PlantConstants, Value], Changes]
    adds_to: int | None = None


CLOGGED = 0.8
"""Share of the first stage's flow gain that is lost at the limit of damage (PHY-13)."""

REGISTRY: tuple[Parameter, ...] = (
    Parameter(
        name="spool_offset",
        symbol="OXS",
        unit="m",
        lower=-np.inf,
        upper=np.inf,
        kind=Kind.NUISANCE,
        scale=1e-5,
        short="spool sensor offset",
        meaning="constant error of the spool's sensor",
        changes=lambda c, value: {"OXS": c.OXS + value},
        adds_to=SPOOL_ROW,
    ),
    Parameter(
        name="pressure_offset",
        symbol="OPD",
        unit="Pa",
        lower=-np.inf,
        upper=np.inf,
        kind=Kind.NUISANCE,
        scale=5e5,
        short="pressure sensor offset",
        meaning="constant error of the sensor of differential pressure",
        changes=lambda c, value: {"OPD": c.OPD + value},
        adds_to=PRESSURE_ROW,
    ),
    Parameter(
        name="sampling_lead",
        symbol="DLY",
        unit="s",
        lower=0.0,
        upper=2e-4,
        kind=Kind.NUISANCE,
        scale=1e-4,
        short="sampling instant",
        meaning="time before the end of the tick at which the spool is sampled",
        changes=lambda c, value: {"DLY": c.DLY + value},
    ),
    Parameter(
        name="null_bias",
        symbol="ib",
        unit="A",
        lower=-5e-4,
        upper=5e-4,
        kind=Kind.NUISANCE,
        scale=2e-4,
        short="null bias",
        meaning="current that the torque motor adds to the commanded one",
        changes=lambda c, value: {"IB": c.IB + value},
    ),
    Parameter(
        name="torque_motor_gain",
        symbol="dGM",
        unit="1",
        lower=-0.1,
        upper=0.1,
        kind=Kind.NUISANCE,
        scale=0.1,
        short="torque-motor gain",
        meaning="relative change of the torque motor's gain",
        changes=lambda c, value: {"GM": c.GM * (1.0 + value)},
    ),
    Parameter(
        name="hysteresis",
        symbol="hyst",
        unit="1",
        lower=0.0,
        upper=0.1,
        kind=Kind.NUISANCE,
        scale=0.04,
        short="torque-motor hysteresis",
        meaning="width of the torque motor's hysteresis over rated current",
        changes=lambda c, value: {"HYS": c.HYS + value},
    ),
    Parameter(
        name="backlash",
        symbol="b",
        unit="m",
        lower=0.0,
        upper=2e-5,
        kind=Kind.NUISANCE,
        scale=5e-6,
        short="feedback backlash",
        meaning="half-width of the backlash between spool and feedback spring",
        changes=lambda c, value: {"BKL": c.BKL + value},
    ),
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
        changes=lambda c, value: {"GQF": c.GQF * (1.0 - CLOGGED * value)},
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
        changes=lambda c, value: {"FSS": c.FSS + value * (c.FSS1 - c.FSS)},
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
        changes=lambda c, value: {"FDJ": c.FDJ + value * (c.FDJ1 - c.FDJ)},
    ),
)
"""All that can be estimated; the progressive faults are those of the paper (PHY-13 to PHY-15)."""

FAULTS: tuple[Parameter, ...] = tuple(item for item in REGISTRY if item.kind is Kind.FAULT)
FAULT_NAMES: tuple[str, ...] = tuple(item.name for item in FAULTS)
OFFSETS: tuple[Parameter, ...] = tuple(item for item in REGISTRY if item.adds_to is not None)
"""Constant errors of sensors, which a test shows directly."""


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
