"""The command `rul`: what a planner asks."""

from __future__ import annotations

import json
from datetime import datetime
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


@pytest.fixture(autouse=True)
def today(monkeypatch: pytest.MonkeyPatch) -> None:
    set_today(monkeypatch, "2026-01-22")


def set_today(monkeypatch: pytest.MonkeyPatch, day: str) -> None:
    for module in ("prognosis.units", "history.records"):
        name = f"ehadiag.{module}.current_utc_text"
        monkeypatch.setattr(name, lambda: f"{day}T09:00:00.000Z")


def run(capsys: pytest.CaptureFixture[str], place: Path, *words: str) -> tuple[int, str, str]:
    code = main(["rul", *words, "--history", str(place)])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_a_unit_in_a_sentence(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, place, "--unit", "1", "--before", "2000")
    assert code == 0
    assert "First: jack friction reaches its limit in about " in out
    assert " with 80 %." in out
    assert "Chance of a severity at its limit before 2000 hours: " in out


def test_the_next_inspection_is_named_with_its_unit_or_is_a_date(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for text, said in (("1e3", "1e3 hours: "), ("20261231", "20261231: ")):
        code, out, _ = run(capsys, place, "--unit", "1", "--before", text)
        assert code == 0
        assert f"at its limit before {said}" in out


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


def test_workers_say_the_same(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, alone, _ = run(capsys, place, "--all", "--json")
    monkeypatch.setattr("ehadiag.batch.workers.worker_count", lambda _: 2)
    code, out, _ = run(capsys, place, "--all", "--json")
    assert (code, out) == (0, alone)


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
        history.append(an_entry(4, 10.0, severities=(), verdict="NOT_TESTED"))
    _, out, _ = run(capsys, place, "--all", "--before", "400")
    assert "about (date)" not in out  # the only unit with a use a day is at its limit
    worn, still, new, bare = (" ".join(line.split()) for line in out.splitlines()[1:])
    assert worn == "1 reference-31 jack friction about 430 hours at its limit at its limit -"
    assert "no number: 4 diagnoses over 300 hours show no growth" in still
    assert "too few diagnoses" in new
    assert bare.startswith("4 reference-31 - 10 hours too few diagnoses")
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
        (("--unit", "3"), "is of other, reference-31: name its actuator (--actuator)"),
        (("--unit", "3", "--actuator", "x"), "actuator x: serial 3 is of other"),
        (("--unit", "1", "--before", "soon"), "--before soon: need a date"),
        (("--unit", "1", "--before", "2020-01-01"), "--before 2020-01-01: is past"),
        (("--unit", "1", "--before", "20200101"), "--before 20200101: is past"),
        (("--unit", "1", "--before", "1e300"), "--before 1e300: need 0 … 1e+09"),
        (("--all", "--before", "soon"), "--before soon: need a date"),
        (("--unit", "1", "--hours", "100"), "hours 100: were 2000 at the last diagnosis"),
        (("--unit", "1", "--cycles", "5"), "not stated in hours"),
        (("--all", "--actuator", "foo"), "--actuator foo: there is other, reference-31"),
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


def test_times_left_are_counted_from_now(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A forecast that begins at an old test is late on the unsafe side."""

    def asked(*words: str) -> tuple[float, float, float]:
        tree = json.loads(run(capsys, place, "--unit", "1", "--json", *words)[1])
        left = tree["severities"]["FDJ"]["remaining"]["limit"]
        return tree["usage_now"], left["median"], left["chance_past"]

    fresh = asked()
    set_today(monkeypatch, "2026-01-31")
    now, median, _ = asked()
    assert now - fresh[0] == pytest.approx(900.0)
    assert median == pytest.approx(fresh[1] - 900.0)
    assert median == pytest.approx(asked("--hours", str(now))[1])
    _, out, _ = run(capsys, place, "--unit", "1")
    said = "Counted from now, about 3000 hours by 100 hours a day since the test of 2026-01-21."
    assert said in out
    assert "about 3000 hours" in run(capsys, place, "--all")[1]
    told = ("--unit", "1", "--before", "200", "--hours")
    chances = []
    for hours in ("2000", "3000", "4000", "6000", "20000"):
        tree = json.loads(run(capsys, place, *told, hours, "--json")[1])
        chances.append(tree["chance_before"])
    assert chances == sorted(chances)
    assert chances[-1] > 0.98
    _, out, _ = run(capsys, place, *told, "20000")
    assert "First: jack friction may have reached its limit: above 99 %." in out
    assert "is at its limit" not in out


def test_without_a_use_a_day_times_are_from_the_last_test(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, days = tmp_path / "h", {1: "2026-01-{:02}", 2: "2026-01-05T{:02}:00"}
    with History(place, create=True) as history:
        for serial, day in days.items():
            for n in range(1, 16):
                values = (0.1, 0.2, 0.04 * n)
                tested = datetime.fromisoformat(day.format(n)).isoformat() + "Z"
                history.append(an_entry(serial, 10.0 * n, values, tested=tested))
    code, out, _ = run(capsys, place, "--all", "--before", "2026-02-01")
    assert code == 0
    lines = {line[0]: " ".join(line.split()) for line in out.splitlines()[1:]}
    assert "its use a day is not known" in lines["2"]
    assert "150 hours on 2026-01-05" in lines["2"]
    assert " %" in lines["1"].rpartition("about")[2]
    code, out, err = run(capsys, place, "--unit", "2", "--before", "2026-02-01")
    assert code == 2
    assert "the use a day of serial 2 is not known; name hours" in err
    _, out, _ = run(capsys, place, "--unit", "2")
    assert "from the test of 2026-01-05; the usage since then is not known" in out


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"serial": 99}, "serial 99: the history has no diagnosis of it; there are 1, 2"),
        ({"serial": 3}, "serial 3 is of other, reference-31"),
        ({"serial": 1.5}, "no diagnosis of it"),
        ({"actuator": "bogus"}, "actuator bogus: serial 1 is of reference-31"),
        ({"limit": 7.0}, "levels: need"),
        ({"advisory": 0.9}, "levels: need"),
        ({"limit": float("nan")}, "levels: need"),
        ({"seed": -1}, "seed -1: need"),
    ],
)
def test_python_says_in_one_line_what_is_wrong(
    place: Path, wrong: dict[str, float], words: str
) -> None:
    with pytest.raises(ehadiag.ConfigurationError, match=words):
        ehadiag.forecast(str(place), **({"serial": 1} | wrong))  # type: ignore[arg-type]
    ehadiag.History(str(place)).close()


def test_hours_far_beyond_have_no_date(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, place, "--unit", "1", "--hours", "5e6", "--json")
    assert code == 0
    assert json.loads(out)["severities"]["FDJ"]["remaining"]["limit"]["date"] is None


def test_a_unit_at_its_limit_is_before_one_that_may_be_past_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "h"
    with History(place, create=True) as history:
        for n in range(1, 15):
            day = f"2026-01-{n:02}T12:00:00.000Z"
            history.append(an_entry(1, 100.0 * n, (0.1, 0.2, 0.04 * n), tested=day))
            history.append(an_entry(2, 100.0 * n, (0.1, 0.2, 0.06 * n), tested=day))
    set_today(monkeypatch, "2026-03-31")
    trees = [json.loads(line) for line in run(capsys, place, "--all", "--json")[1].splitlines()]
    limits = [tree["severities"]["FDJ"]["remaining"]["limit"] for tree in trees]
    assert [limit["reached"] for limit in limits] == [True, False]
    assert limits[1]["median"] < 0.0
