"""The identification on board: against the truth of the reference recordings, and in slices."""

import csv
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from places import LOGS

from ehadiag.core.actuator import default_actuator
from ehadiag.export.library import rules
from ehadiag.model.plant import plant_constants
from ehadiag.monitor.cusum import design_cusum
from ehadiag.monitor.plan import monitor_plan
from ehadiag.onboard.elementary import (
    cosine,
    logarithm,
    normal_below,
    round_down,
    round_even,
    square_root,
)
from ehadiag.onboard.kernels import begin_identification, identify_some
from ehadiag.onboard.layout import SIZE, Outcome
from ehadiag.onboard.rules import with_rules
from ehadiag_tools.onboard.replay import ticks_of, unit_of
from firmware_iface.logs.reader import read_recording

PLAN = with_rules(
    monitor_plan(
        default_actuator(), plant_constants(default_actuator()), design_cusum(100.0, 1e-3)
    ),
    rules(default_actuator()),
)
with (LOGS / "truth.csv").open() as file:
    TRUTH = {
        row["file"]: tuple(float(row[name]) for name in ("Kintas", "FSS", "FDJ"))
        for row in csv.DictReader(file)
    }


def identified(log, slices=(1e9,), ticks=None):
    """Memory after an identification, in slices of so many runs, taken in turn."""
    recording = read_recording(LOGS / log)
    told = np.ascontiguousarray(ticks_of(recording)[:ticks])
    unit = np.array(unit_of(recording, (0.0, 0.0, 0.0)), dtype=np.float64)
    memory = np.zeros(SIZE)
    places = memory.ctypes.data, PLAN.ctypes.data
    assert begin_identification(*places, unit.ctypes.data) == 0
    for k in range(10_000):
        amounts = float(len(told)), float(slices[k % len(slices)])
        if identify_some(*places, told.ctypes.data, amounts) == 0:
            return Outcome(*memory[: len(Outcome._fields)].tolist())
    raise AssertionError("no end")


def check(log):
    outcome, truth = identified(log), TRUTH[log]
    assert outcome[:3] == pytest.approx(truth, abs=0.002)
    assert outcome.verdict == (0.0 if max(truth) == 0.0 else 10.0)
    assert outcome.cost / outcome.samples == pytest.approx(1.0, abs=0.06)
    assert max(outcome.spool_rms, outcome.pressure_rms) < 1.06
    assert outcome.runs <= 600
    assert max(outcome[3:6]) < 0.01


@pytest.mark.parametrize("log", ["healthy-closed.blf", "lossy-open.blf"])
def test_finds_the_truth(log):
    check(log)


@pytest.mark.slow
@pytest.mark.parametrize("log", sorted(TRUTH))
def test_finds_the_truth_of_every_reference_recording(log):
    check(log)


def test_however_it_is_sliced_the_result_is_the_same():
    whole = identified("healthy-open.blf", ticks=700)
    assert identified("healthy-open.blf", (1.0, 3.0, 20.0), ticks=700) == whole


@pytest.mark.parametrize("amounts", [(99.0, 1.0), (2e6, 1.0), (500.0, 0.0), (math.nan, 1.0)])
def test_an_amount_out_of_its_range_is_refused(amounts):
    memory = np.zeros(SIZE)
    assert identify_some(memory.ctypes.data, PLAN.ctypes.data, memory.ctypes.data, amounts) == 2


def test_a_unit_that_cannot_be_is_refused():
    memory, unit = np.full(SIZE, 3.0), np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 2e7, 0.0])
    places = memory.ctypes.data, PLAN.ctypes.data, unit.ctypes.data
    assert begin_identification(*places) == 1
    assert (memory == 3.0).all()


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


@pytest.mark.parametrize("z", np.linspace(-6.0, 6.0, 25).tolist())
def test_normal_distribution(z):
    assert normal_below(z) == pytest.approx(0.5 * math.erfc(-z / math.sqrt(2.0)), abs=1e-7)
