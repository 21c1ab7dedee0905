"""The verdict on board against the rule of `ehadiag diagnose` at its default levels.

Recordings that carry no verdict: what the host refuses, on board too.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from exported import host_library
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace
from places import LOGS

from ehadiag import Verdict, bundled_tests, default_actuator
from ehadiag import simulate as simulate_test
from ehadiag.assess import verdict
from ehadiag.assess.diagnosis import diagnose
from ehadiag.core.actuator import Discrepancy
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.core.criteria import ESTIMATION, FIT
from ehadiag.export.library import exported_unit, library_plan
from ehadiag.identify.estimates import FIRST_STAGE_STD, friction_range
from ehadiag.identify.identification_session import NuisanceMode
from ehadiag.identify.prior import DAILY_PRIORS
from ehadiag.model.plant import plant_constants, relative_viscosity
from ehadiag.model.registry import unit_constants
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.monitor.monitor_memory import MONITOR, MONITOR_PLAN_SIZE, MONITOR_SIZE
from ehadiag.monitor.plan import design_cusum
from ehadiag.onboard import onboard_optimum
from ehadiag.onboard.onboard_identification import begin_identification, continue_identification
from ehadiag.onboard.onboard_memory import (
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_PARAMETERS,
    ONBOARD_VERDICT,
    PHASES,
    PLAN_DIRECTIONS,
    PROGRESS,
    REASONS,
    UNIT_SUPPLY,
    UNIT_VISCOSITY,
    OnboardOutcome,
    VerdictRules,
    set_environment,
)
from ehadiag_tools.onboard.replay import surrounded, ticks_of
from firmware_iface.recording import CHANNELS
from firmware_iface.signals.recordings import read_recording

LEVELS = verdict.Levels()
TESTS = bundled_tests().values()
ACTUATOR = default_actuator()


def plan_of(actuator):
    """Plan of an exported library."""
    return library_plan(actuator, design_cusum(FALSE_ALARM_INTERVAL_H, 1e-3))


PLAN = plan_of(ACTUATOR)
EDGE = 1e-5
"""Of a chance: the normal distribution on board is one to 1e-7."""
NOT_TESTED = 30.0
NAMES = ("Kintas", "FSS", "FDJ")


def on_board(values, stds, outliers=0.0, rms=1.0, plan=PLAN):
    """Outcome of an identification that has come to these estimates."""
    memory = np.zeros(ONBOARD.end)
    known = OnboardOutcome(*values, *stds, *(0.0,) * 11)._replace(
        samples=1000.0, outliers=outliers, spool_rms=rms, pressure_rms=1.0
    )
    memory[: len(known)] = known
    assert onboard_optimum.write_verdict(memory.ctypes.data, plan) == 0
    return OnboardOutcome(*memory[: len(known)].tolist())


def judged(values, stds, frictions=()):
    """The same by the rule of the package."""
    estimates = [
        SimpleNamespace(
            name=name, value=value, std=std, interval95=(value - 1.96 * std, value + 1.96 * std)
        )
        for name, value, std in zip(NAMES, values, stds, strict=True)
    ]
    return verdict.judge(
        SimpleNamespace(
            estimates=estimates,
            nuisances={},
            frictions=frictions,
            exponent_doubted=False,
            named=lambda name: estimates[NAMES.index(name)],
        ),
        LEVELS,
    )[0], estimates


def test_the_deviations_are_those_of_the_package():
    """Normal matrix, covariance of the gradient, shift and fit in; deviations out."""
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((ONBOARD_PARAMETERS, 400)) * 1e3
    normal, meat, shift = (
        rows @ rows.T,
        3.0 * rows @ rows.T,
        rng.standard_normal(ONBOARD_PARAMETERS),
    )
    considered, believed = np.array([1e-4, 2e-4, 0.0]), np.array([0.0, 0.0, 1e-4])
    memory = np.zeros(ONBOARD.end)
    for place, numbers in (
        (ONBOARD.normal, normal), (ONBOARD.normal + normal.size, shift), (ONBOARD.meat, meat),
        (ONBOARD.considered, considered), (ONBOARD.believed, believed),
    ):  # fmt: skip
        memory[place : place + numbers.size] = numbers.ravel()
    assert onboard_optimum.write_deviations(memory.ctypes.data, PLAN, ONBOARD_PARAMETERS, 1.3) == 0
    inverse = np.linalg.inv(normal + np.diag([12.0] * ONBOARD_GENES + [0.0] * 2))
    sandwich = inverse @ meat @ inverse
    curved = inverse * 1.3 / ESTIMATION.capped_variance
    variance = np.maximum(np.diag(curved), np.diag(sandwich))[:ONBOARD_GENES]
    moved = (inverse @ shift)[:ONBOARD_GENES]
    variance = np.maximum(variance, believed) + moved**2 + considered
    expected = np.sqrt(variance + ESTIMATION.discrepancy_std**2)
    assert memory[ONBOARD_GENES : 2 * ONBOARD_GENES] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("ticks", "doubtful"), [(2, False), (5, True)])
def test_a_break_away_that_a_calibration_moves_makes_friction_doubtful(ticks, doubtful):
    """Two samples, four deviations off, are no break-away at another tick; five are one."""
    memory = np.zeros(ONBOARD.end)
    memory[ONBOARD.noise : ONBOARD.noise + 2] = 1.0
    memory[ONBOARD.along : ONBOARD.along + ONBOARD_GENES] = 1.0
    moved_model = ONBOARD.monitors + (1 + ONBOARD_GENES) * MONITOR_SIZE + MONITOR.residual
    memory[moved_model] = 4.0
    for _ in range(ticks):
        onboard_optimum.add_directions(memory.ctypes.data)
    onboard_optimum.end_directions(memory.ctypes.data)
    normal = ONBOARD.normal + np.arange(ONBOARD_PARAMETERS) * (ONBOARD_PARAMETERS + 1)
    memory[normal] = 1e8
    assert onboard_optimum.write_deviations(memory.ctypes.data, PLAN, ONBOARD_PARAMETERS, 1.0) == 0
    std = memory[ONBOARD_GENES : 2 * ONBOARD_GENES]
    extra = FAULT_LAWS["FSS"].ambiguous_std if doubtful else 0.0
    assert std[0] == std[2]
    assert std[1] == pytest.approx(math.hypot(std[0], extra))


@given(
    st.tuples(*(st.floats(0.0, 1.0),) * 3),
    st.tuples(*(st.floats(-4.0, -1.0).map(lambda power: 10.0**power),) * 3),
)
def test_the_verdict_is_that_of_the_package(values, stds):
    expected, estimates = judged(values, stds)
    above = [verdict.chance_above(item, LEVELS.advisory) for item in estimates]
    limits = [verdict.chance_above(item, LEVELS.limit) for item in estimates]
    assume(max(stds) < FIT.max_shown_std)
    assume(abs(sum(above) - verdict.VERDICT.max_chance_false_healthy) > EDGE)
    assume(all(abs(chance - verdict.VERDICT.min_chance_fault) > EDGE for chance in limits))
    found = on_board(values, stds)
    assert found.verdict == float(expected)


def of_exponent(exponent, **others):
    """The reference unit with an exponent of clogging."""
    valve = replace(ACTUATOR.servovalve, clogging_exponent=exponent)
    return replace(ACTUATOR, servovalve=valve, **others)


RANGE = library_plan(of_exponent((0.0, 2.0)), design_cusum(100.0, 1e-3))


@given(
    st.tuples(*(st.floats(0.0, 1.0),) * 3),
    st.tuples(*(st.floats(-4.0, -1.5).map(lambda power: 10.0**power),) * 3),
)
def test_a_range_of_exponents_does_what_it_does_in_the_package(values, stds):
    friction = friction_range(
        dict(zip(NAMES, values, strict=True)), stds[1], plant_constants(ACTUATOR), (0.0, 2.0),
        with_exponent=2.0,
    )  # fmt: skip
    wider = math.hypot(stds[0], FIRST_STAGE_STD * friction.frictions[-1])
    expected, estimates = judged(
        (values[0], friction.value, values[2]), (wider, friction.std, stds[2]), friction.frictions
    )
    above = [verdict.chance_above(item, LEVELS.advisory) for item in estimates]
    limits = [verdict.chance_above(item, LEVELS.limit) for item in estimates]
    assume(abs(sum(above) - verdict.VERDICT.max_chance_false_healthy) > EDGE)
    assume(all(abs(chance - verdict.VERDICT.min_chance_fault) > EDGE for chance in limits))
    assume(np.abs(np.array(friction.frictions) - LEVELS.limit).min() > EDGE)
    found = on_board(values, stds, plan=RANGE)
    assert found.verdict == float(expected)
    if found.verdict != NOT_TESTED:
        assert found[:6] == pytest.approx(
            [item.value for item in estimates] + [item.std for item in estimates], rel=1e-9
        )


@pytest.mark.parametrize(
    "wrong",
    [{"outliers": verdict.FIT.max_outlier_share + 1e-3}, {"outliers": math.nan},
     {"rms": verdict.FIT.max_rms + 1e-3}, {"rms": math.nan}],
    ids=str,
)  # fmt: skip
def test_what_the_model_does_not_explain_is_not_tested(wrong):
    assert on_board((0.1, 0.1, 0.1), (0.01,) * 3).verdict == 0.0
    found = on_board((0.1, 0.1, 0.1), (0.01,) * 3, **wrong)
    assert (found.verdict, found.reasons) == (NOT_TESTED, REASONS.unexplained)
    assert all(math.isnan(value) for value in found[:8])


def test_a_severity_that_the_test_does_not_show_is_not_tested():
    found = on_board((0.1, 0.1, 0.5), (0.01, 0.01, 0.11))
    assert (found.verdict, found.reasons) == (NOT_TESTED, REASONS.hidden)
    assert math.isnan(found.FDJ)


FILES = {
    of_plant: [of_exponent(exponent, discrepancy=Discrepancy()) for exponent in stated]
    for of_plant, stated in ((0.0, [(0.0, 2.0)]), (2.0, [2.0, (0.0, 2.0)]))
}
"""Files that are right of a plant by its exponent: what a file states that states nothing."""


APART = [(11, FILES[2.0][0]), *((19, actuator) for actuator in FILES[2.0])]
"""Recordings of which a search ends beside the optimum: the package's, half a deviation and more
from the library's, which holds the truth; with a range of the last one the library's, which then
answers NOT TESTED."""


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 21))
def test_doubt_about_the_faults_laws_is_that_of_the_package(seed):
    """Intervals and verdict of the library, whatever exponent the plant has."""
    severities = dict(zip(NAMES, np.random.default_rng(seed).uniform(0.0, 0.6, 3), strict=True))
    exponent, test = 2.0 * (seed % 2), ("open", "closed")[seed // 2 % 2]
    recording = simulate_test(test, actuator=of_exponent(exponent), seed=seed, **severities)
    for actuator in FILES[exponent]:
        if (seed, actuator) in APART:
            continue
        host = diagnose([recording], actuator, TESTS, nuisances=NuisanceMode.NONE)
        code, memory = run(surrounded(recording), ticks_of(recording), 1e9, actuator)
        assert code == 0
        found = OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())
        assert found.verdict == float(host.verdict)
        if found.verdict == NOT_TESTED:
            continue
        for k, item in enumerate(host.identification.estimates):
            value, std = found[k], found[ONBOARD_GENES + k]
            near = max(0.2 * item.std, 2e-3)
            assert [value, std] == pytest.approx([item.value, item.std], abs=near)
            assert abs(value - severities[item.name]) < 3.0 * std


@pytest.mark.parametrize("oil", [-60.0, -20.0, 0.0, 40.0, 85.3, 100.0, 200.0])
def test_the_surroundings_give_the_viscosity_of_the_package(oil):
    unit = np.zeros(8)
    assert set_environment(unit.ctypes.data, (oil, 20.7e6, 0.7e6)) == 0
    assert unit[5] == pytest.approx(relative_viscosity(oil), rel=1e-12)
    assert unit[6] == 20e6


@pytest.mark.parametrize(
    "around",
    [(-61.0, 2e7, 0.0), (201.0, 2e7, 0.0), (40.0, 1e6, 1e6), (float("nan"), 2e7, 0.0),
     (40.0, float("nan"), 0.0), (40.0, float("inf"), 0.0)],
)  # fmt: skip
def test_surroundings_that_cannot_be_are_refused(around):
    unit = np.full(8, 3.0)
    assert set_environment(unit.ctypes.data, around) == 1
    assert (unit == 3.0).all()


def test_a_spool_that_friction_holds_beside_its_middle_is_no_offset():
    """In closed loop, with the position's sensor off: the spool rests 60 LSB from its offset."""
    severities = {"Kintas": 0.4377, "FSS": 0.6481, "FDJ": 0.5719}
    offsets = (-20.15, -1.76, 19.86, -19.45)
    recording = simulate_test("closed", offsets_lsb=offsets, seed=1, **severities)
    code, memory = run(surrounded(recording), ticks_of(recording), 1e9)
    assert code == 0
    found = OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())
    assert found.verdict == 10.0
    for value, std, true in zip(found[:3], found[3:6], severities.values(), strict=True):
        assert abs(value - true) < 4.0 * std
    assert found.runs < 400.0


def test_an_effect_that_the_library_does_not_know_is_refused():
    """Friction would stand in for hysteresis, 210 of its deviations off."""
    recording = simulate_test(
        "open", Kintas=0.9378, FSS=0.0244, FDJ=0.9364, hysteresis=0.002, seed=4
    )
    code, memory = run(surrounded(recording), ticks_of(recording), 1e9)
    assert code == 0
    found = OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())
    assert (found.verdict, found.reasons) == (NOT_TESTED, REASONS.unexplained)


@pytest.mark.parametrize("off", [-0.5, 0.5])
def test_a_step_of_the_bus_in_cold_oil_moves_no_severity(off):
    """Without a calibration, by half a step of 0.1 K: jack friction would be 8 deviations off."""
    severities = {"Kintas": 0.3, "FSS": 0.4, "FDJ": 0.5}
    recording = simulate_test("open", oil_temperature=-15.0, seed=2, **severities)
    unit = np.array(surrounded(recording))
    unit[UNIT_VISCOSITY] = relative_viscosity(-15.0 + 0.1 * off)
    code, memory = run(unit, ticks_of(recording), 1e9)
    assert code == 0
    found = OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())
    assert found.verdict == 10.0
    for value, std, true in zip(found[:3], found[3:6], severities.values(), strict=True):
        assert abs(value - true) < 5.0 * std < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("off", [-3.0, -1.5, 1.5])
def test_what_viscosity_of_the_day_moves_counts_in_the_deviation(off):
    """Of a unit with a calibration; a healthy one's `FDJ` was 16 deviations off once."""
    new = np.array(unit_constants(ACTUATOR), dtype=np.float64)
    plan = np.concatenate([PLAN, *(new * (1.0 + 5e-4 * row) for row in np.eye(len(new))[:3])])
    plan[PLAN_DIRECTIONS] = 3.0
    for name, value in (
        ("most_excess", math.inf),
        ("viscosity_std", DAILY_PRIORS["oil_viscosity"].std),
        ("supply_std", DAILY_PRIORS["supply_pressure"].std),
    ):
        plan[MONITOR_PLAN_SIZE + VerdictRules._fields.index(name)] = value
    recording = read_recording(LOGS / "healthy-open.blf")
    unit, memory = np.array(surrounded(recording)), np.zeros(ONBOARD.end)
    unit[UNIT_VISCOSITY] /= 1.0 + 0.038 * off
    ticks = np.ascontiguousarray(ticks_of(recording))
    places = memory.ctypes.data, plan.ctypes.data
    assert begin_identification(*places, unit.ctypes.data) == 0
    assert continue_identification(*places, ticks.ctypes.data, (float(len(ticks)), 1e9)) == 0
    found = OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())
    assert found.verdict == 0.0
    for value, std in zip(found[:3], found[3:6], strict=True):
        assert value < 2.5 * std < 0.03


RECORDING = read_recording(LOGS / "paper-open-1.blf")


def frozen(values):
    return np.where(np.isfinite(values), values[100], np.nan)


def dead(values):
    return np.full_like(values, np.nan)


DAMAGES = {
    "spool frozen": {"spool": frozen},
    "pressure frozen": {"pressure": frozen},
    "spool dead": {"spool": dead},
    "pressure dead": {"pressure": dead},
    "spool at its converter's end": {"spool": lambda v: np.where(v > 0.2e-3, 1.0, v)},
    "pressure at its converter's end": {"pressure": lambda v: np.where(v > 1e5, 1e9, v)},
    "position at its converter's end": {"position": lambda v: np.where(v > 1e-3, 1.0, v)},
    "spool stuck half-way": {"spool": lambda v: np.where(np.arange(len(v)) < 2500, v, v[2500])},
    "pressure of the other sign": {"pressure": np.negative},
}


def damaged(damage):
    """Recording with a damaged channel, at its converter's ends where it is beyond them."""
    samples = RECORDING.samples
    changed = {name: work(getattr(samples, name)) for name, work in damage.items()}
    saturated = np.array(samples.saturated)
    for channel in (CHANNELS.spool, CHANNELS.pressure):
        if channel.name in changed:
            top = channel.full_scale - channel.lsb
            row = ("current", "spool", "pressure", "position").index(channel.name)
            saturated[row] |= np.abs(np.nan_to_num(changed[channel.name])) >= top
            changed[channel.name] = np.clip(changed[channel.name], -channel.full_scale, top)
    if "position" in changed:
        saturated[3] |= np.nan_to_num(changed["position"]) >= 1.0
    return replace(RECORDING, samples=replace(samples, saturated=saturated, **changed))


def carried(ticks, supply=2e7):
    """Whether ticks of the reference unit carry a verdict on board."""
    unit = np.array(surrounded(RECORDING))
    unit[UNIT_SUPPLY] = supply
    _, memory = run(unit, ticks, 1.5 * len(ticks))
    return bool(memory[PROGRESS.phase] == PHASES.grids)


def run(unit, ticks, work, actuator=None):
    """Code of the first slice of an identification on board, and its memory."""
    plan, library = plan_of(actuator or ACTUATOR), host_library(actuator)
    memory, start = np.zeros(ONBOARD.end), exported_unit(unit, plan)
    ticks, amounts = np.ascontiguousarray(ticks), np.array([len(ticks), work])
    begin = library.function("eha_identify_begin", 2)
    assert begin(memory.ctypes.data, start.ctypes.data) == 0
    going = library.function("eha_identify_run", 3)
    return going(memory.ctypes.data, ticks.ctypes.data, amounts.ctypes.data), memory


def test_a_sound_recording_carries_a_verdict():
    assert carried(ticks_of(RECORDING))


@pytest.mark.parametrize("name", list(DAMAGES)[:-2])
def test_a_damaged_channel_carries_none(name):
    assert not carried(ticks_of(damaged(DAMAGES[name])))


def test_a_few_samples_at_the_end_do_no_harm():
    ticks = ticks_of(RECORDING)
    ticks[:80, 2] = CHANNELS.spool.full_scale
    assert carried(ticks)
    ticks[:90, 2] = CHANNELS.spool.full_scale
    assert not carried(ticks)


@pytest.mark.parametrize(("share", "carries"), [(0.57, True), (0.56, False)])
def test_with_much_too_low_a_supply_nothing_is_judged(share, carries):
    assert carried(ticks_of(RECORDING), share * ACTUATOR.servovalve.PSR) is carries


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGES)
def test_what_the_host_does_not_test_the_board_does_not_either(name):
    recording = damaged(DAMAGES[name])
    found = diagnose([recording], ACTUATOR, TESTS, nuisances=NuisanceMode.NONE)
    assert found.verdict is Verdict.NOT_TESTED
    code, memory = run(surrounded(recording), ticks_of(recording), 1e9)
    assert code == 0
    assert memory[ONBOARD_VERDICT] == NOT_TESTED
