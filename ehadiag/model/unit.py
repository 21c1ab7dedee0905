"""Physical constants of one unit: its data, and what a calibration learned of its effects."""

from __future__ import annotations

import numpy as np

from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Environment
from ehadiag.model.parameters import Unknowns
from ehadiag.model.plant import PlantConstants, plant_constants

__all__ = ["unit_constants"]


def unit_constants(actuator: Actuator, environment: Environment | None = None) -> PlantConstants:
    """Constants of the unit as new, see `plant_constants`, with its calibrated effects in them."""
    base = plant_constants(actuator, environment)
    calibration = actuator.calibration
    if calibration is None:
        return base
    base = base._replace(NPL=float(calibration.plays))
    return Unknowns((), (base,), calibration.effects).constants(np.empty(0))
