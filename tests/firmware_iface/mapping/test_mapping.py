"""Untrusted mappings and DBC files are checked, and refused in one line."""

from __future__ import annotations

import contextlib
from importlib import resources
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ehadiag.core.errors import ConfigurationError, EhadiagError, InputOutputError
from ehadiag.core.recording import BitState, CommandMode
from firmware_iface.mapping.bus_map import default_map, load_map
from firmware_iface.mapping.units import si_factor

DATA = resources.files("firmware_iface").joinpath("data")
TOML = DATA.joinpath("eha_fcc.toml").read_text()
DBC = DATA.joinpath("eha_fcc.dbc").read_text()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "eha_fcc.dbc").write_text(DBC)
    return tmp_path


def load(folder, text=TOML, dbc=None):
    path = folder / "map.toml"
    path.write_text(text)
    if dbc is not None:
        (folder / "eha_fcc.dbc").write_text(dbc)
    return load_map(path)


def refused(folder, match, text=TOML, dbc=None):
    with pytest.raises(ConfigurationError, match=match) as error:
        load(folder, text, dbc)
    assert "\n" not in str(error.value)
    assert "map.toml" in str(error.value) or "eha_fcc.dbc" in str(error.value)


def test_default_map_is_the_contract():
    bus = default_map()
    assert {m.name: m.can_id for m in bus.messages.values()} == {
        "ServoTelemetry": 0x110,
        "ServoCommand": 0x111,
        "Environment": 0x120,
        "BitRequest": 0x200,
        "BitStatus": 0x201,
    }
    assert bus.tick_ns == 1_000_000
    assert bus.modes == {1: CommandMode.CURRENT, 2: CommandMode.POSITION}
    assert bus.states == {number: BitState(number) for number in range(6)}
    assert bus.requests == {"start": 1, "abort": 2}
    assert all(m.length == 8 and m.crc is not None for m in bus.messages.values())
    assert [m.name for m in bus.messages.values() if m.counts_ticks] == [
        "ServoTelemetry",
        "ServoCommand",
    ]
    assert bus.messages["Environment"].cycle_ns == 100_000_000


def test_the_default_files_load_as_a_users_own(folder):
    own, default = load(folder), default_map()
    assert own.messages == default.messages


def test_dbc_option_overrides_the_mapping(folder, tmp_path):
    (tmp_path / "other.dbc").write_text(DBC)
    path = folder / "map.toml"
    path.write_text(TOML.replace('"eha_fcc.dbc"', '"missing.dbc"'))
    assert load_map(path, tmp_path / "other.dbc").messages == default_map().messages
    with pytest.raises(InputOutputError, match=r"missing\.dbc"):
        load_map(path)


@pytest.mark.parametrize("path", ["/etc/passwd", "../eha_fcc.dbc", "a/../../b.dbc", "a\\\\b.dbc"])
def test_the_mapping_names_no_file_outside_its_folder(folder, path):
    refused(folder, "in the mapping's folder", TOML.replace('"eha_fcc.dbc"', f'"{path}"'))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("ServoCurrent", "Nothing", "no signal 'Nothing'"),
        ('"Environment"', '"Weather"', "no message 'Weather'"),
        ('signal = "DiffPressure"', 'signal = "JackPosition"', "unit 'mm' is no pressure"),
        ('signal = "ServoCurrent"', 'signal = "TelemetryCounter"', "gives no unit; add unit"),
        ('signal = "ServoCurrent"', 'signal = "ServoCurrent", scale = 0.0', "scale must lie"),
        ('signal = "ServoCurrent"', 'signal = "ServoCurrent", scale = nan', "finite"),
        ('signal = "ServoCurrent"', 'signal = "ServoCurrent", unit = "kg"', "unit 'kg' is no"),
        ('signal = "ServoCurrent"', 'signal = "ServoCurrent", sign = 1', "sign"),
        ("ehadiag.mapping/1", "ehadiag.mapping/9", "schema"),
        ("tick_ms = 1.0", "tick_ms = 0.0", "tick_ms"),
        ('counts = "ticks"', 'counts = "seconds"', "counts"),
        ('crc = "TelemetryCrc8"', 'crc = "ServoCurrent"', "must fill one byte"),
        ('counter = "TelemetryCounter"', 'counter = "Missing"', "no signal 'Missing'"),
        ("[protection.Environment]", "[protection.Weather]", "which no role uses"),
        ('mode = { message = "ServoCommand", signal = "CommandMode" }\n', "", "command.mode is"),
        ("[channels]", "[chanels]", "chanels"),
        ("spool = ", "# spool = ", "spool"),
    ],
)
def test_wrong_mapping(folder, old, new, match):
    assert old in TOML
    refused(folder, match, TOML.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("BO_ 272", "BO_ twelve", "not a valid DBC"),
        ("BO_ 288 Environment", "BO_ 272 Environment", "share an identifier"),
        ("BO_ 272 ServoTelemetry: 8", "BO_ 272 ServoTelemetry: 80", "longer than a CAN FD"),
        ("36|12@1+", "36|40@1+", "DBC"),
        ("24|12@1+ (0.01220703125,-25)", "24|12@1+ (0,-25)", "a scale outside"),
    ],
)
def test_wrong_dbc(folder, old, new, match):
    assert old in DBC
    refused(folder, match, dbc=DBC.replace(old, new, 1))


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_units_with_characters_of_their_own(folder, encoding):
    dbc = DBC.replace('"degC"', '"°C"').replace('"mA"', '"µA"')
    (folder / "eha_fcc.dbc").write_bytes(dbc.encode(encoding))
    (folder / "map.toml").write_text(TOML)
    bus = load_map(folder / "map.toml")
    assert bus.find("channels.current")[1].gain == pytest.approx(1e-6)
    assert bus.find("environment.oil_temperature")[1].gain == 1.0


def test_multiplexers_in_a_circle(folder):
    dbc = DBC.replace("SpoolPosition : 12", "SpoolPosition m1M : 12")
    dbc = dbc.replace("DiffPressure : 24", "DiffPressure m1M : 24")
    dbc += (
        "\nSG_MUL_VAL_ 272 SpoolPosition DiffPressure 1-1;\n"
        "SG_MUL_VAL_ 272 DiffPressure SpoolPosition 1-1;\n"
    )
    refused(folder, "circle|DBC", dbc=dbc)


def test_dbc_that_is_too_large(folder):
    refused(folder, "larger than", dbc=DBC + " " * (9 << 20))


@pytest.mark.parametrize(
    ("text", "dimension", "gain", "bias"),
    [
        ("mA", "current", 1e-3, 0.0),
        ("µA", "current", 1e-6, 0.0),
        (" mm ", "length", 1e-3, 0.0),
        ("inch", "length", 0.0254, 0.0),
        ("bar", "pressure", 1e5, 0.0),
        ("psi", "pressure", 6894.757293168361, 0.0),
        ("K", "temperature", 1.0, -273.15),
        ("°C", "temperature", 1.0, 0.0),
        ("msec", "time", 1e-3, 0.0),
    ],
)
def test_units(text, dimension, gain, bias):
    assert si_factor(text, dimension, "here") == pytest.approx((gain, bias))


def test_fahrenheit():
    gain, bias = si_factor("degF", "temperature", "here")
    assert gain * 212.0 + bias == pytest.approx(100.0)
    assert gain * 32.0 + bias == pytest.approx(0.0, abs=1e-12)


def test_scale_and_offset_come_before_the_unit(folder):
    line = 'signal = "DiffPressure", scale = -10.0, offset = 3.0, unit = "bar"'
    role = load(folder, TOML.replace('signal = "DiffPressure"', line)).find("channels.pressure")[1]
    assert role.gain == pytest.approx(-1e6)
    assert role.bias == pytest.approx(3e5)


@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_bytes_crash_the_loader(tmp_path, data):
    texts = {"map.toml": TOML, "eha_fcc.dbc": DBC}
    victim = data.draw(st.sampled_from(sorted(texts)))
    for name, text in texts.items():
        content = bytearray(text.encode())
        if name == victim:
            for _ in range(data.draw(st.integers(1, 4))):
                at = data.draw(st.integers(0, len(content)))
                new = data.draw(
                    st.one_of(
                        st.binary(max_size=6),
                        st.sampled_from(
                            [
                                b"-1",
                                b"99999999999",
                                b"1e400",
                                b"nan",
                                b'"',
                                b"@0-",
                                b"|64@",
                                b"m1 ",
                                b"M ",
                            ]
                        ),
                    )
                )
                content[at : at + data.draw(st.integers(0, 8))] = new
        (tmp_path / name).write_bytes(bytes(content))
    with contextlib.suppress(EhadiagError):
        bus = load_map(Path(tmp_path / "map.toml"))
        assert bus.find("channels.spool") is not None
