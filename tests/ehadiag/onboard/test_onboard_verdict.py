"""The verdict on board against the rule of `ehadiag diagnose` at its default levels."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ehadiag.assess import acceptance, verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.export.library import rules
from ehadiag.identify.estimates import NOT_SHOWN_STD
from ehadiag.identify.uncertainty import DISCREPANCY_STD, EXPECTED_CAPPED
from ehadiag.model.plant import relative_viscosity
from ehadiag.onboard import conclude
from ehadiag.onboard.environment import set_environment
from ehadiag.onboard.layout import GENES, PARAMETERS, SIZE, Outcome
from ehadiag.onboard.rules import PLAN_SIZE, Rules, with_rules

LEVELS = verdict.Levels()
PLAN = with_rules(np.zeros(PLAN_SIZE - len(Rules._fields)), rules(default_actuator()))
EDGE = 1e-5
"""Of a chance: the normal distribution on board is one to 1e-7."""
NAMES = ("Kintas", "FSS", "FDJ")


def on_board(values, stds, outliers=0.0, complete=True, rms=1.0):
    """Outcome of an identification that has come to these estimates."""
    memory = np.zeros(SIZE)
    known = Outcome(*values, *stds, *(0.0,) * 10)._replace(
        samples=1000.0, outliers=outliers, spool_rms=rms, pressure_rms=1.0
    )
    memory[: len(known)] = known
    assert conclude.judge(memory.ctypes.data, PLAN, complete) == 0
    return Outcome(*memory[: len(known)].tolist())


def judged(values, stds):
    """The same by the rule of the package."""
    estimates = [
        SimpleNamespace(
            name=name, value=value, std=std, interval95=(value - 1.96 * std, value + 1.96 * std)
        )
        for name, value, std in zip(NAMES, values, stds, strict=True)
    ]
    return verdict.judge(SimpleNamespace(estimates=estimates), LEVELS)[0], estimates


def test_the_deviations_are_those_of_the_package():
    """Normal matrix, covariance of the gradient, shift and fit in; deviations out."""
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((PARAMETERS, 400)) * 1e3
    normal, meat, shift = rows @ rows.T, 3.0 * rows @ rows.T, rng.standard_normal(PARAMETERS)
    memory = np.zeros(SIZE)
    assert conclude.deviate(memory.ctypes.data, normal.copy(), meat, shift, 1.3) == 0
    inverse = np.linalg.inv(normal + np.diag([12.0] * GENES + [0.0] * 2))
    sandwich = inverse @ meat @ inverse
    curved = inverse * 1.3 / EXPECTED_CAPPED
    variance = np.maximum(np.diag(curved), np.diag(sandwich)) + (inverse @ shift) ** 2
    expected = np.sqrt(variance + DISCREPANCY_STD**2)[:GENES]
    assert memory[GENES : 2 * GENES] == pytest.approx(expected, rel=1e-9)


@given(
    st.tuples(*(st.floats(0.0, 1.0),) * 3),
    st.tuples(*(st.floats(-4.0, -1.0).map(lambda power: 10.0**power),) * 3),
)
def test_the_verdict_is_that_of_the_package(values, stds):
    expected, estimates = judged(values, stds)
    above = [verdict.chance_above(item, LEVELS.advisory) for item in estimates]
    limits = [verdict.chance_above(item, LEVELS.limit) for item in estimates]
    assume(max(stds) < NOT_SHOWN_STD)
    assume(abs(sum(above) - verdict.FALSE_HEALTHY) > EDGE)
    assume(all(abs(chance - verdict.FAULT_CHANCE) > EDGE for chance in limits))
    found = on_board(values, stds)
    assert found.verdict == float(expected)


@pytest.mark.parametrize(
    "wrong",
    [{"outliers": acceptance.MOST_OUTLIERS + 1e-3}, {"outliers": math.nan}, {"complete": False},
     {"rms": acceptance.MOST_RMS + 1e-3}, {"rms": math.nan}],
    ids=str,
)  # fmt: skip
def test_what_the_model_does_not_explain_is_not_tested(wrong):
    assert on_board((0.1, 0.1, 0.1), (0.01,) * 3).verdict == 0.0
    assert on_board((0.1, 0.1, 0.1), (0.01,) * 3, **wrong).verdict == 30.0


def test_a_severity_that_the_test_does_not_show_is_not_tested():
    assert on_board((0.1, 0.1, 0.5), (0.01, 0.01, 0.11)).verdict == 30.0


@pytest.mark.parametrize("oil", [-60.0, -20.0, 0.0, 40.0, 85.3, 100.0, 200.0])
def test_the_surroundings_give_the_viscosity_of_the_package(oil):
    unit = np.zeros(8)
    assert set_environment(unit.ctypes.data, (oil, 20.7e6, 0.7e6)) == 0
    assert unit[5] == pytest.approx(relative_viscosity(oil), rel=1e-12)
    assert unit[6] == 20e6


@pytest.mark.parametrize(
    "around",
    [(-61.0, 2e7, 0.0), (201.0, 2e7, 0.0), (40.0, 1e6, 1e6), (float("nan"), 2e7, 0.0),
     (40.0, float("nan"), 0.0), (40.0, float("inf"), 0.0)],
)  # fmt: skip
def test_surroundings_that_cannot_be_are_refused(around):
    unit = np.full(8, 3.0)
    assert set_environment(unit.ctypes.data, around) == 1
    assert (unit == 3.0).all()
