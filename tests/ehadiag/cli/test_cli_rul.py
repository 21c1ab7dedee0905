"""`ehadiag rul`: remaining life on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_result import Run
from history_cases import an_entry

from ehadiag.history.store import History


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    with History(tmp_path / "fleet", create=True) as history:
        for n in range(1, 13):
            values = (0.02 * n + 0.004 * (n % 3), 0.3, 0.1)
            history.append(an_entry(7, 100.0 * n, values, samples=f"{n}"))
    return tmp_path / "fleet"


def test_a_table_for_people(run: Run, fleet: Path) -> None:
    found = run("rul", "--serial", 7, "--history", fleet)
    assert found.code == 0
    assert "12 of 12 diagnoses say hours" in found.out
    assert "80 %" in found.out
    assert "no number: 12 diagnoses over 1100 hours show no growth" in found.out


def test_an_object_for_programs(run: Run, fleet: Path) -> None:
    (found,) = run("rul", "--serial", 7, "--json", "--history", fleet, "--limit", 0.5).objects
    limit = found["severities"]["Kintas"]["remaining"]["limit"]
    low, high = limit["interval80"]
    assert found["schema"] == "ehadiag.rul/1"
    assert limit["level"] == 0.5
    assert low < limit["median"] < high
    assert found["severities"]["FSS"]["remaining"]["limit"]["median"] is None
    assert found["severities"]["FSS"]["remaining"]["advisory"]["median"] == 0.0
    (again,) = run("rul", "--serial", 7, "--json", "--history", fleet, "--limit", 0.5).objects
    assert again == found


def test_no_number_is_no_failure(run: Run, fleet: Path) -> None:
    found = run("rul", "--serial", 99, "--history", fleet)
    assert found.code == 0
    assert "no number: no diagnoses" in found.out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "--serial"),
        (("--serial", "7"), "no health history"),
        (("--serial", "7", "--history", "none"), "no history none"),
        (("--serial", "7", "--unit", "days"), "days"),
        (("--serial", "7", "--advisory", "0.9"), "levels"),
    ],
)
def test_wrong_usage_is_two(run: Run, options: tuple[str, ...], said: str) -> None:
    found = run("rul", *options)
    assert found.code == 2
    assert said in found.message
