"""What is fuzzed: each target takes any bytes and must neither raise nor disagree with itself.

The errors that a user may see (`EhadiagError`) are answers, not findings. No target needs the
fuzzer: the tests play the kept inputs through these functions too.

What comes after the decoder is slow for its many numpy calls: a millisecond for an input that takes
a tenth of that to decode. While fuzzing it sees one input in `SHARE`, chosen by a check sum of the
input: the same input always takes the same path, and a change of one bit chooses anew.
"""

from __future__ import annotations

import contextlib
import gzip
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import IntFlag, auto
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from ehadiag.core.actuator import default_actuator, load_actuator
from firmware_iface import bus_map as busmap
from firmware_iface.alignment.align import assemble, windowed_recordings
from firmware_iface.bus_map import default_map, load_map
from firmware_iface.codec import Decoded, DecodedTable, decode
from firmware_iface.dbc import Dbc, parse_dbc
from firmware_iface.errors import EhadiagError
from firmware_iface.files import decode_toml
from firmware_iface.find_test import CandidateTests
from firmware_iface.live_decode import (
    SAMPLE_FIELDS,
    BitRequest,
    BitStatus,
    LiveDecoder,
    LiveTicks,
    Sample,
)
from firmware_iface.logs.blf import CONTAINER_HEADER, FILE_HEADER, OBJECT_HEADER
from firmware_iface.logs.log_files import Budget
from firmware_iface.logs.reader import read_frames, read_recordings
from firmware_iface.mapping_file import MappingFile
from firmware_iface.protection import crc8, intact
from firmware_iface.recording import CommandMode
from firmware_iface.signals.columns import load_columns
from firmware_iface.signals.recordings import Interpretation, choose_recording, recorded_tests
from firmware_iface.stored_test import bundled_tests, load_test
from firmware_iface.transport.frames import MAX_PAYLOAD, Frame, FrameTable
from firmware_iface.transport.serial_link import MAX_CODED_BYTES, Framer, packet_of

SHARE = 16
"""While fuzzing, inputs for one that goes all the way to recordings."""

RECORD = struct.Struct("<BBhB8s")
"""One frame of the target `frames`: flags, choice of identifier (its two highest bits: the adapter
channel), time step, length, payload."""
IDENTIFIERS = (0x110, 0x111, 0x120, 0x200, 0x201, 0x110, 0x111, 0x7FF)
KINDS = (".blf", ".asc", ".csv", ".trc", "container")
"""Logs by the first byte of an input; `container` is the inside of a sound BLF file."""
SIGNALS = (".log", ".csv", ".parquet", ".log.gz", ".csv.gz", "packed.csv.gz", "packed.log.gz")
"""Recordings by the first byte of an input; `packed`: the input is what a sound gzip file holds."""
CONFIGURATIONS: tuple[Callable[[str], object], ...] = (
    load_actuator,
    load_test,
    load_columns,
    load_map,
)
"""Readers by the first byte of an input."""
BUDGET = Budget(frames=100_000, size=1 << 20)
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""In memory where the system has such a folder: a file is written for every input."""
MOST_TICKS = 256
BUS = default_map()
CANDIDATES = CandidateTests(tuple(bundled_tests().values()), default_actuator().controller)
MEANING = Interpretation(BUS, None, CANDIDATES)


class Flags(IntFlag):
    """First byte of a frame: right check sum, extended identifier, ..., steps in milliseconds."""

    SEALED = auto()
    EXTENDED = auto()
    ERROR = auto()
    REMOTE = auto()
    SLOW = auto()


def target(name: str, share: int = 1) -> Callable[[bytes], None]:
    """Return the function that takes one input; one in `share` goes all the way."""

    def check(data: bytes) -> None:
        if data:
            TARGETS[name](data, zlib.crc32(data) % share == 0)

    return check


def _frames(data: bytes, all_the_way: bool) -> None:
    frames = _frames_of(data)
    decoder, live = LiveDecoder(BUS), LiveTicks(BUS, CommandMode.CURRENT)
    answers = [decoder.decode(frame) for frame in frames]
    given = [len(live.take(frame)) for frame in frames]
    if max(given, default=0) > MOST_TICKS:
        raise AssertionError("one frame completes more ticks than a turn of the counter has")
    samples = sum(_is_telemetry(frame) for frame in frames)
    if not live.lost <= sum(given) <= live.lost + samples:
        raise AssertionError("ticks were made up or kept back")
    if frames and all_the_way:
        table = FrameTable.from_frames(frames)
        _compare(answers, decode(table, BUS), len(set(table.channel.tolist()) - {0}) > 1)
        with contextlib.suppress(EhadiagError):
            assemble(table, BUS, "fuzz")


def _is_telemetry(frame: Frame) -> bool:
    """Whether a frame could complete a tick."""
    message = next(item for item in BUS.messages.values() if item.measures)
    mine = (frame.can_id, frame.extended) == (message.can_id, message.extended)
    return mine and not frame.error and not frame.remote and intact(message, frame.data)


def _compare(
    answers: list[BitStatus | Sample | BitRequest | None],
    decoded: DecodedTable,
    several_channels: bool,
) -> None:
    """One frame at a time and in columns, the same frames are good and say the same.

    But what is in conflict, or of another channel than the first, only the columns still have.
    """
    roles = {Sample: "channels.spool", BitRequest: "request.code", BitStatus: "status.state"}
    for kind, role in roles.items():
        found = BUS.find(role)
        if found is None:
            raise AssertionError(f"the default bus has no {role}")
        item = decoded.messages[found[0].name]
        rows = item.row
        if kind is BitStatus:
            rows = rows[np.isin(item.values[role], list(BUS.states))]
        live_rows = [row for row, answer in enumerate(answers) if type(answer) is kind]
        if not set(live_rows) <= set(rows.tolist()):
            raise AssertionError(f"{found[0].name}: the decoders accept different frames")
        for row in set(rows.tolist()) - set(live_rows):
            if not several_channels and not _in_conflict(item, row):
                raise AssertionError(f"{found[0].name}: a sound frame was left out")
    messages = decoded.messages.values()
    for name, key in SAMPLE_FIELDS.items():
        live = [getattr(answer, key) for answer in answers if isinstance(answer, Sample)]
        item = next(item for item in messages if name in item.values)
        taken = [type(answers[row]) is Sample for row in item.row.tolist()]
        column = item.values[name][np.array(taken, dtype=np.bool_)]
        if not np.allclose(live, column, rtol=1e-12, atol=0.0):
            raise AssertionError(f"{name}: the decoders disagree")


def _in_conflict(item: Decoded, row: int) -> bool:
    """Whether a frame has the counter of an earlier one with another payload."""
    if item.counter is None:
        return False
    place = int(np.searchsorted(item.row, row))
    used = item.counter[:place] == item.counter[place]
    return bool((item.data[:place][used] != item.data[place]).any())


def _frames_of(data: bytes) -> list[Frame]:
    """Frames of the default bus, damaged as the input has it."""
    frames = []
    now = 0
    for at in range(0, len(data) - RECORD.size + 1, RECORD.size):
        flags, choice, step, length, payload = RECORD.unpack_from(data, at)
        now += step * (1_000_000 if flags & Flags.SLOW else 1000)
        can_id = IDENTIFIERS[choice % len(IDENTIFIERS)]
        if flags & Flags.SEALED:
            payload = payload[:7] + bytes((crc8(can_id.to_bytes(2, "little") + payload[:7]),))
        elif length != len(payload):
            payload = (payload * 8)[: length % (MAX_PAYLOAD + 1)]
        frames.append(
            Frame(
                now,
                can_id,
                payload,
                extended=bool(flags & Flags.EXTENDED),
                fd=len(payload) > 8,
                error=bool(flags & Flags.ERROR),
                remote=bool(flags & Flags.REMOTE),
                channel=choice >> 6,
            )
        )
    return frames


def _windows(data: bytes, _: bool) -> None:
    """The same frames in windows as small as can be: none larger than allowed, none without end."""
    frames = _frames_of(data)
    if not frames:
        return
    held = 20 + data[0]
    tables = [FrameTable.from_frames(frames[at : at + 10]) for at in range(0, len(frames), 10)]
    found = list(windowed_recordings(tables, BUS, "fuzz", held, least=20))
    if not found:
        raise AssertionError("no recording at all")
    if any(item.quality.total("received") > min(len(frames), held + 10) for item in found):
        raise AssertionError("a test has more frames than a window")
    best = choose_recording(found)
    if best.samples is None and any(item.samples is not None for item in found):
        raise AssertionError("a test was passed over for nothing")


def _serial(data: bytes, _: bool) -> None:
    whole, pieces = Framer(), Framer()
    frames, found = whole.feed(data), []
    cut = 1 + data[0] % 40
    for at in range(0, len(data), cut):
        found += pieces.feed(data[at : at + cut])
        if len(pieces._partial) > MAX_CODED_BYTES:
            raise AssertionError("the framer keeps more than a packet")
    if (found, pieces.bad, pieces.bytes_seen) != (frames, whole.bad, whole.bytes_seen):
        raise AssertionError("the framer depends on how the bytes come")
    for frame in frames:
        again = Framer().feed(packet_of(frame))
        if len(again) != 1 or (again[0].can_id, again[0].data) != (frame.can_id, frame.data):
            raise AssertionError("a frame does not survive its own packet")


def _logs(data: bytes, all_the_way: bool) -> None:
    kind, content = KINDS[data[0] % len(KINDS)], data[1:]
    if kind == "container":
        kind, content = ".blf", _blf_around(content)
    with _file(kind, content) as name, contextlib.suppress(EhadiagError):
        if all_the_way:
            read_recordings(name, BUS)
        else:
            read_frames(name)


def _blf_around(content: bytes) -> bytes:
    """A BLF file with one container that is not compressed: a fuzzer does not get through zlib."""
    date = (2026, 1, 4, 1, 0, 0, 0, 0)
    header = FILE_HEADER.pack(
        b"LOGG", FILE_HEADER.size, *(0,) * 8, 0, len(content), 1, 0, *date, *date
    )
    size = OBJECT_HEADER.size + CONTAINER_HEADER.size + len(content)
    start = OBJECT_HEADER.pack(b"LOBJ", OBJECT_HEADER.size, 1, size, 10)
    return header + start + CONTAINER_HEADER.pack(0, len(content)) + content


@cache
def _default_mapping() -> tuple[MappingFile, Dbc]:
    """Parsed once: ten milliseconds for the same answer would be nearly all of the time."""
    files = resources.files("firmware_iface").joinpath("data")
    mapping = decode_toml(files.joinpath("eha_fcc.toml").read_bytes(), MappingFile, "default")
    return mapping, parse_dbc(files.joinpath("eha_fcc.dbc").read_bytes(), "default")


def _mappings(data: bytes, _: bool) -> None:
    """First byte even: a mapping against the default DBC; odd: a DBC for the default mapping."""
    mapping, dbc = _default_mapping()
    with contextlib.suppress(EhadiagError):
        if data[0] % 2:
            dbc = parse_dbc(data[1:], "fuzz")
        else:
            mapping = decode_toml(data[1:], MappingFile, "fuzz")
        busmap.resolve(mapping, dbc, "fuzz", "fuzz")


def _signals(data: bytes, _: bool) -> None:
    """Recordings that are not binary logs, to their tests."""
    kind, content = SIGNALS[data[0] % len(SIGNALS)], data[1:]
    if kind.startswith("packed"):
        kind, content = kind.removeprefix("packed"), gzip.compress(content, 1)
    with _file(kind, content) as path, contextlib.suppress(EhadiagError):
        list(recorded_tests([path], MEANING, BUDGET))


def _configurations(data: bytes, _: bool) -> None:
    """Actuator files, test files, mappings of columns, mappings of frames that name a DBC."""
    with _file(".toml", data[1:]) as path, contextlib.suppress(EhadiagError):
        CONFIGURATIONS[data[0] % len(CONFIGURATIONS)](path)


@contextmanager
def _file(suffix: str, content: bytes) -> Iterator[str]:
    with tempfile.NamedTemporaryFile(dir=MEMORY, suffix=suffix, delete=False) as file:
        file.write(content)
    try:
        yield file.name
    finally:
        Path(file.name).unlink()


TARGETS: Mapping[str, Callable[[bytes, bool], None]] = {
    "frames": _frames,
    "windows": _windows,
    "serial": _serial,
    "logs": _logs,
    "mappings": _mappings,
    "signals": _signals,
    "configurations": _configurations,
}
