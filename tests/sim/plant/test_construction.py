"""Switches of the simulator for valves of another construction (PHY-42 to PHY-45)."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from ehadiag import ConfigurationError, default_actuator
from ehadiag_sim.conditions import Effects, Faults, UnmodelledEffects
from ehadiag_sim.plant_dynamics import plant_response
from ehadiag_sim.plant_laws import plant_coefficients

STEP = 1e-6
CURRENT = np.concatenate([np.linspace(0.0, 2e-3, 60), np.full(20, 1e-2), np.full(40, -1e-3)])


def with_orifices(**stage):
    actuator = default_actuator()
    stage = msgspec.structs.replace(
        actuator.second_stage, kind="orifice", volume_of_one_chamber=0.9e-4, **stage
    )
    return msgspec.structs.replace(actuator, second_stage=stage)


def response(actuator=None, faults=None, **strange):
    effects = Effects(unmodelled=UnmodelledEffects(**strange))
    return plant_response(actuator or with_orifices(), CURRENT, faults, effects, STEP)


def test_four_equal_lands_are_the_two():
    """Written with a pressure in each chamber they are the same lands."""
    tiny = 1e-12
    plain, four = response(), response(underlap_errors=(tiny,) * 4)
    assert np.abs(plain[0] - four[0]).max() == 0.0
    assert np.abs(plain[1] - four[1]).max() < 2e3, "Pa; a sixth of a converter's step"


def test_lands_show_by_their_mean_and_their_middle():
    """Differences of the same mean and middle hardly act on the differential pressure."""
    plain = response()[1]
    alike = response(underlap_errors=(0.05, 0.05, -0.05, -0.05))[1]
    shifted = response(underlap_errors=(0.05, -0.05, 0.05, -0.05))[1]
    assert np.abs(alike - plain).max() < 0.2 * np.abs(shifted - plain).max()


def test_stiff_ends_are_no_ends_and_soft_ones_show():
    plain, stiff, soft = (response(spool_end_volume=volume)[0] for volume in (0.0, 1e-9, 2e-7))
    assert np.abs(stiff - plain).max() < 1e-6
    assert np.abs(soft - plain).max() > 2e-6, "eight steps of the converter"


def test_a_series_filter_takes_pressure_as_the_square_of_the_flow():
    actuator = default_actuator()
    valve = msgspec.structs.replace(actuator.servovalve, clogging_exponent=2.0)
    series = msgspec.structs.replace(actuator, servovalve=valve)
    worn = Faults(0.5, 0.0, 0.0)
    new, paper, clogged = (
        plant_coefficients(unit, faults, Effects())
        for unit, faults in ((series, Faults()), (actuator, worn), (series, worn))
    )
    assert paper.FORCE == new.FORCE
    assert pytest.approx(0.36 * new.FORCE) == clogged.FORCE


def test_there_are_four_lands():
    with pytest.raises(ConfigurationError, match="underlap_errors: need 4 values, not 2"):
        UnmodelledEffects(underlap_errors=(0.1, 0.1))
