"""Reading, simulating and diagnosing from Python: the command line's answers, and its errors."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bus_synth import START, make_truth, play
from msgspec.structs import replace
from places import LOGS, ROOT

import ehadiag
from ehadiag.api import log_if_compiling
from ehadiag.assess.diagnosis import diagnose as core_diagnose
from ehadiag.cli.main import main
from ehadiag.identify.solvers import CompactGa
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.simulation import simulate as core_simulate
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.logs.recorder import Recorder

OPEN, CLOSED = LOGS / "paper-open-1.blf", LOGS / "paper-closed-1.blf"
DATA = ROOT / "firmware_iface" / "data"


@pytest.fixture(scope="module")
def recording() -> ehadiag.Recording:
    (found,) = ehadiag.read(OPEN)
    return found


@pytest.fixture(scope="module")
def result(recording: ehadiag.Recording) -> ehadiag.Result:
    return ehadiag.diagnose(recording)


def unread(result: ehadiag.Result) -> dict[str, Any]:
    """The object without what only a log tells."""
    tree = untimed(result.to_json())
    del tree["configuration"]["mapping"], tree["request"]["logs"]
    for item in tree["recordings"]:
        del item["log"]
    return tree


def untimed(line: str) -> dict[str, Any]:
    """A result without the seconds that it took."""
    tree: dict[str, Any] = json.loads(line)
    assert set(tree.pop("timing_s")) >= {"read", "first", "search", "refine", "total"}
    return tree


def output_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Standard output of the command line."""
    capsys.readouterr()
    assert main([str(item) for item in arguments]) in (0, 10, 20, 30)
    return capsys.readouterr().out


@pytest.mark.parametrize("logs", [(OPEN,), (OPEN, CLOSED)], ids=["one", "joint"])
def test_the_json_is_the_command_lines(
    logs: tuple[Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    told = output_of(capsys, "diagnose", "--json", "--joint", *logs)
    result = ehadiag.diagnose(logs)
    ours, theirs = untimed(result.to_json()), untimed(told)
    assert json.dumps(ours) == json.dumps(theirs)


def test_a_path_its_text_a_recording_and_lists_of_them_are_the_same(
    result: ehadiag.Result, recording: ehadiag.Recording
) -> None:
    expected = unread(result)
    for given in (OPEN, str(OPEN), [OPEN], (recording,), iter([recording]), ehadiag.read(OPEN)):
        assert unread(ehadiag.diagnose(given)) == expected


def test_printed_it_is_the_command_lines_table(
    result: ehadiag.Result, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = output_of(capsys, "diagnose", OPEN).splitlines()
    ours = str(result).splitlines()
    assert [line.rstrip() for line in theirs[:-1]] == ours[:-1]
    assert theirs[-1].rpartition(",")[0] == ours[-1].rpartition(",")[0]
    assert "\x1b" not in str(result)


def test_faults_by_name(result: ehadiag.Result) -> None:
    identification = result.diagnosis.identification
    assert identification is not None
    assert tuple(result.faults) == FAULT_NAMES
    for item in identification.estimates:
        fault = result.faults[item.name]
        assert (fault.value, fault.std, fault.interval) == (item.value, item.std, item.interval95)
        assert (fault.first, fault.search) == (item.first, item.search)
        assert fault.interval[0] <= fault.value <= fault.interval[1]
    with pytest.raises(TypeError):
        result.faults["FSS"] = result.faults["FDJ"]  # type: ignore[index]


def test_verdict_and_reasons(result: ehadiag.Result) -> None:
    assert result.verdict is ehadiag.Verdict.DEGRADED
    assert (str(result.verdict), f"{result.verdict:>10}") == ("DEGRADED", "  DEGRADED")
    assert int(result.verdict) == 10
    assert result.reasons == result.diagnosis.reasons
    assert result.test == "open"
    assert result.source == str(OPEN)
    assert repr(result).startswith(f"<Result DEGRADED {OPEN}: ")


def test_levels_solver_seed_and_progress(recording: ehadiag.Recording) -> None:
    seen: list[tuple[str, float]] = []
    result = ehadiag.diagnose(
        recording,
        advisory=0.9,
        limit=0.95,
        solver=CompactGa(budget=400),
        seed=3,
        progress=lambda stage, share: seen.append((stage, share)),
    )
    assert result.verdict is ehadiag.Verdict.HEALTHY
    assert json.loads(result.to_json())["solver"]["seed"] == 3
    assert seen
    with pytest.raises(ehadiag.ConfigurationError, match="solver 'swarm'"):
        ehadiag.diagnose(recording, solver="swarm")


def test_actuator_and_test_as_object_or_file(recording: ehadiag.Recording) -> None:
    expected = core_diagnose(
        [recording], ehadiag.default_actuator(), ehadiag.bundled_tests().values()
    )
    data, stored = ROOT / "ehadiag" / "data", ROOT / "firmware_iface" / "data" / "tests"
    for actuator in (data / "actuator.toml", str(data / "actuator.toml"), expected.actuator):
        for test in (stored / "open.toml", "open", [expected.tests[0]]):
            result = ehadiag.diagnose(recording, actuator=actuator, test=test)  # type: ignore[arg-type]
            assert result.reasons == expected.reasons


def test_one_test_stands_for_recordings_without_a_number(recording: ehadiag.Recording) -> None:
    nameless = replace(recording, test_id=None)
    assert ehadiag.diagnose(nameless).verdict is ehadiag.Verdict.NOT_TESTED
    assert ehadiag.diagnose(nameless, test="open").verdict is ehadiag.Verdict.DEGRADED
    several = ehadiag.diagnose(nameless, test=["open", "closed"])
    assert several.verdict is ehadiag.Verdict.NOT_TESTED


def test_where_nothing_can_be_identified(recording: ehadiag.Recording) -> None:
    empty = replace(recording, samples=None, source="empty.blf")
    result = ehadiag.diagnose(empty)
    assert str(result.verdict) == "NOT_TESTED"
    assert not result.identified
    assert tuple(result.faults) == FAULT_NAMES
    assert all(math.isnan(fault.value) for fault in result.faults.values())
    faults = json.loads(result.to_json())["faults"]
    unknown = dict.fromkeys(("first", "search", "estimate", "std", "interval95"))
    assert faults["FSS"].items() >= (unknown | {"flags": []}).items()
    assert str(result).startswith("NOT TESTED  The test in this recording is not known.\n")
    assert "recording empty.blf" in str(result)
    with pytest.raises(ehadiag.NotTestedError, match=r"empty\.blf: nothing to plot: "):
        result.plot()
    with pytest.raises(ehadiag.NotTestedError, match=r"empty\.blf: no telemetry"):
        empty.to_frame()


def test_what_cannot_be_diagnosed_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ehadiag.ConfigurationError, match="nothing to diagnose"):
        ehadiag.diagnose([])
    with pytest.raises(ehadiag.InputOutputError, match=r"nothing\.blf: no such file"):
        ehadiag.diagnose(tmp_path / "nothing.blf")
    with pytest.raises(ehadiag.InputOutputError, match=r"DBC file .*nothing\.dbc"):
        ehadiag.read(OPEN, dbc=tmp_path / "nothing.dbc")


def test_a_mapping_as_file_or_object(recording: ehadiag.Recording) -> None:
    mapping, dbc = DATA / "eha_fcc.toml", DATA / "eha_fcc.dbc"
    for options in ({"mapping": mapping}, {"mapping": default_map()}):
        (found,) = ehadiag.read(OPEN, **options)  # type: ignore[arg-type]
        assert found.samples is not None
        assert recording.samples is not None
        np.testing.assert_array_equal(found.samples.spool, recording.samples.spool)
    result = ehadiag.diagnose(str(OPEN), mapping=str(mapping), dbc=str(dbc))
    assert result.verdict is ehadiag.Verdict.DEGRADED


def test_all_tests_of_a_log_or_the_last_complete_one(tmp_path: Path) -> None:
    encoder, truth = Encoder(default_map()), make_truth(300)
    later = START + 10_000_000_000
    with Recorder(tmp_path / "two.blf") as recorder:
        for frame in (
            *play(encoder, truth, test_id=1, idle_after=50),
            *play(encoder, truth, test_id=2, start_ns=later, idle_after=50),
        ):
            recorder.write(frame)
    assert [item.test_id for item in ehadiag.read(tmp_path / "two.blf", every=True)] == [1, 2]
    assert [item.test_id for item in ehadiag.read(tmp_path / "two.blf")] == [2]


def test_the_simulator_behind_the_door_is_the_detailed_one() -> None:
    ours = ehadiag.simulate("open", FSS=0.6, oil_temperature=60.0, noise_lsb=0.25, seed=5)
    theirs = core_simulate(
        ehadiag.default_actuator(),
        ehadiag.bundled_tests()["open"],
        Faults(FSS=0.6),
        Effects(oil_temperature=60.0),
        Sensors(noise_lsb=0.25),
        seed=5,
    )
    assert ours.samples is not None
    np.testing.assert_array_equal(ours.samples.spool, theirs.samples.spool)
    assert ours.environment.oil_temperature == 60.0
    assert ours.source == "simulated open"
    same = ehadiag.simulate(
        ehadiag.bundled_tests()["open"],
        faults=Faults(FSS=0.6),
        effects=Effects(oil_temperature=60.0),
        sensors=Sensors(noise_lsb=0.25),
        seed=5,
    )
    assert same.samples is not None
    np.testing.assert_array_equal(same.samples.pressure, ours.samples.pressure)


def test_conditions_that_there_are_not() -> None:
    with pytest.raises(TypeError, match=r"no condition Fss; there are Kintas, FSS, FDJ, "):
        ehadiag.simulate(Fss=0.5)
    with pytest.raises(TypeError, match="FSS beside an object Faults"):
        ehadiag.simulate(FSS=0.5, faults=Faults())
    with pytest.raises(ehadiag.ConfigurationError, match=r"fault FSS: 1\.5 is outside"):
        ehadiag.simulate(FSS=1.5)
    with pytest.raises(ehadiag.ConfigurationError, match="test 'opne'"):
        ehadiag.simulate("opne")


def test_who_will_wait_for_the_compiler_is_told(
    tmp_path: Path, result: ehadiag.Result, caplog: pytest.LogCaptureFixture
) -> None:
    log_if_compiling()  # a diagnosis was made, so its kernels are kept
    assert caplog.messages == []
    code = "from ehadiag.api import log_if_compiling as log; log()"
    nothing_kept = os.environ | {"EHADIAG_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", code], env=nothing_kept, stderr=subprocess.PIPE, text=True
    ) as waiting:
        assert waiting.stderr is not None
        line = waiting.stderr.readline()
        waiting.kill()  # what follows is a minute of compiling
    assert line.startswith("ehadiag: compiling the model's kernels (search, model), once")


@pytest.mark.parametrize("seed", [-1, 1 << 32, "x", 0.5])
def test_a_seed_that_is_none_is_refused_at_once(seed: Any) -> None:
    for call in (ehadiag.diagnose, ehadiag.calibrate, ehadiag.simulate):
        with pytest.raises(ehadiag.ConfigurationError, match="need a whole number, 0 … 4294967295"):
            call("open", seed=seed)
