"""Verdicts by the chance of being at or above a level, and by the estimates alone."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.assess.verdict import Levels, Rule, Verdict, chance_above, judge
from ehadiag.identify.result import Estimate
from ehadiag.identify.uncertainty import interval95

severities = st.floats(0.0, 1.0)
deviations = st.floats(1e-5, 2.0)


def estimate(name, value, std):
    span = interval95(value, std)
    return Estimate(name, value, value, value, std, span, at_bound=False, shown=True)


def verdict(*pairs, rule=Rule.INTERVAL):
    estimates = [estimate(f"S{i}", *pair) for i, pair in enumerate(pairs)]
    return judge(SimpleNamespace(estimates=estimates), Levels(rule=rule))


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        ([(0.1, 0.01), (0.0, 0.01), (0.2, 0.01)], Verdict.HEALTHY),
        ([(0.24, 0.001)], Verdict.HEALTHY),
        ([(0.24, 0.01)], Verdict.DEGRADED),  # below, but the chance is 16 %
        ([(0.2305, 0.01), (0.2305, 0.01)], Verdict.DEGRADED),  # 2.6 % each
        ([(0.25, 0.001)], Verdict.DEGRADED),
        ([(0.74, 0.02)], Verdict.DEGRADED),  # at the limit by 31 %
        ([(0.75, 0.02)], Verdict.FAULT),
        ([(0.5, 0.2)], Verdict.NOT_TESTED),
        ([(0.5, 0.2), (0.9, 0.01)], Verdict.FAULT),  # precedence
        ([(0.5, 0.2), (0.4, 0.01)], Verdict.NOT_TESTED),
    ],
)
def test_the_verdict_goes_by_the_interval(pairs, expected):
    found, reasons = verdict(*pairs)
    assert found is expected
    assert bool(reasons) is (expected is not Verdict.HEALTHY)


def test_the_reason_says_the_chance():
    assert verdict((0.24, 0.01))[1] == (
        "S0 0.240 may be at or above the advisory level 0.25: chance 15.9%",
    )


@given(st.lists(st.tuples(severities, deviations), min_size=1, max_size=4))
def test_never_healthy_where_the_chance_is_greater(pairs):
    found, _ = verdict(*pairs)
    levels = Levels()
    chances = [chance_above(estimate("S", *pair), levels.advisory) for pair in pairs]
    assert (found is Verdict.HEALTHY) <= (max(chances) <= 0.025)
    limits = [chance_above(estimate("S", *pair), levels.limit) for pair in pairs]
    assert (found is Verdict.FAULT) == (max(limits) >= 0.5)


@given(severities, severities)
def test_a_sure_estimate_is_judged_alike_by_both_rules(first, second):
    pairs = [(first, 0.0), (second, 0.0)]
    assert verdict(*pairs)[0] is verdict(*pairs, rule=Rule.ESTIMATE)[0]


@given(severities, deviations, severities)
def test_chances_are_chances(value, std, level):
    chance = chance_above(estimate("S", value, std), level)
    assert 0.0 <= chance <= 1.0
    assert chance_above(estimate("S", value, std), 0.0) == pytest.approx(1.0)
