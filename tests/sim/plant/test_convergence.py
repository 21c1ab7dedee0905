"""The plant's kernels against an independent stiff solver with event location.

The effects of real units against the stiff solver, one by one and together.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from other_actuator import with_data
from stiff_reference import StiffReference

from ehadiag import default_actuator
from ehadiag.core.actuator import SecondStage
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S, plant_response
from ehadiag_sim.simulation import simulate
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit
from firmware_iface.recording import CHANNELS
from firmware_iface.stored_test import resolve_test

STEPS_LSB = np.array([[CHANNELS.spool.lsb], [CHANNELS.pressure.lsb], [CHANNELS.position.lsb]])
STEPS = np.array([8e-6, 4e-6, 2e-6, 1e-6, 0.5e-6])
SPAN = np.arange(200) * 1e-3


def errors(actuator, currents, fault, steps):
    reference = StiffReference(actuator, fault.Kintas, fault.FSS, fault.FDJ)
    truth = reference.respond(currents)
    gaps = [
        (plant_response(actuator, currents, fault, step=step) - truth) / STEPS_LSB for step in steps
    ]
    return np.array([np.sqrt((gap**2).mean(axis=1)) for gap in gaps]), truth, reference


def order(rms):
    """Slope of error over step in doubly logarithmic scale, per channel."""
    return np.polyfit(np.log(STEPS), np.log(rms), 1)[0]


def test_smooth_history_converges_with_order_one():
    """No friction, no stop: 25 Hz across both corners of the pressure saturation."""
    actuator = with_data(servovalve={"FSS0": 0.0}, jack={"FDJ0": 0.0})
    drive = 3e-3 * np.sin(2 * np.pi * 25 * SPAN)
    rms, truth, _ = errors(actuator, drive, Faults(Kintas=0.3), STEPS)
    assert np.abs(truth[0]).max() > actuator.servovalve.PSR / actuator.servovalve.GP
    np.testing.assert_allclose(order(rms), 1.0, atol=0.03)


def test_stick_slip_history_converges_with_order_one():
    """Two tones: spool and jack stick and break away again and again."""
    drive = 1.5e-3 * (np.sin(2 * np.pi * 7 * SPAN) + np.sin(2 * np.pi * 43 * SPAN))
    rms, _, reference = errors(default_actuator(), drive, Faults(0.3, 0.6, 0.6), STEPS)
    assert reference.slides[1] >= 15
    assert reference.slides[2] >= 6
    np.testing.assert_allclose(order(rms), 1.0, atol=0.2)


def test_stops_of_flapper_and_spool_converge_with_order_one():
    """Twenty per cent more torque than as new drives the spool into its stops."""
    actuator = with_data(servovalve={"GM": 1.2 * 2.82})
    drive = 10e-3 * np.sign(np.sin(2 * np.pi * 20 * SPAN + 0.1))
    rms, truth, reference = errors(actuator, drive, Faults(0.2, 0.2, 0.3), STEPS)
    assert np.abs(truth[0]).max() == pytest.approx(actuator.servovalve.XSM)
    assert reference.slides[0] >= 5
    np.testing.assert_allclose(order(rms), 1.0, atol=0.2)


def test_default_step_is_converged():
    """Of the noise floor of 0.58 LSB the integration takes less than a tenth anywhere."""
    rng = np.random.default_rng(7)
    drive = np.interp(SPAN, SPAN[::10], rng.uniform(-10e-3, 10e-3, 20))
    rms, _, reference = errors(default_actuator(), drive, Faults(0.5, 0.5, 0.5), [DEFAULT_STEP_S])
    assert reference.slides[1] >= 5
    assert rms.max() < 0.05


LSB = np.array([[CHANNELS.spool.lsb], [CHANNELS.pressure.lsb], [CHANNELS.position.lsb]])
TIME = np.arange(150) * 1e-3
FAULTS = Faults(0.3, 0.4, 0.2)
LINEAR = default_actuator()
ORIFICE = msgspec.structs.replace(LINEAR, second_stage=SecondStage(kind="orifice", beta=7e8))
DRIVE = 1.5e-3 * (np.sin(2 * np.pi * 7 * TIME) + np.sin(2 * np.pi * 43 * TIME))


def rms_errors(actuator, effects, steps, drive=DRIVE):
    reference = StiffReference(actuator, FAULTS.Kintas, FAULTS.FSS, FAULTS.FDJ, effects)
    truth = reference.respond(drive)
    gaps = [
        (plant_response(actuator, drive, FAULTS, effects, step) - truth) / LSB for step in steps
    ]
    return np.array([np.sqrt((gap**2).mean(axis=1)) for gap in gaps]), truth


ALL = Effects(
    hysteresis=0.03,
    plays=5,
    null_bias=0.15e-3,
    gain_change=0.03,
    backlash=3e-6,
    spool_stribeck=20e-3,
    jack_stribeck=4e-3,
    load=80.0,
    load_spring=2e4,
)


ONE_BY_ONE = [
    (LINEAR, Effects(hysteresis=0.03, plays=7, null_bias=-0.2e-3)),
    (LINEAR, Effects(backlash=4e-6, gain_change=-0.04)),
    (LINEAR, Effects(spool_stribeck=10e-3)),
    (LINEAR, Effects(jack_stribeck=3e-3)),
    (LINEAR, Effects(load=-200.0, load_spring=1e5)),
    (ORIFICE, Effects()),
]


@pytest.mark.parametrize(
    ("actuator", "effects"),
    [
        (LINEAR, ALL),
        (ORIFICE, ALL),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ONE_BY_ONE),
    ],
)
def test_default_step_is_converged_with_every_effect(actuator, effects):
    """Of the noise floor of 0.58 LSB the integration takes less than a tenth."""
    rms, truth = rms_errors(actuator, effects, [DEFAULT_STEP_S])
    plain = plant_response(LINEAR, DRIVE, FAULTS, step=1e-6)
    assert np.abs((truth - plain) / LSB).max() > 2.0, "the effect does nothing"
    assert rms.max() < 0.05


@pytest.mark.parametrize("actuator", [pytest.param(LINEAR, marks=pytest.mark.slow), ORIFICE])
def test_error_falls_with_the_step(actuator):
    steps = np.array([4e-6, 2e-6, 1e-6, 0.5e-6])
    rms, _ = rms_errors(actuator, ALL, steps)
    slope = np.polyfit(np.log(steps), np.log(rms), 1)[0]
    np.testing.assert_allclose(slope, 1.0, atol=0.35)


def test_orifice_has_the_pressure_gain_of_the_file_near_null():
    """A jack that is held, a spool slightly off null: P12 = GP·XS but for leakage."""
    jack = msgspec.structs.replace(ORIFICE.jack, FDJ0=1e6, FDJ1=2e6)
    held = msgspec.structs.replace(ORIFICE, jack=jack)
    slick = msgspec.structs.replace(
        held, servovalve=msgspec.structs.replace(held.servovalve, FSS0=0.0, CLK=0.0)
    )
    spool, pressure, position = plant_response(slick, np.full(2000, 0.02e-3), step=4e-6)[:, -1]
    assert position == 0.0
    assert 0.0 < spool < 2e-6
    assert pressure == pytest.approx(2e12 * spool, rel=2e-3)


def test_hydraulic_spring_rings_where_oil_and_mass_say():
    """Lightly damped: released from a bent spring, it swings at sqrt(2·β/V·AJ²/MJ)."""
    from ehadiag_sim.plant_dynamics import STATE, advance_plant
    from ehadiag_sim.plant_laws import plant_coefficients

    p = plant_coefficients(ORIFICE, Faults(), Effects())._replace(
        GQ=0.0, CLK=0.0, CJ=0.0, FSJ=0.0, FDJ=0.0
    )
    state = np.zeros(STATE.end)
    state[STATE.pressure] = 1e6
    seen = []
    for _ in range(4000):
        advance_plant(state, p, 0.0, 1e-6, 100)
        seen.append(state[STATE.pressure])
    expected = np.sqrt(p.OIL * p.AJ**2 / p.MJ) / (2 * np.pi)
    spectrum = np.abs(np.fft.rfft(seen * np.hanning(len(seen)), 1 << 18))
    found = np.argmax(spectrum) * 1e4 / (1 << 18)
    assert found == pytest.approx(expected, rel=2e-3)
    assert 50.0 < found < 100.0
    energy = 0.5 * p.MJ * state[STATE.jack_velocity] ** 2 + 0.5 * state[STATE.pressure] ** 2 / p.OIL
    assert energy == pytest.approx(0.5 * 1e12 / p.OIL, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["open", "closed"])
def test_a_stored_test_is_converged_at_the_default_step(name):
    """All of the test with its break-aways; the docs state these figures."""
    fault = Faults(0.3, 0.6, 0.3)
    currents = simulate(default_actuator(), resolve_test(name), fault).current
    rms, _, reference = errors(default_actuator(), currents, fault, [4e-6, DEFAULT_STEP_S])
    assert reference.slides[1] > 50
    assert rms[1].max() < 0.02
    assert (rms[0] / rms[1] > 8.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("orifice", [False, True])
def test_random_units_are_near_at_the_coarse_step_of_studies(orifice):
    """Medians of four units with every usual effect, each other one in the closed-loop test.

    Of an error that falls with the step, three quarters are between it and a quarter of the step.
    """
    rms = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        unit = random_unit(rng, data=True, orifice=orifice)
        fault, name = Faults(*rng.random(3).tolist()), ("open", "closed")[seed % 2]
        test, options = resolve_test(name), {"seed": seed, "step": COARSE_STEP}
        run = simulate(unit.actuator, test, fault, unit.effects, unit.sensors, **options)
        fixed = unit.actuator, run.current, fault, unit.effects
        coarse, fine = (plant_response(*fixed, step=part * COARSE_STEP) for part in (1.0, 0.25))
        gap = (coarse - fine) / 0.75 / STEPS_LSB
        rms.append(np.sqrt((gap**2).mean(axis=1)))
    spool, pressure, position = np.median(rms, axis=0)
    assert max(spool, position) < 0.05
    assert pressure < (0.6 if orifice else 0.05)
