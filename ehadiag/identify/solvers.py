"""Global search: the objective, capped squares of residuals, and the solvers that minimise it.

The compact genetic algorithm, and pygad for offline use, behind one interface.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.compile.jit import Array
from ehadiag.identify import compact_ga
from ehadiag.identify.linearisation import RUN_BLOCK_SIZE
from ehadiag.model.registry import ResidualModel
from firmware_iface.errors import ConfigurationError

SEARCH_CAP = 25.0
"""Largest square of one weighted residual, 1: a break-away that went the other way costs no more.
Five deviations: noise alone makes that of one sample in two million."""


class Objective:
    """A function of a population within bounds; counts its evaluations.

    All unknowns of the model are searched and have finite bounds; cap: largest square of one
    weighted residual that counts.
    """

    def __init__(self, model: ResidualModel, cap: float = SEARCH_CAP) -> None:
        self.model = model
        self.cap = cap
        self.lower = model.unknowns.lower
        self.upper = model.unknowns.upper

    @property
    def evaluations(self) -> int:
        """Evaluations so far."""
        return self.model.evaluations

    def __call__(self, population: Array) -> Array:
        """Cost of each row, shape (n,) for a population of shape (n, k)."""
        return self.model.costs(population, self.cap)


EvaluationProgress = Callable[[int, int], None]
"""Called with evaluations done and budget."""


class SearchResult(msgspec.Struct, frozen=True, eq=False):
    """Outcome of one global search."""

    best: Array
    """Shape (k,)."""
    cost: float
    evaluations: int
    generations: int
    history: Array
    """Best cost after each generation."""


class Solver(Protocol):
    """Minimises an objective within its bounds, from a start with a deviation."""

    @property
    def name(self) -> str:
        """What results call it."""
        ...

    @property
    def budget(self) -> int:
        """Evaluations at most."""
        ...

    def with_budget(self, budget: int) -> Solver:
        """Return the same solver with another number of evaluations."""
        ...

    def minimise(
        self,
        objective: Objective,
        start: Array,
        deviation: Array | float,
        seed: int,
        progress: EvaluationProgress | None = None,
    ) -> SearchResult:
        """Search; the same seed gives the same answer.

        `start` has shape (k,), `deviation` about it too, or is one for all genes.
        """
        ...


class CompactGa(msgspec.Struct, frozen=True):
    """The compact genetic algorithm (`ehadiag.identify.compact_ga`)."""

    budget: int = 600
    """Evaluations at most, 1: of a search of its own; the stages have a twelfth of them."""
    virtual_population: float = 42.0
    """Individuals that the probability vector stands for, 1: a bound of judgement."""
    samples: int = RUN_BLOCK_SIZE // 2
    """Individuals drawn a generation, 1: half a block of runs, since how often the elite moves on
    counts more."""
    tolerance: float = 1e-6
    """Done when the deviation of every gene is below, 1: a hundredth of what noise leaves."""
    name: ClassVar[str] = "cga"

    def with_budget(self, budget: int) -> CompactGa:
        """Return the same solver with another number of evaluations."""
        return replace(self, budget=budget)

    def minimise(
        self,
        objective: Objective,
        start: Array,
        deviation: Array | float,
        seed: int,
        progress: EvaluationProgress | None = None,
    ) -> SearchResult:
        """Search, see the protocol."""
        width = objective.upper - objective.lower
        first = (np.asarray(start, dtype=np.float64) - objective.lower) / width
        state = compact_ga.initial_state(
            first, np.broadcast_to(deviation / width, first.shape), seed
        )
        population, before = np.empty((self.samples, len(first))), np.empty(len(first))
        history: list[float] = []
        used = 0
        while used + self.samples <= self.budget:
            compact_ga.draw_generation(state, population)
            if not history:
                population[0] = first
            costs = objective(objective.lower + population * width)
            compact_ga.update_state(
                state, population, costs, self.virtual_population, self.tolerance, before
            )
            used += self.samples
            history.append(float(state.best[0]))
            if progress is not None:
                progress(used, self.budget)
            if state.spread.max() < self.tolerance:
                break
        best = objective.lower + state.elite * width
        return SearchResult(best, float(state.best[0]), used, len(history), np.array(history))


class PygadGa(msgspec.Struct, frozen=True):
    """pygad's genetic algorithm on the same objective.

    The mutation's range shrinks geometrically with the generations, from the deviation to
    `finest`; pygad's own adaptive mutation changes how often a gene mutates, not how far.
    """

    budget: int = 1600
    population: int = RUN_BLOCK_SIZE
    finest: float = 5e-6
    """Range of the mutation in the last generation."""
    name: ClassVar[str] = "pygad"

    def with_budget(self, budget: int) -> PygadGa:
        """Return the same solver with another number of evaluations."""
        return replace(self, budget=budget)

    def minimise(
        self,
        objective: Objective,
        start: Array,
        deviation: Array | float,
        seed: int,
        progress: EvaluationProgress | None = None,
    ) -> SearchResult:
        """Search; deterministic for a seed."""
        import pygad  # noqa: PLC0415 - half a second, only for who asks

        widest = float(np.max(deviation))
        rng = np.random.default_rng(seed)
        lower, upper = objective.lower, objective.upper
        first = np.clip(rng.normal(start, deviation, (self.population, len(start))), lower, upper)
        first[0] = start
        before = objective.evaluations
        history: list[float] = []

        def fitness(_: Any, solutions: Array, __: Any) -> Array:
            return -objective(np.clip(solutions, lower, upper))

        generations = max(1, (self.budget - self.population) // (self.population - 1))

        def after(ga: Any) -> None:
            share = ga.generations_completed / generations
            reach = widest * min(1.0, self.finest / widest) ** share
            ga.random_mutation_min_val, ga.random_mutation_max_val = -reach, reach
            history.append(-float(np.max(ga.last_generation_fitness)))
            if progress is not None:
                progress(objective.evaluations - before, self.budget)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ga = pygad.GA(
                num_generations=generations,
                num_parents_mating=3,
                initial_population=first,
                fitness_func=fitness,
                fitness_batch_size=self.population,
                # No gene_space: with one, a mutated gene is drawn from all of it.
                parent_selection_type="sss",
                keep_elitism=1,
                crossover_type="uniform",
                mutation_type="random",
                mutation_by_replacement=False,
                mutation_probability=0.8,
                random_mutation_min_val=-widest,
                random_mutation_max_val=widest,
                random_seed=seed,
                suppress_warnings=True,
                on_generation=after,
            )
            ga.run()
            best, value, _ = ga.best_solution(ga.last_generation_fitness)
        used = objective.evaluations - before
        return SearchResult(
            np.clip(np.asarray(best, dtype=np.float64), lower, upper),
            -float(value),
            used,
            len(history),
            np.array(history),
        )


SOLVERS: dict[str, Callable[[], Solver]] = {"cga": CompactGa, "pygad": PygadGa}


def make_solver(name: str) -> Solver:
    """Return the solver of that name; ConfigurationError if there is none."""
    if name not in SOLVERS:
        raise ConfigurationError(f"solver {name!r}: choose one of {', '.join(SOLVERS)}")
    return SOLVERS[name]()
