"""Remaining life: numbers, why there is none, and alarms."""

from __future__ import annotations

import numpy as np
import pytest
from history_cases import an_entry, an_event

from ehadiag.history.records import Entry, MaintenanceEvent, Usage, continued_usage
from ehadiag.prognosis.averaging import AVERAGING_RULES, learn_fleet
from ehadiag.prognosis.forecast import Forecast, forecast
from ehadiag.prognosis.lives import Life, lives_of
from ehadiag.prognosis.units import prognosis_of
from firmware_iface import FREE_MOTION
from firmware_iface.errors import ConfigurationError

RATE = 2.5e-4
NOISE = 2e-4


def worn(serial: int, number: int = 20, rate: float = RATE, jump: float = 0.0) -> Life:
    rng = np.random.default_rng(serial)
    age = 100.0 * np.arange(1.0, number + 1)
    path = np.cumsum(rng.gamma(6.0, 100.0 * rate / 6.0, number))
    path[number // 2 :] += jump
    return Life(serial, age, path + NOISE * rng.standard_normal(number), np.full(number, NOISE), 0)


FLEET = learn_fleet([worn(serial, 28) for serial in range(10, 22)], 2000.0)
ALONE = learn_fleet([], 2000.0)


def of(life: Life, fleet=FLEET, levels=(0.25, 0.75)) -> Forecast:  # type: ignore[no-untyped-def]
    return forecast("FSS", "hours", life, fleet, levels)


@pytest.mark.parametrize("fleet", [FLEET, ALONE], ids=["fleet", "alone"])
def test_a_worn_unit_gets_numbers(fleet) -> None:  # type: ignore[no-untyped-def]
    life = worn(1)
    advisory, limit = of(life, fleet).remaining
    assert (advisory.low, advisory.median, advisory.high) == (0.0, 0.0, 0.0)
    assert limit.low is not None
    assert limit.median is not None
    assert limit.high is not None
    true = (0.75 - life.value[-1]) / RATE
    assert limit.low < limit.median < limit.high
    assert 0.5 * true < limit.median < 2.0 * true


def test_a_fleet_narrows_the_interval() -> None:
    life = worn(1, 8)
    widths = []
    for fleet in (FLEET, ALONE):
        left = of(life, fleet).remaining[1]
        if left.high is None or left.low is None:
            assert fleet is ALONE
            return
        widths.append(left.high - left.low)
    assert widths[0] < widths[1]


def test_the_same_seed_gives_the_same_digits() -> None:
    assert of(worn(1)) == of(worn(1))


@pytest.mark.parametrize(
    ("life", "why"),
    [
        (worn(1, 1), "1 diagnosis of the unit, needs 2"),
        (worn(1, 0), "no diagnoses of the unit"),
        (worn(1, 20, rate=1e-9), "show no growth beyond their noise"),
    ],
)
def test_what_cannot_carry_a_number_gets_none_and_a_reason(life: Life, why: str) -> None:
    for left in of(life).remaining:
        assert left.median is left.low is left.high is None
        assert why in left.why


@pytest.mark.parametrize("fleet", [FLEET, ALONE], ids=["fleet", "alone"])
def test_a_jump_is_an_alarm(fleet) -> None:  # type: ignore[no-untyped-def]
    found = of(worn(1, 20, jump=0.4), fleet, (0.95,))
    assert "between 1000 and 1100 hours" in found.alarm
    assert "99.9% of diagnoses" in found.alarm


def test_a_fall_without_an_event_is_an_alarm() -> None:
    found = of(worn(1, 20, jump=-0.2), FLEET, (0.75,))
    assert "no wear falls" in found.alarm


def test_ordinary_wear_raises_no_alarm() -> None:
    assert [of(worn(serial)).alarm for serial in range(30, 38)] == [""] * 8


def test_a_filter_change_begins_a_new_life() -> None:
    first = [an_entry(7, 100.0 * n, (0.03 * n, 0.02 * n, 0.0)) for n in range(1, 16)]
    second = [an_entry(7, 1500.0 + 100 * n, (0.03 * n, 0.3 + 0.02 * n, 0.0)) for n in range(1, 11)]
    entries = [*first, *second]
    found = prognosis_of(7, entries, [an_event(hours=1500.0)], (0.25, 0.75))
    kintas, fss, fdj = found.forecasts
    assert kintas.diagnoses == 10
    assert kintas.fleet == 1
    assert fss.diagnoses == 25
    assert fss.alarm == kintas.alarm == ""
    left = kintas.remaining[1]
    assert left.low is not None
    assert left.high is not None
    assert left.low < 1500.0 < left.high * 1.2
    assert "no growth" in fdj.remaining[1].why
    # Nobody wrote the change down.
    silent = prognosis_of(7, entries, [], (0.25, 0.75)).forecasts[0]
    assert "append it as an event" in silent.alarm


def test_simulated_units_are_no_fleet_of_real_ones() -> None:
    mine = [an_entry(7, 100.0 * n, (0.03 * n, 0.1, 0.1)) for n in range(1, 9)]
    others = [
        an_entry(8, 100.0 * n, (0.03 * n, 0.1, 0.1), simulated=True) for n in range(1, 9)
    ]  # fmt: skip
    assert prognosis_of(7, [*mine, *others], [], (0.25, 0.75)).forecasts[0].fleet == 0


def test_cycles_stand_for_hours_where_only_they_are_said() -> None:
    rows = [an_entry(7, None, (0.03 * n, 0.1, 0.1), usage=Usage(None, n)) for n in range(1, 9)]
    assert prognosis_of(7, rows, [], (0.25, 0.75)).unit == "cycles"


def test_a_unit_that_nobody_knows_has_no_numbers() -> None:
    found = prognosis_of(99, [], [], (0.25, 0.75))
    assert found.actuator is None
    assert all(left.median is None for item in found.forecasts for left in item.remaining)


def test_one_units_jump_does_not_change_the_forecasts_of_the_others() -> None:
    others = [worn(serial, 28) for serial in range(10, 16)]
    life, last = worn(1, 8), worn(16, 28)
    value = last.value.copy()
    value[-1] += 0.3
    jumped = Life(last.serial, last.age, value, last.std, last.born)
    sound = of(life, learn_fleet([*others, last], 2000.0)).remaining[1].median
    beside = learn_fleet([*others, jumped], 2000.0)
    assert of(life, beside).remaining[1].median == pytest.approx(sound, rel=0.15)


def test_a_steady_fall_is_an_alarm() -> None:
    age = 100.0 * np.arange(1.0, 7.0)
    life = Life(1, age, np.linspace(0.5, 0.25, 6), np.full(6, NOISE), 0.0)
    for fleet in (FLEET, ALONE):
        found = of(life, fleet)
        assert "no wear falls" in found.alarm
        assert all(left.median is None for left in found.remaining if left.level > 0.3)


def test_many_lives_are_drawn_from_evenly_not_by_their_diagnoses() -> None:
    """A cap that kept the lives with most diagnoses kept the slow ones."""
    lives = [worn(serial, 10 + serial % 40) for serial in range(10, 210)]
    seen = [len(life.age) for life in learn_fleet(lives, 2000.0).seen]
    assert np.mean(seen) == pytest.approx(
        np.mean([min(len(life.age), 32) for life in lives]), rel=0.15
    )


def test_hours_since_the_last_diagnosis_shorten_what_is_left() -> None:
    life = worn(1)
    whole = forecast("FSS", "hours", life, FLEET, (0.75,)).remaining[0]
    later = forecast("FSS", "hours", life, FLEET, (0.75,), elapsed=200.0).remaining[0]
    assert whole.median is not None
    assert later.median is not None
    assert later.median == pytest.approx(whole.median - 200.0)
    assert later.chance_within(0.0) == whole.chance_within(200.0)
    past = forecast("FSS", "hours", life, FLEET, (0.75,), elapsed=1e5).remaining[0]
    assert past.chance_within(0.0) == 1.0
    assert not past.reached


def test_the_chance_within_a_time_is_that_of_the_quantiles() -> None:
    left = of(worn(1)).remaining[1]
    assert left.median is not None
    assert left.high is not None
    assert left.chance_within(left.median) == pytest.approx(0.5, abs=0.01)
    assert left.chance_within(left.high) == pytest.approx(0.9, abs=0.01)
    assert left.chance_within(0.0) == 0.0


def test_what_no_life_has_shown_is_called_extrapolated() -> None:
    young = [worn(serial, 8) for serial in range(10, 22)]
    found = of(worn(1, 6), learn_fleet(young, 2000.0), (0.95,))
    assert "0.95 is extrapolated" in found.note
    assert of(worn(1, 6)).note == ""


def test_a_way_that_few_lives_have_passed_may_be_passed_faster_or_slower() -> None:
    """Both halves of the interval grow with it; without a fleet the upper one has a floor."""
    young = learn_fleet([worn(serial, 8) for serial in range(10, 22)], 2000.0)
    for fleet, level in ((young, 0.6), (ALONE, 0.6), (ALONE, 0.2)):
        life = worn(1, 6)
        left = of(life, fleet, (level,)).remaining[0]
        assert left.median is not None
        assert left.low is not None
        assert left.high is not None
        tops = [0.0] if fleet is ALONE else [float(item.value.max()) for item in fleet.seen]
        passed = max(life.value.max(), np.quantile(tops, AVERAGING_RULES.unseen_quantile))
        least = np.log(level / passed)
        assert np.log(left.median / left.low) > 0.99 * least
        later = AVERAGING_RULES.later * (1.0 if fleet is ALONE else least)
        assert np.log(left.high / left.median) > 0.99 * later


def test_a_rate_that_rose_and_fell_may_do_so_again() -> None:
    """Without a fleet each half of the interval has a share of the swing, else it has not."""
    age = 100.0 * np.arange(1.0, 25.0)
    for fast, slow in ((4e-4, 4e-5), (2.2e-4, 2.2e-4)):
        growth = 100.0 * np.where(np.arange(24) // 4 % 2, slow, fast)
        life = Life(1, age, np.cumsum(growth), np.full(24, NOISE), 0)
        left = of(life, ALONE, (0.75,)).remaining[0]
        assert left.median is not None
        assert left.low is not None
        assert left.high is not None
        least = AVERAGING_RULES.swing_alone * np.log(10.0)
        for half in (np.log(left.median / left.low), np.log(left.high / left.median)):
            assert (half > 0.99 * least) == (fast > slow)


def test_severities_by_free_motion_count_and_a_refused_test_does_not() -> None:
    rows = [an_entry(7, 100.0 * n, (0.03 * n, 0.1, 0.1)) for n in range(1, 5)]
    untested = {"verdict": "NOT_TESTED"}
    moved = an_entry(7, 500.0, (0.15, 0.1, 0.1), 0.01, test=FREE_MOTION, **untested)
    refused = an_entry(7, 600.0, (0.9, 0.1, 0.1), **untested)
    life = lives_of([*rows, moved, refused], [], "Kintas", "hours")[7][0]
    assert life.age.tolist() == [100.0, 200.0, 300.0, 400.0, 500.0]
    assert life.std[-1] == 0.01


def running_away(serial: int, top: float) -> tuple[Life, float]:
    """A life whose rate grows without bound, seen up to a severity; its age at 0.75."""
    rng = np.random.default_rng(serial)
    end = float(rng.uniform(1800.0, 2200.0))
    age = np.arange(40.0, end, 40.0)
    value = 0.06 * (1.0 / (1.0 - age / end) - 1.0) + NOISE * rng.standard_normal(len(age))
    seen = slice(0, int(np.argmax(value > top)))
    whole = Life(serial, age[seen], value[seen], np.full(len(age), NOISE)[seen], 0.0)
    return whole, end * (1.0 - 1.0 / (1.0 + 0.75 / 0.06))


def test_lives_that_ended_before_the_limit_are_run_on_as_they_grew() -> None:
    """Scaled to the limit, they would last too long where growth speeds up."""
    lives = [running_away(serial, 0.48)[0] for serial in range(400, 412)]
    fleet, early = learn_fleet(lives, 2000.0), []
    for serial in range(500, 510):
        life, end = running_away(serial, 0.2)
        left = of(life, fleet, (0.75,)).remaining[0]
        assert left.low is not None
        early.append(end - life.age[-1] < left.low)
    assert np.mean(early) < 0.25


def test_a_cover_of_fleets_own_lives() -> None:
    """Eighty per cent, give or take what forty lives allow."""
    inside = []
    for serial in range(300, 340):
        life = worn(serial, 34)
        now = Life(1, life.age[:12], life.value[:12], life.std[:12], 0.0)
        left = of(now, FLEET, (0.6,)).remaining[0]
        end = float(np.interp(0.6, np.maximum.accumulate(life.value), life.age)) - now.age[-1]
        assert left.low is not None
        assert left.high is not None
        inside.append(left.low <= end <= left.high)
    assert 0.65 < np.mean(inside) < 0.98


def test_hours_of_a_swapped_unit_count_anew() -> None:
    def tested(n: int, hours: float, *values: float) -> Entry:
        return an_entry(7, hours, values, tested=f"2026-{1 + n // 28:02}-{1 + n % 28:02}T12:00:00Z")

    old = [tested(n, 100.0 * n, 0.03 * n, 0.02 * n, 0.01 * n) for n in range(1, 21)]
    new = [tested(20 + n, 100.0 * n, 0.03 * n, 0.02 * n, 0.01 * n) for n in range(1, 5)]
    swap = an_event(
        "swapped", 2050.0, resets=("Kintas", "FSS", "FDJ"), when="2026-01-21T15:00:00.000Z"
    )
    found = prognosis_of(7, [*old, *new], [swap], (0.25, 0.75), now="2026-01-27T00:00:00.000Z")
    assert [item.diagnoses for item in found.forecasts] == [4, 4, 4]
    assert [item.at for item in found.forecasts] == [400.0] * 3
    assert found.usage_now == pytest.approx(600.0, rel=0.2)
    assert found.forecasts[0].remaining[1].median == pytest.approx(1900.0, rel=0.3)
    with pytest.raises(ConfigurationError, match="were 400 at the last"):
        prognosis_of(7, [*old, *new], [swap], (0.25, 0.75), today=Usage(300.0))
    fewer = prognosis_of(7, [*old, *new[:1]], [swap], (0.25, 0.75)).forecasts[0]
    assert fewer.remaining[1].why == "1 diagnosis of the unit, needs 3"
    # Hours that run on across the swap are those of the place.
    on = [tested(20 + n, 2050.0 + 100.0 * n, 0.03 * n, 0.02 * n, 0.01 * n) for n in range(1, 5)]
    assert prognosis_of(7, [*old, *on], [swap], (0.25, 0.75)).forecasts[0].at == 2450.0


ALL = ("Kintas", "FSS", "FDJ")


def a_unit(*hours: float, first: int = 1) -> list[Entry]:
    """Diagnoses of a unit, one a day."""
    return [
        an_entry(7, at, (0.02 * n, 0.2, 0.3), tested=f"2026-01-{first + n:02}T12:00:00.000Z")
        for n, at in enumerate(hours)
    ]


def a_swap(day: int, hours: float | None = None) -> MaintenanceEvent:
    return an_event("swapped", hours, resets=ALL, when=f"2026-01-{day:02}T15:00:00.000Z")


def test_hours_begin_anew_at_each_of_two_swaps_without_a_test_between() -> None:
    entries = [*a_unit(100.0, 900.0), *a_unit(10.0, first=9)]
    events = [a_swap(4, 950.0), a_swap(6, 30.0)]
    counted, changes, _ = continued_usage(entries, events, ALL)
    assert [item.usage.hours for item in counted] == [100.0, 900.0, 990.0]
    assert [item.usage.hours for item in changes] == [950.0, 980.0]


def test_rounded_hours_after_an_overhaul_are_of_the_same_unit() -> None:
    entries = [*a_unit(900.0), *a_unit(880.0, 1000.0, first=9)]
    counted, _, _ = continued_usage(entries, [a_swap(4)], ALL)
    assert [item.usage.hours for item in counted] == [900.0, 880.0, 1000.0]


def test_a_unit_swapped_in_has_no_usage_until_it_is_tested_or_stated() -> None:
    entries, day = a_unit(*(100.0 * n for n in range(1, 11))), "2026-03-01T00:00:00.000Z"
    found = prognosis_of(7, entries, [a_swap(20)], (0.25, 0.75), now=day)
    assert (found.usage_now, found.usage_tested, found.per_day) == (None, None, None)
    today = Usage(hours=30.0)
    stated = prognosis_of(7, entries, [a_swap(20, 950.0)], (0.25, 0.75), today=today, now=day)
    assert stated.usage_now == 30.0
    assert prognosis_of(7, entries, [], (0.25, 0.75), now=day).usage_tested == 1000.0


def test_a_clock_before_the_last_test_gives_no_dates() -> None:
    entries = a_unit(*(100.0 * n for n in range(1, 11)))
    wrong = prognosis_of(7, entries, [], (0.25, 0.75), now="2026-01-02T00:00:00.000Z")
    assert (wrong.usage_now, wrong.date_after(100.0)) == (None, None)
    right = prognosis_of(7, entries, [], (0.25, 0.75), now="2026-01-10T00:00:00.000Z")
    assert right.usage_now == 1000.0
    assert right.date_after(100.0) == "2026-01-11"
