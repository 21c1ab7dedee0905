"""The benchmark runs through, with tiny sizes; no figure is judged."""

import json
import math
import shutil
from dataclasses import asdict
from itertools import product

import numpy as np
import pytest

from ehadiag.core.channels import POSITION, PRESSURE, SPOOL
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.search.objective import Objective
from ehadiag.model.scalar.residuals import ScalarModel
from ehadiag.model.scalar.response import respond
from ehadiag.model.scalar.transition import spool_tables
from ehadiag.model.simd.layout import LANES
from ehadiag.model.simd.model import SimdModel
from ehadiag_tools.bench import c_model as bench_c_model
from ehadiag_tools.bench import table as bench
from ehadiag_tools.bench.c_model import CLanes, CModel, CUnlocated
from ehadiag_tools.bench.decode import tiled
from ehadiag_tools.bench.operations import Tally, count_operations, counting
from ehadiag_tools.bench.peak import beginning
from ehadiag_tools.bench.problem import population, whole_test
from ehadiag_tools.bench.search import Goal, ReachedError
from ehadiag_tools.damaged import damaged_unit
from firmware_iface.logs.reader import read_frames

TINY = ["--repeats", "1", "--ticks", "5", "--seeds", "1", "--budget", "50", "--pushes", "50"]
TINY += ["--seconds", "0.02", "--frames", "2000"]


@pytest.mark.parametrize("section", ["lanes", "search", "estimate", "push", "decode"])
def test_each_section_gives_figures(section, capsys):
    assert bench.main(["--only", section, "--json", "-", *TINY]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["machine"]
    assert len(told["figures"]) >= 4
    for figure in told["figures"]:
        assert figure["section"] == section
        if figure["value"] is None:
            assert "left out" in figure["remark"]
        else:
            # A share is one minus a ratio of times: any number where the machine is busy.
            assert math.isfinite(figure["value"])
            assert figure["value"] >= 0.0 or figure["unit"] == "%"


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.6, 0.3), (1.0, 1.0, 1.0)])
def test_c_and_numba_are_the_same_algorithm(faults):
    """Else their times could not be compared."""
    constants = damaged_unit(faults)
    current = resolve_test("open").command()
    model = CModel(constants, spool_tables(constants, 1e-3), current)
    model()
    numba = respond(constants, current, 1e-3)
    np.testing.assert_allclose(model.spool, numba.spool, atol=1e-6 * SPOOL.lsb)
    np.testing.assert_allclose(model.pressure, numba.pressure, atol=1e-6 * PRESSURE.lsb)
    np.testing.assert_allclose(model.position, numba.position, atol=1e-6 * POSITION.lsb)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize(
    "anchor", [(0.0, np.inf, np.inf, 0.0), (0.1, 2.0 * SPOOL.lsb, 20.0 * SPOOL.lsb, 0.0)]
)
def test_c_and_lanes_are_the_same_algorithm(anchor):
    two = whole_test(bench.LOGS, 2)
    batch = two.batch._replace(anchor=np.array([anchor] * 2))
    lanes = SimdModel(batch, two.unknowns)
    corners = np.array(list(product((0.0, 0.4, 1.0), repeat=3)))
    residuals, anchored = lanes.residuals(corners)
    assert anchored.any() == np.isfinite(anchor[1])
    candidates = two.unknowns.candidates(corners)
    model = CLanes(batch, lanes.levels, candidates, np.inf, residuals=True)
    model()
    lsb = np.array([SPOOL.lsb, PRESSURE.lsb])[:, None] * batch.weight
    assert np.all(np.abs(residuals - model.residuals) <= 1e-6 * lsb)
    np.testing.assert_allclose(model.costs, (residuals**2).sum(axis=(1, 2)), rtol=1e-9)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("single", [False, True])
def test_vectors_without_located_events_are_nearly_the_same_model(single):
    """What events taken late make of most samples is an LSB or two."""
    lanes, rows = whole_test(bench.LOGS, 1), population(4)
    batch, candidates = lanes.batch, lanes.unknowns.candidates(rows)
    # The lanes' own answer is the measurement.
    for candidate, off in zip(candidates, lanes.residuals(rows)[0], strict=True):
        own = batch._replace(
            spool=batch.spool - off[0] / batch.weight[0],
            pressure=batch.pressure - off[1] / batch.weight[1],
            weight=np.repeat([[1.0 / SPOOL.lsb], [1.0 / PRESSURE.lsb]], off.shape[1], axis=1),
        )
        model = CUnlocated(own, lanes.levels, candidate[None], 25.0, single=single)
        model()
        assert (model.costs == model.costs[0]).all()
        assert 0.0 < np.sqrt(model.costs[0] / off.size) < 2.0


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_c_in_single_precision_is_near():
    lanes = whole_test(bench.LOGS, 1)
    rows = lanes.unknowns.candidates(population(4))
    double, single = (
        CLanes(lanes.batch, lanes.levels, rows, 25.0, single=kind) for kind in (False, True)
    )
    double()
    single()
    assert (double.costs != single.costs).all()
    np.testing.assert_allclose(single.costs, double.costs, rtol=1e-3)


def test_a_race_ends_where_it_should():
    """At the goal or with its budget, whoever evaluated on the same model before."""
    lanes, rows = whole_test(bench.LOGS, 1), population(4)
    objective = Objective(ScalarModel(lanes.batch, lanes.unknowns))
    objective(rows)
    race = Goal(objective, -np.inf, 9)
    values = race(rows)
    assert race(rows[2:3]) == values[2]
    assert race.spent == 5
    with pytest.raises(ReachedError):
        race(rows)
    easy = Goal(objective, float(values.min()), 9)
    with pytest.raises(ReachedError):
        easy(rows)
    assert easy.best == values.min()


def test_numbers_count_what_is_done_with_them():
    tally = Tally()
    a = np.arange(1.0, 9.0).view(counting(tally))
    b = a * a + np.float64(2.0) / a
    assert (tally.vector, tally.divisions, tally.choices, tally.scalar) == (24, 8, 0, 0)
    c = np.where(a > 3.0, np.minimum(a, b), -a)
    assert (tally.vector, tally.choices) == (24, 32)
    assert max(np.float64(3.0) * c[7] - 1.0, abs(c[6])) / c[1] == -11.5
    assert (tally.vector, tally.choices, tally.scalar) == (24, 32, 3)
    assert (c[7] - c).tolist() == (8.0 - np.asarray(c)).tolist()
    assert (c * c[1] > c[2]).any()
    assert (tally.vector, tally.choices, tally.scalar) == (40, 40, 3)
    assert tally.result().arithmetic == 43


def test_operations_are_counted_tick_by_tick():
    """At rest every tick takes as many, and no lane goes alone."""
    lanes = whole_test(bench.LOGS, 1)
    rows = lanes.unknowns.candidates(population(LANES))
    batch = lanes.batch._replace(current=np.zeros(len(lanes.batch.current)))
    jobs = [
        (beginning(batch, ticks), np.zeros(ticks, dtype=np.int64), rows) for ticks in (10, 20, 30)
    ]
    counts = [np.array(list(asdict(found).values())) for found in count_operations(jobs)]
    np.testing.assert_array_equal(counts[2] - counts[1], counts[1] - counts[0])
    assert (counts[1] - counts[0] > 0).tolist() == [True, True, True, False]


@pytest.mark.parametrize("section", ["kernel", "lanes"])
def test_without_a_compiler_c_is_left_out(section, monkeypatch, capsys):
    monkeypatch.setattr(bench_c_model.shutil, "which", lambda _: None)
    assert bench.main(["--only", section, *TINY]) == 0
    assert "left out: no cc on the path" in capsys.readouterr().out


@pytest.mark.slow
def test_whole_processes(tmp_path):
    target = tmp_path / "figures.json"
    assert bench.main(["--only", "process", "--json", str(target), *TINY]) == 0
    assert "says that it compiles" in target.read_text()


@pytest.mark.parametrize(
    "arguments", [["--only", "nothing"], ["--repeats", "0"], ["--logs", "no-such-folder"]]
)
def test_wrong_options_are_told_in_a_line(arguments, capsys):
    assert bench.main(arguments) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_tiling_keeps_frames_in_order_of_time():
    table = read_frames(bench.LOGS / "paper-open-2.blf")
    long = tiled(table, 2 * len(table) + 5)
    assert len(long) == 2 * len(table) + 5
    assert (long.time_ns[1:] >= long.time_ns[:-1]).all()
    assert (long.data[len(table) :][:5] == table.data[:5]).all()
