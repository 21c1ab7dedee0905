import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.recording import CommandMode
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import Plant
from ehadiag_tools.free_motion.motion import REACH, STEP, free_motion, random_command
from ehadiag_tools.free_motion.study import Case, garwood, main, watch


def test_the_interval_of_a_count_is_garwoods() -> None:
    """Values of Garwood 1936, table 1 (95 %)."""
    assert garwood(0) == (0.0, pytest.approx(3.689, abs=1e-3))
    assert garwood(5) == (pytest.approx(1.623, abs=1e-3), pytest.approx(11.668, abs=1e-3))


@pytest.mark.parametrize("mode", list(CommandMode))
def test_motion_is_that_of_its_seed_and_stays_within_reach(mode: CommandMode) -> None:
    actuator = default_actuator()
    rows = [free_motion(actuator, Faults(), mode, 0.5, seed) for seed in (1, 1, 2)]
    assert rows[0].shape == (500, 5)
    np.testing.assert_array_equal(rows[0], rows[1])
    assert (rows[0] != rows[2]).any()
    commands = random_command(np.random.default_rng(0), 60_000, 1e3, REACH[mode])
    assert np.abs(commands).max() <= REACH[mode]
    assert np.ptp(commands) > REACH[mode]


@pytest.mark.parametrize("mode", list(CommandMode))
def test_motion_is_that_of_the_plant_tick_by_tick(mode: CommandMode) -> None:
    actuator, faults = default_actuator(), Faults(0.2, 0.4, 0.3)
    rows = free_motion(actuator, faults, mode, 0.4, 7)
    rng = np.random.default_rng((7, int(mode)))
    random_command(rng, len(rows), 1e3, REACH[mode])
    plant = Plant(actuator, faults, seed=int(rng.integers(1 << 31)), step=STEP)
    lsb = np.array([channel.lsb for channel in CHANNELS])
    half = np.array([channel.half for channel in CHANNELS])
    codes = np.array([plant.tick(command, mode) for command in rows[:, 0].tolist()])
    np.testing.assert_allclose(rows[:, 1:], (codes - half) * lsb, rtol=1e-12)
    assert np.ptp(rows[:, 4]) > 0.0


def test_a_minute_tells_its_alarms_and_what_it_cost() -> None:
    grown = Case(CommandMode.CURRENT, (0.3, 0.3, 0.3), (0.3, 0.3, 0.9), 1, 0.5, seconds=3.0)
    found = watch(grown)
    assert found.alarms
    assert 0.0 <= found.resting < 1.0
    assert found.cost_s > 0.0


@pytest.mark.slow
def test_the_study_prints_rates_with_their_intervals(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--motion-hours", "0.03"]) == 0
    printed = capsys.readouterr().out
    assert "both" in printed
    assert "stated 2.00/h" in printed
