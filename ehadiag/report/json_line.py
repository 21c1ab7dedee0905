"""The machine-readable result: one JSON object a line, schema `ehadiag.diagnosis/1`."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ehadiag.core.printable import valid_text
from ehadiag.report.faults import Fault, faults_of

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.other_faults import OtherFault
    from ehadiag.assess.position import PositionFit
    from ehadiag.report.spent import Spent

__all__ = ["SCHEMA", "json_line", "source_name", "test_name"]

SCHEMA = "ehadiag.diagnosis/1"


def json_line(diagnosis: Diagnosis, spent: Spent, solver: str, seed: int) -> str:
    """One line without its end.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    spent : Spent
        Around the diagnosis.
    solver : str
        What was asked for; stated also where nothing was identified.
    seed : int
        See `solver`.

    Returns
    -------
    str
        The object without a line end, strict JSON.
    """
    found = diagnosis.identification
    timing = found.timing if found else None
    serials = [item.serial for item in diagnosis.recordings if item.serial is not None]
    tree: dict[str, Any] = {
        "schema": SCHEMA,
        "source": source_name(diagnosis),
        "test": test_name(diagnosis),
        "actuator": diagnosis.actuator.name,
        "serial": serials[0] if serials else None,
        "verdict": diagnosis.verdict.name,
        "reasons": [valid_text(reason) for reason in diagnosis.reasons],
        "faults": {
            name: _fault(fault, identified=found is not None)
            for name, fault in faults_of(diagnosis).items()
        },
        "other": [_other(item) for item in diagnosis.other],
        "fit": _fit(diagnosis),
        "culprit": asdict(diagnosis.culprit) if diagnosis.culprit else None,
        "positions": [_position(fit) for fit in diagnosis.positions],
        "quality": _quality(diagnosis),
        "solver": {
            "name": found.solver if found else solver,
            "seed": found.seed if found else seed,
            "evaluations": found.evaluations if found else 0,
            "generations": found.generations if found else 0,
            "converged": found.converged if found else None,
        },
        "timing_s": {
            "read": _rounded(spent.read),
            "first": _rounded(timing.first) if timing else None,
            "search": _rounded(timing.search) if timing else None,
            "refine": _rounded(timing.refine) if timing else None,
            "total": _rounded(spent.read + diagnosis.elapsed),
            "after_test": None if spent.after_test is None else _rounded(spent.after_test),
        },
    }
    return json.dumps(_finite(tree), allow_nan=False)


def source_name(diagnosis: Diagnosis) -> str:
    r"""File or bus; several joined by ' + '; bytes that are not UTF-8 are written as `\xff`."""
    return " + ".join(valid_text(recording.source) for recording in diagnosis.recordings)


def test_name(diagnosis: Diagnosis) -> str | None:
    """Name of the test; several joined by '+'; None if unknown."""
    names = [test.name for test in diagnosis.tests if test is not None]
    return "+".join(names) or None


def _fault(fault: Fault, *, identified: bool) -> dict[str, Any]:
    if not identified:
        empty = dict.fromkeys(("first", "search", "estimate", "std", "interval95"))
        return {**empty, "flags": []}
    return {
        "first": fault.first,
        "search": fault.search,
        "estimate": fault.value,
        "std": fault.std,
        "interval95": list(fault.interval),
        "flags": list(fault.flags),
    }


def _fit(diagnosis: Diagnosis) -> dict[str, Any] | None:
    if diagnosis.identification is None:
        return None
    fit = diagnosis.identification.fit
    return {
        "spool_rms": fit.spool_rms,
        "pressure_rms": fit.pressure_rms,
        "outliers": fit.outliers,
        "spool_noise_mm": fit.spool_noise * 1e3,
        "pressure_noise_MPa": fit.pressure_noise * 1e-6,
        "spool_offset_mm": fit.spool_offset * 1e3,
        "pressure_offset_MPa": fit.pressure_offset * 1e-6,
        "anchored": fit.anchored,
    }


def _other(item: OtherFault) -> dict[str, Any]:
    return {
        "name": item.name,
        "value": item.value,
        "unit": item.unit,
        "std": item.std,
        "interval95": list(item.interval95),
        "limit": item.limit,
        "beyond": item.beyond,
    }


def _position(fit: PositionFit | None) -> dict[str, float] | None:
    if fit is None:
        return None
    return {
        "gain": fit.gain,
        "drift_mm_s": fit.drift * 1e3,
        "rms": fit.rms,
        "outliers": fit.outliers,
    }


def _quality(diagnosis: Diagnosis) -> dict[str, Any]:
    def total(count: str) -> int:
        return sum(recording.quality.total(count) for recording in diagnosis.recordings)

    saturated: dict[str, int] = {}
    for recording in diagnosis.recordings:
        for channel, count in recording.quality.saturated.items():
            saturated[channel] = saturated.get(channel, 0) + count
    return {
        "frames": total("received"),
        "lost": total("lost"),
        "repeated": total("repeated"),
        "conflicts": total("conflicts"),
        "crc_errors": total("crc_errors"),
        "out_of_order": total("out_of_order"),
        "length_errors": total("length_errors"),
        "range_errors": total("range_errors"),
        "foreign": sum(recording.quality.foreign for recording in diagnosis.recordings),
        "error_frames": sum(recording.quality.error_frames for recording in diagnosis.recordings),
        "saturated": saturated,
        "notes": [valid_text(note) for note in diagnosis.notes],
    }


def _rounded(seconds: float) -> float:
    return round(seconds, 4)


def _finite(node: Any) -> Any:
    """Put null in the place of numbers that are none: JSON has no others."""
    if isinstance(node, dict):
        return {key: _finite(value) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [_finite(value) for value in node]
    return None if isinstance(node, float) and not math.isfinite(node) else node
