"""Histories cut into lives, and growth told from noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from history_cases import an_entry, an_event
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.history.records import Usage
from ehadiag.prognosis.lives import Life, increments_of, lives_of


def entries(*rows: tuple[float, float]) -> list:
    return [an_entry(7, hours, (value, 0.2, 0.3)) for hours, value in rows]


GROWN = entries((100, 0.1), (200, 0.2), (300, 0.3), (400, 0.05), (500, 0.1))


def ages(events: list, name: str = "Kintas") -> list[list[float]]:
    return [life.age.tolist() for life in lives_of(GROWN, events, name, "hours")[7]]


def test_without_events_there_is_one_life() -> None:
    assert ages([]) == [[100, 200, 300, 400, 500]]


def test_an_event_that_names_no_severity_renews_those_that_fell() -> None:
    assert ages([an_event(hours=300.0)]) == [[100, 200, 300], [100, 200]]
    assert ages([an_event(hours=300.0)], "FSS") == [[100, 200, 300, 400, 500]]
    assert ages([an_event(hours=200.0)]) == [[100, 200, 300, 400, 500]]


def test_an_event_renews_what_it_names() -> None:
    event = an_event(hours=200.0, resets=("FSS",))
    assert ages([event], "FSS") == [[100, 200], [100, 200, 300]]
    assert ages([event]) == [[100, 200, 300, 400, 500]]


def test_a_life_that_nobody_has_seen_is_empty() -> None:
    assert ages([an_event(hours=600.0, resets=("Kintas",))])[-1] == []


def test_events_of_other_units_and_those_that_nothing_places_do_nothing() -> None:
    assert len(ages([an_event(hours=300.0, serial=8)])) == 1
    early = an_event(hours=None, resets=("Kintas",), when="2026-01-01T00:00:00.000Z")
    assert len(ages([early])) == 1


def test_what_says_no_hours_or_has_no_verdict_is_left_out() -> None:
    rows = [
        replace(GROWN[0], usage=Usage(None, 5.0)),
        replace(GROWN[1], verdict="NOT_TESTED"),
        replace(GROWN[2], serial=None),
        GROWN[3],
    ]
    (life,) = lives_of(rows, [], "Kintas", "hours")[7]
    assert life.age.tolist() == [400.0]
    assert lives_of(rows, [], "Kintas", "cycles")[7][0].age.tolist() == [5.0]


def test_diagnoses_of_one_hour_are_joined_by_their_weights() -> None:
    pair = [an_entry(7, 5.0, (0.1, 0, 0), std=1e-3), an_entry(7, 5.0, (0.2, 0, 0), std=2e-3)]
    (life,) = lives_of(pair, [], "Kintas", "hours")[7]
    assert life.value.tolist() == [0.12]
    assert life.std[0] < 1e-3


@given(st.lists(st.floats(0.0, 1.0), min_size=0, max_size=30), st.floats(1e-5, 0.1))
def test_increments_are_growth_beyond_noise(values: list[float], std: float) -> None:
    age = np.arange(len(values), dtype=float)
    life = Life(1, age, np.array(values), np.full(len(values), std), 0.0)
    found = increments_of([life, life])
    assert np.all(np.abs(found.high - found.low) >= 4.999 * np.sqrt(2.0) * std)
    assert np.all(found.start < found.end)
    half = len(found) // 2
    assert np.array_equal(found.start[1:half], found.end[: max(half - 1, 0)])
    assert found.life.tolist() == [0] * half + [1] * half


@pytest.mark.parametrize("usage", [Usage(), Usage(None, 600.0)])
def test_an_event_without_hours_is_placed_by_its_date(usage: Usage) -> None:
    values = (0.1, 0.2, 0.3, 0.1, 0.2)
    rows = [
        an_entry(7, 100.0 * n, (value, 0, 0), tested=f"2026-03-0{n}T12:00:00Z")
        for n, value in enumerate(values, start=1)
    ]
    event = an_event(resets=("Kintas",), when="2026-03-03T18:00:00.000Z", usage=usage)
    assert [life.born for life in lives_of(rows, [event], "Kintas", "hours")[7]] == [0.0, 300.0]
    before = an_event(resets=("Kintas",), when="2026-02-01T00:00:00.000Z", usage=usage)
    assert [life.born for life in lives_of(rows, [before], "Kintas", "hours")[7]] == [0.0]
