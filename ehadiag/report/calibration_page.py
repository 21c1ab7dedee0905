"""The report of a calibration: one HTML page that needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.printable import printable
from ehadiag.core.shown_in import factor_and_unit
from ehadiag.model.parameters import parameter
from ehadiag.report.html import fill
from ehadiag.report.responses import draw_responses, modelled

if TYPE_CHECKING:
    from bokeh.models import LayoutDOM

    from ehadiag.calibration.result import Calibrated, Value
    from ehadiag.core.calibration import Calibration

__all__ = ["calibration_page"]

STRONG = 0.9
"""Correlation from which on two parameters are hardly told apart."""


def calibration_page(found: Calibrated, version: str, made: str) -> str:
    """Write the page.

    Parameters
    ----------
    found : Calibrated
        What was learned, or why nothing.
    version : str
        Of the program.
    made : str
        When the page is made: UTC, ISO 8601.

    Returns
    -------
    str
        HTML.
    """
    plots: dict[str, LayoutDOM] = {}
    pairs = zip(found.experiments, found.recordings, strict=False)
    responses = draw_responses(modelled((a, a.constants, b) for a, b in pairs), plots)
    unit = found.actuator
    calibration = unit.calibration if unit else None
    serial = calibration.serial if calibration else None
    return fill(
        "calibration.html.j2",
        plots,
        responses=responses,
        no_response="" if responses else "No responses are drawn: nothing was learned from them.",
        verdict="HEALTHY" if unit else "NOT_TESTED",
        words="CALIBRATED" if unit else "NOT CALIBRATED",
        meaning="The unit's own data and effects stand in its actuator file."
        if unit
        else "Nothing was learned; no actuator file was written.",
        reasons=_texts(found.reasons),
        unit=printable(f"{found.start.name}, serial {'unknown' if serial is None else serial}"),
        made=made,
        values=[_value(item) for item in found.values],
        held=_held(calibration),
        correlations=_correlations(calibration),
        strong=f"{STRONG:g}",
        severities=[
            {"name": item.name, "estimate": f"{item.value:.5f}", "std": f"{item.std:.5f}"}
            for item in found.severities
        ],
        tried=[
            {
                "words": item.words,
                "excess": f"{item.excess:.2f}",
                "criterion": f"{item.criterion:.0f}",
            }
            for item in found.tried
        ],
        second_stage=unit.second_stage.kind if unit else "none was chosen",
        recordings=_recordings(found, calibration),
        fit=_fit(calibration),
        notes=_texts(found.notes),
        origin=[
            ("actuator that it began with", printable(found.start.name)),
            ("seed of the search", str(found.seed)),
            ("model runs", str(found.evaluations)),
            ("time", f"{found.elapsed:.1f} s"),
            ("program", f"ehadiag {version}"),
        ],
    )


def _value(item: Value) -> dict[str, str]:
    factor, unit = factor_and_unit(item.unit, max(abs(item.start), abs(item.value)))
    return {
        "symbol": item.symbol,
        "meaning": item.meaning,
        "start": f"{item.start * factor:.6g}",
        "value": f"{item.value * factor:.6g}",
        "std": f"{item.std * factor:.2g}",
        "unit": unit,
        "shown": "shown" if item.shown else "hardly shown: little more is known than before",
    }


def _held(calibration: Calibration | None) -> list[tuple[str, str]]:
    """What the recordings do not show, and why it was held."""
    if calibration is None:
        return []
    return [(_short(name), printable(why)) for name, why in calibration.held.items()]


def _correlations(calibration: Calibration | None) -> dict[str, Any] | None:
    """Correlation of what is not known exactly; with the standard deviations the covariance."""
    if calibration is None:
        return None
    matrix = _correlation(calibration)
    names = [_short(name) for name in calibration.parameters]
    return {
        "names": names,
        "rows": [
            {
                "name": name,
                "std": f"{std:.2g}",
                "cells": [
                    {"text": f"{value:+.2f}", "strong": row != column and abs(value) >= STRONG}
                    for column, value in enumerate(values)
                ],
            }
            for row, (name, std, values) in enumerate(
                zip(names, calibration.std, matrix.tolist(), strict=True)
            )
        ],
    }


def _correlation(calibration: Calibration) -> NDArray[np.float64]:
    count = len(calibration.parameters)
    lower = np.zeros((count, count))
    for number, row in enumerate(calibration.root):
        lower[number, : number + 1] = row
    return lower @ lower.T


def _recordings(found: Calibrated, calibration: Calibration | None) -> list[Mapping[str, str]]:
    digests = [item.sha256 for item in calibration.recordings] if calibration else []
    return [
        {
            "source": printable(recording.source),
            "test": printable(test.name) if test else "unknown",
            "sha256": digests[number] if number < len(digests) else "",
        }
        for number, (recording, test) in enumerate(zip(found.recordings, found.tests, strict=True))
    ]


def _fit(calibration: Calibration | None) -> list[tuple[str, str]]:
    if calibration is None:
        return []
    fit = calibration.fit
    return [
        ("residuals over the noise", f"{fit.excess:.3g}"),
        ("rms of the spool's, in units of the noise", f"{fit.spool_rms:.3g}"),
        ("rms of the pressure's, in units of the noise", f"{fit.pressure_rms:.3g}"),
        ("outliers", f"{fit.outliers:.2%}"),
    ]


def _short(name: str) -> str:
    try:
        return parameter(name).short
    except KeyError:
        return printable(name)


def _texts(values: tuple[str, ...]) -> list[str]:
    return [printable(value) for value in values]
