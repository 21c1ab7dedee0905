"""Writes the report: one HTML page, with the trend of the unit where there is a history."""

from __future__ import annotations

import argparse
import json
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.assess.verdict import Levels
from ehadiag.core.errors import ConfigurationError

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.calibration.result import Calibrated
    from ehadiag.report.page import Trend

__all__ = ["add_report_option", "calibration_report", "need_report_library", "report_of"]


def add_report_option(parser: argparse.ArgumentParser, place: str = "to the output folder") -> None:
    """Add `--report`; `place` says where the page goes."""
    parser.add_argument(
        "--report",
        action="store_true",
        help=f"also write a report, one HTML page that needs no network, {place}"
        " (needs ehadiag[report])",
    )


def need_report_library() -> None:
    """Raise ConfigurationError where the libraries of reports are not installed."""
    if find_spec("bokeh") is None or find_spec("jinja2") is None:
        raise ConfigurationError("a report needs bokeh and jinja2: pip install 'ehadiag[report]'")


def report_of(
    line: str, levels: Levels, history: Path | None, diagnosis: Diagnosis | None = None
) -> bytes:
    """Return the page.

    Parameters
    ----------
    line : str
        JSON result.
    levels : Levels
        Advisory level and limit.
    history : Path | None
        Of the unit; None: no trend.
    diagnosis : Diagnosis | None
        That the result is of; None: no responses are drawn.

    Returns
    -------
    bytes
        HTML, UTF-8.
    """
    from ehadiag import __version__  # noqa: PLC0415
    from ehadiag.history.keep import now  # noqa: PLC0415
    from ehadiag.report.page import page_of  # noqa: PLC0415 - bokeh is slow

    result = json.loads(line)
    trend = None if history is None else _trend(result, levels, history)
    page = page_of(result, levels, __version__, now(), diagnosis, trend)
    return page.encode("utf-8", errors="backslashreplace")


def calibration_report(found: Calibrated) -> bytes:
    """Return the page of a calibration.

    Parameters
    ----------
    found : Calibrated
        What was learned, or why nothing.

    Returns
    -------
    bytes
        HTML, UTF-8.
    """
    from ehadiag import __version__  # noqa: PLC0415
    from ehadiag.history.keep import now  # noqa: PLC0415
    from ehadiag.report.calibration_page import calibration_page  # noqa: PLC0415 - bokeh is slow

    page = calibration_page(found, __version__, now())
    return page.encode("utf-8", errors="backslashreplace")


def _trend(result: dict[str, Any], levels: Levels, place: Path) -> Trend | None:
    from ehadiag.history.counted import counted  # noqa: PLC0415
    from ehadiag.history.store import History  # noqa: PLC0415
    from ehadiag.prognosis.unit import prognosis_of  # noqa: PLC0415
    from ehadiag.report.page import Trend  # noqa: PLC0415

    serial = result.get("serial")
    if not isinstance(serial, int) or not place.exists():
        return None
    with History(place) as history:
        entries, events = history.entries(), history.events()
    mine = counted([item for item in entries if item.serial == serial])
    if not mine:
        return None
    future = prognosis_of(serial, entries, events, (levels.advisory, levels.limit))
    return Trend(mine, [item for item in events if item.serial == serial], future)
