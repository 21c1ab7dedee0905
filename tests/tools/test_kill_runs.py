"""What a killed live test leaves: history and recording."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from ehadiag.history.store import History
from ehadiag_tools.soak.kills import kill_run, whole_run

pytestmark = pytest.mark.slow
RUNS = 2
MOST_LOST_S = 5.0
"""Of a recording: the machine of a test may be busy with others."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """A folder with a history, and how long a whole run takes."""
    folder = tmp_path_factory.mktemp("kills")
    return folder, whole_run(folder)


def test_a_killed_test_leaves_a_sound_history_and_its_recording(
    place: tuple[Path, float],
) -> None:
    folder, whole = place
    moments = random.Random(7)
    for number in range(1, RUNS + 1):
        moment = moments.uniform(0.3, 1.0) * whole
        assert kill_run(folder, number, moment, MOST_LOST_S).wrong == ()
    last = kill_run(folder, RUNS + 1, 10.0 * whole)
    assert last.ended
    assert last.told
    assert last.wrong == ()
    with History(folder / "history.db") as history:
        assert len(history.entries()) >= 2


def test_what_is_wrong_is_found(place: tuple[Path, float]) -> None:
    folder, whole = place
    (folder / "run-99.blf").write_bytes(b"nothing that a log begins with")
    found = kill_run(folder, 99, 10.0 * whole)
    assert any("recording" in item for item in found.wrong)
