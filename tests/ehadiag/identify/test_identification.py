"""The identification as a whole, on recordings that the project's simulator did not make."""

import numpy as np
import pytest
from identify_cases import PAPER_FAULTS, own_experiment, recorded

from ehadiag.identify.search.first_approximation import first_approximation, first_inputs
from ehadiag.identify.search.solvers import PygadGa
from ehadiag.identify.session import identify
from ehadiag.model.parameters import FAULT_NAMES

PAPER_FIRST = {
    "open": (0.7147, 7.7791, 9.6052, 9.5992),
    "closed": (0.3005, 4.5653, 5.1306, 2.2902),
}
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
    found = first_approximation(first_inputs([paper(test, number)]))
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
    from ehadiag_tools.accuracy.cases import random_faults
    from ehadiag_tools.accuracy.figures import figures_of, percent_errors
    from ehadiag_tools.accuracy.runs import Run, perform

    cases = random_faults(20, 11)
    records = [perform(Run(test, faults, noise_seed=i)) for i, faults in enumerate(cases)]
    figures = figures_of(records)
    mean, p95, largest = {"open": (0.02, 0.04, 0.3), "closed": (0.03, 0.06, 0.6)}[test]
    assert figures.mean_all <= mean
    assert figures.p95_case <= p95
    assert max(figures.maximum) <= largest
    assert figures.coverage_all >= 88.0
    interval = np.array([record["interval95"] for record in records])
    widths = np.abs(percent_errors(records)) / (50.0 * np.diff(interval).squeeze(-1))
    assert np.median(widths) >= 0.1, "intervals several times wider than the errors need"
