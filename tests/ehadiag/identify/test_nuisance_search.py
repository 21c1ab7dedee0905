"""The search for many parameters: on problems whose answer is known.

Severities of actuators with effects that their data do not tell.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_cases import recorded
from msgspec.structs import replace

from ehadiag import default_actuator
from ehadiag.core.actuator import MAX_NOISE_EXCESS
from ehadiag.identify.estimates import excess_cost, is_noise, is_unexplainable
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.identification_session import NuisanceMode, identify
from ehadiag.identify.linearisation import ParameterDensity, linearised_by_regression
from ehadiag.identify.nuisance_estimate import optima_covariance
from ehadiag.identify.nuisance_search import MultistartResult, StartEnd, multistart_search
from ehadiag.identify.posterior import MANY_UNKNOWNS_SCHEDULE, cauchy_cost, search_posterior
from ehadiag.identify.prior import (
    JointPrior,
    ParameterPrior,
    basic_nuisances_of,
    prior_density,
    prior_information,
)
from ehadiag.model.registry import FAULTS, parameter
from ehadiag_sim.conditions import Faults
from ehadiag_tools.simulator.units import random_unit, record
from firmware_iface.stored_test import resolve_test

SAMPLES = 400


class Problem:
    """Residuals as a function of points: what the search needs of `Derivatives`.

    The last coordinate is simply added to the first signal.
    """

    estimated = (*FAULTS, parameter("spool_offset"))

    def __init__(self, function, lower=(-9.0, -9.0, -9.0)):
        self.function = function
        self.curved = np.arange(3)
        self.lower = np.array([*lower, -np.inf])
        self.upper = np.array([9.0, 9.0, 9.0, np.inf])
        self.scale = np.ones(4)
        self.evaluations = 0

    def many(self, points):
        self.evaluations += len(points)
        out = np.array([self.function(point[:3]) for point in points])
        out[:, 0] -= points[:, 3, None]
        return out

    def additive_slopes(self):
        out = np.zeros((4, 2, SAMPLES))
        out[3, 0] = -1.0
        return out


def noise(seed=0):
    return np.random.default_rng(seed).standard_normal((2, SAMPLES))


def linear(seed=1):
    slopes = np.random.default_rng(seed).standard_normal((3, 2, SAMPLES))
    return slopes, lambda p: np.einsum("i,isn->sn", p, slopes) - 3.0


@given(seed=st.integers(0, 99), widths=st.lists(st.floats(1e-6, 1.0), min_size=3, max_size=3))
@settings(max_examples=20, deadline=None)
def test_a_linear_model_is_found_exactly_whatever_the_spread(seed, widths):
    slopes, function = linear(seed)
    found = linearised_by_regression(
        Problem(function),
        ParameterDensity(np.array([0.3, -0.2, 0.1, 0.5]), np.diag(widths)),
        np.random.default_rng(seed),
    )
    assert np.allclose(found.jacobian[:3], slopes, rtol=1e-4, atol=1e-5)
    assert found.scatter.max() < 1e-9
    assert np.allclose(found.residuals[1], function(found.x[:3])[1])


def test_points_stay_within_the_bounds():
    seen = []
    problem = Problem(lambda p: seen.append(p.copy()) or linear()[1](p), lower=(0.0, 0.0, 0.0))
    linearised_by_regression(
        problem, ParameterDensity(np.zeros(4), np.eye(3)), np.random.default_rng(0)
    )
    assert min(p.min() for p in seen) >= 0.0


def test_rows_that_jump_scatter():
    """A break-away makes a step: over it the linear model does not hold."""
    _, function = linear()

    def jumping(p):
        out = function(p)
        out[1, :10] += 20.0 * (p[0] > 0.0)
        return out

    found = linearised_by_regression(
        Problem(jumping), ParameterDensity(np.zeros(4), np.eye(3)), np.random.default_rng(0)
    )
    assert found.scatter[1, :10].min() > 1.0 > found.scatter[1, 10:].max()


def curved(truth, seed=3):
    """Bent, with a valley: the first two coordinates nearly pass for each other."""
    t = np.linspace(0.0, 6.0, SAMPLES)

    def response(p):
        first = 300.0 * np.sin((p[0] + p[1]) * t) + 40.0 * np.tanh(p[0] - p[1]) * t
        return np.array([first, 200.0 * np.exp(-0.3 * p[2] * t) + 30.0 * p[0]])

    measured = response(np.array(truth)) + noise(seed)
    return lambda p: measured - response(p)


def searched(problem, begin, width=0.4):
    first = ParameterDensity(np.array([*begin, 0.0]), width * np.eye(3))
    information = np.diag([1.0, 1.0, 1.0, 0.0])
    return multistart_search(problem, first, information, [first], is_noise, seed=1)


def test_it_finds_the_optimum_of_a_bent_valley():
    truth = (0.8, 0.5, 0.7)
    found = searched(Problem(curved(truth)), (0.5, 0.5, 0.5))
    assert found.explained
    assert np.allclose(found.density.x[:3], truth, atol=0.01)
    assert found.density.x[3] == pytest.approx(0.0, abs=0.3)


def test_an_optimum_at_a_bound_is_hit():
    found = searched(Problem(curved((0.8, 0.0, 0.7)), lower=(0.0, 0.0, 0.0)), (0.5, 0.5, 0.5))
    assert found.explained
    assert found.density.x[1] == pytest.approx(0.0, abs=0.01)


def test_the_same_seed_gives_the_same_answer():
    one, two = (searched(Problem(curved((0.8, 0.5, 0.7))), (0.2, 0.9, 0.5)) for _ in range(2))
    assert np.array_equal(one.density.x, two.density.x)


def test_what_nothing_explains_ends_with_the_budget():
    wave = 30.0 * np.sin(np.arange(SAMPLES) / 5.0)
    problem = Problem(lambda p: curved((0.8, 0.5, 0.7))(p) + wave)
    told = []
    first = ParameterDensity(np.array([0.5, 0.5, 0.5, 0.0]), 0.4 * np.eye(3))
    found = multistart_search(
        problem, first, np.zeros((4, 4)), [first], is_noise, budget=600, progress=told.append
    )
    assert not found.explained
    assert problem.evaluations < 600 + 600  # a start goes on to its end
    assert len(told) > found.starts  # between the rounds of each start, too
    assert told[-1] == 1.0


@pytest.mark.parametrize(("row", "size", "starts"), [(1, 4.0, 1), (1, 1.2, 2), (0, 4.0, 5)])
def test_a_place_that_only_misses_the_pressure_is_the_last_one(row, size, starts):
    """Once if that is far off, else twice. The spool may be explained elsewhere."""
    wave = np.zeros((2, SAMPLES))
    wave[row] = size * np.sin(np.arange(SAMPLES) / 5.0)
    problem = Problem(lambda p: curved((0.8, 0.5, 0.7))(p) + wave)
    first = ParameterDensity(np.array([0.5, 0.5, 0.5, 0.0]), 0.4 * np.eye(3))
    found = multistart_search(
        problem, first, np.zeros((4, 4)), [first], is_noise, gives_up=is_unexplainable
    )
    assert not found.explained
    assert found.starts == starts
    assert found.density.x[2] == pytest.approx(0.7, abs=0.05) or row == 1


@pytest.mark.parametrize("looks", [True, False])
def test_a_start_that_only_misses_the_pressure_looks_along_the_alias(looks):
    """The spool shows the sum of alias and offset; the pressure shows the alias near its truth."""
    t = np.linspace(0.0, 6.0, SAMPLES)

    def response(p):
        spool = 90.0 * p[0] + 100.0 * p[1] * np.sin(t) + 50.0 * p[2] * np.cos(t)
        return np.array([spool, 60.0 * np.tanh(8.0 * (p[0] - 0.4)) * np.sin(9.0 * t)])

    measured = response(np.array([0.4, 0.5, 0.6])) + noise()
    problem = Problem(lambda p: measured - response(p))
    first = ParameterDensity(np.array([1.4, 0.3, 0.3, 0.0]), 0.1 * np.eye(3))
    found = multistart_search(
        problem, first, np.diag([1.0, 1.0, 1.0, 0.0]), [first], is_noise, alias="Kintas", budget=1,
        goes_slow=True, looks_about=looks,
    )  # fmt: skip
    assert found.explained == looks
    assert (found.density.x[0] == pytest.approx(0.4, abs=0.01)) == looks


def test_a_settled_belief_is_as_wide_as_the_noise_allows():
    truth = (0.8, 0.5, 0.7)
    values = []
    for seed in range(8):
        problem = Problem(curved(truth, seed))
        start = ParameterDensity(np.array([0.7, 0.6, 0.6, 0.0]), 0.1 * np.eye(3))
        draw = partial(linearised_by_regression, rng=np.random.default_rng(seed))
        found = search_posterior(problem, start, start, np.zeros((4, 4)), draw)
        assert found.settled
        belief = found.density
        values.append(belief.x[:3])
    spread = np.std(values, axis=0)
    stated = 0.5 * np.sqrt(np.diag(belief.root @ belief.root.T))
    assert np.all(stated > 0.3 * spread)
    assert np.all(stated < 4.0 * spread)


def sharpened(function, width=0.4, pace=MANY_UNKNOWNS_SCHEDULE, seen=None):
    """A search on such residuals; also how many points it ran, and the places it came through."""
    problem = Problem(function)
    begin = ParameterDensity(np.array([0.5, 0.5, 0.5, 0.0]), width * np.eye(3))
    rng = np.random.default_rng(5)

    def linearise(model, belief):
        if seen is not None:
            seen.append(belief.x)
        return linearised_by_regression(model, belief, rng)

    found = search_posterior(problem, begin, begin, np.zeros((4, 4)), linearise, pace)
    return found, problem.evaluations


def cost_of(function, x):
    return cauchy_cost(Problem(function).many(x[None, :])[0])


def test_a_search_that_nothing_helps_ends_early():
    wave = 30.0 * np.sin(np.arange(SAMPLES) / 5.0)
    _, runs = sharpened(lambda p: curved((0.8, 0.5, 0.7))(p) + wave)
    assert runs < MANY_UNKNOWNS_SCHEDULE.most_rounds * 15 // 2


def test_a_step_of_the_cost_beside_the_optimum_keeps_no_search_from_its_end():
    smooth = curved((0.8, 0.5, 0.7))

    def stepped(p):
        out = smooth(p)
        out[1, :12] += 9.0 * (p[0] > 0.8005)
        return out

    found, runs = sharpened(stepped)
    assert found.settled
    assert runs < MANY_UNKNOWNS_SCHEDULE.most_rounds * 15
    assert np.allclose(found.density.x[:3], (0.8, 0.5, 0.7), atol=0.01)


@pytest.mark.parametrize("rounds", [1, 2, 3, 5])
def test_a_search_ends_at_the_best_place_that_it_came_through(rounds):
    function, seen = curved((0.8, 0.5, 0.7)), []
    found, _ = sharpened(
        function, pace=replace(MANY_UNKNOWNS_SCHEDULE, most_rounds=rounds), seen=seen
    )
    best = min(cost_of(function, x) for x in seen)
    assert cost_of(function, found.density.x) <= best


def test_noise_is_told_from_what_lasts():
    white = noise()
    assert is_noise(white)
    assert excess_cost(white) == pytest.approx(1.0, abs=0.1)
    assert is_noise(0.5 * white), "whatever its level"
    lasting = white + np.sin(np.arange(SAMPLES) / 9.0)
    assert excess_cost(lasting) > MAX_NOISE_EXCESS
    white[0, :20] = 8.0
    assert not is_noise(white)


def test_optima_of_like_cost_widen_the_interval():
    def spread(costs):
        places = tuple(StartEnd(np.array([0.1 * k, 0.0]), cost) for k, cost in enumerate(costs))
        best = MultistartResult(
            ParameterDensity(places[0].x, np.eye(1)), noise(), costs[0], True, places
        )
        return optima_covariance(best, np.array([1.0, 2.0]))

    assert spread([600.0]).max() == 0.0
    assert spread([600.0, 600.0])[0, 0] == pytest.approx(0.5 * 0.1**2)
    assert spread([600.0, 700.0])[0, 0] < 1e-20


def test_what_is_known_beforehand_replaces_the_usual_sizes():
    problem = Problem(linear()[1])
    usual, told = (
        prior_density(problem, {}),
        prior_density(problem, {"FSS": ParameterPrior(0.1, 0.02)}),
    )
    place = [item.name for item in problem.estimated].index("FSS")
    assert (usual.x[place], told.x[place]) == (0.4, 0.1)
    assert told.root[place, place] == 0.02
    information = prior_information(problem, {"FSS": ParameterPrior(0.1, 0.02)})
    assert information[place, place] == pytest.approx(2500.0)
    assert np.all(prior_information(problem, {})[3] == 0.0), "an offset may have any size"


def test_what_is_known_of_several_together_keeps_their_correlation():
    problem = Problem(linear()[1])
    names = tuple(item.name for item in problem.estimated[:2])
    covariance = np.array([[4e-4, 3.9e-4], [3.9e-4, 4e-4]])
    joint = JointPrior(names, np.array([0.2, 0.3]), covariance)
    belief = prior_density(problem, {}, joint)
    assert belief.x[:2] == pytest.approx([0.2, 0.3])
    assert (belief.root @ belief.root.T)[:2, :2] == pytest.approx(covariance)
    information = prior_information(problem, {}, joint)
    assert information[:2, :2] == pytest.approx(np.linalg.inv(covariance))


def test_sensors_offsets_are_always_estimated_and_no_nuisance_of_choice():
    names = [item.name for item in basic_nuisances_of(0.0)]
    assert names == ["null_bias", "torque_motor_gain", "hysteresis", "backlash"]


TRUTH = (0.52, 0.6, 0.47)
FREED = ("null_bias", "torque_motor_gain", "hysteresis", "backlash")


@lru_cache(maxsize=4)
def stranger(test, seed=1):
    """Recording of a unit with offsets, gain, null bias, hysteresis and backlash, and the unit."""
    unit = random_unit(np.random.default_rng(seed))
    recording = record(unit, resolve_test(test), Faults(*TRUTH), seed=seed)
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(test), default_actuator()
    )
    return experiment, unit


def errors(result):
    """Of the severities, in percent of damage."""
    values = np.array([item.value for item in result.estimates])
    return 100.0 * np.abs(values - TRUTH)


@pytest.fixture(scope="module", params=["open", "closed"])
def found(request):
    return request.param, identify([stranger(request.param)[0]])


def test_severities_are_exact_with_all_effects_unknown(found):
    test, result = found
    assert errors(result).mean() < {"open": 0.05, "closed": 0.5}[test]
    for item, truth in zip(result.estimates, TRUTH, strict=True):
        assert abs(item.value - truth) < 4.0 * item.std
        assert item.shown


def test_it_says_what_was_freed_and_what_it_found(found):
    test, result = found
    effects = stranger(test)[1].effects
    assert set(result.freed) == set(FREED)
    truth = (effects.null_bias, effects.gain_change, effects.hysteresis, effects.backlash)
    for name, value in zip(FREED, truth, strict=True):
        nuisance = result.nuisances[name]
        assert abs(nuisance.value - value) < 5.0 * nuisance.std + 1e-9
        assert nuisance.std > 0.0


def test_it_is_explained_and_quick(found):
    _, result = found
    assert result.fit.outliers < 0.01
    assert result.evaluations < 1200


def test_severities_alone_do_not_explain_it():
    result = identify([stranger("open")[0]], nuisances=NuisanceMode.NONE)
    assert result.freed == ()
    assert result.fit.outliers > 0.015


def test_both_tests_together_are_better_than_closed_loop_alone(found):
    test, alone = found
    if test == "open":
        pytest.skip("against closed loop")
    both = identify([stranger("open")[0], stranger("closed")[0]])
    assert errors(both).mean() < 0.05
    for one, joint in zip(alone.estimates, both.estimates, strict=True):
        assert joint.std < one.std


@pytest.mark.parametrize("test", ["open", "closed"])
def test_a_textbook_actuator_is_identified_as_without_nuisances(test):
    item = recorded(f"paper-{test}-2.blf", test)
    auto, none = (
        identify([item], nuisances=mode) for mode in (NuisanceMode.AUTO, NuisanceMode.NONE)
    )
    assert auto.freed == ()
    assert [e.value for e in auto.estimates] == [e.value for e in none.estimates]
    assert [e.std for e in auto.estimates] == [e.std for e in none.estimates]


@pytest.mark.parametrize("test", ["open", "closed"])
def test_a_textbook_actuator_with_everything_free(test):
    result = identify([recorded(f"paper-{test}-2.blf", test)], nuisances=NuisanceMode.ALL)
    truth = np.array([0.3, 0.6, 0.3])
    values = np.array([item.value for item in result.estimates])
    assert set(result.freed) == set(FREED)
    assert 100.0 * np.abs(values - truth).mean() < {"open": 0.05, "closed": 0.5}[test]


def test_a_reversed_sensor_is_explained_by_nothing():
    experiment, _ = stranger("open")
    result = identify([replace(experiment, spool=-experiment.spool)])
    assert result.fit.outliers > 0.015
    assert result.evaluations < 4000
