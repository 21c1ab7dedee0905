"""A step of least squares within the bounds."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from ehadiag.identify.refine.bounded_step import bounded_step

CORRELATED = np.array([[4.0, 1.5, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
UNIT = (np.zeros(3), np.ones(3))


def test_without_bounds_it_is_the_lowest_point():
    x, gradient = np.array([0.5, 0.5, 0.5, 9.0]), np.array([0.1, -0.2, 0.0, 30.0])
    normal = np.diag([1.0, 2.0, 3.0, 4.0])
    free = (np.full(4, -np.inf), np.full(4, np.inf))
    np.testing.assert_allclose(bounded_step(x, normal, gradient, *free), [0.4, 0.6, 0.5, 1.5])


@pytest.mark.parametrize(("bound", "sign"), [(0.0, 1.0), (1.0, -1.0)])
def test_what_stands_at_its_bound_is_held_there_and_released_from_it(bound, sign):
    x = np.array([bound, 0.5, 0.5])
    held = bounded_step(x, np.eye(3), np.array([0.3 * sign, 0.1, 0.0]), *UNIT)
    np.testing.assert_allclose(held, [bound, 0.4, 0.5])
    released = bounded_step(x, np.eye(3), np.array([-0.3 * sign, 0.1, 0.0]), *UNIT)
    np.testing.assert_allclose(released, [bound + 0.3 * sign, 0.4, 0.5])


def test_where_one_coordinate_meets_its_bound_the_others_are_sought_anew():
    x, gradient = np.array([0.1, 0.5, 0.5]), np.array([2.0, 0.0, 0.0])
    out = bounded_step(x, CORRELATED, gradient, *UNIT)
    # The first one goes down by 0.1 only; the second follows it: 1.5 * 0.1 / 1.
    np.testing.assert_allclose(out, [0.0, 0.65, 0.5])


@st.composite
def problems(draw, most=6):
    """A parabola in a box of up to six coordinates, some without bounds, some starting at one."""
    k = draw(st.integers(1, most))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows = rng.standard_normal((k + draw(st.integers(0, 3)), k))
    rows *= 10.0 ** rng.uniform(-draw(st.floats(0.0, 2.0)), 0.0, k)
    normal = rows.T @ rows + 10.0 ** draw(st.floats(-4.0, 0.0)) * np.eye(k)
    lower, upper = -rng.random(k), rng.random(k)
    lower[rng.random(k) < 0.2] = -np.inf
    upper[rng.random(k) < 0.2] = np.inf
    x = rng.uniform(np.maximum(lower, -5.0), np.minimum(upper, 5.0))
    place = rng.random(k)
    x = np.where((place < 0.25) & np.isfinite(lower), lower, x)
    x = np.where((place > 0.75) & np.isfinite(upper), upper, x)
    gradient = normal @ (3.0 * rng.standard_normal(k))
    return x, normal, gradient, lower, upper


def height(x, normal, gradient, point):
    step = point - x
    return gradient @ step + 0.5 * step @ normal @ step


@given(problems())
@settings(max_examples=300)
def test_it_is_what_least_squares_with_bounds_find(problem):
    """Another library's answer to the same problem lies nowhere lower."""
    x, normal, gradient, lower, upper = problem
    found = bounded_step(*problem)
    assert np.all((found >= lower) & (found <= upper))
    root = np.linalg.cholesky(normal).T
    target = -np.linalg.solve(root.T, gradient)
    box = (lower - x - 1e-12, upper - x + 1e-12)
    other = x + lsq_linear(root, target, box, method="bvls", tol=1e-14).x
    size = 1.0 + abs(height(x, normal, gradient, other))
    assert height(x, normal, gradient, found) <= height(x, normal, gradient, other) + 1e-7 * size


@given(problems(most=4))
@settings(max_examples=100)
def test_it_is_the_lowest_of_all_choices_of_what_is_held(problem):
    """Every coordinate at one of its bounds or free: 3^k systems of equations, by hand."""
    x, normal, gradient, lower, upper = problem
    best = np.inf
    for choice in itertools.product((-1, 0, 1), repeat=len(x)):
        sides = np.array(choice)
        held, free = sides != 0, sides == 0
        ends = np.where(sides < 0, lower, upper)
        if not np.isfinite(ends[held]).all():
            continue
        step = np.zeros(len(x))
        step[held] = (ends - x)[held]
        pull = gradient[free] + normal[np.ix_(free, held)] @ step[held]
        step[free] = -np.linalg.solve(normal[np.ix_(free, free)], pull)
        point = x + step
        if np.all((point >= lower - 1e-12) & (point <= upper + 1e-12)):
            best = min(best, height(x, normal, gradient, point))
    found = height(x, normal, gradient, bounded_step(*problem))
    assert found <= best + 1e-7 * (1.0 + abs(best))
