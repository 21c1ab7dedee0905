"""The A2L file, as a2ltool checks and reads it in a process of its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ehadiag import default_actuator
from ehadiag.cli.main import main
from ehadiag.export.a2l import A2L_FILE, a2l_text
from firmware_iface.bus_map import default_map
from firmware_iface.xcp import MEASUREMENTS, XcpIds

TOOL = shutil.which("a2ltool", path=str(Path(sys.executable).parent)) or shutil.which("a2ltool")
pytestmark = pytest.mark.skipif(TOOL is None, reason="needs a2ltool")


def checked(path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    assert TOOL is not None
    return subprocess.run(
        [TOOL, str(path), *options], capture_output=True, text=True, timeout=60, check=False
    )


def kept_interface(path: Path, *options: str) -> bool:
    """Whether the interface's data are as the file's own A2ML says."""
    cleaned = path.with_name("cleaned.a2l")
    assert checked(path, *options, "--ifdata-cleanup", "--output", str(cleaned)).returncode == 0
    return "/begin IF_DATA XCP" in cleaned.read_text()


def test_a2ltool_finds_nothing_wrong(tmp_path: Path) -> None:
    assert main(["export", "--a2l", "--xcp", "18FF0001:6F1", "--out", str(tmp_path)]) == 0
    path = tmp_path / A2L_FILE
    found = checked(path, "--strict", "--check", "--show-xcp")
    assert found.returncode == 0, found.stdout
    assert "No problems found" in found.stdout
    for line in ("CAN id master: 0x18FF0001", "CAN id slave: 0x6F1"):
        assert line in found.stdout
    assert "baudrate" not in found.stdout
    assert kept_interface(path)
    text = path.read_text()
    for item in MEASUREMENTS:
        assert f"/begin MEASUREMENT {item.name} " in text


def test_interface_data_are_as_the_standard_has_them(tmp_path: Path) -> None:
    """a2ltool brings its own A2ML of XCP; our subset is left out for it."""
    text = a2l_text(default_actuator(), default_map(), XcpIds())
    before, own = text.split("    /begin A2ML")
    path, standard = tmp_path / "own.a2l", tmp_path / "standard.a2l"
    path.write_text(before + own.split("/end A2ML\n")[1])
    assert checked(path, "--insert-a2ml", "--output", str(standard)).returncode == 0
    assert '"XCPplus"' in standard.read_text()
    assert kept_interface(standard)


@pytest.mark.parametrize(
    ("right", "wrong"), [("DYNAMIC 252", "DYNAMO 252"), ("CAN_ID_MASTER 0x", "CAN_ID_MASTR 0x")]
)
def test_wrong_interface_data_are_seen(right: str, wrong: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.a2l"
    text = a2l_text(default_actuator(), default_map(), XcpIds())
    assert text.count(right) == 1
    path.write_text(text.replace(right, wrong))
    assert not kept_interface(path)
