"""The local page in a real browser during a session whose every text is hostile."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_pages import MODES, browser, objections, opened, overflow, show
from page_sessions import show_everything

from ehadiag import Levels
from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, MaintenanceEvent, Usage
from ehadiag.history.store import History
from ehadiag.serve.pages import Pages
from ehadiag.serve.server import LOOPBACK_ADDRESS, Site, serve
from ehadiag.serve.sessions import Session, SessionRunner

__all__ = ["browser"]
pytestmark = pytest.mark.slow
CUT = """[...document.querySelectorAll('#verdict, #severities .number')]
  .filter((item) => item.getBoundingClientRect().right > innerWidth)
  .map((item) => item.innerText)"""
"""Cells of the verdict and the severities that a narrow window cuts."""
HOSTILE = "</td></script><script>alert(1)</script><img src=x onerror=alert(2)>"


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Of a running site: a session, a history and a report, each with hostile texts."""
    place = tmp_path / "history.db"
    with History(place, create=True) as history:
        for hours in (10.0, 20.0, 30.0):
            value = hours / 100.0
            found = Severity(name="FSS", estimate=value, std=1e-3, interval95=(0.0, 1.0))
            history.append(
                Entry(
                    "2026-01-02T00:00:00Z", "2026-01-01T00:00:00Z", HOSTILE, 7, HOSTILE, "HEALTHY",
                    (), Usage(hours, None), (), (found,), None, (), "0", False, "{}",
                )
            )  # fmt: skip
        history.append_event(
            MaintenanceEvent(
                "2026-01-03T00:00:00Z", "2026-01-03T00:00:00Z", 7, None, Usage(), HOSTILE, ()
            )
        )
    (tmp_path / "<img src=x onerror=alert(3)>.html").write_text("<p>a report</p>")
    session = Session(HOSTILE, show_everything, (HOSTILE,))
    with SessionRunner(session, {HOSTILE: session}) as sessions:
        pages = Pages(tmp_path, place, Levels(), (HOSTILE,))
        server = serve(Site(pages, sessions, "token"), 0)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://{LOOPBACK_ADDRESS}:{server.server_port}"
        server.shutdown()
        server.server_close()


def test_pages_show_hostile_texts_as_texts_and_nothing_is_objected_to(
    browser: object, address: str
) -> None:
    for path, ready in (
        ("/session", "#alarms td"), ("/", "td"), ("/history/7", ".bk-Figure"), ("/reports", "td"),
    ):  # fmt: skip
        with opened(browser, address + path, ready) as (page, wrong, asked):
            for mode in MODES:
                show(page, *mode)
                assert overflow(page) == 0, path
                assert objections(page) == [], path
            assert "onerror=alert(" in page.inner_text("main")
            assert page.evaluate("document.querySelectorAll('img').length") == 0
            if path == "/session":
                page.set_viewport_size({"width": 400, "height": 900})
                assert page.evaluate(CUT) == []
                for item, words in (
                    ("#unit", HOSTILE), ("#verdict", "DEGRADED"), ("#residuals", "-3.25"),
                    ("#against", HOSTILE), ("#alarms", "below"), ("#alarm-count", "1"),
                    ("#phase", "3.5 s left"), ("#bus", "2000"), ("#severities", "0.3000"),
                    ("#said", HOSTILE), ("#notes", HOSTILE), ("#test", HOSTILE),
                ):  # fmt: skip
                    assert words in page.text_content(item), item
        assert wrong == []
        assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
