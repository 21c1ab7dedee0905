"""Framing of the serial link on byte streams of any shape, whole or damaged."""

from __future__ import annotations

import binascii
import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag import ConfigurationError
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.serial_link import MAX_CODED_BYTES, Framer, packet_of

frames = st.builds(
    lambda can_id, us, data: Frame(us * 1000, can_id, data),
    st.integers(0, 0x7FF),
    st.integers(0, 2**31 - 1),
    st.binary(min_size=8, max_size=8),
)
damage = st.binary(max_size=60)


def test_the_packet_is_what_the_contract_says() -> None:
    frame = Frame(time_ns=0x01020304 * 1000, can_id=0x110, data=bytes(range(1, 9)))
    body = struct.pack("<HI", 0x110, 0x01020304) + bytes(range(1, 9))
    crc = struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))
    # No zero inside: COBS then is one length byte and the data as they are.
    assert 0 not in body + crc
    assert packet_of(frame) == bytes([17]) + body + crc + b"\0"


def test_the_check_sum_is_crc_16_ccitt_false() -> None:
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1


@given(st.lists(frames, max_size=20), st.lists(st.integers(1, 40), max_size=40))
def test_frames_come_through_however_the_bytes_are_cut(sent: list[Frame], cuts: list[int]) -> None:
    stream = b"".join(packet_of(frame) for frame in sent)
    framer, got = Framer(), []
    for cut in cuts:
        got += framer.feed(stream[:cut])
        stream = stream[cut:]
    got += framer.feed(stream)
    assert [(item.can_id, item.data) for item in got] == [(x.can_id, x.data) for x in sent]
    assert framer.bad == 0
    if sent:
        assert got[0].time_ns == sent[0].time_ns
        apart = [(b.time_ns - a.time_ns) % (2**32 * 1000) for a, b in itertools.pairwise(got)]
        assert apart == [
            (b.time_ns - a.time_ns) % (2**32 * 1000) for a, b in itertools.pairwise(sent)
        ]


@given(st.lists(damage, max_size=8), frames)
def test_after_any_damage_the_next_whole_packet_is_found(noise: list[bytes], last: Frame) -> None:
    framer = Framer()
    for piece in noise:
        framer.feed(piece)
    framer.feed(b"\0")
    got = framer.feed(packet_of(last))
    assert (got[-1].can_id, got[-1].data) == (last.can_id, last.data)


@given(frames, st.integers(0, 16), st.integers(0, 7))
def test_no_single_bit_flip_gets_through(frame: Frame, at: int, bit: int) -> None:
    packet = bytearray(packet_of(frame))
    packet[at] ^= 1 << bit
    framer = Framer()
    assert framer.feed(b"\0" + bytes(packet) + b"\0") == []
    assert framer.bad >= 1


@given(st.binary(max_size=3000))
def test_memory_stays_bounded_and_nothing_raises(noise: bytes) -> None:
    framer = Framer()
    framer.feed(noise.replace(b"\0", b"\1"))
    assert len(framer._partial) <= MAX_CODED_BYTES
    assert framer.bytes_seen == len(noise)


def test_an_endless_packet_counts_once_as_damage() -> None:
    framer = Framer()
    for _ in range(100):
        framer.feed(b"\x05" * 100)
    assert framer.bad == 1
    good = Frame(0, 0x110, bytes(8))
    assert [x.can_id for x in framer.feed(b"\0" + packet_of(good))] == [0x110]
    assert framer.bad == 1


def test_time_runs_on_where_the_field_wraps() -> None:
    step_us = 2**30
    framer, times = Framer(), []
    for k in range(9):
        times += [f.time_ns for f in framer.feed(packet_of(Frame(k * step_us * 1000, 1, bytes(8))))]
    assert times == [k * step_us * 1000 for k in range(9)]


def test_time_may_step_back_a_little() -> None:
    framer = Framer()
    stream = [packet_of(Frame(us * 1000, 1, bytes(8))) for us in (5000, 4000, 6000)]
    assert [f.time_ns // 1000 for f in framer.feed(b"".join(stream))] == [5000, 4000, 6000]


def test_an_identifier_beyond_11_bits_is_damage() -> None:
    from cobs import cobs

    body = struct.pack("<HI", 0x800, 0) + bytes(8)
    coded = cobs.encode(body + struct.pack("<H", binascii.crc_hqx(body, 0xFFFF)))
    framer = Framer()
    assert framer.feed(coded + b"\0") == []
    assert framer.bad == 1


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0, 0x12345, bytes(8), extended=True),
        Frame(0, 0x123, bytes(7)),
        Frame(0, 0x123, bytes(12), fd=True),
        Frame(0, 0x123, b"", remote=True),
        Frame(0, 0x123, bytes(8), error=True),
    ],
)
def test_what_the_link_cannot_carry_is_refused(frame: Frame) -> None:
    with pytest.raises(ConfigurationError, match="classic 8-byte"):
        packet_of(frame)
