"""A parameter of the identification: bounds, and its effect on the physical constants.

Here are also the parameters for errors of an actuator's data file and of the oil and supply probes.
The torque motor's gain is not among these: no recording could tell it from the nuisance of that
name. The ends of the friction scales (FSS1, FDJ1) have no tolerance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from ehadiag.core.actuator import Actuator
from ehadiag.model.plant import PLANT_FIELDS, ConstantValue, PlantConstants
from ehadiag.model.severities import FAULT_LAWS
from firmware_iface.recording import CHANNELS, Channels

ConstantChanges = Mapping[str, ConstantValue]
"""Fields of `PlantConstants` with the values that they take."""


class ParameterKind(Enum):
    """Kind of a parameter; the effects of all parameters are applied in the order of the kinds."""

    DATUM = "datum"
    """By how much the unit differs from its actuator file, or a probe from the truth."""
    NUISANCE = "nuisance"
    """Of the installation or of the day: estimated so that it does not pass for a fault."""
    FAULT = "fault"
    """A progressive fault: a severity from 0, as new, to 1, limit of damage."""


class UsualSizes(NamedTuple):
    """Usual sizes of parameters of any unit."""

    severity_mean: float = 0.4
    """Mean of a severity, 1."""
    severity_std: float = 0.3
    """Standard deviation of a severity, 1."""
    nuisance_mean: float = 0.5
    """Mean of a nuisance that is never negative, in units of its scale."""
    nuisance_std: float = 0.4
    """Standard deviation of a nuisance that is never negative, in units of its scale."""
    signed_std: float = 0.5
    """Standard deviation of a nuisance of either sign, in units of its scale."""


USUAL = UsualSizes()


class Parameter(msgspec.Struct, frozen=True):
    """One scalar that can be estimated."""

    name: str
    """Identifier in tables, files and reports."""
    symbol: str
    """As the specification writes it."""
    unit: str
    """SI."""
    lower: float
    upper: float
    """Bounds."""
    kind: ParameterKind
    scale: float
    """What is large: points of a search are in units of it, derivatives over a share of it."""
    short: str
    meaning: str
    """In two words, and in a line."""
    changes: Callable[[PlantConstants, ConstantValue], ConstantChanges]
    """(constants, value) -> the fields of the constants that it changes; pure, and for arrays
    too."""
    adds_to: int | None = None
    """Row of the residuals to which the parameter is simply added (a constant error of a sensor):
    its derivative is known. None: it acts through the model."""
    sized_by: str | None = None
    """Channel with whose range bounds and scale grow: they are given for the default range."""
    limit: str | None = None
    """Field of the actuator file's `limits` beyond which the effect is a fault of its own."""
    datum: str | None = None
    """Key of the actuator file that the parameter is the relative error of."""
    datum_unit: str = ""
    """SI unit of that datum."""
    passes_for: str | None = None
    """Severity with the same effect, which no recording distinguishes."""
    day_std: float | None = None
    """Deviation of what differs from day to day, which no calibration can keep."""
    condition: str | None = None
    """Condition of the simulator that makes it, where its name is another one."""
    basic: bool = False
    """Whether `--nuisances` frees it."""

    @property
    def prior(self) -> tuple[float, float]:
        """Mean and deviation of its usual size, the prior of any unit."""
        if self.kind is ParameterKind.FAULT:
            return USUAL.severity_mean, USUAL.severity_std
        if self.lower >= 0.0:
            return USUAL.nuisance_mean * self.scale, USUAL.nuisance_std * self.scale
        return 0.0, USUAL.signed_std * self.scale

    @property
    def needs_yielding_oil(self) -> bool:
        """Whether it acts on a second stage of orifices alone, in which the oil yields."""
        return set(self.changes(PlantConstants(*(1.0,) * PLANT_FIELDS), 0.0)) == {"OIL"}

    def limit_of(self, actuator: Actuator) -> float | None:
        """Largest size, SI, of either sign, of a sound unit; None where there is no limit.

        That of a current is a share of the rated one.
        """
        if self.limit is None:
            return None
        limit = float(getattr(actuator.limits, self.limit))
        return limit * actuator.controller.IM if self.unit == "A" else limit


def scaled_to_channels(item: Parameter, channels: Channels) -> Parameter:
    """Return a parameter with bounds and scale for converters of these ranges."""
    if item.sized_by is None:
        return item
    names = [channel.name for channel in CHANNELS]
    index = names.index(item.sized_by)
    ratio = channels[index].full_scale / CHANNELS[index].full_scale
    if ratio == 1.0:
        return item
    return replace(
        item,
        lower=item.lower * ratio,
        upper=item.upper * ratio,
        scale=item.scale * ratio,
        sized_by=None,
    )


DATUM_ERROR_BOUND = 0.3
"""Relative error of a datum beyond which a unit is another one than its file describes."""
USUAL_DATUM_ERROR = 0.05
"""Usual tolerance of a data sheet."""


FAULT_OF_CONSTANT = {law.constant: name for name, law in FAULT_LAWS.items()}


def _datum(symbol: str, unit: str, short: str, field: str | None = None) -> Parameter:
    """Relative error of a datum; `field`: of the constants, where its name is another one."""
    name = field or symbol

    def changes(c: PlantConstants, value: ConstantValue) -> ConstantChanges:
        return {name: getattr(c, name) * (1.0 + value)}

    return Parameter(
        name=f"datum_{symbol}",
        symbol=f"d{symbol}",
        unit="1",
        lower=-DATUM_ERROR_BOUND,
        upper=DATUM_ERROR_BOUND,
        kind=ParameterKind.DATUM,
        scale=USUAL_DATUM_ERROR,
        short=short,
        meaning=f"relative error of the actuator file's {symbol}, {short}",
        changes=changes,
        datum=symbol,
        datum_unit=unit,
        passes_for=FAULT_OF_CONSTANT.get(name),
    )


DATA_ERROR_PARAMETERS: tuple[Parameter, ...] = (
    _datum("KSF", "N m/m", "feedback-wire stiffness"),
    _datum("KF", "N m/m", "flapper stiffness"),
    _datum("JF", "N m s²/m", "flapper inertia"),
    _datum("CF", "N m s/m", "flapper damping"),
    _datum("XFM", "m", "flapper stop"),
    _datum("GQF", "m²/s", "first-stage flow gain"),
    _datum("GPF", "Pa/m", "first-stage pressure gain"),
    _datum("AS", "m²", "spool end area"),
    _datum("MS", "kg", "spool mass"),
    _datum("CS", "N s/m", "spool viscous coefficient"),
    _datum("FSS0", "N", "spool friction as new", "FSS"),
    _datum("GP", "Pa/m", "pressure gain"),
    _datum("GQ", "m²/s", "flow gain"),
    _datum("CLK", "m³/(s Pa)", "leakage"),
    _datum("AJ", "m²", "jack area"),
    _datum("MJ", "kg", "jack mass"),
    _datum("CJ", "N s/m", "jack viscous coefficient"),
    _datum("FDJ0", "N", "jack friction as new", "FDJ"),
    Parameter(
        name="bulk_modulus",
        symbol="dβ",
        unit="1",
        lower=-0.9,
        upper=1.0,
        kind=ParameterKind.DATUM,
        scale=0.1,
        short="bulk modulus",
        meaning="relative error of the actuator file's β, the oil's bulk modulus; of orifices only",
        changes=lambda c, value: {"OIL": c.OIL * (1.0 + value)},
        datum="beta",
        datum_unit="Pa",
    ),
    Parameter(
        name="datum_volume_of_one_chamber",
        symbol="dV",
        unit="1",
        lower=-DATUM_ERROR_BOUND,
        upper=DATUM_ERROR_BOUND,
        kind=ParameterKind.DATUM,
        scale=USUAL_DATUM_ERROR,
        short="volume of one chamber",
        meaning="relative error of the actuator file's V, the volume of one chamber",
        changes=lambda c, value: {"OIL": c.OIL / (1.0 + value), "CHB": c.CHB / (1.0 + value)},
        datum="volume_of_one_chamber",
        datum_unit="m³",
    ),
    Parameter(
        name="oil_viscosity",
        symbol="dν",
        unit="1",
        lower=-0.5,
        upper=1.0,
        kind=ParameterKind.DATUM,
        scale=0.05,
        short="oil viscosity",
        meaning="relative error of the viscosity that the oil's temperature probe makes believe",
        changes=lambda c, value: {
            "CS": c.CS * (1.0 + value),
            "CJ": c.CJ * (1.0 + value),
            "CLK": c.CLK / (1.0 + value),
        },
        day_std=0.038,  # a probe 2 K off, evenly: 3.3 % of viscosity each
    ),
    Parameter(
        name="supply_pressure",
        symbol="dPSR",
        unit="Pa",
        lower=-5e6,
        upper=5e6,
        kind=ParameterKind.DATUM,
        scale=1e5,
        short="supply pressure",
        meaning="error of the supply less return pressure that the probes show",
        changes=lambda c, value: {"PSR": c.PSR + value},
        day_std=0.058e6,  # a probe 0.1 MPa off, evenly
    ),
)
"""In the order of the chain: first stage, second stage, jack, oil and supply."""
