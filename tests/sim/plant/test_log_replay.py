"""Replay: the simulator, driven by a recording's currents, reproduces the recording."""

import numpy as np
import pytest
from msgspec.structs import replace

from ehadiag import bundled_tests, default_actuator
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.simulation import simulate
from ehadiag_tools.main import main
from ehadiag_tools.simulator.units import effects_of, replay, residuals
from firmware_iface.recording import Environment

ACTUATOR = default_actuator()
TESTS = bundled_tests()
FAULTS = Faults(0.6, 0.3, 0.3)
STEP = 5e-6
FLOOR = np.sqrt(0.5**2 + 1 / 12)


@pytest.fixture(scope="module", params=["open", "closed"])
def run(request):
    return simulate(ACTUATOR, TESTS[request.param], FAULTS, seed=4, step=STEP)


def truth(result):
    return np.vstack([result.current, result.spool, result.pressure, result.position])


def test_replay_rebuilds_the_run_exactly(run):
    again = replay(ACTUATOR, run.samples, run.command, FAULTS, Effects(), STEP)
    np.testing.assert_array_equal(again, truth(run))


def test_replay_bridges_lost_rows(run):
    """Two per cent lost, some in a row: the next current tells what the position was."""
    samples = run.samples
    lost = np.random.default_rng(1).random(samples.ticks) < 0.02
    lost[[300, 301, 302]] = True
    channels = ("current", "spool", "pressure", "position")
    holes = {name: np.where(lost, np.nan, getattr(samples, name)) for name in channels}
    holed = replace(samples, **holes)
    again = replay(ACTUATOR, holed, run.command, FAULTS, Effects(), STEP)
    single = lost & ~np.roll(lost, -1)
    assert single.sum() > 50
    gap = (again - truth(run)) / np.array([[24e-3], [1e-3], [50e6], [0.12]]) * 4096
    # Only where two rows in turn are lost may a code be guessed wrong.
    assert np.abs(gap[0]).max() < 30.0
    assert (np.abs(gap[0]) < 0.1).mean() > 0.998
    assert np.sqrt((gap[3] ** 2).mean()) < 0.5


def test_residual_is_the_noise_floor(run):
    gap = residuals(ACTUATOR, run.samples, run.command, FAULTS, Effects(), STEP)
    np.testing.assert_allclose(np.sqrt((gap**2).mean(axis=1)), FLOOR, rtol=0.03)


def test_residual_shows_other_faults(run):
    gap = residuals(ACTUATOR, run.samples, run.command, Faults(0.5, 0.3, 0.4), Effects(), STEP)
    assert np.sqrt((gap[1:3] ** 2).mean(axis=1)).min() > 1.1 * FLOOR


def test_environment_becomes_effects():
    assert effects_of(Environment()) == Effects()
    known = effects_of(Environment(20.1e6, 0.6e6, 85.0))
    assert (known.supply_pressure, known.return_pressure) == (20.1e6, 0.6e6)
    assert known.oil_temperature == 85.0


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        (None, 3, "truth.csv"),
        ("file,test,Kintas,FSS,FDJ\na.blf,open,1.5,0,0\n", 2, "Kintas"),
        ("file,test,Kintas,FSS,FDJ\na.blf,open,0,0,0\n", 3, "a.blf"),
    ],
)
def test_bad_folder_is_one_line_on_stderr(tmp_path, capsys, text, code, words):
    if text is not None:
        (tmp_path / "truth.csv").write_text(text)
    kept = str(tmp_path / "kept.jsonl")
    assert main(["recordings", str(tmp_path), "--jobs", "1", "--resume", kept]) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
