"""Figures of identifications with known truth, in percent of full damage, and their bound."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis
from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.identify.experiment import Experiment
from ehadiag.model.registry import FAULT_NAMES, FAULTS
from ehadiag.model.residual_models import model_response
from ehadiag_sim.conditions import Sensors
from ehadiag_tools.damaged import damaged
from ehadiag_tools.study import Record, grouped
from firmware_iface.errors import EhadiagError
from firmware_iface.recording import PRESSURE_CHANNEL, SPOOL_CHANNEL

Array = NDArray[np.float64]
ROUNDING = 1e-12
"""Rounding of a severity, 1; an interval that ends at the truth holds it."""
STEPS = (2e-5, 5e-6)
"""Half-widths of the differences for derivatives, 1; the wide and the narrow one."""
AGREEMENT = 0.2
"""Largest relative difference of derivatives by both widths, 1; others are left out."""
SEVERITY_HEADINGS = (
    "test", "severity", "runs", "bias", "mean", "rms", "maximum", "coverage of 95 %, %",
    "rms / Cramér–Rao bound",
)  # fmt: skip


def outcome(found: Diagnosis | EhadiagError) -> Record:
    """Verdict, estimates, reasons and notes of a diagnosis, or why there is none."""
    if isinstance(found, EhadiagError):
        return {"verdict": "error", "value": [], "why": str(found), "notes": []}
    estimates = found.identification.estimates if found.identification else ()
    return {
        "verdict": found.verdict.name,
        "value": [item.value for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
        "why": "; ".join(found.reasons),
        "notes": [note for item in found.recordings for note in item.quality.notes],
    }


def percent_errors(records: Sequence[Record], stage: str = "value") -> Array:
    """Estimate less truth in percent, shape (n, 3), after a stage: first, search, value."""
    estimate = np.array([record[stage] for record in records])
    truth = np.array([record["faults"] for record in records])
    return np.asarray(100.0 * (estimate - truth))


def holds_truth(records: Sequence[Record]) -> NDArray[np.bool_]:
    """Whether the 95 % interval of each severity holds the truth, shape (n, 3)."""
    low, high = _ends(records)
    truth = np.array([record["faults"] for record in records])
    return np.asarray((low <= truth + ROUNDING) & (truth - ROUNDING <= high))


def is_wrong(record: Record, levels: Levels | None = None) -> bool:
    """Whether a verdict is another than the truth's, and the intervals exclude the truth.

    An interval that holds the truth on the other side of a level says that it may be so.
    """
    levels = levels or Levels()
    worst = max(record["faults"])
    true = Verdict.HEALTHY if worst < levels.advisory else Verdict.DEGRADED
    true = Verdict.FAULT if worst >= levels.limit else true
    if record["verdict"] in (None, Verdict.NOT_TESTED.name, true.name):
        return False
    return not bool(holds_truth([record]).all())


def stated_of(records: Sequence[Record]) -> list[Record]:
    """Records with a verdict and estimates."""
    without = ("error", Verdict.NOT_TESTED.name)
    return [item for item in records if item["verdict"] not in without and item["value"]]


ERROR_HEADINGS = ("mean", "largest", "intervals that hold")


def error_cells(stated: Sequence[Record]) -> list[str]:
    """Mean and largest of the records' largest errors in percent, and coverage."""
    if not stated:
        return ["", "", "0 of 0"]
    largest, held = np.abs(percent_errors(stated)).max(axis=1), holds_truth(stated)
    return [f"{largest.mean():.3f} %", f"{largest.max():.3f} %", f"{held.sum()} of {held.size}"]


def percent_widths(records: Sequence[Record]) -> Array:
    """Width of the 95 % interval of each severity in percent, shape (n, 3)."""
    low, high = _ends(records)
    return 100.0 * (high - low)


def _ends(records: Sequence[Record]) -> tuple[Array, Array]:
    interval = np.array([record["interval95"] for record in records])
    return interval[..., 0], interval[..., 1]


def rms(values: Array) -> float:
    """Root of the mean square of what is finite; NaN where nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def severity_rows(records: Sequence[Record]) -> Iterator[tuple[object, ...]]:
    """Rows of a table with `SEVERITY_HEADINGS`; the bound's ratio is of truths inside 0 … 1."""
    for (test,), part in grouped(records, "test").items():
        error, held = percent_errors(part), holds_truth(part)
        truth = np.array([record["faults"] for record in part])
        bound = 100.0 * np.array([record["bound"] for record in part], dtype=np.float64)
        ratio = np.where((truth > 0.0) & (truth < 1.0), error / bound, np.nan)
        for j, name in enumerate(FAULT_NAMES):
            mine = error[:, j]
            yield (
                test, name, len(part), f"{mine.mean():+.4f}", f"{np.abs(mine).mean():.4f}",
                f"{rms(mine):.4f}", f"{np.abs(mine).max():.4f}", f"{100.0 * held[:, j].mean():.1f}",
                f"{rms(ratio[:, j]):.2f}",
            )  # fmt: skip


def cramer_rao(experiments: Sequence[Experiment], faults: Sequence[float]) -> Array:
    """Deviations of all severities at the truth, sensor offsets known to be zero, shape (k,).

    The smallest that any unbiased estimate can have. Noise of the converters as in PHY-21 and
    PHY-22: 0.5 LSB rms and rounding, taken as Gaussian of variance 0.25 + 1/12 LSB². Ticks at
    which a break-away tips between both sides of a difference are left out: there the response has
    no derivative. NaN for a severity that shows in no recording.
    """
    total = sum((_information(item, faults) for item in experiments), np.zeros((len(FAULTS),) * 2))
    out = np.full(len(FAULTS), np.nan)
    shown = np.diag(total) > 0.0
    inverse = np.linalg.inv(total[np.ix_(shown, shown)])
    out[shown] = np.sqrt(np.diag(inverse))
    return out


def _information(experiment: Experiment, faults: Sequence[float]) -> Array:
    """Fisher information of one test, shape (k, k)."""
    truth = np.asarray(faults, dtype=np.float64)
    wide, narrow = (_derivatives(experiment, truth, step) for step in STEPS)
    scale = np.sqrt(np.mean(narrow**2, axis=2, keepdims=True))
    smooth = (np.abs(wide - narrow) <= AGREEMENT * (np.abs(narrow) + scale)).all(axis=0)
    measured = np.vstack([np.isfinite(experiment.spool), np.isfinite(experiment.pressure)])
    rows = narrow[:, smooth & measured]
    return np.asarray(rows @ rows.T)


def _derivatives(experiment: Experiment, truth: Array, step: float) -> Array:
    """Derivatives of spool and pressure in units of their noise, shape (k, 2, n)."""
    noise = np.sqrt(Sensors().noise_lsb ** 2 + 1.0 / 12.0) * np.array(
        [SPOOL_CHANNEL.lsb, PRESSURE_CHANNEL.lsb]
    )
    out = np.empty((len(FAULTS), len(noise), experiment.ticks))
    for j in range(len(FAULTS)):
        sides = []
        for sign in (1.0, -1.0):
            x = truth.copy()
            x[j] = min(max(x[j] + sign * step, 0.0), 1.0)
            constants = damaged(experiment.constants, x)
            answer = model_response(constants, experiment.trace.current, experiment.tick)
            sides.append((x[j], np.vstack([answer.spool, answer.pressure])))
        (high, above), (low, below) = sides
        out[j] = (above - below) / (high - low) / noise[:, None]
    return out
