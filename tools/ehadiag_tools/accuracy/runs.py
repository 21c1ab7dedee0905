"""One identification with known truth: its recording, its estimate, its errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.core.errors import InputOutputError
from ehadiag.core.recording import Environment, Samples
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.result import Identification
from ehadiag.identify.search.solvers import make_solver
from ehadiag.identify.session import identify
from ehadiag.model.scalar.response import respond
from ehadiag_sim.plant.conditions import Faults, Sensors
from ehadiag_sim.plant.simulator import simulate
from ehadiag_tools.accuracy.bound import cramer_rao
from ehadiag_tools.accuracy.cases import Faults3
from ehadiag_tools.damaged import damaged_unit
from firmware_iface.logs.reader import read_recording

__all__ = ["PLANTS", "TESTS", "Run", "experiments_of", "identified", "perform", "summary_of"]

PLANTS = ("detailed", "monitoring")
TESTS: Mapping[str, tuple[str, ...]] = {
    "open": ("open",),
    "closed": ("closed",),
    "joint": ("open", "closed"),
}
"""Stored tests that one identification gets."""


@dataclass(frozen=True, slots=True)
class Run:
    """Settings of one identification; what it gives depends on nothing else but the code."""

    test: str
    """One of `TESTS`."""
    faults: Faults3
    noise_seed: int = 0
    search_seed: int = 0
    plant: str = "detailed"
    """The independent simulator, or the monitoring model itself with fresh noise."""
    recordings: tuple[str, ...] = ()
    """Logs instead of a simulation, one for each stored test."""
    solver: str = "cga"


def perform(run: Run) -> dict[str, Any]:
    """Identify, and compare with the truth. The record has plain numbers only, fractions of 1."""
    experiments = experiments_of(run)
    result = identified(run, experiments)
    return {
        **asdict(run),
        **summary_of(result),
        "bound": [float(value) for value in cramer_rao(experiments, run.faults)],
    }


def identified(run: Run, experiments: list[Experiment]) -> Identification:
    """Identify with the solver and seed of a run."""
    return identify(experiments, solver=make_solver(run.solver), seed=run.search_seed)


def summary_of(result: Identification) -> dict[str, Any]:
    """What a record keeps of an identification."""
    estimates = result.estimates
    return {
        "first": [item.first for item in estimates],
        "search": [item.search for item in estimates],
        "value": [item.value for item in estimates],
        "std": [item.std for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
        "outliers": result.fit.outliers,
        "anchored": result.fit.anchored,
        "cost": result.cost,
        "evaluations": result.evaluations,
        "converged": result.converged,
        "rescued": result.rescued,
    }


def experiments_of(run: Run) -> list[Experiment]:
    """Experiments of a run, one for each stored test."""
    names = TESTS[run.test]
    actuator = default_actuator()
    out = []
    for index, name in enumerate(names):
        if run.recordings:
            samples, environment = _recorded(run.recordings[index])
        else:
            single = replace(run, test=name, search_seed=0, solver="")
            samples, environment = _simulated(single)
        out.append(build_experiment(samples, environment, resolve_test(name), actuator))
    return out


@lru_cache(maxsize=8)
def _recorded(path: str) -> tuple[Samples, Environment]:
    recording = read_recording(Path(path))
    if recording.samples is None:
        raise InputOutputError(f"log {path}: no telemetry of a test in it")
    return recording.samples, recording.environment


@lru_cache(maxsize=8)
def _simulated(run: Run) -> tuple[Samples, Environment]:
    if run.plant == "monitoring":
        return _own_plant(run)
    return _detailed(run.test, run.faults, run.noise_seed)


@lru_cache(maxsize=8)
def _detailed(test: str, faults: Faults3, seed: int) -> tuple[Samples, Environment]:
    # Open and closed loop of one seed must not have the same noise: a joint estimate has both.
    key = (seed, list(TESTS).index(test))
    noise = int(np.random.SeedSequence(key).generate_state(1)[0])
    done = simulate(default_actuator(), resolve_test(test), Faults(*faults), seed=noise)
    recording = done.recording("simulated")
    return done.samples, recording.environment


def _own_plant(run: Run) -> tuple[Samples, Environment]:
    """Spool and pressure by the monitoring model, with the converters' noise and rounding.

    The current is that of one detailed simulation, whatever the noise seed, so that the bound is
    the same for all seeds; its jack position is kept, from which the current is rebuilt exactly.
    """
    samples, environment = _detailed(run.test, run.faults, 0)
    (experiment,) = experiments_of(Run(run.test, run.faults))
    truth = respond(
        damaged_unit(run.faults, environment=environment),
        experiment.trace.current,
        experiment.tick,
    )
    rng = np.random.default_rng(np.random.SeedSequence((run.noise_seed, 7)))
    noise = Sensors().noise_lsb
    measured = []
    for channel, clean in ((SPOOL, truth.spool), (PRESSURE, truth.pressure)):
        volts = clean + noise * channel.lsb * rng.standard_normal(len(clean))
        measured.append(channel.decode(channel.encode(volts)))
    return replace(samples, spool=measured[0], pressure=measured[1]), environment
