"""Loads, or compiles, every kernel that a diagnosis runs."""

from __future__ import annotations

import numpy as np

from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import CommandMode, Environment, Samples
from ehadiag.core.stored_test import Line, StoredTest, Windows
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.search.solvers import CompactGa
from ehadiag.identify.session import identify
from ehadiag.model.scalar.response import respond

__all__ = ["warm_up"]


def warm_up(actuator: Actuator, test: StoredTest) -> None:
    """Identify from a fraction of a second of nothing, in the loop that the test closes."""
    ticks = 200
    rest = np.zeros(ticks)
    samples = Samples(
        period_ns=round(1e9 / test.rate),
        mode=CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT,
        current=rest,
        spool=rest,
        pressure=rest,
        position=rest,
        command=rest,
        saturated=np.zeros((4, ticks), dtype=np.bool_),
        host_ns=np.arange(ticks),
    )
    length = ticks / test.rate
    whole = ((0.0, length),)
    silence = StoredTest(
        name="silence",
        id=test.id,
        mode=test.mode,
        unit=test.unit,
        rate=test.rate,
        segment=(Line(((0.0, 0.0), (length, 0.0))),),
        windows=Windows(whole, whole, whole, whole),
    )
    experiment = build_experiment(samples, Environment(), silence, actuator)
    identify([experiment], solver=CompactGa(budget=20))
    respond(experiment.constants, experiment.trace.current, experiment.tick)
