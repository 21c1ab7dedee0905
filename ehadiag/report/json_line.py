"""The machine-readable result: one JSON object a line, schema `ehadiag.diagnosis/2`, or `/1`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ehadiag.core.dates import date_text
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.printable import valid_text
from ehadiag.model.parameters import FAULTS
from ehadiag.report.faults import Fault, faults_of
from ehadiag.report.origin import configuration, log_tree, package, recordings

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.other_faults import OtherFault
    from ehadiag.assess.position import PositionFit
    from ehadiag.core.actuator import Actuator
    from ehadiag.identify.result import Identification
    from ehadiag.report.asked import Asked, LogFile
    from ehadiag.report.spent import Spent

__all__ = [
    "NEWEST",
    "SCHEMA",
    "VERSIONS",
    "error_line",
    "first_version",
    "json_line",
    "source_name",
    "test_name",
]

SCHEMA = "ehadiag.diagnosis"
VERSIONS = (1, 2)
NEWEST = VERSIONS[-1]
FIRST = (
    "source", "test", "actuator", "serial", "verdict", "reasons", "faults", "fit", "quality",
    "solver", "timing_s",
)  # fmt: skip
"""Keys of version 1; all others came later."""
UNCAPPED = ("spool_rms_uncapped", "pressure_rms_uncapped")
"""Of the fit, from version 2 on."""


def json_line(
    diagnosis: Diagnosis,
    spent: Spent,
    asked: Asked,
    logs: Sequence[LogFile | None] = (),
) -> str:
    """One line without its end.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    spent : Spent
        Around the diagnosis.
    asked : Asked
        What was asked for; stated also where nothing was identified.
    logs : Sequence[LogFile | None]
        Log of each recording; empty where there was none.
    Returns
    -------
    str
        The object without a line end, strict JSON.
    """
    tree = _core(diagnosis, spent, asked) | _added(diagnosis, asked, logs)
    return _text(tree, NEWEST)


def first_version(line: str) -> str:
    """Return an object as `ehadiag.diagnosis/1` has it.

    Parameters
    ----------
    line : str
        Object of version 2 that is no error's: version 1 has none of these.

    Returns
    -------
    str
        The object without a line end, strict JSON.
    """
    tree = json.loads(line)
    if tree["fit"] is not None:
        tree["fit"] = {key: value for key, value in tree["fit"].items() if key not in UNCAPPED}
    return _text({key: tree[key] for key in FIRST}, 1)


def error_line(
    source: str, error: str, exit_code: int, asked: Asked, actuator: Actuator, log: LogFile | None
) -> str:
    """Return the object of an input that could not be read: all keys, and no verdict.

    Parameters
    ----------
    source : str
        The input as it was named.
    error : str
        What is wrong with it.
    exit_code : int
        That it would end with alone.
    asked : Asked
        What was asked for.
    actuator : Actuator
        What would have been diagnosed.
    log : LogFile | None
        The log, if there is one.

    Returns
    -------
    str
        The object without a line end, strict JSON; of version 2, the first that knows such ones.
    """
    nothing = dict.fromkeys(("test", "serial", "verdict", "date", "fit", "quality", "timing_s"))
    tree: dict[str, Any] = {
        "source": valid_text(source),
        "actuator": actuator.name,
        **nothing,
        "reasons": [],
        "faults": {item.name: _fault(None) for item in FAULTS},
        "solver": _solver(None, asked),
        "error": {"text": valid_text(error), "exit_code": exit_code, "log": log_tree(log)},
        "recordings": [],
        **_of_the_call(asked, actuator),
    }
    return _text(tree, NEWEST)


def _text(tree: dict[str, Any], version: int) -> str:
    return json.dumps(_finite({"schema": f"{SCHEMA}/{version}", **tree}), allow_nan=False)


def _core(diagnosis: Diagnosis, spent: Spent, asked: Asked) -> dict[str, Any]:
    found = diagnosis.identification
    timing = found.timing if found else None
    serials = [item.serial for item in diagnosis.recordings if item.serial is not None]
    faults = faults_of(diagnosis).items()
    return {
        "source": source_name(diagnosis),
        "test": test_name(diagnosis),
        "actuator": diagnosis.actuator.name,
        "serial": serials[0] if serials else None,
        "verdict": diagnosis.verdict.name,
        "reasons": [valid_text(reason) for reason in diagnosis.reasons],
        "faults": {name: _fault(fault if found else None) for name, fault in faults},
        "other": [_other(item) for item in diagnosis.other],
        "fit": _fit(diagnosis),
        "culprit": asdict(diagnosis.culprit) if diagnosis.culprit else None,
        "positions": [_position(fit) for fit in diagnosis.positions],
        "quality": _quality(diagnosis),
        "solver": _solver(found, asked),
        "timing_s": {
            "read": _rounded(spent.read),
            "first": _rounded(timing.first) if timing else None,
            "search": _rounded(timing.search) if timing else None,
            "refine": _rounded(timing.refine) if timing else None,
            "total": _rounded(spent.read + diagnosis.elapsed),
            "after_test": None if spent.after_test is None else _rounded(spent.after_test),
        },
    }


def _added(diagnosis: Diagnosis, asked: Asked, logs: Sequence[LogFile | None]) -> dict[str, Any]:
    """What version 2 adds at the top; a further part of the result is a further key here."""
    dates = [date_text(item.start_ns) for item in diagnosis.recordings]
    return {
        "error": None,
        "date": next((date for date in dates if date is not None), None),
        "recordings": recordings(diagnosis, logs),
        **_of_the_call(asked, diagnosis.actuator),
    }


def _of_the_call(asked: Asked, actuator: Actuator) -> dict[str, Any]:
    return {
        "actuator_sha256": fingerprint(actuator),
        "configuration": configuration(asked),
        "package": package(),
    }


def _solver(found: Identification | None, asked: Asked) -> dict[str, Any]:
    return {
        "name": found.solver if found else asked.solver,
        "seed": found.seed if found else asked.seed,
        "evaluations": found.evaluations if found else 0,
        "generations": found.generations if found else 0,
        "converged": found.converged if found else None,
    }


def source_name(diagnosis: Diagnosis) -> str:
    r"""File or bus; several joined by ' + '; bytes that are not UTF-8 are written as `\xff`."""
    return " + ".join(valid_text(recording.source) for recording in diagnosis.recordings)


def test_name(diagnosis: Diagnosis) -> str | None:
    """Name of the test; several joined by '+'; None if unknown."""
    names = [test.name for test in diagnosis.tests if test is not None]
    return "+".join(names) or None


def _fault(fault: Fault | None) -> dict[str, Any]:
    if fault is None:
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
        **{name: getattr(fit, name) for name in UNCAPPED},
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
