"""Reports in a real browser: no errors, no requests, nothing cut, nothing that axe-core objects to.

Runs where Chromium and the packages of the group `browser` are installed.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from places import LOGS
from test_calibrated_pages import NOW, learned, worn

import ehadiag
from ehadiag.assess.verdict import Levels
from ehadiag.cli.report_page import report_of
from ehadiag.report.calibration_page import calibration_page

pytestmark = pytest.mark.slow
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
SWITCHES = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
]  # fmt: skip
SERIOUS = {"serious", "critical"}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    with playwright.sync_playwright() as player:
        found = player.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield found
        found.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    strict = Levels(0.1, 0.3)
    failed = ehadiag.diagnose(LOGS / "paper-open-4.blf", levels=strict)
    results = {
        "healthy": ehadiag.diagnose(LOGS / "healthy-open.blf"),
        "failed": failed,
        "calibrated unit": None,
    }
    out = {}
    for name, result in results.items():
        levels = strict if name == "failed" else Levels()
        diagnosis = worn() if result is None else result.diagnosis
        line = (ehadiag.Result(diagnosis) if result is None else result).to_json()
        out[name] = folder / f"{name}.html"
        out[name].write_bytes(report_of(line, levels, None, diagnosis))
    out["calibration"] = folder / "calibration.html"
    out["calibration"].write_text(calibration_page(learned(), "1", NOW))
    return out


@pytest.mark.parametrize(("width", "scheme"), [(400, "dark"), (1600, "light")])
def test_pages_open_without_errors_requests_or_overflow(
    browser: Any, pages: dict[str, Path], width: int, scheme: str
) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    for path in pages.values():
        wrong: list[str] = []
        asked: list[str] = []
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        page = context.new_page()
        page.on("pageerror", lambda error, to=wrong: to.append(str(error)))
        page.on(
            "console",
            lambda said, to=wrong: to.append(said.text) if said.type == "error" else None,
        )
        page.on("request", lambda request, to=asked: to.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector(".bk-Figure, .bk-Column")
        drawn = page.evaluate("document.querySelectorAll('.plot').length")
        over = page.evaluate(
            "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )
        assert wrong == []
        assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
        assert drawn >= 2
        assert over == 0
        context.close()
        # The page's own policy would keep axe-core's script out too.
        context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=True
        )
        page = context.new_page()
        page.goto(path.as_uri())
        found = axe.run(page).response["violations"]
        assert [item["id"] for item in found if item["impact"] in SERIOUS] == []
        context.close()


def test_plots_are_scaled_to_the_paper(browser: Any, pages: dict[str, Path]) -> None:
    page = browser.new_page(viewport={"width": 1600, "height": 900})
    page.goto(pages["healthy"].as_uri())
    page.wait_for_selector(".bk-Figure, .bk-Column")
    width = "Math.max(...[...document.querySelectorAll('.plot')]"
    width += ".map(item => item.getBoundingClientRect().width))"
    assert page.evaluate(width) > 1000
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.evaluate(width) < 710
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.evaluate(width) > 1000
    page.close()
