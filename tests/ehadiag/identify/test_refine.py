"""The refinement finds the truth again, and says what it left out."""

import numpy as np
import pytest
from identify_cases import NOISE, own_experiment, recorded

from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.identify.experiment import ANCHOR_LSB, make_batch
from ehadiag.identify.refine.least_squares import gaps_of, median_offsets, refine
from ehadiag.identify.uncertainty import covariance

FAULTS = ((0.3, 0.6, 0.3), (0.6, 0.2, 0.9), (0.1, 0.9, 0.5))


def refined(experiment, start):
    batch = make_batch([experiment], anchor_lsb=ANCHOR_LSB)
    return refine(batch, np.asarray(start), np.zeros(2), NOISE)


@pytest.mark.parametrize("faults", FAULTS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_displaced_start_comes_back(faults, sign):
    experiment = own_experiment(faults)
    start = np.array(faults) + sign * np.array([0.002, 0.001, 0.003])
    found = refined(experiment, start)
    assert found.converged
    std = np.sqrt(np.diag(covariance(found)))
    assert (np.abs(found.values - faults) < 4.0 * std).all()
    assert np.abs(found.values - faults).max() < 5e-4


def test_two_starts_meet():
    """The optimum does not remember where the search began."""
    experiment = recorded("paper-closed-4.blf", "closed")
    ends = [refined(experiment, 0.6 + np.array(d)).values for d in ((2e-4,) * 3, (-3e-4,) * 3)]
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-5)


@pytest.mark.parametrize("corner", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_corners_are_reached_and_not_left(corner):
    found = refined(own_experiment(corner), np.abs(np.array(corner) - 0.002))
    assert ((found.values >= 0.0) & (found.values <= 1.0)).all()
    np.testing.assert_allclose(found.values, corner, atol=6e-4)


def test_constant_offsets_are_told_from_faults():
    faults = (0.4, 0.5, 0.6)
    clean = refined(own_experiment(faults), faults)
    # The offset is taken off at rest already; what is left is for the refinement.
    experiment = own_experiment(faults, offsets_lsb=(3.0, -5.0))
    found = refined(experiment, faults)
    total = (
        (experiment.spool_offset + found.offsets[0]) / SPOOL.lsb,
        (experiment.pressure_offset + found.offsets[1]) / PRESSURE.lsb,
    )
    assert total == pytest.approx((3.0, -5.0), abs=0.05)
    np.testing.assert_allclose(found.values, clean.values, atol=4e-4)


def test_glitches_are_left_out():
    """One sample in a hundred is far off: no constant moves by a deviation."""
    faults = (0.4, 0.5, 0.6)
    experiment = own_experiment(faults)
    whole = refined(experiment, faults)
    rows = np.random.default_rng(0).choice(experiment.ticks, 55, replace=False)
    experiment.pressure[rows] += 40 * PRESSURE.lsb
    found = refined(experiment, faults)
    assert not found.used[1, rows].any()
    std = np.sqrt(np.diag(covariance(whole)))
    assert (np.abs(found.values - whole.values) < std).all()


def test_median_offsets_are_those_of_the_sensors():
    experiment = own_experiment((0.4, 0.5, 0.6), offsets_lsb=(3.0, -5.0))
    batch = make_batch([experiment])
    found = median_offsets(batch, gaps_of(batch, np.array([0.4, 0.5, 0.6])))
    total = found + np.array([experiment.spool_offset, experiment.pressure_offset])
    assert total[0] / SPOOL.lsb == pytest.approx(3.0, abs=0.1)
    assert total[1] / PRESSURE.lsb == pytest.approx(-5.0, abs=0.1)
