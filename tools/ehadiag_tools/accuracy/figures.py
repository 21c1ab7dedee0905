"""Statistics of many identifications with known truth, in percent of full damage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.parameters import FAULT_NAMES

__all__ = [
    "Figures",
    "figures_of",
    "holds_truth",
    "percent_errors",
    "percent_widths",
    "print_figures",
]

SAME = 1e-12
"""An estimate on the bound is told as such; the last digit of a sum must not decide."""

Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Figures:
    """Of n identifications; lists have one entry for each of Kintas, FSS, FDJ."""

    runs: int
    bias: list[float]
    """Mean error."""
    mean: list[float]
    """Mean absolute error."""
    rms: list[float]
    maximum: list[float]
    """Largest absolute error."""
    coverage: list[float]
    """Share of 95 % intervals that hold the truth, %."""
    bound_ratio: list[float]
    """Rms error in units of each run's own Cramér–Rao bound, truths inside the bounds only."""
    first_mean: float
    """Mean absolute error of the first approximation, all constants."""
    mean_all: float
    """Mean absolute error, all constants."""
    p95_case: float
    """95th percentile of the mean of the three absolute errors of a run."""
    worst_case: float
    """Largest mean of the three absolute errors of a run."""
    coverage_all: float
    coverage_inside: float
    """The same of truths that are neither 0 nor 1."""
    rescued: int
    not_converged: int
    most_outliers: float
    """Largest share of residuals beyond three deviations, %."""


def percent_errors(records: Sequence[Record], stage: str = "value") -> NDArray[np.float64]:
    """Estimate less truth in percent, shape (n, 3), after a stage: first, search, value."""
    estimate = np.array([record[stage] for record in records])
    truth = np.array([record["faults"] for record in records])
    return np.asarray(100.0 * (estimate - truth))


def holds_truth(records: Sequence[Record]) -> NDArray[np.bool_]:
    """Whether the 95 % interval of each severity holds the truth, shape (n, 3)."""
    low, high = _ends(records)
    truth = np.array([record["faults"] for record in records])
    return np.asarray((low <= truth + SAME) & (truth - SAME <= high))


def percent_widths(records: Sequence[Record]) -> NDArray[np.float64]:
    """Width of the 95 % interval of each severity in percent, shape (n, 3)."""
    low, high = _ends(records)
    return 100.0 * (high - low)


def _ends(records: Sequence[Record]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    interval = np.array([record["interval95"] for record in records])
    return interval[..., 0], interval[..., 1]


def figures_of(records: Sequence[Record]) -> Figures:
    """Figures of a non-empty list of records of `ehadiag_tools.accuracy.runs.perform`."""
    error = percent_errors(records)
    case = np.abs(error).mean(axis=1)
    truth = np.array([record["faults"] for record in records])
    inside = (truth > 0.0) & (truth < 1.0)
    held = holds_truth(records)
    bound = 100.0 * np.array([record["bound"] for record in records])
    ratio = np.where(inside, error / bound, np.nan)
    return Figures(
        runs=len(records),
        bias=_listed(error.mean(axis=0)),
        mean=_listed(np.abs(error).mean(axis=0)),
        rms=_listed(np.sqrt((error**2).mean(axis=0))),
        maximum=_listed(np.abs(error).max(axis=0)),
        coverage=_listed(100.0 * held.mean(axis=0)),
        bound_ratio=[_rms(column[np.isfinite(column)]) for column in ratio.T],
        first_mean=float(np.abs(percent_errors(records, "first")).mean()),
        mean_all=float(case.mean()),
        p95_case=float(np.percentile(case, 95.0)),
        worst_case=float(case.max()),
        coverage_all=float(100.0 * held.mean()),
        coverage_inside=float(100.0 * held[inside].mean()) if inside.any() else float("nan"),
        rescued=sum(bool(record["rescued"]) for record in records),
        not_converged=sum(not record["converged"] for record in records),
        most_outliers=100.0 * max(record["outliers"] for record in records),
    )


def print_figures(title: str, figures: Figures) -> None:
    """Two tables: per constant, and over all."""
    print(f"{title}: {figures.runs} runs, errors in percent\n")
    print("| | bias | mean | rms | maximum | coverage of 95 %, % | rms / Cramér–Rao bound |")
    print("| --- |" + " --- |" * 6)
    for j, name in enumerate(FAULT_NAMES):
        print(
            f"| {name} | {figures.bias[j]:+.4f} | {figures.mean[j]:.4f} | {figures.rms[j]:.4f} "
            f"| {figures.maximum[j]:.4f} | {figures.coverage[j]:.1f} "
            f"| {figures.bound_ratio[j]:.2f} |"
        )
    print()
    rows = {
        "mean of all constants": f"{figures.mean_all:.4f}",
        "95th percentile of the case mean": f"{figures.p95_case:.4f}",
        "worst case mean": f"{figures.worst_case:.4f}",
        "maximum of any constant": f"{max(figures.maximum):.4f}",
        "mean after the first approximation": f"{figures.first_mean:.3f}",
        "coverage of 95 %, all": f"{figures.coverage_all:.1f} %",
        "coverage of 95 %, truths inside the cube": f"{figures.coverage_inside:.1f} %",
        "sent back to the whole cube": f"{figures.rescued} ({_share(figures.rescued, figures)})",
        "not converged": f"{figures.not_converged} ({_share(figures.not_converged, figures)})",
        "largest share of outliers": f"{figures.most_outliers:.2f} %",
    }
    print("| | |\n| --- | --- |")
    for name, value in rows.items():
        print(f"| {name} | {value} |")
    print(flush=True)


def _share(count: int, figures: Figures) -> str:
    return f"{100.0 * count / figures.runs:.1f} %"


def _listed(values: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in values]


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
