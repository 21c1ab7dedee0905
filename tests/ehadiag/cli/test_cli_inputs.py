"""Which files a folder stands for, and what is said of options that have nothing to do."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

from ehadiag.cli.batch.inputs import expand

HEALTHY = LOGS / "healthy-open.blf"


def names(folder: str = "rig") -> list[str]:
    return [item.name for item in expand([folder])]


@pytest.fixture
def rig(run: Run) -> Path:
    place = Path("rig")
    place.mkdir()
    shutil.copy(HEALTHY, place / "a.blf")
    return place


def test_a_table_of_results_is_no_recording(rig: Path, run: Run) -> None:
    """The same call each night, its tables beside the recordings."""
    pytest.importorskip("pyarrow")
    call = ("diagnose", "rig", "--results", "rig/all.csv", "--results", "rig/all.parquet", "--json")
    assert run(*call).code == 0
    again = run(*call)
    assert again.code == 0
    assert [item["source"] for item in again.objects] == ["rig/a.blf"]
    assert again.message == (
        "ehadiag: folder rig: a table of results is no recording: rig/all.csv and 1 more"
    )
    assert len(Path("rig/all.csv").read_text().splitlines()) == 2


def test_a_recording_in_a_folder_is_not_written_over(rig: Path, run: Run) -> None:
    (rig / "run.csv").write_text("time,current\n0,0\n")
    result = run("diagnose", "rig", "--results", "rig/run.csv")
    assert result.code == 2
    assert "--results rig/run.csv: is the log rig/run.csv as well" in result.message


def test_decoded_signals_of_all_kinds_are_found(rig: Path, run: Run) -> None:
    for suffix in ("csv", "mf4", "parquet", "parquet.gz", "txt"):
        (rig / f"d.{suffix}").write_bytes(b"x")
    assert names() == [f"rig/{n}" for n in ("a.blf", "d.csv", "d.mf4", "d.parquet", "d.parquet.gz")]


def test_hidden_folders_are_left_out_unless_named(rig: Path, run: Run) -> None:
    for place in (rig / ".git" / "x", rig / "b"):
        place.mkdir(parents=True)
        shutil.copy(HEALTHY, place / "c.blf")
    assert names() == ["rig/a.blf", "rig/b/c.blf"]
    assert names("rig/.git") == ["rig/.git/x/c.blf"]


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_links_to_folders_are_said(rig: Path, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    (rig / "real").mkdir()
    (rig / "there").symlink_to("real")
    (rig / "b.blf").symlink_to("a.blf")
    assert names() == ["rig/a.blf", "rig/b.blf"]
    said = capsys.readouterr().err
    assert "a link to a folder is not followed, name the folder to read it: rig/there" in said


def test_no_history_is_made_where_nothing_is_kept(run: Run) -> None:
    assert run("diagnose", "none.blf", "--history", "x.sqlite").code == 3
    assert not Path("x.sqlite").exists()
    result = run("diagnose", HEALTHY, "--history", "none/x.sqlite")
    assert result.code == 3
    assert "history none/x.sqlite: cannot be opened: no such folder" in result.message
    assert run("diagnose", HEALTHY, "--history", "x.sqlite").code == 0
    assert len(run("history", "list", "--json", "--history", "x.sqlite").objects) == 1


def test_a_list_says_what_it_has_no_use_for(run: Run) -> None:
    result = run("diagnose", "--list", "--joint", "--history", "x", "--hours", 3, HEALTHY)
    assert result.code == 0
    assert result.message == (
        "ehadiag: --list diagnoses none, and has no use for --joint, --history, --hours"
    )
    assert run("diagnose", "--list", HEALTHY).err == ""


def test_more_results_may_follow_the_options_of_a_report(run: Run) -> None:
    run("diagnose", HEALTHY, "--out", ".", "--no-picture", "--json")
    shutil.copy("healthy-open.json", "b.json")
    result = run("report", "healthy-open.json", "--advisory", 0.1, "b.json")
    assert result.code == 0, result.err
    assert Path("healthy-open.html").exists()
    assert json.loads(Path("b.json").read_text())
    assert Path("b.html").exists()
    assert "unrecognized arguments: x" in run("tests", "x").err


def test_a_template_is_not_written_into_a_file(run: Run) -> None:
    Path("A.toml").write_text("mine")
    result = run("init", "actuator", "A.toml")
    assert result.code == 3
    assert result.message == (
        "ehadiag: A.toml: is no folder; name the one to write actuator.toml into"
    )
    assert Path("A.toml").read_text() == "mine"
