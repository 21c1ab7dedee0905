"""State of a simulated actuator: its faults, its effects, and the errors of its sensors."""

from __future__ import annotations

from dataclasses import dataclass, field

from ehadiag.core.errors import ConfigurationError
from ehadiag_sim.plant.checked import check_ranges, number, within
from ehadiag_sim.plant.strangers import Strangers

__all__ = ["DataErrors", "Effects", "Faults", "Sensors", "Strangers"]

CHANNEL_COUNT = 4


@dataclass(frozen=True, slots=True)
class Faults:
    """The three progressive faults (PHY-12 to 15), each 0 (as new) … 1 (limit of damage).

    Raises
    ------
    ConfigurationError: a constant outside 0 … 1.
    """

    Kintas: float = number(0.0, 0.0, 1.0)
    """Clogging of the servovalve first-stage filter."""
    FSS: float = number(0.0, 0.0, 1.0)
    """Dry friction between spool and sleeve."""
    FDJ: float = number(0.0, 0.0, 1.0)
    """Dry friction between jack and cylinder."""

    def __post_init__(self) -> None:
        check_ranges(self, "fault")


@dataclass(frozen=True, slots=True)
class DataErrors:
    """By what share the unit's data differ from its actuator file (PHY-37).

    Each -0.5 … 1; 0.05 means 5 % more than the file says.

    Raises
    ------
    ConfigurationError: a share outside its range.
    """

    GM: float = number(0.0, -0.5, 1.0)
    KSF: float = number(0.0, -0.5, 1.0)
    KF: float = number(0.0, -0.5, 1.0)
    GP: float = number(0.0, -0.5, 1.0)
    GQ: float = number(0.0, -0.5, 1.0)
    CS: float = number(0.0, -0.5, 1.0)
    CJ: float = number(0.0, -0.5, 1.0)
    MJ: float = number(0.0, -0.5, 1.0)
    FSS0: float = number(0.0, -0.5, 1.0)
    FDJ0: float = number(0.0, -0.5, 1.0)

    def __post_init__(self) -> None:
        check_ranges(self, "data error")


@dataclass(frozen=True, slots=True)
class Effects:
    """What the three faults leave out (PHY-16 to 39).

    Raises
    ------
    ConfigurationError: a value outside the range given beside it.
    """

    hysteresis: float = number(0.0, 0.0, 1.0)
    """Torque-motor hysteresis: width of the loop as a fraction of rated current, 0 … 1."""
    plays: int = 1
    """Number of plays whose mean the hysteresis is, 1 … 256."""
    null_bias: float = number(0.0, -5e-3, 5e-3, "effect null_bias (A)")
    """Added to the current before hysteresis and gain, A, ±5e-3."""
    gain_change: float = number(0.0, -2.0, 1.0)
    """Relative change of the torque-motor gain, -2 (wired the wrong way round) … 1."""
    backlash: float = number(0.0, 0.0, 1e-3, "effect backlash (m)")
    """Half-width of the play between spool and feedback-spring ball, m, 0 … 1e-3."""
    oil_temperature: float = number(40.0, -54.0, 205.0, "oil temperature (degC)")
    """degC, -54 … 205: the range of MIL-PRF-83282."""
    supply_pressure: float = number(20.7e6, 0.0, 100e6, "supply pressure (Pa)")
    """Pa, above the return pressure, at most 100 MPa."""
    return_pressure: float = number(0.7e6, 0.0, 100e6, "return pressure (Pa)")
    """Pa, 0 … 100 MPa."""
    spool_stribeck: float = number(0.0, 0.0, 10.0, "effect spool_stribeck (m/s)")
    """Stribeck velocity of the spool's friction, m/s, 0 (none) … 10."""
    jack_stribeck: float = number(0.0, 0.0, 10.0, "effect jack_stribeck (m/s)")
    """Stribeck velocity of the jack's friction, m/s, 0 (none) … 10."""
    load: float = number(0.0, -1e6, 1e6, "effect load (N)")
    """Constant load on the jack beside the actuator file's FR, N, ±1e6."""
    load_spring: float = number(0.0, 0.0, 1e8, "effect load_spring (N/m)")
    """Stiffness that draws the jack to its middle, N/m, 0 … 1e8."""
    data: DataErrors = field(default_factory=DataErrors)
    """By what the unit's data differ from the actuator file."""
    strangers: Strangers = field(default_factory=Strangers)
    """Effects that no requirement names."""

    def __post_init__(self) -> None:
        check_ranges(self, "effect")
        within("effect plays", self.plays, 1, 256)
        if self.plays != int(self.plays):
            raise ConfigurationError(f"effect plays: {self.plays} is not a whole number")
        if self.supply_pressure <= self.return_pressure:
            raise ConfigurationError("supply pressure must be greater than return pressure")


@dataclass(frozen=True, slots=True)
class Sensors:
    """How converters and probes err (PHY-21, 22, 33 to 38); offsets in LSB of each channel.

    Raises
    ------
    ConfigurationError: a value outside the range given beside it.
    """

    noise_lsb: float = number(0.5, 0.0, 100.0, "sensor noise (LSB)")
    """Electrical noise before conversion, rms, 0 … 100."""
    offsets_lsb: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Constant offset of current, spool, pressure, position, ±4096."""
    gains: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Relative gain errors of current, spool, pressure, position, -1 … 1."""
    filter_time: float = number(0.0, 0.0, 0.1, "sensor filter_time (s)")
    """Time constant of the analogue filter before spool and pressure converters, s, 0 … 0.1."""
    early: float = number(0.0, 0.0, 1.0, "sensor early (s)")
    """All channels are sampled so long before the end of the tick, s; less than a tick."""
    temperature_error: float = number(0.0, -100.0, 100.0, "temperature probe error (K)")
    """What the oil temperature probe reads too much, K, ±100."""
    supply_error: float = number(0.0, -20e6, 20e6, "supply probe error (Pa)")
    """What the supply pressure probe reads too much, Pa, ±20e6."""

    def __post_init__(self) -> None:
        check_ranges(self, "sensor")
        for name, values, limit in (
            ("offset (LSB)", self.offsets_lsb, 4096.0),
            ("gain", self.gains, 1.0),
        ):
            if len(values) != CHANNEL_COUNT:
                raise ConfigurationError(
                    f"sensor {name.split()[0]}s: need {CHANNEL_COUNT} values, not {len(values)}"
                )
            for value in values:
                within(f"sensor {name}", value, -limit, limit)
