"""What a calibration could not explain: how far it widens intervals and raises limits."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from ehadiag.assess.acceptance import most_left
from ehadiag.core.actuator import default_actuator
from ehadiag.core.calibration import Calibration, Goodness, Source
from ehadiag.identify.nuisance.explained import is_noise, leaves_no_more
from ehadiag.identify.nuisance.knowledge import knowledge_of
from ehadiag.model.parameters import FAULTS, parameter
from ehadiag.model.plant import plant_constants


def fit(excess, outliers=0.002):
    return Goodness(excess=excess, outliers=outliers, spool_rms=1.0, pressure_rms=1.1)


def calibration_of(excess, name="hysteresis"):
    """Of a unit of which one effect was learned."""
    return Calibration(
        date="2026-01-02T03:04:05Z",
        start="reference-31",
        effects={name: 0.02},
        parameters=(name,),
        std=(1e-5,),
        root=((1.0,),),
        fit=fit(excess),
        recordings=(Source(name="a.blf", test="open"),),
    )


def severity_std(excess, name="hysteresis"):
    """Of such a unit, beside all else."""
    calibration = calibration_of(excess, name)
    unit = msgspec.structs.replace(default_actuator(), calibration=calibration)
    free = (*FAULTS, parameter(name))
    added = knowledge_of(unit).spread(
        free, dict.fromkeys((item.name for item in free), 0.0), plant_constants(unit)
    )
    assert added[3, 3] == 0.0
    return np.sqrt(np.diag(added)[:3])


def test_a_unit_that_is_explained_has_the_floor_alone():
    assert severity_std(1.05) == pytest.approx(1e-4)
    assert severity_std(1.16) == pytest.approx(1e-4)


def test_what_is_left_widens_every_severity():
    assert severity_std(2.32) == pytest.approx(np.hypot(1e-4, 3e-3))
    assert (severity_std(1.5) > severity_std(1.3)).all()


def test_effects_beyond_the_usual_ones_widen_what_they_bend():
    kintas, spool, jack = severity_std(1.05, "spool_stribeck")
    assert spool == pytest.approx(0.04 * np.sqrt(0.05), rel=1e-3)
    assert spool > kintas > jack > 1e-3
    assert (severity_std(1.15, "spool_stribeck") > severity_std(1.05, "spool_stribeck")).all()


def test_what_wear_brings_out_of_effects_beyond_the_usual_ones_is_allowed():
    usual, further = calibration_of(1.1), calibration_of(1.1, "spool_bow")
    assert most_left(usual) == most_left(None)
    assert most_left(further)[0] == pytest.approx(6.0 * most_left(None)[0] + 2.0 * 0.002)
    assert most_left(further)[1] > most_left(None)[1]
    assert most_left(calibration_of(1.5))[0] == pytest.approx(most_left(None)[0] + 2.0 * 0.002)


def residuals(size):
    """Noise, and a slow wave of some size that no model explains."""
    rng = np.random.default_rng(1)
    wave = size * np.sin(np.arange(4000) / 300.0)
    return rng.standard_normal((2, 4000)) + wave


def test_a_later_recording_may_leave_what_the_calibration_left():
    assert is_noise(residuals(0.0))
    assert not is_noise(residuals(1.0))
    assert not leaves_no_more(fit(1.1))(residuals(1.0))
    assert leaves_no_more(fit(1.5, 0.02))(residuals(1.0))
    assert not leaves_no_more(fit(1.5, 0.02))(residuals(9.0))
