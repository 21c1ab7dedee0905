"""Stated deviations against what happens, on linear problems whose answer is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from identify_cases import NOISE, own_experiment

from ehadiag.identify.experiment import make_batch
from ehadiag.identify.refine.least_squares import refine
from ehadiag.identify.uncertainty import covariance, interval95, normal_matrix

N = 400
TRUTH = np.array([0.4, 0.5, 0.6])


@cache
def template():
    """Any refinement: only its figures are replaced."""
    faults = np.array([0.3, 0.6, 0.3])
    return refine(make_batch([own_experiment(faults)]), faults, np.zeros(2), NOISE)


def linear_problem(seed, noise):
    """Least squares on gaps = noise - J (x - truth), shape (5, 2, N) as the refinement's."""
    jacobian = np.random.default_rng(seed).standard_normal((5, 2, N))
    jacobian[:3] *= 40.0
    rows = jacobian.reshape(5, -1)
    step = np.linalg.solve(rows @ rows.T, rows @ noise.ravel())
    gaps = (noise.ravel() - step @ rows).reshape(2, N)
    used = np.ones((2, N), dtype=np.bool_)
    return replace(
        template(), values=TRUTH + step[:3], offsets=step[3:], gaps=gaps, jacobian=jacobian,
        spool_rate=np.zeros(N), used=used, weighted=used,
    )  # fmt: skip


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
        std = np.sqrt(np.diag(covariance(fit)))
        for value, s, truth in zip(fit.values, std, TRUTH, strict=True):
            low, high = interval95(value, s)
            held.append(low <= truth <= high)
    assert 0.93 <= np.mean(held) <= 0.99


def test_correlated_gaps_widen_what_correlates_with_them():
    """A constant that acts slowly is less sure when the gaps move slowly."""
    rng = np.random.default_rng(2)
    slow = 40.0 * np.sin(2 * np.pi * np.arange(N) / 200.0)
    errors, stds = [], []
    for trial in range(200):
        noise = correlated(rng)
        fit = linear_problem(trial, noise)
        fit.jacobian[0] = slow
        rows = fit.jacobian.reshape(5, -1)
        step = np.linalg.solve(rows @ rows.T, rows @ noise.ravel())
        fit.gaps[:] = (noise.ravel() - step @ rows).reshape(2, N)
        errors.append(step[0])
        stds.append(np.sqrt(covariance(fit)[0, 0]))
    real = np.std(errors)
    naive = 1.0 / np.sqrt(2 * (slow**2).sum())
    assert real > 2.0 * naive
    assert 0.7 < np.median(stds) / real < 1.3


def test_deviations_are_those_of_the_curvature_when_all_is_well():
    fit = linear_problem(0, white(np.random.default_rng(3)))
    curved = np.sqrt(np.diag(np.linalg.inv(normal_matrix(fit)))[:3])
    stated = np.sqrt(np.diag(covariance(fit)))
    assert (stated >= 0.999 * curved).all()
    assert (stated < 1.5 * curved).all()


def test_rows_left_out_carry_nothing():
    fit = linear_problem(0, white(np.random.default_rng(4)))
    whole = covariance(fit)
    fit.used[:, 100:] = False
    fit.jacobian[:, ~fit.used] = 0.0
    assert (np.diag(covariance(fit)) > 2.0 * np.diag(whole)).all()


def test_what_the_test_does_not_show_is_uniform():
    fit = linear_problem(0, white(np.random.default_rng(5)))
    fit.jacobian[2] = 0.0
    std = np.sqrt(np.diag(covariance(fit)))
    assert std[2] == pytest.approx(1.0 / np.sqrt(12.0), rel=0.02)
    assert (std[:2] < 0.01).all()


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_an_interval_holds_its_estimate_and_stays_inside(value, std):
    low, high = interval95(value, std)
    assert 0.0 <= low <= value <= high <= 1.0


def test_an_interval_is_the_central_one():
    low, high = interval95(0.5, 0.01)
    assert (low, high) == pytest.approx((0.4804, 0.5196), abs=1e-5)
    assert interval95(0.0, 0.01) == pytest.approx((0.0, 0.0196), abs=1e-5)
    assert interval95(1.0, 0.01) == pytest.approx((0.9804, 1.0), abs=1e-5)
