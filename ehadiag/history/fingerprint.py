"""Hashes of a recording: of its file, and of the samples that were decoded from it."""

from __future__ import annotations

import hashlib
import os
import stat
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ehadiag.core.recording import Recording

__all__ = ["hash_of_file", "hash_of_samples"]


def hash_of_file(path: str) -> str | None:
    """SHA-256 of a file's bytes.

    Parameters
    ----------
    path : str
        Of the recording.

    Returns
    -------
    str | None
        Hexadecimal; None where there is no regular file of this name, such as for a bus.
    """
    try:
        # A FIFO must not make anybody wait.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError):
        return None
    with open(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            return None
        try:
            return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError:
            return None


def hash_of_samples(recording: Recording) -> str | None:
    """SHA-256 of what was decoded: the same for a log, its packed copy and its conversion.

    Parameters
    ----------
    recording : Recording
        One test of one unit.

    Returns
    -------
    str | None
        Hexadecimal; None without samples. Times of arrival do not count: formats round them.
    """
    samples = recording.samples
    if samples is None:
        return None
    out = hashlib.sha256(
        f"{recording.test_id} {recording.serial} {samples.period_ns} {samples.mode}".encode()
    )
    for values in (
        samples.command,
        samples.current,
        samples.spool,
        samples.pressure,
        samples.position,
    ):
        # One zero, one NaN: the bits must say no more than the numbers.
        plain = np.where(np.isnan(values), np.nan, values + 0.0)
        out.update(plain.astype("<f8").tobytes())
    return out.hexdigest()
