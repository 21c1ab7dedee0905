"""Sensors, control law and plant together, tick by tick and over a whole test."""

import msgspec
import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import CHANNELS, CURRENT, POSITION
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.recording import BitState, CommandMode
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.plant.conditions import Effects, Faults, Sensors
from ehadiag_sim.plant.simulator import Plant, bus_command, simulate

ACTUATOR = default_actuator()
TESTS = bundled_tests()
COARSE = 10e-6
FAULTS = Faults(0.3, 0.3, 0.3)
NOISELESS = Sensors(noise_lsb=0.0)


def run(test="closed", **changes):
    options = {"faults": FAULTS, "step": COARSE} | changes
    return simulate(ACTUATOR, TESTS[test], **options)


def decoded(codes):
    return np.array([c.decode(row) for c, row in zip(CHANNELS, codes, strict=True)])


def truth(result):
    return np.vstack([result.current, result.spool, result.pressure, result.position])


LSB = np.array([[channel.lsb] for channel in CHANNELS])


def test_same_seed_same_run_other_seed_another():
    first, again, other = run(seed=5), run(seed=5), run(seed=6)
    np.testing.assert_array_equal(first.codes, again.codes)
    np.testing.assert_array_equal(first.spool, again.spool)
    assert (first.codes != other.codes).any()


def test_ticks_and_bulk_are_one():
    """What the emulator sends tick by tick is what a simulated run holds."""
    bulk = run(seed=11)
    plant = Plant(ACTUATOR, FAULTS, Effects(), Sensors(), 11, step=COARSE)
    codes = [plant.tick(float(x), CommandMode.POSITION) for x in bus_command(TESTS["closed"])]
    np.testing.assert_array_equal(np.array(codes).T, bulk.codes)


def test_control_law_works_on_the_digitised_position_of_the_tick_before():
    result = run(seed=2)
    seen = POSITION.decode(result.codes[3])
    wanted = 1.7 * (result.command[1:] - seen[:-1])
    np.testing.assert_allclose(result.current[1:], np.clip(wanted, -10e-3, 10e-3), atol=1e-15)
    # It would not be so with the position of the same tick.
    late = np.clip(1.7 * (result.command - seen), -10e-3, 10e-3)
    assert np.abs(result.current - late).max() > CURRENT.lsb


def test_sample_before_the_test_is_noisy_too():
    first = {run_first_current(seed) for seed in range(20)}
    assert len(first) > 1
    steps = np.array(sorted(first)) / (1.7 * POSITION.lsb)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def run_first_current(seed):
    plant = Plant(ACTUATOR, seed=seed, step=COARSE)
    plant.tick(0.0, CommandMode.POSITION)
    return round(plant.truth[0], 12)


def test_open_loop_current_is_the_command():
    result = run("open")
    np.testing.assert_array_equal(result.current, np.clip(result.command, -10e-3, 10e-3))


def test_command_has_the_resolution_of_the_bus():
    for name, step in (("open", 0.5e-6), ("closed", 2e-6)):
        command, exact = bus_command(TESTS[name]), TESTS[name].command()
        np.testing.assert_allclose(command / step, np.rint(command / step), atol=1e-6)
        assert 0.4 * step < np.abs(command - exact).max() <= 0.5 * step * (1 + 1e-6)


def test_a_tick_acts_on_the_command_that_the_bus_can_carry():
    plant = Plant(ACTUATOR, sensors=NOISELESS, step=COARSE)
    plant.tick(1.2345678e-3, CommandMode.CURRENT)
    assert plant.truth[0] == pytest.approx(1.2345e-3, rel=1e-9)
    plant = Plant(ACTUATOR, sensors=NOISELESS, step=COARSE)
    plant.tick(1.2347e-3, CommandMode.POSITION)
    assert plant.truth[0] == pytest.approx(1.7 * 1.234e-3, rel=1e-9)


def test_noise_and_quantisation_are_what_the_contract_says():
    result = run("open", seed=3)
    gap = (decoded(result.codes) - truth(result)) / LSB
    floor = np.sqrt(0.5**2 + 1 / 12)
    np.testing.assert_allclose(gap.std(axis=1), floor, rtol=0.03)
    np.testing.assert_allclose(gap.mean(axis=1), 0.0, atol=0.03)
    assert np.abs(np.corrcoef(gap) - np.eye(4)).max() < 0.06


def test_without_noise_codes_are_the_nearest():
    result = run("open", sensors=NOISELESS)
    gap = (decoded(result.codes) - truth(result)) / LSB
    assert np.abs(gap).max() <= 0.5 + 1e-9


def test_offset_shifts_its_channel_only():
    plain = run("open", sensors=NOISELESS)
    moved = run("open", sensors=Sensors(noise_lsb=0.0, offsets_lsb=(0.0, 7.0, 0.0, -3.0)))
    shift = (moved.codes - plain.codes).mean(axis=1)
    np.testing.assert_allclose(shift, [0.0, 7.0, 0.0, -3.0], atol=1e-12)


def test_offset_of_the_jack_sensor_moves_the_jack_in_closed_loop():
    moved = run(sensors=Sensors(noise_lsb=0.0, offsets_lsb=(0.0, 0.0, 0.0, 20.0)))
    plain = run(sensors=NOISELESS)
    gap = (moved.position - plain.position)[1500:1690].mean() / POSITION.lsb
    assert gap == pytest.approx(-20.0, abs=2.0)


def test_converter_saturates_and_says_so():
    result = run("open", sensors=Sensors(offsets_lsb=(0.0, 2000.0, 0.0, 0.0)))
    samples = result.samples
    assert result.codes[1].max() == 4095
    np.testing.assert_array_equal(samples.saturated[1], result.codes[1] == 4095)
    assert samples.saturated[1].any()
    assert not samples.saturated[[0, 2, 3]].any()
    quality = result.recording("here").quality
    assert quality.saturated["spool"] == samples.saturated[1].sum()


def test_recording_is_perfect_and_complete():
    recording = run(effects=Effects(oil_temperature=60.0)).recording("simulator")
    samples = recording.samples
    assert samples is not None
    assert (recording.source, recording.test_id) == ("simulator", TESTS["closed"].id)
    assert recording.outcome.state is BitState.COMPLETE
    assert recording.environment.oil_temperature == 60.0
    assert recording.environment.supply_pressure == 20.7e6
    assert samples.mode is CommandMode.POSITION
    assert samples.ticks == TESTS["closed"].ticks
    assert samples.period_ns == 1_000_000
    assert (np.diff(samples.host_ns) == samples.period_ns).all()
    assert recording.quality.total("accepted") == 2 * samples.ticks
    assert recording.quality.total("lost") == 0


def test_position_follows_its_command():
    result = run()
    assert abs(result.position[1690] - 10e-3) < 0.5e-3
    assert abs(result.position[2290] + 10e-3) < 0.5e-3


def test_worn_actuators_differ_from_new_ones_by_more_than_noise():
    new = run("open", faults=Faults())
    for fault in (Faults(Kintas=0.3), Faults(FSS=0.3), Faults(FDJ=0.3)):
        worn = run("open", faults=fault)
        gap = (truth(worn) - truth(new)) / LSB
        assert np.sqrt((gap[1:3] ** 2).mean(axis=1)).max() > 3.0


def test_rates_must_agree():
    slow = msgspec.structs.replace(
        ACTUATOR, controller=msgspec.structs.replace(ACTUATOR.controller, rate=500.0)
    )
    with pytest.raises(ConfigurationError, match="500 Hz"):
        simulate(slow, TESTS["open"])
