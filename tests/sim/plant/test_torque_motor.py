"""Torque motor: null bias, gain, and hysteresis as a Prandtl-Ishlinskii operator."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag_sim.plant.conditions import Effects, Strangers
from ehadiag_sim.plant.torque_motor import TorqueMotor

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
    bent = outputs(Effects(strangers=Strangers(torque_cubic=-0.1)), [IM])[-1]
    assert bent == pytest.approx(0.9 * IM)
    narrow = Effects(hysteresis=0.04, plays=8, strangers=Strangers(play_skew=5.0))
    even = Effects(hysteresis=0.04, plays=8)
    assert outputs(narrow, [IM])[-1] > outputs(even, [IM])[-1]
