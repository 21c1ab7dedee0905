"""One identification with known truth: the paper's cases, seeded random ones, and their records."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ehadiag.core.actuator import default_actuator
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.identification_session import identify
from ehadiag.model.residual_models import model_response
from ehadiag_sim.conditions import Faults, Sensors
from ehadiag_sim.simulation import simulate
from ehadiag_tools.accuracy.figures import cramer_rao
from ehadiag_tools.damaged import damaged_unit
from ehadiag_tools.study import Record
from firmware_iface.errors import InputOutputError
from firmware_iface.logs.reader import read_recording
from firmware_iface.recording import PRESSURE_CHANNEL, SPOOL_CHANNEL, Environment, Samples
from firmware_iface.stored_test import resolve_test

Severities = tuple[float, float, float]
"""Kintas, FSS, FDJ, each 0 … 1."""
SURFACE_PERIOD = 4
"""Random cases for one on the surface of the cube, until each of its parts was visited."""
PLANTS = ("detailed", "monitoring")
"""The independent simulator; the monitoring model itself."""
TESTS: Mapping[str, tuple[str, ...]] = {
    "open": ("open",),
    "closed": ("closed",),
    "joint": ("open", "closed"),
}
"""Stored tests that one identification gets."""


@dataclass(frozen=True, slots=True)
class PaperCase:
    """One case of the paper's Tables 1 and 2 (PHY-40).

    Errors are means in percent: after the first approximation, after the genetic algorithm.
    """

    test: str
    number: int
    faults: Severities
    first: float
    final: float


PAPER: tuple[PaperCase, ...] = (
    PaperCase("open", 1, (0.3, 0.3, 0.3), 0.7147, 0.1937),
    PaperCase("open", 2, (0.3, 0.6, 0.3), 7.7791, 0.4891),
    PaperCase("open", 3, (0.6, 0.6, 0.3), 9.6052, 0.2816),
    PaperCase("open", 4, (0.6, 0.6, 0.6), 9.5992, 0.2754),
    PaperCase("closed", 1, (0.3, 0.3, 0.3), 0.3005, 0.2943),
    PaperCase("closed", 2, (0.3, 0.6, 0.3), 4.5653, 0.2479),
    PaperCase("closed", 3, (0.6, 0.6, 0.3), 5.1306, 0.3380),
    PaperCase("closed", 4, (0.6, 0.6, 0.6), 2.2902, 0.2346),
)


def random_faults(count: int, seed: int) -> list[Severities]:
    """Points of the unit cube; a longer list begins with the shorter one of the same seed.

    Among them, one in four, are all corners, a point on each edge and on each face: 26 in all.
    """
    rng = np.random.default_rng(seed)
    surface: list[list[float]] = []
    faces: tuple[float | None, ...] = (0.0, 1.0, None)
    for place in itertools.product(faces, repeat=3):
        if place != (None, None, None):
            free = rng.random(3)
            surface.append([float(r) if v is None else v for v, r in zip(place, free, strict=True)])
    order = iter(rng.permutation(len(surface)))
    out: list[Severities] = []
    for index in range(count):
        inside = rng.random(3)
        special = next(order, None) if index % SURFACE_PERIOD == 0 else None
        a, b, c = inside if special is None else surface[special]
        out.append((float(a), float(b), float(c)))
    return out


@dataclass(frozen=True, slots=True)
class Case:
    """Settings of one identification; what it gives depends on nothing else but the code.

    A test is one of `TESTS`, a plant of `PLANTS`; recordings, one log for each stored test, are
    identified instead of a simulation.
    """

    test: str
    faults: Severities
    noise_seed: int = 0
    search_seed: int = 0
    plant: str = "detailed"
    recordings: tuple[str, ...] = ()


def perform(case: Case) -> Record:
    """Identify; plain numbers only, fractions of 1."""
    experiments = experiments_of(case)
    result = identify(experiments, seed=case.search_seed)
    return {
        "faults": case.faults,
        "first": [item.first for item in result.estimates],
        "search": [item.search for item in result.estimates],
        "value": [item.value for item in result.estimates],
        "std": [item.std for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "outliers": result.fit.outliers,
        "anchored": result.fit.anchored,
        "evaluations": result.evaluations,
        "converged": result.converged,
        "rescued": result.rescued,
        "bound": [float(value) for value in cramer_rao(experiments, case.faults)],
    }


def experiments_of(case: Case) -> list[Experiment]:
    """Experiments of a case, one for each stored test."""
    out = []
    for index, name in enumerate(TESTS[case.test]):
        if case.recordings:
            samples, environment = _recorded(case.recordings[index])
        elif case.plant == "monitoring":
            samples, environment = _monitoring(name, case.faults, case.noise_seed)
        else:
            samples, environment = _detailed(name, case.faults, case.noise_seed)
        test = resolve_test(name)
        out.append(build_experiment(samples, environment, test, default_actuator()))
    return out


@lru_cache(maxsize=8)
def _recorded(path: str) -> tuple[Samples, Environment]:
    recording = read_recording(Path(path))
    if recording.samples is None:
        raise InputOutputError(f"log {path}: no telemetry of a test in it")
    return recording.samples, recording.environment


@lru_cache(maxsize=8)
def _detailed(test: str, faults: Severities, seed: int) -> tuple[Samples, Environment]:
    # Open and closed loop of one seed must not have the same noise: a joint estimate has both.
    key = (seed, list(TESTS).index(test))
    noise = int(np.random.SeedSequence(key).generate_state(1)[0])
    done = simulate(default_actuator(), resolve_test(test), Faults(*faults), seed=noise)
    recording = done.recording("simulated")
    return done.samples, recording.environment


@lru_cache(maxsize=8)
def _monitoring(test: str, faults: Severities, seed: int) -> tuple[Samples, Environment]:
    """Spool and pressure by the monitoring model, with the converters' noise and rounding.

    The current is that of one detailed simulation, whatever the noise seed, so that the bound is
    the same for all seeds; its jack position is kept, from which the current is rebuilt exactly.
    """
    samples, environment = _detailed(test, faults, 0)
    (experiment,) = experiments_of(Case(test, faults))
    truth = model_response(
        damaged_unit(faults, environment=environment), experiment.trace.current, experiment.tick
    )
    rng = np.random.default_rng(np.random.SeedSequence((seed, 7)))
    noise = Sensors().noise_lsb
    measured = []
    for channel, clean in ((SPOOL_CHANNEL, truth.spool), (PRESSURE_CHANNEL, truth.pressure)):
        volts = clean + noise * channel.lsb * rng.standard_normal(len(clean))
        measured.append(channel.decode(channel.encode(volts)))
    return replace(samples, spool=measured[0], pressure=measured[1]), environment
