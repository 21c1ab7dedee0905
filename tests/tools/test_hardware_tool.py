"""`tools/hardware`: what counts as a wrong class, its table, its exit code."""

from types import SimpleNamespace

import pytest

from ehadiag.assess.verdict import Verdict
from ehadiag_tools.accuracy.hardware import main, row_of, wrong_class


def found(verdict, *intervals):
    estimates = [SimpleNamespace(interval95=interval) for interval in intervals]
    return SimpleNamespace(verdict=verdict, identification=SimpleNamespace(estimates=estimates))


@pytest.mark.parametrize(
    ("verdict", "interval", "truth", "wrong"),
    [
        (Verdict.HEALTHY, (0.0, 0.1), 0.1, False),
        (Verdict.HEALTHY, (0.0, 0.1), 0.26, False),
        (Verdict.HEALTHY, (0.0, 0.1), 0.28, True),
        (Verdict.NOT_TESTED, (0.8, 0.9), 0.1, False),
        (Verdict.FAULT, (0.8, 0.9), 0.5, True),
        (Verdict.FAULT, (0.7, 0.9), 0.5, False),
        (Verdict.FAULT, (0.8, 0.9), 0.74, False),
        (Verdict.DEGRADED, (0.3, 0.4), 0.1, True),
        (Verdict.DEGRADED, (0.2, 0.4), 0.1, False),
        (Verdict.DEGRADED, (0.0, 0.1), 0.1, False),  # for another reason than the faults
        (Verdict.DEGRADED, (0.3, 0.4), 0.9, True),
        (Verdict.DEGRADED, (0.3, 0.4), 0.5, False),
    ],
)
def test_a_class_is_wrong_if_the_interval_excludes_the_truth(verdict, interval, truth, wrong):
    assert wrong_class(found(verdict, interval), [truth, 0.0, 0.0]) is wrong


def test_a_row_counts_verdicts_and_times():
    records = [
        {"verdict": "HEALTHY", "not_allowed": True, "processor_s": 0.1},
        {"verdict": "NOT_TESTED", "not_allowed": False, "processor_s": 0.3},
        {"verdict": "NOT_TESTED", "not_allowed": False, "processor_s": 0.2},
    ]
    cells = ["open", "dead-spool", "1", "0", "0", "2", "1", "0.20", "0.30"]
    assert row_of(records, "open", "dead-spool") == cells


@pytest.mark.slow
def test_the_table_and_the_reasons_are_printed(tmp_path, capsys):
    arguments = ["--test", "open", "--kind", "dead-current", "--cases", "1", "--jobs", "1"]
    assert main([*arguments, "--reasons", "--results", str(tmp_path / "kept.jsonl")]) == 0
    told = capsys.readouterr().out
    assert "| open | dead-current | 0 | 0 | 0 | 1 | 0 |" in told
    assert "servovalve current" in told


def test_an_unknown_number_of_cases_is_an_error(capsys):
    assert main(["--cases", "0"]) != 0
    assert "--cases" in capsys.readouterr().err
