"""Reads a DBC file with cantools, caches the result, and locates its signals in payloads."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from importlib.util import find_spec
from itertools import islice
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import ConfigurationError, reason_of
from firmware_iface.files import MAX_DBC_BYTES, Folder, private_folder, warn_once
from firmware_iface.recording import MAX_CAN_ID, BoolArray, FloatArray, IntArray

FLOAT_FORMATS = {16: "<e", 32: "<f", 64: "<d"}
"""Formats of `struct` by the bits of a number."""
WORD_BITS = 64
PIECE_BITS = 32


class SignalLayout(msgspec.Struct, frozen=True, dict=True):
    """Place and number format of one signal."""

    name: str
    """As in the DBC."""
    start: int
    """DBC start bit: the least significant bit of a little-endian signal, the most significant one
    of a big-endian signal, both counted 8 * byte + bit.
    """
    length: int
    """Bits, 1 … 64."""
    big_endian: bool = False
    """Number format; floats have 16, 32 or 64 bits."""
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    """Physical value = raw * scale + offset."""
    offset: float = 0.0
    minimum: float | None = None
    """Physical range, None where the DBC gives none."""
    maximum: float | None = None
    unit: str = ""
    """Unit text of the DBC."""
    selectors: tuple[tuple[SignalLayout, frozenset[int]], ...] = ()
    """Multiplexers that must all hold one of their values for the signal to be present."""

    @cached_property
    def lead(self) -> int:
        """Bits before the signal: from bit 0 of byte 0, or from the payload's first (top) bit."""
        if self.big_endian:
            return 8 * (self.start // 8) + 7 - self.start % 8
        return self.start

    @property
    def last_byte(self) -> int:
        """Index of the last payload byte that the signal touches."""
        return (self.lead + self.length - 1) // 8

    def bits(self, data: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """Bit pattern of the signal in each payload; data of shape (n, width), result (n,)."""
        return _bits(data, self.lead, self.length, self.big_endian)

    def raw(self, data: NDArray[np.uint8]) -> IntArray | FloatArray:
        """Raw number of each payload, before scale and offset.

        Unsigned 64-bit values above the signed range wrap: no role of ours is that wide.
        """
        pattern = self.bits(data)
        if self.is_float:
            return _as_float(pattern, self.length)
        if not self.signed:
            return pattern.astype(np.int64)
        spare = np.uint64(WORD_BITS - self.length)
        shifted: IntArray = (pattern << spare).view(np.int64)
        return shifted >> spare.astype(np.int64)

    def physical(self, data: NDArray[np.uint8]) -> FloatArray:
        """Physical value in the DBC's unit, shape (n,)."""
        with np.errstate(invalid="ignore"):  # a signalling NaN comes out as a quiet one
            raw = self.raw(data).astype(np.float64)
            if self.scale != 1.0:
                raw *= self.scale
            if self.offset != 0.0:
                raw += self.offset
        return raw

    def present(self, data: NDArray[np.uint8]) -> BoolArray | None:
        """Which payloads carry the signal; None if all do."""
        if not self.selectors:
            return None
        mask = np.ones(len(data), dtype=np.bool_)
        for selector, values in self.selectors:
            mask &= np.isin(selector.raw(data), sorted(values))
        return mask


def _bits(data: NDArray[np.uint8], lead: int, length: int, big: bool) -> NDArray[np.uint64]:
    width = data.shape[1]
    first, last = lead // 8, (lead + length - 1) // 8
    if last - first >= 8 or width < 8:
        return _bits_in_pieces(data, lead, length, big)
    base = min(first, width - 8)
    if width == 8 and data.flags.c_contiguous:
        word = data.view(">u8" if big else "<u8").reshape(-1)
    else:
        window = np.ascontiguousarray(data[:, base : base + 8])
        word = window.view(">u8" if big else "<u8").reshape(-1)
    inside = lead - 8 * base
    shift = WORD_BITS - inside - length if big else inside
    out: NDArray[np.uint64] = word.astype(np.uint64, copy=False) >> np.uint64(shift)
    if length < WORD_BITS:
        out &= np.uint64((1 << length) - 1)
    return out


def _bits_in_pieces(
    data: NDArray[np.uint8], lead: int, length: int, big: bool
) -> NDArray[np.uint64]:
    """Signals over nine bytes, and payload tables narrower than a word."""
    if data.shape[1] < 8:
        wide = np.zeros((len(data), 8), dtype=np.uint8)
        wide[:, : data.shape[1]] = data
        return _bits(wide, lead, length, big)
    rest = length - PIECE_BITS
    head = _bits(data, lead, PIECE_BITS, big)
    tail = _bits(data, lead + PIECE_BITS, rest, big)
    if big:
        return (head << np.uint64(rest)) | tail
    return head | (tail << np.uint64(PIECE_BITS))


def _as_float(pattern: NDArray[np.uint64], length: int) -> FloatArray:
    if length == 64:
        return pattern.view(np.float64)
    if length == 32:
        single = pattern.astype(np.uint32).view(np.float32)
    else:
        single = pattern.astype(np.uint16).view(np.float16)
    with np.errstate(invalid="ignore"):  # signalling NaN patterns are legal payloads
        return single.astype(np.float64)


MAX_CACHED_BYTES = 32 << 20
MAX_CACHED_FILES = 16
"""Largest number of files in the cache; the oldest goes."""
MAX_SIGNALS = 10_000
MAX_MESSAGE_SIGNALS = 1000
"""Largest number of signals of all messages, and of one."""
MAX_SIGNAL_BITS = 8 * 1785
"""Largest length of a message, and offset of a signal in it, bits: J1939's longest message."""
MAX_LAYOUT_WORK = MAX_SIGNALS * 512**2
"""Sum of the squares of bits that the parser goes through for each signal; 512 are those of FD."""
MAX_MULTIPLEXED_VALUES = 100_000
"""Largest number of values in the ranges of all multiplexers, 1: the parser lists each value."""
SKIPPED_PATTERN = re.compile(r'//.*?\n|"(?:\\"|[^"])*?"')
"""Comments and quoted texts, in which nothing is counted."""
LAYOUT_PATTERN = re.compile(
    r"(?:BO_\s*([-+]?\d++)\s*(\w+)\s*)?:\s*([-+]?\d++)\s*(?=[A-Za-z_])"
    r"|(?:SG_\s+(\w+)(?:\s+\w+)?\s*)?:\s*([-+]?\d++)\s*\|\s*([-+]?\d++)"
)
"""A message (identifier, name, bytes), or a signal (name, start, length)."""
RANGES_PATTERN = re.compile(r"SG_MUL_VAL_([^;]*)")
RANGE_PATTERN = re.compile(r"(?<!\d)(\d++)\s*-\s*(\d++)")
MAX_DIGITS = 12
"""Largest number of digits that are converted, 1: an identifier has ten."""
UNASSIGNED_MESSAGE = "VECTOR__INDEPENDENT_SIG_MSG"
"""Message of signals that are of no message; the parser passes it over."""
DBC_ERROR_PLACE = re.compile(r"at line (\d+), column (\d+)")
CACHE_FORMAT = 2
"""Version of the cache's content, 1; another version is not read."""


class DbcSignal(msgspec.Struct, frozen=True):
    """One signal; `scale` and `offset` are None where the raw value is no plain number."""

    name: str
    start: int
    length: int
    byte_order: Literal["big_endian", "little_endian"]
    is_signed: bool
    is_float: bool
    scale: float | None
    offset: float | None
    minimum: float | None
    maximum: float | None
    unit: str
    multiplexer: str | None
    multiplexer_ids: tuple[int, ...]


class DbcMessage(msgspec.Struct, frozen=True):
    """One message; `cycle_ms` is 0 where the file gives none."""

    name: str
    frame_id: int
    extended: bool
    fd: bool
    length: int
    cycle_ms: int
    signals: tuple[DbcSignal, ...]


Dbc = dict[str, DbcMessage]
CACHE_DECODER = msgspec.json.Decoder(Dbc)


def cached_dbc(text: bytes, name: str) -> Mapping[str, DbcMessage]:
    """`parse_dbc`, from the cache if the same bytes were read before."""
    if len(text) > MAX_DBC_BYTES:
        return parse_dbc(text, name)  # which refuses it
    folder = private_folder("dbc")
    if folder is None:
        return parse_dbc(text, name)
    with folder:
        parser = find_spec("cantools")
        # Another version of cantools is another file; what it is called takes 15 ms to find out.
        path = (parser and parser.origin) or __file__
        stamp = path, os.stat(path).st_mtime_ns, os.stat(path).st_size
        key = hashlib.sha256(f"{CACHE_FORMAT} {stamp} ".encode() + text).hexdigest()
        kept = _read_cache(folder, f"{key}.json")
        if kept is None:
            kept = parse_dbc(text, name)
            _write_cache(kept, folder, f"{key}.json")
        return kept


def parse_dbc(text: bytes, name: str) -> Dbc:
    """Messages of a DBC by their name; `name` is the file's, for errors.

    ConfigurationError: not a DBC, or too large.
    """
    if len(text) > MAX_DBC_BYTES:
        raise ConfigurationError(f"DBC file {name}: larger than {MAX_DBC_BYTES} bytes")
    try:
        content = text.decode("utf-8")
    except UnicodeDecodeError:
        content = text.decode("cp1252", "replace")  # what older tools write
    _check_budget(content, name)
    import cantools.database  # noqa: PLC0415 - slow to import
    from cantools.database.can.database import Database  # noqa: PLC0415

    try:
        database = cantools.database.load_string(content, "dbc")
        if not isinstance(database, Database):
            raise ConfigurationError(f"DBC file {name}: no CAN messages in it")
        return {message.name: plain_message(message) for message in database.messages}
    except ConfigurationError:
        raise
    except Exception as error:
        raise ConfigurationError(f"DBC file {name}: not a valid DBC{_reason(error)}") from None


def _check_budget(content: str, name: str) -> None:
    """Refuse a DBC that would keep the parser busy for minutes, or that names an identifier twice.

    Multiplexed signals cost the square of their number in a message, each signal that of its bits.
    """
    plain = SKIPPED_PATTERN.sub(" ", content)
    message, size, count, total, work = "", 0, 0, 0, 0
    names: dict[int, str] = {}
    for found in LAYOUT_PATTERN.finditer(plain):
        identifier, title, size_text, signal, start, length = found.groups()
        if size_text is not None:
            message, size, count = title or "", 8 * _small(size_text), 0
            if size > MAX_SIGNAL_BITS:
                raise ConfigurationError(
                    f"DBC file {name}: message {message} of more than {MAX_SIGNAL_BITS // 8} bytes"
                )
            if identifier is not None and message != UNASSIGNED_MESSAGE:
                _check_twice(names, _small(identifier), message, name)
            continue
        bits = max(_small(start) + _small(length), size)
        count, total, work = count + 1, total + 1, work + bits**2
        if bits > MAX_SIGNAL_BITS:
            raise ConfigurationError(
                f"DBC file {name}: signal {signal} of message {message} reaches beyond"
                f" {MAX_SIGNAL_BITS // 8} bytes"
            )
        if count > MAX_MESSAGE_SIGNALS:
            raise ConfigurationError(
                f"DBC file {name}: a message of more than {MAX_MESSAGE_SIGNALS} signals"
            )
    if total > MAX_SIGNALS or work > MAX_LAYOUT_WORK:
        raise ConfigurationError(
            f"DBC file {name}: more than {MAX_SIGNALS} signals, or too long ones; keep the messages"
            " that are mapped"
        )
    _check_ranges(plain, name)


def _check_twice(names: dict[int, str], identifier: int, message: str, name: str) -> None:
    """Refuse a second message of an identifier: nothing tells their frames apart."""
    if identifier in names:
        raise ConfigurationError(
            f"DBC file {name}: messages {names[identifier]} and {message} have the same identifier"
            f" {identifier & MAX_CAN_ID:#x}"
        )
    names[identifier] = message


def _check_ranges(plain: str, name: str) -> None:
    """Refuse ranges of multiplexers whose values do not fit into memory."""
    values = 0
    for statement in RANGES_PATTERN.finditer(plain):
        for low, high in RANGE_PATTERN.findall(statement[1]):
            values += max(_small(high) - _small(low) + 1, 0)
    if values > MAX_MULTIPLEXED_VALUES:
        raise ConfigurationError(
            f"DBC file {name}: multiplexers of more than {MAX_MULTIPLEXED_VALUES} values"
        )


def _small(digits: str) -> int:
    """Number of digits; a longer one than any identifier counts as the largest."""
    return int(digits) if len(digits) <= MAX_DIGITS else 10**MAX_DIGITS


def _reason(error: Exception) -> str:
    """Why a file is no valid DBC, without quoting a line of it: a link may lead to any file."""
    text = str(error)
    if place := DBC_ERROR_PLACE.search(text):
        return f": invalid syntax at line {place[1]}, column {place[2]}"
    if type(error).__module__.startswith("cantools."):
        return f": {' '.join(text.split())[:200]}"  # it was a DBC, and names its messages
    return ""


def plain_message(message: Any) -> DbcMessage:
    """What this project needs of a cantools message."""
    return DbcMessage(
        name=message.name,
        frame_id=message.frame_id,
        extended=message.is_extended_frame,
        fd=message.is_fd,
        length=message.length,
        cycle_ms=int(message.cycle_time or 0),
        signals=tuple(_plain_signal(item) for item in message.signals),
    )


def _plain_signal(signal: Any) -> DbcSignal:
    conversion = signal.conversion
    return DbcSignal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        byte_order=signal.byte_order,
        is_signed=signal.is_signed,
        is_float=conversion.is_float,
        scale=_number(getattr(conversion, "scale", None)),
        offset=_number(getattr(conversion, "offset", None)),
        minimum=_number(signal.minimum),
        maximum=_number(signal.maximum),
        unit=signal.unit or "",
        multiplexer=signal.multiplexer_signal,
        multiplexer_ids=tuple(signal.multiplexer_ids or ()),
    )


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _read_cache(folder: Folder, name: str) -> Dbc | None:
    """Return what is kept; None if there is nothing, or nothing that can be read."""
    try:
        return CACHE_DECODER.decode(folder.read(name, MAX_CACHED_BYTES))
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError, RecursionError):
        warn_once(f"cache folder {folder.path}: what was kept of a DBC is damaged; read again")
        return None


def _write_cache(found: Dbc, folder: Folder, name: str) -> None:
    """Write to the cache if that is possible, and gives the same when it is read."""
    content = msgspec.json.encode(found)
    with suppress(msgspec.DecodeError):
        if len(content) >= MAX_CACHED_BYTES or CACHE_DECODER.decode(content) != found:
            return
        try:
            folder.write(name, content, synced=False)
            by_age = sorted(folder.names(), key=folder.changed_at, reverse=True)
            for old in islice(by_age, MAX_CACHED_FILES, None):
                folder.remove(old)
        except OSError as error:
            warn_once(f"cache folder {folder.path}: {reason_of(error)}; the DBC is not kept")
