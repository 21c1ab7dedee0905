"""Errors and stated deviations of real diagnoses of simulated tests, as a table."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ehadiag
from ehadiag.model.parameters import FAULT_NAMES

__all__ = ["TABLE", "Noise", "measure", "read_table"]

TABLE = Path(__file__).with_name("noise.csv")
HALF = 2


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Diagnoses with known truth, of one severity; shape (diagnoses,) each."""

    truth: NDArray[np.float64]
    error: NDArray[np.float64]
    std: NDArray[np.float64]

    def draw(self, severity: float, rng: np.random.Generator) -> tuple[float, float]:
        """Return error and stated deviation of a diagnosis near a severity: one of the table's."""
        near = np.argsort(np.abs(self.truth - severity))[:12]
        index = int(rng.choice(near))
        return float(self.error[index] * rng.choice((-1.0, 1.0))), float(self.std[index])


def read_table(path: Path = TABLE) -> dict[str, Noise]:
    """Read the table, by severity."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    out = {}
    for name in FAULT_NAMES:
        mine = [row for row in rows if row["severity"] == name]
        truth, value, std = (
            np.array([float(row[key]) for row in mine]) for key in ("truth", "estimate", "std")
        )
        out[name] = Noise(truth, value - truth, std)
    return out


def measure(number: int, seed: int) -> Iterator[dict[str, object]]:
    """Diagnose simulated tests of random severities; every other unit has effects of its own."""
    rng = np.random.default_rng(seed)
    for index in range(number):
        truth = rng.uniform(0.0, 0.8, 3)
        own: dict[str, Any] = {}
        if index % HALF:
            own = {
                "null_bias": float(rng.uniform(-1e-4, 1e-4)),
                "hysteresis": float(rng.uniform(0.0, 0.02)),
                "load": float(rng.uniform(-50.0, 50.0)),
            }
        severities: dict[str, Any] = dict(zip(FAULT_NAMES, truth.tolist(), strict=True))
        recording = ehadiag.simulate("open", seed=index + 1, **severities, **own)
        found = ehadiag.diagnose(recording)
        if not found.identified or found.verdict is ehadiag.Verdict.NOT_TESTED:
            continue
        for name, fault in found.faults.items():
            yield {
                "severity": name,
                "truth": f"{severities[name]:.6f}",
                "estimate": f"{fault.value:.6f}",
                "std": f"{fault.std:.6f}",
                "effects": int(bool(own)),
            }
