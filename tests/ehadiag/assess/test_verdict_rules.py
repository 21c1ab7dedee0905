"""Verdicts by the chance of being at or above a level, and by the estimates alone.

A diagnosis that is fed while the test runs: what is worked out, and what is left alone.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from msgspec.structs import replace

from ehadiag import Levels, Recording, Samples, Verdict, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import DiagnosisSession, diagnose
from ehadiag.assess.verdict import VerdictRule, chance_above, judge
from ehadiag.identify.estimates import interval95
from ehadiag.identify.identification_result import Estimate
from ehadiag.identify.solvers import PygadGa
from ehadiag.identify.staged_search import STAGE_SHARES
from ehadiag_sim.conditions import Faults
from ehadiag_sim.simulation import simulate
from firmware_iface.recording import BitOutcome, Environment, Quality
from firmware_iface.stored_test import resolve_test

severities = st.floats(0.0, 1.0)
deviations = st.floats(1e-5, 2.0)


def estimate(name, value, std):
    span = interval95(value, std)
    return Estimate(name, value, value, value, std, span, at_bound=False, shown=True)


def verdict(*pairs, rule=VerdictRule.INTERVAL):
    estimates = [estimate(f"S{i}", *pair) for i, pair in enumerate(pairs)]
    return judge(
        SimpleNamespace(estimates=estimates, frictions=(), exponent_doubted=False),
        Levels(rule=rule),
    )


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
    assert verdict(*pairs)[0] is verdict(*pairs, rule=VerdictRule.ESTIMATE)[0]


@given(severities, deviations, severities)
def test_chances_are_chances(value, std, level):
    chance = chance_above(estimate("S", value, std), level)
    assert 0.0 <= chance <= 1.0
    assert chance_above(estimate("S", value, std), 0.0) == pytest.approx(1.0)


TESTS = tuple(bundled_tests().values())


@pytest.fixture(scope="module", params=["open", "closed"])
def recording(request):
    test = resolve_test(request.param)
    done = simulate(default_actuator(), test, Faults(0.4, 0.5, 0.6), seed=3, step=1e-6)
    return done.recording("simulated")


def session_of(tests=TESTS, **options):
    return DiagnosisSession(default_actuator(), tests, **options)


def stored(recording):
    return next(test for test in TESTS if test.id == recording.test_id)


def cut(recording, ticks):
    """The recording as it was after so many ticks."""
    samples = recording.samples
    arrays = {
        name: getattr(samples, name)[..., :ticks]
        for name in Samples.__struct_fields__
        if isinstance(getattr(samples, name), np.ndarray)
    }
    return replace(recording, samples=replace(samples, **arrays))


def test_fed_when_due_the_verdict_is_that_of_the_recording_alone(recording):
    test, session = stored(recording), session_of()
    due = session.due_s(test)
    assert len(due) == 1 + len(STAGE_SHARES)
    for end in due:
        session.feed(cut(recording, round(end * test.rate) + 7))
    fed = session.finish([recording])
    alone = diagnose([recording], default_actuator(), TESTS)
    assert session.reused >= 1 + len(STAGE_SHARES) + 1
    assert (fed.verdict, fed.reasons, fed.notes) == (alone.verdict, alone.reasons, alone.notes)
    assert fed.identification.estimates == alone.identification.estimates
    np.testing.assert_array_equal(fed.identification.covariance, alone.identification.covariance)


def test_an_empty_recording_is_left_alone(recording):
    session = session_of()
    session.feed(Recording("bus", None, 1, None, BitOutcome(), Environment(), Quality()))
    session.feed(cut(recording, 0))
    session.finish([recording])
    assert session.reused == 0


def test_what_cannot_carry_a_verdict_is_left_alone(recording):
    """The model does not come back from a supply of nothing, or from frozen oil."""
    samples = recording.samples
    everywhere = np.zeros_like(samples.saturated)
    everywhere[1] = True
    holed = np.where(np.arange(len(samples.spool)) % 5 == 0, samples.spool, np.nan)
    for unfit in (
        replace(recording, environment=Environment(0.0, 0.0, 40.0)),
        replace(recording, environment=Environment(21e6, 0.0, -100.0)),
        replace(recording, samples=replace(samples, saturated=everywhere)),
        replace(recording, samples=replace(samples, spool=holed)),
        replace(recording, test_id=99),
    ):
        session = session_of()
        session.feed(unfit)
        session.feed(unfit)
        assert session.reused == 0
    session = session_of()
    session.feed(recording)
    session.feed(recording)
    assert session.reused > 0


def test_only_what_can_be_worked_out_early_is_due():
    test = resolve_test("open")
    assert session_of().due_s(test) == pytest.approx([3.5, 4.0, 4.5, 5.0])
    # No quiet part to judge the noise by; a solver that holds the interpreter.
    windows = structs.replace(test.windows, refinement=((0.5, 5.5),))
    assert session_of().due_s(structs.replace(test, windows=windows)) == ()
    assert session_of(solver=PygadGa()).due_s(test) == ()
