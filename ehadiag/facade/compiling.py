"""Whether a call will wait for the compiler, which its caller should know beforehand."""

from __future__ import annotations

import logging

__all__ = ["compiling_notice", "log_if_compiling"]

IDENTIFICATION, SIMULATION = "ehadiag_identify", "ehadiag_sim"
"""Packages of kernels, as the names of their cache files hold them."""


def compiling_notice(*, simulation: bool = False, identification: bool = True) -> str:
    """What to tell who will wait; empty where all kernels that are needed are in the cache."""
    from ehadiag.compile.kernel_cache import cache_folder, kept_kernels  # noqa: PLC0415 - loads numba

    needed = [SIMULATION] * simulation + [IDENTIFICATION] * identification
    kept = kept_kernels()
    if all(any(kind in name for name in kept) for kind in needed):
        return ""
    often = "in memory, at each start" if cache_folder() is None else "once for this installation"
    return f"compiling the model's kernels, {often} (up to half a minute)"


def log_if_compiling(*, simulation: bool = False, identification: bool = True) -> None:
    """Log a warning, which goes to standard error where logging is not set up."""
    notice = compiling_notice(simulation=simulation, identification=identification)
    if notice:
        logging.getLogger("ehadiag").warning("ehadiag: %s", notice)
