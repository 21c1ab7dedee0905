"""The effects of real units against the stiff solver, one by one and together."""

import msgspec
import numpy as np
import pytest

from ehadiag.core.actuator import SecondStage, default_actuator
from ehadiag.core.channels import POSITION, PRESSURE, SPOOL
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.dynamics import DEFAULT_STEP, respond
from ehadiag_tools.simulator.stiff_reference import StiffReference

LSB = np.array([[SPOOL.lsb], [PRESSURE.lsb], [POSITION.lsb]])
TIME = np.arange(150) * 1e-3
FAULTS = Faults(0.3, 0.4, 0.2)
LINEAR = default_actuator()
ORIFICE = msgspec.structs.replace(LINEAR, second_stage=SecondStage(kind="orifice", beta=7e8))
DRIVE = 1.5e-3 * (np.sin(2 * np.pi * 7 * TIME) + np.sin(2 * np.pi * 43 * TIME))


def rms_errors(actuator, effects, steps, drive=DRIVE):
    reference = StiffReference(actuator, FAULTS.Kintas, FAULTS.FSS, FAULTS.FDJ, effects)
    truth = reference.respond(drive)
    gaps = [(respond(actuator, drive, FAULTS, effects, step) - truth) / LSB for step in steps]
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


@pytest.mark.parametrize(
    ("actuator", "effects"),
    [
        (LINEAR, Effects(hysteresis=0.03, plays=7, null_bias=-0.2e-3)),
        (LINEAR, Effects(backlash=4e-6, gain_change=-0.04)),
        (LINEAR, Effects(spool_stribeck=10e-3)),
        (LINEAR, Effects(jack_stribeck=3e-3)),
        (LINEAR, Effects(load=-200.0, load_spring=1e5)),
        (LINEAR, ALL),
        (ORIFICE, Effects()),
        (ORIFICE, ALL),
    ],
)
def test_default_step_is_converged_with_every_effect(actuator, effects):
    """Of the noise floor of 0.58 LSB the integration takes less than a tenth."""
    rms, truth = rms_errors(actuator, effects, [DEFAULT_STEP])
    plain = respond(LINEAR, DRIVE, FAULTS, step=1e-6)
    assert np.abs((truth - plain) / LSB).max() > 2.0, "the effect does nothing"
    assert rms.max() < 0.05


@pytest.mark.parametrize("actuator", [LINEAR, ORIFICE])
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
    spool, pressure, position = respond(slick, np.full(2000, 0.02e-3), step=4e-6)[:, -1]
    assert position == 0.0
    assert 0.0 < spool < 2e-6
    assert pressure == pytest.approx(2e12 * spool, rel=2e-3)


def test_hydraulic_spring_rings_where_oil_and_mass_say():
    """Lightly damped: released from a bent spring, it swings at sqrt(2·β/V·AJ²/MJ)."""
    from ehadiag_sim.plant.coefficients import coefficients
    from ehadiag_sim.plant.kernels import DXJ, P12, STATES, advance

    p = coefficients(ORIFICE, Faults(), Effects())._replace(
        GQ=0.0, CLK=0.0, CJ=0.0, FSJ=0.0, FDJ=0.0
    )
    state = np.zeros(STATES)
    state[P12] = 1e6
    seen = []
    for _ in range(4000):
        advance(state, p, 0.0, 1e-6, 100)
        seen.append(state[P12])
    expected = np.sqrt(p.OIL * p.AJ**2 / p.MJ) / (2 * np.pi)
    spectrum = np.abs(np.fft.rfft(seen * np.hanning(len(seen)), 1 << 18))
    found = np.argmax(spectrum) * 1e4 / (1 << 18)
    assert found == pytest.approx(expected, rel=2e-3)
    assert 50.0 < found < 100.0
    energy = 0.5 * p.MJ * state[DXJ] ** 2 + 0.5 * state[P12] ** 2 / p.OIL
    assert energy == pytest.approx(0.5 * 1e12 / p.OIL, rel=1e-3)
