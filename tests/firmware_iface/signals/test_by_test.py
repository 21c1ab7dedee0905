"""Values that reach a logger late, overtaken or seldom, placed by the test that was played."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from firmware_iface.signals.by_test import (
    Clockwork,
    Events,
    Expected,
    placed_by_time,
    placed_in_order,
)

TESTS = bundled_tests()
CONTROLLER = default_actuator().controller
NOISE = 3e-6
LEAD = 200


def late(count: int, jitter: float, drift: float, rng: np.random.Generator):
    """Arrivals of frames that keep their order, on a clock that drifts."""
    true = np.arange(count) + np.abs(rng.normal(0.0, jitter, count))
    return np.maximum.accumulate(true) * (1.0 + drift)


def open_loop(jitter: float, drift: float, seed: int, keep: float):
    """What is seen of an open loop test, the ticks that it is of, and what is expected."""
    rng = np.random.default_rng(seed)
    command = np.concatenate([np.zeros(LEAD), TESTS["open"].command()])
    told = np.concatenate([np.full(LEAD, np.nan), TESTS["open"].command()])
    at = late(len(command), jitter, drift, rng)
    # What comes at the same instant as the next one is overtaken before the logger looks.
    seen = np.append(np.diff(at) > 1e-9, [True]) & (rng.random(len(at)) < keep)
    tick = np.flatnonzero(seen)
    current = command[tick] + rng.normal(0.0, NOISE, len(tick))
    events = Events(at[tick], current, np.full(len(tick), np.nan), 0.1)
    return events, tick, Expected(told, np.zeros(len(told), dtype=np.bool_), CONTROLLER)


@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.5, 1.0])
def test_the_current_tells_the_tick_where_it_moves(jitter):
    events, tick, expected = open_loop(jitter, 50e-6, 1, 0.95)
    placed = placed_in_order(events, expected, NOISE)
    moving = expected.tells(tick, NOISE)
    assert moving.sum() > 1000
    assert np.mean(placed.tick[moving] == tick[moving]) > 0.995
    assert np.all(np.diff(placed.tick) >= 1)


@settings(max_examples=3, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(-100e-6, 100e-6), st.integers(0, 10_000), st.floats(0.7, 1.0))
def test_placed_ticks_rise_and_are_near(jitter, drift, seed, keep):
    events, tick, expected = open_loop(jitter, drift, seed, keep)
    placed = placed_in_order(events, expected, NOISE)
    assert np.all(np.diff(placed.tick) >= 1)
    assert np.median(np.abs(placed.tick - tick)) <= 1
    assert np.all(placed.late >= 0.0)


def test_in_closed_loop_the_position_before_tells_the_current():
    rng = np.random.default_rng(3)
    command = TESTS["closed"].command()
    position = command + rng.normal(0.0, 20e-6, len(command))
    before = np.concatenate([[0.0], position[:-1]])
    current = np.clip(CONTROLLER.GAP * (command - before), -CONTROLLER.IM, CONTROLLER.IM)
    at = late(len(command), 0.5, 0.0, rng)
    seen = np.flatnonzero(np.append(np.diff(at) > 1e-9, [True]))
    events = Events(at[seen], current[seen], position[seen], 0.1)
    expected = Expected(command, np.ones(len(command), dtype=np.bool_), CONTROLLER)
    placed = placed_in_order(events, expected, NOISE)
    assert np.mean(placed.tick == seen) > 0.97


def test_what_tells_nothing_goes_by_the_time_on_the_same_clock():
    true = np.arange(500)
    clock = Clockwork(100e-6, 0.4)
    at = (true + 0.4) / (1.0 - 100e-6)
    placed = placed_by_time(at, clock, 0.2)
    assert np.array_equal(placed.tick, true)
    assert np.all(placed.late < 0.01)


def test_an_integral_in_the_control_law_tells_nothing():
    law = type(CONTROLLER)(IM=0.01, GAP=1.7, GAI=1.0)
    expected = Expected(np.zeros(3), np.ones(3, dtype=np.bool_), law)
    assert np.isnan(expected.current(np.arange(3), np.zeros(3))).all()
