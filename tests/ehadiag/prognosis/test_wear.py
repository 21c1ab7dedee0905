"""Laws of wear against simulation and linear algebra; histories cut into lives."""

from __future__ import annotations

import numpy as np
import pytest
from history_cases import an_entry, an_event
from msgspec.structs import replace
from scipy import stats

from ehadiag.history.records import Usage
from ehadiag.prognosis.lives import Life, lives_of
from ehadiag.prognosis.wear import LAW_NAMES, draw_laws, draw_passages, filter_lives

LAWS = draw_laws()
SCALE = 2000.0
LIFE = Life(
    1, np.array([100.0, 350.0, 500.0, 900.0]), np.array([0.01, 0.05, 0.07, 0.16]),
    np.full(4, 1e-3), 0.0,
)  # fmt: skip


def sets_of(law: str) -> np.ndarray:
    return np.flatnonzero(LAWS.law == LAW_NAMES.index(law))


def ones(value: float) -> np.ndarray:
    return np.full((1, len(LAWS.law)), value)


@pytest.mark.parametrize("law", ["Wiener", "power"])
def test_the_filter_has_the_density_of_a_normal_vector(law: str) -> None:
    found = filter_lives(LAWS, [LIFE], SCALE, ones(0.3), ones(0.2))
    for index in sets_of(law)[:3]:
        clock = (LIFE.age / SCALE) ** LAWS.power[index]
        since = clock[1:] - clock[0]
        covariance = 0.2**2 * np.outer(since, since) + 1e-6 + 1e-6 * np.eye(3)
        covariance += (LAWS.spread[index] * 0.3) ** 2 * np.minimum.outer(since, since)
        expected = stats.multivariate_normal(LIFE.value[0] + 0.3 * since, covariance)
        assert found.score[-1, 0, index] == pytest.approx(
            expected.logpdf(LIFE.value[1:]), rel=1e-4, abs=1e-3
        )


def test_each_law_follows_its_own_noiseless_path() -> None:
    """Its parameter sets have the highest density where a set made the life."""
    age = np.linspace(100.0, 2400.0, 24)
    for law in ("power", "Paris", "logistic", "two phases"):
        index = int(sets_of(law)[7])
        table, power = LAWS.table[:, index], LAWS.power[index]
        at = (age / SCALE) ** power
        clock = at + (LAWS.gain[index] - 1.0) * np.maximum(at - LAWS.knee[index], 0.0)
        grid = np.linspace(-0.05, 1.05, len(table))
        zero = np.interp(0.0, grid, table)
        end = np.interp(0.7, grid, table) - zero
        value = np.interp(zero + end * clock / clock[-1], table, grid)
        life = Life(1, age, value, np.full(24, 1e-4), 0.0)
        usual = np.tile(end / clock[-1], (1, len(LAWS.law)))
        score = filter_lives(LAWS, [life], SCALE, usual, usual).score[-1, 0]
        assert score[sets_of(law)].max() > score[sets_of("Wiener")].max() + 5.0


@pytest.mark.parametrize("law", ["Wiener", "gamma", "inverse Gaussian", "walking rate"])
def test_passages_are_those_of_simulated_paths(law: str) -> None:
    rng = np.random.default_rng(1)
    index, number, far, rate = int(sets_of(law)[5]), 3000, 0.3, 0.4
    laws = replace(
        LAWS,
        power=np.ones_like(LAWS.power), exponent=np.zeros_like(LAWS.power), table=np.tile(
            np.linspace(-0.05, 1.05, len(LAWS.table))[:, None], len(LAWS.law)
        ),
    )  # fmt: skip
    full = np.full(number, 1.0)
    found = draw_passages(
        laws, np.full(number, index), (0.0 * full, rate * full, 0 * full, 0 * full, 0 * full,
        rate * full), 0.0 * full, far * full, SCALE, rng,
    ) / SCALE  # fmt: skip
    step, spread = 1.0 / 500.0, LAWS.spread[index] * rate
    shape = (1500, number)
    if law == "gamma":
        growth = rng.gamma(step * (rate / spread) ** 2, spread**2 / rate, shape)
    elif law == "inverse Gaussian":
        growth = rng.wald(rate * step, step**2 * rate**3 / spread**2, shape)
    else:
        walk = LAWS.walk[index] * rate * np.sqrt(step) * rng.standard_normal(shape)
        speed = np.abs(rate + np.cumsum(walk, axis=0))
        growth = speed * step + spread * np.sqrt(step) * rng.standard_normal(shape)
    crossed = np.maximum.accumulate(np.cumsum(growth, axis=0)) >= far
    simulated = np.where(crossed[-1], (np.argmax(crossed, axis=0) + 1) * step, np.inf)
    shares = (0.1, 0.5, 0.9)
    tolerance = 0.15 if law == "walking rate" else 0.05
    assert np.quantile(found, shares) == pytest.approx(np.quantile(simulated, shares), tolerance)


def test_a_part_that_recovers_may_never_arrive() -> None:
    index = np.full(4000, sets_of("Wiener")[0])
    zero = np.zeros(4000)
    state = (zero, zero, zero, zero, zero + 1.0, zero + 0.4)
    found = draw_passages(
        LAWS, index, state, zero + 10.0, zero + 0.9, SCALE, np.random.default_rng(1)
    )
    assert 0.3 < np.mean(np.isinf(found)) < 0.6


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


def test_an_event_of_another_actuator_renews_nothing() -> None:
    event = an_event(hours=200.0, resets=("Kintas",), actuator="other")
    assert ages([event]) == [[100, 200, 300, 400, 500]]
    assert len(ages([replace(event, actuator="reference-31")])) == 2


def test_days_are_those_since_the_first_diagnosis() -> None:
    rows = [
        an_entry(7, None, (0.1 * n, 0, 0), tested=f"2026-03-0{n}T12:00:00Z") for n in range(1, 5)
    ]
    (life,) = lives_of(rows, [], "Kintas", "days")[7]
    assert life.age.tolist() == [0.0, 1.0, 2.0, 3.0]
