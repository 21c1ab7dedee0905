"""A time limit ends a search between two of its steps, wherever it runs out."""

from __future__ import annotations

import pytest
from identify_cases import own_experiment

from ehadiag.cli.deadline import Deadline
from ehadiag.core.errors import NotTestedError
from ehadiag.identify.session import Nuisances, identify
from ehadiag.model.simd.model import SimdModel

TICK_S = 2e-7
"""What a tick of a run takes by the clock of these tests, 1 to 2 ms for a whole test: twice what it
takes a slow machine."""
OVERSHOOT_S = 0.15


class Clock:
    """A clock that only runs of the model move on."""

    def __init__(self, patched: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        for name in ("residuals", "costs"):
            patched.setattr(SimdModel, name, self._timed(getattr(SimdModel, name)))

    def __call__(self) -> float:
        return self.now

    def _timed(self, run):
        def timed(model, points, *rest):
            self.now += TICK_S * len(points) * len(model.batch.current)
            return run(model, points, *rest)

        return timed


@pytest.mark.parametrize(
    ("nuisances", "limit", "stage"),
    [
        (Nuisances.AUTO, 0.05, "search"),
        (Nuisances.AUTO, 0.18, "refinement"),
        (Nuisances.ALL, 0.27, "nuisances"),
        (Nuisances.ALL, 0.3, "nuisances"),
    ],
)
def test_a_search_ends_soon_after_its_time(
    nuisances: Nuisances, limit: float, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    deadline = Deadline(limit, clock)
    tell = deadline.watch(lambda _stage, _share: None)
    with pytest.raises(NotTestedError, match=f"given up in the {stage}"):
        identify([own_experiment((0.3, 0.4, 0.2))], nuisances=nuisances, progress=tell)
    assert deadline.passed
    assert clock.now < limit + OVERSHOOT_S
