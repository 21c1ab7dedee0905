"""The last round of a refinement: what the vector kernels are off is taken out."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from identify_cases import named, own_experiment

from ehadiag.identify.refine import last_round as module
from ehadiag.identify.refine.derivatives import capped
from ehadiag.identify.refine.first_part import anchored_derivatives
from ehadiag.identify.refine.last_round import by_a_finer_model, last_round
from ehadiag.identify.refine.least_squares import described, refine
from ehadiag.identify.refine.linearisation import Belief, crossed
from ehadiag.identify.refine.posterior import robust_weights
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.laws import ESTIMATED_BEND
from ehadiag.model.parameters import FAULTS as SEVERITIES
from ehadiag.model.scalar.residuals import ScalarModel

FAULTS = (0.3, 0.3, 0.3)


@cache
def exact():
    """An experiment whose samples are the finer model's, without noise."""
    noisy = own_experiment(FAULTS)
    batch = lay_out([noisy])
    model = ScalarModel(batch, unknowns_of([noisy], SEVERITIES), ESTIMATED_BEND)
    spool, pressure = model.residuals(np.array([FAULTS]))[0][0] / batch.weight
    return replace(noisy, spool=noisy.spool - spool, pressure=noisy.pressure - pressure)


@cache
def whole():
    return anchored_derivatives([exact()])


@cache
def by_the_rounds():
    """Optimum of the vector kernels, and its deviations in units of the scales."""
    found = refine(whole(), named(FAULTS))
    return found, np.sqrt(np.diag(np.linalg.inv(found.normal)))


def error(found):
    """Of the severities, in deviations."""
    _, std = by_the_rounds()
    return ((found.x * found.scale)[:3] - FAULTS) / (std * found.scale)[:3]


def belief(shift=0.0):
    before, std = by_the_rounds()
    return Belief(before.x + shift * std, np.diag(2.0 * std[whole().curved]))


def test_the_last_round_ends_where_the_finer_model_has_its_optimum():
    before, _ = by_the_rounds()
    after, costs = last_round(whole(), belief(), True)
    assert np.abs(error(before)).max() > 0.15
    assert np.abs(error(after)).max() < 0.05
    assert costs == [pytest.approx(capped(whole().many(before.x[None])[0]))]
    assert after.converged
    assert not np.any(after.jacobian[:, ~after.used])


def test_costs_of_other_points_are_theirs():
    before, std = by_the_rounds()
    beside = before.x + std
    _, costs = last_round(whole(), belief(), False, beside)
    assert costs[1] == pytest.approx(np.minimum(whole().many(beside[None])[0] ** 2, 9.0).sum())
    assert costs[1] > costs[0]


def test_a_step_that_is_none_of_a_last_round_is_not_taken():
    far = belief(np.array([0.0, 0.0, 5.0, 0.0, 0.0]))
    after, _ = last_round(whole(), far, True)
    np.testing.assert_array_equal(after.x, far.x)


def test_an_optimum_of_many_unknowns_moves_by_what_the_finer_model_has_more():
    before, _ = by_the_rounds()
    linear = crossed(whole(), belief())
    found = described(whole(), before.x, linear, settled=True)
    after = by_a_finer_model(whole(), found, linear)
    assert np.abs(error(after)).max() < 0.5 * np.abs(error(before)).max()
    rows = linear.jacobian.reshape(len(found.x), -1)
    held = 1e9 * (rows * robust_weights(linear).ravel()) @ rows.T
    known = by_a_finer_model(whole(), replace(found, information=held), linear)
    np.testing.assert_allclose(known.x, found.x, atol=1e-9)


def test_break_aways_at_other_ticks_are_none_of_the_models_errors(monkeypatch):
    before, _ = by_the_rounds()
    linear = crossed(whole(), belief())
    found = described(whole(), before.x, linear, settled=True)
    monkeypatch.setattr(module, "JUMP", 0.0)
    np.testing.assert_allclose(by_a_finer_model(whole(), found, linear).x, found.x, atol=1e-15)
