"""Parquet files that are small on the disk and large in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import ConfigurationError, InputOutputError
from firmware_iface.logs.log_files import Budget
from firmware_iface.signals.columns import ColumnMap
from firmware_iface.signals.tables import read_signals

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
NAMES = ("time", "current", "spool", "pressure", "position")
LONG = "A" * (8 << 20)


def read(path: Path) -> object:
    return read_signals(path, ColumnMap(), Budget(), complete=True)


def test_texts_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a dictionary the file holds each text once."""
    path, rows = tmp_path / "x.parquet", 20
    numbers = {name: np.arange(rows) * 1e-3 for name in NAMES}
    parquet.write_table(pyarrow.table({**numbers, "note": [LONG] * rows}), path)
    assert path.stat().st_size < 2 << 20
    unpacked: list[str] = []
    read_table = parquet.read_table

    def watched(source: Path, columns: list[str], **options: object) -> object:
        unpacked.extend(columns)
        return read_table(source, columns=columns, **options)

    monkeypatch.setattr(parquet, "read_table", watched)
    assert "channels.spool" in read(path)
    assert sorted(unpacked) == sorted(NAMES)


def test_a_text_in_place_of_a_number_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    table = {name: np.arange(20) * 1e-3 for name in NAMES} | {"time": [LONG] * 20}
    parquet.write_table(pyarrow.table(table), path)
    with pytest.raises((ConfigurationError, InputOutputError)) as error:
        read(path)
    assert "\n" not in str(error.value)
    assert "AAAA" not in str(error.value)


def test_lists_in_lists_are_no_columns(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    kind = pyarrow.float64()
    for _ in range(30):
        kind = pyarrow.list_(kind)
    table = {name: np.arange(20) * 1e-3 for name in NAMES}
    parquet.write_table(pyarrow.table({**table, "deep": pyarrow.array([None] * 20, kind)}), path)
    assert "channels.spool" in read(path)
