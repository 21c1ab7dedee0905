"""A calibrated unit in page and picture: its own effects count once, and the calibration's page."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray
from report_html import Page

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.calibration.result import Calibrated, Tried
from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from ehadiag.report.calibration_page import calibration_page
from ehadiag.report.modelled import signals_of
from ehadiag.report.picture import draw_column
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit, record

TESTS = bundled_tests()
UNIT = random_unit(np.random.default_rng([1, 3]), data=True, serial=41)
NOW = "2026-03-01T12:00:00.000Z"


@lru_cache(maxsize=1)
def learned() -> Calibrated:
    both = [
        record(UNIT, TESTS[name], Faults(), seed=seed, step=COARSE_STEP)
        for seed, name in enumerate(("open", "closed"))
    ]
    return calibrate(both, default_actuator(), TESTS.values())


@lru_cache(maxsize=1)
def worn() -> Diagnosis:
    recording = record(UNIT, TESTS["open"], Faults(0.3, 0.45, 0.2), seed=3, step=COARSE_STEP)
    unit = learned().actuator
    assert unit is not None
    return diagnose([recording], unit, TESTS.values())


def rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@pytest.mark.slow
def test_page_and_picture_of_a_calibrated_unit_draw_the_response_that_was_fitted() -> None:
    diagnosis = worn()
    found, samples = diagnosis.identification, diagnosis.recordings[0].samples
    assert found is not None
    assert samples is not None
    (experiment,) = diagnosis.experiments
    constants = found.constants(experiment.constants)
    _, spool, pressure, _ = signals_of(experiment, constants, samples.current)
    axes = Figure().subplots(5, 1)
    draw_column(list(axes), experiment, constants)
    for axis, signal in ((axes[1], spool), (axes[3], pressure)):
        np.testing.assert_array_equal(axis.lines[1].get_ydata(), signal.modelled)
    twice = constants._replace(HYS=2.0 * constants.HYS, IB=2.0 * constants.IB)
    wrong = signals_of(experiment, twice, samples.current)[1]
    window = slice(*(round(t / experiment.tick) for t in experiment.test.windows.refinement[0]))
    noise = 1e3 * experiment.spool_noise
    assert rms(spool.residual[window]) < 2.0 * noise
    assert rms(pressure.residual[window]) < 2.0 * experiment.pressure_noise * 1e-6
    assert rms(wrong.residual[window]) > 5.0 * noise


@pytest.mark.slow
def test_the_page_of_a_calibration_says_what_was_learned_and_how_well() -> None:
    found = learned()
    text = Page(calibration_page(found, "1.2.3", NOW)).text
    assert found.actuator is not None
    assert found.actuator.calibration is not None
    assert "CALIBRATED" in text
    for item in found.values:
        assert item.meaning in text
    for part in ("What was learned", "covariance", "Evidence of the models", "serial 41"):
        assert part in text
    for why in found.actuator.calibration.held.values():
        assert why in text
    assert text.count("rms residual over the whole test") == 2
    assert "+1.00" in text


def test_a_refused_calibration_has_a_page_that_says_why() -> None:
    hostile = "<script>alert(1)</script>\x1b[31m"
    refused = Calibrated(
        recordings=(), tests=(), start=default_actuator(), actuator=None, reasons=(hostile,),
        notes=(), severities=(), values=(), tried=(), experiments=(), seed=0, evaluations=0,
        elapsed=0.0,
    )  # fmt: skip
    html = calibration_page(refused, "1", NOW)
    page = Page(html)
    assert page.scripts == []
    assert "NOT CALIBRATED" in page.text
    assert "<script>alert(1)" in page.text
    assert "\x1b" not in html
    tried = (Tried("one model", 1.0, 0.0), Tried("another", 3.0, 99.0))
    assert "another" in Page(calibration_page(replace(refused, tried=tried), "1", NOW)).text
