"""The identification as a whole, on recordings that the project's simulator did not make.

Units whose second stage has orifices and compressible oil: what is left over, severities. The
objective: what counts, what does not, and that digits repeat.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_cases import PAPER_FAULTS, own_experiment, own_samples, recorded

from ehadiag import default_actuator
from ehadiag.identify.experiment import (
    ANCHOR_THRESHOLDS_LSB,
    build_experiment,
    lay_out_spans,
    unknowns_of,
)
from ehadiag.identify.identification_session import identify
from ehadiag.identify.solvers import SEARCH_CAP, Objective, PygadGa
from ehadiag.identify.staged_search import first_approximation, first_approximation_inputs
from ehadiag.model.registry import FAULT_NAMES, FAULTS, Unknowns, parameter
from ehadiag.model.residual_models import SimdModel
from ehadiag_sim import conditions
from ehadiag_tools.simulator.units import random_unit, record
from firmware_iface.recording import CHANNELS, Environment
from firmware_iface.stored_test import resolve_test

PAPER_FIRST = {"open": (0.7147, 7.7791, 9.6052, 9.5992), "closed": (0.3005, 4.5653, 5.1306, 2.2902)}
"""The paper's mean error after the first approximation, percent (PHY-40)."""
ALL = [(test, number) for test in ("open", "closed") for number in range(1, 5)]


def paper(test, number):
    return recorded(f"paper-{test}-{number}.blf", test)


def values(result):
    return np.array([item.value for item in result.estimates])


def errors(result, faults):
    return 100.0 * np.abs(values(result) - np.array(faults))


@pytest.mark.parametrize(("test", "number"), ALL)
def test_first_approximation_is_no_worse_than_the_papers(test, number):
    found = first_approximation(first_approximation_inputs([paper(test, number)]))
    values = np.array([found.values[name] for name in FAULT_NAMES])
    error = 100.0 * np.abs(values - PAPER_FAULTS[number - 1]).mean()
    assert error <= PAPER_FIRST[test][number - 1]


def test_paper_cases_are_ten_times_better_than_the_papers():
    for test, limit in (("open", 0.02), ("closed", 0.03)):
        means = []
        for number, faults in enumerate(PAPER_FAULTS, start=1):
            result = identify([paper(test, number)])
            assert result.converged
            assert not result.rescued
            means.append(errors(result, faults).mean())
        assert max(means) <= 0.15
        assert np.mean(means) <= limit


@pytest.mark.parametrize(
    ("file", "test", "faults"),
    [
        ("healthy-open.blf", "open", (0.0, 0.0, 0.0)),
        ("healthy-closed.blf", "closed", (0.0, 0.0, 0.0)),
        ("lossy-open.blf", "open", (0.4, 0.2, 0.5)),
        ("hot-worn-closed.asc", "closed", (0.2, 0.5, 0.1)),
    ],
)
def test_other_recordings(file, test, faults):
    """As new (at the bounds), with lost and corrupt frames, with hot oil and less supply."""
    result = identify([recorded(file, test)])
    assert errors(result, faults).max() <= 0.15
    for item, truth in zip(result.estimates, faults, strict=True):
        assert abs(item.value - truth) <= 4.0 * item.std
        assert item.shown


def test_result_is_consistent():
    result = identify([paper("open", 2)], seed=7)
    assert tuple(item.name for item in result.estimates) == FAULT_NAMES
    assert (result.seed, result.solver) == (7, "cga")
    for j, item in enumerate(result.estimates):
        low, high = item.interval95
        assert low <= item.value <= high
        assert item.std == pytest.approx(np.sqrt(result.covariance[j, j]))
        assert not item.at_bound
    assert np.all(np.linalg.eigvalsh(result.covariance) > 0.0)
    assert result.fit.outliers < 0.01
    assert result.fit.spool_rms == pytest.approx(1.0, abs=0.1)
    assert result.fit.pressure_rms == pytest.approx(1.0, abs=0.1)


def test_the_same_seed_gives_the_same_digits():
    first, second = (identify([paper("closed", 1)], seed=3) for _ in range(2))
    np.testing.assert_array_equal(values(first), values(second))
    np.testing.assert_array_equal(first.covariance, second.covariance)
    assert first.evaluations == second.evaluations


def test_search_seeds_hardly_matter():
    found = np.array([values(identify([paper("closed", 4)], seed=seed)) for seed in range(4)])
    assert 100.0 * np.ptp(found, axis=0).max() <= 0.01


def test_another_solver_ends_at_the_same_place():
    own, other = (identify([paper("open", 4)], solver=s) for s in (None, PygadGa()))
    assert (own.solver, other.solver) == ("cga", "pygad")
    assert 100.0 * np.abs(values(own) - values(other)).max() <= 0.02


def test_two_recordings_are_surer_than_one():
    both = [paper("open", 3), paper("closed", 3)]
    joint = identify(both)
    alone = [identify([item]) for item in both]
    assert errors(joint, (0.6, 0.6, 0.3)).mean() <= 0.02
    for j, item in enumerate(joint.estimates):
        assert item.std <= 1.05 * min(result.estimates[j].std for result in alone)


def test_an_estimate_at_its_bound_says_so():
    result = identify([own_experiment((0.0, 1.0, 0.5))])
    kintas, fss, fdj = result.estimates
    np.testing.assert_allclose(values(result), (0.0, 1.0, 0.5), atol=5e-4)
    for item, bound in ((kintas, 0.0), (fss, 1.0)):
        assert item.at_bound == (abs(item.value - bound) <= 1e-6)
        assert item.interval95[0 if bound == 0.0 else 1] == pytest.approx(bound, abs=1e-3)
    assert not fdj.at_bound


def test_a_severity_that_nothing_shows_is_flagged():
    """Without a single pressure sample nothing tells the friction of the jack."""
    experiment = own_experiment((0.3, 0.3, 0.3))
    experiment.pressure[:] = np.nan
    result = identify([experiment])
    assert [item.shown for item in result.estimates] == [True, True, False]
    low, high = result.estimates[2].interval95
    assert high - low > 0.5
    assert errors(result, (0.3, 0.3, 0.3))[:2].max() <= 0.15


def test_stages_are_told():
    stages = []
    identify([paper("open", 1)], progress=lambda stage, share: stages.append((stage, share)))
    names = list(dict.fromkeys(stage for stage, _ in stages))
    assert names == ["first approximation", "search", "refinement"]
    assert all(0.0 <= share <= 1.0 for _, share in stages)


@pytest.mark.slow
@pytest.mark.parametrize("test", ["open", "closed"])
def test_random_cases_of_the_cube(test):
    """A short sweep with the independent simulator, corners and edges included."""
    from ehadiag_tools.accuracy.cases import Case, perform, random_faults
    from ehadiag_tools.accuracy.figures import holds_truth, percent_errors

    cases = random_faults(20, 11)
    records = [perform(Case(test, faults, noise_seed=i)) for i, faults in enumerate(cases)]
    error = np.abs(percent_errors(records))
    mean, p95, largest = {"open": (0.02, 0.04, 0.3), "closed": (0.03, 0.06, 0.6)}[test]
    assert error.mean() <= mean
    assert np.percentile(error.mean(axis=1), 95.0) <= p95
    assert error.max() <= largest
    assert holds_truth(records).mean() >= 0.88
    interval = np.array([record["interval95"] for record in records])
    widths = error / (50.0 * np.diff(interval).squeeze(-1))
    assert np.median(widths) >= 0.1, "intervals several times wider than the errors need"


SEVERITIES = (0.52, 0.34, 0.47)
NOISE_LSB = np.sqrt(0.5**2 + 1.0 / 12.0)
"""Of the electronics and of rounding (PHY-22)."""
LSB = np.array([CHANNELS.spool.lsb, CHANNELS.pressure.lsb, CHANNELS.position.lsb])


@lru_cache(maxsize=4)
def recorded_unit(test, seed):
    """Recording of a unit with orifices, offsets, gain, null bias, hysteresis and backlash."""
    unit = random_unit(np.random.default_rng(seed), orifice=True)
    recording = record(unit, resolve_test(test), conditions.Faults(*SEVERITIES), seed=seed)
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(test), unit.actuator
    )
    return experiment, unit


def truth(experiment, unit):
    """Values of the model's parameters by name."""
    effects, offsets = unit.effects, unit.sensors.offsets_lsb
    return {
        "null_bias": effects.null_bias,
        "hysteresis": effects.hysteresis,
        "torque_motor_gain": effects.gain_change,
        "backlash": effects.backlash,
        "spool_offset": offsets[1] * CHANNELS[1].lsb - experiment.spool_offset,
        "pressure_offset": offsets[2] * CHANNELS[2].lsb - experiment.pressure_offset,
        "position_offset": offsets[3] * CHANNELS[3].lsb - experiment.position_offset,
        **{item.name: value for item, value in zip(FAULTS, SEVERITIES, strict=True)},
    }


@pytest.mark.parametrize("test", ["open", "closed"])
def test_with_all_known_nothing_but_noise_is_left(test):
    experiment, unit = recorded_unit(test, 0)
    values = truth(experiment, unit)
    unknowns = Unknowns(tuple(parameter(name) for name in values), (experiment.constants,), {})
    model = SimdModel(lay_out_spans([experiment], channels=(True, True, True)), unknowns)
    residuals = model.residuals(np.array([list(values.values())]))[0][0]
    level = np.sqrt(np.mean(residuals**2, axis=1)) * np.array(experiment.noise) / LSB
    assert level == pytest.approx([NOISE_LSB] * 3, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 6])
def test_severities_are_found_with_the_effects_unknown_in_closed_loop(seed):
    experiment, _ = recorded_unit("closed", seed)
    found = identify([experiment])
    errors = [abs(item.value - to) for item, to in zip(found.estimates, SEVERITIES, strict=True)]
    assert np.mean(errors) < 0.5e-2


@pytest.mark.slow
def test_severities_are_found_with_the_effects_unknown_in_open_loop():
    experiment, _ = recorded_unit("open", 0)
    found = identify([experiment])
    errors = [abs(item.value - to) for item, to in zip(found.estimates, SEVERITIES, strict=True)]
    assert np.mean(errors) < 0.05e-2


share = st.floats(0.0, 1.0)
candidates = st.lists(st.tuples(share, share, share), min_size=1, max_size=9).map(np.array)


def objective_of(experiments, windows=None, **options):
    batch = lay_out_spans(experiments, windows, **options)
    return Objective(SimdModel(batch, unknowns_of(experiments, FAULTS)))


@pytest.fixture(scope="module")
def objective():
    return objective_of([recorded("paper-closed-2.blf", "closed")])


@given(candidates)
@settings(max_examples=15)
def test_one_or_many_candidates_give_the_same_digits(objective, rows):
    together = objective(rows)
    alone = np.array([objective(row[None])[0] for row in rows])
    np.testing.assert_array_equal(together, alone)


@given(candidates)
@settings(max_examples=10)
def test_a_repeated_call_gives_the_same_digits(objective, rows):
    np.testing.assert_array_equal(objective(rows), objective(rows))


@given(candidates)
@settings(max_examples=10)
def test_cost_is_at_most_the_cap_of_each_sample(objective, rows):
    samples = np.count_nonzero(objective.model.batch.weight)
    cost = objective(rows)
    assert (cost >= 0.0).all()
    assert (cost <= SEARCH_CAP * samples).all()


def test_the_truth_costs_about_one_a_sample(objective):
    samples = np.count_nonzero(objective.model.batch.weight)
    cost = objective(
        np.array([[0.3, 0.6, 0.3], [0.35, 0.6, 0.3], [0.3, 0.7, 0.3], [0.3, 0.6, 0.4]])
    )
    assert cost[0] / samples == pytest.approx(1.0, abs=0.15)
    assert (cost[1:] > 2.0 * cost[0]).all()


def test_evaluations_are_counted(objective):
    before = objective.evaluations
    objective(np.full((7, 3), 0.5))
    objective(np.full((1, 3), 0.5))
    assert objective.evaluations == before + 8


def test_recordings_add_up():
    """Two recordings cost what they cost alone."""
    one, two = recorded("paper-open-2.blf", "open"), recorded("paper-closed-2.blf", "closed")
    x = np.array([[0.31, 0.59, 0.33], [0.9, 0.1, 0.5]])
    both = objective_of([one, two], anchor_lsb=ANCHOR_THRESHOLDS_LSB)(x)
    apart = [objective_of([item], anchor_lsb=ANCHOR_THRESHOLDS_LSB)(x) for item in (one, two)]
    np.testing.assert_allclose(both, apart[0] + apart[1], rtol=1e-12)


def test_missing_and_saturated_samples_cost_nothing():
    samples = own_samples((0.3, 0.3, 0.3))
    samples.spool[1000:] = np.nan
    samples.saturated[2, 1000:] = True
    samples.pressure[1000:] = 1e9
    test = resolve_test("open")
    broken = build_experiment(samples, Environment(), test, default_actuator())
    objective = objective_of([broken])
    assert np.count_nonzero(objective.model.batch.weight) == 2 * 1000
    assert objective(np.full((1, 3), 0.3))[0] < 2.0 * 2000


def test_windows_limit_what_counts():
    experiment = own_experiment((0.3, 0.3, 0.3))
    batch = lay_out_spans(
        [experiment], [((3.5, 4.5), (5.0, 5.5))], lead=0.1, channels=(False, True)
    )
    assert np.count_nonzero(batch.weight[0]) == 0
    assert np.count_nonzero(batch.weight[1]) == 1500
    np.testing.assert_array_equal(np.diff(batch.start), [1100, 600])


def test_a_span_outside_the_recording_is_refused():
    with pytest.raises(ValueError, match="no span"):
        lay_out_spans([own_experiment((0.3, 0.3, 0.3))], [((7.0, 8.0),)])
