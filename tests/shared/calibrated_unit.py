"""A unit that was calibrated from its recordings as new; its tests are of one xdist group."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from ehadiag import Calibrated, Diagnosis, Recording, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag_sim.conditions import Faults
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit, record

TESTS = bundled_tests()
UNIT = random_unit(np.random.default_rng([1, 3]), data=True, serial=41)
of_calibrated_unit = pytest.mark.xdist_group("calibrated unit")


@lru_cache(maxsize=8)
def recording(
    test: str, faults: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 1
) -> Recording:
    return record(UNIT, TESTS[test], Faults(*faults), seed=seed, step=COARSE_STEP)


@lru_cache(maxsize=1)
def learned() -> Calibrated:
    both = [recording("open"), recording("closed", seed=2)]
    return calibrate(both, default_actuator(), TESTS.values())


@lru_cache(maxsize=1)
def diagnosis_when_worn() -> Diagnosis:
    unit = learned().actuator
    assert unit is not None
    return diagnose([recording("open", (0.3, 0.45, 0.2), 3)], unit, TESTS.values())
