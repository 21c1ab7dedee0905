"""Compiled kernels on disk: never stale, never another user's, and thrown away when damaged.

numba's own file cache does not see edits in another module that a kernel inlines, trusts whatever
lies where it looks, and ends in a traceback where a file is damaged or cannot be written. Here each
compiled kernel is one file in a private folder (`ehadiag.core.cache_folder`) whose name holds the
versions of the compiler and a hash of *all* kernel sources. A file begins with the digest of the
rest, so that nothing is unpickled but what was written whole. Without a folder kernels are compiled
in memory.
"""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import caching, environment, serialize
from numba.core.runtime import rtsys

from ehadiag.core.cache_folder import private_folder, tell
from ehadiag.core.errors import reason_of
from ehadiag.core.folder import Folder

__all__ = ["KernelCache", "cache_folder", "kept_kernels", "source_hash"]

KERNEL_FOLDERS = (
    "ehadiag/compile",
    "ehadiag/model",
    "ehadiag/identify",
    "ehadiag/monitor",
    "ehadiag/onboard",
    "ehadiag_sim",
)
SUFFIX = ".kernel"
DIGEST = hashlib.sha256
MAX_BYTES = 64 << 20
"""Of one compiled kernel; the largest has some hundred kilobytes."""


@cache
def cache_folder() -> Folder | None:
    """Folder of compiled kernels, opened once; None where nothing can be kept."""
    return private_folder(f"kernels-{source_hash()}")


def kept_kernels() -> list[str]:
    """Names of the files of compiled kernels; they hold the modules that the kernels are of."""
    folder = cache_folder()
    return [] if folder is None else [name for name in folder.names() if name.endswith(SUFFIX)]


@cache
def source_hash() -> str:
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


class KernelCache(caching.FunctionCache):
    """What numba asks for the compiled code of one function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        # Not that of the base class: it looks for a place among the sources.
        self._py_func = function
        self._impl = _Contents()
        self._module = function.__module__.replace(".", "_")
        self._place = f"{function.__name__}-{function.__code__.co_firstlineno}"
        self.enable()

    @property
    def cache_path(self) -> str:
        """Where it is kept, for numba's own messages."""
        folder = cache_folder()
        return "memory" if folder is None else str(folder.path)

    def flush(self) -> None:
        """Nothing: a file that does not fit is thrown away when it is read."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load compiled code; None where it must be compiled.

        Without the compiler's tables of Python and numpy: they take 0.2 s and 60 MB, and only who
        compiles needs them (numba loads them then). Machine code needs the symbols of the runtime.
        """
        folder = cache_folder()
        if folder is None or not self._enabled:
            return None
        rtsys.initialize(target_context)
        key = self._index_key(sig, target_context.codegen())
        name = self._name(key)
        try:
            content = folder.read(name, MAX_BYTES)
        except FileNotFoundError:
            return None
        except OSError as error:
            _discard(folder, name, reason_of(error))
            return None
        size = DIGEST().digest_size
        if DIGEST(content[size:]).digest() != content[:size]:
            _discard(folder, name, "damaged")
            return None
        try:
            kept, payload = pickle.loads(memoryview(content)[size:])
            return self._impl.rebuild(target_context, payload) if kept == key else None
        except Exception as error:  # whatever the compiler makes of what it wrote itself
            _discard(folder, name, f"not understood ({type(error).__name__})")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code, if there is a place for it."""
        folder = cache_folder()
        if folder is None or not self._enabled or not self._impl.check_cachable(data):
            return
        key = self._index_key(sig, data.codegen)
        content = serialize.dumps((key, self._impl.reduce(data)))
        try:
            folder.write(self._name(key), DIGEST(content).digest() + content, synced=False)
        except OSError as error:
            tell(
                f"cache folder {folder.path}: {reason_of(error)}; the compiled kernels are"
                " not kept for the next run"
            )

    def _name(self, key: Any) -> str:
        """File of the code for these types and this processor."""
        return f"{self._module}-{self._place}-{DIGEST(repr(key).encode()).hexdigest()[:16]}{SUFFIX}"


def _discard(folder: Folder, name: str, why: str) -> None:
    """Throw a file away, and say so."""
    tell(f"cache folder {folder.path}: a compiled kernel is {why}; thrown away, compiled again")
    try:
        folder.remove(name)
    except OSError as error:
        tell(f"cache folder {folder.path}: {reason_of(error)}")


class _Contents(caching.CompileResultCacheImpl):
    """What of a compiled function is kept."""

    def __init__(self) -> None:
        pass  # the base class looks for a place among the sources

    def reduce(self, cres: Any) -> tuple[Any, ...]:
        """Return what is pickled of a compiled kernel."""
        *head, environments = super().reduce(cres)
        return (*head, tuple(_bare_if_empty(item) for item in environments))

    def check_cachable(self, cres: Any) -> bool:
        """Whether the code holds no addresses of this process."""
        lifted = any(not item.can_cache for item in cres.lifted)
        return not lifted and not cres.library.has_dynamic_globals


class _BareEnvironment:
    """Stands in the cache for the environment of a function of numba that a kernel has inlined.

    Unpickling the environment itself loads the module that the function is of, for constants that
    the function does not have.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return environment._rebuild_env, ("numba", [], self._name)


def _bare_if_empty(item: Any) -> Any:
    foreign = str(item.globals["__name__"]).startswith("numba.")
    return _BareEnvironment(item.env_name) if foreign and not item.consts else item
