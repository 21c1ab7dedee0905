"""The local page in a real browser during a session whose every text is hostile."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_pages import MODES, browser, objections, opened, overflow, show

from ehadiag.assess.verdict import Levels
from ehadiag.history.records import Entry, Event, Severity, Usage
from ehadiag.history.store import History
from ehadiag.serve.pages import Pages
from ehadiag.serve.server import HOST, Site, serve
from ehadiag.serve.sessions import Sessions

__all__ = ["browser"]
pytestmark = pytest.mark.slow
HOSTILE = "</td></script><script>alert(1)</script><img src=x onerror=alert(2)>"
TALKER = """
import signal, sys, time
from ehadiag.live.snapshot import (
    Alarm, Bus, Ending, Residuals, RunningTest, Severity, Signals, Snapshot
)
text, line = sys.argv[2], tuple(float(item % 9) for item in range(100))
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
print(text, file=sys.stderr, flush=True)
for number in range(1, 2000):
    item = Snapshot(
        number=number, time="2026-03-01T12:00:00.000Z", command="bit", actuator=text, serial=7,
        bus=Bus(name=text, state="open", detail=text, frames=number, rate_per_s=2000.0, load=0.2),
        test=RunningTest(name=text, phase="running", elapsed_s=2.0, duration_s=5.5, left_s=3.5),
        mode="current", signals=Signals(line, line, line, line, line, line, line),
        residuals=Residuals(spool=-3.25, pressure=None, against=text, spool_below=1.0),
        alarms=(Alarm(time=text, signal="spool", side="below", during=text),), alarm_count=1,
        severities=(Severity(name="FSS", estimate=0.3, std=0.01, source=text),),
        working=text, notes=(text,), ending=Ending(verdict="DEGRADED", reasons=(text,)),
    )
    sys.stdout.buffer.write(item.to_json() + b"\\n")
    sys.stdout.buffer.flush()
    time.sleep(0.1)
"""


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Of a running site: a session, a history and a report, each with hostile texts."""
    place = tmp_path / "history.db"
    with History(place, create=True) as history:
        for hours in (10.0, 20.0, 30.0):
            severities = (Severity("FSS", hours / 100.0, 1e-3, 0.0, 1.0, False, True),)
            history.append(
                Entry(
                    "2026-01-02T00:00:00Z", "2026-01-01T00:00:00Z", HOSTILE, 7, HOSTILE, "HEALTHY",
                    (), Usage(hours, None), (), severities, None, (), "0", False, "{}",
                )
            )  # fmt: skip
        history.append_event(
            Event("2026-01-03T00:00:00Z", "2026-01-03T00:00:00Z", 7, None, Usage(), HOSTILE, ())
        )
    (tmp_path / "<img src=x onerror=alert(3)>.html").write_text("<p>a report</p>")
    program = (sys.executable, "-c", TALKER)
    with Sessions(("monitor", HOSTILE), {HOSTILE: ("bit", HOSTILE)}, program) as sessions:
        pages = Pages(tmp_path, place, Levels(), (HOSTILE,))
        server = serve(Site(pages, sessions, "token"), 0)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://{HOST}:{server.server_port}"
        server.shutdown()
        server.server_close()


def test_pages_show_hostile_texts_as_texts_and_nothing_is_objected_to(
    browser: object, address: str
) -> None:
    for path, ready in (
        ("/", "#alarms td"), ("/history", "td"), ("/history/7", ".bk-Figure"), ("/reports", "td"),
    ):  # fmt: skip
        with opened(browser, address + path, ready) as (page, wrong, asked):
            for mode in MODES:
                show(page, *mode)
                assert overflow(page) == 0, path
                assert objections(page) == [], path
            assert "onerror=alert(" in page.inner_text("main")
            assert page.evaluate("document.querySelectorAll('img').length") == 0
            if path == "/":
                for item, words in (
                    ("#unit", HOSTILE), ("#verdict", "DEGRADED"), ("#residuals", "-3.25"),
                    ("#against", HOSTILE), ("#alarms", "below"), ("#alarm-count", "1"),
                    ("#phase", "3.5 s left"), ("#bus", "2000"), ("#severities", "0.3000"),
                    ("#said", HOSTILE), ("#notes", HOSTILE), ("#test", HOSTILE),
                ):  # fmt: skip
                    assert words in page.inner_text(item), item
        assert wrong == []
        assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
