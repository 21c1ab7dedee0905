"""Encoding of frames, byte for byte as in the reference recordings and as cantools reads them.

What a computer says it has found itself: put together live and from a log, of the right test.
"""

from __future__ import annotations

from importlib import resources

import cantools.database
import numpy as np
import pytest
from bus_synth import START, make_truth, play, recordings
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from onboard_frames import SEVERITIES, findings, progress
from places import ROOT

from ehadiag import CommandMode, ConfigurationError
from firmware_iface.bus_map import default_map, load_map
from firmware_iface.codec import Encoder, decode
from firmware_iface.live_decode import LiveDecoder, OnboardReader
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import CHANNELS, BitReason, BitState, OnboardState
from firmware_iface.transport.frames import FrameTable

KEYS = ("current", "spool", "pressure", "position")
CODES = st.tuples(*(st.integers(0, 4095),) * 4)


@pytest.fixture(scope="module")
def dbc():
    path = resources.files("firmware_iface").joinpath("data/eha_fcc.dbc")
    return cantools.database.load_string(path.read_text(), "dbc")


@pytest.mark.parametrize("name", ["paper-open-1.blf", "paper-closed-2.blf", "hot-worn-closed.asc"])
def test_re_encodes_a_reference_recording_byte_for_byte(encoder, bus_map, logs, name):
    table = read_frames(logs / name)
    decoded = decode(table, bus_map).messages
    telemetry, command = decoded["ServoTelemetry"], decoded["ServoCommand"]
    codes = np.stack(
        [
            channel.encode(telemetry.values[f"channels.{key}"])
            for channel, key in zip(CHANNELS, KEYS, strict=True)
        ],
        axis=1,
    )
    built = {}
    for index, row in enumerate(telemetry.row):
        (frame,) = encoder.telemetry(codes[index], 0, int(telemetry.counter[index]))
        built[int(row)] = frame
    for index, row in enumerate(command.row):
        mode = CommandMode(int(command.values["command.mode"][index]))
        value = command.values[f"command.{mode.name.lower()}"][index]
        test_id = int(command.values["command.test_id"][index])
        (built[int(row)],) = encoder.command(mode, value, test_id, 0, int(command.counter[index]))
    for index, row in enumerate(decoded["BitStatus"].row):
        field = {key: item[index] for key, item in decoded["BitStatus"].values.items()}
        (built[int(row)],) = encoder.status(
            int(field["status.state"]),
            int(field["status.reason"]),
            int(field["status.test_id"]),
            field["status.elapsed"],
            int(field["status.serial"]),
            0,
        )
    environment = decoded["Environment"]
    for index, row in enumerate(environment.row):
        values = [
            environment.values[f"environment.{key}"][index]
            for key in ("supply_pressure", "return_pressure", "oil_temperature")
        ]
        (built[int(row)],) = encoder.environment(*values, 0)
    assert len(built) == len(table)
    for row, frame in built.items():
        assert (frame.can_id, frame.data) == (table.can_id[row], table.data[row].tobytes())


@given(CODES, st.integers(0, 1000))
def test_codes_survive_exactly(bus_map, shared, codes, counter):
    (frame,) = shared.telemetry(codes, 5, counter)
    item = decode(FrameTable.from_frames([frame]), bus_map).messages["ServoTelemetry"]
    for channel, key, code in zip(CHANNELS, KEYS, codes, strict=True):
        value = item.values[f"channels.{key}"]
        assert channel.encode(value)[0] == code
        assert value[0] == pytest.approx(channel.decode(np.array([code]))[0], rel=1e-12, abs=1e-18)
    assert item.counter.tolist() == [counter % 256]
    live = LiveDecoder(bus_map).decode(frame)
    assert [getattr(live, key) for key in KEYS] == [item.values[f"channels.{k}"][0] for k in KEYS]


@pytest.fixture(scope="module")
def shared(bus_map):
    return Encoder(bus_map)


def test_counters_go_on_by_themselves_and_wrap(encoder):
    data = [encoder.environment(1e6, 1e5, 20.0, 0)[0].data[6] for _ in range(258)]
    assert data == [*range(256), 0, 1]
    assert encoder.status(BitState.IDLE, 0, 0, 0.0, 1, 0)[0].data[6] == 0


def test_a_given_counter_sets_the_next(encoder):
    encoder.telemetry((0, 0, 0, 0), 0, 255)
    assert encoder.telemetry((0, 0, 0, 0), 0)[0].data[6] == 0


def test_cantools_reads_the_frames(encoder, dbc):
    (frame,) = encoder.command(CommandMode.POSITION, -0.0123, 2, 7)
    assert dbc.decode_message(frame.can_id, frame.data, decode_choices=False) == {
        "PositionCommand": pytest.approx(-12.3),
        "CurrentCommand": 0,
        "CommandMode": 2,
        "CommandTestId": 2,
        "CommandCounter": 0,
        "CommandCrc8": frame.data[7],
    }
    (frame,) = encoder.status(BitState.REFUSED, BitReason.NOT_CENTRED, 9, 1.234, 4321, 7)
    status = dbc.decode_message(frame.can_id, frame.data)
    assert (str(status["BitState"]), str(status["BitReason"])) == ("Refused", "NotCentred")
    assert (status["ElapsedTime"], status["ActuatorSerial"]) == (1234, 4321)
    (frame,) = encoder.request("abort", 2)
    request = dbc.decode_message(frame.can_id, frame.data)
    assert (str(request["RequestCode"]), request["RequestTestId"]) == ("Abort", 2)


def test_values_beyond_the_signal_are_held_at_its_end(encoder, dbc):
    (frame,) = encoder.command(CommandMode.CURRENT, 1.0, 1, 0)
    assert dbc.decode_message(frame.can_id, frame.data)["CurrentCommand"] == pytest.approx(16.3835)
    (frame,) = encoder.command(CommandMode.CURRENT, -1.0, 1, 0)
    assert dbc.decode_message(frame.can_id, frame.data)["CurrentCommand"] == pytest.approx(-16.384)


def test_unknown_request_is_one_line(encoder):
    with pytest.raises(ConfigurationError, match="no request code 'stop'"):
        encoder.request("stop", 1)


BEFORE = "BO_ 528 OnboardVerdict"
DATA = ROOT / "firmware_iface" / "data"
NOTHING, RECORDING, IDENTIFYING, DONE, GIVEN_UP = OnboardState


@pytest.fixture
def reader():
    return OnboardReader(default_map())


def hear(reader, *frames):
    for frame in frames:
        reader.take(frame)


def test_a_result_is_whole_with_its_last_severity(reader):
    hear(reader, progress(DONE, 2, 20, 442), *findings()[:2])
    assert reader.result is None
    hear(reader, findings()[2])
    found = reader.result
    assert (found.test_id, found.verdict, found.runs) == (2, 20, 442)
    for name, (value, std) in SEVERITIES.items():
        assert found.severities[name] == pytest.approx(value, abs=1e-9)
        assert found.std[name] == pytest.approx(std, abs=1e-9)


def test_severities_count_only_behind_the_word_that_it_is_done(reader):
    hear(reader, *findings())
    assert reader.result is None
    hear(reader, progress(IDENTIFYING), *findings())
    assert reader.result is None


@pytest.mark.parametrize("state", [NOTHING, RECORDING, IDENTIFYING, GIVEN_UP])
def test_a_result_goes_with_the_next_state(reader, state):
    hear(reader, progress(DONE), *findings(), progress(state))
    assert reader.result is None
    assert reader.awaited is (state in (RECORDING, IDENTIFYING))


def test_what_is_awaited(reader):
    assert not reader.awaited
    hear(reader, progress(DONE))
    assert reader.awaited
    hear(reader, *findings())
    assert not reader.awaited


def test_a_damaged_frame_counts_for_nothing(reader):
    first, *rest = findings()
    broken = replace(first, data=bytes([first.data[0] ^ 1]) + first.data[1:])
    hear(reader, progress(DONE), broken, *rest)
    assert reader.result is None
    hear(reader, replace(first, error=True), replace(first, remote=True, data=b""))
    assert reader.result is None


@pytest.mark.parametrize(("test_id", "ours"), [(1, True), (2, False), (None, True)])
def test_a_result_is_that_of_its_test(reader, test_id, ours):
    hear(reader, progress(DONE, 1), *findings())
    assert (reader.of_test(test_id) is not None) is ours


def test_each_recording_has_what_was_found_after_it(encoder, bus_map):
    first = play(encoder, make_truth(300), idle_before=200, idle_after=200)
    second = play(
        encoder, make_truth(300, 2), idle_before=200, idle_after=200, test_id=2, counter=13 + 700,
        start_ns=START + 700_000_000,
    )  # fmt: skip
    found = dict.fromkeys(SEVERITIES, (0.5, 0.01))
    frames = [
        progress(DONE, 2), *findings(found), *first,
        progress(DONE, 1, 10), *findings(), progress(NOTHING, 1), *second,
    ]  # fmt: skip
    one, two = recordings(frames, bus_map)
    assert one.onboard.verdict == 10
    assert one.onboard.severities["FSS"] == pytest.approx(0.6, abs=1e-9)
    assert two.onboard is None
    one, two = recordings([*frames, progress(DONE, 1), *findings()], bus_map)
    assert two.onboard is None, "of another test"
    one, two = recordings([*frames, progress(DONE, 2), *findings(found)], bus_map)
    assert two.onboard.severities["FSS"] == pytest.approx(0.5, abs=1e-9)


def test_they_are_neither_foreign_nor_counted(encoder, bus_map):
    frames = play(encoder, make_truth(300), idle_before=50, idle_after=50)
    (plain,) = recordings(frames, bus_map)
    (told,) = recordings([*frames, progress(DONE), *findings()], bus_map)
    assert told.quality == plain.quality


def test_a_dbc_without_these_messages_is_still_the_default_bus(tmp_path):
    text = (DATA / "eha_fcc.dbc").read_text()
    kept = [
        part
        for part in text.split("\n\n")
        if not part.startswith("BO_ 52") and "BO_ 53" not in part
    ]
    assert BEFORE not in "\n\n".join(kept[:-1])
    path = tmp_path / "older.dbc"
    lines = "\n\n".join(kept).splitlines()
    path.write_text(
        "\n".join(x for x in lines if not any(f" {n} " in x for n in (528, 529, 530, 531)))
    )
    bus_map = default_map(path)
    assert bus_map.onboard == ()
    assert bus_map.messages.keys() == default_map().messages.keys()


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('FSS = { message = "OnboardFSS", signal = "SeverityFSS" }\n', "onboard.FSS is needed"),
        ('state = { message = "OnboardVerdict", signal = "OnboardState" }\n', "onboard.state is"),
    ],
)
def test_half_a_finding_is_refused(tmp_path, line, why):
    text = (DATA / "eha_fcc.toml").read_text()
    assert line in text
    (tmp_path / "map.toml").write_text(text.replace(line, ""))
    (tmp_path / "eha_fcc.dbc").write_bytes((DATA / "eha_fcc.dbc").read_bytes())
    with pytest.raises(ConfigurationError, match=why):
        load_map(tmp_path / "map.toml")


def test_a_message_of_two_minds_is_refused(tmp_path):
    text = (DATA / "eha_fcc.toml").read_text()
    old = 'runs = { message = "OnboardVerdict", signal = "OnboardRuns" }'
    new = 'runs = { message = "BitStatus", signal = "ElapsedTime" }'
    (tmp_path / "map.toml").write_text(text.replace(old, new))
    (tmp_path / "eha_fcc.dbc").write_bytes((DATA / "eha_fcc.dbc").read_bytes())
    with pytest.raises(ConfigurationError, match="BitStatus carries onboard findings and other"):
        load_map(tmp_path / "map.toml")
