"""Tells tables of results from recordings: both may be CSV or Parquet, and lie in one folder."""

from __future__ import annotations

from pathlib import Path

from ehadiag.cli.batch.row import COLUMNS

__all__ = ["MARK", "is_table_of_results"]

MARK = b"ehadiag.results/1"
"""Stands in the footer of our Parquet files."""
FOOTER_BYTES = 1 << 16
FIRST = ",".join(list(COLUMNS)[:6]).encode()
"""Begins our CSV files."""


def is_table_of_results(path: Path) -> bool:
    """Whether a file was written by `--results`; False too where it cannot be read."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            if path.suffix.lower() == ".csv":
                return file.read(len(FIRST)) == FIRST
            if path.suffix.lower() == ".parquet":
                file.seek(max(path.stat().st_size - FOOTER_BYTES, 0))
                return MARK in file.read(FOOTER_BYTES)
    except OSError:
        pass
    return False
