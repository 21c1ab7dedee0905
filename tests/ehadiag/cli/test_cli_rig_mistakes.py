"""Slips of a rig's engineer, in units, columns and names: one line says which it is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas
import pytest
from cli_result import Run
from places import LOGS

from firmware_iface.logs.reader import read_recording

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
    (found,) = run("diagnose", "--json", log).objects
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
        (("monitor", "--log", LOG, "--serial", "/dev/x"), 2, "name it or a bus, not both"),
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
