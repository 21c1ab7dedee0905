"""Pictures and pages of a result as bytes; matplotlib and bokeh are loaded only when needed.

A working folder's matplotlib settings and fonts are not used.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from ehadiag.assess.verdict import Levels
from ehadiag.core.conventions import __version__

if TYPE_CHECKING:
    from ehadiag.calibration.unit_models import Calibrated
    from ehadiag.report.picture import Picture
    from ehadiag.report.report_pages import UnitTrend
    from ehadiag.result import Result


@contextlib.contextmanager
def _isolated_matplotlib() -> Iterator[None]:
    """Load matplotlib in a folder of its own.

    It reads `matplotlibrc` in the working folder, which may be anybody's, and keeps a list of fonts
    in a folder that need not be safe either.
    """
    import tempfile  # noqa: PLC0415

    from firmware_iface.files import private_folder  # noqa: PLC0415

    if "matplotlib" in sys.modules:
        yield
        return
    with contextlib.ExitStack() as stack:
        own = private_folder("matplotlib")
        if own is None:
            place = stack.enter_context(tempfile.TemporaryDirectory(prefix="ehadiag-"))
        else:
            stack.enter_context(own)
            place = str(own.path)
        os.environ.setdefault("MPLCONFIGDIR", place)
        with contextlib.suppress(OSError):
            stack.enter_context(contextlib.chdir(place))
        yield


def diagnosis_png(result: Result) -> bytes:
    """Return the picture of a result as a PNG; see `Result.can_be_drawn`."""
    from ehadiag.report.response_signals import result_picture  # noqa: PLC0415

    return isolated_png(result_picture(result))


def isolated_png(picture: Picture) -> bytes:
    """Return a picture as a PNG; matplotlib is loaded in a folder of its own."""
    with _isolated_matplotlib():
        from ehadiag.report.matplotlib_figures import picture_png  # noqa: PLC0415 - slow

    return picture_png(picture)


def diagnosis_html_page(result: Result, levels: Levels, history: Path | None) -> bytes:
    """Return the page of a result, with its trend where there is a history, as UTF-8.

    Responses are drawn where the result's diagnosis is at hand.
    """
    from ehadiag.history.records import current_utc_text  # noqa: PLC0415
    from ehadiag.report.report_pages import diagnosis_page  # noqa: PLC0415 - bokeh is slow

    trend = None if history is None else _unit_trend(result, levels, history)
    page = diagnosis_page(result, levels, __version__, current_utc_text(), trend)
    return page.encode("utf-8", errors="backslashreplace")


def index_html_page(
    results: Sequence[tuple[Result, Path]], place: Path, levels: Levels, history: Path | None
) -> bytes:
    """Return a page with a line for each result and a link to its report, as UTF-8.

    place: where the page goes; links are relative to it; history: health history, for trends and
    remaining life; None: none is drawn.
    """
    from ehadiag.report.fleet_table import (  # noqa: PLC0415
        FleetUnit,
        fleet_summary,
        fleet_table,
        levels_text,
    )
    from ehadiag.report.head import verdict_word  # noqa: PLC0415
    from ehadiag.report.page_parts import templates_of  # noqa: PLC0415 - bokeh is slow

    units = []
    for result, page in results:
        trend = None if history is None else _unit_trend(result, levels, history)
        past = [
            max(item.estimate or 0.0 for item in entry.severities)
            for entry in (trend.entries if trend else ())
            if entry.severities
        ]
        link = quote(os.path.relpath(page, place.parent).replace(os.sep, "/"))
        units.append(
            FleetUnit(
                serial=result.serial,
                actuator=result.actuator,
                verdict=result.verdict.name,
                word=verdict_word(result.verdict.name, identified=result.identified),
                severities=tuple(result.severities.values()),
                past=past,
                tested=result.date or "",
                link=link,
                prognosis=trend.prognosis if trend else None,
            )
        )
    template = templates_of("ehadiag.report").get_template("index.html.j2")
    head, rows = fleet_table(units, levels)
    page_text = template.render(
        head=head, rows=rows, summary=fleet_summary(units), levels=levels_text(levels)
    )
    return page_text.encode("utf-8", errors="backslashreplace")


def calibration_html_page(found: Calibrated) -> bytes:
    """Return the page of a calibration as UTF-8."""
    from ehadiag.history.records import current_utc_text  # noqa: PLC0415
    from ehadiag.report.report_pages import calibration_page  # noqa: PLC0415 - bokeh is slow

    page = calibration_page(found, __version__, current_utc_text())
    return page.encode("utf-8", errors="backslashreplace")


def _unit_trend(result: Result, levels: Levels, place: Path) -> UnitTrend | None:
    from ehadiag.history.records import counted_entries, of_unit  # noqa: PLC0415
    from ehadiag.history.store import History  # noqa: PLC0415
    from ehadiag.prognosis.units import prognosis_of  # noqa: PLC0415
    from ehadiag.report.report_pages import UnitTrend  # noqa: PLC0415

    serial, kind = result.serial, result.actuator
    if serial is None or not place.exists():
        return None
    with History(place) as history:
        entries, events = history.alike(serial, kind)
    mine, own = of_unit(entries, events, serial, kind)
    if not (mine := counted_entries(mine)):
        return None
    both = (levels.advisory, levels.limit)
    future = prognosis_of(serial, entries, events, both, actuator=kind)
    return UnitTrend(mine, own, future)
