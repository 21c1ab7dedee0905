"""What holds of the monitoring model for any current and any faults."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import SPOOL
from ehadiag.model.anchor import Anchor
from ehadiag.model.plant import plant_constants
from ehadiag.model.scalar.response import respond
from ehadiag_tools.damaged import damaged_unit

TICK = 1e-3
CONSTANTS = plant_constants(default_actuator())
ANCHOR = Anchor(0.3, 1.3 * SPOOL.lsb, 6.0 * SPOOL.lsb)

share = st.floats(0.0, 1.0)
faults_of = st.tuples(share, share, share).map(np.array)
levels = st.lists(st.tuples(st.floats(-10e-3, 10e-3), st.integers(1, 12)), min_size=1, max_size=8)
currents = levels.map(lambda parts: np.concatenate([np.full(n, level) for level, n in parts]))


def run(faults, current, **options):
    return respond(damaged_unit(faults), current, TICK, **options)


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
    assert held.anchored == 0
    np.testing.assert_array_equal(held.spool, free.spool)
    np.testing.assert_array_equal(held.pressure, free.pressure)


@given(faults_of, currents, st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_anchoring_ignores_noise_and_missing_samples(faults, current, seed):
    free = run(faults, current)
    rng = np.random.default_rng(seed)
    measured = free.spool + 0.5 * SPOOL.lsb * np.clip(rng.standard_normal(len(current)), -2.5, 2.5)
    measured[rng.random(len(current)) < 0.1] = np.nan
    held = run(faults, current, measured=measured, anchor=ANCHOR)
    np.testing.assert_array_equal(held.spool, free.spool)


def test_anchoring_takes_a_wrong_start_back():
    """A spool that starts 20 LSB off stays off when it runs free, not when it is anchored."""
    time = np.arange(400) * TICK
    current = 0.3e-3 * np.sin(2 * np.pi * 2 * time)
    truth = run((0.3, 1.0, 0.3), current)
    off = 20 * SPOOL.lsb
    free = run((0.3, 1.0, 0.3), current, origin=off)
    held = run((0.3, 1.0, 0.3), current, origin=off, measured=truth.spool, anchor=ANCHOR)
    assert np.abs(free.spool - truth.spool)[:30].min() > 10 * SPOOL.lsb
    assert held.anchored >= 1
    assert np.abs(held.spool - truth.spool)[1:].max() < SPOOL.lsb


def first_motion(faults):
    """Tick at which a slow ramp of current first moves the spool by more than one LSB."""
    current = np.linspace(0.0, 2e-3, 1500)
    return int(np.flatnonzero(run(faults, current).spool > SPOOL.lsb)[0])


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
