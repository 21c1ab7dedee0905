"""Whether a call will wait for the compiler, which its caller should know beforehand."""

from __future__ import annotations

import logging

__all__ = ["NOTICE", "compiling", "log_if_compiling"]

IDENTIFICATION, SIMULATION = "ehadiag_identify", "ehadiag_sim"
"""Packages of kernels, as the names of their cache files hold them."""
NOTICE = "compiling the model's kernels, once for this installation (up to half a minute)"


def compiling(*, simulation: bool = False, identification: bool = True) -> bool:
    """Whether kernels of the simulation, or of the identification, are not in the cache."""
    from ehadiag.compile.kernels import cache_folder  # noqa: PLC0415 - loads numba

    needed = [SIMULATION] * simulation + [IDENTIFICATION] * identification
    return not all(any(cache_folder().glob(f"*{kind}*.nbi")) for kind in needed)


def log_if_compiling(*, simulation: bool = False, identification: bool = True) -> None:
    """Log a warning, which goes to standard error where logging is not set up."""
    if compiling(simulation=simulation, identification=identification):
        logging.getLogger("ehadiag").warning("ehadiag: %s", NOTICE)
