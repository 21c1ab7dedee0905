"""When the effects of a calibrated unit are taken to have changed since its calibration."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from ehadiag.identify.nuisance import freed
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

    monkeypatch.setattr(freed, "estimate", answer)
    monkeypatch.setattr(freed, "considered_in", lambda *_: ())
    known = replace(CALIBRATED, aliases=(object(),))
    freeing = freed.Freeing(known, effects=(), seed=0, tell=lambda _share: None)
    found = freeing.estimated([], None, 9.0)
    assert found.excess == taken
