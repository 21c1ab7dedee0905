"""The C side, built once with all warnings as errors."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import c_side
import pytest


@pytest.fixture(scope="session")
def c_build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with fcc-serial, fcc-can and libfcc.so."""
    for program in ("cc", "make"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} on this machine")
    folder = tmp_path_factory.mktemp("c")
    done = subprocess.run(
        ["make", "-C", str(c_side.SOURCES), f"OUT={folder}", "CC=cc"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="session")
def library(c_build: Path) -> Any:
    return c_side.load(c_build / "libfcc.so")
