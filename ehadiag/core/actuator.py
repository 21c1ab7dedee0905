"""Data of one actuator (controller, servovalve, jack), read from a TOML file and checked."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ehadiag.core.calibration import Calibration
from ehadiag.core.converters import Converters
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.toml_file import decode_toml, read_toml

__all__ = [
    "MOST_TOLERANCE",
    "VARYING",
    "Actuator",
    "Controller",
    "Jack",
    "Limits",
    "SecondStage",
    "Servovalve",
    "Tolerance",
    "default_actuator",
    "load_actuator",
    "with_tolerance",
]

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
# Each range is some decades about what is built, so that no product of them leaves the numbers.


class Controller(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Position controller of the flight-control computer (PHY-2)."""

    IM: Annotated[float, msgspec.Meta(ge=1e-4, le=10)]
    """Rated current and saturation, A."""
    GAP: Annotated[float, msgspec.Meta(ge=0, le=1e4)]
    """Proportional gain, A/m."""
    GAI: Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)] = 0.0
    """Integral gain, A/(m s)."""
    GAD: Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)] = 0.0
    """Derivative gain, A s/m."""
    rate: Annotated[float, msgspec.Meta(ge=10, le=1e5)] = 1000.0
    """Control rate, Hz."""


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
    volume: Annotated[float, msgspec.Meta(ge=1e-7, le=1e-1)] = 1.6e-4
    """Volume of both chambers together, m³; of orifices only."""


MOST_TOLERANCE = 0.3
Share = Annotated[float, msgspec.Meta(ge=0, le=MOST_TOLERANCE)]

VARYING = ("GM", "KSF", "KF", "GQF", "CS", "FSS0", "GP", "GQ", "MJ", "CJ", "FDJ0")
"""Data in which units of one type differ, and of which a test shows what matters (PHY-37)."""


class Tolerance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """By what share a unit's data may differ from its file, each evenly within ± so much (PHY-37).

    The ends of the friction scales (FSS1, FDJ1), the stops of spool and jack and the supply have
    none.
    """

    all: Share = 0.0
    """Of each of `VARYING` that is not named."""
    GM: Share | None = None
    KSF: Share | None = None
    KF: Share | None = None
    JF: Share | None = None
    CF: Share | None = None
    XFM: Share | None = None
    GQF: Share | None = None
    GPF: Share | None = None
    AS: Share | None = None
    MS: Share | None = None
    CS: Share | None = None
    FSS0: Share | None = None
    GP: Share | None = None
    GQ: Share | None = None
    CLK: Share | None = None
    AJ: Share | None = None
    MJ: Share | None = None
    CJ: Share | None = None
    FDJ0: Share | None = None

    def of(self, name: str) -> float:
        """Return the tolerance of a datum."""
        own: float | None = getattr(self, name)
        if own is not None:
            return own
        return self.all if name in VARYING else 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Data that have one."""
        return tuple(name for name in self.__struct_fields__[1:] if self.of(name) > 0.0)


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sizes, of either sign, beyond which an effect of the unit is a fault of its own."""

    null_bias: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.03
    """Of rated current."""
    hysteresis: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.06
    """Full width over rated current."""
    backlash: Annotated[float, msgspec.Meta(gt=0, le=1e-3)] = 8e-6
    """Half-width, m."""
    torque_motor_gain: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.1
    """Relative change."""


class Actuator(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One actuator: its parts, how far their data may be off, what was learned of the unit."""

    name: Name
    controller: Controller
    servovalve: Servovalve
    jack: Jack
    second_stage: SecondStage = SecondStage()
    limits: Limits = Limits()
    tolerance: Tolerance = Tolerance()
    converters: Converters | msgspec.UnsetType = msgspec.UNSET
    """Behind the measured channels; unset: nothing is known of them."""
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


def default_actuator() -> Actuator:
    """Return the reference actuator, which comes with the package."""
    text = resources.files("ehadiag").joinpath("data/actuator.toml").read_bytes()
    return _checked(decode_toml(text, Actuator, "bundled actuator.toml"), "bundled actuator.toml")


def with_tolerance(actuator: Actuator, share: float) -> Actuator:
    """Return the same actuator, the data in which units differ with one tolerance.

    Parameters
    ----------
    actuator : Actuator
        Its file's own tolerances do not count.
    share : float
        The tolerance, 0 … `MOST_TOLERANCE`.

    Returns
    -------
    Actuator
        As new data.

    Raises
    ------
    ConfigurationError
        The actuator is calibrated: what was found takes the place of tolerances.
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
    objection = actuator.calibration.objection() if actuator.calibration else ""
    if objection:
        raise ConfigurationError(f"{source}: {objection}")
    return actuator
