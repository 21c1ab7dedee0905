"""Processes of wear against densities worked out another way, and against their own simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from ehadiag.prognosis.lives import Increments, Life, increments_of
from ehadiag.prognosis.wear import PROCESSES, Gamma, Law, Process, Wiener

LAW = Law(power=1.3, rate=0.4, variety=0.3, spread=0.2, feedback=1.5)
STRAIGHT = Law(power=1.0, rate=0.4, variety=0.01, spread=0.2, feedback=1e-6)
SCALE = 2000.0


def a_life(noise: float = 1e-4) -> Life:
    age = np.array([100.0, 350.0, 500.0, 900.0])
    return Life(1, age, np.array([0.01, 0.05, 0.07, 0.16]), np.full(4, noise), 0.0)


def nothing() -> Increments:
    return increments_of([Life(1, np.empty(0), np.empty(0), np.empty(0), 0.0)])


def on_the_scale(value: np.ndarray) -> np.ndarray:
    return np.log1p(LAW.feedback * value) / LAW.feedback


def test_wiener_density_is_that_of_a_normal_vector() -> None:
    life = a_life()
    step = np.diff((life.age / SCALE) ** LAW.power)
    slope = 1.0 + LAW.feedback * life.value
    noise = (life.std[:-1] / slope[:-1]) ** 2 + (life.std[1:] / slope[1:]) ** 2
    covariance = np.diag((LAW.spread * LAW.rate) ** 2 * step + noise)
    covariance += (LAW.variety * LAW.rate) ** 2 * np.outer(step, step)
    expected = stats.multivariate_normal(LAW.rate * step, covariance).logpdf(
        np.diff(on_the_scale(life.value))
    ) - np.sum(np.log(slope[1:]))
    assert Wiener().log_likelihood(increments_of([life]), LAW, SCALE) == pytest.approx(expected)


def test_gamma_density_is_the_integral_over_scales() -> None:
    life = a_life()
    shape = np.diff((life.age / SCALE) ** LAW.power) / LAW.spread**2
    growth = np.diff(on_the_scale(life.value))
    alpha = LAW.variety**-2
    beta = alpha * LAW.rate * LAW.spread**2

    def density(inverse: float) -> float:
        each = stats.gamma.pdf(growth, shape, scale=1.0 / inverse)
        return float(np.prod(each) * stats.gamma.pdf(inverse, alpha, scale=1.0 / beta))

    whole, _ = quad(density, 0.0, 20.0 * alpha / beta, limit=400)
    expected = np.log(whole) - np.sum(np.log1p(LAW.feedback * life.value[1:]))
    found = Gamma().log_likelihood(increments_of([life]), LAW, SCALE)
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("process", PROCESSES.values(), ids=PROCESSES)
def test_lives_are_independent(process: Process) -> None:
    life = a_life()
    one = process.log_likelihood(increments_of([life]), LAW, SCALE)
    two = process.log_likelihood(increments_of([life, life]), LAW, SCALE)
    assert two == pytest.approx(2.0 * one)


@pytest.mark.parametrize("process", PROCESSES.values(), ids=PROCESSES)
def test_passage_is_that_of_simulated_paths(process: Process) -> None:
    rng = np.random.default_rng(1)
    found = process.passage(nothing(), STRAIGHT, SCALE, np.zeros(4000), 0.3, rng)
    step = 1.0 / 400.0
    steps = (1600, 4000)
    if process.name == "Wiener":
        deviation = STRAIGHT.spread * STRAIGHT.rate * np.sqrt(step)
        growth = rng.normal(STRAIGHT.rate * step, deviation, steps)
    else:
        shape = step / STRAIGHT.spread**2
        growth = rng.gamma(shape, STRAIGHT.rate * STRAIGHT.spread**2, steps)
    crossed = np.maximum.accumulate(np.cumsum(growth, axis=0)) >= 0.3
    simulated = (np.argmax(crossed, axis=0) + 1) * step
    shares = (0.1, 0.5, 0.9)
    assert np.quantile(found, shares) == pytest.approx(np.quantile(simulated, shares), rel=0.04)


def test_a_wiener_process_that_falls_may_never_arrive() -> None:
    law = STRAIGHT._replace(variety=5.0)
    rng = np.random.default_rng(1)
    found = Wiener().passage(nothing(), law, SCALE, np.zeros(4000), 0.9, rng)
    assert 0.3 < np.mean(np.isinf(found)) < 0.5


def test_no_gamma_process_falls() -> None:
    life = Life(1, np.array([1.0, 2.0]), np.array([0.3, 0.2]), np.full(2, 1e-4), 0.0)
    assert Gamma().log_likelihood(increments_of([life]), LAW, SCALE) == -np.inf


@pytest.mark.parametrize("process", PROCESSES.values(), ids=PROCESSES)
def test_chances_of_an_increment_are_uniform(process: Process) -> None:
    """What the process makes itself has any chance as often as any other."""
    rng = np.random.default_rng(2)
    law = STRAIGHT._replace(variety=0.3)
    highs = []
    for _ in range(400):
        if process.name == "Wiener":
            rate = rng.normal(law.rate, law.variety * law.rate)
            grown = rng.normal(rate * 0.5, law.spread * law.rate * np.sqrt(0.5))
        else:
            alpha = law.variety**-2
            inverse = rng.gamma(alpha, 1.0 / (alpha * law.rate * law.spread**2))
            grown = rng.gamma(0.5 / law.spread**2, 1.0 / inverse)
        life = Life(1, np.array([0.0, 1000.0]), np.array([0.1, 0.1 + grown]), np.full(2, 1e-6), 0.0)
        tried = increments_of([life])
        low, high = process.chances(nothing(), tried, law, SCALE)
        assert low + high == pytest.approx(1.0, abs=1e-3)
        highs.append(high)
    assert stats.kstest(highs, "uniform").pvalue > 0.01
