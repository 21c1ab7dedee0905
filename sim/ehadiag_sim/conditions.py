"""Settings of a simulated unit, with their ranges: faults, other effects, sensor errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import CHANNELS


class ConditionOption(NamedTuple):
    """Command-line option of one field of a condition."""

    field: str
    flag: str
    """Name of the option, such as `--null-bias-mA`."""
    metavar: str
    """Unit of the value, or its symbol in the help."""
    help: str
    """Meaning and usual size."""
    scale: float
    """SI value of one unit."""
    default: Any
    """Default value in the option's unit; a tuple for an option of several values."""
    basic: bool
    """Whether the option stands with the severities, not with the rest of its class."""

    @property
    def key(self) -> str:
        """Name in a scenario."""
        return self.flag.removeprefix("--").replace("-", "_")


def condition_field(
    default: Any,
    low: float,
    high: float,
    what: str = "",
    *,
    option: str = "",
    help: str = "",
    scale: float = 1.0,
    basic: bool = False,
) -> Any:
    """Field of a frozen data class with default, range, and option of the command line.

    default: number, or one number for each channel; SI; low: least value; high: largest value;
    what: name in errors, with the unit; empty: the name of the field; option: name and placeholder
    of the option, `--null-bias-mA mA`; empty: there is none; help: see `ConditionOption`; scale:
    see `ConditionOption`; basic: see `ConditionOption`. Returns for the body of a data class.
    """
    metadata = {"range": (low, high), "what": what}
    flag, _, metavar = option.partition(" ")
    shown = default / scale if isinstance(default, float) else default
    rest = (flag, metavar, help, scale, shown, basic)
    return field(default=default, metadata=metadata | ({"option": rest} if option else {}))


def condition_options(kind: type[Any]) -> list[ConditionOption]:
    """Return the options of a class of conditions, in the order of its fields."""
    return [
        ConditionOption(item.name, *item.metadata["option"])
        for item in fields(kind)
        if "option" in item.metadata
    ]


def check_ranges(item: Any, kind: str) -> None:
    """Raise ConfigurationError for a field of `condition_field` outside its range or length.

    kind: what the fields are, for the message ("fault").
    """
    for entry in fields(item):
        if "range" in entry.metadata:
            low, high = entry.metadata["range"]
            what = entry.metadata["what"] or f"{kind} {entry.name}"
            value, usual = getattr(item, entry.name), entry.default
            if isinstance(usual, tuple) and len(value) != len(usual):
                named = f"{kind} {entry.name.removesuffix('_lsb')}"
                raise ConfigurationError(f"{named}: need {len(usual)} values, not {len(value)}")
            for number in value if isinstance(value, tuple) else (value,):
                check_within(what, number, low, high)


def check_within(what: str, value: float, low: float, high: float) -> None:
    """Raise ConfigurationError unless `value` is finite and from `low` to `high`."""
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigurationError(f"{what}: {value:g} is outside {low:g} … {high:g}")


@dataclass(frozen=True, slots=True)
class UnmodelledEffects:
    """Effects that a bench may show and no requirement names, unknown to the identification; 0:
    none.

    A value outside its range raises ConfigurationError.
    """

    # fmt: off
    torque_cubic: float = condition_field(0.0, -0.5, 0.5,
        option="--torque-cubic C", help="torque × (1 + C·(i/IM)²); a size to try: -0.05")
    play_skew: float = condition_field(0.0, -10.0, 10.0,
        option="--play-skew K",
        help="weights of the plays fall as exp(-K·(i + 0.5)/n); a size to try: 3")
    driver_lag: float = condition_field(0.0, 0.0, 5e-3,
        option="--driver-lag-ms ms", scale=1e-3,
        help="time constant of the current driver; a size to try: 0.3")
    land_asymmetry: float = condition_field(0.0, -0.5, 0.5,
        option="--land-asymmetry A",
        help="lands open by 1 ± A of the travel to either side; a size to try: 0.03")
    land_shift: float = condition_field(0.0, -1e-4, 1e-4,
        option="--land-shift-um um", scale=1e-6,
        help="spool position at which the lands are closed; a size to try: 2")
    spool_bend_2: float = condition_field(0.0, -0.3, 0.3,
        option="--spool-bend-square A",
        help="spool sensor × (1 + A·x/XSM + B·(x/XSM)²); a size to try: 0.005")
    spool_bend_3: float = condition_field(0.0, -0.3, 0.3,
        option="--spool-bend-cubic B", help="and B; a size to try: 0.01")
    jack_bend_2: float = condition_field(0.0, -0.3, 0.3,
        option="--jack-bend-square A", help="the same for jack sensor and XJM")
    jack_bend_3: float = condition_field(0.0, -0.3, 0.3,
        option="--jack-bend-cubic B", help="and B")
    oil_drift: float = condition_field(0.0, -20.0, 20.0,
        option="--oil-drift-K-s K/s", help="the oil warms during the test; a size to try: 1")
    friction_asymmetry: float = condition_field(0.0, -0.9, 0.9,
        option="--friction-asymmetry A",
        help="jack friction × (1 ± A) out and in; a size to try: 0.05")
    spool_friction_slope: float = condition_field(0.0, -0.9, 0.9,
        option="--spool-friction-slope A",
        help="spool friction × (1 + A·XS/XSM); a size to try: 0.05")
    spool_end_volume: float = condition_field(0.0, 0.0, 1e-5,
        option="--spool-end-volume-ul ul", scale=1e-9,
        help="oil at each end of the spool, which yields; a size to try: 20")
    underlap_errors: tuple[float, ...] = condition_field((0.0,) * 4, -0.9, 0.9,
        option="--underlap-errors FRACTION",
        help="by how much the underlap of each of the four lands of an orifice stage is off"
        " 2·PSR/GP; a size to try: ±0.08")
    # fmt: on

    def __post_init__(self) -> None:
        check_ranges(self, "unmodelled effect")


@dataclass(frozen=True, slots=True)
class Faults:
    """The three progressive faults (PHY-12 to 15), each 0 (as new) … 1 (limit of damage).

    A value outside its range raises ConfigurationError.
    """

    # fmt: off
    Kintas: float = condition_field(0.0, 0.0, 1.0,
        option="--Kintas K", help="clogging of the first-stage filter, 0 … 1 (default 0)")
    FSS: float = condition_field(0.0, 0.0, 1.0,
        option="--FSS K", help="spool-sleeve friction, 0 … 1 (default 0)")
    FDJ: float = condition_field(0.0, 0.0, 1.0,
        option="--FDJ K", help="jack-cylinder friction, 0 … 1 (default 0)")
    # fmt: on

    def __post_init__(self) -> None:
        check_ranges(self, "fault")


@dataclass(frozen=True, slots=True)
class DataErrors:
    """Relative differences of the unit's data from its actuator file (PHY-37), each -0.5 … 1.

    A value outside its range raises ConfigurationError.
    """

    GM: float = condition_field(0.0, -0.5, 1.0)
    """Torque-motor gain."""
    KSF: float = condition_field(0.0, -0.5, 1.0)
    """Stiffness of the feedback wire."""
    KF: float = condition_field(0.0, -0.5, 1.0)
    """Net stiffness of the flapper."""
    GP: float = condition_field(0.0, -0.5, 1.0)
    """Pressure gain of the second stage."""
    GQ: float = condition_field(0.0, -0.5, 1.0)
    """Flow gain of the second stage."""
    CS: float = condition_field(0.0, -0.5, 1.0)
    """Viscous coefficient of the spool."""
    CJ: float = condition_field(0.0, -0.5, 1.0)
    """Viscous coefficient of the jack."""
    MJ: float = condition_field(0.0, -0.5, 1.0)
    """Mass of jack and surface."""
    FSS0: float = condition_field(0.0, -0.5, 1.0)
    """Static spool friction as new."""
    FDJ0: float = condition_field(0.0, -0.5, 1.0)
    """Dynamic jack friction as new."""

    def __post_init__(self) -> None:
        check_ranges(self, "data error")


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects that the three faults leave out (PHY-16 to 39).

    A value outside its range raises ConfigurationError.
    """

    # fmt: off
    hysteresis: float = condition_field(0.0, 0.0, 1.0,
        option="--hysteresis FRACTION",
        help="torque-motor hysteresis, full width of the loop as a fraction of IM; usual:"
        " 0.01 … 0.04")
    plays: int = condition_field(1, 1, 256,
        option="--plays N",
        help="number of plays whose mean the hysteresis is (default 1); usual: 1 … 16")
    null_bias: float = condition_field(0.0, -5e-3, 5e-3, "effect null_bias (A)",
        option="--null-bias-mA mA", help="null bias; usual: up to ±0.2 (2 % of IM)", scale=1e-3)
    gain_change: float = condition_field(0.0, -2.0, 1.0,
        option="--gain-change FRACTION", help="of the torque-motor gain; usual: ±0.05")
    backlash: float = condition_field(0.0, 0.0, 1e-3, "effect backlash (m)",
        option="--backlash-um um", scale=1e-6,
        help="half-width of the play between spool and feedback ball; usual: 0 … 5")
    oil_temperature: float = condition_field(40.0, -54.0, 205.0, "oil temperature (degC)",
        option="--oil-temperature degC", help="(default 40)", basic=True)
    supply_pressure: float = condition_field(20.7e6, 0.0, 100e6, "supply pressure (Pa)",
        option="--supply MPa", scale=1e6, basic=True,
        help="supply pressure (default 20.7; return 0.7)")
    return_pressure: float = condition_field(0.7e6, 0.0, 100e6, "return pressure (Pa)")
    spool_stribeck: float = condition_field(0.0, 0.0, 10.0, "effect spool_stribeck (m/s)",
        option="--spool-stribeck-mm-s mm/s", scale=1e-3,
        help="Stribeck velocity of the spool's friction; usual: 1 … 50")
    jack_stribeck: float = condition_field(0.0, 0.0, 10.0, "effect jack_stribeck (m/s)",
        option="--jack-stribeck-mm-s mm/s", scale=1e-3,
        help="Stribeck velocity of the jack's friction; usual: 1 … 50")
    load: float = condition_field(0.0, -1e6, 1e6, "effect load (N)",
        option="--load-N N", help="constant load on the jack; usual: near 0 on the ground")
    load_spring: float = condition_field(0.0, 0.0, 1e8, "effect load_spring (N/m)",
        option="--load-spring-N-mm N/mm", scale=1e3,
        help="load spring that draws the jack to its middle; usual: near 0 on the ground")
    data: DataErrors = field(default_factory=DataErrors)
    unmodelled: UnmodelledEffects = field(default_factory=UnmodelledEffects)
    # fmt: on

    def __post_init__(self) -> None:
        check_ranges(self, "effect")
        if self.plays != int(self.plays):
            raise ConfigurationError(f"effect plays: {self.plays} is not a whole number")
        if self.supply_pressure <= self.return_pressure:
            raise ConfigurationError("supply pressure must be greater than return pressure")


@dataclass(frozen=True, slots=True)
class Sensors:
    """Errors of converters and probes (PHY-21, 22, 33 to 38); offsets in LSB of each channel.

    Attributes
    ----------
    noise_lsb : float
        Electrical noise before conversion, rms, 0 … 100.
    offsets_lsb : tuple[float, ...]
        Constant offset of current, spool, pressure, position, ±4096.
    gains : tuple[float, ...]
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

    # fmt: off
    noise_lsb: float = condition_field(0.5, 0.0, 100.0, "sensor noise (LSB)",
        option="--noise LSB", help="rms noise of the converters (default 0.5)", basic=True)
    offsets_lsb: tuple[float, ...] = condition_field(
        (0.0,) * len(CHANNELS), -4096.0, 4096.0, "sensor offset (LSB)",
        option="--offsets LSB", help="offsets of current, spool, pressure, position", basic=True)
    gains: tuple[float, ...] = condition_field((0.0,) * len(CHANNELS), -1.0, 1.0, "sensor gain",
        option="--sensor-gains FRACTION",
        help="gain errors of current, spool, pressure, position; usual: ±0.005")
    filter_time: float = condition_field(0.0, 0.0, 0.1, "sensor filter_time (s)",
        option="--filter-ms ms", scale=1e-3,
        help="time constant of the analogue filter on spool and pressure; usual: 0 … 0.2")
    early: float = condition_field(0.0, 0.0, 1.0, "sensor early (s)",
        option="--early-ms ms", scale=1e-3,
        help="all channels are sampled so long before the end of the tick; usual: 0 … 0.2")
    temperature_error: float = condition_field(0.0, -100.0, 100.0, "temperature probe error (K)",
        option="--temperature-error-K K", help="what the oil's probe reads too much; usual: ±2")
    supply_error: float = condition_field(0.0, -20e6, 20e6, "supply probe error (Pa)",
        option="--supply-error-MPa MPa", scale=1e6,
        help="what the supply's probe reads too much; usual: ±0.1")
    # fmt: on

    def __post_init__(self) -> None:
        check_ranges(self, "sensor")
