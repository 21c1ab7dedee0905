"""Encoding of frames, byte for byte as in the reference recordings and as cantools reads them."""

from __future__ import annotations

from importlib import resources

import cantools.database
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.core.channels import CHANNELS
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.recording import BitReason, BitState, CommandMode
from firmware_iface.codec.decode import decode
from firmware_iface.codec.encode import Encoder
from firmware_iface.codec.live_decode import LiveDecoder
from firmware_iface.logs.reader import read_frames
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
