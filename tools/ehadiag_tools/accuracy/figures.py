"""Figures of identifications with known truth, in percent of full damage, and their bound."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis
from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.identify.experiment import Experiment
from ehadiag.model.registry import FAULT_NAMES, FAULTS
from ehadiag.model.residual_models import model_response
from ehadiag_sim.conditions import Sensors
from ehadiag_tools.simulator.units import damaged
from ehadiag_tools.study import Record, grouped, markdown
from firmware_iface.errors import EhadiagError
from firmware_iface.recording import CHANNELS

Array = NDArray[np.float64]
NOT_TESTED = Verdict.NOT_TESTED.name
ROUNDING = 1e-12
"""Rounding of a severity, 1; an interval that ends at the truth holds it."""
STEPS = (2e-5, 5e-6)
"""Half-widths of the differences for derivatives, 1; the wide and the narrow one."""
AGREEMENT = 0.2
"""Largest relative difference of derivatives by both widths, 1; others are left out."""
FAR_OFF = 5.0
"""Error in stated deviations from which an estimate is wrong without a word, 1."""
HEADINGS = (
    "severity", "cases", "answered", "sure and wrong", "bias", "mean", "p95", "worst",
    f"beyond {FAR_OFF:g} deviations", "intervals that hold", "coverage of 95 %", "mean width",
    "rms / Cramér–Rao bound",
)  # fmt: skip
LEVEL_MARGIN = 0.02
"""Distance of a severity from a level within which either class will do, 1."""


def outcome(found: Diagnosis | EhadiagError) -> Record:
    """Verdict, estimates, reasons and notes of a diagnosis, or why there is none."""
    if isinstance(found, EhadiagError):
        return {"verdict": "error", "value": [], "reasons": [str(found)], "notes": []}
    estimates = found.identification.estimates if found.identification else ()
    return {
        "verdict": found.verdict.name,
        "value": [item.value for item in estimates],
        "std": [item.std for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
        "reasons": list(found.reasons),
        "notes": [note for item in found.recordings for note in item.quality.notes],
    }


def percent_errors(records: Sequence[Record], stage: str = "value") -> Array:
    """Estimate less truth in percent, shape (n, 3), after a stage: first, search, value."""
    estimate = np.array([record[stage] for record in records])
    truth = np.array([record["faults"] for record in records])
    return np.asarray(100.0 * (estimate - truth))


def holds_truth(records: Sequence[Record]) -> NDArray[np.bool_]:
    """Whether the 95 % interval of each severity holds the truth, shape (n, 3)."""
    interval = np.array([record["interval95"] for record in records])
    truth = np.array([record["faults"] for record in records])
    low, high = interval[..., 0], interval[..., 1]
    return np.asarray((low <= truth + ROUNDING) & (truth - ROUNDING <= high))


def deviations(records: Sequence[Record]) -> Array:
    """Errors in deviations, shape (n, 3), by the half of the interval that no bound cuts."""
    interval = np.array([record["interval95"] for record in records])
    value = np.array([record["value"] for record in records])
    half = np.maximum(interval[..., 1] - value, value - interval[..., 0])
    error = percent_errors(records) / 100.0
    return np.asarray(error * NORMAL_HALF_WIDTH_95 / np.maximum(half, ROUNDING))


def is_answered(record: Record) -> bool:
    """Whether a record has estimates, and no verdict that withholds them."""
    return bool(record["value"]) and record.get("verdict") not in ("error", NOT_TESTED)


def is_wrong(record: Record) -> bool:
    """Whether a verdict is of another class than the truth, although the intervals exclude that.

    Another effect than the faults may make it DEGRADED.
    """
    levels, worst = Levels(), max(record["faults"])
    if record.get("verdict") == Verdict.HEALTHY.name:
        return worst > levels.advisory + LEVEL_MARGIN
    if "verdict" not in record or not is_answered(record):
        return False
    lows, tops = zip(*record["interval95"], strict=True)
    if record["verdict"] == Verdict.FAULT.name:
        return worst < levels.limit - LEVEL_MARGIN and max(lows) > levels.limit
    if worst > levels.limit + LEVEL_MARGIN:
        return max(tops) < levels.limit
    return worst < levels.advisory - LEVEL_MARGIN and max(lows) > levels.advisory


def accuracy_table(records: Sequence[Record], *by: str, of_all: bool = False) -> Iterator[str]:
    """Table of errors and intervals in percent of damage, by the records' values of these names.

    Errors are of what is answered, or of all that has estimates; intervals of what is answered.
    p95 of all severities is that of the cases' means; the bound's ratio is of truths inside 0 … 1.
    """
    rows: list[tuple[object, ...]] = []
    for key, part in grouped(records, *by).items():
        answered = [item for item in part if is_answered(item)]
        counts = (len(part), len(answered), sum(map(is_wrong, part)))
        estimated = [item for item in part if item["value"]] if of_all else answered
        columns = [*range(len(FAULTS)), slice(None)] if estimated else []
        for name, column in zip((*FAULT_NAMES, "all"), columns, strict=False):
            rows.append((*key, name, *counts, *_error_cells(estimated, answered, column)))
        rows += [] if estimated else [(*key, "all", *counts, *"–" * (len(HEADINGS) - 4))]
    yield from markdown((*by, *HEADINGS), rows)


def _error_cells(
    estimated: Sequence[Record], answered: Sequence[Record], column: int | slice
) -> list[str]:
    error = percent_errors(estimated)[:, column].reshape(len(estimated), -1)
    cells = [
        f"{error.mean():+.4f}", f"{np.abs(error).mean():.4f}",
        f"{np.quantile(np.abs(error).mean(axis=1), 0.95):.4f}", f"{np.abs(error).max():.4f}",
    ]  # fmt: skip
    if not answered:
        return [*cells, "–", "0 of 0", "–", "–", "–"]
    held = holds_truth(answered)[:, column]
    interval = np.array([item["interval95"] for item in answered])
    width = 100.0 * (interval[..., 1] - interval[..., 0])[:, column].mean()
    far = int((np.abs(deviations(answered)[:, column]) > FAR_OFF).sum())
    cells += [
        str(far),
        f"{held.sum()} of {held.size}",
        f"{100.0 * held.mean():.1f} %",
        f"{width:.3f}",
    ]
    return [*cells, _over_bound(estimated, column)]


def _over_bound(records: Sequence[Record], column: int | slice) -> str:
    """Rms error over the Cramér–Rao bound."""
    bounded = [item for item in records if item.get("bound") is not None]
    if not bounded:
        return "–"
    truth = np.array([item["faults"] for item in bounded])
    ratio = percent_errors(bounded) / (100.0 * np.array([item["bound"] for item in bounded]))
    inside = np.where((truth > 0.0) & (truth < 1.0), ratio, np.nan)[:, column]
    finite = inside[np.isfinite(inside)]
    return f"{np.sqrt(np.mean(finite**2)):.2f}" if finite.size else "–"


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
        [CHANNELS.spool.lsb, CHANNELS.pressure.lsb]
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
