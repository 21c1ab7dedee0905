"""Global search of the severities by the compact genetic algorithm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel
from ehadiag.identify.search.compact_ga import CompactGaState, draw, learn_from
from ehadiag.monitor.layout import NUMBER
from ehadiag.onboard.layout import (
    ELITE,
    GENERATOR,
    GENES,
    LANES,
    LOOK,
    MEAN,
    POINT,
    POPULATION,
    SAMPLES,
    SIZE,
    SPREAD,
    TRIAL,
    Advance,
    advance_of,
    keep_advance,
)
from ehadiag.onboard.run import run_model, vector_at

__all__ = ["search"]

Array = NDArray[np.float64]
GENERATIONS = 40
VIRTUAL_POPULATION = 42.0
TOLERANCE = 1e-4
CAP = 100.0
"""Largest square of one residual that counts: the model runs free."""


@brief_kernel
def search(address: int, plan_address: int, plan: Array, ticks_address: int, count: int) -> None:
    """One run of the genetic search; a generation is drawn before its first, learnt from after."""
    p = array_at(address, (SIZE,))
    a = advance_of(p)
    state = CompactGaState(
        array_at(address + NUMBER * MEAN, (GENES,)),
        array_at(address + NUMBER * SPREAD, (GENES,)),
        array_at(address + NUMBER * ELITE, (GENES,)),
        array_at(address + NUMBER * GENERATOR, (1,)),
        array_at(address + NUMBER * (GENERATOR + 1), (1,)).view(np.uint64),
    )
    population = array_at(address + NUMBER * POPULATION, (SAMPLES, GENES))
    costs = array_at(address + NUMBER * (POPULATION + SAMPLES * GENES), (SAMPLES,))
    trial = vector_at(address, TRIAL)
    k = int(a.steps) % SAMPLES
    if k == 0:
        draw(state, population)
        if a.steps == 0.0:
            for i in range(GENES):
                population[0, i] = p[POINT + i]
    for i in range(GENES):
        trial[i] = population[k, i]
    spool, pressure = run_model(address, plan_address, plan, ticks_address, count, trial, CAP)
    costs[k] = spool + pressure
    done, phase = a.steps + 1.0, a.phase
    if k == SAMPLES - 1:
        before = array_at(address + NUMBER * (LANES - GENES), (GENES,))
        learn_from(state, population, costs, VIRTUAL_POPULATION, TOLERANCE, before)
        narrow = max(p[SPREAD], p[SPREAD + 1], p[SPREAD + 2]) <= TOLERANCE
        if narrow or done >= GENERATIONS * SAMPLES:
            phase, done = LOOK, 0.0
            for i in range(GENES):
                p[POINT + i] = p[ELITE + i]
    keep_advance(p, Advance(phase, done, a.best, 0.0, 0.0))
