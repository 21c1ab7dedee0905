"""The examples run, and print what their page says; the notebook's cells show what they should."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path

import pytest
from places import ROOT
from printed_output import output_matches

FOLDER = ROOT / "examples"
PAGE = FOLDER / "README.md"
COMMANDS = re.findall(
    r"^```sh\npython (\S+)([^\n]*)\n```\n```\n(.*?)^```",
    PAGE.read_text(encoding="utf-8"),
    re.DOTALL | re.MULTILINE,
)


def test_every_example_is_on_the_page() -> None:
    assert sorted(ROOT / script for script, *_ in COMMANDS) == sorted(FOLDER.glob("*.py"))


@pytest.mark.parametrize(
    ("script", "arguments", "told"), COMMANDS, ids=[Path(script).stem for script, *_ in COMMANDS]
)
def test_example_prints_what_the_page_says(
    script: str, arguments: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    paths = [str(ROOT / item) if (ROOT / item).exists() else item for item in arguments.split()]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [script, *paths])
    runpy.run_path(str(ROOT / script), run_name="__main__")
    printed = capsys.readouterr().out
    assert output_matches(told, printed), printed
    for picture in re.findall(r"see (\S+\.png)", told):
        assert (tmp_path / picture).stat().st_size > 10_000


@pytest.mark.slow
def test_the_notebook_runs_and_shows_table_picture_and_frames(tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    (tmp_path / "examples").mkdir()
    logs = tmp_path / "tests" / "data" / "logs"
    logs.mkdir(parents=True)
    shutil.copy(ROOT / "tests" / "data" / "logs" / "paper-closed-1.blf", logs)
    notebook = nbformat.read(FOLDER / "diagnose.ipynb", as_version=4)
    place = {"metadata": {"path": str(tmp_path / "examples")}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=place).execute()
    shown = [
        output["data"]
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if "data" in output
    ]
    assert len(shown) == 6
    version, frame, table, picture, faults, study = shown
    assert re.match(r"'\d+\.\d+", version["text/plain"])
    assert "pressure" in frame["text/html"]
    assert table["text/html"].startswith("<style>")
    assert "FSS" in table["text/html"]
    assert len(picture["image/png"]) > 10_000
    assert "interval" not in faults["text/plain"]
    assert re.search(r"^FSS +0\.(30|29)\d+ ", faults["text/plain"], re.MULTILINE)
    assert re.findall(r"HEALTHY|DEGRADED|FAULT", study["text/plain"]) == [
        "HEALTHY",
        "DEGRADED",
        "DEGRADED",
    ]
