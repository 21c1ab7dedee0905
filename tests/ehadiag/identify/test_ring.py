"""Ring of the pressure: what it shows of oil and volume, and where it is left out."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from ehadiag import Verdict, default_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag.core.actuator import Calibration, CalibrationSource, FitQuality
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.nuisance_estimate import without_slips
from ehadiag.identify.prior import ParameterPrior
from ehadiag.identify.ring import Ring, find_ring, is_same_ring, ring_prior
from ehadiag.model.plant import plant_constants, ring_out_time, slip_speed
from ehadiag.model.residual_models import model_response
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.simulation import simulate
from ehadiag_tools.accuracy.cases import UnitCase, perform_unit
from ehadiag_tools.simulator.units import damaged_unit
from firmware_iface.stored_test import bundled_tests, resolve_test


def with_volume(volume):
    actuator = default_actuator()
    stage = msgspec.structs.replace(
        actuator.second_stage, kind="orifice", by_position=True, volume_of_one_chamber=volume
    )
    return msgspec.structs.replace(actuator, second_stage=stage)


@pytest.fixture(scope="module")
def recording():
    test = resolve_test("open")
    done = simulate(with_volume(0.9e-4), test, effects=Effects(null_bias=1e-4), step=1e-6)
    return done.recording("simulated")


def ring_of(recording, volume):
    assert recording.samples is not None
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test("open"), with_volume(volume)
    )
    # What the rest before the test looks like is taken off: with a bias it is no sensor's error.
    values = {
        "null_bias": 1e-4,
        "spool_offset": -experiment.spool_offset,
        "pressure_offset": -experiment.pressure_offset,
    }
    return find_ring([experiment], values)


@pytest.mark.parametrize(("volume", "stiffness"), [(0.9e-4, 0.0), (0.945e-4, 0.05)])
def test_the_scan_finds_the_stiffness(recording, volume, stiffness):
    ring = ring_of(recording, volume)
    assert ring is not None
    assert ring.stiffness == pytest.approx(stiffness, abs=0.01)
    assert not ring.is_of_other_volume


def test_a_total_volume_is_named(recording):
    ring = ring_of(recording, 1.8e-4)
    assert ring is not None
    assert ring.is_of_other_volume
    assert "√2 times" in ring.words
    assert "volume_of_one_chamber is twice the volume of one chamber" in ring.words


@pytest.mark.parametrize(
    ("stiffness", "other"), [(1.0, True), (-0.5, True), (0.0, False), (0.3, False), (-0.3, False)]
)
def test_a_factor_of_two_is_another_volume(stiffness, other):
    assert Ring(stiffness, 80.0).is_of_other_volume == other


def test_the_prior_holds_the_ratio_of_stiffness_and_mass():
    prior = ring_prior(Ring(0.1, 80.0), ParameterPrior(0.0, 0.15), ParameterPrior(0.0, 0.03))
    ratio = [1.0, -1.1]
    assert (prior.mean == [0.1, 0.0]).all()
    assert (prior.covariance @ ratio) @ ratio == pytest.approx(0.004**2)
    assert prior.covariance[1, 1] == pytest.approx(0.03**2)


@pytest.mark.parametrize(
    ("values", "agrees"),
    [
        ({"bulk_modulus": 1.1}, True),
        ({"bulk_modulus": 0.0}, False),
        ({"bulk_modulus": 1.0, "datum_volume_of_one_chamber": 0.05, "datum_MJ": -0.1}, True),
        ({"bulk_modulus": 1.0, "datum_volume_of_one_chamber": 0.3}, False),
        ({}, False),
    ],
)
def test_a_ring_that_the_estimate_contradicts(values, agrees):
    assert Ring(1.0, 126.0).agrees_with(values) is agrees


def missing(actuator, name, begin, end):
    """Share of the pressure between two instants, s, that is not learned from."""
    test = resolve_test(name)
    recording = simulate(actuator, test, step=1e-6).recording("simulated")
    experiment = build_experiment(recording.samples, recording.environment, test, actuator)
    left = np.isnan(experiment.sliding(slip_speed(experiment.constants)).pressure)
    return float(left[round(1e3 * begin) : round(1e3 * end)].mean())


@pytest.mark.parametrize(
    ("begin", "end", "share"), [(0.4, 1.1, 0.0), (1.3, 1.6, 1.0), (2.6, 3.2, 0.0), (4.6, 5.4, 0.0)]
)
def test_pressure_on_a_standing_jack_is_left_out(begin, end, share):
    """Ramps at 10 mm/s and fast sines are learned from, holds are not."""
    assert missing(with_volume(0.9e-4), "closed", begin, end) == share


def test_a_worn_jack_slips_at_more():
    test = resolve_test("closed")
    recording = simulate(with_volume(0.9e-4), test, step=1e-5).recording("simulated")
    experiment = build_experiment(
        recording.samples, recording.environment, test, with_volume(0.9e-4)
    )
    c = experiment.constants
    ratio = slip_speed(experiment.constants, 0.5) / slip_speed(experiment.constants)
    assert ratio == pytest.approx((c.FDJ + 0.5 * (c.FDJ1 - c.FDJ)) / c.FDJ)


@pytest.mark.parametrize("further", [1e-3, 1e-2])
def test_the_phase_of_slips_does_not_show_where_the_jack_is_fast(further):
    """It passed for friction: `FDJ` was up to 19 deviations off."""
    test, actuator, worn = resolve_test("open"), with_volume(0.9e-4), Faults(0.2, 0.1, 0.8)
    recording = simulate(actuator, test, worn, step=1e-5).recording("simulated")
    assert recording.samples is not None
    experiment = build_experiment(recording.samples, recording.environment, test, actuator)
    c, noise = experiment.constants, experiment.pressure_noise
    one, other = (
        model_response(
            damaged_unit((0.2, 0.1, friction), actuator), experiment.trace.current, experiment.tick
        ).pressure
        for friction in (0.8, 0.8 + further)
    )
    # What friction itself changes on a jack that slides, and as much again where that reverses.
    itself = 2.0 * further * (c.FDJ1 - c.FDJ) / c.AJ
    largest = []
    for ring_out in (0.0, ring_out_time(c, 0.8, noise)):
        kept = np.isfinite(experiment.sliding(slip_speed(c, 0.8), ring_out).pressure)
        assert kept.sum() > 200
        largest.append(np.abs(other - one)[kept].max())
    assert largest[0] > noise + itself
    assert largest[1] < noise + itself


def test_a_ring_out_is_no_longer_than_the_noise_shows():
    c = plant_constants(with_volume(0.9e-4))
    band = 2.0 * c.FDJ / c.AJ
    assert ring_out_time(c, 0.0, band) == 0.0
    assert ring_out_time(c, 0.0, 0.1 * band) > 0.0
    assert ring_out_time(c, 0.5, 0.1 * band) > ring_out_time(c, 0.0, 0.1 * band)
    assert ring_out_time(plant_constants(default_actuator()), 0.5, 0.1 * band) == 0.0


@pytest.mark.parametrize(
    ("ring", "other", "same"),
    [
        (Ring(0.1, 80.0), Ring(0.102, 80.1), True),
        (Ring(0.1, 80.0), Ring(0.11, 80.4), False),
        (Ring(0.1, 80.0), None, False),
        (None, None, True),
    ],
)
def test_two_scans_say_the_same(ring, other, same):
    assert is_same_ring(ring, other) is same


def test_a_second_stage_without_oil_leaves_nothing_out():
    assert missing(default_actuator(), "closed", 0.0, 5.5) == 0.0


def calibrated(actuator):
    """A unit of which hysteresis and null bias were learned, and something left."""
    calibration = Calibration(
        date="2026-01-02T03:04:05Z",
        start=actuator.name,
        effects={"hysteresis": 0.02, "null_bias": 0.0},
        parameters=("hysteresis", "null_bias"),
        std=(1e-4, 1e-7),
        root=((1.0,), (0.0, 1.0)),
        fit=FitQuality(excess=1.5, outliers=0.01, spool_rms=1.0, pressure_rms=1.2),
        recordings=(CalibrationSource(name="a.blf", test="open"),),
    )
    return msgspec.structs.replace(actuator, calibration=calibration)


@pytest.mark.slow
def test_a_worn_jack_that_slips_is_judged_where_it_is_fast():
    """The pressure of a slow jack rings at phases that no model foresees."""
    test, actuator, worn = resolve_test("closed"), with_volume(0.9e-4), Faults(0.2, 0.1, 0.6)
    unit = calibrated(actuator)
    done = simulate(actuator, test, worn, effects=Effects(hysteresis=0.02), seed=3, step=1e-6)
    recording = done.recording("simulated")
    assert recording.samples is not None
    experiment = build_experiment(recording.samples, recording.environment, test, unit)
    slow = np.isnan(experiment.sliding(slip_speed(experiment.constants, worn.FDJ)).pressure)
    assert 0.3 < slow.mean() < 0.95
    ticks = np.arange(len(slow))
    ring = 4e5 * np.sin(2.0 * np.pi * 0.083 * ticks + np.cumsum(ticks % 50 == 0))
    pressure = recording.samples.pressure + np.where(slow, ring, 0.0)
    samples = replace(recording.samples, pressure=pressure)
    found = diagnose([replace(recording, samples=samples)], unit, bundled_tests().values())
    assert found.identification is not None
    slips = slip_speed(experiment.constants, worn.FDJ)
    assert found.identification.slip_speed == pytest.approx(slips, rel=0.3)
    assert found.identification.named("FDJ").value == pytest.approx(0.6, abs=0.01)
    assert found.verdict is Verdict.DEGRADED
    assert any("slips in steps below" in note for note in found.notes)


@pytest.mark.parametrize("volume", [1.6e-4, 2.4e-4])
def test_a_worn_jack_keeps_enough_of_its_pressure(volume):
    """It slips nearly throughout; all that is left of the pressure rings."""
    test, actuator = resolve_test("open"), with_volume(volume)
    worn = Faults(0.3, 0.2, 0.95)
    recording = simulate(actuator, test, worn, seed=6, step=1e-6).recording("unit")
    begun = build_experiment(recording.samples, recording.environment, test, actuator)
    slow = slip_speed(begun.constants, worn.FDJ)
    ring_out = ring_out_time(begun.constants, worn.FDJ, begun.pressure_noise)
    assert np.isfinite(begun.sliding(slow, ring_out).pressure).sum() < 50
    kept = np.isfinite(without_slips(begun, slow, worn.FDJ).pressure).sum()
    assert 100 <= kept < np.isfinite(begun.sliding(slow).pressure).sum()


@pytest.mark.slow
def test_friction_of_a_jack_that_slipped_before_it_was_fast():
    """Of 0.4 s at speed the first 0.1 rang on: 12 deviations off."""
    found = perform_unit(UnitCase("open", 54, 9518, data="calibrated", groups=("orifice",)))
    for truth, (low, high) in zip(found["faults"], found["interval95"], strict=True):
        assert low <= truth <= high
    assert found["verdict"] == "answered"


def of_series_filter(worn, effects):
    """A worn unit with m = 2, diagnosed with this exponent and with 0."""
    test, actuator = resolve_test("open"), with_volume(0.9e-4)
    series = msgspec.structs.replace(actuator.servovalve, clogging_exponent=2.0)
    true = msgspec.structs.replace(actuator, servovalve=series)
    recording = simulate(true, test, worn, effects=effects, seed=3, step=1e-6).recording("unit")
    return {
        exponent: diagnose([recording], calibrated(unit), bundled_tests().values())
        for exponent, unit in ((0.0, actuator), (2.0, true))
    }


@pytest.mark.slow
def test_a_wrong_exponent_of_clogging_is_contradicted_by_the_recording():
    stated = of_series_filter(Faults(0.3, 0.9, 0.2), Effects(hysteresis=0.02))
    assert stated[2.0].verdict is Verdict.FAULT
    assert stated[0.0].verdict is Verdict.NOT_TESTED
    assert any("contradicts servovalve.clogging_exponent: with 2" in r for r in stated[0.0].reasons)


@pytest.mark.slow
def test_an_exponent_of_zero_that_is_not_borne_out_is_any():
    """The null bias has changed, which either exponent explains."""
    truth = Faults(0.3, 0.2, 0.2)
    stated = of_series_filter(truth, Effects(hysteresis=0.02, null_bias=1e-4))
    found = {name: item.identification for name, item in stated.items()}
    assert found[0.0] is not None
    assert found[2.0] is not None
    assert found[0.0].exponent_doubted
    assert not found[2.0].exponent_doubted
    low, high = found[0.0].named("FSS").interval95
    assert low <= truth.FSS < found[0.0].frictions[-1] <= high
    assert found[2.0].named("FSS").value == pytest.approx(truth.FSS, abs=0.01)
    assert any("does not bear out servovalve.clogging_exponent" in n for n in stated[0.0].notes)
