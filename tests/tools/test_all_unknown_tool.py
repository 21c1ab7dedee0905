"""`tools/all_unknown`: its bound, and what it prints."""

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.accuracy import all_unknown
from ehadiag_tools.accuracy.bound import cramer_rao
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, record


def test_more_unknowns_have_a_larger_bound():
    faults, test = (0.3, 0.4, 0.2), resolve_test("open")
    recording = record(Unit(), test, Faults(*faults), seed=1, step=COARSE_STEP)
    assert recording.samples is not None
    experiment = build_experiment(
        recording.samples, recording.environment, test, default_actuator()
    )
    few, many = cramer_rao([experiment], faults), all_unknown.bound_of(experiment, faults)
    assert np.all(many > 0.8 * few)  # noise as seen, and as specified
    assert many[1] > 2.0 * few[1]  # spool friction and hysteresis do nearly the same


def test_a_row_holds_errors_in_percent_beside_their_bound(capsys):
    record_of = {
        "faults": [0.1, 0.2, 0.3],
        "value": [0.1, 0.201, 0.3],
        "interval95": [[0.0, 0.2], [0.3, 0.4], [0.2, 0.4]],
        "bound": [1e-4, 2e-3, 1e-4],
        "not_tested": True,
        "processor_s": 0.25,
    }
    all_unknown.print_rows("open", [record_of])
    said = capsys.readouterr().out
    row = next(line for line in said.splitlines() if "| FSS |" in line)
    assert [float(cell) for cell in row.split("|")[4:9]] == pytest.approx([0.1, 0.1, 0.2, 0.5, 0.0])
    assert "1 NOT TESTED, 250 ms" in said
