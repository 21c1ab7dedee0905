"""Which recordings choose a unit's model, and when the other second stage is tried."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest

from ehadiag.calibration import as_new, choice
from ehadiag.calibration.as_new import learned_as_new
from ehadiag.calibration.choice import choose
from ehadiag.calibration.effects import QUICK, in_order
from ehadiag.calibration.models import SMOOTH, Model
from ehadiag.calibration.session import Part, Session
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from ehadiag.identify.nuisance.explained import excess, is_noise
from ehadiag.model.batch import SPOOL_ROW
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit, record

TESTS = bundled_tests()
UNIT = random_unit(np.random.default_rng([1, 3]), data=True)
SKEW = "hysteresis_skew"


@lru_cache(maxsize=4)
def recording(test, seed):
    return replace(record(UNIT, TESTS[test], seed=seed, step=COARSE_STEP), source=f"{test}-{seed}")


def left(spool, pressure):
    """Noise, and waves of some sizes in both signals that no model explains."""
    rng = np.random.default_rng(1)
    wave = np.sin(np.arange(4000) / 300.0)
    out = rng.standard_normal((2, 4000)) + pressure * wave
    out[SPOOL_ROW] += (spool - pressure) * wave
    return out


class Told:
    """A session whose searches leave what the test says, by the model, and keep what was asked."""

    def __init__(self, leaves, hysteresis=0.02):
        self.leaves = leaves
        self.values = {"hysteresis": hysteresis}
        self.start = default_actuator()
        self.recordings = (None, None)
        self.asked = []

    def learn(self, model, **how):
        self.asked.append((model, how))
        residuals = left(*self.leaves(model))
        estimated = SimpleNamespace(
            refined=SimpleNamespace(residuals=residuals, values=self.values),
            explained=is_noise(residuals),
            excess=excess(residuals),
        )
        part = how.get("part", Part.ALL)
        experiments = [None] * (1 if part is Part.OPEN_LOOP else 2)
        return SimpleNamespace(
            model=model, estimated=estimated, experiments=experiments, criterion=0.0
        )

    @property
    def models(self):
        return [model for model, _ in self.asked]


@pytest.fixture
def further(monkeypatch):
    def freed(session, model):
        return session.learn(replace(model, beside=(SKEW,)), part=Part.OPEN_LOOP)

    def again(session, best):
        if best.estimated.explained:
            return best
        return session.learn(replace(best.model, beside=(SKEW, "load")), part=Part.OPEN_LOOP)

    monkeypatch.setattr(choice, "looked_for_again", again)
    monkeypatch.setattr(choice, "with_further_effects", freed)
    monkeypatch.setattr(as_new, "asked_for_by", lambda _found: (SKEW,))


def chosen(leaves, *, compare=False):
    session = Told(leaves)
    tried = choose(session, session.start, compare=compare)
    assert {how["part"] for _, how in session.asked} == {Part.OPEN_LOOP}
    return session, tried[-1].model


def test_what_is_explained_is_taken():
    session, model = chosen(lambda _model: (0.0, 0.0))
    assert session.models == [model] == [Model("linear")]


def test_the_other_stage_is_tried_where_only_the_pressure_is_left():
    def leaves(model):
        return (0.0, 0.0 if model.second_stage == "orifice" else 9.0)

    session, model = chosen(leaves)
    assert model == Model("orifice")
    assert {item.second_stage for item in session.models[:-1]} == {"linear"}


def test_where_the_spool_is_left_no_other_stage_is_tried(further):
    def leaves(model):
        return (0.0, 0.0) if model.rich else (5.0, 9.0)

    session, model = chosen(leaves)
    assert (model.second_stage, model.plays) == ("linear", SMOOTH)
    assert "orifice" not in {item.second_stage for item in session.models}


def test_the_other_stage_is_not_given_up_where_effects_explain_too_little(further):
    def leaves(model):
        return (0.0, 0.0) if model.rich and model.second_stage == "orifice" else (5.0, 9.0)

    assert chosen(leaves)[1].second_stage == "orifice"


def test_where_only_the_pressure_is_left_the_other_stage_comes_before_another_look(further):
    def leaves(model):
        if not model.rich:
            return (5.0, 9.0)
        return (0.0, 0.0 if model.second_stage == "orifice" else 9.0)

    session, _ = chosen(leaves)
    looked = [len(item.beside) for item in session.models if item.second_stage == "linear"]
    assert max(looked) == 1


def test_where_neither_stage_explains_the_better_one_is_looked_for_again(further):
    session, model = chosen(lambda model: (0.0, 9.0) if model.rich else (5.0, 9.0))
    assert len(model.beside) == 2
    assert {item.second_stage for item in session.models} == {"linear", "orifice"}


def test_a_comparison_tries_all():
    session, _ = chosen(lambda _model: (0.0, 0.0), compare=True)
    assert session.models == [
        Model(kind, plays) for plays in (1, SMOOTH) for kind in ("linear", "orifice")
    ]


def learned_after(leaves, hysteresis=0.02):
    session = Told(leaves, hysteresis)
    best = session.learn(Model("linear", SMOOTH, (SKEW, "load")), part=Part.OPEN_LOOP)
    learned = learned_as_new(session, best)
    assert all(how["new"] for _, how in session.asked[1:])
    assert learned.model.beside == (SKEW,)
    return [(model.beside, how.get("hint_of_open", False)) for model, how in session.asked[1:]]


def test_what_open_loop_explains_is_learned_as_it_is(further):
    assert learned_after(lambda _model: (0.0, 0.0)) == [((SKEW,), True)]


def test_effects_that_closed_loop_may_ask_for_are_freed_once_more(further):
    asked = learned_after(lambda _model: (1.0, 1.0))
    assert asked == [(in_order(QUICK), True), ((SKEW,), False), ((SKEW,), True)]


def test_with_little_hysteresis_closed_loop_asks_for_nothing(further):
    asked = learned_after(lambda _model: (1.0, 1.0), hysteresis=0.001)
    assert {names for names, _ in asked} == {(SKEW,)}


def test_closed_loop_that_open_loop_does_not_explain_asks_for_more(further):
    asked = learned_after(lambda model: (9.0, 9.0) if len(model.beside) == 1 else (0.0, 0.0))
    assert (in_order(QUICK), True) in asked


@pytest.mark.parametrize(
    ("part", "names"),
    [
        (Part.ALL, ["open-1", "closed-2", "open-3"]),
        (Part.EACH_TEST, ["open-1", "closed-2"]),
        (Part.OPEN_LOOP, ["open-1"]),
    ],
)
def test_a_part_of_the_recordings(part, names):
    every = [recording("open", 1), recording("closed", 2), recording("open", 3)]
    found = Session(every, default_actuator(), TESTS.values(), None, 0, None)
    built = found.build(default_actuator(), part)
    wanted = [item for item in every if item.source in names]
    assert [item.spool[100] for item in built] == [
        item.spool[100] for item in map(built_alone, wanted)
    ]


def built_alone(item):
    session = Session([item], default_actuator(), TESTS.values(), None, 0, None)
    return session.build(default_actuator())[0]


def test_closed_loop_alone_chooses_for_itself():
    alone = Session([recording("closed", 2)], default_actuator(), TESTS.values(), None, 0, None)
    assert len(alone.build(default_actuator(), Part.OPEN_LOOP)) == 1
