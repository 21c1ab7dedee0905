"""A closed-loop test that begins from a hold: friction keeps spool and pressure off their rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

import ehadiag
from ehadiag.compile.jit import Array
from ehadiag.identify.experiment import (
    Experiment,
    build_experiment,
    lay_out_spans,
    share_offsets,
    unknowns_of,
)
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS
from ehadiag.model.residual_models import SimdModel
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.simulation import Plant, SimulatedRun, bus_command, simulate
from ehadiag_tools.accuracy.cases import UnitCase, draw_unit, perform_unit
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, record
from firmware_iface.recording import CommandMode, Environment, Recording

CLOSED = next(test for test in ehadiag.bundled_tests().values() if test.closed_loop)
ENVIRONMENT = Environment(supply_pressure=20.7e6, return_pressure=0.7e6, oil_temperature=40.0)


def from_hold(seed: int, worn: Callable[[np.ndarray], None] = lambda _: None):
    """True severities, jack friction 0.75 and more, and the recording after a motion and a hold."""
    rng = np.random.default_rng(seed)
    faults = Faults(*rng.uniform(0.0, 0.6, 2), rng.uniform(0.75, 1.0))
    plant = Plant(ehadiag.default_actuator(), faults, Effects(), Sensors(), seed)
    size, ticks = rng.uniform(-5e-3, 5e-3), round(rng.uniform(500.0, 1500.0))
    for tick in range(ticks):
        plant.tick(size * np.sin(2.0 * np.pi * tick / 700.0), CommandMode.POSITION)
    for _ in range(1000):
        plant.tick(0.0, CommandMode.POSITION)
    command = bus_command(CLOSED, plant.scales)
    truth, codes = np.empty((4, CLOSED.ticks)), np.empty((4, CLOSED.ticks), dtype=np.int64)
    for tick, value in enumerate(command.tolist()):
        codes[:, tick] = plant.tick(value, CommandMode.POSITION)
        truth[:, tick] = plant.truth
    worn(codes)
    run = SimulatedRun(
        CLOSED, Effects(), command, *truth, codes, ENVIRONMENT, plant.scales.channels
    )
    return faults, run.recording(f"hold {seed}")


def severities_of(recording: Recording) -> list[float]:
    result = ehadiag.diagnose(recording)
    assert result.verdict is ehadiag.Verdict.FAULT, result.reasons
    return [item.value for item in result.severities.values()]


SEEDS = (2003, 2006, 2011)
"""Pressure of -1.7 and -0.25 MPa at the start; a spool that slips just then."""


@pytest.mark.parametrize("seed", SEEDS)
def test_it_is_diagnosed(seed: int) -> None:
    faults, recording = from_hold(seed)
    expected = (faults.Kintas, faults.FSS, faults.FDJ)
    np.testing.assert_allclose(severities_of(recording), expected, atol=0.005)


def frozen(codes: np.ndarray) -> None:
    codes[2] = codes[2, 0]


def frozen_half(codes: np.ndarray) -> None:
    codes[2, :2750] = codes[2, 0]


def shifted(codes: np.ndarray) -> None:
    codes[2, 1500:] += 40


@pytest.mark.parametrize(
    "worn",
    [frozen, *(pytest.param(item, marks=pytest.mark.slow) for item in (frozen_half, shifted))],
)
def test_a_pressure_sensor_that_lies_is_still_refused(worn: Callable[[np.ndarray], None]) -> None:
    result = ehadiag.diagnose(from_hold(SEEDS[0], worn)[1])
    assert result.verdict is ehadiag.Verdict.NOT_TESTED


def test_a_sensor_that_reads_beside_zero_is_no_hold() -> None:
    """A pressure 0.2 MPa off at rest is the sensor's, as the motion shows; so is 3 µm of spool."""
    done = simulate(
        ehadiag.default_actuator(),
        CLOSED,
        Faults(0.3, 0.3, 0.3),
        sensors=Sensors(offsets_lsb=(0.0, 12.0, 16.0, 0.0)),
        step=1e-6,
    )
    begun = build_experiment(done.samples, ENVIRONMENT, CLOSED, ehadiag.default_actuator())
    assert begun.origin == 0.0
    assert np.isfinite(begun.pressure).all()


@pytest.fixture(scope="module")
def biased() -> tuple[Unit, list[float], Recording]:
    """A null bias moves the spool from the first tick on; its sensor reads beside zero."""
    unit, faults = draw_unit(UnitCase("closed", 228, seed=8200))
    return unit, faults, record(unit, CLOSED, Faults(*faults), seed=5, step=COARSE_STEP)


def test_an_origin_that_the_sensor_read_has_its_offset(
    biased: tuple[Unit, list[float], Recording],
) -> None:
    unit, _, recording = biased
    samples = recording.samples
    assert samples is not None
    begun = build_experiment(samples, ENVIRONMENT, CLOSED, ehadiag.default_actuator())
    offset = unit.sensors.offsets_lsb[1] * begun.channels.spool.lsb
    assert begun.origin_read
    assert begun.origin == pytest.approx(offset, abs=1e-6)
    mended = begun.with_origin(offset)
    assert mended.origin == pytest.approx(0.0, abs=1e-6)
    assert mended.with_origin(offset) is mended
    resting = replace(begun, rested=True, spool_offset=offset, pressure_offset=0.0)
    assert share_offsets([resting, begun])[1].origin == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
def test_friction_and_hysteresis_do_not_trade_by_a_wrong_origin(
    biased: tuple[Unit, list[float], Recording],
) -> None:
    """The spool's friction was 11 % off once, and sure."""
    _, faults, recording = biased
    result = ehadiag.diagnose(recording)
    assert result.verdict is not ehadiag.Verdict.NOT_TESTED, result.reasons
    found = result.severities["FSS"]
    assert found.std is not None
    assert abs(found.value - faults[1]) < 4.0 * found.std < 0.03


@pytest.fixture(scope="module")
def sliding() -> UnitCase:
    """A null bias holds the spool open, and the jack slides from the first tick on."""
    return UnitCase("open", 17, seed=151)


def test_a_jack_that_slides_at_rest_shows_no_offset(sliding: UnitCase) -> None:
    test = ehadiag.bundled_tests()["open"]
    unit, faults = draw_unit(sliding)
    samples = record(unit, test, Faults(*faults), seed=5, step=COARSE_STEP).samples
    assert samples is not None
    begun = build_experiment(samples, ENVIRONMENT, test, ehadiag.default_actuator())
    assert begun.origin_read
    assert not begun.rested
    assert begun.spool_offset == begun.pressure_offset == 0.0
    offset = unit.sensors.offsets_lsb[1] * begun.channels.spool.lsb
    assert begun.with_origin(offset).origin == pytest.approx(-6.9e-6, abs=2e-7)
    assert not np.isfinite(begun.pressure[:200]).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "unit",
    [
        UnitCase("open", 17, seed=151),  # its jack slides at rest: 6 deviations off once
        UnitCase("closed", 30, seed=88101),  # a first offset 4.6 µm off: 18 deviations
        UnitCase("closed", 32, seed=99001),  # beside a break-away at another tick: 5 deviations
        UnitCase("closed", 201, seed=99004),  # stuck elsewhere since before the motion: NOT TESTED
        UnitCase("closed", 613, seed=99004),  # from the origin less its offset not explained
        UnitCase("closed", 846, seed=99004),  # null bias 24 µA beside: the spool alone explained
        UnitCase("closed", 411, seed=99011),  # the same, passed for explained: FSS 8 % off
    ],
    ids=lambda unit: f"{unit.test}-{unit.case}",
)
def test_no_estimate_is_sure_and_wrong(unit: UnitCase) -> None:
    found = perform_unit(unit)
    assert found["verdict"] == "answered"
    for truth, (low, high) in zip(found["faults"], found["interval95"], strict=True):
        assert low < truth < high


def test_an_end_with_a_break_away_at_a_wrong_tick_is_not_the_last() -> None:
    """`FSS` was 4 % off, 28 deviations: little more than noise was left."""
    effects = Effects(hysteresis=0.0269907325, null_bias=-3.76348823e-05, gain_change=0.0246187024)
    done = simulate(
        ehadiag.default_actuator(), CLOSED, Faults(0.208, 0.145, 0.082), effects, seed=13, step=5e-7
    )
    friction = ehadiag.diagnose(done.recording("simulated")).severities["FSS"]
    assert abs(friction.value - 0.145) < 2.5 * friction.std


@pytest.mark.slow
def test_a_spool_with_hardly_any_friction_is_refused_or_right() -> None:
    """Its own severities leave 3 % of outliers; `FDJ` was 5 deviations off once, and sure."""
    found = perform_unit(UnitCase("closed", 151, seed=99002))
    pairs = zip(found["faults"], found["interval95"], strict=True)
    assert found["verdict"] == "NOT_TESTED" or all(low < x < high for x, (low, high) in pairs)


def test_what_creeps_before_the_motion_is_left_out(
    biased: tuple[Unit, list[float], Recording],
) -> None:
    samples = biased[2].samples
    assert samples is not None
    begun = build_experiment(samples, ENVIRONMENT, CLOSED, ehadiag.default_actuator())
    left = begun.without_creep()
    batch, whole = lay_out_spans([left]), lay_out_spans([begun])
    assert batch.weight[1].nonzero()[0][0] == 301  # the command moves from tick 201 on
    assert np.array_equal(batch.weight[:, 301:], whole.weight[:, 301:])
    held = np.isnan(begun.pressure)
    assert held[:301].any()
    assert np.array_equal(batch.weight[0, held], whole.weight[0, held])
    opened = replace(begun, test=ehadiag.bundled_tests()["open"])
    assert opened.without_creep() is opened


def test_before_the_motion_the_model_follows_the_sensor_of_the_spool(
    biased: tuple[Unit, list[float], Recording],
) -> None:
    samples = biased[2].samples
    assert samples is not None
    begun = build_experiment(samples, ENVIRONMENT, CLOSED, ehadiag.default_actuator())
    away = replace(begun, origin=begun.origin + 2e-5)
    truth = np.array([[*biased[1], *np.zeros(len(SENSOR_OFFSETS))]])

    def spools(item: Experiment) -> Array:
        free = unknowns_of([item], (*FAULTS, *SENSOR_OFFSETS))
        return SimdModel(lay_out_spans([item]), free).residuals(truth)[0][0, 0]

    follows = spools(away.without_creep(followed=True)) - spools(begun.without_creep(followed=True))
    free_run = spools(away) - spools(begun)
    assert np.abs(follows[301:400]).max() < 0.2 * np.abs(free_run[301:400]).max()


@pytest.mark.slow
@pytest.mark.parametrize("case", [153, 165])
def test_friction_is_not_decided_by_a_break_away_in_the_noise(case: int) -> None:
    """A spool crept up to its break-away before the command moved: 0.006 and 0.11 off, and sure."""
    done = perform_unit(UnitCase("closed", case, 9300, "all"))
    assert done["verdict"] == "answered"
    low, high = done["interval95"][1]
    assert abs(done["value"][1] - done["faults"][1]) < 0.9 * (high - low)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        (28001, 51),  # 0.0105 off without the time before the motion, which explains 0.002
        (29001, 124),  # 0.0069 off, 8 deviations
        (28001, 4),  # the noise breaks it away before the motion, nine blocks of ticks are wrong
    ],
)
def test_what_creeps_before_the_motion_is_taken_back(case: tuple[int, int]) -> None:
    seed, unit = case
    done = perform_unit(UnitCase("closed", unit, seed))
    assert done["verdict"] == "answered"
    np.testing.assert_allclose(done["value"], done["faults"], atol=0.004)
    for truth, (low, high) in zip(done["faults"], done["interval95"], strict=True):
        assert low - 1e-3 < truth < high + 1e-3
