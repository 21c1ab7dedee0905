"""Physical constants of a unit with given fault severities, to run the model by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.model.plant import PlantConstants, plant_constants
from ehadiag.model.registry import FAULTS, Unknowns
from firmware_iface.recording import Environment


def damaged(
    constants: PlantConstants, severities: Sequence[float] | NDArray[np.float64]
) -> PlantConstants:
    """Constants of a unit, given those as new, with severities 0 … 1 in the order of `FAULTS`."""
    point = np.asarray(severities, dtype=np.float64)
    return Unknowns(FAULTS, (constants,), {}).constants(point)


def damaged_unit(
    severities: Sequence[float] | NDArray[np.float64],
    actuator: Actuator | None = None,
    environment: Environment | None = None,
) -> PlantConstants:
    """Constants of an actuator, the reference one unless given, with these severities."""
    return damaged(plant_constants(actuator or default_actuator(), environment), severities)
