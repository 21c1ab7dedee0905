"""Inputs that rigs have and that must be taken, or refused in one line that helps."""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

HEALTHY = LOGS / "healthy-open.blf"
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
    assert "unrecognized arguments: --sed 1" in result.message
    result = run("tests", "more")
    assert result.code == 2
