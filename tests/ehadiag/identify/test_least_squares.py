"""A step of least squares within the bounds.

Pseudo-inverse of a regression's points, also where the library's decomposition fails. Derivatives
of a model's residuals, on models whose derivatives are known.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_cases import own_experiment
from msgspec.structs import replace
from scipy.optimize import lsq_linear

from ehadiag.identify.experiment import lay_out_spans, unknowns_of
from ehadiag.identify.linearisation import ConsideredParameter, Derivatives, pseudo_inverse
from ehadiag.identify.posterior import bounded_step
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, Unknowns, parameter
from ehadiag.model.residual_models import SimdModel

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


def triangle(count=26):
    """Of random rotations: many equal singular values."""
    rng = np.random.default_rng(3)
    turns = [np.linalg.qr(rng.standard_normal((count, count)))[0] for _ in range(2)]
    return np.linalg.qr(np.vstack([*turns, turns[0][:5]]))[1]


def test_it_is_the_inverse():
    assert pseudo_inverse(triangle()) @ triangle() == pytest.approx(np.eye(26), abs=1e-12)


def test_it_is_the_same_where_the_decomposition_does_not_converge(monkeypatch):
    expected, library = pseudo_inverse(triangle()), np.linalg.pinv

    def failing(matrix, *rest, hermitian=False, **more):
        if not hermitian:
            raise np.linalg.LinAlgError("SVD did not converge")
        return library(matrix, *rest, hermitian=True, **more)

    monkeypatch.setattr(np.linalg, "pinv", failing)
    assert pseudo_inverse(triangle()) == pytest.approx(expected, abs=1e-12)


def test_a_direction_without_points_is_not_seen():
    flat = triangle() @ np.diag([1.0] * 25 + [0.0])
    assert np.abs(pseudo_inverse(flat)[25]).max() < 1e-9


ROWS = 2
N = 60
NOISE = (2e-7, 3e4)
LEAD = parameter("sampling_lead")


class Batch:
    weight = np.vstack([np.full(N, 1.0 / NOISE[0]), np.full(N, 1.0 / NOISE[1])])


class Formula:
    """A `ResidualModel` whose residuals are a formula of the unknowns."""

    batch = Batch()

    def __init__(self, formula, free):
        self.unknowns = Unknowns(tuple(free), (), {})
        self.evaluations = 0
        self.formula = formula

    def residuals(self, points):
        self.evaluations += len(points)
        out = np.array([np.broadcast_to(self.formula(*p), (ROWS, N)) for p in points])
        return out, np.arange(len(points))


def rows(seed, size):
    return np.random.default_rng(seed).standard_normal((size, ROWS, N))


@pytest.mark.parametrize("x", [(0.4, 0.5, 0.6), (0.0, 1.0, 0.5)])
def test_a_smooth_model_has_the_derivatives_of_its_formula(x):
    """At a bound too, where both sides of the difference lie inside."""
    a, b = rows(0, len(FAULTS)), rows(1, len(FAULTS))

    def formula(*p):
        p = np.array(p)[:, None, None]
        return (a * p + 0.5 * b * p**2).sum(axis=0)

    model = Derivatives(Formula(formula, FAULTS), NOISE)
    slope = model.slopes([np.array(x)])[0]
    expected = a + b * np.array(x)[:, None, None]
    np.testing.assert_allclose(slope.jacobian, expected, atol=3e-4)
    assert slope.smooth.all()
    assert model.trusted(slope).smooth.all()
    assert model.trusted_slope(np.array(x)).smooth.all()


def test_an_offset_is_known_without_a_run():
    """Its derivative is the weight of the signal it adds to, in units of the noise."""
    model = Derivatives(Formula(lambda *_: rows(2, 1)[0], (*FAULTS, *SENSOR_OFFSETS)), NOISE)
    slope = model.slopes([np.zeros(len(FAULTS) + len(SENSOR_OFFSETS))])[0]
    assert model.evaluations == 1 + 2 * len(FAULTS)
    for k, item in enumerate(model.estimated):
        for signal in (SPOOL_ROW, PRESSURE_ROW):
            expected = -1.0 if signal == item.adds_to else 0.0
            if item in SENSOR_OFFSETS:
                np.testing.assert_allclose(slope.jacobian[k, signal], expected)


def test_a_row_that_jumps_beside_the_point_is_left_out():
    """A break-away on one side of the difference only; further out, the wider one sees it."""
    for place, seen_narrow in ((2e-5, True), (1.2e-4, False)):

        def formula(kintas, _fss, _fdj, place=place):
            out = np.zeros((ROWS, N))
            out[0, 7] = 5.0 if kintas > 0.5 + place else 0.0
            return out

        model = Derivatives(Formula(formula, FAULTS), NOISE)
        slope = model.slopes([np.full(3, 0.5)])[0]
        assert slope.smooth[0, 7] == (not seen_narrow)
        assert not model.trusted(slope).smooth[0, 7]
        assert model.trusted(slope).smooth.sum() == ROWS * N - 1


def test_what_is_considered_moves_the_residuals_but_is_not_estimated():
    shape = rows(3, 1)[0] / 0.15e-6 / 10.0

    def formula(*p):
        return p[-1] * shape

    free = (*FAULTS, LEAD)
    model = Derivatives(Formula(formula, free), NOISE, [ConsideredParameter(LEAD, 0.15e-6)])
    beside = np.full(len(FAULTS), 0.25)
    runs, considered, anchored = model.at(np.full(len(FAULTS), 0.5), beside)
    np.testing.assert_allclose(considered[0], 0.15e-6 * shape)
    assert runs.shape == (2, *shape.shape)
    assert not runs.any()
    assert (anchored, len(considered), len(model.estimated)) == (0, 1, len(FAULTS))


def test_what_is_considered_may_be_run_in_turns():
    shapes = rows(3, 3) / 0.15e-6 / 10.0
    three = [replace(LEAD, name=name) for name in "abc"]
    model = Derivatives(
        Formula(lambda *p: np.tensordot(p[-3:], shapes, 1), (*FAULTS, *three)),
        NOISE,
        [ConsideredParameter(item, 0.15e-6) for item in three],
    )
    x = np.full(len(FAULTS), 0.5)
    whole = model.at(x)[1]
    first, second = (model.at(x, days=slice(turn, None, 2))[1] for turn in (0, 1))
    assert [bool(part.any()) for part in (*first, *second)] == [
        True,
        False,
        True,
        False,
        True,
        False,
    ]
    np.testing.assert_array_equal(first + second, whole)


def test_an_instant_of_sampling_acts_by_how_fast_a_signal_changes():
    """Beside a run of the model with that lead: the same but for what bends within two ticks."""
    experiment = own_experiment((0.3, 0.3, 0.3))
    unknowns = unknowns_of([experiment], (*FAULTS, *SENSOR_OFFSETS, LEAD))
    model = SimdModel(lay_out_spans([experiment]), unknowns)
    x = np.array([0.3, 0.3, 0.3, 0.0, 0.0])
    by_run, by_rate = (
        Derivatives(
            model, experiment.noise, [ConsideredParameter(LEAD, 0.15e-6, (SPOOL_ROW,), by_rate)]
        )
        for by_rate in (False, True)
    )
    (expected,), residuals = by_run.at(x / by_run.scale)[1], by_rate.at(x / by_run.scale)[0][0]
    (found,) = by_rate.held_effects(residuals)
    assert not found[PRESSURE_ROW].any()
    left = np.sqrt(np.mean((found - expected)[SPOOL_ROW] ** 2))
    assert left < 0.35 * np.sqrt(np.mean(expected[SPOOL_ROW] ** 2))
    assert model.evaluations == 3
