"""Every harness fault has its stated outcome, and no sample is invented."""

from __future__ import annotations

import re
from dataclasses import replace

import fault_cases
import numpy as np
import pytest
from fault_cases import CASES, Case, Run, right_and_wrong, run
from places import ROOT

DOCUMENT = ROOT / "docs" / "reference" / "bus-faults.md"
LONGEST_S = 4.0
"""Simulated time of the longest case: request, test, time limits, and less than 2 s beyond them."""


@pytest.fixture(scope="module")
def sound() -> Run:
    return run(CASES[0])


@pytest.mark.parametrize("case", CASES, ids=[item.name for item in CASES])
def test_a_fault_gives_its_stated_outcome(case: Case, sound: Run) -> None:
    came = run(case)
    right, wrong = right_and_wrong(sound.recording, came.recording)
    assert wrong <= case.wrong
    assert came.simulated_s < LONGEST_S
    assert came.outcome.complete == (not case.why)
    assert re.search(case.why, came.outcome.why)
    if not case.why:
        assert right >= case.least
        assert came.outcome.serial == 77
    for count in case.counts:
        assert came.recording.quality.total(count) > 0, count


def test_the_comparison_sees_wrong_and_missing_samples(sound: Run) -> None:
    samples = sound.recording.samples
    assert samples is not None
    assert right_and_wrong(sound.recording, sound.recording) == (1.0, 0.0)
    spool, pressure = samples.spool.copy(), samples.pressure.copy()
    spool[:40] += 1e-6
    pressure[:40] = np.nan
    damaged = replace(sound.recording, samples=replace(samples, spool=spool, pressure=pressure))
    assert right_and_wrong(sound.recording, damaged) == (0.95, 0.025)


def test_the_table_in_the_docs_is_this_one() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == fault_cases.table()


def test_the_same_seed_gives_the_same_damage() -> None:
    case = next(item for item in CASES if item.name == "loss of 5 %")
    first, again, other = run(case, 3), run(case, 3), run(case, 4)
    assert first.outcome == again.outcome
    assert first.recording.quality == again.recording.quality
    assert first.recording.quality != other.recording.quality
