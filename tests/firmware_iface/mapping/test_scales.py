"""How finely, and how far, the computer behind a mapping sees its actuator."""

from __future__ import annotations

import msgspec
import pytest
from other_valve import write_rig

from ehadiag.core.actuator import default_actuator, load_actuator
from ehadiag.core.channels import SCALES
from ehadiag.core.errors import ConfigurationError
from firmware_iface.mapping.bus_map import default_map, load_map
from firmware_iface.mapping.scales import scales_of

PLAIN = 'signal = "SpoolPosition" }'


@pytest.fixture
def rig(tmp_path):
    """Folder of the rig with the other valve."""
    return write_rig(tmp_path)


def stated(rig, words: str):
    """The rig's mapping with more said of the spool's converter."""
    path = rig / "rig.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(PLAIN, f'signal = "SpoolPosition", {words} }}'), encoding="utf-8")
    return load_map(path)


def test_default_bus_has_the_default_scales():
    assert scales_of(default_map(), default_actuator()) == SCALES


def test_default_mapping_says_nothing_of_converters():
    assert default_map().stated == ()
    roles = msgspec.to_builtins(default_map())["messages"]["ServoTelemetry"]["roles"]
    assert all("stated" not in role for role in roles)


def test_scales_of_a_rig_are_those_of_its_files(rig):
    scales = scales_of(load_map(rig / "rig.toml"), load_actuator(rig / "actuator.toml"))
    assert (scales.current_step, scales.position_step) == pytest.approx((1e-5, 5e-6))
    assert scales.channels.current.lsb == pytest.approx(96e-3 / 4096)
    assert scales.channels.position.lsb == pytest.approx(120e-3 / 65536)


def test_mapping_states_a_converter_in_the_signals_unit(rig):
    bus = stated(rig, 'unit = "um", scale = 1000.0, range = [-900.0, 900.0], resolution = 0.5')
    said = bus.stated
    assert said[1] == pytest.approx((-0.9e-3, 0.9e-3, 0.5e-6))
    assert said[0] is said[2] is said[3] is None
    channel = scales_of(bus, load_actuator(rig / "actuator.toml")).channels.spool
    assert (channel.full_scale, channel.lsb) == pytest.approx((0.9e-3, 0.5e-6))


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("range = [1.0, -1.0]", r"range must be \[least, most\]"),
        ("range = [-1.0, 1.0], resolution = 0.5", "resolution"),
        ("resolution = 0.0", "resolution"),
        ("range = [1.0]", "range"),
    ],
)
def test_a_statement_that_cannot_be_is_refused(rig, words, why):
    with pytest.raises(ConfigurationError, match=why):
        stated(rig, words)


def test_a_signal_too_short_for_its_converter_is_named(rig):
    with pytest.raises(ConfigurationError, match=r"ServoCurrent carries -12 .* reaches ±48 mA"):
        scales_of(default_map(), load_actuator(rig / "actuator.toml"))


def test_a_command_too_short_for_the_rated_current_is_named(rig):
    path = rig / "rig.dbc"
    text = path.read_text(encoding="utf-8").replace("(0.01,0) [-327.68", "(0.001,0) [-32.768")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="rated current of actuator 'reference-31' is 40"):
        scales_of(load_map(rig / "rig.toml"), load_actuator(rig / "actuator.toml"))


def test_an_assumed_range_ends_where_the_bus_does(tmp_path):
    rig = write_rig(tmp_path, converters="")
    channels = scales_of(load_map(rig / "rig.toml"), load_actuator(rig / "actuator.toml")).channels
    assert channels.current.full_scale == pytest.approx(48e-3)
    assert channels.spool.full_scale == pytest.approx(1e-3)
