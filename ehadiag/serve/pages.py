"""The pages: live view, health history, reports; the templates escape every text of others."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup
from msgspec import structs

from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.core.conventions import MAX_RESULT_BYTES, shown_date
from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, MaintenanceEvent, counted_entries, of_unit
from ehadiag.history.store import History
from ehadiag.model.registry import FAULT_NAMES
from ehadiag.prognosis.units import Prognosis, prognosis_of
from ehadiag.report.bokeh_plots import plot_column, plot_live_signals
from ehadiag.report.fleet_table import Cell, FleetUnit, fleet_summary, fleet_table, levels_text
from ehadiag.report.head import (
    full_name,
    percent,
    plain_name,
    verdict_word,
)
from ehadiag.report.page_parts import embed_plots, script_sources, templates_of
from ehadiag.report.prognosis_tables import named_levels, remaining_text
from ehadiag.report.trend_bus_pictures import (
    first_to_the_limit,
    has_trend,
    kept_advice,
    trend_column,
)
from ehadiag.result import Result
from ehadiag.serve.server import Page
from firmware_iface import FREE_MOTION
from firmware_iface.errors import EhadiagError, printable
from firmware_iface.files import read_small_file

MAX_PAGE_ROWS = 500
"""Of a list, newest first."""
REPORT_CONTENT_POLICY = "sandbox allow-scripts"
"""A report may be anybody's file: its scripts run, but not in the name of this server."""


class Pages:
    """Makes the page of a path.

    folder: where results and reports go; history: health history; None: none is kept; tests: that
    the page offers to start; simulated: whether tests run on a simulated unit.
    """

    def __init__(
        self,
        folder: Path,
        history: Path | None,
        levels: Levels,
        tests: Sequence[str],
        *,
        simulated: bool = False,
    ) -> None:
        self._folder = folder
        self._history = history
        self._levels = levels
        self._tests = tuple(tests)
        self._simulated = simulated
        self._fleet: tuple[object, tuple[str, ...], list[list[Cell]], str] = (None, (), [], "")
        self._live: Page | None = None

    def __call__(self, path: str) -> Page | None:
        """Return the page of a path; None where there is none.

        path: decoded, such as `/history/7`. EhadiagError: the history or a file cannot be read.
        """
        if path == "/session":
            # Made once: a plotting library of a megabyte is in it.
            self._live = self._live or self._live_page()
            return self._live
        whole: dict[str, Callable[[], Page]] = {
            "/": self._fleet_page,
            "/reports": self._reports_page,
        }
        if path in whole:
            return whole[path]()
        start, _, rest = path[1:].partition("/")
        if start == "history" and rest.isdecimal() and rest.isascii() and len(rest) < 20:
            return self._unit_page(int(rest))
        return self._report(rest) if start == "reports" else None

    def _live_page(self) -> Page:
        scripts, elements = embed_plots({"signals": plot_live_signals()})
        own = files("ehadiag.serve").joinpath("templates/live.js").read_text(encoding="utf-8")
        return _page(
            "live.html.j2",
            [*scripts, own],
            title="Test",
            here="/session",
            tests=self._tests,
            simulated=self._simulated,
            faults=[(name, plain_name(name), full_name(name)) for name in FAULT_NAMES],
            plots=[Markup(item) for item in elements.values()],
        )

    def _fleet_page(self) -> Page:
        """Return the units, worst first, with trend and time left."""
        place, none = self._history, "No diagnosis is kept yet: run a test."
        stamp = place.stat().st_mtime_ns if place is not None and place.exists() else None
        if stamp != self._fleet[0] or stamp is None:
            try:
                units = self._units()
                self._fleet = stamp, *fleet_table(units, self._levels), fleet_summary(units)
            except EhadiagError as error:  # the other pages do without it
                self._fleet, none = (None, (), [], ""), str(error)
        if place is None:
            none = "No history is kept: --history."
        _, head, rows, summary = self._fleet
        lines = (f"{levels_text(self._levels)} Worst unit first.",) if rows else ()
        shown = rows[:MAX_PAGE_ROWS]
        return self._list("Fleet", "/", head, shown, none=none, lines=lines, summary=summary)

    def _units(self) -> list[FleetUnit]:
        entries, events = self._kept()
        by_unit: dict[int | None, list[Entry]] = {}
        for entry in entries:
            by_unit.setdefault(entry.serial, []).append(entry)
        counted = {serial: counted_entries(mine) for serial, mine in by_unit.items()}
        newest = {serial: _last_test(mine) for serial, mine in counted.items()}
        known = [serial for serial in newest if serial is not None]
        known.sort(key=lambda serial: -_worst_value(newest[serial]))
        levels = (self._levels.advisory, self._levels.limit)
        futures = {
            serial: prognosis_of(serial, entries, events, levels)
            # Some 0.3 s each.
            for serial in known[:20]
        }
        return [
            FleetUnit(
                serial=serial,
                actuator=last.actuator,
                verdict=last.verdict,
                word=_word(last),
                severities=self._advised(last) if serial in futures else last.severities,
                past=[
                    _worst_value(item)
                    for item in counted[serial]
                    if item.severities and item.by_test
                ],
                tested=last.tested or last.appended,
                link="" if serial is None else f"/history/{serial}",
                prognosis=futures.get(serial) if serial is not None else None,
            )
            for serial, last in newest.items()
        ]

    def _advised(self, entry: Entry) -> list[Severity]:
        """Severities with what to do about them, which only the whole result has."""
        advice = kept_advice(self._result_of(entry))
        return [
            structs.replace(item, advice=advice.get(item.name, "")) for item in entry.severities
        ]

    def _unit_page(self, serial: int) -> Page:
        """Return one unit's diagnoses, trend and remaining life."""
        entries, events = self._kept(serial)
        levels = (self._levels.advisory, self._levels.limit)
        future = prognosis_of(serial, entries, events, levels)
        mine, own = of_unit(entries, events, serial, future.actuator)
        used = counted_entries(mine)
        last = _last_test(used) if used else None
        first = first_to_the_limit(future, kept_advice(self._result_of(last)))
        lines = [" ".join(first)] if first else []
        lines += [
            f"{plain_name(item.name)} {item.alarm}" for item in future.forecasts if item.alarm
        ]
        lines += [f"{item.when[:10]}: {printable(item.text)}" for item in own]
        plots = {}
        if has_trend(used):
            plots["trend"] = plot_column(trend_column(used, own, future))
        return self._list(
            f"Unit {serial}",
            "",
            ["test", "verdict", "severities"],
            [_diagnosed(entry) for entry in mine[::-1][:MAX_PAGE_ROWS]],
            none="No diagnosis of this unit is kept.",
            lines=lines,
            plots=plots,
            summary=_word(last) if last else "",
            kind=last.verdict if last else "",
            left=_left_to_the_levels(future),
        )

    def _result_of(self, entry: Entry | None) -> str:
        """Whole result of a diagnosis; empty without any."""
        if self._history is None or entry is None:
            return ""
        with History(self._history) as history:
            return history.entry(entry.number).result

    def _reports_page(self) -> Page:
        """Return the list of the reports in the folder."""
        rows = [
            [
                Cell(printable(path.name), "/reports/" + quote(os.fsencode(path.name))),
                *_reported(path),
                Cell(f"{datetime.fromtimestamp(path.stat().st_mtime, UTC):%Y-%m-%d %H:%M}"),
            ]
            for path in self._reports()[:MAX_PAGE_ROWS]
        ]  # fmt: skip
        return self._list(
            "Reports",
            "/reports",
            ["report", "unit", "verdict", "worst severity", "written"],
            rows,
            none="No report is in the folder yet: each test that ends writes one.",
        )

    def _report(self, name: str) -> Page | None:
        """Return one of the listed files, and nothing else of the machine's."""
        found = next((path for path in self._reports() if path.name == name), None)
        if found is None:
            return None
        return Page(read_small_file(found, 16 << 20, "report"), policy=REPORT_CONTENT_POLICY)

    def _reports(self) -> list[Path]:
        """Reports of the folder, newest first; no links."""
        found = [
            path for path in self._folder.glob("*.html") if path.is_file() and not path.is_symlink()
        ]
        return sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)

    def _kept(
        self, serial: int | None = None
    ) -> tuple[Sequence[Entry], Sequence[MaintenanceEvent]]:
        """Diagnoses and events of all units; of one unit and its fleet."""
        if self._history is None or not self._history.exists():
            return (), ()
        with History(self._history) as history:
            if serial is not None:
                return history.alike(serial)
            return history.entries(brief=True), history.events()

    def _list(
        self,
        title: str,
        here: str,
        head: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        *,
        none: str,
        lines: Sequence[str] = (),
        plots: dict[str, Any] | None = None,
        summary: str = "",
        kind: str = "",
        left: Sequence[Sequence[Cell]] = (),
    ) -> Page:
        scripts, elements = embed_plots(plots or {})
        return _page(
            "list.html.j2",
            scripts,
            title=title,
            summary=summary,
            kind=kind,
            here=here,
            head=head,
            rows=rows,
            empty_text=none,
            lines=lines,
            left=left,
            plot=next((Markup(item) for item in elements.values()), None),
        )


def _left_to_the_levels(future: Prognosis) -> list[list[Cell]]:
    """Lines of the table of a unit's remaining life, the soonest at its limit first; the head."""
    levels = [f"{name} {percent(level)}" for name, level in named_levels(future)]
    head = ["fault", "now", *(f"{future.unit} to {level}" for level in levels)]
    ordered = sorted(
        future.forecasts,
        key=lambda item: math.inf if (left := item.remaining[-1].median) is None else left,
    )
    rows = [
        [full_name(item.name), "none" if item.value is None else percent(item.value),
         *map(remaining_text, item.remaining)]
        for item in ordered
    ]  # fmt: skip
    return [[Cell(text) for text in row] for row in (head, *rows)] if rows else []


def _diagnosed(entry: Entry) -> list[Cell]:
    severities = ", ".join(
        f"{plain_name(item.name)} {'none' if item.estimate is None else percent(item.estimate)}"
        for item in entry.severities
    )
    return [
        Cell(shown_date(printable(entry.tested or entry.appended))),
        Cell(_word(entry), kind=entry.verdict),
        Cell(severities or "none"),
    ]


def _last_test(entries: Sequence[Entry]) -> Entry:
    """Last of a unit's rows that a test made; where none did, the last one."""
    return next((item for item in entries[::-1] if item.by_test), entries[-1])


def _word(entry: Entry) -> str:
    """Word for the verdict of a history's row; of a monitor's, which has none, what it is."""
    if not entry.by_test:
        return FREE_MOTION.upper()
    return verdict_word(entry.verdict, identified=bool(entry.severities))


def _worst_value(entry: Entry) -> float:
    return max((item.estimate or 0.0 for item in entry.severities), default=0.0)


def _reported(path: Path) -> list[Cell]:
    """Return unit, verdict and worst severity of the result beside a report; empty without one."""
    try:
        line = read_small_file(path.with_suffix(".json"), MAX_RESULT_BYTES, "result")
        result = Result.from_json(line)
    except (EhadiagError, ValueError):
        return [Cell(""), Cell(""), Cell("")]
    judged = result.severities.values() if result.verdict is not Verdict.NOT_TESTED else ()
    known = [item for item in judged if item.estimate is not None]
    worst = max(known, key=lambda item: item.value, default=None)
    return [
        Cell("unknown" if result.serial is None else str(result.serial)),
        Cell(
            verdict_word(result.verdict.name, identified=result.identified),
            kind=result.verdict.name,
        ),
        Cell("" if worst is None else f"{plain_name(worst.name)} {percent(worst.value)}"),
    ]


def _page(template: str, scripts: Sequence[str], **values: Any) -> Page:
    nav = files("ehadiag.serve").joinpath("templates/nav.js").read_text(encoding="utf-8")
    scripts = [*scripts, nav]
    policy = (
        f"default-src 'none'; script-src {script_sources(scripts)}; style-src 'unsafe-inline'; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    html = templates_of("ehadiag.serve").get_template(template)
    body = html.render(scripts=[Markup(script) for script in scripts], **values)
    return Page(body.encode("utf-8", errors="backslashreplace"), policy=policy)
