"""The recordings that the benchmark identifies."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Recording, Samples
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.search.stages import LEAD_S
from ehadiag.identify.spans import Spans, lay_out, unknowns_of
from ehadiag.model.parameters import FAULTS
from ehadiag.model.simd.model import SimdModel
from firmware_iface.logs.reader import read_recording

__all__ = [
    "HEALTHY",
    "LOG",
    "TRUTH",
    "all_tests",
    "experiment",
    "healthy_experiment",
    "population",
    "recording",
    "samples",
    "search_window",
    "whole_test",
]

LOG = "paper-open-2.blf"
TRUTH = (0.3, 0.6, 0.3)
"""Of that recording."""
HEALTHY = "healthy-closed.blf"


@lru_cache(maxsize=1)
def recording(logs: Path) -> Recording:
    """Return the recording, an open-loop test of 5.5 s."""
    return read_recording(logs / LOG)


def samples(logs: Path) -> Samples:
    """Return its samples."""
    found = recording(logs).samples
    assert found is not None
    return found


def experiment(logs: Path) -> Experiment:
    """Prepare it for the identification."""
    return build_experiment(
        samples(logs), recording(logs).environment, resolve_test("open"), default_actuator()
    )


def healthy_experiment(logs: Path) -> Experiment:
    """Prepare that of a healthy actuator in closed loop, whose spool keeps breaking away."""
    found = read_recording(logs / HEALTHY)
    assert found.samples is not None
    return build_experiment(
        found.samples, found.environment, resolve_test("closed"), default_actuator()
    )


def whole_test(logs: Path, tests: int) -> SimdModel:
    """Model of the recording laid out so many times, all of the test; the severities unknown."""
    return _model([experiment(logs)] * tests)


def all_tests(logs: Path) -> list[SimdModel]:
    """Model of each recording of the paper's cases, all of the test."""
    out = []
    for kind in ("open", "closed"):
        for log in sorted(logs.glob(f"paper-{kind}-*.blf")):
            found = read_recording(log)
            assert found.samples is not None
            item = build_experiment(
                found.samples, found.environment, resolve_test(kind), default_actuator()
            )
            out.append(_model([item]))
    return out


def population(size: int) -> np.ndarray:
    """Points all over the space of the severities, shape (size, k)."""
    return np.random.default_rng(0).uniform(0.0, 1.0, (size, len(FAULTS)))


def search_window(logs: Path) -> SimdModel:
    """Model of the window on which the genetic search works."""
    item = experiment(logs)
    return _model([item], [item.test.windows.refinement], LEAD_S)


def _model(
    experiments: Sequence[Experiment], spans: Spans | None = None, lead: float = 0.0
) -> SimdModel:
    batch = lay_out(experiments, spans, lead=lead)
    return SimdModel(batch, unknowns_of(experiments, FAULTS), threads=1)
