"""`tools/data_sheet`: a run is drawn from its seed, and its table has the columns of the others."""

import numpy as np
import pytest

from ehadiag_tools.accuracy import data_sheet
from ehadiag_tools.accuracy.nuisances import HEADINGS, row_of


def test_a_case_is_the_same_each_time_and_another_one_with_another_number():
    first, again, other = (data_sheet._drawn(1, case, ()) for case in (3, 3, 4))
    assert first == again
    assert first[0].effects != other[0].effects
    assert first[0].serial == 3


def test_a_group_of_effects_changes_nothing_else():
    plain, sensed = data_sheet._drawn(1, 3, ()), data_sheet._drawn(1, 3, ("sensing",))
    assert plain[0].effects == sensed[0].effects
    assert plain[1] == sensed[1]
    assert sensed[0].sensors.filter_time > 0.0


def test_a_refused_calibration_counts_as_not_tested():
    records = [
        {
            "faults": [0.1, 0.2, 0.3],
            "value": [0.1, 0.2, 0.4],
            "interval95": [[0.0, 0.2]] * 2 + [[0.3, 0.5]],
            "not_tested": refused,
            "evaluations": 10,
            "processor_s": 0.1,
        }
        for refused in (True, False)
    ]
    row = dict(zip(HEADINGS, row_of("open, calibrated", "auto", records), strict=True))
    assert row["NOT TESTED, %"] == "50.0"
    assert float(row["mean"]) == pytest.approx(100.0 * np.mean([0.0, 0.0, 0.1]), abs=1e-3)
