"""Pages in a real browser: what goes wrong in them, what they ask for, what axe-core objects to.

Runs where Chromium and the packages of the group `browser` are installed.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
SWITCHES = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
]  # fmt: skip
SERIOUS = {"serious", "critical"}
MODES = ((400, "dark"), (1600, "light"))
"""Width of the window, and what its user prefers."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    with playwright.sync_playwright() as player:
        found = player.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield found
        found.close()


@contextmanager
def opened(browser: Any, url: str, ready: str) -> Iterator[tuple[Any, list[str], list[str]]]:
    """Open a page and wait for an element: the page, its errors, and the addresses it asks for."""
    wrong: list[str] = []
    asked: list[str] = []
    context = browser.new_context()
    page = context.new_page()
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("dialog", lambda dialog: wrong.append(dialog.message))
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    show(page, *MODES[0])
    page.goto(url)
    page.wait_for_selector(ready)
    yield page, wrong, asked
    context.close()


def show(page: Any, width: int, scheme: str) -> None:
    """Give the window a width, and its user a preference."""
    page.set_viewport_size({"width": width, "height": 900})
    page.emulate_media(color_scheme=scheme)


def overflow(page: Any) -> int:
    """How much wider than its window a page is, in pixels."""
    wide: int = page.evaluate(
        "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    )
    return wide


def objections(page: Any) -> list[str]:
    """What axe-core finds serious."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    found = axe.run(page).response["violations"]
    return [item["id"] for item in found if item["impact"] in SERIOUS]
