"""The examples for test frameworks, run by the frameworks themselves in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

FOLDER = ROOT / "examples" / "frameworks"
PLUGIN = ("-p", "ehadiag.pytest_plugin")
"""By its entry point where the package is installed; by name also where it is only on the path."""


def run(place: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        cwd=place,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )


@pytest.mark.slow
def test_pytest(tmp_path: Path) -> None:
    """One unit within its limits, the same beyond tighter ones, severities in the report."""
    words = ("-m", "pytest", *PLUGIN, "-p", "no:cacheprovider", "-c", "/dev/null")
    words = (*words, "--rootdir", str(FOLDER), "--junit-xml", "r.xml", "-q", str(FOLDER))
    done = run(tmp_path, *words)
    assert done.returncode == 0, done.stdout
    assert "1 passed, 1 xfailed" in done.stdout
    report = (tmp_path / "r.xml").read_text()
    assert 'property name="FSS" value="0.4' in report or 'value="0.39' in report


def test_a_unit_without_a_bus_is_skipped(tmp_path: Path) -> None:
    (tmp_path / "test_rig.py").write_text(
        "import pytest\npytest_plugins = ['ehadiag.pytest_plugin']\n"
        "def test_unit(ehadiag_unit):\n    ehadiag_unit('open')\n"
    )
    done = run(tmp_path, "-m", "pytest", "-rs", "-q", "-c", "/dev/null", "test_rig.py")
    assert "--ehadiag-interface" in done.stdout
    assert "1 skipped" in done.stdout


@pytest.mark.slow
def test_openhtf(tmp_path: Path) -> None:
    pytest.importorskip("openhtf")
    done = run(tmp_path, str(FOLDER / "openhtf_station.py"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "openhtf.txt").read_text() == "PASS"
    assert (tmp_path / "openhtf.blf").stat().st_size > 10_000


@pytest.mark.slow
def test_robot_framework(tmp_path: Path) -> None:
    pytest.importorskip("robot")
    words = ("-m", "robot", "--pythonpath", str(FOLDER), str(FOLDER / "unit.robot"))
    done = run(tmp_path, *words)
    assert done.returncode == 0, done.stdout
    assert "1 test, 1 passed, 0 failed" in done.stdout
