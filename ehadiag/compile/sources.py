"""Hashes of kernel sources, and the cache folder of what was compiled from them.

A hash covers a module and all project modules that it imports, without docstrings and comments.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from firmware_iface.errors import reason_of
from firmware_iface.files import Folder, private_folder, warn_once

PACKAGES = ("ehadiag", "firmware_iface", "ehadiag_sim")
"""Packages whose modules hold kernels, or numbers and functions that kernels use."""
KERNEL_DIGEST = hashlib.sha256
MAX_LIBRARY_BYTES = 64 << 20
"""Size of a file in the folder, bytes, at most; the largest library has half a megabyte."""
SOURCE_DIGESTS_FILE = "sources.json"
"""Digests of source files by the hash of their bytes: parsing all of them takes 0.3 s."""
PREBUILT = Path(__file__).parent.parent / "_kernels"
"""Folder of the libraries that came with the package."""


@cache
def cache_folder() -> Folder | None:
    """Folder of compiled libraries, opened once; None where there is none."""
    return private_folder("kernels")


def read_cached(file: str) -> bytes | None:
    """Read compiled code from the cache folder; a damaged file is removed."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        content = folder.read(file, MAX_LIBRARY_BYTES)
        size = KERNEL_DIGEST().digest_size
        if KERNEL_DIGEST(content[size:]).digest() == content[:size]:
            return content[size:]
        why = "damaged"
    except FileNotFoundError:
        return None
    except OSError as error:
        why = reason_of(error)
    warn_once(f"cache folder {folder.path}: a compiled kernel is {why}; thrown away")
    try:
        folder.remove(file)
    except OSError as error:
        warn_once(f"cache folder {folder.path}: {reason_of(error)}")
    return None


def cached(file: str, compile_code: Callable[[], bytes]) -> bytes:
    """Compiled code of the cache folder; code that is not in it is compiled, and kept there."""
    folder, found = cache_folder(), read_cached(file)
    if found is not None or folder is None:
        return found or compile_code()
    from filelock import FileLock  # noqa: PLC0415 - only where something is compiled

    content = b""
    try:
        with FileLock(folder.path / f"{file}.lock"):  # another process may be compiling the same
            content = read_cached(file) or compile_code()
            folder.write(file, KERNEL_DIGEST(content).digest() + content, synced=False)
    except OSError as error:
        warn_once(
            f"cache folder {folder.path}: {reason_of(error)}; the compiled kernels are"
            " not kept for the next run"
        )
    return content or compile_code()


@cache
def source_hash(module: str) -> str:
    """Hash of a module and of all project modules that it imports, without docstrings and comments.

    Imports within functions do not count: kernels know the names of their module only.
    """
    digests = sorted((name, item.digest) for name, item in sources_of(module).items())
    return KERNEL_DIGEST(repr(digests).encode()).hexdigest()[:16]


class Source(NamedTuple):
    """Source file of a module."""

    key: str
    """Hash of its bytes."""
    digest: str
    """Hash of its code."""
    imported: tuple[str, ...]
    """Project modules that it imports, and names that may be modules."""


def sources_of(module: str) -> dict[str, Source]:
    """Source files of a module and of all project modules that it imports, by module."""
    found: dict[str, Source] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        if name not in found and (item := _source(name)) is not None:
            found[name] = item
            pending += item.imported
    return found


@cache
def _source(module: str) -> Source | None:
    """Source file of a module; None where it is no module."""
    package, *parts = module.split(".")
    root = _folder_of(package)
    if root is None:
        return None
    folder = os.path.join(root, package, *parts)
    for path in (os.path.join(folder, "__init__.py"), f"{folder}.py"):
        if os.path.basename(path) in _names(os.path.dirname(path)):
            return _digest(Path(path).read_bytes(), package)
    return None


@cache
def _folder_of(package: str) -> str | None:
    """Where a package or a module of the top level is; hundreds of names are looked up there."""
    roots = dict.fromkeys((str(Path(__file__).parents[2]), *sys.path))
    return next((root for root in roots if {package, f"{package}.py"} & _names(root)), None)


@cache
def _names(folder: str) -> frozenset[str]:
    with contextlib.suppress(OSError):
        return frozenset(os.listdir(folder))
    return frozenset()


def _digest(content: bytes, package: str) -> Source:
    key, kept = KERNEL_DIGEST(content).hexdigest(), kept_digests()
    if key not in kept:
        tree = ast.parse(content)
        imported = sorted(_imported(tree, {package, *PACKAGES}))
        for node in ast.walk(tree):
            if isinstance(body := getattr(node, "body", None), list):
                body[:] = [item for item in body if not _is_text(item)]
        kept[key] = [KERNEL_DIGEST(ast.dump(tree).encode()).hexdigest(), imported]
        _keep_digests(kept)
    digest, imported = kept[key]
    return Source(key, digest, tuple(imported))


def _is_text(node: ast.AST) -> bool:
    """Whether a statement is a docstring."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _imported(tree: ast.Module, packages: set[str]) -> Iterator[str]:
    """Project modules that a module imports when it is loaded; also names that may be modules."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            names = [item.name for item in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{item.name}" for item in node.names)]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in packages)


@cache
def kept_digests() -> dict[str, Any]:
    """Digests of source files that came with the package or that earlier processes worked out."""
    kept: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError):
        kept |= json.loads((PREBUILT / SOURCE_DIGESTS_FILE).read_bytes())
    folder = cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError, ValueError, TypeError):
            kept |= json.loads(folder.read(SOURCE_DIGESTS_FILE, MAX_LIBRARY_BYTES))
    return kept


def _keep_digests(digests: dict[str, Any]) -> None:
    folder = cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError):  # the next process works them out, too
            folder.write(SOURCE_DIGESTS_FILE, json.dumps(digests).encode(), synced=False)
