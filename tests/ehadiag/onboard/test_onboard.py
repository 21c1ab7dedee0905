"""The identification on board: against the truth of the reference recordings, and in slices."""

import csv
import ctypes
import ctypes.util
import math
import platform

import numpy as np
import pytest
from exported import host_library
from hypothesis import example, given
from hypothesis import strategies as st
from places import LOGS

from ehadiag import default_actuator
from ehadiag.compile.elementary import (
    cosine,
    logarithm,
    normal_cdf,
    round_down,
    round_even,
    square_root,
)
from ehadiag.compile.jit import brief_kernel
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.export.library import exported_unit, library_plan
from ehadiag.monitor.plan import design_cusum
from ehadiag.onboard.onboard_memory import ONBOARD, REASONS, OnboardOutcome
from ehadiag_tools.onboard.replay import surrounded, ticks_of
from firmware_iface.signals.recordings import read_recording

PLAN = library_plan(default_actuator(), design_cusum(FALSE_ALARM_INTERVAL_H, 1e-3))
NOT_TESTED = 30.0
FE_OVERFLOW, FE_ALL_EXCEPT = 0x08, 0x3D
"""Of an x86-64's <fenv.h>."""
with (LOGS / "truth.csv").open() as file:
    TRUTH = {
        row["file"]: tuple(float(row[name]) for name in ("Kintas", "FSS", "FDJ"))
        for row in csv.DictReader(file)
    }


def begun(log):
    """Ticks of a recording, and the memory of an identification that was begun for it."""
    recording = read_recording(LOGS / log)
    unit, memory = exported_unit(surrounded(recording), PLAN), np.zeros(ONBOARD.end)
    begin = host_library().function("eha_identify_begin", 2)
    assert begin(memory.ctypes.data, unit.ctypes.data) == 0
    return np.ascontiguousarray(ticks_of(recording)), memory


def run(memory, ticks, work=1e9):
    """One slice of an identification; whether it goes on."""
    going = host_library().function("eha_identify_run", 3)
    amounts = np.array([len(ticks), work])
    return going(memory.ctypes.data, ticks.ctypes.data, amounts.ctypes.data) == 1


def outcome_of(memory):
    return OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())


def identified(log, slices=(1e9,), ticks=None):
    """Outcome of an identification, in slices of so many ticks of a model, taken in turn."""
    recorded, memory = begun(log)
    recorded = np.ascontiguousarray(recorded[:ticks])
    for k in range(10_000):
        if not run(memory, recorded, slices[k % len(slices)]):
            return outcome_of(memory)
    raise AssertionError("no end")


def refused_for(log, reason, ticks):
    """Check that an identification of ticks is refused for a reason, and has no numbers."""
    _, memory = begun(log)
    assert not run(memory, np.ascontiguousarray(ticks))
    outcome = outcome_of(memory)
    assert (outcome.verdict, outcome.reasons) == (NOT_TESTED, reason)
    assert all(math.isnan(value) for value in outcome[:8])


def check(log):
    outcome, truth = identified(log), TRUTH[log]
    assert outcome[:3] == pytest.approx(truth, abs=0.002)
    assert outcome.verdict == (0.0 if max(truth) == 0.0 else 10.0)
    assert outcome.cost / outcome.samples == pytest.approx(1.0, abs=0.06)
    assert max(outcome.spool_rms, outcome.pressure_rms) < 1.06
    assert outcome.runs <= 200
    assert outcome.reasons == 0.0
    assert max(outcome[3:6]) < 0.01


@pytest.mark.parametrize("log", ["healthy-closed.blf", "lossy-open.blf"])
def test_finds_the_truth(log):
    check(log)


@pytest.mark.slow
@pytest.mark.parametrize("log", sorted(TRUTH))
def test_finds_the_truth_of_every_reference_recording(log):
    check(log)


def test_however_it_is_sliced_the_result_is_the_same():
    whole = identified("healthy-closed.blf")
    assert identified("healthy-closed.blf", (700.0, 333.0, 20_000.0)) == whole


@pytest.mark.parametrize("share", [0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.9, 0.9998])
@pytest.mark.parametrize("log", sorted(TRUTH))
def test_a_test_cut_short_is_refused(log, share):
    ticks = begun(log)[0]
    refused_for(log, REASONS.length, ticks[: math.floor(share * len(ticks))])


def test_a_test_that_is_too_long_is_refused():
    ticks = begun("paper-open-1.blf")[0]
    refused_for("paper-open-1.blf", REASONS.length, np.vstack([ticks, ticks[-1:]]))


def test_a_test_with_its_end_lost_is_refused():
    ticks = begun("paper-open-1.blf")[0]
    ticks[-300:] = np.nan
    refused_for("paper-open-1.blf", REASONS.lost, ticks)


@pytest.mark.parametrize("tick", [0, 2000, 5499])
def test_a_recording_that_changes_between_calls_is_noticed(tick):
    ticks, memory = begun("paper-open-1.blf")
    assert run(memory, ticks, 60_000.0)
    ticks[tick, 3] += 1e-3
    while run(memory, ticks):
        pass
    assert outcome_of(memory).reasons == REASONS.changed
    assert math.isnan(outcome_of(memory).Kintas)


def test_another_length_between_calls_is_noticed():
    ticks, memory = begun("paper-open-1.blf")
    assert run(memory, ticks, 60_000.0)
    assert not run(memory, ticks[:-1])
    assert outcome_of(memory).reasons == REASONS.changed


@pytest.mark.parametrize("x", [1e-16, 1e-3, 0.5, 0.999, 1.0, 1.7, 12345.6])
def test_logarithm(x):
    assert logarithm(x) == pytest.approx(math.log(x), rel=1e-15, abs=1e-15)


@pytest.mark.parametrize("x", np.linspace(-12.0, 12.0, 49).tolist())
def test_cosine(x):
    assert cosine(x) == pytest.approx(math.cos(x), abs=1e-13)


@given(st.floats(allow_nan=False) | st.integers(-(2**40), 2**40).map(lambda n: n / 2.0))
def test_rounding_is_that_of_the_c_library(x):
    for own, library in ((round_even, np.rint), (round_down, np.floor)):
        assert np.float64(own(x)).tobytes() == library(np.float64(x)).tobytes()


@given(st.floats(allow_nan=False) | st.integers(0, 2**53).map(lambda n: (n / 2.0**20) ** 2))
@example(2.0**-1023)
@example(5e-324)
def test_the_root_is_that_of_ieee_754(x):
    with np.errstate(invalid="ignore"):
        expected = np.sqrt(np.float64(x))
    assert np.float64(square_root(x)).tobytes() == expected.tobytes() or math.isnan(expected)
    assert math.isnan(square_root(x)) == math.isnan(expected)


@brief_kernel
def compiled_root(x: float) -> float:
    """Return the square root as a compiler makes it."""
    return square_root(x)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="flags of an x86-64")
@pytest.mark.parametrize("x", [5e-324, 2.0**-1023, 1e-300, 0.3, 4.0, 1e9, 1e300, 1.7e308])
def test_the_root_overflows_nowhere(x):
    """As the processor has it: its flag of an overflow stays down."""
    assert compiled_root(x) == math.sqrt(x)
    flags = ctypes.CDLL(ctypes.util.find_library("m"))
    flags.feclearexcept(FE_ALL_EXCEPT)
    compiled_root(x)
    assert flags.fetestexcept(FE_OVERFLOW) == 0


@pytest.mark.parametrize("z", np.linspace(-6.0, 6.0, 25).tolist())
def test_normal_distribution(z):
    assert normal_cdf(z) == pytest.approx(0.5 * math.erfc(-z / math.sqrt(2.0)), abs=1e-7)
