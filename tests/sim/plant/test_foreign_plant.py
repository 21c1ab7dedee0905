"""Plants of other makers that cannot be run: one clear line. Real ones: test_export_fmu.py."""

import zipfile

import pytest

from ehadiag import ConfigurationError
from ehadiag.cli.main import main
from ehadiag_sim.conditions import Effects, Faults
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
        (MAPPING + "[starts]\n", "starts"),
    ],
)
def test_a_mapping_that_does_not_fit_is_named(unit, mapping, message):
    with pytest.raises(ConfigurationError, match=message):
        ForeignPlant(unit(mapping))


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
