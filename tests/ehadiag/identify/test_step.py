"""A step of least squares within the bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import lsq_linear

from ehadiag.identify.refine.bounded_step import bounded_step

CORRELATED = np.array([[4.0, 1.5, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 1.0]])


def test_without_bounds_it_is_the_lowest_point():
    x, gradient = np.array([0.5, 0.5, 0.5, 9.0]), np.array([0.1, -0.2, 0.0, 30.0])
    normal = np.diag([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(bounded_step(x, normal, gradient), [0.4, 0.6, 0.5, 1.5])


@pytest.mark.parametrize(("bound", "sign"), [(0.0, 1.0), (1.0, -1.0)])
def test_a_constant_is_held_at_its_bound_and_released_from_it(bound, sign):
    x = np.array([bound, 0.5, 0.5])
    held = bounded_step(x, np.eye(3), np.array([0.3 * sign, 0.1, 0.0]))
    np.testing.assert_allclose(held, [bound, 0.4, 0.5])
    released = bounded_step(x, np.eye(3), np.array([-0.3 * sign, 0.1, 0.0]))
    np.testing.assert_allclose(released, [bound + 0.3 * sign, 0.4, 0.5])


def test_where_one_constant_meets_its_bound_the_others_are_sought_anew():
    x, gradient = np.array([0.1, 0.5, 0.5]), np.array([2.0, 0.0, 0.0])
    out = bounded_step(x, CORRELATED, gradient)
    # The first one goes down by 0.1 only; the second follows it: 1.5 * 0.1 / 1.
    np.testing.assert_allclose(out, [0.0, 0.65, 0.5])


@given(
    x=arrays(float, 3, elements=st.floats(0.0, 1.0)),
    gradient=arrays(float, 3, elements=st.floats(-3.0, 3.0)),
    rows=arrays(float, (4, 3), elements=st.floats(-1.0, 1.0)),
)
def test_it_is_the_lowest_point_inside(x, gradient, rows):
    normal = rows.T @ rows + 0.5 * np.eye(3)
    step = bounded_step(x, normal, gradient) - x
    assert np.all((x + step >= 0.0) & (x + step <= 1.0))
    root = np.linalg.cholesky(normal).T
    best = lsq_linear(root, -np.linalg.solve(root.T, gradient), (-x - 1e-12, 1.0 - x + 1e-12)).x
    low = gradient @ best + 0.5 * best @ normal @ best
    assert gradient @ step + 0.5 * step @ normal @ step <= low + 1e-6
