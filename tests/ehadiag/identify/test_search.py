"""Compact genetic algorithm and its rivals behind one interface."""

import numpy as np
import pytest
from identify_cases import recorded

from ehadiag.core.errors import ConfigurationError
from ehadiag.identify.experiment import make_batch
from ehadiag.identify.search.compact_ga import compact_ga, state_bytes
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import CompactGa, PygadGa, make_solver

TRUTH = np.array([0.6, 0.6, 0.3])
START = TRUTH + np.array([0.01, -0.01, 0.01])


@pytest.fixture
def objective():
    experiment = recorded("paper-open-3.blf", "open")
    return Objective(make_batch([experiment], [experiment.test.windows.refinement], lead=0.1))


@pytest.mark.parametrize("solver", [CompactGa(budget=400), PygadGa(budget=400)])
def test_the_same_seed_gives_the_same_digits(objective, solver):
    first = solver.minimise(objective, START, 0.02, 5)
    second = solver.minimise(objective, START, 0.02, 5)
    other = solver.minimise(objective, START, 0.02, 6)
    np.testing.assert_array_equal(first.best, second.best)
    np.testing.assert_array_equal(first.history, second.history)
    assert first.cost == second.cost
    assert (first.history != other.history[: len(first.history)]).any()


@pytest.mark.parametrize("solver", [CompactGa(budget=800), PygadGa(budget=800)])
def test_the_best_never_gets_worse_and_is_what_it_says(objective, solver):
    before = objective.evaluations
    found = solver.minimise(objective, START, 0.02, 1)
    assert objective.evaluations - before == found.evaluations <= 800
    assert (np.diff(found.history) <= 0.0).all()
    assert found.cost == found.history[-1] == objective(found.best)[0]
    assert found.cost <= objective(START)[0]
    assert ((found.best >= 0.0) & (found.best <= 1.0)).all()


def test_compact_ga_finds_the_truth(objective):
    for seed in range(5):
        found = CompactGa().minimise(objective, START, 0.02, seed)
        np.testing.assert_allclose(found.best, TRUTH, atol=5e-4)


def test_progress_is_told_and_changes_nothing(objective):
    told = []
    quiet = CompactGa().minimise(objective, START, 0.02, 3)
    loud = CompactGa().minimise(objective, START, 0.02, 3, lambda *args: told.append(args))
    np.testing.assert_array_equal(quiet.best, loud.best)
    assert told
    assert all(0 <= done <= budget == 600 for done, budget in told)


def test_an_interrupt_stops_the_search(objective):
    def stop(_done, _budget):
        raise KeyboardInterrupt

    solver = CompactGa(budget=200_000, tolerance=0.0)
    with pytest.raises(KeyboardInterrupt):
        solver.minimise(objective, START, 0.02, 0, stop)


def run_compact(objective, control, history):
    return compact_ga(
        objective.batch, objective.work, np.zeros(2), 25.0, START,
        np.full(3, 0.02), 40.0, 8, 400, 1e-5, 1, control, history,
    )  # fmt: skip


def test_a_set_flag_stops_before_the_first_generation(objective):
    history = np.full(51, np.nan)
    best, cost, used, generations = run_compact(objective, np.array([1, 0]), history)
    assert (used, generations) == (0, 0)
    np.testing.assert_array_equal(best, START)
    assert cost == np.inf
    assert np.isnan(history).all()


def test_the_counter_follows_the_evaluations(objective):
    control = np.zeros(2, dtype=np.int64)
    _, _, used, generations = run_compact(objective, control, np.empty(51))
    assert control[1] == used == 8 * generations


def test_memory_is_that_of_the_genes():
    assert state_bytes(3) <= 128
    assert state_bytes(6) - state_bytes(3) == 3 * 24


def test_an_unknown_solver_is_refused():
    with pytest.raises(ConfigurationError, match="choose one of cga, pygad"):
        make_solver("annealing")
