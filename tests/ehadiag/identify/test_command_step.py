"""Which rounding of a commanded position the measured current followed."""

import numpy as np
import pytest

from ehadiag.core.channels import CURRENT, POSITION
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.command_step import step_by_current

STORED = resolve_test("closed").command()
GAP = 1.7


def follows(seed):
    """Jack position that the control law works on: behind its command, with the sensor's noise."""
    rng = np.random.default_rng(seed)
    place = np.roll(STORED, 40) + POSITION.lsb * 0.5 * rng.standard_normal(len(STORED))
    return POSITION.decode(POSITION.encode(place))


def measured_current(command, seen, seed):
    """As the converter gives it."""
    rng = np.random.default_rng([seed, 1])
    volts = GAP * (command - seen) + 0.4 * CURRENT.lsb
    volts += CURRENT.lsb * 0.5 * rng.standard_normal(len(STORED))
    return CURRENT.decode(CURRENT.encode(volts))


@pytest.mark.parametrize("step", [0.0, 1e-6, 2e-6, 5e-6, POSITION.lsb / 16, POSITION.lsb / 4])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_step_is_found_by_its_effect_of_less_than_a_step_of_current(step, seed):
    command = np.round(STORED / step) * step if step else STORED
    seen = follows(seed)
    measured = measured_current(command, seen, seed)
    measured[100:150] = np.nan
    found = step_by_current(STORED, lambda item: GAP * (item - seen), measured, POSITION.lsb)
    assert found == pytest.approx(step, rel=1e-9)


def test_nothing_measured_tells_nothing():
    nothing = np.full(len(STORED), np.nan)
    assert step_by_current(STORED, lambda item: item, nothing, POSITION.lsb) == 0.0
    assert step_by_current(STORED, lambda item: item, STORED, POSITION.lsb) == 0.0
