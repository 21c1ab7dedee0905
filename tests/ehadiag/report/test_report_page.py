"""The report: one page that loads nothing, in which texts of others are text.

A calibrated unit in page and picture: its own effects count once, and the calibration's page.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from typing import Any

import msgspec
import numpy as np
import pytest
from calibrated_unit import diagnosis_when_worn, learned, of_calibrated_unit
from history_cases import an_entry, an_event
from msgspec.structs import replace
from numpy.typing import NDArray
from places import LOGS
from report_html import Page

import ehadiag
from ehadiag import Calibrated, Levels, default_actuator
from ehadiag.calibration.unit_models import TriedModel
from ehadiag.prognosis.units import prognosis_of
from ehadiag.records import result_of
from ehadiag.report.matplotlib_figures import draw_picture
from ehadiag.report.picture import Panel
from ehadiag.report.report_pages import (
    MAX_PAGE_RESPONSES,
    UnitTrend,
    calibration_page,
    diagnosis_page,
)
from ehadiag.report.response_signals import modelled_column, result_picture

NOW = "2026-03-01T12:00:00.000Z"
HOSTILE = (
    "</script><script>alert(1)</script><img src=http://x/ onerror=alert(1)>\"'&{{7*7}}\x1b[31m"
)


@pytest.fixture(scope="module")
def worn() -> ehadiag.Result:
    return ehadiag.diagnose(LOGS / "paper-open-4.blf")


@pytest.fixture(scope="module")
def plain(worn: ehadiag.Result) -> str:
    """The page of one result."""
    return written(worn)


@pytest.fixture(scope="module")
def with_trend(worn: ehadiag.Result) -> str:
    """The page of a result with the history of its unit."""
    return written(worn, a_trend())


def written(result: ehadiag.Result, trend: UnitTrend | None = None, **changes: Any) -> str:
    changed = msgspec.structs.replace(result, **changes).with_diagnosis(result.diagnosis)
    return diagnosis_page(changed, Levels(), "1.2.3", NOW, trend)


def a_trend(text: str = "filter changed") -> UnitTrend:
    entries = [an_entry(1, 100.0 * n, (0.03 * n, 0.02 * n, 0.01 * n)) for n in range(1, 10)]
    events = [an_event(text, hours=50.0, serial=1)]
    return UnitTrend(entries, events, prognosis_of(1, entries, events, (0.25, 0.75)))


def test_the_verdict_comes_first_and_in_words(worn: ehadiag.Result, plain: str) -> None:
    page = Page(plain)
    text = re.sub(r"\s+", " ", page.text).strip()
    assert text.startswith("Unit 1: DEGRADED Unit 1: DEGRADED Jack friction is at 60 %")
    for name, fault in worn.faults.items():
        assert name in text
        assert f"{fault.value:.5f}" in text
    for words in ("spool sensor offset", "seed 0", "ehadiag 1.2.3", "SHA-256", "frames"):
        assert words in text


def test_no_line_breaks_before_a_percent_sign(with_trend: str) -> None:
    text = Page(with_trend).text
    assert "at 60\N{NO-BREAK SPACE}%" in text
    assert " %" not in text


def test_the_page_loads_nothing(with_trend: str) -> None:
    html = with_trend
    page = Page(html)
    assert len(html.encode()) < 3_000_000
    for name in ("src", "href", "srcset", "data", "action", "background", "poster"):
        assert page.attributes(name) == []
    assert not {tag for tag, _ in page.elements} & {"link", "iframe", "object", "embed", "base"}
    (style,) = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style


def test_the_policy_allows_the_pages_own_scripts_and_nothing_else(plain: str) -> None:
    page = Page(plain)
    digests = [
        base64.b64encode(hashlib.sha256(item.encode()).digest()).decode() for item in page.scripts
    ]
    assert digests
    (allowed,) = re.findall(r"script-src ([^;]*);", page.policy)
    assert allowed.split() == [f"'sha256-{item}'" for item in digests]
    assert page.policy.startswith("default-src 'none';")
    for word in ("http", "*", "unsafe-eval", "'self'"):
        assert word not in page.policy


def test_texts_of_others_are_text(worn: ehadiag.Result, with_trend: str) -> None:
    plain = Page(with_trend)
    advised = {
        name: msgspec.structs.replace(item, advice=HOSTILE)
        for name, item in worn.severities.items()
    }
    hostile = written(
        worn, a_trend(HOSTILE), source=HOSTILE, test=HOSTILE, actuator=HOSTILE, reasons=(HOSTILE,),
        quality=msgspec.structs.replace(worn.quality, saturated={HOSTILE: 1}, notes=(HOSTILE,)),
        search=msgspec.structs.replace(worn.search, name=HOSTILE), severities=advised,
    )  # fmt: skip
    page = Page(hostile)
    lists = {"ul"}  # of notes, which the other page has none of
    assert {tag for tag, _ in page.elements} - lists == {tag for tag, _ in plain.elements} - lists
    assert len(page.scripts) == len(plain.scripts)
    assert "alert(1)" in page.text
    assert not any("alert(1)" in script for script in page.scripts)
    assert "\x1b" not in hostile
    assert "{{7*7}}" in page.text


def test_an_unknown_verdict_is_not_read(worn: ehadiag.Result) -> None:
    line = worn.to_json().replace('"DEGRADED"', '"x\\" onload=\\"alert(1)"')
    with pytest.raises(ValueError, match="verdict"):
        ehadiag.Result.from_json(line)


def test_what_was_not_tested_has_no_plots() -> None:
    result = ehadiag.diagnose(LOGS / "healthy-open.blf")
    tree = json.loads(result.to_json())
    for fault in tree["faults"].values():
        fault.update(dict.fromkeys(("first", "search", "estimate", "std", "interval95")))
    tree |= {"verdict": "NOT_TESTED", "reasons": ["the test was aborted"], "fit": None}
    page = Page(diagnosis_page(ehadiag.Result.from_json(json.dumps(tree)), Levels(), "1", NOW))
    assert page.scripts == []
    assert "script-src 'none'" in page.policy
    for words in ("NOT TESTED", "The test was aborted", "not at hand"):
        assert words in page.text
    assert "% interval" not in page.text


def test_what_was_not_tested_is_drawn_beside_what_was_expected(worn: ehadiag.Result) -> None:
    diagnosis = replace(worn.diagnosis, identification=None, verdict=ehadiag.Verdict.NOT_TESTED)
    html = diagnosis_page(result_of(diagnosis), Levels(), "1", NOW)
    assert "expected of a unit as new" in html
    assert "Measured and expected" in Page(html).text
    unknown = replace(diagnosis, tests=(None,))
    assert "expected of a unit as new" not in diagnosis_page(result_of(unknown), Levels(), "1", NOW)


def test_a_long_test_keeps_the_page_small(worn: ehadiag.Result) -> None:
    recordings = worn.diagnosis.recordings * 9
    many = replace(
        worn.diagnosis, recordings=recordings, experiments=worn.diagnosis.experiments * 9
    )
    html = diagnosis_page(worn.with_diagnosis(many), Levels(), "1", NOW)
    assert len(html.encode()) < 3_000_000
    assert html.count('class="plot" role="img"') == MAX_PAGE_RESPONSES
    assert f"Of {worn.diagnosis.experiments[0].ticks} samples at most" in html


def test_the_trend_shows_remaining_life_events_and_alarms(
    worn: ehadiag.Result, plain: str, with_trend: str
) -> None:
    trend = a_trend()
    assert "Trend of this unit" not in Page(plain).text
    text = Page(with_trend).text
    assert "Remaining life" in text
    assert "hours to limit 0.75" in text
    assert "filter changed" in text
    first, *others = trend.prognosis.forecasts
    alarmed = replace(trend.prognosis, forecasts=(replace(first, alarm="+0.4 at once"), *others))
    assert (
        "Alarm: filter clogging (Kintas) +0.4 at once"
        in Page(written(worn, replace(trend, prognosis=alarmed))).text
    )


def test_every_plot_has_words_and_every_table_a_head(with_trend: str) -> None:
    page = Page(with_trend)
    images = [attrs for _, attrs in page.elements if attrs.get("role") == "img"]
    assert len(images) == 3 + 2
    assert all(len(attrs["aria-label"] or "") > 20 for attrs in images)
    assert ("html", {"lang": "en"}) in page.elements
    assert sum(tag == "h1" for tag, _ in page.elements) == 1


def rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def residual(panel: Panel) -> NDArray[np.float64]:
    assert panel.residual is not None
    return 1e-3 * panel.residual


@pytest.mark.slow
@of_calibrated_unit
def test_page_and_picture_of_a_calibrated_unit_draw_the_response_that_was_fitted() -> None:
    diagnosis = diagnosis_when_worn()
    found = diagnosis.identification
    assert found is not None
    (experiment,) = diagnosis.experiments
    constants = found.constants(experiment.constants)
    column = modelled_column(experiment, constants, diagnosis.recordings[0])
    _, spool, pressure, _ = column.panels
    figure = draw_picture(result_picture(result_of(diagnosis)))
    axes = {axis.get_ylabel(): axis for axis in figure.axes}
    for panel in (spool, pressure):
        drawn = axes[panel.y_label].lines[1].get_ydata()
        np.testing.assert_array_equal(drawn, panel.curves[1].y)
    twice = constants._replace(HYS=2.0 * constants.HYS, IB=2.0 * constants.IB)
    wrong = modelled_column(experiment, twice, diagnosis.recordings[0]).panels[1]
    window = slice(*(round(t / experiment.tick) for t in experiment.test.windows.refinement[0]))
    noise = 1e3 * experiment.spool_noise
    assert rms(residual(spool)[window]) < 2.0 * noise
    assert rms(residual(pressure)[window]) < 2.0 * experiment.pressure_noise * 1e-6
    assert rms(residual(wrong)[window]) > 5.0 * noise


@pytest.mark.slow
@of_calibrated_unit
def test_the_page_of_a_calibration_says_what_was_learned_and_how_well() -> None:
    found = learned()
    text = Page(calibration_page(found, "1.2.3", NOW)).text
    assert found.actuator is not None
    assert found.actuator.calibration is not None
    assert "CALIBRATED" in text
    for item in found.values:
        assert item.meaning in text
    for part in ("What was learned", "covariance", "Evidence of the models", "serial 41"):
        assert part in text
    for why in found.actuator.calibration.held.values():
        assert why in text
    assert text.count("rms residual over the whole test") == 2
    assert "+1.00" in text


def test_a_refused_calibration_has_a_page_that_says_why() -> None:
    hostile = "<script>alert(1)</script>\x1b[31m"
    refused = Calibrated(
        recordings=(), tests=(), start=default_actuator(), actuator=None, reasons=(hostile,),
        notes=(), severities=(), values=(), tried=(), experiments=(), seed=0, evaluations=0,
        elapsed=0.0,
    )  # fmt: skip
    html = calibration_page(refused, "1", NOW)
    page = Page(html)
    assert page.scripts == []
    assert "NOT CALIBRATED" in page.text
    assert "<script>alert(1)" in page.text
    assert "\x1b" not in html
    tried = (TriedModel("one model", 1.0, 0.0), TriedModel("another", 3.0, 99.0))
    assert "another" in Page(calibration_page(replace(refused, tried=tried), "1", NOW)).text


def test_the_head_has_the_tests_date_and_says_what_to_do(plain: str) -> None:
    page = Page(plain)
    text = re.sub(r"\s+", " ", page.text)
    assert "Unit 1: DEGRADED" in text
    assert "tested 2023-11-14 22:13 UTC, open-loop test, actuator type reference-31" in text
    assert text.index("tested 2023-11-14") < text.index("Severities") < text.index(NOW)
    assert "Plan to overhaul the jack." in text
