"""Data of one actuator (servovalve, jack, limits, calibration), and its TOML file."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ehadiag.core.criteria import FIT
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import decode_toml, read_toml
from firmware_iface.stored_test import Controller


class ConverterSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One converter: its range is ±full_scale."""

    full_scale: Annotated[float, msgspec.Meta(gt=0, le=1e9)]
    """Half range, SI unit of the channel."""
    bits: Annotated[int, msgspec.Meta(ge=6, le=24)] = 12
    """Width."""


class ConverterSpecs(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The four converters; of those that are left out nothing is known."""

    current: ConverterSpec | msgspec.UnsetType = msgspec.UNSET
    """Of the servovalve current, A."""
    spool: ConverterSpec | msgspec.UnsetType = msgspec.UNSET
    """Of the spool position, m."""
    pressure: ConverterSpec | msgspec.UnsetType = msgspec.UNSET
    """Of the differential pressure, Pa."""
    position: ConverterSpec | msgspec.UnsetType = msgspec.UNSET
    """Of the jack position, m."""


MAX_CALIBRATED_PARAMETERS = 64
MIN_ROOT_DIAGONAL = 1e-9
MAX_NOISE_EXCESS = 1.16
"""Excess up to which a model leaves nothing (`ehadiag.identify.estimates`)."""

LongText = Annotated[str, msgspec.Meta(max_length=1000)]
ShortText = Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
PositiveSize = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
CalibrationNumber = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
CorrelationFactor = Annotated[float, msgspec.Meta(ge=-1.1, le=1.1)]
NonNegativeRatio = Annotated[float, msgspec.Meta(ge=0, le=1e6)]


class CalibrationSource(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A recording that was learned from."""

    name: LongText
    test: ShortText
    sha256: Annotated[str, msgspec.Meta(max_length=64)] = ""
    """Of the log; empty where it was none."""


class FitQuality(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well the model explains the recordings with what was learned."""

    excess: NonNegativeRatio
    """Cost of the residuals over that of noise alone; about 1."""
    outliers: NonNegativeRatio
    """Share of residuals beyond three times the noise."""
    spool_rms: NonNegativeRatio
    """Residual in units of the noise."""
    pressure_rms: NonNegativeRatio

    @property
    def left(self) -> float:
        """What the model leaves beside noise, over what noise alone may leave; 0: nothing."""
        return max(self.excess / MAX_NOISE_EXCESS - 1.0, 0.0)

    @property
    def most_excess(self) -> float:
        """Excess that a later recording of the unit may have."""
        return FIT.wear_excess_factor * self.excess


class Calibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What was learned beside the data, which stand in the file's own tables."""

    date: ShortText
    """UTC, ISO 8601."""
    start: ShortText
    """Name of the actuator that it began with."""
    serial: Annotated[int, msgspec.Meta(ge=0, le=4294967295)] | None = None
    """Of the unit; None where its bus does not say."""
    plays: Annotated[int, msgspec.Meta(ge=1, le=256)] = 1
    """Of the hysteresis (PHY-29)."""
    effects: dict[str, CalibrationNumber]
    """Nuisances of the unit by name, SI."""
    parameters: Annotated[
        tuple[ShortText, ...], msgspec.Meta(min_length=1, max_length=MAX_CALIBRATED_PARAMETERS)
    ]
    """What is not known exactly: effects, and data by their relative error."""
    std: tuple[PositiveSize, ...]
    """Standard deviations of the parameters, SI."""
    root: tuple[tuple[CorrelationFactor, ...], ...]
    """Lower triangle L of their correlation L Lᵀ, row by row."""
    held: dict[str, LongText] = {}
    """What the recordings do not show: why it was held."""
    fit: FitQuality
    evidence: dict[str, CalibrationNumber] = {}
    """Bayesian information criterion of each model that was tried, less the best one's; of open
    loop if there was one."""
    recordings: tuple[CalibrationSource, ...]

    def objection(self) -> str:
        """Return what one key alone cannot tell; empty where all is well."""
        count = len(self.parameters)
        if len(set(self.parameters)) < count:
            return "calibration.parameters: a name stands twice"
        unknown = sorted(set(self.effects) - set(self.parameters))
        if unknown:
            return f"calibration.effects: {', '.join(unknown)} not among calibration.parameters"
        if len(self.std) != count:
            return f"calibration.std: need {count} numbers, one of each parameter"
        if [len(row) for row in self.root] != list(range(1, count + 1)):
            return f"calibration.root: need {count} rows of 1, 2, … numbers"
        if any(row[-1] < MIN_ROOT_DIAGONAL for row in self.root):
            return "calibration.root: the last number of a row must be above 0"
        return ""


ActuatorName = Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
# Each range is some decades about what is built, so that no product of them leaves the numbers.


ExponentOrRange = float | tuple[float, float]
MAX_CLOGGING_EXPONENT = 2.0
"""Largest exponent of the pressure gain behind a clogged filter, 1: that of a filter, turbulent or
laminar, in series with a bridge of turbulent orifices, whose flow is as the root of its pressure;
one behind the bridge's supply has 0."""


class Servovalve(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Two-stage flapper-nozzle servovalve, SI units (PHY-4 to 6, PHY-11)."""

    GM: Annotated[float, msgspec.Meta(ge=1e-4, le=1e4)]
    """Torque-motor gain, N m/A."""
    JF: Annotated[float, msgspec.Meta(ge=1e-9, le=1)]
    """Flapper inertia, N m/(m/s²)."""
    CF: Annotated[float, msgspec.Meta(ge=0, le=1000)]
    """Flapper damping, N m/(m/s)."""
    KF: Annotated[float, msgspec.Meta(ge=0.01, le=1e7)]
    """Net flapper stiffness, N m/m."""
    KSF: Annotated[float, msgspec.Meta(ge=1e-3, le=1e7)]
    """Feedback-wire stiffness, N m/m."""
    XFM: Annotated[float, msgspec.Meta(ge=1e-7, le=0.01)]
    """Flapper stop, m."""
    GQF: Annotated[float, msgspec.Meta(ge=1e-6, le=1e4)]
    """First-stage flow gain as new, m²/s."""
    GPF: Annotated[float, msgspec.Meta(ge=1e6, le=1e16)]
    """First-stage pressure gain, Pa/m."""
    clogging_exponent: ExponentOrRange = 0.0
    """Exponent m of the pressure gain behind a clogged filter, GPF k^m, 1 (PHY-45), or the range
    in which it is: a datum of the valve's maker."""
    AS: Annotated[float, msgspec.Meta(ge=1e-8, le=0.1)]
    """Spool end area, m²."""
    MS: Annotated[float, msgspec.Meta(ge=1e-6, le=100)]
    """Spool mass, kg."""
    CS: Annotated[float, msgspec.Meta(ge=0, le=1e5)]
    """Spool viscous coefficient at 40 °C, N s/m."""
    XSM: Annotated[float, msgspec.Meta(ge=1e-6, le=0.1)]
    """Spool stop, m."""
    FSS0: Annotated[float, msgspec.Meta(ge=0, le=1e5)]
    """Static spool friction as new, N."""
    FSS1: Annotated[float, msgspec.Meta(ge=1e-3, le=1e5)]
    """Static spool friction at the limit of damage, N."""
    PSR: Annotated[float, msgspec.Meta(ge=10000, le=2e8)]
    """Supply minus return pressure, Pa."""
    GP: Annotated[float, msgspec.Meta(ge=1e6, le=1e17)]
    """Pressure gain, Pa/m."""
    GQ: Annotated[float, msgspec.Meta(ge=1e-6, le=1e4)]
    """Flow gain, m²/s."""
    CLK: Annotated[float, msgspec.Meta(ge=0, le=1e-6)]
    """Leakage, m³/(s Pa)."""

    @property
    def clogging_range(self) -> tuple[float, float]:
        """Least and largest exponent of the pressure gain behind a clogged filter, 1."""
        m = self.clogging_exponent
        return m if isinstance(m, tuple) else (m, m)


class Jack(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Jack and control surface, SI units (PHY-7, PHY-11)."""

    AJ: Annotated[float, msgspec.Meta(ge=1e-6, le=10)]
    """Active area, m²."""
    MJ: Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)]
    """Equivalent mass of jack and surface, kg."""
    CJ: Annotated[float, msgspec.Meta(ge=0, le=1e9)]
    """Viscous coefficient at 40 °C, N s/m."""
    XJM: Annotated[float, msgspec.Meta(ge=1e-4, le=10)]
    """Stop, m."""
    FDJ0: Annotated[float, msgspec.Meta(ge=0, le=1e7)]
    """Dynamic friction as new, N."""
    FDJ1: Annotated[float, msgspec.Meta(ge=1e-3, le=1e7)]
    """Dynamic friction at the limit of damage, N."""
    FR: Annotated[float, msgspec.Meta(ge=-1e7, le=1e7)] = 0.0
    """External load, N."""


class SecondStage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How spool position becomes pressure: PHY-6, or the orifices of PHY-39."""

    kind: Literal["linear", "orifice"] = "linear"
    """`linear`: saturating pressure gain, stiff oil; `orifice`: two lands, compressible oil."""
    beta: Annotated[float, msgspec.Meta(ge=1e7, le=3e9)] = 7.5e8
    """Effective bulk modulus of the oil, Pa; of orifices only."""
    volume_of_one_chamber: Annotated[float, msgspec.Meta(ge=1e-7, le=1e-1)] = 1.6e-4
    """Volume of one chamber with its lines, the jack in the middle, m³; of orifices only."""
    volume: Annotated[float, msgspec.Meta(ge=1e-7, le=1e-1)] | msgspec.UnsetType = msgspec.UNSET
    """Former name of `volume_of_one_chamber`, still read."""
    by_position: bool = False
    """Whether the chambers' volumes follow the jack's travel (PHY-42); of orifices only."""


MAX_TOLERANCE = 0.3
ToleranceShare = Annotated[float, msgspec.Meta(ge=0, le=MAX_TOLERANCE)]

VARYING_PARAMETERS = ("GM", "KSF", "KF", "GQF", "CS", "FSS0", "GP", "GQ", "MJ", "CJ", "FDJ0")
"""Data in which units of one type differ, and of which a test shows what matters (PHY-37)."""


class Tolerance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """By what share a unit's data may differ from its file, each evenly within ± so much (PHY-37).

    The ends of the friction scales (FSS1, FDJ1), the stops of spool and jack and the supply have
    none.
    """

    all: ToleranceShare = 0.0
    """Of each of `VARYING_PARAMETERS` that is not named."""
    GM: ToleranceShare | None = None
    KSF: ToleranceShare | None = None
    KF: ToleranceShare | None = None
    JF: ToleranceShare | None = None
    CF: ToleranceShare | None = None
    XFM: ToleranceShare | None = None
    GQF: ToleranceShare | None = None
    GPF: ToleranceShare | None = None
    AS: ToleranceShare | None = None
    MS: ToleranceShare | None = None
    CS: ToleranceShare | None = None
    FSS0: ToleranceShare | None = None
    GP: ToleranceShare | None = None
    GQ: ToleranceShare | None = None
    CLK: ToleranceShare | None = None
    AJ: ToleranceShare | None = None
    MJ: ToleranceShare | None = None
    CJ: ToleranceShare | None = None
    FDJ0: ToleranceShare | None = None

    def of(self, name: str) -> float:
        """Return the tolerance of a datum."""
        own: float | None = getattr(self, name)
        if own is not None:
            return own
        return self.all if name in VARYING_PARAMETERS else 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Data that have one."""
        return tuple(name for name in self.__struct_fields__[1:] if self.of(name) > 0.0)


DiscrepancyShare = Annotated[float, msgspec.Meta(ge=0, le=0.5)]


class Discrepancy(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviation of each severity by a wrong law of the fault, over the severity, 1.

    What a unit shows as new says nothing of it (Kennedy and O'Hagan, J. R. Stat. Soc. B 63(3),
    2001).
    """

    Kintas: DiscrepancyShare = 0.01
    """Of the filter's clogging."""
    FSS: DiscrepancyShare = 0.03
    """Of the spool's friction, whose law is that of clogging too."""
    FDJ: DiscrepancyShare = 0.01
    """Of the jack's friction."""


class EffectLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sizes, of either sign, beyond which an effect of the unit is a fault of its own."""

    null_bias: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.03
    """Of rated current."""
    hysteresis: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.06
    """Full width over rated current."""
    backlash: Annotated[float, msgspec.Meta(gt=0, le=1e-3)] = 8e-6
    """Half-width, m."""
    torque_motor_gain: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.1
    """Relative change."""


class Advice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What to do about each fault, as the end of "Plan to …"; empty: nothing is said."""

    Kintas: LongText = "clean or replace the filter of the servovalve's first stage"
    FSS: LongText = "replace the servovalve"
    FDJ: LongText = "overhaul the jack"


class Actuator(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One actuator: its parts, how far their data may be off, what was learned of the unit."""

    name: ActuatorName
    controller: Controller
    servovalve: Servovalve
    jack: Jack
    second_stage: SecondStage = SecondStage()
    limits: EffectLimits = EffectLimits()
    tolerance: Tolerance = Tolerance()
    discrepancy: Discrepancy = Discrepancy()
    converters: ConverterSpecs | msgspec.UnsetType = msgspec.UNSET
    """Behind the measured channels; unset: nothing is known of them."""
    advice: Advice = Advice()
    """What to do about a fault; no datum of the model."""
    calibration: Calibration | None = None
    """What was learned of this unit; None: the data are those of a type."""


def load_actuator(path: Path | str) -> Actuator:
    """Read an actuator file.

    Parameters
    ----------
    path : Path | str
        File to read.

    Returns
    -------
    Actuator
        The actuator's data, checked.

    Raises
    ------
    InputOutputError
        The file cannot be read.
    ConfigurationError
        Not TOML, a key unknown or missing, a value out of its range.
    """
    return _checked(read_toml(Path(path), Actuator, "actuator file"), f"actuator file {path}")


@cache
def default_actuator() -> Actuator:
    """Return the reference actuator, which comes with the package."""
    text = Path(__file__).parents[1].joinpath("data/actuator.toml").read_bytes()
    return _checked(decode_toml(text, Actuator, "bundled actuator.toml"), "bundled actuator.toml")


def with_tolerance(actuator: Actuator, share: float) -> Actuator:
    """Return the same actuator, the data in which units differ with one tolerance.

    actuator: its file's own tolerances do not count; share: the tolerance, 0 … `MAX_TOLERANCE`.
    ConfigurationError: the actuator is calibrated: what was found takes the place of tolerances.
    """
    if actuator.calibration is not None:
        raise ConfigurationError(
            f"tolerance: actuator {actuator.name!r} is calibrated, which says how far its data may"
            " be off"
        )
    return msgspec.structs.replace(actuator, tolerance=Tolerance(all=share))


def _checked(actuator: Actuator, source: str) -> Actuator:
    """Check what one key alone cannot tell."""
    if actuator.servovalve.FSS1 <= actuator.servovalve.FSS0:
        raise ConfigurationError(f"{source}: servovalve.FSS1 must be greater than servovalve.FSS0")
    if actuator.jack.FDJ1 <= actuator.jack.FDJ0:
        raise ConfigurationError(f"{source}: jack.FDJ1 must be greater than jack.FDJ0")
    stage = actuator.second_stage
    if stage.volume is not msgspec.UNSET:
        stage = msgspec.structs.replace(
            stage, volume_of_one_chamber=stage.volume, volume=msgspec.UNSET
        )
        actuator = msgspec.structs.replace(actuator, second_stage=stage)
    low, high = actuator.servovalve.clogging_range
    if not 0.0 <= low <= high <= MAX_CLOGGING_EXPONENT:
        raise ConfigurationError(
            f"{source}: servovalve.clogging_exponent: need a number from 0 to"
            f" {MAX_CLOGGING_EXPONENT:g}, or the two ends of a range, the smaller one first"
        )
    objection = actuator.calibration.objection() if actuator.calibration else ""
    if objection:
        raise ConfigurationError(f"{source}: {objection}")
    return actuator


ACTUATOR_FILE_HEAD = (
    "# Written by `ehadiag calibrate`; SI units. Keys: docs/reference/actuator-file.md.\n"
)


def actuator_toml(actuator: Actuator) -> bytes:
    """Return an actuator as TOML, every number to its last digit.

    actuator: the data. Returns UTF-8.
    """
    tree: Any = msgspec.to_builtins(actuator)
    import tomli_w  # noqa: PLC0415 - only where a file is written

    return (ACTUATOR_FILE_HEAD + tomli_w.dumps(_without_none(tree))).encode()


def _without_none(node: Any) -> Any:
    """Leave out what is not there: TOML has no word for it."""
    if isinstance(node, dict):
        return {key: _without_none(value) for key, value in node.items() if value is not None}
    if isinstance(node, list | tuple):
        return [_without_none(item) for item in node]
    return node
