"""Configuration files of others: refused in one line and at once, whatever is in them.

A calibrated actuator's file: what it keeps, and what is refused in it.
"""

from __future__ import annotations

import math
import os
import re
import time
from importlib import resources
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ehadiag import (
    Actuator,
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    default_actuator,
    load_actuator,
    load_test,
)
from ehadiag.core.actuator import (
    Calibration,
    CalibrationSource,
    FitQuality,
    Jack,
    SecondStage,
    Servovalve,
    actuator_toml,
    with_tolerance,
)
from ehadiag.identify.prior import calibration_covariance, unit_prior
from ehadiag.model.registry import unit_constants
from firmware_iface.files import MAX_TOML_BYTES, decode_toml, read_toml
from firmware_iface.stored_test import Controller

DATA = resources.files("ehadiag").joinpath("data")
STAGE = '\n[second_stage]\nkind = "orifice"\nbeta = 7.5e8\nvolume_of_one_chamber = 1.6e-4\n'
ACTUATOR = DATA.joinpath("actuator.toml").read_text() + STAGE
TEST = resources.files("firmware_iface").joinpath("data/tests/open.toml").read_text()
N = MAX_TOML_BYTES
HOSTILE = {
    "a key of many parts": b"a" + b".a" * (N // 2 - 2) + b"=1",
    "many keys of many parts": b"\n".join(b"[k%d" % i + b".a" * 48 + b"]" for i in range(N // 106)),
    "quoted parts": b'"a,"' + b'."a,"' * (N // 6) + b"=1",
    "parts that look like numbers": b"a" + b".1 .1" * (N // 5 - 9) + b"=1",
    "parts behind a string": b"x = {a = '''\n\"''', a" + b".a" * (N // 2 - 100) + b'= "1"}',
    "lists in lists": b"a=" + b"[" * (N // 2),
    "tables in tables": b"a=" + b"{a=" * (N // 4),
    "a long number": b"a=" + b"9" * (N - 5),
    "many keys": b"\n".join(b"k%d=1" % i for i in range(N // 9)),
    "many tables": b"[[a]]\n" * (N // 6),
    "a string without an end": b'a="' + b"\\" * (N - 10),
    "a large file": b"#" * (N + 1),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_the_parser_comes_to_an_end(case: str) -> None:
    begin = time.process_time()
    with pytest.raises(ConfigurationError) as caught:
        decode_toml(HOSTILE[case], Actuator, "here")
    assert time.process_time() - begin < 20.0, "without the limits: minutes to days"
    assert str(caught.value).startswith("here: ")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(os.name != "posix", reason="FIFOs and devices")
@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "link to a device", "null"])
def test_what_is_no_file_makes_nobody_wait(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path = Path("/dev/zero")
        case "folder":
            path.mkdir()
        case "link to a device":
            path.symlink_to("/dev/zero")
        case "null":
            path = Path("x\0y")
    with pytest.raises(InputOutputError, match=r"^actuator file .*(regular|null)"):
        load_actuator(path)


def test_an_error_quotes_nothing_of_a_file(tmp_path: Path) -> None:
    secret = tmp_path / "shadow"
    secret.write_text("root:$6$secret:19000:0:99999:7:::\n")
    (tmp_path / "link.toml").symlink_to(secret)
    with pytest.raises(ConfigurationError) as caught:
        read_toml(tmp_path / "link.toml", Actuator, "actuator file")
    assert "secret" not in str(caught.value)
    assert str(caught.value).endswith("not valid TOML at line 1, column 5")


def ranges() -> list[tuple[str, float, float]]:
    """Each number of an actuator file with its range."""
    found = []
    for part in (Controller, Servovalve, Jack, SecondStage):
        for field in msgspec.inspect.type_info(part).fields:
            former = field.name == "volume"  # the bundled file has the name of today
            if isinstance(field.type, msgspec.inspect.FloatType) and not former:
                found.append((field.name, field.type.ge, field.type.le))
    return found


@pytest.mark.parametrize(("key", "low", "high"), ranges())
def test_numbers_beyond_what_is_built(key: str, low: float, high: float, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    for value in (1e308, -1e308, 1e-308 if low > 0 else -1e-308, high * 1.01, 10**30):
        assert low <= high
        if low <= value <= high:
            continue
        path.write_text(re.sub(rf"(?m)^{key} *=\s*\S+", f"{key} = {value!r}", ACTUATOR))
        with pytest.raises(ConfigurationError, match=rf"at `\$\.\w+\.{key}`"):
            load_actuator(path)


SPANS = ", ".join("[0.7, 1.2]" for _ in range(20_000))
TESTS = {
    "rate": ("rate = 1000.0", "rate = 1e308", "rate"),
    "low rate": ("rate = 1000.0", "rate = 1e-308", "rate"),
    "many windows": ("FDJ = ", f"FDJ = [{SPANS}]\n_ = ", "at"),
    "an endless end": ("end = 5.5", "end = 1e308", "longer than 600 s"),
    "a long test": ("end = 5.5", "end = 599.0", "599000 ticks long, need 100 to 60000"),
    "a great amplitude": ("amplitude = 8.0", "amplitude = 1e308", "amplitude"),
    "a great command": ("amplitude = 8.0", "amplitude = 9e4", "need at most 10 A"),
    "a great frequency": ("frequency = ", "frequency = 1e308 #", "beyond half the rate"),
    "a name of none": ('name = "open"', 'name = "free motion"', "by the monitor: choose another"),
    "a fast sine": ("frequency = ", "frequency = 501 #", "beyond half the rate"),
}


@pytest.mark.parametrize("case", TESTS)
def test_tests_without_an_end(case: str, tmp_path: Path) -> None:
    old, new, words = TESTS[case]
    assert old in TEST
    (tmp_path / "x.toml").write_text(TEST.replace(old, new, 1))
    begin = time.process_time()
    with pytest.raises(EhadiagError) as caught:
        load_test(tmp_path / "x.toml")
    assert words in str(caught.value)
    assert time.process_time() - begin < 10.0


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
    fit=FitQuality(excess=1.1, outliers=0.002, spool_rms=1.0, pressure_rms=1.02),
    recordings=(CalibrationSource(name="a [b].blf", test="open", sha256="00"),),
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
        unit_prior(with_calibration(effects={"magic": 1.0}))
    with pytest.raises(ConfigurationError, match="'FSS'"):
        unit_prior(with_calibration(parameters=("null_bias", "FSS", "datum_KF")))


def test_the_constants_have_the_effects_and_deviations_are_known_about_them():
    unit = with_calibration()
    constants = unit_constants(unit)
    assert (constants.IB, constants.HYS, constants.NPL) == (1.1e-4, 0.02, 3.0)
    knowledge = unit_prior(unit)
    assert np.all(knowledge.joint.mean == 0.0)
    hysteresis = knowledge.free[1]
    assert hysteresis.lower == -0.02, "none is less than none"
    correlation = 0.6
    covariance = calibration_covariance(GOOD)
    assert covariance[0, 1] == pytest.approx(correlation * 1e-7 * 1e-5)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(GOOD.std)


@pytest.mark.parametrize(("excess", "sound"), [(1.1, True), (1.5, False)])
def test_a_sound_recording_is_explained_if_the_unit_as_new_was(excess, sound):
    fit = FitQuality(excess=excess, outliers=0.01, spool_rms=1.0, pressure_rms=1.0)
    knowledge = unit_prior(with_calibration(fit=fit))
    assert knowledge.has_inexact_data
    assert knowledge.explains_sound_units is sound


def test_tolerances_have_no_place_beside_a_calibration():
    with pytest.raises(ConfigurationError, match="calibrated"):
        with_tolerance(with_calibration(), 0.05)


def test_the_former_name_of_a_chambers_volume_is_still_read(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    for name in ("volume", "volume_of_one_chamber"):
        path.write_text(
            ACTUATOR.replace("volume_of_one_chamber = 1.6e-4", f"{name} = 0.9e-4"), encoding="utf-8"
        )
        read = load_actuator(path)
        assert read.second_stage.volume_of_one_chamber == 0.9e-4
        assert b"volume_of_one_chamber" in actuator_toml(read)
        assert b"\nvolume =" not in actuator_toml(read)


@pytest.mark.parametrize("given", ["2.1", "-0.1", "[1.0, 0.5]", "[0.0, 3.0]"])
def test_an_exponent_of_clogging_has_its_range(given: str, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text(
        ACTUATOR.replace("XFM =", f"clogging_exponent = {given}\nXFM ="), encoding="utf-8"
    )
    with pytest.raises(ConfigurationError, match="clogging_exponent: need a number from 0 to 2"):
        load_actuator(path)
    path.write_text(ACTUATOR.replace("XFM =", "clogging_exponent = [0, 2]\nXFM ="))
    assert load_actuator(path).servovalve.clogging_range == (0.0, 2.0)
