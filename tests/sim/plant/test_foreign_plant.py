"""Plants of other makers that cannot be run: one clear line. Real ones: test_export_fmu.py."""

import math
import zipfile
from pathlib import Path

import pytest

from ehadiag import ConfigurationError, InputOutputError, bundled_tests, default_actuator
from ehadiag.cli.main import main
from ehadiag_sim.conditions import DataErrors, Effects, Faults, Sensors, UnmodelledEffects
from ehadiag_sim.emulator import emulated_computer
from ehadiag_sim.foreign_plant import ForeignPlant

pytest.importorskip("fmpy")

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="valve" guid="1">
  <{kind} modelIdentifier="valve"/>
  <ModelVariables>
    <ScalarVariable name="i" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="x" valueReference="1" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="n" valueReference="2" causality="output" variability="discrete">
      <Integer/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>
</fmiModelDescription>
"""
MAPPING = 'current = "i"\nspool = "x"\npressure = "x"\nposition = "x"\n'


@pytest.fixture
def unit(tmp_path):
    def make(mapping=MAPPING, kind="CoSimulation"):
        path = tmp_path / "valve.fmu"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", DESCRIPTION.format(kind=kind))
        path.with_suffix(".toml").write_text(mapping)
        return path

    return make


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        (MAPPING.replace('"i"', '"u"'), "no real variable 'u'"),
        (MAPPING.replace('position = "x"', 'position = "n"'), "no real variable 'n'"),
        (MAPPING + "[start]\nvolume = 1.0\n", "no real variable 'volume'"),
        (MAPPING + '[conditions]\nFSX = "i"\n', "there is no 'FSX'"),
        (MAPPING + '[conditions]\ndata = "i"\n', "there is no 'data'"),
        (MAPPING + '[conditions]\nunmodelled = "i"\n', "there is no 'unmodelled'"),
        (MAPPING + '[conditions]\nFDJ = { variable = "i", scale = 0 }\n', "i: scale must not be 0"),
        (MAPPING + '[conditions]\nFDJ = { variable = "i", scale = nan }\n', "a finite number"),
        (MAPPING.replace('"i"', '{ variable = "i", scale = 0.0 }'), "i: scale must not be 0"),
        (MAPPING.replace('"i"', '{ variable = "i", scale = inf }'), "a finite number"),
        (MAPPING.replace('"i"', '{ variable = "i", offset = nan }'), "a finite number"),
        (MAPPING + "[start]\ni = nan\n", "a finite number"),
        (MAPPING + "[starts]\n", "starts"),
    ],
)
def test_a_mapping_that_does_not_fit_is_named(unit, mapping, message):
    with pytest.raises(ConfigurationError, match=message):
        ForeignPlant(unit(mapping))


@pytest.mark.parametrize("path", ["", ".", "absent.fmu"])
def test_what_is_no_file_is_refused(path):
    with pytest.raises(ConfigurationError, match="is no file"):
        ForeignPlant(Path(path))


def test_a_unit_of_fmi_1_is_refused(tmp_path):
    path = tmp_path / "old.fmu"
    text = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="valve" modelIdentifier="valve" guid="1"
  numberOfContinuousStates="0" numberOfEventIndicators="0">
  <ModelVariables>
    <ScalarVariable name="i" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
  </ModelVariables>
  <Implementation><CoSimulation_StandAlone><Capabilities/></CoSimulation_StandAlone></Implementation>
</fmiModelDescription>
"""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
    with pytest.raises(ConfigurationError, match=r"is of FMI 1\.0; need FMI 2\.0 or 3\.0"):
        ForeignPlant(path)


@pytest.mark.parametrize(
    "effects",
    [Effects(unmodelled=UnmodelledEffects(torque_cubic=0.1)), Effects(data=DataErrors(0.1))],
)
def test_effects_of_the_simulator_alone_are_refused(unit, effects):
    with pytest.raises(ConfigurationError, match="cannot be played by a foreign plant"):
        ForeignPlant(unit()).values(Faults(), effects)


class Unit:
    """What a unit in FMPy's hands does, with an output that is given."""

    def __init__(self, output):
        self.output, self.freed = output, 0

    def getReal(self, references):
        return [self.output] * len(references)

    def freeInstance(self):
        self.freed += 1

    def __getattr__(self, name):
        return lambda *_, **__: None


def test_outputs_that_are_not_finite_end_the_run_with_the_time(unit, monkeypatch):
    fake = Unit(1e-3)
    monkeypatch.setattr("fmpy.simulation.instantiate_fmu", lambda *_, **__: fake)
    run = ForeignPlant(unit()).begin(1e-3, Faults(), Effects(), Sensors())
    run.advance(0.0)
    fake.output = math.nan
    with pytest.raises(InputOutputError, match=r"not finite at 0\.002 s"):
        run.advance(0.0)
    run.close()
    run.close()
    assert fake.freed == 1


def test_one_unit_lives_at_a_time(unit, monkeypatch):
    living = []

    class Counted(Unit):
        def freeInstance(self):
            living.remove(self)

    def instantiate(*_, **__):
        assert not living
        living.append(Counted(0.0))
        return living[-1]

    monkeypatch.setattr("fmpy.simulation.instantiate_fmu", instantiate)
    core = emulated_computer(
        default_actuator(), bundled_tests().values(), foreign=ForeignPlant(unit())
    )
    core.start(1)
    for _ in range(200):
        core.step()
    assert core.tests_started == 1


def test_broken_hardware_is_of_the_simulated_plant_alone(unit):
    foreign = ForeignPlant(unit())
    with pytest.raises(ConfigurationError, match="'dead-coil': is not of a foreign plant"):
        emulated_computer(default_actuator(), [], broken="dead-coil", foreign=foreign)


def test_what_is_no_unit_for_co_simulation_is_refused(unit, tmp_path):
    with pytest.raises(ConfigurationError, match="co-simulation"):
        ForeignPlant(unit(kind="ModelExchange"))
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(ConfigurationError, match="no unit that FMPy reads"):
        ForeignPlant(tmp_path / "text.fmu")


def test_a_condition_without_a_variable_is_refused(unit):
    plant = ForeignPlant(unit(MAPPING + '[conditions]\nFDJ = { variable = "i", scale = 0.5 }\n'))
    assert plant.values(Faults(FDJ=0.4), Effects(oil_temperature=20.0)) == {"i": 0.8}
    with pytest.raises(ConfigurationError, match="no variable for Kintas"):
        plant.values(Faults(Kintas=0.1), Effects())


def test_a_unit_without_a_binary_ends_the_command_with_one_line(unit, capsys):
    assert main(["bit", "--simulate", "--fast", "--test", "open", "--plant", str(unit())]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "valve.fmu" in line
    assert main(["bit", "--simulate", "--fast", "--test", "open", "--plant-mapping", "x"]) == 2
