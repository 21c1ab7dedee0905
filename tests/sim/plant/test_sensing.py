"""Sensor filters, sampling instant, gains and probes of the simulated plant."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.plant.coefficients import coefficients
from ehadiag_sim.plant.conditions import Effects, Faults, Sensors, Strangers
from ehadiag_sim.plant.converters import Converters
from ehadiag_sim.plant.dynamics import Dynamics, respond
from ehadiag_sim.plant.kernels import P12, STATES, XJ, XS, advance
from ehadiag_sim.plant.simulator import simulate

ACTUATOR = default_actuator()
TESTS = bundled_tests()
COARSE = 10e-6
DRIVE = 4e-3 * np.sin(2 * np.pi * 31 * np.arange(60) * 1e-3)


def every_substep(drive, step):
    """Spool, pressure and jack after each sub-step, by calls of one sub-step each."""
    p = coefficients(ACTUATOR, Faults(), Effects())
    state = np.zeros(STATES)
    rows = []
    for current in drive:
        for _ in range(round(1e-3 / step)):
            advance(state, p, p.GM * current, step, 1)
            rows.append((state[XS], state[P12], state[XJ]))
    return np.array(rows).T


def seen(drive, **options):
    plant = Dynamics(ACTUATOR, step=COARSE, **options)
    rows = []
    for current in drive:
        plant.advance(float(current))
        rows.append(plant.seen)
    return np.array(rows).T


def test_filter_is_first_order_on_spool_and_pressure_only():
    tau = 0.15e-3
    fine = every_substep(DRIVE, COARSE)
    left = np.exp(-COARSE / tau)
    expected = lfilter([1.0 - left], [1.0, -left], fine[:2])[:, 99::100]
    got = seen(DRIVE, filter_time=tau)
    np.testing.assert_allclose(got[1:3], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(got[3], fine[2, 99::100])
    np.testing.assert_array_equal(got[0], DRIVE)


def test_early_samples_are_those_of_the_instant():
    fine = every_substep(DRIVE, COARSE)
    got = seen(DRIVE, early=0.2e-3)
    np.testing.assert_allclose(got[1:], fine[:, 79::100], rtol=1e-9, atol=1e-15)


def test_an_early_instant_does_not_change_the_plant():
    plain = respond(ACTUATOR, DRIVE, step=COARSE)
    plant = Dynamics(ACTUATOR, step=COARSE, early=0.2e-3)
    for tick, current in enumerate(DRIVE):
        plant.advance(float(current))
        np.testing.assert_allclose(plant.spool, plain[0, tick], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("early", [1e-3, 2e-3, -1e-6])
def test_an_instant_outside_the_tick_is_refused(early):
    with pytest.raises(ConfigurationError, match="early"):
        Dynamics(ACTUATOR, early=early)


@given(st.lists(st.floats(-1.5, 1.5), min_size=4, max_size=4))
def test_four_at_once_are_what_each_channel_gives(shares):
    converters = Converters(ACTUATOR, Sensors(noise_lsb=0.0), Strangers(), 0)
    values = [share * channel.full_scale for share, channel in zip(shares, CHANNELS, strict=True)]
    single = [int(c.encode(np.array([v]))[0]) for c, v in zip(CHANNELS, values, strict=True)]
    assert converters.digitise(tuple(values)).tolist() == single


def test_gain_and_offset_in_that_order():
    sensors = Sensors(offsets_lsb=(1.0, 2.0, 3.0, 4.0), gains=(0.0, 0.1, -0.1, 0.5))
    got = Converters(ACTUATOR, sensors, Strangers(), 0).read((1e-3, 0.1e-3, 1e6, 10e-3))
    lsb = [channel.lsb for channel in CHANNELS]
    expected = [1e-3 + lsb[0], 0.11e-3 + 2 * lsb[1], 0.9e6 + 3 * lsb[2], 15e-3 + 4 * lsb[3]]
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_bent_sensors_are_right_at_null_and_off_at_the_stop():
    strange = Strangers(spool_bend_2=0.02, spool_bend_3=-0.05, jack_bend_3=0.03)
    item = Converters(ACTUATOR, Sensors(), strange, 0)
    spool, jack = ACTUATOR.servovalve.XSM, ACTUATOR.jack.XJM
    np.testing.assert_allclose(item.read((0.0, 0.0, 0.0, 0.0)), 0.0)
    np.testing.assert_allclose(
        item.read((1e-3, -spool, 1e6, jack)), [1e-3, -spool * 0.93, 1e6, jack * 1.03]
    )


def test_probes_err_but_the_oil_is_what_it_is():
    right = simulate(ACTUATOR, TESTS["open"], effects=Effects(oil_temperature=60.0), step=COARSE)
    wrong = simulate(
        ACTUATOR,
        TESTS["open"],
        effects=Effects(oil_temperature=60.0),
        sensors=Sensors(temperature_error=-2.04, supply_error=0.104e6),
        step=COARSE,
    )
    np.testing.assert_array_equal(right.codes, wrong.codes)
    environment = wrong.recording("x", 7).environment
    assert environment.oil_temperature == 58.0
    assert environment.supply_pressure == pytest.approx(20.8e6)
    assert wrong.recording("x", 7).serial == 7


def test_oil_that_warms_thins_during_the_test_and_the_probe_tells_the_middle():
    drifting = Effects(oil_temperature=40.0, strangers=Strangers(oil_drift=10.0))
    run = simulate(ACTUATOR, TESTS["open"], effects=drifting, step=COARSE)
    still = simulate(ACTUATOR, TESTS["open"], step=COARSE)
    gap = np.abs(run.pressure - still.pressure)
    assert gap[4600:].max() > 3.0 * gap[:1000].max()
    assert run.environment.oil_temperature == pytest.approx(40.0 + 10.0 * 2.75, abs=0.1)


def test_a_lagging_driver_is_late_by_its_time_constant():
    """A ramp: behind it, the spool follows that of the ramp tau earlier."""
    slope, tau = 20e-3, 2e-3
    time = np.arange(200) * 1e-3
    slick = msgspec.structs.replace(
        ACTUATOR, servovalve=msgspec.structs.replace(ACTUATOR.servovalve, FSS0=0.0)
    )
    prompt = respond(slick, slope * time, step=COARSE)[0]
    late = respond(
        slick, slope * time, effects=Effects(strangers=Strangers(driver_lag=tau)), step=COARSE
    )[0]
    rate = (prompt[-1] - prompt[-51]) / 50e-3
    assert (prompt[-1] - late[-1]) / rate == pytest.approx(tau, rel=0.02)


def test_lands_shift_and_differ():
    """Blocked jack: the pressure is that of the shifted, stretched spool position."""
    held = msgspec.structs.replace(
        ACTUATOR, jack=msgspec.structs.replace(ACTUATOR.jack, FDJ0=1e6, FDJ1=2e6)
    )
    strange = Effects(strangers=Strangers(land_shift=1e-6, land_asymmetry=0.1))
    slick = msgspec.structs.replace(
        held, servovalve=msgspec.structs.replace(held.servovalve, FSS0=0.0)
    )
    for current, factor in ((0.2e-3, 1.1), (-0.2e-3, 0.9)):
        drive = np.full(100, current)
        spool, plain, _ = respond(slick, drive, step=COARSE)[:, -1]
        changed = respond(slick, drive, effects=strange, step=COARSE)[1, -1]
        assert changed / plain == pytest.approx(factor * (spool - 1e-6) / spool, rel=1e-6)


def test_friction_of_strangers_depends_on_way_and_place():
    drive = np.full(300, 0.5e-3)
    strange = Effects(strangers=Strangers(friction_asymmetry=0.3))
    loss = {}
    for sign in (1.0, -1.0):
        plain = respond(ACTUATOR, sign * drive, step=COARSE)[1, -1]
        changed = respond(ACTUATOR, sign * drive, effects=strange, step=COARSE)[1, -1]
        loss[sign] = sign * (changed - plain) * ACTUATOR.jack.AJ
    assert loss[1.0] == pytest.approx(0.3 * 150.0, rel=0.1)
    assert loss[-1.0] == pytest.approx(-0.3 * 150.0, rel=0.1)
    grown = Effects(strangers=Strangers(spool_friction_slope=0.5))
    worn = Faults(FSS=0.5)
    gap = np.abs(
        respond(ACTUATOR, DRIVE, worn, grown, COARSE) - respond(ACTUATOR, DRIVE, worn, step=COARSE)
    )[0]
    assert gap.max() > CHANNELS[1].lsb
