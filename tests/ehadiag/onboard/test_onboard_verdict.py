"""The verdict on board against the rule of `ehadiag diagnose` at its default levels."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ehadiag.assess import verdict
from ehadiag.model.plant import relative_viscosity
from ehadiag.onboard import conclude
from ehadiag.onboard.environment import set_environment
from ehadiag.onboard.layout import GENES, NORMAL, PARAMETERS, SIZE, Outcome

LEVELS = verdict.Levels()
EDGE = 1e-5
"""Of a chance: the normal distribution on board is one to 1e-7."""
NAMES = ("Kintas", "FSS", "FDJ")


def on_board(values, stds, outliers=0.0):
    """Outcome of an identification that has come to these estimates."""
    memory = np.zeros(SIZE)
    known = Outcome(*values, *(0.0,) * 8, outliers, 0.0, 0.0)._replace(samples=1000.0)
    memory[: len(known)] = known
    normal = np.eye(PARAMETERS)
    normal[range(GENES), range(GENES)] = 1.0 / np.array(stds) ** 2
    memory[NORMAL : NORMAL + PARAMETERS**2] = normal.ravel()
    conclude.conclude(memory.ctypes.data, True)
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


def test_levels_and_chances_are_the_same():
    assert (LEVELS.advisory, LEVELS.limit) == (conclude.ADVISORY, conclude.LIMIT)
    assert conclude.FALSE_HEALTHY == verdict.FALSE_HEALTHY
    assert conclude.FAULT_CHANCE == verdict.FAULT_CHANCE
    assert LEVELS.rule is verdict.Rule.INTERVAL


@given(
    st.tuples(*(st.floats(0.0, 1.0),) * 3),
    st.tuples(*(st.floats(-4.0, 0.0).map(lambda power: 10.0**power),) * 3),
)
def test_the_verdict_is_that_of_the_package(values, stds):
    expected, estimates = judged(values, stds)
    above = [verdict.chance_above(item, LEVELS.advisory) for item in estimates]
    limits = [verdict.chance_above(item, LEVELS.limit) for item in estimates]
    assume(abs(sum(above) - verdict.FALSE_HEALTHY) > EDGE)
    assume(all(abs(chance - verdict.FAULT_CHANCE) > EDGE for chance in limits))
    found = on_board(values, stds)
    assert found.verdict == float(expected)
    assert found[3:6] == pytest.approx(stds, rel=1e-9)


@pytest.mark.parametrize("outliers", [conclude.MOST_OUTLIERS + 0.01, float("nan")])
def test_what_the_model_does_not_explain_is_not_tested(outliers):
    assert on_board((0.1, 0.1, 0.1), (0.01,) * 3).verdict == 0.0
    assert on_board((0.1, 0.1, 0.1), (0.01,) * 3, outliers).verdict == 30.0


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
