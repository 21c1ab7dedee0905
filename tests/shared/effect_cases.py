"""The monitoring model beside the simulator, the same effects in both; no noise, no rounding."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from ehadiag import default_actuator
from ehadiag.model.batch import NO_ANCHOR, SIGNAL_ROWS, Batch
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import FAULTS, Unknowns, parameter
from ehadiag.model.residual_models import ScalarModel, SimdModel
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_dynamics import PlantDynamics
from firmware_iface.recording import CHANNELS
from firmware_iface.stored_test import resolve_test

TICK = 1e-3
LSB = np.array([CHANNELS.spool.lsb, CHANNELS.pressure.lsb, CHANNELS.position.lsb])
MODELS = {"alone": ScalarModel, "block": SimdModel}
CURRENT = resolve_test("open").command()[1900:3000]
"""A, one a tick: from creeping through both stops of the valve to rest."""


def simulated(faults=(0.3, 0.2, 0.4), effects=None, *, actuator=None, current=CURRENT, **sensors):
    """Spool, pressure and jack as the simulator's sensors see them, SI, shape (3, n)."""
    plant = PlantDynamics(
        actuator or default_actuator(), Faults(*faults), effects or Effects(), **sensors
    )
    out = np.empty((SIGNAL_ROWS, len(current)))
    for tick, value in enumerate(current.tolist()):
        plant.advance(value)
        out[:, tick] = plant.seen[1:]
    return out


def batch_of(measured, current=CURRENT, *, anchor=NO_ANCHOR, rows=SIGNAL_ROWS):
    """One test, weighed so that residuals are in LSB."""
    n = len(current)
    return Batch(
        test=np.zeros(1, dtype=np.int64),
        tick=np.array([TICK]),
        start=np.array([0, n]),
        origin=np.zeros(1),
        place=np.zeros(1),
        history=np.zeros(1, dtype=np.int64),
        since=np.zeros(1, dtype=np.int64),
        current=current,
        spool=measured[0],
        pressure=measured[1],
        position=measured[2],
        weight=np.repeat(1.0 / LSB[:rows, None], n, axis=1),
        anchor=anchor.as_array()[None, :],
    )


def unknowns_of(values, actuator=None, environment=None):
    """Space of named parameters, about the constants of an actuator."""
    base = plant_constants(actuator or default_actuator(), environment)
    return Unknowns(tuple(parameter(name) for name in values), (base,), {})


def residuals_of(kind, values, batch, actuator=None, *, plays=1):
    """Residuals of one candidate, its parameters by name, in LSB, shape (rows, n)."""
    space = unknowns_of(values, actuator)
    base = tuple(item._replace(NPL=float(plays)) for item in space.base)
    model = MODELS[kind](batch, replace(space, base=base))
    return model.residuals(np.array([list(values.values())]))[0][0]


def severities(faults=(0.3, 0.2, 0.4)):
    """By name."""
    return {item.name: value for item, value in zip(FAULTS, faults, strict=True)}


def rms(residuals):
    """Of each row."""
    return np.sqrt(np.mean(residuals**2, axis=1))
