"""Reads a DBC file with cantools, and keeps the result in the user's cache.

cantools takes a quarter of a second to load (it loads python-can, and that whatever reads MF4), so
what it found in a file is kept, as JSON under a hash of the file's bytes.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import version
from itertools import islice
from typing import Any, Literal

import msgspec

from ehadiag.core.cache_folder import private_folder, tell
from ehadiag.core.errors import ConfigurationError, reason_of
from ehadiag.core.folder import Folder

__all__ = ["MAX_DBC_BYTES", "DbcMessage", "DbcSignal", "parse_dbc", "recall_dbc"]

MAX_DBC_BYTES = 2 << 20
MAX_KEPT_BYTES = 32 << 20
MAX_KEPT = 16
"""Files in the cache; the oldest goes."""
MAX_SIGNALS = 10_000
MAX_MESSAGE_SIGNALS = 1000
"""Of all messages, and of one."""
MESSAGE = re.compile(rb"\bBO_\s")
SIGNAL = re.compile(rb"\bSG_\s+\w+(?:\s+\w+)?\s*:")
PLACE = re.compile(r"at line (\d+), column (\d+)")
FORM = 1
"""Raised with each change of what is kept."""


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
DECODER = msgspec.json.Decoder(Dbc)


def recall_dbc(text: bytes, name: str) -> Mapping[str, DbcMessage]:
    """`parse_dbc`, from the cache if the same bytes were read before."""
    if len(text) > MAX_DBC_BYTES:
        return parse_dbc(text, name)  # which refuses it
    folder = private_folder("dbc")
    if folder is None:
        return parse_dbc(text, name)
    with folder:
        key = hashlib.sha256(f"{FORM} {version('cantools')} ".encode() + text).hexdigest()
        kept = _read(folder, f"{key}.json")
        if kept is None:
            kept = parse_dbc(text, name)
            _keep(kept, folder, f"{key}.json")
        return kept


def parse_dbc(text: bytes, name: str) -> Dbc:
    """Messages of a DBC by their name; `name` is the file's, for errors.

    Parameters
    ----------
    text : bytes
        Contents of the file.
    name : str
        Name of the file, for error messages.

    Returns
    -------
    Dbc
        Messages and signals.

    Raises
    ------
    ConfigurationError
        Not a DBC, or too large.
    """
    _check_budget(text, name)
    import cantools.database  # noqa: PLC0415 - slow to import
    from cantools.database.can.database import Database  # noqa: PLC0415

    try:
        content = text.decode("utf-8")
    except UnicodeDecodeError:
        content = text.decode("cp1252", "replace")  # what older tools write
    try:
        database = cantools.database.load_string(content, "dbc")
        if not isinstance(database, Database):
            raise ConfigurationError(f"DBC file {name}: no CAN messages in it")
        return {message.name: plain_message(message) for message in database.messages}
    except ConfigurationError:
        raise
    except Exception as error:
        raise ConfigurationError(f"DBC file {name}: not a valid DBC{_reason(error)}") from None


def _check_budget(text: bytes, name: str) -> None:
    """Refuse what would take its parser longer than anybody waits.

    Multiplexed signals cost the square of their number in a message.
    """
    if len(text) > MAX_DBC_BYTES:
        raise ConfigurationError(f"DBC file {name}: larger than {MAX_DBC_BYTES} bytes")
    total = 0
    for message in MESSAGE.split(text):
        signals = len(SIGNAL.findall(message))
        total += signals
        if signals > MAX_MESSAGE_SIGNALS:
            raise ConfigurationError(
                f"DBC file {name}: a message of more than {MAX_MESSAGE_SIGNALS} signals"
            )
    if total > MAX_SIGNALS:
        raise ConfigurationError(
            f"DBC file {name}: more than {MAX_SIGNALS} signals; keep the messages that are mapped"
        )


def _reason(error: Exception) -> str:
    """Why a DBC is none, without quoting a line of it: a link may lead to any file."""
    text = str(error)
    if place := PLACE.search(text):
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


def _read(folder: Folder, name: str) -> Dbc | None:
    """Return what is kept; None if there is nothing, or nothing that can be read."""
    try:
        return DECODER.decode(folder.read(name, MAX_KEPT_BYTES))
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError, RecursionError):
        tell(f"cache folder {folder.path}: what was kept of a DBC is damaged; read again")
        return None


def _keep(found: Dbc, folder: Folder, name: str) -> None:
    """Write to the cache if that is possible, and gives the same when it is read."""
    content = msgspec.json.encode(found)
    with suppress(msgspec.DecodeError):
        if len(content) >= MAX_KEPT_BYTES or DECODER.decode(content) != found:
            return
        try:
            folder.write(name, content, synced=False)
            by_age = sorted(folder.names(), key=folder.changed_at, reverse=True)
            for old in islice(by_age, MAX_KEPT, None):
                folder.remove(old)
        except OSError as error:
            tell(f"cache folder {folder.path}: {reason_of(error)}; the DBC is not kept")
