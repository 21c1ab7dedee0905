"""Solvers behind one interface: the compact genetic algorithm, and pygad for offline use."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.errors import ConfigurationError
from ehadiag.identify.search.compact_ga import compact_ga
from ehadiag.identify.search.objective import Objective

__all__ = ["SOLVERS", "CompactGa", "PygadGa", "SearchResult", "Solver", "make_solver"]

Progress = Callable[[int, int], None]
"""Called with evaluations done and budget."""
POLL_S = 0.05
PARENTS, ELITE, MUTATION = 3, 1, 0.8
"""Of pygad: parents of a generation, individuals kept, probability that a gene mutates."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Outcome of one global search."""

    best: NDArray[np.float64]
    """Shape (3,)."""
    cost: float
    evaluations: int
    generations: int
    history: NDArray[np.float64]
    """Best cost after each generation."""


class Solver(Protocol):
    """Minimises an objective over the unit cube, from a start with a deviation."""

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
        start: NDArray[np.float64],
        deviation: NDArray[np.float64] | float,
        seed: int,
        progress: Progress | None = None,
    ) -> SearchResult:
        """Search; the same seed gives the same answer.

        `start` has shape (3,), `deviation` about it too, or is one for all genes.
        """
        ...


@dataclass(frozen=True, slots=True)
class CompactGa:
    """The compact genetic algorithm, model and all in one compiled call."""

    budget: int = 600
    """Evaluations at most."""
    virtual_population: float = 42.0
    samples: int = 16
    """Individuals drawn a generation."""
    tolerance: float = 1e-6
    """Done when the deviation of every gene is below."""
    name: str = field(default="cga", init=False)

    def with_budget(self, budget: int) -> CompactGa:
        """Return the same solver with another number of evaluations."""
        return replace(self, budget=budget)

    def minimise(
        self,
        objective: Objective,
        start: NDArray[np.float64],
        deviation: NDArray[np.float64] | float,
        seed: int,
        progress: Progress | None = None,
    ) -> SearchResult:
        """Search; with `progress`, Ctrl-C stops it between two generations."""
        control = np.zeros(2, dtype=np.int64)
        history = np.empty(self.budget // self.samples + 1)
        outcome: list[tuple[NDArray[np.float64], float, int, int]] = []

        def work() -> None:
            outcome.append(
                compact_ga(
                    objective.batch,
                    objective.work,
                    objective.offsets,
                    objective.cap,
                    np.asarray(start, dtype=np.float64),
                    np.broadcast_to(np.asarray(deviation, np.float64), len(start)).copy(),
                    self.virtual_population,
                    self.samples,
                    self.budget,
                    self.tolerance,
                    seed,
                    control,
                    history,
                )
            )

        if progress is None:
            work()
        else:
            thread = threading.Thread(target=work, name="ehadiag-search")
            thread.start()
            try:
                while thread.is_alive():
                    thread.join(POLL_S)
                    progress(int(control[1]), self.budget)
            except BaseException:
                control[0] = 1
                thread.join()
                raise
        best, cost, used, generations = outcome[0]
        objective.evaluations += used
        return SearchResult(best, float(cost), used, generations, history[:generations].copy())


@dataclass(frozen=True, slots=True)
class PygadGa:
    """pygad's genetic algorithm on the same objective.

    The mutation's range shrinks geometrically with the generations, from the deviation to
    `finest`; pygad's own adaptive mutation changes how often a gene mutates, not how far.
    """

    budget: int = 1600
    population: int = 16
    finest: float = 5e-6
    """Range of the mutation in the last generation."""
    name: str = field(default="pygad", init=False)

    def with_budget(self, budget: int) -> PygadGa:
        """Return the same solver with another number of evaluations."""
        return replace(self, budget=budget)

    def minimise(
        self,
        objective: Objective,
        start: NDArray[np.float64],
        deviation: NDArray[np.float64] | float,
        seed: int,
        progress: Progress | None = None,
    ) -> SearchResult:
        """Search; deterministic for a seed."""
        import pygad  # noqa: PLC0415 - half a second, only for who asks

        widest = float(np.max(deviation))
        rng = np.random.default_rng(seed)
        first = np.clip(rng.normal(start, deviation, (self.population, len(start))), 0.0, 1.0)
        first[0] = start
        before = objective.evaluations
        history: list[float] = []

        def fitness(_: Any, solutions: NDArray[np.float64], __: Any) -> NDArray[np.float64]:
            return -objective(np.clip(solutions, 0.0, 1.0))

        generations = max(1, (self.budget - self.population) // (self.population - ELITE))

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
                num_parents_mating=PARENTS,
                initial_population=first,
                fitness_func=fitness,
                fitness_batch_size=self.population,
                # No gene_space: with one, a mutated gene is drawn from all of it.
                parent_selection_type="sss",
                keep_elitism=ELITE,
                crossover_type="uniform",
                mutation_type="random",
                mutation_by_replacement=False,
                mutation_probability=MUTATION,
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
            np.clip(np.asarray(best, dtype=np.float64), 0.0, 1.0),
            -float(value),
            used,
            len(history),
            np.array(history),
        )


SOLVERS: dict[str, Callable[[], Solver]] = {"cga": CompactGa, "pygad": PygadGa}


def make_solver(name: str) -> Solver:
    """Return the solver of that name.

    Raises
    ------
    ConfigurationError: there is none.
    """
    if name not in SOLVERS:
        raise ConfigurationError(f"solver {name!r}: choose one of {', '.join(SOLVERS)}")
    return SOLVERS[name]()
