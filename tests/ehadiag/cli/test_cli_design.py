"""`ehadiag design` as a user calls it."""

import json

import pytest

from ehadiag.cli.main import main
from ehadiag.core.stored_test import load_test


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
