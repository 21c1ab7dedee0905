"""Compact genetic algorithm and its rivals behind one interface."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from identify_cases import recorded

from ehadiag import ConfigurationError
from ehadiag.identify import compact_ga
from ehadiag.identify.experiment import lay_out_spans, unknowns_of
from ehadiag.identify.solvers import CompactGa, Objective, PygadGa, make_solver
from ehadiag.model.registry import FAULTS
from ehadiag.model.residual_models import SimdModel

TRUTH = np.array([0.6, 0.6, 0.3])
START = TRUTH + np.array([0.01, -0.01, 0.01])


@pytest.fixture
def objective():
    experiment = recorded("paper-open-3.blf", "open")
    batch = lay_out_spans([experiment], [experiment.test.windows.refinement], lead=0.1)
    return Objective(SimdModel(batch, unknowns_of([experiment], FAULTS)))


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
    assert found.cost == found.history[-1] == objective(found.best[None])[0]
    assert found.cost <= objective(START[None])[0]
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


def test_the_search_is_its_three_steps(objective):
    """A generation at a time, by hand: the digits of the solver, which holds nothing else."""
    solver = CompactGa(budget=160)
    state = compact_ga.initial_state(START, np.full(3, 0.02), 4)
    population = np.empty((solver.samples, 3))
    for generation in range(20):
        compact_ga.draw_generation(state, population)
        if generation == 0:
            population[0] = START
        costs = objective(population)
        compact_ga.update_state(
            state, population, costs, solver.virtual_population, solver.tolerance, np.empty(3)
        )
    found = solver.minimise(objective, START, 0.02, 4)
    np.testing.assert_array_equal(found.best, state.elite)
    assert (found.cost, found.generations, found.evaluations) == (state.best[0], 20, 160)


def test_other_bounds_scale_the_search():
    """Genes are shares of the bounds: a bowl found between 0 and 1 is found between -40 and 60."""

    class Bowl(Objective):
        evaluations = 0

        def __init__(self, lower, upper):
            self.lower, self.upper = np.full(4, lower), np.full(4, upper)

        def __call__(self, population):
            shares = (population - self.lower) / (self.upper - self.lower)
            return ((shares - 0.3) ** 2).sum(axis=1)

    unit, wide = Bowl(0.0, 1.0), Bowl(-40.0, 60.0)
    here = CompactGa(budget=4000).minimise(unit, np.full(4, 0.5), 0.1, 0)
    there = CompactGa(budget=4000).minimise(wide, np.full(4, 10.0), 10.0, 0)
    np.testing.assert_allclose(here.best, 0.3, atol=1e-3)
    np.testing.assert_allclose(there.best, -40.0 + 100.0 * here.best, atol=1e-6)


def test_a_budget_below_a_generation_leaves_the_start(objective):
    found = CompactGa(budget=7).minimise(objective, START, 0.02, 1)
    assert (found.evaluations, found.generations) == (0, 0)
    np.testing.assert_allclose(found.best, START)
    assert found.cost == np.inf


@given(st.integers(0, 2**63), st.integers(1, 6), st.integers(1, 20))
def test_draws_stay_inside_and_the_elite_never_gets_worse(seed, genes, samples):
    rng = np.random.default_rng(seed % 1000)
    state = compact_ga.initial_state(rng.random(genes), rng.random(genes), seed)
    population = np.empty((samples, genes))
    best = np.inf
    for _ in range(5):
        compact_ga.draw_generation(state, population)
        assert ((population >= 0.0) & (population <= 1.0)).all()
        costs = rng.random(samples)
        compact_ga.update_state(state, population, costs, 40.0, 1e-6, np.empty(genes))
        best = min(best, costs.min())
        assert state.best[0] == best
        assert ((state.mean >= 0.0) & (state.mean <= 1.0)).all()
        assert (state.spread > 0.0).all()


def test_memory_is_that_of_the_genes():
    assert compact_ga.state_bytes(3) <= 128
    assert compact_ga.state_bytes(6) - compact_ga.state_bytes(3) == 3 * 24


def test_an_unknown_solver_is_refused():
    with pytest.raises(ConfigurationError, match="choose one of cga, pygad"):
        make_solver("annealing")
