"""Parameters for errors of an actuator's data file, and of the oil and supply probes.

The torque motor's gain is not among them: as a datum it does the same as `torque_motor_gain`, which
no recording could tell from it. The ends of the friction scales (FSS1, FDJ1) have no tolerance.
"""

from __future__ import annotations

from ehadiag.model.parameter import Changes, Kind, Parameter
from ehadiag.model.plant import PlantConstants, Value

__all__ = ["DATA"]

REACH = 0.3
"""Relative error of a datum beyond which a unit is another one than its file describes."""
USUAL = 0.05
"""Usual tolerance of a data sheet."""


def _datum(symbol: str, short: str, field: str | None = None) -> Parameter:
    """Relative error of a datum; `field`: of the constants, where its name is another one."""
    name = field or symbol

    def changes(c: PlantConstants, value: Value) -> Changes:
        return {name: getattr(c, name) * (1.0 + value)}

    return Parameter(
        name=f"datum_{symbol}",
        symbol=f"d{symbol}",
        unit="1",
        lower=-REACH,
        upper=REACH,
        kind=Kind.DATUM,
        scale=USUAL,
        short=short,
        meaning=f"relative error of the actuator file's {symbol}, {short}",
        changes=changes,
    )


DATA: tuple[Parameter, ...] = (
    _datum("KSF", "feedback-wire stiffness"),
    _datum("KF", "flapper stiffness"),
    _datum("JF", "flapper inertia"),
    _datum("CF", "flapper damping"),
    _datum("XFM", "flapper stop"),
    _datum("GQF", "first-stage flow gain"),
    _datum("GPF", "first-stage pressure gain"),
    _datum("AS", "spool end area"),
    _datum("MS", "spool mass"),
    _datum("CS", "spool viscous coefficient"),
    _datum("FSS0", "spool friction as new", "FSS"),
    _datum("GP", "pressure gain"),
    _datum("GQ", "flow gain"),
    _datum("CLK", "leakage"),
    _datum("AJ", "jack area"),
    _datum("MJ", "jack mass"),
    _datum("CJ", "jack viscous coefficient"),
    _datum("FDJ0", "jack friction as new", "FDJ"),
    Parameter(
        name="bulk_modulus",
        symbol="dβ",
        unit="1",
        lower=-0.9,
        upper=1.0,
        kind=Kind.DATUM,
        scale=0.1,
        short="bulk modulus",
        meaning="relative error of the actuator file's β, the oil's bulk modulus; of orifices only",
        changes=lambda c, value: {"OIL": c.OIL * (1.0 + value)},
    ),
    Parameter(
        name="oil_viscosity",
        symbol="dν",
        unit="1",
        lower=-0.5,
        upper=1.0,
        kind=Kind.DATUM,
        scale=0.05,
        short="oil viscosity",
        meaning="relative error of the viscosity that the oil's temperature probe makes believe",
        changes=lambda c, value: {
            "CS": c.CS * (1.0 + value),
            "CJ": c.CJ * (1.0 + value),
            "CLK": c.CLK / (1.0 + value),
        },
    ),
    Parameter(
        name="supply_pressure",
        symbol="dPSR",
        unit="Pa",
        lower=-5e6,
        upper=5e6,
        kind=Kind.DATUM,
        scale=1e5,
        short="supply pressure",
        meaning="error of the supply less return pressure that the probes show",
        changes=lambda c, value: {"PSR": c.PSR + value},
    ),
)
"""In the order of the chain: first stage, second stage, jack, oil and supply."""
