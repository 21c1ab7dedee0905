"""Which rounding of a commanded position the measured current followed.

The commanded current, rebuilt exactly, also where samples are lost. Offsets of the sensors are
taken from the rest before a test, if there was one.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from ehadiag import CommandMode, Samples, Verdict, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.signals import commanded_current, resolution_by_current
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.simulation import simulate
from firmware_iface.recording import CHANNELS
from firmware_iface.stored_test import resolve_test

STORED = resolve_test("closed").command()
GAP = 1.7


def follows(seed):
    """Jack position that the control law works on: behind its command, with the sensor's noise."""
    rng = np.random.default_rng(seed)
    place = np.roll(STORED, 40) + CHANNELS.position.lsb * 0.5 * rng.standard_normal(len(STORED))
    return CHANNELS.position.decode(CHANNELS.position.encode(place))


def measured_current(command, seen, seed):
    """As the converter gives it."""
    rng = np.random.default_rng([seed, 1])
    volts = GAP * (command - seen) + 0.4 * CHANNELS.current.lsb
    volts += CHANNELS.current.lsb * 0.5 * rng.standard_normal(len(STORED))
    return CHANNELS.current.decode(CHANNELS.current.encode(volts))


@pytest.mark.parametrize(
    "step", [0.0, 1e-6, 2e-6, 5e-6, CHANNELS.position.lsb / 16, CHANNELS.position.lsb / 4]
)
@pytest.mark.parametrize("seed", [1, 2])
def test_the_step_is_found_by_its_effect_of_less_than_a_step_of_current(step, seed):
    command = np.round(STORED / step) * step if step else STORED
    seen = follows(seed)
    measured = measured_current(command, seen, seed)
    measured[100:150] = np.nan
    found = resolution_by_current(
        STORED, lambda item: GAP * (item - seen), measured, CHANNELS.position.lsb
    )
    assert found == pytest.approx(step, rel=1e-9)


def test_nothing_measured_tells_nothing():
    nothing = np.full(len(STORED), np.nan)
    assert resolution_by_current(STORED, lambda item: item, nothing, CHANNELS.position.lsb) == 0.0
    assert resolution_by_current(STORED, lambda item: item, STORED, CHANNELS.position.lsb) == 0.0


TEST = resolve_test("closed")
EXACT = 5e-12
"""A."""


def controller(**gains):
    return msgspec.structs.replace(default_actuator().controller, **gains)


def closed_loop(data, *, seed=0, lag=40.0, offset_lsb=0.0, noise_lsb=0.5):
    """A jack that follows its command late, the simulator's control law on its noisy codes."""
    rng = np.random.default_rng(seed)
    command = np.rint(TEST.command() / 2e-6) * 2e-6
    law = PositionController(data)
    place, seen = 0.0, CHANNELS.position.lsb * rng.integers(-1, 2)
    current, position = np.empty(TEST.ticks), np.empty(TEST.ticks)
    for k, wanted in enumerate(command.tolist()):
        current[k] = law.current(wanted, CommandMode.POSITION, float(seen))
        place += lag * current[k] * 1e-3
        volts = np.array([place + noise_lsb * CHANNELS.position.lsb * rng.standard_normal()])
        seen = CHANNELS.position.decode(CHANNELS.position.encode(volts))[0]
        position[k] = seen
    measured = current + CHANNELS.current.lsb * (
        offset_lsb + noise_lsb * rng.standard_normal(TEST.ticks)
    )
    nothing = np.zeros(TEST.ticks)
    samples = Samples(
        period_ns=1_000_000,
        mode=CommandMode.POSITION,
        current=CHANNELS.current.decode(CHANNELS.current.encode(measured)),
        spool=nothing,
        pressure=nothing,
        position=position,
        command=command,
        saturated=np.zeros((4, TEST.ticks), dtype=np.bool_),
        host_ns=np.zeros(TEST.ticks, dtype=np.int64),
    )
    return samples, current


def without(samples, rows, *, commands_too=False):
    """Telemetry rows lost: all four channels."""
    lost = {}
    for name in ("current", "spool", "pressure", "position"):
        values = getattr(samples, name).copy()
        values[rows] = np.nan
        lost[name] = values
    command = samples.command.copy()
    if commands_too:
        command[rows] = np.nan
    return Samples(
        period_ns=samples.period_ns,
        mode=samples.mode,
        command=command,
        saturated=samples.saturated,
        host_ns=samples.host_ns,
        **lost,
    )


def test_open_loop_current_is_the_command():
    test = resolve_test("open")
    data = default_actuator().controller
    command = 1.3 * test.command()
    shape = np.zeros(test.ticks)
    played = np.clip(command, -data.IM, data.IM)
    samples = Samples(
        1_000_000, CommandMode.CURRENT, played, shape, shape, shape, command,
        np.zeros((4, test.ticks), dtype=np.bool_), np.zeros(test.ticks, dtype=np.int64),
    )  # fmt: skip
    trace = commanded_current(samples, test, data)
    assert trace.rebuilt
    np.testing.assert_array_equal(trace.current, played)
    assert trace.command_deviation == pytest.approx(0.3 * 10e-3, rel=1e-9)


def test_proportional_law_is_rebuilt_exactly():
    samples, truth = closed_loop(controller())
    trace = commanded_current(samples, TEST, controller())
    assert trace.rebuilt
    np.testing.assert_allclose(trace.current, truth, atol=EXACT)
    assert 0.5 < trace.residual_lsb < 0.65


@given(st.integers(0, 2**32 - 1), st.floats(0.001, 0.2))
@settings(max_examples=25)
def test_lost_samples_have_their_exact_codes(seed, share):
    """One code of position is many codes of current, so the current tells the lost code.

    Where the current of the same tick is lost too or saturates, nothing tells it.
    """
    samples, truth = closed_loop(controller(), seed=seed % 50)
    rows = np.flatnonzero(np.random.default_rng(seed).random(TEST.ticks) < share)
    trace = commanded_current(without(samples, rows), TEST, controller())
    assert trace.rebuilt
    told = np.ones(TEST.ticks, dtype=np.bool_)
    told[rows] = False
    np.testing.assert_allclose(trace.current[told], truth[told], atol=EXACT)
    # Elsewhere the position is bridged: it moves few codes a tick.
    code = controller().GAP * CHANNELS.position.lsb
    assert np.abs(trace.current - truth).max() < 200.0 * code


def test_a_current_sensor_with_an_offset_does_not_spoil_lost_codes():
    samples, truth = closed_loop(controller(), offset_lsb=5.0)
    rows = np.arange(100, TEST.ticks, 50)
    trace = commanded_current(without(samples, rows), TEST, controller())
    # Within the offset of saturation nothing tells whether the law was linear.
    linear = np.abs(truth) < controller().IM - 10.0 * CHANNELS.current.lsb
    told = np.setdiff1d(np.flatnonzero(linear), rows)
    np.testing.assert_allclose(trace.current[told], truth[told], atol=EXACT)
    assert trace.offset == pytest.approx(5.0 * CHANNELS.current.lsb, abs=0.3 * CHANNELS.current.lsb)


@pytest.mark.parametrize("gains", [{"GAI": 10.0}, {"GAD": 0.01}, {"GAI": 10.0, "GAD": 0.01}])
def test_integral_and_derivative_are_rebuilt(gains):
    data = controller(**gains)
    samples, truth = closed_loop(data)
    plain = commanded_current(samples, TEST, controller())
    trace = commanded_current(samples, TEST, data)
    assert trace.rebuilt
    assert not plain.rebuilt
    # The unlogged sample before the test enters the first two ticks, and the integral for good.
    np.testing.assert_allclose(trace.current[2:], truth[2:], atol=0.2 * CHANNELS.current.lsb)


def test_another_control_law_is_noticed():
    """Half the gain does not explain the current."""
    samples, _ = closed_loop(controller())
    trace = commanded_current(samples, TEST, controller(GAP=0.5 * controller().GAP))
    assert not trace.rebuilt
    assert trace.residual_lsb > 20.0


def test_without_command_frames_the_stored_command_serves():
    samples, truth = closed_loop(controller())
    blind = without(samples, np.array([], dtype=int))
    blind.command[:] = np.nan
    trace = commanded_current(blind, TEST, controller())
    assert trace.rebuilt
    # The stored command is exact, the played one rounded to 2 µm.
    assert np.abs(trace.current - truth)[1:].max() < controller().GAP * 1.01e-6
    assert trace.command_deviation == 0.0


@pytest.mark.parametrize("lost", [(), range(500, 900, 7)])
def test_a_bus_without_commands_shows_by_the_current_how_they_were_rounded(lost):
    samples, current = closed_loop(controller())
    samples = without(samples, list(lost))
    samples = replace(samples, command=np.full(samples.ticks, np.nan))
    trace = commanded_current(samples, TEST, controller())
    assert trace.command_step == pytest.approx(2e-6)
    assert np.abs(trace.current - current).max() < EXACT


OPEN = resolve_test("open")
FAULTS = (0.78, 0.02, 0.98)


@pytest.fixture(scope="module")
def pushed():
    """Recording of a unit whose null bias moves the spool from the first tick on."""
    effects = Effects(null_bias=9.2e-5, hysteresis=0.007, gain_change=0.01)
    done = simulate(default_actuator(), OPEN, Faults(*FAULTS), effects, seed=1, step=1e-6)
    return done.recording("simulated", 1)


def experiment_of(recording):
    return build_experiment(recording.samples, recording.environment, OPEN, default_actuator())


def test_a_spool_that_moves_from_the_first_tick_on_shows_no_offset(pushed):
    experiment = experiment_of(pushed)
    assert not experiment.rested
    assert experiment.origin == experiment.pressure_offset == 0.0


def test_nor_does_it_start_displaced(pushed):
    found = diagnose([pushed], default_actuator(), bundled_tests().values())
    assert found.verdict is Verdict.FAULT
    values = [item.value for item in found.identification.estimates]
    np.testing.assert_allclose(values, FAULTS, atol=0.002)


def test_a_spool_that_friction_holds_beside_the_middle_starts_there(pushed):
    pressure = np.where(np.arange(OPEN.ticks) < 100, 1.8e6, pushed.samples.pressure)
    held = replace(pushed, samples=replace(pushed.samples, pressure=pressure))
    experiment = experiment_of(held)
    assert experiment.rested
    assert experiment.origin > 0.0


def test_a_spoilt_sample_does_not_undo_a_rest(pushed):
    pressure = np.where(np.arange(OPEN.ticks) < 100, 1.8e6, pushed.samples.pressure)
    pressure[1] += 0.2e6
    spoilt = replace(pushed, samples=replace(pushed.samples, pressure=pressure))
    assert experiment_of(spoilt).rested
