"""The report: one HTML page that needs no network, from a JSON result and what is at hand with it.

The page allows no source beyond itself: a Content-Security-Policy names the hashes of its own
scripts. Every text of others is escaped by the template, and none is handed to a script.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ehadiag.core.printable import printable
from ehadiag.history.fingerprint import hash_of_file
from ehadiag.model.parameters import parameter
from ehadiag.report.modelled import signals_of
from ehadiag.report.plots import embedded, plot_response, plot_severities, plot_trend
from ehadiag.report.prognosis_table import levels_named, remaining_text

if TYPE_CHECKING:
    from bokeh.models import LayoutDOM

    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.verdict import Levels
    from ehadiag.history.records import Entry, Event
    from ehadiag.prognosis.unit import Prognosis

__all__ = ["Trend", "page_of"]

MEANING = {
    "HEALTHY": "No severity is at or above the advisory level.",
    "DEGRADED": "A severity is, or may be, at or above the advisory level.",
    "FAULT": "A severity is at or above the limit.",
    "NOT_TESTED": "No verdict can be given.",
}
MOST_RESPONSES = 6
"""Recordings whose responses are drawn: the page stays below three megabytes."""


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
    labels = _responses(diagnosis, plots)
    if trend is not None and any(entry.severities for entry in trend.entries):
        unit = trend.prognosis.unit if trend.prognosis.used else None
        plots["trend"] = plot_trend(
            trend.entries, trend.events, unit, (levels.advisory, levels.limit)
        )
    scripts, elements = embedded(plots)
    found = {name: Markup(element) for name, element in elements.items()}
    verdict = str(result.get("verdict"))
    serial = result.get("serial")
    return _template().render(
        policy=_policy(scripts),
        scripts=[Markup(script) for script in scripts],
        plots={"severities": found.get("severities"), "trend": found.get("trend")},
        responses=[
            {"source": source, "label": label, "plot": found[key]}
            for key, (source, label) in labels.items()
        ],
        no_response=""
        if labels
        else "No responses are drawn: samples, or what was identified from them, are not at hand.",
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


@cache
def _template() -> Any:
    environment = Environment(
        loader=PackageLoader("ehadiag.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("report.html.j2")


def _policy(scripts: Sequence[str]) -> str:
    """Nothing from anywhere but this page; of scripts only its own."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(item.encode()).digest()).decode()}'"
        for item in scripts
    )
    allowed = hashes or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data:; font-src data:; base-uri 'none'; form-action 'none'"
    )


def _responses(
    diagnosis: Diagnosis | None, plots: dict[str, LayoutDOM]
) -> dict[str, tuple[str, str]]:
    """Add a plot for each recording; return its source and its words for those who do not see."""
    if diagnosis is None or diagnosis.identification is None:
        return {}
    found = diagnosis.identification
    out = {}
    pairs = zip(diagnosis.experiments, diagnosis.recordings, strict=False)
    for number, (experiment, recording) in enumerate(pairs):
        if recording.samples is None or number == MOST_RESPONSES:
            break
        signals = signals_of(experiment, found, recording.samples.current)
        key = f"response{number}"
        plots[key] = plot_response(signals, experiment.tick, experiment.test)
        out[key] = (
            _text(recording.source),
            "Measured and modelled current, spool position, differential pressure and jack"
            f" position over {experiment.test.duration:g} s. Rms residual: spool"
            f" {found.fit.spool_rms:.2f}, pressure {found.fit.pressure_rms:.2f} of the noise.",
        )
    return out


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
        bound = " (at its bound)" if item.at_bound else ""
        cells = {"value": f"{item.value:.4g}{bound}", "std": f"{item.std:.2g}", "unit": known.unit}
        out.append({"name": known.short, **cells})
    return out


def _quality(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    out = []
    for part in ("quality", "fit"):
        for name, value in _part(result, part).items():
            if name == "notes":
                continue
            shown = json.dumps(value) if isinstance(value, dict) else _number(value)
            out.append((_text(name.replace("_", " ")), _text(shown)))
    return out


def _origin(
    result: Mapping[str, Any], diagnosis: Diagnosis | None, version: str
) -> list[tuple[str, str]]:
    solver = _part(result, "solver")
    out = [("recording", _text(result.get("source")))]
    for item in diagnosis.recordings if diagnosis is not None else ():
        out.append(("SHA-256 of the recording", hash_of_file(item.source) or "no file"))
    out += [
        ("actuator", _text(result.get("actuator"))),
        ("serial number", _text(result.get("serial"))),
        ("test", _text(result.get("test"))),
        ("search", f"{_text(solver.get('name'))}, seed {_text(solver.get('seed'))}"),
        ("result", _text(result.get("schema"))),
        ("program", f"ehadiag {version}"),
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
