"""The response that the model gives with what was identified, beside what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.result import Identification
from ehadiag.model.parameters import REGISTRY, Unknowns
from ehadiag.model.scalar.response import respond

__all__ = ["Signal", "signals_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """One signal of a test, in the unit that people read; shape (ticks,) each."""

    name: str
    unit: str
    measured: Array
    """NaN where missing, or at the converter's end."""
    modelled: Array

    @property
    def residual(self) -> Array:
        """Measured less modelled."""
        return self.measured - self.modelled


def signals_of(
    experiment: Experiment, found: Identification, measured_current: Array
) -> tuple[Signal, ...]:
    """Run the model from rest with severities, effects and offsets as identified.

    Parameters
    ----------
    experiment : Experiment
        What was identified from.
    found : Identification
        What was identified.
    measured_current : Array
        A, shape (ticks,).

    Returns
    -------
    tuple[Signal, ...]
        Current (measured against commanded), spool, differential pressure, jack position.
    """
    values = {item.name: item.value for item in found.estimates}
    values |= {name: item.value for name, item in found.nuisances.items()}
    free = tuple(item for item in REGISTRY if item.name in values)
    point = np.array([values[item.name] for item in free])
    constants = Unknowns(free, (experiment.constants,), {}).constants(point)
    trace = experiment.trace
    model = respond(constants, trace.current, experiment.tick, origin=experiment.origin)
    spool = model.spool + values.get("spool_offset", 0.0)
    pressure = model.pressure + values.get("pressure_offset", 0.0)
    position = model.position + values.get("position_offset", 0.0)
    current = measured_current[: experiment.ticks] - trace.offset
    return (
        Signal("servovalve current", "mA", current * 1e3, trace.current * 1e3),
        Signal("spool position", "mm", experiment.spool * 1e3, spool * 1e3),
        Signal("differential pressure", "MPa", experiment.pressure * 1e-6, pressure * 1e-6),
        Signal("jack position", "mm", experiment.position * 1e3, position * 1e3),
    )
