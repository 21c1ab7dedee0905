"""A range of the clogging's exponent: the interval holds what each of it makes of the friction."""

from __future__ import annotations

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from places import LOGS

import ehadiag
from ehadiag import Levels, Verdict, default_actuator, simulate
from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import judge
from ehadiag.core.actuator import Discrepancy, SecondStage
from ehadiag.identify.estimates import (
    interval95,
    likelihood_ratio_cost,
    over_exponents,
)
from ehadiag.identify.identification_result import (
    Estimate,
    Fit,
    Identification,
    IdentificationTiming,
    Nuisance,
)
from ehadiag.identify.prior import unit_prior
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import FAULTS, parameter
from ehadiag_tools.accuracy import verdicts
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import bundled_tests

STD = 1e-3
NAMES = ("Kintas", "FSS", "FDJ")


def with_exponent(exponent):
    actuator = default_actuator()
    valve = msgspec.structs.replace(actuator.servovalve, clogging_exponent=exponent)
    return msgspec.structs.replace(actuator, servovalve=valve)


ANY = with_exponent((0.0, 2.0))


def identified(*values):
    """An identification with the largest exponent."""
    return Identification(
        estimates=tuple(
            Estimate(
                item.name,
                value,
                value,
                value,
                STD,
                interval95(value, STD),
                at_bound=False,
                shown=True,
            )
            for item, value in zip(FAULTS, values, strict=True)
        ),
        nuisances={"null_bias": Nuisance(0.0, 1e-6, at_bound=False)},
        about={},
        covariance=np.eye(3) * STD**2,
        fit=Fit(1.0, 1.0, 0.003, 1e-7, 1e4, 0.0, 0.0, 0, 0.003, 1.0),
        solver="cga",
        seed=0,
        evaluations=1,
        generations=1,
        cost=1.0,
        residuals=np.ones((2, 1)),
        converged=True,
        attempts=1,
        timing=IdentificationTiming(0.0, 0.0, 0.0),
    )


def over_any(found, constants, with_exponent=2.0):
    """An identification with one exponent, by all of them."""
    return over_exponents(found, constants, (0.0, 2.0), with_exponent=with_exponent)


@given(kintas=st.floats(0.0, 1.0), friction=st.floats(0.0, 1.0), exponent=st.floats(0.0, 2.0))
def test_the_interval_holds_the_friction_of_every_exponent(kintas, friction, exponent):
    constants = plant_constants(ANY)
    new = constants.FSS / (constants.FSS1 - constants.FSS)
    seen = (friction + new) * (1.0 - 0.8 * kintas) ** (2.0 - exponent) - new
    found = over_any(identified(kintas, seen, 0.3), constants)
    low, high = found.named("FSS").interval95
    assert low - 1e-9 <= friction <= high + 1e-9
    clogging = found.named("Kintas")
    assert clogging.value == kintas
    assert clogging.std == pytest.approx(np.hypot(STD, 0.02 * found.frictions[-1]))
    assert found.covariance[0, 0] == pytest.approx(clogging.std**2)
    assert found.covariance[2, 2] == pytest.approx(STD**2)
    assert found.covariance[1, 1] == pytest.approx(found.named("FSS").std ** 2)
    assert found.named("FSS").shown, "doubt about the exponent is none about the test"


@given(kintas=st.floats(0.1, 0.9), friction=st.floats(0.0, 0.5))
def test_estimate_and_exponent_are_what_was_identified(kintas, friction):
    """The response is that with the largest exponent, which was searched with."""
    constants = plant_constants(ANY)
    found = over_any(identified(kintas, friction, 0.3), constants)
    seen = found.constants(constants)
    assert seen.CLE == 2.0
    free = tuple(parameter(name) for name in ("Kintas", "FSS"))
    assert {item.name for item in free} < set(found.values)
    largest = plant_constants(with_exponent(2.0))
    gain = largest.GPF * (1.0 - 0.8 * kintas) ** 2.0
    force = largest.FSS + friction * (largest.FSS1 - largest.FSS)
    assert pytest.approx(force / gain, rel=1e-9) == seen.FSS / seen.GPF


@given(kintas=st.floats(0.1, 0.9), friction=st.floats(0.0, 0.5))
def test_a_doubted_zero_is_any_exponent(kintas, friction):
    """What was identified with exponent 0 has the frictions of what was with 2."""
    constants = plant_constants(with_exponent(0.0))
    new = constants.FSS / (constants.FSS1 - constants.FSS)
    papers = min((friction + new) * (1.0 - 0.8 * kintas) ** -2.0 - new, 1.0)
    series = (papers + new) * (1.0 - 0.8 * kintas) ** 2.0 - new
    found = over_any(identified(kintas, papers, 0.3), constants, with_exponent=0.0)
    other = over_any(identified(kintas, series, 0.3), plant_constants(ANY))
    assert found.frictions == pytest.approx(other.frictions, abs=1e-9)
    assert found.constants(constants).CLE == 0.0, "the response is the one identified"
    assert (
        pytest.approx(constants.FSS + papers * (constants.FSS1 - constants.FSS))
        == found.constants(constants).FSS
    )


def test_a_number_is_no_range():
    found = identified(0.5, 0.2, 0.3)
    constants = plant_constants(with_exponent(1.0))
    assert over_exponents(found, constants, (1.0, 1.0), with_exponent=1.0) is found


def test_the_verdict_covers_both_ends():
    constants = plant_constants(ANY)
    verdict, _ = judge(over_any(identified(0.8, 0.3, 0.3), constants), Levels())
    assert verdict is Verdict.FAULT, "the filter's clogging alone decides"
    verdict, reasons = judge(over_any(identified(0.1, 0.3, 0.3), constants), Levels())
    assert verdict is Verdict.DEGRADED
    assert not any("clogging_exponent" in reason for reason in reasons)


@pytest.mark.parametrize(
    ("kintas", "friction", "expected"),
    [
        (0.6, 0.3, Verdict.DEGRADED),  # a fault with exponents up to 0.7
        (0.6, 0.1, Verdict.DEGRADED),  # with none
        (0.7, 0.2, Verdict.NOT_TESTED),  # up to 0.5, and below the advisory level with 2
        (0.5, 0.6, Verdict.NOT_TESTED),  # up to 1.6
        (0.5, 0.8, Verdict.FAULT),
    ],
)
def test_a_fault_with_some_exponents_alone_is_none(kintas, friction, expected):
    found = over_any(identified(kintas, friction, 0.3), plant_constants(ANY))
    verdict, reasons = judge(found, Levels())
    assert verdict is expected
    fault = [value >= Levels().limit for value in found.frictions]
    named = any("servovalve.clogging_exponent" in reason for reason in reasons)
    assert named is (any(fault) and not all(fault))


@given(kintas=st.floats(0.0, 0.9), friction=st.floats(0.0, 1.0), std=st.floats(1e-3, 0.1))
def test_the_interval_is_that_of_both_ends(kintas, friction, std):
    """The one with the largest exponent, and that with the least, friction up to 1."""
    constants = plant_constants(ANY)
    one = identified(kintas, friction, 0.3)
    given = tuple(
        replace(item, std=std, interval95=interval95(item.value, std)) for item in one.estimates
    )
    low, high = over_any(replace(one, estimates=given), constants).named("FSS").interval95
    assert low == pytest.approx(interval95(friction, std)[0], abs=1e-9)
    new = constants.FSS / (constants.FSS1 - constants.FSS)
    ratio = (1.0 - 0.8 * kintas) ** -2.0
    least = (friction + new) * ratio - new
    assert high == pytest.approx(interval95(min(least, 1.0), std * ratio)[1], abs=1e-9)


def test_discrepancy_grows_with_wear_and_with_what_is_left():
    prior = unit_prior(msgspec.structs.replace(ANY, discrepancy=type(ANY.discrepancy)()))
    size = [
        np.sqrt(np.diag(prior.discrepancy_covariance(FAULTS, dict.fromkeys(NAMES, w), excess)))
        for w, excess in ((0.0, 1.0), (0.4, 1.0), (0.8, 1.0), (0.8, 2.0))
    ]
    assert not size[0].any()
    assert size[2] == pytest.approx(2.0 * size[1])
    assert size[3] == pytest.approx(2.0 * size[2])
    assert not any(unit_prior(default_actuator()).discrepancy.values()), "the reference's laws hold"
    stiff = prior.discrepancy_covariance(FAULTS, {"Kintas": 0.0, "FSS": 0.8, "FDJ": 0.0}, 1.0)
    assert np.sqrt(np.diag(stiff)) == pytest.approx([0.008, 0.024, 0.0])


@pytest.mark.slow
def test_a_series_filter_on_the_bundled_file_as_its_page_says():
    """`ehadiag init actuator`, an exponent, the simulator: `FSS` was 0.5848 ± 0.0002 for 0.6."""
    put_in = {"Kintas": 0.3, "FSS": 0.6, "FDJ": 0.3}
    unit = msgspec.structs.replace(with_exponent(2.0), second_stage=SecondStage(kind="orifice"))
    found = ehadiag.diagnose(simulate("open", actuator=unit, **put_in), actuator=unit)
    for name, value in put_in.items():
        assert found.faults[name].estimate == pytest.approx(value, abs=5e-4), name


def test_an_error_of_the_flow_gain_reaches_the_friction_where_the_filter_takes_pressure():
    """It passes for clogging, and clogging for less pressure at the spool."""
    tolerance = type(default_actuator().tolerance)(GQF=0.1)
    shifts = {}
    for exponent in (0.0, 2.0):
        unit = msgspec.structs.replace(with_exponent(exponent), tolerance=tolerance)
        values = {"Kintas": 0.5, "FSS": 0.4, "FDJ": 0.3}
        spread = unit_prior(unit).spread(FAULTS, values, plant_constants(unit))
        shifts[exponent] = np.sqrt(np.diag(spread))
    assert (
        shifts[2.0][0] == pytest.approx(shifts[0.0][0]) == pytest.approx(0.6 / 0.8 * 0.1 / 3**0.5)
    )
    assert shifts[0.0][1] == 0.0
    relative = shifts[2.0][1] / (0.4 + 2.0 / 58.0)
    assert relative == pytest.approx(2.0 * 0.1 / 3**0.5, rel=1e-6)


def test_judging_needs_no_effects():
    assert judge(SimpleNamespace(estimates=(), frictions=()), Levels())[0] is Verdict.HEALTHY


def test_doubt_about_a_law_widens_the_interval_and_hides_nothing():
    recording = read_recording(LOGS / "paper-open-2.blf")
    found = {
        doubt: diagnose(
            [recording],
            msgspec.structs.replace(
                default_actuator(), discrepancy=Discrepancy(Kintas=0.0, FSS=doubt, FDJ=0.0)
            ),
            bundled_tests().values(),
        )
        for doubt in (0.0, 0.2)
    }
    sure, doubtful = (found[doubt].identification.named("FSS") for doubt in (0.0, 0.2))
    assert doubtful.value == sure.value == pytest.approx(0.6, abs=1e-3)
    assert doubtful.std == pytest.approx(0.2 * 0.6, rel=0.4), "and by what the residuals add"
    assert doubtful.shown
    assert found[0.2].verdict is found[0.0].verdict is Verdict.DEGRADED


def test_evidence_counts_each_signal_by_its_own_samples() -> None:
    rng = np.random.default_rng(0)
    residuals = rng.standard_normal((2, 4000))
    worse = residuals * np.array([[1.0], [1.2]])
    whole = likelihood_ratio_cost(worse, residuals)
    residuals[1, 2000:] = worse[1, 2000:] = 0.0
    half = likelihood_ratio_cost(worse, residuals)
    assert half == pytest.approx(0.5 * whole, rel=0.2, abs=1.0)


@pytest.mark.parametrize("seed", [17, 18])
def test_an_exponent_of_0_is_tested_without_calibration(seed: int) -> None:
    """`FSS` was 0.80 ± 0.06 and a FAULT where the valve has m = 1 and the file says nothing."""
    recording = simulate(
        "closed", actuator=with_exponent(1.0), Kintas=0.3, FSS=0.6, FDJ=0.2, seed=seed
    )
    silent = msgspec.structs.replace(default_actuator(), discrepancy=Discrepancy())
    found = ehadiag.diagnose(recording, actuator=silent)
    assert found.verdict is not Verdict.FAULT
    low, high = found.faults["FSS"].interval95
    assert low < 0.6 < high
    assert any("does not bear out servovalve.clogging_exponent" in note for note in found.notes)
    own = simulate("closed", actuator=silent, Kintas=0.3, FSS=0.6, FDJ=0.2, seed=seed)
    assert ehadiag.diagnose(own, actuator=silent).faults["FSS"].estimate == pytest.approx(
        0.6, abs=1e-3
    )


@pytest.mark.slow
def test_an_exponent_of_0_that_hides_a_series_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit that is explained to the noise: `FSS` was 0.274 ± 0.014 for 0.046 once."""
    monkeypatch.setattr(verdicts, "statements_of", lambda _unit: {"wrongly 0": 0.0})
    (wrongly,) = verdicts.perform_valve(verdicts.ValveCase(19, 52002, "closed"))["tested"]
    assert wrongly["verdict"] == Verdict.DEGRADED.name
    for truth, (low, high) in zip(wrongly["faults"], wrongly["interval95"], strict=True):
        assert low < truth < high
