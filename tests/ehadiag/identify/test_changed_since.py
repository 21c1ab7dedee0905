"""When the effects of a calibrated unit are taken to have changed since its calibration."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from ehadiag.identify import session
from ehadiag.identify.nuisance.knowledge import Knowledge
from ehadiag.identify.nuisance.prior import Joint


@dataclass(frozen=True)
class Answer:
    excess: float
    explained: bool = False


CALIBRATED = Knowledge(joint=Joint(("null_bias",), np.zeros(1), np.array([[1e-16]])))
"""A unit of which one effect is known well."""


@pytest.mark.parametrize(
    ("as_known", "loosened", "taken"),
    [
        (1.17, 1.14, 1.17),  # wear brings out what the unit's model leaves
        (1.9, 1.7, 1.9),  # the effects explain little of it
        (6.0, 1.1, 1.1),
    ],
)
def test_effects_are_loosened_only_where_that_explains_what_the_calibration_does_not(
    monkeypatch, as_known, loosened, taken
):
    def answer(_experiments, _free, *, joint, **_):
        return Answer(as_known if joint is CALIBRATED.joint else loosened)

    monkeypatch.setattr(session, "estimate", answer)
    monkeypatch.setattr(session, "considered_in", lambda *_: ())
    known = replace(CALIBRATED, aliases=(object(),))
    found = session.Session(knowledge=known)._freed([], None, 9.0, lambda _stage, _share: None)
    assert found.excess == taken
