"""The monitoring model against independent solutions of the specified equations (PHY-4 to 9).

What holds of the monitoring model for any current and any faults.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from other_actuator import with_data
from scipy.linalg import expm
from stiff_reference import StiffReference

from ehadiag import default_actuator
from ehadiag.model.batch import Anchor
from ehadiag.model.plant import plant_constants
from ehadiag.model.residual_models import model_response
from ehadiag.model.simd_jack import driven_jack_costs
from ehadiag_tools.simulator.units import damaged_unit
from firmware_iface.recording import CHANNELS

TICK = 1e-3
LSB = np.array([[CHANNELS.spool.lsb], [CHANNELS.pressure.lsb], [CHANNELS.position.lsb]])
CORNERS = [
    (0, 0, 0),
    (1, 1, 1),
    (0.3, 0.6, 0.3),
    *(
        pytest.param(item, marks=pytest.mark.slow)
        for item in ((0, 1, 0), (1, 0, 1), (0.9, 0.1, 0.5))
    ),
]


def model(actuator, faults, current):
    answer = model_response(damaged_unit(faults, actuator), current, TICK)
    return np.vstack([answer.spool, answer.pressure, answer.position])


def differences(actuator, faults, current):
    reference = StiffReference(actuator, *faults)
    off = (model(actuator, faults, current) - reference.respond(current)) / LSB
    return np.sqrt((off**2).mean(axis=1)), np.abs(off).max(axis=1), reference


@pytest.mark.parametrize("faults", CORNERS)
def test_stick_slip_follows_the_stiff_solver(faults):
    """Two tones; the spool and the jack stick and break away again and again."""
    time = np.arange(100) * TICK
    current = 1.5e-3 * (np.sin(2 * np.pi * 7 * time) + np.sin(2 * np.pi * 43 * time))
    rms, _, reference = differences(default_actuator(), faults, current)
    assert reference.slides[1] >= 5
    assert rms[0] < 0.02
    assert rms[1] < 0.4
    assert rms[2] < 0.02


@pytest.mark.parametrize("faults", CORNERS)
def test_full_steps_follow_the_stiff_solver(faults):
    """Rated current back and forth: flapper on its stops, second stage saturated."""
    current = np.zeros(90)
    current[1:] = 10e-3 * np.sign(np.sin(2 * np.pi * 20 * np.arange(89) * TICK + 0.1))
    rms, largest, reference = differences(default_actuator(), faults, current)
    assert reference.slides[0] >= 3  # the flapper left its stops
    assert rms[0] < 0.05
    assert largest[0] < 0.5
    # A spool that rushes through the middle as a tick ends leaves 3 LSB of pressure in that tick.
    assert rms[1] < 0.8
    assert rms[2] < 0.05


@pytest.mark.parametrize("faults", [(0, 0, 0), (0.5, 1, 0.2)])
def test_stops_of_the_spool_follow_the_stiff_solver(faults):
    """Twenty per cent more torque drives the spool into its stops."""
    actuator = with_data(servovalve={"GM": 1.2 * 2.82})
    current = np.zeros(60)
    current[1:] = 10e-3 * np.sign(np.sin(2 * np.pi * 20 * np.arange(59) * TICK + 0.1))
    answer = model(actuator, faults, current)
    assert np.abs(answer[0]).max() == actuator.servovalve.XSM
    rms, _, _ = differences(actuator, faults, current)
    assert rms[0] < 0.05


def test_a_load_moves_the_jack_to_its_stop():
    actuator = with_data(jack={"XJM": 0.2e-3, "FR": 300.0})
    current = np.zeros(80)
    current[1:] = 2e-3 * np.sign(np.sin(2 * np.pi * 15 * np.arange(79) * TICK + 0.1))
    answer = model(actuator, (0.2, 0.2, 0.2), current)
    assert np.abs(answer[2]).max() == 0.2e-3
    rms, _, reference = differences(actuator, (0.2, 0.2, 0.2), current)
    assert reference.slides[2] >= 2
    assert rms[2] < 0.05


def test_without_friction_the_spool_is_the_linear_system():
    """No dry friction, no stop: the matrix exponential is the exact answer."""
    actuator = with_data(servovalve={"FSS0": 0.0})
    valve, kintas = actuator.servovalve, 0.4
    time = np.arange(300) * TICK
    current = 1e-3 * (np.sin(2 * np.pi * 3 * time) + 0.5 * np.sin(2 * np.pi * 37 * time))
    drag = valve.GPF / (valve.GQF * (1 - 0.8 * kintas)) * valve.AS**2 + valve.CS
    rates = np.zeros((5, 5))  # XF, DXF, XS, DXS, current
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = np.array([-valve.KF, -valve.CF, -valve.KSF, 0.0, valve.GM]) / valve.JF
    rates[3, 0], rates[3, 3] = valve.AS * valve.GPF / valve.MS, -drag / valve.MS
    step = expm(rates * TICK)
    state, exact = np.zeros(5), []
    for value in current:
        state[4] = value
        state = step @ state
        exact.append(state[2])
    assert np.abs(exact).max() > 20 * CHANNELS.spool.lsb
    answer = model(actuator, (kintas, 0.0, 0.0), current)
    np.testing.assert_allclose(answer[0], exact, atol=1e-3 * CHANNELS.spool.lsb)


def jack_by_small_steps(constants, spool, step=0.5e-6):
    """Second stage and jack, the contract's section 1 as it stands; the spool moves straight."""
    c, dynamic = constants, constants.FDJ
    substeps = round(TICK / step)
    velocity = before = 0.0
    out = []
    for after in spool:
        for i in range(1, substeps + 1):
            xs = before + (after - before) * i / substeps
            source = min(max(c.GP * xs, -c.PSR), c.PSR)
            saturated = abs(c.GP * xs) > c.PSR
            resistance = c.PSR / (c.GQ * abs(xs)) if saturated else c.GP / c.GQ
            share = 1.0 / (1.0 + resistance * c.CLK)
            drag = c.AJ**2 * share * resistance + c.CJ
            push = c.AJ * share * source - c.FR
            if velocity == 0.0:
                if abs(push) > 2.0 * dynamic:
                    velocity = np.copysign(1e-15, push)
                else:
                    continue
            way = np.copysign(1.0, velocity)
            new = (velocity + step / c.MJ * (push - way * dynamic)) / (1.0 + step / c.MJ * drag)
            velocity = 0.0 if new * way < 0.0 else new
        before = after
        out.append(share * (source - resistance * c.AJ * velocity))
    return np.array(out)


@pytest.mark.parametrize("fdj", [0.0, 0.4, 1.0])
def test_jack_alone_follows_small_steps(fdj):
    """A given straight-lined spool path through the middle, saturated at both ends."""
    constants = damaged_unit((0.0, 0.0, fdj))
    spool = 60e-6 * np.sin(2 * np.pi * 20 * np.arange(1, 61) * TICK)
    before = np.concatenate([[0.0], spool[:-1]])
    rate = (spool - before) / TICK
    nodes = np.column_stack([np.full(60, TICK), spool, rate, rate, np.zeros(60)])
    truth, lsb = jack_by_small_steps(constants, spool), CHANNELS.pressure.lsb
    row = np.array([constants], dtype=np.float64)
    (cost,) = driven_jack_costs(row, nodes, 0.0, truth, lsb, np.inf)
    assert np.sqrt(cost / 60) < 0.3


CONSTANTS = plant_constants(default_actuator())
ANCHOR = Anchor(0.3, 1.3 * CHANNELS.spool.lsb, 6.0 * CHANNELS.spool.lsb)

share = st.floats(0.0, 1.0)
faults_of = st.tuples(share, share, share).map(np.array)
levels = st.lists(st.tuples(st.floats(-10e-3, 10e-3), st.integers(1, 12)), min_size=1, max_size=8)
currents = levels.map(lambda parts: np.concatenate([np.full(n, level) for level, n in parts]))


def run(faults, current, **options):
    return model_response(damaged_unit(faults), current, TICK, **options)


@given(faults_of, currents)
def test_the_mirrored_current_gives_the_mirrored_response(faults, current):
    there, back = run(faults, current), run(faults, -current)
    np.testing.assert_array_equal(there.spool, -back.spool)
    np.testing.assert_allclose(there.pressure, -back.pressure, atol=1e-6)
    np.testing.assert_allclose(there.position, -back.position, atol=1e-15)


@given(faults_of, currents)
def test_nothing_leaves_its_stops(faults, current):
    answer = run(faults, current)
    for values, limit in (
        (answer.spool, CONSTANTS.XSM),
        (answer.pressure, CONSTANTS.PSR),
        (answer.position, CONSTANTS.XJM),
    ):
        assert np.isfinite(values).all()
        assert np.abs(values).max() <= limit


@given(faults_of, currents)
def test_a_repeated_call_gives_the_same_digits(faults, current):
    first, second = run(faults, current), run(faults, current)
    np.testing.assert_array_equal(first.spool, second.spool)
    np.testing.assert_array_equal(first.pressure, second.pressure)


@given(faults_of, st.integers(1, 300))
def test_without_current_nothing_moves(faults, ticks):
    answer = run(faults, np.zeros(ticks))
    assert not answer.spool.any()
    assert not answer.pressure.any()
    assert not answer.position.any()


@given(faults_of, currents)
def test_the_past_does_not_feel_the_future(faults, current):
    """The response to the first half is that of the whole, cut."""
    half = max(1, len(current) // 2)
    whole, part = run(faults, current), run(faults, current[:half])
    np.testing.assert_array_equal(whole.spool[:half], part.spool)
    np.testing.assert_array_equal(whole.pressure[:half], part.pressure)


@given(faults_of, currents)
def test_anchoring_leaves_a_true_model_alone(faults, current):
    free = run(faults, current)
    held = run(faults, current, measured=free.spool, anchor=ANCHOR)
    assert held.anchored.size == 0
    np.testing.assert_array_equal(held.spool, free.spool)
    np.testing.assert_array_equal(held.pressure, free.pressure)


@given(faults_of, currents, st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_anchoring_ignores_noise_and_missing_samples(faults, current, seed):
    free = run(faults, current)
    rng = np.random.default_rng(seed)
    measured = free.spool + 0.5 * CHANNELS.spool.lsb * np.clip(
        rng.standard_normal(len(current)), -2.5, 2.5
    )
    measured[rng.random(len(current)) < 0.1] = np.nan
    held = run(faults, current, measured=measured, anchor=ANCHOR)
    np.testing.assert_array_equal(held.spool, free.spool)


def test_anchoring_takes_a_wrong_start_back():
    """A spool that starts 20 LSB off stays off when it runs free, not when it is anchored."""
    time = np.arange(400) * TICK
    current = 0.3e-3 * np.sin(2 * np.pi * 2 * time)
    truth = run((0.3, 1.0, 0.3), current)
    off = 20 * CHANNELS.spool.lsb
    free = run((0.3, 1.0, 0.3), current, origin=off)
    held = run((0.3, 1.0, 0.3), current, origin=off, measured=truth.spool, anchor=ANCHOR)
    assert np.abs(free.spool - truth.spool)[:30].min() > 10 * CHANNELS.spool.lsb
    assert held.anchored.size >= 1
    assert np.abs(held.spool - truth.spool)[1:].max() < CHANNELS.spool.lsb


def first_motion(faults):
    """Tick at which a slow ramp of current first moves the spool by more than one LSB."""
    current = np.linspace(0.0, 2e-3, 1500)
    return int(np.flatnonzero(run(faults, current).spool > CHANNELS.spool.lsb)[0])


@pytest.mark.parametrize("kintas", [0.0, 0.5, 1.0])
def test_more_spool_friction_breaks_away_later(kintas):
    ticks = [first_motion((kintas, fss, 0.0)) for fss in np.linspace(0.0, 1.0, 9)]
    assert all(a < b for a, b in itertools.pairwise(ticks))


def test_more_jack_friction_takes_more_pressure_to_move():
    current = np.linspace(0.0, 1e-3, 1500)
    peaks = [run((0.0, 0.0, fdj), current).pressure.max() for fdj in np.linspace(0.0, 1.0, 9)]
    assert all(a < b for a, b in itertools.pairwise(peaks))


def test_a_clogged_filter_slows_the_spool():
    current = np.concatenate([[0.0], np.full(8, 10e-3)])
    spool = [run((kintas, 0.2, 0.2), current).spool[5] for kintas in np.linspace(0.0, 1.0, 9)]
    assert all(a > b for a, b in itertools.pairwise(spool))
