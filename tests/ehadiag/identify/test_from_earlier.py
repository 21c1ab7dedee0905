"""A refinement that begins from the unit's last diagnosis: the same answer, without a search."""

from __future__ import annotations

import math

import numpy as np
import pytest
from identify_cases import recorded

from ehadiag.identify.identification_session import (
    EarlierEstimate,
    IdentificationSession,
    NuisanceMode,
    identify,
)
from ehadiag.identify.prior import UnitPrior
from ehadiag.model.registry import FAULT_NAMES, parameter


@pytest.fixture(scope="module", params=["paper-open-2.blf open", "paper-closed-3.blf closed"])
def known(request):
    """An experiment, and its estimate from its own search."""
    experiment = recorded(*request.param.split())
    return experiment, identify([experiment])


def begun(experiment, found, changes, **options):
    """Identify from an earlier estimate that differs by some changes."""
    values = {
        item.name: min(max(item.value + change, 0.0), 1.0)
        for item, change in zip(found.estimates, changes, strict=True)
    }
    earlier = EarlierEstimate(values, "yesterday")
    return IdentificationSession(earlier=earlier, **options).finish([experiment])


@pytest.mark.parametrize("changes", [(0.0, 0.0, 0.0), (3e-4, -3e-4, 5e-4)])
def test_small_wear_needs_no_search(known, changes):
    experiment, found = known
    new = begun(experiment, found, changes)
    assert new.begun_from == "yesterday"
    assert new.evaluations < found.evaluations / 5
    for before, after in zip(found.estimates, new.estimates, strict=True):
        assert after.value == pytest.approx(before.value, abs=0.1 * before.std)
        assert after.std == pytest.approx(before.std, rel=0.02)
        assert math.isnan(after.first)
        assert math.isnan(after.search)


@pytest.mark.parametrize("name", FAULT_NAMES)
def test_what_broke_overnight_is_found_by_the_search(known, name):
    experiment, found = known
    jump = [-0.2 if item == name else 0.0 for item in FAULT_NAMES]
    new = begun(experiment, found, jump)
    assert not new.begun_from
    assert [item.value for item in new.estimates] == [item.value for item in found.estimates]
    assert [item.search for item in new.estimates] == [item.search for item in found.estimates]


def test_rounds_that_do_not_come_to_rest_are_no_answer():
    experiment = recorded("paper-closed-1.blf", "closed")
    found = identify([experiment])
    new = begun(experiment, found, (0.0, 0.0, 0.0))
    assert not new.begun_from
    assert [item.value for item in new.estimates] == [item.value for item in found.estimates]


def test_an_earlier_estimate_has_no_weight(known):
    """Two days of the same drift end where the recording is, not between."""
    experiment, found = known
    ends = [
        [item.value for item in begun(experiment, found, (side, side, side)).estimates]
        for side in (-4e-4, 4e-4)
    ]
    stds = [item.std for item in found.estimates]
    assert np.abs(np.subtract(*ends) / stds).max() < 0.1


@pytest.mark.parametrize(
    "options",
    [
        {"nuisances": NuisanceMode.ALL},
        {"nuisances": NuisanceMode.NONE, "prior": UnitPrior(free=(parameter("null_bias"),))},
    ],
)
def test_more_unknowns_are_searched_for(known, options):
    experiment, found = known
    assert not begun(experiment, found, (0.0, 0.0, 0.0), **options).begun_from
