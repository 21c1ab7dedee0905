"""No call writes over what it reads, over the health history, or over what it wrote itself."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

HEALTHY, WORN = LOGS / "healthy-open.blf", LOGS / "paper-open-1.blf"
OPEN, CLOSED = LOGS / "healthy-open.blf", LOGS / "healthy-closed.blf"
links = pytest.mark.skipif(os.name != "posix", reason="links of POSIX")


@pytest.fixture
def place(run: Run, tmp_path: Path) -> Path:
    """Files that a call may read, with content that must stay."""
    shutil.copy(HEALTHY, tmp_path / "v.blf")
    (tmp_path / "rec.csv").write_text("time,current,spool,pressure,position\n0,0,0,0,0\n")
    assert run("init", "actuator").code == 0
    assert run("init", "mapping").code == 0
    assert run("init", "defaults").code == 0
    assert run("history", "init", "--history", "h.sqlite").code == 0
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("v.blf", "--summary", "v.blf"), "--summary v.blf: is the log v.blf as well"),
        (("v.blf", "--junit", "./v.blf"), "--junit ./v.blf: is the log v.blf as well"),
        (("rec.csv", "--results", "rec.csv"), "--results rec.csv: is the log rec.csv as well"),
        (("v.blf", "--resume", "v.blf"), "--resume v.blf: is the log v.blf as well"),
        (
            ("v.blf", "--results", "q.csv", "--junit", "q.csv"),
            "--junit q.csv: is --results q.csv as well",
        ),
        (
            ("v.blf", "--results", "q.csv", "--results", "x/../q.csv"),
            "--results x/../q.csv: is --results q.csv as well",
        ),
        (
            ("v.blf", "--actuator", "actuator.toml", "--summary", "actuator.toml"),
            "--summary actuator.toml: is --actuator actuator.toml as well",
        ),
        (
            ("v.blf", "--mapping", "mapping.toml", "--junit", "eha_fcc.dbc"),
            "--junit eha_fcc.dbc: is the DBC eha_fcc.dbc as well",
        ),
        (
            ("v.blf", "--summary", "ehadiag.toml"),
            "--summary ehadiag.toml: is the defaults file ehadiag.toml as well",
        ),
        (
            ("v.blf", "--history", "h.sqlite", "--junit", "h.sqlite"),
            "--junit h.sqlite: is the health history h.sqlite as well",
        ),
        (
            ("v.blf", "--history", "new.sqlite", "--summary", "new.sqlite-wal"),
            "--summary new.sqlite-wal: is the health history new.sqlite-wal as well",
        ),
        (("v.blf", "--history", "v.blf"), "the health history v.blf: is the log v.blf as well"),
    ],
)
def test_diagnose_writes_over_nothing_it_uses(
    arguments: tuple[str, ...], said: str, place: Path, run: Run
) -> None:
    before = contents(place)
    (place / "x").mkdir()
    result = run("diagnose", *arguments)
    assert result.code == 2
    assert result.message == f"ehadiag: {said}; name another file"
    assert contents(place) == before


@links
def test_another_name_of_a_file_is_the_file(place: Path, run: Run) -> None:
    (place / "soft").symlink_to("v.blf")
    os.link(place / "v.blf", place / "hard")
    for name in ("soft", "hard"):
        result = run("diagnose", "v.blf", "--summary", name)
        assert result.code == 2
        assert f"--summary {name}: is the log v.blf as well" in result.message
    assert (place / "v.blf").read_bytes() == HEALTHY.read_bytes()


def test_the_history_of_the_environment_is_kept_too(
    place: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EHADIAG_HISTORY", "h.sqlite")
    assert run("diagnose", "v.blf", "--summary", "h.sqlite").code == 2
    assert run("diagnose", "v.blf", "--no-history", "--summary", "h.sqlite").code == 2
    with contextlib.closing(sqlite3.connect(place / "h.sqlite")) as history:
        history.execute("SELECT * FROM diagnosis").fetchall()


@pytest.mark.parametrize(
    ("verb", "name"), [(("export",), "h.csv"), (("plot", "--unit", 1), "h.png")]
)
def test_exports_of_a_history_do_not_replace_it(
    verb: tuple[object, ...], name: str, place: Path, run: Run
) -> None:
    run("diagnose", "v.blf", "--history", name)
    result = run("history", *verb, "--history", name, "--out", name)
    assert result.code == 2
    assert f"--out {name}: is the health history {name} as well" in result.message
    assert len(run("history", "list", "--json", "--history", name).objects) == 1


@pytest.mark.usefixtures("undrawn")
def test_a_report_replaces_neither_a_result_nor_another_report(place: Path, run: Run) -> None:
    run("diagnose", "v.blf", "--json", "--out", ".", "--no-picture")
    shutil.copy("v.json", "r.html")
    shutil.copy("v.json", "v.txt")
    result = run("report", "r.html")
    assert result.code == 2
    assert "report r.html: is the result r.html as well" in result.message
    assert json.loads(Path("r.html").read_text())["verdict"] == "HEALTHY"
    assert "report v.html: is report v.html as well" in run("report", "v.json", "v.txt").message
    assert run("report", "v.json", "v.json").code == 0


@pytest.mark.parametrize(
    ("name", "said"), [("mapping.toml", "--mapping mapping.toml"), ("eha_fcc.dbc", "the DBC")]
)
def test_an_export_of_the_services_does_not_replace_what_it_reads(
    name: str, said: str, place: Path, run: Run
) -> None:
    before = contents(place)
    result = run("export", "--pdx", name, "--mapping", "mapping.toml")
    assert result.code == 2
    assert f"--pdx {name}: is {said}" in result.message
    assert contents(place) == before


@pytest.mark.parametrize("what", [("--target", "cortex-m4"), ("--fmu",)])
def test_what_knows_no_bus_takes_no_mapping(what: tuple[str, ...], place: Path, run: Run) -> None:
    for option in (("--mapping", "mapping.toml"), ("--dbc", "x"), ("--id-offset", 1), ("--xcp",)):
        result = run("export", *what, "--out", "o", *option)
        assert result.code == 2
        assert result.message.startswith(f"ehadiag: {option[0]}: needs --a2l or --pdx")
    assert not (place / "o").exists()


def test_a_live_test_records_beside_its_history(place: Path, run: Run) -> None:
    result = run(
        "bit", "--simulate", "--fast", "--test", "open", "--record", "n.blf", "--history", "n.blf"
    )
    assert result.code == 2
    assert not Path("n.blf").exists()


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("--log", "rec.csv", "--log-file", "rec.csv"), "the log rec.csv"),
        (("-i", "virtual", "--from", "r.json", "--log-file", "r.json"), "--from r.json"),
        (
            ("-i", "virtual", "--history", "h.sqlite", "--log-file", "h.sqlite"),
            "the health history h.sqlite",
        ),
    ],
)
def test_alarms_are_appended_to_nothing_that_is_read(
    arguments: tuple[str, ...], what: str, place: Path, run: Run
) -> None:
    (place / "r.json").write_text("{}")
    before = contents(place)
    result = run("monitor", *arguments)
    assert result.code == 2
    assert f": is {what} as well" in result.message
    assert contents(place) == before


@pytest.mark.usefixtures("undrawn")
def test_a_result_leaves_other_files_of_its_folder_alone(place: Path, run: Run) -> None:
    """The page of somebody else, and the summary that the same call writes there."""
    shutil.copy(WORN, "w.blf")
    Path("v.html").write_text("somebody's page")
    result = run(
        "diagnose", "v.blf", "w.blf", "--out", ".", "--report", "--no-picture",
        "--summary", "w.json",
    )  # fmt: skip
    assert Path("v.html").read_text() == "somebody's page"
    assert "wrote v-2.json, v-2.html" in result.err
    assert "wrote w-2.json, w-2.html" in result.err
    assert json.loads(Path("w.json").read_text())["schema"] == "ehadiag.summary/1"


def test_calibration_is_refused_before_the_work(place: Path, run: Run) -> None:
    (place / "unit.png").write_bytes(b"somebody's picture")
    result = run("calibrate", OPEN, CLOSED, "--out", "unit.toml")
    assert result.code == 2
    assert "--out unit.toml: unit.png exists" in result.message
    assert (place / "unit.png").read_bytes() == b"somebody's picture"


@links
def test_a_folder_that_is_a_link_is_refused_before_the_work(place: Path, run: Run) -> None:
    (place / "there").mkdir()
    (place / "link").symlink_to("there")
    # Logs that cannot be read would be said first, did the work come first.
    result = run("calibrate", "none.blf", "none2.blf", "--out", "link/x.toml")
    assert result.code == 3
    assert "output folder link: is a link" in result.message


def test_a_design_is_refused_before_the_work(place: Path, run: Run) -> None:
    result = run("design", "--out", "none/x.toml")
    assert result.code == 3
    assert "none/x.toml: there is no folder none" in result.message
