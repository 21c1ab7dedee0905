"""Untrusted mappings and DBC files are checked, and refused in one line.

How finely, and how far, the computer behind a mapping sees its actuator. Extraction and packing of
signals against cantools, over random layouts.
"""

from __future__ import annotations

import contextlib
from importlib import resources
from pathlib import Path

import cantools.database
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from other_valve import write_rig

from ehadiag import (
    CommandMode,
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    default_actuator,
    load_actuator,
)
from ehadiag_sim.simulation import scales_of
from firmware_iface.bus_map import default_map, load_map, si_factor, signal_layout
from firmware_iface.dbc import SignalLayout, plain_message
from firmware_iface.recording import DEFAULT_SCALES, BitState

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
        ("BO_ 288 Environment", "BO_ 272 Environment", "have the same identifier"),
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
    assert scales_of(default_map(), default_actuator()) == DEFAULT_SCALES


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
    assert msgspec.structs.astuple(said[1]) == pytest.approx((-0.9e-3, 0.9e-3, 0.5e-6))
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


@st.composite
def messages(draw):
    """A DBC message of 1 … 64 bytes with one signal anywhere in it."""
    size = draw(st.sampled_from([1, 2, 3, 5, 7, 8, 12, 16, 64]))
    bits = 8 * size
    floating = draw(st.booleans()) and size >= 4
    length = (
        draw(st.sampled_from([n for n in (32, 64) if n <= bits]))
        if floating
        else draw(st.integers(1, min(64, bits)))
    )
    lead = draw(st.integers(0, bits - length))
    big = draw(st.booleans())
    signed = draw(st.booleans()) or floating
    start = 8 * (lead // 8) + 7 - lead % 8 if big else lead
    scale = draw(st.sampled_from(["1", "0.5", "-0.25", "3"]))
    offset = draw(st.sampled_from(["0", "-12", "7.5"]))
    order, sign = int(not big), "-" if signed else "+"
    text = (
        f'VERSION ""\nBS_:\nBU_: A\nBO_ 100 M: {size} A\n'
        f' SG_ S : {start}|{length}@{order}{sign} ({scale},{offset}) [0|0] "" A\n'
    )
    if floating:
        text += f"SIG_VALTYPE_ 100 S : {1 if length == 32 else 2};\n"
    return text, size


def parse(text):
    database = cantools.database.load_string(text, "dbc")
    (message,) = database.messages
    plain = plain_message(message)
    return message, signal_layout(plain.signals[-1], plain, "test")


@settings(max_examples=300)
@given(messages(), st.data())
def test_extraction_agrees_with_cantools(made, data):
    text, size = made
    message, layout = parse(text)
    rows = data.draw(st.lists(st.binary(min_size=size, max_size=size), min_size=1, max_size=4))
    width = 8 if size <= 8 else 64
    table = np.frombuffer(b"".join(row.ljust(width, b"\0") for row in rows), np.uint8)
    got = layout.physical(table.reshape(-1, width))
    if layout.length == 64 and not layout.signed:
        return  # wraps, as documented; no role is that wide
    for value, row in zip(got, rows, strict=True):
        expected = float(message.decode(row)["S"])
        assert value == pytest.approx(expected, rel=1e-12, nan_ok=True)


@given(st.integers(1, 63), st.booleans(), st.binary(min_size=8, max_size=8))
def test_unsigned_values_fill_their_range(length, big, row):
    start = 7 if big else 0
    layout = SignalLayout("S", start, length, big_endian=big)
    table = np.frombuffer(row, np.uint8).reshape(1, 8)
    word = int.from_bytes(row, "big" if big else "little")
    expected = word >> (64 - length) if big else word & ((1 << length) - 1)
    assert int(layout.raw(table)[0]) == expected


def test_presence_follows_nested_multiplexers():
    outer = SignalLayout("outer", 0, 4)
    inner = SignalLayout("inner", 4, 4, selectors=((outer, frozenset({1})),))
    leaf = SignalLayout(
        "leaf", 8, 8, selectors=((outer, frozenset({1})), (inner, frozenset({2, 3})))
    )
    table = np.zeros((4, 8), np.uint8)
    table[:, 0] = [0x21, 0x31, 0x41, 0x22]
    assert outer.present(table) is None
    assert leaf.present(table).tolist() == [True, True, False, False]
    assert inner.present(table).tolist() == [True, True, True, False]


def test_a_sister_unit_has_the_same_map_at_other_identifiers():
    own, sister = default_map(), default_map().shifted(0x20)
    for name, message in own.messages.items():
        assert sister.messages[name].can_id == message.can_id + 0x20
    assert sister.shifted(0x20) == sister
    assert sister.shifted(0) == own


def test_an_identifier_that_none_can_have_is_refused():
    with pytest.raises(ConfigurationError, match=r"identifier 0x8.*need 0 … 0x7ff"):
        default_map().shifted(0x700)
    with pytest.raises(ConfigurationError, match="need 0"):
        default_map().shifted(-0x700)
