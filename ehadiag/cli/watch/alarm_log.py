"""Log of a monitor: JSON lines, each with its time, on the disk before the next is written."""

from __future__ import annotations

import contextlib
import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ehadiag.core.dates import utc_text
from ehadiag.core.errors import InputOutputError, reason_of
from ehadiag.core.folder import append_to_file
from ehadiag.core.printable import valid_text

__all__ = ["SCHEMA", "AlarmLog", "now_text"]

SCHEMA = "ehadiag.monitor/1"


class AlarmLog:
    """Appends events to a file; without one it keeps nothing.

    Parameters
    ----------
    path : Path | None
        The file; it is made where there is none. None: no log.

    Raises
    ------
    InputOutputError
        It cannot be opened, is a link or no file.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        try:
            self._file = (
                None if path is None else os.fdopen(append_to_file(path), "a", encoding="utf-8")
            )
        except OSError as error:
            raise InputOutputError(f"log {path}: {reason_of(error)}") from None

    def write(self, event: str, **content: Any) -> dict[str, Any]:
        """Append an event, and return what was written.

        Parameters
        ----------
        event : str
            Its name: `begin`, `unit`, `alarm` or `end`.
        **content : Any
            What there is to say of it.

        Returns
        -------
        dict[str, Any]
            The object of the line.

        Raises
        ------
        InputOutputError
            It cannot be written.
        """
        texts = {
            key: valid_text(value) if isinstance(value, str) else value
            for key, value in content.items()
        }
        tree = {"schema": SCHEMA, "time": now_text(), "event": event, **texts}
        if self._file is not None:
            try:
                self._file.write(json.dumps(tree, allow_nan=False) + "\n")
                self._file.flush()
                os.fsync(self._file.fileno())
            except OSError as error:
                raise InputOutputError(f"log {self._path}: {reason_of(error)}") from None
        return tree

    def close(self) -> None:
        """Close the file; may be called twice. What could not be written was said then."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()


def now_text() -> str:
    """Time of day: UTC, ISO 8601, to the millisecond."""
    return utc_text(datetime.now(UTC))
