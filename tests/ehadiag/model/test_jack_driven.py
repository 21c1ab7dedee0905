"""Jacks of many candidates along a measured path of the spool: against the scalar model."""

import numpy as np
import pytest

from ehadiag.core.recording import Environment
from ehadiag.model.parameters import FAULTS, Unknowns
from ehadiag.model.plant import plant_of
from ehadiag.model.scalar.jack import jack_response
from ehadiag.model.simd.jack_driven import driven_costs
from ehadiag_tools.damaged import damaged_unit

TICKS, TICK, BEFORE, NOISE = 400, 1e-3, 2e-7, 3e4


def test_costs_are_those_of_the_scalar_model():
    rng = np.random.default_rng(3)
    base = damaged_unit((0.0, 0.0, 0.0), environment=Environment())
    points = rng.uniform(0.0, 1.0, (19, len(FAULTS)))
    candidates = Unknowns(FAULTS, (base,), {}).candidates(points)[:, 0]
    # To and fro past the closed orifice: jacks start, creep and stop.
    place = 8e-6 * np.sin(np.arange(1, TICKS + 1) / 40.0) + 2e-7 * rng.standard_normal(TICKS)
    rate = np.diff(place, prepend=BEFORE) / TICK
    nodes = np.column_stack([np.full(TICKS, TICK), place, rate, rate, np.zeros(TICKS)])
    measured = 1e5 * rng.standard_normal(TICKS)
    measured[::17] = np.nan
    found = driven_costs(candidates, nodes, BEFORE, measured, NOISE, 25.0)
    for row, cost in zip(candidates, found, strict=True):
        pressure, position = np.empty(TICKS), np.empty(TICKS)
        jack_response(
            plant_of(row), TICK, BEFORE, 0.0, 0.0, position, nodes, np.arange(1, TICKS + 1),
            pressure, position,
        )  # fmt: skip
        residuals = (measured - pressure) / NOISE
        assert cost == pytest.approx(np.minimum(residuals**2, 25.0)[~np.isnan(residuals)].sum())
