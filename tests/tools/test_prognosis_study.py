"""The study of remaining life: its units, and its tables."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag_tools.prognosis import study
from ehadiag_tools.prognosis.noise import measure, read_table
from ehadiag_tools.prognosis.units import LAWS, LIMIT, make_unit


def test_the_table_is_of_real_diagnoses() -> None:
    for noise in read_table().values():
        assert len(noise.error) > 50
        # Stated deviations are those of the errors.
        assert 0.5 < np.sqrt(np.mean((noise.error / noise.std) ** 2)) < 1.5


def test_a_row_is_a_diagnosis_that_can_be_made_again() -> None:
    (kintas, *_) = measure(1, 1)
    table = read_table()["Kintas"]
    assert table.truth[0] == pytest.approx(float(str(kintas["truth"])))
    assert table.error[0] == pytest.approx(
        float(str(kintas["estimate"])) - table.truth[0], abs=2e-5
    )


@pytest.mark.parametrize("law", LAWS)
def test_a_unit_wears_until_the_limit(law: str) -> None:
    unit = make_unit(law, 3, read_table(), 1)
    assert bool(unit.events) == (unit.name == "Kintas")
    last = unit.entries[-1].severities[0].estimate
    assert last is not None
    assert 0.6 < last < LIMIT + 0.01
    assert unit.born < unit.end
    assert make_unit(law, 3, read_table(), 1).end == unit.end


@pytest.mark.slow
def test_the_study_prints_its_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert study.main(["--units", "6"]) == 0
    out = capsys.readouterr().out
    assert "| all | ehadiag | 100.0% |" in out
    assert "| straight line |" in out
    assert "| steady | straight line | " in out.partition("coverage off 80 %")[2]
