"""Extraction and packing of signals against cantools, over random layouts."""

from __future__ import annotations

import cantools.database
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_iface.mapping.bus_map import signal_layout
from firmware_iface.mapping.dbc import plain_message
from firmware_iface.mapping.signal_layout import SignalLayout


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
