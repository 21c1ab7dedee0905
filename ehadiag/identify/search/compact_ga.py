"""Real-valued compact genetic algorithm, compiled as a whole.

Mininno, Cupertino, Naso, "Real-Valued Compact Genetic Algorithms for Embedded Microcontroller
Optimization", IEEE Trans. Evolutionary Computation 12(2), 2008. A probability vector (mean and
deviation of each gene) stands for the population; each generation draws individuals from it, the
elite competes with each of them (persistent elitism), and the vector moves towards winners by the
weight of one individual in a virtual population. Several individuals are drawn a generation, so
that the model runs on many at once.

Three things differ from the paper. Draws outside the bounds are put on the bound, not drawn again:
an optimum at a bound is hit, not only approached. After each generation the mean goes half way to
the elite, and the deviation is at least a multiple of the elite's step in it: the vector shrinks
with every loser, and would else collapse beside the optimum while the elite still moves on.

The state is the vector, the elite and the random generator: a few numbers, whatever the number of
generations or the size of the virtual population.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.scalar.residuals import Batch
from ehadiag.model.simd.residuals import LaneWork, run_blocks

__all__ = ["compact_ga", "state_bytes"]

PULL = 0.5
"""Share of its distance from the elite by which the mean moves after a generation."""
REACH = 1.5
"""Least deviation after a generation, in steps of the elite."""


def state_bytes(genes: int) -> int:
    """Memory of the search itself: mean, deviation and elite of each gene, cost, generator."""
    return genes * 3 * 8 + 8 + 8


@kernel
def _next_uniform(state: NDArray[np.uint64]) -> float:
    """Uniform in (0, 1): SplitMix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (float(z >> np.uint64(11)) + 0.5) / 9007199254740992.0


@kernel
def _next_normal(state: NDArray[np.uint64]) -> float:
    """Standard normal: Box and Muller."""
    radius = math.sqrt(-2.0 * math.log(_next_uniform(state)))
    return radius * math.cos(2.0 * math.pi * _next_uniform(state))


@kernel
def compact_ga(
    batch: Batch,
    work: LaneWork,
    offsets: NDArray[np.float64],
    cap: float,
    start: NDArray[np.float64],
    deviation: NDArray[np.float64],
    virtual_population: float,
    samples: int,
    budget: int,
    tolerance: float,
    seed: int,
    control: NDArray[np.int64],
    history: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float, int, int]:
    """Search from `start`, all genes in 0 … 1.

    Parameters
    ----------
    batch, work, cap: see `ehadiag.model.simd.residuals.run_blocks`.
    offsets: sensor offsets, held, shape (2,).
    start, deviation: mean and deviation of the first probability vector, shape (3,).
    virtual_population: size N_p of the population that the vector stands for.
    samples: individuals drawn a generation.
    budget: evaluations at most.
    tolerance: stop once all deviations are below.
    control: shape (2,); [0] set to non-zero by another thread stops the search, [1] is the number
        of evaluations done so far.
    history: out, best cost after each generation, shape (at least budget / samples,).

    Returns
    -------
    Elite, its cost, evaluations, generations.
    """
    genes = start.shape[0]
    state = np.empty(1, dtype=np.uint64)
    state[0] = np.uint64(seed)
    mean, spread = start.copy(), deviation.copy()
    population = np.empty((samples, genes + 2))
    for i in range(samples):
        population[i, genes], population[i, genes + 1] = offsets[0], offsets[1]
    values = np.empty(samples)
    elite, best, before = start.copy(), np.inf, np.empty(genes)
    used, generation = 0, 0
    while used + samples <= budget and control[0] == 0:
        for i in range(samples):
            for g in range(genes):
                value = mean[g] + spread[g] * _next_normal(state)
                population[i, g] = min(max(value, 0.0), 1.0)
        if generation == 0:
            population[0, :genes] = start
        run_blocks(batch, population, cap, work, values, work.uncounted, work.no_gaps)
        used += samples
        for g in range(genes):
            before[g] = elite[g]
        for i in range(samples):
            wins = values[i] < best
            for g in range(genes):
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
                best = values[i]
        for g in range(genes):
            mean[g] += PULL * (elite[g] - mean[g])
            spread[g] = max(spread[g], REACH * abs(elite[g] - before[g]))
        history[generation] = best
        generation += 1
        control[1] = used
        if spread.max() < tolerance:
            break
    return elite, best, used, generation
