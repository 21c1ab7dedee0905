"""Reports in a real browser: no errors, no requests, nothing cut, nothing that axe-core objects to.

Runs where Chromium and the packages of the group `browser` are installed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from browser_pages import MODES, browser, objections, opened, overflow, show
from calibrated_unit import diagnosis_when_worn, learned, of_calibrated_unit
from places import LOGS

import ehadiag
from ehadiag import Levels
from ehadiag.records import result_of
from ehadiag.report.rendering import diagnosis_html_page
from ehadiag.report.report_pages import calibration_page

__all__ = ["browser"]
pytestmark = [pytest.mark.slow, of_calibrated_unit]
PLOT = ".bk-Figure, .bk-Column"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    strict = Levels(0.1, 0.3)
    failed = ehadiag.diagnose(LOGS / "paper-open-4.blf", advisory=0.1, limit=0.3)
    results = {
        "healthy": ehadiag.diagnose(LOGS / "healthy-open.blf"),
        "failed": failed,
        "calibrated unit": None,
    }
    out = {}
    for name, result in results.items():
        levels = strict if name == "failed" else Levels()
        shown = result_of(diagnosis_when_worn()) if result is None else result
        out[name] = folder / f"{name}.html"
        out[name].write_bytes(diagnosis_html_page(shown, levels, None))
    out["calibration"] = folder / "calibration.html"
    out["calibration"].write_text(calibration_page(learned(), "1", "2026-03-01T12:00:00.000Z"))
    return out


def test_pages_open_without_errors_requests_or_overflow(
    browser: Any, pages: dict[str, Path]
) -> None:
    for path in pages.values():
        with opened(browser, path.as_uri(), PLOT) as (page, wrong, asked):
            for mode in MODES:
                show(page, *mode)
                assert overflow(page) == 0
                assert objections(page) == []
            assert page.evaluate("document.querySelectorAll('[role=img]').length") >= 2
        assert wrong == []
        assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []


def test_plots_are_scaled_to_the_paper(browser: Any, pages: dict[str, Path]) -> None:
    page = browser.new_page(viewport={"width": 1600, "height": 900})
    page.goto(pages["healthy"].as_uri())
    page.wait_for_selector(PLOT)
    width = "Math.max(...[...document.querySelectorAll('.plot')]"
    width += ".map(item => item.getBoundingClientRect().width))"
    assert page.evaluate(width) > 1000
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.evaluate(width) < 710
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.evaluate(width) > 1000
    page.close()
