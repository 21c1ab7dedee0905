"""One row of a table for one result: the columns of CSV and Parquet files."""

from __future__ import annotations

from typing import Any

from ehadiag.core.printable import printable

__all__ = ["COLUMNS", "row_of"]

FAULTS = ("Kintas", "FSS", "FDJ")
COLUMNS: dict[str, type[str] | type[int] | type[float]] = {
    "source": str,
    "date": str,
    "test": str,
    "actuator": str,
    "serial": int,
    "verdict": str,
    **{f"{fault}{part}": float for fault in FAULTS for part in ("", "_std", "_low95", "_high95")},
    "spool_rms": float,
    "pressure_rms": float,
    "oil_temperature_degC": float,
    "supply_pressure_MPa": float,
    "frames": int,
    "lost": int,
    "total_s": float,
    "reasons": str,
    "notes": str,
    "error": str,
}
"""Names and kinds; each may be empty."""


def row_of(tree: dict[str, Any]) -> dict[str, str | int | float | None]:
    """Flatten a result; text in it is printable, several reasons are joined by `; `.

    Parameters
    ----------
    tree : dict[str, Any]
        Object `ehadiag.diagnosis/2`.

    Returns
    -------
    dict[str, str | int | float | None]
        A value for each of `COLUMNS`.
    """
    fit, quality, timing = tree["fit"] or {}, tree["quality"] or {}, tree["timing_s"] or {}
    first = tree["recordings"][0] if tree["recordings"] else {}
    row: dict[str, Any] = {
        **{key: tree[key] for key in ("source", "date", "test", "actuator", "serial", "verdict")},
        **{key: fit.get(key) for key in ("spool_rms", "pressure_rms")},
        **{key: first.get(key) for key in ("oil_temperature_degC", "supply_pressure_MPa")},
        **{key: quality.get(key) for key in ("frames", "lost")},
        "total_s": timing.get("total"),
        "reasons": "; ".join(tree["reasons"]),
        "notes": "; ".join(quality.get("notes", ())),
        "error": tree["error"] and tree["error"]["text"],
    }
    for name in FAULTS:
        fault = tree["faults"][name]
        low, high = fault["interval95"] or (None, None)
        row |= {name: fault["estimate"], f"{name}_std": fault["std"]}
        row |= {f"{name}_low95": low, f"{name}_high95": high}
    return {
        key: printable(value) if isinstance(value := row[key], str) else value for key in COLUMNS
    }
