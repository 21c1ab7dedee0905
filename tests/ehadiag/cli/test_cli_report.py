"""`--report`, and `ehadiag report`. `ehadiag rul`: remaining life on the command line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from cli_result import Run
from history_cases import an_entry
from places import LOGS

import ehadiag
from ehadiag.history.store import History
from ehadiag.terminal import output

HEALTHY = LOGS / "healthy-open.blf"
WORN = LOGS / "paper-open-4.blf"


@pytest.fixture(scope="module")
def result() -> str:
    """The JSON of a diagnosis."""
    return ehadiag.diagnose(HEALTHY).to_json()


def test_a_page_is_written_beside_result_and_picture(run: Run) -> None:
    result = run("diagnose", "--report", "--out", "o", WORN, "--advisory", "0.3")
    assert result.code == 10
    assert "o/paper-open-4.html" in result.err
    page = Path("o/paper-open-4.html").read_text()
    assert "DEGRADED" in page
    assert "advisory level 0.3" in page


@pytest.mark.usefixtures("undrawn")
def test_an_index_lists_the_results_worst_first_with_links(run: Run) -> None:
    run("diagnose", "--no-picture", "--out", "o", HEALTHY, WORN)
    names = ("o/healthy-open.json", "o/paper-open-4.json")
    assert run("report", *names, "--index", "all.html").code == 0
    page = Path("all.html").read_text()
    assert page.index(">DEGRADED<") < page.index(">HEALTHY<")
    assert 'href="o/paper-open-4.html"' in page
    assert "60\N{NO-BREAK SPACE}%" in page
    assert "Plan to" in page
    assert "2 results, worst first: " in page
    assert page.count('href="o/') == 2  # one link a row
    assert ">time left<" not in page  # without a history there is none
    twice = run("report", *names, "--index", "o/healthy-open.html")
    assert (twice.code, "name another file" in twice.message) == (2, True)


@pytest.mark.usefixtures("undrawn")
def test_many_reports_show_how_many_are_done(
    run: Run, monkeypatch: pytest.MonkeyPatch, result: str
) -> None:
    counted = []

    @contextmanager
    def bar(total: int, what: str) -> Iterator[Callable[[], None]]:
        yield lambda: counted.append((total, what))

    monkeypatch.setattr("ehadiag.cli.diagnose_commands.counting_bar", bar)
    Path("r.json").write_text(result)
    run("report", "r.json", "none.json", "nor-this.json")
    assert counted == 3 * [(3, "report")]


def test_one_of_them_is_no_plural(monkeypatch: pytest.MonkeyPatch) -> None:
    stages = []
    monkeypatch.setattr(output._ProgressLines, "update", lambda _, stage, __: stages.append(stage))
    for total in (1, 2):
        with output.counting_bar(total, "report") as count:
            count()
    assert stages == ["1 report:", "2 reports:"]


def test_a_trend_where_there_is_a_history(run: Run) -> None:
    options = ("--no-picture", "--out", "o", "--history", "h", "--hours", 5)
    run("diagnose", "--report", *options, HEALTHY)
    page = Path("o/healthy-open.html").read_text()
    assert "Trend of this unit" in page
    assert "no number: 1 diagnosis of the unit, needs 3" in page


def test_a_page_from_a_stored_result(run: Run) -> None:
    shutil.copy(WORN, "w.blf")
    run("diagnose", "--no-picture", "--out", "o", "w.blf")
    assert not Path("o/w.html").exists()
    assert run("report", "o/w.json").code == 0
    assert "Measured and modelled" in Path("o/w.html").read_text()
    Path("w.blf").unlink()
    gone = run("report", "o/w.json")
    assert gone.code == 0
    assert "w.blf is not at hand" in gone.err
    page = Path("o/w.html").read_text()
    assert "No responses are drawn" in page
    assert "0.59988" in page


def test_another_recording_under_the_same_name_is_not_drawn(run: Run) -> None:
    shutil.copy(WORN, "w.blf")
    run("diagnose", "--no-picture", "--out", "o", "w.blf")
    shutil.copy(HEALTHY, "w.blf")
    assert "diagnosed otherwise now" in run("report", "o/w.json").err
    assert "No responses are drawn" in Path("o/w.html").read_text()


@pytest.mark.usefixtures("undrawn")
def test_an_old_page_does_not_stay_beside_a_new_result(run: Run) -> None:
    run("diagnose", "--report", "--no-picture", "--out", "o", HEALTHY)
    assert Path("o/healthy-open.html").exists()
    run("diagnose", "--no-picture", "--out", "o", HEALTHY)
    assert not Path("o/healthy-open.html").exists()


@pytest.mark.parametrize(
    "content", ["", "x", "[]", "{}", '{"schema": "ehadiag.diagnosis/1"}', "[" * 100_000,
                '{"schema": "ehadiag.diagnosis/1", "faults": {"a": 1}}'],
)  # fmt: skip
def test_what_is_no_result_is_refused(run: Run, content: str) -> None:
    Path("r.json").write_text(content)
    found = run("report", "r.json")
    assert found.code == 2
    assert "none of ehadiag's JSON results" in found.message
    assert not Path("r.html").exists()


def test_the_page_goes_by_the_levels_of_its_result(run: Run) -> None:
    assert run("diagnose", "--no-picture", "--out", "o", "--limit", 0.5, WORN).code == 20
    run("report", "o/paper-open-4.json")
    page = Path("o/paper-open-4.html").read_text()
    assert "limit 0.5" in page
    assert "limit 0.75" not in page


def test_other_actuator_data_draw_no_responses(run: Run) -> None:
    run("diagnose", "--no-picture", "--out", "o", HEALTHY)
    run("init", "actuator", ".")
    text = Path("actuator.toml").read_text()
    Path("other.toml").write_text(text.replace("511.6", "511.7"))
    found = run("report", "o/healthy-open.json", "--actuator", "other.toml")
    assert found.code == 0
    assert "it goes by other actuator data" in found.err
    assert "No responses are drawn" in Path("o/healthy-open.html").read_text()


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree["faults"]["FSS"].update(estimate="much"),
        lambda tree: tree["faults"]["FSS"].update(flags=5),
        lambda tree: tree.update(solver="cga"),
        lambda tree: tree["solver"].update(seed=-5),
        lambda tree: tree["solver"].update(seed=1 << 80),
    ],
)
def test_a_result_with_keys_of_the_wrong_kind_ends_in_one_line(
    run: Run, change: Callable[[dict[str, Any]], None], result: str
) -> None:
    tree = json.loads(result)
    change(tree)
    Path("r.json").write_text(json.dumps(tree))
    found = run("report", "r.json")
    assert found.code == 2
    assert "none of ehadiag's JSON results" in found.err


def test_a_page_needs_a_folder(run: Run) -> None:
    found = run("diagnose", "--report", HEALTHY)
    assert found.code == 2
    assert "--out" in found.message


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    with History(tmp_path / "fleet", create=True) as history:
        for n in range(1, 13):
            values = (0.02 * n + 0.004 * (n % 3), 0.3, 0.1)
            history.append(an_entry(7, 100.0 * n, values, samples=f"{n}"))
    return tmp_path / "fleet"


def test_a_table_for_people(run: Run, fleet: Path) -> None:
    found = run("rul", "--unit", 7, "--history", fleet)
    assert found.code == 0
    assert "12 of 12 diagnoses say hours" in found.out
    assert "80 %" in found.out
    assert "no number: 12 diagnoses over 1100 hours show no growth" in found.out


def test_an_object_for_programs(run: Run, fleet: Path) -> None:
    (found,) = run("rul", "--unit", 7, "--json", "--history", fleet, "--limit", 0.5).objects
    limit = found["severities"]["Kintas"]["remaining"]["limit"]
    low, high = limit["interval80"]
    assert found["schema"] == "ehadiag.rul/2"
    assert limit["level"] == 0.5
    assert low < limit["median"] < high
    assert found["severities"]["FSS"]["remaining"]["limit"]["median"] is None
    assert found["severities"]["FSS"]["remaining"]["advisory"]["median"] == 0.0
    (again,) = run("rul", "--unit", 7, "--json", "--history", fleet, "--limit", 0.5).objects
    assert again == found


def test_no_number_is_no_failure(run: Run, fleet: Path) -> None:
    with History(fleet) as history:
        history.append(an_entry(8, 100.0))
    found = run("rul", "--unit", 8, "--history", fleet)
    assert found.code == 0
    assert "no number: 1 diagnosis of the unit" in found.out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "--unit"),
        (("--unit", "7"), "no health history"),
        (("--unit", "7", "--history", "none"), "no history none"),
        (("--unit", "7", "--in", "weeks"), "weeks"),
        (("--unit", "hours"), "--in hours"),
        (("--serial", "7"), "--unit N for the unit"),
        (("--unit", "7", "--advisory", "0.9"), "levels"),
    ],
)
def test_wrong_usage_is_two(run: Run, options: tuple[str, ...], said: str) -> None:
    found = run("rul", *options)
    assert found.code == 2
    assert said in found.message
