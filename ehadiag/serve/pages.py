"""The pages: live view, health history, reports; the templates escape every text of others."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from markupsafe import Markup

from ehadiag.core.dates import utc_text
from ehadiag.core.printable import printable
from ehadiag.core.small_file import read_small_file
from ehadiag.history.counted import counted
from ehadiag.history.store import History
from ehadiag.prognosis.unit import prognosis_of
from ehadiag.report.html import script_sources, templates_of
from ehadiag.report.live_plots import plot_signals
from ehadiag.report.plots import embedded, plot_trend
from ehadiag.report.prognosis_table import levels_named, remaining_text
from ehadiag.serve.server import Page

if TYPE_CHECKING:
    from ehadiag.assess.verdict import Levels
    from ehadiag.history.records import Entry, Event

__all__ = ["Pages"]

MOST_ROWS = 500
"""Of a list, newest first."""
LARGEST_REPORT = 16 << 20
REPORT_POLICY = "sandbox allow-scripts"
"""A report may be anybody's file: its scripts run, but not in the name of this server."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a list."""

    text: str
    link: str = ""
    kind: str = ""


class Pages:
    """Makes the page of a path.

    Parameters
    ----------
    folder : Path
        Where results and reports go.
    history : Path | None
        Health history; None: none is kept.
    levels : Levels
        Advisory level and limit.
    tests : Sequence[str]
        That the page offers to start.
    """

    def __init__(
        self, folder: Path, history: Path | None, levels: Levels, tests: Sequence[str]
    ) -> None:
        self._folder = folder
        self._history = history
        self._levels = levels
        self._tests = tuple(tests)
        self._live: Page | None = None

    def __call__(self, path: str) -> Page | None:
        """Return the page of a path; None where there is none.

        Parameters
        ----------
        path : str
            Decoded, such as `/history/7`.

        Returns
        -------
        Page | None
            The page.

        Raises
        ------
        EhadiagError
            The history or a file cannot be read.
        """
        if path == "/":
            # Made once: a plotting library of a megabyte is in it.
            self._live = self._live or self._live_page()
            return self._live
        whole: dict[str, Callable[[], Page]] = {
            "/history": self._units_page,
            "/reports": self._reports_page,
        }
        if path in whole:
            return whole[path]()
        start, _, rest = path[1:].partition("/")
        if start == "history" and rest.isdecimal() and rest.isascii() and len(rest) < 20:
            return self._unit_page(int(rest))
        return self._report(rest) if start == "reports" else None

    def _live_page(self) -> Page:
        scripts, elements = embedded({"signals": plot_signals()})
        own = files("ehadiag.serve").joinpath("templates/live.js").read_text(encoding="utf-8")
        return _page(
            "live.html.j2",
            [*scripts, own],
            title="Live",
            here="/",
            tests=self._tests,
            plots=[Markup(item) for item in elements.values()],
        )

    def _units_page(self) -> Page:
        """Return the list of the units, with the last diagnosis of each."""
        entries, _ = self._kept()
        last: dict[int | None, Entry] = {}
        for entry in entries:
            last[entry.serial] = entry
        rows = [
            [
                Cell("unknown") if serial is None else Cell(str(serial), f"/history/{serial}"),
                Cell(printable(entry.actuator)),
                *_diagnosed(entry),
            ]
            for serial, entry in sorted(
                last.items(), key=lambda item: (item[1].tested or item[1].appended), reverse=True
            )[:MOST_ROWS]
        ]  # fmt: skip
        return self._list(
            "Health history",
            "/history",
            ["serial", "actuator", "last test", "verdict", "severities"],
            rows,
            none="No diagnosis is kept yet." if self._history else "No history is kept: --history.",
        )

    def _unit_page(self, serial: int) -> Page:
        """Return one unit's diagnoses, trend and remaining life."""
        entries, events = self._kept()
        mine = [entry for entry in entries if entry.serial == serial]
        levels = (self._levels.advisory, self._levels.limit)
        future = prognosis_of(serial, entries, events, levels)
        lines = [
            f"{item.name}: {future.unit} to {name} {level:g}: {remaining_text(left)}"
            for item in future.forecasts
            for (name, level), left in zip(levels_named(future), item.remaining, strict=True)
        ]
        lines += [f"{item.name} {item.alarm}" for item in future.forecasts if item.alarm]
        own = [item for item in events if item.serial == serial]
        lines += [f"{item.when[:10]}: {printable(item.text)}" for item in own]
        used = counted(mine)
        plots = {}
        if any(entry.severities for entry in used):
            unit = future.unit if future.used else None
            plots["trend"] = plot_trend(used, own, unit, levels)
        return self._list(
            f"Unit {serial}",
            "",
            ["test", "verdict", "severities"],
            [_diagnosed(entry) for entry in mine[::-1][:MOST_ROWS]],
            none="No diagnosis of this unit is kept.",
            lines=lines,
            plots=plots,
        )

    def _reports_page(self) -> Page:
        """Return the list of the reports in the folder."""
        rows = [
            [
                Cell(printable(path.name), "/reports/" + quote(os.fsencode(path.name))),
                Cell(utc_text(datetime.fromtimestamp(path.stat().st_mtime, UTC))),
            ]
            for path in self._reports()[:MOST_ROWS]
        ]  # fmt: skip
        return self._list(
            "Reports",
            "/reports",
            ["report", "written"],
            rows,
            none="No report is in the folder yet: each test that ends writes one.",
        )

    def _report(self, name: str) -> Page | None:
        """Return one of the listed files, and nothing else of the machine's."""
        found = next((path for path in self._reports() if path.name == name), None)
        if found is None:
            return None
        return Page(read_small_file(found, LARGEST_REPORT, "report"), policy=REPORT_POLICY)

    def _reports(self) -> list[Path]:
        """Reports of the folder, newest first; no links."""
        found = [
            path for path in self._folder.glob("*.html") if path.is_file() and not path.is_symlink()
        ]
        return sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)

    def _kept(self) -> tuple[Sequence[Entry], Sequence[Event]]:
        if self._history is None or not self._history.exists():
            return (), ()
        with History(self._history) as history:
            return history.entries(), history.events()

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
    ) -> Page:
        scripts, elements = embedded(plots or {})
        return _page(
            "list.html.j2",
            scripts,
            title=title,
            here=here,
            head=head,
            rows=rows,
            none=none,
            lines=lines,
            plot=next((Markup(item) for item in elements.values()), None),
        )


def _diagnosed(entry: Entry) -> list[Cell]:
    severities = ", ".join(
        f"{item.name} {'none' if item.estimate is None else f'{item.estimate:.4f}'}"
        for item in entry.severities
    )
    return [
        Cell(printable(entry.tested or entry.appended)),
        Cell(entry.verdict.replace("_", " "), kind=entry.verdict),
        Cell(severities or "none"),
    ]


def _page(template: str, scripts: Sequence[str], **values: Any) -> Page:
    policy = (
        f"default-src 'none'; script-src {script_sources(scripts)}; style-src 'unsafe-inline'; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    html = templates_of("ehadiag.serve").get_template(template)
    body = html.render(scripts=[Markup(script) for script in scripts], **values)
    return Page(body.encode("utf-8", errors="backslashreplace"), policy=policy)
