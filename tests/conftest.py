"""For all tests: settings of hypothesis, time limits, collection, a small disk."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# An example's time says nothing on a machine that other work shares; each run draws other ones.
settings.register_profile("any machine", deadline=None, max_examples=50)
settings.load_profile("any machine")

# Tests start some two hundred processes: without bytecode each compiles the package anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

SLOW_LIMIT = 1800.0
"""Time limit of a test that is marked slow, s; that of others is in pyproject.toml."""


def pytest_xdist_auto_num_workers() -> int:
    """One process more than processors: some tests wait for a bus that keeps time."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Let each process begin with other files: in a fresh clone it compiles these for all."""
    gc.disable()  # what is collected stays: to look for garbage in it takes a fifth of the time
    config, worker = session.config, getattr(session.config, "workerinput", None)
    if worker and config.args == config.getini("testpaths"):
        files = sorted(str(file) for file in Path(__file__).parent.rglob("test_*.py"))
        first = len(files) * int(worker["workerid"][2:]) // worker["workercount"]
        config.args[:] = files[first:] + files[:first]


def pytest_collection_finish() -> None:
    """Look for garbage again, but not among the tests."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Bring the tests into one order; give slow ones more time."""
    items.sort(key=lambda item: item.path)
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_LIMIT))


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB; only root can make one."""
    place = tmp_path / "tiny"
    place.mkdir()
    options = ["-t", "tmpfs", "-o", "size=64k,mode=0700", "none", str(place)]
    try:
        made = subprocess.run(["mount", *options], capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no file system can be mounted: {error}")
    if made.returncode != 0:
        pytest.skip(f"no file system can be mounted: {made.stderr.strip()}")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)
