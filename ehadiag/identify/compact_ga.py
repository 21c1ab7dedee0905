"""Real-valued compact genetic algorithm: a probability vector instead of a population.

Mininno, Cupertino, Naso, "Real-Valued Compact Genetic Algorithms for Embedded Microcontroller
Optimization", IEEE Trans. Evolutionary Computation 12(2), 2008. A probability vector (mean and
deviation of each gene) stands for the population; each generation draws individuals from it, the
elite competes with each of them (persistent elitism), and the vector moves towards winners by the
weight of one individual in a virtual population. Several individuals are drawn a generation, so
that the model runs on many at once.

Three things differ from the paper. Draws outside the bounds are put on the bound, not drawn again:
an optimum at a bound is hit, not only approached. After each generation the mean goes half way to
the elite, and the deviation is at least a multiple of the elite's step in it: the vector shrinks
with every loser, and would else collapse away from the optimum while the elite still moves on.

The state is the vector, the elite and the random generator: a few numbers, whatever the number of
generations or the size of the virtual population.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2, bare_kernel, kernel

ELITE_PULL = 0.5
"""Share of its distance from the elite by which the mean moves after a generation, 1: the vector
would else collapse away from the optimum while the elite moves on. Half: as much of the old as of
the new."""
MIN_SPREAD_STEPS = 1.5
"""Least deviation after a generation, in steps of the elite, for the same reason: more than one, so
that the next step can be as long; a bound of judgement, as the paper's tables have it (`tools/study
paper`)."""


class CompactGaState(NamedTuple):
    """State of the search between two generations; k genes."""

    mean: Array
    spread: Array
    elite: Array
    """Probability vector and best individual, in shares of the bounds 0 … 1; shape (k,)."""
    best: Array
    """Cost of the elite; shape (1,)."""
    generator: NDArray[np.uint64]
    """State of the random numbers; shape (1,)."""


def state_bytes(genes: int) -> int:
    """Memory of the search itself: mean, deviation and elite of each gene, cost, generator."""
    return sum(part.nbytes for part in initial_state(np.zeros(genes), np.zeros(genes), 0))


def initial_state(mean: Array, spread: Array, seed: int) -> CompactGaState:
    """State before the first generation."""
    generator = np.array([seed], dtype=np.uint64)
    return CompactGaState(mean.copy(), spread.copy(), mean.copy(), np.array([np.inf]), generator)


@bare_kernel
def _next_uniform(state: NDArray[np.uint64]) -> float:
    """Uniform in (0, 1): SplitMix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (float(z >> np.uint64(11)) + 0.5) / 9007199254740992.0


@bare_kernel
def _next_normal(state: NDArray[np.uint64]) -> float:
    """Standard normal: Box and Muller."""
    radius = math.sqrt(-2.0 * math.log(_next_uniform(state)))
    return radius * math.cos(2.0 * math.pi * _next_uniform(state))


@kernel
def draw_generation(state: CompactGaState, out: Array2) -> None:
    """Draw a generation: out, shape (samples, k), each gene in 0 … 1."""
    for i in range(out.shape[0]):
        for g in range(out.shape[1]):
            value = state.mean[g] + state.spread[g] * _next_normal(state.generator)
            out[i, g] = min(max(value, 0.0), 1.0)


@kernel
def update_state(
    state: CompactGaState,
    population: Array2,
    costs: Array,
    virtual_population: float,
    tolerance: float,
    before: Array,
) -> None:
    """Let the elite compete with a generation, and move the probability vector towards winners.

    population: shape (samples, k); costs: shape (samples,); virtual_population: size N_p of the
    population that the vector stands for; tolerance: deviation at which the search is done, a
    gene's own is kept above a quarter of it; before: shape (k,), overwritten.
    """
    mean, spread, elite = state.mean, state.spread, state.elite
    for g in range(population.shape[1]):
        before[g] = elite[g]
    for i in range(population.shape[0]):
        wins = costs[i] < state.best[0]
        for g in range(population.shape[1]):
            winner = population[i, g] if wins else elite[g]
            loser = elite[g] if wins else population[i, g]
            change = (winner - loser) / virtual_population
            square = (
                spread[g] ** 2
                + ((winner - mean[g]) ** 2 - (loser - mean[g]) ** 2) / virtual_population
                - change**2
            )
            mean[g] = min(max(mean[g] + change, 0.0), 1.0)
            spread[g] = math.sqrt(max(square, (0.25 * tolerance) ** 2))
            if wins:
                elite[g] = population[i, g]
        if wins:
            state.best[0] = costs[i]
    for g in range(population.shape[1]):
        mean[g] += ELITE_PULL * (elite[g] - mean[g])
        spread[g] = max(spread[g], MIN_SPREAD_STEPS * abs(elite[g] - before[g]))
