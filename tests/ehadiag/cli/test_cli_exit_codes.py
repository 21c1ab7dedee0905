"""One order of exit codes, whichever way several things come of a call."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

from ehadiag.cli.batch.job import Job, Reading
from ehadiag.cli.commands import diagnose
from ehadiag.cli.exit_codes import code_of_inputs, worst_code

HEALTHY, CLOSED = (LOGS / name for name in ("healthy-open.blf", "healthy-closed.blf"))
WORST_FIRST = (20, 40, 3, 30, 10, 0)


def test_the_order() -> None:
    for worse, better in itertools.combinations(WORST_FIRST, 2):
        assert worst_code((better, worse)) == worst_code((worse, better)) == worse
    assert worst_code(()) == 0
    assert worst_code((2, 30)) == 3
    assert code_of_inputs([2]) == 2
    assert code_of_inputs([2, 2]) == 3


@pytest.mark.parametrize(("codes", "worst"), [((20, 30), 20), ((30, 3), 3), ((10, 0), 10)])
def test_tests_of_one_recording(
    codes: tuple[int, int], worst: int, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two tests of one recording; their verdicts are put in their place."""
    ended, read = iter(codes), Job.read
    monkeypatch.setattr(
        Job, "read", lambda self, log, _: Reading(read(self, log).recordings * 2, None, 0.0)
    )
    monkeypatch.setattr(diagnose, "finish", lambda *_: next(ended))
    assert run("diagnose", "--merge", "--all", HEALTHY, CLOSED).code == worst
    assert next(ended, None) is None


def test_inputs_that_cannot_be_read(run: Run) -> None:
    Path("x.unknown").write_text("x")
    Path("y.unknown").write_text("y")
    for options in (["--list"], ["--joint"], []):
        alone = run("diagnose", *options, "x.unknown")
        assert alone.code == 2
        assert run("diagnose", *options, "x.unknown", "y.unknown").code == 3
    assert run("report", "x.unknown").code == 2
    assert run("report", "x.unknown", "y.unknown").code == 3
