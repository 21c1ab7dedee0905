"""Paths of the repository and of its test data."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
LOGS = ROOT / "tests" / "data" / "logs"
CORPUS = ROOT / "tests" / "data" / "fuzz"
