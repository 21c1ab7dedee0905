"""Many recordings in one call: names, order, workers, files of results, resumption."""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import shlex
import shutil
import sys
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
from cli_result import Run
from places import LOGS, ROOT
from stored_results import LINES, former_result
from two_actuators import write_log, write_mappings

from ehadiag.batch.result_files import junit_report, result_columns
from ehadiag.result import Result
from ehadiag.terminal.output import BatchSummary, summary_lines, worst_exit_code

HEALTHY = LOGS / "healthy-open.blf"
WORN = LOGS / "paper-open-4.blf"


def valid(tree: dict[str, Any]) -> bool:
    schema = resources.files("ehadiag").joinpath("data/schemas/diagnosis-3.json").read_text()
    jsonschema.Draft202012Validator(json.loads(schema)).validate(tree)
    return True


def without_times(tree: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in tree.items() if key != "timing_s"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings, one of them packed, something broken, and what is no recording."""
    place = tmp_path / "rig"
    (place / "b").mkdir(parents=True)
    shutil.copy(HEALTHY, place / "a.blf")
    (place / "b" / "c.blf.gz").write_bytes(gzip.compress(WORN.read_bytes()))
    (place / "b" / "d.blf").write_bytes(b"no recording")
    (place / "b" / "notes.txt").write_text("nothing")
    (place / ".hidden.blf").write_bytes(b"")
    return place


def test_folder_pattern_and_list_in_order_and_as_often_as_named(
    folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("rig/a.blf\nrig/none.blf\n"))
    result = run("diagnose", "rig", "--json", "--summary", "s.json", "rig/b/*.gz", "-", "no*.blf")
    assert [(item["source"], item["verdict"]) for item in result.objects] == [
        ("rig/a.blf", "HEALTHY"),
        ("rig/b/c.blf.gz", "DEGRADED"),
        ("rig/b/d.blf", None),
        ("rig/b/c.blf.gz", "DEGRADED"),
        ("rig/a.blf", "HEALTHY"),
        ("rig/none.blf", None),
        ("no*.blf", None),
    ]
    assert all(valid(item) for item in result.objects)
    assert result.objects[2]["error"]["log"]["bytes"] == len(b"no recording")
    assert "no*.blf: matches no file" in result.objects[6]["error"]["text"]
    assert result.code == 3
    told = json.loads(Path("s.json").read_text())
    assert told["verdicts"] == {"HEALTHY": 2, "DEGRADED": 2, "FAULT": 0, "NOT_TESTED": 0}
    faults = result.objects[1]["faults"]
    worst = max(faults, key=lambda name: faults[name]["estimate"])
    assert (told["failed"], told["exit_code"], told["worst"][0]["fault"]) == (3, 3, worst)
    assert [item["source"] for item in told["failures"]] == [
        "rig/b/d.blf", "rig/none.blf", "no*.blf",
    ]  # fmt: skip
    assert "7 recordings in" in result.err


def test_an_empty_folder_and_an_empty_list_are_said(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    result = run("diagnose", "empty")
    assert result.code == 3
    assert "folder empty: no recording in it" in result.message
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    result = run("diagnose", "-")
    assert result.code == 2
    assert "no recording named" in result.message


def test_workers_give_what_one_process_gives(folder: Path, run: Run) -> None:
    here = run("diagnose", "--json", "--jobs", 1, "--out", "one", "rig")
    there = run("diagnose", "--json", "--jobs", 2, "--out", "two", "rig")
    assert list(map(without_times, here.objects)) == list(map(without_times, there.objects))
    assert here.code == there.code == 3
    names = sorted(path.name for path in Path("one").iterdir())
    assert names == ["a.json", "a.png", "c.blf.json", "c.blf.png"]
    for path in Path("one").glob("*.png"):
        assert path.read_bytes() == (Path("two") / path.name).read_bytes()


def test_tables_and_report_are_read_by_others(folder: Path, run: Run) -> None:
    import junitparser
    import pandas

    result = run(
        "diagnose", "rig", "--json", "--results", "r.csv", "--results", "r.parquet",
        "--results", "r.jsonl", "--junit", "r.xml",
    )  # fmt: skip
    objects = result.objects
    assert [json.loads(line) for line in Path("r.jsonl").read_text().splitlines()] == objects
    with Path("r.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(result_columns())
    assert [row["verdict"] for row in rows] == ["HEALTHY", "DEGRADED", ""]
    assert float(rows[1]["FSS"]) == objects[1]["faults"]["FSS"]["estimate"]
    table = pandas.read_parquet("r.parquet")
    assert list(table["FSS"][:2]) == [item["faults"]["FSS"]["estimate"] for item in objects[:2]]
    assert table["error"][2] == objects[2]["error"]["text"]
    (suite,) = junitparser.JUnitXml.fromfile("r.xml")
    assert (suite.tests, suite.failures, suite.errors, suite.skipped) == (3, 1, 1, 0)
    assert suite.hostname
    assert datetime.fromisoformat(suite.timestamp) <= datetime.now(UTC).replace(tzinfo=None)


@pytest.mark.parametrize(("kind", "counts"), [("skipped", (0, 1)), ("error", (1, 0))])
def test_not_tested_is_what_the_build_server_is_to_see(tmp_path: Path, kind: str, counts: object):
    import junitparser

    result = Result.from_json(LINES[4])
    with junit_report(str(tmp_path / "r.xml"), kind) as take:
        take(result)
    (suite,) = junitparser.JUnitXml.fromfile(str(tmp_path / "r.xml"))
    assert (suite.errors, suite.skipped) == counts


def test_a_summary_says_how_many_more_there_are():
    summary = BatchSummary(30)
    for number in range(30):
        summary.take(msgspec.structs.replace(Result.from_json(LINES[4]), source=f"{number}.blf"))
    lines = summary_lines(summary.tree(30, 1))
    assert lines[-1] == "and 20 more NOT TESTED"


def test_a_call_goes_on_where_another_stopped(folder: Path, run: Run) -> None:
    first = run("diagnose", "--json", "--resume", "r.jsonl", "rig/a.blf", "rig/b/d.blf")
    whole = Path("r.jsonl").read_bytes()
    Path("r.jsonl").write_bytes(whole + b'{"schema": "ehadiag.dia')  # a power cut
    shutil.copy(HEALTHY, folder / "b" / "d.blf")
    names = ("rig/b/c.blf.gz", "rig/a.blf", "rig/b/d.blf", "rig/a.blf")
    again = run("diagnose", "--json", "--resume", "r.jsonl", "--summary", "s.json", *names)
    assert [item["source"] for item in again.objects] == list(names)
    assert again.objects[1] == again.objects[3] == first.objects[0]
    assert again.objects[2]["verdict"] == "HEALTHY"
    assert json.loads(Path("s.json").read_text())["reused"] == 2
    lines = Path("r.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == again.objects
    assert again.code == 10


def test_results_of_other_options_are_found_anew(folder: Path, run: Run) -> None:
    run("diagnose", "--resume", "r.jsonl", "rig/a.blf")
    result = run("diagnose", "--resume", "r.jsonl", "--seed", 1, "--summary", "s.json", "rig/a.blf")
    assert "1 of an earlier call do not count here" in result.err
    assert "another seed (1)" in result.err
    assert json.loads(Path("s.json").read_text())["reused"] == 0
    (line,) = Path("r.jsonl").read_text().splitlines()
    assert json.loads(line)["configuration"]["seed"] == 1
    before = Path("r.jsonl").read_bytes()
    result = run("diagnose", "--results", "r.jsonl", "rig/a.blf")
    assert result.code == 3
    assert "--resume" in result.err
    assert Path("r.jsonl").read_bytes() == before


DECISIVE = (
    (["--start", 0.5], "another start (--start) (1)"),
    (["--end", 9.0], "another end (--end) (1)"),
    (["--test", "mine.toml"], "another test file (1)"),
    (["--mapping", "bus.toml"], "another mapping (1)"),
    (["--actuator", "unit.toml"], "another actuator (1)"),
    (["--tolerance", 0.05, "--seed", 3], "another seed and actuator (1)"),
    (["--limit", 0.8], "another level of verdicts (1)"),
    (["--time-limit", 99], "another time limit (1)"),
)


def test_whatever_decides_a_result_decides_whether_it_is_taken(run: Run) -> None:
    (tree,) = run("diagnose", "--json", HEALTHY).objects
    log = Path("d.blf")
    log.write_bytes(b"no recording")
    for name, package, source, word in (
        ("mine.toml", "firmware_iface", "tests/open.toml", ("0.7, 1.5", "0.7, 1.6")),
        ("unit.toml", "ehadiag", "actuator.toml", ("MJ  = 150", "MJ  = 151")),
        ("bus.toml", "firmware_iface", "eha_fcc.toml", ("tick_ms = 1.0", "tick_ms = 1.5")),
        ("eha_fcc.dbc", "firmware_iface", "eha_fcc.dbc", ("", "")),
    ):
        text = resources.files(package).joinpath("data", source).read_text()
        Path(name).write_text(text.replace(*word))
    earlier = json.dumps(tree) + "\n"
    for options, why in DECISIVE:
        Path("r.jsonl").write_text(earlier)
        assert why in run("diagnose", "--resume", "r.jsonl", *options, log).err
    Path("r.jsonl").write_text(earlier)
    assert "another" not in run("diagnose", "--resume", "r.jsonl", log).err


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["--results", "r.txt"], "need a name in .jsonl, .csv, .parquet"),
        (["--joint", "--summary", "s.json"], "--joint gives one result"),
        (["--cluster", "tcp://127.0.0.1:1", "--jobs", 2], "a cluster has its own number"),
    ],
)
def test_wrong_options(arguments: list[object], why: str, run: Run) -> None:
    result = run("diagnose", *arguments, HEALTHY)
    assert result.code == 2
    assert why in result.message


def test_a_report_that_cannot_be_written_keeps_the_verdict(run: Run) -> None:
    Path("s.json").mkdir()
    result = run("diagnose", "--json", "--summary", "s.json", HEALTHY)
    assert result.objects[0]["verdict"] == "HEALTHY"
    assert result.code == 3
    assert "summary s.json: Is a directory" in result.message


def test_same_names_of_other_folders_are_not_overwritten(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, log in (("x", HEALTHY), ("y", WORN)):
        (tmp_path / name).mkdir()
        shutil.copy(log, tmp_path / name / "test.blf")
        monkeypatch.chdir(tmp_path / name)
        for _ in range(2):
            run("diagnose", "--out", tmp_path / "out", "--no-picture", "test.blf")
    written = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in written] == ["test-2.json", "test.json"]
    verdicts = [json.loads(path.read_text())["verdict"] for path in written]
    assert verdicts == ["DEGRADED", "HEALTHY"]


def test_the_page_works_as_typed(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the cluster, which has a test of its own."""
    (tmp_path / "recordings").mkdir()
    for log in (HEALTHY, WORN):
        shutil.copy(log, tmp_path / "recordings")
    page = (ROOT / "docs" / "how-to" / "many-recordings.md").read_text()
    commands = re.findall(r"```sh\n(.*)\n```", page)
    assert len(commands) == 5
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"recordings/{WORN.name}\n"))
    for command in commands[:3]:
        _, _, typed = command.rpartition("| ")
        program, *arguments = shlex.split(typed)
        assert program == "ehadiag"
        assert run(*arguments).code == 10
    write_mappings(tmp_path)
    write_log(tmp_path / "both.blf", HEALTHY, WORN)
    assert run(*shlex.split(commands[3])[1:]).code == 10
    names = ("all.jsonl", "all.csv", "report.xml", "summary.json")
    assert all(Path(name).stat().st_size for name in names)
    assert len(Path("all.jsonl").read_text().splitlines()) == 2


def test_the_worst_code() -> None:
    assert worst_exit_code({0, 10, 30, 3, 20}) == 20
    assert worst_exit_code({0, 10, 30, 2}) == 3
    assert worst_exit_code({0, 10, 30}) == 30
    assert worst_exit_code(set()) == 0


def test_a_summary_does_not_grow() -> None:
    summary = BatchSummary(1000)
    for number in range(1000):
        found = former_result({"FSS": number / 1000}, serial=number // 4, verdict="FAULT")
        found |= {"source": f"{number}.blf"}
        if number % 2:
            found["error"] = {"text": "no", "exit_code": 3, "log": None}
        summary.take(Result.from_json(json.dumps(found)))
    tree = summary.tree(20, 1)
    assert len(tree["failures"]) == 100
    assert [item["serial"] for item in tree["worst"]] == list(range(249, 239, -1))
