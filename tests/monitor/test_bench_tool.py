"""The benchmark runs through, with tiny sizes; no figure is judged."""

import json
import shutil
from itertools import product

import numpy as np
import pytest

from ehadiag.actuator import default_actuator
from ehadiag.channels import POSITION, PRESSURE, SPOOL
from ehadiag.identify.lanes import lane_residuals, lane_work
from ehadiag.model.constants import plant_constants
from ehadiag.model.monitoring import respond
from ehadiag.model.transition import spool_tables
from ehadiag.storedtest import resolve_test
from ehadiag_tools import bench, bench_c_model
from ehadiag_tools.bench_c_model import CLanes, CModel
from ehadiag_tools.bench_decode import tiled
from ehadiag_tools.bench_problem import whole_test
from firmware_iface.logs import read_frames

TINY = ["--repeats", "1", "--ticks", "5", "--seeds", "1", "--budget", "50", "--pushes", "50"]
TINY += ["--seconds", "0.02", "--frames", "2000"]


@pytest.mark.parametrize("section", ["search", "estimate", "push", "decode"])
def test_each_section_gives_figures(section, capsys):
    assert bench.main(["--only", section, "--json", "-", *TINY]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["machine"]
    assert len(told["figures"]) >= 4
    for figure in told["figures"]:
        assert figure["section"] == section
        assert figure["value"] is None or figure["value"] >= 0.0
        assert figure["value"] is not None or "left out" in figure["remark"]


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.6, 0.3), (1.0, 1.0, 1.0)])
def test_c_and_numba_are_the_same_algorithm(faults):
    """Else their times could not be compared."""
    constants = plant_constants(default_actuator())
    current = resolve_test("open").command()
    model = CModel(constants, spool_tables(constants, *faults[:2], 1e-3), faults[2], current)
    model()
    numba = respond(constants, np.array(faults), current, 1e-3)
    np.testing.assert_allclose(model.spool, numba.spool, atol=1e-6 * SPOOL.lsb)
    np.testing.assert_allclose(model.pressure, numba.pressure, atol=1e-6 * PRESSURE.lsb)
    np.testing.assert_allclose(model.position, numba.position, atol=1e-6 * POSITION.lsb)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize(
    "anchor", [(0.0, np.inf, np.inf), (0.1, 2.0 * SPOOL.lsb, 20.0 * SPOOL.lsb)]
)
def test_c_and_lanes_are_the_same_algorithm(anchor):
    batch = whole_test(bench.LOGS, 2)._replace(anchor=np.array([anchor] * 2))
    work = lane_work(batch)
    corners = np.array([[*faults, 0.0, 0.0] for faults in product((0.0, 0.4, 1.0), repeat=3)])
    gaps, anchored = np.empty((27, 2, len(batch.current))), np.empty(27, dtype=np.int64)
    lane_residuals(batch, corners, work, gaps, anchored)
    assert anchored.any() == np.isfinite(anchor[1])
    model = CLanes(batch, work.levels, corners, np.inf, gaps=True)
    model()
    lsb = np.array([SPOOL.lsb, PRESSURE.lsb])[:, None] * batch.weight
    assert np.all(np.abs(gaps - model.gaps) <= 1e-6 * lsb)
    np.testing.assert_allclose(model.costs, (gaps**2).sum(axis=(1, 2)), rtol=1e-9)


def test_without_a_compiler_c_is_left_out(monkeypatch, capsys):
    monkeypatch.setattr(bench_c_model.shutil, "which", lambda _: None)
    assert bench.main(["--only", "kernel", *TINY]) == 0
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
