"""Parameters for what a unit and its sensors do besides the faults."""

from __future__ import annotations

import numpy as np

from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.parameter import Kind, Parameter

__all__ = ["NUISANCES"]

NUISANCES: tuple[Parameter, ...] = (
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
)
"""In the order of the chain, the sensors first."""
