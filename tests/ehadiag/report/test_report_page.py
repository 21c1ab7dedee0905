"""The report: one page that loads nothing, in which texts of others are text."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from typing import Any

import pytest
from history_cases import an_entry, an_event
from places import LOGS
from report_html import Page

import ehadiag
from ehadiag.assess.verdict import Levels
from ehadiag.prognosis.unit import prognosis_of
from ehadiag.report.page import Trend, page_of
from ehadiag.report.responses import MOST_RESPONSES

NOW = "2026-03-01T12:00:00.000Z"
HOSTILE = (
    "</script><script>alert(1)</script><img src=http://x/ onerror=alert(1)>\"'&{{7*7}}\x1b[31m"
)


@pytest.fixture(scope="module")
def worn() -> ehadiag.Result:
    return ehadiag.diagnose(LOGS / "paper-open-4.blf")


def written(result: ehadiag.Result, trend: Trend | None = None, **changes: Any) -> str:
    tree = json.loads(result.to_json()) | changes
    return page_of(tree, Levels(), "1.2.3", NOW, result.diagnosis, trend)


def a_trend(text: str = "filter changed") -> Trend:
    entries = [an_entry(1, 100.0 * n, (0.03 * n, 0.02 * n, 0.01 * n)) for n in range(1, 10)]
    events = [an_event(text, hours=50.0, serial=1)]
    return Trend(entries, events, prognosis_of(1, entries, events, (0.25, 0.75)))


def test_the_verdict_comes_first_and_in_words(worn: ehadiag.Result) -> None:
    page = Page(written(worn))
    text = re.sub(r"\s+", " ", page.text).strip()
    assert text.startswith("DEGRADED: reference-31, serial 1 DEGRADED A severity is, or may be")
    for name, fault in worn.faults.items():
        assert name in text
        assert f"{fault.value:.5f}" in text
    for words in ("spool sensor offset", "seed 0", "ehadiag 1.2.3", "SHA-256", "frames"):
        assert words in text


def test_the_page_loads_nothing(worn: ehadiag.Result) -> None:
    html = written(worn, a_trend())
    page = Page(html)
    assert len(html.encode()) < 3_000_000
    for name in ("src", "href", "srcset", "data", "action", "background", "poster"):
        assert page.attributes(name) == []
    assert not {tag for tag, _ in page.elements} & {"link", "iframe", "object", "embed", "base"}
    (style,) = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style


def test_the_policy_allows_the_pages_own_scripts_and_nothing_else(worn: ehadiag.Result) -> None:
    page = Page(written(worn))
    digests = [
        base64.b64encode(hashlib.sha256(item.encode()).digest()).decode() for item in page.scripts
    ]
    assert digests
    (allowed,) = re.findall(r"script-src ([^;]*);", page.policy)
    assert allowed.split() == [f"'sha256-{item}'" for item in digests]
    assert page.policy.startswith("default-src 'none';")
    for word in ("http", "*", "unsafe-eval", "'self'"):
        assert word not in page.policy


def test_texts_of_others_are_text(worn: ehadiag.Result) -> None:
    plain = Page(written(worn, a_trend()))
    hostile = written(
        worn, a_trend(HOSTILE), source=HOSTILE, test=HOSTILE, actuator=HOSTILE, reasons=[HOSTILE],
        serial=HOSTILE, verdict="DEGRADED",
        quality={"frames": HOSTILE, HOSTILE: 1, "notes": [HOSTILE]},
        solver={"name": HOSTILE, "seed": HOSTILE},
    )  # fmt: skip
    page = Page(hostile)
    assert {tag for tag, _ in page.elements} == {tag for tag, _ in plain.elements}
    assert len(page.scripts) == len(plain.scripts)
    assert "alert(1)" in page.text
    assert not any("alert(1)" in script for script in page.scripts)
    assert "\x1b" not in hostile
    assert "{{7*7}}" in page.text


def test_an_unknown_verdict_is_not_believed(worn: ehadiag.Result) -> None:
    html = written(worn, verdict='x" onload="alert(1)')
    assert '<body class="NOT_TESTED">' in html


def test_what_was_not_tested_has_no_plots() -> None:
    result = ehadiag.diagnose(LOGS / "healthy-open.blf")
    tree = json.loads(result.to_json())
    for fault in tree["faults"].values():
        fault.update(dict.fromkeys(("first", "search", "estimate", "std", "interval95")))
    tree |= {"verdict": "NOT_TESTED", "reasons": ["the test was aborted"], "fit": None}
    page = Page(page_of(tree, Levels(), "1", NOW))
    assert page.scripts == []
    assert "script-src 'none'" in page.policy
    for words in ("NOT TESTED", "the test was aborted", "nothing was identified", "not at hand"):
        assert words in page.text


def test_what_was_not_tested_is_drawn_beside_what_was_expected(worn: ehadiag.Result) -> None:
    diagnosis = replace(worn.diagnosis, identification=None, verdict=ehadiag.Verdict.NOT_TESTED)
    html = page_of({"verdict": "NOT_TESTED"}, Levels(), "1", NOW, diagnosis)
    assert "expected of a unit as new" in html
    assert "Measured and expected" in Page(html).text
    unknown = replace(diagnosis, tests=(None,))
    assert "expected of a unit as new" not in page_of({}, Levels(), "1", NOW, unknown)


def test_a_long_test_keeps_the_page_small(worn: ehadiag.Result) -> None:
    recordings = worn.diagnosis.recordings * 9
    many = replace(
        worn.diagnosis, recordings=recordings, experiments=worn.diagnosis.experiments * 9
    )
    html = page_of(json.loads(worn.to_json()), Levels(), "1", NOW, many)
    assert len(html.encode()) < 3_000_000
    assert html.count('role="img"') == 1 + MOST_RESPONSES
    assert f"Of {worn.diagnosis.experiments[0].ticks} samples at most" in html


def test_the_trend_shows_remaining_life_events_and_alarms(worn: ehadiag.Result) -> None:
    trend = a_trend()
    assert "Trend of this unit" not in Page(written(worn)).text
    text = Page(written(worn, trend)).text
    assert "Remaining life" in text
    assert "hours to limit 0.75" in text
    assert "filter changed" in text
    first, *others = trend.prognosis.forecasts
    alarmed = replace(trend.prognosis, forecasts=(replace(first, alarm="+0.4 at once"), *others))
    assert (
        "Alarm: Kintas +0.4 at once" in Page(written(worn, replace(trend, prognosis=alarmed))).text
    )


def test_every_plot_has_words_and_every_table_a_head(worn: ehadiag.Result) -> None:
    page = Page(written(worn, a_trend()))
    images = [attrs for _, attrs in page.elements if attrs.get("role") == "img"]
    assert len(images) == 3
    assert all(len(attrs["aria-label"] or "") > 30 for attrs in images)
    assert ("html", {"lang": "en"}) in page.elements
    assert sum(tag == "h1" for tag, _ in page.elements) == 1
