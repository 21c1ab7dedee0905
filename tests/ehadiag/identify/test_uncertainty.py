"""Stated deviations against what happens, on linear problems whose answer is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from ehadiag.core.criteria import ESTIMATION
from ehadiag.identify.estimates import estimate_covariance, interval95
from ehadiag.identify.least_squares import Refinement
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS

ROWS = 2
N = 400
TRUTH = np.array([0.4, 0.5, 0.6])


PARAMETERS = (*FAULTS, *SENSOR_OFFSETS)
K = len(PARAMETERS)
SCALE = np.array([item.scale for item in PARAMETERS])


def linear_problem(seed, noise):
    """Least squares on residuals = noise - J (x - truth), in units of the scales."""
    jacobian = np.random.default_rng(seed).standard_normal((K, ROWS, N))
    jacobian[: len(FAULTS)] *= 40.0
    rows = jacobian.reshape(K, -1)
    step = np.linalg.solve(rows @ rows.T, rows @ noise.ravel())
    residuals = (noise.ravel() - step @ rows).reshape(ROWS, N)
    used = np.ones((ROWS, N), dtype=np.bool_)
    return Refinement(
        parameters=PARAMETERS,
        x=np.concatenate([TRUTH, np.zeros(len(SENSOR_OFFSETS))]) + step,
        scale=SCALE,
        cost=float((residuals**2).sum()),
        residuals=residuals,
        jacobian=jacobian,
        considered=np.zeros((0, ROWS, N)),
        used=used,
        weighted=used,
        evaluations=0,
        converged=True,
        anchored=0,
        step=np.full(K, 0.01),
    )


def severities(fit):
    return fit.x[: len(FAULTS)]


def deviations(fit):
    """Of the severities."""
    return np.sqrt(np.diag(estimate_covariance(fit)))[: len(FAULTS)]


def white(rng):
    return rng.standard_normal((2, N))


def correlated(rng):
    """Moving average over eight ticks, unit variance."""
    raw = rng.standard_normal((2, N + 7))
    return np.array([np.convolve(row, np.ones(8), "valid") for row in raw]) / np.sqrt(8.0)


@pytest.mark.parametrize("noise", [white, lambda rng: 3.0 * white(rng)])
def test_intervals_of_a_linear_problem_hold_the_truth(noise):
    """Also with three times the noise that the weights assume."""
    rng = np.random.default_rng(1)
    held = []
    for trial in range(300):
        fit = linear_problem(trial, noise(rng))
        for value, s, truth in zip(severities(fit), deviations(fit), TRUTH, strict=True):
            low, high = interval95(value, s)
            held.append(low <= truth <= high)
    assert 0.93 <= np.mean(held) <= 0.99


def test_correlated_residuals_widen_what_correlates_with_them():
    """A severity that acts slowly is less sure when the residuals move slowly."""
    rng = np.random.default_rng(2)
    slow = 40.0 * np.sin(2 * np.pi * np.arange(N) / 200.0)
    errors, stds = [], []
    for trial in range(200):
        noise = correlated(rng)
        fit = linear_problem(trial, noise)
        fit.jacobian[0] = slow
        rows = fit.jacobian.reshape(K, -1)
        step = np.linalg.solve(rows @ rows.T, rows @ noise.ravel())
        fit.residuals[:] = (noise.ravel() - step @ rows).reshape(ROWS, N)
        errors.append(step[0])
        stds.append(np.sqrt(estimate_covariance(fit)[0, 0]))
    real = np.std(errors)
    naive = 1.0 / np.sqrt(2 * (slow**2).sum())
    assert real > 2.0 * naive
    assert 0.7 < np.median(stds) / real < 1.3


def test_deviations_are_those_of_the_curvature_when_all_is_well():
    fit = linear_problem(0, white(np.random.default_rng(3)))
    curved = np.sqrt(np.diag(np.linalg.inv(fit.normal))) * fit.scale
    stated = np.sqrt(np.diag(estimate_covariance(fit)))
    assert (stated >= 0.999 * curved).all()
    assert (stated < 1.5 * curved).all()


def test_the_last_step_of_a_search_that_did_not_settle_is_in_the_deviation():
    fit = linear_problem(0, white(np.random.default_rng(5)))
    unsettled = np.diag(estimate_covariance(replace(fit, converged=False)))
    step = (fit.step * fit.scale) ** 2
    assert np.allclose(unsettled - np.diag(estimate_covariance(fit)), step)


def test_rows_left_out_carry_nothing():
    fit = linear_problem(0, white(np.random.default_rng(4)))
    whole = estimate_covariance(fit)
    fit.used[:, 100:] = False
    fit.jacobian[:, ~fit.used] = 0.0
    assert (np.diag(estimate_covariance(fit)) > 2.0 * np.diag(whole)).all()


def test_what_the_test_does_not_show_is_uniform():
    fit = linear_problem(0, white(np.random.default_rng(5)))
    fit.jacobian[2] = 0.0
    std = deviations(fit)
    assert std[2] == pytest.approx(1.0 / np.sqrt(12.0), rel=0.02)
    assert (std[:2] < 0.01).all()


def test_what_is_considered_moves_the_estimate_in_proportion():
    """A deviation of it shifts the residuals, and least squares by what answers that shift."""
    fit = linear_problem(0, white(np.random.default_rng(6)))
    shift = np.array([2e-3, -1e-3, 5e-4, 0.0, 0.0])
    moving = replace(fit, considered=np.tensordot(shift, fit.jacobian, axes=1)[None])
    added = estimate_covariance(moving) - estimate_covariance(fit)
    added /= np.outer(fit.scale, fit.scale)
    np.testing.assert_allclose(added, np.outer(shift, shift), rtol=0.01, atol=1e-9)


def test_no_estimate_is_surer_than_both_sides_integration():
    fit = linear_problem(0, 1e-6 * white(np.random.default_rng(7)))
    fit.jacobian[:] *= 1e6
    np.testing.assert_allclose(
        np.sqrt(np.diag(estimate_covariance(fit))),
        ESTIMATION.discrepancy_std * fit.scale,
        rtol=1e-3,
    )


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_an_interval_holds_its_estimate_and_stays_inside(value, std):
    low, high = interval95(value, std)
    assert 0.0 <= low <= value <= high <= 1.0


def test_an_interval_is_the_central_one():
    low, high = interval95(0.5, 0.01)
    assert (low, high) == pytest.approx((0.4804, 0.5196), abs=1e-5)
    assert interval95(0.0, 0.01) == pytest.approx((0.0, 0.0196), abs=1e-5)
    assert interval95(1.0, 0.01) == pytest.approx((0.9804, 1.0), abs=1e-5)
