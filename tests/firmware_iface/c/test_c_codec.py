"""The C codec against the Python one, byte for byte."""

from __future__ import annotations

import binascii
import random
import re
import shutil
import subprocess
import sys
from ctypes import c_double, c_int16, c_uint8, c_uint16
from pathlib import Path
from typing import Any

import c_side
import pytest
from c_side import SOURCES
from hypothesis import assume, example, given
from hypothesis import strategies as st

from ehadiag import CommandMode, bundled_tests
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder, decode
from firmware_iface.live_decode import BitRequest, BitStatus, LiveDecoder
from firmware_iface.protection import crc8
from firmware_iface.recording import BitReason, BitState
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.serial_link import Framer, packet_of

BYTE = st.integers(0, 255)
CODE = st.integers(0, 4095)
WORD = st.integers(-(1 << 15), (1 << 15) - 1)
PAYLOAD = st.binary(min_size=8, max_size=8)
BUS = default_map()
ENCODER = Encoder(BUS)
"""Only for messages whose counter is given or set aside."""


def counted(encoder_frame: Frame, counter: int) -> bytes:
    """The same frame with another counter."""
    data = encoder_frame.data[:6] + bytes((counter,))
    header = encoder_frame.can_id.to_bytes(2, "little")
    return data + bytes((crc8(header + data),))


@given(codes=st.tuples(CODE, CODE, CODE, CODE), counter=BYTE)
@example(codes=(0, 0, 0, 0), counter=255)
@example(codes=(4095, 4095, 4095, 4095), counter=0)
def test_telemetry(library: Any, codes: tuple[int, ...], counter: int) -> None:
    wanted = ENCODER.telemetry(codes, 0, counter)[0]
    frame, following = c_side.pack(library, "telemetry", (c_uint16 * 4)(*codes), counter=counter)
    assert frame.content == (wanted.can_id, wanted.data)
    assert following == (counter + 1) % 256
    raw = c_side.unpack(library, "telemetry", wanted)
    assert (raw.current, raw.spool, raw.pressure, raw.position) == codes
    assert raw.counter == counter


@given(mode=st.sampled_from(CommandMode), value=WORD, test_id=BYTE, counter=BYTE)
def test_command(library: Any, mode: CommandMode, value: int, test_id: int, counter: int) -> None:
    si = value * (0.5e-6 if mode is CommandMode.CURRENT else 2e-6)
    wanted = ENCODER.command(mode, si, test_id, 0, counter)[0]
    frame, _ = c_side.pack(
        library, "command", c_uint8(mode), c_int16(value), c_uint8(test_id), counter=counter
    )
    assert frame.content == (wanted.can_id, wanted.data)
    raw = c_side.unpack(library, "command", wanted)
    other = raw.position if mode is CommandMode.CURRENT else raw.current
    ours = raw.current if mode is CommandMode.CURRENT else raw.position
    assert (raw.mode, raw.test_id, ours, other) == (mode, test_id, value, 0)


@given(supply=CODE, back=CODE, oil=CODE, counter=BYTE)
def test_environment(library: Any, supply: int, back: int, oil: int, counter: int) -> None:
    item = Encoder(BUS).environment(supply * 1e4, back * 1e4, oil * 0.1 - 100.0, 0)[0]
    frame, _ = c_side.pack(
        library, "environment", *map(c_uint16, (supply, back, oil)), counter=counter
    )
    assert frame.content == (item.can_id, counted(item, counter))
    raw = c_side.unpack(library, "environment", item)
    assert (raw.supply, raw.ret, raw.oil) == (supply, back, oil)


@given(
    state=st.sampled_from(BitState),
    reason=st.sampled_from(BitReason),
    test_id=BYTE,
    elapsed=st.integers(0, 65535),
    serial=st.integers(0, 65535),
    counter=BYTE,
)
def test_status(
    library: Any,
    state: BitState,
    reason: BitReason,
    test_id: int,
    elapsed: int,
    serial: int,
    counter: int,
) -> None:
    item = Encoder(BUS).status(state, reason, test_id, elapsed / 1000, serial, 0)[0]
    numbers = (c_uint8(state), c_uint8(reason), c_uint8(test_id), c_uint16(elapsed))
    frame, _ = c_side.pack(library, "status", *numbers, c_uint16(serial), counter=counter)
    assert frame.content == (item.can_id, counted(item, counter))
    raw = c_side.unpack(library, "status", item)
    assert (raw.state, raw.reason, raw.test_id) == (state, reason, test_id)
    assert (raw.elapsed, raw.serial) == (elapsed, serial)
    heard = LiveDecoder(BUS).decode(Frame(0, frame.id, bytes(frame.data)))
    assert isinstance(heard, BitStatus)
    assert heard == BitStatus(state, reason, test_id, heard.elapsed, serial)
    assert round(heard.elapsed * 1000) == elapsed


@given(code=st.integers(0, 15), test_id=BYTE, counter=BYTE)
def test_request(library: Any, code: int, test_id: int, counter: int) -> None:
    item = Encoder(BUS).request(code, test_id)[0]
    frame, _ = c_side.pack(library, "request", c_uint8(code), c_uint8(test_id), counter=counter)
    assert frame.content == (item.can_id, counted(item, counter))
    raw = c_side.unpack(library, "request", item)
    assert (raw.code, raw.test_id) == (code, test_id)
    heard = LiveDecoder(BUS).decode(Frame(0, frame.id, bytes(frame.data)))
    names = {1: "start", 2: "abort"}
    assert heard == BitRequest(names.get(code, ""), test_id)


PHYSICAL = {
    "telemetry": (
        0x110,
        {
            "channels.current": ("servo_telemetry_servo_current", "current", 1e-3),
            "channels.spool": ("servo_telemetry_spool_position", "spool", 1e-3),
            "channels.pressure": ("servo_telemetry_diff_pressure", "pressure", 1e6),
            "channels.position": ("servo_telemetry_jack_position", "position", 1e-3),
        },
    ),
    "command": (
        0x111,
        {
            "command.position": ("servo_command_position_command", "position", 1e-3),
            "command.current": ("servo_command_current_command", "current", 1e-3),
        },
    ),
    "environment": (
        0x120,
        {
            "environment.supply_pressure": ("environment_supply_pressure", "supply", 1e6),
            "environment.return_pressure": ("environment_return_pressure", "ret", 1e6),
            "environment.oil_temperature": ("environment_oil_temperature", "oil", 1.0),
        },
    ),
}


@pytest.mark.parametrize("message", PHYSICAL)
@given(payload=PAYLOAD)
def test_any_payload_means_the_same_physical_values(
    library: Any, message: str, payload: bytes
) -> None:
    can_id, roles = PHYSICAL[message]
    frame = Frame(0, can_id, counted(Frame(0, can_id, payload), payload[6]))
    raw = c_side.unpack(library, message, frame)
    decoded = decode(FrameTable.from_frames([frame]), BUS)
    item = next(item for item in decoded.messages.values() if item.message.can_id == can_id)
    assert len(item.row) == 1
    for role, (signal, field, unit) in roles.items():
        convert = getattr(library, f"eha_fcc_{signal}_decode")
        convert.restype = c_double
        number = c_int16 if message == "command" else c_uint16
        value = convert(number(getattr(raw, field))) * unit
        assert item.values[role][0] == pytest.approx(value, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("message", PHYSICAL)
@given(share=st.floats(0.0, 1.0))
def test_physical_values_round_to_the_same_number(library: Any, message: str, share: float) -> None:
    database = {item.can_id: item for item in BUS.messages.values()}
    can_id, roles = PHYSICAL[message]
    for role in database[can_id].roles:
        if role.name not in roles:
            continue
        name = roles[role.name][0]
        layout = role.signal
        assert layout.minimum is not None
        assert layout.maximum is not None
        value = layout.minimum + share * (layout.maximum - layout.minimum)
        number = (value - layout.offset) / layout.scale
        assume(abs(number % 1 - 0.5) > 1e-6)  # halves: to even there, away from zero here
        convert = getattr(library, f"eha_fcc_{name}_encode")
        convert.restype = c_int16 if layout.signed else c_uint16
        assert convert(c_double(value)) == round(number)


@pytest.mark.parametrize("message", ["telemetry", "command", "environment", "request", "status"])
def test_every_flipped_bit_and_every_other_identifier_is_refused(
    library: Any, message: str
) -> None:
    ids = {"telemetry": 0x110, "command": 0x111, "environment": 0x120, "request": 0x200}
    can_id = ids.get(message, 0x201)
    payload = random.Random(4).randbytes(8)
    good = Frame(0, can_id, counted(Frame(0, can_id, payload), payload[6]))
    assert c_side.unpack(library, message, good) is not None
    for bit in range(64):
        data = bytearray(good.data)
        data[bit // 8] ^= 1 << bit % 8
        assert c_side.unpack(library, message, Frame(0, can_id, bytes(data))) is None
    for other in {*range(0x10, 0x210, 0x10), 0x110, 0x111, 0x120, 0x200, 0x201} - {can_id}:
        masked = Frame(0, other, good.data)
        assert c_side.unpack(library, message, masked) is None
        sealed = Frame(0, other, counted(masked, payload[6]))
        assert c_side.unpack(library, message, sealed) is None


@given(data=st.binary(max_size=40))
@example(data=b"123456789")
def test_crc_16(library: Any, data: bytes) -> None:
    assert library.fcc_crc16(data, len(data)) == binascii.crc_hqx(data, 0xFFFF)


@given(can_id=st.integers(0, 0x7FF), payload=PAYLOAD, stamp=st.integers(0, 2**32 - 1))
@example(can_id=0, payload=bytes(8), stamp=0)
@example(can_id=0x7FF, payload=b"\xff" * 8, stamp=2**32 - 1)
def test_packets_of_the_serial_link(library: Any, can_id: int, payload: bytes, stamp: int) -> None:
    frame = Frame(stamp * 1000, can_id, payload)
    packet = c_side.link_packet(library, frame, stamp)
    assert packet == packet_of(frame)
    assert c_side.Link(library).feed(packet) == [(can_id, payload, stamp)]


PACKET = st.builds(
    lambda can_id, payload: packet_of(Frame(0, can_id, payload)), st.integers(0, 0x7FF), PAYLOAD
)


@given(pieces=st.lists(st.one_of(PACKET, st.binary(max_size=40)), max_size=12), data=st.data())
def test_a_damaged_line_gives_the_same_packets_on_both_sides(
    library: Any, pieces: list[bytes], data: st.DataObject
) -> None:
    stream = bytearray(b"".join(pieces))
    for _ in range(data.draw(st.integers(0, 3))):
        if stream:
            stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(BYTE)
    stream += b"\0"
    ours, theirs = Framer(), c_side.Link(library)
    frames = ours.feed(bytes(stream))
    assert [(item.can_id, item.data) for item in frames] == [
        item[:2] for item in theirs.feed(bytes(stream))
    ]
    assert theirs.dropped == ours.bad


@pytest.mark.parametrize("name", ["open", "closed"])
def test_stored_tests_are_those_of_the_contract(library: Any, name: str) -> None:
    test = bundled_tests()[name]
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    stored = library.fcc_test_find(c_uint8(test.id))
    assert library.fcc_test_ticks(stored) == test.ticks
    at = slice(0, 2) if test.closed_loop else slice(2, 4)
    wanted = [
        int.from_bytes(ENCODER.command(mode, value, 1, 0)[0].data[at], "little", signed=True)
        for value in test.command().tolist()
    ]
    assert [library.fcc_test_command(stored, tick) for tick in range(test.ticks)] == wanted
    assert library.fcc_test_find(c_uint8(0)) is None
    assert library.fcc_test_find(c_uint8(3)) is None


def test_the_generated_code_is_that_of_the_dbc(tmp_path: Path) -> None:
    import cantools

    committed = (SOURCES / "generated" / "eha_fcc.h").read_text(encoding="utf-8")
    made_by = re.search(r"cantools version ([\d.]+)\.\n", committed)
    assert made_by is not None
    if made_by[1] != cantools.__version__:
        pytest.skip(f"generated by cantools {made_by[1]}, here is {cantools.__version__}")
    if shutil.which("make") is None:
        pytest.skip("no make on this machine")
    copy = tmp_path / "c"
    shutil.copytree(SOURCES, copy, ignore=shutil.ignore_patterns("build"))
    shutil.copytree(SOURCES.parent / "data", tmp_path / "data")
    (copy / "generated" / "eha_fcc.h").unlink()
    (copy / "generated" / "eha_fcc.c").unlink()
    subprocess.run(
        ["make", "-C", str(copy), "generate", f"PYTHON={sys.executable}"],
        check=True,
        capture_output=True,
    )
    for name in ("eha_fcc.h", "eha_fcc.c"):
        anew = (copy / "generated" / name).read_text(encoding="utf-8")
        assert anew == (SOURCES / "generated" / name).read_text(encoding="utf-8"), name
