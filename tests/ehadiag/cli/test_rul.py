"""The command `rul`: what a planner asks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from history_cases import an_entry

import ehadiag
from ehadiag.cli.main import main
from ehadiag.history.store import History


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight units whose jack friction grows, the faster the higher their serial number."""
    path = tmp_path_factory.mktemp("history") / "h"
    with History(path, create=True) as history:
        for serial in range(1, 9):
            rate = 0.018 + 0.002 * serial
            for n in range(1, 21):
                entry = an_entry(
                    serial, 100.0 * n, (0.01 * n, 0.2, min(rate * n, 1.0)), samples=f"{serial}-{n}",
                    tested=f"2026-{1 + n // 28:02}-{1 + n % 28:02}T12:00:00.000Z",
                )  # fmt: skip
                history.append(entry)
        for n in range(1, 4):
            history.append(an_entry(3, 100.0 * n, (0.1 * n, 0.2, 0.3), actuator="other"))
    return path


def run(capsys: pytest.CaptureFixture[str], place: Path, *words: str) -> tuple[int, str, str]:
    code = main(["rul", *words, "--history", str(place)])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_a_unit_in_a_sentence(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, place, "--unit", "1", "--before", "2000")
    assert code == 0
    assert "First: jack friction reaches its limit in about " in out
    assert " with 80 %." in out
    assert "Chance of a severity at its limit before 2000: " in out


def test_all_units_by_urgency(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, place, "--all", "--json", "--before", "500")
    assert code == 0
    trees = [json.loads(line) for line in out.splitlines()]
    assert len(trees) == 9
    serials = [tree["serial"] for tree in trees if tree["actuator"] == "reference-31"]
    assert serials[0] in (5, 6, 7, 8)
    assert serials[-1] == 1
    assert trees[0]["chance_before"] >= trees[-2]["chance_before"]
    code, out, _ = run(capsys, place, "--all")
    assert len(out.splitlines()) == 10
    assert "about (date)" in out
    assert "jack friction" in out


def test_a_table_of_units_says_in_words_what_has_no_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "h"
    with History(place, create=True) as history:
        for n in range(1, 5):
            day = f"2026-01-{5 * n:02}T12:00:00.000Z"
            history.append(an_entry(1, 100.0 * n, (0.1, 0.2, 0.2 * n), tested=day))
            history.append(an_entry(2, 100.0 * n, (0.1, 0.2, 0.3)))
        history.append(an_entry(3, 100.0, (0.1, 0.2, 0.3)))
    _, out, _ = run(capsys, place, "--all", "--before", "400")
    assert "about" not in out  # the only unit with a use a day is at its limit
    worn, still, new = (" ".join(line.split()) for line in out.splitlines()[1:])
    assert worn == "1 reference-31 jack friction at its limit at its limit -"
    assert "no number: 4 diagnoses over 300 hours show no growth" in still
    assert "too few diagnoses" in new
    _, out, _ = run(capsys, place, "--unit", "1", "--before", "400")
    assert "First: jack friction is at its limit." in out
    assert "%." not in out


def test_a_date_is_a_time_at_the_units_own_use(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, place, "--unit", "1", "--before", "2999-01-01", "--json")
    tree = json.loads(out)
    assert code == 0
    assert tree["per_day"] == pytest.approx(100.0, rel=0.1)
    assert tree["chance_before"] > 0.9
    assert tree["severities"]["FDJ"]["remaining"]["limit"]["date"] > "2026"


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("--unit", "99"), "no diagnosis of it; there are 1, 2, 3, 4, 5, 6, 7, 8"),
        (("--unit", "3"), "is of other, reference-31: name one by --actuator"),
        (("--unit", "3", "--actuator", "x"), "--actuator x: serial 3 is of other"),
        (("--unit", "1", "--before", "soon"), "need a date"),
        (("--all", "--hours", "3"), "of one unit"),
    ],
)
def test_what_is_not_known_is_one_line(
    place: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], error: str
) -> None:
    code, _, err = run(capsys, place, *words)
    assert code == 2
    assert error in err
    assert err.count("\n") == 1


def test_an_event_belongs_to_its_actuator(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "h"
    copy.write_bytes(place.read_bytes())
    event = ["history", "event", "new jack", "--replaced", "jack", "--hours", "2000"]
    assert main([*event, "--unit", "3", "--history", str(copy)]) == 2
    named = [*event, "--unit", "3", "--actuator", "other", "--history", str(copy)]
    assert main(named) == 0
    capsys.readouterr()
    found = ehadiag.forecast(copy, 3, actuator="reference-31")
    assert [item.diagnoses for item in found.forecasts] == [20, 20, 20]
    assert main([*event, "--unit", "1", "--history", str(copy)]) == 0
    found = ehadiag.forecast(copy, 1)
    assert [item.diagnoses for item in found.forecasts] == [20, 20, 0]


def test_python_and_command_say_the_same(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, place, "--unit", "2", "--json", "--hours", "2100")
    found = ehadiag.forecast(place, 2, today=ehadiag.Usage(hours=2100.0))
    limit = json.loads(out)["severities"]["FDJ"]["remaining"]["limit"]
    assert limit["median"] == found.forecasts[2].remaining[1].median
