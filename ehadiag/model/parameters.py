"""The parameter vector: what can be estimated, with bounds, units and names.

Kernels take a parameter vector, not three arguments, so that nuisance effects (sensor offsets,
torque-motor gain, backlash …) join the faults without another signature.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FAULTS", "FAULT_NAMES", "Parameter"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One scalar that an estimate has: name, bounds, unit, meaning in two words and in one line."""

    name: str
    lower: float
    upper: float
    unit: str
    short: str
    meaning: str


FAULTS: tuple[Parameter, ...] = (
    Parameter(
        "Kintas", 0.0, 1.0, "1", "filter clogging", "clogging of the valve's first-stage filter"
    ),
    Parameter("FSS", 0.0, 1.0, "1", "spool friction", "dry friction between spool and sleeve"),
    Parameter("FDJ", 0.0, 1.0, "1", "jack friction", "dry friction between jack and cylinder"),
)
"""The progressive faults of the paper (model.md section 3); 0 as new, 1 limit of damage."""

FAULT_NAMES: tuple[str, ...] = tuple(parameter.name for parameter in FAULTS)
