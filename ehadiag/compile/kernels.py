"""The project's one compiler decorator: numba options, and a cache that cannot go stale.

numba's own file cache does not see edits in another module that a kernel inlines, and finds no
place to write in a read-only installation without HOME. Here every compiled kernel lives in one
folder keyed by the versions of the compiler and a hash of *all* kernel sources.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite
import numba
import numpy as np
from numba.core import caching, environment
from numba.core.runtime import rtsys

from ehadiag.core.cache_folder import private_folder

__all__ = [
    "bare_kernel",
    "brief_kernel",
    "cache_folder",
    "inlined",
    "inlined_exact",
    "kernel",
    "merged",
]

F = TypeVar("F", bound=Callable[..., Any])

KERNEL_FOLDERS = (
    "ehadiag/compile",
    "ehadiag/model",
    "ehadiag/identify",
    "ehadiag/monitor",
    "ehadiag_sim",
)


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
        dispatcher._cache = _KernelCache(function)
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


@cache
def cache_folder() -> Path:
    """Return the folder of compiled kernels, created if need be; see `private_folder`."""
    folder = private_folder(f"kernels-{_digest()}")
    return folder or Path(tempfile.mkdtemp(prefix="ehadiag-"))


@cache
def _digest() -> str:
    """Hash of compiler versions and of every kernel source that is installed."""
    digest = hashlib.sha256()
    for part in (sys.version, np.__version__, numba.__version__, llvmlite.__version__):
        digest.update(part.encode())
    for folder in KERNEL_FOLDERS:
        for root in dict.fromkeys((Path(__file__).parents[2], *map(Path, sys.path))):
            sources = sorted((root / folder).rglob("*.py"))
            for source in sources:
                digest.update(str(source.relative_to(root)).encode())
                digest.update(source.read_bytes())
            if sources:
                break
    return digest.hexdigest()[:16]


class _Locator:
    """Tells numba where one function's index and machine code go."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._module = function.__module__.replace(".", "_")

    def ensure_cache_path(self) -> None:
        cache_folder().mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(cache_folder())

    def get_source_stamp(self) -> str:
        return _digest()

    def get_disambiguator(self) -> str:
        return f"{self._module}-{self._lineno}"

    @classmethod
    def from_function(cls, function: Callable[..., Any], _source: str) -> _Locator:
        return cls(function)


class _BareEnvironment:
    """Stands in the cache for the environment of a function of numba that a kernel has inlined.

    Unpickling the environment itself loads the module that the function is of, for constants that
    the function does not have.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return environment._rebuild_env, ("numba", [], self._name)


class _KernelCacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = (_Locator,)

    def reduce(self, cres: Any) -> tuple[Any, ...]:
        """Return what is pickled of a compiled kernel."""
        *head, environments = super().reduce(cres)
        return (*head, tuple(_bare_if_empty(item) for item in environments))


def _bare_if_empty(item: Any) -> Any:
    foreign = str(item.globals["__name__"]).startswith("numba.")
    return _BareEnvironment(item.env_name) if foreign and not item.consts else item


class _KernelCache(caching.FunctionCache):
    _impl_class = _KernelCacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load compiled code without the compiler's tables of Python and numpy.

        They take 0.2 s and 60 MB, and only who compiles needs them (numba loads them then). Machine
        code needs the symbols of the runtime.
        """
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)
