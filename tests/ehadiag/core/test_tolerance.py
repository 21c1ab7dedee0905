"""Tolerances of an actuator's data: how a file and the command line give them."""

from importlib import resources

import msgspec
import pytest

from ehadiag.core.actuator import (
    VARYING,
    Jack,
    Servovalve,
    Tolerance,
    default_actuator,
    load_actuator,
    with_tolerance,
)
from ehadiag.core.errors import ConfigurationError
from ehadiag.identify.nuisance.knowledge import PASS_FOR_FAULTS, datum_name, knowledge_of
from ehadiag.model.parameters import DATA, parameter
from ehadiag.model.plant import plant_constants


def test_the_bundled_file_has_none():
    assert default_actuator().tolerance.names == ()
    assert not knowledge_of(default_actuator()).doubts
    assert knowledge_of(default_actuator()).explains_sound
    assert not knowledge_of(with_tolerance(default_actuator(), 0.05)).explains_sound


def test_all_data_of_the_model_can_have_one():
    own = Tolerance.__struct_fields__[1:]
    named = {item.name for item in DATA if item.name.startswith("datum_")}
    assert {datum_name(symbol) for symbol in own} == named | {"torque_motor_gain"}
    data = {*Servovalve.__struct_fields__, *Jack.__struct_fields__}
    assert set(own) <= data


def test_one_for_all_goes_to_the_data_in_which_units_differ():
    tolerance = with_tolerance(default_actuator(), 0.05).tolerance
    assert set(tolerance.names) == set(VARYING)
    assert Tolerance(all=0.05, KF=0.0, AS=0.02).of("KF") == 0.0
    assert set(Tolerance(all=0.05, KF=0.0, AS=0.02).names) == {*VARYING, "AS"} - {"KF"}


@pytest.mark.parametrize("line", ["all = 0.4", "all = -0.1", "FSS1 = 0.05", "KF = 'much'"])
def test_a_wrong_one_is_refused(tmp_path, line):
    bundled = resources.files("ehadiag").joinpath("data/actuator.toml").read_text("utf-8")
    file = tmp_path / "unit.toml"
    file.write_text(bundled.partition("[tolerance]")[0] + f"[tolerance]\n{line}\n")
    with pytest.raises(ConfigurationError, match="tolerance"):
        load_actuator(file)


def test_a_tolerance_bounds_the_datum_and_has_a_uniform_density():
    knowledge = knowledge_of(
        msgspec.structs.replace(default_actuator(), tolerance=Tolerance(KF=0.06))
    )
    (item,) = knowledge.free
    assert (item.name, item.lower, item.upper) == ("datum_KF", -0.06, 0.06)
    assert knowledge.known["datum_KF"].std == pytest.approx(0.06 / 3**0.5)


@pytest.mark.parametrize("symbol", PASS_FOR_FAULTS)
def test_a_datum_that_passes_for_a_fault_counts_in_the_interval(symbol):
    actuator = msgspec.structs.replace(default_actuator(), tolerance=Tolerance(**{symbol: 0.1}))
    knowledge = knowledge_of(actuator)
    fault = PASS_FOR_FAULTS[symbol]
    assert knowledge.free == ()
    base = plant_constants(actuator)
    spread = knowledge.spread([parameter(fault)], {fault: 0.3}, base)[0, 0] ** 0.5
    # The severity that does what the datum's deviation does, from the scales of PHY-13 to 15.
    off = 0.1 / 3**0.5
    expected = {
        "GQF": off * (1.0 - 0.8 * 0.3) / 0.8,
        "FSS0": off * base.FSS * (1.0 - 0.3) / (base.FSS1 - base.FSS),
        "FDJ0": off * base.FDJ * (1.0 - 0.3) / (base.FDJ1 - base.FDJ),
    }[symbol]
    assert spread == pytest.approx(expected, rel=1e-4)
