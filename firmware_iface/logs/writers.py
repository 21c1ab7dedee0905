"""Opens python-can's log writers so that a killed process leaves a readable file.

Imported only where a recording is written: python-can takes half a second to import.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import can

from firmware_iface.errors import ConfigurationError, install_command
from firmware_iface.files import create_file
from firmware_iface.logs.can_readers import mf4_library

FILE_BUFFER_BYTES = 1 << 20
"""Bytes. Larger than what comes between two flushes, so that each flush is one write and a killed
process leaves no half line or half container."""


class FlushingBlfWriter(can.BLFWriter):
    """A BLF file that is readable up to its last flush.

    python-can's own keeps up to 128 KiB in memory and writes the true header at its end; without
    the header's start time a reader takes frame times as relative ones.
    """

    def flush(self) -> None:
        """Write all frames so far and a header that fits them."""
        while self._buffer_size:
            self._flush()
        end = self.file.tell()
        self.file.seek(0)
        self._write_header(end)
        self.file.seek(end)
        self.file.flush()


def open_writer(path: Path) -> Any:
    """Create `path`, which must not exist, and return the writer for its suffix.

    path: file to create; the suffix chooses the format. Returns a writer of python-can or asammdf.
    ConfigurationError: MF4 without its library; OSError: the file exists or cannot be created.
    """
    suffix = path.suffix.lower()
    descriptor = create_file(path)

    def begin(mode: Any, **text: Any) -> Any:
        return open(path, mode, FILE_BUFFER_BYTES, opener=lambda *_: descriptor, **text)

    if suffix == ".mf4":
        file = begin("w+b")
        try:
            return mf4_library().MF4Writer(file)
        except (ImportError, NotImplementedError):
            file.close()
            path.unlink()
            raise ConfigurationError(
                f"recording {path}: MF4 needs asammdf: {install_command('mf4')}"
            ) from None
    if suffix == ".blf":
        return FlushingBlfWriter(begin("wb"))
    kinds: dict[str, Any] = {".asc": can.ASCWriter, ".csv": can.CSVWriter, ".trc": can.TRCWriter}
    return kinds[suffix](begin("w", encoding="utf-8", newline=""))
