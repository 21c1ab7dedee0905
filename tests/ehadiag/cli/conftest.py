"""A fixture that runs the command line in this process."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from cli_result import Result, Run

from ehadiag.cli.main import main


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    """No test shall see, or wait for, the compiler."""
    assert main(["warmup"]) == 0


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call `ehadiag` in an empty folder, without a bus in the environment."""
    monkeypatch.chdir(tmp_path)
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "EHADIAG_HISTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "no history of the user's own"))

    for name in [item for item in os.environ if item.startswith("EHADIAG_")]:
        if name != "EHADIAG_CACHE_DIR":
            monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "no defaults of the user's own"))

    def call(*arguments: object) -> Result:
        capsys.readouterr()
        try:
            code = main([str(item) for item in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return Result(code, captured.out, captured.err)

    return call


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures and pages are files of a few bytes: what they show is tested beside them."""
    monkeypatch.setattr("ehadiag.report.matplotlib_figures.picture_png", lambda _: b"\x89PNG")
    for page in ("diagnosis_page", "calibration_page"):
        monkeypatch.setattr(f"ehadiag.report.report_pages.{page}", lambda *_: "<html>")


@pytest.fixture
def environment() -> dict[str, str]:
    """Environment of a child process, without a bus."""
    return {key: value for key, value in os.environ.items() if not key.startswith("CAN_")}
