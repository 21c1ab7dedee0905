"""BLF files that no logger writes: short objects, and dates that a stamp cannot hold."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from places import LOGS

from firmware_iface.errors import InputOutputError
from firmware_iface.logs.blf import CONTAINER_HEADER, FILE_HEADER, OBJECT_HEADER
from firmware_iface.logs.reader import FrameLog, read_frames

START_YEAR_OFFSET = 40
"""Byte of the start's year in the file header."""


def an_object(kind: int, size: int, version: int = 1) -> bytes:
    return OBJECT_HEADER.pack(b"LOBJ", 32, version, size, kind).ljust(size, b"\0")


def blf(content: bytes) -> bytes:
    header = b"LOGG" + struct.pack("<L", FILE_HEADER.size)
    size = OBJECT_HEADER.size + CONTAINER_HEADER.size + len(content)
    container = OBJECT_HEADER.pack(b"LOBJ", 16, 1, size, 10) + CONTAINER_HEADER.pack(
        0, len(content)
    )
    return header.ljust(FILE_HEADER.size, b"\0") + container + content


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", [1, 73, 86, 100, 101])
@pytest.mark.parametrize("size", [16, 20, 24, 28, 31])
def test_a_short_object_is_damage(kind: int, size: int, version: int, tmp_path: Path) -> None:
    path = tmp_path / "short.blf"
    path.write_bytes(blf(an_object(kind, size, version)))
    with pytest.raises(InputOutputError, match="no frames in it"):
        read_frames(path)
    path.write_bytes(blf(an_object(1, 48) + an_object(kind, size, version)))
    reader = FrameLog(path)
    assert sum(map(len, reader)) == 1


@pytest.mark.parametrize("year", [0, 1, 1969, 2117, 2262, 2263, 9999, 65535])
def test_a_start_beyond_all_stamps_is_no_date(year: int, tmp_path: Path) -> None:
    content = bytearray((LOGS / "healthy-open.blf").read_bytes())
    (before,) = struct.unpack_from("<H", content, START_YEAR_OFFSET)
    assert 2000 < before < 2100
    struct.pack_into("<H", content, START_YEAR_OFFSET, year)
    path = tmp_path / "dated.blf"
    path.write_bytes(content)
    table = read_frames(path)
    assert 0 <= table.time_ns[0] <= table.time_ns[-1] < 3_600_000_000_000


def test_a_start_within_reach_is_the_date(tmp_path: Path) -> None:
    content = bytearray((LOGS / "healthy-open.blf").read_bytes())
    struct.pack_into("<H", content, START_YEAR_OFFSET, 2115)
    path = tmp_path / "dated.blf"
    path.write_bytes(content)
    assert read_frames(path).time_ns[0] > 4_500_000_000_000_000_000
