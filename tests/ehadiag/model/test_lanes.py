"""The population's kernel against the scalar one, lane by lane."""

import platform
import re

import llvmlite.binding
import numba
import numpy as np
import pytest
from ehadiag.model.simd.threads import residuals_on_cores
from hypothesis import given, settings
from hypothesis import strategies as st
from other_actuator import with_data
from places import LOGS

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment, make_batch
from ehadiag.model.plant import plant_constants
from ehadiag.model.scalar.residuals import Batch, costs, residuals, workspace
from ehadiag.model.scalar.response import FREE_RUN, respond
from ehadiag.model.simd.layout import LANES
from ehadiag.model.simd.residuals import lane_costs, lane_residuals, lane_work, run_blocks
from firmware_iface.logs.reader import read_recording

CORNERS = np.array(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0])).reshape(3, 8).T
NO_CAP = 1e9


def candidates_of(rows):
    population = np.zeros((len(rows), 5))
    population[:, :3] = rows
    return population


def own_batch(
    faults, current, *, channels=(True, True), offsets=(0.0, 0.0), tick=1e-3, actuator=None
):
    """Weights in LSB, the model's own answer as the measurement."""
    constants = plant_constants(actuator or default_actuator())
    truth = respond(constants, np.asarray(faults), current, tick)
    n = len(current)
    return Batch(
        constants=np.array([tuple(constants)]),
        tick=np.array([tick]),
        start=np.array([0, n]),
        origin=np.zeros(1),
        current_before=np.zeros(1),
        current=current,
        spool=truth.spool + offsets[0],
        pressure=truth.pressure + offsets[1],
        weight=np.vstack(
            [np.full(n, channels[0] / SPOOL.lsb), np.full(n, channels[1] / PRESSURE.lsb)]
        ),
        anchor=FREE_RUN.as_array()[None, :],
    )


def in_lanes(batch, population, cap=NO_CAP, work=None):
    out = np.empty(len(population))
    lane_costs(batch, population, cap, lane_work(batch) if work is None else work, out)
    return out


def one_by_one(batch, population, cap=NO_CAP):
    out = np.empty(len(population))
    costs(batch, population, cap, workspace(batch), np.empty((2, len(batch.current))), out)
    return out


@pytest.fixture(scope="module", params=["open", "closed"])
def recorded_batch(request):
    recording = read_recording(LOGS / f"paper-{request.param}-2.blf")
    return make_batch(
        [
            build_experiment(
                recording.samples,
                recording.environment,
                resolve_test(request.param),
                default_actuator(),
            )
        ]
    )


@pytest.fixture(scope="module")
def population():
    rng = np.random.default_rng(7)
    return candidates_of(np.vstack([CORNERS, rng.random((23, 3)), [[0.3, 0.6, 0.3]]]))


def test_the_spool_is_the_scalar_kernels(recorded_batch, population):
    """Each candidate's own scalar answer is the measurement: 0.05 LSB rms are the most it may err.

    A marginal event may fall the other way by rounding; none does here.
    """
    current = recorded_batch.current
    for index in (0, 3, 6, 7, 12, 20, 31):
        batch = own_batch(population[index, :3], current, channels=(True, False))
        gap = np.sqrt(in_lanes(batch, population[index : index + 1])[0] / len(current))
        assert gap < 0.05


def test_the_pressure_is_the_scalar_kernels_but_for_a_few_samples(recorded_batch, population):
    """With each sample's gap capped at 1 LSB the mean square is that of 0.1 LSB rms or less."""
    current = recorded_batch.current
    for index in (0, 3, 6, 7, 12, 20, 31):
        batch = own_batch(population[index, :3], current, channels=(False, True))
        gap = np.sqrt(in_lanes(batch, population[index : index + 1], cap=1.0)[0] / len(current))
        assert gap < 0.1


def test_costs_are_those_of_the_scalar_kernel(recorded_batch, population):
    """A handful of samples beside an event err by LSBs: at the truth that shows most, below 1 %."""
    np.testing.assert_allclose(
        in_lanes(recorded_batch, population, cap=25.0),
        one_by_one(recorded_batch, population, cap=25.0),
        rtol=1e-2,
    )


def test_one_lane_gives_the_digits_of_many(recorded_batch, population):
    work = lane_work(recorded_batch)
    together = in_lanes(recorded_batch, population, 25.0, work)
    alone = [
        in_lanes(recorded_batch, row[None, :], 25.0, work)[0] for row in population[:: LANES // 4]
    ]
    np.testing.assert_array_equal(together[:: LANES // 4], alone)
    order = np.random.default_rng(1).permutation(len(population))
    np.testing.assert_array_equal(
        in_lanes(recorded_batch, population[order], 25.0, work), together[order]
    )


def test_a_population_that_fills_no_block(recorded_batch, population):
    work = lane_work(recorded_batch)
    whole = in_lanes(recorded_batch, population, 25.0, work)
    part = in_lanes(recorded_batch, population[: LANES + 3], 25.0, work)
    np.testing.assert_array_equal(part, whole[: LANES + 3])


def test_stops_are_met():
    """Full current long enough for the flapper, the spool and the jack to strike their stops."""
    current = np.concatenate([np.full(600, 10e-3), np.full(900, -10e-3), np.zeros(100)])
    for faults in CORNERS:
        truth = respond(plant_constants(default_actuator()), faults, current, 1e-3)
        assert np.abs(truth.position).max() == plant_constants(default_actuator()).XJM
        batch = own_batch(faults, current)
        gap = np.sqrt(in_lanes(batch, candidates_of([faults]), cap=1.0)[0] / len(current))
        assert gap < 0.1


@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.3, 0.5, 0.4)])
def test_the_jack_feels_a_spool_that_meets_its_stop(faults):
    """Against sixteen times the ticks: a spool that stops makes a kink in its path."""
    stroke = default_actuator().servovalve.XSM
    actuator = with_data({"XSM": stroke / 4.0})
    current, finer = 10e-3 * np.sin(2.0 * np.pi * 20e-3 * np.arange(120)), 16
    fine = respond(
        plant_constants(actuator), np.array(faults), np.repeat(current, finer), 1e-3 / finer
    )
    assert np.mean(np.abs(fine.spool) == stroke / 4.0) > 0.3
    batch = own_batch(faults, current, actuator=actuator)
    batch = batch._replace(pressure=fine.pressure[finer - 1 :: finer])
    gaps = np.empty((1, 2, len(current)))
    lane_residuals(
        batch, candidates_of([faults]), lane_work(batch), gaps, np.empty(1, dtype=np.int64)
    )
    assert np.abs(gaps[0, 1]).max() < 0.5


def test_offsets_and_missing_samples_count_as_in_the_scalar_kernel():
    current = 4e-3 * np.sin(np.arange(400) * 0.05)
    batch = own_batch((0.4, 0.2, 0.5), current, offsets=(3e-7, 2e4))
    batch.spool[50:60] = np.nan
    batch.pressure[100:140] = np.nan
    batch.weight[0, 200:220] = 0.0
    rows = candidates_of([(0.4, 0.2, 0.5), (0.5, 0.3, 0.4)])
    rows[:, 3], rows[:, 4] = 3e-7, 2e4
    here, there = in_lanes(batch, rows, 25.0), one_by_one(batch, rows, 25.0)
    assert here[0] < 10.0  # an offset or gap taken wrongly makes hundreds
    np.testing.assert_allclose(here[1], there[1], rtol=1e-3)
    rows[:, 3] = 0.0
    # The scalar jack is up to 0.1 LSB off: 1 in 600 of 2 x 400 squares.
    np.testing.assert_allclose(
        in_lanes(batch, rows, 25.0), one_by_one(batch, rows, 25.0), rtol=2e-2
    )


def test_spans_start_from_their_own_origin():
    current = 3e-3 * np.sin(np.arange(300) * 0.05)
    one = own_batch((0.3, 0.3, 0.3), current)
    two = one._replace(
        constants=np.vstack([one.constants] * 2),
        tick=np.repeat(one.tick, 2),
        start=np.array([0, 120, 300]),
        origin=np.array([0.0, 4e-5]),
        current_before=np.array([0.0, current[119]]),
        anchor=np.vstack([one.anchor] * 2),
    )
    rows = candidates_of([(0.3, 0.3, 0.3), (0.1, 0.8, 0.6)])
    np.testing.assert_allclose(in_lanes(two, rows, 25.0), one_by_one(two, rows, 25.0), rtol=1e-2)


def test_a_flapper_that_does_not_ring():
    current = 4e-3 * np.sign(np.sin(np.arange(300) * 0.04))
    batch = own_batch((0.3, 0.3, 0.3), current)
    slow = plant_constants(default_actuator())._replace(CF=0.4)
    batch = batch._replace(constants=np.array([tuple(slow)]))
    rows = candidates_of([(0.3, 0.3, 0.3), (0.8, 0.9, 0.1)])
    np.testing.assert_allclose(
        in_lanes(batch, rows, 25.0), one_by_one(batch, rows, 25.0), rtol=1e-3
    )


def test_residuals_and_anchors_are_the_scalar_kernels(recorded_batch, population):
    noise = 1.0 / recorded_batch.weight[0].max()
    anchored = recorded_batch._replace(anchor=np.array([[0.1, 3.0 * noise, 12.0 * noise]]))
    n, ticks = 18, len(recorded_batch.current)
    population = population[-n:].copy()
    population[:, 3] = np.linspace(-1e-6, 1e-6, n)
    out, counts = np.empty((n, 2, ticks)), np.empty(n, dtype=np.int64)
    lane_residuals(anchored, population, lane_work(anchored), out, counts)
    there, scalar = np.empty((2, ticks)), workspace(anchored)
    assert counts.max() > 0
    for i in range(n):
        assert residuals(anchored, population[i], scalar, there) == counts[i]
        np.testing.assert_allclose(out[i, 0], there[0], atol=1e-6)
    costs_here = np.minimum(out**2, 25.0).sum(axis=(1, 2))
    np.testing.assert_allclose(costs_here, in_lanes(anchored, population, 25.0), rtol=1e-12)


SHORT = 4e-3 * np.sin(np.arange(250) * 0.06)
CUBE = st.tuples(*[st.floats(0.0, 1.0)] * 3)


@settings(max_examples=30)
@given(one=CUBE, others=st.lists(CUBE, min_size=1, max_size=LANES + 2), place=st.integers(0, 99))
def test_no_lane_depends_on_its_neighbours(one, others, place):
    batch = own_batch((0.3, 0.3, 0.3), SHORT)
    batch = batch._replace(anchor=np.array([[0.1, 1e-6, 4e-6]]))
    work = lane_work(batch)
    place %= len(others) + 1
    rows = candidates_of([*others[:place], one, *others[place:]])
    n = len(rows)
    together, alone = np.empty((n, 2, 250)), np.empty((1, 2, 250))
    counts, count = np.empty(n, dtype=np.int64), np.empty(1, dtype=np.int64)
    lane_residuals(batch, rows, work, together, counts)
    lane_residuals(batch, rows[place : place + 1], work, alone, count)
    np.testing.assert_array_equal(together[place], alone[0])
    assert counts[place] == count[0]


@pytest.mark.parametrize("count", [5, 16, 17, 32, 50])
def test_several_cores_give_the_digits_of_one(recorded_batch, count):
    """Whatever is left over for the last of them."""
    rows = candidates_of(np.random.default_rng(1).random((count, 3)))
    work = lane_work(recorded_batch)
    found = []
    for cores in (1, 2, 3):
        gaps = np.full((count, 2, len(recorded_batch.current)), np.nan)
        anchored = np.full(count, -1)
        residuals_on_cores(recorded_batch, rows, work, gaps, anchored, cores)
        found.append((gaps, anchored))
    for gaps, anchored in found[1:]:
        np.testing.assert_array_equal(gaps, found[0][0])
        np.testing.assert_array_equal(anchored, found[0][1])
    assert np.isfinite(found[0][0]).all()
    assert (found[0][1] >= 0).all()


def test_the_kernel_is_made_of_vector_instructions(tmp_path):
    """Products and sums of doubles in the block's kernel: by vectors, not one by one."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("the names of the instructions are those of x86")
    # Compiled anew, without a cache: code that is loaded cannot be looked at.
    batch = own_batch((0.3, 0.3, 0.3), SHORT)
    fresh = numba.njit(nogil=True, error_model="numpy")(run_blocks.py_func)
    work = lane_work(batch)
    rows, none = candidates_of([(0.3, 0.3, 0.3)]), (work.uncounted, work.no_gaps)
    fresh(batch, rows, 25.0, work, np.empty(1), *none)
    (text,) = fresh.inspect_asm().values()
    wide = len(re.findall(r"\bv?(?:f?n?m(?:add|sub)\d+|mul|add|sub)pd\b", text))
    fused = len(re.findall(r"\bvf\w+pd\b.*%[yz]mm", text))
    assert wide > 150
    if "avx2" in llvmlite.binding.get_host_cpu_features().flatten().replace("-avx2", ""):
        assert fused > 60
    division = re.findall(r"\bv?divpd\b", text)
    assert len(division) >= 2
