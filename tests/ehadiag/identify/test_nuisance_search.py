"""The search for many parameters: on problems whose answer is known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag.identify.nuisance.estimate import spread_of_optima
from ehadiag.identify.nuisance.explained import MOST_EXCESS, excess, is_noise
from ehadiag.identify.nuisance.prior import Joint, Known, belief_of, information_of, nuisances_of
from ehadiag.identify.nuisance.starts import Found, Place, search
from ehadiag.identify.refine.linearisation import Belief, linearised
from ehadiag.identify.refine.posterior import MANY, robust_cost, sharpen
from ehadiag.model.parameters import FAULTS, REGISTRY, parameter

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


@given(
    seed=st.integers(0, 99),
    widths=st.lists(st.floats(1e-6, 1.0), min_size=3, max_size=3),
)
@settings(max_examples=20, deadline=None)
def test_a_linear_model_is_found_exactly_whatever_the_spread(seed, widths):
    slopes, function = linear(seed)
    found = linearised(
        Problem(function),
        Belief(np.array([0.3, -0.2, 0.1, 0.5]), np.diag(widths)),
        np.random.default_rng(seed),
    )
    assert np.allclose(found.jacobian[:3], slopes, rtol=1e-4, atol=1e-5)
    assert found.scatter.max() < 1e-9
    assert np.allclose(found.residuals[1], function(found.x[:3])[1])


def test_points_stay_within_the_bounds():
    seen = []
    problem = Problem(lambda p: seen.append(p.copy()) or linear()[1](p), lower=(0.0, 0.0, 0.0))
    linearised(problem, Belief(np.zeros(4), np.eye(3)), np.random.default_rng(0))
    assert min(p.min() for p in seen) >= 0.0


def test_rows_that_jump_scatter():
    """A break-away makes a step: over it the linear model does not hold."""
    _, function = linear()

    def jumping(p):
        out = function(p)
        out[1, :10] += 20.0 * (p[0] > 0.0)
        return out

    found = linearised(Problem(jumping), Belief(np.zeros(4), np.eye(3)), np.random.default_rng(0))
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
    first = Belief(np.array([*begin, 0.0]), width * np.eye(3))
    information = np.diag([1.0, 1.0, 1.0, 0.0])
    return search(problem, first, information, [first], is_noise, seed=1)


def test_it_finds_the_optimum_of_a_bent_valley():
    truth = (0.8, 0.5, 0.7)
    found = searched(Problem(curved(truth)), (0.5, 0.5, 0.5))
    assert found.explained
    assert np.allclose(found.belief.x[:3], truth, atol=0.01)
    assert found.belief.x[3] == pytest.approx(0.0, abs=0.3)


def test_an_optimum_at_a_bound_is_hit():
    found = searched(Problem(curved((0.8, 0.0, 0.7)), lower=(0.0, 0.0, 0.0)), (0.5, 0.5, 0.5))
    assert found.explained
    assert found.belief.x[1] == pytest.approx(0.0, abs=0.01)


def test_the_same_seed_gives_the_same_answer():
    one, two = (searched(Problem(curved((0.8, 0.5, 0.7))), (0.2, 0.9, 0.5)) for _ in range(2))
    assert np.array_equal(one.belief.x, two.belief.x)


def test_what_nothing_explains_ends_with_the_budget():
    wave = 30.0 * np.sin(np.arange(SAMPLES) / 5.0)
    problem = Problem(lambda p: curved((0.8, 0.5, 0.7))(p) + wave)
    told = []
    first = Belief(np.array([0.5, 0.5, 0.5, 0.0]), 0.4 * np.eye(3))
    found = search(
        problem,
        first,
        np.zeros((4, 4)),
        [first],
        is_noise,
        budget=600,
        tell=told.append,
    )
    assert not found.explained
    assert problem.evaluations < 600 + 600  # a start goes on to its end
    assert len(told) > found.starts  # between the rounds of each start, too
    assert told[-1] == 1.0


@pytest.mark.parametrize(
    ("row", "before", "confirms", "starts"),
    [
        (1, np.inf, True, 2),  # found again
        (1, 2.0, True, 1),  # and not better than with fewer unknowns
        (0, 2.0, True, None),  # the spool may be explained elsewhere
        (1, 2.0, False, None),
    ],
)
def test_a_place_that_only_misses_the_pressure_is_left_once_it_is_found_again(
    row, before, confirms, starts
):
    wave = np.zeros((2, SAMPLES))
    wave[row] = 4.0 * np.sin(np.arange(SAMPLES) / 5.0)
    problem = Problem(lambda p: curved((0.8, 0.5, 0.7))(p) + wave)
    first = Belief(np.array([0.5, 0.5, 0.5, 0.0]), 0.4 * np.eye(3))
    found = search(
        problem,
        first,
        np.zeros((4, 4)),
        [first],
        is_noise,
        confirms=confirms,
        before=before,
    )
    assert not found.explained
    assert found.confirmed == (starts is not None)
    assert found.starts == starts or (starts is None and found.starts > 2)
    assert found.belief.x[2] == pytest.approx(0.7, abs=0.05) or row == 1


def test_a_settled_belief_is_as_wide_as_the_noise_allows():
    truth = (0.8, 0.5, 0.7)
    values = []
    for seed in range(8):
        problem = Problem(curved(truth, seed))
        start = Belief(np.array([0.7, 0.6, 0.6, 0.0]), 0.1 * np.eye(3))
        draw = partial(linearised, rng=np.random.default_rng(seed))
        found = sharpen(problem, start, start, np.zeros((4, 4)), draw)
        assert found.settled
        belief = found.belief
        values.append(belief.x[:3])
    spread = np.std(values, axis=0)
    stated = 0.5 * np.sqrt(np.diag(belief.root @ belief.root.T))
    assert np.all(stated > 0.3 * spread)
    assert np.all(stated < 4.0 * spread)


def sharpened(function, width=0.4, pace=MANY, seen=None):
    """A search on such residuals; also how many points it ran, and the places it came through."""
    problem = Problem(function)
    begin = Belief(np.array([0.5, 0.5, 0.5, 0.0]), width * np.eye(3))
    rng = np.random.default_rng(5)

    def linearise(model, belief):
        if seen is not None:
            seen.append(belief.x)
        return linearised(model, belief, rng)

    found = sharpen(problem, begin, begin, np.zeros((4, 4)), linearise, pace)
    return found, problem.evaluations


def cost_of(function, x):
    return robust_cost(Problem(function).many(x[None, :])[0])


def test_a_search_that_nothing_helps_ends_early():
    wave = 30.0 * np.sin(np.arange(SAMPLES) / 5.0)
    _, runs = sharpened(lambda p: curved((0.8, 0.5, 0.7))(p) + wave)
    assert runs < MANY.most_rounds * 15 // 2


def test_a_step_of_the_cost_beside_the_optimum_keeps_no_search_from_its_end():
    smooth = curved((0.8, 0.5, 0.7))

    def stepped(p):
        out = smooth(p)
        out[1, :12] += 9.0 * (p[0] > 0.8005)
        return out

    found, runs = sharpened(stepped)
    assert found.settled
    assert runs < MANY.most_rounds * 15
    assert np.allclose(found.belief.x[:3], (0.8, 0.5, 0.7), atol=0.01)


@pytest.mark.parametrize("rounds", [1, 2, 3, 5])
def test_a_search_ends_at_the_best_place_that_it_came_through(rounds):
    function, seen = curved((0.8, 0.5, 0.7)), []
    found, _ = sharpened(function, pace=replace(MANY, most_rounds=rounds), seen=seen)
    best = min(cost_of(function, x) for x in seen)
    assert cost_of(function, found.belief.x) <= best


def test_noise_is_told_from_what_lasts():
    white = noise()
    assert is_noise(white)
    assert excess(white) == pytest.approx(1.0, abs=0.1)
    assert is_noise(0.5 * white), "whatever its level"
    lasting = white + np.sin(np.arange(SAMPLES) / 9.0)
    assert excess(lasting) > MOST_EXCESS
    white[0, :20] = 8.0
    assert not is_noise(white)


def test_optima_of_like_cost_widen_the_interval():
    def spread(costs):
        places = tuple(Place(np.array([0.1 * k, 0.0]), cost) for k, cost in enumerate(costs))
        best = Found(Belief(places[0].x, np.eye(1)), noise(), costs[0], True, places)
        return spread_of_optima(best, np.array([1.0, 2.0]))

    assert spread([600.0]).max() == 0.0
    assert spread([600.0, 600.0])[0, 0] == pytest.approx(0.5 * 0.1**2)
    assert spread([600.0, 700.0])[0, 0] < 1e-20


def test_what_is_known_beforehand_replaces_the_usual_sizes():
    problem = Problem(linear()[1])
    usual, told = belief_of(problem, {}), belief_of(problem, {"FSS": Known(0.1, 0.02)})
    place = [item.name for item in problem.estimated].index("FSS")
    assert (usual.x[place], told.x[place]) == (0.4, 0.1)
    assert told.root[place, place] == 0.02
    information = information_of(problem, {"FSS": Known(0.1, 0.02)})
    assert information[place, place] == pytest.approx(2500.0)
    assert np.all(information_of(problem, {})[3] == 0.0), "an offset may have any size"


def test_what_is_known_of_several_together_keeps_their_correlation():
    problem = Problem(linear()[1])
    names = tuple(item.name for item in problem.estimated[:2])
    covariance = np.array([[4e-4, 3.9e-4], [3.9e-4, 4e-4]])
    joint = Joint(names, np.array([0.2, 0.3]), covariance)
    belief = belief_of(problem, {}, joint)
    assert belief.x[:2] == pytest.approx([0.2, 0.3])
    assert (belief.root @ belief.root.T)[:2, :2] == pytest.approx(covariance)
    information = information_of(problem, {}, joint)
    assert information[:2, :2] == pytest.approx(np.linalg.inv(covariance))


def test_sensors_offsets_are_always_estimated_and_no_nuisance_of_choice():
    names = [item.name for item in nuisances_of(REGISTRY)]
    assert names == ["null_bias", "torque_motor_gain", "hysteresis", "backlash"]
