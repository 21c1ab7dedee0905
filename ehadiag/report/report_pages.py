"""HTML reports of a diagnosis and of a calibration, one page each that needs no network.

The templates escape every text, and no script gets a text of others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ehadiag.core.conventions import display_unit, to_precision
from ehadiag.core.criteria import FIT
from ehadiag.history.records import hash_of_file
from ehadiag.model.registry import parameter
from ehadiag.report.bokeh_plots import MAX_PAGE_VALUES, plot_column
from ehadiag.report.head import full_name, head_of, percent
from ehadiag.report.page_parts import render_template
from ehadiag.report.prognosis_tables import named_levels, remaining_text
from ehadiag.report.response_signals import calibration_columns, response_columns
from ehadiag.report.trend_bus_pictures import has_trend, trend_column

if TYPE_CHECKING:
    from bokeh.models import LayoutDOM

    from ehadiag.assess.verdict import Levels
    from ehadiag.calibration.unit_models import Calibrated
    from ehadiag.core.actuator import Calibration
    from ehadiag.history.records import Entry, MaintenanceEvent
    from ehadiag.prognosis.units import Prognosis
    from ehadiag.report.head import Bar
    from ehadiag.report.picture import PictureColumn
    from ehadiag.result import Result

MAX_PAGE_RESPONSES = 4
"""Number of responses drawn: two seconds of processor time, and less than three megabytes."""


class UnitTrend(msgspec.Struct, frozen=True):
    """The unit's history and prognosis."""

    entries: Sequence[Entry]
    events: Sequence[MaintenanceEvent]
    prognosis: Prognosis


def diagnosis_page(
    result: Result, levels: Levels, version: str, made: str, trend: UnitTrend | None = None
) -> str:
    """Write the page of a diagnosis.

    result: responses are drawn where its diagnosis is at hand; version: of the program; made: when
    the page is made: UTC, ISO 8601.
    """
    plots: dict[str, LayoutDOM] = {}
    columns = response_columns(result.diagnosis) if result.at_hand else ()
    responses = _draw_responses((column for _, column in columns), plots)
    if trend is not None and has_trend(trend.entries):
        plots["trend"] = plot_column(trend_column(trend.entries, trend.events, trend.prognosis))
    verdict = result.verdict.name
    future = trend.prognosis if trend else None
    head = head_of(result, levels, future)
    faults = [_fault(bar) for bar in head.bars]
    dated = [f"{label} {date}" for label, date in head.facts if label in ("tested", "recorded")]
    return render_template(
        "report.html.j2",
        plots,
        responses=responses,
        no_response="" if responses else "No responses are drawn: samples are not at hand.",
        verdict=verdict,
        head=head,
        percent=percent,
        running=", ".join([head.title, *dated]),
        full_name=full_name,
        made=made,
        levels=levels,
        faults=faults,
        effects=_effects(result),
        quality=_quality(result),
        notes=result.notes,
        origin=_origin(result, version),
        forecasts=future.forecasts if future else (),
        remaining_head=[
            f"{future.unit} to {name} {level:g}" for name, level in named_levels(future)
        ]
        if future
        else [],
        remaining_text=remaining_text,
        events=trend.events if trend else (),
    )


def _draw_responses(
    columns: Iterable[PictureColumn], plots: dict[str, LayoutDOM]
) -> list[dict[str, Any]]:
    """Add a plot for each of the first responses; return what the template shows of them."""
    shown = list(itertools.islice(columns, MAX_PAGE_RESPONSES))
    most = MAX_PAGE_VALUES // max(len(shown), 1)
    out = []
    for number, column in enumerate(shown):
        key, names = f"response{number}", [panel.name for panel in column.panels]
        plots[key] = plot_column(column, most)
        ticks, end = len(column.panels[0].x), column.panels[0].x[-1]
        words = f"{column.title} {', '.join(names[:-1])} and {names[-1]} over {end:.3g} s"
        residuals = [
            f"{panel.name} {np.sqrt(np.nanmean(panel.residual**2)):.3g} {panel.small_unit}"
            for panel in column.panels
            if panel.residual is not None
        ]
        if residuals:
            words += f"; rms residual over the whole test: {', '.join(residuals)}"
        out.append(
            {"key": key, "column": column, "words": f"{words}.", "ticks": ticks,
             "drawn": min(most, ticks)}
        )  # fmt: skip
    return out


def _fault(bar: Bar) -> dict[str, Any]:
    return {
        "name": bar.name if bar.name == bar.symbol else f"{bar.name} ({bar.symbol})",
        "estimate": bar.value,
        "interval": bar.interval,
        "standing": bar.standing,
    }


def _effects(result: Result) -> list[dict[str, str]]:
    out = []
    for item in result.effects:
        if item.value is None or item.std is None:
            continue
        factor, unit = display_unit(item.unit, item.value)
        value, std = to_precision(factor * item.std, factor * item.value, factor * item.std)
        value += " (at its bound)" * item.at_bound
        std = std if result.relied_on else "none"
        out.append({"name": item.meaning or item.name, "value": value, "std": std, "unit": unit})
    return out


GOOD_QUALITY: Mapping[str, tuple[str, Callable[[float], bool]]] = {
    **dict.fromkeys(
        ("lost", "repeated", "conflicts", "crc_errors", "out_of_order", "length_errors",
         "range_errors", "error_frames"),
        ("0", lambda count: count == 0),
    ),
    "spool_rms": (f"about 1, at most {FIT.max_rms:g}", lambda rms: rms <= FIT.max_rms),
    "pressure_rms": (f"about 1, at most {FIT.max_rms:g}", lambda rms: rms <= FIT.max_rms),
    "outliers": (
        f"at most {FIT.max_outlier_share:g}", lambda share: share <= FIT.max_outlier_share
    ),
}  # fmt: skip
"""What is good of a quantity, in words and as a test: bounds of a verdict, or none lost at all."""


def _quality(result: Result) -> list[tuple[str, str, str, bool]]:
    """Return quantity, what was found, what is good, and whether it is."""
    parts = [msgspec.structs.asdict(part) for part in (result.quality, result.fit) if part]
    out = []
    for name, value in (pair for part in parts for pair in part.items() if pair[0] != "notes"):
        text = _number(value)
        if isinstance(value, dict):
            text = ", ".join(f"{key} {_number(count)}" for key, count in value.items())
        words, is_good = GOOD_QUALITY.get(name, ("", lambda _: True))
        known = isinstance(value, int | float)
        out.append((_quantity(name), text, words if known else "", known and is_good(value)))
    return out


def _quantity(key: str) -> str:
    """Words for a key of the result: `spool_noise_mm` is the spool noise, mm."""
    words = key.replace("crc", "CRC").replace("_", " ")
    for unit in ("mm", "MPa"):
        words = words.removesuffix(f" {unit}") + f", {unit}" * words.endswith(f" {unit}")
    return words


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "none" if value is None else str(value)


def _origin(result: Result, version: str) -> list[tuple[str, Any]]:
    package = result.package
    libraries = f"python {package.python}, numpy {package.numpy}, numba {package.numba}"
    return [
        ("recording", result.source),
        *(
            ("SHA-256 of the recording", hash_of_file(item.source) or "no file")
            for item in (result.recordings if result.at_hand else ())
        ),
        ("date of the test", result.date),
        ("actuator", result.actuator),
        ("SHA-256 of its data", result.actuator_sha256),
        ("serial number", result.serial),
        ("test", result.test),
        ("search", f"{result.solver}, seed {result.seed}"),
        ("result", result.schema),
        ("program", f"ehadiag {version}, {libraries}"),
    ]


def _or_unknown(value: Any) -> str:
    return "unknown" if value is None else str(value)


def _short_name(name: str, otherwise: str) -> str:
    try:
        return parameter(name).short
    except KeyError:
        return otherwise


def calibration_page(found: Calibrated, version: str, made: str) -> str:
    """Write the page of a calibration, or of why there is none; made: UTC, ISO 8601."""
    plots: dict[str, LayoutDOM] = {}
    responses = _draw_responses(calibration_columns(found), plots)
    unit = found.actuator
    calibration = unit.calibration if unit else None
    digests = [item.sha256 for item in calibration.recordings] if calibration else []
    return render_template(
        "calibration.html.j2",
        plots,
        found=found,
        responses=responses,
        no_response="" if responses else "No responses are drawn: nothing was learned from them.",
        verdict="HEALTHY" if unit else "NOT_TESTED",
        words="CALIBRATED" if unit else "NOT CALIBRATED",
        meaning="The unit's own data and effects stand in its actuator file."
        if unit
        else "Nothing was learned; no actuator file was written.",
        reasons=found.reasons,
        unit=f"{found.start.name}, serial {_or_unknown(calibration and calibration.serial)}",
        made=made,
        running=f"calibration, {made[:16].replace('T', ' ')}",
        values=[
            (item, *display_unit(item.unit, max(abs(item.start), abs(item.value))))
            for item in found.values
        ],
        held=[(_short_name(name, name), why) for name, why in calibration.held.items()]
        if calibration
        else [],
        correlations=_correlations(calibration) if calibration else None,
        recordings=list(
            itertools.zip_longest(found.recordings, found.tests, digests[-len(found.recordings) :])
        ),
        calibration=calibration,
        version=version,
    )


def _correlations(calibration: Calibration) -> dict[str, Any]:
    """Correlation of the estimates; with the standard deviations it is the covariance."""
    count = len(calibration.parameters)
    lower = np.zeros((count, count))
    for number, row in enumerate(calibration.root):
        lower[number, : number + 1] = row
    names = [_short_name(name, name) for name in calibration.parameters]
    rows = zip(names, calibration.std, (lower @ lower.T).tolist(), strict=True)
    # From the correlation 0.9 on two parameters are hardly told apart.
    return {"names": names, "rows": list(rows), "strong": 0.9}
