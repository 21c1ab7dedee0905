"""Whether a call will wait for the compiler, which its caller should know beforehand."""

from __future__ import annotations

import logging

__all__ = ["compiling_notice", "log_if_compiling"]

IDENTIFICATION, SIMULATION = "ehadiag_identify", "ehadiag_sim"
"""Packages of kernels, as the names of their cache files hold them."""


def compiling_notice(*, simulation: bool = False, identification: bool = True) -> str:
    """What to tell who will wait; empty where all kernels that are needed are in the cache."""
    from ehadiag.compile.kernels import cache_folder  # noqa: PLC0415 - loads numba

    needed = [SIMULATION] * simulation + [IDENTIFICATION] * identification
    if all(any(cache_folder().glob(f"*{kind}*.nbi")) for kind in needed):
        return ""
    return "compiling the model's kernels, once for this installation (up to half a minute)"


def log_if_compiling(*, simulation: bool = False, identification: bool = True) -> None:
    """Log a warning, which goes to standard error where logging is not set up."""
    notice = compiling_notice(simulation=simulation, identification=identification)
    if notice:
        logging.getLogger("ehadiag").warning("ehadiag: %s", notice)
