"""The report: one HTML page that needs no network, from a JSON result and what is at hand with it.

Every text of others is escaped by the template, and none is handed to a script.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ehadiag.core.printable import printable
from ehadiag.core.shown_in import factor_and_unit
from ehadiag.history.fingerprint import hash_of_file
from ehadiag.model.parameters import parameter
from ehadiag.report.html import fill
from ehadiag.report.plots import plot_severities, plot_trend
from ehadiag.report.prognosis_table import levels_named, remaining_text
from ehadiag.report.responses import Drawn, draw_responses, expected, modelled

if TYPE_CHECKING:
    from bokeh.models import LayoutDOM

    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.verdict import Levels
    from ehadiag.history.records import Entry, Event
    from ehadiag.prognosis.unit import Prognosis

__all__ = ["Trend", "page_of"]

LIBRARIES = ("python", "numpy", "numba")
UNITS = ("mm", "MPa")
MEANING = {
    "HEALTHY": "No severity is at or above the advisory level.",
    "DEGRADED": "A severity is, or may be, at or above the advisory level.",
    "FAULT": "A severity is at or above the limit.",
    "NOT_TESTED": "No verdict can be given.",
}


@dataclass(frozen=True, slots=True)
class Trend:
    """The unit's history, and what it says of the future."""

    entries: Sequence[Entry]
    """That count."""
    events: Sequence[Event]
    prognosis: Prognosis


def page_of(
    result: Mapping[str, Any],
    levels: Levels,
    version: str,
    made: str,
    diagnosis: Diagnosis | None = None,
    trend: Trend | None = None,
) -> str:
    """Write the page.

    Parameters
    ----------
    result : Mapping[str, Any]
        A JSON result.
    levels : Levels
        Advisory level and limit.
    version : str
        Of the program.
    made : str
        When the page is made: UTC, ISO 8601.
    diagnosis : Diagnosis | None
        That the result is of; None: samples are not at hand, and no responses are drawn.
    trend : Trend | None
        History of the unit.

    Returns
    -------
    str
        HTML.
    """
    plots: dict[str, LayoutDOM] = {}
    rows = _rows(result)
    if rows:
        plots["severities"] = plot_severities(rows, levels.advisory, levels.limit)
    responses = draw_responses(_drawn(diagnosis), plots)
    if trend is not None and any(entry.severities for entry in trend.entries):
        unit = trend.prognosis.unit if trend.prognosis.used else None
        plots["trend"] = plot_trend(
            trend.entries, trend.events, unit, (levels.advisory, levels.limit)
        )
    verdict = str(result.get("verdict"))
    serial = result.get("serial")
    return fill(
        "report.html.j2",
        plots,
        responses=responses,
        no_response="" if responses else "No responses are drawn: samples are not at hand.",
        verdict=verdict if verdict in MEANING else "NOT_TESTED",
        words=_text(verdict.replace("_", " ")),
        meaning=MEANING.get(verdict, ""),
        reasons=_texts(result.get("reasons")),
        unit=_text(f"{result.get('actuator')}, serial {'unknown' if serial is None else serial}"),
        test=_text(result.get("test") or "unknown"),
        made=made,
        advisory=f"{levels.advisory:g}",
        limit=f"{levels.limit:g}",
        faults=_faults(result, levels),
        hidden=_hidden(result),
        effects=_effects(diagnosis),
        quality=_quality(result),
        notes=_texts(_part(result, "quality").get("notes")),
        origin=_origin(result, diagnosis, version),
        **_trend(trend),
    )


def _drawn(diagnosis: Diagnosis | None) -> list[Drawn]:
    """Of each recording: what was identified, or what was to be expected, beside the measured."""
    if diagnosis is None:
        return []
    found = diagnosis.identification
    if found is None or not all(math.isfinite(item.value) for item in found.estimates):
        pairs = zip(diagnosis.recordings, diagnosis.tests, strict=True)
        return expected(pairs, diagnosis.actuator)
    return modelled(
        (item, found.constants(item.constants), recording)
        for item, recording in zip(diagnosis.experiments, diagnosis.recordings, strict=False)
    )


def _rows(result: Mapping[str, Any]) -> list[tuple[str, float, float, float]]:
    return [
        (_text(name), fault["estimate"], *fault["interval95"])
        for name, fault in _part(result, "faults").items()
        if fault.get("estimate") is not None and fault.get("interval95") is not None
    ]


def _faults(result: Mapping[str, Any], levels: Levels) -> list[dict[str, str]]:
    out = []
    for name, fault in _part(result, "faults").items():
        value, interval = fault.get("estimate"), fault.get("interval95")
        none = value is None or interval is None
        out.append(
            {
                "name": _text(name),
                "meaning": _meaning(name),
                "estimate": "none" if none else f"{value:.5f}",
                "interval": "none" if none else f"{interval[0]:.5f} … {interval[1]:.5f}",
                "standing": "not known"
                if none
                else _standing(value, interval[1], levels)
                + (", at its bound" if "at_bound" in (fault.get("flags") or ()) else ""),
            }
        )
    return out


def _standing(value: float, high: float, levels: Levels) -> str:
    if value >= levels.limit:
        return "at or above the limit"
    if value >= levels.advisory:
        return "at or above the advisory level"
    return "may be above the advisory level" if high >= levels.advisory else "below both"


def _meaning(name: str) -> str:
    try:
        return parameter(name).short
    except KeyError:
        return ""


def _hidden(result: Mapping[str, Any]) -> list[str]:
    out = []
    for name, fault in _part(result, "faults").items():
        flags = fault.get("flags") or ()
        if fault.get("estimate") is None:
            out.append(f"{_text(name)}: nothing was identified")
        if "not_shown" in flags:
            out.append(f"{_text(name)}: the test does not show it")
    return out


def _effects(diagnosis: Diagnosis | None) -> list[dict[str, str]]:
    if diagnosis is None or diagnosis.identification is None:
        return []
    out = []
    for name, item in diagnosis.identification.nuisances.items():
        known = parameter(name)
        factor, unit = factor_and_unit(known.unit, item.value)
        bound = " (at its bound)" if item.at_bound else ""
        cells = {
            "value": f"{factor * item.value:.4g}{bound}",
            "std": f"{factor * item.std:.2g}",
            "unit": unit,
        }
        out.append({"name": known.short, **cells})
    return out


def _quality(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    out = []
    for part in ("quality", "fit"):
        for name, value in _part(result, part).items():
            if name == "notes":
                continue
            if isinstance(value, dict):
                shown = ", ".join(f"{key} {_number(count)}" for key, count in value.items())
            else:
                shown = _number(value)
            out.append((_quantity(name), _text(shown)))
    return out


def _quantity(key: str) -> str:
    """Words for a key of the result: `spool_noise_mm` is the spool noise, mm."""
    words = key.replace("crc", "CRC").replace("_", " ")
    for unit in UNITS:
        words = words.removesuffix(f" {unit}") + f", {unit}" * words.endswith(f" {unit}")
    return _text(words)


def _origin(
    result: Mapping[str, Any], diagnosis: Diagnosis | None, version: str
) -> list[tuple[str, str]]:
    solver = _part(result, "solver")
    out = [("recording", _text(result.get("source")))]
    for item in diagnosis.recordings if diagnosis is not None else ():
        out.append(("SHA-256 of the recording", hash_of_file(item.source) or "no file"))
    package = _part(result, "package")
    made_with = [f"{key} {_text(package[key])}" for key in LIBRARIES if key in package]
    out += [
        ("date of the test", _text(result.get("date"))),
        ("actuator", _text(result.get("actuator"))),
        ("SHA-256 of its data", _text(result.get("actuator_sha256"))),
        ("serial number", _text(result.get("serial"))),
        ("test", _text(result.get("test"))),
        ("search", f"{_text(solver.get('name'))}, seed {_text(solver.get('seed'))}"),
        ("result", _text(result.get("schema"))),
        ("program", ", ".join([f"ehadiag {version}", *made_with])),
    ]
    return out


def _trend(trend: Trend | None) -> dict[str, Any]:
    if trend is None:
        return {"alarms": [], "events": [], "remaining": [], "remaining_head": []}
    future = trend.prognosis
    head = ["severity", "now"]
    head += [f"{future.unit} to {name} {level:g}" for name, level in levels_named(future)]
    return {
        "alarms": [f"{item.name} {item.alarm}" for item in future.forecasts if item.alarm],
        "events": [_text(f"{item.when[:10]}: {item.text}") for item in trend.events],
        "remaining_head": head,
        "remaining": [
            [
                item.name,
                "none" if item.value is None else f"{item.value:.4f}",
                *(remaining_text(left) for left in item.remaining),
            ]
            for item in future.forecasts
        ],
    }


def _part(result: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return an object of the result; an empty one where it is null."""
    found = result.get(name)
    return found if isinstance(found, dict) else {}


def _texts(values: Any) -> list[str]:
    return [_text(value) for value in values or ()]


def _text(value: Any) -> str:
    return printable("unknown" if value is None else str(value))


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "none" if value is None else str(value)
