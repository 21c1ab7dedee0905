"""The refinement finds the truth again, and says what it left out.

The last round of a refinement: what the vector kernels are off is taken out.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from identify_cases import named, own_experiment, recorded
from msgspec.structs import replace

from ehadiag.core.criteria import ESTIMATION
from ehadiag.identify.estimates import estimate_covariance
from ehadiag.identify.experiment import lay_out_spans, unknowns_of
from ehadiag.identify.least_squares import (
    last_round,
    median_offsets,
    near_spread,
    refine_severities,
    refined_with_day,
    refinement_at,
    rest_near,
)
from ehadiag.identify.linearisation import LinearModel, ParameterDensity, linearised_on_cross
from ehadiag.identify.partial_refinement import anchored_derivatives, free_run_residuals
from ehadiag.identify.signals import median_of
from ehadiag.model.registry import FAULT_NAMES, parameter
from ehadiag.model.registry import FAULTS as SEVERITIES
from ehadiag.model.residual_models import SimdModel
from firmware_iface.recording import CHANNELS

CASES = ((0.3, 0.6, 0.3), (0.6, 0.2, 0.9), (0.1, 0.9, 0.5))


def refined(experiment, start):
    return refine_severities(anchored_derivatives([experiment]), named(start))


def severities(found):
    return np.array([found.values[name] for name in FAULT_NAMES])


def deviations(found):
    """Of the severities, by name."""
    names = [item.name for item in found.parameters]
    std = np.sqrt(np.diag(estimate_covariance(found)))
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
        (experiment.spool_offset + found.values["spool_offset"]) / CHANNELS.spool.lsb,
        (experiment.pressure_offset + found.values["pressure_offset"]) / CHANNELS.pressure.lsb,
    )
    assert total == pytest.approx((3.0, -5.0), abs=0.05)
    np.testing.assert_allclose(severities(found), severities(clean), atol=4e-4)


def test_glitches_are_left_out():
    """One sample in a hundred is far off: no severity moves by a deviation."""
    faults = (0.4, 0.5, 0.6)
    experiment = own_experiment(faults)
    whole = refined(experiment, faults)
    rows = np.random.default_rng(0).choice(experiment.ticks, 55, replace=False)
    experiment.pressure[rows] += 40 * CHANNELS.pressure.lsb
    found = refined(experiment, faults)
    assert not found.used[1, rows].any()
    assert (np.abs(severities(found) - severities(whole)) < deviations(whole)).all()


def test_median_offsets_are_those_of_the_sensors():
    experiment = own_experiment((0.4, 0.5, 0.6), offsets_lsb=(3.0, -5.0))
    found = median_offsets(*free_run_residuals([experiment], None, named((0.4, 0.5, 0.6))))
    spool = found["spool_offset"] + experiment.spool_offset
    pressure = found["pressure_offset"] + experiment.pressure_offset
    assert spool / CHANNELS.spool.lsb == pytest.approx(3.0, abs=0.1)
    assert pressure / CHANNELS.pressure.lsb == pytest.approx(-5.0, abs=0.1)


FAULTS = (0.3, 0.3, 0.3)


VISCOSITY_STD = 2.3e-3
"""Of oil at -20 °C by the bus's steps of 0.1 K."""


@cache
def exact():
    """An experiment without noise whose oil is a deviation thicker than the bus says."""
    noisy = replace(own_experiment(FAULTS), viscosity_std=VISCOSITY_STD)
    batch = lay_out_spans([noisy])
    model = SimdModel(batch, unknowns_of([noisy], (*SEVERITIES, parameter("oil_viscosity"))))
    there = np.array([[*FAULTS, VISCOSITY_STD]])
    spool, pressure = model.residuals(there)[0][0] / batch.weight
    return replace(noisy, spool=noisy.spool - spool, pressure=noisy.pressure - pressure)


@cache
def whole():
    return anchored_derivatives([exact()])


@cache
def by_the_rounds():
    """Optimum of the vector kernels, and its deviations in units of the scales."""
    found = refine_severities(whole(), named(FAULTS))
    return found, np.sqrt(np.diag(np.linalg.inv(found.normal)))


def error(found):
    """Of the severities, in deviations."""
    _, std = by_the_rounds()
    return ((found.x * found.scale)[:3] - FAULTS) / (std * found.scale)[:3]


def belief(shift=0.0):
    before, std = by_the_rounds()
    return ParameterDensity(before.x + shift * std, np.diag(2.0 * std[whole().curved]))


def test_the_last_round_estimates_the_oil_of_the_day():
    before, _ = by_the_rounds()
    after = last_round(whole(), belief(), settled=True)
    # The density of the oil holds back a little.
    assert np.abs(error(before)).max() > 1.5
    assert np.abs(error(after)).max() < 0.4 * np.abs(error(before)).max()
    assert after.converged
    assert not np.any(after.jacobian[:, ~after.used])
    alone = estimate_covariance(replace(after, daily=after.daily[:0]))
    assert estimate_covariance(after)[2, 2] > 1.02 * alone[2, 2]


def test_a_last_round_that_steps_by_more_than_a_deviation_has_not_come_to_rest():
    _, std = by_the_rounds()
    after = last_round(whole(), belief(3.0), settled=True)
    assert not after.converged
    assert (np.sqrt(np.diag(estimate_covariance(after))) > 2.0 * std * after.scale)[:3].all()


def test_rows_that_jump_do_not_make_an_optimum_sure():
    before, _ = by_the_rounds()
    wide = replace(belief(), root=5.0 * belief().root)
    linear = linearised_on_cross(whole(), wide)
    found = refinement_at(whole(), before.x, linear, settled=True)
    jumps = found.weighted & (linear.scatter >= ESTIMATION.max_informative_scatter)
    counted = jumps & (linear.scatter < ESTIMATION.max_row_scatter)
    assert np.count_nonzero(counted) > 5
    assert not found.used[jumps].any()
    assert not found.jacobian[:, jumps].any()


@pytest.mark.parametrize("shift", [-2.0, 0.5])
def test_rounds_near_the_optimum_end_where_a_last_round_does(shift):
    before, std = by_the_rounds()
    start = replace(before, x=before.x + shift * std).values
    model, sofar = whole(), whole().evaluations
    found = rest_near(model, start, near_spread(before))
    after = last_round(whole(), belief(), settled=True)
    np.testing.assert_allclose(error(found), error(after), atol=0.15)
    assert found.evaluations - sofar <= 23  # three rounds of half a block each
    assert found.daily.any(axis=(1, 2)).all()


def test_a_break_away_within_reach_is_no_rest():
    before, _ = by_the_rounds()
    assert rest_near(whole(), before.values, 100.0 * near_spread(before)) is None


def test_an_optimum_of_many_unknowns_moves_by_the_oil_of_the_day():
    before, _ = by_the_rounds()
    linear = linearised_on_cross(whole(), belief())
    found = refinement_at(whole(), before.x, linear, settled=True)
    after = refined_with_day(whole(), found, linear)
    assert np.abs(error(after)).max() < 0.5 * np.abs(error(before)).max()
    held = 1e9 * linear.sums().normal
    known = refined_with_day(whole(), replace(found, information=held), linear)
    np.testing.assert_allclose(known.x, found.x, atol=1e-9)


@pytest.mark.parametrize("samples", [3, 8, 21])
def test_sums_of_lines_are_those_of_weighted_samples(samples):
    """Also of fewer samples than a vector holds; further rows count where the step leads."""
    rng = np.random.default_rng(samples)
    jacobian, more = rng.standard_normal((4, 2, samples)), rng.standard_normal((1, 2, samples))
    residuals, scatter = 3.0 * rng.standard_normal((2, samples)), rng.random((2, samples))
    step = rng.standard_normal(5)
    linear = LinearModel(np.zeros(4), residuals, jacobian, scatter, np.zeros(4), residuals)
    rows = np.concatenate([jacobian, more]).reshape(5, -1)
    for further, shift in ((more, step), (more[:0], None)):
        mine = rows[: 4 + len(further)]
        at = residuals.ravel() + (0.0 if shift is None else shift @ mine)
        variance = 1.0 + scatter.ravel()
        weights = 1.0 / (variance + at**2 / ESTIMATION.cauchy_scale**2)
        sums = linear.sums(further, shift)
        np.testing.assert_allclose(sums.normal, (mine * weights) @ mine.T, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(sums.gradient, (mine * weights) @ residuals.ravel(), atol=1e-11)
        expected = (residuals.ravel() ** 2 * weights).sum() / (variance * weights).sum()
        assert sums.excess == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("shape", [(1,), (2,), (7,), (3, 8)])
def test_median_is_that_of_numpy(shape):
    values = np.round(np.random.default_rng(3).standard_normal(shape), 1)
    np.testing.assert_array_equal(median_of(values), np.median(values, axis=-1))
