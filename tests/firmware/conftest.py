"""The C side, built once with all warnings as errors, and a pair of pseudo-terminals."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import subprocess
import threading
from collections.abc import Iterator
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


@pytest.fixture
def wire() -> Iterator[tuple[str, str]]:
    """Two pty pairs, joined in the middle: the two ends of a serial cable."""
    if not hasattr(os, "openpty"):
        pytest.skip("no pseudo-terminals on this system")
    import tty

    (a, a_end), (b, b_end) = os.openpty(), os.openpty()
    for item in (a, b, a_end, b_end):
        tty.setraw(item)
    for item in (a, b):
        os.set_blocking(item, False)
    stop = threading.Event()

    def forward(target: int, data: bytes) -> None:
        # An end that nobody reads fills up: its writer must not hang for ever.
        while data and not stop.is_set():
            if select.select([], [target], [], 0.02)[1]:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(target, data) :]

    def join() -> None:
        while not stop.is_set():
            for source in select.select([a, b], [], [], 0.02)[0]:
                forward(b if source == a else a, os.read(source, 4096))

    thread = threading.Thread(target=join)
    thread.start()
    yield os.ttyname(a_end), os.ttyname(b_end)
    stop.set()
    thread.join()
    for item in (a, b, a_end, b_end):
        os.close(item)
