"""Worker processes that end before their time."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ehadiag.cli.batch.workers import Workers


def gives(given: tuple[int, str]) -> int:
    """Return the number; 5 ends its process, 9 does so the first time."""
    number, folder = given
    mark = Path(folder) / "came"
    if number == 5 or (number == 9 and not mark.exists()):
        mark.touch()
        os._exit(1)
    return number


@pytest.mark.slow
def test_what_ends_its_worker_takes_no_other_with_it(tmp_path: Path) -> None:
    inputs = [(number, str(tmp_path)) for number in range(80)]
    with Workers(2) as workers:
        made = list(workers.over(gives, inputs, lambda given: -given[0]))
    assert made == [-5 if number == 5 else number for number in range(80)]
