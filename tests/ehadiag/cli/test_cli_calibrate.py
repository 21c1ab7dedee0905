"""`ehadiag calibrate`: its file, its table, its JSON object, and what it refuses.

`ehadiag design` as a user calls it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from cli_result import REPOSITORY, Run
from places import LOGS

from ehadiag import load_actuator, load_test
from ehadiag.cli.main import main

OPEN, CLOSED = LOGS / "healthy-open.blf", LOGS / "healthy-closed.blf"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--out", "unit.json"], "ends in .toml"),
        (["--out", "unit.toml", "--update"], "--update: needs --actuator"),
    ],
)
def test_wrong_options_are_refused_at_once(run: Run, arguments: list[str], text: str) -> None:
    result = run("calibrate", OPEN, *arguments)
    assert result.code == 2
    assert text in result.err


def test_a_file_that_exists_is_not_written_over(run: Run) -> None:
    Path("unit.toml").write_text("mine")
    assert run("calibrate", OPEN, CLOSED, "--out", "unit.toml").code == 2
    assert Path("unit.toml").read_text() == "mine"


def test_one_recording_is_refused_without_a_file(run: Run) -> None:
    result = run("calibrate", OPEN, "--out", "unit.toml", "--json")
    assert result.code == 30
    (found,) = result.objects
    assert not found["calibrated"]
    assert "not enough" in found["reasons"][0]
    assert not Path("unit.toml").exists()


def test_a_missing_log_is_an_error_of_input(run: Run) -> None:
    assert run("calibrate", "nothing.blf", OPEN, "--out", "unit.toml").code == 3


@pytest.mark.slow
def test_a_unit_is_learned_and_diagnosed_with_its_file(run: Run) -> None:
    result = run("calibrate", OPEN, CLOSED, "--out", "new/unit.toml", "--json")
    assert result.code == 0, result.err
    (found,) = result.objects
    page = (
        (REPOSITORY / "docs" / "reference" / "json.md").read_text().partition("## Calibration")[2]
    )
    assert {key for key in found if not re.search(rf"`{key}`", page)} == set()
    assert abs(found["values"]["hysteresis"]["value"]) < 1e-3
    unit = load_actuator("new/unit.toml")
    assert unit.calibration is not None
    assert [len(item.sha256) for item in unit.calibration.recordings] == [64, 64]
    assert Path("new/unit.png").stat().st_size > 10_000
    keys = (REPOSITORY / "docs" / "reference" / "actuator-file.md").read_text()
    assert all(f"`calibration.{key}`" in keys for key in unit.calibration.__struct_fields__)
    after = run("diagnose", "--actuator", "new/unit.toml", LOGS / "paper-open-4.blf")
    assert after.code == 10
    assert "actuator calibrated on" in after.out
    assert run("diagnose", "--actuator", "new/unit.toml", "--tolerance", 0.05, OPEN).code == 2


def test_the_score_is_a_table(capsys):
    assert main(["design", "--test", "closed"]) == 0
    out = capsys.readouterr().out
    assert "test closed:" in out
    assert "FSS alone, %" in out
    assert "travel 10." in out


def test_a_better_test_is_written_and_told(tmp_path, capsys):
    file = tmp_path / "better.toml"
    code = main(["design", "--out", str(file), "--budget", "25", "--seed", "1", "--json"])
    told = json.loads(capsys.readouterr().out)
    assert code == 0
    assert told["schema"] == "ehadiag.design/1"
    assert told["file"] == str(file)
    assert told["proposed"]["figure"] < told["scored"]["figure"]
    test = load_test(file)
    assert (test.name, test.id) == ("open-designed", 101)
    assert "seed 1" in test.description
    # Not a second time over it.
    assert main(["design", "--out", str(file), "--budget", "13"]) == 3
    assert "exists already" in capsys.readouterr().err


def test_limits_that_nothing_keeps_are_told(tmp_path, capsys):
    file = tmp_path / "none.toml"
    assert main(["design", "--out", str(file), "--budget", "13", "--max-travel", "0.001"]) == 0
    assert "all exceed the limits" in capsys.readouterr().err
    assert not file.exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--id", "300", "--out", "x.toml"], "need 1 … 255"),
        (["--test", "nothing"], "neither a stored test"),
        (["--name", "n" * 65, "--out", "x.toml"], "64 characters"),
    ],
)
def test_wrong_usage_is_one_line(arguments, said, capsys):
    assert main(["design", *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
