"""Reads decoded signals from files of arrays: MF4, TDMS, HDF5 and with it MATLAB 7.3.

Each channel is an array with a name; times are a channel of their own, the waveform's in TDMS,
the group's in MF4.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from firmware_iface.errors import (
    ConfigurationError,
    InputOutputError,
    install_command,
    printable,
)
from firmware_iface.logs.can_readers import (
    MAX_PACKED_BLOCK,
    check_packed_blocks,
    inflated_size,
)
from firmware_iface.logs.log_files import Budget
from firmware_iface.recording import FloatArray, RecordedSignal
from firmware_iface.signals.columns import TIME_ROLE, ColumnMap, column_unit, missing_channels
from firmware_iface.signals.tables import MAX_TABLE_ROWS, checked_signals

UNIT_ATTRIBUTES = ("unit", "units", "Unit", "Units", "unit_string")
MATLAB_REFERENCES = "#"
"""Begins the names of MATLAB's own groups."""
CHECKSUM_BYTES = 4
"""Of a block of HDF5, which may be packed with it."""


class ArrayChannel(msgspec.Struct, frozen=True):
    """One channel of a file; read when it is needed."""

    length: int
    unit: str
    read: Callable[[], FloatArray]
    times: Callable[[], FloatArray] | None = None
    """Its own time stamps, s; None: those of another channel."""


def array_signals(
    channels: Mapping[str, ArrayChannel], columns: ColumnMap, path: Path, *, complete: bool
) -> dict[str, RecordedSignal]:
    """Take the signals that have a role out of channels by name; see `SignalReader`."""
    present, where = list(channels), f"log {path}"
    column = columns.columns.get(TIME_ROLE)
    stamped = column is not None and (
        column.column in channels or not any(item.times for item in channels.values())
    )
    rest = {role: item for role, item in columns.columns.items() if stamped or role != TIME_ROLE}
    columns = ColumnMap(rest, columns.tick_ns)
    found = columns.resolve(present, where)
    if complete and (lacking := missing_channels(found, present)):
        raise ConfigurationError(f"{where}: {lacking}")
    longest = max((channels[item.column].length for item in found.values()), default=0)
    if longest > MAX_TABLE_ROWS:
        raise InputOutputError(f"{where}: more than {MAX_TABLE_ROWS} values; cut it about the test")
    values: dict[str, FloatArray] = {}
    for role, column in found.items():
        gain, bias = column_unit(column, channels[column.column].unit, role, where)
        values[role] = channels[column.column].read() * gain + bias
    out = {}
    for role, column in found.items():
        if role == TIME_ROLE:
            continue
        times = channels[column.column].times
        stamps = values.get(TIME_ROLE) if stamped or times is None else times()
        if stamps is None:
            raise ConfigurationError(
                f"{where}: no channel of time stamps: name it by --column time=NAME:UNIT"
            )
        if len(stamps) != len(values[role]):
            raise InputOutputError(
                f"{where}: {printable(column.column)!r} has {len(values[role])} values,"
                f" but {len(stamps)} time stamps"
            )
        out[role] = stamps, values[role]
    return checked_signals(out.items(), path)


def _by_name(found: Mapping[tuple[str, str], ArrayChannel]) -> dict[str, ArrayChannel]:
    """Channels by their name, where that is of one channel alone; else with their group's."""
    counts = Counter(name for _, name in found)
    return {
        name if counts[name] == 1 else f"{group}/{name}": channel
        for (group, name), channel in found.items()
    }


class _ArrayReader(ABC):
    """Reads signals of one kind of file, through an optional library."""

    signature = b""
    library: str
    """Name of the package that reads the files."""
    kind: str
    """Name of the kind of file, for messages."""

    def signals(
        self,
        path: Path,
        columns: ColumnMap,
        budget: Budget,
        *,
        complete: bool,
    ) -> dict[str, RecordedSignal]:
        """Read a file, see `SignalReader`."""
        try:
            with self._channels(path, budget) as channels:
                return array_signals(channels, self._needed(columns), path, complete=complete)
        except (ConfigurationError, InputOutputError):
            raise
        except ImportError:
            raise InputOutputError(
                f"log {path}: {self.kind} needs {self.library}: {install_command('daq')}"
            ) from None
        except Exception:  # any kind, and it quotes the file
            raise InputOutputError(
                f"log {path}: not a readable {self.kind} file of signals"
            ) from None

    def _needed(self, columns: ColumnMap) -> ColumnMap:
        return columns

    @abstractmethod
    def _channels(
        self, path: Path, budget: Budget
    ) -> AbstractContextManager[Mapping[str, ArrayChannel]]:
        """Open the file; channels by name while it is open."""


class Mf4SignalReader(_ArrayReader):
    """ASAM's measurements; the time of a channel is that of its group, whatever that is called."""

    library, kind = "asammdf", "MF4"

    def _needed(self, columns: ColumnMap) -> ColumnMap:
        rest = {role: item for role, item in columns.columns.items() if role != TIME_ROLE}
        return ColumnMap(rest, columns.tick_ns)

    @contextmanager
    def _channels(self, path: Path, budget: Budget) -> Iterator[Mapping[str, ArrayChannel]]:
        from asammdf import MDF  # noqa: PLC0415 - optional, and slow

        check_packed_blocks(path, budget.size)
        with closing(MDF(path)) as file:
            yield _by_name(
                {
                    (str(number), channel.name): _mf4_channel(file, number, index)
                    for number, group in enumerate(file.groups)
                    for index, channel in enumerate(group.channels)
                    if index != file.masters_db.get(number)
                }
            )


def _mf4_channel(file: Any, group: int, index: int) -> ArrayChannel:
    @cache
    def found() -> Any:
        return file.get(group=group, index=index)

    return ArrayChannel(
        file.groups[group].channel_group.cycles_nr,
        file.get_channel_unit(group=group, index=index) or "",
        lambda: np.asarray(found().samples, dtype=np.float64),
        lambda: np.asarray(found().timestamps, dtype=np.float64),
    )


class TdmsReader(_ArrayReader):
    """Files of LabVIEW; the time of a channel is that of its waveform."""

    signature, library, kind = b"TDSm", "npTDMS", "TDMS"

    @contextmanager
    def _channels(self, path: Path, _: Budget) -> Iterator[Mapping[str, ArrayChannel]]:
        from nptdms import TdmsFile  # noqa: PLC0415 - optional

        with TdmsFile.open(path) as file:
            yield _by_name(
                {
                    (group.name, channel.name): _tdms_channel(channel)
                    for group in file.groups()
                    for channel in group.channels()
                }
            )


def _tdms_channel(channel: Any) -> ArrayChannel:
    about = channel.properties
    times = "wf_increment" in about and "wf_start_offset" in about
    return ArrayChannel(
        len(channel),
        str(about.get("unit_string", "")),
        lambda: np.asarray(channel[:], dtype=np.float64),
        (lambda: np.asarray(channel.time_track(), dtype=np.float64)) if times else None,
    )


class HdfReader(_ArrayReader):
    """Files of HDF5, and of MATLAB from version 7.3 on."""

    library, kind = "h5py", "HDF5"

    @contextmanager
    def _channels(self, path: Path, _: Budget) -> Iterator[Mapping[str, ArrayChannel]]:
        import h5py  # noqa: PLC0415 - optional, and slow

        if not h5py.is_hdf5(path):
            raise InputOutputError(
                f"log {path}: not a file of HDF5; of MATLAB save it as version 7.3 (-v7.3)"
            )
        with h5py.File(path, "r") as file:
            found: dict[tuple[str, str], ArrayChannel] = {}

            def take(name: str, item: Any) -> None:
                if isinstance(item, h5py.Dataset) and not name.startswith(MATLAB_REFERENCES):
                    found.update(_hdf_channels(name, item))

            file.visititems(take)
            yield _by_name(found)


def _hdf_channels(path: str, item: Any) -> dict[tuple[str, str], ArrayChannel]:
    """Channels of one data set: a row or column of numbers, or a table with named columns."""
    unit = next((item.attrs[key] for key in UNIT_ATTRIBUTES if key in item.attrs), "")
    text = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    if item.dtype.names and item.ndim == 1:
        return {
            (path, field): ArrayChannel(item.size, "", partial(_numbers, item, field))
            for field in item.dtype.names
        }
    line = item.ndim > 0 and item.size == max(item.shape)
    if not line or item.dtype.kind not in "fiu":
        return {}
    group, _, name = path.rpartition("/")
    return {(group, name): ArrayChannel(item.size, text, partial(_numbers, item, ()))}


def _numbers(item: Any, part: Any) -> FloatArray:
    if item.chunks:
        _check_blocks(item)
    return np.asarray(item[part], dtype=np.float64).reshape(-1)


def _check_blocks(item: Any) -> None:
    """Refuse a data set whose packed blocks take too much memory: one is unpacked whole.

    The library unpacks whatever a block holds, before it cuts it to its size.
    """
    import h5py  # noqa: PLC0415 - loaded, see HdfReader

    where = f"log {item.file.filename}: {printable(item.name)!r} is"
    size = math.prod(item.chunks) * item.id.get_type().get_size()
    if size > MAX_PACKED_BLOCK:
        raise InputOutputError(
            f"{where} stored in blocks of more than {MAX_PACKED_BLOCK >> 20} MiB; store it in"
            " smaller ones"
        )
    made = item.id.get_create_plist()
    filters = [made.get_filter(number)[0] for number in range(made.get_nfilters())]
    packed = filters.count(h5py.h5z.FILTER_DEFLATE)
    rest = set(filters) - {
        h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32
    }  # fmt: skip
    if rest or packed > 1:
        raise InputOutputError(f"{where} packed by another method than gzip; store it by gzip")
    if not packed:
        return
    places: list[tuple[int, ...]] = []
    item.id.chunk_iter(lambda block: places.append(block.chunk_offset))
    for place in places:
        skipped, block = item.id.read_direct_chunk(place)
        if skipped >> filters.index(h5py.h5z.FILTER_DEFLATE) & 1:
            continue  # packing did not make it smaller
        if inflated_size(block, 0, len(block), size + CHECKSUM_BYTES) > size + CHECKSUM_BYTES:
            raise InputOutputError(
                f"{where} damaged: a block of it unpacks to more than the {size} bytes that it"
                " states"
            )
