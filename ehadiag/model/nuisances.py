"""Parameters for what a unit and its sensors do besides the faults."""

from __future__ import annotations

from typing import Any

import numpy as np

from ehadiag.model.batch import POSITION_ROW, PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.parameter import ConstantChanges, Parameter, ParameterKind
from ehadiag.model.plant import ConstantValue, PlantConstants

MAX_LAP_SHARE = 0.8
"""Largest lap, 1: share of the travel that opens a land; one as wide as that would turn the
pressure about the middle."""
ANY_SIZE = (-np.inf, np.inf)


def _nuisance(
    name: str,
    symbol: str,
    unit: str,
    bounds: tuple[float, float],
    scale: float,
    short: str,
    meaning: str,
    constant: str,
    **further: Any,
) -> Parameter:
    """Nuisance that is added to a field of the constants, unless `changes` states otherwise."""

    def changes(c: PlantConstants, value: ConstantValue) -> ConstantChanges:
        return {constant: getattr(c, constant) + value}

    kind = ParameterKind.NUISANCE
    return Parameter(
        name, symbol, unit, *bounds, kind, scale, short, meaning,
        **{"changes": changes, **further},
    )  # fmt: skip


def _gain(signal: str, symbol: str, sensor: str) -> Parameter:
    """Relative error of a sensor's gain."""
    return _nuisance(
        f"{signal}_gain", symbol, "1", (-0.5, 0.5), 0.01, f"{signal} sensor gain",
        f"relative error of the gain of {sensor}", symbol,
    )  # fmt: skip


# fmt: off
NUISANCE_PARAMETERS: tuple[Parameter, ...] = (
    _nuisance("spool_offset", "OXS", "m", ANY_SIZE, 1e-5, "spool sensor offset",
              "constant error of the spool's sensor", "OXS",
              adds_to=SPOOL_ROW, sized_by="spool"),
    _nuisance("pressure_offset", "OPD", "Pa", ANY_SIZE, 5e5, "pressure sensor offset",
              "constant error of the sensor of differential pressure", "OPD",
              adds_to=PRESSURE_ROW, sized_by="pressure"),
    _nuisance("position_offset", "OXJ", "m", ANY_SIZE, 1.2e-3, "position sensor offset",
              "constant error of the jack's sensor", "OXJ",
              adds_to=POSITION_ROW, sized_by="position"),
    _gain("spool", "GXS", "the spool's sensor"),
    _gain("pressure", "GPD", "the sensor of differential pressure"),
    _gain("position", "GXJ", "the jack's sensor"),
    _nuisance("spool_bend", "BX2", "1", (-0.1, 0.1), 0.01, "spool sensor bend",
              "even part of the curve of the spool's sensor at its stop, over the position there",
              "BX2"),
    _nuisance("spool_bow", "BX3", "1", (-0.1, 0.1), 0.01, "spool sensor bow",
              "odd part of the curve of the spool's sensor at its stop, over the position there",
              "BX3"),
    _nuisance("pressure_bend", "BP2", "1", (-0.1, 0.1), 0.01, "pressure sensor bend",
              "even part of the pressure sensor's curve at the supply, over the pressure there",
              "BP2"),
    _nuisance("pressure_bow", "BP3", "1", (-0.1, 0.1), 0.01, "pressure sensor bow",
              "odd part of the pressure sensor's curve at the supply, over the pressure there",
              "BP3"),
    _nuisance("filter_time", "τ", "s", (0.0, 5e-4), 1e-4, "analogue filter",
              "time constant of the filter before the converters of spool and pressure", "TAU"),
    _nuisance("sampling_lead", "DLY", "s", (0.0, 2e-4), 1e-4, "sampling instant",
              "time before the end of the tick at which the channels are sampled", "DLY"),
    _nuisance("driver_lag", "LAG", "s", (0.0, 5e-3), 2e-4, "driver lag",
              "time constant of the driver of the current and of the coil", "LAG"),
    _nuisance("clogging_exponent", "dm", "1", (-2.0, 2.0), 1.0, "clogging exponent",
              "exponent of the pressure gain behind a clogged filter, less the actuator file's",
              "CLE"),
    _nuisance("first_stage_null", "XFN", "m", (-5e-6, 5e-6), 5e-7, "null of the first stage",
              "the first stage's null from the middle between the flapper's stops", "XFN"),
    _nuisance("null_bias", "ib", "A", (-5e-4, 5e-4), 2e-4, "null bias",
              "current that the torque motor adds to the commanded one", "IB",
              sized_by="current", limit="null_bias", basic=True),
    _nuisance("torque_motor_gain", "dGM", "1", (-0.2, 0.2), 0.1, "torque-motor gain",
              "relative change of the torque motor's gain", "GM",
              changes=lambda c, value: {"GM": c.GM * (1.0 + value)},
              limit="torque_motor_gain", datum="GM", datum_unit="N m/A",
              condition="gain_change", basic=True),
    _nuisance("hysteresis", "hyst", "1", (0.0, 0.1), 0.04, "torque-motor hysteresis",
              "width of the torque motor's hysteresis over rated current", "HYS",
              limit="hysteresis", basic=True),
    _nuisance("hysteresis_skew", "k", "1", (-12.0, 12.0), 3.0, "hysteresis skew",
              "by how much a wide play of a smooth hysteresis counts less than a narrow one",
              "SKW"),
    _nuisance("torque_even", "TQ2", "1", (-0.3, 0.3), 0.05, "torque curve, even",
              "even part of the torque's curve at rated current, over the torque there", "TQ2"),
    _nuisance("torque_odd", "TQ3", "1", (-0.5, 0.5), 0.05, "torque curve, odd",
              "odd part of the torque's curve at rated current, over the torque there", "TQ3"),
    _nuisance("spool_stribeck", "vSS", "m/s", (0.0, 0.2), 0.01, "spool Stribeck velocity",
              "velocity over which the spool's friction falls from static to dynamic", "VSS"),
    _nuisance("backlash", "b", "m", (0.0, 2e-5), 5e-6, "feedback backlash",
              "half-width of the backlash between spool and feedback spring", "BKL",
              sized_by="spool", limit="backlash", basic=True),
    _nuisance("land_shift", "XLD", "m", (-5e-5, 5e-5), 2e-6, "shift of the lands",
              "spool position at which the metering lands are closed", "XLD", sized_by="spool"),
    _nuisance("land_even", "LD2", "1", (-0.5, 0.5), 0.02, "lands, even",
              "opening of the lands to the plus side over the mean of both sides, less 1", "LD2"),
    _nuisance("land_odd", "LD3", "1", (-0.5, 0.5), 0.02, "lands, odd",
              "odd part of the opening of the lands at the spool's stop, over the travel there",
              "LD3"),
    _nuisance("land_lap", "LAP", "m", (-8e-6, 8e-6), 1e-6, "lap of the lands",
              "travel that the overlap of the lands takes, below 0 an underlap", "LAP",
              changes=lambda c, value: {
                  "LAP": np.minimum(c.LAP + value, MAX_LAP_SHARE * c.PSR / c.GP)}),
    _nuisance("jack_stribeck", "vSJ", "m/s", (0.0, 0.2), 0.01, "jack Stribeck velocity",
              "velocity over which the jack's friction falls from static to dynamic", "VSJ"),
    _nuisance("friction_way", "WAY", "1", (-0.5, 0.5), 0.05, "friction by direction",
              "friction of a jack that moves out over the mean of both ways, less 1", "WAY"),
    _nuisance("load", "FR", "N", (-2e4, 2e4), 100.0, "load",
              "constant load on the jack beside that of the actuator file", "FR"),
    _nuisance("load_spring", "ka", "N/m", (0.0, 1e6), 1e4, "load spring",
              "stiffness of a load that draws the jack to its middle", "KA"),
)
# fmt: on
"""In the order of the chain, the sensors first."""
