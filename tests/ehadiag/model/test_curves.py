"""Smooth curves of torque motor and spool sensor, and friction by direction, beside the plant's."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import MODELS, batch_of, residuals_of, rms, severities, simulated

from ehadiag.core.stored_test import resolve_test
from ehadiag_sim.plant.conditions import Effects, Strangers

BOTH = pytest.mark.parametrize("kind", list(MODELS))
FAULTS = (0.3, 0.2, 0.4)
HYSTERESIS = {"hysteresis": 0.03}


@BOTH
@pytest.mark.parametrize(
    ("effects", "values"),
    [
        (Effects(strangers=Strangers(torque_cubic=-0.05)), {"torque_odd": -0.05}),
        (Effects(strangers=Strangers(friction_asymmetry=0.05)), {"friction_way": 0.05}),
        (Effects(strangers=Strangers(land_shift=2e-6)), {"land_shift": 2e-6}),
        (Effects(strangers=Strangers(land_asymmetry=0.03)), {"land_even": 0.03}),
    ],
    ids=["torque", "friction", "shift", "asymmetry"],
)
def test_an_effect_is_the_simulators(kind, effects, values):
    measured = simulated(FAULTS, effects)
    here = residuals_of(kind, {**severities(FAULTS), **values}, batch_of(measured))
    without = residuals_of(kind, severities(FAULTS), batch_of(measured))
    # Where full current turns, a jack that turns within the tick makes one sample wrong.
    assert (rms(np.clip(here, -3.0, 3.0)) < [0.05, 0.3, 0.05]).all()
    assert np.mean(np.abs(without[1])) > 10.0 * np.mean(np.abs(here[1]))


@BOTH
def test_a_lag_of_the_driver_delays_the_spool(kind):
    """Held over each tick is the mean of what flows, so that little of the lag is left."""
    current = resolve_test("open").command()[:1500]
    measured = simulated(FAULTS, Effects(strangers=Strangers(driver_lag=3e-4)), current=current)
    batch = batch_of(measured, current)
    here = residuals_of(kind, {**severities(FAULTS), "driver_lag": 3e-4}, batch)
    without = residuals_of(kind, severities(FAULTS), batch)
    assert (rms(without) > 4.0 * rms(here))[[0, 2]].all()
    assert np.mean(np.abs(here[1])) < 0.1


@BOTH
def test_lands_that_overlap_pass_less_near_the_middle(kind):
    values = {**severities(FAULTS), "land_lap": 1e-6}
    batch = batch_of(simulated(FAULTS))
    overlap = residuals_of(kind, values, batch)[1]
    assert rms(overlap[None])[0] > 0.7
    # A small overlap is a smaller pressure gain in the middle, and less flow at any opening.
    same = residuals_of(kind, {**values, "land_lap": 0.0}, batch)[1]
    assert rms(same[None])[0] < 0.3


@BOTH
def test_a_bent_pressure_sensor_reads_a_cubic(kind):
    supply = 20e6
    straight = simulated(FAULTS)
    share = straight[1] / supply
    bent = straight.copy()
    bent[1] *= 0.99 + 0.004 * share - 0.01 * share**2
    gains = {"pressure_gain": -0.01, "pressure_bend": 0.004, "pressure_bow": -0.01}
    here, plain = (
        residuals_of(kind, {**severities(FAULTS), **values}, batch_of(bent))[1]
        for values in (gains, {})
    )
    assert np.mean(np.abs(here)) < 0.02 * np.mean(np.abs(plain))


@BOTH
def test_wide_plays_may_count_less(kind):
    effects = Effects(hysteresis=0.03, plays=8, strangers=Strangers(play_skew=2.0))
    batch = batch_of(simulated(FAULTS, effects))
    values = {**severities(FAULTS), **HYSTERESIS}
    plain, skewed = (
        residuals_of(kind, {**values, "hysteresis_skew": skew}, batch, plays=8)
        for skew in (0.0, 2.0)
    )
    assert rms(skewed)[0] < 0.05
    assert rms(plain)[0] > 1.0


@BOTH
def test_a_bent_spool_sensor_reads_a_cubic(kind):
    stop = 0.381e-3
    straight = simulated(FAULTS)
    share = straight[0] / stop
    bent = straight.copy()
    bent[0] *= 1.01 + 0.004 * share - 0.01 * share**2
    values = {**severities(FAULTS), "spool_gain": 0.01, "spool_bend": 0.004, "spool_bow": -0.01}
    here = residuals_of(kind, values, batch_of(bent))
    assert rms(here)[0] < 0.05
