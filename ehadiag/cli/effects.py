"""Command-line options for the effects of a simulated actuator (PHY-16 to PHY-38)."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from ehadiag.core.errors import ConfigurationError

if TYPE_CHECKING:
    from ehadiag_sim.plant.conditions import DataErrors, Effects, Sensors

__all__ = ["add_effect_options", "the_effects", "the_sensors"]


class _Switch(NamedTuple):
    """One number of `Effects`, `Sensors` or `Strangers`."""

    option: str
    field: str
    """Of the data class."""
    unit: str
    scale: float
    """SI value of one unit."""
    what: str
    """Meaning and usual size."""


EFFECTS = (
    _Switch("--null-bias-mA", "null_bias", "mA", 1e-3, "null bias; usual: up to ±0.2 (2 %% of IM)"),
    _Switch(
        "--hysteresis",
        "hysteresis",
        "FRACTION",
        1.0,
        "torque-motor hysteresis, full width of the loop as a fraction of IM; usual: 0.01 … 0.04",
    ),
    _Switch(
        "--gain-change", "gain_change", "FRACTION", 1.0, "of the torque-motor gain; usual: ±0.05"
    ),
    _Switch(
        "--backlash-um",
        "backlash",
        "um",
        1e-6,
        "half-width of the play between spool and feedback ball; usual: 0 … 5",
    ),
    _Switch(
        "--spool-stribeck-mm-s",
        "spool_stribeck",
        "mm/s",
        1e-3,
        "Stribeck velocity of the spool's friction; usual: 1 … 50",
    ),
    _Switch(
        "--jack-stribeck-mm-s",
        "jack_stribeck",
        "mm/s",
        1e-3,
        "Stribeck velocity of the jack's friction; usual: 1 … 50",
    ),
    _Switch("--load-N", "load", "N", 1.0, "constant load on the jack; usual: near 0 on the ground"),
    _Switch(
        "--load-spring-N-mm",
        "load_spring",
        "N/mm",
        1e3,
        "load spring that draws the jack to its middle; usual: near 0 on the ground",
    ),
)
SENSORS = (
    _Switch(
        "--filter-ms",
        "filter_time",
        "ms",
        1e-3,
        "time constant of the analogue filter on spool and pressure; usual: 0 … 0.2",
    ),
    _Switch(
        "--early-ms",
        "early",
        "ms",
        1e-3,
        "all channels are sampled so long before the end of the tick; usual: 0 … 0.2",
    ),
    _Switch(
        "--temperature-error-K",
        "temperature_error",
        "K",
        1.0,
        "what the oil's probe reads too much; usual: ±2",
    ),
    _Switch(
        "--supply-error-MPa",
        "supply_error",
        "MPa",
        1e6,
        "what the supply's probe reads too much; usual: ±0.1",
    ),
)
STRANGERS = (
    _Switch(
        "--torque-cubic",
        "torque_cubic",
        "C",
        1.0,
        "torque × (1 + C·(i/IM)²); a size to try: -0.05",
    ),
    _Switch(
        "--play-skew",
        "play_skew",
        "K",
        1.0,
        "weights of the plays fall as exp(-K·(i + 0.5)/n); a size to try: 3",
    ),
    _Switch(
        "--driver-lag-ms",
        "driver_lag",
        "ms",
        1e-3,
        "time constant of the current driver; a size to try: 0.3",
    ),
    _Switch(
        "--land-asymmetry",
        "land_asymmetry",
        "A",
        1.0,
        "lands open by 1 ± A of the travel to either side; a size to try: 0.03",
    ),
    _Switch(
        "--land-shift-um",
        "land_shift",
        "um",
        1e-6,
        "spool position at which the lands are closed; a size to try: 2",
    ),
    _Switch(
        "--spool-bend-square",
        "spool_bend_2",
        "A",
        1.0,
        "spool sensor × (1 + A·x/XSM + B·(x/XSM)²); a size to try: 0.005",
    ),
    _Switch("--spool-bend-cubic", "spool_bend_3", "B", 1.0, "and B; a size to try: 0.01"),
    _Switch("--jack-bend-square", "jack_bend_2", "A", 1.0, "the same for jack sensor and XJM"),
    _Switch("--jack-bend-cubic", "jack_bend_3", "B", 1.0, "and B"),
    _Switch(
        "--oil-drift-K-s",
        "oil_drift",
        "K/s",
        1.0,
        "the oil warms during the test; a size to try: 1",
    ),
    _Switch(
        "--friction-asymmetry",
        "friction_asymmetry",
        "A",
        1.0,
        "jack friction × (1 ± A) out and in; a size to try: 0.05",
    ),
    _Switch(
        "--spool-friction-slope",
        "spool_friction_slope",
        "A",
        1.0,
        "spool friction × (1 + A·XS/XSM); a size to try: 0.05",
    ),
)
DATA = ("GM", "KSF", "KF", "GP", "GQ", "CS", "CJ", "MJ", "FSS0", "FDJ0")


def add_effect_options(parser: argparse.ArgumentParser) -> None:
    """Add the effects of a real unit, how its sensors err, and what no requirement names.

    All are off by default.
    """
    group = parser.add_argument_group(
        "effects of a real unit, simulated", "as in PHY-16 to 39; all off by default"
    )
    _add(group, EFFECTS)
    group.add_argument(
        "--plays",
        type=int,
        default=1,
        metavar="N",
        help="number of plays whose mean the hysteresis is (default 1); usual: 1 … 16",
    )
    group.add_argument(
        "--data-error",
        action="append",
        default=[],
        metavar="NAME=FRACTION",
        help="how far a datum is off the actuator file's; repeatable, NAME of"
        f" {', '.join(DATA)}; usual: ±0.05",
    )
    group = parser.add_argument_group("errors of simulated sensors", "all off by default")
    group.add_argument(
        "--sensor-gains",
        type=float,
        nargs=4,
        default=(0.0, 0.0, 0.0, 0.0),
        metavar="FRACTION",
        help="gain errors of current, spool, pressure, position; usual: ±0.005",
    )
    _add(group, SENSORS)
    group.add_argument(
        "--broken",
        metavar="KIND",
        help="broken hardware, for instance frozen-spool or foamed-oil; sizes by --simulator-seed;"
        " an unknown kind lists all",
    )
    group = parser.add_argument_group(
        "strangers, simulated", "effects that the identification does not know; all off by default"
    )
    _add(group, STRANGERS)


def the_effects(arguments: argparse.Namespace) -> Effects:
    """Return the effects that the options describe.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.

    Returns
    -------
    Effects
        The effects.

    Raises
    ------
    ConfigurationError
        A value out of its range, `--data-error` without a known name and a number.
    """
    from ehadiag_sim.plant.conditions import Effects, Strangers  # noqa: PLC0415

    return Effects(
        oil_temperature=arguments.oil_temperature,
        supply_pressure=arguments.supply * 1e6,
        plays=arguments.plays,
        data=_data_errors(arguments.data_error),
        strangers=Strangers(**_values(arguments, STRANGERS)),
        **_values(arguments, EFFECTS),
    )


def the_sensors(arguments: argparse.Namespace) -> Sensors:
    """Return how the sensors err by the options.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.

    Returns
    -------
    Sensors
        The errors of the sensors.

    Raises
    ------
    ConfigurationError
        A value out of its range.
    """
    from ehadiag_sim.plant.conditions import Sensors  # noqa: PLC0415

    return Sensors(
        noise_lsb=arguments.noise,
        offsets_lsb=tuple(arguments.offsets),
        gains=tuple(arguments.sensor_gains),
        **_values(arguments, SENSORS),
    )


def _add(group: argparse._ArgumentGroup, switches: Iterable[_Switch]) -> None:
    for item in switches:
        group.add_argument(
            item.option,
            dest=item.field,
            type=float,
            default=0.0,
            metavar=item.unit,
            help=item.what,
        )


def _values(arguments: argparse.Namespace, switches: Iterable[_Switch]) -> dict[str, float]:
    return {item.field: getattr(arguments, item.field) * item.scale for item in switches}


def _data_errors(pairs: list[str]) -> DataErrors:
    from ehadiag_sim.plant.conditions import DataErrors  # noqa: PLC0415

    errors = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            errors[name] = float(text)
        except ValueError:
            name = ""
        if name not in DATA:
            raise ConfigurationError(
                f"--data-error {pair}: need NAME=FRACTION with a name of {', '.join(DATA)}"
            )
    return DataErrors(**errors)
