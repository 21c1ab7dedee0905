"""What residuals a stated discrepancy of the faults' laws allows."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.identify.estimates import explained_deviations
from ehadiag.identify.least_squares import Refinement
from ehadiag.model.registry import FAULTS


def refinement(jacobian, used, severities=(0.5, 0.4, 0.8)):
    return Refinement(
        parameters=FAULTS,
        x=np.array(severities),
        scale=np.ones(3),
        cost=0.0,
        residuals=np.zeros(used.shape),
        jacobian=np.where(used, jacobian, 0.0),
        considered=np.zeros((0, *used.shape)),
        used=used,
        weighted=np.ones(used.shape, dtype=np.bool_),
        evaluations=1,
        converged=True,
        anchored=0,
        step=np.zeros(3),
    )


@given(share=st.floats(0.0, 0.1), slope=st.floats(-300.0, 300.0))
def test_it_is_the_change_of_a_sample_by_the_discrepancy(share, slope):
    used = np.ones((2, 50), dtype=np.bool_)
    jacobian = np.zeros((3, 2, 50))
    jacobian[0, 1] = slope
    found = explained_deviations(refinement(jacobian, used), {FAULTS[0].name: share})
    assert (found[0] == 1.0).all()
    assert np.allclose(found[1], np.hypot(1.0, share * 0.5 * slope))


def test_a_row_that_took_no_part_has_the_sensitivity_of_its_neighbours():
    used = np.ones((2, 50), dtype=np.bool_)
    used[1, 20:30] = False
    jacobian = np.full((3, 2, 50), 200.0)
    found = explained_deviations(refinement(jacobian, used), {"FDJ": 0.01})
    assert np.allclose(found, found[0, 0])
    assert found[0, 0] > 1.5


def test_without_a_discrepancy_nothing_but_noise_is_allowed():
    used = np.zeros((2, 50), dtype=np.bool_)
    found = explained_deviations(refinement(np.full((3, 2, 50), 1e3), used), {"FDJ": 0.01})
    assert (found == 1.0).all()
    assert (explained_deviations(refinement(np.ones((3, 2, 50)), ~used), {}) == 1.0).all()
