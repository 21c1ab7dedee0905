"""Co-simulation units in FMPy, against the simulator and the monitor of the package."""

import importlib.util
import json
import math
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from places import LOGS

from ehadiag import CommandMode, ConfigurationError, Monitor, bundled_tests, default_actuator
from ehadiag.cli.main import main
from ehadiag.export.fmu import export_fmus
from ehadiag.monitor.monitor_memory import MONITOR_UNIT_FIELDS
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.foreign_plant import ForeignPlant
from ehadiag_sim.simulation import Plant, simulate
from ehadiag_tools.onboard.replay import ticks_of, unit_of
from firmware_iface.files import RESULT_MODE, Folder
from firmware_iface.signals.recordings import read_recording

fmpy = pytest.importorskip("fmpy")
TICK = 1e-3
SEVERITIES = (0.3, 0.4, 0.2)
NAMES = [f"eha_{model}_fmi{n}" for model in ("actuator", "monitor") for n in (2, 3)]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("FMUs"),
    pytest.mark.skipif(sys.platform != "linux", reason="units are written for Linux"),
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here"),
]


@pytest.fixture(scope="module", autouse=True)
def coarse_step():
    """Not here: a unit has the simulator's own step."""


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    out = tmp_path_factory.mktemp("units")
    with Folder.at(out, RESULT_MODE) as folder:
        export_fmus(default_actuator(), folder)
    return out


class Running:
    """A unit in FMPy's hands, stepped by hand."""

    def __init__(self, path, place, parameters):
        told = fmpy.read_model_description(path)
        self._where = {item.name: item.valueReference for item in told.modelVariables}
        three = told.fmiVersion == "3.0"
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self.fmu = (FMU3Slave if three else FMU2Slave)(
            guid=told.guid if not three else told.instantiationToken,
            unzipDirectory=fmpy.extract(path, place),
            modelIdentifier=told.coSimulation.modelIdentifier,
            instanceName="one",
        )
        self._get = self.fmu.getFloat64 if three else self.fmu.getReal
        self._set = self.fmu.setFloat64 if three else self.fmu.setReal
        self.fmu.instantiate()
        self.put(parameters)
        if not three:
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self._time = 0.0

    def put(self, values):
        self._set([self._where[name] for name in values], list(values.values()))

    def read(self, *names):
        return np.array(self._get([self._where[name] for name in names]))

    def step(self, step=TICK):
        self.fmu.doStep(currentCommunicationPoint=self._time, communicationStepSize=step)
        self._time += step


@pytest.mark.parametrize("name", NAMES)
def test_fmpy_finds_nothing_wrong(units, name):
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(units / f"{name}.fmu")) == []


@pytest.mark.parametrize("name", NAMES)
def test_no_library_of_python_is_loaded(units, name, tmp_path):
    place = fmpy.extract(str(units / f"{name}.fmu"), tmp_path)
    (library,) = tmp_path.rglob("*.so")
    loaded = subprocess.run(["ldd", library], capture_output=True, text=True, check=True).stdout
    assert "python" not in loaded
    assert place


@pytest.mark.parametrize("version", [2, 3])
def test_the_actuator_is_the_simulator(units, version, tmp_path):
    effects = Effects(hysteresis=0.02, plays=4, null_bias=1e-4, oil_temperature=25.0, load=300.0)
    plant = Plant(default_actuator(), Faults(*SEVERITIES), effects, Sensors(noise_lsb=0.0))
    parameters = dict(zip(("Kintas", "FSS", "FDJ"), SEVERITIES, strict=True))
    parameters |= {"hysteresis": 0.02, "plays": 4.0, "null_bias": 1e-4}
    parameters |= {"oil_temperature": 25.0, "load": 300.0, "closed": 1.0}
    unit = Running(str(units / f"eha_actuator_fmi{version}.fmu"), tmp_path, parameters)
    names = ("true_current", "true_spool", "true_pressure", "true_position")
    for k in range(200):
        command = 0.004 * math.sin(0.04 * k)
        unit.put({"command": command})
        unit.step()
        plant.tick(command, CommandMode.POSITION)
        np.testing.assert_allclose(unit.read(*names), plant.truth, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("version", [2, 3])
def test_the_monitor_is_that_of_the_package(units, version, tmp_path):
    recording = read_recording(LOGS / "paper-closed-1.blf")
    start = dict(zip(MONITOR_UNIT_FIELDS, unit_of(recording, SEVERITIES), strict=True))
    unit = Running(str(units / f"eha_monitor_fmi{version}.fmu"), tmp_path, start)
    monitor = Monitor(
        default_actuator(), SEVERITIES, recording.environment, mode=recording.samples.mode
    )
    inputs = ("command", "current", "spool", "pressure", "position")
    names = ("predicted_spool", "residual_spool", "pressure_upper")
    for row in ticks_of(recording)[:300].tolist():
        unit.put(dict(zip(inputs, row, strict=True)))
        unit.step()
        reading = monitor.push(tuple(row))
        own = reading.predicted[0], reading.residual[0], reading.cusum[1, 0]
        np.testing.assert_allclose(unit.read(*names), own, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("version", [2, 3])
def test_what_cannot_be_is_refused(units, version, tmp_path):
    path = str(units / f"eha_actuator_fmi{version}.fmu")
    with pytest.raises(Exception, match="fmi"):
        Running(path, tmp_path / "a", {"Kintas": 1.5})
    unit = Running(path, tmp_path / "b", {})
    with pytest.raises(Exception, match="fmi"):
        unit.step(0.4 * TICK)
    with pytest.raises(Exception, match="fmi"):
        unit.put({"E_GM": 0.05})
    unit.put({"Kintas": 1.5})
    with pytest.raises(Exception, match="fmi"):
        unit.step()


@pytest.mark.parametrize("version", [2, 3])
def test_faults_oil_and_load_change_in_a_run(units, version, tmp_path):
    unit = Running(str(units / f"eha_actuator_fmi{version}.fmu"), tmp_path, {})
    plant = Plant(default_actuator(), sensors=Sensors(noise_lsb=0.0))
    names = ("true_current", "true_spool", "true_pressure", "true_position")
    for k in range(200):
        if k == 80:
            values = {"FDJ": 0.5, "oil_temperature": 0.0, "supply_pressure": 18e6}
            unit.put({**values, "load": 1000.0, "load_force": 500.0})
            effects = Effects(oil_temperature=0.0, supply_pressure=18e6, load=1500.0)
            plant.change(Faults(FDJ=0.5), effects, Sensors(noise_lsb=0.0))
        command = 0.005 * math.sin(0.05 * k)
        unit.put({"command": command})
        unit.step()
        plant.tick(command, CommandMode.CURRENT)
        np.testing.assert_allclose(unit.read(*names), plant.truth, rtol=1e-9, atol=1e-15)
    moved = np.diff(unit.read("true_position"), prepend=plant.truth[3])
    assert moved == pytest.approx(0.0, abs=1e-12)
    assert unit.read("true_velocity") != 0.0


@pytest.mark.parametrize("name", NAMES)
def test_a_run_goes_on_from_a_stored_state(units, name, tmp_path):
    unit = Running(units / f"{name}.fmu", tmp_path, {})
    three = name.endswith("3")
    keep = unit.fmu.getFMUState if three else unit.fmu.getFMUstate
    restore = unit.fmu.setFMUState if three else unit.fmu.setFMUstate
    free = unit.fmu.freeFMUState if three else unit.fmu.freeFMUstate
    pack = unit.fmu.serializeFMUState if three else unit.fmu.serializeFMUstate
    unpack = unit.fmu.deserializeFMUState if three else unit.fmu.deSerializeFMUstate
    shown = ("true_spool", "true_position") if "actuator" in name else ("predicted_spool", "alarms")

    def run():
        found = []
        for k in range(40):
            unit.put({"command": 0.004 * math.sin(0.1 * k)})
            unit.step()
            found.append(unit.read(*shown))
        return np.array(found)

    run()
    kept = keep()
    content = pack(kept)
    first = run()
    free(kept)
    restore(unpack(content))
    assert run().tobytes() == first.tobytes()
    assert np.ptp(first[:, 0]) > 0.0


def test_units_of_measure_are_stated(units):
    for name in NAMES:
        described = fmpy.read_model_description(units / f"{name}.fmu")
        assert all(item.unit for item in described.modelVariables if item.name != "time")
        pressure = next(item for item in described.unitDefinitions if item.name == "Pa").baseUnit
        assert (pressure.kg, pressure.m, pressure.s) == (1, -1, -2)


@pytest.mark.parametrize("version", [2, 3])
def test_a_unit_of_another_maker_plays_the_actuator(units, version, tmp_path, capsys):
    path = units / f"eha_actuator_fmi{version}.fmu"
    mapping = tmp_path / "map.toml"
    mapping.write_text(
        'current = "command"\nspool = "true_spool"\nposition = "true_position"\n'
        'pressure = { variable = "true_pressure", scale = 1.0 }\n'
        'conditions = { Kintas = "Kintas", FSS = "FSS", FDJ = "FDJ", null_bias = "null_bias" }\n'
        "start = { closed = 0.0 }\n"
    )
    foreign = ForeignPlant(path, mapping)
    test = bundled_tests()["open"]
    effects = Effects(null_bias=5e-5)
    theirs, ours = (
        simulate(default_actuator(), test, Faults(*SEVERITIES), effects, seed=3, foreign=plant)
        for plant in (foreign, None)
    )
    for name in ("spool", "pressure", "position"):
        np.testing.assert_allclose(
            getattr(theirs, name), getattr(ours, name), rtol=1e-9, atol=1e-14
        )
    assert np.array_equal(theirs.codes, ours.codes)
    command = ["bit", "--test", "closed", "--simulate", "--fast", "--Kintas", "0.3", "--FSS", "0.6"]
    command += ["--FDJ", "0.3", "--plant", str(path), "--plant-mapping", str(mapping)]
    assert main([*command, "--out", str(tmp_path / "out")]) == 10
    (tmp_path / "loaded.toml").write_text("load_N = 5.0\n")
    command[command.index("--simulate") : command.index("--fast")] = [
        "--simulate", str(tmp_path / "loaded.toml"),
    ]  # fmt: skip
    capsys.readouterr()
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    assert "no variable for load: name one under [conditions]" in capsys.readouterr().err


def test_without_a_compiler_it_says_so(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(ConfigurationError, match="no C compiler"):
        export_fmus(default_actuator(), None)


def test_without_zig_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("ehadiag.export.targets.find_spec", lambda _name: None)
    with pytest.raises(ConfigurationError, match=r"need ziglang: .*install .*(ziglang|cross)"):
        export_fmus(default_actuator(), None, platforms=["x86_64-windows"])
    with pytest.raises(ConfigurationError, match="platform 'amiga': need one of x86_64-linux, "):
        export_fmus(default_actuator(), None, platforms=["amiga"])


BINARIES = {
    ("linux64", "x86_64-linux", "so"): b"\x7fELF\x02\x01.{12}\x3e\0",
    ("aarch64-linux", "aarch64-linux", "so"): b"\x7fELF\x02\x01.{12}\xb7\0",
    ("win64", "x86_64-windows", "dll"): b"MZ.{1,500}PE\0\0\x64\x86",
    ("darwin64", "x86_64-darwin", "dylib"): b"\xcf\xfa\xed\xfe\x07\0\0\x01",
    ("aarch64-darwin", "aarch64-darwin", "dylib"): b"\xcf\xfa\xed\xfe\x0c\0\0\x01",
}
"""Beginning of a library, with the number of its machine, by folders in FMI 2 and 3 and suffix."""


def test_a_unit_for_all_platforms_has_a_binary_for_each(units, tmp_path):
    from fmpy.validation import validate_fmu

    pytest.importorskip("ziglang", reason="no ziglang, which links for other computers")
    with Folder.at(tmp_path, RESULT_MODE) as folder:
        export_fmus(default_actuator(), folder, platforms=["all"])
    for name in NAMES:
        path = tmp_path / f"{name}.fmu"
        assert validate_fmu(str(path)) == []
        with zipfile.ZipFile(path) as archive:
            assert len(archive.namelist()) == 1 + len(BINARIES)
            for (two, three, suffix), begin in BINARIES.items():
                place = two if name.endswith("2") else three
                content = archive.read(f"binaries/{place}/{name}.{suffix}")
                assert re.match(begin, content, re.DOTALL), place
                assert f"fmi{name[-1]}DoStep\0".encode() in content
    found = []
    for place in (units, tmp_path):
        path = place / "eha_actuator_fmi3.fmu"
        unit = Running(path, tmp_path / f"run{len(found)}", {"Kintas": 0.3, "oil_temperature": 10})
        found.append([])
        for k in range(300):
            unit.put({"command": 0.006 * math.sin(0.05 * k)})
            unit.step()
            found[-1].append(unit.read("spool", "true_pressure", "true_position"))
    assert np.array(found[0]).tobytes() == np.array(found[1]).tobytes()
    assert np.ptp(found[0], axis=0).all()


def in_ecos(path, parameters, inputs, outputs):
    """What Ecos, the second importer, reads; its library stays in a process of its own."""
    there = importlib.util.find_spec("ecospy") is not None
    if not there or not Path(sys.prefix, "lib", "libtbb.so.12").exists():
        pytest.skip("no ecospy with its tbb here")
    told = json.dumps([str(path), parameters, inputs, outputs])
    done = subprocess.run(
        [sys.executable, "-c", ECOS], input=told, capture_output=True, text=True, check=True
    )
    (found,) = (line for line in done.stdout.splitlines() if line.startswith("[["))
    return np.array(json.loads(found))


ECOS = """
import ctypes, json, pathlib, sys
# The library of Ecos needs one that its package does not bring.
ctypes.CDLL(str(pathlib.Path(sys.prefix, "lib", "libtbb.so.12")), mode=ctypes.RTLD_GLOBAL)
from ecospy import EcosSimulation, EcosSimulationStructure
path, parameters, inputs, outputs = json.load(sys.stdin)
structure = EcosSimulationStructure()
structure.add_model("unit", path)
structure.add_parameter_set("told", {f"unit::{name}": value for name, value in parameters.items()})
with EcosSimulation(structure=structure, step_size=1e-3) as run:
    run.init(parameter_set="told")
    found = []
    for values in inputs:
        for name, value in values.items():
            run.set_real(f"unit::{name}", value)
        run.step(1)
        found.append([run.get_real(f"unit::{name}") for name in outputs])
    print(json.dumps(found))
"""


@pytest.mark.parametrize("name", NAMES)
def test_a_second_importer_reads_the_same_digits(units, tmp_path, name):
    if "actuator" in name:
        parameters = {"Kintas": 0.2, "FDJ": 0.5, "supply_pressure": 20e6}
        outputs = ["spool", "true_pressure", "true_position"]
        inputs = [{"command": 8e-3 * math.sin(0.1 * tick)} for tick in range(150)]
    else:
        parameters = dict.fromkeys(("Kintas", "FSS"), 0.1)
        outputs = ["predicted_spool", "residual_pressure", "alarms"]
        named = ("command", "current", "spool", "pressure", "position")
        ticks = ticks_of(read_recording(LOGS / "paper-open-1.blf"))[700:850]
        inputs = [dict(zip(named, row, strict=True)) for row in ticks.tolist()]
    ours = Running(units / f"{name}.fmu", tmp_path / "unit", parameters)
    own = []
    for values in inputs:
        ours.put(values)
        ours.step()
        own.append(ours.read(*outputs))
    theirs = in_ecos(units / f"{name}.fmu", parameters, inputs, outputs)
    assert np.array(own).tobytes() == theirs.tobytes()
    assert np.ptp(theirs[:, 0]) > 0.0
