"""Settings of a simulated unit: its faults, its other effects and its sensor errors."""

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

    Attributes
    ----------
    Kintas : float
        Clogging of the servovalve first-stage filter.
    FSS : float
        Dry friction between spool and sleeve.
    FDJ : float
        Dry friction between jack and cylinder.

    Raises
    ------
    ConfigurationError
        A constant outside 0 … 1.
    """

    Kintas: float = number(0.0, 0.0, 1.0)
    FSS: float = number(0.0, 0.0, 1.0)
    FDJ: float = number(0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        check_ranges(self, "fault")


@dataclass(frozen=True, slots=True)
class DataErrors:
    """By what share the unit's data differ from its actuator file (PHY-37).

    Each -0.5 … 1; 0.05 means 5 % more than the file says.

    Attributes
    ----------
    GM : float
        Torque-motor gain.
    KSF : float
        Stiffness of the feedback wire.
    KF : float
        Net stiffness of the flapper.
    GP : float
        Pressure gain of the second stage.
    GQ : float
        Flow gain of the second stage.
    CS : float
        Viscous coefficient of the spool.
    CJ : float
        Viscous coefficient of the jack.
    MJ : float
        Mass of jack and surface.
    FSS0 : float
        Static spool friction as new.
    FDJ0 : float
        Dynamic jack friction as new.

    Raises
    ------
    ConfigurationError
        A share outside its range.
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

    Attributes
    ----------
    hysteresis : float
        Torque-motor hysteresis: width of the loop as a fraction of rated current, 0 … 1.
    plays : int
        Number of plays whose mean the hysteresis is, 1 … 256.
    null_bias : float
        Added to the current before hysteresis and gain, A, ±5e-3.
    gain_change : float
        Relative change of the torque-motor gain, -2 (wired the wrong way round) … 1.
    backlash : float
        Half-width of the play between spool and feedback-spring ball, m, 0 … 1e-3.
    oil_temperature : float
        degC, -54 … 205: the range of MIL-PRF-83282.
    supply_pressure : float
        Pa, above the return pressure, at most 100 MPa.
    return_pressure : float
        Pa, 0 … 100 MPa.
    spool_stribeck : float
        Stribeck velocity of the spool's friction, m/s, 0 (none) … 10.
    jack_stribeck : float
        Stribeck velocity of the jack's friction, m/s, 0 (none) … 10.
    load : float
        Constant load on the jack beside the actuator file's FR, N, ±1e6.
    load_spring : float
        Stiffness that draws the jack to its middle, N/m, 0 … 1e8.
    data : DataErrors
        By what the unit's data differ from the actuator file.
    strangers : Strangers
        Effects that no requirement names.

    Raises
    ------
    ConfigurationError
        A value outside the range given beside it.
    """

    hysteresis: float = number(0.0, 0.0, 1.0)
    plays: int = 1
    null_bias: float = number(0.0, -5e-3, 5e-3, "effect null_bias (A)")
    gain_change: float = number(0.0, -2.0, 1.0)
    backlash: float = number(0.0, 0.0, 1e-3, "effect backlash (m)")
    oil_temperature: float = number(40.0, -54.0, 205.0, "oil temperature (degC)")
    supply_pressure: float = number(20.7e6, 0.0, 100e6, "supply pressure (Pa)")
    return_pressure: float = number(0.7e6, 0.0, 100e6, "return pressure (Pa)")
    spool_stribeck: float = number(0.0, 0.0, 10.0, "effect spool_stribeck (m/s)")
    jack_stribeck: float = number(0.0, 0.0, 10.0, "effect jack_stribeck (m/s)")
    load: float = number(0.0, -1e6, 1e6, "effect load (N)")
    load_spring: float = number(0.0, 0.0, 1e8, "effect load_spring (N/m)")
    data: DataErrors = field(default_factory=DataErrors)
    strangers: Strangers = field(default_factory=Strangers)

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

    Attributes
    ----------
    noise_lsb : float
        Electrical noise before conversion, rms, 0 … 100.
    offsets_lsb : tuple[float, float, float, float]
        Constant offset of current, spool, pressure, position, ±4096.
    gains : tuple[float, float, float, float]
        Relative gain errors of current, spool, pressure, position, -1 … 1.
    filter_time : float
        Time constant of the analogue filter before spool and pressure converters, s, 0 … 0.1.
    early : float
        All channels are sampled so long before the end of the tick, s; less than a tick.
    temperature_error : float
        What the oil temperature probe reads too much, K, ±100.
    supply_error : float
        What the supply pressure probe reads too much, Pa, ±20e6.

    Raises
    ------
    ConfigurationError
        A value outside the range given beside it.
    """

    noise_lsb: float = number(0.5, 0.0, 100.0, "sensor noise (LSB)")
    offsets_lsb: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    gains: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    filter_time: float = number(0.0, 0.0, 0.1, "sensor filter_time (s)")
    early: float = number(0.0, 0.0, 1.0, "sensor early (s)")
    temperature_error: float = number(0.0, -100.0, 100.0, "temperature probe error (K)")
    supply_error: float = number(0.0, -20e6, 20e6, "supply probe error (Pa)")

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
