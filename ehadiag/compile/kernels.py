"""The project's one compiler decorator: numba options, and a cache that cannot go stale."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from ehadiag.compile.kernel_cache import KernelCache

__all__ = [
    "bare_kernel",
    "brief_kernel",
    "inlined",
    "inlined_exact",
    "kernel",
    "merged",
]

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile on first call: no interpreter lock, IEEE division, cached on disk."""
    return _cached(numba.njit(nogil=True, error_model="numpy")(function), function)


def bare_kernel(function: F) -> F:
    """Compile like `kernel` what allocates nothing: numba then counts no references to arrays."""
    return _cached(numba.njit(nogil=True, error_model="numpy", _nrt=False)(function), function)


def brief_kernel(function: F) -> F:
    """Compile like `kernel`, for calls of a microsecond: the interpreter lock is kept.

    To give it back and take it again costs more than such a call, and beside a thread that runs
    Python it may take milliseconds.
    """
    return _cached(numba.njit(error_model="numpy")(function), function)


def _cached(dispatcher: Any, function: F) -> F:
    if hasattr(dispatcher, "enable_caching"):  # absent with NUMBA_DISABLE_JIT=1
        dispatcher._cache = KernelCache(function)
    return cast("F", dispatcher)


def inlined(function: F) -> F:
    """Compile as a part of the kernels that call it: named tuples cost nothing to hand over.

    A product and a sum may become one instruction with one rounding, nothing else is loosened.
    """
    return numba.njit(nogil=True, error_model="numpy", forceinline=True, fastmath={"contract"})(
        function
    )


def merged(function: F) -> F:
    """Make it a part of the one kernel that calls it, with that one's options.

    Unlike `inlined` it is not compiled by itself before, and what it calls with it.
    """
    return cast("F", numba.njit(inline="always")(function))


def inlined_exact(function: F) -> F:
    """Compile like `inlined`, with each product and each sum rounded by itself."""
    return numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)
