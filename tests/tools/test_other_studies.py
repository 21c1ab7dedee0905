"""Studies of the monitor, of remaining life, of the decoder and of many recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import LOGS

import ehadiag
from ehadiag.core.actuator import default_actuator
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_sim.conditions import Faults
from ehadiag_tools.bench import prepare, tiled
from ehadiag_tools.free_motion.motion import (
    ALL_KINDS,
    Motion,
    MotionCase,
    free_motion,
    garwood,
    perform,
    random_command,
)
from ehadiag_tools.prognosis.units import LAWS, LIMIT, TABLE, read_noise, simulate_unit
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import CommandMode


def test_the_interval_of_a_count_is_garwoods() -> None:
    """Values of Garwood 1936, table 1 (95 %)."""
    assert garwood(0) == (0.0, pytest.approx(3.689, abs=1e-3))
    assert garwood(5) == (pytest.approx(1.623, abs=1e-3), pytest.approx(11.668, abs=1e-3))


@pytest.mark.parametrize("mode", list(CommandMode))
def test_motion_is_that_of_its_seed_and_moves_everything(mode: CommandMode) -> None:
    actuator = default_actuator()
    name = mode.name.lower()
    pieces = [Motion("noise", name, 6.0, (0.0, 0.0, 0.0), seed) for seed in (1, 1, 2)]
    rows = [free_motion(actuator, piece).rows for piece in pieces]
    assert rows[0].shape == (6000, 5)
    np.testing.assert_array_equal(rows[0], rows[1])
    assert (rows[0] != rows[2]).any()
    assert (np.ptp(rows[0], axis=0) > 0.0).all()


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_commands_of_a_kind_stay_in_range_and_move(kind: str) -> None:
    commands = random_command(np.random.default_rng(0), kind, 60_000, 1e3, 10e-3)
    assert np.abs(commands).max() <= 10e-3
    assert np.ptp(commands) > 1e-4


@pytest.mark.slow
def test_a_growth_raises_an_alarm_with_its_name_and_none_before() -> None:
    severities, change = (0.3, 0.3, 0.3), {"change": "FSS", "size": 0.1, "after": 45.0}
    motion = Motion("gusts", "position", 90.0, severities, 1, **change)
    (when, causes), *_ = perform(MotionCase(motion, 10.0))["alarms"]
    assert 45.0 < when < 85.0
    assert causes[0][0] == "FSS"
    assert causes[0][1] == pytest.approx(0.1, abs=0.03)


def test_the_noise_of_diagnoses_is_as_stated_and_can_be_made_again() -> None:
    noise = read_noise()
    for item in noise.values():
        assert len(item.error) > 50
        assert 0.5 < np.sqrt(np.mean((item.error / item["std"]) ** 2)) < 1.5
    truth = dict(zip(FAULT_NAMES, np.random.default_rng(1).uniform(0.0, 0.8, 3), strict=True))
    assert noise["Kintas"].truth[0] == pytest.approx(truth["Kintas"], abs=1e-6)
    found = ehadiag.diagnose(ehadiag.simulate("open", seed=1, faults=Faults(**truth)))
    error = found.faults["Kintas"].value - truth["Kintas"]
    assert noise["Kintas"].error[0] == pytest.approx(error, abs=2e-5), TABLE


@pytest.mark.parametrize("law", LAWS)
def test_a_unit_wears_until_the_limit(law: str) -> None:
    unit = simulate_unit(law, 3, read_noise(), 1)
    assert bool(unit.events) == (unit.name == "Kintas")
    last = unit.entries[-1].severities[0].estimate
    assert last is not None
    assert 0.4 < last < LIMIT + 0.01
    assert unit.born < unit.end
    assert simulate_unit(law, 3, read_noise(), 1).end == unit.end


def test_tiling_keeps_frames_in_order_of_time() -> None:
    table = read_frames(LOGS / "paper-open-2.blf")
    long = tiled(table, 2 * len(table) + 5)
    assert len(long) == 2 * len(table) + 5
    assert (long.time_ns[1:] >= long.time_ns[:-1]).all()
    assert (long.data[len(table) :][:5] == table.data[:5]).all()


def test_recordings_are_simulated_once_and_copied(tmp_path: Path) -> None:
    logs = prepare(tmp_path, 3, seed=1, simulated=1)
    assert [path.name for path in logs] == ["00000.blf", "00001.blf", "00002.blf"]
    assert len({path.read_bytes() for path in logs}) == 1
    before = logs[0].stat().st_mtime_ns
    assert prepare(tmp_path, 3, seed=2, simulated=1) == logs
    assert logs[0].stat().st_mtime_ns == before
