"""A diagnosis that is fed while the test runs: what is worked out, and what is left alone."""

from dataclasses import fields, replace

import numpy as np
import pytest
from msgspec import structs

from ehadiag.assess.diagnosis import DiagnosisSession, diagnose
from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Environment, Outcome, Quality, Recording, Samples
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag.identify.search.solvers import PygadGa
from ehadiag.identify.search.stages import STAGES
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import simulate

TESTS = tuple(bundled_tests().values())


@pytest.fixture(scope="module", params=["open", "closed"])
def recording(request):
    test = resolve_test(request.param)
    return simulate(default_actuator(), test, Faults(0.4, 0.5, 0.6), seed=3).recording("simulated")


def session_of(tests=TESTS, **options):
    return DiagnosisSession(default_actuator(), tests, **options)


def stored(recording):
    return next(test for test in TESTS if test.id == recording.test_id)


def cut(recording, ticks):
    """The recording as it was after so many ticks."""
    samples = recording.samples
    arrays = {
        field.name: getattr(samples, field.name)[..., :ticks]
        for field in fields(Samples)
        if isinstance(getattr(samples, field.name), np.ndarray)
    }
    return replace(recording, samples=replace(samples, **arrays))


def test_fed_when_due_the_verdict_is_that_of_the_recording_alone(recording):
    test, session = stored(recording), session_of()
    due = session.due_s(test)
    assert len(due) == 1 + len(STAGES)
    for end in due:
        session.feed(cut(recording, round(end * test.rate) + 7))
    fed = session.finish([recording])
    alone = diagnose([recording], default_actuator(), TESTS)
    assert session.reused >= 1 + len(STAGES) + 1
    assert (fed.verdict, fed.reasons, fed.notes) == (alone.verdict, alone.reasons, alone.notes)
    assert fed.identification.estimates == alone.identification.estimates
    np.testing.assert_array_equal(fed.identification.covariance, alone.identification.covariance)


def test_an_empty_recording_is_left_alone(recording):
    session = session_of()
    session.feed(Recording("bus", None, 1, None, Outcome(), Environment(), Quality()))
    session.feed(cut(recording, 0))
    session.finish([recording])
    assert session.reused == 0


def test_what_cannot_carry_a_verdict_is_left_alone(recording):
    """The model does not come back from a supply of nothing, or from frozen oil."""
    samples = recording.samples
    everywhere = np.zeros_like(samples.saturated)
    everywhere[1] = True
    holed = samples.spool.copy()
    holed[::3] = np.nan
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
