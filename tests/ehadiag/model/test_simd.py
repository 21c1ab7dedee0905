"""Blocks of candidates against one alone, which chooses steps of its own for the jack.

The kernels as plain Python give what the compiled ones give.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from other_actuator import with_data
from places import LOGS

from ehadiag import default_actuator
from ehadiag.compile.vector import LANES
from ehadiag.identify.experiment import build_experiment, lay_out_spans, unknowns_of
from ehadiag.model.batch import NO_ANCHOR, Anchor, Batch
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, Unknowns, parameter
from ehadiag.model.residual_models import ScalarModel, SimdModel, model_response
from ehadiag_tools.simulator.units import damaged_unit
from firmware_iface.recording import CHANNELS
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test

CORNERS = np.array(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0])).reshape(3, 8).T
NO_CAP = 1e9
ALL = (*FAULTS, *SENSOR_OFFSETS, parameter("sampling_lead"))


def space(actuator=None, free=FAULTS, tests=1):
    return Unknowns(free, (plant_constants(actuator or default_actuator()),) * tests, {})


def own_batch(
    faults, current, *, channels=(True, True), offsets=(0.0, 0.0), tick=1e-3, actuator=None
):
    """Weights in LSB, the model's own answer as the measurement."""
    truth = model_response(damaged_unit(faults, actuator), current, tick)
    n = len(current)
    return Batch(
        test=np.zeros(1, dtype=np.int64),
        tick=np.array([tick]),
        start=np.array([0, n]),
        origin=np.zeros(1),
        place=np.zeros(1),
        history=np.zeros(1, dtype=np.int64),
        since=np.zeros(1, dtype=np.int64),
        current=current,
        spool=truth.spool + offsets[0],
        pressure=truth.pressure + offsets[1],
        position=truth.position,
        weight=np.vstack(
            [
                np.full(n, channels[0] / CHANNELS.spool.lsb),
                np.full(n, channels[1] / CHANNELS.pressure.lsb),
            ]
        ),
        anchor=NO_ANCHOR.as_array()[None, :],
    )


def in_lanes(batch, points, cap=NO_CAP, unknowns=None):
    return SimdModel(batch, unknowns or space()).costs(np.asarray(points), cap)


def one_by_one(batch, points, cap=NO_CAP, unknowns=None):
    return ScalarModel(batch, unknowns or space()).costs(np.asarray(points), cap)


@pytest.fixture(scope="module", params=["open", "closed"])
def recorded_model(request):
    recording = read_recording(LOGS / f"paper-{request.param}-2.blf")
    experiment = build_experiment(
        recording.samples,
        recording.environment,
        resolve_test(request.param),
        default_actuator(),
    )
    return SimdModel(lay_out_spans([experiment]), unknowns_of([experiment], FAULTS), threads=1)


@pytest.fixture(scope="module")
def population():
    rng = np.random.default_rng(7)
    return np.vstack([CORNERS, rng.random((23, 3)), [[0.3, 0.6, 0.3]]])


def test_the_spool_is_that_of_one_alone(recorded_model, population):
    """Each candidate's own answer is the measurement: rounding is all that it may err."""
    current = recorded_model.batch.current
    for index in (0, 3, 6, 7, 12, 20, 31):
        batch = own_batch(population[index], current, channels=(True, False))
        off = np.sqrt(in_lanes(batch, population[index : index + 1])[0] / len(current))
        assert off < 1e-8


def test_the_pressure_is_that_of_one_alone_but_for_a_few_samples(recorded_model, population):
    """With each residual capped at 1 LSB the mean square is that of 0.1 LSB rms or less."""
    current = recorded_model.batch.current
    for index in (0, 3, 6, 7, 12, 20, 31):
        batch = own_batch(population[index], current, channels=(False, True))
        off = np.sqrt(in_lanes(batch, population[index : index + 1], cap=1.0)[0] / len(current))
        assert off < 0.1


def test_costs_are_those_of_one_alone(recorded_model, population):
    """A handful of samples beside an event err by LSBs: at the truth that shows most, below 1 %."""
    model = recorded_model
    np.testing.assert_allclose(
        model.costs(population, 25.0),
        one_by_one(model.batch, population, 25.0, model.unknowns),
        rtol=1e-2,
    )


def test_one_lane_gives_the_digits_of_many(recorded_model, population):
    together = recorded_model.costs(population, 25.0)
    alone = [recorded_model.costs(row[None, :], 25.0)[0] for row in population[:: LANES // 4]]
    np.testing.assert_array_equal(together[:: LANES // 4], alone)
    order = np.random.default_rng(1).permutation(len(population))
    np.testing.assert_array_equal(recorded_model.costs(population[order], 25.0), together[order])


@pytest.mark.parametrize("size", [1, 7, 8, 9, 15, 17, LANES + 3])
def test_a_population_that_fills_no_block(recorded_model, population, size):
    whole = recorded_model.costs(population, 25.0)
    np.testing.assert_array_equal(recorded_model.costs(population[:size], 25.0), whole[:size])
    residuals, anchored = recorded_model.residuals(population[:size])
    every, counts = recorded_model.residuals(population)
    np.testing.assert_array_equal(residuals, every[:size])
    np.testing.assert_array_equal(anchored, counts[:size])


def test_steps_of_the_jack_may_be_handed_on(recorded_model, population):
    """A model of the same spans gives the same digits with them as with those it finds."""
    model = recorded_model
    other = SimdModel(model.batch, model.unknowns, levels=model.levels)
    np.testing.assert_array_equal(other.costs(population, 25.0), model.costs(population, 25.0))
    assert 0 <= model.levels.min() < model.levels.max() <= 4


def test_stops_are_met():
    """Full current long enough for the flapper, the spool and the jack to strike their stops."""
    current = np.concatenate([np.full(600, 10e-3), np.full(900, -10e-3), np.zeros(100)])
    for faults in CORNERS:
        truth = model_response(damaged_unit(faults), current, 1e-3)
        assert np.abs(truth.position).max() == plant_constants(default_actuator()).XJM
        batch = own_batch(faults, current)
        off = np.sqrt(in_lanes(batch, faults[None], cap=1.0)[0] / len(current))
        assert off < 0.1


@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.3, 0.5, 0.4)])
def test_the_jack_feels_a_spool_that_meets_its_stop(faults):
    """Against sixteen times the ticks: a spool that stops makes a kink in its path."""
    stroke = default_actuator().servovalve.XSM
    actuator = with_data({"XSM": stroke / 4.0})
    current, finer = 10e-3 * np.sin(2.0 * np.pi * 20e-3 * np.arange(120)), 16
    fine = model_response(damaged_unit(faults, actuator), np.repeat(current, finer), 1e-3 / finer)
    assert np.mean(np.abs(fine.spool) == stroke / 4.0) > 0.3
    batch = own_batch(faults, current, actuator=actuator)
    batch = batch._replace(pressure=fine.pressure[finer - 1 :: finer])
    residuals, _ = SimdModel(batch, space(actuator)).residuals(np.array([faults]))
    assert np.abs(residuals[0, 1]).max() < 0.5


def test_offsets_and_missing_samples_count_as_for_one_alone():
    current = 4e-3 * np.sin(np.arange(400) * 0.05)
    batch = own_batch((0.4, 0.2, 0.5), current, offsets=(3e-7, 2e4))
    batch.spool[50:60] = np.nan
    batch.pressure[100:140] = np.nan
    batch.weight[0, 200:220] = 0.0
    unknowns = space(free=(*FAULTS, *SENSOR_OFFSETS))
    rows = np.array([(0.4, 0.2, 0.5, 3e-7, 2e4), (0.5, 0.3, 0.4, 3e-7, 2e4)])
    here, there = (run(batch, rows, 25.0, unknowns) for run in (in_lanes, one_by_one))
    assert here[0] < 10.0  # an offset or dropout taken wrongly makes hundreds
    np.testing.assert_allclose(here[1], there[1], rtol=1e-3)
    rows[:, 3] = 0.0
    # The jack alone is up to 0.1 LSB off: 1 in 600 of 2 x 400 squares.
    np.testing.assert_allclose(
        in_lanes(batch, rows, 25.0, unknowns), one_by_one(batch, rows, 25.0, unknowns), rtol=2e-2
    )


@pytest.mark.parametrize("lead", [0.0, 5e-5, 1e-4, 1.5e-4, 2e-4])
def test_the_sampling_instant_is_that_of_finer_ticks(lead):
    """A spool read before the end of the tick: all look back along their own path."""
    current, finer = 3e-3 * np.sin(np.arange(400) * 0.05), 20
    faults = (0.3, 0.6, 0.3)
    fine = model_response(damaged_unit(faults), np.repeat(current, finer), 1e-3 / finer).spool
    expected = fine[finer - 1 - round(lead * finer / 1e-3) :: finer]
    batch = own_batch(faults, current, channels=(True, False))
    unknowns = space(free=(*FAULTS, parameter("sampling_lead")))
    for kind in (SimdModel, ScalarModel):
        residuals, _ = kind(batch, unknowns).residuals(np.array([(*faults, lead)]))
        seen = batch.spool - residuals[0, 0] * CHANNELS.spool.lsb
        assert np.sqrt(np.mean((seen - expected) ** 2)) < 0.02 * CHANNELS.spool.lsb
        assert np.abs(seen - expected).max() < 0.3 * CHANNELS.spool.lsb


def test_spans_start_from_their_own_origin():
    current = 3e-3 * np.sin(np.arange(300) * 0.05)
    one = own_batch((0.3, 0.3, 0.3), current)
    two = one._replace(
        test=np.array([0, 1]),
        tick=np.repeat(one.tick, 2),
        start=np.array([0, 120, 300]),
        origin=np.array([0.0, 4e-5]),
        place=np.zeros(2),
        history=np.array([0, 120]),
        since=np.array([0, 120]),
        anchor=np.vstack([one.anchor] * 2),
    )
    hot = plant_constants(default_actuator())._replace(CS=1.0, PSR=18e6)
    unknowns = Unknowns(FAULTS, (plant_constants(default_actuator()), hot), {})
    rows = np.array([(0.3, 0.3, 0.3), (0.1, 0.8, 0.6)])
    np.testing.assert_allclose(
        in_lanes(two, rows, 25.0, unknowns), one_by_one(two, rows, 25.0, unknowns), rtol=1e-2
    )


def test_a_flapper_that_does_not_ring():
    current = 4e-3 * np.sign(np.sin(np.arange(300) * 0.04))
    batch = own_batch((0.3, 0.3, 0.3), current)
    slow = plant_constants(default_actuator())._replace(CF=0.4)
    unknowns = Unknowns(FAULTS, (slow,), {})
    rows = np.array([(0.3, 0.3, 0.3), (0.8, 0.9, 0.1)])
    np.testing.assert_allclose(
        in_lanes(batch, rows, 25.0, unknowns), one_by_one(batch, rows, 25.0, unknowns), rtol=1e-3
    )


def test_residuals_and_anchors_are_those_of_one_alone(recorded_model, population):
    batch = recorded_model.batch
    noise = 1.0 / batch.weight[0].max()
    anchored = batch._replace(anchor=Anchor(0.1, 3.0 * noise, 12.0 * noise).as_array()[None])
    points = np.zeros((18, len(FAULTS) + 1))
    points[:, :3] = population[-18:]
    points[:, 3] = np.linspace(-1e-6, 1e-6, 18)
    unknowns = Unknowns((*FAULTS, parameter("spool_offset")), recorded_model.unknowns.base, {})
    model = SimdModel(anchored, unknowns)
    out, counts = model.residuals(points)
    there, expected = ScalarModel(anchored, unknowns).residuals(points)
    assert counts.max() > 0
    np.testing.assert_array_equal(counts, expected)
    np.testing.assert_allclose(out[:, 0], there[:, 0], atol=1e-6)
    costs = np.minimum(out**2, 25.0).sum(axis=(1, 2))
    np.testing.assert_allclose(costs, model.costs(points, 25.0), rtol=1e-12)


SHORT = 4e-3 * np.sin(np.arange(250) * 0.06)
CUBE = st.tuples(*[st.floats(0.0, 1.0)] * 3)


@settings(max_examples=30)
@given(one=CUBE, others=st.lists(CUBE, min_size=1, max_size=LANES + 2), place=st.integers(0, 99))
def test_no_lane_depends_on_its_neighbours(one, others, place):
    batch = own_batch((0.3, 0.3, 0.3), SHORT)
    model = SimdModel(batch._replace(anchor=Anchor(0.1, 1e-6, 4e-6).as_array()[None]), space())
    place %= len(others) + 1
    together, counts = model.residuals(np.array([*others[:place], one, *others[place:]]))
    alone, count = model.residuals(np.array([one]))
    np.testing.assert_array_equal(together[place], alone[0])
    assert counts[place] == count[0]


@pytest.mark.parametrize("count", [5, 16, 17, 32, 50])
def test_several_processors_give_the_digits_of_one(recorded_model, count):
    """Whatever is left over for the last of them."""
    points = np.random.default_rng(1).random((count, 3))
    batch, unknowns, levels = recorded_model.batch, recorded_model.unknowns, recorded_model.levels
    found = [
        SimdModel(batch, unknowns, threads=threads, levels=levels).residuals(points)
        for threads in (1, 2, 3)
    ]
    for residuals, anchored in found[1:]:
        np.testing.assert_array_equal(residuals, found[0][0])
        np.testing.assert_array_equal(anchored, found[0][1])
    assert np.isfinite(found[0][0]).all()
    assert (found[0][1] >= 0).all()


@pytest.mark.parametrize("kind", [SimdModel, ScalarModel])
def test_evaluations_are_counted(kind):
    model = kind(own_batch((0.3, 0.3, 0.3), SHORT), space())
    model.residuals(np.full((7, 3), 0.5))
    model.costs(np.full((2, 3), 0.5), 25.0)
    assert model.evaluations == 9


def test_unbounded_unknowns_do_not_coarsen_the_jack():
    """Offsets have no bounds to scatter candidates in: the jack's steps are those of the faults."""
    batch = own_batch((0.3, 0.3, 0.3), 8e-3 * np.sin(np.arange(250) * 0.2))
    plain, more = (
        SimdModel(batch, space(free=free)) for free in (FAULTS, (*FAULTS, *SENSOR_OFFSETS))
    )
    np.testing.assert_array_equal(plain.levels, more.levels)


SCRIPT = """
import sys
import numba, numpy as np
from ehadiag.model.batch import Anchor
from ehadiag.model.residual_models import model_response
from ehadiag.model.plant import PlantConstants

assert numba.config.DISABLE_JIT
current, measured = np.loadtxt(sys.stdin)
constants = PlantConstants(*map(float, sys.argv[1:]))
anchor = Anchor(0.3, 3e-7, 1.5e-6)
answer = model_response(constants, current, 1e-3, measured=measured, anchor=anchor)
for row in (answer.spool, answer.pressure, answer.position, [len(answer.anchored)]):
    print(*[float(x).hex() for x in row])
"""


def test_plain_python_gives_the_compiled_answer():
    """Steps, slow motion and a sample that re-anchors, over 60 ticks."""
    current = np.concatenate([np.zeros(2), np.full(8, 8e-3), 1.5e-3 * np.sin(np.arange(50) * 0.4)])
    constants = damaged_unit([0.3, 0.6, 0.3])
    measured = model_response(constants, current, 1e-3).spool + 0.1e-6
    measured[30:] += 3e-6
    compiled = model_response(
        constants, current, 1e-3, measured=measured, anchor=Anchor(0.3, 3e-7, 1.5e-6)
    )
    text = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in (current, measured))
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *map(repr, constants)],
        input=text,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )
    rows = [[float.fromhex(x) for x in line.split()] for line in done.stdout.splitlines()]
    assert len(compiled.anchored) == rows[3][0] >= 1
    # The compiler may join a product and a sum into one rounding.
    np.testing.assert_allclose(rows[0], compiled.spool, atol=1e-14)
    np.testing.assert_allclose(rows[1], compiled.pressure, atol=1e-2)
    np.testing.assert_allclose(rows[2], compiled.position, atol=1e-13)
