"""Derivatives of a model's residuals, on models whose derivatives are known."""

import numpy as np
import pytest
from identify_cases import own_experiment

from ehadiag.identify.refine.derivatives import Considered, Derivatives
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.parameters import FAULTS, OFFSETS, Unknowns, parameter
from ehadiag.model.simd.model import SimdModel

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
    model = Derivatives(Formula(lambda *_: rows(2, 1)[0], (*FAULTS, *OFFSETS)), NOISE)
    slope = model.slopes([np.zeros(len(FAULTS) + len(OFFSETS))])[0]
    assert model.evaluations == 1 + 2 * len(FAULTS)
    for k, item in enumerate(model.estimated):
        for signal in (SPOOL_ROW, PRESSURE_ROW):
            expected = -1.0 if signal == item.adds_to else 0.0
            if item in OFFSETS:
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
    model = Derivatives(Formula(formula, free), NOISE, [Considered(LEAD, 0.15e-6)])
    beside = np.full(len(FAULTS), 0.25)
    residuals, considered, anchored, runs = model.at(np.full(len(FAULTS), 0.5), beside)
    assert not residuals.any()
    np.testing.assert_allclose(considered[0], 0.15e-6 * shape)
    assert runs.shape == (1, *residuals.shape)
    assert not runs.any()
    assert (anchored, len(considered), len(model.estimated)) == (0, 1, len(FAULTS))


def test_what_is_considered_counts_on_the_rows_that_it_is_sized_by():
    shape = rows(3, 1)[0] / 0.15e-6 / 10.0
    item = Considered(LEAD, 0.15e-6, (SPOOL_ROW,))
    model = Derivatives(Formula(lambda *p: p[-1] * shape, (*FAULTS, LEAD)), NOISE, [item])
    considered = model.at(np.full(len(FAULTS), 0.5))[1][0]
    np.testing.assert_allclose(considered[SPOOL_ROW], 0.15e-6 * shape[SPOOL_ROW])
    assert not considered[PRESSURE_ROW].any()


def test_an_instant_of_sampling_acts_by_how_fast_a_signal_changes():
    """Beside a run of the model with that lead: the same but for what bends within two ticks."""
    experiment = own_experiment((0.3, 0.3, 0.3))
    unknowns = unknowns_of([experiment], (*FAULTS, *OFFSETS, LEAD))
    model = SimdModel(lay_out([experiment]), unknowns)
    x = np.array([0.3, 0.3, 0.3, 0.0, 0.0])
    by_run, by_rate = (
        Derivatives(model, experiment.noise, [Considered(LEAD, 0.15e-6, (SPOOL_ROW,), by_rate)])
        for by_rate in (False, True)
    )
    (expected,), (found,) = by_run.at(x / by_run.scale)[1], by_rate.at(x / by_run.scale)[1]
    assert not found[PRESSURE_ROW].any()
    left = np.sqrt(np.mean((found - expected)[SPOOL_ROW] ** 2))
    assert left < 0.35 * np.sqrt(np.mean(expected[SPOOL_ROW] ** 2))
    assert model.evaluations == 3
