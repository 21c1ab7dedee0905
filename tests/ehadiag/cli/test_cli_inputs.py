"""Which files a folder stands for, and what is said of options that have nothing to do.

Inputs that rigs have and that must be taken, or refused in one line that helps. Slips of a rig's
engineer, in units, columns and names: one line says which it is.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
from importlib import resources
from pathlib import Path

import numpy as np
import pandas
import pytest
from cli_result import Run
from places import LOGS

from ehadiag.cli.command_parser import CommandParser
from ehadiag.cli.diagnose_commands import expand_logs
from ehadiag.cli.main import parse_arguments, parser_and_commands
from ehadiag.terminal import output
from firmware_iface.signals.recordings import read_recording

HEALTHY = LOGS / "healthy-open.blf"


def names(folder: str = "rig") -> list[str]:
    return [item.name for item in expand_logs([folder], print)]


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
    assert "a link to a folder is not followed, name the folder to read it: rig/there" in (
        capsys.readouterr().out
    )


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


@pytest.mark.usefixtures("undrawn")
def test_more_results_may_follow_the_options_of_a_report(run: Run) -> None:
    run("diagnose", HEALTHY, "--out", ".", "--no-picture", "--json")
    shutil.copy("healthy-open.json", "b.json")
    result = run("report", "healthy-open.json", "--advisory", 0.1, "b.json")
    assert result.code == 0, result.err
    assert Path("healthy-open.html").exists()
    assert json.loads(Path("b.json").read_text())
    assert Path("b.html").exists()
    assert "unrecognized arguments: x; see ehadiag tests --help" in run("tests", "x").err
    assert "no command 'diagnos', did you mean diagnose?" in run("diagnos").err


def test_a_template_is_not_written_into_a_file(run: Run) -> None:
    Path("A.toml").write_text("mine")
    result = run("init", "actuator", "A.toml")
    assert result.code == 3
    assert result.message == (
        "ehadiag: A.toml: is no folder; name the one to write actuator.toml into"
    )
    assert Path("A.toml").read_text() == "mine"


BUNDLED = resources.files("firmware_iface").joinpath("data")


@pytest.fixture
def dbc() -> str:
    return BUNDLED.joinpath("eha_fcc.dbc").read_text()


def test_a_dbc_of_the_default_names_needs_no_mapping(run: Run, dbc: str) -> None:
    Path("rig.dbc").write_text(dbc)
    (found,) = run("diagnose", "--json", "--dbc", "rig.dbc", HEALTHY).objects
    assert found["verdict"] == "HEALTHY"
    assert found["configuration"]["mapping"]["name"] == "rig.dbc"


def test_a_dbc_of_other_names_asks_for_a_mapping(run: Run, dbc: str) -> None:
    Path("rig.dbc").write_text(dbc.replace("FCC_", "RIG_").replace("ACT_", "RIG_"))
    Path("other.dbc").write_text('VERSION ""\nBU_: A\nBO_ 1 Other: 8 A\n')
    result = run("diagnose", "--dbc", "other.dbc", HEALTHY)
    assert result.code == 2
    assert "names another bus than the default mapping" in result.message
    assert "--mapping" in result.message


def test_a_dbc_outside_the_mappings_folder_is_named_by_the_user(run: Run, dbc: str) -> None:
    folder = Path("mappings")
    folder.mkdir()
    Path("rig.dbc").write_text(dbc)
    text = BUNDLED.joinpath("eha_fcc.toml").read_text()
    (folder / "rig.toml").write_text(text.replace('"eha_fcc.dbc"', '"../rig.dbc"'))
    result = run("diagnose", "--mapping", "mappings/rig.toml", HEALTHY)
    assert result.code == 2
    assert "name a DBC elsewhere by --dbc" in result.message
    run_there = ("diagnose", "--json", "--mapping", "mappings/rig.toml", "--dbc")
    for name in ("rig.dbc", "mappings/../rig.dbc"):
        (found,) = run(*run_there, name, HEALTHY).objects
        assert found["verdict"] == "HEALTHY"


@pytest.mark.parametrize(
    "text",
    [
        "time_s,current_mA,spool_mm\n0.000,1.0,0.2\n0.001,1.1,0.2\n",
        "time;current\n1;2\n",
        "a,b\n1\n",
        "1,2,3,4,5,6,7,8,9\n",
    ],
)
def test_decoded_signals_without_names_ask_for_them(text: str, run: Run) -> None:
    Path("daq.csv").write_text(text)
    result = run("diagnose", "daq.csv")
    assert result.code == 2
    assert "log daq.csv: no column for channels." in result.message
    assert "--column ROLE=NAME:UNIT" in result.message


def test_options_may_follow_logs(run: Run, tmp_path: Path) -> None:
    shutil.copy(HEALTHY, tmp_path / "a.blf")
    result = run("diagnose", "a.blf", "--json", "--seed", 1, "a.blf", "--no-picture", "a.blf")
    assert [item["configuration"]["seed"] for item in result.objects] == [1, 1, 1]
    result = run("diagnose", "a.blf", "--sed", 1)
    assert result.code == 2
    assert "unrecognized arguments: --sed (did you mean --seed?)" in result.message
    result = run("tests", "more")
    assert result.code == 2


LOG = LOGS / "healthy-open.blf"


@pytest.fixture(scope="module")
def signals() -> pandas.DataFrame:
    """Decoded signals of a healthy test, in mA, mm and MPa."""
    samples = read_recording(LOG).samples
    assert samples is not None
    return pandas.DataFrame(
        {
            "time": np.arange(samples.ticks) * 1e-3,
            "current": samples.current * 1e3,
            "spool": samples.spool * 1e3,
            "pressure": samples.pressure * 1e-6,
            "position": samples.position * 1e3,
            "current_command": samples.command * 1e3,
        }
    )


UNITS = {"current": "mA", "spool": "mm", "pressure": "MPa", "position": "mm"}


def written(table: pandas.DataFrame, **units: str) -> str:
    """A CSV with these units in its header."""
    names = {name: f"{name} [{unit}]" for name, unit in units.items()}
    table.rename(columns=names).to_csv("rig.csv", index=False)
    return "rig.csv"


def test_values_without_their_unit_are_named(run: Run, signals: pandas.DataFrame) -> None:
    found = run("diagnose", "--json", written(signals, pressure="MPa")).objects[0]
    assert found["verdict"] == "NOT_TESTED"
    words = [reason.split(" reads ")[0] for reason in found["reasons"]]
    assert words == ["current", "spool", "position"]
    assert all(reason.endswith("check unit and scale of its signal") for reason in found["reasons"])


def test_the_right_units_have_a_verdict(run: Run, signals: pandas.DataFrame) -> None:
    log = written(signals, current_command="mA", **UNITS)
    assert run("diagnose", log).code == 0


@pytest.mark.parametrize(
    ("factor", "named"), [(1e6, ["pressure"]), (145.0, ["pressure"]), (5.0, [])]
)
def test_a_unit_that_is_wrong_is_named(
    run: Run, signals: pandas.DataFrame, factor: float, named: list[str]
) -> None:
    wrong = signals.assign(pressure=signals.pressure * factor)
    log = written(wrong, current_command="mA", **UNITS)
    (found,) = run("diagnose", "--json", "--nuisances", "none", log).objects
    assert found["verdict"] == "NOT_TESTED"
    reads = [reason for reason in found["reasons"] if " reads " in reason]
    assert [reason.split()[0] for reason in reads] == named


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"time,spool,spool\n0,1,2\n", "several columns are named 'spool': rename all but one"),
        ("time,spool\n0,0\n".encode("utf-16"), "is in UTF-16: save it as UTF-8"),
        (
            b"time,spool,pressure,position\n" + b"7,0,0,0\n" * 20,
            "channels.spool has 20 numbers, but only 1 different time stamps; at least 10",
        ),
    ],
)
def test_tables_that_cannot_be_read_say_why(run: Run, content: bytes, said: str) -> None:
    Path("rig.csv").write_bytes(content)
    found = run("diagnose", "rig.csv")
    assert (found.code, found.err.count("\n")) == (3, 1)
    assert said in found.err


def test_one_recording_twice_is_no_joint_estimate(run: Run) -> None:
    found = run("diagnose", "--json", "--joint", LOG, LOG)
    assert found.code == 30
    assert "name each test once" in found.objects[0]["reasons"][0]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("report", "."), 2, "result .: is a folder, name a file in it"),
        (("diagnose", LOG, "--out", "file"), 3, "output folder file: is a file; name a folder"),
        (("monitor", "--log", LOG, "--record", "file"), 3, "--record file: is a file"),
        (("monitor", "--log", LOG, "--on-alarm", "/no/such/program"), 2, "no such program"),
        (("monitor", "--log", LOG, "--from", LOG), 2, "is none of ehadiag's JSON results"),
        (("check-bus", "--log", LOG, "-i", "virtual"), 2, "name it or a bus, not both"),
        (("monitor", "--log", LOG, "--port", "/dev/x"), 2, "name it or a bus, not both"),
        (("serve", "-i", "nothing"), 2, "interface 'nothing' unknown"),
        (("export", "--target", "nothing", "--out", "o"), 2, "target 'nothing': need one of host"),
    ],
)
def test_names_of_the_wrong_thing(
    run: Run, arguments: tuple[object, ...], code: int, said: str
) -> None:
    Path("file").write_text("")
    found = run(*arguments)
    assert found.code == code
    assert said in found.err
    assert found.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("diagnose", LOG, "--out", "closed"), "output folder closed: no right to write in it"),
        (("diagnose", LOG, "--summary", "closed/s.json"), "closed/s.json: Permission denied"),
        (("diagnose", LOG, "--results", "gone/r.jsonl"), "gone/r.jsonl: No such file"),
        (("design", "--out", "closed/t.toml"), "closed/t.toml: no right to write in its folder"),
        (("calibrate", LOG, "--out", "closed/u.toml"), "folder closed: no right to write in it"),
        (("export", "--target", "cortex-m4", "--out", "closed"), "closed: no right to write"),
    ],
)
def test_what_cannot_be_written_is_said_before_anything_slow(
    run: Run, monkeypatch: pytest.MonkeyPatch, arguments: tuple[object, ...], said: str
) -> None:
    ask = os.access
    monkeypatch.setattr(
        "os.access", lambda path, how: Path(path).name != "closed" and ask(path, how)
    )
    Path("closed").mkdir()
    found = run(*arguments)
    assert (found.code, found.out, found.err.count("\n")) == (3, "", 1)
    assert said in found.err


def test_a_folder_that_cannot_be_read_is_named(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: str) -> None:
        raise PermissionError(13, "Permission denied", path)

    Path("rig").mkdir()
    monkeypatch.setattr("os.scandir", refused)
    found = run("diagnose", "rig")
    assert found.code == 3
    assert "folder rig: Permission denied" in found.err


def test_the_program_alone_shows_its_help_and_is_no_verdict(run: Run) -> None:
    result = run()
    assert result.code == 2
    assert "bit" in result.out
    assert "diagnose" in result.out
    assert result.err == ""


def all_helps() -> list[CommandParser]:
    (commands,) = (
        item
        for item in parser_and_commands()[0]._actions
        if isinstance(item, argparse._SubParsersAction)
    )
    return list(commands.choices.values())


def test_a_short_help_has_at_most_a_screen_two_examples_and_the_way_on() -> None:
    helps = [item for item in all_helps() if item.usual]
    assert {"ehadiag bit", "ehadiag diagnose", "ehadiag serve"} <= {item.prog for item in helps}
    for parser in helps:
        text = parser.format_help()
        assert len(text.splitlines()) <= 60, parser.prog
        assert len(parser.usual) <= 14
        assert f"{parser.prog} --help-all" in text
        assert len(parser.format_full_help()) > len(text)


def test_the_examples_of_the_help_can_be_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EHADIAG_HISTORY", raising=False)
    for parser in all_helps():
        assert len(parser.examples) == 2, parser.prog
        assert parser.examples[0] in parser.format_help()
        for line in parser.examples:
            program, *words = shlex.split(line)
            assert program == "ehadiag"
            assert callable(parse_arguments(words).run)


def test_progress_in_a_log_is_a_line_now_and_then_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr(output.time, "monotonic", lambda: clock[0])
    with output.progress_bar() as show:
        for second in range(100):
            clock[0] = float(second)
            show("search", second / 100)
    assert capsys.readouterr().err.splitlines() == [
        "ehadiag: search 30%, about 70 s left",
        "ehadiag: search 60%, about 40 s left",
        "ehadiag: search 90%, about 10 s left",
    ]
