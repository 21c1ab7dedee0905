"""Fuzz targets that need a file: decoded signals and candump logs, and what configures a call."""

from __future__ import annotations

import contextlib
import gzip
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ehadiag.core.actuator import default_actuator, load_actuator
from ehadiag.core.errors import EhadiagError
from ehadiag.core.find_test import Sought
from ehadiag.core.stored_test import bundled_tests, load_test
from firmware_iface.logs.any_recording import Meaning, recorded_tests
from firmware_iface.logs.budget import Budget
from firmware_iface.mapping.bus_map import default_map, load_map
from firmware_iface.signals.columns import load_columns

__all__ = ["CONFIGURATIONS", "SIGNALS", "configurations", "signals"]

SIGNALS = (".log", ".csv", ".parquet", ".log.gz", ".csv.gz", "packed.csv.gz", "packed.log.gz")
"""Recordings by the first byte of an input; `packed`: the input is what a sound gzip file holds."""
CONFIGURATIONS: tuple[Callable[[str], object], ...] = (
    load_actuator,
    load_test,
    load_columns,
    load_map,
)
"""Readers by the first byte of an input."""
BUDGET = Budget(frames=100_000, size=1 << 20)
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""In memory where the system has such a folder: a file is written for every input."""


def signals(_: int) -> Callable[[bytes], None]:
    """Recordings that are not binary logs, to their tests."""
    sought = Sought(tuple(bundled_tests().values()), default_actuator().controller)
    meaning = Meaning(default_map(), None, sought)

    def check(data: bytes) -> None:
        if not data:
            return
        kind, content = SIGNALS[data[0] % len(SIGNALS)], data[1:]
        if kind.startswith("packed"):
            kind, content = kind.removeprefix("packed"), gzip.compress(content, 1)
        with _file(kind, content) as path, contextlib.suppress(EhadiagError):
            list(recorded_tests([path], meaning, BUDGET))

    return check


def configurations(_: int) -> Callable[[bytes], None]:
    """Actuator files, test files, mappings of columns, mappings of frames that name a DBC."""

    def check(data: bytes) -> None:
        if not data:
            return
        with _file(".toml", data[1:]) as path, contextlib.suppress(EhadiagError):
            CONFIGURATIONS[data[0] % len(CONFIGURATIONS)](path)

    return check


@contextmanager
def _file(suffix: str, content: bytes) -> Iterator[str]:
    with tempfile.NamedTemporaryFile(dir=MEMORY, suffix=suffix, delete=False) as file:
        file.write(content)
    try:
        yield file.name
    finally:
        Path(file.name).unlink()
