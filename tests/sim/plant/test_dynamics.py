"""Properties of the plant that hold for any input.

Torque motor: null bias, gain, and hysteresis as a Prandtl-Ishlinskii operator.
"""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag import ConfigurationError, default_actuator
from ehadiag_sim.conditions import Effects, Faults, UnmodelledEffects
from ehadiag_sim.plant_dynamics import (
    STATE,
    PlantDynamics,
    advance_plant,
    plant_response,
    velocity_after,
)
from ehadiag_sim.plant_laws import TorqueMotor, plant_coefficients, play_operator

ACTUATOR = default_actuator()
COARSE = 2e-6
unit = st.floats(0.0, 1.0)
faults = st.builds(Faults, Kintas=unit, FSS=unit, FDJ=unit)
effects = st.builds(
    Effects,
    hysteresis=st.floats(0.0, 0.2),
    gain_change=st.floats(-0.3, 0.3),
    backlash=st.floats(0.0, 50e-6),
    oil_temperature=st.floats(-40.0, 120.0),
    supply_pressure=st.floats(5e6, 28e6),
)
currents = st.lists(st.floats(-10e-3, 10e-3), min_size=1, max_size=25).map(np.array)


@settings(max_examples=60)
@given(faults, effects, currents)
def test_nothing_leaves_its_limits(fault, effect, drive):
    plant = PlantDynamics(ACTUATOR, fault, effect, COARSE)
    for current in drive:
        plant.advance(float(current))
        state = plant.state
        assert np.isfinite(state).all()
        assert abs(state[STATE.flapper]) <= ACTUATOR.servovalve.XFM
        assert abs(plant.spool) <= ACTUATOR.servovalve.XSM
        assert abs(plant.pressure) <= effect.supply_pressure - effect.return_pressure
        assert abs(plant.position) <= ACTUATOR.jack.XJM
        assert abs(state[STATE.ball] - state[STATE.spool]) <= effect.backlash + 1e-18


@settings(max_examples=40)
@given(faults, effects, currents)
def test_mirrored_current_gives_mirrored_response(fault, effect, drive):
    there = plant_response(ACTUATOR, drive, fault, effect, COARSE)
    back = plant_response(ACTUATOR, -drive, fault, effect, COARSE)
    np.testing.assert_array_equal(there, -back)


@settings(max_examples=40)
@given(faults, st.floats(-0.99, 0.99))
def test_friction_holds_a_spool_at_rest(fault, share):
    """Flapper at a still place whose spool force is just below static friction."""
    p = plant_coefficients(ACTUATOR, fault, Effects())
    flapper = share * min(p.FSS / p.FORCE, p.XFM)
    state = np.zeros(STATE.end)
    state[STATE.flapper] = flapper
    advance_plant(state, p, p.KF * flapper, COARSE, 500)
    assert (state[STATE.spool], state[STATE.spool_velocity], state[STATE.jack_velocity]) == (
        0.0,
        0.0,
        0.0,
    )


def test_spool_breaks_away_just_above_static_friction():
    p = plant_coefficients(ACTUATOR, Faults(FSS=0.5), Effects())
    state = np.zeros(STATE.end)
    state[STATE.flapper] = 1.01 * p.FSS / p.FORCE
    advance_plant(state, p, p.KF * state[STATE.flapper], COARSE, 500)
    assert state[STATE.spool] > 0.0


speeds = st.just(0.0) | st.floats(1e-6, 1.0) | st.floats(-1.0, -1e-6)
forces = st.floats(-1e4, 1e4)


@given(speeds, forces, st.floats(0.0, 100.0), st.floats(0.0, 1e3), st.floats(1e-8, 1e-3))
def test_dry_friction_never_drives(velocity, force, damping, static, step):
    """Friction takes energy: the step ends no faster, and no further, than without friction."""
    mass = 0.5
    per_mass = 1.0 / (mass + step * damping)
    slick = velocity_after(mass * velocity, force, step, per_mass, 0.0, 0.0)
    rough = velocity_after(mass * velocity, force, step, per_mass, static, 0.5 * static)
    if velocity != 0.0:
        assert rough * velocity >= 0.0
        assert abs(rough) <= abs(slick)
    elif abs(force) <= static:
        assert rough == 0.0
    else:
        assert abs(rough) <= abs(slick)


@settings(max_examples=40)
@given(faults, st.floats(0.01, 2.0), st.floats(0.001, 0.3))
def test_undriven_masses_only_lose_energy(fault, spool_speed, jack_speed):
    """Flapper and feedback are cut off, so that nothing feeds the spool and the jack."""
    p = plant_coefficients(ACTUATOR, fault, Effects())._replace(FORCE=0.0, GP=1e-6, KSF=0.0)
    state = np.zeros(STATE.end)
    state[STATE.spool_velocity], state[STATE.jack_velocity] = spool_speed, jack_speed
    energy = np.inf
    for _ in range(50):
        advance_plant(state, p, 0.0, COARSE, 10)
        now = (
            0.5 * p.MS * state[STATE.spool_velocity] ** 2
            + 0.5 * p.MJ * state[STATE.jack_velocity] ** 2
        )
        assert now <= energy
        energy = now
    assert state[STATE.spool_velocity] >= 0.0
    assert state[STATE.jack_velocity] >= 0.0


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=50), st.floats(0.0, 0.5))
def test_play_holds_inside_its_width_and_is_dragged_outside(inputs, width):
    held = 0.0
    for value in inputs:
        before, held = held, play_operator(held, value, width)
        assert abs(held - value) <= width + 1e-12
        if abs(before - value) <= width:
            assert held == pytest.approx(before, abs=1e-12)


def test_gain_change_scales_the_steady_spool():
    drive = np.full(200, 4e-3)
    slick = msgspec.structs.replace(
        ACTUATOR, servovalve=msgspec.structs.replace(ACTUATOR.servovalve, FSS0=0.0)
    )
    for change in (-0.2, 0.0, 0.2):
        spool = plant_response(slick, drive, Faults(), Effects(gain_change=change), COARSE)[0, -1]
        steady = 2.82 * (1.0 + change) * 4e-3 / 74.3
        assert spool == pytest.approx(steady, rel=1e-6)


def test_hysteresis_is_as_wide_as_it_says():
    """A slow triangle of 5 mA up and back: current behind the play differs by hyst·IM."""
    drive = np.concatenate([np.linspace(0, 5e-3, 100), np.linspace(5e-3, -5e-3, 200)])
    plant = PlantDynamics(ACTUATOR, effects=Effects(hysteresis=0.05), step=COARSE)
    seen = []
    for current in drive:
        plant.advance(float(current))
        seen.append(plant.motor_current)
    rising, falling = np.array(seen[50:99]) - drive[50:99], np.array(seen[150:]) - drive[150:]
    np.testing.assert_allclose(rising, -0.5 * 0.05 * 10e-3, atol=1e-15)
    np.testing.assert_allclose(falling, 0.5 * 0.05 * 10e-3, atol=1e-15)


def test_hysteresis_costs_the_spool_half_its_width():
    slick = msgspec.structs.replace(
        ACTUATOR, servovalve=msgspec.structs.replace(ACTUATOR.servovalve, FSS0=0.0)
    )
    drive = np.full(200, 4e-3)
    spool = plant_response(slick, drive, effects=Effects(hysteresis=0.05), step=COARSE)[0, -1]
    assert spool == pytest.approx(2.82 * (4e-3 - 0.25e-3) / 74.3, rel=1e-6)


def test_backlash_moves_the_steady_spool_by_its_half_width():
    slick = msgspec.structs.replace(
        ACTUATOR, servovalve=msgspec.structs.replace(ACTUATOR.servovalve, FSS0=0.0)
    )
    drive = np.concatenate([np.linspace(0.0, 4e-3, 150), np.full(200, 4e-3)])
    tight = plant_response(slick, drive, step=COARSE)[0, -1]
    loose = plant_response(slick, drive, effects=Effects(backlash=5e-6), step=COARSE)[0, -1]
    assert loose - tight == pytest.approx(5e-6, rel=0.02)


def test_jack_at_its_stop_sees_the_blocked_pressure():
    drive = np.full(400, 10e-3)
    effect = Effects(supply_pressure=15.7e6, return_pressure=0.7e6)
    spool, pressure, position = plant_response(ACTUATOR, drive, effects=effect, step=COARSE)[:, -1]
    valve = ACTUATOR.servovalve
    leak = 15e6 / (valve.GQ * spool) * valve.CLK
    assert position == ACTUATOR.jack.XJM
    assert pressure == pytest.approx(15e6 / (1.0 + leak), rel=1e-9)


def test_external_load_below_friction_moves_nothing_above_it_does():
    for load, moves in ((250.0, False), (400.0, True)):  # static friction as new: 300 N
        jack = msgspec.structs.replace(ACTUATOR.jack, FR=load)
        loaded = msgspec.structs.replace(ACTUATOR, jack=jack)
        position = plant_response(loaded, np.zeros(20), step=COARSE)[2, -1]
        assert (position < 0.0) == moves


@pytest.mark.parametrize("speed", [-0.006, -10.0])
def test_jack_driven_back_cannot_exceed_the_supply(speed):
    p = plant_coefficients(ACTUATOR, Faults(), Effects())
    state = np.zeros(STATE.end)
    state[STATE.jack_velocity] = speed
    advance_plant(state, p, 0.0, 1e-7, 1)
    assert state[STATE.pressure] == p.PSR
    slowed = (p.MJ * speed + 1e-7 * (p.AJ * p.PSR + p.FDJ)) / (p.MJ + 1e-7 * p.CJ)
    assert state[STATE.jack_velocity] == pytest.approx(slowed, rel=1e-12)


def test_spool_stands_at_its_stop():
    plant = PlantDynamics(ACTUATOR, effects=Effects(gain_change=0.2), step=COARSE)
    for _ in range(30):
        plant.advance(10e-3)
    state = plant.state
    assert (state[STATE.spool], state[STATE.spool_velocity]) == (ACTUATOR.servovalve.XSM, 0.0)


def test_flapper_strikes_its_stop_without_bounce():
    plant = PlantDynamics(ACTUATOR, Faults(Kintas=1.0, FSS=1.0), step=COARSE)
    plant.advance(10e-3)
    state = plant.state
    assert (state[STATE.flapper], state[STATE.flapper_velocity]) == (ACTUATOR.servovalve.XFM, 0.0)


@pytest.mark.parametrize("step", [0.0, -1e-6, 2e-3, float("nan"), float("inf")])
def test_impossible_step_is_refused(step):
    with pytest.raises(ConfigurationError, match="integration step"):
        PlantDynamics(ACTUATOR, step=step)


def test_position_integrates_velocity_over_a_tick():
    plant = PlantDynamics(ACTUATOR, step=COARSE)
    for _ in range(60):
        plant.advance(5e-3)
    before = plant.state
    plant.advance(5e-3)
    after = plant.state
    mean = 0.5 * (before[STATE.jack_velocity] + after[STATE.jack_velocity])
    assert (after[STATE.jack] - before[STATE.jack]) / 1e-3 == pytest.approx(mean, rel=1e-3)


IM = 10e-3
counts = st.sampled_from([1, 2, 5, 12])
widths = st.floats(0.0, 0.1)
histories = st.lists(st.floats(-IM, IM), min_size=1, max_size=40)


def motor(effects):
    return TorqueMotor(1.0, IM, effects)


def outputs(effects, history):
    item = motor(effects)
    return [item.torque(value) for value in history]


@given(histories, counts, widths)
def test_output_stays_within_the_half_widths(history, count, width):
    got = outputs(Effects(hysteresis=width, plays=count), history)
    for value, out in zip(history, got, strict=True):
        assert abs(out - value) <= 0.5 * width * IM + 1e-15


@given(histories, counts, widths, st.integers(2, 5))
def test_only_reversals_count_not_the_rate(history, count, width, parts):
    effects = Effects(hysteresis=width, plays=count)
    points = [0.0, *history]
    slow = [
        a + (b - a) * (i + 1) / parts for a, b in itertools.pairwise(points) for i in range(parts)
    ]
    assert outputs(effects, slow)[-1] == pytest.approx(outputs(effects, history)[-1], abs=1e-15)


@given(histories, counts, widths, st.floats(0.0, 1.0))
def test_a_closed_inner_loop_leaves_no_trace(history, count, width, share):
    """Return-point memory: away from a reversal and back to it."""
    effects = Effects(hysteresis=width, plays=count)
    last = history[-1]
    before = ([0.0, *history])[-2]
    inner = last + share * (before - last)
    plain = outputs(effects, [*history, last])[-1]
    assert outputs(effects, [*history, inner, last])[-1] == pytest.approx(plain, abs=1e-15)


@pytest.mark.parametrize("count", [1, 3, 12])
def test_the_loop_has_the_stated_width(count):
    """Rising minus falling, wide beyond twice the largest half-width."""
    effects = Effects(hysteresis=0.04, plays=count)
    up = outputs(effects, [-IM, 0.0])[-1]
    down = outputs(effects, [IM, 0.0])[-1]
    assert down - up == pytest.approx(0.04 * IM, rel=1e-12)


def test_half_widths_are_spread_as_the_contract_says():
    """The slope of the virgin curve rises by 1/n where the input passes each half-width."""
    n, width = 4, 0.04
    item = motor(Effects(hysteresis=width, plays=n))
    corners = width * IM * (np.arange(n) + 0.5) / n
    inputs = np.linspace(0.0, IM * 0.06, 600)
    slopes = np.diff([item.torque(value) for value in inputs]) / np.diff(inputs)
    for number, corner in enumerate(corners):
        beyond = np.argmax(inputs > corner) + 1
        assert slopes[beyond] == pytest.approx((number + 1) / n)


def test_bias_comes_before_hysteresis_and_gain_after():
    item = TorqueMotor(2.0, IM, Effects(hysteresis=0.02, null_bias=0.3e-3))
    assert item.torque(1e-3) == pytest.approx(2.0 * (1.3e-3 - 0.1e-3))
    assert item.current == pytest.approx(1.2e-3)


def test_strangers_bend_and_weigh():
    bent = outputs(Effects(unmodelled=UnmodelledEffects(torque_cubic=-0.1)), [IM])[-1]
    assert bent == pytest.approx(0.9 * IM)
    narrow = Effects(hysteresis=0.04, plays=8, unmodelled=UnmodelledEffects(play_skew=5.0))
    even = Effects(hysteresis=0.04, plays=8)
    assert outputs(narrow, [IM])[-1] > outputs(even, [IM])[-1]
