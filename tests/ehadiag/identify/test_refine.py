"""The refinement finds the truth again, and says what it left out."""

import numpy as np
import pytest
from identify_cases import named, own_experiment, recorded

from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.identify.refine.first_part import anchored_derivatives, residuals_at
from ehadiag.identify.refine.least_squares import median_offsets, refine
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULT_NAMES

CASES = ((0.3, 0.6, 0.3), (0.6, 0.2, 0.9), (0.1, 0.9, 0.5))


def refined(experiment, start):
    return refine(anchored_derivatives([experiment]), named(start))


def severities(found):
    return np.array([found.values[name] for name in FAULT_NAMES])


def deviations(found):
    """Of the severities, by name."""
    names = [item.name for item in found.parameters]
    std = np.sqrt(np.diag(covariance(found)))
    return np.array([std[names.index(name)] for name in FAULT_NAMES])


@pytest.mark.parametrize("faults", CASES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_displaced_start_comes_back(faults, sign):
    experiment = own_experiment(faults)
    start = np.array(faults) + sign * np.array([0.002, 0.001, 0.003])
    found = refined(experiment, start)
    assert found.converged
    assert (np.abs(severities(found) - faults) < 4.0 * deviations(found)).all()
    assert np.abs(severities(found) - faults).max() < 5e-4


def test_two_starts_meet():
    """The optimum does not remember where the search began."""
    experiment = recorded("paper-closed-4.blf", "closed")
    starts = ((2e-4,) * 3, (-3e-4,) * 3)
    ends = [severities(refined(experiment, 0.6 + np.array(d))) for d in starts]
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-5)


@pytest.mark.parametrize("corner", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_corners_are_reached_and_not_left(corner):
    found = severities(refined(own_experiment(corner), np.abs(np.array(corner) - 0.002)))
    assert ((found >= 0.0) & (found <= 1.0)).all()
    np.testing.assert_allclose(found, corner, atol=6e-4)


def test_constant_offsets_are_told_from_faults():
    faults = (0.4, 0.5, 0.6)
    clean = refined(own_experiment(faults), faults)
    # The offset is taken off at rest already; what is left is for the refinement.
    experiment = own_experiment(faults, offsets_lsb=(3.0, -5.0))
    found = refined(experiment, faults)
    total = (
        (experiment.spool_offset + found.values["spool_offset"]) / SPOOL.lsb,
        (experiment.pressure_offset + found.values["pressure_offset"]) / PRESSURE.lsb,
    )
    assert total == pytest.approx((3.0, -5.0), abs=0.05)
    np.testing.assert_allclose(severities(found), severities(clean), atol=4e-4)


def test_glitches_are_left_out():
    """One sample in a hundred is far off: no severity moves by a deviation."""
    faults = (0.4, 0.5, 0.6)
    experiment = own_experiment(faults)
    whole = refined(experiment, faults)
    rows = np.random.default_rng(0).choice(experiment.ticks, 55, replace=False)
    experiment.pressure[rows] += 40 * PRESSURE.lsb
    found = refined(experiment, faults)
    assert not found.used[1, rows].any()
    assert (np.abs(severities(found) - severities(whole)) < deviations(whole)).all()


def test_median_offsets_are_those_of_the_sensors():
    experiment = own_experiment((0.4, 0.5, 0.6), offsets_lsb=(3.0, -5.0))
    found = median_offsets(*residuals_at([experiment], None, named((0.4, 0.5, 0.6))))
    spool = found["spool_offset"] + experiment.spool_offset
    pressure = found["pressure_offset"] + experiment.pressure_offset
    assert spool / SPOOL.lsb == pytest.approx(3.0, abs=0.1)
    assert pressure / PRESSURE.lsb == pytest.approx(-5.0, abs=0.1)
