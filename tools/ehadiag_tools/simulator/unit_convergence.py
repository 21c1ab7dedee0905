"""Integration step of the simulator against its error on random units with every effect.

No stiff solver: the reference is the simulator itself at a step of a sixteenth microsecond, which
`convergence` has shown to go to the solver's answer. Both get the currents of one run of the unit.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.channels import POSITION, PRESSURE, SPOOL
from ehadiag.core.stored_test import StoredTest
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.dynamics import respond
from ehadiag_sim.plant.simulator import simulate
from ehadiag_tools.simulator.units import random_unit

__all__ = ["unit_table"]

FINEST = 0.0625e-6
LSB = np.array([[SPOOL.lsb], [PRESSURE.lsb], [POSITION.lsb]])


def unit_table(
    test: StoredTest, count: int, steps_us: Sequence[float], ticks: int | None = None
) -> None:
    """Print the error per step over `count` random units, of either second stage and friction.

    `ticks`: only the first so many.
    """
    print(
        f"Test {test.name}, {count} random units each, faults random too: LSB rms, median (largest)"
    )
    print("\n| second stage | friction | step, µs | spool | pressure | position | run, s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for orifice, friction in itertools.product((False, True), repeat=2):
        errors: dict[float, list[NDArray[np.float64]]] = {step: [] for step in steps_us}
        spent = dict.fromkeys(steps_us, 0.0)
        for seed in range(count):
            rng = np.random.default_rng(seed)
            unit = random_unit(rng, data=True, friction=friction, orifice=orifice)
            faults = Faults(*rng.random(3).tolist())
            run = simulate(unit.actuator, test, faults, unit.effects, unit.sensors, seed=seed)
            fixed = unit.actuator, run.current[:ticks], faults, unit.effects
            reference = respond(*fixed, step=FINEST)
            for step in steps_us:
                began = time.process_time()
                gap = (respond(*fixed, step=step * 1e-6) - reference) / LSB
                spent[step] += time.process_time() - began
                errors[step].append(np.sqrt((gap**2).mean(axis=1)))
        stage = "orifice" if orifice else "linear"
        law = "Stribeck" if friction else "Coulomb"
        for step in steps_us:
            rms = np.array(errors[step])
            cells = [f"{np.median(part):.3f} ({part.max():.2f})" for part in rms.T]
            print(
                f"| {stage} | {law} | {step:g} | {' | '.join(cells)} | {spent[step] / count:.2f} |",
                flush=True,
            )
    print()
