"""The response that the model gives with what was identified, beside what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.response import respond
from ehadiag.model.sensors import SensorLaw, sensor_law
from ehadiag.report.events import NO_EVENTS, Events, events_of

__all__ = ["Signal", "sensed", "signals_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """One signal of a test, in the unit that people read; shape (ticks,) each."""

    name: str
    unit: str
    small_unit: str
    """A thousandth of it, in which people read residuals."""
    measured: Array
    """NaN where missing, or at the converter's end."""
    modelled: Array
    events: Events = NO_EVENTS
    """Of the modelled motion."""
    beside: str = "modelled"
    """What a legend calls the curve beside the measured one; empty: there is none."""

    @property
    def residual(self) -> Array:
        """Measured less modelled."""
        return self.measured - self.modelled


def sensed(experiment: Experiment, constants: PlantConstants) -> tuple[Array, Array, Array]:
    """Run the model from rest, and read its response by sensors with these errors.

    Parameters
    ----------
    experiment : Experiment
        What was recorded.
    constants : PlantConstants
        Of the actuator, with the offsets and gains of its sensors.

    Returns
    -------
    tuple[Array, Array, Array]
        Spool (m), differential pressure (Pa) and jack position (m), shape (ticks,) each.
    """
    current = experiment.trace.current
    model = respond(constants, current, experiment.tick, origin=experiment.origin)
    law = _law(constants)
    bent = model.spool * (law.spool_even + law.spool_odd * model.spool)
    return (
        law.spool_offset + model.spool * (law.spool_gain + bent),
        law.pressure_offset + law.pressure_gain * model.pressure,
        law.position_offset + law.position_gain * model.position,
    )


def _law(constants: PlantConstants) -> SensorLaw:
    """As the function is written: compiled for this one call it would take half a second."""
    law: SensorLaw = getattr(sensor_law, "py_func", sensor_law)(constants)
    return law


def signals_of(
    experiment: Experiment, constants: PlantConstants, measured_current: Array
) -> tuple[Signal, ...]:
    """Run the model from rest, and set its response beside what was measured.

    Parameters
    ----------
    experiment : Experiment
        What was recorded.
    constants : PlantConstants
        Of the actuator as it was found, with the errors of its sensors.
    measured_current : Array
        A, shape (ticks,).

    Returns
    -------
    tuple[Signal, ...]
        Current (measured against commanded), spool, differential pressure, jack position.
    """
    spool, pressure, position = sensed(experiment, constants)
    law, trace = _law(constants), experiment.trace
    at_spool = events_of((spool - law.spool_offset) / law.spool_gain, float(constants.XSM))
    at_jack = events_of((position - law.position_offset) / law.position_gain, float(constants.XJM))
    current = measured_current[: experiment.ticks] - trace.offset
    return (
        Signal("servovalve current", "mA", "µA", current * 1e3, trace.current * 1e3),
        Signal("spool position", "mm", "µm", experiment.spool * 1e3, spool * 1e3, at_spool),
        Signal("differential pressure", "MPa", "kPa", experiment.pressure * 1e-6, pressure * 1e-6),
        Signal("jack position", "mm", "µm", experiment.position * 1e3, position * 1e3, at_jack),
    )
