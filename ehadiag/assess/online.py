"""Identification of a test while it runs: finished, but for its last step, when the test is."""

from __future__ import annotations

import numpy as np

from ehadiag.assess.acceptance import out_of_range
from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import build_experiment, noise_is_judged_early
from ehadiag.identify.pipeline import run_ahead
from ehadiag.identify.search.solvers import CompactGa, Solver
from ehadiag.identify.search.stages import STAGES, Memory, first_ends_at, stage_ends_at

__all__ = ["OnlineIdentification"]

LEAST_SHARE = 0.75
"""Share of samples without which nothing is worked out ahead."""


class OnlineIdentification:
    """Works ahead on the samples of a running test.

    Call `take` with the recording as it is so far, after each instant of `due_s`; then hand
    `memory` to `ehadiag.assess.diagnosis.diagnose` with the finished recording. What was worked
    out ahead is used where the finished recording has the same samples to the last bit, so that
    the answer is that of the recording alone, only sooner.

    For one thread at a time.
    """

    def __init__(
        self,
        test: StoredTest,
        actuator: Actuator,
        *,
        solver: Solver | None = None,
        seed: int = 0,
    ) -> None:
        self._test = test
        self._actuator = actuator
        self._solver = solver or CompactGa()
        self._seed = seed
        self.memory = Memory()
        ends = {first_ends_at(test), *(stage_ends_at(test, i) for i in range(len(STAGES)))}
        if not isinstance(self._solver, CompactGa) or not noise_is_judged_early(test):
            ends = set()
        self.due_s: tuple[float, ...] = tuple(sorted(end for end in ends if end < test.duration))
        """Instants of the test (s) at which there is something to work out; none for a solver that
        holds the interpreter, nor for a test without a quiet first part."""

    def take(self, recording: Recording) -> None:
        """Work out all that the samples so far allow; nothing of what cannot carry a verdict."""
        samples = recording.samples
        if not self.due_s or samples is None or samples.ticks == 0:
            return
        if recording.test_id not in (None, self._test.id):
            return
        if out_of_range(recording.environment, samples, self._actuator):
            return
        experiment = build_experiment(samples, recording.environment, self._test, self._actuator)
        for values in (experiment.spool, experiment.pressure):
            if np.isfinite(values).mean() < LEAST_SHARE:
                return
        run_ahead(experiment, self._solver, self._seed, self.memory)
