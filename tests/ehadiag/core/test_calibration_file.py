"""A calibrated actuator's file: what it keeps, and what is refused in it."""

import math

import msgspec
import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator, load_actuator, with_tolerance
from ehadiag.core.actuator_file import actuator_toml
from ehadiag.core.calibration import Calibration, Goodness, Source
from ehadiag.core.errors import ConfigurationError
from ehadiag.identify.nuisance.knowledge import covariance_of, knowledge_of
from ehadiag.model.unit import unit_constants

GOOD = Calibration(
    date="2026-01-02T03:04:05Z",
    start="reference-31",
    serial=7,
    plays=3,
    effects={"null_bias": 1.1e-4, "hysteresis": 0.02},
    parameters=("null_bias", "hysteresis", "datum_KF"),
    std=(1e-7, 1e-5, 0.01),
    root=((1.0,), (0.6, 0.8), (0.0, 0.28, 0.96)),
    held={"datum_KF": "hardly shown"},
    fit=Goodness(excess=1.1, outliers=0.002, spool_rms=1.0, pressure_rms=1.02),
    recordings=(Source(name="a [b].blf", test="open", sha256="00"),),
)


def with_calibration(**changes):
    calibration = msgspec.structs.replace(GOOD, **changes)
    return msgspec.structs.replace(default_actuator(), calibration=calibration)


def test_nothing_is_lost_in_the_file(tmp_path):
    unit = with_calibration(std=(1e-7, math.pi * 1e-6, 0.01))
    (tmp_path / "unit.toml").write_bytes(actuator_toml(unit))
    assert load_actuator(tmp_path / "unit.toml") == unit


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"std": (1e-7, 1e-5)}, "need 3 numbers"),
        ({"root": ((1.0,), (0.6, 0.8))}, "need 3 rows"),
        ({"root": ((1.0,), (1.0, 0.0), (0.0, 0.0, 1.0))}, "above 0"),
        ({"parameters": ("null_bias", "null_bias", "datum_KF")}, "stands twice"),
        ({"std": (1e-7, -1e-5, 0.01)}, "std"),
        ({"effects": {"backlash": 1e-6}}, "backlash not among"),
    ],
)
def test_a_covariance_that_is_none_is_refused(tmp_path, changes, text):
    (tmp_path / "unit.toml").write_bytes(actuator_toml(with_calibration(**changes)))
    with pytest.raises(ConfigurationError, match=text):
        load_actuator(tmp_path / "unit.toml")


def test_a_parameter_that_the_model_does_not_have_is_refused():
    with pytest.raises(ConfigurationError, match="'magic'"):
        knowledge_of(with_calibration(effects={"magic": 1.0}))
    with pytest.raises(ConfigurationError, match="'FSS'"):
        knowledge_of(with_calibration(parameters=("null_bias", "FSS", "datum_KF")))


def test_the_constants_have_the_effects_and_deviations_are_known_about_them():
    unit = with_calibration()
    constants = unit_constants(unit)
    assert (constants.IB, constants.HYS, constants.NPL) == (1.1e-4, 0.02, 3.0)
    knowledge = knowledge_of(unit)
    assert np.all(knowledge.joint.mean == 0.0)
    hysteresis = knowledge.free[1]
    assert hysteresis.lower == -0.02, "none is less than none"
    correlation = 0.6
    covariance = covariance_of(GOOD)
    assert covariance[0, 1] == pytest.approx(correlation * 1e-7 * 1e-5)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(GOOD.std)


@pytest.mark.parametrize(("excess", "sound"), [(1.1, True), (1.5, False)])
def test_a_sound_recording_is_explained_if_the_unit_as_new_was(excess, sound):
    fit = Goodness(excess=excess, outliers=0.01, spool_rms=1.0, pressure_rms=1.0)
    knowledge = knowledge_of(with_calibration(fit=fit))
    assert knowledge.doubts
    assert knowledge.explains_sound is sound


def test_tolerances_have_no_place_beside_a_calibration():
    with pytest.raises(ConfigurationError, match="calibrated"):
        with_tolerance(with_calibration(), 0.05)
