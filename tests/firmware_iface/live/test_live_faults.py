"""Every harness fault has its stated outcome, and no sample is invented.

From a damaged harness, or a damaged log, to the verdict: the stated outcome, never a wrong one.
"""

from __future__ import annotations

import dataclasses
import re
import tracemalloc
from pathlib import Path

import fault_cases
import numpy as np
import pytest
from fault_cases import CASES, Case, Run, right_and_wrong, run
from fault_diagnosis import Diagnoser, Judged, deviations, objection
from fault_logs import KEPT, LOG_CASES, NOISE, LogCase, collected, noise
from msgspec.structs import replace
from places import ROOT

from ehadiag import Verdict
from firmware_iface.recording import BitState
from firmware_iface.tester import Assembler

DOCUMENT = ROOT / "docs" / "reference" / "bus-faults.md"
LONGEST_SHORT_S = 4.0
"""Simulated time of the longest case: request, test, time limits, and less than 2 s beyond them."""


@pytest.fixture(scope="module")
def sound_run() -> Run:
    return run(CASES[0])


@pytest.mark.parametrize("case", CASES, ids=[item.name for item in CASES])
def test_a_fault_gives_its_stated_outcome(case: Case, sound_run: Run) -> None:
    came = run(case)
    right, wrong = right_and_wrong(sound_run.recording, came.recording)
    assert wrong <= case.wrong
    assert came.simulated_s < LONGEST_SHORT_S
    assert came.outcome.complete == (not case.why)
    assert re.search(case.why, came.outcome.why)
    if not case.why:
        assert right >= case.least
        assert came.outcome.serial == 77
    for count in case.counts:
        assert came.recording.quality.total(count) > 0, count


def test_the_comparison_sees_wrong_and_missing_samples(sound_run: Run) -> None:
    samples = sound_run.recording.samples
    assert samples is not None
    assert right_and_wrong(sound_run.recording, sound_run.recording) == (1.0, 0.0)
    spool, pressure = samples.spool.copy(), samples.pressure.copy()
    spool[:40] += 1e-6
    pressure[:40] = np.nan
    damaged = replace(sound_run.recording, samples=replace(samples, spool=spool, pressure=pressure))
    assert right_and_wrong(sound_run.recording, damaged) == (0.95, 0.025)


def test_the_table_in_the_docs_is_this_one() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == fault_cases.table()


def test_the_same_seed_gives_the_same_damage() -> None:
    case = next(item for item in CASES if item.name == "loss of 5 %")
    first, again, other = run(case, 3), run(case, 3), run(case, 4)
    assert first.outcome == again.outcome
    assert first.recording.quality == again.recording.quality
    assert first.recording.quality != other.recording.quality


LONGEST_S = 9.0
"""Simulated time: request, 5.5 s of test, 1 s to its end, 1 s for an abort; not 2 s beyond."""
QUICK = ("loss of 20 %", "telemetry counter stuck")
CLOSED = (
    "loss of 1 %",
    "loss of 5 %",
    "loss of 10 %",
    "frames 40 places late, 5 %",
    "pause of 0.1 s, frames lost",
    "bit flips with a valid CRC, 1 %",
)
QUICK_LOGS = ("last 0.2 s missing, and with it the status of completion", "last 0.3 s missing")


@pytest.fixture(scope="module")
def diagnoser() -> Diagnoser:
    return Diagnoser()


@pytest.fixture(scope="module")
def sound(diagnoser: Diagnoser) -> Judged:
    judged = diagnoser.judge(CASES[0])
    assert judged.diagnosis.verdict is Verdict.DEGRADED  # all constants are 0.3
    assert judged.diagnosis.identification is not None
    for item in judged.diagnosis.identification.estimates:
        assert abs(item.value - 0.3) <= 2.0 * 1.96 * item.std, item.name
    return judged


def marked(cases: tuple[Case, ...] | tuple[LogCase, ...], quick: tuple[str, ...]) -> list[object]:
    return [
        pytest.param(item, id=item.name, marks=() if item.name in quick else pytest.mark.slow)
        for item in cases
    ]


@pytest.mark.parametrize("case", marked(CASES, QUICK))
def test_a_fault_gives_the_stated_verdict(case: Case, diagnoser: Diagnoser, sound: Judged) -> None:
    came = diagnoser.judge(case)
    assert objection(case, sound.diagnosis, came.diagnosis) == ""
    assert came.run.simulated_s < LONGEST_S


@pytest.fixture(scope="module")
def closed_diagnoser() -> Diagnoser:
    return Diagnoser("closed")


@pytest.fixture(scope="module")
def sound_closed(closed_diagnoser: Diagnoser) -> Judged:
    return closed_diagnoser.judge(CASES[0])


@pytest.mark.slow
@pytest.mark.xdist_group("closed loop")
@pytest.mark.parametrize(
    ("name", "responds"),
    [
        *((name, False) for name in CLOSED),
        ("loss of 20 %", True),
        ("loss in bursts of 20 frames", True),
    ],
)
def test_the_closed_loop_test_bears_it_too(
    name: str, responds: bool, closed_diagnoser: Diagnoser, sound_closed: Judged
) -> None:
    """The response shows the jack positions that nothing else does."""
    case = next(item for item in CASES if item.name == name)
    came = closed_diagnoser.judge(case).diagnosis
    assert objection(case, sound_closed.diagnosis, came) == ""
    assert not responds or any("the response told" in note for note in came.notes), came.notes


@pytest.mark.parametrize("case", marked(LOG_CASES, QUICK_LOGS))
def test_a_damaged_log_gives_the_stated_verdict(
    case: LogCase, diagnoser: Diagnoser, sound: Judged, tmp_path: Path
) -> None:
    frames = sound.run.frames
    begun = next(item.time_ns for item in frames if item.can_id == 0x111 and item.data[5] == 1)
    came = diagnoser.diagnose(case.damage(frames, begun / 1e9, tmp_path))
    assert objection(Case(case.name, unfit=case.why), sound.diagnosis, came) == ""


def test_a_log_that_ends_early_has_fewer_samples_and_no_word_of_its_end(sound: Judged) -> None:
    frames = sound.run.frames
    begun = next(item.time_ns for item in frames if item.can_id == 0x111 and item.data[5] == 1)
    recording = collected(item for item in frames if item.time_ns - begun < 5_300_000_000)
    assert recording.samples is not None
    assert recording.samples.ticks == 5300
    assert recording.outcome.state is BitState.RUNNING


def test_the_memory_of_a_flood_is_that_of_what_is_kept() -> None:
    assembler = Assembler("log", max_frames=KEPT)
    tracemalloc.start()
    try:
        assembler.extend(noise(NOISE, 0))
        recording = assembler.recording()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert recording.samples is None
    # 64 bytes of payload and 14 of the rest a frame. All of the flood would be twice as much.
    assert peak < 1.2 * KEPT * 90


def test_the_comparison_of_verdicts_sees_what_is_wrong(sound: Judged) -> None:
    clean = sound.diagnosis
    case = Case("x")
    assert objection(case, clean, clean) == ""
    assert "instead of" in objection(case, clean, replace(clean, verdict=Verdict.HEALTHY))
    assert "instead of" in objection(case, clean, replace(clean, verdict=Verdict.NOT_TESTED))
    assert "was stated" in objection(dataclasses.replace(case, unfit="x"), clean, clean)
    untested = replace(clean, verdict=Verdict.NOT_TESTED, reasons=("because",))
    assert objection(dataclasses.replace(case, unfit="because"), clean, untested) == ""
    assert "other reasons" in objection(dataclasses.replace(case, why="lost"), clean, untested)
    assert clean.identification is not None
    moved = tuple(
        replace(item, value=item.value + 4.0 * item.std) for item in clean.identification.estimates
    )
    shifted = replace(clean, identification=replace(clean.identification, estimates=moved))
    assert np.allclose(list(deviations(clean, shifted).values()), 4.0)
    assert "estimates differ by" in objection(case, clean, shifted)
