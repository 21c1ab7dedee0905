import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import CommandMode
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.free_motion.motion import REACH, free_motion, random_command
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
